"""Record files, whatever their format: CSV, Parquet, HDF5 and MATLAB files look alike from here.

- `open_columns`: a `ColumnFile` for a file, by its ending
- `refusals`: what the system refuses becomes a `RecordError`

A `ColumnFile` yields columns in batches of float64 arrays (an empty cell is NaN) and says where a
row stands in the file, in the words a person needs to find it: the line of a text editor for CSV,
the row else. Nothing here judges the numbers; `reading` does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from counterspin.errors import RecordError
from counterspin.records.array_files import Hdf5File, MatlabFile
from counterspin.records.column_file import ColumnFile
from counterspin.records.csv_file import CsvFile
from counterspin.records.parquet_file import ParquetFile


def open_columns(path: Path) -> ColumnFile:
    """Open a record file.

    Parameters
    ----------
    path
        A file ending in .csv, .txt, .tsv, .parquet, .h5, .hdf5 or .mat.

    Raises
    ------
    RecordError
        The file is missing, unreadable, empty, or of an unknown kind.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        known = ", ".join(sorted(_READERS))
        raise RecordError(f"{path}: a record file ends in one of {known}; this one does not.")
    with refusals(path):
        if not path.exists():
            raise RecordError(f"{path}: there is no such file.")
        if path.is_dir():
            raise RecordError(f"{path}: this is a directory; a record is a file.")
        if path.stat().st_size == 0:
            raise RecordError(f"{path}: the file is empty.")
        return reader(path)


@contextmanager
def refusals(path: Path) -> Iterator[None]:
    """Turn what the system refuses while a file is read into a `RecordError`."""
    try:
        yield
    except PermissionError:
        raise RecordError(f"{path}: the file cannot be read; check its permissions.") from None
    except OSError as error:
        reason = error.strerror or str(error).splitlines()[0]
        raise RecordError(f"{path}: the file cannot be read: {reason}.") from None


def _matlab(path: Path) -> ColumnFile:
    """Open a .mat file, which from version 7.3 on is an HDF5 file."""
    import h5py

    return Hdf5File(path) if h5py.is_hdf5(path) else MatlabFile(path)


_READERS: dict[str, Callable[[Path], ColumnFile]] = {
    ".csv": CsvFile,
    ".txt": CsvFile,
    ".tsv": CsvFile,
    ".parquet": ParquetFile,
    ".h5": Hdf5File,
    ".hdf5": Hdf5File,
    ".mat": _matlab,
}
