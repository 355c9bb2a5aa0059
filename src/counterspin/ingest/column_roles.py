"""Guess the role of each column of a recorder's file.

Names and units are the first evidence. Without them, the numbers decide: time rises in even steps;
an angle rises with time, perhaps wrapped; a signal has a wave of one revolution. A person's answers
take precedence over both.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.quantity import parse_quantity
from counterspin.campaign.settings import OBSERVABLES
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.ingest.contents import FileColumn, FileContents, frequency, wave
from counterspin.records.sampling import has_shared_times, row_rate
from counterspin.records.unit_notation import unit_in_name
from counterspin.units import is_convertible, unit_factor

_TIME: Final = re.compile(
    r"(?i)(t|time|zeit|temps|elapsed|stamp|x_value|seconds|millis|micros)([^a-z]|stamp|$)"
    r"|(.*[^a-z])?i?(tow|sow|time|timestamp|stamp|(time|seconds?).of.week)([^a-z].*)?$"
)
_ANGLE: Final = re.compile(
    r"(?i).*(angle|theta|phi|azimuth|heading|winkel|encoder|spindle|count|kurs)|enc([^a-z]|$)"
)
#: A quantity's letter with that of its axis, alone or before a unit: `xE`, `v_N (m/s)`.
_LETTER: Final = r"(?-i:[adpsuvx]_?{}(?![A-Za-z]))"
#: Words in names -> the axis; in Chinese and Japanese too, and what stands at the beginning alone.
_AXES: Final = {
    axis: re.compile(rf"(?i)(.*[^a-z])?({words})([^a-z]|$)|{alone}")
    for axis, words, alone in (
        ("east", "east|ost", f".*[\u6771\u4e1c]|est([^a-z]|$)|{_LETTER.format('E')}"),
        ("north", "north|nord|norte", f".*\u5317|{_LETTER.format('N')}"),
        ("west", "west|ouest|oeste", ".*\u897f"),
        ("south", "south|süd|sued|sud|sur", ".*\u5357"),
        ("up", "up|height", ".*\u4e0a"),
    )
}
#: A thermometer's column.
_TEMPERATURE: Final = re.compile(r"(?i)(.*[^a-z])?temp(erature?|eratur)?([^a-z].*|$)")
#: Scale of temperature -> what a thermometer beside an accelerometer shows in it.
_THERMOMETER: Final = {"degC": (-60.0, 150.0), "K": (210.0, 425.0)}
#: Serial days of Excel and datenum of MATLAB, from 1990 to 2100, and the longest step of a record.
_DAY_NUMBERS: Final = ((32874.0, 73051.0), (726834.0, 767011.0))
_LONGEST_STEP_DAYS: Final = 1e-3
#: Names of a column that counts the rows.
_COUNTER: Final = re.compile(
    r"(?i)(no|nr|num|number|index|idx|scan|samples?|points?|rows?|zeile|lfd\.? ?nr|#)\.?( #\d+)?"
)
#: Names of single numbers: rows a second, s between rows, revolutions a minute.
_SAMPLING: Final = re.compile(r"(?i)(.*[._])?(fs|f_s|sampl(e|ing)_?(rate|frequency))(_?hz)?")
_STEP: Final = re.compile(r"(?i)(.*[._])?(dt|delta_?t|ts|sampl(e|ing)_?(time|interval))(_?s)?")
_TURNING: Final = re.compile(r"(?i)(.*[._])?(n_?)?rpm")
#: Answers: there is no such column; it is not used; it is that of the temperature.
NONE: Final = "none"
UNUSED: Final = "unused"
TEMPERATURE: Final = "temperature"
#: Units of one revolution -> the unit's name.
_TURNS: Final = {2.0 * np.pi: "rad", 360.0: "deg", 1.0: "rev"}
#: Relative size within which a revolution's numbers are those of a unit.
_UNIT_TOLERANCE: Final = 0.02
#: Time counts as even where nearly all steps are the usual one within this part of it.
_EVEN_STEP_PART: Final = 0.5
#: Unit of time -> rates of a centrifuge, rad per unit: so fast in s would be impossible in ms, so
#: slow in ms useless in s.
_TURNING_UNITS: Final = {
    "s": (0.1, 60.0),
    "ms": (1e-4, 1e-2),
    "us": (1e-7, 1e-5),
    "ns": (1e-10, 1e-8),
}


@frozen
class TimeGuess:
    """The time column."""

    column: str  #: In the file.
    unit: str | None  #: ``iso`` for time stamps; None: unknown.
    factor: float  #: By which it is multiplied to be in s.


@frozen
class AngleGuess:
    """The angle column."""

    #: The column, and its unit; of pulses a unit of time. None: unknown.
    column: str
    unit: str | None
    per_revolution: float | None = None  #: Of counts; None of others.
    pulses: bool = False  #: Whether the column has times of pulses.
    known: bool = False  #: Whether the unit is the file's own.
    turn: float | None = None  #: A revolution, in the column's numbers, as the waves show it.


@frozen
class SignalGuess:
    """A signal: its column, observable and unit (None: unknown), axis and wave by the angle.

    The wave is the signal's amplitude, in the column's unit, and its phase against the angle as the
    encoder counts it, rad; None without an angle.
    """

    column: str
    observable: str | None
    unit: str | None
    axis: str | None
    amplitude: float
    phase: float | None
    known: bool = False
    by_radius: bool = False  #: Whether the unit is the one in which it swings by the radius.


@frozen
class FileGuess:
    """The columns of one file."""

    contents: FileContents  #: The file.
    #: The columns; None: there seems to be none.
    time: TimeGuess | None
    angle: AngleGuess | None
    sampling: float | None  #: Rows a second where there is no time, Hz; None: unknown.
    signals: tuple[SignalGuess, ...]  #: In the order of the file.
    #: Size of the spindle's rate, rad/s; where rows are counted, rad a row. None: unknown.
    rate: float | None
    rising: bool  #: Whether the encoder counts up.
    unused: tuple[str, ...]  #: Names of columns that seem to be none of these.
    #: The accelerometers' temperature, column and scale; None: there seems to be none.
    temperature: tuple[str, str] | None = None
    turning: float | None = None  #: Median rate of the waves, rad/s; None without waves.
    shared: FileColumn | None = None  #: Times that rows share, whose rows are counted instead.
    uncounted: str = ""  #: Why the rows that share times cannot be counted; empty: they can.

    @property
    def temperature_table(self) -> dict[str, dict[str, str]]:
        """Return the temperature's table in [records]; empty without a temperature."""
        if self.temperature is None:
            return {}
        column, scale = self.temperature
        return {"temperature": {"column": column, "unit": scale}}

    @property
    def sampling_words(self) -> list[str]:
        """Return the description of rows that are counted for a person; empty with a time."""
        if self.time is not None or self.sampling is None:
            return []
        rate = f"time: no time column; {self.sampling:.8g} rows per second"
        if self.shared is None or self.uncounted:
            return [rate]
        return [
            f"{rate}, calculated from the row count, because several rows have the same time in "
            f"column '{self.shared.name}'"
        ]

    @property
    def temperature_words(self) -> list[str]:
        """Return the description of the temperature for a person."""
        if self.temperature is None:
            return []
        column, scale = self.temperature
        return [f"temperature: column '{column}', in {scale}"]


