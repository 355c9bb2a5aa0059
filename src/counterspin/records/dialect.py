"""Stated format of a record file; `layout` detects properties that are not stated."""

from __future__ import annotations

from typing import Final

from counterspin.frozen import frozen


@frozen
class Dialect:
    """Stated format of a file; None: detected."""

    skip_lines: int | None = None  #: Lines, or rows of a sheet, before the names.
    delimiter: str | None = None  #: Delimiter of cells.
    decimal: str | None = None  #: Decimal separator.
    encoding: str | None = None  #: Encoding, as named in Python.
    units_row: bool | None = None  #: Whether a row of units follows the names.
    skip_footer: int | None = None  #: Lines at the end that are not rows.
    sheet: str | None = None  #: Sheet of an Excel file.
    select: tuple[str, str] | None = None  #: Column, and its value in the rows to read.
    #: Group of an HDF5 or TDMS file, or structure of a MATLAB file, that contains the columns.
    group: str | None = None


#: Dialect that is completely detected.
AUTODETECT: Final = Dialect()
