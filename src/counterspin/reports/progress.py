"""A sign of life on the terminal while work goes on; nothing where there is no terminal."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

#: Seconds of work before anything is shown.
QUIET_SECONDS: Final = 1.0


def _is_watched() -> bool:
    # None: whoever started the program closed it.
    return sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def progress(
    console: Console | None = None,
    *,
    patience: float = QUIET_SECONDS,
    words: tuple[str, str, str] = ("Reading runs", "Reading runs", "Estimating"),
) -> Iterator[Callable[[int, int], None] | None]:
    """Show how much is done, on standard error, and wipe it out at the end.

    console: Where to show it; None: standard error.
    """
    if console is None and not _is_watched():
        yield None
        return
    bar = _Bar(console, words)
    # A short calibration ends before the timer, and neither shows nor loads anything.
    timer = threading.Timer(patience, bar.show)
    timer.daemon = True
    timer.start()
    try:
        yield bar.advance
    finally:
        timer.cancel()
        timer.join()
        bar.close()


class _Bar:
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
    """Show how much is done, how much a second, and the time left, on standard error."""
    if not _is_watched():
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
