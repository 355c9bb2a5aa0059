"""What the head of a LabVIEW measurement file (.lvm) states of its columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from counterspin.records.dialect import file_unit

#: Lines of the head, by their first cell: units of the columns, what x is, and its step.
_UNITS: Final = "Y_Unit_Label"
_DIMENSION: Final = "X_Dimension"
_STEP: Final = "Delta_X"
#: The column of x, as the line of names calls it.
_X: Final = "X_Value"


def labview_head(
    above: Iterable[Sequence[str]], names: Sequence[str], decimal: str
) -> tuple[dict[str, str], float | None]:
    """Return units by column, in plain signs, and the time between rows, s; None: not stated.

    above: Cells of the lines above the names. Their first cell says what the others are, which
        stand above their columns.
    """
    stated = {cells[0]: cells[1:] for cells in above if cells and cells[1:]}
    columns = [name for name in names if name.lower() != "comment"]
    named = columns[1:] if columns and columns[0] in (_X, "") else columns
    units = {
        name: unit
        for name, text in zip(named, stated.get(_UNITS, ()), strict=False)
        if name and (unit := file_unit(text))
    }
    if set(filter(None, stated.get(_DIMENSION, ()))) != {"Time"}:
        return units, None
    if _X in names:
        units[_X] = "s"
    steps = {_number(text, decimal) for text in stated.get(_STEP, ()) if text}
    step = steps.pop() if len(steps) == 1 else None
    return units, step if step is not None and step > 0.0 else None


def _number(text: str, decimal: str) -> float | None:
    try:
        return float(text.replace(decimal, "."))
    except ValueError:
        return None