@np.errstate(all="ignore")  # no number of a file is too odd to be looked at
def guess_file(
    contents: FileContents, answers: Mapping[str, str] = MappingProxyType({})
) -> FileGuess:
    """Return the role of each column of a file; see the module.

    answers: A person's answers about the file, by the keys of questions.
    """
    columns = [
        replace(column, unit=answers.get(f"{column.name} unit", column.unit))
        for column in contents.columns
    ]
    # A file of several rates has a time for each of them.
    longest = max(len(column.values) for column in columns)
    rows = [column for column in columns if len(column.values) == longest]
    # Rows of several sensors seem to share times.
    series = [column.values for column in rows]
    steady = (
        rows if contents.is_mixed else [c for c in rows if not has_shared_times(c.values, series)]
    )
    time_column = _chosen(rows, answers.get("time"), lambda _: _time_column(steady))
    time: TimeGuess | None = None
    sampling, shared, uncounted = None, None, ""
    seconds = np.arange(longest, dtype=float)
    if time_column is not None:
        unit = "iso" if time_column.stamps else _time_unit(time_column, contents, answers)
        factor = 1.0 if time_column.stamps or unit is None else unit_factor(unit, "s")
        time = TimeGuess(time_column.name, unit, factor)
        seconds = time_column.values * factor
    else:
        shared = _shared_times(rows) if answers.get("time") != NONE else None
        sampling, uncounted = _row_rate(contents, answers, shared)
        seconds = seconds / (sampling or 1.0)
    clocks = {column.name for column in (time_column, shared) if column}
    rest = [c for c in columns if c.name not in clocks and not c.stamps]
    long = [column for column in rest if len(column.values) == longest]
    swings = {c.name: None if contents.is_mixed else frequency(seconds, c.values) for c in long}
    advancing = [
        column
        for column in long
        if not contents.is_mixed
        and _advance(column.values, seconds) is not None
        and not (time_column and np.array_equal(column.values, time_column.values, equal_nan=True))
    ]
    angle_column = _chosen(advancing, answers.get("angle"), _angle_column)
    swinging = [
        column
        for column in long
        if column is not angle_column
        and _is_signal(column, None if column in advancing else swings[column.name], answers)
    ]
    usual = [swing for column in swinging if (swing := swings[column.name])]
    turning = float(np.median(usual)) if usual else None  # Hz
    angle, theta, rising = None, None, True
    if angle_column is not None:
        angle, theta = _angle(angle_column, seconds, turning, answers)
        rising = theta is None or float(np.nanmedian(np.diff(theta))) > 0.0
    elif turning is not None and answers.get("angle") != NONE:
        angle, theta = _pulses(rest, seconds, turning)
    rate = waves = None if turning is None else 2.0 * np.pi * turning
    if theta is not None:
        good = np.isfinite(theta) & np.isfinite(seconds)
        rate = abs(float(np.polyfit(seconds[good], theta[good], 1)[0]))
    elif (time or sampling) and (per_minute := _number(contents, _TURNING)):
        rate = per_minute * 2.0 * np.pi / 60.0
    if time is not None and time.unit is None and (unit := _time_unit_from_rate(rate)):
        return guess_file(contents, {**answers, "time unit": unit})
    signals = tuple(_signal(column, seconds, theta, rate, answers) for column in swinging)
    taken = {signal.column for signal in signals}
    taken |= {part.column for part in (time, angle) if part}
    warm = _temperature([column for column in columns if column.name not in taken], answers)
    taken |= {warm[0]} if warm else set()
    unused = tuple(column.name for column in columns if column.name not in taken)
    unused = (*unused, *contents.others, *contents.numbers)
    parts = (contents, time, angle, sampling, signals, rate, rising, unused, warm, waves)
    return FileGuess(*parts, shared, uncounted)


