"""Tables in Excel workbooks (.xlsx), read with the extra ``excel``.

- `excel_table`: one sheet, its first row the names of the columns
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from counterspin.errors import DamagedFileError, RecordError
from counterspin.input import read_file
from counterspin.records.column_file import quoted, record_errors

if TYPE_CHECKING:
    import polars as pl

#: More than this no workbook has when it is unpacked; a row of ten numbers has 400 bytes.
_UNPACKED_BYTES: Final = 100_000_000


def excel_table(path: Path, sheet: str | None = None, content: bytes | None = None) -> pl.DataFrame:
    """Return one sheet of a workbook, cells of text remaining text.

    Parameters
    ----------
    path
        The workbook.
    sheet
        The sheet's name; None: the only one that has rows.
    content
        What is in the file; None: it is read.

    Raises
    ------
    RecordError
        The file cannot be read, has no such sheet, or has several and none is named; or the
        package that reads it is not installed.
    """
    with record_errors(path):
        try:
            import fastexcel
            import polars as pl
        except ModuleNotFoundError:
            raise RecordError(
                f"{path}: Excel files need the package fastexcel. Install it with pip install "
                "'counterspin[excel]', or save the table as CSV."
            ) from None
        content = read_file(path) if content is None else content
        _require_size(path, content)
        book = fastexcel.read_excel(content)
        names = book.sheet_names
        if sheet is None:
            # A workbook may come with empty sheets.
            full = [name for name in names if book.load_sheet(name).height > 0]
            if len(full) != 1:
                held = f"the sheets {quoted(full)} hold rows; name one" if full else "it has none"
                raise RecordError(f"{path}: which sheet is the table: {held}.")
            sheet = full[0]
        elif sheet not in names:
            raise RecordError(f"{path}: there is no sheet '{sheet}'; it has {quoted(names)}.")
        # A type that is guessed from the first rows breaks on a column that looks whole there.
        table = book.load_sheet(sheet, schema_sample_rows=None).to_polars()
        mixed = [name for name, kind in table.schema.items() if kind == pl.String()]
        if mixed:
            # Among text the reader rounds numbers to nine decimals.
            kinds: dict[str | int, Any] = dict.fromkeys(mixed, "float")
            numbers = book.load_sheet(sheet, dtypes=kinds).to_polars().select(mixed)
            exact = numbers.cast(pl.String())
            table = table.with_columns(exact[name].fill_null(table[name]) for name in mixed)
        return table


def _require_size(path: Path, content: bytes) -> None:
    """Refuse what is no workbook, or unpacks to what no table has, before it is unpacked."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as parts:
            size = sum(part.file_size for part in parts.infolist())
    except zipfile.BadZipFile as error:
        raise DamagedFileError(
            f"{path}: this is no workbook, or a damaged one ({error}). If it is an older one or "
            "has a password, save it as .xlsx without one, or as CSV."
        ) from None
    if size > _UNPACKED_BYTES:
        raise DamagedFileError(
            f"{path}: the workbook unpacks to {size / 1e6:.0f} MB, more than the "
            f"{_UNPACKED_BYTES / 1e6:.0f} MB that a table may have; save the table as CSV."
        )
