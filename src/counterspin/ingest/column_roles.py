"""Guess the role of each column of a recorder's file.

Names and units are the first evidence. Without them, the numbers decide: time increases in even
steps; an angle increases with time, perhaps wrapped; a signal oscillates once per revolution.
Answers take precedence over both.
"""

from __future__ import annotations

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
from counterspin.ingest.column_values import (
    COUNTER_NAME,
    first_word_unit,
    has_distinct_times,
    has_even_steps,
    is_nondecreasing,
    is_row_counter,
    round_counts,
    temperature_scale,
    time_unit_from_values,
    unwrap_values,
    without_repeats,
)
from counterspin.ingest.contents import FileColumn, FileContents, find_frequency, fit_wave
from counterspin.records.sampling import estimate_row_rate, has_shared_times
from counterspin.records.unit_notation import unit_in_name
from counterspin.units import is_convertible, unit_factor

_TIME_NAME: Final = re.compile(
    r"(?i)(t|time|zeit|temps|elapsed|stamp|x_value|seconds|millis|micros)([^a-z]|stamp|$)"
    r"|(.*[^a-z])?i?(tow|sow|time|timestamp|stamp|(time|seconds?).of.week)([^a-z].*)?$"
)
_ANGLE_NAME: Final = re.compile(
    r"(?i).*(angle|theta|phi|azimuth|heading|winkel|encoder|spindle|count|kurs)|enc([^a-z]|$)"
)
#: Letter of a quantity with the letter of its axis, such as `xE` or `v_N (m/s)`.
_AXIS_LETTER: Final = r"(?-i:[adpsuvx]_?{}(?![A-Za-z]))"
#: Axis -> pattern of its names, including Chinese and Japanese ones.
_AXIS_NAMES: Final = {
    axis: re.compile(rf"(?i)(.*[^a-z])?({words})([^a-z]|$)|{alone}")
    for axis, words, alone in (
        ("east", "east|ost", f".*[\u6771\u4e1c]|est([^a-z]|$)|{_AXIS_LETTER.format('E')}"),
        ("north", "north|nord|norte", f".*\u5317|{_AXIS_LETTER.format('N')}"),
        ("west", "west|ouest|oeste", ".*\u897f"),
        ("south", "south|süd|sued|sud|sur", ".*\u5357"),
        ("up", "up|height", ".*\u4e0a"),
    )
}
#: Names of scalar values: sampling rate (Hz), sampling interval (s), rate (rpm).
_SAMPLING_RATE_NAME: Final = re.compile(
    r"(?i)(.*[._])?(fs|f_s|sampl(e|ing)_?(rate|frequency))(_?hz)?"
)
_INTERVAL_NAME: Final = re.compile(
    r"(?i)(.*[._])?(dt|delta_?t|ts|sampl(e|ing)_?(time|interval))(_?s)?"
)
_RPM_NAME: Final = re.compile(r"(?i)(.*[._])?(n_?)?rpm")
#: Answers: no such column; unused column; column of the temperature.
NO_COLUMN: Final = "none"
UNUSED_ROLE: Final = "unused"
TEMPERATURE_ROLE: Final = "temperature"
#: Size of a revolution -> unit.
_UNIT_BY_REVOLUTION: Final = {2.0 * np.pi: "rad", 360.0: "deg", 1.0: "rev"}
#: Relative tolerance of the size of a revolution in a unit.
_UNIT_TOLERANCE: Final = 0.02
#: Unit of time -> plausible range of a centrifuge's rate, rad per unit; the ranges do not overlap.
_RATE_RANGES: Final = {
    "s": (0.1, 60.0),
    "ms": (1e-4, 1e-2),
    "us": (1e-7, 1e-5),
    "ns": (1e-10, 1e-8),
}


@frozen
class TimeGuess:
    """The time column."""

    column: str  #: Name in the file.
    unit: str | None  #: ``iso`` for time stamps; None: unknown.
    factor: float  #: Factor to s.


