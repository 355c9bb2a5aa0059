"""Record files, whatever their format: CSV, Parquet, HDF5 and MATLAB files look alike from here.

A `ColumnFile` yields columns in batches of float64 arrays (an empty cell is NaN) and says where a
row stands in the file, in the words a person needs to find it: the line of a text editor for CSV,
the row else. Nothing here judges the numbers; `reading` does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO, Final

from counterspin.errors import RecordError
from counterspin.input import FileIdentity, open_file
from counterspin.records.array_files import Hdf5File, MatlabFile
from counterspin.records.column_file import ColumnFile, record_errors
from counterspin.records.csv_file import CsvFile
from counterspin.records.dialect import TO_BE_FOUND, Dialect
from counterspin.records.excel_file import ExcelFile
from counterspin.records.memory import MemoryFile, MemoryTable
from counterspin.records.parquet_file import ParquetFile
from counterspin.records.tdms_file import TdmsFile

#: Bytes that show whether a file is text.
_SHOWN_BYTES: Final = 4096


def _matlab(path: Path, stream: BinaryIO, dialect: Dialect) -> ColumnFile:
    """Open a .mat file: HDF5 from version 7.3 on, MATLAB's own format before, or ``-ascii``."""
    import h5py

    if h5py.is_hdf5(path):
        return Hdf5File(path, stream, dialect)
    head = stream.read(_SHOWN_BYTES)
    stream.seek(0)
    # MATLAB's own begins with words too; numbers follow in bytes that no text has.
    is_text = not head.startswith(b"MATLAB") and b"\0" not in head
    return (CsvFile if is_text else MatlabFile)(path, stream, dialect)


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


#: Ending of a record file, in lower case -> what opens it.
RECORD_FORMATS: Final[Mapping[str, Callable[[Path, BinaryIO, Dialect], ColumnFile]]] = {
    ".csv": CsvFile,
    ".txt": CsvFile,
    ".tsv": CsvFile,
    ".lvm": CsvFile,
    ".log": CsvFile,
    ".dat": CsvFile,
    ".asc": CsvFile,
    ".xls": _named_excel,
    ".parquet": ParquetFile,
    ".h5": Hdf5File,
    ".hdf5": Hdf5File,
    ".mat": _matlab,
    ".xlsx": ExcelFile,
    ".tdms": TdmsFile,
}


#: Endings of files that hold other files, made small.
_PACKED: Final = (".gz", ".zip", ".bz2", ".xz", ".zst", ".7z", ".rar", ".tar", ".tgz")


def wrong_ending(path: Path) -> str:
    """Return why a file is no record by its ending, and what to do; empty if it may be one."""
    ending = path.suffix.lower()
    if ending in RECORD_FORMATS:
        return ""
    if ending in _PACKED:
        return "the file is packed; unpack it, and give the file inside."
    kind = "this is a folder" if path.is_dir() else "this one does not"
    return f"a record file ends in one of {', '.join(RECORD_FORMATS)}; {kind}."


def opener_of(path: Path) -> Callable[[Path, BinaryIO, Dialect], ColumnFile]:
    """Return what opens a file; RecordError if no record has its ending, or if it is a folder."""
    if wrong := wrong_ending(path):
        raise RecordError(f"{path}: {wrong}")
    return RECORD_FORMATS[path.suffix.lower()]


def open_columns(path: Path | MemoryTable, dialect: Dialect = TO_BE_FOUND) -> ColumnFile:
    """Open a record file, as a context manager."""
    if isinstance(path, MemoryTable):
        return MemoryFile(path)
    opener = opener_of(path)
    with record_errors(path), ExitStack() as stack:
        stream = stack.enter_context(open_file(path))
        if FileIdentity.of(stream.fileno()).size == 0:
            raise RecordError(f"{path}: the file is empty.")
        file = opener(path, stream, dialect)
        stack.pop_all()
        return file
