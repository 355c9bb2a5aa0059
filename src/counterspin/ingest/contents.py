"""Columns of a recorder's file, and their oscillations, before roles are assigned."""

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
from counterspin.readings.entries import MAX_READINGS
from counterspin.records.column_file import ColumnFile
from counterspin.records.dialect import Dialect
from counterspin.records.formats import open_columns, sheets_with_tables
from counterspin.records.isolation import run_isolated
from counterspin.records.reading import MAX_MAGNITUDE
from counterspin.records.sampling import find_split_time
from counterspin.records.several_sensors import (
    MAX_SENSORS,
    STACKED_NAME,
    TEST_ROWS,
    find_interleaved_sensors,
    find_sensor_columns,
    find_stacked_sensors,
)

#: Answer that every sheet of a workbook is a run.
ALL_SHEETS: Final = "all"
#: Advice on the format of a table.
_FORMAT_ADVICE: Final = (
    "Remove words between the numeric cells. Export one column for each quantity, with one "
    "header row followed by numeric cells only. Suitable formats are .csv with semicolons or "
    "tabs, .xlsx, .tdms, .mat and .h5."
)
#: Advice if text follows the numbers of a column.
_SPLIT_ADVICE: Final = (
    "If another run begins at this line, put each run into a separate file. If the line is a "
    "remark, remove it."
)
#: Largest numbers of rows and columns that are read.
_MAX_ROWS: Final = 2_000_000
_MAX_COLUMNS: Final = 200
#: Number of first cells of a text column, which show repetitions.
_N_FIRST_CELLS: Final = 60


@frozen(eq=False)
class FileColumn:
    """One column of a file."""

    name: str  #: Name in the file.
    unit: str  #: Unit in the file, normalised; empty if not stated.
    #: Numbers, NaN for empty cells, shape (n,); for time stamps, s since the first.
    values: Array
    is_timestamp: bool = False  #: Whether the values are time stamps.


@frozen(eq=False)
class FileContents:
    """The contents of a file."""

    path: Path  #: The file.
    columns: tuple[FileColumn, ...]  #: Columns of numbers or time stamps.
    text_columns: tuple[str, ...]  #: Names of the other columns.
    format_description: str  #: Detected format, if it is not plain.
    decimal: str = "."  #: Decimal separator.
    sheet: str | None = None  #: Sheet of a workbook with several tables.
    sheets: tuple[str, ...] = ()  #: All sheets with tables.
    group: str | None = None  #: Group of the run in a file with several runs.
    runs: tuple[str, ...] = ()  #: Groups that contain one run each.
    interval: float | None = None  #: Sampling interval stated in the file, s.
    #: Name -> scalar value in addition to the columns.
    numbers: Mapping[str, float] = field(default_factory=dict)
    #: Text column -> first cells.
    first_text_cells: Mapping[str, Sequence[str]] = field(default_factory=dict)
    #: Text column -> cell of each row; only for small files.
    text_cells: Mapping[str, Sequence[str]] = field(default_factory=dict)
    #: Messages about columns of numbers that contain a text cell.
    unread_reasons: tuple[str, ...] = ()
    footer: tuple[str, ...] = ()  #: Lines at the end that are not rows.
    #: Column that distinguishes several sensors, with its values; selected value.
    sensors: tuple[str, tuple[str, ...]] | None = None
    selected_sensor: str | None = None
    remarks: tuple[str, ...] = ()  #: Remarks on the rows, such as repeated values.

    @property
    def title(self) -> str:
        """The name of the file without extension, with the sheet or the group."""
        table_name = self.sheet or self.group
        return f"{self.path.stem} {table_name}" if table_name else self.path.stem

    @property
    def dialect_keys(self) -> dict[str, Any]:
        """The keys of a description that select rows and table of the file."""
        keys: dict[str, Any] = {
            "sheet": self.sheet,
            "group": self.group,
            "skip_footer": len(self.footer),
        }
        if self.sensors and self.selected_sensor:
            keys["select"] = {"column": self.sensors[0], "value": self.selected_sensor}
        return {key: value for key, value in keys.items() if value}

    @property
    def is_mixed(self) -> bool:
        """True if the rows belong to several sensors, of which none is selected."""
        return self.sensors is not None and self.selected_sensor is None

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
    """Read the contents of files.

    answers: ``sheet`` selects the table of a workbook, by default the first, or `ALL_SHEETS`.
    progress: Called with the numbers of read files and of all files.
    """
    sheet_answer, sensor = (answers or {}).get("sheet"), (answers or {}).get("select")
    all_contents: list[FileContents] = []
    for n_done, file in enumerate(files, 1):
        sheets = sheets_with_tables(file)
        if len(sheets) < 2:
            contents = read_contents(file, sensor=sensor)
            groups = [read_contents(file, sensor=sensor, group=run) for run in contents.runs]
            all_contents += groups or [contents]
        else:
            used_sheets = (
                sheets
                if sheet_answer == ALL_SHEETS
                else (sheet_answer if sheet_answer in sheets else sheets[0],)
            )
            all_contents += [read_contents(file, sheet, sheets, sensor) for sheet in used_sheets]
        if progress is not None:
            progress(n_done, len(files))
    return tuple(all_contents)


