"""Long work in processes of its own, which report progress by a pipe.

A page that is loaded again finds its job; a process that is ended leaves no half result.
"""

from __future__ import annotations

import signal
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from counterspin.calibration.options import Method
from counterspin.errors import CounterspinError, CounterspinWarning
from counterspin.reports.numbers import field_unit
from counterspin.reports.typography import typeset, typeset_block
from counterspin.workers import SPAWNING

if TYPE_CHECKING:
    from counterspin.monitoring.result import WatchState


#: Takes how much is done, and how much there is.
Progress = Callable[[int, int], None]


class Worker:
    """A process with its own memory, which can be ended at any time."""

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
        """True while it is at work."""
        return self._process.is_alive()

    def hear(self, seconds: float = 0.0) -> tuple[Any, ...] | None:
        """Return its next report; None without a report within a time, s.

        The death of the process is reported as a failure.
        """
        try:
            told: tuple[Any, ...] | None = self._here.recv() if self._here.poll(seconds) else None
        except (EOFError, OSError):
            return "failed", "its process died; perhaps memory ran out"
        return told

    def end(self) -> None:
        """End it in any state."""
        self._process.terminate()
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
        self._here.close()


def report_progress(there: Connection, work: Callable[[Progress], Any]) -> None:
    """Run some work in its own process; report its progress and its end."""
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


#: How many finished jobs are remembered.
_MAX_FINISHED_JOBS: Final = 50

#: Takes what a job's process has made, and may fail of it.
Then = Callable[[Any], None]

JobState = Literal["waiting", "running", "done", "failed", "stopped"]


@dataclass
class Job:
    """Work in the background."""

    number: int  #: By which it is known.
    campaign: str  #: The campaign's name in the folder.
    #: The result's name there, or the folder's that is filled; empty: it is only shown.
    output: str
    command: str  #: The same as a command.
    #: What it is.
    kind: Literal["calibration", "study", "simulation", "forecast", "plan", "fit", "sample"] = (
        "calibration"
    )
    state: JobState = "waiting"  #: Where it stands.
    progress: tuple[int, int] = (0, 0)  #: Runs or trials that are done, and all of them.
    error: str = ""  #: Why it failed.
    seconds: float = 0.0  #: How long it took, or has taken so far.
    stop: threading.Event = field(default_factory=threading.Event, repr=False)

    @property
    def aim(self) -> tuple[str, ...]:
        """The object of the job; no two jobs with the same one run at once."""
        return (self.output,) if self.output else (self.kind, self.campaign)

    def shown(self) -> dict[str, Any]:
        """Return the state for the page."""
        return {key: value for key, value in vars(self).items() if key != "stop"}


class Jobs:
    """The jobs of one server; they run one after the other."""

    def __init__(self) -> None:
        self._jobs: dict[int, Job] = {}
        self._lock = threading.Lock()
        self._turn = threading.Lock()
        self._number = 0
        self._closed = False

    def all(self) -> list[Job]:
        """Return all known jobs, the newest first."""
        with self._lock:
            return sorted(self._jobs.values(), key=lambda job: -job.number)

    def begin(
        self,
        make: Callable[[int], Job],
        work: Callable[..., None],
        *words: Any,
        then: Then = lambda _: None,
    ) -> Job:
        """Start a job, or return the one that is at work on the same result already.

        then: Called in the server with the output of the process; a CounterspinError makes the job
            fail. It is not called for a job that is stopped.
        """
        with self._lock:
            if self._closed:
                raise CounterspinError("the server is ending")
            job = make(self._number + 1)
            for other in self._jobs.values():
                if other.state in ("waiting", "running") and other.aim == job.aim:
                    return other
            self._number += 1
            self._jobs[job.number] = job
            over = [n for n, j in self._jobs.items() if j.state not in ("waiting", "running")]
            for number in over[:-_MAX_FINISHED_JOBS]:
                del self._jobs[number]
        self._start(job, work, words, then)
        return job

    def _start(
        self, job: Job, work: Callable[..., None], words: tuple[Any, ...], then: Then
    ) -> None:
        threading.Thread(target=self._work, args=(job, work, words, then), daemon=True).start()

    def stop(self, number: int) -> Job:
        """End a job; CounterspinError if no job has the number."""
        with self._lock:
            if number not in self._jobs:
                raise CounterspinError(f"there is no job {number}")
            job = self._jobs[number]
        job.stop.set()
        return job

    def close(self) -> None:
        """End all jobs, and start no more."""
        with self._lock:
            self._closed = True
            running = list(self._jobs.values())
        for job in running:
            job.stop.set()
        with self._turn:
            pass  # whoever was at work has ended its process

    def _work(
        self, job: Job, work: Callable[..., None], words: tuple[Any, ...], then: Then
    ) -> None:
        with self._turn:
            if job.stop.is_set():
                job.state = "stopped"
                return
            job.state, begun = "running", time.monotonic()
            try:
                worker = Worker(work, *words)
            except CounterspinError as error:
                job.error, job.state = str(error), "failed"
                return
            try:
                while not job.stop.is_set() and job.state == "running":
                    if (told := worker.hear(0.05)) is not None:
                        self._hear(job, told, then)
                    job.seconds = time.monotonic() - begun
            finally:
                if job.stop.is_set() and job.state == "running":
                    job.state = "stopped"
                worker.end()

    @staticmethod
    def _hear(job: Job, told: tuple[Any, ...], then: Then) -> None:
        match told:
            case ("progress", done, total):
                job.progress = (done, total)
            case ("done", made):
                try:
                    then(made)
                except CounterspinError as error:
                    job.error, job.state = str(error), "failed"
                else:
                    job.state = "done"
            case (_, why):
                job.error, job.state = why, "failed"


