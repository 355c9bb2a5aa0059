"""Formats of record files by their endings: **the** table of formats.

A new format is a row here and a class or function that opens its files.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from counterspin.frozen import frozen

_TEXT: Final = "counterspin.records.csv_file:CsvFile"
_ARRAYS: Final = "counterspin.records.array_files"
_TABLES: Final = "counterspin.records.table_files"


@frozen
class RecordFormat:
    """Format of record files with one ending."""

    opener: str  #: Name of what opens a file, ``module:name``; imported for the first file.
    #: Libraries of native code that read the format, which may be absent; empty for text.
    libraries: tuple[str, ...] = ()
    holds_readings: bool = False  #: True if a table of readings may have this format.
    #: In formats with sheets, names of the functions that list the sheets with a table of numbers,
    #: and that read a sheet without numbers.
    sheets: str = ""
    text_sheet: str = ""

    @property
    def can_grow(self) -> bool:
        """True if a recorder can append rows to a file while it is read."""
        return self.opener == _TEXT


#: Ending of a record file, in lower case -> its format.
RECORD_FORMATS: Final[Mapping[str, RecordFormat]] = {
    ".csv": RecordFormat(_TEXT, holds_readings=True),
    ".txt": RecordFormat(_TEXT, holds_readings=True),
    ".tsv": RecordFormat(_TEXT, holds_readings=True),
    ".lvm": RecordFormat(_TEXT),
    ".log": RecordFormat(_TEXT),
    ".dat": RecordFormat(_TEXT),
    ".asc": RecordFormat(_TEXT),
    ".xls": RecordFormat("counterspin.records.csv_file:open_text_named_excel"),
    ".parquet": RecordFormat(f"{_TABLES}:ParquetFile", ("polars",), holds_readings=True),
    ".h5": RecordFormat(f"{_ARRAYS}:Hdf5File", ("h5py",), holds_readings=True),
    ".hdf5": RecordFormat(f"{_ARRAYS}:Hdf5File", ("h5py",), holds_readings=True),
    ".mat": RecordFormat(f"{_ARRAYS}:open_matlab", ("h5py", "scipy.io"), holds_readings=True),
    ".xlsx": RecordFormat(
        f"{_TABLES}:ExcelFile",
        ("fastexcel", "polars"),
        holds_readings=True,
        sheets=f"{_TABLES}:table_sheets",
        text_sheet=f"{_TABLES}:excel_table",
    ),
    ".tdms": RecordFormat("counterspin.records.tdms_file:TdmsFile", ("nptdms", "polars")),
}

#: Endings of files that hold other files, made small.
_COMPRESSED_SUFFIXES: Final = (".gz", ".zip", ".bz2", ".xz", ".zst", ".7z", ".rar", ".tar", ".tgz")


#: Ending of a file that is no record, though it may hold one -> what to do with it.
_ALTERNATIVES: Final[Mapping[str, str]] = {
    ".npy": "NumPy's binary format is not supported; write it as text: "
    'savetxt("NAME.csv", load("NAME.npy"), delimiter=",").',
    ".npz": "NumPy's binary format is not supported; write an array as text: "
    'savetxt("NAME.csv", load("NAME.npz")["ARRAY"], delimiter=",").',
    **dict.fromkeys(
        (".json", ".jsonl", ".xml", ".yaml", ".yml", ".toml", ".db", ".sqlite"),
        "not a data table; export the data as CSV with one line per sample.",
    ),
    **dict.fromkeys(
        (".ods", ".numbers", ".doc", ".docx", ".rtf", ".pdf"),
        "this format is not supported; save the table as .xlsx or .csv in the program that wrote "
        "the file.",
    ),
    **dict.fromkeys(
        (".bin", ".raw", ".pkl", ".pickle"),
        "the byte layout of this file is unknown; export text, such as .csv, from the program "
        "that wrote it.",
    ),
}


def format_of(path: Path) -> RecordFormat | None:
    """Return the format of a record file by its ending; None if no record file has this ending."""
    return RECORD_FORMATS.get(path.suffix.lower())


def suffix_problem(path: Path) -> str:
    """Return why a file is no record by its ending, and what to do; empty if it may be one."""
    ending = path.suffix.lower()
    if format_of(path) is not None:
        return ""
    if ending in _COMPRESSED_SUFFIXES:
        return "the file is compressed; unpack it, and use the extracted file."
    if ending in _ALTERNATIVES and not path.is_dir():
        return _ALTERNATIVES[ending]
    problem = "this is a folder" if path.is_dir() else "this file does not"
    return f"the name of a record file must end in one of {', '.join(RECORD_FORMATS)}; {problem}."