def _chosen(
    columns: Sequence[FileColumn],
    answers: str | None,
    guess: Callable[[Sequence[FileColumn]], FileColumn | None],
) -> FileColumn | None:
    """Return the column that a person named, or else the guessed one."""
    named = next((column for column in columns if column.name == answers), None)
    return named if answers == NONE or named is not None else guess(columns)


def _temperature(
    columns: Sequence[FileColumn], answers: Mapping[str, str]
) -> tuple[str, str] | None:
    """Return name and scale of the temperature's column, by answer, unit or name; None without."""
    scales = {column.name: scale for column in columns if (scale := temperature_scale(column))}
    used = {name: scale for name, scale in scales.items() if answers.get(f"{name} is") != UNUSED}
    chosen = [name for name in used if answers.get(f"{name} is") == TEMPERATURE]
    return next(((name, used[name]) for name in (*chosen, *used)), None)


def temperature_scale(column: FileColumn) -> str | None:
    """Return the scale of a column of temperatures; None for others, such as raw counts."""
    scale = column.unit or ("degC" if _TEMPERATURE.fullmatch(column.name) else "")
    low, high = _THERMOMETER.get(scale, (math.inf, -math.inf))
    known = column.values[np.isfinite(column.values)]
    return scale if known.size and low < known.min() and known.max() < high else None


def _sampling(contents: FileContents, answers: Mapping[str, str]) -> float | None:
    """Return the number of rows a second, Hz: as a person answered, or as the file states it."""
    if "sampling_rate" in answers:
        return parse_quantity(answers["sampling_rate"], "Hz").value
    if contents.interval:
        return 1.0 / contents.interval
    if rate := _number(contents, _SAMPLING):
        return rate
    step = _number(contents, _STEP)
    return 1.0 / step if step else None


def _row_rate(
    contents: FileContents, answers: Mapping[str, str], shared: FileColumn | None
) -> tuple[float | None, str]:
    """Return the number of rows a second, Hz, or the reason why rows cannot be counted.

    shared: Times that rows share, which tell the rate if nothing else states it.
    """
    sampling = _sampling(contents, answers)
    if sampling is not None or shared is None:
        return sampling, ""
    try:
        return row_rate(shared.values), ""
    except ValueError as error:
        return None, str(error)


