"""Processes that are kept for as long as somebody looks at what they tell."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from counterspin.application.processes import Progress, Worker, report_progress
from counterspin.errors import CounterspinError
from counterspin.input import FileIdentity
from counterspin.reports.numbers import field_unit
from counterspin.reports.typography import typeset, typeset_block

if TYPE_CHECKING:
    from counterspin.monitoring.result import WatchState

#: Seconds after which a process ends at whose words nobody looks any more.
UNSEEN_SECONDS: Final = 15.0

#: Most processes that are kept at once.
_MAX_FOLLOWED: Final = 4


#: How long an answer is waited for before it is said that the work goes on, s.
_PATIENCE: Final = 1.0


@dataclass
class _View:
    worker: Worker
    stamp: FileIdentity | None = None
    asked: float = 0.0
    told: dict[str, Any] = field(default_factory=dict)
    answers: dict[Hashable, Any] = field(default_factory=dict)


class LiveViews:
    """The processes that are kept."""

    def __init__(self) -> None:
        self._views: dict[tuple[Path, str], _View] = {}
        self._lock = threading.Lock()

    def look(self, campaign: Path, goal: str) -> dict[str, Any]:
        """Return the newest state of a campaign, which is followed from the first look on.

        goal: Such as ``K_II 1e-8 g/g^2``; empty: none.
        """
        nothing = {"html": "", "events": [], "complete": False, "reached": None}
        with self._lock:
            key = (campaign, goal)
            view = self._view(key, None, follow_into, campaign, goal)
            over = False
            while not over and (heard := view.worker.hear()) is not None:
                match heard:
                    case ("told", told):
                        view.told = told
                    case ("failed", why):
                        view.told, over = {"error": why}, True
                    case _:
                        over = True
            if over:
                self._views.pop(key).worker.end()
            return nothing | view.told

    def ask(self, file: Path, work: Callable[..., None], question: Hashable) -> Any:
        """Return a process's answer to a question about a file; None while it works on it.

        The process is begun with the first question, and kept for the next.
        """
        until = time.monotonic() + _PATIENCE
        while True:
            with self._lock:
                key = (file, work.__name__)
                view = self._view(key, FileIdentity.of(file), work, file)
                if question not in view.answers:
                    view.answers[question] = None
                    view.worker.ask(question)
                while (heard := view.worker.hear()) is not None:
                    match heard:
                        case ("told", asked, answer):
                            view.answers[asked] = answer
                        case (_, why):
                            self._views.pop(key).worker.end()
                            raise CounterspinError(why)
                if view.answers[question] is not None:
                    return view.answers.pop(question)
            if time.monotonic() > until:
                return None
            time.sleep(0.02)

    def end(self, file: Path) -> None:
        """End what is done about a file."""
        with self._lock:
            for key in [key for key in self._views if key[0] == file]:
                self._views.pop(key).worker.end()

    def _view(
        self,
        key: tuple[Path, str],
        stamp: FileIdentity | None,
        work: Callable[..., None],
        *words: Any,
    ) -> _View:
        """Return the process of a key; a new one if there is none, or the file has changed."""
        view = self._views.get(key)
        if view is not None and view.stamp != stamp:
            self._views.pop(key).worker.end()
            view = None
        if view is None:
            if len(self._views) >= _MAX_FOLLOWED:
                raise CounterspinError("too many campaigns and plans are open at once")
            view = self._views[key] = _View(Worker(work, *words), stamp)
            if len(self._views) == 1:
                threading.Thread(target=self._forget, daemon=True).start()
        view.asked = time.monotonic()
        return view

    def _forget(self) -> None:
        """End what nobody looks at, until nothing is left."""
        while True:
            time.sleep(UNSEEN_SECONDS / 5.0)
            with self._lock:
                for key, view in list(self._views.items()):
                    if time.monotonic() - view.asked > UNSEEN_SECONDS:
                        self._views.pop(key).worker.end()
                if not self._views:
                    return

    def close(self) -> None:
        """End all of them."""
        with self._lock:
            for view in self._views.values():
                view.worker.end()
            self._views.clear()


def reached(state: WatchState) -> dict[str, Any]:
    """Return how many minutes are recorded, and the u of each coefficient by then."""
    units = {c.name: field_unit(c.unit) for c in state.coefficients}
    return {
        "minutes": sum(run.seconds or 0.0 for run in state.runs) / 60.0,
        "u": [
            {
                "name": f"{c.name}, {typeset(units[c.name][0])}",
                "u": None if c.u is None else c.u * units[c.name][1],
            }
            for c in state.coefficients
        ],
    }


def follow_into(there: Connection, campaign: Path, goal: str) -> None:
    """Follow a campaign's records, and tell each new state."""

    def work(_: Progress) -> None:
        from counterspin.monitoring.watch import watch
        from counterspin.reports.html import part

        for state in watch(campaign, goals=[goal] if goal else []):
            # The page keeps a list of what happened, of which the state knows the newest.
            quiet = state.model_copy(update={"events": []})
            blocks = list(map(typeset_block, quiet.blocks()))
            told = {"events": state.events, "complete": state.complete, "reached": reached(state)}
            there.send(("told", {"html": part(blocks, title="Live"), **told}))

    report_progress(there, work)
