"""What is in a file of a recorder, before anybody says what it means."""

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
    """One column of a file."""

    name: str  #: In the file.
    unit: str  #: By the file itself, in plain signs; empty text where it states none.
    #: Numbers, NaN where a cell is empty, shape (n,); of time stamps, s after the first.
    values: Array
    stamps: bool = False  #: Whether they are time stamps.


@frozen(eq=False)
class Look:
    """What is in a file."""

    path: Path  #: The file.
    columns: tuple[FileColumn, ...]  #: Those that hold numbers or time stamps.
    others: tuple[str, ...]  #: Names of those that hold neither.
    found: str  #: How it is written, where that is not plain.


def look(path: Path, dialect: Dialect = TO_BE_FOUND) -> Look:
    """Return what is in a file."""
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
