"""Record files of Apache Parquet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from counterspin.errors import RecordError
from counterspin.records.column_file import ColumnFile, frame_columns, nanoseconds, plain_path
from counterspin.records.dialect import Dialect
from counterspin.records.pieces import Columns

if TYPE_CHECKING:
    import polars as pl


class ParquetFile(ColumnFile):
    """A Parquet file with numeric columns."""

    def __init__(self, path: Path, stream: BinaryIO, _dialect: Dialect) -> None:
        import polars as pl

        super().__init__(path, stream)
        try:
            self._schema = self._scan().collect_schema()
        except pl.exceptions.PolarsError:
            raise RecordError(f"{path}: this is not a readable Parquet file.") from None
        self.names = self._schema.names()

    def _scan(self) -> pl.LazyFrame:
        import polars as pl

        return pl.scan_parquet(plain_path(self.path), glob=False, hive_partitioning=False)

    def _require(self, wanted: Sequence[str]) -> None:
        import polars as pl

        for name in wanted:
            if name not in self.stamps and not self._schema[name].is_numeric():
                raise RecordError(
                    f"{self.path}: column '{name}' is of type {self._schema[name]}; "
                    "numbers are needed."
                )
        rows = int(self._scan().select(pl.len()).collect().item())
        self._require_bytes(8 * rows * len(wanted))

    def _table(self) -> pl.DataFrame:
        """Return every column of the file with its type."""
        self._require([name for name, kind in self._schema.items() if kind.is_numeric()])
        return self._scan().collect()

    def _batches(self, wanted: Sequence[str]) -> Iterator[Columns]:
        """Yield batches of the columns as the streaming engine decodes them."""
        numbers = self._scan().select(self._column(name) for name in wanted)
        for frame in numbers.collect_batches(maintain_order=True):
            columns = frame_columns(frame)
            for name in self.stamps:
                columns[name] = self.seconds(frame[name])
            yield columns

    def _column(self, name: str) -> pl.Expr:
        import polars as pl

        kind = self._schema[name]
        if name not in self.stamps:
            return pl.col(name).cast(pl.Float64())
        if kind == pl.String():
            return nanoseconds(name)
        if not isinstance(kind, pl.Datetime):
            raise RecordError(f"{self.path}: column '{name}' holds no time stamps.")
        return pl.col(name).dt.cast_time_unit("ns").to_physical()