def _time_unit(time: FileColumn, contents: FileContents, answers: Mapping[str, str]) -> str | None:
    """Return the unit of a time: answered, stated, by a stated rate, or days; None if unknown."""
    unit = answers.get("time unit") or _unit_of(time, "s")
    unit = unit or _unit_by_rate(time, _sampling(contents, answers))
    return unit or ("d" if _counts_days(time) else None)


def _unit_by_rate(time: FileColumn, sampling: float | None) -> str | None:
    """Return the unit in which a time's steps make the sampling rate, Hz; None if no unit does."""
    step = float(np.nanmedian(np.diff(time.values)))
    for unit in ("s", "ms", "us") if sampling else ():
        if abs(step * unit_factor(unit, "s") * (sampling or 0.0) - 1.0) < _UNIT_TOLERANCE:
            return unit
    return None


def _counts_days(time: FileColumn) -> bool:
    """Return whether a time counts days: a serial number of Excel, or a datenum of MATLAB."""
    if time.stamps:
        return False
    first, last = float(np.nanmin(time.values)), float(np.nanmax(time.values))
    dated = any(low < first and last < high for low, high in _DAY_NUMBERS)
    return dated and float(np.nanmedian(np.diff(time.values))) < _LONGEST_STEP_DAYS


def _time_unit_from_rate(rate: float | None) -> str | None:
    """Return the unit of time that fits a spindle's rate, rad per unit; None if no unit does."""
    for unit, (slowest, fastest) in _TURNING_UNITS.items():
        if rate is not None and slowest <= abs(rate) <= fastest:
            return unit
    return None


def _number(contents: FileContents, names: re.Pattern[str]) -> float | None:
    """Return the only number in a name, if it is positive."""
    found = [value for name, value in contents.numbers.items() if names.fullmatch(name)]
    return found[0] if found and np.isfinite(found[0]) and found[0] > 0.0 else None


def _is_signal(column: FileColumn, swing: float | None, answers: Mapping[str, str]) -> bool:
    """Return whether a column is a signal: by an answer, by its wave, or by its name."""
    if (what := answers.get(f"{column.name} is")) is not None:
        return what not in (TEMPERATURE, UNUSED)
    if "signal" in answers:
        return column.name == answers["signal"]
    if np.ptp(column.values[np.isfinite(column.values)]) == 0.0:
        return False  # zeros of a residual, or of an unused channel
    if column.unit and not any(is_convertible(column.unit, si) for si in OBSERVABLES.values()):
        return False  # such as a temperature
    return bool(swing or _axis(column.name))


def common_guess(guesses: Sequence[FileGuess]) -> FileGuess:
    """Return the guess common to several files, for which the first stands."""
    first = guesses[0]
    for guess in guesses[1:]:
        names = {column.name for column in guess.contents.columns}
        asked = [p.column for p in (first.time, first.angle, *first.signals) if p and p.column]
        if missing := [name for name in asked if name not in names]:
            raise RecordError(
                f"{guess.contents.path} has no column '{missing[0]}', unlike "
                f"{first.contents.path.name}. Give only files with the same layout.",
                code="missing-column",
            )
    rate = first.rate if all(guess.rate for guess in guesses) else None
    return replace(first, rate=rate)


# Columns


def _time_column(columns: Sequence[FileColumn]) -> FileColumn | None:
    """Return the time column: by its kind, its name or its unit, or by even steps."""
    # A clock that stands still from row to row tells no time of theirs.
    stamps = [column for column in columns if column.stamps and is_fine(column.values)]
    if stamps:
        return stamps[0]
    rising = [column for column in columns if is_even(column.values)]
    named = [column for column in rising if _is_named_time(column.name)]
    united = [column for column in rising if _unit_of(column, "s")]
    # A telephone writes a row whenever it has one; rows with the same time are one.
    uneven = [column for column in columns if _is_named_time(column.name) and _rises(column.values)]
    # Without a word, the time stands first, and something else advances with it.
    rows = np.arange(max((len(column.values) for column in columns), default=0), dtype=float)
    advancing = [
        column
        for column in columns
        if len(column.values) == len(rows) and _advance(column.values, rows) is not None
    ]
    first = [
        column
        for column in rising[:1]
        if column is columns[0]
        and not _ANGLE.match(column.name)
        and not _COUNTER.fullmatch(column.name)
    ]
    first = first if len(advancing) > 1 else []
    return next(iter([*named, *united, *uneven, *first]), None)


