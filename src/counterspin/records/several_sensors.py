"""Find a column that tells several sensors apart, whose rows stand in one file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from counterspin.errors import RecordError
from counterspin.records.column_file import ColumnFile, format_names

if TYPE_CHECKING:
    import numpy as np

#: Names of columns that tell sensors apart.
_NAME: Final = re.compile(
    r"(?i)(.*[^a-z])?(device|sensor|instance|inst|imu|unit|type|channel|chan|ch|node|source|src|mac"
    r"|addr(ess)?|serial|sn|id|uid|tag|topic|stream|kind|module|board|probe|slot|port)"
    r"([ _-]?(id|no|nr|num|number|name|type|index|idx|address|instance))?([^a-z].*)?$"
)
#: Of these, names of columns that tell sensors apart where their records follow one another.
STACKED_NAME: Final = re.compile(
    r"(?i)(.*[^a-z])?(device|sensor|instance|imu|node|mac|addr(ess)?|serial|board|probe|topic)"
    r"([ _-]?(id|no|nr|num|number|name|index|address))?(?P<beside>[^a-z].*)?$"
)
_MIN_STACKED_ROWS: Final = 20
#: Rows that show whether values alternate, and most different values.
SHOWING_ROWS: Final = 2000
MAX_VALUES: Final = 32
#: Part of the rows that each value has at least, and part at which the value changes.
_MIN_FRACTION: Final = 0.01
_CHANGING_PART: Final = 0.05
#: Deviation of a step from the median step, and part of the steps that deviate less in a record.
_MAX_STEP_DEVIATION: Final = 0.5
_MIN_EVEN_FRACTION: Final = 0.9
_MIN_RISING_FRACTION: Final = 0.3  #: Part of the steps of a time that rise.


def sensor_columns(cells: Mapping[str, Sequence[str]]) -> Iterator[tuple[str, list[str]]]:
    """Yield columns that tell sensors apart in alternating rows, and their values.

    cells: Column -> its first cells. A column counts by its name, or if its words recur in turn.
    """
    for name, column in cells.items():
        values = list(dict.fromkeys(cell for cell in column if cell))
        count = len(values)
        if not 2 <= count <= min(MAX_VALUES, len(column) // 4):
            continue
        alternating = column[count:] == column[:-count] and not all(map(_is_number, values))
        complete = all(
            not _is_number(value) or float(value.replace(",", ".")).is_integer() for value in values
        )
        change_count = sum(before != after for before, after in pairwise(column))
        is_frequent = change_count >= _CHANGING_PART * len(column)
        min_rows = min(column.count(value) for value in values)
        is_named = _NAME.fullmatch(name) and complete and is_frequent
        if (alternating or is_named) and min_rows >= max(2.0, _MIN_FRACTION * len(column)):
            yield name, sorted(values)


def stacked_sensors(
    cells: Mapping[str, Sequence[str]], numbers: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, list[str]]]:
    """Yield columns that tell apart sensors whose records follow one another, and their values.

    cells: Column of words, or with a name of `STACKED_NAME` -> all its cells. It counts if a column
        of numbers, the time, falls where it changes and nowhere else; or if it is named and each of
        its values has one stretch of rows.
    numbers: Column of numbers -> its values.
    """
    for name, column in cells.items():
        starts = [row for row in range(1, len(column)) if column[row] != column[row - 1]]
        values = list(dict.fromkeys(column))
        edges = [0, *starts, len(column)]
        shortest = min(end - start for start, end in pairwise(edges))
        if not 1 < len(values) <= MAX_VALUES or shortest < _MIN_STACKED_ROWS:
            continue
        is_named = STACKED_NAME.fullmatch(name)
        is_contiguous = len(starts) == len(values) - 1
        time_falls = (
            {row for row, step in enumerate((series[1:] < series[:-1]).tolist(), 1) if step}
            for key, series in numbers.items()
            if key != name
        )
        falls_at_changes = any(rows and rows <= set(starts) for rows in time_falls)
        if falls_at_changes or (
            is_named and not is_named["beside"] and is_contiguous and "" not in values
        ):
            yield name, sorted(values)


def interleaved_sensors(
    cells: Mapping[str, Sequence[str]], numbers: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, list[str]]]:
    """Yield columns whose values part the rows into records with even times, and their values.

    cells: Column -> all its cells.
    numbers: Column of numbers -> its values; one of them is a time that is not even in all rows.
    """
    import numpy as np

    for name, column in cells.items():
        values = list(dict.fromkeys(column))
        if not 1 < len(values) <= MAX_VALUES:
            continue
        labels = np.array(column)
        rows = [np.flatnonzero(labels == value) for value in values]
        recurs = np.sum(labels[1:] != labels[:-1]) >= 2 * len(values)
        if not recurs or "" in values or min(map(len, rows)) < _MIN_STACKED_ROWS:
            continue
        for key, series in numbers.items():
            # Any periodic column parts the rows of a coarse clock into even times.
            is_long = key != name and len(series) == len(column)
            is_fine = is_long and float(np.mean(np.diff(series) > 0.0)) > _MIN_RISING_FRACTION
            if (
                is_fine
                and not _is_even(series)
                and all(_is_even(series[sensor_rows]) for sensor_rows in rows)
            ):
                yield name, sorted(values)
                break


def _is_even(series: np.ndarray) -> bool:
    """Return whether numbers rise in even steps."""
    import numpy as np

    steps = np.diff(series)
    median_step = float(np.median(steps))
    is_usual = np.abs(steps - median_step) < _MAX_STEP_DEVIATION * median_step
    is_rising = median_step > 0.0 and bool((steps >= 0.0).all())
    return is_rising and float(np.mean(is_usual)) > _MIN_EVEN_FRACTION


def require_single_sensor(file: ColumnFile, wanted: Sequence[str]) -> None:
    """Raise RecordError if rows of several sensors alternate in a file and none is selected.

    wanted: Columns that are read; they are quantities.
    """
    if file.selection is not None:
        return
    other_names = [name for name in file.names if name and name not in wanted]
    for name, values in sensor_columns(file.first_cells(other_names, SHOWING_ROWS)):
        raise RecordError(f"{file.path}: {sensors_message(name, values)}", code="several-sensors")


def sensors_message(name: str, values: Sequence[str]) -> str:
    """Return a message about a column that tells sensors apart."""
    example = f'select = {{ column = "{name}", value = "{values[0]}" }}'
    return (
        f"column '{name}' has {len(values)} different values ({format_names(values, 8)}), so "
        f"the rows come from several sensors. Select the rows of one sensor: {example} in "
        "[records]."
    )


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True
