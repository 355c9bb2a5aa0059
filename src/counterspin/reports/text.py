"""Results and progress in the terminal.

Numbers are never broken: text columns wrap first, then titles. If the terminal is still too narrow,
the columns are split into several tables.
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
    MAX_TERMINAL_ROWS,
    Block,
    Heading,
    Paragraph,
    Style,
    Table,
    remove_pictures,
)
from counterspin.reports.typography import typeset_block

if TYPE_CHECKING:
    from rich.progress import Progress


#: Delay before progress is shown, s.
PROGRESS_DELAY: Final = 1.0


def _is_terminal() -> bool:
    # None: the parent process closed it.
    return sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def show_progress(
    console: Console | None = None,
    *,
    delay: float = PROGRESS_DELAY,
    labels: tuple[str, str, str] = ("Reading runs", "Reading runs", "Estimating"),
) -> Iterator[Callable[[int, int], None] | None]:
    """Show a progress bar on standard error, and erase it at the end.

    console: Console for the progress bar; None: standard error.
    """
    if console is None and not _is_terminal():
        yield None
        return
    bar = _ProgressBar(console, labels)
    # A short calibration ends before the timer, so nothing is shown or loaded.
    timer = threading.Timer(delay, bar.show)
    timer.daemon = True
    timer.start()
    try:
        yield bar.advance
    finally:
        timer.cancel()
        timer.join()
        bar.close()


class _ProgressBar:
    def __init__(self, console: Console | None, labels: tuple[str, str, str]) -> None:
        self.console = console
        self.start_label, self.counting_label, self.end_label = labels
        self.latest = (0, 0)
        self.bar: Progress | None = None

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
        bar.add_task(self.start_label, total=None)
        bar.start()
        self.bar = bar
        self.advance(*self.latest)

    def advance(self, n_done: int, n_total: int) -> None:
        self.latest = (n_done, n_total)
        if self.bar is not None:
            (task,) = self.bar.task_ids
            text = self.counting_label if n_total else self.start_label
            text = self.end_label if 0 < n_total == n_done else text
            self.bar.update(task, description=text, completed=n_done, total=n_total or None)

    def close(self) -> None:
        if self.bar is not None:
            self.bar.stop()


@contextmanager
def show_work_progress(label: str) -> Iterator[Callable[[int, int], None] | None]:
    """Show progress, speed and remaining time on standard error."""
    if not _is_terminal():
        yield None
        return
    from rich import progress as rich
    from rich.console import Console

    bar = rich.Progress(
        rich.TextColumn(label),
        rich.BarColumn(),
        rich.MofNCompleteColumn(),
        rich.TextColumn("{task.fields[rate]}"),
        rich.TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    with bar:
        task = bar.add_task(label, total=None, rate="")

        def advance(n_done: int, n_total: int) -> None:
            speed = bar.tasks[0].speed
            rate = f"{speed:.3g}/s" if speed else ""
            bar.update(task, completed=n_done, total=n_total, rate=rate)

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


def make_console(file: TextIO | None = None) -> Console:
    """Return a console for reports.

    file: Output file; None: standard output.
    """
    console = _Console(file=file, highlight=False, emoji=False)
    if console.width < _MIN_WIDTH or (not console.is_terminal and "COLUMNS" not in os.environ):
        console.width = _PLAIN_WIDTH
    return console


class Report:
    """Blocks of a report as a rich renderable, in the width and encoding of its console.

    Pictures are omitted; their numbers are in the tables. Numbers and units are typeset on a
    terminal, and typable in piped output.
    """

    def __init__(self, blocks: list[Block]) -> None:
        self.blocks = remove_pictures(blocks)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield each block; called by rich."""
        previous_block: Block | None = None
        for original_block in self.blocks:
            # Piped text stays typable, as in a campaign file.
            block = typeset_block(original_block) if options.is_terminal else original_block
            if previous_block is not None and _needs_blank_line(previous_block, block):
                yield ""
            match block:
                case Heading(text, _):
                    yield Text(substitute_unencodable(text, options.encoding), "bold")
                case Paragraph(text, style):
                    text = substitute_unencodable(text, options.encoding)
                    yield Text(text, _STYLES[style], overflow="fold")
                case Table():
                    yield from _make_tables(block, options)
            previous_block = block


def _needs_blank_line(previous_block: Block, block: Block) -> bool:
    if isinstance(block, Heading):
        return True
    return not isinstance(previous_block, Heading) and isinstance(
        previous_block, Table
    ) | isinstance(block, Table)


