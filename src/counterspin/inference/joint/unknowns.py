"""What a joint fit estimates, what it considers, and which inputs are uncertain.

- `Unknown`, `Considered`: terms of the accelerometers, of the platform, of a run's rotation
- `Unknowns`: all of them
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from counterspin.frozen import frozen
from counterspin.inference.joint.series import Series
from counterspin.inference.least_squares import REGULARISATION
from counterspin.physics.terms import OWN_TERMS, SHARED_TERMS, TERMS, shown_by_readings

#: Rotation of a run as unknowns, where no angle is recorded: rad, rad/s, 1/s.
ROTATION: Final = ("spindle.start_angle", "spindle.rate", "spindle.drift")


@frozen
class Unknown:
    """One unknown of the joint fit.

    Attributes
    ----------
    owner
        The accelerometer's name, the run's name, or empty for what all share.
    symbol
        A term of the table, one of `ROTATION` or of `counterspin.inference.joint.encoder.SYMBOLS`.
    prior
        (value, standard uncertainty) of the coefficient; infinite: nothing known.
    limit
        Largest credible size.
    asked
        Whether anybody wants to know it; else it is there because others cannot be told from it.
    """

    owner: str
    symbol: str
    prior: tuple[float, float]
    limit: float
    asked: bool = True

    @property
    def nominal(self) -> float:
        """What the coefficient is in a perfect system."""
        return TERMS[self.symbol].nominal if self.symbol in TERMS else 0.0

    @property
    def prior_mean(self) -> float:
        """The prior's value less nominal; where nothing is known, nominal itself, which is 0."""
        return self.prior[0] - self.nominal if math.isfinite(self.prior[1]) else 0.0

    @property
    def spread(self) -> float:
        """The prior's u; where nothing is known, that of the solver's numerical regularisation."""
        return self.prior[1] if math.isfinite(self.prior[1]) else REGULARISATION * self.limit

    @property
    def name(self) -> str:
        """Owner and symbol in one word."""
        return f"{self.owner}.{self.symbol}" if self.owner else self.symbol

    def concerns(self, series: Series) -> bool:
        """Return whether the unknown can show in a series."""
        if self.symbol in OWN_TERMS:
            return self.owner == series.accelerometer
        if self.symbol not in SHARED_TERMS and shown_by_readings(self.symbol):
            return False
        return self.owner in ("", series.run)


@frozen
class Considered(Unknown):
    """A term that is not estimated: its prior's value is taken, its uncertainty carried."""


@frozen
class Unknowns:
    """What is estimated, what is considered, and which inputs are uncertain.

    Attributes
    ----------
    unknowns, considered
        In the order of the solution's rows and considered columns.
    inputs
        Input (a key of `inputs.INPUTS`, or `inputs.TIMING`) -> standard uncertainty, SI;
        considered too.
    """

    unknowns: tuple[Unknown, ...]
    considered: tuple[Considered, ...] = ()
    inputs: Mapping[str, float] | None = None

    @property
    def considered_names(self) -> tuple[str, ...]:
        """Names of the solution's considered columns."""
        return (*(c.name for c in self.considered), *(self.inputs or ()))

    @property
    def considered_means(self) -> list[float]:
        """Assumed values of the solution's considered columns, less nominal."""
        return [*(c.prior_mean for c in self.considered), *(0.0 for _ in self.inputs or ())]

    @property
    def considered_sizes(self) -> list[float]:
        """Standard uncertainties of the solution's considered columns."""
        return [*(c.prior[1] for c in self.considered), *(self.inputs or {}).values()]
