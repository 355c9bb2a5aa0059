"""What a report is made of: plain blocks of words and cells, however they are set.

- `Block`: `Heading`, `Paragraph` or `Table` of `Column` and rows
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Style = Literal["plain", "answer", "warning", "quiet"]


@dataclass(frozen=True)
class Heading:
    """A heading."""

    text: str


@dataclass(frozen=True)
class Paragraph:
    """A paragraph and what kind of thing it says."""

    text: str
    style: Style = "plain"


@dataclass(frozen=True)
class Column:
    """A column: numbers are kept in one piece, words may be wrapped."""

    title: str
    align: Literal["left", "right"] = "left"
    wraps: bool = False


@dataclass(frozen=True)
class Table:
    """A table; rows whose index is in `quiet` hold nothing that the data determined."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    quiet: frozenset[int] = frozenset()


Block = Heading | Paragraph | Table
