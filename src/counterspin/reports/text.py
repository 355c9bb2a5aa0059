"""Results and progress in the terminal.

Numbers are never broken: columns of words wrap first, then titles. If the terminal is still too
narrow, the columns are printed in several tables below each other.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, TextIO

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.table import Table as RichTable
from rich.text import Text

from counterspin.characters import substitute_unencodable
from counterspin.reports.blocks import (
    TERMINAL_ROWS,
    Block,
    Heading,
    Paragraph,
    Style,
    Table,
    text_blocks,
)
from counterspin.reports.typography import typeset_block

if TYPE_CHECKING:
    from rich.progress import Progress


#: Delay before progress is shown, s.
QUIET_SECONDS: Final = 1.0


def _is_terminal() -> bool:
    # None: the parent process closed it.
    return sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def progress(
    console: Console | None = None,
    *,
    patience: float = QUIET_SECONDS,
    words: tuple[str, str, str] = ("Reading runs", "Reading runs", "Estimating"),
) -> Iterator[Callable[[int, int], None] | None]:
    """Show the progress of work on standard error, and erase it at the end.

    console: Console for the progress bar; None: standard error.
    """
    if console is None and not _is_terminal():
        yield None
        return
    bar = _ProgressBar(console, words)
    # A short calibration ends before the timer, so nothing is shown or loaded.
    timer = threading.Timer(patience, bar.show)
    timer.daemon = True
    timer.start()
    try:
        yield bar.advance
    finally:
        timer.cancel()
        timer.join()
        bar.close()


class _ProgressBar:
    def __init__(self, console: Console | None, words: tuple[str, str, str]) -> None:
        self.console = console
        self.before, self.while_counting, self.after = words
        self.reached = (0, 0)
        self.shown: Progress | None = None

    def show(self) -> None:
        from rich import progress as rich
        from rich.console import Console

        bar = rich.Progress(
            rich.TextColumn("{task.description}"),
            rich.BarColumn(),
            rich.MofNCompleteColumn(),
            rich.TimeElapsedColumn(),
            console=self.console or Console(stderr=True),
            transient=True,
        )
        bar.add_task(self.before, total=None)
        bar.start()
        self.shown = bar
        self.advance(*self.reached)

    def advance(self, done: int, total: int) -> None:
        self.reached = (done, total)
        if self.shown is not None:
            (task,) = self.shown.task_ids
            text = self.while_counting if total else self.before
            text = self.after if 0 < total == done else text
            self.shown.update(task, description=text, completed=done, total=total or None)

    def close(self) -> None:
        if self.shown is not None:
            self.shown.stop()


@contextmanager
def work_progress(what: str) -> Iterator[Callable[[int, int], None] | None]:
    """Show the amount done, the speed, and the remaining time, on standard error."""
    if not _is_terminal():
        yield None
        return
    from rich import progress as rich
    from rich.console import Console

    bar = rich.Progress(
        rich.TextColumn(what),
        rich.BarColumn(),
        rich.MofNCompleteColumn(),
        rich.TextColumn("{task.fields[rate]}"),
        rich.TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    with bar:
        task = bar.add_task(what, total=None, rate="")

        def advance(done: int, total: int) -> None:
            speed = bar.tasks[0].speed
            rate = f"{speed:.3g}/s" if speed else ""
            bar.update(task, completed=done, total=total, rate=rate)

        yield advance


#: Width of plain text without a terminal, in characters.
_PLAIN_WIDTH: Final = 100

#: Smallest plausible width; ``COLUMNS=0`` comes from scripts.
_MIN_WIDTH: Final = 10

#: Gap between columns, in characters.
_COLUMN_GAP: Final = 2

_STYLES: Final[dict[Style, str]] = {
    "plain": "",
    "answer": "bold green",
    "reserved": "bold yellow",
    "undetermined": "bold magenta",
    "warning": "yellow",
    "quiet": "dim",
    "equation": "italic",
    "command": "cyan",
}


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """Raise the error to the caller; rich would end the process."""
        raise BrokenPipeError


def report_console(file: TextIO | None = None) -> Console:
    """Return a console for reports.

    file: Output file; None: standard output.
    """
    made = _Console(file=file, highlight=False, emoji=False)
    if made.width < _MIN_WIDTH or (not made.is_terminal and "COLUMNS" not in os.environ):
        made.width = _PLAIN_WIDTH
    return made


class Report:
    """Blocks of a report as a rich renderable, in the width and encoding of its console.

    Pictures are omitted; their numbers are in the tables. Numbers and units are typeset on a
    terminal, and typable in piped output.
    """

    def __init__(self, blocks: list[Block]) -> None:
        self.blocks = text_blocks(blocks)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield each block; called by rich."""
        before: Block | None = None
        for plain in self.blocks:
            # Piped text stays typable, as in a campaign file.
            block = typeset_block(plain) if options.is_terminal else plain
            if before is not None and _needs_blank_line(before, block):
                yield ""
            match block:
                case Heading(text, _):
                    yield Text(substitute_unencodable(text, options.encoding), "bold")
                case Paragraph(text, style):
                    text = substitute_unencodable(text, options.encoding)
                    yield Text(text, _STYLES[style], overflow="fold")
                case Table():
                    yield from _tables(block, options)
            before = block


