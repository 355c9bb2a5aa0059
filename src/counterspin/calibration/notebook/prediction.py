"""What a calibrated accelerometer will indicate, with the uncertainty of that."""

from __future__ import annotations

from counterspin.arrays import Array
from counterspin.frozen import frozen


@frozen(eq=False)
class Prediction:
    """What an accelerometer indicates at specific forces."""

    indicated: Array  #: In g, shape (n,).
    #: Standard uncertainty from the coefficients, with what nothing states at its typical size; the
    #: noise of an indication is no part of it. In g, shape (n,).
    u: Array
    unit: str = "g"  #: Of both.

    def __repr__(self) -> str:
        """Return how many there are, and the extremes."""
        n = self.indicated.size
        low, high = float(self.indicated.min()), float(self.indicated.max())
        largest = float(self.u.max())
        return f"<{n} indications from {low:.6g} to {high:.6g} g, u at most {largest:.2g} g>"
