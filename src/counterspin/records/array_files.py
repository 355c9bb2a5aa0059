"""Record files of named arrays: HDF5, and both formats of MATLAB.

A column is an array with one dimension larger than 1, in MATLAB a column or a row. A matrix has one
column per element of its shorter dimension: `pos` of 12001 x 2 has the columns `pos.1` and `pos.2`,
in HDF5 `pos/1` and `pos/2`. A single number is not a column.
"""

from __future__ import annotations

import re
import struct
import zlib
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.records.column_file import ColumnFile, Columns, concatenate_batches, format_names
from counterspin.records.csv_file import CsvFile
from counterspin.records.dialect import Dialect
from counterspin.records.header_footer import parse_interval
from counterspin.records.unit_notation import parse_file_unit

if TYPE_CHECKING:
    import polars as pl


#: Rows read at a time (24 MB for three columns).
_BATCH_ROWS = 1_000_000
#: Largest number of columns of a matrix.
_MAX_COLUMNS = 200
#: End of MATLAB's header -> byte order; length of the header; type of a compressed element.
_BYTE_ORDERS = {b"IM": "<", b"MI": ">"}
_MATLAB_HEADER_BYTES = 128
_MATLAB_COMPRESSED_TYPE = 15
#: Numeric array classes of MATLAB.
_MATLAB_NUMBER_CLASSES = {"double", "single", "logical"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
#: Bytes that show whether a .mat file is text.
_PREVIEW_BYTES = 4096


#: Pattern of group names that denote a sensor.
_SENSOR_NAME = re.compile(
    r"(?i)(?<![a-z])(imu|sensor|device|acc(el(erometer)?)?|board|node|unit)(?![a-z])"
)


class ArrayFile(ColumnFile):
    """A file of named arrays."""

    _paths: dict[str, str]  # name, with or without its group -> path
    _column_indices: dict[str, int]  # name of a matrix column -> index
    _single_values: list[str]  # names of arrays with a single value

    @abstractmethod
    def _open_arrays(self, names: Sequence[str]) -> AbstractContextManager[Mapping[str, Any]]:
        """Open arrays, which have a dtype and a shape, and can be sliced."""

    @abstractmethod
    def _shape(self, name: str) -> tuple[int, ...] | None:
        """Return the shape of an array; RecordError unless this file contains its numbers."""

    def _name_columns(
        self,
        shapes: Mapping[str, tuple[int, ...] | None],
        group: str | None,
        *,
        separator: str,
        path_separator: str = "/",
    ) -> None:
        """Name the columns in the requested group, or in the only one.

        shapes: Path of an array -> shape; None: no shape.
        group: Path of the requested group, joined by `separator`; None: not stated.
        """
        paths = list(shapes)
        if group is None:
            groups = {path.rpartition(path_separator)[0] for path in paths}
            prefix = groups.pop() if len(groups) == 1 else ""
            self.runs = tuple(
                run.replace(path_separator, separator)
                for run in _find_run_groups(paths, path_separator)
            )
        else:
            prefix = group.strip(separator).replace(separator, path_separator)
        prefix = f"{prefix}{path_separator}" if prefix else ""
        paths_in_group = [path for path in paths if path.startswith(prefix)]
        short_names = {
            path[len(prefix) :].replace(path_separator, separator): path for path in paths_in_group
        }
        if group is not None and not short_names:
            raise RecordError(
                f"{self.path}: no group '{group}' contains columns.", code="missing-column"
            )
        # Full paths are names, too.
        self._paths = {
            path.replace(path_separator, separator): path for path in paths
        } | short_names
        self.names, self._single_values, self._column_indices = [], [], {}
        for name, path in list(self._paths.items()):
            n_columns = _column_count(shapes[path])
            columns = (
                [name]
                if n_columns == 1
                else [f"{name}{separator}{index + 1}" for index in range(n_columns)]
            )
            if n_columns > 1:
                self._paths |= dict.fromkeys(columns, path)
                self._column_indices |= {column: index for index, column in enumerate(columns)}
            if name in short_names:
                self.names += columns
                self._single_values += [name] if n_columns == 0 else []

    def single_numbers(self) -> dict[str, float]:
        """Return name -> number of the arrays with a single value."""
        numbers = {}
        for name in self._single_values:
            with suppress(RecordError):
                self._shape(name)  # raises RecordError without numbers
                numbers[name] = float(next(self._batches([name]))[name][0])
        return numbers

    def has_column(self, name: str) -> bool:
        """Return whether the file has a column of this name."""
        return name in self._paths

    def _require(self, names: Sequence[str]) -> None:
        lengths = {}
        for name in names:
            shape = self._shape(name)
            if shape is not None and name in self._column_indices:
                shape = (max(shape),)
            n_values = 0 if shape is None else int(np.prod(shape, dtype=object))
            # HDF5 has empty datasets, whose shape is None.
            if shape is None or n_values != max(shape, default=0):
                columns = [
                    column
                    for column in self._column_indices
                    if self._paths[column] == self._paths[name] and column.startswith(name)
                ]
                hint = f": {format_names(columns)}" if columns else ""
                raise RecordError(
                    (
                        f"{self.path}: '{name}' has the shape {shape}; a single column is "
                        f"required{hint}."
                    ),
                    code="wrong-shape",
                )
            lengths[name] = n_values
        if len(set(lengths.values())) > 1:
            name_list = ", ".join(f"'{name}' {length}" for name, length in lengths.items())
            raise RecordError(
                f"{self.path}: the columns have different lengths: {name_list}.", code="wrong-shape"
            )
        self._check_size(8 * sum(lengths.values()))

    def _batches(self, names: Sequence[str]) -> Iterator[Columns]:
        with self._open_arrays(names) as arrays:
            for name, array in arrays.items():
                if name in self.timestamp_columns and array.dtype.kind != "M":
                    raise RecordError(
                        f"{self.path}: '{name}' contains no readable time stamps; "
                        "export the time in seconds.",
                        code="not-numeric",
                    )
                if name not in self.timestamp_columns and array.dtype.kind not in "fiub":
                    raise RecordError(
                        f"{self.path}: '{name}' does not contain numbers.", code="not-numeric"
                    )
            length = max((max(array.shape, default=1) for array in arrays.values()), default=0)
            for start in range(0, length, _BATCH_ROWS):
                stop = min(start + _BATCH_ROWS, length)
                yield {
                    name: self._elapsed_seconds(array, start, stop)
                    if name in self.timestamp_columns
                    else _slice(array, start, stop, self._column_indices.get(name, 0))
                    for name, array in arrays.items()
                }

    def _elapsed_seconds(self, array: Any, start: int, stop: int) -> np.ndarray:
        """Return time stamps as seconds since the first one."""
        import polars as pl

        stamps = np.asarray(array[start:stop]).astype("datetime64[ns]").astype(np.int64)
        return self.elapsed_seconds(pl.Series(stamps))

    def _table(self) -> pl.DataFrame:
        """Return all arrays of the file, which must be columns of numbers of equal length."""
        import polars as pl

        self._require(self.names)
        return pl.DataFrame(concatenate_batches(list(self._batches(self.names)) or [{}]))


class Hdf5File(ArrayFile):
    """Datasets of an HDF5 file."""

    def __init__(self, path: Path, stream: BinaryIO, dialect: Dialect) -> None:
        import h5py

        super().__init__(path, stream)
        if not h5py.is_hdf5(path):
            raise RecordError(f"{path}: this is not an HDF5 file.", code="file-damaged")
        with h5py.File(path, "r") as file:
            datasets: dict[str, Any] = {}
            # Links are not followed.
            file.visititems(
                lambda name, item: (
                    datasets.update({name: item}) if isinstance(item, h5py.Dataset) else None
                )
            )
            is_matlab = path.suffix.lower() == ".mat"
            # MATLAB's internal datasets are not columns; its structures are groups with fields.
            shapes = {
                path: shape
                for dataset_name, dataset in datasets.items()
                if not is_matlab or dataset_name[0] != "#"
                for path, shape in _iter_fields(dataset_name, dataset)
            }
            attributes = (
                attribute for item in (file, *datasets.values()) for attribute in item.attrs.items()
            )
            intervals = {parse_interval([[key, str(value)]], ".") for key, value in attributes} - {
                None
            }
            self.interval = intervals.pop() if len(intervals) == 1 else None
            separator = "." if is_matlab else "/"
            self._name_columns(shapes, dialect.group, separator=separator)
            for name in self.names:
                dataset, field = _split_field(file, self._paths[name])
                text = "" if field else str(_find_attribute(dataset, "units", "unit") or "")
                # A netCDF time has a unit such as "seconds since 2026-01-01".
                self.units[name] = parse_file_unit(text.partition(" since ")[0]) or ""

    def _shape(self, name: str) -> tuple[int, ...] | None:
        import h5py

        with h5py.File(self.path, "r") as file:
            dataset, field = _split_field(file, self._paths[name])
            # The checksum would not cover numbers in another file.
            if dataset.is_virtual or dataset.external:
                raise RecordError(
                    f"{self.path}: the values of '{name}' are stored in another file. Export a "
                    "single file that contains all values.",
                    code="missing-column",
                )
            if field:
                array = _FieldArray(dataset, field)
                is_numeric, shape = array.dtype.kind in "fiu", array.shape
            else:
                type_class = dataset.id.get_type().get_class()
                is_numeric, shape = type_class in (h5py.h5t.INTEGER, h5py.h5t.FLOAT), dataset.shape
            if not is_numeric:
                raise RecordError(
                    f"{self.path}: '{name}' does not contain numbers.", code="not-numeric"
                )
            return shape

    @contextmanager
    def _open_arrays(self, names: Sequence[str]) -> Iterator[Mapping[str, Any]]:
        import h5py

        with h5py.File(self.path, "r") as file:
            arrays = {}
            for name in names:
                dataset, field = _split_field(file, self._paths[name])
                arrays[name] = _FieldArray(dataset, field) if field else _scale_dataset(dataset)
            yield arrays

    def _missing_columns_message(self, missing_names: Sequence[str]) -> str:
        import h5py

        with h5py.File(self.path, "r") as file:
            for name in missing_names:
                if isinstance(file.get(name, getlink=True), h5py.ExternalLink | h5py.SoftLink):
                    return f"'{name}' is a link; export a file that contains the column itself."
        return super()._missing_columns_message(missing_names)


def _iter_fields(name: str, dataset: Any) -> Iterator[tuple[str, tuple[int, ...] | None]]:
    """Yield path and shape of a dataset, or of each field of a compound dataset."""
    if not _is_compound(dataset):
        yield name, dataset.shape
        return
    for field in dataset.dtype.names:
        yield f"{name}/{field}", (*dataset.shape, *dataset.dtype[field].shape)


def _split_field(file: Any, path: str) -> tuple[Any, str]:
    """Return the dataset at a path, and the field of a compound dataset (or empty text)."""
    group, _, field = path.rpartition("/")
    dataset = file[group] if group else None
    return (dataset, field) if dataset is not None and _is_compound(dataset) else (file[path], "")


def _is_compound(node: Any) -> bool:
    """Return whether an HDF5 object is a dataset with named fields."""
    import h5py

    if not isinstance(node, h5py.Dataset):
        return False
    return bool(node.id.get_type().get_class() == h5py.h5t.COMPOUND)


@frozen(eq=False)
class _FieldArray:
    """A field of a compound dataset as an array."""

    dataset: Any
    field: str

    @property
    def dtype(self) -> Any:
        return self.dataset.dtype[self.field].base

    @property
    def shape(self) -> tuple[int, ...]:
        return (*self.dataset.shape, *self.dataset.dtype[self.field].shape)

    @property
    def size(self) -> int:
        return int(np.prod(self.shape))

    def __getitem__(self, index: Any) -> Any:
        first, *remaining = index if isinstance(index, tuple) else (index,)
        values = self.dataset.fields(self.field)[first]
        return values[(slice(None), *remaining)] if remaining else values


@frozen(eq=False)
class _ScaledArray:
    """A dataset of integers with the scale of the netCDF conventions."""

    dataset: Any
    factor: float
    offset: float
    missing_value: float | None  #: Value of missing samples.
    dtype: Any = np.dtype(float)

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.dataset.shape)

    def __getitem__(self, index: Any) -> np.ndarray:
        values = np.asarray(self.dataset[index], dtype=float)
        scaled_values = values * self.factor + self.offset
        return np.where(values == self.missing_value, np.nan, scaled_values)