def _shared_times(columns: Sequence[FileColumn]) -> FileColumn | None:
    """Return the times, s, that several rows share or that come in bursts; None without such."""
    for column in columns:
        unit = "s" if column.stamps else _unit_of(column, "s")
        if unit and has_shared_times(column.values, [c.values for c in columns]):
            return replace(column, values=column.values * unit_factor(unit, "s"))
    return None


def _is_named_time(name: str) -> bool:
    """Return whether a column has a name of times; a path may precede it."""
    return bool(_TIME.match(re.split(r"[/.]", name)[-1]))


def why_no_time(contents: FileContents) -> str:
    """Return why a file has no time: one that is not read, one that falls, or no column."""
    for name, cells in contents.first_words.items():
        if _is_named_time(name) and (stamp := next(filter(None, cells), "")):
            spoilt = (reason for reason in contents.spoilt if f"column '{name}'" in reason)
            return next(spoilt, f"Column '{name}' cannot be read as a time: '{stamp}'").rstrip(".")
    for column in contents.columns:
        falls = np.flatnonzero(np.diff(column.values) < 0.0)
        reason = "most rows have the same value"
        if falls.size:
            reason = f"it decreases in row {falls[0] + 2} (number of decreases: {falls.size})"
        if _is_named_time(column.name) and (falls.size or not is_fine(column.values)):
            return f"Column '{column.name}' is not used as the time: {reason}"
    return "The file has no time column"


def _rises(values: Array) -> bool:
    """Return whether numbers never fall, and rise between most rows."""
    steps = np.diff(values[np.isfinite(values)])
    return bool(len(steps) >= 8 and (steps >= 0.0).all() and is_fine(values))


def is_fine(stamps: Array) -> bool:
    """Return whether times differ between most rows."""
    steps = np.diff(stamps[np.isfinite(stamps)])
    return bool(len(steps) and np.mean(steps > 0.0) > 0.5)


def is_nominal(values: Array) -> bool:
    """Return whether a column holds nothing except -1, 0 and 1: nominal orientations."""
    return bool(np.isin(values[np.isfinite(values)], (-1.0, 0.0, 1.0)).all())


def is_even(values: Array) -> bool:
    """Return whether numbers rise in even steps, as time does."""
    steps = np.diff(values[np.isfinite(values)])
    if len(steps) < 8 or not (steps >= 0).all():
        return False
    usual = float(np.median(steps))
    return bool(usual > 0.0 and np.mean(np.abs(steps - usual) < _EVEN_STEP_PART * usual) > 0.9)


def _angle_column(advancing: Sequence[FileColumn]) -> FileColumn | None:
    """Return the angle column among those that advance evenly, perhaps wrapped."""
    turning = [column for column in advancing if not counts_rows(column)]
    named = [column for column in turning if _ANGLE.match(column.name)]
    united = [c for c in turning if _unit_of(c, "rad") or _unit_of(c, "count")]
    return next(iter([*named, *united, *turning]), None)


def counts_rows(column: FileColumn) -> bool:
    """Return whether a column has row numbers, which advance at any rate."""
    return bool(_COUNTER.fullmatch(column.name)) or bool(
        column.values[0] in (0.0, 1.0) and (np.diff(column.values) == 1.0).all()
    )


def _advance(values: Array, time: Array) -> tuple[Array, float | None] | None:
    """Return unwrapped values and their period; None if they do not advance."""
    good = np.isfinite(values) & np.isfinite(time)
    if good.sum() < max(16, 0.8 * len(values)):
        return None
    steps = np.diff(values[good])
    usual = float(np.median(steps))
    scatter = float(np.median(np.abs(steps - usual)))
    if usual == 0.0 or scatter > 0.3 * abs(usual):
        return None
    odd = np.abs(steps - usual) > 0.9 * abs(usual) + 10.0 * scatter
    period = None
    unwrapped = np.full(len(values), np.nan)
    turns = np.zeros(len(steps))
    if odd.any():
        jumps = usual - steps[odd]
        period = abs(float(np.median(jumps)))
        if odd.mean() > 0.4 or not (np.abs(np.abs(jumps) - period) < 0.1 * period).mean() > 0.9:
            return None
        turns[odd] = np.round(jumps / period)
    unwrapped[good] = values[good] + (period or 0.0) * np.concatenate([[0.0], np.cumsum(turns)])
    return unwrapped, period


