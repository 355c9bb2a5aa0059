"""Statements of a person on how a record file is written; `layout` finds what is not stated."""

from __future__ import annotations

from typing import Final

from counterspin.frozen import frozen


@frozen
class Dialect:
    """How a file is written, as far as a person says it; None: to be found."""

    skip_lines: int | None = None  #: Lines, or rows of a sheet, before the names.
    #: Between cells, and in numbers.
    delimiter: str | None = None
    decimal: str | None = None
    encoding: str | None = None  #: As Python names it.
    units_row: bool | None = None  #: Whether a row of units stands below the names.
    skip_footer: int | None = None  #: Lines at the end that are not rows.
    sheet: str | None = None  #: Of an Excel file.
    select: tuple[str, str] | None = None  #: A column, and its value in the rows that are read.
    #: Of an HDF5 or TDMS file, or the structure of a MATLAB file; columns are named within it.
    group: str | None = None


#: Everything is to be found.
AUTODETECT: Final = Dialect()