def _scale_dataset(dataset: Any) -> Any:
    """Return a dataset, scaled if its attributes state a scale or a value of missing samples."""
    factor, offset, missing_value = (
        float(value) if isinstance(value, (np.integer, np.floating)) else None
        for name in ("scale_factor", "add_offset", "_FillValue")
        for value in [_find_attribute(dataset, name)]
    )
    if dataset.dtype.kind not in "fiu" or (factor, offset, missing_value) == (None, None, None):
        return dataset
    return _ScaledArray(dataset, 1.0 if factor is None else factor, offset or 0.0, missing_value)


def _find_attribute(dataset: Any, *names: str) -> Any:
    """Return the number or text of the first attribute with one of these names; or None."""
    for name in names:
        values = np.ravel(dataset.attrs.get(name, ()))
        if values.size == 1:
            value = values[0]
            return value.decode(errors="replace") if isinstance(value, bytes) else value
    return None


class MatlabFile(ArrayFile):
    """Variables of a MATLAB file up to version 7."""

    def __init__(self, path: Path, stream: BinaryIO, dialect: Dialect) -> None:
        from scipy.io import whosmat

        super().__init__(path, stream)
        self._check_size(_read_inflated_size(stream))
        try:
            variables = whosmat(stream)
        except (ValueError, TypeError, NotImplementedError) as error:
            raise RecordError(
                f"{path}: this is not a MATLAB file of version 4 to 7, or it is damaged. Save it "
                "again.",
                code="file-damaged",
            ) from error
        self._variables = {
            name: (tuple(shape), matlab_class) for name, shape, matlab_class in variables
        }
        self._loaded: dict[str, np.ndarray] = {}
        for name, (_, matlab_class) in list(self._variables.items()):
            if matlab_class == "struct":
                self._expand_structure(name)
        shapes = {name: shape for name, (shape, _) in self._variables.items()}
        self._name_columns(shapes, dialect.group, separator=".", path_separator=".")

    def _expand_structure(self, name: str) -> None:
        """Replace a structure by its fields, named by their paths."""
        from scipy.io import loadmat

        self._stream.seek(0)
        pending_items = [(name, loadmat(self._stream, variable_names=[name])[name])]
        del self._variables[name]
        while pending_items:
            path, value = pending_items.pop()
            if value.dtype.names is not None and value.size <= _MAX_COLUMNS:
                fields = [
                    (f"{path}{f'({index})' if value.size > 1 else ''}.{key}", element[key])
                    for index, element in enumerate(value.ravel(), 1)
                    for key in value.dtype.names
                ]
                pending_items += reversed(fields)
            elif value.dtype.kind in "fiub":
                self._variables[path] = (value.shape, "double")
                self._loaded[path] = value

    def _missing_columns_message(self, missing_names: Sequence[str]) -> str:
        opaque_names = [
            name for name, (_, matlab_class) in self._variables.items() if matlab_class == "opaque"
        ]
        if opaque_names or any(name == "None" for name in self._variables):
            return (
                f"the file has no column '{missing_names[0]}'. Only MATLAB can read an object "
                "such as a table. In MATLAB, save s = table2struct(T, 'ToScalar', true) instead."
            )
        return super()._missing_columns_message(missing_names)

    def _shape(self, name: str) -> tuple[int, ...]:
        shape, matlab_class = self._variables[self._paths[name]]
        if matlab_class not in _MATLAB_NUMBER_CLASSES:
            raise RecordError(
                f"{self.path}: '{name}' does not contain numbers.", code="not-numeric"
            )
        return shape

    @contextmanager
    def _open_arrays(self, names: Sequence[str]) -> Iterator[Mapping[str, Any]]:
        from scipy.io import loadmat

        # The format does not allow partial reading of a variable.
        paths = [self._paths[name] for name in names]
        unloaded_paths = [path for path in paths if path not in self._loaded]
        if unloaded_paths:
            self._stream.seek(0)
            self._loaded |= loadmat(self._stream, variable_names=unloaded_paths)
        yield {name: self._loaded[self._paths[name]] for name in names}


