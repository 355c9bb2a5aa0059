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
from typing import TYPE_CHECKING, Any, Final, cast

from counterspin.application.answers import JobEntry, JobKind, JobState, LiveState, Reached
from counterspin.application.served_folder import RequestError
from counterspin.calibration.options import Method
from counterspin.errors import CounterspinError, CounterspinWarning
from counterspin.reports.numbers import find_display_unit
from counterspin.reports.typography import typeset, typeset_block
from counterspin.workers import SPAWN_CONTEXT

if TYPE_CHECKING:
    from counterspin.monitoring.result import WatchState


#: Takes how much is done, and how much there is.
Progress = Callable[[int, int], None]


class Worker:
    """A process with its own memory, which can be ended at any time."""

    def __init__(self, function: Callable[..., None], *arguments: Any) -> None:
        self._connection, connection = SPAWN_CONTEXT.Pipe()
        self._process = SPAWN_CONTEXT.Process(
            target=function, args=(connection, *arguments), daemon=True
        )
        try:
            self._process.start()
        except OSError as error:  # no memory, or too many processes
            self._connection.close()
            raise CounterspinError(
                f"the process cannot be started ({error.strerror})", code="worker-failed"
            ) from error
        finally:
            connection.close()

    @property
    def is_alive(self) -> bool:
        """True while it is at work."""
        return self._process.is_alive()

    def receive(self, seconds: float = 0.0) -> tuple[Any, ...] | None:
        """Return its next report; None without a report within a time, s.

        The death of the process is reported as a failure.
        """
        try:
            message: tuple[Any, ...] | None = (
                self._connection.recv() if self._connection.poll(seconds) else None
            )
        except (EOFError, OSError):
            return (
                "failed",
                "the process ended unexpectedly, possibly because it ran out of memory",
            )
        return message

    def terminate(self) -> None:
        """End it in any state."""
        self._process.terminate()
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
        self._connection.close()


def report_progress(connection: Connection, function: Callable[[Progress], Any]) -> None:
    """Run some work in its own process; report its progress and its end."""
    # Ctrl-C in the terminal is for the server, which ends its processes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # What a result warns of stands in it.
    warnings.simplefilter("ignore", CounterspinWarning)
    # A server that is gone is told nothing.
    with suppress(BrokenPipeError, ConnectionError, EOFError):
        try:
            connection.send(
                ("done", function(lambda done, total: connection.send(("progress", done, total))))
            )
        except (BrokenPipeError, ConnectionError, EOFError):
            raise
        except CounterspinError as error:
            connection.send(("failed", str(error)))
        except Exception as error:
            connection.send(("failed", f"internal error ({type(error).__name__}: {error})"))


#: How many finished jobs are remembered.
_MAX_FINISHED_JOBS: Final = 50

#: Takes what a job's process has made, and may fail of it.
OnDone = Callable[[Any], None]


@dataclass
class Job:
    """Work in the background."""

    number: int  #: By which it is known.
    campaign: str  #: The campaign's name in the folder.
    #: The result's name there, or the folder's that is filled; empty: it is only shown.
    output: str
    command: str  #: Equivalent command.
    kind: JobKind = "calibration"  #: What it is.
    state: JobState = "waiting"  #: Where it stands.
    progress: tuple[int, int] = (0, 0)  #: Runs or trials that are done, and all of them.
    error: str = ""  #: Why it failed.
    seconds: float = 0.0  #: How long it took, or has taken so far.
    stop: threading.Event = field(default_factory=threading.Event, repr=False)

    @property
    def conflict_key(self) -> tuple[str, ...]:
        """The object of the job; no two jobs with the same one run at once."""
        return (self.output,) if self.output else (self.kind, self.campaign)

    def to_dict(self) -> JobEntry:
        """Return the state for the page."""
        return JobEntry(
            number=self.number,
            campaign=self.campaign,
            output=self.output,
            command=self.command,
            kind=self.kind,
            state=self.state,
            progress=self.progress,
            error=self.error,
            seconds=self.seconds,
        )


