"""Read what a text states of its columns in the lines above their names.

LabVIEW's measurement files (.lvm) state units and the step of the time; other recorders state a
sampling rate or interval.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Final

from counterspin.records.layout import NUMBERED
from counterspin.records.unit_notation import parse_file_unit
from counterspin.units import unit_factor

#: Lines of the head, by their first cell: units of the columns, what x is, and its step.
_UNITS: Final = "Y_Unit_Label"
_DIMENSION: Final = "X_Dimension"
_STEP: Final = "Delta_X"
#: The column of x, as the line of names calls it.
_TIME_ZERO: Final = "X_Value"


#: Lines of other heads, in lower case: rows a second, and the time between rows.
_RATE_KEY: Final = re.compile(
    r"(sampl(e|ing)|data|output) ?_?(rate|frequency)|rate|fs|odr|messrate|abtast(rate|frequenz)"
)
_INTERVAL_KEY: Final = re.compile(
    r"sampl(e|ing) ?(interval|time|period)|abtast(zeit|ung|intervall)|hresolution|scan( interval)?"
)
#: A key, perhaps with its unit in brackets, a number, and perhaps its unit.
_STATED: Final = re.compile(
    r"[#%;/\s]*([^\W\d][^\d:=\[(]*?)\s*(?:[\[(]([^\])]+)[\])])?\s*[:=]*\s*"
    r"([\d.,]+(?:[eE][-+]?\d+)?)(?:\s*([^\d\s]\S*))?(?:\s.*)?"
)


def parse_header(
    lines_above: Iterable[Sequence[str]], names: Sequence[str], decimal: str
) -> tuple[dict[str, str], float | None]:
    """Return units by column, in plain signs, and the time between rows, s; None: not stated.

    lines_above: Cells of the lines above the names. Their first cell names the others, which
        stand above their columns.
    """
    entries = {cells[0]: cells[1:] for cells in lines_above if cells and cells[1:]}
    columns = [name for name in names if name.lower() != "comment"]
    plain_names = {name: name.partition(NUMBERED)[0] for name in names}
    named_columns = (
        columns[1:] if columns and plain_names[columns[0]] in (_TIME_ZERO, "") else columns
    )
    units = {
        name: unit
        for name, text in zip(named_columns, entries.get(_UNITS, ()), strict=False)
        if name and (unit := parse_file_unit(text))
    }
    if set(filter(None, entries.get(_DIMENSION, ()))) != {"Time"}:
        return units, parse_interval(lines_above, decimal)
    units |= {name: "s" for name in names if plain_names[name] == _TIME_ZERO}
    steps = {_parse_number(text, decimal) for text in entries.get(_STEP, ()) if text}
    step = steps.pop() if len(steps) == 1 else None
    return units, step if step is not None and step > 0.0 else None


def parse_interval(lines_above: Iterable[Sequence[str]], decimal: str) -> float | None:
    """Return the time between rows that a line of the head states, s; None: none does."""
    for cells in lines_above:
        match = _STATED.fullmatch(" ".join(cells))
        interval = _parse_number(match[3], decimal) if match else None
        if not match or not interval:
            continue
        unit_text = match[4] or match[2]
        unit = parse_file_unit(unit_text) if unit_text else ""
        try:
            key = match[1].strip().lower()
            if _RATE_KEY.fullmatch(key):
                return 1.0 / (interval * (unit_factor(unit, "Hz") if unit else 1.0))
            if _INTERVAL_KEY.fullmatch(key):
                return interval * (unit_factor(unit, "s") if unit else 1.0)
        except ValueError:
            continue  # another quantity
    return None


def _parse_number(text: str, decimal: str) -> float | None:
    try:
        return float(text.replace(decimal, "."))
    except ValueError:
        return None
