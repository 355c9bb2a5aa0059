"""The trials of a study, batch by batch, on one core, on many, or on a cluster.

Work is handed out in tasks of whole batches. What a batch gives depends on its number alone, so
that results are the same however the work is shared out. A task that is lost with its worker is
handed out again, and counts once.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from functools import lru_cache
from typing import Any, Final, Literal, Protocol

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import CounterspinError
from counterspin.frozen import frozen
from counterspin.inference.joint.unknowns import ROTATION, Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.physics.terms import ACCELEROMETER_TERMS
from counterspin.studies.draws import DRIFT, NOISE_STREAM, TRUTH_STREAM, Draws, StudyTruth, stream
from counterspin.studies.result import Driver, Tally
from counterspin.workers import ALONE, WorkerPool, Workers, worker_pool

#: What a trial costs: ``linear``; ``sampled`` where sigma is from the residuals, and with it the
#: second stage's weights; ``readings``; ``full``.
Cost = Literal["linear", "sampled", "readings", "full"]

#: Trials of a batch: they fit a cache, and take a fraction of a second with slow engines.
_BATCH: Final[dict[Cost, int]] = {
    "linear": 8192,
    "sampled": 8192,
    "readings": 64,
    "full": 8,
}


@frozen
class Trials:
    """The results of an analysis in n trials."""

    #: Of each coefficient, shape (c, n); u is the combined standard uncertainty.
    estimate: Array
    u: Array
    dof: Array  #: Its effective degrees of freedom, shape (c, n); infinite where noise is given.


class Engine(Protocol):
    """Makes the trials of one analysis."""

    def trials(self, draws: Draws, generator: np.random.Generator) -> Trials:
        """Return the results of the analysis for each draw of the true values, with new noise."""
        ...


@frozen
class JointRequest:
    """Options of the joint fit."""

    model: Unknowns  #: Unknowns, considered terms, uncertain inputs.
    noise: Mapping[str, Noise]  #: Accelerometer -> its noise, given or to be estimated.

    @property
    def reported(self) -> list[int]:
        """Places of the unknowns that a study reports: those asked for that the runs share."""
        return [
            place
            for place, unknown in enumerate(self.model.unknowns)
            if unknown.is_of_interest
            and not (unknown.has_default_prior and unknown.prior[1] >= unknown.limit)
            and (
                unknown.symbol in ACCELEROMETER_TERMS
                or (not unknown.owner and unknown.symbol not in ROTATION)
            )
        ]


@frozen
class ReportedCoefficient:
    """A coefficient of an analysis."""

    #: Names; the owner of a platform term is empty.
    analysis: str
    owner: str
    symbol: str
    #: The Cramer-Rao bound of its standard uncertainty; None where it cannot be had.
    bound: float | None

    @property
    def name(self) -> str:
        """Owner and symbol in one word."""
        return f"{self.owner}.{self.symbol}" if self.owner else self.symbol


@frozen
class EnginePart:
    """An engine and its reported coefficients, in the order of its rows."""

    engine: Engine  #: The engine.
    cost: Cost  #: What a trial of it costs.
    #: Which stream of noise it draws from. Analyses that share one see the same readings.
    noise: int
    words: str  #: What it is called.
    rows: tuple[int, ...]  #: Its own rows that are reported.
    reported: tuple[ReportedCoefficient, ...]  #: What they are.
    lost: tuple[str, ...] = ()  #: Coefficients that the records do not determine.


@frozen
class StudyEngine:
    """Everything that a worker needs."""

    truth: StudyTruth  #: What is true.
    seed: int  #: Of the study.
    parts: tuple[EnginePart, ...]  #: An engine for each analysis.
    tally: Tally  #: What is counted.

    @property
    def batch_size(self) -> int:
        """Trials in a batch."""
        return min(_BATCH[part.cost] for part in self.parts)

    @property
    def reported(self) -> tuple[ReportedCoefficient, ...]:
        """All that is reported, in the order of a batch's rows."""
        return tuple(coefficient for part in self.parts for coefficient in part.reported)

    def batch(self, number: int, trials: int, *, keep: bool = False) -> tuple[Array, Array | None]:
        """Do the trials of one batch.

        number: Of the batch, from 0.
        keep: Whether each trial is returned too.
        Returns: sums of each of c reported coefficients, shape (c, width); truth, estimate and u
            of each trial, shape (c, 3, n), or None.
        """
        draws = self.truth.draw(stream(self.seed, number, TRUTH_STREAM), self.batch_size)
        driven = [_driven(draws, driver)[:trials] for driver in self.tally.drivers]
        sums, values = [], []
        for part in self.parts:
            noise = stream(self.seed, number, NOISE_STREAM + part.noise)
            # Simulation without shortcut is slow: run only the trials that count.
            few = draws.part(0, trials) if part.cost in ("full", "readings") else draws
            answer = part.engine.trials(few, noise)
            for row, coefficient in zip(part.rows, part.reported, strict=True):
                truth = draws.mean(coefficient.owner, coefficient.symbol)[:trials]
                estimate = answer.estimate[row, :trials]
                u, dof = answer.u[row, :trials], answer.dof[row, :trials]
                sums.append(self.tally.count(estimate, truth, u, dof, driven))
                if keep:
                    values.append(np.stack([truth, estimate, np.broadcast_to(u, truth.shape)]))
        return np.array(sums), np.array(values) if keep else None