def _find_run_groups(paths: Sequence[str], separator: str) -> list[str]:
    """Return groups with the same columns whose names differ only in a number; or an empty list.

    Groups named after sensors are not runs, because each contains a different sensor.
    """
    groups: dict[str, set[str]] = {}
    for path in paths:
        group, _, name = path.rpartition(separator)
        groups.setdefault(group, set()).add(name)
    groups_by_columns: dict[tuple[str, frozenset[str]], list[str]] = {}
    for group, names in groups.items():
        if len(names) > 1 and re.search(r"\d", group) and not _SENSOR_NAME.search(group):
            groups_by_columns.setdefault((re.sub(r"\d+", "#", group), frozenset(names)), []).append(
                group
            )
    return next((runs for runs in groups_by_columns.values() if len(runs) > 1), [])


def open_matlab(path: Path, stream: BinaryIO, dialect: Dialect) -> ColumnFile:
    """Open a .mat file: HDF5 from version 7.3 on, MATLAB's own format before, or ``-ascii``."""
    import h5py

    if h5py.is_hdf5(path):
        return Hdf5File(path, stream, dialect)
    first_bytes = stream.read(_PREVIEW_BYTES)
    stream.seek(0)
    # MATLAB's format also starts with text, but contains bytes that text does not.
    is_text = not first_bytes.startswith(b"MATLAB") and b"\0" not in first_bytes
    return (CsvFile if is_text else MatlabFile)(path, stream, dialect)


