"""The parts of a campaign as the calculation sees them: SI and g-units, names resolved.

Accelerometer coefficients are in g-units; everything else is SI, angles in rad. `Quantity`
carries a standard uncertainty; a plain number is exact.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Final

from counterspin.campaign.quantity import Quantity
from counterspin.campaign.settings import Output, StatedNoise
from counterspin.frozen import frozen
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.grades import DEFAULT_GRADE
from counterspin.physics.spindle import Spindle
from counterspin.records.record import ColumnSpec

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
class Accelerometer:
    """One accelerometer under calibration."""

    name: str  #: Its name in the campaign.
    #: Its axes while the platform is level; `Mounting.turned` gives those of a run's attitude.
    mounting: Mounting
    observable: str  #: ``displacement``, ``velocity`` or ``specific_force``.
    channel: ColumnSpec  #: The column with it.
    #: Term symbol -> what is known beforehand, in g-units (`bias` is K_F, `scale_factor` K_I);
    #: those of [model.priors] that apply to this accelerometer are included. u = 0 means known
    #: exactly. A term here that the model neither estimates nor considers has this value.
    priors: Mapping[str, Quantity]
    serial_number: str | None = None  #: Free text, or None.
    output: Output | None = None  #: What its readings are in; None: g or m/s^2.
    #: The column of specific force in records on an arm or at rest; None if there are none.
    force: ColumnSpec | None = None
    #: One of `counterspin.physics.grades.GRADES`: how large its terms may be.
    grade: str = DEFAULT_GRADE


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


@frozen
class Simulation:
    """How `counterspin simulate` makes the records."""

    sampling_rate: float  #: Samples a second, Hz.
    seed: int  #: Of the random numbers.
    truth: SimulatedTruth  #: What it makes them from.
    poses: int = 24  #: In a record of poses.


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
