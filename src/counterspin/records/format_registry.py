"""Registry of the record file formats by file extension.

A new format requires an entry here, and a class or function that opens its files.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from counterspin.frozen import frozen

_TEXT_OPENER: Final = "counterspin.records.csv_file:CsvFile"
_ARRAY_MODULE: Final = "counterspin.records.array_files"
_TABLE_MODULE: Final = "counterspin.records.table_files"


@frozen
class RecordFormat:
    """Format of record files with a file extension."""

    opener: str  #: Class or function that opens a file, ``module:name``; imported on demand.
    #: Libraries of native code that read the format, which may be absent; empty for text.
    libraries: tuple[str, ...] = ()
    holds_readings: bool = False  #: True if a table of readings may have this format.
    #: For formats with sheets, functions that list the sheets with numbers, and read a text sheet.
    sheets: str = ""
    text_sheet: str = ""

    @property
    def can_grow(self) -> bool:
        """True if a recorder can append rows to a file while it is read."""
        return self.opener == _TEXT_OPENER


#: File extension, in lower case -> format.
RECORD_FORMATS: Final[Mapping[str, RecordFormat]] = {
    ".csv": RecordFormat(_TEXT_OPENER, holds_readings=True),
    ".txt": RecordFormat(_TEXT_OPENER, holds_readings=True),
    ".tsv": RecordFormat(_TEXT_OPENER, holds_readings=True),
    ".lvm": RecordFormat(_TEXT_OPENER),
    ".log": RecordFormat(_TEXT_OPENER),
    ".dat": RecordFormat(_TEXT_OPENER),
    ".asc": RecordFormat(_TEXT_OPENER),
    ".xls": RecordFormat("counterspin.records.csv_file:open_text_named_excel"),
    ".parquet": RecordFormat(f"{_TABLE_MODULE}:ParquetFile", ("polars",), holds_readings=True),
    ".h5": RecordFormat(f"{_ARRAY_MODULE}:Hdf5File", ("h5py",), holds_readings=True),
    ".hdf5": RecordFormat(f"{_ARRAY_MODULE}:Hdf5File", ("h5py",), holds_readings=True),
    ".mat": RecordFormat(f"{_ARRAY_MODULE}:open_matlab", ("h5py", "scipy.io"), holds_readings=True),
    ".xlsx": RecordFormat(
        f"{_TABLE_MODULE}:ExcelFile",
        ("fastexcel", "polars"),
        holds_readings=True,
        sheets=f"{_TABLE_MODULE}:find_table_sheets",
        text_sheet=f"{_TABLE_MODULE}:read_excel_table",
    ),
    ".tdms": RecordFormat("counterspin.records.tdms_file:TdmsFile", ("nptdms", "polars")),
}

#: Extensions of compressed files.
_COMPRESSED_SUFFIXES: Final = (".gz", ".zip", ".bz2", ".xz", ".zst", ".7z", ".rar", ".tar", ".tgz")


#: Extension of an unsupported file that may contain a record -> advice.
_ADVICE_BY_SUFFIX: Final[Mapping[str, str]] = {
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
        "the byte layout of this file is unknown; export a text file, such as .csv, from the "
        "program that wrote it.",
    ),
}


def format_of(path: Path) -> RecordFormat | None:
    """Return the format of a record file by its extension; None for unsupported extensions."""
    return RECORD_FORMATS.get(path.suffix.lower())


def suffix_problem(path: Path) -> str:
    """Return problem and advice for an unsupported extension; empty for supported ones."""
    suffix = path.suffix.lower()
    if format_of(path) is not None:
        return ""
    if suffix in _COMPRESSED_SUFFIXES:
        return "the file is compressed; unpack it and use the extracted file."
    if suffix in _ADVICE_BY_SUFFIX and not path.is_dir():
        return _ADVICE_BY_SUFFIX[suffix]
    problem = "this is a folder" if path.is_dir() else "this file does not"
    return f"the name of a record file must end in one of {', '.join(RECORD_FORMATS)}; {problem}."