@frozen
class AngleGuess:
    """The angle column."""

    column: str  #: Name in the file.
    unit: str | None  #: Unit; one of time for pulses; None: unknown.
    per_revolution: float | None = None  #: Counts per revolution; None for other units.
    pulses: bool = False  #: Whether the column contains the times of pulses.
    has_file_unit: bool = False  #: Whether the file states the unit.
    period: float | None = None  #: Size of a revolution by the signals, in the column's numbers.


@frozen
class SignalGuess:
    """A signal: column, observable, unit and axis (None: unknown), amplitude and phase.

    The amplitude is in the column's unit. The phase is relative to the encoder angle, rad; None
    without an angle.
    """

    column: str
    observable: str | None
    unit: str | None
    axis: str | None
    amplitude: float
    phase: float | None
    has_file_unit: bool = False
    is_unit_from_radius: bool = False  #: Whether the unit was inferred from the radius.


@frozen
class FileGuess:
    """The columns of one file."""

    contents: FileContents  #: Contents of the file.
    #: Columns of time and angle; None: not found.
    time: TimeGuess | None
    angle: AngleGuess | None
    sampling_rate: float | None  #: Sampling rate without a time column, Hz; None: unknown.
    signals: tuple[SignalGuess, ...]  #: Signals in the order of the file.
    #: Magnitude of the spindle's rate, rad/s; without time, rad per row. None: unknown.
    rate: float | None
    is_increasing: bool  #: Whether the angle increases.
    unused_columns: tuple[str, ...]  #: Names of the other columns.
    #: Column and scale of the accelerometer temperature; None: not found.
    temperature: tuple[str, str] | None = None
    wave_rate: float | None = None  #: Median rate of the signals' oscillations, rad/s; or None.
    #: Times shared by several rows, which are therefore counted.
    shared_times: FileColumn | None = None
    uncounted_reason: str = ""  #: Reason why rows that share times cannot be counted; or empty.

    @property
    def temperature_table(self) -> dict[str, dict[str, str]]:
        """The key `temperature` of [records]; empty without a temperature."""
        if self.temperature is None:
            return {}
        column, scale = self.temperature
        return {"temperature": {"column": column, "unit": scale}}

    @property
    def sampling_text(self) -> list[str]:
        """Statement about counted rows; empty with a time column."""
        if self.time is not None or self.sampling_rate is None:
            return []
        rate = f"time: no time column; {self.sampling_rate:.8g} rows per second"
        if self.shared_times is None or self.uncounted_reason:
            return [rate]
        return [
            f"{rate}, calculated from the row count, because several rows have the same time in "
            f"column '{self.shared_times.name}'"
        ]

    @property
    def temperature_text(self) -> list[str]:
        """Statement about the temperature; empty without one."""
        if self.temperature is None:
            return []
        column, scale = self.temperature
        return [f"temperature: column '{column}', in {scale}"]


