"""Record files of named arrays: HDF5, and MATLAB in either of its formats.

- `Hdf5File`: datasets at the root or in one group; `group/name` names any other
- `MatlabFile`: variables of a .mat file up to version 7 (from 7.3 on they are HDF5)

A column is an array with one dimension larger than 1; MATLAB keeps it as a column or a row.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from counterspin.errors import RecordError
from counterspin.records.column_file import ColumnFile
from counterspin.records.pieces import Columns, joined

if TYPE_CHECKING:
    import polars as pl

#: Rows read at a time (24 MB for three columns).
_BATCH_ROWS = 1_000_000


class ArrayFile(ColumnFile):
    """A file of named arrays."""

    @abstractmethod
    def _arrays(self, wanted: Sequence[str]) -> AbstractContextManager[Mapping[str, Any]]:
        """Open the wanted arrays; they have a dtype and a shape, and can be sliced."""

    def require(self, wanted: Sequence[str]) -> None:
        """Raise `RecordError` unless the wanted arrays are columns of numbers, equally long."""
        super().require(wanted)
        with self._arrays(wanted) as arrays:
            lengths = {}
            for name in wanted:
                array = arrays[name]
                if array.dtype.kind not in "fiu":
                    raise RecordError(f"{self.path}: '{name}' does not hold numbers.")
                # HDF5 has datasets without any space, whose shape is None.
                if array.shape is None or array.size != max(array.shape, default=0):
                    raise RecordError(
                        f"{self.path}: '{name}' has the shape {array.shape}; one column is needed."
                    )
                lengths[name] = array.size
        if len(set(lengths.values())) > 1:
            listed = ", ".join(f"'{name}' {length}" for name, length in lengths.items())
            raise RecordError(f"{self.path}: the columns differ in length: {listed}.")

    def batches(self, wanted: Sequence[str]) -> Iterator[Columns]:
        """Yield slices of the arrays."""
        with self._arrays(wanted) as arrays:
            length = max((arrays[name].size for name in wanted), default=0)
            for start in range(0, length, _BATCH_ROWS):
                stop = min(start + _BATCH_ROWS, length)
                yield {name: _slice(arrays[name], start, stop) for name in wanted}

    def table(self) -> pl.DataFrame:
        """Return all arrays of the file, which must be columns of numbers, equally long."""
        import polars as pl

        self.require(self.names)
        return pl.DataFrame(joined(list(self.batches(self.names)) or [{}]))


class Hdf5File(ArrayFile):
    """Datasets of an HDF5 file."""

    def __init__(self, path: Path) -> None:
        import h5py

        self.path = path
        if not h5py.is_hdf5(path):
            raise RecordError(f"{path}: this is not an HDF5 file.")
        with self._datasets() as datasets:
            self.names = list(datasets)

    @contextmanager
    def _arrays(self, wanted: Sequence[str]) -> Iterator[Mapping[str, Any]]:
        with self._datasets() as datasets:
            yield {name: datasets[name] for name in wanted}

    @contextmanager
    def _datasets(self) -> Iterator[dict[str, Any]]:
        import h5py

        with h5py.File(self.path, "r") as file:
            datasets: dict[str, Any] = {}
            file.visititems(
                lambda name, item: datasets.update({name: item}) if hasattr(item, "dtype") else None
            )
            groups = {name.rpartition("/")[0] for name in datasets}
            if len(groups) == 1:
                yield {name.rpartition("/")[2]: item for name, item in datasets.items()}
            else:
                yield datasets


class MatlabFile(ArrayFile):
    """Variables of a MATLAB file up to version 7."""

    def __init__(self, path: Path) -> None:
        from scipy.io import whosmat

        self.path = path
        self._loaded: dict[str, np.ndarray] = {}
        with _damage_named(path):
            self.names = [name for name, _, _ in whosmat(path)]

    @contextmanager
    def _arrays(self, wanted: Sequence[str]) -> Iterator[Mapping[str, Any]]:
        from scipy.io import loadmat

        # The format has no way to read part of a variable.
        missing = [name for name in wanted if name not in self._loaded]
        if missing:
            with _damage_named(self.path):
                self._loaded |= loadmat(self.path, variable_names=missing)
        yield self._loaded


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    try:
        yield
    except (ValueError, TypeError, NotImplementedError) as error:
        raise RecordError(f"{path}: this is not a MATLAB file: {error}.") from None


def _slice(array: Any, start: int, stop: int) -> np.ndarray:
    index = tuple(slice(start, stop) if size > 1 else 0 for size in array.shape)
    return np.atleast_1d(np.asarray(array[index], dtype=float))
