"""Record files of text: a header line, then lines of numbers."""

from __future__ import annotations

import io
import re
from codecs import BOM_UTF8
from collections.abc import Iterator, Sequence
from itertools import count, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from counterspin.errors import RecordError
from counterspin.records.column_file import (
    ColumnFile,
    Columns,
    frame_columns,
    nanoseconds,
    plain_path,
    record_errors,
)
from counterspin.records.dialect import AUTODETECT, Dialect
from counterspin.records.header_metadata import parse_header
from counterspin.records.layout import (
    BLANKS,
    EMPTY_CELL_TEXTS,
    HEAD_LINES,
    MAX_FOOTER_LINES,
    Line,
    describe_lines,
    detect_format,
    footer_lines,
    is_plain_format,
    join_quoted_lines,
    plain_format,
    split_cells,
)
from counterspin.records.unit_notation import number_rewriters

if TYPE_CHECKING:
    import polars as pl

#: No line is longer.
_LINE_BYTES = 100_000
#: No quoted cell has more line ends.
_CELL_LINE_ENDS = 100
#: Bytes that are searched for quotation marks at once.
_CHUNK_BYTES = 1 << 20
#: Bytes that show whether characters are wide.
_PREVIEW_BYTES = 400
#: Digits beside other signs, as in `10:00 -> 1.5` and `(0.5`.
_MIXED_CELL = re.compile(r"[([{>=:].*\d|\d.*[)\]}<]")
#: Lines of a table's body, and bytes of its end, that show what stands below the rows.
_BODY_LINES = 20
_TAIL_BYTES = 16_384
#: A number with its unit, `1.25 mA`.
_UNIT_CELL = re.compile(r"[-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)? ?[^\s\d,;.:+-]\S{0,9}")
_FORM = (
    "A .csv file must contain a header line with the column names, followed by lines of numbers."
)