def read_contents(
    path: Path,
    sheet: str | None = None,
    sheets: tuple[str, ...] = (),
    sensor: str | None = None,
    group: str | None = None,
) -> FileContents:
    """Read the contents of a file, or of one of its sheets or groups.

    sensor: Value of the column that distinguishes several sensors, to select rows; or column and
        value, ``device=A``.
    """
    return run_isolated(_read_contents, path, sheet, sheets, sensor, group)


def _read_contents(
    path: Path, sheet: str | None, sheets: tuple[str, ...], sensor: str | None, group: str | None
) -> FileContents:
    with open_columns(path, Dialect(sheet=sheet, group=group)) as file:
        footer = file.footer
        cells = file.first_cells([name for name in file.names if name], TEST_ROWS)
        sensor_column, sensors = next(find_sensor_columns(cells), ("", []))
    column_name, _, value = (sensor or "").partition("=")
    selection = (sensor_column, sensor) if sensor is not None and sensor in sensors else None
    if selection is None and value:
        selection = sensor_column, _ = column_name.strip(), value.strip()
    dialect = Dialect(sheet=sheet, skip_footer=len(footer), select=selection, group=group)
    with open_columns(path, dialect) as file:
        names = [name for name in dict.fromkeys(file.names) if name][:_MAX_COLUMNS]
        columns, text_columns, unread_reasons, reasons = [], [], [], []
        first_reason = ""
        for name in names:
            column, reason = _read_column(file, name)
            if column is None:
                text_columns.append(name)
                first_reason = first_reason or reason
                if "contains the text" in reason and f"{file.locate(0)}:" not in reason:
                    reasons.append(reason)
                    unread_reasons.append(reason.replace(str(path), path.name))
            else:
                columns.append(column)
        columns = _merge_split_time(file, columns)
        if not sensor_column:
            sensor_column, sensors = _find_stacked_sensors(
                file, columns, file.first_cells(text_columns, _N_FIRST_CELLS)
            )
            if sensor in sensors:
                return _read_contents(path, sheet, sheets, f"{sensor_column}={sensor}", group)
        if not columns:
            preview = file.preview()
            advice = (
                f"First lines of the file:\n{preview}\n{_FORMAT_ADVICE}"
                if preview
                else _FORMAT_ADVICE
            )
            if reasons:
                split_advice = "" if "each run" in reasons[0] else f" {_SPLIT_ADVICE}"
                raise RecordError(f"{reasons[0]}{split_advice}", code="not-numeric")
            message = f"no column contains only numbers. {advice}"
            raise RecordError(
                f"{path}: {message}" if preview or not first_reason else first_reason,
                code="not-numeric",
            )
        return FileContents(
            path,
            tuple(columns),
            tuple(text_columns),
            file.format_description,
            file.decimal,
            sheet,
            sheets,
            group,
            file.runs,
            file.interval,
            file.single_numbers(),
            file.first_cells(text_columns, _N_FIRST_CELLS),
            _read_text_columns(file, text_columns, max(len(column.values) for column in columns)),
            tuple(unread_reasons),
            footer,
            sensors=(sensor_column, tuple(sensors)) if sensor_column else None,
            selected_sensor=selection and selection[1],
        )