class Jobs:
    """The jobs of one server; they run one after the other."""

    def __init__(self) -> None:
        self._jobs: dict[int, Job] = {}
        self._lock = threading.Lock()
        self._run_lock = threading.Lock()
        self._number = 0
        self._closed = False

    def all(self) -> list[Job]:
        """Return all known jobs, the newest first."""
        with self._lock:
            return sorted(self._jobs.values(), key=lambda job: -job.number)

    def begin(
        self,
        make_job: Callable[[int], Job],
        function: Callable[..., None],
        *arguments: Any,
        on_done: OnDone = lambda _: None,
    ) -> Job:
        """Start a job, or return the one that is at work on the same result already.

        on_done: Called in the server with the output of the process; a CounterspinError makes the
            job fail. It is not called for a job that is stopped.
        """
        with self._lock:
            if self._closed:
                raise RequestError("the server is shutting down")
            job = make_job(self._number + 1)
            for active_job in self._jobs.values():
                if (
                    active_job.state in ("waiting", "running")
                    and active_job.conflict_key == job.conflict_key
                ):
                    return active_job
            self._number += 1
            self._jobs[job.number] = job
            finished = [n for n, j in self._jobs.items() if j.state not in ("waiting", "running")]
            for number in finished[:-_MAX_FINISHED_JOBS]:
                del self._jobs[number]
        self._start_thread(job, function, arguments, on_done)
        return job

    def _start_thread(
        self, job: Job, function: Callable[..., None], arguments: tuple[Any, ...], on_done: OnDone
    ) -> None:
        threading.Thread(
            target=self._run, args=(job, function, arguments, on_done), daemon=True
        ).start()

    def stop(self, number: int) -> Job:
        """End a job; CounterspinError if no job has the number."""
        with self._lock:
            if number not in self._jobs:
                raise RequestError(f"job {number} does not exist")
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
        with self._run_lock:
            pass  # whoever was at work has ended its process

    def _run(
        self, job: Job, function: Callable[..., None], arguments: tuple[Any, ...], on_done: OnDone
    ) -> None:
        with self._run_lock:
            if job.stop.is_set():
                job.state = "stopped"
                return
            job.state, start = "running", time.monotonic()
            try:
                worker = Worker(function, *arguments)
            except CounterspinError as error:
                job.error, job.state = str(error), "failed"
                return
            try:
                while not job.stop.is_set() and job.state == "running":
                    if (message := worker.receive(0.05)) is not None:
                        self._handle_message(job, message, on_done)
                    job.seconds = time.monotonic() - start
            finally:
                if job.stop.is_set() and job.state == "running":
                    job.state = "stopped"
                worker.terminate()

    @staticmethod
    def _handle_message(job: Job, message: tuple[Any, ...], on_done: OnDone) -> None:
        match message:
            case ("progress", done, total):
                job.progress = (done, total)
            case ("done", made):
                try:
                    on_done(made)
                except CounterspinError as error:
                    job.error, job.state = str(error), "failed"
                else:
                    job.state = "done"
            case (_, why):
                job.error, job.state = why, "failed"


def run_calibration(
    connection: Connection,
    campaign: Path,
    output: Path,
    method: Method,
    accept_misfit: str | None,
) -> None:
    """Calibrate a campaign and write its result."""

    def calibrate_and_write(progress: Progress) -> None:
        from counterspin.calibration.calibrate import calibrate
        from counterspin.calibration.result import Result
        from counterspin.output import check_writable

        check_writable(output, Result.file_type, overwrite=True)
        result = calibrate(campaign, method=method, accept_misfit=accept_misfit, progress=progress)
        result.write(output, overwrite=True)

    report_progress(connection, calibrate_and_write)


#: Seconds after which a process ends at whose words nobody looks any more.
VIEW_TIMEOUT: Final = 15.0

#: Most processes that are kept at once.
_MAX_VIEWS: Final = 4


@dataclass
class _View:
    worker: Worker
    requested_at: float = 0.0
    state: dict[str, Any] = field(default_factory=dict)


class LiveViews:
    """The processes that are kept."""

    def __init__(self) -> None:
        self._views: dict[tuple[Path, str], _View] = {}
        self._lock = threading.Lock()

    def poll(self, campaign: Path, goal: str) -> LiveState:
        """Return the newest state of a campaign, which is followed from the first call on.

        goal: Such as ``K_II 1e-8 g/g^2``; empty: none.
        """
        empty_state = {"html": "", "events": [], "complete": False, "reached": None}
        with self._lock:
            key = (campaign, goal)
            view = self._view(key)
            has_ended = False
            while not has_ended and (message := view.worker.receive()) is not None:
                match message:
                    case ("told", told):
                        view.state = told
                    case ("failed", why):
                        view.state, has_ended = {"error": why}, True
                    case _:
                        has_ended = True
            if has_ended:
                self._views.pop(key).worker.terminate()
            return cast("LiveState", empty_state | view.state)

    def _view(self, key: tuple[Path, str]) -> _View:
        """Return the process that follows a campaign with a goal; start it if there is none."""
        view = self._views.get(key)
        if view is None:
            if len(self._views) >= _MAX_VIEWS:
                raise RequestError(
                    "too many campaigns are being monitored at once; close another Live page"
                )
            view = self._views[key] = _View(Worker(run_watch, *key))
            if len(self._views) == 1:
                threading.Thread(target=self._end_unused, daemon=True).start()
        view.requested_at = time.monotonic()
        return view

    def _end_unused(self) -> None:
        """End the views that no page requests any longer, until none is left."""
        while True:
            time.sleep(VIEW_TIMEOUT / 5.0)
            with self._lock:
                for key, view in list(self._views.items()):
                    if time.monotonic() - view.requested_at > VIEW_TIMEOUT:
                        self._views.pop(key).worker.terminate()
                if not self._views:
                    return

    def close(self) -> None:
        """End all processes."""
        with self._lock:
            for view in self._views.values():
                view.worker.terminate()
            self._views.clear()


def current_uncertainties(state: WatchState) -> Reached:
    """Return the recorded time in minutes, and the u of each coefficient by then."""
    units = {c.name: find_display_unit(c.unit) for c in state.coefficients}
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


def run_watch(connection: Connection, campaign: Path, goal: str) -> None:
    """Follow a campaign's records, and report each new state."""

    def work(_: Progress) -> None:
        from counterspin.monitoring.watch import watch
        from counterspin.reports.html import render_fragment

        for state in watch(campaign, goals=[goal] if goal else []):
            # The page keeps a list of what happened, of which the state knows the newest.
            quiet_blocks = state.model_copy(update={"events": []})
            blocks = list(map(typeset_block, quiet_blocks.blocks()))
            message = {
                "events": state.events,
                "complete": state.complete,
                "reached": current_uncertainties(state),
            }
            connection.send(("told", {"html": render_fragment(blocks, title="Live"), **message}))

    report_progress(connection, work)
