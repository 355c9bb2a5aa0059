"""Display of text: escape control characters, and substitute characters an encoding lacks."""

from __future__ import annotations

import codecs
import re
from functools import partial
from io import TextIOWrapper
from typing import Final, TextIO

#: Characters that a terminal interprets, that XML cannot represent, or that change the direction of
#: the following text: C0 and C1 controls, directional marks (Unicode Standard Annex 9), line
#: separators, noncharacters, and lone surrogates (such as from a file name that is not UTF-8).
_CONTROL_CHARACTER: Final = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff\ufffe\uffff]"
)

#: Substitutes for characters in encodings without them.
_ASCII_SUBSTITUTES: Final = {"±": "+/-", "×": "x", "−": "-", "–": "-", "µ": "u", "…": "..."}

#: Superscript digits, such as those of 10⁻⁵, are substituted by a caret and plain digits.
_SUPERSCRIPT_DIGITS: Final = re.compile("[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+")
_SUPERSCRIPT_TO_ASCII: Final = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


class MultilineText(str):
    """Text with intended line breaks; line breaks within each given line are escaped."""

    __slots__ = ()

    def __new__(cls, *lines: str) -> MultilineText:
        """Return the lines, joined with line breaks."""
        return super().__new__(cls, "\n".join(map(escape_controls, lines)))


def escape_controls(text: str) -> str:
    r"""Return a text with control characters in Python's notation, such as ``\x1b``."""
    if isinstance(text, MultilineText):
        return text
    return _CONTROL_CHARACTER.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


def substitute_unencodable(text: str, encoding: str) -> str:
    """Return the text with substitutes for characters that the encoding lacks: ``+/-`` for ``±``.

    A character without a substitute becomes a question mark.
    """
    if _is_encodable(text, encoding):
        return text
    text = _SUPERSCRIPT_DIGITS.sub(
        lambda match: (
            match[0]
            if _is_encodable(match[0], encoding)
            else f"^{match[0].translate(_SUPERSCRIPT_TO_ASCII)}"
        ),
        text,
    )
    return "".join(
        character if _is_encodable(character, encoding) else _ASCII_SUBSTITUTES.get(character, "?")
        for character in text
    )


def with_article(noun: str) -> str:
    """Return a noun with its indefinite article."""
    return f"{'an' if noun[0] in 'aeiou' else 'a'} {noun}"


def install_substitution(stream: TextIO | None) -> None:
    """Make a stream substitute the characters that its encoding lacks."""
    if isinstance(stream, TextIOWrapper):
        handler_name = f"counterspin-{stream.encoding}"
        codecs.register_error(handler_name, partial(_handle_encode_error, stream.encoding))
        stream.reconfigure(errors=handler_name)


def _handle_encode_error(encoding: str, error: UnicodeError) -> tuple[str, int]:
    """Return substitutes for characters that cannot be encoded, and their end (`codecs`)."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    # Some codecs ask for one character at a time; superscript digits are replaced together.
    digits = _SUPERSCRIPT_DIGITS.match(error.object, error.start)
    end = error.end if digits is None else max(error.end, digits.end())
    return substitute_unencodable(error.object[error.start : end], encoding), end


def _is_encodable(text: str, encoding: str) -> bool:
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return False
    return True
