"""What a text states of its columns, in the lines above their names and within their cells.

LabVIEW's measurement files (.lvm) state units and the step of the time; other recorders a sampling
rate or interval; and some write the unit behind each number, `1.25 mA`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Final

from counterspin.errors import RecordError
from counterspin.records.dialect import MARKS, NUMBERED, Line, file_unit, split
from counterspin.units import unit_factor

#: Lines of the head, by their first cell: units of the columns, what x is, and its step.
_UNITS: Final = "Y_Unit_Label"
_DIMENSION: Final = "X_Dimension"
_STEP: Final = "Delta_X"
#: The column of x, as the line of names calls it.
_X: Final = "X_Value"


#: Lines of other heads, in lower case: rows a second, and the time between rows.
_RATE_KEY: Final = re.compile(r"sampl(e|ing) ?(rate|frequency)|messrate|abtast(rate|frequenz)")
_INTERVAL_KEY: Final = re.compile(
    r"sampl(e|ing) ?(interval|time|period)|abtast(zeit|ung|intervall)|hresolution|scan( interval)?"
)
_STATED: Final = re.compile(r"\s*([\d.,]+(?:[eE][-+]?\d+)?)\s*(\S*)")

#: A number and, perhaps one blank behind it, what may be its unit.
_WITH_UNIT: Final = re.compile(
    r"([-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?)[ \xa0]?([^\s\d,;.:+-]\S{0,9})"
)
#: Lines one below the other whose cells have units, at least.
_FEWEST_LINES: Final = 3


def stated_head(
    above: Iterable[Sequence[str]], names: Sequence[str], decimal: str
) -> tuple[dict[str, str], float | None]:
    """Return units by column, in plain signs, and the time between rows, s; None: not stated.

    above: Cells of the lines above the names. Their first cell says what the others are, which
        stand above their columns.
    """
    stated = {cells[0]: cells[1:] for cells in above if cells and cells[1:]}
    columns = [name for name in names if name.lower() != "comment"]
    plain = {name: name.partition(NUMBERED)[0] for name in names}
    named = columns[1:] if columns and plain[columns[0]] in (_X, "") else columns
    units = {
        name: unit
        for name, text in zip(named, stated.get(_UNITS, ()), strict=False)
        if name and (unit := file_unit(text))
    }
    if set(filter(None, stated.get(_DIMENSION, ()))) != {"Time"}:
        return units, _interval(above, decimal)
    units |= {name: "s" for name in names if plain[name] == _X}
    steps = {_number(text, decimal) for text in stated.get(_STEP, ()) if text}
    step = steps.pop() if len(steps) == 1 else None
    return units, step if step is not None and step > 0.0 else None


def _interval(above: Iterable[Sequence[str]], decimal: str) -> float | None:
    """Return the time between rows that a line of the head states, s; None: none does."""
    for cells in above:
        key, _, behind = cells[0].partition(":") if cells else ("", "", "")
        value = _STATED.fullmatch(behind or next(iter(cells[1:]), ""))
        number = _number(value[1], decimal) if value else None
        if not value or not number:
            continue
        unit = file_unit(value[2]) if value[2] else ""
        try:
            if _RATE_KEY.fullmatch(key.strip().lower()):
                return 1.0 / (number * (unit_factor(unit, "Hz") if unit else 1.0))
            if _INTERVAL_KEY.fullmatch(key.strip().lower()):
                return number * (unit_factor(unit, "s") if unit else 1.0)
        except ValueError:
            continue  # another quantity
    return None


def _number(text: str, decimal: str) -> float | None:
    try:
        return float(text.replace(decimal, "."))
    except ValueError:
        return None


# Within the cells


def delimiter_between_units(lines: Sequence[Line], stated: str | None = None) -> str | None:
    """Return what parts cells that have units, in lines below each other; None: none have.

    Of several columns two have some at least: one alone, as `30 deg`, may be the rows' names.

    stated: What a person says that parts them.
    """
    best, most = None, 0
    for mark in [stated] if stated else MARKS:
        rows = [split(line, mark) for _, line in lines]
        counts = [sum(map(bool, map(_parted, cells))) for cells in rows]
        enough = [count >= min(2, len(c)) for count, c in zip(counts, rows, strict=True)]
        below = any(
            all(enough[k : k + _FEWEST_LINES]) for k in range(len(enough) - _FEWEST_LINES + 1)
        )
        if below and sum(counts) > most:  # a decimal comma parts less than what parts cells
            best, most = mark, sum(counts)
    return best


def without_units(
    lines: Iterable[str], delimiter: str, path: object
) -> tuple[list[str], dict[int, str]]:
    """Return lines without the units of their cells, and the unit of each column, by its place.

    Lines before the first three below each other that have some are left as they are; RecordError
    where a column changes its unit.
    """
    bare: list[str] = []
    waiting: list[list[str]] = []
    units: dict[int, tuple[str, int]] = {}
    begun = False
    for number, line in enumerate(lines, 1):
        cells = split(line, delimiter)
        waiting = [*waiting, cells] if any(map(_parted, cells)) else []
        bare.append(line)
        begun = begun or len(waiting) == _FEWEST_LINES
        if not begun:
            continue
        rows, waiting = waiting or [cells], []
        for place, row in enumerate(rows):
            at = number - len(rows) + 1 + place
            kept = _bare_cells(row, units, at, path)
            bare[at - 1] = delimiter.join(f'"{c}"' if delimiter in c else c for c in kept)
    return bare, {column: unit for column, (unit, _) in units.items()}


def _bare_cells(
    cells: Sequence[str], units: dict[int, tuple[str, int]], line: int, path: object
) -> Iterable[str]:
    for column, cell in enumerate(cells):
        parted = _parted(cell)
        if parted is None:
            yield cell
            continue
        number, unit = parted
        before, first = units.setdefault(column, (unit, line))
        if unit != before:
            raise RecordError(
                f"{path}, line {line}: cell {column + 1} is in {unit}, that of line {first} in "
                f"{before}. Export each column in one unit."
            )
        yield number


def _parted(cell: str) -> tuple[str, str] | None:
    """Return a cell's number and unit; None if it is not both."""
    match = _WITH_UNIT.fullmatch(cell)
    unit = file_unit(match[2]) if match else None
    return (match[1], unit) if match and unit else None
