"""Typesetting of numbers, units and symbols."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from counterspin.characters import MultilineText
from counterspin.reports.blocks import (
    Bars,
    Block,
    Card,
    Heading,
    Paragraph,
    Picture,
    Plot,
    Sphere,
    Table,
)

#: A coefficient, score or force in prose, such as K_II: the letter and its index. A superscript
#: may follow.
SYMBOL: Final = (
    r"(K|E|a(?=_[IPO])|delta(?=_[IPO]))_((?:[A-Z]{1,3}|\d|n)(?:_asym)?)(?![^\W²³⁴]|\.\w)"
)
#: Names of Greek letters -> printed letters.
_GREEK_LETTERS: Final = {"delta": "δ"}

SUPERSCRIPTS: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

#: A power of ten alone, before a unit or after a cross.
_POWER_OF_TEN: Final = re.compile(r"(?<![\w.])1e([-+]?\d+)(?!\w)")
#: A number, perhaps with its uncertainty in brackets, times a power of ten.
_SCIENTIFIC_NUMBER: Final = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?(?:\([\d.]+\))?)e([-+]?\d+)(?!\w)")
_CARET_EXPONENT: Final = re.compile(r"(?<=\w)\^(-?\d)(?!\.?\d)")
#: The unit ug (micro-g).
_MICRO_G: Final = re.compile(r"(?<![\w.])ug(?!\w|\.\w)")
#: Minus signs of numbers, but not hyphens in words, names and dates.
_MINUS_SIGN: Final = re.compile(r"(?<![^\s(\[=±×])-(?=\.?\d)|(?<= )-(?= \d)")
_MULTIPLICATION_SIGN: Final = re.compile(r"(?<=[\d)]) x (?=10[⁻⁰-⁹¹²³])")


def typeset(text: str) -> str:
    """Return a text with typeset powers of ten, exponents and micro signs.

    Other text is unchanged.
    """
    text = _POWER_OF_TEN.sub(lambda match: f"10{_to_superscript(match[1])}", text)
    text = _SCIENTIFIC_NUMBER.sub(lambda match: f"{match[1]} × 10{_to_superscript(match[2])}", text)
    text = _CARET_EXPONENT.sub(lambda match: match[1].translate(SUPERSCRIPTS), text)
    return _MINUS_SIGN.sub("−", _MULTIPLICATION_SIGN.sub(" × ", _MICRO_G.sub("µg", text)))


def set_indices(text: str, format_symbol: Callable[[str, str], str], symbol: str = SYMBOL) -> str:
    """Return prose with symbols formatted by a renderer.

    format_symbol: Returns a symbol, given its letter and its index.
    """

    def replace_symbol(match: re.Match[str]) -> str:
        return format_symbol(_GREEK_LETTERS.get(match[1], match[1]), match[2].replace("_", ","))

    return re.sub(rf"(?<![\w.]){symbol}", replace_symbol, text)


def _to_superscript(exponent: str) -> str:
    """Return an exponent in superscript; Python writes ``e-09`` and ``e+12``."""
    sign = "-" if exponent.startswith("-") else ""
    return f"{sign}{exponent.lstrip('+-0') or '0'}".translate(SUPERSCRIPTS)


def _typeset_cell(cell: str) -> str:
    return (
        MultilineText(*typeset(cell).split("\n"))
        if isinstance(cell, MultilineText)
        else typeset(cell)
    )


def _typeset_card(card: Card) -> Card:
    return replace(
        card,
        value=typeset(card.value),
        unit=typeset(card.unit),
        remarks=tuple(map(typeset, card.remarks)),
        shares=tuple(replace(share, label=typeset(share.label)) for share in card.shares),
        note=typeset(card.note),
        checks=tuple(replace(check, text=typeset(check.text)) for check in card.checks),
        paragraphs=tuple(replace(p, text=typeset(p.text)) for p in card.paragraphs),
    )


def typeset_block(block: Block) -> Block:
    """Return a block with all text typeset, except commands."""
    match block:
        case Heading():
            return replace(block, text=typeset(block.text))
        case Paragraph():
            return block if block.style == "command" else replace(block, text=typeset(block.text))
        case Table():
            return replace(
                block,
                columns=tuple(
                    replace(column, title=typeset(column.title)) for column in block.columns
                ),
                rows=tuple(tuple(map(_typeset_cell, row)) for row in block.rows),
            )
        case Card():
            return _typeset_card(block)
    return _typeset_picture(block)


def _typeset_picture(picture: Picture) -> Picture:
    titled_picture = replace(picture, title=typeset(picture.title))
    match titled_picture:
        case Plot():
            return replace(
                titled_picture,
                x_label=typeset(titled_picture.x_label),
                y_label=typeset(titled_picture.y_label),
                series=tuple(
                    replace(series, label=typeset(series.label)) for series in titled_picture.series
                ),
            )
        case Bars():
            texts = tuple(map(typeset, titled_picture.texts))
            return replace(titled_picture, texts=texts, x_label=typeset(titled_picture.x_label))
        case Sphere():
            return replace(titled_picture, value_label=typeset(titled_picture.value_label))
    return titled_picture