@np.errstate(all="ignore")  # files may contain arbitrary numbers
def guess_file(
    contents: FileContents, answers: Mapping[str, str] = MappingProxyType({})
) -> FileGuess:
    """Guess the role of each column of a file; see the module.

    answers: Key of a question about the file -> answer.
    """
    columns = [
        replace(column, unit=answers.get(f"{column.name} unit", column.unit))
        for column in contents.columns
    ]
    # A file with several sampling rates has a time column for each of them.
    n_rows = max(len(column.values) for column in columns)
    full_columns = [column for column in columns if len(column.values) == n_rows]
    # Rows of several sensors may share times.
    full_values = [column.values for column in full_columns]
    time_candidates = (
        full_columns
        if contents.is_mixed
        else [column for column in full_columns if not has_shared_times(column.values, full_values)]
    )
    time_column = _choose_column(
        full_columns, answers.get("time"), lambda _: _find_time_column(time_candidates)
    )
    time: TimeGuess | None = None
    sampling_rate, shared_times, uncounted_reason = None, None, ""
    seconds = np.arange(n_rows, dtype=float)
    if time_column is not None:
        unit = (
            "iso" if time_column.is_timestamp else _find_time_unit(time_column, contents, answers)
        )
        factor = 1.0 if time_column.is_timestamp or unit is None else unit_factor(unit, "s")
        time = TimeGuess(time_column.name, unit, factor)
        seconds = time_column.values * factor
    else:
        shared_times = (
            _find_shared_times(full_columns) if answers.get("time") != NO_COLUMN else None
        )
        sampling_rate, uncounted_reason = _find_row_rate(contents, answers, shared_times)
        seconds = seconds / (sampling_rate or 1.0)
    time_names = {column.name for column in (time_column, shared_times) if column}
    other_columns = [
        column for column in columns if column.name not in time_names and not column.is_timestamp
    ]
    candidates = [column for column in other_columns if len(column.values) == n_rows]
    frequencies = {
        column.name: None if contents.is_mixed else find_frequency(seconds, column.values)
        for column in candidates
    }
    advancing_columns = [
        column
        for column in candidates
        if not contents.is_mixed
        and unwrap_values(column.values, seconds) is not None
        and not (time_column and np.array_equal(column.values, time_column.values, equal_nan=True))
    ]
    angle_column = _choose_column(advancing_columns, answers.get("angle"), _find_angle_column)
    signal_columns = [
        column
        for column in candidates
        if column is not angle_column
        and _is_signal(
            column, None if column in advancing_columns else frequencies[column.name], answers
        )
    ]
    signal_frequencies = [f for column in signal_columns if (f := frequencies[column.name])]
    rotation_frequency = float(np.median(signal_frequencies)) if signal_frequencies else None  # Hz
    angle, theta, is_increasing = None, None, True
    if angle_column is not None:
        angle, theta = _guess_angle(angle_column, seconds, rotation_frequency, answers)
        is_increasing = theta is None or float(np.nanmedian(np.diff(theta))) > 0.0
    elif rotation_frequency is not None and answers.get("angle") != NO_COLUMN:
        angle, theta = _guess_pulses(other_columns, seconds, rotation_frequency)
    rate = wave_rate = None if rotation_frequency is None else 2.0 * np.pi * rotation_frequency
    if theta is not None:
        is_valid = np.isfinite(theta) & np.isfinite(seconds)
        rate = abs(float(np.polyfit(seconds[is_valid], theta[is_valid], 1)[0]))
    elif (time or sampling_rate) and (rpm := _find_number(contents, _RPM_NAME)):
        rate = rpm * 2.0 * np.pi / 60.0
    if time is not None and time.unit is None and (unit := _time_unit_from_rate(rate)):
        return guess_file(contents, {**answers, "time unit": unit})
    signals = tuple(
        _guess_signal(column, seconds, theta, rate, answers) for column in signal_columns
    )
    used_names = {signal.column for signal in signals}
    used_names |= {guess.column for guess in (time, angle) if guess}
    temperature = _find_temperature(
        [column for column in columns if column.name not in used_names], answers
    )
    used_names |= {temperature[0]} if temperature else set()
    unused_names = tuple(column.name for column in columns if column.name not in used_names)
    unused_names = (*unused_names, *contents.text_columns, *contents.numbers)
    return FileGuess(
        contents,
        time,
        angle,
        sampling_rate,
        signals,
        rate,
        is_increasing,
        unused_names,
        temperature,
        wave_rate,
        shared_times,
        uncounted_reason,
    )


def _choose_column(
    columns: Sequence[FileColumn],
    answer: str | None,
    guess: Callable[[Sequence[FileColumn]], FileColumn | None],
) -> FileColumn | None:
    """Return the column of an answer, or else the guessed one."""
    selected_column = next((column for column in columns if column.name == answer), None)
    return selected_column if answer == NO_COLUMN or selected_column is not None else guess(columns)


def _find_temperature(
    columns: Sequence[FileColumn], answers: Mapping[str, str]
) -> tuple[str, str] | None:
    """Return name and scale of the temperature column, by answer, unit or name; or None."""
    scales = {column.name: scale for column in columns if (scale := temperature_scale(column))}
    candidates = {
        name: scale for name, scale in scales.items() if answers.get(f"{name} is") != UNUSED_ROLE
    }
    answered_names = [name for name in candidates if answers.get(f"{name} is") == TEMPERATURE_ROLE]
    return next(((name, candidates[name]) for name in (*answered_names, *candidates)), None)