def _needs_blank_line(before: Block, block: Block) -> bool:
    if isinstance(block, Heading):
        return True
    return not isinstance(before, Heading) and isinstance(before, Table) | isinstance(block, Table)


def _tables(block: Table, options: ConsoleOptions) -> Iterator[RenderableType]:
    """Yield the table, split into several with repeated names if the columns do not fit.

    Numbers are broken only if a single column next to the names is too wide.
    """
    titles = [substitute_unencodable(column.title, options.encoding) for column in block.columns]
    shown, count = block.rows[:TERMINAL_ROWS], len(block.rows) + block.omitted
    rows = [[substitute_unencodable(cell, options.encoding) for cell in row] for row in shown]
    for number, (chosen, widths) in enumerate(
        _split_columns(block, [titles, *rows], options.max_width)
    ):
        table = RichTable(
            box=box.SIMPLE_HEAD,
            padding=(0, _COLUMN_GAP - 1, 0, 0),
            pad_edge=False,
            show_edge=False,
            header_style="bold",
        )
        for place, width in zip(chosen, widths, strict=True):
            justify = block.columns[place].align
            table.add_column(Text(titles[place]), justify=justify, width=width, overflow="fold")
        for index, row in enumerate(rows):
            style = _STYLES["quiet"] if index in block.quiet else None
            table.add_row(*(Text(row[place], overflow="fold") for place in chosen), style=style)
        if number:
            yield ""
        yield table
    if count > len(shown):
        yield Text(
            f"{count - len(shown)} of {count} rows are not shown. The JSON "
            "file and the HTML report contain all rows.",
            _STYLES["quiet"],
        )


def _split_columns(
    block: Table, rows: list[list[str]], available: int
) -> Iterator[tuple[list[int], Sequence[int | None]]]:
    """Yield the columns of each table that fits the terminal, and their widths."""
    wanted, whole, least = [], [], []
    for index, column in enumerate(block.columns):
        lines = [line for row in rows for line in row[index].split("\n")]
        words = max((len(word) for line in lines for word in line.split()), default=0)
        title = max(map(len, rows[0][index].split()), default=0)
        cells = max((len(line) for row in rows[1:] for line in row[index].split("\n")), default=0)
        wanted.append(max(map(len, lines)))
        # Right-aligned numbers stay on one line; only their title is wrapped.
        words = max(title, cells) if column.align == "right" else words
        wrapped = max(words, min(column.narrowest, wanted[-1]))
        whole.append(wrapped if column.wraps else wanted[-1])
        least.append(wrapped if column.wraps else max(title, cells))
    everything = list(range(len(block.columns)))
    for widths in (whole, least):
        if (spare := _spare_width(widths, everything, available)) >= 0:
            yield everything, _distribute_width(widths, wanted, everything, spare)
            return
    # A column without a title belongs to the previous name.
    names = 1
    while names < len(everything) and not rows[0][names]:
        names += 1
    chosen = everything[:names]
    for index in everything[names:]:
        if len(chosen) > names and _spare_width(least, [*chosen, index], available) < 0:
            yield (
                chosen,
                _distribute_width(least, wanted, chosen, _spare_width(least, chosen, available)),
            )
            chosen = everything[:names]
        chosen = [*chosen, index]
    yield chosen, _distribute_width(least, wanted, chosen, _spare_width(least, chosen, available))


def _spare_width(widths: Sequence[int], chosen: Sequence[int], available: int) -> int:
    return available - sum(widths[index] for index in chosen) - _COLUMN_GAP * (len(chosen) - 1)


def _distribute_width(
    least: Sequence[int], wanted: Sequence[int], chosen: Sequence[int], spare: int
) -> Sequence[int | None]:
    """Return the widths of columns; spare width goes to those that lack most."""
    if spare < 0:
        return [None] * len(chosen)
    widths = [least[index] for index in chosen]
    lacking = [wanted[index] - least[index] for index in chosen]
    while spare > 0 and any(lacking):
        neediest = lacking.index(max(lacking))
        widths[neediest] += 1
        lacking[neediest] -= 1
        spare -= 1
    return widths
