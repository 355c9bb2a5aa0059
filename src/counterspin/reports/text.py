"""A result in the terminal, or as plain text where it is piped.

Numbers are never cut: columns of words wrap first, and only where a terminal is too narrow for
the numbers themselves are these wrapped too.

- `Report`: blocks as rich prints them
- `report_console`: a console that is wide enough when its output is no terminal
"""

from __future__ import annotations

import os
from typing import Final, TextIO

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table as RichTable
from rich.text import Text

from counterspin.reports.blocks import Block, Heading, Paragraph, Style, Table, without_pictures
from counterspin.reports.typography import speakable, typeset_block, visible

#: Columns of plain text, where there is no terminal to ask.
_PLAIN_WIDTH: Final = 100

#: Characters between two columns.
_GAP: Final = 2

_STYLES: Final[dict[Style, str]] = {
    "plain": "",
    "answer": "bold green",
    "warning": "yellow",
    "quiet": "dim",
    "equation": "italic",
    "command": "cyan",
}


def report_console(file: TextIO | None = None, *, error: bool = False) -> Console:
    """Return a console for reports.

    Parameters
    ----------
    file
        Where it writes; None: standard output.
    error
        Standard error in place of standard output.

    Returns
    -------
    Console
        As wide as the terminal; 100 columns where there is none, unless ``COLUMNS`` says else.
    """
    made = Console(file=file, stderr=error, highlight=False, emoji=False)
    if not made.is_terminal and "COLUMNS" not in os.environ:
        made.width = _PLAIN_WIDTH
    return made


class Report:
    """Blocks of a report as rich prints them, in the width and characters of its console.

    Pictures are left out; what they show stands in the tables. On a terminal numbers and units are
    as in print; where the output is piped, as one can type them.
    """

    def __init__(self, blocks: list[Block]) -> None:
        self.blocks = without_pictures(blocks)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield each block; called by rich."""
        before: Block | None = None
        for plain in self.blocks:
            # Piped text stays as a campaign file would have it, and as one can type it.
            block = typeset_block(plain) if options.is_terminal else plain
            if before is not None and _stand_apart(before, block):
                yield ""
            match block:
                case Heading(text, _):
                    yield Text(_shown(text, options, lines=False), "bold")
                case Paragraph(text, style):
                    text = _shown(text, options, lines=False)
                    yield Text(text, _STYLES[style], overflow="fold")
                case Table():
                    yield _table(block, options)
            before = block


def _shown(text: str, options: ConsoleOptions, *, lines: bool = True) -> str:
    return speakable(visible(text, lines=lines), options.encoding)


def _stand_apart(before: Block, block: Block) -> bool:
    if isinstance(block, Heading):
        return True
    return not isinstance(before, Heading) and isinstance(before, Table) | isinstance(block, Table)


def _table(block: Table, options: ConsoleOptions) -> RichTable:
    rows = [
        [_shown(cell, options, lines=place > 0) for place, cell in enumerate(row)]
        for row in block.rows
    ]
    titles = [_shown(column.title, options, lines=False) for column in block.columns]
    widths = _widths(block, [titles, *rows], options.max_width)
    table = RichTable(
        box=box.SIMPLE_HEAD,
        padding=(0, _GAP - 1, 0, 0),
        pad_edge=False,
        show_edge=False,
        header_style="bold",
    )
    for index, (column, title) in enumerate(zip(block.columns, titles, strict=True)):
        width = None if widths is None else widths[index]
        table.add_column(Text(title), justify=column.align, width=width, overflow="fold")
    for index, row in enumerate(rows):
        style = _STYLES["quiet"] if index in block.quiet else None
        table.add_row(*(Text(cell, overflow="fold") for cell in row), style=style)
    return table


def _widths(block: Table, rows: list[list[str]], available: int) -> list[int] | None:
    """Return the columns' widths; None if they cannot hold every number and word in one piece."""
    widths, wanted = [], []
    for index, column in enumerate(block.columns):
        lines = [line for row in rows for line in row[index].split("\n")]
        wanted.append(max(map(len, lines)))
        words = [word for line in lines for word in line.split()]
        least = max(map(len, words), default=0)
        least = max(least, min(column.narrowest, wanted[-1])) if column.wraps else wanted[-1]
        widths.append(least)
    spare = available - sum(widths) - _GAP * (len(widths) - 1)
    if spare < 0:
        return None
    # Room goes, one by one, to the column of words that lacks most.
    while spare > 0 and widths != wanted:
        widths[max(range(len(widths)), key=lambda i: wanted[i] - widths[i])] += 1
        spare -= 1
    return widths