def _find_stacked_sensors(
    file: ColumnFile, columns: Sequence[FileColumn], first_cells: Mapping[str, Sequence[str]]
) -> tuple[str, list[str]]:
    """Return the column that distinguishes sensors by the times of their rows, and its values.

    first_cells: Text column -> first cells.
    """
    values_by_name = {column.name: column.values for column in columns}
    named_columns = {name for name in values_by_name if STACKED_NAME.fullmatch(name)}
    repeating_columns = {
        name for name, values in values_by_name.items() if len(np.unique(values)) <= MAX_SENSORS
    }
    text_columns = {
        name for name, cells in first_cells.items() if len(set(cells)) < len(cells) // 2
    }
    cells = {
        name: [cell.strip() for cell in file.all_cells(name)]
        for name in (*first_cells, *values_by_name)
        if name in named_columns | repeating_columns | text_columns
    }
    stacked_cells = {
        name: column for name, column in cells.items() if name in named_columns | text_columns
    }
    sensor_columns = (
        *find_stacked_sensors(stacked_cells, values_by_name),
        *find_interleaved_sensors(cells, values_by_name),
    )
    return next(iter(sensor_columns), ("", []))


def _merge_split_time(file: ColumnFile, columns: list[FileColumn]) -> list[FileColumn]:
    """Merge two columns of a split time into one column of time stamps."""
    if any(column.is_timestamp for column in columns):
        return columns
    split_time = find_split_time({column.name: column.values for column in columns})
    if split_time is None:
        return columns
    file.timestamp_columns, file.first_timestamp = frozenset([split_time.name]), None
    seconds = np.array(
        file.read_columns([split_time.name])[split_time.name][:_MAX_ROWS], dtype=float
    )
    other_columns = [
        column for column in columns if column.name not in (split_time.coarse, split_time.fine)
    ]
    return [FileColumn(split_time.name, "", seconds, is_timestamp=True), *other_columns]


def _read_text_columns(file: ColumnFile, names: Sequence[str], rows: int) -> dict[str, list[str]]:
    """Read the text columns of a table that is small enough for readings."""
    if not names or rows > MAX_READINGS:
        return {}
    try:
        frame = file.table()
    except RecordError:  # arrays of text, or of different lengths
        return {}
    existing_names = [name for name in names if name in frame.columns]
    return {
        name: ["" if cell is None else str(cell).strip() for cell in frame[name]]
        for name in existing_names
    }


def _read_column(file: ColumnFile, name: str) -> tuple[FileColumn | None, str]:
    """Read a column of numbers or time stamps; return None and a reason for other columns."""
    reason = ""
    for is_timestamp in (False, True):
        file.timestamp_columns = frozenset([name] if is_timestamp else [])
        file.first_timestamp = None
        try:
            file.require([name])
            values = file.read_columns([name])[name][:_MAX_ROWS]
        except RecordError as error:
            reason = reason or str(error)
            continue
        numbers = np.array(values, dtype=float)
        numbers[~(np.abs(numbers) < MAX_MAGNITUDE)] = np.nan  # not a measurement
        if np.isfinite(numbers).any():
            return FileColumn(name, file.units.get(name, ""), numbers, is_timestamp), ""
    return None, reason


# Oscillation of a column with the revolutions

