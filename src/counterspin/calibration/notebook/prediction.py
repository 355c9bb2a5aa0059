"""What a calibrated accelerometer will indicate, with the uncertainty of that."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.calibration.notebook.instrument import instrument_of, with_unstated
from counterspin.frozen import frozen
from counterspin.physics.correction import indication

if TYPE_CHECKING:
    from counterspin.calibration.result import Result


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


def predict(
    result: Result,
    accelerometer: str,
    force: npt.ArrayLike,
    pendulous: npt.ArrayLike,
    output_axis: npt.ArrayLike,
) -> Prediction:
    """Return what an accelerometer of a result indicates; see `Result.predict`."""
    given = (np.atleast_1d(np.asarray(part, float)) for part in (force, pendulous, output_axis))
    axes = np.stack(np.broadcast_arrays(*given))
    if axes.ndim != 2 or not axes.size or not np.isfinite(axes).all():
        raise ValueError("specific forces are finite numbers, or arrays of one and the same length")
    whole, _ = with_unstated(result, ("I", "|I|", "P", "O"))
    return Prediction(*indication(instrument_of(whole, accelerometer), axes))
