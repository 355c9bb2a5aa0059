"""The columns of a recorder's file and their waves, before any meaning is assigned."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.readings.entries import MOST_READINGS
from counterspin.records.column_file import ColumnFile
from counterspin.records.dialect import Dialect
from counterspin.records.formats import open_columns, sheets_with_tables
from counterspin.records.isolation import run_isolated
from counterspin.records.reading import MAX_MAGNITUDE
from counterspin.records.sampling import find_split_time
from counterspin.records.several_sensors import (
    MAX_VALUES,
    SHOWING_ROWS,
    STACKED_NAME,
    interleaved_sensors,
    sensor_columns,
    stacked_sensors,
)

#: The answer that every sheet of a workbook is a run.
ALL_SHEETS: Final = "all"
#: What a table has to be like.
_WANTED: Final = (
    "Remove words between the numeric cells. Export one column for each quantity, with one "
    "header row followed by numeric cells only. Suitable formats are .csv with semicolons or "
    "tabs, .xlsx, .tdms, .mat and .h5."
)
#: What to do where numbers end at words.
_ANOTHER_RUN: Final = (
    "If another run begins at this line, put each run into a separate file. If the line is a "
    "remark, remove it."
)
#: Rows that are looked at, at most, and columns.
_MAX_ROWS: Final = 2_000_000
_MAX_COLUMNS: Final = 200
#: Cells of a column of words that show whether it repeats.
_FIRST_CELLS: Final = 60


@frozen(eq=False)
class FileColumn:
    """One column of a file."""

    name: str  #: In the file.
    unit: str  #: By the file itself, in plain signs; empty text where it states none.
    #: Numbers, NaN where a cell is empty, shape (n,); of time stamps, s after the first.
    values: Array
    stamps: bool = False  #: Whether they are time stamps.


@frozen(eq=False)
class FileContents:
    """The contents of a file."""

    path: Path  #: The file.
    columns: tuple[FileColumn, ...]  #: Those that hold numbers or time stamps.
    others: tuple[str, ...]  #: Names of those that hold neither.
    found: str  #: How it is written, where that is not plain.
    decimal: str = "."  #: What parts decimals in it.
    sheet: str | None = None  #: That of a workbook which has several tables.
    sheets: tuple[str, ...] = ()  #: All of these.
    group: str | None = None  #: The group that holds the run, of a file with several runs.
    runs: tuple[str, ...] = ()  #: Groups that hold a run each.
    interval: float | None = None  #: Time between rows by the file, s.
    #: Single numbers that stand beside the columns, by name.
    numbers: Mapping[str, float] = field(default_factory=dict)
    #: Column that holds neither numbers nor time stamps -> its first cells.
    first_words: Mapping[str, Sequence[str]] = field(default_factory=dict)
    #: Of a small file: column that holds neither numbers nor time stamps -> its cells, row by row.
    words: Mapping[str, Sequence[str]] = field(default_factory=dict)
    #: Which columns would hold numbers except for a cell, and where it stands, in words.
    spoilt: tuple[str, ...] = ()
    footer: tuple[str, ...] = ()  #: Lines at the end that are not rows.
    #: A column that tells several sensors apart and its values, and the one that is selected.
    sensors: tuple[str, tuple[str, ...]] | None = None
    selected: str | None = None
    remarks: tuple[str, ...] = ()  #: Faults of the rows, such as repeated values, a sentence each.

    @property
    def title(self) -> str:
        """The name of the file without its ending, and the sheet or the group."""
        part = self.sheet or self.group
        return f"{self.path.stem} {part}" if part else self.path.stem

    @property
    def dialect_keys(self) -> dict[str, Any]:
        """The keys of a description by which the file is read."""
        keys: dict[str, Any] = {
            "sheet": self.sheet,
            "group": self.group,
            "skip_footer": len(self.footer),
        }
        if self.sensors and self.selected:
            keys["select"] = {"column": self.sensors[0], "value": self.selected}
        return {key: value for key, value in keys.items() if value}

    @property
    def is_mixed(self) -> bool:
        """True if rows of several sensors are read, because none is selected."""
        return self.sensors is not None and self.selected is None

    @property
    def rows(self) -> int:
        """The number of rows."""
        return max(len(column.values) for column in self.columns)


def read_files(
    files: Sequence[Path],
    answers: Mapping[str, str] | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[FileContents, ...]:
    """Return the contents of the runs' files.

    answers: ``sheet`` selects the table of workbooks with several, or `ALL_SHEETS`; the default is
        the first.
    progress: Called with (files looked at, files in all).
    """
    asked, sensor = (answers or {}).get("sheet"), (answers or {}).get("select")
    all_contents: list[FileContents] = []
    for done, file in enumerate(files, 1):
        sheets = sheets_with_tables(file)
        if len(sheets) < 2:
            contents = read_contents(file, sensor=sensor)
            groups = [read_contents(file, sensor=sensor, group=run) for run in contents.runs]
            all_contents += groups or [contents]
        else:
            taken = sheets if asked == ALL_SHEETS else (asked if asked in sheets else sheets[0],)
            all_contents += [read_contents(file, sheet, sheets, sensor) for sheet in taken]
        if progress is not None:
            progress(done, len(files))
    return tuple(all_contents)


def read_contents(
    path: Path,
    sheet: str | None = None,
    sheets: tuple[str, ...] = (),
    sensor: str | None = None,
    group: str | None = None,
) -> FileContents:
    """Return the contents of a file, or of one of its sheets or groups.

    sensor: Value of the column that tells several sensors apart, of the rows that are read; or
        that column and the value, ``device=A``.
    """
    return run_isolated(_read_contents, path, sheet, sheets, sensor, group)


def _read_contents(
    path: Path,
    sheet: str | None,
    sheets: tuple[str, ...],
    sensor: str | None,
    group: str | None,
) -> FileContents:
    with open_columns(path, Dialect(sheet=sheet, group=group)) as file:
        footer = file.footer
        cells = file.first_cells([name for name in file.names if name], SHOWING_ROWS)
        told_apart, kinds = next(sensor_columns(cells), ("", []))
    stated, _, value = (sensor or "").partition("=")
    chosen = (told_apart, sensor) if sensor is not None and sensor in kinds else None
    if chosen is None and value:
        chosen = told_apart, _ = stated.strip(), value.strip()
    dialect = Dialect(sheet=sheet, skip_footer=len(footer), select=chosen, group=group)
    with open_columns(path, dialect) as file:
        names = [name for name in dict.fromkeys(file.names) if name][:_MAX_COLUMNS]
        columns, others, spoilt, reasons = [], [], [], []
        first = ""
        for name in names:
            column, why = _column(file, name)
            if column is None:
                others.append(name)
                first = first or why
                if "contains the text" in why and f"{file.locate(0)}:" not in why:
                    reasons.append(why)
                    spoilt.append(why.replace(str(path), path.name))
            else:
                columns.append(column)
        columns = _with_split_time(file, columns)
        if not told_apart:
            told_apart, kinds = _stacked(file, columns, file.first_cells(others, _FIRST_CELLS))
            if sensor in kinds:
                return _read_contents(path, sheet, sheets, f"{told_apart}={sensor}", group)
        if not columns:
            seen = file.preview()
            lines = f"First lines of the file:\n{seen}\n{_WANTED}" if seen else _WANTED
            if reasons:
                more = "" if "each run" in reasons[0] else f" {_ANOTHER_RUN}"
                raise RecordError(f"{reasons[0]}{more}", code="not-numeric")
            shown = f"no column contains only numbers. {lines}"
            raise RecordError(
                f"{path}: {shown}" if seen or not first else first, code="not-numeric"
            )
        return FileContents(
            path,
            tuple(columns),
            tuple(others),
            file.format_description,
            file.decimal,
            sheet,
            sheets,
            group,
            file.runs,
            file.interval,
            file.single_numbers(),
            file.first_cells(others, _FIRST_CELLS),
            _read_text_columns(file, others, max(len(column.values) for column in columns)),
            tuple(spoilt),
            footer,
            sensors=(told_apart, tuple(kinds)) if told_apart else None,
            selected=chosen and chosen[1],
        )


def _stacked(
    file: ColumnFile, columns: Sequence[FileColumn], first: Mapping[str, Sequence[str]]
) -> tuple[str, list[str]]:
    """Return the column that tells apart sensors by the times of their rows, and its values.

    first: Column of words -> its first cells.
    """
    numbers = {column.name: column.values for column in columns}
    named = {name for name in numbers if STACKED_NAME.fullmatch(name)}
    few = {name for name, values in numbers.items() if len(np.unique(values)) <= MAX_VALUES}
    words = {name for name, cells in first.items() if len(set(cells)) < len(cells) // 2}
    cells = {
        name: [cell.strip() for cell in file.all_cells(name)]
        for name in (*first, *numbers)
        if name in named | few | words
    }
    stacked = {name: column for name, column in cells.items() if name in named | words}
    found = (*stacked_sensors(stacked, numbers), *interleaved_sensors(cells, numbers))
    return next(iter(found), ("", []))


def _with_split_time(file: ColumnFile, columns: list[FileColumn]) -> list[FileColumn]:
    """Return columns with one column of time stamps in place of the two of a split time."""
    if any(column.stamps for column in columns):
        return columns
    split = find_split_time({column.name: column.values for column in columns})
    if split is None:
        return columns
    file.timestamp_columns, file.first_timestamp = frozenset([split.name]), None
    seconds = np.array(file.read_columns([split.name])[split.name][:_MAX_ROWS], dtype=float)
    rest = [column for column in columns if column.name not in (split.coarse, split.fine)]
    return [FileColumn(split.name, "", seconds, stamps=True), *rest]


def _read_text_columns(file: ColumnFile, names: Sequence[str], rows: int) -> dict[str, list[str]]:
    """Return columns of words of a table that is small enough to be one of readings."""
    if not names or rows > MOST_READINGS:
        return {}
    try:
        frame = file.table()
    except RecordError:  # arrays of words, or of other lengths
        return {}
    known = [name for name in names if name in frame.columns]
    return {name: ["" if c is None else str(c).strip() for c in frame[name]] for name in known}


def _column(file: ColumnFile, name: str) -> tuple[FileColumn | None, str]:
    """Return a column as numbers or time stamps; or None, and why it has no numbers."""
    why = ""
    for stamps in (False, True):
        file.timestamp_columns = frozenset([name] if stamps else [])
        file.first_timestamp = None
        try:
            file.require([name])
            values = file.read_columns([name])[name][:_MAX_ROWS]
        except RecordError as error:
            why = why or str(error)
            continue
        numbers = np.array(values, dtype=float)
        numbers[~(np.abs(numbers) < MAX_MAGNITUDE)] = np.nan  # what no instrument measures
        if np.isfinite(numbers).any():
            return FileColumn(name, file.units.get(name, ""), numbers, stamps), ""
    return None, why


# The wave that a revolution makes in a column

#: Samples that are looked at.
_MAX_SAMPLES: Final = 1 << 16
#: Fewest swings that tell a frequency, and how much of the square a wave must have.
_FEWEST_SWINGS: Final = 2.0
_WAVE_SHARE: Final = 0.5


def frequency(time: Array, values: Array) -> float | None:
    """Return the frequency of a column's wave, Hz; None without a wave.

    time, values: Shape (n,), NaN for missing values; time rises, in s.
    """
    good = np.isfinite(time) & np.isfinite(values)
    t, y = time[good][:_MAX_SAMPLES], values[good][:_MAX_SAMPLES]
    if t.size < 16 or t[-1] <= t[0]:
        return None
    even = np.linspace(t[0], t[-1], t.size)
    y = np.interp(even, t, y)
    x = (even - even.mean()) / (even[-1] - even[0])
    y = y - np.polynomial.polynomial.polyval(x, np.polynomial.polynomial.polyfit(x, y, 2))
    total = float(np.sum(y**2))
    power = np.abs(np.fft.rfft(y * np.hanning(y.size), 4 * y.size)) ** 2
    place = int(np.argmax(power[8:])) + 8
    at = place / (4 * y.size * (even[1] - even[0]))
    if total == 0.0 or at * (even[-1] - even[0]) < _FEWEST_SWINGS:
        return None
    # The peak of a parabola through the three highest, then the wave itself decides.
    if place + 1 < power.size:
        low, high, after = np.log(power[place - 1 : place + 2] + 1e-300)
        bend = low - 2.0 * high + after
        shift = 0.5 * (low - after) / bend if bend < 0.0 else 0.0
        at *= (place + shift) / place
    amplitude, _ = wave(2.0 * np.pi * at * even, y)
    return float(at) if amplitude**2 / 2.0 * y.size > _WAVE_SHARE * total else None


def wave(angle: Array, values: Array, degree: int = 2) -> tuple[float, float]:
    """Return amplitude and phase of values = A cos(angle + phase) + a polynomial.

    angle: Unwrapped, rad.
    values: Values at the angles, shape (n,), NaN where missing.
    degree: Of the polynomial in the angle.
    """
    good = np.isfinite(angle) & np.isfinite(values)
    th, y = angle[good], values[good]
    if not th.size:
        return math.nan, math.nan
    x = (th - th.mean()) / (np.ptp(th) or 1.0)
    design = np.column_stack([np.cos(th), np.sin(th), np.vander(x, degree + 1, increasing=True)])
    a, b, *_ = np.linalg.lstsq(design, y, rcond=None)[0]
    return float(np.hypot(a, b)), float(np.arctan2(-b, a))
