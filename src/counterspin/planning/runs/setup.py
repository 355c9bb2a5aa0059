"""What is planned, as the calculation sees it: instruments, attitudes, unknowns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.motion import Site
from counterspin.physics.observation import ORDERS
from counterspin.physics.terms import INPUTS


@frozen
class PlannedInstrument:
    """One accelerometer as a plan sees it."""

    #: As in `Series`.
    name: str
    mounting: Mounting
    observable: str
    noise: Noise  #: Of one sample.
    timing: float = 0.0  #: Standard deviation of the time stamps, s.

    @property
    def order(self) -> int:
        """How often the observable integrates the specific force."""
        return ORDERS[self.observable]


def expected_record(
    series: Series, expected: Mapping[Unknown, float], scale_factor: float
) -> Series:
    """Return a record with the errors that are expected of it, but for those of inputs.

    expected: Values less nominal.
    scale_factor: K_I, with which the accelerometer sees the platform's errors.
    """
    own = [u for u in expected if expected[u] and u.symbol not in INPUTS and u.concerns(series)]
    columns = series.columns([u.symbol for u in own], scale_factor)
    return replace(series, error=columns @ [expected[u] for u in own])


@frozen
class Setup:
    """What is planned: instruments, attitudes, unknowns."""

    instruments: tuple[PlannedInstrument, ...]  #: The accelerometers.
    #: Name -> rows x, y, z in east-north-up, shape (3, 3). The model has the unknowns that belong
    #: to a run, such as its tilt, once for each of these names.
    attitudes: dict[str, Array]
    #: m; where the centrifuge stands.
    radius: float
    site: Site
    sampling_rate: float  #: Samples a second, Hz.
    model: Unknowns  #: What is estimated and considered.
    #: Expected values of the unknowns, less nominal, shape (p,); the uncertain inputs act on them.
    estimate: Array
    scale_factors: dict[str, float]  #: K_I of each accelerometer.

    @cached_property
    def shared(self) -> tuple[int, ...]:
        """Places of the unknowns that all runs share, in the model."""
        unknowns = enumerate(self.model.unknowns)
        return tuple(i for i, unknown in unknowns if unknown.owner not in self.attitudes)

    @cached_property
    def considered(self) -> tuple[int, ...]:
        """Places of the considered terms that all runs share."""
        owners = [other.owner for other in self.model.considered]
        return tuple(i for i, owner in enumerate(owners) if owner not in self.attitudes)

    def own(self, attitude: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the places of a run's own unknowns and of its own considered terms."""
        model = self.model
        return (
            tuple(i for i, unknown in enumerate(model.unknowns) if unknown.owner == attitude),
            tuple(i for i, other in enumerate(model.considered) if other.owner == attitude),
        )

    @property
    def considered_sizes(self) -> Array:
        """Standard uncertainties of all considered columns, in the model's order."""
        return np.array(self.model.considered_sizes)
