"""Numbers as programs write them: thousands separators, and exponents of Fortran."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

#: Thousands separator -> the decimal mark beside it: thin, narrow and other blanks that are not
#: broken, an apostrophe, or the mark that does not separate decimals.
_GROUPED: Final = {
    **dict.fromkeys(("\u202f", "\u2009", "\xa0", "'", "’"), r"[.,]"),
    ".": ",",
    ",": r"\.",
}
#: A number of double precision, 1.25D-03, up to the letter, and its exponent.
_FORTRAN_NUMBER: Final = re.compile(r"(?<![\w.,])([-+]?(?:\d+[.,]\d*|[.,]\d+))[dD]([-+]?\d{1,3})\b")


def number_rewriters(text: str) -> Iterator[Callable[[str], str]]:
    """Yield the functions that rewrite the numbers of a file for the parser.

    text: The first lines of the file.
    """
    if _FORTRAN_NUMBER.search(text):
        yield partial(_FORTRAN_NUMBER.sub, r"\1E\2")
    if (separator := find_thousands_separator(text)) is not None:
        yield partial(strip_thousands, separator=separator)


def find_thousands_separator(text: str) -> str | None:
    """Return the thousands separator of cells that have decimals too; None without one."""
    for separator, decimal in _GROUPED.items():
        edge = '"' if separator == "," else r'["\t;\n]'
        cell = rf"{edge}[-+]?\d{{1,3}}(?:{re.escape(separator)}\d{{3}})+{decimal}\d+(?={edge})"
        if re.search(cell, f"\n{text}\n"):
            return separator
    return None


def strip_thousands(text: str, separator: str) -> str:
    """Return a text without the thousands separators."""
    edge = '"' if separator == "," else r'["\t;\r\n]'
    cell = rf"(?<={edge})[-+]?\d{{1,3}}(?:{re.escape(separator)}\d{{3}})+(?=[.,]?\d*{edge})"
    return re.sub(cell, lambda match: match[0].replace(separator, ""), f"\n{text}\n")[1:-1]
