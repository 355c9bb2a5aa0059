"""What all record files have in common, whatever their format.

- `ColumnFile`: named columns, in batches, with the place of each row in the file
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from counterspin.errors import RecordError
from counterspin.records.pieces import Columns

if TYPE_CHECKING:
    import polars as pl


class ColumnFile(ABC):
    """The named columns of one record file.

    Attributes
    ----------
    path
        The file.
    names
        All its columns.
    """

    path: Path
    names: list[str]

    def require(self, wanted: Sequence[str]) -> None:
        """Raise `RecordError` unless the file has the wanted columns and they can hold numbers."""
        missing = [name for name in wanted if name not in self.names]
        if not missing:
            return
        from difflib import get_close_matches

        close = get_close_matches(missing[0], self.names, n=1)
        words = f"there is no column {quoted(missing)}; the file has {quoted(self.names)}."
        if close:
            words += f" Did you mean '{close[0]}'?"
        raise RecordError(f"{self.path}: {words}")

    @abstractmethod
    def batches(self, wanted: Sequence[str]) -> Iterator[Columns]:
        """Yield the wanted columns, which `require` has passed, in consecutive batches."""

    @abstractmethod
    def table(self) -> pl.DataFrame:
        """Return the whole file as it stands, cells of text remaining text.

        Raises
        ------
        RecordError
            The file is not a table.
        """

    def look_closely(self) -> bool:
        """Read with more patience from now on, if there is such a way that was not taken yet."""
        return False

    def locate(self, row: int) -> str:
        """Say where data row `row` (counted from 0) stands in the file."""
        return f"row {row + 1}"


def quoted(names: Sequence[str], cap: int = 20) -> str:
    """Return column names for a message, in quotation marks, the first ones of many."""
    listed = ", ".join(f"'{name}'" for name in names[:cap])
    return listed + (f" and {len(names) - cap} more" if len(names) > cap else "") or "none"


def frame_columns(frame: pl.DataFrame) -> Columns:
    """Return the columns of a frame as arrays."""
    return {column.name: column.to_numpy() for column in frame.get_columns()}