def _make_tables(block: Table, options: ConsoleOptions) -> Iterator[RenderableType]:
    """Yield the table, or several tables with repeated row names if the columns do not fit.

    Numbers are broken only if a single column next to the names is too wide.
    """
    titles = [substitute_unencodable(column.title, options.encoding) for column in block.columns]
    shown_rows, n_rows = block.rows[:MAX_TERMINAL_ROWS], len(block.rows) + block.n_omitted
    rows = [[substitute_unencodable(cell, options.encoding) for cell in row] for row in shown_rows]
    for table_index, (column_indices, widths) in enumerate(
        _split_columns(block, [titles, *rows], options.max_width)
    ):
        table = RichTable(
            box=box.SIMPLE_HEAD,
            padding=(0, _COLUMN_GAP - 1, 0, 0),
            pad_edge=False,
            show_edge=False,
            header_style="bold",
        )
        for k, width in zip(column_indices, widths, strict=True):
            justify = block.columns[k].align
            table.add_column(Text(titles[k]), justify=justify, width=width, overflow="fold")
        for index, row in enumerate(rows):
            style = _STYLES["quiet"] if index in block.quiet_rows else None
            table.add_row(
                *(Text(row[column_index], overflow="fold") for column_index in column_indices),
                style=style,
            )
        if table_index:
            yield ""
        yield table
    if n_rows > len(shown_rows):
        yield Text(
            f"{n_rows - len(shown_rows)} of {n_rows} rows are not shown. The JSON "
            "file and the HTML report contain all rows.",
            _STYLES["quiet"],
        )


def _split_columns(
    block: Table, rows: list[list[str]], max_width: int
) -> Iterator[tuple[list[int], Sequence[int | None]]]:
    """Yield the columns of each table that fits the terminal, and their widths."""
    full_widths, wrapped_widths, min_widths = [], [], []
    for index, column in enumerate(block.columns):
        lines = [line for row in rows for line in row[index].split("\n")]
        word_width = max((len(word) for line in lines for word in line.split()), default=0)
        title_width = max(map(len, rows[0][index].split()), default=0)
        cell_width = max(
            (len(line) for row in rows[1:] for line in row[index].split("\n")), default=0
        )
        full_widths.append(max(map(len, lines)))
        # Right-aligned numbers stay on one line; only their title is wrapped.
        word_width = max(title_width, cell_width) if column.align == "right" else word_width
        wrapped_width = max(word_width, min(column.min_width, full_widths[-1]))
        wrapped_widths.append(wrapped_width if column.wraps else full_widths[-1])
        min_widths.append(wrapped_width if column.wraps else max(title_width, cell_width))
    all_indices = list(range(len(block.columns)))
    for widths in (wrapped_widths, min_widths):
        if (spare_width := _spare_width(widths, all_indices, max_width)) >= 0:
            yield all_indices, _distribute_width(widths, full_widths, all_indices, spare_width)
            return
    # A column without a title belongs to the previous name.
    n_name_columns = 1
    while n_name_columns < len(all_indices) and not rows[0][n_name_columns]:
        n_name_columns += 1
    indices = all_indices[:n_name_columns]
    for index in all_indices[n_name_columns:]:
        if (
            len(indices) > n_name_columns
            and _spare_width(min_widths, [*indices, index], max_width) < 0
        ):
            yield (
                indices,
                _distribute_width(
                    min_widths, full_widths, indices, _spare_width(min_widths, indices, max_width)
                ),
            )
            indices = all_indices[:n_name_columns]
        indices = [*indices, index]
    yield (
        indices,
        _distribute_width(
            min_widths, full_widths, indices, _spare_width(min_widths, indices, max_width)
        ),
    )


def _spare_width(widths: Sequence[int], indices: Sequence[int], max_width: int) -> int:
    return max_width - sum(widths[index] for index in indices) - _COLUMN_GAP * (len(indices) - 1)


def _distribute_width(
    min_widths: Sequence[int], full_widths: Sequence[int], indices: Sequence[int], spare_width: int
) -> Sequence[int | None]:
    """Return the widths of columns; spare width goes to those that lack most."""
    if spare_width < 0:
        return [None] * len(indices)
    widths = [min_widths[index] for index in indices]
    missing_widths = [full_widths[index] - min_widths[index] for index in indices]
    while spare_width > 0 and any(missing_widths):
        index_of_max = missing_widths.index(max(missing_widths))
        widths[index_of_max] += 1
        missing_widths[index_of_max] -= 1
        spare_width -= 1
    return widths
