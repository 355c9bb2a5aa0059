"""Units and numbers as files write them, to units in plain signs and numbers for the parser."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import Final

from counterspin.units import normalise_unit

#: Thousands separator -> the decimal mark used with it: thin, narrow and other blanks that are not
#: broken, an apostrophe, or the mark that does not separate decimals.
_GROUPED: Final = {
    **dict.fromkeys(("\u202f", "\u2009", "\xa0", "'", "’"), r"[.,]"),
    ".": ",",
    ",": r"\.",
    " ": r"[.,]",
}
#: A number of double precision, 1.25D-03, up to the letter, and its exponent.
_FORTRAN_EXPONENT: Final = re.compile(r"[dD][-+\d]")
_FORTRAN_NUMBER: Final = re.compile(r"(?<![\w.,])([-+]?(?:\d+[.,]\d*|[.,]\d+))[dD]([-+]?\d{1,3})\b")
#: A unit in brackets at the end of a name.
_IN_BRACKETS: Final = re.compile(r".*?[\[(]([^\[\]()]+)[\])]")
#: Words that files write for units.
_WORDS: Final = {
    "sec": "s",
    "sec.": "s",
    "sek": "s",
    "sek.": "s",
    "sekunden": "s",
    "second": "s",
    "seconds": "s",
    "msec": "ms",
    **dict.fromkeys(("millis", "millis()"), "ms"),
    **dict.fromkeys(("micros", "micros()"), "us"),
    "deg": "deg",
    "Grad": "deg",  # lower-case grad is 0.9 of it
    "degree": "deg",
    "degrees": "deg",
    "radian": "rad",
    "radians": "rad",
    "revolutions": "rev",
    "umdr": "rev",
    "umdrehungen": "rev",
    "meter": "m",
    "meters": "m",
    "metre": "m",
    "metres": "m",
    "inch": "in",
    "inches": "in",
    "foot": "ft",
    "feet": "ft",
    "counts": "count",
    "volt": "V",
    "volts": "V",
    "vdc": "V",
    "cts": "count",
    "lsb": "count",
    "digits": "count",
    "impulse": "count",
    "inkremente": "count",
    "rpm": "rpm",
    "r/min": "rpm",
    "u/min": "rpm",
    "upm": "rpm",
    "u/s": "rev/s",
    "min-1": "1/min",
    "min⁻¹": "1/min",
    "m/s²": "m/s^2",
    "m/s2": "m/s^2",
    "m/(s^2)": "m/s^2",
    "m s-2": "m/s^2",
    "m.s-2": "m/s^2",
    "m*s-2": "m/s^2",
    "m*s^-2": "m/s^2",
    "m s^-2": "m/s^2",
    "m·s^-2": "m/s^2",
    "m/sec^2": "m/s^2",
    "m/s/s": "m/s^2",
    "ft/s2": "ft/s^2",
    "inch/s^2": "in/s^2",
    "ft/sec^2": "ft/s^2",
    "ft/s/s": "ft/s^2",
    "m.s⁻²": "m/s^2",
    "m s⁻²": "m/s^2",
    "m·s⁻²": "m/s^2",
    "deg.s-1": "deg/s",
    "rad.s-1": "rad/s",
    "deg s-1": "deg/s",
    "rad s-1": "rad/s",
    "°.s-1": "deg/s",
    "dps": "deg/s",
}
#: There is no factor from a temperature in these to one in another unit.
TEMPERATURES: Final = ("°C", "degC", "deg C", "℃")


def parse_file_unit(text: str) -> str | None:
    """Return a unit as a file writes it, perhaps in brackets, in plain signs; None if none."""
    bare = text.strip()
    while bare and bare[0] + bare[-1] in ("[]", "()", "<>", "{}"):
        bare = bare[1:-1].strip()
    return _known_unit(bare) if 0 < len(bare) <= 20 else None


def bracketed_unit(name: str) -> str:
    """Return the unit in brackets at the end of a column's name; empty text if there is none."""
    match = _IN_BRACKETS.fullmatch(name)
    # A number in brackets counts the elements of an array.
    return (parse_file_unit(match[1]) or "") if match and not match[1].isdigit() else ""


def unit_in_name(name: str) -> str:
    """Return the unit at the end of a name, `time_s`, `Reading mV`, `U/mV`; empty without one.

    A single letter alone is a name, and so is A after a blank: sensor A. "in" is a word.
    """
    *before, ending = re.split(r"[_\s,]+", name.strip())
    if ending == "in" or "A" == ending != name.rpartition("_")[2]:
        return ""
    if not before and len(ending) < 2:
        return ""
    return parse_file_unit(ending) or parse_file_unit(ending.partition("/")[2]) or ""


@lru_cache(maxsize=256)
def _known_unit(text: str) -> str | None:
    if text in TEMPERATURES:
        return "degC"
    try:
        return normalise_unit(_WORDS.get(text) or _WORDS.get(text.lower(), text))
    except ValueError:
        return None


def number_rewriters(text: str) -> Iterator[Callable[[str], str]]:
    """Yield the functions that rewrite the numbers of a file for the parser.

    text: The first lines of the file.
    """
    if _FORTRAN_EXPONENT.search(text) and _FORTRAN_NUMBER.search(text):
        yield partial(_FORTRAN_NUMBER.sub, r"\1E\2")
    if "\u2212" in text:
        yield lambda whole: whole.replace("\u2212", "-")
    if (separator := find_thousands_separator(text)) is not None:
        yield partial(strip_thousands, separator=separator)


def find_thousands_separator(text: str) -> str | None:
    """Return the thousands separator of cells that have decimals too; None without one."""
    for separator, decimal in _GROUPED.items():
        edge = '"' if separator == "," else r'["\t;\n]'
        # Blanks at the beginning of a line may separate columns.
        start = edge.replace(r"\n", "") if separator == " " else edge
        cell = rf"{start}[-+]?\d{{1,3}}(?:{re.escape(separator)}\d{{3}})+{decimal}\d+(?={edge})"
        if separator in text and re.search(cell, f"\n{text}\n"):
            return separator
    return None


def strip_thousands(text: str, separator: str) -> str:
    """Return a text without the thousands separators."""
    edge = '"' if separator == "," else r'["\t;\r\n]'
    cell = rf"(?<={edge})[-+]?\d{{1,3}}(?:{re.escape(separator)}\d{{3}})+(?=[.,]?\d*{edge})"
    return re.sub(cell, lambda match: match[0].replace(separator, ""), f"\n{text}\n")[1:-1]
