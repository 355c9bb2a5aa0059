"""Reports as GitHub-flavoured Markdown, for issues, wikis and plain text.

Pictures are omitted; their numbers are in the tables. Every character with a meaning in Markdown is
escaped (CommonMark 0.31, section 2.4).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Final

from counterspin.characters import escape_controls
from counterspin.reports.blocks import (
    ANSWER_STYLES,
    Block,
    Column,
    Heading,
    Paragraph,
    Table,
    text_blocks,
)

#: Characters that are markup anywhere; $ begins a formula on GitHub.
_SPECIAL: Final = re.compile(r"[\\`*_\[\]<>|~&$#]")

#: Markup at the beginning of a line: lists, underlined headings, rules.
_SPECIAL_AT_START: Final = re.compile(r"^(?:[-+=](?=[-+=\s]|$)|\d{1,9}(?=[.)](?:\s|$)))")


def markdown(blocks: Sequence[Block]) -> str:
    """Return blocks as GitHub-flavoured Markdown, without pictures."""
    parts = []
    for style, group in groupby(text_blocks(blocks), _quote_style):
        if style is None:
            parts += [_format_block(block) for block in group]
        else:
            parts.append(_quote(style, [b.text for b in group if isinstance(b, Paragraph)]))
    return "\n\n".join(filter(None, parts)) + "\n"


def escape_markdown(text: str, line_break: str = "\\\n") -> str:
    """Return text with Markdown characters escaped."""
    lines = (" ".join(line.split()) for line in escape_controls(text).splitlines())
    return line_break.join(_escape_line(line) for line in lines if line)


def _escape_line(line: str) -> str:
    start = _SPECIAL_AT_START.match(line)
    line = _SPECIAL.sub(r"\\\g<0>", line)
    if start is None:
        return line
    # The mark of a list follows its number.
    place = start.end() if start[0][0].isdigit() else 0
    return f"{line[:place]}\\{line[place:]}"


def _format_block(block: Heading | Paragraph | Table) -> str:
    match block:
        case Heading(text, level):
            return f"{'#' * level} {escape_markdown(text, ' ')}"
        case Paragraph(text, "equation"):
            return _code_block(text, "text")
        case Paragraph(text, "command"):
            return _code_block(text, "sh")
        case Paragraph(text, _):
            return escape_markdown(text)
    return "\n".join(_table(block))


def _quote_style(block: Block) -> str | None:
    """Return the style of a block quote, or None."""
    apart = isinstance(block, Paragraph) and block.style in {
        *ANSWER_STYLES,
        "undetermined",
        "warning",
    }
    return block.style if apart and isinstance(block, Paragraph) else None


def _quote(style: str, texts: Sequence[str]) -> str:
    lines = ["[!WARNING]"] if style in ("undetermined", "warning") else []
    for number, text in enumerate(texts):
        said = escape_markdown(text)
        lines += [""] if number else []
        lines += (f"**{said}**" if style in ANSWER_STYLES else said).split("\n")
    return "\n".join(f"> {line}".rstrip() for line in lines)


def _code_block(text: str, language: str) -> str:
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
