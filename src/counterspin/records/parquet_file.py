"""Record files of Apache Parquet.

- `ParquetFile`: columns of numbers
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from counterspin.errors import RecordError
from counterspin.records.column_file import ColumnFile, frame_columns
from counterspin.records.pieces import Columns

if TYPE_CHECKING:
    import polars as pl


class ParquetFile(ColumnFile):
    """A Parquet file with numeric columns."""

    def __init__(self, path: Path) -> None:
        import polars as pl

        self.path = path
        try:
            self._schema = pl.scan_parquet(path).collect_schema()
        except pl.exceptions.PolarsError:
            raise RecordError(f"{path}: this is not a readable Parquet file.") from None
        self.names = self._schema.names()

    def require(self, wanted: Sequence[str]) -> None:
        """Raise `RecordError` unless the file has the wanted columns and they hold numbers."""
        super().require(wanted)
        for name in wanted:
            if not self._schema[name].is_numeric():
                raise RecordError(
                    f"{self.path}: column '{name}' is of type {self._schema[name]}; "
                    "numbers belong there."
                )

    def table(self) -> pl.DataFrame:
        """Return every column of the file with its type."""
        import polars as pl

        return pl.read_parquet(self.path)

    def batches(self, wanted: Sequence[str]) -> Iterator[Columns]:
        """Yield batches of the columns as the streaming engine decodes them."""
        import polars as pl

        frames = pl.scan_parquet(self.path).select(pl.col(wanted).cast(pl.Float64()))
        try:
            for frame in frames.collect_batches(maintain_order=True):
                yield frame_columns(frame)
        except pl.exceptions.PolarsError as error:
            reason = str(error).splitlines()[0]
            raise RecordError(f"{self.path}: the Parquet file is damaged: {reason}") from None
