"""A campaign as the calculation sees it: SI and g-units, names resolved, defaults filled in.

Accelerometer coefficients are in g-units; everything else is SI, angles in rad. `Quantity`
carries a standard uncertainty; a plain number is exact.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from counterspin.arrays import Array
from counterspin.campaign.error_model import ErrorModel
from counterspin.campaign.machine import MachineModel
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.readings import Output, Reading
from counterspin.campaign.specification import Specifications
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.grades import DEFAULT_GRADE, Size
from counterspin.physics.motion import Site
from counterspin.physics.spindle import Spindle
from counterspin.physics.terms import term
from counterspin.records.dialect import TO_BE_FOUND, Dialect
from counterspin.records.memory import MemoryTable
from counterspin.records.record import ColumnKind, ColumnSpec

if TYPE_CHECKING:
    from counterspin.campaign.memory.source import Source


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


def sample_count(duration: float, sampling_rate: float) -> int:
    """Return the samples of a record from t = 0 to the last one within its duration.

    duration, sampling_rate: s, Hz. A sample that falls on the end but for rounding is within.
    """
    return math.floor(duration * sampling_rate * (1.0 + 1e-12)) + 1


@frozen
class Channel:
    """One column of the record files."""

    column: str  #: Its name in the file.
    #: Factor from its numbers to SI: s, rad, m, m/s or m/s^2. Of a specific force recorded in g it
    #: is the site's gravity.
    factor: float
    unit: str  #: The unit in the file, as the campaign writes it; empty text: the file says it.
    offset: float = 0.0  #: What is added then, SI: the direction of an encoder's zero, rad.
    #: The SI unit of what comes out; empty text: an output such as a current, as m/s^2.
    si_unit: str = ""
    #: As of `counterspin.records.record.ColumnSpec`.
    kind: ColumnKind = "numbers"
    per_revolution: float = 1.0

    def filed(self, values: Array) -> Array:
        """Return values in SI as the column has them."""
        filed: Array = (values - self.offset) / self.factor
        return filed

    def spec(self, gravity: float) -> ColumnSpec:
        """Return the column as the records know it; `gravity` is the site's, m/s^2."""
        return ColumnSpec(
            self.column,
            self.factor,
            self.offset,
            self.unit or None,
            self.si_unit,
            gravity,
            self.kind,
            self.per_revolution,
        )


@frozen
class Recording:
    """How a record is read: its time, its angle (or None), and how its file is written."""

    time: Channel
    angle: Channel | None
    dialect: Dialect = TO_BE_FOUND


@frozen
class Accelerometer:
    """One accelerometer under calibration."""

    name: str  #: Its name in the campaign.
    #: Its axes while the platform is level; `Mounting.turned` gives those of a run's attitude.
    mounting: Mounting
    observable: str  #: ``displacement``, ``velocity`` or ``specific_force``.
    channel: Channel  #: The column with it.
    #: Term symbol -> what is known beforehand, in g-units (`bias` is K_F, `scale_factor` K_I);
    #: those of [model.priors] that apply to this accelerometer are included. u = 0 means known
    #: exactly. A term here that the model neither estimates nor considers has this value.
    priors: Mapping[str, Quantity]
    serial_number: str | None = None  #: Free text, or None.
    output: Output | None = None  #: What its readings are in; None: g or m/s^2.
    #: The column of specific force in records on an arm or at rest; None if there are none.
    force: Channel | None = None
    #: One of `counterspin.physics.grades.GRADES`: how large its terms may be.
    grade: str = DEFAULT_GRADE


@frozen
class StatedNoise:
    """Noise of the records: SI, or ``"estimate"`` where it is to be estimated from residuals."""

    #: White noise of the observable, standard deviation a sample: m, m/s, m/s^2.
    displacement: float | str = 0.0
    velocity: float | str = 0.0
    specific_force: float | str = 0.0
    #: White noise of the accelerometer, random-walk coefficient N: m/s^2/Hz^0.5.
    acceleration: float | str = 0.0
    #: Wander of the accelerometer's bias: instability B, m/s^2, and random walk K, m/s^2/s^0.5.
    flicker: float | str = 0.0
    bias_walk: float | str = 0.0
    quantisation: float | str = 0.0  #: Step of the recorded displacement, m.
    #: White noise of the encoder and of the time stamps, rad and s.
    angle: float | str = 0.0
    timing: float | str = 0.0

    @property
    def wanders(self) -> bool:
        """Whether the bias wanders, or may."""
        return self.flicker != 0.0 or self.bias_walk != 0.0


