"""Record files, whatever their format, as columns or as a table.

CSV, Parquet, HDF5 and MATLAB files look alike from here. A `ColumnFile` yields columns in batches
of float64 arrays (an empty cell is NaN) and says where a row stands in the file, in the words a
person needs to find it: the line of a text editor for CSV, the row else. Nothing here judges the
numbers; `reading` does.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final, cast

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
    column_rows,
    record_errors,
)
from counterspin.records.csv_file import CsvFile
from counterspin.records.dialect import TO_BE_FOUND, Dialect
from counterspin.records.isolation import in_reader_process
from counterspin.records.memory import MemoryFile, MemoryTable
from counterspin.records.record import ColumnSpec

if TYPE_CHECKING:
    import polars as pl


#: Bytes that show whether a file is text.
_SHOWN_BYTES: Final = 4096


def _matlab(path: Path, stream: BinaryIO, dialect: Dialect) -> ColumnFile:
    """Open a .mat file: HDF5 from version 7.3 on, MATLAB's own format before, or ``-ascii``."""
    import h5py

    if h5py.is_hdf5(path):
        return _loaded(_HDF5)(path, stream, dialect)
    head = stream.read(_SHOWN_BYTES)
    stream.seek(0)
    # MATLAB's own begins with words too; numbers follow in bytes that no text has.
    is_text = not head.startswith(b"MATLAB") and b"\0" not in head
    return (CsvFile if is_text else _loaded(_MATLAB))(path, stream, dialect)


def _named_excel(path: Path, stream: BinaryIO, dialect: Dialect) -> ColumnFile:
    """Open text that is named .xls, as LabVIEW and others name what Excel is to open."""
    head = stream.read(_SHOWN_BYTES)
    stream.seek(0)
    if head.startswith((b"\xd0\xcf\x11\xe0", b"PK")):
        raise RecordError(f"{path}: this is a workbook; save it as .xlsx, without a password.")
    if head.lstrip().startswith(b"<"):
        raise RecordError(
            f"{path}: this is a page or XML for Excel; open it there, save it as .xlsx."
        )
    return CsvFile(path, stream, dialect)


#: Opens a record file.
Opener = Callable[[Path, BinaryIO, Dialect], ColumnFile]

_HDF5: Final = "counterspin.records.array_files:Hdf5File"
_MATLAB: Final = "counterspin.records.array_files:MatlabFile"
_TABLES: Final = "counterspin.records.table_files"

#: Ending of a record file, in lower case -> its opener, or the name by which that is loaded.
RECORD_FORMATS: Final[Mapping[str, Opener | str]] = {
    ".csv": CsvFile,
    ".txt": CsvFile,
    ".tsv": CsvFile,
    ".lvm": CsvFile,
    ".log": CsvFile,
    ".dat": CsvFile,
    ".asc": CsvFile,
    ".xls": _named_excel,
    ".parquet": f"{_TABLES}:ParquetFile",
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".mat": _matlab,
    ".xlsx": f"{_TABLES}:ExcelFile",
    ".tdms": "counterspin.records.array_files:TdmsFile",
}


#: Endings of files that hold other files, made small.
_PACKED: Final = (".gz", ".zip", ".bz2", ".xz", ".zst", ".7z", ".rar", ".tar", ".tgz")


#: Ending of a file that is no record, though it may hold one -> what to do with it.
_INSTEAD: Final[Mapping[str, str]] = {
    ".npy": "NumPy's own format is not read; write it as text: "
    'savetxt("NAME.csv", load("NAME.npy"), delimiter=",").',
    ".npz": "NumPy's own format is not read; write an array as text: "
    'savetxt("NAME.csv", load("NAME.npz")["ARRAY"], delimiter=",").',
    **dict.fromkeys(
        (".json", ".jsonl", ".xml", ".yaml", ".yml", ".toml", ".db", ".sqlite"),
        "this is no table; write its rows to a .csv file, a line for each time.",
    ),
    **dict.fromkeys(
        (".ods", ".numbers", ".doc", ".docx", ".rtf", ".pdf"),
        "this format is not read; save its table as .xlsx or .csv in the program that wrote it.",
    ),
    **dict.fromkeys(
        (".bin", ".raw", ".pkl", ".pickle"),
        "how its bytes are arranged is not stated; export text, such as .csv, from the program "
        "that wrote it.",
    ),
}


def wrong_ending(path: Path) -> str:
    """Return why a file is no record by its ending, and what to do; empty if it may be one."""
    ending = path.suffix.lower()
    if ending in RECORD_FORMATS:
        return ""
    if ending in _PACKED:
        return "the file is packed; unpack it, and give the file inside."
    if ending in _INSTEAD and not path.is_dir():
        return _INSTEAD[ending]
    kind = "this is a folder" if path.is_dir() else "this one does not"
    return f"a record file ends in one of {', '.join(RECORD_FORMATS)}; {kind}."


def _loaded(opener: Opener | str) -> Opener:
    return cast("Opener", load_name(opener)) if isinstance(opener, str) else opener


def opener_of(path: Path) -> Opener:
    """Return the opener of a file; RecordError for an unknown ending or a folder."""
    if wrong := wrong_ending(path):
        raise RecordError(f"{path}: {wrong}")
    return _loaded(RECORD_FORMATS[path.suffix.lower()])


