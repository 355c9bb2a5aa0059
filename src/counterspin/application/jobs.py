"""Background jobs in separate processes, which report progress through a pipe.

A reloaded page finds its job; a terminated process leaves no partial result.
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

from counterspin.application.answers import (
    CurrentUncertainties,
    JobEntry,
    JobKind,
    JobState,
    LiveState,
)
from counterspin.application.served_folder import RequestError
from counterspin.calibration.options import Method
from counterspin.errors import CounterspinError, CounterspinWarning, describe_system_error
from counterspin.reports.numbers import find_display_unit
from counterspin.reports.typography import typeset, typeset_block
from counterspin.workers import SPAWN_CONTEXT

if TYPE_CHECKING:
    from counterspin.monitoring.result import WatchState


#: Called with the number of completed items and the total number.
ProgressCallback = Callable[[int, int], None]


class Worker:
    """A separate process that can be terminated at any time."""

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
        """True while the process is running."""
        return self._process.is_alive()

    def receive(self, timeout: float = 0.0) -> tuple[Any, ...] | None:
        """Return the next message of the process; None if there is none within the timeout, s.

        If the process has died, the message reports a failure.
        """
        try:
            message: tuple[Any, ...] | None = (
                self._connection.recv() if self._connection.poll(timeout) else None
            )
        except (EOFError, OSError):
            return (
                "failed",
                "the process ended unexpectedly, possibly because it ran out of memory",
            )
        return message

    def terminate(self) -> None:
        """Terminate the process in any state."""
        self._process.terminate()
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
        self._connection.close()


def report_progress(connection: Connection, function: Callable[[ProgressCallback], Any]) -> None:
    """Run a function in a worker process; report its progress and its result or error."""
    # Ctrl-C is handled by the server, which terminates its processes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Results contain their warnings.
    warnings.simplefilter("ignore", CounterspinWarning)
    # The server may have ended.
    with suppress(BrokenPipeError, ConnectionError, EOFError):
        try:
            connection.send(
                ("done", function(lambda done, total: connection.send(("progress", done, total))))
            )
        except (BrokenPipeError, ConnectionError, EOFError):
            raise
        except CounterspinError as error:
            connection.send(("failed", str(error)))
        except OSError as error:
            connection.send(("failed", describe_system_error(error)))
        except Exception as error:
            connection.send(("failed", f"internal error ({type(error).__name__}: {error})"))


#: Number of finished jobs that are kept.
_MAX_FINISHED_JOBS: Final = 50

#: Called with the result of a job's process.
DoneCallback = Callable[[Any], None]


@dataclass
class Job:
    """A background job."""

    number: int  #: Number of the job.
    campaign: str  #: Name of the campaign in the served folder.
    #: Name of the result file or output folder; empty: nothing is written.
    output: str
    command: str  #: Equivalent command.
    kind: JobKind = "calibration"
    state: JobState = "waiting"
    progress: tuple[int, int] = (0, 0)  #: Number of completed runs or trials, and total number.
    error: str = ""  #: Error message of a failed job.
    seconds: float = 0.0  #: Elapsed time, s.
    stop: threading.Event = field(default_factory=threading.Event, repr=False)

    @property
    def conflict_key(self) -> tuple[str, ...]:
        """Key of the output; jobs with the same key do not run at the same time."""
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
    """The jobs of a server, which run one after the other."""

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
        on_done: DoneCallback = lambda _: None,
    ) -> Job:
        """Start a job, or return the active job with the same output.

        on_done: Called in the server with the result of the process; a CounterspinError makes the
            job fail. Not called if the job is stopped.
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
            finished_numbers = [
                job_number
                for job_number, stored_job in self._jobs.items()
                if stored_job.state not in ("waiting", "running")
            ]
            for number in finished_numbers[:-_MAX_FINISHED_JOBS]:
                del self._jobs[number]
        self._start_thread(job, function, arguments, on_done)
        return job

    def _start_thread(
        self,
        job: Job,
        function: Callable[..., None],
        arguments: tuple[Any, ...],
        on_done: DoneCallback,
    ) -> None:
        threading.Thread(
            target=self._run, args=(job, function, arguments, on_done), daemon=True
        ).start()

    def stop(self, number: int) -> Job:
        """Stop a job; RequestError if no job has the number."""
        with self._lock:
            if number not in self._jobs:
                raise RequestError(f"job {number} does not exist")
            job = self._jobs[number]
        job.stop.set()
        return job

    def close(self) -> None:
        """Stop all jobs, and refuse new jobs."""
        with self._lock:
            self._closed = True
            jobs = list(self._jobs.values())
        for job in jobs:
            job.stop.set()
        with self._run_lock:
            pass  # the running job has terminated its process

    def _run(
        self,
        job: Job,
        function: Callable[..., None],
        arguments: tuple[Any, ...],
        on_done: DoneCallback,
    ) -> None:
        with self._run_lock:
            if job.stop.is_set():
                job.state = "stopped"
                return
            job.state, start_time = "running", time.monotonic()
            try:
                worker = Worker(function, *arguments)
            except CounterspinError as error:
                job.error, job.state = str(error), "failed"
                return
            try:
                while not job.stop.is_set() and job.state == "running":
                    if (message := worker.receive(0.05)) is not None:
                        self._handle_message(job, message, on_done)
                    job.seconds = time.monotonic() - start_time
            finally:
                if job.stop.is_set() and job.state == "running":
                    job.state = "stopped"
                worker.terminate()

    @staticmethod
    def _handle_message(job: Job, message: tuple[Any, ...], on_done: DoneCallback) -> None:
        match message:
            case ("progress", n_done, n_total):
                job.progress = (n_done, n_total)
            case ("done", output):
                try:
                    on_done(output)
                except CounterspinError as error:
                    job.error, job.state = str(error), "failed"
                else:
                    job.state = "done"
            case (_, reason):
                job.error, job.state = reason, "failed"


