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
    VALUE_STYLES,
    Block,
    Column,
    Heading,
    Paragraph,
    Table,
    remove_pictures,
)

#: Characters that are markup anywhere; $ begins a formula on GitHub.
_MARKUP_CHARACTER: Final = re.compile(r"[\\`*_\[\]<>|~&$#]")

#: Markup at the beginning of a line: lists, underlined headings, rules.
_MARKUP_AT_START: Final = re.compile(r"^(?:[-+=](?=[-+=\s]|$)|\d{1,9}(?=[.)](?:\s|$)))")


def render_markdown(blocks: Sequence[Block]) -> str:
    """Return blocks as GitHub-flavoured Markdown, without pictures."""
    paragraphs = []
    for style, group in groupby(remove_pictures(blocks), _quote_style):
        if style is None:
            paragraphs += [_format_block(block) for block in group]
        else:
            paragraphs.append(
                _format_quote(
                    style, [block.text for block in group if isinstance(block, Paragraph)]
                )
            )
    return "\n\n".join(filter(None, paragraphs)) + "\n"


def escape_markdown(text: str, line_break: str = "\\\n") -> str:
    """Return text with Markdown characters escaped."""
    lines = (" ".join(line.split()) for line in escape_controls(text).splitlines())
    return line_break.join(_escape_line(line) for line in lines if line)


def _escape_line(line: str) -> str:
    match = _MARKUP_AT_START.match(line)
    line = _MARKUP_CHARACTER.sub(r"\\\g<0>", line)
    if match is None:
        return line
    # The mark of a list follows its number.
    position = match.end() if match[0][0].isdigit() else 0
    return f"{line[:position]}\\{line[position:]}"


def _format_block(block: Heading | Paragraph | Table) -> str:
    match block:
        case Heading(text, level):
            return f"{'#' * level} {escape_markdown(text, ' ')}"
        case Paragraph(text, "equation"):
            return _format_code(text, "text")
        case Paragraph(text, "command"):
            return _format_code(text, "sh")
        case Paragraph(text, _):
            return escape_markdown(text)
    return "\n".join(_format_table(block))


def _quote_style(block: Block) -> str | None:
    """Return the style of a block quote, or None."""
    if isinstance(block, Paragraph) and block.style in {*VALUE_STYLES, "undetermined", "warning"}:
        return block.style
    return None


def _format_quote(style: str, texts: Sequence[str]) -> str:
    lines = ["[!WARNING]"] if style in ("undetermined", "warning") else []
    for index, text in enumerate(texts):
        escaped_text = escape_markdown(text)
        lines += [""] if index else []
        lines += (f"**{escaped_text}**" if style in VALUE_STYLES else escaped_text).split("\n")
    return "\n".join(f"> {line}".rstrip() for line in lines)


def _format_code(text: str, language: str) -> str:
    max_backticks = max((len(backticks) for backticks in re.findall("`+", text)), default=0)
    fence = "`" * max(3, max_backticks + 1)
    return f"{fence}{language}\n{text}\n{fence}"


def _format_table(table: Table) -> Iterator[str]:
    titles = [escape_markdown(column.title, " ") for column in table.columns]
    rows = [[escape_markdown(cell, "<br>") for cell in row] for row in table.rows]
    widths = [max(3, *map(len, cells)) for cells in zip(titles, *rows, strict=True)]
    separators = [
        "-" * (width - 1) + ":" if column.align == "right" else "-" * width
        for column, width in zip(table.columns, widths, strict=True)
    ]
    for cells in (titles, separators, *rows):
        yield _format_row(table.columns, cells, widths)


def _format_row(columns: Sequence[Column], cells: Sequence[str], widths: Sequence[int]) -> str:
    padded_cells = (
        cell.rjust(width) if column.align == "right" else cell.ljust(width)
        for column, cell, width in zip(columns, cells, widths, strict=True)
    )
    return f"| {' | '.join(padded_cells)} |"