def open_columns(path: Path | MemoryTable, dialect: Dialect = TO_BE_FOUND) -> ColumnFile:
    """Open a record file, as a context manager."""
    if isinstance(path, MemoryTable):
        return MemoryFile(path)
    require_thread_count()
    opener = opener_of(path)
    with record_errors(path), ExitStack() as stack:
        stream = stack.enter_context(open_file(path))
        if FileIdentity.of(stream.fileno()).size == 0:
            raise RecordError(f"{path}: the file is empty.")
        file = opener(path, stream, dialect)
        if dialect.select is not None:
            file.select(*dialect.select)
        stack.pop_all()
        return file


# As a table ------------------------------------------------------------------------------------


@frozen(eq=False)
class FiledTable:
    """A file's columns, and how they are written."""

    frame: pl.DataFrame  #: Cells of text as they stand.
    #: Column -> its unit by a row of units, in plain signs; empty without such a row.
    units: Mapping[str, str]
    #: What parts cells and decimals in a file of text.
    delimiter: str
    decimal: str
    found: str  #: How the file is written, where that is not plain.


def read_table(path: Path, dialect: Dialect = TO_BE_FOUND) -> FiledTable:
    """Return a whole file as it stands, cells of text remaining text."""
    return in_reader_process(_table, path, dialect)


def read_small_table(
    path: Path, dialect: Dialect = TO_BE_FOUND
) -> tuple[FiledTable, list[str], str]:
    """Return a table, where each of its rows stands, and the SHA-256 of what was read."""
    return in_reader_process(_small_table, path, dialect)


def is_workbook(path: Path) -> bool:
    """Return True if a file is an Excel workbook."""
    return path.suffix.lower() == ".xlsx"


def read_numbers(
    path: Path | MemoryTable, names: Sequence[str], dialect: Dialect = TO_BE_FOUND
) -> Columns:
    """Return columns of numbers, NaN where a cell is empty, of a file in any dialect."""
    return in_reader_process(_numbers, path, list(names), dialect)


def read_scaled(
    path: Path | MemoryTable, columns: Sequence[ColumnSpec], dialect: Dialect = TO_BE_FOUND
) -> list[Array]:
    """Return columns in SI, NaN where a cell is empty; rows may be counted, and stamps timed."""
    return in_reader_process(_scaled, path, list(columns), dialect)


def locate(path: Path | MemoryTable, row: int, dialect: Dialect = TO_BE_FOUND) -> str:
    """Say where data row `row` (counted from 0) stands in the file."""
    if isinstance(path, Path) and is_workbook(path):
        return f"row {row + 1} below the names"
    return in_reader_process(_locate, path, row, dialect)


def places(path: Path, rows: int) -> list[str]:
    """Say where each of the data rows stands in the file."""
    if is_workbook(path):
        return _sheet_places(rows)
    return in_reader_process(_places, path, rows)


def _table(path: Path, dialect: Dialect) -> FiledTable:
    with open_columns(path, dialect) as file:
        return _filed(file)


def _filed(file: ColumnFile) -> FiledTable:
    units = file.units if file.units_row else {}
    return FiledTable(file.table(), units, file.delimiter, file.decimal, file.found)


def _small_table(path: Path, dialect: Dialect) -> tuple[FiledTable, list[str], str]:
    try:
        with open_columns(path, dialect) as file:
            # On leaving, the file must still be what it was when it was opened.
            table = _filed(file)
            return table, file.places(table.frame.height), _checksum(file.content())
    except NoRowsError:  # of words, such as attitudes: names stand in the first row then
        with record_errors(path):
            content = read_file(path)
        frame = load_name(f"{_TABLES}:excel_table")(path, dialect, content)
        plain = FiledTable(frame, {}, ColumnFile.delimiter, ColumnFile.decimal, "")
        return plain, _sheet_places(frame.height), _checksum(content)


def _checksum(content: bytes) -> str:
    return f"sha256:{hashlib.sha256(content).hexdigest()}"


def _sheet_places(rows: int) -> list[str]:
    return [f"row {row + 1} below the names" for row in range(rows)]


def _numbers(path: Path | MemoryTable, names: list[str], dialect: Dialect) -> Columns:
    with open_columns(path, dialect) as file:
        file.require(names)
        return file.whole(names)


def _scaled(path: Path | MemoryTable, columns: list[ColumnSpec], dialect: Dialect) -> list[Array]:
    filed = [spec.name for spec in columns if not spec.is_made]
    with open_columns(path, dialect) as file:
        file.stamps = frozenset(spec.name for spec in columns if spec.kind == "stamps")
        file.require(filed)
        read = file.whole(filed)
        rows = np.arange(column_rows(read), dtype=float)
        resolved = [spec.resolved(file) for spec in columns]
        return [
            (rows if spec.is_made else read[spec.name]) * spec.factor + spec.offset
            for spec in resolved
        ]


def _locate(path: Path | MemoryTable, row: int, dialect: Dialect) -> str:
    with open_columns(path, dialect) as file:
        return file.locate_row(row)


def _places(path: Path, rows: int) -> list[str]:
    with open_columns(path) as file:
        return file.places(rows)
