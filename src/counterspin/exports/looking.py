"""What is in a file of a recorder, before anybody says what it means.

- `look`: its columns, with their units and numbers
- `Look`, `FileColumn`: what comes out
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.records.column_file import ColumnFile
from counterspin.records.dialect import TO_BE_FOUND, Dialect
from counterspin.records.formats import open_columns
from counterspin.records.isolation import isolated
from counterspin.records.reading import LARGEST_VALUE

#: Rows that are looked at, at most, and columns.
_MAX_ROWS: Final = 2_000_000
_MAX_COLUMNS: Final = 200


@frozen(eq=False)
class FileColumn:
    """One column of a file.

    Attributes
    ----------
    name
        In the file.
    unit
        By the file itself, in plain signs; empty text where it states none.
    values
        Numbers, NaN where a cell is empty, shape (n,); of time stamps, s after the first.
    stamps
        Whether they are time stamps.
    """

    name: str
    unit: str
    values: Array
    stamps: bool = False


@frozen(eq=False)
class Look:
    """What is in a file.

    Attributes
    ----------
    path
        The file.
    columns
        Those that hold numbers or time stamps.
    others
        Names of those that hold neither.
    found
        How it is written, where that is not plain.
    """

    path: Path
    columns: tuple[FileColumn, ...]
    others: tuple[str, ...]
    found: str


def look(path: Path, dialect: Dialect = TO_BE_FOUND) -> Look:
    """Return what is in a file.

    Parameters
    ----------
    path
        A record file of any format.
    dialect
        How it is written, as far as that is known.

    Raises
    ------
    RecordError
        The file cannot be read, or has no columns of numbers.
    """
    return isolated(_look, path, dialect)


def _look(path: Path, dialect: Dialect) -> Look:
    with open_columns(path, dialect) as file:
        names = [name for name in dict.fromkeys(file.names) if name][:_MAX_COLUMNS]
        columns, others = [], []
        for name in names:
            column = _column(file, name)
            if column is None:
                others.append(name)
            else:
                columns.append(column)
        if not columns:
            raise RecordError(f"{path}: no column of the file holds numbers.")
        return Look(path, tuple(columns), tuple(others), file.found)


def _column(file: ColumnFile, name: str) -> FileColumn | None:
    """Return a column as numbers, or as time stamps, or None."""
    for stamps in (False, True):
        file.stamps = frozenset([name] if stamps else [])
        file.first_stamp = None
        try:
            file.require([name])
            values = file.whole([name])[name][:_MAX_ROWS]
        except RecordError:
            continue
        numbers = np.array(values, dtype=float)
        numbers[~(np.abs(numbers) < LARGEST_VALUE)] = np.nan  # what no instrument measures
        if np.isfinite(numbers).any():
            return FileColumn(name, file.units.get(name, ""), numbers, stamps)
    return None
