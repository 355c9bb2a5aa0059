"""Detection of a column that distinguishes the rows of several sensors in a file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from counterspin.errors import RecordError
from counterspin.records.column_file import ColumnFile, format_names

if TYPE_CHECKING:
    import numpy as np

#: Names of columns that distinguish sensors.
_SENSOR_NAME: Final = re.compile(
    r"(?i)(.*[^a-z])?(device|sensor|instance|inst|imu|unit|type|channel|chan|ch|node|source|src|mac"
    r"|addr(ess)?|serial|sn|id|uid|tag|topic|stream|kind|module|board|probe|slot|port)"
    r"([ _-]?(id|no|nr|num|number|name|type|index|idx|address|instance))?([^a-z].*)?$"
)
#: Names of columns that distinguish sensors with consecutive records.
STACKED_NAME: Final = re.compile(
    r"(?i)(.*[^a-z])?(device|sensor|instance|imu|node|mac|addr(ess)?|serial|board|probe|topic)"
    r"([ _-]?(id|no|nr|num|number|name|index|address))?(?P<beside>[^a-z].*)?$"
)
_MIN_STACKED_ROWS: Final = 20
#: Number of rows in which alternating values are detected, and largest number of values.
TEST_ROWS: Final = 2000
MAX_SENSORS: Final = 32
#: Smallest fraction of rows with each value, and smallest fraction of rows with a change.
_MIN_FRACTION: Final = 0.01
_MIN_CHANGE_FRACTION: Final = 0.05
#: Tolerance of even steps, relative to the median step, and smallest fraction of even steps.
_MAX_STEP_DEVIATION: Final = 0.5
_MIN_EVEN_FRACTION: Final = 0.9
_MIN_RISING_FRACTION: Final = 0.3  #: Smallest fraction of increasing steps of a time.


def find_sensor_columns(cells: Mapping[str, Sequence[str]]) -> Iterator[tuple[str, list[str]]]:
    """Yield columns that distinguish sensors in alternating rows, and their values.

    cells: Column -> first cells. A column is accepted by its name, or if its texts alternate.
    """
    for name, column in cells.items():
        values = list(dict.fromkeys(cell for cell in column if cell))
        n_values = len(values)
        if not 2 <= n_values <= min(MAX_SENSORS, len(column) // 4):
            continue
        is_alternating = column[n_values:] == column[:-n_values] and not all(
            map(_is_number, values)
        )
        has_whole_numbers = all(
            not _is_number(value) or float(value.replace(",", ".")).is_integer() for value in values
        )
        n_changes = sum(previous != following for previous, following in pairwise(column))
        is_frequent = n_changes >= _MIN_CHANGE_FRACTION * len(column)
        min_rows = min(column.count(value) for value in values)
        is_named = _SENSOR_NAME.fullmatch(name) and has_whole_numbers and is_frequent
        if (is_alternating or is_named) and min_rows >= max(2.0, _MIN_FRACTION * len(column)):
            yield name, sorted(values)


def find_stacked_sensors(
    cells: Mapping[str, Sequence[str]], numbers: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, list[str]]]:
    """Yield columns that distinguish sensors with consecutive records, and their values.

    cells: Text column, or column with a name of `STACKED_NAME` -> all cells. It is accepted if a
        column of numbers, the time, decreases only where it changes; or if it has such a name and
        each value occurs in consecutive rows.
    numbers: Column of numbers -> values.
    """
    for name, column in cells.items():
        starts = [row for row in range(1, len(column)) if column[row] != column[row - 1]]
        values = list(dict.fromkeys(column))
        edges = [0, *starts, len(column)]
        min_rows = min(end - start for start, end in pairwise(edges))
        if not 1 < len(values) <= MAX_SENSORS or min_rows < _MIN_STACKED_ROWS:
            continue
        is_named = STACKED_NAME.fullmatch(name)
        is_contiguous = len(starts) == len(values) - 1
        decreasing_rows = (
            {row for row, step in enumerate((series[1:] < series[:-1]).tolist(), 1) if step}
            for key, series in numbers.items()
            if key != name
        )
        decreases_at_changes = any(rows and rows <= set(starts) for rows in decreasing_rows)
        if decreases_at_changes or (
            is_named and not is_named["beside"] and is_contiguous and "" not in values
        ):
            yield name, sorted(values)


def find_interleaved_sensors(
    cells: Mapping[str, Sequence[str]], numbers: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, list[str]]]:
    """Yield columns whose values split the rows into records with even times, and their values.

    cells: Column -> all cells.
    numbers: Column of numbers -> values; one of them is a time with uneven steps in total.
    """
    import numpy as np

    for name, column in cells.items():
        values = list(dict.fromkeys(column))
        if not 1 < len(values) <= MAX_SENSORS:
            continue
        labels = np.array(column)
        sensor_indices = [np.flatnonzero(labels == value) for value in values]
        is_recurring = np.sum(labels[1:] != labels[:-1]) >= 2 * len(values)
        if not is_recurring or "" in values or min(map(len, sensor_indices)) < _MIN_STACKED_ROWS:
            continue
        for key, series in numbers.items():
            # Any periodic column splits the rows of a coarse clock into even times.
            has_all_rows = key != name and len(series) == len(column)
            is_fine = has_all_rows and float(np.mean(np.diff(series) > 0.0)) > _MIN_RISING_FRACTION
            if (
                is_fine
                and not _has_even_steps(series)
                and all(_has_even_steps(series[sensor_rows]) for sensor_rows in sensor_indices)
            ):
                yield name, sorted(values)
                break


def _has_even_steps(series: np.ndarray) -> bool:
    """Return whether values increase in even steps."""
    import numpy as np

    steps = np.diff(series)
    median_step = float(np.median(steps))
    is_typical = np.abs(steps - median_step) < _MAX_STEP_DEVIATION * median_step
    is_rising = median_step > 0.0 and bool((steps >= 0.0).all())
    return is_rising and float(np.mean(is_typical)) > _MIN_EVEN_FRACTION


def require_single_sensor(file: ColumnFile, names: Sequence[str]) -> None:
    """Raise RecordError if rows of several sensors alternate in a file and none is selected.

    names: Columns to read, which are quantities.
    """
    if file.selection is not None:
        return
    other_names = [name for name in file.names if name and name not in names]
    for name, values in find_sensor_columns(file.first_cells(other_names, TEST_ROWS)):
        raise RecordError(
            f"{file.path}: {several_sensors_message(name, values)}", code="several-sensors"
        )


def several_sensors_message(name: str, values: Sequence[str]) -> str:
    """Return a message about a column that distinguishes sensors."""
    example = f'select = {{ column = "{name}", value = "{values[0]}" }}'
    return (
        f"column '{name}' has {len(values)} different values ({format_names(values, 8)}), so the "
        f"rows come from several sensors. Select the rows of one sensor: {example} in [records]."
    )


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True
