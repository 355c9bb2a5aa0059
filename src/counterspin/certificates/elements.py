"""The words and numbers of a certificate's XML, and its namespaces."""

from __future__ import annotations

from typing import Any, Final

from counterspin.reports.characters import escape_controls

DCC: Final = "https://ptb.de/dcc"
SI: Final = "https://ptb.de/si"
NAMESPACES: Final = {"dcc": DCC, "si": SI}

#: Language of the text that counterspin writes.
ENGLISH: Final = "en"

Element = Any  # lxml carries no types


def clean(words: str) -> str:
    """Return text that XML can represent (clause 2.2) and no reader obeys, no blanks around it."""
    return escape_controls(words).strip()


def number(value: float) -> str:
    """Write a number so that it reads back as the same double."""
    return repr(float(value))


def factor(value: float) -> str:
    """Write a coverage factor or probability, which must not have an exponent."""
    return f"{value:.4f}".rstrip("0").rstrip(".")
