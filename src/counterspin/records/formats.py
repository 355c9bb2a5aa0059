"""Record files as streams of columns: CSV, Parquet, HDF5 and MATLAB files look alike from here.

`open_columns` checks that the file and its columns exist and returns a `ColumnFile`, which yields
the columns in batches of float64 arrays (an empty cell is NaN) and tells where a row stands in
the file, in the words a person needs to find it: the line of a text editor for CSV, the row else.
Nothing here judges the numbers; `records` does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from counterspin.errors import RecordError
from counterspin.records.column_file import ColumnFile, Columns, frame_arrays
from counterspin.records.csv_file import CsvFile

if TYPE_CHECKING:
    import polars as pl

#: Rows read at a time from HDF5 (24 MB for three columns).
_HDF5_BATCH = 1_000_000


def open_columns(path: Path, names: Sequence[str]) -> ColumnFile:
    """Open a record file to read the named columns.

    Parameters
    ----------
    path
        A file ending in .csv, .txt, .tsv, .parquet, .h5, .hdf5 or .mat.
    names
        The columns wanted, as the file calls them.

    Raises
    ------
    RecordError
        The file is missing, unreadable, empty, of an unknown kind, or lacks a column.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        known = ", ".join(sorted(_READERS))
        raise RecordError(f"{path}: a record file ends in one of {known}; this one does not.")
    try:
        if not path.exists():
            raise RecordError(f"{path}: there is no such file.")
        if path.is_dir():
            raise RecordError(f"{path}: this is a directory; a record is a file.")
        if path.stat().st_size == 0:
            raise RecordError(f"{path}: the file is empty.")
        return reader(path, names)
    except PermissionError:
        raise RecordError(f"{path}: the file cannot be read; check its permissions.") from None
    except OSError as error:
        reason = error.strerror or str(error).splitlines()[0]
        raise RecordError(f"{path}: the file cannot be read: {reason}.") from None


class ParquetFile(ColumnFile):
    """A Parquet file with numeric columns."""

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        import polars as pl

        super().__init__(path, names)
        try:
            schema = pl.scan_parquet(path).collect_schema()
        except pl.exceptions.PolarsError:
            raise RecordError(f"{path}: this is not a readable Parquet file.") from None
        self._require(schema.names())
        for name in names:
            if not schema[name].is_numeric():
                raise RecordError(
                    f"{path}: column '{name}' is of type {schema[name]}; numbers belong there."
                )

    def table(self) -> pl.DataFrame:
        """Return every column of the file with its type."""
        import polars as pl

        return pl.read_parquet(self.path)

    def batches(self) -> Iterator[Columns]:
        """Yield batches of the columns as the streaming engine decodes them."""
        import polars as pl

        frames = pl.scan_parquet(self.path).select(pl.col(self.names).cast(pl.Float64()))
        try:
            for frame in frames.collect_batches(maintain_order=True):
                yield frame_arrays(frame)
        except pl.exceptions.PolarsError as error:
            reason = str(error).splitlines()[0]
            raise RecordError(f"{self.path}: the Parquet file is damaged: {reason}") from None


class ArraysFile(ColumnFile):
    """A file of named one-dimensional arrays: HDF5, or MATLAB in either of its formats.

    HDF5 datasets stand at the root or in one group (`group/name` names any other). MATLAB keeps
    its arrays as columns or rows; both are read as they stand.
    """

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        import h5py

        super().__init__(path, names)
        self._hdf5 = bool(h5py.is_hdf5(path))
        if not self._hdf5 and path.suffix.lower() != ".mat":
            raise RecordError(f"{path}: this is not an HDF5 file.")
        with self._arrays() as arrays:
            self._require(list(arrays))
            lengths = {}
            for name in names:
                array = arrays[name]
                if array.dtype.kind not in "fiu":
                    raise RecordError(f"{path}: '{name}' does not hold numbers.")
                # HDF5 has datasets without any space, whose shape is None.
                if array.shape is None or array.size != max(array.shape, default=0):
                    raise RecordError(
                        f"{path}: '{name}' has the shape {array.shape}; one column is needed."
                    )
                lengths[name] = array.size
        if len(set(lengths.values())) > 1:
            listed = ", ".join(f"'{name}' {length}" for name, length in lengths.items())
            raise RecordError(f"{path}: the columns differ in length: {listed}.")
        self._length = max(lengths.values(), default=0)

    def _arrays(self) -> Any:
        return _hdf5_arrays(self.path) if self._hdf5 else _matlab_arrays(self.path, self.names)

    def batches(self) -> Iterator[Columns]:
        """Yield slices of the arrays."""
        with self._arrays() as arrays:
            for start in range(0, self._length, _HDF5_BATCH):
                stop = min(start + _HDF5_BATCH, self._length)
                yield [_slice(arrays[name], start, stop) for name in self.names]


def _slice(array: Any, start: int, stop: int) -> np.ndarray:
    index = tuple(slice(start, stop) if size > 1 else 0 for size in array.shape)
    return np.atleast_1d(np.asarray(array[index], dtype=float))


class _hdf5_arrays:  # noqa: N801 - used as a function
    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> dict[str, Any]:
        import h5py

        self._file = h5py.File(self._path, "r")
        found: dict[str, Any] = {}
        self._file.visititems(
            lambda name, item: found.update({name: item}) if hasattr(item, "dtype") else None
        )
        groups = {name.rpartition("/")[0] for name in found}
        if len(groups) == 1:
            return {name.rpartition("/")[2]: item for name, item in found.items()}
        return found

    def __exit__(self, *_: object) -> None:
        self._file.close()


class _matlab_arrays:  # noqa: N801 - used as a function
    def __init__(self, path: Path, names: Sequence[str]) -> None:
        self._path, self._names = path, names

    def __enter__(self) -> dict[str, Any]:
        from scipy.io import loadmat, whosmat

        try:
            present = [name for name, _, _ in whosmat(self._path)]
            arrays = loadmat(self._path, variable_names=self._names)
        except (ValueError, TypeError, NotImplementedError) as error:
            raise RecordError(f"{self._path}: this is not a MATLAB file: {error}.") from None
        return {name: arrays.get(name) for name in present}

    def __exit__(self, *_: object) -> None: ...


_READERS: dict[str, Callable[[Path, Sequence[str]], ColumnFile]] = {
    ".csv": CsvFile,
    ".txt": CsvFile,
    ".tsv": CsvFile,
    ".parquet": ParquetFile,
    ".h5": ArraysFile,
    ".hdf5": ArraysFile,
    ".mat": ArraysFile,
}
