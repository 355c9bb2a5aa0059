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
    parse_nanoseconds,
    polars_path,
    record_errors,
)
from counterspin.records.dialect import AUTODETECT, Dialect
from counterspin.records.header_footer import MAX_FOOTER_LINES, count_footer_lines, parse_header
from counterspin.records.layout import (
    BLANKS,
    EMPTY_CELL_TEXTS,
    HEAD_LINES,
    Line,
    describe_lines,
    detect_format,
    is_plain_format,
    join_quoted_lines,
    plain_format,
    split_cells,
)
from counterspin.records.unit_notation import number_rewriters

if TYPE_CHECKING:
    import polars as pl

#: Largest length of a line.
_MAX_LINE_BYTES = 100_000
#: Largest number of line ends in a quoted cell.
_MAX_CELL_LINE_ENDS = 100
#: Bytes searched for quotation marks at a time.
_CHUNK_BYTES = 1 << 20
#: Bytes that show whether the encoding is wide.
_PREVIEW_BYTES = 400
#: Digits with other characters, as in `10:00 -> 1.5` and `(0.5`.
_MIXED_CELL = re.compile(r"[([{>=:].*\d|\d.*[)\]}<]")
_BLANK_LINE = re.compile(rb"(?m)^[ \t\r]*(?=\n)")
#: Lines of the table body, and bytes at the end of the file, in which a footer is detected.
_BODY_LINES = 20
_TAIL_BYTES = 16_384
#: A number with its unit, `1.25 mA`.
_UNIT_CELL = re.compile(r"[-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)? ?[^\s\d,;.:+-]\S{0,9}")
_FORMAT_ADVICE = (
    "A .csv file must contain a header line with the column names, followed by lines of numbers."
)


