"""Records in memory: columns that a program holds, read like those of a file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.records.column_file import ColumnFile, Columns

if TYPE_CHECKING:
    import polars as pl


@frozen(eq=False)
class MemoryTable:
    """Columns of one record."""

    name: str  #: What messages call it.
    #: Name -> values, float64, shape (n,), read-only; NaN where there is none.
    columns: Mapping[str, np.ndarray]
    others: tuple[str, ...] = ()  #: Names of columns that hold something else than numbers.

    def __str__(self) -> str:
        """Return the name of the table in messages."""
        return self.name

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of the columns, such as ``sha256:9f86...``.

        Of each in turn: its name in UTF-8, a zero byte, and its values as little-endian float64.
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
    """A table in memory in the place of a file."""

    def __init__(self, table: MemoryTable) -> None:
        self.path = Path(table.name)
        self.names = [*table.columns, *table.others]
        self.identity = None
        self.units, self.units_row = {}, False
        self.timestamp_columns, self.format_description = frozenset(), ""
        self.first_timestamp, self.interval = None, None
        self._table_in_memory = table

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Nothing is to be closed, and nobody else can have changed it."""

    def _require(self, wanted: Sequence[str]) -> None:
        for name in wanted:
            if name in self._table_in_memory.others:
                raise RecordError(f"{self.path}: column '{name}' contains no numbers.")

    def _batches(self, wanted: Sequence[str]) -> Iterator[Columns]:
        yield {name: self._table_in_memory.columns[name] for name in wanted}

    def _table(self) -> pl.DataFrame:
        return self._table_in_memory.frame()