@frozen
class RunTruth:
    """True spindle motion and platform errors of one simulated run."""

    spindle: Spindle  #: The true motion of the spindle.
    #: Symbol of a shared term -> true value, SI; those that are zero are left out.
    shared: Mapping[str, float]


@frozen(eq=False)
class Run:
    """One run at constant nominal rate."""

    name: str  #: Its name, unique in the campaign.
    rate: float  #: Nominal rate, rad/s; negative for the sense from east towards south.
    record: Path  #: Absolute path of the record file.
    #: Where the platform's x, y, z axes point in east-north-up, as rows, shape (3, 3).
    attitude: Array
    #: Length of the record in s, as planned or simulated; None where it is not stated.
    duration: float | None = None
    #: Truth of a simulated run; None where nothing is to be simulated. A calibration does not read
    #: it.
    truth: RunTruth | None = None
    #: K, and s of its beginning by any clock; None where they were not recorded.
    temperature: float | None = None
    time: float | None = None
    recording: Recording | None = None  #: How its record is read; None: as the campaign's others.
    #: From where to where the record is used, s in its own time.
    part: tuple[float, float] = (-math.inf, math.inf)
    continued_in: tuple[Path, ...] = ()  #: Files in which the record goes on.
    #: The file with the times of its pulses; None: they are in the record, if anywhere.
    pulses: Path | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """All its files, the record first."""
        return (self.record, *self.continued_in, *([self.pulses] if self.pulses else []))


@frozen
class SimulatedTruth:
    """True values of the simulated accelerometers; platform and spindle are in `RunTruth`."""

    #: Accelerometer -> term symbol -> true value in g-units; terms not named are nominal.
    coefficients: Mapping[str, Mapping[str, float]]
    #: Accelerometer -> error of the displacement at the start of each run and of its rate of
    #: change: m, m/s.
    start_offset: Mapping[str, float]
    start_velocity: Mapping[str, float]
    noise: StatedNoise  #: True noise of records; every component a number.
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


@frozen
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
    clock
        By how much of itself the recorder's clock runs fast; None: not stated.
    own_velocity
        Whether the navigation computer takes its own velocity for the Coriolis acceleration, and
        not the platform's.
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
    tables, table_checksums
        Files of readings, and SHA-256 of those that were read with the description.
    frames
        Records that are in memory, by the files in whose place they are.
    dialect
        How record files are written, as far as that is said.
    skipped
        Names of the runs that are left out.
    source
        The description that it was resolved from; None of a copy that `dataclasses.replace` made.
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
    table_checksums: Mapping[Path, str] = field(default_factory=dict)
    frames: Mapping[Path, MemoryTable] = field(default_factory=dict, repr=False)
    clock: Quantity | None = None
    own_velocity: bool = False
    dialect: Dialect = TO_BE_FOUND
    skipped: tuple[str, ...] = ()
    source: Source | None = field(default=None, init=False, repr=False, compare=False)

    def limit_of(self, symbol: str, owner: str = "") -> float:
        """Return the largest credible size of a term: as stated, or by the owner's grade.

        Parameters
        ----------
        symbol
            Of the table of terms.
        owner
            The accelerometer, for a term of its own; else it is no matter.
        """
        return self.model.limits.get(symbol) or self._size(symbol, owner).limit

    def typical_of(self, symbol: str, owner: str = "") -> float:
        """Return the standard uncertainty to assume of a term; parameters as of `limit_of`."""
        return self.model.typical.get(symbol) or self._size(symbol, owner).typical

    def _size(self, symbol: str, owner: str) -> Size:
        accelerometer = self.accelerometers.get(owner)
        return term(symbol).sizes(DEFAULT_GRADE if accelerometer is None else accelerometer.grade)

    def recording_of(self, run: Run) -> Recording:
        """Return how the record of a run is read."""
        return run.recording or Recording(self.time, self.angle, self.dialect)

    def record_at(self, file: Path) -> Path | MemoryTable:
        """Return the record in memory that stands in the place of a file, or else the file."""
        return self.frames.get(file, file)

    def change(self, **changes: Any) -> Campaign:
        """Return the campaign with named changes, checked as its description was.

        Parameters
        ----------
        **changes
            ``title``, ``gravity``, ``latitude``, ``radius``, ``terms``, ``considered``,
            ``priors``, ``noise``, ``truth``, ``seed``, ``sampling_rate``, or another section of
            ``campaign.toml``: what to write there. A mapping changes the keys it has; None takes
            a key away. ``accelerometers`` and ``runs``: the names of those that stay, or a
            mapping from names to changes. ``records``: as of `make_campaign`. Any other key is
            named with dots, ``**{"records.time.column": "t"}``.

        Raises
        ------
        CampaignError
            With every mistake, as of a file.

        Notes
        -----
        A prior takes the place of one in the accelerometer's own table (``bias``). Where terms
        are changed, the priors of those that are left out go with them.
        """
        from counterspin.campaign.memory.changes import change_campaign

        return change_campaign(self, changes)

    def join(self, *others: Campaign) -> Campaign:
        """Return one campaign with the runs of this one and of others, for one fit.

        Parameters
        ----------
        *others
            Of the same site, centrifuge, accelerometers, noise, model and columns.

        Returns
        -------
        Campaign
            A run whose name is taken has the campaign's number behind it, ``slow (2)``. The
            truth is kept where all have the same.

        Raises
        ------
        CampaignError
            With all that they do not have in common.
        """
        from counterspin.campaign.memory.joining import join_campaigns

        return join_campaigns([self, *others])

    def write(self, folder: Path | str, *, overwrite: bool = False) -> Path:
        """Write ``campaign.toml`` and all records, from which the same result comes.

        Parameters
        ----------
        folder
            Made if it is not there.
        overwrite
            Whether files that are already there may be replaced.

        Returns
        -------
        Path
            The description.

        Raises
        ------
        CounterspinError
            If a file is in the way, cannot be written, or a record is not there.
        """
        from counterspin.campaign.memory.writing import write_campaign

        return write_campaign(self, folder, overwrite=overwrite)

    def require_records(self, what: str) -> None:
        """Raise CampaignError if there is no record, which `what` needs, or a reading beside."""
        if self.readings:
            raise CampaignError(
                str(self.path),
                [f"runs: {what} takes records of a double turntable; this campaign has readings"],
            )