def _angle(
    column: FileColumn, time: Array, turning: float | None, answers: Mapping[str, str]
) -> tuple[AngleGuess, Array | None]:
    """Return the unit of an angle, and the angle in rad as the encoder counts it."""
    found = _advance(column.values, time)
    assert found is not None
    unwrapped, period = found
    if turning is not None:
        good = np.isfinite(unwrapped) & np.isfinite(time)
        slope = abs(float(np.polyfit(time[good], unwrapped[good], 1)[0]))
        if period is None or abs(slope / turning / period - 1.0) > _UNIT_TOLERANCE:
            period = slope / turning
    unit = answers.get("angle unit") or _unit_of(column, "rad")
    known = "angle unit" in answers or is_convertible(column.unit, "rad")
    if unit is not None and unit != "count":
        factor = unit_factor(unit, "rad")
        # A name may say what the numbers do not.
        if known or period is None or abs(period * factor / (2.0 * np.pi) - 1.0) < _UNIT_TOLERANCE:
            return AngleGuess(column.name, unit, known=known), unwrapped * factor
    if "per_revolution" in answers:
        stated = float(answers["per_revolution"])
        return AngleGuess(column.name, "count", stated), unwrapped * 2.0 * np.pi / stated
    if period is None:
        return AngleGuess(column.name, unit), None
    for turn, name in _TURNS.items():
        if (
            abs(period / turn - 1.0) < _UNIT_TOLERANCE
            and unit != "count"
            and not is_convertible(column.unit, "count")
        ):
            return AngleGuess(column.name, name), unwrapped * 2.0 * np.pi / turn
    counts = _whole_counts(period)
    guess = AngleGuess(column.name, "count", counts, turn=period)
    return guess, unwrapped * 2.0 * np.pi / (counts or period)


def _whole_counts(period: float) -> float | None:
    """Return the counts of a revolution: the nearest power of two or round number."""
    near = [2.0**n for n in range(8, 33)] + [
        digit * 10.0**n for n in range(2, 9) for digit in (1.0, 1.2, 1.8, 2.0, 2.5, 3.6, 4.0, 5.0)
    ]
    best = min(near, key=lambda counts: abs(counts / period - 1.0))
    return best if abs(best / period - 1.0) < 1e-3 else None


def _pulses(
    columns: Sequence[FileColumn], time: Array, turning: float
) -> tuple[AngleGuess | None, Array | None]:
    """Return a column of few numbers that are times, one a revolution, and the angle, rad."""
    for column in columns:
        values = column.values[np.isfinite(column.values)]
        if 3 <= len(values) < len(time) / 4 and (np.diff(values) > 0.0).all():
            unit = _unit_of(column, "s")
            interval = float(np.median(np.diff(values))) * (unit_factor(unit, "s") if unit else 1.0)
            if abs(interval * turning - 1.0) < _UNIT_TOLERANCE:
                turns = np.arange(len(values)) * 2.0 * np.pi
                factor = unit_factor(unit, "s") if unit else 1.0
                theta = np.interp(time, values * factor, turns, left=np.nan, right=np.nan)
                known = bool(column.unit)
                return AngleGuess(column.name, unit or "s", pulses=True, known=known), theta
    return None, None


def _signal(
    column: FileColumn,
    time: Array,
    theta: Array | None,
    rate: float | None,
    answers: Mapping[str, str],
) -> SignalGuess:
    """Return a signal with its observable by the unit, and its wave."""
    wanted = answers.get(f"{column.name} is")
    observable, unit = wanted, None
    for name, si in OBSERVABLES.items():
        if wanted in (None, name) and (unit := _unit_of(column, si)) is not None:
            observable = name
            break
    phase = None
    amplitude = 0.0
    if theta is not None:
        amplitude, phase = wave(theta, column.values)
    elif rate is not None:
        amplitude, _ = wave(rate * time, column.values)
    known = bool(column.unit)
    axis = answers.get(f"{column.name} axis") or _axis(column.name)
    return SignalGuess(column.name, observable, unit, axis, amplitude, phase, known)


def _axis(name: str) -> str | None:
    return next((axis for axis, words in _AXES.items() if words.match(name)), None)


def _unit_of(column: FileColumn, wanted: str) -> str | None:
    """Return the unit of a column by the file, or else by its name."""
    for text in (column.unit, unit_in_name(column.name)):
        if text:
            return text if is_convertible(text, wanted) else None
    return None
