"""What goes on while the page is used, each job in a process of its own.

- `Jobs`: begins them, one at a time, and knows what becomes of them; `Job`: one of them
- `tell_of`: what a process does, told to the server
- `calibrate_into`: a calibration's

A page that is loaded again finds its job; a process that is ended leaves no half result.
"""

from __future__ import annotations

import signal
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, Literal

from counterspin.calibration.options import Method
from counterspin.errors import CounterspinError, CounterspinWarning
from counterspin.workers import SPAWNING

#: How many finished jobs are remembered.
_MAX_FINISHED_JOBS: Final = 50

#: Takes how much is done, and how much there is.
Progress = Callable[[int, int], None]

JobState = Literal["waiting", "running", "done", "failed", "stopped"]


@dataclass
class Job:
    """A calibration, a study or a simulation.

    Attributes
    ----------
    number
        By which it is known.
    campaign
        The campaign's name in the folder.
    output
        The result's name there, or the folder's that is filled.
    command
        The same as a command.
    kind
        What it is.
    state
        Where it stands.
    progress
        Runs or trials that are done, and all of them.
    error
        Why it failed.
    seconds
        How long it took, or has taken so far.
    """

    number: int
    campaign: str
    output: str
    command: str
    kind: Literal["calibration", "study", "simulation"] = "calibration"
    state: JobState = "waiting"
    progress: tuple[int, int] = (0, 0)
    error: str = ""
    seconds: float = 0.0
    stop: threading.Event = field(default_factory=threading.Event, repr=False)

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

    def begin(self, make: Callable[[int], Job], work: Callable[..., None], *words: Any) -> Job:
        """Begin a job, or return the one that is at work on the same result already.

        Parameters
        ----------
        make
            Makes the job of a number.
        work
            What its process calls, with the end of a pipe, as `tell_of` takes it, and `words`.
        words
            What its process is given.
        """
        with self._lock:
            if self._closed:
                raise CounterspinError("the server is ending")
            job = make(self._number + 1)
            for other in self._jobs.values():
                if other.state in ("waiting", "running") and other.output == job.output:
                    return other
            self._number += 1
            self._jobs[job.number] = job
            over = [n for n, j in self._jobs.items() if j.state not in ("waiting", "running")]
            for number in over[:-_MAX_FINISHED_JOBS]:
                del self._jobs[number]
        self._start(job, work, words)
        return job

    def _start(self, job: Job, work: Callable[..., None], words: tuple[Any, ...]) -> None:
        threading.Thread(target=self._work, args=(job, work, words), daemon=True).start()

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

    def _work(self, job: Job, work: Callable[..., None], words: tuple[Any, ...]) -> None:
        with self._turn:
            if job.stop.is_set():
                job.state = "stopped"
                return
            job.state, begun = "running", time.monotonic()
            here, there = SPAWNING.Pipe(duplex=False)
            process = SPAWNING.Process(target=work, args=(there, *words), daemon=True)
            try:
                process.start()
            except OSError as error:  # no memory, or too many processes
                job.error = f"the process that works on it cannot begin: {error.strerror}"
                job.state = "failed"
                here.close()
                return
            finally:
                there.close()
            try:
                while not job.stop.is_set() and job.state == "running":
                    if here.poll(0.05):
                        self._hear(job, here)
                    job.seconds = time.monotonic() - begun
            finally:
                if job.stop.is_set() and job.state == "running":
                    process.terminate()
                    job.state = "stopped"
                process.join(5.0)
                if process.is_alive():
                    process.kill()
                here.close()

    @staticmethod
    def _hear(job: Job, here: Connection) -> None:
        try:
            kind, *told = here.recv()
        except (EOFError, OSError):
            job.error = "the process that worked on it died; perhaps memory ran out"
            job.state = "failed"
            return
        if kind == "progress":
            job.progress = (told[0], told[1])
        elif kind == "done":
            job.state = "done"
        else:
            job.error, job.state = told[0], "failed"


def tell_of(there: Connection, work: Callable[[Progress], None]) -> None:
    """Do something in a process of its own, and tell how far it is and how it ended.

    Parameters
    ----------
    there
        Takes ``("progress", done, in all)``, then ``("done",)`` or ``("failed", why)``.
    work
        Is given what takes its progress.
    """
    # Ctrl-C in the terminal is for the server, which ends its jobs.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # What a result warns of stands in it.
    warnings.simplefilter("ignore", CounterspinWarning)
    try:
        work(lambda done, total: there.send(("progress", done, total)))
        there.send(("done",))
    except CounterspinError as error:
        there.send(("failed", str(error)))
    except Exception as error:
        there.send(("failed", f"internal error ({type(error).__name__}: {error})"))


def calibrate_into(
    there: Connection,
    campaign: Path,
    output: Path,
    method: Method,
    accept_misfit: str | None,
) -> None:
    """Calibrate a campaign and write its result.

    Parameters
    ----------
    there
        As of `tell_of`.
    campaign
        Its description.
    output
        Where the result is written; an earlier one is replaced, and nothing else.
    method, accept_misfit
        As for `counterspin.calibration.calibrate.calibrate`.
    """

    def work(progress: Progress) -> None:
        from counterspin.calibration.calibrate import calibrate
        from counterspin.calibration.result import Result
        from counterspin.output import reserve

        reserve(output, Result.file_kind, overwrite=True)
        result = calibrate(campaign, method=method, accept_misfit=accept_misfit, progress=progress)
        result.write(output, overwrite=True)

    tell_of(there, work)
