"""State of a campaign while it is recorded, and noise at rest: the JSON of both.

SI units, coefficients in g-units.
"""

from __future__ import annotations

from typing import ClassVar, Final, Literal

from counterspin.inference.noise.spectrum import AllanValue, SpectralLine, SpectrumValue
from counterspin.results import ReportableResult, ResultPart


class ResidualState(ResultPart):
    """Residuals of one accelerometer in one run."""

    rms: float  #: Root mean square, a sample, in `unit`.
    stated: float | None  #: White noise that the campaign states; None where it is to be estimated.
    ratio: float  #: Whitened residuals over their value expected from the noise: near 1.
    p: float | None  #: Probability of larger ones; None where the noise was estimated from them.
    unit: str  #: Of ``rms`` and ``stated``.


class PosesState(ResultPart):
    """The poses of a triad that one record has so far."""

    count: int  #: How many there are.
    threshold: float  #: Scatter below which the sensor rests, m/s^2.
    #: Root mean square of what is felt more or less than g in them, m/s^2; None where nothing is
    #: fitted yet.
    rms: float | None
    outlying: list[str]  #: Names of those that deviate from the model.
    #: Directions in which one more pose would say more than all that are there, the most telling
    #: first: ``+X -Y up`` is halfway between X up and Y down.
    missing: list[str]


class MeanState(ResultPart):
    """The mean of a record over whole revolutions, or at rest."""

    value: float  #: By the nominal sensitivity, g.
    u: float  #: Its standard uncertainty, g.
    revolutions: int  #: Whole ones; 0 at rest.


class RunState(ResultPart):
    """The state of a run so far."""

    run: str  #: Its name.
    record: str  #: Its file.
    #: ``waiting``: no file, or too little of it; ``read``; ``failed``: it cannot be used as it
    #: stands.
    state: Literal["waiting", "read", "failed"]
    why: str | None = None  #: The reason for waiting, or the fault.
    rows: int = 0  #: Read so far.
    seconds: float = 0.0  #: Recorded so far.
    #: How long it is to be; None where the campaign does not say.
    stated_seconds: float | None = None
    sampling_rate: float | None = None  #: Rows a second, Hz.
    repeated: int = 0  #: Rows that repeat a time.
    empty: int = 0  #: Empty cells.
    outliers: int = 0  #: Samples left out.
    gaps: int = 0  #: Stretches of missing rows.
    longest_gap: float = 0.0  #: The longest of them, s.
    rate: float | None = None  #: Of rotation, rad/s.
    u_rate: float | None = None  #: Its standard uncertainty; None without a recorded angle.
    nominal_rate: float  #: As stated, rad/s; 0 at rest.
    drift: float | None = None  #: Of the rate, 1/s.
    ripple: float | None = None  #: Largest one of the rate, rad/s; None: none seen.
    harmonic: int | None = None  #: Which harmonic that is.
    angle_rms: float | None = None  #: Of the recorded angle about the model, rad.
    residuals: dict[str, ResidualState] = {}  #: By accelerometer.
    poses: PosesState | None = None  #: Of a record of poses of unknown attitude.
    means: dict[str, MeanState] = {}  #: By accelerometer, of a record on an arm or at rest.


class CurrentEstimate(ResultPart):
    """Current estimate of a coefficient from the existing records."""

    name: str  #: Such as ``Qx.K_II``.
    value: float | None  #: None where it is not determined.
    u: float | None  #: Standard uncertainty.
    unit: str  #: Of both.


class GoalState(ResultPart):
    """A goal: the u that is wanted of a coefficient, the u reached, and whether that is enough."""

    name: str  #: Of the coefficient.
    wanted: float  #: The u that is wanted of it.
    u: float | None  #: Reached so far; None: not determined.
    unit: str  #: Of both.
    met: bool  #: Whether that is enough.


class WatchState(ReportableResult):
    """A campaign whose records grow, at one moment."""

    BLOCKS: ClassVar[str] = "counterspin.monitoring.page:watch_blocks"
    KIND: ClassVar[str] = "watch"

    title: str  #: Of the campaign.
    runs: list[RunState]  #: In the order of the description.
    #: K_II of each accelerometer, all of a triad in poses, and the coefficients of goals.
    coefficients: list[CurrentEstimate]
    goals: list[GoalState]  #: What is wanted.
    events: list[str]  #: What happened to files since the state before, in sentences.
    #: Why the records that are there cannot be fitted together; None if they can.
    trouble: str | None
    complete: bool  #: Whether every run is read and as long as the campaign states.

    @property
    def met(self) -> bool:
        """True if the watch has goals and all of them are met."""
        return bool(self.goals) and all(goal.met for goal in self.goals)


