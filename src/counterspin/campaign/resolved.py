"""A campaign as the calculation sees it: SI and g-units, names resolved, defaults filled in.

Accelerometer coefficients are in g-units; everything else is SI, angles in rad. `Quantity`
carries a standard uncertainty; a plain number is exact.

- `Campaign`: all of it; `Channel`, `Accelerometer`, `StatedNoise`, `ErrorModel`, `Run`: its parts
- `sample_count`: rows of a record of known length
- `Simulation`, `SimulatedTruth`, `RunTruth`: what `counterspin simulate` makes the records from
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from counterspin.arrays import Array
from counterspin.campaign.machine import MachineModel
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.readings import Output, Reading
from counterspin.campaign.specification import Specifications
from counterspin.errors import CampaignError
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.motion import Site
from counterspin.physics.spindle import Spindle


def sample_count(duration: float, sampling_rate: float) -> int:
    """Return the samples of a record from t = 0 to the last one within its duration.

    Parameters
    ----------
    duration, sampling_rate
        s, Hz. A sample that falls on the end but for rounding is within.
    """
    return math.floor(duration * sampling_rate * (1.0 + 1e-12)) + 1


@dataclass(frozen=True)
class Channel:
    """One column of the record files.

    Attributes
    ----------
    column
        Its name in the file.
    factor
        Factor from its numbers to SI: s, rad, m, m/s or m/s^2. Of a specific force recorded in g
        it is the site's gravity.
    unit
        The unit in the file, as the campaign writes it.
    """

    column: str
    factor: float
    unit: str


@dataclass(frozen=True)
class Accelerometer:
    """One accelerometer under calibration.

    Attributes
    ----------
    name
        Its name in the campaign.
    mounting
        Its axes while the platform is level; `Mounting.turned` gives those of a run's attitude.
    observable
        ``displacement``, ``velocity`` or ``specific_force``.
    channel
        The column with it.
    priors
        Term symbol -> what is known beforehand, in g-units (`bias` is K_F, `scale_factor` K_I);
        those of [model.priors] that apply to this accelerometer are included. u = 0 means known
        exactly. A term here that the model neither estimates nor considers has this value.
    serial_number
        Free text, or None.
    output
        What its readings are in; None: g or m/s^2.
    """

    name: str
    mounting: Mounting
    observable: str
    channel: Channel
    priors: Mapping[str, Quantity]
    serial_number: str | None = None
    output: Output | None = None


@dataclass(frozen=True)
class StatedNoise:
    """Noise of the records: SI, or ``"estimate"`` where it is to be estimated from residuals.

    Attributes
    ----------
    displacement, velocity, specific_force
        White noise of the observable, standard deviation a sample: m, m/s, m/s^2.
    acceleration
        White noise of the accelerometer, random-walk coefficient N: m/s^2/Hz^0.5.
    quantisation
        Step of the recorded displacement, m.
    angle, timing
        White noise of the encoder and of the time stamps, rad and s.
    """

    displacement: float | str = 0.0
    velocity: float | str = 0.0
    specific_force: float | str = 0.0
    acceleration: float | str = 0.0
    quantisation: float | str = 0.0
    angle: float | str = 0.0
    timing: float | str = 0.0


@dataclass(frozen=True)
class ErrorModel:
    """Which terms are estimated and which are carried in the uncertainty.

    Attributes
    ----------
    terms
        Symbols to estimate; bare names are resolved to the components that act.
    considered
        Symbols that are not estimated but whose prior enters the uncertainty.
    priors
        Symbol of a shared term -> prior, SI (tilt: one of each run). Those of accelerometer terms
        are in `Accelerometer.priors`.
    limits
        Every symbol of the term tables -> its largest credible size, in the table's unit.
    typical
        Likewise -> the standard uncertainty to assume of a term that the model leaves out.
    """

    terms: tuple[str, ...]
    considered: tuple[str, ...]
    priors: Mapping[str, Quantity]
    limits: Mapping[str, float]
    typical: Mapping[str, float]


@dataclass(frozen=True)
class RunTruth:
    """True spindle motion and platform errors of one simulated run.

    Attributes
    ----------
    spindle
        The true motion of the spindle.
    shared
        Symbol of a shared term -> true value, SI; those that are zero are left out.
    """

    spindle: Spindle
    shared: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Run:
    """One run at constant nominal rate.

    Attributes
    ----------
    name
        Its name, unique in the campaign.
    rate
        Nominal rate, rad/s; negative for the sense from east towards south.
    record
        Absolute path of the record file.
    attitude
        Where the platform's x, y, z axes point in east-north-up, as rows, shape (3, 3).
    duration
        Length of the record in s, as planned or simulated; None where it is not stated.
    truth
        Truth of a simulated run; None where nothing is to be simulated. A calibration does not
        read it.
    """

    name: str
    rate: float
    record: Path
    attitude: Array
    duration: float | None = None
    truth: RunTruth | None = None


@dataclass(frozen=True)
class SimulatedTruth:
    """True values of the simulated accelerometers; platform and spindle are in `RunTruth`.

    Attributes
    ----------
    coefficients
        Accelerometer -> term symbol -> true value in g-units; terms not named are nominal.
    start_offset, start_velocity
        Accelerometer -> error of the displacement at the start of each run and of its rate of
        change: m, m/s.
    noise
        True noise; every component a number.
    """

    coefficients: Mapping[str, Mapping[str, float]]
    start_offset: Mapping[str, float]
    start_velocity: Mapping[str, float]
    noise: StatedNoise


@dataclass(frozen=True)
class Simulation:
    """How `counterspin simulate` makes the records.

    Attributes
    ----------
    sampling_rate
        Samples a second, Hz.
    seed
        Of the random numbers.
    truth
        What it makes them from.
    """

    sampling_rate: float
    seed: int
    truth: SimulatedTruth


@dataclass(frozen=True)
class Campaign:
    """A campaign description, checked and resolved.

    Attributes
    ----------
    title
        [campaign] title; the folder's name if there is none.
    path, folder
        The description's file and its folder, absolute.
    site
        Gravity and latitude as plain numbers, for the physics.
    gravity, latitude, radius
        The same with their uncertainties: m/s^2, rad, m.
    time
        Column of the time, in s.
    angle
        Column of the spindle's angle, in rad; None: the nominal rate is taken.
    timing_offset
        How much later than its displacement the angle of a row was sampled, s; None: not stated.
    accelerometers
        By name, in the file's order.
    noise
        None: to be estimated from the residuals.
    model
        Terms, priors and limits.
    runs
        In the file's order; names and records are unique.
    simulation
        None if the file has neither [simulation] nor [truth].
    details
        What else [campaign] states (`serial_number`, `date`, `laboratory`, `operator`,
        `comment`), only what is there.
    specifications
        Tolerance limits of the coefficients; None if the file states none.
    checksum
        SHA-256 of the description as it was read, such as ``sha256:9f86...``; None if it was made
        otherwise.
    """

    title: str
    path: Path
    folder: Path
    site: Site
    gravity: Quantity
    latitude: Quantity
    radius: Quantity
    time: Channel
    angle: Channel | None
    timing_offset: Quantity | None
    accelerometers: Mapping[str, Accelerometer]
    noise: StatedNoise | None
    model: ErrorModel
    runs: tuple[Run, ...]
    simulation: Simulation | None
    details: Mapping[str, str]
    specifications: Specifications | None = None
    readings: tuple[Reading, ...] = ()
    machine: MachineModel = field(default_factory=MachineModel)
    reference_temperature: float | None = None
    tables: tuple[Path, ...] = ()
    checksum: str | None = None

    def require_records(self, what: str) -> None:
        """Raise CampaignError if there is no record, which `what` needs, or a reading beside."""
        if self.readings:
            raise CampaignError(
                str(self.path),
                [f"runs: {what} takes records of a double turntable; this campaign has readings"],
            )
