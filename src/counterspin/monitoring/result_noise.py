"""What a record at rest says of its noise, and its JSON. SI units."""

from __future__ import annotations

from typing import ClassVar, Final, Literal

from counterspin.reports.shown import ShownResult
from counterspin.results import ResultPart

#: SI unit -> the unit of what is recorded in g, and how many of it are 1 g of the former.
_IN_G: Final = {
    "m/s^2/Hz^0.5": ("ug/Hz^0.5", 1e6),
    "m/s^2": ("ug", 1e6),
    "m/s^2/s^0.5": ("ug/h^0.5", 60e6),
    "m/s^2/s": ("ug/h", 3600e6),
}


def shown_unit(unit: str, in_g: bool, gravity: float) -> tuple[str, float]:
    """Return the unit in which a quantity is shown, and the factor that leads to it.

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
    high: float | None  #: Upper end; of what does not show, an upper limit. None: no limit.
    unit: str  #: Of all three.


class NoiseLineFound(ResultPart):
    """A wave in the record."""

    frequency: float  #: Hz.
    u_frequency: float  #: Its standard uncertainty.
    amplitude: float  #: Of the specific force, m/s^2.
    u: float  #: Standard uncertainty of the amplitude.
    name: str | None  #: What it may be, such as ``50 Hz mains, harmonic 3``; None: nothing known.


class AllanValue(ResultPart):
    """The overlapping Allan deviation at one averaging time."""

    tau: float  #: Averaging time, s.
    deviation: float  #: m/s^2.
    low: float  #: Lower end of its 95 % interval, by chi-square.
    high: float  #: Upper end.
    dof: float  #: Equivalent degrees of freedom, of the noise that was found.
    expected: float  #: What the components found make of it, m/s^2.


class SpectrumValue(ResultPart):
    """The power spectral density of the specific force at one frequency, two-sided."""

    frequency: float  #: Hz.
    density: float  #: (m/s^2)^2/Hz; white noise of coefficient N has N^2.
    low: float  #: Lower end of its 95 % interval, by chi-square.
    high: float  #: Upper end.
    dof: float  #: Degrees of freedom.
    expected: float  #: What the components found make of it.


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
    filled: int  #: Samples put in from their neighbours, outliers among them.
    gaps: int  #: Stretches of missing rows, at which the record is cut.
    resolution: float | None  #: Least step between different samples, SI; None: none is seen.
    #: By key of ``[noise]``: ``acceleration`` N, ``flicker`` B, ``bias_walk`` K, and white noise of
    #: the record: ``displacement``, ``velocity``, or of a specific force ``quantisation`` (m/s).
    components: dict[str, NoiseSize]
    drift: float  #: Straight line of the bias, m/s^2 a second.
    u_drift: float  #: Its standard uncertainty, by the components that show.
    lines: list[NoiseLineFound]  #: Waves, the largest against its neighbourhood first.
    allan: list[AllanValue]  #: Overlapping Allan deviation, without the lines.
    spectrum: list[SpectrumValue]  #: Power spectral density, lines and all.
    remarks: list[str]  #: What to know before these figures are used.


class NoiseResult(ShownResult):
    """The noise of a record at rest.

    Attributes
    ----------
    record
        The file.
    checksum
        SHA-256 of it; None of a record in memory.
    gravity
        By which g and m/s^2 are converted, m/s^2.
    signals
        One for each column.
    unused
        Columns that are no displacement, velocity or specific force.
    table
        The ``[noise]`` table, to be pasted into ``campaign.toml``.
    """

    BLOCKS: ClassVar[str] = "counterspin.monitoring.noise_page:noise_blocks"
    KIND: ClassVar[str] = "noise"
    REPORT_KIND: ClassVar[str | None] = "a report of noise"

    record: str  #: The file.
    checksum: str | None  #: SHA-256 of it; None of a record in memory.
    gravity: float  #: By which g and m/s^2 are converted, m/s^2.
    signals: list[SignalNoise]  #: One for each column.
    unused: list[str]  #: Columns that are no displacement, velocity or specific force.
    table: str  #: The ``[noise]`` table, to be pasted into ``campaign.toml``.
