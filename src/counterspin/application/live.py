"""Runs judged while the centrifuge turns: one record at once, a campaign while its records grow.

- `LiveViews`: campaigns that are followed, each in a process of its own, as long as somebody looks
- `follow_into`: what that process does
"""

from __future__ import annotations

import signal
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Final

from counterspin.errors import CounterspinError
from counterspin.reports.html import part
from counterspin.reports.typography import typeset_block
from counterspin.workers import SPAWNING

#: Seconds after which a campaign that nobody looks at any more is followed no longer.
UNSEEN_SECONDS: Final = 15.0

#: Most campaigns that are followed at once.
_MAX_FOLLOWED: Final = 4


@dataclass
class _View:
    process: BaseProcess
    here: Connection
    asked: float
    told: dict[str, Any]


class LiveViews:
    """The campaigns that are followed."""

    def __init__(self) -> None:
        self._views: dict[tuple[Path, str], _View] = {}
        self._lock = threading.Lock()

    def look(self, campaign: Path, goal: str) -> dict[str, Any]:
        """Return the newest state of a campaign, which is followed from the first look on.

        Parameters
        ----------
        campaign
            Its description.
        goal
            Such as ``K_II 1e-8 g/g^2``; empty: none.

        Returns
        -------
        dict
            ``html``, ``events`` and ``complete``; or ``error``, and it is followed no longer.
        """
        with self._lock:
            view = self._views.get((campaign, goal))
            if view is None:
                if len(self._views) >= _MAX_FOLLOWED:
                    raise CounterspinError("too many campaigns are followed at once")
                view = self._views[campaign, goal] = _begun(campaign, goal)
                if len(self._views) == 1:
                    threading.Thread(target=self._forget, daemon=True).start()
            view.asked = time.monotonic()
            with suppress(EOFError, OSError):
                while view.here.poll():
                    view.told = view.here.recv()
            if not view.process.is_alive() and not view.told.get("complete"):
                view.told.setdefault("error", "the process that followed the records died")
            if "error" in view.told or view.told.get("complete"):
                _ended(self._views.pop((campaign, goal)))
            return view.told

    def _forget(self) -> None:
        """Stop following what nobody looks at, until nothing is followed."""
        while True:
            time.sleep(UNSEEN_SECONDS / 5.0)
            with self._lock:
                for key, view in list(self._views.items()):
                    if time.monotonic() - view.asked > UNSEEN_SECONDS:
                        _ended(self._views.pop(key))
                if not self._views:
                    return

    def close(self) -> None:
        """Stop following all of them."""
        with self._lock:
            for view in self._views.values():
                _ended(view)
            self._views.clear()


def _begun(campaign: Path, goal: str) -> _View:
    here, there = SPAWNING.Pipe(duplex=False)
    process = SPAWNING.Process(target=follow_into, args=(there, campaign, goal), daemon=True)
    process.start()
    there.close()
    return _View(process, here, time.monotonic(), {"html": "", "events": [], "complete": False})


def _ended(view: _View) -> None:
    view.process.terminate()
    view.process.join(5.0)
    view.here.close()


def follow_into(there: Connection, campaign: Path, goal: str) -> None:
    """Follow a campaign's records, and tell each new state.

    Parameters
    ----------
    there
        Takes what `LiveViews.look` returns.
    campaign, goal
        As there.
    """
    # Ctrl-C in the terminal is for the server.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    from counterspin.monitoring.page import render_watch
    from counterspin.monitoring.watch import watch

    try:
        for state in watch(campaign, goals=[goal] if goal else []):
            blocks = list(map(typeset_block, render_watch(state).blocks))
            html = part(blocks, title="Live")
            there.send({"html": html, "events": state.events, "complete": state.complete})
    except CounterspinError as error:
        there.send({"error": str(error)})
    except (BrokenPipeError, ConnectionError):
        return
    except Exception as error:
        there.send({"error": f"internal error ({type(error).__name__}: {error})"})
