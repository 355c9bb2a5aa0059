"""The report as GitHub-flavoured Markdown: for issues, wikis and readers of plain text.

Pictures are left out; what they show stands in the tables. Words come out as they are: every
character that Markdown would read is escaped (CommonMark 0.31, section 2.4).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Final

from counterspin.characters import escape_controls
from counterspin.reports.blocks import (
    ANSWERS,
    Block,
    Column,
    Heading,
    Paragraph,
    Table,
    without_pictures,
)

#: Read as markup wherever they stand; $ begins a formula on GitHub.
_EVERYWHERE: Final = re.compile(r"[\\`*_\[\]<>|~&$#]")

#: Read as markup where a line begins: lists, underlined headings, rules.
_AT_START: Final = re.compile(r"^(?:[-+=](?=[-+=\s]|$)|\d{1,9}(?=[.)](?:\s|$)))")


def markdown(blocks: Sequence[Block]) -> str:
    """Return blocks as GitHub-flavoured Markdown, pictures left out."""
    parts = []
    for style, group in groupby(without_pictures(blocks), _quoted):
        if style is None:
            parts += [_set(block) for block in group]
        else:
            parts.append(_quote(style, [b.text for b in group if isinstance(b, Paragraph)]))
    return "\n\n".join(filter(None, parts)) + "\n"


def escape_markdown(text: str, line_break: str = "\\\n") -> str:
    """Return words as Markdown that shows them as they are."""
    lines = (" ".join(line.split()) for line in escape_controls(text).splitlines())
    return line_break.join(_escaped_line(line) for line in lines if line)


def _escaped_line(line: str) -> str:
    start = _AT_START.match(line)
    line = _EVERYWHERE.sub(r"\\\g<0>", line)
    if start is None:
        return line
    # The mark of a list follows its number.
    place = start.end() if start[0][0].isdigit() else 0
    return f"{line[:place]}\\{line[place:]}"


def _set(block: Heading | Paragraph | Table) -> str:
    match block:
        case Heading(text, level):
            return f"{'#' * level} {escape_markdown(text, ' ')}"
        case Paragraph(text, "equation"):
            return _fenced(text, "text")
        case Paragraph(text, "command"):
            return _fenced(text, "sh")
        case Paragraph(text, _):
            return escape_markdown(text)
    return "\n".join(_table(block))


def _quoted(block: Block) -> str | None:
    """Return the style of what is set apart by a bar at its side."""
    apart = isinstance(block, Paragraph) and block.style in {*ANSWERS, "undetermined", "warning"}
    return block.style if apart and isinstance(block, Paragraph) else None


def _quote(style: str, texts: Sequence[str]) -> str:
    lines = ["[!WARNING]"] if style in ("undetermined", "warning") else []
    for number, text in enumerate(texts):
        said = escape_markdown(text)
        lines += [""] if number else []
        lines += (f"**{said}**" if style in ANSWERS else said).split("\n")
    return "\n".join(f"> {line}".rstrip() for line in lines)


def _fenced(text: str, language: str) -> str:
    longest = max((len(ticks) for ticks in re.findall("`+", text)), default=0)
    fence = "`" * max(3, longest + 1)
    return f"{fence}{language}\n{text}\n{fence}"


def _table(table: Table) -> Iterator[str]:
    titles = [escape_markdown(column.title, " ") for column in table.columns]
    rows = [[escape_markdown(cell, "<br>") for cell in row] for row in table.rows]
    widths = [max(3, *map(len, cells)) for cells in zip(titles, *rows, strict=True)]
    rules = [
        "-" * (width - 1) + ":" if column.align == "right" else "-" * width
        for column, width in zip(table.columns, widths, strict=True)
    ]
    for cells in (titles, rules, *rows):
        yield _row(table.columns, cells, widths)


def _row(columns: Sequence[Column], cells: Sequence[str], widths: Sequence[int]) -> str:
    padded = (
        cell.rjust(width) if column.align == "right" else cell.ljust(width)
        for column, cell, width in zip(columns, cells, widths, strict=True)
    )
    return f"| {' | '.join(padded)} |"
