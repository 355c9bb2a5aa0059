"""Results of checks, monitoring and noise analyses, with their JSON.

Values are in SI units, coefficients in g-units.
"""

from __future__ import annotations

from typing import ClassVar, Final, Literal

from counterspin.errors import RecordError
from counterspin.inference.noise.components import COMPONENTS_BY_KEY
from counterspin.inference.noise.spectrum import AllanValue, SpectralLine, SpectrumValue
from counterspin.results import ReportableResult, ResultPart


class ResidualState(ResultPart):
    """Residuals of an accelerometer in a run."""

    rms: float  #: Root mean square of the residuals of single samples, in ``unit``.
    stated: float | None  #: White noise stated in the campaign; None if the fit estimates it.
    #: Root mean square of the whitened residuals, divided by its expected value; near 1 for a good
    #: fit.
    ratio: float
    #: Probability of a larger ratio; None if the noise was estimated from the residuals.
    p: float | None
    unit: str  #: Unit of ``rms`` and ``stated``.


class PosesState(ResultPart):
    """Poses of a triad detected so far in a record."""

    count: int  #: Number of poses.
    threshold: float  #: Scatter below which the sensor is considered to be at rest, m/s^2.
    #: RMS of norm(f) - g over all poses, m/s^2; None before the first fit.
    rms: float | None
    outlying: list[str]  #: Names of poses that deviate from the model.
    #: Directions in which one more pose would add more information than all present poses, with
    #: the most informative direction first; ``+X -Y up`` is halfway between X up and Y down.
    missing: list[str]


class MeanState(ResultPart):
    """The mean of a record over whole revolutions, or at rest."""

    value: float  #: Mean reading in g, converted with the nominal sensitivity.
    u: float  #: Standard uncertainty of the mean, g.
    revolutions: int  #: Number of whole revolutions; 0 at rest.


class RunState(ResultPart):
    """Current state of a run."""

    run: str  #: Name of the run.
    record: str  #: Record file.
    #: ``waiting``: no file, or too few rows; ``read``: the file was read; ``failed``: the file
    #: cannot be used.
    state: Literal["waiting", "read", "failed"]
    why: str | None = None  #: Reason for waiting, or the fault.
    rows: int = 0  #: Number of rows read.
    seconds: float = 0.0  #: Recorded time, s.
    stated_seconds: float | None = None  #: Duration stated in the campaign, s; None if not stated.
    sampling_rate: float | None = None  #: Sampling rate, Hz.
    repeated: int = 0  #: Number of rows with a repeated time.
    empty: int = 0  #: Number of empty cells.
    outliers: int = 0  #: Number of rejected samples.
    gaps: int = 0  #: Number of gaps (intervals without rows).
    longest_gap: float = 0.0  #: Longest gap, s.
    rate: float | None = None  #: Rate of rotation, rad/s.
    u_rate: float | None = None  #: Standard uncertainty of the rate; None without a recorded angle.
    nominal_rate: float  #: Nominal rate, rad/s; 0 at rest.
    drift: float | None = None  #: Relative drift of the rate, 1/s.
    ripple: float | None = None  #: Largest ripple of the rate, rad/s; None if none is detected.
    harmonic: int | None = None  #: Harmonic of the largest ripple.
    angle_rms: float | None = None  #: Root mean square of the encoder residual, rad.
    residuals: dict[str, ResidualState] = {}  #: Residuals by accelerometer.
    poses: PosesState | None = None  #: Poses found in a record with unknown attitudes.
    #: Mean reading of each accelerometer, for a record on an arm or at rest.
    means: dict[str, MeanState] = {}


class CurrentEstimate(ResultPart):
    """Current estimate of a coefficient from the existing records."""

    name: str  #: Name of the coefficient, such as ``Qx.K_II``.
    value: float | None  #: Estimate; None if not determined.
    u: float | None  #: Standard uncertainty.
    unit: str  #: Unit of the numbers.


class GoalState(ResultPart):
    """A goal for the uncertainty of a coefficient, and its current state."""

    name: str  #: Name of the coefficient.
    wanted: float  #: Target value of u.
    u: float | None  #: Current value of u; None if not determined.
    unit: str  #: Unit of the numbers.
    met: bool  #: Whether the target is reached.


class WatchState(ReportableResult):
    """State of a campaign during recording."""

    BLOCKS: ClassVar[str] = "counterspin.monitoring.page:watch_blocks"
    KIND: ClassVar[str] = "watch"

    title: str  #: Title of the campaign.
    runs: list[RunState]  #: Runs in the order of the description.
    #: K_II of each accelerometer, the coefficients of a triad in poses, and the coefficients in
    #: goals.
    coefficients: list[CurrentEstimate]
    goals: list[GoalState]  #: Targets for u.
    events: list[str]  #: Changes to files since the previous state, as sentences.
    #: Reason why the present records cannot be fitted together; None if the fit succeeded.
    trouble: str | None
    complete: bool  #: Whether every run has been read and has the stated duration.

    @property
    def met(self) -> bool:
        """True if the watch has goals and all of them are met."""
        return bool(self.goals) and all(goal.met for goal in self.goals)


