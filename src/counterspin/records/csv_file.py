"""Record files of text: a header line, then lines of numbers.

- `CsvFile`: cells parted by comma, semicolon or tab
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from counterspin.errors import RecordError
from counterspin.records.column_file import ColumnFile, Columns, frame_arrays

if TYPE_CHECKING:
    import polars as pl

#: No line of column names is longer, in bytes.
_LONGEST_HEADER = 100_000
#: What counts as an empty cell of a CSV file, in lower case and without surrounding blanks.
_EMPTY_WORDS = ("", "nan")


class CsvFile(ColumnFile):
    """A text table with a header line; cells parted by comma, semicolon or tab; '#' comments."""

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        super().__init__(path, names)
        self._find_header()
        self._require(self._header)
        # Looking out for comments takes the parser half as long again. A comment cannot pass for
        # a number, so where the first column is read the strict parser stops at it by itself.
        self._comments = self._header[0] not in names
        for name in self.names:
            if self._header.count(name) > 1:
                raise RecordError(f"{path}: two columns of the header are named '{name}'.")

    def _find_header(self) -> None:
        number = blank = 0
        with self.path.open("rb") as file:
            for raw in file:
                number += 1
                line = raw.decode("utf-8-sig", errors="replace").strip("\r\n")
                odd = "\ufffd" in line or any(c < " " and c != "\t" for c in line)
                if odd or len(raw) > _LONGEST_HEADER:
                    raise RecordError(
                        f"{self.path}, line {number}: this is not text in UTF-8; a .csv file holds "
                        "a line of column names and lines of numbers."
                    )
                if line.strip() and not line.startswith("#"):
                    break
            else:
                raise RecordError(f"{self.path}: the file has no header line and no rows.")
            for raw in file:
                # Among the rows a blank line is a row of empty cells; here it stops the parser.
                if raw.strip():
                    break
                blank += 1
        self._before_rows = number + blank
        # The delimiter is the one that the header uses most; a lone column has none.
        self._separator = max(",;\t", key=line.count)
        cells = next(csv.reader([line], delimiter=self._separator))
        self._header = [cell.strip() for cell in cells]
        if all(_is_number(cell) for cell in self._header):
            raise RecordError(
                f"{self.path}, line {number}: the first line must name the columns, "
                f"but it holds numbers: {line[:60]}"
            )

    def _scan(self, wanted: Any) -> pl.LazyFrame:
        import polars as pl

        # An explicit type for every column: a type guessed from the first lines breaks on a
        # column that looks whole at the start. Unwanted columns are never parsed.
        schema = {
            name if name not in self._header[:place] else f"{name} ({place})": (
                wanted if name in self.names else pl.String()
            )
            for place, name in enumerate(self._header)
        }
        return pl.scan_csv(
            self.path,
            separator=self._separator,
            has_header=False,  # read above: blanks around the names are no part of them
            skip_lines=self._before_rows,
            comment_prefix="#" if self._comments else None,
            schema=schema,
            encoding="utf8-lossy",
        ).select(self.names)

    def table(self) -> pl.DataFrame:
        """Return every column of the file as text; comments are left out."""
        import polars as pl

        whole = CsvFile(self.path, self._header)
        whole._comments = True
        return whole._scan(pl.String()).collect()

    def batches(self) -> Iterator[Columns]:
        """Yield batches of the columns; text in a cell raises `RecordError` with its line."""
        import polars as pl

        done = 0
        try:
            for frame in self._scan(pl.Float64()).collect_batches(maintain_order=True):
                yield frame_arrays(frame)
                done += frame.height
        except pl.exceptions.NoDataError:
            return
        except pl.exceptions.PolarsError:
            # The strict parser says no more than the cell's text. Find out where it stands; if it
            # is a comment, or blanks around the numbers, go on from there with the tolerant one.
            self._comments = True
            self._refuse_bad_cells()
            cells = pl.all().str.strip_chars().cast(pl.Float64(), strict=False)
            frames = self._scan(pl.String()).select(cells).slice(done)
            for frame in frames.collect_batches(maintain_order=True):
                yield frame_arrays(frame)

    def _refuse_bad_cells(self) -> None:
        import polars as pl

        number, width = self._widest_line()
        if width > len(self._header):
            raise RecordError(
                f"{self.path}, line {number}: the line has {width} cells, "
                f"the header names {len(self._header)}."
            )
        text = pl.all().str.strip_chars()
        bad = text.cast(pl.Float64(), strict=False).is_null() & ~text.str.to_lowercase().is_in(
            list(_EMPTY_WORDS)
        )
        marks = self._scan(pl.String()).select(bad.fill_null(False))
        rows = (
            marks.with_row_index("#row")
            .filter(pl.any_horizontal(self.names))
            .head(1)
            .collect(engine="streaming")
        )
        if rows.is_empty():
            return
        row = int(rows["#row"][0])
        column = next(name for name in self.names if rows[name][0])
        cell = str(self._scan(pl.String()).select(column).slice(row, 1).collect().item())
        hint = ""
        if _is_number(cell.replace(",", ".")):
            hint = " Write numbers with a decimal point, not a comma."
        raise RecordError(
            f"{self.path}, {self.locate(row)}: column '{column}' holds the text '{cell[:40]}' "
            f"where a number belongs.{hint}"
        )

    def _widest_line(self) -> tuple[int, int]:
        """Return the first line with more cells than the header, or the last line."""
        number, width = 0, 0
        with self.path.open(encoding="utf-8", errors="replace", newline="") as file:
            for number, line in enumerate(file, start=1):
                if line.count(self._separator) < len(self._header) or line.startswith("#"):
                    continue
                width = len(next(csv.reader([line.rstrip("\r\n")], delimiter=self._separator)))
                if width > len(self._header):
                    return number, width
        return number, 0

    def locate(self, row: int) -> str:
        """Say on which line, as a text editor counts them, data row `row` stands."""
        # A comment takes a line and is no row; only a pass over the file tells where they are.
        with self.path.open("rb") as file:
            body = islice(enumerate(file, start=1), self._before_rows, None)
            data = (number for number, line in body if not line.startswith(b"#"))
            number = next(islice(data, row, None), row + self._before_rows + 1)
        return f"line {number}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
