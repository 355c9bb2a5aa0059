"""Record files of text: a header line, then lines of numbers.

- `CsvFile`: cells parted by comma, semicolon or tab
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from itertools import count, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from counterspin.errors import RecordError
from counterspin.records.column_file import ColumnFile, frame_columns, plain_path
from counterspin.records.pieces import Columns

if TYPE_CHECKING:
    import polars as pl

#: No line is longer.
_LINE_BYTES = 100_000
_FORM = "A .csv file holds a line of column names and lines of numbers."
#: What counts as an empty cell of a CSV file, in lower case and without surrounding blanks.
_EMPTY_WORDS = ("", "nan")


class CsvFile(ColumnFile):
    """A text table with a header line; cells parted by comma, semicolon or tab; '#' comments."""

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        super().__init__(path, stream)
        self._closely = False
        self._find_header()

    def _lines(self) -> Iterator[tuple[int, bytes]]:
        """Yield the numbers and bytes of the lines."""
        self._stream.seek(0)
        with open(self._stream.fileno(), "rb", closefd=False) as file:
            for number in count(1):
                line = file.readline(_LINE_BYTES + 1)
                if len(line) > _LINE_BYTES:
                    raise RecordError(
                        f"{self.path}, line {number}: the line has more than {_LINE_BYTES} bytes. "
                        f"{_FORM}"
                    )
                if not line:
                    return
                yield number, line

    def _require(self, wanted: Sequence[str]) -> None:
        for name in wanted:
            if self.names.count(name) > 1:
                raise RecordError(f"{self.path}: two columns of the header are named '{name}'.")

    def _find_header(self) -> None:
        blank = 0
        numbered = self._lines()
        for number, raw in numbered:
            line = raw.decode("utf-8-sig", errors="replace").strip("\r\n")
            if "\ufffd" in line or any(c < " " and c != "\t" for c in line):
                raise RecordError(f"{self.path}, line {number}: this is not text in UTF-8. {_FORM}")
            if line.strip() and not line.startswith("#"):
                break
        else:
            raise RecordError(f"{self.path}: the file has no header line and no rows.")
        for _, raw in numbered:
            # Among the rows a blank line is a row of empty cells; here it stops the parser.
            if raw.strip():
                break
            blank += 1
        self._before_rows = number + blank
        # The delimiter is the one that the header uses most; a lone column has none.
        self._separator = max(",;\t", key=line.count)
        cells = next(csv.reader([line], delimiter=self._separator))
        self.names = [cell.strip() for cell in cells]
        if all(_is_number(cell) for cell in self.names):
            raise RecordError(
                f"{self.path}, line {number}: the first line must name the columns, "
                f"but it holds numbers: {line[:60]}"
            )

    def _scan(self, wanted: Sequence[str], kind: Any, *, comments: bool) -> pl.LazyFrame:
        import polars as pl

        # An explicit type for every column: a type guessed from the first lines breaks on a
        # column that looks whole at the start. Unwanted columns are never parsed.
        schema = {
            name if name not in self.names[:place] else f"{name} ({place})": (
                kind if name in wanted else pl.String()
            )
            for place, name in enumerate(self.names)
        }
        return pl.scan_csv(
            plain_path(self.path),
            separator=self._separator,
            has_header=False,  # read above: blanks around the names are no part of them
            skip_lines=self._before_rows,
            comment_prefix="#" if comments else None,
            schema=schema,
            encoding="utf8-lossy",
            glob=False,
            missing_columns="insert",  # where the first row is short, as in any other
        ).select(wanted)

    def _text(self, wanted: Sequence[str]) -> pl.LazyFrame:
        import polars as pl

        return self._scan(wanted, pl.String(), comments=True)

    def _table(self) -> pl.DataFrame:
        """Return every column of the file as text; comments are left out."""
        import polars as pl

        self._require(self.names)
        try:
            return self._text(self.names).collect()
        except pl.exceptions.PolarsError:
            self._refuse_bad_lines()
            raise

    def look_closely(self) -> bool:
        """Look out for comments, blanks around numbers and text from now on, at twice the time."""
        before, self._closely = self._closely, True
        return not before

    def _batches(self, wanted: Sequence[str]) -> Iterator[Columns]:
        """Yield batches of the columns.

        Raises
        ------
        RecordError
            A cell is no number. Only after `look_closely` it is known where; till then rows before
            it may be missing, as the parser goes on for a while, and a comment is no number either.
        """
        import polars as pl

        if self._closely:
            self._refuse_bad_cells(wanted)
            cells = pl.all().str.strip_chars().cast(pl.Float64(), strict=False)
            frames = self._text(wanted).select(cells)
        else:
            # Looking out for comments takes the parser half as long again. They cannot pass for
            # numbers, so where the first column is read the strict parser stops at them by itself.
            frames = self._scan(wanted, pl.Float64(), comments=self.names[0] not in wanted)
        try:
            for frame in frames.collect_batches(maintain_order=True):
                yield frame_columns(frame)
        except pl.exceptions.NoDataError:
            return
        except pl.exceptions.PolarsError as error:
            raise RecordError(f"{self.path}: a cell is no number.") from error

    def _refuse_bad_cells(self, wanted: Sequence[str]) -> None:
        import polars as pl

        self._refuse_bad_lines()
        text = pl.all().str.strip_chars()
        bad = text.cast(pl.Float64(), strict=False).is_null() & ~text.str.to_lowercase().is_in(
            list(_EMPTY_WORDS)
        )
        marks = self._text(wanted).select(bad.fill_null(False))
        index = _unused_name(wanted)
        rows = (
            marks.with_row_index(index)
            .filter(pl.any_horizontal(wanted))
            .head(1)
            .collect(engine="streaming")
        )
        if rows.is_empty():
            return
        row = int(rows[index][0])
        column = next(name for name in wanted if rows[name][0])
        cell = str(self._text([column]).slice(row, 1).collect().item())
        hint = ""
        if _is_number(cell.replace(",", ".")):
            hint = " Write numbers with a decimal point, not a comma."
        raise RecordError(
            f"{self.path}, {self.locate(row)}: column '{column}' holds the text '{cell[:40]}' "
            f"where a number belongs.{hint}"
        )

    def _refuse_bad_lines(self) -> None:
        """Refuse a line with too many cells, or a quotation mark that is never closed."""
        opened = 0  # the line at which a quoted cell begins that has not ended yet
        for number, raw in self._lines():
            line = raw.decode("utf-8", errors="replace").rstrip("\r\n")
            if line.startswith("#") and not opened:
                continue
            if line.count('"') % 2:
                opened = 0 if opened else number
            elif not opened and line.count(self._separator) >= len(self.names):
                width = len(next(csv.reader([line], delimiter=self._separator)))
                if width > len(self.names):
                    raise RecordError(
                        f"{self.path}, line {number}: the line has {width} cells, "
                        f"the header names {len(self.names)}."
                    )
        if opened:
            raise RecordError(
                f"{self.path}, line {opened}: a quotation mark lacks the one that closes it."
            )

    def locate(self, row: int) -> str:
        """Say on which line, as a text editor counts them, data row `row` stands."""
        number = next(islice(self._data_lines(), row, None), row + self._before_rows + 1)
        return f"line {number}"

    def places(self, rows: int) -> list[str]:
        """Say on which line each of the data rows stands."""
        return [f"line {number}" for number in islice(self._data_lines(), rows)]

    def _data_lines(self) -> Iterator[int]:
        # A comment takes a line and is no row; only a pass over the file tells where they are.
        body = islice(self._lines(), self._before_rows, None)
        return (number for number, line in body if not line.startswith(b"#"))


def _unused_name(names: Sequence[str]) -> str:
    return "row" + "_" * max(map(len, names), default=0)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
