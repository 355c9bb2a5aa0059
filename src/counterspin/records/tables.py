"""A record file as a table, for those who add columns to it.

- `read_table`: all columns as they stand
- `read_numbers`: some of them as numbers
- `locate`: where a row stands in the file
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from counterspin.errors import RecordError
from counterspin.records.formats import open_columns
from counterspin.records.isolation import isolated
from counterspin.records.pieces import Columns, joined

if TYPE_CHECKING:
    import polars as pl


def read_table(path: Path) -> pl.DataFrame:
    """Return a whole file as it stands, cells of text remaining text.

    Raises
    ------
    RecordError
        The file cannot be read, or is not a table.
    """
    return isolated(_table, path)


def read_numbers(path: Path, names: Sequence[str]) -> Columns:
    """Return columns of numbers, NaN where a cell is empty.

    Raises
    ------
    RecordError
        The file cannot be read, lacks a column or has no rows, or a cell holds text.
    """
    return isolated(_numbers, path, list(names))


def locate(path: Path, row: int) -> str:
    """Say where data row `row` (counted from 0) stands in the file."""
    return isolated(_locate, path, row)


def _table(path: Path) -> pl.DataFrame:
    with open_columns(path) as file:
        return file.table()


def _numbers(path: Path, names: list[str]) -> Columns:
    with open_columns(path) as file:
        file.require(names)
        try:
            batches = list(file.batches(names))
        except RecordError:
            if not file.look_closely():
                raise
            batches = list(file.batches(names))
    if not batches:
        raise RecordError(f"{path}: the file has no rows.")
    return joined(batches)


def _locate(path: Path, row: int) -> str:
    with open_columns(path) as file:
        return file.locate(row)