class CheckedRun(ReportableResult):
    """A checked record."""

    BLOCKS: ClassVar[str] = "counterspin.monitoring.page:check_blocks"
    KIND: ClassVar[str] = "check"

    run: RunState  #: What it shows, fitted by itself.
    remarks: list[str]  #: What is wrong or odd, in sentences; empty if nothing is.
    good: bool  #: Whether it may be kept as it is.
    others: list[str]  #: The other runs of the campaign whose records are there.
    reached: list[CurrentEstimate]  #: Coefficients by this record and those others.
    #: The u that the whole campaign will reach if its other runs are made as described; values are
    #: None.
    expected: list[CurrentEstimate]
    why_not: str | None = None  #: Why that cannot be said; None if it can.


#: SI unit -> the unit of a record in g, and its number per 1 g of the SI quantity.
_IN_G: Final = {
    "m/s^2/Hz^0.5": ("ug/Hz^0.5", 1e6),
    "m/s^2": ("ug", 1e6),
    "m/s^2/s^0.5": ("ug/h^0.5", 60e6),
    "m/s^2/s": ("ug/h", 3600e6),
}


def shown_unit(unit: str, in_g: bool, gravity: float) -> tuple[str, float]:
    """Return the display unit of a quantity, and the conversion factor to it.

    in_g: Whether it was recorded in g.
    """
    if in_g and unit in _IN_G:
        name, factor = _IN_G[unit]
        return name, factor / gravity
    return unit, 1.0


class NoiseSize(ResultPart):
    """The size of one component of the noise."""

    value: float | None  #: None: the record does not show it.
    low: float  #: Lower end of its 95 % interval; 0: the record may be without it.
    high: float | None  #: Upper end; an upper limit for an undetected component. None: no limit.
    unit: str  #: Of all three.


class SignalNoise(ResultPart):
    """The noise of one column."""

    name: str  #: Of the accelerometer, or of the column.
    column: str  #: In the file.
    observable: Literal["displacement", "velocity", "specific_force"]  #: What it holds.
    in_g: bool  #: Whether it is recorded in g, or in an output converted with gravity.
    rows: int  #: Of the record.
    sampling_rate: float  #: Rows a second, Hz.
    seconds: float  #: Of all that was used.
    outliers: int  #: Samples left out.
    filled: int  #: Samples missing in the parts used, outliers among them.
    gaps: int  #: Stretches of missing rows, at which the record is cut.
    resolution: float | None  #: Least step between different samples, SI; None: none is seen.
    #: By key of ``[noise]``: ``acceleration`` N, ``flicker`` B, ``bias_walk`` K, and white noise of
    #: the record: ``displacement``, ``velocity``, or of a specific force ``quantisation`` (m/s).
    components: dict[str, NoiseSize]
    drift: float  #: Straight line of the bias, m/s^2 a second.
    u_drift: float  #: Its standard uncertainty, by the components that show.
    lines: list[SpectralLine]  #: Waves, the largest against its neighbourhood first.
    allan: list[AllanValue]  #: Overlapping Allan deviation, without the lines.
    spectrum: list[SpectrumValue]  #: Power spectral density, lines and all.
    remarks: list[str]  #: What to know before these figures are used.


class NoiseResult(ReportableResult):
    """The noise of a record at rest."""

    BLOCKS: ClassVar[str] = "counterspin.monitoring.page:noise_blocks"
    KIND: ClassVar[str] = "noise"
    REPORT_KIND: ClassVar[str | None] = "a report of noise"

    record: str  #: The file.
    checksum: str | None  #: SHA-256 of it; None of a record in memory.
    gravity: float  #: By which g and m/s^2 are converted, m/s^2.
    signals: list[SignalNoise]  #: One for each column.
    unused: list[str]  #: Columns other than displacement, velocity and specific force.
    table: str  #: The ``[noise]`` table, to be pasted into ``campaign.toml``.
