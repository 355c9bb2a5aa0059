"""Record files of any format, as columns or as a table.

A `ColumnFile` yields columns in batches of float64 arrays (NaN for empty cells), and returns the
location of a row for messages: the line in a text editor for CSV, or else the row. `reading` checks
the numbers.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, cast

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import RecordError, require_thread_count
from counterspin.frozen import frozen
from counterspin.input import FileIdentity, open_file, read_file
from counterspin.loading import load_name
from counterspin.records.column_file import (
    ColumnFile,
    Columns,
    NoRowsError,
    record_errors,
    row_count,
)
from counterspin.records.dialect import AUTODETECT, Dialect
from counterspin.records.format_registry import RECORD_FORMATS, format_of, suffix_problem
from counterspin.records.isolation import run_isolated
from counterspin.records.memory import MemoryFile, MemoryTable
from counterspin.records.record import ColumnSpec

if TYPE_CHECKING:
    import polars as pl


#: Opens a record file.
Opener = Callable[[Path, BinaryIO, Dialect], ColumnFile]


def find_opener(path: Path) -> Opener:
    """Return the opener of a file; RecordError for an unsupported extension or a folder."""
    if problem := suffix_problem(path):
        raise RecordError(f"{path}: {problem}", code="wrong-file-type")
    return cast("Opener", load_name(RECORD_FORMATS[path.suffix.lower()].opener))


def open_columns(path: Path | MemoryTable, dialect: Dialect = AUTODETECT) -> ColumnFile:
    """Open a record file, as a context manager."""
    if isinstance(path, MemoryTable):
        return MemoryFile(path)
    require_thread_count()
    opener = find_opener(path)
    with record_errors(path), ExitStack() as stack:
        stream = stack.enter_context(open_file(path))
        if FileIdentity.from_file(stream.fileno()).size == 0:
            raise RecordError(f"{path}: the file is empty.", code="no-rows")
        file = opener(path, stream, dialect)
        if dialect.select is not None:
            file.select(*dialect.select)
        stack.pop_all()
        return file


# As a table ------------------------------------------------------------------------------------


@frozen(eq=False)
class StoredTable:
    """The columns of a file, and its format."""

    frame: pl.DataFrame  #: Cells; text remains text.
    units: Mapping[str, str]  #: Column -> normalised unit in the units row; or empty.
    delimiter: str  #: Delimiter of a text file.
    decimal: str  #: Decimal separator of a text file.
    format_description: str  #: Detected format, if it is not plain.


def read_table(path: Path, dialect: Dialect = AUTODETECT) -> StoredTable:
    """Read a whole file; text cells remain text."""
    return run_isolated(_read_table, path, dialect)


def read_small_table(
    path: Path, dialect: Dialect = AUTODETECT
) -> tuple[StoredTable, list[str], str]:
    """Read a table; return it with the locations of its rows and the SHA-256 of the file."""
    return run_isolated(_read_small_table, path, dialect)


def has_sheets(path: Path) -> bool:
    """Return True if the format of a file has sheets."""
    file_format = format_of(path)
    return file_format is not None and bool(file_format.sheets)


def sheets_with_tables(path: Path) -> tuple[str, ...]:
    """Return the sheets of a file that contain a table of numbers; empty without sheets."""
    file_format = format_of(path)
    if file_format is None or not file_format.sheets:
        return ()
    return tuple(run_isolated(load_name(file_format.sheets), path))


def read_numbers(
    path: Path | MemoryTable, names: Sequence[str], dialect: Dialect = AUTODETECT
) -> Columns:
    """Read columns of numbers, NaN for empty cells."""
    return run_isolated(_read_numbers, path, list(names), dialect)


def read_scaled(
    path: Path | MemoryTable, columns: Sequence[ColumnSpec], dialect: Dialect = AUTODETECT
) -> list[Array]:
    """Read columns in SI, NaN for empty cells, including counted rows and time stamps."""
    return run_isolated(_read_scaled, path, list(columns), dialect)


def locate(path: Path | MemoryTable, row: int, dialect: Dialect = AUTODETECT) -> str:
    """Return the location in the file of a data row, counted from 0."""
    return run_isolated(_locate, path, row, dialect)


def _read_table(path: Path, dialect: Dialect) -> StoredTable:
    with open_columns(path, dialect) as file:
        return _make_stored_table(file)


def _make_stored_table(file: ColumnFile) -> StoredTable:
    units = file.units if file.units_row else {}
    return StoredTable(file.table(), units, file.delimiter, file.decimal, file.format_description)


def _read_small_table(path: Path, dialect: Dialect) -> tuple[StoredTable, list[str], str]:
    try:
        with open_columns(path, dialect) as file:
            # The context manager checks that the file has not changed.
            table = _make_stored_table(file)
            return table, file.row_locations(table.frame.height), _sha256(file.content())
    except NoRowsError:  # a sheet of text, such as attitudes: the first row contains the names
        with record_errors(path):
            content = read_file(path)
        read_text = load_name(RECORD_FORMATS[path.suffix.lower()].text_sheet)
        frame = read_text(path, dialect, content)
        text_table = StoredTable(frame, {}, ColumnFile.delimiter, ColumnFile.decimal, "")
        locations = [f"row {row + 1} below the names" for row in range(frame.height)]
        return text_table, locations, _sha256(content)


def _sha256(content: bytes) -> str:
    return f"sha256:{hashlib.sha256(content).hexdigest()}"


def _read_numbers(path: Path | MemoryTable, names: list[str], dialect: Dialect) -> Columns:
    with open_columns(path, dialect) as file:
        file.require(names)
        return file.read_columns(names)


def _read_scaled(
    path: Path | MemoryTable, columns: list[ColumnSpec], dialect: Dialect
) -> list[Array]:
    columns_in_file = [spec.name for spec in columns if not spec.is_derived_column]
    with open_columns(path, dialect) as file:
        file.timestamp_columns = frozenset(spec.name for spec in columns if spec.kind == "stamps")
        file.require(columns_in_file)
        columns_by_name = file.read_columns(columns_in_file)
        row_numbers = np.arange(row_count(columns_by_name), dtype=float)
        resolved_specs = [spec.resolve_unit(file) for spec in columns]
        return [
            (row_numbers if spec.is_derived_column else columns_by_name[spec.name]) * spec.factor
            + spec.offset
            for spec in resolved_specs
        ]


def _locate(path: Path | MemoryTable, row: int, dialect: Dialect) -> str:
    with open_columns(path, dialect) as file:
        return file.locate_row(row)
