"""What goes on while the page is used, each job in a process of its own.

A page that is loaded again finds its job; a process that is ended leaves no half result.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, Literal

from counterspin.application.processes import Progress, Worker, report_progress
from counterspin.calibration.options import Method
from counterspin.errors import CounterspinError

#: How many finished jobs are remembered.
_MAX_FINISHED_JOBS: Final = 50

#: Takes what a job's process has made, and may fail of it.
Then = Callable[[Any], None]

JobState = Literal["waiting", "running", "done", "failed", "stopped"]


@dataclass
class Job:
    """Work that takes longer than a moment."""

    number: int  #: By which it is known.
    campaign: str  #: The campaign's name in the folder.
    #: The result's name there, or the folder's that is filled; empty: it is only shown.
    output: str
    command: str  #: The same as a command.
    #: What it is.
    kind: Literal["calibration", "study", "simulation", "forecast", "plan", "fit"] = "calibration"
    state: JobState = "waiting"  #: Where it stands.
    progress: tuple[int, int] = (0, 0)  #: Runs or trials that are done, and all of them.
    error: str = ""  #: Why it failed.
    seconds: float = 0.0  #: How long it took, or has taken so far.
    stop: threading.Event = field(default_factory=threading.Event, repr=False)

    @property
    def aim(self) -> tuple[str, ...]:
        """What no two jobs may be at work on at once."""
        return (self.output,) if self.output else (self.kind, self.campaign)

    def shown(self) -> dict[str, Any]:
        """Return what the page is told."""
        return {key: value for key, value in vars(self).items() if key != "stop"}


class Jobs:
    """The jobs of one server; two at once would only take each other's time."""

    def __init__(self) -> None:
        self._jobs: dict[int, Job] = {}
        self._lock = threading.Lock()
        self._turn = threading.Lock()
        self._number = 0
        self._closed = False

    def all(self) -> list[Job]:
        """Return all that are known, the newest first."""
        with self._lock:
            return sorted(self._jobs.values(), key=lambda job: -job.number)

    def begin(
        self,
        make: Callable[[int], Job],
        work: Callable[..., None],
        *words: Any,
        then: Then = lambda _: None,
    ) -> Job:
        """Begin a job, or return the one that is at work on the same result already.

        then: Called here, in the server, with what the process has made; a CounterspinError is why
            the job failed. Of a job that is stopped nothing is made.
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
        """End a job; CounterspinError if there is none of that number."""
        with self._lock:
            if number not in self._jobs:
                raise CounterspinError(f"there is no job {number}")
            job = self._jobs[number]
        job.stop.set()
        return job

    def close(self) -> None:
        """End all jobs, and begin no more."""
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
