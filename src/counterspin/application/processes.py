"""Work that is done in a process of its own, which says over a pipe how far it is."""

from __future__ import annotations

import signal
import warnings
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from counterspin.errors import CounterspinError, CounterspinWarning
from counterspin.workers import SPAWNING

#: Takes how much is done, and how much there is.
Progress = Callable[[int, int], None]


class Worker:
    """A process at work, with a memory of its own, which can be ended at any time."""

    def __init__(self, work: Callable[..., None], *words: Any) -> None:
        self._here, there = SPAWNING.Pipe()
        self._process = SPAWNING.Process(target=work, args=(there, *words), daemon=True)
        try:
            self._process.start()
        except OSError as error:  # no memory, or too many processes
            self._here.close()
            raise CounterspinError(f"its process cannot be started: {error.strerror}") from error
        finally:
            there.close()

    @property
    def is_alive(self) -> bool:
        """Whether it is still at work."""
        return self._process.is_alive()

    def ask(self, question: Any) -> None:
        """Ask it something; one that is dead by now hears nothing."""
        with suppress(OSError):
            self._here.send(question)

    def hear(self, seconds: float = 0.0) -> tuple[Any, ...] | None:
        """Return what it reports next; None if it reports nothing in so many seconds.

        That it died is told as a failure.
        """
        try:
            told: tuple[Any, ...] | None = self._here.recv() if self._here.poll(seconds) else None
        except (EOFError, OSError):
            return "failed", "its process died; perhaps memory ran out"
        return told

    def end(self) -> None:
        """End it, whatever it does."""
        self._process.terminate()
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
        self._here.close()


def report_progress(there: Connection, work: Callable[[Progress], Any]) -> None:
    """Do something in a process of its own, and tell how far it is and how it ended."""
    # Ctrl-C in the terminal is for the server, which ends its processes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # What a result warns of stands in it.
    warnings.simplefilter("ignore", CounterspinWarning)
    # A server that is gone is told nothing.
    with suppress(BrokenPipeError, ConnectionError, EOFError):
        try:
            there.send(("done", work(lambda done, total: there.send(("progress", done, total)))))
        except (BrokenPipeError, ConnectionError, EOFError):
            raise
        except CounterspinError as error:
            there.send(("failed", str(error)))
        except Exception as error:
            there.send(("failed", f"internal error ({type(error).__name__}: {error})"))