def _find_sampling_rate(contents: FileContents, answers: Mapping[str, str]) -> float | None:
    """Return the sampling rate, Hz, from an answer or from the file; None if unknown."""
    if "sampling_rate" in answers:
        return parse_quantity(answers["sampling_rate"], "Hz").value
    if contents.interval:
        return 1.0 / contents.interval
    if rate := _find_number(contents, _SAMPLING_RATE_NAME):
        return rate
    interval = _find_number(contents, _INTERVAL_NAME)
    return 1.0 / interval if interval else None


def _find_row_rate(
    contents: FileContents, answers: Mapping[str, str], shared_times: FileColumn | None
) -> tuple[float | None, str]:
    """Return the sampling rate, Hz, or the reason why rows cannot be counted.

    shared_times: Times shared by rows, which show the rate if it is not stated.
    """
    sampling_rate = _find_sampling_rate(contents, answers)
    if sampling_rate is not None or shared_times is None:
        return sampling_rate, ""
    try:
        return estimate_row_rate(shared_times.values), ""
    except ValueError as error:
        return None, str(error)


def _find_time_unit(
    time: FileColumn, contents: FileContents, answers: Mapping[str, str]
) -> str | None:
    """Return the unit of a time, by answer, file, sampling rate or values; None if unknown."""
    unit = answers.get("time unit") or _find_unit(time, "s") or first_word_unit(time.name)
    unit = unit or _time_unit_from_sampling(time, _find_sampling_rate(contents, answers))
    return unit or time_unit_from_values(time)


def _time_unit_from_sampling(time: FileColumn, sampling_rate: float | None) -> str | None:
    """Return the unit of a time that agrees with the sampling rate, Hz; or None."""
    step = float(np.nanmedian(np.diff(time.values)))
    for unit in ("s", "ms", "us") if sampling_rate else ():
        if abs(step * unit_factor(unit, "s") * (sampling_rate or 0.0) - 1.0) < _UNIT_TOLERANCE:
            return unit
    return None


def _time_unit_from_rate(rate: float | None) -> str | None:
    """Return the unit of time for which a rate in rad per unit is plausible; or None."""
    for unit, (min_rate, max_rate) in _RATE_RANGES.items():
        if rate is not None and min_rate <= abs(rate) <= max_rate:
            return unit
    return None


def _find_number(contents: FileContents, name_pattern: re.Pattern[str]) -> float | None:
    """Return the first scalar value whose name matches a pattern, if it is positive; or None."""
    numbers = [value for name, value in contents.numbers.items() if name_pattern.fullmatch(name)]
    return numbers[0] if numbers and np.isfinite(numbers[0]) and numbers[0] > 0.0 else None


def _is_signal(column: FileColumn, frequency: float | None, answers: Mapping[str, str]) -> bool:
    """Return whether a column is a signal, by answer, oscillation or name."""
    if (role := answers.get(f"{column.name} is")) is not None:
        return role not in (TEMPERATURE_ROLE, UNUSED_ROLE)
    if "signal" in answers:
        return column.name == answers["signal"]
    if np.ptp(column.values[np.isfinite(column.values)]) == 0.0:
        return False  # zeros of a residual, or of an unused channel
    if column.unit and not any(
        is_convertible(column.unit, si_unit) for si_unit in OBSERVABLES.values()
    ):
        return False  # such as a temperature
    return bool(frequency or _guess_axis(column.name))


def merge_guesses(guesses: Sequence[FileGuess]) -> FileGuess:
    """Return the guess of the first file, after checking that the others have the same columns."""
    first = guesses[0]
    for guess in guesses[1:]:
        names = {column.name for column in guess.contents.columns}
        used_names = [
            guess.column
            for guess in (first.time, first.angle, *first.signals)
            if guess and guess.column
        ]
        if missing_names := [name for name in used_names if name not in names]:
            raise RecordError(
                f"{guess.contents.path} has no column '{missing_names[0]}', unlike "
                f"{first.contents.path.name}. Give only files with the same layout.",
                code="missing-column",
            )
    rate = first.rate if all(guess.rate for guess in guesses) else None
    return replace(first, rate=rate)


# Columns


