"""Text as it is shown: numbers and units as in print, and nothing that acts on a terminal.

- `typeset`: ``-2.7 x 1e-5 ug/g^2`` to ``−2.7 × 10⁻⁵ µg/g²``
- `typeset_block`: the same in all words of a block
- `SYMBOL`: what is set as a letter and its index
- `visible`: characters that control a terminal, as what they are called
- `speakable`: the same text for a stream that cannot write ±
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Final

from counterspin.reports.blocks import Bars, Block, Heading, HeatMap, Paragraph, Plot, Table

#: A coefficient or score in prose, such as K_II: the letter and its index.
SYMBOL: Final = r"([KE])_([A-Z]{1,3}|\d|n)(?!\w|\.\w)"

RAISED: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

#: A power of ten that stands by itself, before a unit or after a cross.
_POWER: Final = re.compile(r"(?<![\w.])1e(-?\d+)(?!\w)")
#: A number, perhaps with its uncertainty in brackets, times a power of ten.
_TIMES_POWER: Final = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?(?:\([\d.]+\))?)e(-?\d+)(?!\w)")
_EXPONENT: Final = re.compile(r"(?<=\w)\^(-?\d)(?!\.?\d)")
#: Micro before a gram-force alone: nothing else in a report is called ug.
_MICRO: Final = re.compile(r"(?<![\w.])ug(?!\w|\.\w)")
#: What a terminal obeys and does not show, and what turns the direction of the text after it: C0
#: and C1 controls, marks of direction (Unicode Standard Annex 9), separators of lines. What is
#: half of a character (a file name that is not UTF-8, for example) has no shape either.
_CONTROL: Final = re.compile(
    "[\x00-\x09\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]"
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

#: Signs of numbers; a hyphen within a word, a name or a date is none.
_SIGN: Final = re.compile(r"(?<![^\s(\[=±×])-(?=\.?\d)|(?<= )-(?= \d)")
_CROSS: Final = re.compile(r"(?<=[\d)]) x (?=10[⁻⁰-⁹¹²³])")


def typeset(text: str) -> str:
    """Return a text with its powers of ten, exponents and micro signs set as in print.

    Words and other numbers stay as they are.
    """
    text = _POWER.sub(lambda found: "10" + found[1].translate(RAISED), text)
    text = _TIMES_POWER.sub(lambda found: f"{found[1]} × 10{found[2].translate(RAISED)}", text)
    text = _EXPONENT.sub(lambda found: found[1].translate(RAISED), text)
    return _SIGN.sub("−", _CROSS.sub(" × ", _MICRO.sub("µg", text)))


def typeset_block(block: Block) -> Block:
    """Return a block with all of its words typeset; commands are left to be typed."""
    match block:
        case Heading():
            return replace(block, text=typeset(block.text))
        case Paragraph():
            return block if block.style == "command" else replace(block, text=typeset(block.text))
        case Table():
            return replace(
                block,
                columns=tuple(replace(c, title=typeset(c.title)) for c in block.columns),
                rows=tuple(tuple(map(typeset, row)) for row in block.rows),
            )
        case Plot():
            return replace(
                block,
                title=typeset(block.title),
                x_label=typeset(block.x_label),
                y_label=typeset(block.y_label),
                series=tuple(replace(s, label=typeset(s.label)) for s in block.series),
            )
        case Bars():
            return replace(
                block,
                title=typeset(block.title),
                texts=tuple(map(typeset, block.texts)),
            )
        case HeatMap():
            return replace(block, title=typeset(block.title))


def visible(text: str, *, lines: bool = True) -> str:
    r"""Return a text with characters that act on a terminal in Python's notation, as ``\x1b``.

    Parameters
    ----------
    text
        Of any origin: names and words from files can hold anything.
    lines
        Whether it may have several lines; if not, their ends are written as ``\n``.
    """
    text = _CONTROL.sub(lambda control: control[0].encode("unicode_escape").decode(), text)
    return text if lines else text.replace("\n", "\\n")


def speakable(text: str, encoding: str) -> str:
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


def _can_write(text: str, encoding: str) -> bool:
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return False
    return True