def run_calibration(
    connection: Connection, campaign: Path, output: Path, method: Method, accept_misfit: str | None
) -> None:
    """Calibrate a campaign and write its result."""

    def calibrate_and_write(progress: ProgressCallback) -> None:
        from counterspin.calibration.calibrate import calibrate
        from counterspin.calibration.result import Result
        from counterspin.output import check_writable

        check_writable(output, Result.file_kind, overwrite=True)
        result = calibrate(campaign, method=method, accept_misfit=accept_misfit, progress=progress)
        result.write(output, overwrite=True)

    report_progress(connection, calibrate_and_write)


#: Time after the last request at which a live view ends, s.
VIEW_TIMEOUT: Final = 15.0

#: Largest number of live views.
_MAX_VIEWS: Final = 4


@dataclass
class _View:
    worker: Worker
    requested_at: float = 0.0
    state: dict[str, Any] = field(default_factory=dict)


class LiveViews:
    """Processes that monitor campaigns for live pages."""

    def __init__(self) -> None:
        self._views: dict[tuple[Path, str], _View] = {}
        self._lock = threading.Lock()

    def poll(self, campaign: Path, goal: str) -> LiveState:
        """Return the newest state of a campaign, which is monitored from the first call on.

        goal: Goal such as ``K_II 1e-8 g/g^2``; empty: none.
        """
        empty_state = {"html": "", "events": [], "complete": False, "reached": None}
        with self._lock:
            view_key = (campaign, goal)
            view = self._get_view(view_key)
            has_ended = False
            while not has_ended and (message := view.worker.receive()) is not None:
                match message:
                    case ("told", new_state):
                        view.state = new_state
                    case ("failed", reason):
                        view.state, has_ended = {"error": reason}, True
                    case _:
                        has_ended = True
            if has_ended:
                self._views.pop(view_key).worker.terminate()
            return cast("LiveState", empty_state | view.state)

    def _get_view(self, key: tuple[Path, str]) -> _View:
        """Return the live view of a campaign with a goal; start it if there is none."""
        view = self._views.get(key)
        if view is None:
            if len(self._views) >= _MAX_VIEWS:
                raise RequestError(
                    "too many campaigns are being monitored at once; close one of the other Live "
                    "pages"
                )
            view = self._views[key] = _View(Worker(run_live_view, *key))
            if len(self._views) == 1:
                threading.Thread(target=self._end_unused, daemon=True).start()
        view.requested_at = time.monotonic()
        return view

    def _end_unused(self) -> None:
        """End views that pages no longer request, until none is left."""
        while True:
            time.sleep(VIEW_TIMEOUT / 5.0)
            with self._lock:
                for key, view in list(self._views.items()):
                    if time.monotonic() - view.requested_at > VIEW_TIMEOUT:
                        self._views.pop(key).worker.terminate()
                if not self._views:
                    return

    def close(self) -> None:
        """End all views."""
        with self._lock:
            for view in self._views.values():
                view.worker.terminate()
            self._views.clear()


def current_uncertainties(state: WatchState) -> CurrentUncertainties:
    """Return the recorded time in minutes, and the current u of each coefficient."""
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


def run_live_view(connection: Connection, campaign: Path, goal: str) -> None:
    """Monitor the records of a campaign, and send each new state."""

    def send_states(_: ProgressCallback) -> None:
        from counterspin.monitoring.watch import watch
        from counterspin.reports.html import render_fragment

        for state in watch(campaign, goals=[goal] if goal else []):
            # The page keeps its own list of events.
            state_without_events = state.model_copy(update={"events": []})
            blocks = list(map(typeset_block, state_without_events.blocks()))
            message = {
                "events": state.events,
                "complete": state.complete,
                "reached": current_uncertainties(state),
            }
            connection.send(("told", {"html": render_fragment(blocks, title="Live"), **message}))

    report_progress(connection, send_states)