def _find_time_column(columns: Sequence[FileColumn]) -> FileColumn | None:
    """Return the time column, by time stamps, name, unit or even steps; or None."""
    # Time stamps that repeat in most rows are not the times of the rows.
    timestamp_columns = [
        column for column in columns if column.is_timestamp and has_distinct_times(column.values)
    ]
    if timestamp_columns:
        return timestamp_columns[0]
    even_columns = [column for column in columns if has_even_steps(column.values)]
    named_columns = [column for column in even_columns if _is_named_time(column.name)]
    time_unit_columns = [column for column in even_columns if _find_unit(column, "s")]
    # Telephones write rows at irregular times; rows with the same time are merged.
    uneven_columns = [
        column
        for column in columns
        if _is_named_time(column.name) and is_nondecreasing(column.values)
    ]
    # Without a name, the time is the first column, and another column advances with it.
    row_numbers = np.arange(max((len(column.values) for column in columns), default=0), dtype=float)
    advancing_columns = [
        column
        for column in columns
        if len(column.values) == len(row_numbers)
        and unwrap_values(column.values, row_numbers) is not None
    ]
    first_columns = [
        column
        for column in even_columns[:1]
        if column is columns[0]
        and not _ANGLE_NAME.match(column.name)
        and not COUNTER_NAME.fullmatch(column.name)
    ]
    first_columns = first_columns if len(advancing_columns) > 1 else []
    return next(iter([*named_columns, *time_unit_columns, *uneven_columns, *first_columns]), None)


def _find_shared_times(columns: Sequence[FileColumn]) -> FileColumn | None:
    """Return the times, s, that several rows share or that come in bursts; or None."""
    all_values = [column.values for column in columns]
    for column in columns:
        unit = "s" if column.is_timestamp else _find_unit(column, "s")
        if unit and has_shared_times(column.values, all_values):
            return replace(column, values=column.values * unit_factor(unit, "s"))
    return None


def _is_named_time(name: str) -> bool:
    """Return whether a name, perhaps with a path, is that of a time column."""
    return bool(_TIME_NAME.match(re.split(r"[/.]", name)[-1]))


def explain_missing_time(contents: FileContents) -> str:
    """Explain why a file has no time: it is unreadable, decreasing, constant or missing."""
    for name, cells in contents.first_text_cells.items():
        if _is_named_time(name) and (cell := next(filter(None, cells), "")):
            reasons = (reason for reason in contents.unread_reasons if f"column '{name}'" in reason)
            return next(reasons, f"Column '{name}' cannot be read as a time: '{cell}'").rstrip(".")
    for column in contents.columns:
        drops = np.flatnonzero(np.diff(column.values) < 0.0)
        reason = "most rows have the same value"
        if drops.size:
            reason = f"it decreases in row {drops[0] + 2} (number of decreases: {drops.size})"
        if _is_named_time(column.name) and (drops.size or not has_distinct_times(column.values)):
            return f"Column '{column.name}' is not used as the time: {reason}"
    return "The file has no time column"


def _find_angle_column(advancing_columns: Sequence[FileColumn]) -> FileColumn | None:
    """Return the angle column among those that advance evenly; or None."""
    candidates = [column for column in advancing_columns if not is_row_counter(column)]
    named_columns = [column for column in candidates if _ANGLE_NAME.match(column.name)]
    angle_unit_columns = [
        column for column in candidates if _find_unit(column, "rad") or _find_unit(column, "count")
    ]
    return next(iter([*named_columns, *angle_unit_columns, *candidates]), None)