def _driven(draws: Draws, driver: Driver) -> Array:
    if driver.symbol == DRIFT:
        return np.broadcast_to(draws.drift.mean(axis=0), draws.trials)
    ripple = np.hypot(draws.ripple_cos, draws.ripple_sin).mean(axis=0)
    return np.broadcast_to(ripple, draws.trials)


#: Length of a task, s, and how many are handed out ahead for each worker.
_TASK_DURATION: Final = 0.3
_TASKS_AHEAD: Final = 3

#: Time between two copies of the ledger on disk, s.
_SAVE_INTERVAL: Final = 10.0

#: How often all workers may die in a row with nothing done between.
_MOST_LOSSES: Final = 5

#: Approximate work of whole records below which the duration is not reported, s.
_SHORT_SECONDS: Final = 60.0

#: What a trial takes, roughly, s.
_TRIAL_DURATIONS: Final[dict[Cost, float]] = {
    "linear": 2e-6,
    "sampled": 4e-6,
    "readings": 1e-2,
    "full": 0.1,
}


class Ledger:
    """The finished batches of a study and their results.

    keep: True: keep each trial.
    """

    def __init__(self, engine: StudyEngine, trials: int, *, keep: bool = False) -> None:
        self.trials, self.keep = trials, keep
        self.size, self.reported = engine.batch_size, engine.reported
        count = -(-trials // self.size)
        self.done = np.zeros(count, dtype=bool)
        self.sums = np.zeros((count, len(self.reported), engine.tally.width))
        self.values: dict[int, Array] = {}

    def trials_of(self, batch: int) -> int:
        """Return the number of trials of a batch that count."""
        return min(self.size, self.trials - batch * self.size)

    @property
    def trials_done(self) -> int:
        """Number of finished trials."""
        return sum(self.trials_of(int(batch)) for batch in np.flatnonzero(self.done))

    def enter(self, first: int, sums: Array, values: list[Array]) -> None:
        """Enter the results of a task from its first batch on; repeating this changes nothing."""
        for place, row in enumerate(sums):
            batch = first + place
            if self.done[batch]:
                continue
            self.sums[batch] = row
            if values:
                self.values[batch] = values[place]
            self.done[batch] = True


def expected_duration(engine: StudyEngine, trials: int) -> float:
    """Return the approximate duration of trials on a single worker, s.

    Trials by whole records differ widely: if they matter, one trial is timed.
    """
    seconds = 0.0
    for part in engine.parts:
        duration = _TRIAL_DURATIONS[part.cost]
        if part.cost == "full" and duration * trials > _SHORT_SECONDS:
            draws = engine.truth.draw(stream(engine.seed, 0, TRUTH_STREAM), 1)
            for _ in range(2):  # the first loads what it needs
                start = time.perf_counter()
                part.engine.trials(draws, stream(engine.seed, 0, NOISE_STREAM))
                duration = time.perf_counter() - start
        seconds += duration * trials
    return seconds


@lru_cache(maxsize=2)
def _unpack(engine: bytes) -> StudyEngine:
    made: StudyEngine = pickle.loads(engine)
    return made


def work(engine: bytes, first: int, trials: tuple[int, ...], keep: bool) -> tuple[Array, Any]:
    """Do a task: neighbouring batches, the numbers of whose trials are given."""
    study = _unpack(engine)
    batches = [study.batch(first + i, n, keep=keep) for i, n in enumerate(trials)]
    return np.array([sums for sums, _ in batches]), [values for _, values in batches if keep]


def run_batches(
    engine: StudyEngine,
    ledger: Ledger,
    *,
    workers: Workers = ALONE,
    pool: WorkerPool | None = None,
    progress: Callable[[int, int], None] | None = None,
    save: Callable[[], None] | None = None,
    batches_per_task: int | None = None,
) -> bool:
    """Do every batch that is not done yet.

    workers: How many processes, or which cluster's.
    pool: Workers that are there already; None: they are started. Should they die, others are
        started in their place.
    progress: Called with (trials done, trials in all).
    save: Called now and then and at the end, to keep a copy of the ledger.
    batches_per_task: How many batches are handed out at once; by default about a third of a
        second's work.
    """
    cost = sum(_TRIAL_DURATIONS[part.cost] for part in engine.parts) * engine.batch_size
    size = batches_per_task or max(1, min(64, round(_TASK_DURATION / cost)))
    packed = pickle.dumps(engine)
    try:
        note = _Notes(ledger, progress, save)
        if workers.alone:
            _alone(packed, ledger, size, note)
        else:
            _together(packed, ledger, size, pool, workers, note)
    except KeyboardInterrupt:
        pass
    finally:
        if save is not None:
            save()
    return bool(ledger.done.all())


def _tasks(ledger: Ledger, size: int) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Yield the first batch and the trials of each task that is left, batches in rows."""
    remaining = np.flatnonzero(np.logical_not(ledger.done))
    start = 0
    while start < remaining.size:
        stop = start + 1
        while (
            stop < min(remaining.size, start + size) and remaining[stop] == remaining[stop - 1] + 1
        ):
            stop += 1
        row = tuple(ledger.trials_of(int(batch)) for batch in remaining[start:stop])
        yield int(remaining[start]), row
        start = stop


def _alone(packed: bytes, ledger: Ledger, size: int, note: _Notes) -> None:
    for first, trials in list(_tasks(ledger, size)):
        ledger.enter(first, *work(packed, first, trials, ledger.keep))
        note(sum(trials))


class _Notes:
    """The progress reports of the work, and the updates of the copy on disk."""

    def __init__(
        self,
        ledger: Ledger,
        progress: Callable[[int, int], None] | None,
        save: Callable[[], None] | None,
    ) -> None:
        self.ledger, self.progress, self.save = ledger, progress, save
        self.reached, self.kept = ledger.trials_done, time.monotonic()
        self(0)

    def __call__(self, trials: int) -> None:
        self.reached += trials
        if self.progress is not None:
            self.progress(self.reached, self.ledger.trials)
        if self.save is not None and time.monotonic() - self.kept > _SAVE_INTERVAL:
            self.save()
            self.kept = time.monotonic()


def _together(
    packed: bytes,
    ledger: Ledger,
    size: int,
    pool: WorkerPool | None,
    workers: Workers,
    note: _Notes,
) -> None:
    losses = 0
    died: tuple[type[BaseException], ...] = (BrokenProcessPool,)
    while not ledger.done.all():
        before = int(ledger.done.sum())
        try:
            with nullcontext(pool) if pool else worker_pool(workers, __name__) as current:
                died = current.died
                _hand_out(current, packed, ledger, size, note)
        except died as error:
            # A worker was killed, or ran out of memory. What it had in hand is handed out again.
            pool = None
            losses = 0 if int(ledger.done.sum()) > before else losses + 1
            if losses >= _MOST_LOSSES:
                raise CounterspinError(
                    "the worker processes die at once; try fewer `workers`, "
                    "or check whether memory runs out"
                ) from error


def _hand_out(pool: WorkerPool, packed: bytes, ledger: Ledger, size: int, note: _Notes) -> None:
    # A snapshot: entries made meanwhile must not change the remaining tasks.
    waiting = iter(list(_tasks(ledger, size)))
    pending: dict[Future[tuple[Array, Any]], tuple[int, tuple[int, ...]]] = {}
    try:
        while True:
            ahead = _TASKS_AHEAD * pool.size
            while len(pending) < ahead and (task := next(waiting, None)) is not None:
                pending[pool.executor.submit(work, packed, *task, ledger.keep)] = task
            if not pending:
                return
            finished, _ = wait(pending, return_when=FIRST_COMPLETED)
            for future in finished:
                first, trials = pending.pop(future)
                ledger.enter(first, *future.result())
                note(sum(trials))
    finally:
        for future in pending:
            future.cancel()