def _read_inflated_size(stream: BinaryIO) -> int:
    """Return the stated size of all compressed variables of a .mat file of version 5 to 7, bytes.

    SciPy inflates a variable even to skip it. A file has a header of 128 bytes and elements with a
    type and a size of 4 bytes each, and content, which for type 15 inflates to an element.
    """
    stream.seek(0)
    byte_order = _BYTE_ORDERS.get(stream.read(_MATLAB_HEADER_BYTES)[-2:])
    total_size = 0
    while byte_order is not None and len(element_header := stream.read(8)) == 8:
        data_type, element_size = struct.unpack(f"{byte_order}II", element_header)
        if data_type == 0:
            break  # no element
        start = stream.tell()
        if data_type == _MATLAB_COMPRESSED_TYPE:
            try:
                inner_header = zlib.decompressobj().decompress(
                    stream.read(min(element_size, 256)), 8
                )
            except zlib.error:
                break  # SciPy reports the error
            if len(inner_header) == 8:
                total_size += struct.unpack(f"{byte_order}II", inner_header)[1]
        stream.seek(start + element_size)
    stream.seek(0)
    return total_size


def _column_count(shape: tuple[int, ...] | None) -> int:
    """Return the number of columns of an array: several for a matrix, 0 for a single number."""
    long_dimensions = [dimension for dimension in shape or () if dimension > 1]
    if shape is not None and not long_dimensions and 0 not in shape:
        return 0
    return (
        min(long_dimensions)
        if len(long_dimensions) == 2 and min(long_dimensions) <= _MAX_COLUMNS
        else 1
    )


def _slice(array: Any, start: int, stop: int, column: int) -> np.ndarray:
    """Return a range of an array along its longest axis; `column` is the index along another."""
    longest_axis = int(np.argmax(array.shape)) if array.shape else 0
    index = tuple(
        slice(start, stop) if axis == longest_axis else (column if length > 1 else 0)
        for axis, length in enumerate(array.shape)
    )
    return np.atleast_1d(np.asarray(array[index], dtype=float))