class CsvFile(ColumnFile):
    """A text table: perhaps names and units, then rows; '#' comments."""

    def __init__(self, path: Path, stream: BinaryIO, dialect: Dialect = AUTODETECT) -> None:
        super().__init__(path, stream)
        self._closely = False
        self._are_quotes_checked = False
        #: As UTF-8 and with tabs, where it is no superset of ASCII, or blanks part the cells.
        self._content: bytes | None = None
        self._is_utf8 = False  # of the content in memory
        self._head: list[Line] = []
        self._encoding = dialect.encoding or "utf-8"
        self._detect_format(dialect)

    def _lines(self) -> Iterator[tuple[int, bytes]]:
        """Yield the numbers and bytes of the lines."""
        self._stream.seek(0)
        with (
            open(self._stream.fileno(), "rb", closefd=False)
            if self._content is None
            else io.BytesIO(self._content)
        ) as file:
            for line_number in count(1):
                line = file.readline(_LINE_BYTES + 1)
                if len(line) > _LINE_BYTES:
                    raise RecordError(
                        f"{self.path}, line {line_number}: the line has more than {_LINE_BYTES} "
                        f"bytes. {_FORM}",
                        code="malformed-table",
                    )
                if not line:
                    return
                yield line_number, line

    def _detect_format(self, dialect: Dialect) -> None:
        self._transcode(dialect)
        head = list(islice(self._lines(), HEAD_LINES + (dialect.skip_lines or 0)))
        lines = [(number, self._decode(raw_line)) for number, raw_line in head]
        for rewrite in number_rewriters("\n".join(text for _, text in lines)):
            encoding = "utf-8" if self._is_utf8 else self._encoding
            text = self._rows_content().decode(encoding, errors="replace")
            self._content = rewrite(text).encode()
            self._is_utf8 = True
            head = list(islice(self._lines(), len(head)))
            lines = [(number, self._decode(raw_line)) for number, raw_line in head]
        lines = self._head = join_quoted_lines(lines)
        layout, is_plain = None, is_plain_format(lines)
        if dialect.delimiter is None and dialect.decimal is None:
            is_undescribed = dialect.skip_lines is None and not dialect.units_row
            layout = plain_format(lines, dialect) if is_undescribed and is_plain else None
        detected_format = layout or detect_format(lines, dialect)
        layout = detected_format or plain_format(lines, dialect)
        if detected_format is None and dialect.encoding is None:
            # What is in no known form may be no text at all.
            self._check_is_text(head)
        if layout is None:
            raise RecordError(
                f"{self.path}: the file has no header row and no rows of numbers.", code="no-rows"
            )
        numeric_names = [cell for cell in layout.names if _is_number(cell)]
        mixed_cell = next((cell for cell in layout.names if _MIXED_CELL.search(cell)), None)
        if len(numeric_names) == len(layout.names) or (
            mixed_cell and 2 * len(numeric_names) >= len(layout.names)
        ):
            line = next(line for number, line in lines if number == layout.header)
            mixed_text = f" and the text '{mixed_cell[:40]}'" if mixed_cell else ""
            raise RecordError(
                f"{self.path}, line {layout.header}: the first line must contain the column "
                f"names, but it contains numbers{mixed_text}: {line[:60]}",
                code="malformed-table",
            )
        self.delimiter, self.decimal = layout.delimiter, layout.decimal
        self._named = layout.header > 0
        self._before_rows, self.names = layout.before_rows, list(layout.names)
        self.units = dict(zip(layout.names, layout.units, strict=True))
        self.units_row = layout.units_row
        lines_above = [
            split_cells(line, self.delimiter)
            for number, line in lines
            if number <= layout.before_rows
        ]
        units, self.interval = parse_header(lines_above, self.names, self.decimal)
        self.units |= units
        if not is_plain:
            self.format_description = layout.describe(self._encoding)
        self._mismatch = layout.mismatch
        if dialect.skip_footer is None:
            self.footer = self._read_footer()
        else:
            self._drop_footer(dialect.skip_footer)
        if self.delimiter == BLANKS:
            self._separate_by_tabs()

    def _rows_content(self) -> bytes:
        """Return the content that is parsed."""
        return self.content() if self._content is None else self._content

    def _separate_by_tabs(self) -> None:
        """Take the content with one tab for the blanks between two cells; lines stay lines."""
        self.delimiter = "\t"
        self._content = b"".join(map(_split_by_tabs, (line for _, line in self._lines())))

    def _read_footer(self) -> tuple[str, ...]:
        """Return the lines at the end that are not rows, without those that are blank."""
        self._stream.seek(0, io.SEEK_END)
        start = max(0, self._stream.tell() - _TAIL_BYTES)
        self._stream.seek(start)
        tail = self._stream.read() if self._content is None else self._content[-_TAIL_BYTES:]
        self._decode(tail)  # finds the encoding
        tail_lines = tail.splitlines()
        body = [line for number, line in self._head if number > self._before_rows]
        is_complete = start == 0 and self._content is None
        remaining = tail_lines[self._before_rows + _BODY_LINES :] if is_complete else tail_lines[1:]
        last_lines = [self._decode(line) for line in remaining[-MAX_FOOTER_LINES:]]
        lines = [*body[:_BODY_LINES], *last_lines]
        count = footer_lines([split_cells(line, self.delimiter) for line in lines], self.decimal)
        return tuple(lines[len(lines) - count :])

    def _drop_footer(self, count: int) -> None:
        """Take the content without lines at its end."""
        lines = self._rows_content().splitlines(True)
        self._content = b"".join(lines[: len(lines) - count])

    def _missing_columns_message(self, missing: Sequence[str]) -> str:
        message = super()._missing_columns_message(missing)
        if self._named:
            return message
        location = f"above the first numbers, line {self._before_rows + 1}"
        reason = (
            self._mismatch
            or f"no line {location}, contains column names, so the columns are numbered"
        )
        return f"{message} {reason[0].upper()}{reason[1:]}."

    def first_cells(self, names: Sequence[str], count: int) -> dict[str, list[str]]:
        """Return the first cells of columns, as they are written."""
        if not names:
            return {}
        with record_errors(self.path):
            frame = self._collect(self._as_strings(names).head(count))
            cells = {name: [str(cell or "") for cell in frame[name]] for name in names}
        has_invalid_bytes = any("\ufffd" in cell for column in cells.values() for cell in column)
        if has_invalid_bytes and self._use_utf8():
            return self.first_cells(names, count)
        return cells

    def _cells(self, column: str) -> list[str]:
        self._use_utf8()
        frame = self._collect(self._as_strings([column]))
        return [str(cell or "") for cell in frame[column]]

    def preview(self) -> str:
        """Say what the first lines look like, a line each."""
        return describe_lines(self._head)

    def _transcode(self, dialect: Dialect) -> None:
        """Take the content as UTF-8 in an encoding of wide characters, with CR as ends of lines."""
        self._stream.seek(0)
        first_bytes = self._stream.read(_LINE_BYTES)
        if dialect.encoding is None:
            self._encoding = wide_encoding(first_bytes[:_PREVIEW_BYTES]) or self._encoding
        try:
            wide_codec = "a,;\t1\n".encode(self._encoding) != b"a,;\t1\n"
        except LookupError:
            raise RecordError(
                f"{self.path}: unknown encoding '{self._encoding}'.", code="unknown-choice"
            ) from None
        if wide_codec and self._encoding != "utf-8-sig":
            try:
                self._content = self.content().decode(self._encoding).encode()
                self._is_utf8 = True
            except UnicodeError:
                raise RecordError(
                    f"{self.path}: the file is not {self._encoding} text.", code="wrong-encoding"
                ) from None
        if self._content is not None:
            first_bytes = self._content[:_LINE_BYTES]
        if b"\r" in first_bytes and b"\n" not in first_bytes:
            self._content = self._rows_content().replace(b"\r", b"\n")

    def _decode(self, raw: bytes) -> str:
        """Return a line of the head as text."""
        encoding = "utf-8" if self._is_utf8 else self._encoding
        try:
            text = raw.removeprefix(BOM_UTF8) if encoding == "utf-8" else raw
            return text.decode(encoding).rstrip("\r\n")
        except UnicodeError:
            if self._encoding == "utf-8":
                self._encoding = "latin-1"
            return raw.decode("latin-1").rstrip("\r\n")

    def _check_is_text(self, head: Sequence[tuple[int, bytes]]) -> None:
        for number, raw in head:
            line = raw.decode("utf-8-sig", errors="replace").strip("\r\n")
            if "\ufffd" in line or any(c < " " and c != "\t" for c in line):
                raise RecordError(
                    f"{self.path}, line {number}: the file is not UTF-8 text. {_FORM}",
                    code="wrong-encoding",
                )
            if line.strip() and not line.startswith("#"):
                return

    def _scan(
        self, wanted: Sequence[str], data_type: Any, *, comments: bool = True, quoted: bool = True
    ) -> pl.LazyFrame:
        import polars as pl

        if quoted and not self._are_quotes_checked:
            self._check_quotation_marks()
            self._are_quotes_checked = True

        def data_type_of(name: str) -> Any:
            return (
                data_type if name in wanted and name not in self.timestamp_columns else pl.String()
            )

        # An explicit type for every column: a type guessed from the first lines breaks on a
        # column that looks whole at the start. Unwanted columns are never parsed.
        schema = {
            name if name not in self.names[:index] else f"{name} ({index})": (data_type_of(name))
            for index, name in enumerate(self.names)
        }
        return pl.scan_csv(
            plain_path(self.path) if self._content is None else self._content,
            separator=self.delimiter,
            quote_char='"' if quoted else None,
            decimal_comma=self.decimal == ",",
            has_header=False,  # read above: blanks around the names are no part of them
            skip_lines=self._before_rows,
            comment_prefix="#" if comments else None,
            schema=schema,
            encoding="utf8-lossy",
            glob=False,
            missing_columns="insert",  # where the first row is short, as in any other
        ).select(wanted)

    def _as_strings(self, wanted: Sequence[str]) -> pl.LazyFrame:
        import polars as pl

        return self._scan(wanted, pl.String())

    def _use_utf8(self) -> bool:
        """Encode the content as UTF-8 and return True; return False if it is UTF-8 already.

        Numbers are the same in all encodings, but words are not.
        """
        if self._is_utf8 or self._encoding == "utf-8":
            return False
        content = self._rows_content().decode(self._encoding, errors="replace")
        self._content = content.encode()
        self._is_utf8 = True
        return True

    def _table(self) -> pl.DataFrame:
        """Return every column of the file as text; comments are left out."""
        names = [name for name in self.names if name]
        self._require(names)
        self._use_utf8()
        return self._collect(self._as_strings(names))

    def _collect(self, cells: pl.LazyFrame) -> pl.DataFrame:
        """Return cells as text; RecordError with the line where it has too many."""
        import polars as pl

        try:
            return cells.collect()
        except pl.exceptions.PolarsError:
            self._check_lines()
            raise

    def use_strict_parser(self) -> bool:
        """Look out for comments, blanks around numbers and text from now on, at twice the time."""
        before, self._closely = self._closely, True
        return not before

    def _batches(self, wanted: Sequence[str]) -> Iterator[Columns]:
        """Yield batches of the columns."""
        import polars as pl

        stamps = [name for name in wanted if name in self.timestamp_columns]
        if self._closely:
            self._check_cells(wanted)
            frames = self._as_strings(wanted).select(
                pl.col(name) if name in stamps else self._number_text(name) for name in wanted
            )
        else:
            # Looking out for comments takes the parser half as long again. They cannot pass for
            # numbers, so where the first column is read the strict parser stops at them by itself.
            comments = self.names[0] not in wanted or self.names[0] in stamps
            # Where every column is read as numbers, the parser stops at a quotation mark by itself
            # too, and needs no pass over the file for marks that are not closed.
            quoted = (
                len(wanted) < len(self.names)
                or bool(stamps)
                or any('"' in line for number, line in self._head if number > self._before_rows)
            )
            frames = self._scan(wanted, pl.Float64(), comments=comments, quoted=quoted)
        try:
            for frame in frames.collect_batches(maintain_order=True):
                yield frame_columns(self._convert_timestamps(frame, stamps) if stamps else frame)
        except pl.exceptions.NoDataError:
            return
        except pl.exceptions.PolarsError as error:
            raise RecordError(
                f"{self.path}: a cell is not a number.", code="not-numeric"
            ) from error

    def _check_cells(self, wanted: Sequence[str]) -> None:
        import polars as pl

        self._check_lines()
        invalid = [self._is_invalid(name) for name in wanted]
        is_invalid = self._as_strings(wanted).select(invalid)
        index = _unused_name(wanted)
        rows = (
            is_invalid.with_row_index(index)
            .filter(pl.any_horizontal(wanted))
            .head(1)
            .collect(engine="streaming")
        )
        if rows.is_empty():
            return
        row = int(rows[index][0])
        column = next(name for name in wanted if rows[name][0])
        cell = str(self._as_strings([column]).slice(row, 1).collect().item())
        if column in self.timestamp_columns:
            raise RecordError(
                f"{self.path}, {self.locate(row)}: column '{column}' contains the text "
                f"'{cell[:40]}' instead of a time, such as 2026-03-01T12:00:00.020.",
                code="not-numeric",
            )
        hint = ""
        if cell.strip() == column:
            hint = " The column names occur more than once: put each run into a separate file."
        if _UNIT_CELL.fullmatch(cell.strip()):
            hint = " Move the unit from the cells to the header row, such as 'Time [s]'."
        if _is_number(cell.replace(",", ".")):
            hint = ' Write numbers with a decimal point, or give `decimal=","`.'
        raise RecordError(
            f"{self.path}, {self.locate(row)}: column '{column}' contains the text '{cell[:40]}' "
            f"instead of a number.{hint}",
            code="not-numeric",
        )

    def _number_text(self, name: str) -> pl.Expr:
        """Return the text of a cell as a number, null where it is none."""
        import polars as pl

        text = pl.col(name).str.strip_chars().str.replace(r"[dD]", "e")
        if self.decimal == ",":
            text = text.str.replace_all(".", "_", literal=True).str.replace(",", ".", literal=True)
        return text.cast(pl.Float64(), strict=False)

    def _is_invalid(self, name: str) -> pl.Expr:
        """Return True for cells that are neither empty nor valid."""
        import polars as pl

        empty = pl.col(name).str.strip_chars().str.to_lowercase().is_in(list(EMPTY_CELL_TEXTS))
        value = nanoseconds(name) if name in self.timestamp_columns else self._number_text(name)
        return (value.is_null() & ~empty).fill_null(False).alias(name)

    def _convert_timestamps(self, frame: pl.DataFrame, stamps: Sequence[str]) -> pl.DataFrame:
        """Return a batch with its stamps as seconds after the first one of the file."""
        import polars as pl

        for name in stamps:
            if frame.select(self._is_invalid(name)).to_series().any():
                raise RecordError(f"{self.path}: a cell is not a time.", code="not-numeric")
            times = frame.select(nanoseconds(name)).to_series()
            frame = frame.with_columns(pl.Series(name, self.seconds(times)))
        return frame

    def _check_quotation_marks(self) -> None:
        """Refuse a quotation mark that is not closed, before Polars reads the rest as one cell.

        Polars needs long for such a cell, and crashes on a last cell of one mark.
        """
        open_ends, last = 0, b""
        for chunk in self._chunks():
            open_ends = _unclosed_line_ends(chunk, open_ends)
            last = (last + chunk)[-2:]
            if open_ends > _CELL_LINE_ENDS:
                break
        # A comment may contain a single mark; only the lines tell.
        if open_ends or last.rstrip(b"\r").endswith(b'"'):
            self._check_lines()

    def _chunks(self) -> Iterator[bytes]:
        """Yield the bytes of the rows in chunks."""
        stream: Any = self._stream if self._content is None else io.BytesIO(self._content)
        stream.seek(sum(len(line) for _, line in islice(self._lines(), self._before_rows)))
        while chunk := stream.read(_CHUNK_BYTES):
            yield chunk

    def _check_lines(self) -> None:
        """Refuse a line with too many cells, or a quotation mark that is not closed."""
        open_line = 0  # the line at which a quoted cell begins that has not ended yet
        delimiter = self.delimiter.encode()
        for line_number, raw_line in self._lines():
            if (
                not open_line
                and b'"' not in raw_line
                and raw_line.count(delimiter) < len(self.names)
            ):
                continue
            line = raw_line.decode("utf-8", errors="replace").rstrip("\r\n")
            if line_number <= self._before_rows or (line.startswith("#") and not open_line):
                continue
            if line.count('"') % 2:
                open_line = 0 if open_line else line_number
            elif open_line and line_number > open_line + _CELL_LINE_ENDS:
                raise RecordError(
                    f"{self.path}, line {open_line}: a quotation mark is not closed within "
                    f"{_CELL_LINE_ENDS} lines.",
                    code="malformed-table",
                )
            elif not open_line and line.count(self.delimiter) >= len(self.names):
                width = len(split_cells(line, self.delimiter))
                if width > len(self.names):
                    hint = ""
                    if self.delimiter == "," and width == 2 * len(self.names):
                        hint = (
                            " Commas serve as both cell and decimal separators; export the file "
                            "with semicolons or tabs."
                        )
                    raise RecordError(
                        f"{self.path}, line {line_number}: the line has {width} cells, but the "
                        f"header row has {len(self.names)} names.{hint}",
                        code="malformed-table",
                    )
        if open_line:
            raise RecordError(
                f"{self.path}, line {open_line}: a quotation mark is not closed.",
                code="malformed-table",
            )

    def locate(self, row: int) -> str:
        """Say on which line, as a text editor counts them, data row `row` stands."""
        line_number = next(islice(self._data_lines(), row, None), row + self._before_rows + 1)
        return f"line {line_number}"

    def row_locations(self, rows: int) -> list[str]:
        """Say on which line each of the data rows stands."""
        if self.selection is not None:
            return super().row_locations(rows)
        return [f"line {line_number}" for line_number in islice(self._data_lines(), rows)]

    def _data_lines(self) -> Iterator[int]:
        # A comment takes a line and is no row; only a pass over the file tells where they are.
        body = islice(self._lines(), self._before_rows, None)
        return (line_number for line_number, line in body if not line.startswith(b"#"))


