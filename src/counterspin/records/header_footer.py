"""Lines above the column names and below the rows of a text table.

LabVIEW's measurement files (.lvm) state units and the time step above the names; other recorders
state a sampling rate or interval. Below the rows there may be results, such as a mean.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Final

from counterspin.records.layout import DUPLICATE_MARK, EMPTY_CELL_TEXTS, TIMESTAMP, is_number
from counterspin.records.unit_notation import parse_file_unit
from counterspin.units import unit_factor

#: First cells of header lines: units of the columns, dimension of x, and step of x.
_UNITS_KEY: Final = "Y_Unit_Label"
_DIMENSION_KEY: Final = "X_Dimension"
_STEP_KEY: Final = "Delta_X"
#: Name of the column of x.
_TIME_NAME: Final = "X_Value"


#: Keys of other headers, in lower case: sampling rate and sampling interval.
_RATE_KEY: Final = re.compile(
    r"(sampl(e|ing)|data|output) ?_?(rate|frequency)|rate|fs|odr|messrate|abtast(rate|frequenz)"
)
_INTERVAL_KEY: Final = re.compile(
    r"sampl(e|ing) ?(interval|time|period)|abtast(zeit|ung|intervall)|hresolution|scan( interval)?"
)
#: A key with an optional unit in brackets, and a number with an optional unit.
_STATED_VALUE: Final = re.compile(
    r"[#%;/\s]*([^\W\d][^\d:=\[(]*?)\s*(?:[\[(]([^\])]+)[\])])?\s*[:=]*\s*"
    r"([\d.,]+(?:[eE][-+]?\d+)?)(?:\s*([^\d\s]\S*))?(?:\s.*)?"
)
#: Rows that show the columns of numbers, and smallest number of rows of a table.
_BODY_ROWS: Final = 20
_MIN_ROWS: Final = 3
#: Labels of rows of results below a table.
_RESULT_LABEL: Final = re.compile(
    r"(?i)(mean|average|avg|mittel(wert)?|std|sd|stdev|sigma|sum|summe|min(imum)?|max(imum)?|median|"
    r"variance|range|rms|total|result|checked|approved|signed|operator|end|eof|geprüft)\b.*"
)
#: Smallest fraction of numbers in a column of numbers.
_NUMERIC_FRACTION: Final = 0.6
#: Largest number of lines below the rows.
MAX_FOOTER_LINES: Final = 40


def parse_header(
    lines_above: Iterable[Sequence[str]], names: Sequence[str], decimal: str
) -> tuple[dict[str, str], float | None]:
    """Return column -> normalised unit, and the sampling interval, s (None: not stated).

    lines_above: Cells of the lines above the names. The first cell is a key, the others are the
        values of the columns.
    """
    cells_by_key = {cells[0]: cells[1:] for cells in lines_above if cells and cells[1:]}
    columns = [name for name in names if name.lower() != "comment"]
    plain_names = {name: name.partition(DUPLICATE_MARK)[0] for name in names}
    if columns and plain_names[columns[0]] in (_TIME_NAME, ""):
        columns = columns[1:]
    units = {
        name: unit
        for name, text in zip(columns, cells_by_key.get(_UNITS_KEY, ()), strict=False)
        if name and (unit := parse_file_unit(text))
    }
    if set(filter(None, cells_by_key.get(_DIMENSION_KEY, ()))) != {"Time"}:
        return units, parse_interval(lines_above, decimal)
    units |= {name: "s" for name in names if plain_names[name] == _TIME_NAME}
    steps = {_parse_number(text, decimal) for text in cells_by_key.get(_STEP_KEY, ()) if text}
    step = steps.pop() if len(steps) == 1 else None
    return units, step if step is not None and step > 0.0 else None


def parse_interval(lines_above: Iterable[Sequence[str]], decimal: str) -> float | None:
    """Return the sampling interval that a header line states, s; or None."""
    for cells in lines_above:
        match = _STATED_VALUE.fullmatch(" ".join(cells))
        number = _parse_number(match[3], decimal) if match else None
        if not match or not number:
            continue
        unit_text = match[4] or match[2]
        unit = parse_file_unit(unit_text) if unit_text else ""
        try:
            key = match[1].strip().lower()
            if _RATE_KEY.fullmatch(key):
                return 1.0 / (number * (unit_factor(unit, "Hz") if unit else 1.0))
            if _INTERVAL_KEY.fullmatch(key):
                return number * (unit_factor(unit, "s") if unit else 1.0)
        except ValueError:
            continue  # another quantity
    return None


def _parse_number(text: str, decimal: str) -> float | None:
    try:
        return float(text.replace(decimal, "."))
    except ValueError:
        return None


# Footer


def count_footer_lines(split_lines: Sequence[Sequence[str]], decimal: str) -> int:
    """Return the number of lines at the end of a table that are not rows, such as a mean.

    split_lines: Cells of the rows of the table and of the lines below them.
    """
    body_rows = [cells for cells in split_lines[:_BODY_ROWS] if any(cells)]
    if len(body_rows) < _MIN_ROWS:
        return 0
    width = max(set(map(len, body_rows)), key=list(map(len, body_rows)).count)
    full_rows = [cells for cells in body_rows if len(cells) == width]
    numeric_columns = [
        n for n in range(width) if any(is_number(cells[n], decimal) for cells in full_rows)
    ]
    row_counts = [sum(_is_row_cell(cells[n], decimal) for cells in full_rows) for n in range(width)]
    numeric_columns = [
        n for n in numeric_columns if row_counts[n] >= _NUMERIC_FRACTION * len(full_rows)
    ]
    if not numeric_columns:
        return 0
    is_time = [is_number(cells[0], decimal) for cells in full_rows]
    last_time = max((index for index, number in enumerate(is_time) if number), default=0)
    times = [cells[0].replace(decimal, ".") for cells in full_rows[: last_time + 1]]
    is_first_rising = all(is_time[: last_time + 1]) and all(
        float(previous) < float(following) for previous, following in pairwise(times)
    )
    n_footer_lines = 0
    for index, cells in enumerate(reversed(split_lines[-MAX_FOOTER_LINES:]), 1):
        if not any(cells) or cells[0].startswith("#"):
            n_footer_lines += index == n_footer_lines + 1 and n_footer_lines > 0
            continue
        is_row = all(_is_row_cell(cells[n], decimal) for n in numeric_columns if n < len(cells))
        is_row = is_row and any(
            n < len(cells) and is_number(cells[n], decimal) for n in numeric_columns
        )
        # A row may have text in a column of numbers, such as `up` among `+1` and `-1`, except in
        # place of a time.
        other_columns = [] if is_first_rising else [n for n in numeric_columns if n > 0]
        is_row = is_row or bool(
            other_columns
            and len(cells) == width
            and all(is_number(cells[n], decimal) for n in other_columns)
        )
        if is_row and not _RESULT_LABEL.fullmatch(cells[0]):
            break
        n_footer_lines = index
    return n_footer_lines if n_footer_lines < len(split_lines) - _MIN_ROWS else 0


def _is_row_cell(cell: str, decimal: str) -> bool:
    """Return whether a cell is a number, a time or empty."""
    is_empty = cell.lower() in EMPTY_CELL_TEXTS
    return is_empty or is_number(cell, decimal) or bool(TIMESTAMP.fullmatch(cell))
