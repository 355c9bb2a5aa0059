"""Records in memory: columns and data frames that are read like those of a file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.records.column_file import ColumnFile, Columns

if TYPE_CHECKING:
    import polars as pl

#: Kinds of NumPy's numbers: truth values, integers, floating point.
_NUMERIC_KINDS: Final = "biuf"


@frozen(eq=False)
class MemoryTable:
    """Columns of one record."""

    name: str  #: Name in messages.
    #: Name -> values, float64, shape (n,), read-only; NaN for missing values.
    columns: Mapping[str, np.ndarray]
    non_numeric_names: tuple[str, ...] = ()  #: Names of columns without numbers.

    def __str__(self) -> str:
        """Return the name of the table in messages."""
        return self.name

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of the columns, such as ``sha256:9f86...``.

        For each column: name in UTF-8, a zero byte, and the values as little-endian float64.
        """
        digest = hashlib.sha256()
        for name, values in self.columns.items():
            digest.update(name.encode("utf-8", "surrogatepass") + b"\0")
            digest.update(np.ascontiguousarray(values, dtype="<f8").data)
        return f"sha256:{digest.hexdigest()}"

    def frame(self) -> pl.DataFrame:
        """Return the columns as a polars frame."""
        import polars as pl

        return pl.DataFrame(dict(self.columns))


class MemoryFile(ColumnFile):
    """A table in memory that is read like a file."""

    def __init__(self, table: MemoryTable) -> None:
        self.path = Path(table.name)
        self.names = [*table.columns, *table.non_numeric_names]
        self.identity = None
        self.units, self.units_row = {}, False
        self.timestamp_columns, self.format_description = frozenset(), ""
        self.first_timestamp, self.interval = None, None
        self._memory_table = table

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Do nothing: there is no file."""

    def _require(self, names: Sequence[str]) -> None:
        for name in names:
            if name in self._memory_table.non_numeric_names:
                raise RecordError(
                    f"{self.path}: column '{name}' contains no numbers.", code="not-numeric"
                )

    def _batches(self, names: Sequence[str]) -> Iterator[Columns]:
        yield {name: self._memory_table.columns[name] for name in names}

    def _table(self) -> pl.DataFrame:
        return self._memory_table.frame()


# Columns of frames and arrays, copied to a table in memory


def make_memory_table(name: str, frame: Any) -> MemoryTable:
    """Copy the columns of a data frame to a table."""
    columns: dict[str, np.ndarray] = {}
    non_numeric_names = []
    for key, values in iter_columns(name, frame):
        numbers = _copy_numbers(values)
        if numbers is None:
            non_numeric_names.append(key)
            continue
        if numbers.ndim != 1:
            raise RecordError(
                f"{name}: column '{key}' has the shape {numbers.shape}; a column needs one value "
                "per row.",
                code="wrong-shape",
            )
        columns[key] = numbers
    lengths = {key: len(values) for key, values in columns.items()}
    if len(set(lengths.values())) > 1:
        length_text = ", ".join(f"'{key}' {length}" for key, length in lengths.items())
        raise RecordError(
            f"{name}: the columns have different lengths: {length_text}.", code="wrong-shape"
        )
    if not any(lengths.values()):
        raise RecordError(f"{name}: the file has no rows of numbers.", code="no-rows")
    return MemoryTable(name, columns, tuple(non_numeric_names))


def iter_columns(name: str, frame: Any) -> Iterator[tuple[str, Any]]:
    """Yield name and values of each column of a data frame, mapping or structured array."""
    if isinstance(frame, Mapping):
        yield from ((str(key), values) for key, values in frame.items())
    elif isinstance(frame, np.ndarray) and frame.dtype.names:
        yield from ((key, frame[key]) for key in frame.dtype.names)
    elif hasattr(frame, "columns") and hasattr(frame, "__getitem__"):
        # pandas, polars and similar libraries
        yield from ((str(key), frame[key]) for key in frame.columns)
    elif hasattr(frame, "__arrow_c_stream__") or hasattr(frame, "__dataframe__"):
        import polars as pl

        has_arrow_stream = hasattr(frame, "__arrow_c_stream__")
        polars_frame = pl.DataFrame(frame) if has_arrow_stream else pl.from_dataframe(frame)
        yield from ((column.name, column) for column in polars_frame.get_columns())
    else:
        raise RecordError(
            f"{name}: a {type(frame).__name__} has no named columns. Pass a mapping of arrays, "
            "a polars or pandas data frame, or a file.",
            code="wrong-type",
        )


def _copy_numbers(values: Any) -> np.ndarray | None:
    """Return a read-only copy of a column as float64; None if it does not contain numbers."""
    array = values.to_numpy() if hasattr(values, "to_numpy") else values
    if isinstance(array, np.ma.MaskedArray) and array.dtype.kind in _NUMERIC_KINDS:
        array = np.ma.filled(array.astype(float), np.nan)
    array = np.asarray(array)
    if array.dtype == object:
        # Numbers with missing values, which are not equal to themselves in pandas.
        cells = array.ravel()
        if any(isinstance(cell, str | bytes) for cell in cells):
            return None
        try:
            numbers = [
                np.nan if cell is None or _is_missing(cell) else float(cell) for cell in cells
            ]
        except (TypeError, ValueError):
            return None
        array = np.array(numbers).reshape(array.shape)
    if array.dtype.kind not in _NUMERIC_KINDS:
        return None
    copy = np.array(array, dtype=np.float64)
    if copy.ndim == 2 and 1 in copy.shape:
        copy = copy.ravel()
    copy.flags.writeable = False
    return copy


def _is_missing(cell: Any) -> bool:
    return type(cell).__name__ in ("NAType", "NaTType")
