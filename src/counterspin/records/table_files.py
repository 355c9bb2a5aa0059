"""Record files with binary tables: Apache Parquet and Excel workbooks."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

from counterspin.errors import DamagedFileError, RecordError, install_command
from counterspin.input import read_file
from counterspin.records.column_file import (
    ColumnFile,
    Columns,
    NoRowsError,
    format_names,
    frame_columns,
    parse_nanoseconds,
    polars_path,
    record_errors,
)
from counterspin.records.dialect import AUTODETECT, Dialect
from counterspin.records.header_footer import count_footer_lines
from counterspin.records.layout import EMPTY_CELL_TEXTS, HEAD_LINES, TableFormat, find_rows

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
            raise RecordError(
                f"{path}: this is not a readable Parquet file.", code="file-damaged"
            ) from None
        self.names = self._schema.names()

    def _scan(self) -> pl.LazyFrame:
        import polars as pl

        return pl.scan_parquet(polars_path(self.path), glob=False, hive_partitioning=False)

    def _require(self, names: Sequence[str]) -> None:
        import polars as pl

        for name in names:
            if name not in self.timestamp_columns and not self._schema[name].is_numeric():
                raise RecordError(
                    f"{self.path}: column '{name}' is of type {self._schema[name]}; numbers are "
                    "required.",
                    code="not-numeric",
                )
        rows = int(self._scan().select(pl.len()).collect().item())
        self._check_size(8 * rows * len(names))

    def _table(self) -> pl.DataFrame:
        """Return every column of the file with its type."""
        self._require([name for name, data_type in self._schema.items() if data_type.is_numeric()])
        return self._scan().collect()

    def _batches(self, names: Sequence[str]) -> Iterator[Columns]:
        """Yield batches of the columns as the streaming engine decodes them."""
        numeric_columns = self._scan().select(self._column_expression(name) for name in names)
        for frame in numeric_columns.collect_batches(maintain_order=True):
            columns = frame_columns(frame)
            for name in self.timestamp_columns:
                columns[name] = self.elapsed_seconds(frame[name])
            yield columns

    def _cells(self, column: str) -> list[str]:
        import polars as pl

        frame = self._scan().select(pl.col(column).cast(pl.String())).collect()
        return [str(cell or "") for cell in frame[column]]

    def _first_cells(self, name: str, count: int) -> list[str]:
        import polars as pl

        frame = self._scan().select(pl.col(name).cast(pl.String())).head(count).collect()
        return [str(cell or "") for cell in frame[name]]

    def _column_expression(self, name: str) -> pl.Expr:
        import polars as pl

        data_type = self._schema[name]
        if name not in self.timestamp_columns:
            return pl.col(name).cast(pl.Float64())
        if data_type == pl.String():
            return parse_nanoseconds(name)
        if data_type == pl.Time():
            return pl.col(name).to_physical()
        if not isinstance(data_type, pl.Datetime | pl.Duration):
            raise RecordError(
                f"{self.path}: column '{name}' contains no time stamps.", code="not-numeric"
            )
        return pl.col(name).dt.cast_time_unit("ns").to_physical()


#: Largest unpacked size of a workbook: bytes for any workbook, or bytes per byte (typically ten).
_UNPACKED_BYTES: Final = 100_000_000
_UNPACKED_PER_BYTE: Final = 50


def read_excel_table(
    path: Path, dialect: Dialect = AUTODETECT, content: bytes | None = None
) -> pl.DataFrame:
    """Read one sheet of a workbook; text cells remain text.

    content: Bytes of the file; None: read here.
    """
    with record_errors(path):
        content = read_file(path) if content is None else content
        workbook, sheet = _find_sheet(path, dialect.sheet, content)
        import polars as pl

        header_options = {
            "header_row": dialect.skip_lines or 0,
            "skip_rows": 1 if dialect.units_row else None,
        }
        # Types inferred from the first rows may be wrong for later rows.
        table: pl.DataFrame = workbook.load_sheet(
            sheet, schema_sample_rows=None, **header_options
        ).to_polars()
        text_names = [name for name, data_type in table.schema.items() if data_type == pl.String()]
        if text_names:
            # In text columns, the reader rounds numbers to nine decimals.
            data_types: dict[str | int, Any] = dict.fromkeys(text_names, "float")
            numeric_cells = (
                workbook.load_sheet(sheet, dtypes=data_types, **header_options)
                .to_polars()
                .select(text_names)
            )
            texts = numeric_cells.cast(pl.String())
            table = table.with_columns(texts[name].fill_null(table[name]) for name in text_names)
        return table


#: Largest number of rows of an Excel sheet.
_MAX_ROWS: Final = 1 << 20


def _open_workbook(path: Path, content: bytes) -> Any:
    """Open a workbook."""
    try:
        import fastexcel
    except ModuleNotFoundError:
        raise RecordError(
            f"{path}: Excel files require the package fastexcel. Save the table as CSV, or "
            f"install it: {install_command('excel')}.",
            code="missing-package",
        ) from None
    _require_size(path, content)
    return fastexcel.read_excel(content)


def _find_sheet(path: Path, sheet: str | None, content: bytes) -> tuple[Any, str]:
    """Return the workbook, and the name of the requested sheet or of the only table."""
    workbook = _open_workbook(path, content)
    names = workbook.sheet_names
    if sheet is not None:
        if sheet not in names:
            raise RecordError(
                f"{path}: no sheet is named '{sheet}'; the sheets are {format_names(names)}.",
                code="unknown-sheet",
            )
        return workbook, sheet
    # A workbook may also have empty sheets, and sheets with text.
    sheets = [name for name in names if workbook.load_sheet(name).height > 0]
    matches = sheets if len(sheets) == 1 else _find_table_sheets(workbook, sheets)
    if len(matches) != 1:
        text = (
            f"the sheets {format_names(matches or sheets)} contain rows; name one of them"
            if sheets
            else "the workbook has no sheets with rows"
        )
        raise RecordError(
            f"{path}: the sheet with the table cannot be identified: {text}.",
            code="ambiguous-selection",
        )
    return workbook, matches[0]


def find_table_sheets(path: Path) -> list[str]:
    """Return the sheets of a workbook with rows of numbers below column names."""
    with record_errors(path):
        workbook = _open_workbook(path, read_file(path))
        return _find_table_sheets(workbook, workbook.sheet_names)


def _find_table_sheets(workbook: Any, sheets: Sequence[str]) -> list[str]:
    """Return the sheets with rows that contain more numbers than texts."""
    return [sheet for sheet in sheets if (score := _score_rows(workbook, sheet)) and score[0] > 0]


def _load_cells(
    workbook: Any, sheet: str, data_type: Any, skipped_rows: int, max_rows: int | None = None
) -> pl.DataFrame:
    """Return the cells of a sheet below the skipped rows, all of one type."""
    cells = workbook.load_sheet(
        sheet, header_row=None, skip_rows=skipped_rows, n_rows=max_rows, dtypes=data_type
    )
    frame: pl.DataFrame = cells.to_polars()
    return frame


def _score_rows(
    workbook: Any, sheet: str, dialect: Dialect = AUTODETECT
) -> tuple[int, TableFormat] | None:
    """Return score (numbers minus texts) and layout of the rows of a sheet; or None."""
    first_rows = _load_cells(
        workbook, sheet, "string", 0, HEAD_LINES + (dialect.skip_lines or 0)
    ).rows()
    split_rows = [
        (row_number, ["" if cell is None else cell.strip() for cell in row])
        for row_number, row in enumerate(first_rows, 1)
    ]
    # Text cells, such as those of a pasted file, may contain decimal commas.
    candidates = [find_rows(split_rows, dialect, mark) for mark in (".", ",")]
    return max((rows for rows in candidates if rows), key=lambda rows: rows[0], default=None)


class ExcelFile(ColumnFile):
    """One sheet of a workbook: names, which other rows may precede, optional units, then rows."""

    def __init__(self, path: Path, stream: BinaryIO, dialect: Dialect) -> None:
        super().__init__(path, stream)
        self._rows = _MAX_ROWS
        self._book, self._sheet = _find_sheet(path, dialect.sheet, self.content())
        table_position = _score_rows(self._book, self._sheet, dialect)
        if table_position is None:
            raise NoRowsError(
                f"{path}: sheet '{self._sheet}' has no rows of numbers below a header row."
            )
        self._layout = table_position[1]
        self.names, self.decimal = list(self._layout.names), self._layout.decimal
        self.units = dict(zip(self._layout.names, self._layout.units, strict=True))
        self.units_row = self._layout.units_row
        rows = self._load("string", self._layout.before_rows).rows()
        split_rows = [[str(cell or "").strip() for cell in row] for row in rows]
        self._rows = len(rows) - (dialect.skip_footer or 0)
        if dialect.skip_footer is None and (count := count_footer_lines(split_rows, self.decimal)):
            self.footer = tuple("; ".join(filter(None, cells)) for cells in split_rows[-count:])
        self.format_description = ", ".join(
            [f"sheet '{self._sheet}'"] * (len(self._book.sheet_names) > 1)
            + ["unnamed columns"] * (self._layout.header == 0)
            + [f"names in row {self._layout.header}"] * (self._layout.header > 1)
            + ["a units row"] * self.units_row
            + ["text with decimal commas"] * (self.decimal == ",")
        )

    def _cells(self, column: str) -> list[str]:
        text = self._load("string", self._layout.before_rows)
        return [str(cell or "") for cell in text.to_series(self.names.index(column))]

    def _first_cells(self, name: str, count: int) -> list[str]:
        return self._cells(name)[:count]

    def _load(self, data_type: Any, skipped_rows: int) -> pl.DataFrame:
        """Return the rows below the skipped rows, without a skipped footer."""
        return _load_cells(self._book, self._sheet, data_type, skipped_rows).head(self._rows)

    def _batches(self, names: Sequence[str]) -> Iterator[Columns]:
        import polars as pl

        skipped_rows = self._layout.before_rows
        text, numbers = self._load("string", skipped_rows), self._load("float", skipped_rows)
        times = self._load("datetime", skipped_rows) if self.timestamp_columns else text
        columns = {}
        for name in names:
            index = self.names.index(name)
            stripped_text = text.to_series(index).alias("text").str.strip_chars()
            is_empty = stripped_text.is_null() | stripped_text.str.to_lowercase().is_in(
                list(EMPTY_CELL_TEXTS)
            )
            if name in self.timestamp_columns:
                datetimes = times.to_series(index).cast(pl.Datetime("ns")).cast(pl.Int64())
                stamps = stripped_text.to_frame().select(parse_nanoseconds("text")).to_series()
                value = stamps.fill_null(datetimes)
                columns[name] = self.elapsed_seconds(value)
            else:
                value = numbers.to_series(index)
                if self.decimal == ",":
                    plain_text = stripped_text.str.replace(",", ".", literal=True)
                    value = value.fill_null(plain_text.cast(pl.Float64(), strict=False))
                columns[name] = value.to_numpy()
            invalid_rows = (value.is_null() & ~is_empty).arg_true()
            if len(invalid_rows):
                row = int(invalid_rows[0])
                noun = "time" if name in self.timestamp_columns else "number"
                raise RecordError(
                    f"{self.path}, {self.locate(row)}: column '{name}' contains the text "
                    f"'{str(stripped_text[row])[:40]}' instead of a {noun}.",
                    code="not-numeric",
                )
        yield columns

    def _table(self) -> pl.DataFrame:
        layout = self._layout
        if not layout.header:
            rows = self._load("float", layout.before_rows)
            return rows.rename(dict(zip(rows.columns, layout.names, strict=True)))
        dialect = Dialect(
            skip_lines=layout.header - 1, units_row=layout.units_row, sheet=self._sheet
        )
        return read_excel_table(self.path, dialect, self.content()).head(self._rows)

    def locate(self, row: int) -> str:
        """Return the row of the sheet of a data row."""
        return f"row {row + self._layout.before_rows + 1}"


def _require_size(path: Path, content: bytes) -> None:
    """Raise DamagedFileError for a file that is not a workbook, or unpacks to too many bytes."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            total_size = sum(entry.file_size for entry in archive.infolist())
    except zipfile.BadZipFile as error:
        raise DamagedFileError(
            f"{path}: this is not a workbook, or it is damaged. If it is in an older format or "
            f"protected by a password, save it as .xlsx without a password, or as CSV."
        ) from error
    max_bytes = max(_UNPACKED_BYTES, _UNPACKED_PER_BYTE * len(content))
    if total_size > max_bytes:
        raise DamagedFileError(
            f"{path}: the workbook unpacks to {total_size / 1e6:.0f} MB, more than the "
            f"{max_bytes / 1e6:.0f} MB allowed for a file of this size; save the table as CSV.",
            code="file-too-large",
        )