def _guess_angle(
    column: FileColumn, time: Array, rotation_frequency: float | None, answers: Mapping[str, str]
) -> tuple[AngleGuess, Array | None]:
    """Return the guess of an angle, and the unwrapped encoder angle, rad (None: unknown)."""
    unwrapped_column = unwrap_values(column.values, time)
    assert unwrapped_column is not None
    unwrapped, period = unwrapped_column
    if rotation_frequency is not None:
        is_valid = np.isfinite(unwrapped) & np.isfinite(time)
        slope = abs(float(np.polyfit(time[is_valid], unwrapped[is_valid], 1)[0]))
        if period is None or abs(slope / rotation_frequency / period - 1.0) > _UNIT_TOLERANCE:
            period = slope / rotation_frequency
    unit = answers.get("angle unit") or _find_unit(column, "rad")
    has_file_unit = "angle unit" in answers or is_convertible(column.unit, "rad")
    if unit is not None and unit != "count":
        factor = unit_factor(unit, "rad")
        # The unit in a name may contradict the numbers.
        if (
            has_file_unit
            or period is None
            or abs(period * factor / (2.0 * np.pi) - 1.0) < _UNIT_TOLERANCE
        ):
            return AngleGuess(column.name, unit, has_file_unit=has_file_unit), unwrapped * factor
    if "per_revolution" in answers:
        n_counts = float(answers["per_revolution"])
        return AngleGuess(column.name, "count", n_counts), unwrapped * 2.0 * np.pi / n_counts
    if period is None:
        return AngleGuess(column.name, unit), None
    for revolution, name in _UNIT_BY_REVOLUTION.items():
        if (
            abs(period / revolution - 1.0) < _UNIT_TOLERANCE
            and unit != "count"
            and not is_convertible(column.unit, "count")
        ):
            return AngleGuess(column.name, name), unwrapped * 2.0 * np.pi / revolution
    counts = round_counts(period)
    if counts is None and unit not in (None, "count"):
        # Lost rows without a gap in the time change the period of the signals.
        return AngleGuess(column.name, unit), unwrapped * unit_factor(unit, "rad")
    guess = AngleGuess(column.name, "count", counts, period=period)
    return guess, unwrapped * 2.0 * np.pi / (counts or period)


def _guess_pulses(
    columns: Sequence[FileColumn], time: Array, rotation_frequency: float
) -> tuple[AngleGuess | None, Array | None]:
    """Return the guess of a column of pulse times, one per revolution, and the angle, rad."""
    for column in columns:
        values = column.values[np.isfinite(column.values)]
        if 3 <= len(values) < len(time) / 4 and (np.diff(values) > 0.0).all():
            unit = _find_unit(column, "s")
            interval = float(np.median(np.diff(values))) * (unit_factor(unit, "s") if unit else 1.0)
            if abs(interval * rotation_frequency - 1.0) < _UNIT_TOLERANCE:
                pulse_angles = np.arange(len(values)) * 2.0 * np.pi
                factor = unit_factor(unit, "s") if unit else 1.0
                theta = np.interp(time, values * factor, pulse_angles, left=np.nan, right=np.nan)
                has_file_unit = bool(column.unit)
                return AngleGuess(
                    column.name, unit or "s", pulses=True, has_file_unit=has_file_unit
                ), theta
    return None, None


def _guess_signal(
    column: FileColumn,
    time: Array,
    theta: Array | None,
    rate: float | None,
    answers: Mapping[str, str],
) -> SignalGuess:
    """Return the guess of a signal, with observable, unit, axis, amplitude and phase."""
    answered_role = answers.get(f"{column.name} is")
    observable, unit = answered_role, None
    for name, si_unit in OBSERVABLES.items():
        if answered_role in (None, name) and (unit := _find_unit(column, si_unit)) is not None:
            observable = name
            break
    phase = None
    amplitude = 0.0
    if theta is not None:
        amplitude, phase = fit_wave(theta, without_repeats(column.values), reject_outliers=True)
    elif rate is not None:
        amplitude, _ = fit_wave(rate * time, column.values, reject_outliers=True)
    has_file_unit = bool(column.unit)
    axis = answers.get(f"{column.name} axis") or _guess_axis(column.name)
    return SignalGuess(column.name, observable, unit, axis, amplitude, phase, has_file_unit)


def _guess_axis(name: str) -> str | None:
    return next((axis for axis, pattern in _AXIS_NAMES.items() if pattern.match(name)), None)


def _find_unit(column: FileColumn, target_unit: str) -> str | None:
    """Return the unit of a column, from the file or from its name, if it is convertible."""
    for unit in (column.unit, unit_in_name(column.name)):
        if unit:
            return unit if is_convertible(unit, target_unit) else None
    return None