class CsvFile(ColumnFile):
    """A text table: optional names and units, then rows; '#' comments."""

    def __init__(self, path: Path, stream: BinaryIO, dialect: Dialect = AUTODETECT) -> None:
        super().__init__(path, stream)
        self._is_strict = False
        self._are_quotes_checked = False
        #: Converted content: UTF-8 for wide encodings, tabs for cells separated by blanks.
        self._content: bytes | None = None
        self._is_utf8 = False  # of the content in memory
        self._first_lines: list[Line] = []
        self._encoding = dialect.encoding or "utf-8"
        self._detect_format(dialect)

    def _lines(self) -> Iterator[tuple[int, bytes]]:
        """Yield number and bytes of each line."""
        self._stream.seek(0)
        with (
            open(self._stream.fileno(), "rb", closefd=False)
            if self._content is None
            else io.BytesIO(self._content)
        ) as file:
            for line_number in count(1):
                line = file.readline(_MAX_LINE_BYTES + 1)
                if len(line) > _MAX_LINE_BYTES:
                    raise RecordError(
                        f"{self.path}, line {line_number}: the line is longer than "
                        f"{_MAX_LINE_BYTES} bytes. {_FORMAT_ADVICE}",
                        code="malformed-table",
                    )
                if not line:
                    return
                yield line_number, line

    def _detect_format(self, dialect: Dialect) -> None:
        self._transcode(dialect)
        raw_lines = list(islice(self._lines(), HEAD_LINES + (dialect.skip_lines or 0)))
        lines = [(number, self._decode(raw_line)) for number, raw_line in raw_lines]
        for rewrite in number_rewriters("\n".join(text for _, text in lines)):
            encoding = "utf-8" if self._is_utf8 else self._encoding
            text = self._rows_content().decode(encoding, errors="replace")
            self._content = rewrite(text).encode()
            self._is_utf8 = True
            raw_lines = list(islice(self._lines(), len(raw_lines)))
            lines = [(number, self._decode(raw_line)) for number, raw_line in raw_lines]
        lines = self._first_lines = join_quoted_lines(lines)
        layout, is_plain = None, is_plain_format(lines)
        if dialect.delimiter is None and dialect.decimal is None:
            is_undescribed = dialect.skip_lines is None and not dialect.units_row
            layout = plain_format(lines, dialect) if is_undescribed and is_plain else None
        detected_format = layout or detect_format(lines, dialect)
        layout = detected_format or plain_format(lines, dialect)
        if detected_format is None and dialect.encoding is None:
            # A file without a known layout may not be text.
            self._check_is_text(raw_lines)
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
            mixed_hint = f" and the text '{mixed_cell[:40]}'" if mixed_cell else ""
            raise RecordError(
                f"{self.path}, line {layout.header}: the first line must contain the column "
                f"names, but it contains numbers{mixed_hint}: {line[:60]}",
                code="malformed-table",
            )
        self.delimiter, self.decimal = layout.delimiter, layout.decimal
        self._has_names = layout.header > 0
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
        """Return the converted content, or else that of the file."""
        return self.content() if self._content is None else self._content

    def _separate_by_tabs(self) -> None:
        """Replace the blanks between cells by tabs."""
        self.delimiter = "\t"
        self._content = b"".join(map(_split_by_tabs, (line for _, line in self._lines())))

    def _read_footer(self) -> tuple[str, ...]:
        """Return the lines at the end that are not rows."""
        self._stream.seek(0, io.SEEK_END)
        start = max(0, self._stream.tell() - _TAIL_BYTES)
        self._stream.seek(start)
        tail_bytes = self._stream.read() if self._content is None else self._content[-_TAIL_BYTES:]
        self._decode(tail_bytes)  # finds the encoding
        tail_lines = tail_bytes.splitlines()
        body_lines = [line for number, line in self._first_lines if number > self._before_rows]
        is_complete = start == 0 and self._content is None
        footer_candidates = (
            tail_lines[self._before_rows + _BODY_LINES :] if is_complete else tail_lines[1:]
        )
        last_lines = [self._decode(line) for line in footer_candidates[-MAX_FOOTER_LINES:]]
        lines = [*body_lines[:_BODY_LINES], *last_lines]
        n_footer_lines = count_footer_lines(
            [split_cells(line, self.delimiter) for line in lines], self.decimal
        )
        return tuple(lines[len(lines) - n_footer_lines :])

    def _drop_footer(self, count: int) -> None:
        """Remove lines from the end of the content."""
        lines = self._rows_content().splitlines(True)
        self._content = b"".join(lines[: max(len(lines) - count, 0)])

    def _missing_columns_message(self, missing_names: Sequence[str]) -> str:
        message = super()._missing_columns_message(missing_names)
        if self._has_names:
            return message
        location = f"above the first numbers (line {self._before_rows + 1})"
        unnamed_reason = f"no column names were found {location}, so the columns are numbered"
        reason = self._mismatch or unnamed_reason
        return f"{message} {reason[0].upper()}{reason[1:]}."

    def first_cells(self, names: Sequence[str], count: int) -> dict[str, list[str]]:
        """Return the first cells of columns, as text."""
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
        """Describe the first lines, one line each."""
        return describe_lines(self._first_lines)

    def _transcode(self, dialect: Dialect) -> None:
        """Convert content in a wide encoding to UTF-8, and other line ends to LF.

        If every row is followed by a blank line, blank lines become comments.
        """
        self._stream.seek(0)
        first_bytes = self._stream.read(_MAX_LINE_BYTES)
        if dialect.encoding is None:
            self._encoding = detect_wide_encoding(first_bytes[:_PREVIEW_BYTES]) or self._encoding
        try:
            is_wide = "a,;\t1\n".encode(self._encoding) != b"a,;\t1\n"
        except LookupError:
            raise RecordError(
                f"{self.path}: unknown encoding '{self._encoding}'.", code="unknown-choice"
            ) from None
        if is_wide and self._encoding != "utf-8-sig":
            try:
                self._content = self.content().decode(self._encoding).encode()
                self._is_utf8 = True
            except UnicodeError:
                raise RecordError(
                    f"{self.path}: the file is not {self._encoding} text.", code="wrong-encoding"
                ) from None
        if self._content is not None:
            first_bytes = self._content[:_MAX_LINE_BYTES]
        if b"\r" in first_bytes and b"\n" not in first_bytes:
            self._content = self._rows_content().replace(b"\r", b"\n")
        if b"\r\r\n" in first_bytes:
            self._content = self._rows_content().replace(b"\r\r\n", b"\n")
        if len(_BLANK_LINE.findall(first_bytes)) > 0.4 * first_bytes.count(b"\n"):
            self._content = _BLANK_LINE.sub(b"#", self._rows_content())

    def _decode(self, raw_line: bytes) -> str:
        """Decode one of the first lines; detect Latin-1."""
        encoding = "utf-8" if self._is_utf8 else self._encoding
        try:
            text = raw_line.removeprefix(BOM_UTF8) if encoding == "utf-8" else raw_line
            return text.decode(encoding).rstrip("\r\n")
        except UnicodeError:
            if self._encoding == "utf-8":
                self._encoding = "latin-1"
            return raw_line.decode("latin-1").rstrip("\r\n")

    def _check_is_text(self, raw_lines: Sequence[tuple[int, bytes]]) -> None:
        for number, raw_line in raw_lines:
            line = raw_line.decode("utf-8-sig", errors="replace").strip("\r\n")
            if "\ufffd" in line or any(character < " " and character != "\t" for character in line):
                raise RecordError(
                    f"{self.path}, line {number}: the file is not UTF-8 text. {_FORMAT_ADVICE}",
                    code="wrong-encoding",
                )
            if line.strip() and not line.startswith("#"):
                return

    def _scan(
        self,
        names: Sequence[str],
        data_type: Any,
        *,
        has_comments: bool = True,
        has_quotes: bool = True,
    ) -> pl.LazyFrame:
        import polars as pl

        if has_quotes and not self._are_quotes_checked:
            self._check_quotation_marks()
            self._are_quotes_checked = True

        # An explicit type for every column: polars would infer integers from the first lines.
        # Other columns are not parsed.
        parsed_names = set(names) - self.timestamp_columns
        schema: dict[str, Any] = {}
        for index, name in enumerate(self.names):
            key = f"{name} ({index})" if name in self.names[:index] else name
            schema[key] = data_type if name in parsed_names else pl.String()
        return pl.scan_csv(
            polars_path(self.path) if self._content is None else self._content,
            separator=self.delimiter,
            quote_char='"' if has_quotes else None,
            decimal_comma=self.decimal == ",",
            has_header=False,  # read above, without blanks around the names
            skip_lines=self._before_rows,
            comment_prefix="#" if has_comments else None,
            schema=schema,
            encoding="utf8-lossy",
            glob=False,
            missing_columns="insert",  # if the first row is short
        ).select(names)

    def _as_strings(self, names: Sequence[str]) -> pl.LazyFrame:
        import polars as pl

        return self._scan(names, pl.String())

    def _use_utf8(self) -> bool:
        """Convert the content to UTF-8, for text cells; return False if it is UTF-8 already."""
        if self._is_utf8 or self._encoding == "utf-8":
            return False
        content = self._rows_content().decode(self._encoding, errors="replace")
        self._content = content.encode()
        self._is_utf8 = True
        return True

    def _table(self) -> pl.DataFrame:
        """Return every column of the file as text, without comments."""
        names = [name for name in self.names if name]
        self._require(names)
        self._use_utf8()
        return self._collect(self._as_strings(names))

    def _collect(self, cells: pl.LazyFrame) -> pl.DataFrame:
        """Return cells as text; RecordError for a line with too many cells."""
        import polars as pl

        try:
            return cells.collect()
        except pl.exceptions.PolarsError:
            self._check_lines()
            raise

    def use_strict_parser(self) -> bool:
        """Switch to a parser for comments, blanks around numbers and text, at half the speed."""
        was_strict, self._is_strict = self._is_strict, True
        return not was_strict

    def _batches(self, names: Sequence[str]) -> Iterator[Columns]:
        """Yield batches of the columns."""
        import polars as pl

        timestamp_names = [name for name in names if name in self.timestamp_columns]
        if self._is_strict:
            self._check_cells(names)
            frames = self._as_strings(names).select(
                pl.col(name) if name in timestamp_names else self._number_text(name)
                for name in names
            )
        else:
            # The detection of comments takes 50 % more time. If the first column is read as
            # numbers, the parser stops at comments anyway.
            has_comments = self.names[0] not in names or self.names[0] in timestamp_names
            # If all columns are read as numbers, the parser also stops at quotation marks, and no
            # search for unclosed marks is needed.
            has_quotes = (
                len(names) < len(self.names)
                or bool(timestamp_names)
                or any(
                    '"' in line for number, line in self._first_lines if number > self._before_rows
                )
            )
            frames = self._scan(
                names, pl.Float64(), has_comments=has_comments, has_quotes=has_quotes
            )
        try:
            for frame in frames.collect_batches(maintain_order=True):
                yield frame_columns(
                    self._convert_timestamps(frame, timestamp_names) if timestamp_names else frame
                )
        except pl.exceptions.NoDataError:
            return
        except pl.exceptions.PolarsError as error:
            raise RecordError(
                f"{self.path}: a cell is not a number.", code="not-numeric"
            ) from error

    def _check_cells(self, names: Sequence[str]) -> None:
        import polars as pl

        self._check_lines()
        expressions = [self._is_invalid(name) for name in names]
        is_invalid = self._as_strings(names).select(expressions)
        index_name = _unused_name(names)
        rows = (
            is_invalid.with_row_index(index_name)
            .filter(pl.any_horizontal(names))
            .head(1)
            .collect(engine="streaming")
        )
        if rows.is_empty():
            return
        row = int(rows[index_name][0])
        column = next(name for name in names if rows[name][0])
        cell = str(self._as_strings([column]).slice(row, 1).collect().item())
        if column in self.timestamp_columns:
            raise RecordError(
                f"{self.path}, {self.locate(row)}: column '{column}' contains the text "
                f"'{cell[:40]}' instead of a time, such as 2026-03-01T12:00:00.020.",
                code="not-numeric",
            )
        hint = ""
        if cell.strip() == column:
            hint = " The header row occurs more than once: put each run into a separate file."
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
        """Convert the text of cells to numbers; null for other text."""
        import polars as pl

        text = pl.col(name).str.strip_chars().str.replace(r"[dD]", "e")
        if self.decimal == ",":
            text = text.str.replace_all(".", "_", literal=True).str.replace(",", ".", literal=True)
        return text.cast(pl.Float64(), strict=False)

    def _is_invalid(self, name: str) -> pl.Expr:
        """Return True for cells that are neither empty nor valid."""
        import polars as pl

        is_empty = pl.col(name).str.strip_chars().str.to_lowercase().is_in(list(EMPTY_CELL_TEXTS))
        value = (
            parse_nanoseconds(name) if name in self.timestamp_columns else self._number_text(name)
        )
        return (value.is_null() & ~is_empty).fill_null(False).alias(name)

    def _convert_timestamps(self, frame: pl.DataFrame, names: Sequence[str]) -> pl.DataFrame:
        """Convert the time stamps of a batch to seconds since the first one of the file."""
        import polars as pl

        for name in names:
            if frame.select(self._is_invalid(name)).to_series().any():
                raise RecordError(f"{self.path}: a cell is not a time.", code="not-numeric")
            times = frame.select(parse_nanoseconds(name)).to_series()
            frame = frame.with_columns(pl.Series(name, self.elapsed_seconds(times)))
        return frame

    def _check_quotation_marks(self) -> None:
        """Raise RecordError for an unclosed quotation mark, on which polars is slow or crashes."""
        open_line_ends, last_bytes = 0, b""
        for chunk in self._chunks():
            open_line_ends = _count_unclosed_line_ends(chunk, open_line_ends)
            last_bytes = (last_bytes + chunk)[-2:]
            if open_line_ends > _MAX_CELL_LINE_ENDS:
                break
        # Comments may contain a single mark, so check the lines.
        if open_line_ends or last_bytes.rstrip(b"\r").endswith(b'"'):
            self._check_lines()

    def _chunks(self) -> Iterator[bytes]:
        """Yield the rows in chunks of bytes."""
        stream: Any = self._stream if self._content is None else io.BytesIO(self._content)
        stream.seek(sum(len(line) for _, line in islice(self._lines(), self._before_rows)))
        while chunk := stream.read(_CHUNK_BYTES):
            yield chunk

    def _check_lines(self) -> None:
        """Raise RecordError for a line with too many cells, or an unclosed quotation mark."""
        quote_line = 0  # line of an unclosed quotation mark
        delimiter = self.delimiter.encode()
        for line_number, raw_line in self._lines():
            if (
                not quote_line
                and b'"' not in raw_line
                and raw_line.count(delimiter) < len(self.names)
            ):
                continue
            line = raw_line.decode("utf-8", errors="replace").rstrip("\r\n")
            if line_number <= self._before_rows or (line.startswith("#") and not quote_line):
                continue
            if line.count('"') % 2:
                quote_line = 0 if quote_line else line_number
            elif quote_line and line_number > quote_line + _MAX_CELL_LINE_ENDS:
                raise RecordError(
                    f"{self.path}, line {quote_line}: a quotation mark is not closed within "
                    f"{_MAX_CELL_LINE_ENDS} lines.",
                    code="malformed-table",
                )
            elif not quote_line and line.count(self.delimiter) >= len(self.names):
                n_cells = len(split_cells(line, self.delimiter))
                if n_cells > len(self.names):
                    hint = ""
                    if self.delimiter == "," and n_cells == 2 * len(self.names):
                        hint = (
                            " Commas serve both as cell delimiters and as decimal separators; "
                            "export the file with semicolons or tabs."
                        )
                    raise RecordError(
                        f"{self.path}, line {line_number}: the line has {n_cells} cells, but "
                        f"the header row has {len(self.names)} names.{hint}",
                        code="malformed-table",
                    )
        if quote_line:
            raise RecordError(
                f"{self.path}, line {quote_line}: a quotation mark is not closed.",
                code="malformed-table",
            )

    def locate(self, row: int) -> str:
        """Return the line of a data row, as in a text editor."""
        line_number = next(islice(self._data_lines(), row, None), row + self._before_rows + 1)
        return f"line {line_number}"

    def row_locations(self, rows: int) -> list[str]:
        """Return the line of each data row, as in a text editor."""
        if self.selection is not None:
            return super().row_locations(rows)
        return [f"line {line_number}" for line_number in islice(self._data_lines(), rows)]

    def _data_lines(self) -> Iterator[int]:
        # Comments are lines, but not rows.
        body_lines = islice(self._lines(), self._before_rows, None)
        return (line_number for line_number, line in body_lines if not line.startswith(b"#"))


