"""Parser of units and numbers in the notations of files."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import Final

from counterspin.units import normalise_unit

#: Thousands separator (non-breaking blanks, apostrophe, point or comma) -> decimal separator used
#: with it.
_DECIMAL_BY_SEPARATOR: Final = {
    **dict.fromkeys(("\u202f", "\u2009", "\xa0", "'", "’"), r"[.,]"),
    ".": ",",
    ",": r"\.",
    " ": r"[.,]",
}
#: Fortran number of double precision, 1.25D-03: mantissa and exponent.
_FORTRAN_EXPONENT: Final = re.compile(r"[dD][-+\d]")
_FORTRAN_NUMBER: Final = re.compile(r"(?<![\w.,])([-+]?(?:\d+[.,]\d*|[.,]\d+))[dD]([-+]?\d{1,3})\b")
#: A unit in brackets at the end of a name.
_BRACKETED_UNIT: Final = re.compile(r".*?[\[(]([^\[\]()]+)[\])]")
#: Notation of a unit in files -> unit.
_UNIT_BY_WORD: Final = {
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
    "rads": "rad",
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
    "m/(s^2)": "m/s^2",
    "m/s/s": "m/s^2",
    "mps2": "m/s^2",
    "ft/s/s": "ft/s^2",
    "deg.s-1": "deg/s",
    "rad.s-1": "rad/s",
    "deg s-1": "deg/s",
    "rad s-1": "rad/s",
    "°.s-1": "deg/s",
    "dps": "deg/s",
}
#: Notation of an acceleration in files, such as m/sec2, mm s-2 and ms⁻²: unit of length.
_ACCELERATION: Final = re.compile(
    r"([munck]?m|ft|in)(?:ch)?(?: ?/ ?s(?:ec)?(?:\^|\*\*)?[2²]|[ .*·]?s(?:ec)?\^?(?:-2|⁻²))"
)
#: Notations of degrees Celsius, which no factor converts to other units.
_CELSIUS_UNITS: Final = ("°C", "degC", "deg C", "℃")


def parse_file_unit(text: str) -> str | None:
    """Normalise a unit in a file, with or without brackets; None for other text."""
    unbracketed = text.strip()
    while unbracketed and unbracketed[0] + unbracketed[-1] in ("[]", "()", "<>", "{}"):
        unbracketed = unbracketed[1:-1].strip()
    return _known_unit(unbracketed) if 0 < len(unbracketed) <= 20 else None


def bracketed_unit(name: str) -> str:
    """Return the unit in brackets at the end of a column name; empty without one."""
    match = _BRACKETED_UNIT.fullmatch(name)
    # A number in brackets is the index of an array element.
    return (parse_file_unit(match[1]) or "") if match and not match[1].isdigit() else ""


def unit_in_name(name: str) -> str:
    """Return the unit at the end of a name, `time_s`, `Reading mV`, `U/mV`; empty without one.

    A single letter is a name, as is A after a blank: sensor A. "in" is a word.
    """
    *prefixes, suffix = re.split(r"[_\s,]+", name.strip())
    if suffix == "in" or "A" == suffix != name.rpartition("_")[2]:
        return ""
    if not prefixes and len(suffix) < 2:
        return ""
    return parse_file_unit(suffix) or parse_file_unit(suffix.partition("/")[2]) or ""


@lru_cache(maxsize=256)
def _known_unit(text: str) -> str | None:
    if text in _CELSIUS_UNITS:
        return "degC"
    if match := _ACCELERATION.fullmatch(text):
        return normalise_unit(f"{match[1]}/s^2")
    try:
        return normalise_unit(_UNIT_BY_WORD.get(text) or _UNIT_BY_WORD.get(text.lower(), text))
    except ValueError:
        return None


def number_rewriters(text: str) -> Iterator[Callable[[str], str]]:
    """Yield functions that rewrite the numbers of a file for the parser.

    text: First lines of the file.
    """
    if _FORTRAN_EXPONENT.search(text) and _FORTRAN_NUMBER.search(text):
        yield partial(_FORTRAN_NUMBER.sub, r"\1E\2")
    if "\u2212" in text:
        yield lambda cell_text: cell_text.replace("\u2212", "-")
    if (separator := find_thousands_separator(text)) is not None:
        yield partial(strip_thousands, separator=separator)


def find_thousands_separator(text: str) -> str | None:
    """Return the thousands separator of cells with decimals; or None."""
    for separator, decimal in _DECIMAL_BY_SEPARATOR.items():
        boundary = '"' if separator == "," else r'["\t;\n]'
        # Blanks at the beginning of a line may separate columns.
        start = boundary.replace(r"\n", "") if separator == " " else boundary
        cell_pattern = (
            rf"{start}[-+]?\d{{1,3}}(?:{re.escape(separator)}\d{{3}})+{decimal}\d+(?={boundary})"
        )
        if separator in text and re.search(cell_pattern, f"\n{text}\n"):
            return separator
    return None


def strip_thousands(text: str, separator: str) -> str:
    """Remove thousands separators from a text."""
    boundary = '"' if separator == "," else r'["\t;\r\n]'
    cell_pattern = (
        rf"(?<={boundary})[-+]?\d{{1,3}}(?:{re.escape(separator)}\d{{3}})+(?=[.,]?\d*{boundary})"
    )
    return re.sub(cell_pattern, lambda match: match[0].replace(separator, ""), f"\n{text}\n")[1:-1]
