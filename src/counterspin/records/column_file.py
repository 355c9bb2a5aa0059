"""What all record files have in common, whatever their format.

- `ColumnFile`: named columns, in batches, with the place of each row in the file
"""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from counterspin.errors import RecordError

if TYPE_CHECKING:
    import polars as pl

Columns = list[np.ndarray]


class ColumnFile(ABC):
    """The named columns of one record file."""

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        self.path = path
        self.names = list(names)

    @abstractmethod
    def batches(self) -> Iterator[Columns]:
        """Yield the columns, in the order asked for, in consecutive batches of equal length."""

    def table(self) -> pl.DataFrame:
        """Return the whole file as it stands, cells of text remaining text.

        Raises
        ------
        RecordError
            The file is not a table.
        """
        raise RecordError(f"{self.path}: a table is needed here: a .csv or .parquet file.")

    def locate(self, row: int) -> str:
        """Say where data row `row` (counted from 0) stands in the file."""
        return f"row {row + 1}"

    def _require(self, present: Sequence[str]) -> None:
        missing = [name for name in self.names if name not in present]
        if not missing:
            return
        close = difflib.get_close_matches(missing[0], present, n=1)
        words = f"there is no column {quoted(missing)}; the file has {quoted(present)}."
        if close:
            words += f" Did you mean '{close[0]}'?"
        raise RecordError(f"{self.path}: {words}")


def quoted(names: Sequence[str], cap: int = 20) -> str:
    """Return column names for a message, in quotation marks, the first ones of many."""
    listed = ", ".join(f"'{name}'" for name in names[:cap])
    return listed + (f" and {len(names) - cap} more" if len(names) > cap else "") or "none"


def frame_arrays(frame: pl.DataFrame) -> Columns:
    """Return the columns of a frame as arrays."""
    return [column.to_numpy() for column in frame.get_columns()]