def calibrate_into(
    there: Connection,
    campaign: Path,
    output: Path,
    method: Method,
    accept_misfit: str | None,
) -> None:
    """Calibrate a campaign and write its result."""

    def work(progress: Progress) -> None:
        from counterspin.calibration.calibrate import calibrate
        from counterspin.calibration.result import Result
        from counterspin.output import reserve

        reserve(output, Result.file_kind, overwrite=True)
        result = calibrate(campaign, method=method, accept_misfit=accept_misfit, progress=progress)
        result.write(output, overwrite=True)

    report_progress(there, work)


#: Seconds after which a process ends at whose words nobody looks any more.
UNSEEN_SECONDS: Final = 15.0

#: Most processes that are kept at once.
_MAX_FOLLOWED: Final = 4


@dataclass
class _View:
    worker: Worker
    asked: float = 0.0
    told: dict[str, Any] = field(default_factory=dict)


class LiveViews:
    """The processes that are kept."""

    def __init__(self) -> None:
        self._views: dict[tuple[Path, str], _View] = {}
        self._lock = threading.Lock()

    def look(self, campaign: Path, goal: str) -> dict[str, Any]:
        """Return the newest state of a campaign, which is followed from the first call on.

        goal: Such as ``K_II 1e-8 g/g^2``; empty: none.
        """
        nothing = {"html": "", "events": [], "complete": False, "reached": None}
        with self._lock:
            key = (campaign, goal)
            view = self._view(key)
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

    def _view(self, key: tuple[Path, str]) -> _View:
        """Return the process that follows a campaign with a goal; start it if there is none."""
        view = self._views.get(key)
        if view is None:
            if len(self._views) >= _MAX_FOLLOWED:
                raise CounterspinError("too many campaigns are followed at once")
            view = self._views[key] = _View(Worker(follow_into, *key))
            if len(self._views) == 1:
                threading.Thread(target=self._forget, daemon=True).start()
        view.asked = time.monotonic()
        return view

    def _forget(self) -> None:
        """End the views that no page requests any longer, until none is left."""
        while True:
            time.sleep(UNSEEN_SECONDS / 5.0)
            with self._lock:
                for key, view in list(self._views.items()):
                    if time.monotonic() - view.asked > UNSEEN_SECONDS:
                        self._views.pop(key).worker.end()
                if not self._views:
                    return

    def close(self) -> None:
        """End all processes."""
        with self._lock:
            for view in self._views.values():
                view.worker.end()
            self._views.clear()


def reached_uncertainties(state: WatchState) -> dict[str, Any]:
    """Return the recorded time in minutes, and the u of each coefficient by then."""
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
    """Follow a campaign's records, and report each new state."""

    def work(_: Progress) -> None:
        from counterspin.monitoring.watch import watch
        from counterspin.reports.html import html_fragment

        for state in watch(campaign, goals=[goal] if goal else []):
            # The page keeps a list of what happened, of which the state knows the newest.
            quiet = state.model_copy(update={"events": []})
            blocks = list(map(typeset_block, quiet.blocks()))
            told = {
                "events": state.events,
                "complete": state.complete,
                "reached": reached_uncertainties(state),
            }
            there.send(("told", {"html": html_fragment(blocks, title="Live"), **told}))

    report_progress(there, work)