def open_text_named_excel(path: Path, stream: BinaryIO, dialect: Dialect) -> ColumnFile:
    """Open text that is named .xls, as LabVIEW and others name what Excel is to open."""
    head = stream.read(_PREVIEW_BYTES)
    stream.seek(0)
    if head.startswith((b"\xd0\xcf\x11\xe0", b"PK")):
        raise RecordError(
            f"{path}: this is a workbook; save it as .xlsx without a password.",
            code="wrong-file-type",
        )
    if head.lstrip().startswith(b"<"):
        raise RecordError(
            f"{path}: this is a web page or XML for Excel; open it in Excel and save it as .xlsx.",
            code="wrong-file-type",
        )
    return CsvFile(path, stream, dialect)


def _unclosed_line_ends(chunk: bytes, before: int) -> int:
    """Return the line ends since a quotation mark that is open at the end of a chunk, plus one.

    The result is 0 if no mark is open. It is larger than `_CELL_LINE_ENDS` if any cell of the
    chunk has so many line ends.

    before: The result for the chunks before.
    """
    if b'"' not in chunk:
        return before + chunk.count(b"\n") if before else 0
    data = np.frombuffer(chunk, np.uint8)
    quotation_marks, line_ends = np.flatnonzero(data == ord('"')), np.flatnonzero(data == ord("\n"))
    # Line ends before each mark and at the end of the chunk.
    line_ends_before = np.append(np.searchsorted(line_ends, quotation_marks), len(line_ends))
    in_cells = np.diff(line_ends_before, prepend=1 - before)[0 if before else 1 :: 2]
    max_count = int(in_cells.max(initial=0))
    is_open = (len(quotation_marks) % 2 == 1) != (before > 0)
    if max_count > _CELL_LINE_ENDS:
        return max_count
    return int(in_cells[-1]) + 1 if is_open else 0


def _split_by_tabs(line: bytes) -> bytes:
    """Return a line with one tab between cells that blanks part."""
    if b'"' not in line:
        return b"\t".join(line.split()) + b"\n"
    cells = split_cells(line.decode("latin-1").strip(), BLANKS)
    return "\t".join(cells).encode("latin-1") + b"\n"


def _unused_name(names: Sequence[str]) -> str:
    return "row" + "_" * max(map(len, names), default=0)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def wide_encoding(first_bytes: bytes) -> str | None:
    """Return the encoding of a text of two bytes a character, marked as such or not; None: none."""
    if first_bytes[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    for encoding, high_bytes in (("utf-16-le", first_bytes[1::2]), ("utf-16-be", first_bytes[::2])):
        # Numbers and Latin letters have a zero in their higher byte.
        if len(high_bytes) > 8 and high_bytes.count(0) > 0.8 * len(high_bytes):
            return encoding
    return None