#: Largest number of samples that are analysed.
_MAX_SAMPLES: Final = 1 << 16
#: Smallest number of periods, and smallest fraction of the sum of squares, of an oscillation.
_MIN_PERIODS: Final = 2.0
_MIN_WAVE_FRACTION: Final = 0.5
#: Rejection of outliers: number of fits, smallest number of rows, limit of a residual relative to
#: the median residual.
_OUTLIER_PASSES: Final = 4
_MIN_RECORD_ROWS: Final = 200
_OUTLIER_LIMIT: Final = 8.0


def find_frequency(time: Array, values: Array) -> float | None:
    """Find the frequency of an oscillation, Hz; None without one.

    time, values: Shape (n,), NaN for missing values; the time, in s, increases.
    """
    is_valid = np.isfinite(time) & np.isfinite(values)
    t, y = time[is_valid][:_MAX_SAMPLES], values[is_valid][:_MAX_SAMPLES]
    if t.size < 16 or t[-1] <= t[0]:
        return None
    uniform_times = np.linspace(t[0], t[-1], t.size)
    y = np.interp(uniform_times, t, y)
    x = (uniform_times - uniform_times.mean()) / (uniform_times[-1] - uniform_times[0])
    y = y - np.polynomial.polynomial.polyval(x, np.polynomial.polynomial.polyfit(x, y, 2))
    sum_of_squares = float(np.sum(y**2))
    power = np.abs(np.fft.rfft(y * np.hanning(y.size), 4 * y.size)) ** 2
    peak_index = int(np.argmax(power[8:])) + 8
    peak_frequency = peak_index / (4 * y.size * (uniform_times[1] - uniform_times[0]))
    if (
        sum_of_squares == 0.0
        or peak_frequency * (uniform_times[-1] - uniform_times[0]) < _MIN_PERIODS
    ):
        return None
    # Refine the peak by a parabola through three points, then fit the oscillation.
    if peak_index + 1 < power.size:
        log_before, log_peak, log_after = np.log(power[peak_index - 1 : peak_index + 2] + 1e-300)
        curvature = log_before - 2.0 * log_peak + log_after
        shift = 0.5 * (log_before - log_after) / curvature if curvature < 0.0 else 0.0
        peak_frequency *= (peak_index + shift) / peak_index
    amplitude, _ = fit_wave(2.0 * np.pi * peak_frequency * uniform_times, y)
    return (
        float(peak_frequency)
        if amplitude**2 / 2.0 * y.size > _MIN_WAVE_FRACTION * sum_of_squares
        else None
    )


def fit_wave(
    angle: Array, values: Array, degree: int = 2, *, reject_outliers: bool = False
) -> tuple[float, float]:
    """Fit values = A cos(angle + phase) + polynomial; return amplitude and phase, rad.

    angle: Unwrapped angles, rad, shape (n,).
    values: Values at the angles, shape (n,), NaN if missing.
    degree: Degree of the polynomial in the angle.
    reject_outliers: Whether dropouts and outliers of a record are rejected.
    """
    is_valid = np.isfinite(angle) & np.isfinite(values)
    valid_angle, y = angle[is_valid], values[is_valid]
    if not valid_angle.size:
        return math.nan, math.nan
    x = (valid_angle - valid_angle.mean()) / (np.ptp(valid_angle) or 1.0)
    design = np.column_stack(
        [np.cos(valid_angle), np.sin(valid_angle), np.vander(x, degree + 1, increasing=True)]
    )
    coefficients = np.linalg.lstsq(design, y, rcond=None)[0]
    if reject_outliers and y.size > _MIN_RECORD_ROWS:
        for _ in range(_OUTLIER_PASSES):
            residuals = np.abs(y - design @ coefficients)
            is_inlier = residuals <= _OUTLIER_LIMIT * np.median(residuals)
            coefficients = np.linalg.lstsq(design[is_inlier], y[is_inlier], rcond=None)[0]
    a, b = coefficients[:2]
    return float(np.hypot(a, b)), float(np.arctan2(-b, a))
