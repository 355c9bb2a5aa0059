"""Columns of frames and arrays, copied to a table in memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np

from counterspin.errors import RecordError
from counterspin.records.memory import MemoryTable

#: Kinds of NumPy's numbers: truth values, integers, floating point.
_NUMBERS: Final = "biuf"


def memory_table(name: str, frame: Any) -> MemoryTable:
    """Copy the columns of a frame."""
    columns: dict[str, np.ndarray] = {}
    skipped = []
    for key, values in iter_columns(name, frame):
        numbers = _numbers(values)
        if numbers is None:
            skipped.append(key)
            continue
        if numbers.ndim != 1:
            raise RecordError(
                f"{name}: column '{key}' has the shape {numbers.shape}; a column needs one value "
                "per row."
            )
        columns[key] = numbers
    lengths = {key: len(values) for key, values in columns.items()}
    if len(set(lengths.values())) > 1:
        listing = ", ".join(f"'{key}' {length}" for key, length in lengths.items())
        raise RecordError(f"{name}: the columns differ in length: {listing}.")
    if not any(lengths.values()):
        raise RecordError(f"{name}: the file has no rows of numbers.")
    return MemoryTable(name, columns, tuple(skipped))


def iter_columns(name: str, frame: Any) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of a frame's columns."""
    if isinstance(frame, Mapping):
        yield from ((str(key), values) for key, values in frame.items())
    elif isinstance(frame, np.ndarray) and frame.dtype.names:
        yield from ((key, frame[key]) for key in frame.dtype.names)
    elif hasattr(frame, "columns") and hasattr(frame, "__getitem__"):
        # Of pandas, polars and their like.
        yield from ((str(key), frame[key]) for key in frame.columns)
    elif hasattr(frame, "__arrow_c_stream__") or hasattr(frame, "__dataframe__"):
        import polars as pl

        arrow = hasattr(frame, "__arrow_c_stream__")
        polars_frame = pl.DataFrame(frame) if arrow else pl.from_dataframe(frame)
        yield from ((column.name, column) for column in polars_frame.get_columns())
    else:
        raise RecordError(
            f"{name}: a {type(frame).__name__} has no named columns. Give a mapping of arrays, a "
            "polars or pandas data frame, or a file."
        )


def _numbers(values: Any) -> np.ndarray | None:
    """Return a read-only copy of a column as float64, None if it does not hold numbers."""
    array = values.to_numpy() if hasattr(values, "to_numpy") else values
    if isinstance(array, np.ma.MaskedArray) and array.dtype.kind in _NUMBERS:
        array = np.ma.filled(array.astype(float), np.nan)
    array = np.asarray(array)
    if array.dtype == object:
        # Numbers with gaps; a missing value of pandas is equal to nothing, not even to itself.
        cells = array.ravel()
        if any(isinstance(cell, str | bytes) for cell in cells):
            return None
        try:
            gaps = [np.nan if cell is None or _is_missing(cell) else float(cell) for cell in cells]
        except (TypeError, ValueError):
            return None
        array = np.array(gaps).reshape(array.shape)
    if array.dtype.kind not in _NUMBERS:
        return None
    copied = np.array(array, dtype=np.float64)
    if copied.ndim == 2 and 1 in copied.shape:
        copied = copied.ravel()
    copied.flags.writeable = False
    return copied


def _is_missing(cell: Any) -> bool:
    return type(cell).__name__ in ("NAType", "NaTType")
