"""Characters that may be shown: escape control characters, replace what an encoding lacks."""

from __future__ import annotations

import codecs
import re
from functools import partial
from io import TextIOWrapper
from typing import Final, TextIO

#: What a terminal obeys and does not show, what XML cannot represent, and what turns the direction
#: of the text after it: C0 and C1 controls, marks of direction (Unicode Standard Annex 9),
#: separators of lines, the last two code points. What is half of a character (a file name that is
#: not UTF-8, for example) has no shape either.
_CONTROL: Final = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff\ufffe\uffff]"
)

#: What streams without these characters get instead.
_ASCII: Final = {
    "±": "+/-",
    "×": "x",
    "−": "-",
    "–": "-",
    "µ": "u",
    "…": "...",
}

#: Raised digits, such as those of 10⁻⁵, get a caret before them instead.
_RAISED_DIGITS: Final = re.compile("[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+")
_LOWERED: Final = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


class MultilineText(str):
    """Several lines, each of them visible: ends of lines that we mean, not those of a file."""

    __slots__ = ()

    def __new__(cls, *lines: str) -> MultilineText:
        """Return these lines below each other."""
        return super().__new__(cls, "\n".join(map(escape_controls, lines)))


def escape_controls(text: str) -> str:
    r"""Return a text with its control characters in Python's notation, as ``\x1b``."""
    if isinstance(text, MultilineText):
        return text
    return _CONTROL.sub(lambda control: control[0].encode("unicode_escape").decode(), text)


def encodable(text: str, encoding: str) -> str:
    """Return the text with what the encoding lacks put otherwise: ``+/-`` for ``±``.

    A character without such a substitute becomes a question mark.
    """
    if _can_write(text, encoding):
        return text
    text = _RAISED_DIGITS.sub(
        lambda run: run[0] if _can_write(run[0], encoding) else f"^{run[0].translate(_LOWERED)}",
        text,
    )
    return "".join(c if _can_write(c, encoding) else _ASCII.get(c, "?") for c in text)


def write_substitutes(stream: TextIO | None) -> None:
    """Let a stream write substitutes for the characters that its encoding lacks, as `encodable`."""
    if isinstance(stream, TextIOWrapper):
        handler = f"counterspin-{stream.encoding}"
        codecs.register_error(handler, partial(_substituted, stream.encoding))
        stream.reconfigure(errors=handler)


def _substituted(encoding: str, error: UnicodeError) -> tuple[str, int]:
    """Return substitutes for what could not be encoded, and where to go on (`codecs`)."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    # Some codecs ask for one character at a time; raised digits are replaced together.
    digits = _RAISED_DIGITS.match(error.object, error.start)
    end = error.end if digits is None else max(error.end, digits.end())
    return encodable(error.object[error.start : end], encoding), end


def _can_write(text: str, encoding: str) -> bool:
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return False
    return True