def paper_rows(rate: float, duration: float, sampling_rate: float, *, means: bool) -> float:
    """Return how many rows a record takes that is computed, not read.

    rate, duration, sampling_rate: rad/s, s, Hz.
    means: Whether the samples are averaged as `calibrate` does it.
    """
    from counterspin.records.reduction import BLOCKS_PER_REVOLUTION, block_size

    samples = duration * sampling_rate
    if means and rate:
        samples /= block_size(1.0 / sampling_rate, rate)
    # The integrals need about as many places in a revolution, however few samples it has.
    return max(samples, BLOCKS_PER_REVOLUTION * abs(rate) * duration / (2.0 * math.pi))


def require_room(
    campaign: Campaign, sampling_rate: float, purpose: Literal["forecast", "study", "simulation"]
) -> None:
    """Raise CampaignError if the records of a campaign would be too much to compute.

    What is written piece by piece (a simulation) may have any number of runs.

    sampling_rate: Hz.
    """
    lengths = [
        (f"runs[{index}]", run.rate, run.duration, len(campaign.accelerometers))
        for index, run in enumerate(campaign.runs)
    ]
    if purpose == "simulation":  # the others need only how uncertain a mean is
        lengths += [
            (f'run "{reading.name}"', reading.rate, reading.duration, 1)
            for reading in campaign.readings
            if reading.record is not None
        ]
    sizes = [
        (
            (1 if purpose == "simulation" else count)
            * paper_rows(rate, duration, sampling_rate, means=purpose == "forecast"),
            f"{where}: {duration:.4g} s at {abs(rate) / (2.0 * math.pi):.3g} rev/s, sampled at "
            f"{sampling_rate:.4g} Hz,",
        )
        for where, rate, duration, count in lengths
        if duration is not None
    ]
    total = sum(rows for rows, _ in sizes)
    records = len(campaign.runs) * len(campaign.accelerometers)
    if purpose != "simulation" and records > MOST_RECORDS:
        words = f"runs: they have {records} records, and a {purpose} has room for {MOST_RECORDS}"
        raise CampaignError(str(campaign.path), [words])
    most = MOST_SIMULATED_ROWS if purpose == "simulation" else MOST_ROWS
    advice = (
        f"rows to compute, and a {purpose} has room for {most:.2g}; choose fewer "
        "revolutions, a shorter duration or a lower sampling rate"
    )
    if purpose == "simulation":
        problems = [f"{w} makes {rows:.3g} {advice}" for rows, w in sizes if rows > most]
    elif total > most:
        rows, words = max(sizes)
        problems = [f"{words} makes {rows:.3g} of the {total:.3g} {advice}"]
    else:
        problems = []
    if problems:
        raise CampaignError(str(campaign.path), problems)
