"""The parts of a campaign as the calculation sees them: SI and g-units, names resolved.

Accelerometer coefficients are in g-units; everything else is SI, angles in rad. `Quantity`
carries a standard uncertainty; a plain number is exact.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated, Final

from pydantic import AfterValidator, Field, PrivateAttr

from counterspin.campaign.kinds import (
    PositiveRatio,
    SettingsSection,
    described,
    positive,
    read_exactly,
)
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.settings import StatedNoise
from counterspin.frozen import frozen
from counterspin.physics.spindle import Spindle

#: Most rows, those of all accelerometers together, that are computed at once of records that exist
#: only on paper. A line of a description can state any length, and what is made from it takes
#: memory and time in proportion: at the bound, below 2 GB and about a minute. What is read from
#: files has no such bound.
MOST_ROWS: Final = 1_500_000

#: Most rows of a simulated run; runs are made one after the other, and written.
MOST_SIMULATED_ROWS: Final = 5_000_000

#: Most readings of a campaign, and most records, one for each run and accelerometer, of which a
#: forecast or a study is made.
MOST_READINGS: Final = 10_000
MOST_RECORDS: Final = 60

#: In ``assume``: whatever is not stated.
EVERYTHING: Final = "all"


def sample_count(duration: float, sampling_rate: float) -> int:
    """Return the samples of a record from t = 0 to the last one within its duration.

    duration, sampling_rate: s, Hz. A sample that falls on the end but for rounding is within.
    """
    return math.floor(duration * sampling_rate * (1.0 + 1e-12)) + 1


@frozen
class RunTruth:
    """True spindle motion and platform errors of one simulated run."""

    spindle: Spindle  #: The true motion of the spindle.
    #: Symbol of a shared term -> true value, SI; those that are not there are zero.
    shared: Mapping[str, float]


@frozen
class SimulatedTruth:
    """What is true of a simulated campaign; no calibration reads it."""

    #: Accelerometer -> term symbol -> true value in g-units; terms not named are nominal.
    coefficients: Mapping[str, Mapping[str, float]]
    #: Accelerometer -> error of the displacement at the start of each run and of its rate of
    #: change: m, m/s.
    start_offset: Mapping[str, float]
    start_velocity: Mapping[str, float]
    noise: StatedNoise  #: True noise of records; every component a number.
    runs: Mapping[str, RunTruth]  #: Run -> what is true of its motion and of what all share.
    #: Recorder (of its clock; else empty) and input -> true value, SI; those that are not there are
    #: what the description states.
    inputs: Mapping[tuple[str, str], float] = field(default_factory=dict)
    #: Term of the machine -> true value less nominal, SI.
    machine: Mapping[str, float] = field(default_factory=dict)
    #: Accelerometer -> true noise of its readings, g; of one that is not named, each reading has
    #: that which is stated with it.
    reading_noise: Mapping[str, float] = field(default_factory=dict)


class Simulation(SettingsSection):
    """[simulation]: how `counterspin simulate` samples."""

    sampling_rate: Annotated[float, read_exactly("Hz"), AfterValidator(positive)] = described(
        "rows a second", "100 Hz", 50.0, absent="50 Hz"
    )
    seed: Annotated[int, Field(ge=0)] = described(
        "of the random numbers; each run has a stream of its own", 7, 1
    )
    revolutions: PositiveRatio = described("of each run", 40, 100.0)
    poses: Annotated[int, Field(ge=1, le=10_000)] = described(
        "in a record of [poses](triads.md#poses-in-a-record)", 12, 24
    )

    _truth: SimulatedTruth = PrivateAttr()

    @property
    def truth(self) -> SimulatedTruth:
        """What the records are made from."""
        return self._truth


@frozen
class ErrorModel:
    """Which terms are asked for, which are held, and which are taken as perfect.

    Everything else that acts is an unknown beside what is asked for.
    """

    #: Symbols asked for, those of mountings with their names; bare names are resolved to the
    #: components that act.
    terms: tuple[str, ...]
    #: Symbols that are held: known but not adjusted, their prior's u is carried.
    considered: tuple[str, ...]
    #: Symbol of a shared term -> prior, less nominal, SI (tilt: one of each run). Those of
    #: accelerometer terms are in `Accelerometer.priors`.
    priors: Mapping[str, Quantity]
    #: Symbol -> largest credible size, and standard uncertainty to assume where none is stated, in
    #: the table's unit: where the campaign states them. `Campaign.limit_of` and
    #: `Campaign.typical_of` know all.
    limits: Mapping[str, float]
    typical: Mapping[str, float]
    #: What is taken as perfect where nothing is stated: names, ``platform.*``, ``all``.
    assume: tuple[str, ...] = ()
    setting: Quantity | None = None  #: Error of setting a position at rest, where one is stated.

    def assumes(self, symbol: str) -> bool:
        """Return whether a term, or an input, is taken as perfect where nothing is stated."""
        names = (name.removesuffix("*").removesuffix(".") for name in self.assume)
        return any(
            name in ("", EVERYTHING) or symbol == name or symbol.startswith(f"{name}.")
            for name in names
        )