def open_text_named_excel(path: Path, stream: BinaryIO, dialect: Dialect) -> ColumnFile:
    """Open a text file with the extension .xls, as LabVIEW and other programs write it."""
    first_bytes = stream.read(_PREVIEW_BYTES)
    stream.seek(0)
    if first_bytes.startswith((b"\xd0\xcf\x11\xe0", b"PK")):
        raise RecordError(
            f"{path}: this workbook is old or has a password; save it as .xlsx without a password.",
            code="wrong-file-type",
        )
    if first_bytes.lstrip().startswith(b"<"):
        raise RecordError(
            f"{path}: this is a web page or an XML spreadsheet; open the file in Excel and save "
            "it as .xlsx.",
            code="wrong-file-type",
        )
    return CsvFile(path, stream, dialect)


def _count_unclosed_line_ends(chunk: bytes, open_line_ends: int) -> int:
    """Return the line ends after a quotation mark that is open at the end of a chunk, plus one.

    The result is 0 without an open mark. It is larger than `_MAX_CELL_LINE_ENDS` if any cell of the
    chunk has more line ends.

    open_line_ends: Result for the preceding chunks.
    """
    if b'"' not in chunk:
        return open_line_ends + chunk.count(b"\n") if open_line_ends else 0
    byte_values = np.frombuffer(chunk, np.uint8)
    quotation_marks = np.flatnonzero(byte_values == ord('"'))
    line_ends = np.flatnonzero(byte_values == ord("\n"))
    # Line ends before each mark and at the end of the chunk.
    line_ends_before = np.append(np.searchsorted(line_ends, quotation_marks), len(line_ends))
    counts = np.diff(line_ends_before, prepend=1 - open_line_ends)[0 if open_line_ends else 1 :: 2]
    max_count = int(counts.max(initial=0))
    is_open = (len(quotation_marks) % 2 == 1) != (open_line_ends > 0)
    if max_count > _MAX_CELL_LINE_ENDS:
        return max_count
    return int(counts[-1]) + 1 if is_open else 0


def _split_by_tabs(line: bytes) -> bytes:
    """Replace the blanks between cells by one tab."""
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


def detect_wide_encoding(first_bytes: bytes) -> str | None:
    """Return the encoding of text with two bytes per character; None for other text."""
    if first_bytes[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    for encoding, high_bytes in (("utf-16-le", first_bytes[1::2]), ("utf-16-be", first_bytes[::2])):
        # The high bytes of numbers and Latin letters are zero.
        if len(high_bytes) > 8 and high_bytes.count(0) > 0.8 * len(high_bytes):
            return encoding
    return None