class CheckedRun(ReportableResult):
    """A checked record."""

    BLOCKS: ClassVar[str] = "counterspin.monitoring.page:check_blocks"
    KIND: ClassVar[str] = "check"

    run: RunState  #: State of the run when fitted alone.
    remarks: list[str]  #: Faults and remarks, as sentences; empty if there are none.
    good: bool  #: Whether the record can be used unchanged.
    others: list[str]  #: Other runs of the campaign that have records.
    reached: list[CurrentEstimate]  #: Coefficients from this record and the other records.
    #: Expected u of the complete campaign if the other runs are recorded as described; each
    #: ``value`` is None.
    expected: list[CurrentEstimate]
    why_not: str | None = None  #: Reason why `expected` is missing; None if `expected` is present.


#: SI unit -> display unit for records in g, and factor after division by gravity.
_UNITS_IN_G: Final = {
    "m/s^2/Hz^0.5": ("ug/Hz^0.5", 1e6),
    "m/s^2": ("ug", 1e6),
    "m/s^2/s^0.5": ("ug/h^0.5", 60e6),
    "m/s^2/s": ("ug/h", 3600e6),
}


def noise_display_unit(unit: str, is_in_g: bool, gravity: float) -> tuple[str, float]:
    """Return the display unit of a quantity, and the conversion factor to it.

    is_in_g: Whether the signal was recorded in g.
    """
    if is_in_g and unit in _UNITS_IN_G:
        name, factor = _UNITS_IN_G[unit]
        return name, factor / gravity
    return unit, 1.0


def component_name(key: str) -> str:
    """Return the name of a noise component, given its key in `SignalNoise.components`."""
    if key in COMPONENTS_BY_KEY:
        return COMPONENTS_BY_KEY[key].description
    if key == "quantisation":
        return "quantisation noise of the velocity"
    return f"white noise of the {key}"


class NoiseSize(ResultPart):
    """The size of one component of the noise."""

    value: float | None  #: Estimate; null if the record does not reveal the component.
    low: float  #: Lower end of the 95 % interval; 0 if the component may be absent.
    #: Upper end of the 95 % interval, or the upper limit of an undetected component; null if there
    #: is no limit.
    high: float | None
    unit: str  #: Unit of ``value``, ``low`` and ``high``.


class SignalNoise(ResultPart):
    """The noise of one column."""

    name: str  #: Name of the accelerometer or of the column.
    column: str  #: Column in the file.
    observable: Literal["displacement", "velocity", "specific_force"]  #: Recorded quantity.
    in_g: bool  #: Whether the column is in g, or in an output unit that is converted with gravity.
    rows: int  #: Number of rows in the record.
    sampling_rate: float  #: Sampling rate, Hz.
    seconds: float  #: Duration of the parts used, s.
    outliers: int  #: Number of rejected samples.
    filled: int  #: Number of missing samples in the parts used, including rejected outliers.
    gaps: int  #: Number of gaps at which the record was split.
    #: Smallest difference between distinct samples, in SI units; null if no resolution was
    #: detected.
    resolution: float | None
    #: Noise components with the keys of ``[noise]``: ``acceleration`` (N), ``flicker`` (B),
    #: ``bias_walk`` (K), and the white noise of the record: ``displacement``, ``velocity`` or, for
    #: a specific-force record, ``quantisation`` (m/s).
    components: dict[str, NoiseSize]
    drift: float  #: Linear drift of the bias, m/s^2 per second.
    u_drift: float  #: Standard uncertainty of the drift, calculated from the detected components.
    lines: list[SpectralLine]  #: Spectral lines, most prominent first.
    allan: list[AllanValue]  #: Overlapping Allan deviation after removal of the spectral lines.
    spectrum: list[SpectrumValue]  #: Power spectral density, including the spectral lines.
    remarks: list[str]  #: Remarks on the use of these values.


class NoiseResult(ReportableResult):
    """The noise of a static record."""

    BLOCKS: ClassVar[str] = "counterspin.monitoring.page:noise_blocks"
    KIND: ClassVar[str] = "noise analysis"
    REPORT_KIND: ClassVar[str | None] = "a noise report"

    record: str  #: Record file.
    checksum: str | None  #: SHA-256 of the file; None for a record in memory.
    gravity: float  #: Gravity used to convert between g and m/s^2, in m/s^2.
    signals: list[SignalNoise]  #: Noise of each column.
    unused: list[str]  #: Columns that are not a displacement, a velocity or a specific force.
    table: str  #: ``[noise]`` table that you can paste into ``campaign.toml``.

    def largest_densities(self) -> tuple[float, float]:
        """Return the largest noise density and bias random walk of all specific forces.

        In m/s^2/Hz^0.5 and m/s^2/s^0.5. For an undetected component, the upper limit is used.
        """
        max_values = []
        for name in ("acceleration", "bias_walk"):
            sizes = [
                signal.components.get(name)
                for signal in self.signals
                if signal.observable == "specific_force"
            ]
            values = [
                size.high if size.value is None else size.value
                for size in sizes
                if size is not None
            ]
            detected_values = [value for value in values if value is not None]
            if not detected_values or len(detected_values) < len(sizes):
                raise RecordError(
                    f"{self.record}: the record gives no upper limit of {name} for every column",
                    code="missing-in-result",
                )
            max_values.append(max(detected_values))
        return max_values[0], max_values[1]
