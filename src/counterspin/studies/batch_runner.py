"""Run the trials of a study in batches, on one core, on many cores or on a cluster.

A task consists of several batches. The result of a batch depends on its number alone, so that
results do not depend on the distribution of tasks. A task that is lost with its worker is
submitted again, and counts once.
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
from counterspin.studies.draws import (
    DRIFT,
    NOISE_STREAM,
    TRUTH_STREAM,
    Draws,
    StudyTruth,
    random_stream,
)
from counterspin.studies.result import BiasCovariate, TrialAccumulator
from counterspin.workers import SINGLE_PROCESS, WorkerPool, Workers, worker_pool

#: Cost of a trial: ``linear``; ``sampled`` where sigma is from the residuals, and with it the
#: second stage's weights; ``readings``; ``full``.
CostClass = Literal["linear", "sampled", "readings", "full"]

#: Trials of a batch: they fit a cache, and take a fraction of a second with slow engines.
_BATCH_SIZES: Final[dict[CostClass, int]] = {
    "linear": 8192,
    "sampled": 8192,
    "readings": 64,
    "full": 8,
}


@frozen
class TrialResults:
    """The results of an analysis in n trials."""

    #: Of each coefficient, shape (c, n); u is the combined standard uncertainty.
    estimate: Array
    u: Array
    dof: Array  #: Its effective degrees of freedom, shape (c, n); infinite where noise is given.


class TrialEngine(Protocol):
    """Interface of the engines that run the trials of one analysis."""

    def run_trials(self, draws: Draws, generator: np.random.Generator) -> TrialResults:
        """Return the results of the analysis for each draw of the true values, with new noise."""
        ...


@frozen
class JointRequest:
    """Options of the joint fit."""

    model: Unknowns  #: Unknowns, considered terms, uncertain inputs.
    noise: Mapping[str, Noise]  #: Accelerometer -> its noise, given or to be estimated.

    @property
    def reported_indices(self) -> list[int]:
        """Indices of the reported unknowns: the parameters of interest that the runs share."""
        return [
            index
            for index, unknown in enumerate(self.model.unknowns)
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
class AnalysisEngine:
    """An engine and its reported coefficients, in the order of its rows."""

    engine: TrialEngine  #: The engine.
    cost_class: CostClass  #: Cost of a trial.
    #: Index of the noise stream. Analyses with the same stream have the same readings.
    noise_stream: int
    description: str  #: Description in the result.
    rows: tuple[int, ...]  #: Reported rows of the engine's results.
    coefficients: tuple[ReportedCoefficient, ...]  #: The coefficient of each row.
    undetermined: tuple[str, ...] = ()  #: Coefficients that the records do not determine.


@frozen
class StudyEngine:
    """The true values, engines and sums of a study, as a worker needs them."""

    truth: StudyTruth  #: The true values.
    seed: int  #: Of the study.
    analysis_engines: tuple[AnalysisEngine, ...]  #: An engine for each analysis.
    accumulator: TrialAccumulator  #: The sums over the trials.

    @property
    def batch_size(self) -> int:
        """Trials in a batch."""
        return min(_BATCH_SIZES[part.cost_class] for part in self.analysis_engines)

    @property
    def coefficients(self) -> tuple[ReportedCoefficient, ...]:
        """Reported coefficients, in the order of a batch's rows."""
        return tuple(
            coefficient
            for analysis_engine in self.analysis_engines
            for coefficient in analysis_engine.coefficients
        )

    def run_batch(
        self, number: int, trials: int, *, keep: bool = False
    ) -> tuple[Array, Array | None]:
        """Run the trials of one batch.

        number: Index of the batch, from 0.
        keep: True: return each trial in addition.
        Returns: sums of each of c reported coefficients, shape (c, width); truth, estimate and u
            of each trial, shape (c, 3, n), or None.
        """
        draws = self.truth.draw(random_stream(self.seed, number, TRUTH_STREAM), self.batch_size)
        covariate_values = [
            _covariate_values(draws, covariate)[:trials]
            for covariate in self.accumulator.covariates
        ]
        sums, values = [], []
        for analysis_engine in self.analysis_engines:
            noise = random_stream(self.seed, number, NOISE_STREAM + analysis_engine.noise_stream)
            # Simulation without shortcut is slow: run only the trials that count.
            simulated_draws = (
                draws.slice_trials(0, trials)
                if analysis_engine.cost_class in ("full", "readings")
                else draws
            )
            results = analysis_engine.engine.run_trials(simulated_draws, noise)
            for row, coefficient in zip(
                analysis_engine.rows, analysis_engine.coefficients, strict=True
            ):
                truth = draws.mean(coefficient.owner, coefficient.symbol)[:trials]
                estimate = results.estimate[row, :trials]
                u, dof = results.u[row, :trials], results.dof[row, :trials]
                sums.append(self.accumulator.accumulate(estimate, truth, u, dof, covariate_values))
                if keep:
                    values.append(np.stack([truth, estimate, np.broadcast_to(u, truth.shape)]))
        return np.array(sums), np.array(values) if keep else None


def _covariate_values(draws: Draws, covariate: BiasCovariate) -> Array:
    if covariate.symbol == DRIFT:
        return np.broadcast_to(draws.drift.mean(axis=0), draws.trials)
    ripple = np.hypot(draws.ripple_cos, draws.ripple_sin).mean(axis=0)
    return np.broadcast_to(ripple, draws.trials)


#: Duration of a task, s, and number of tasks submitted in advance for each worker.
_TASK_DURATION: Final = 0.3
_TASKS_AHEAD: Final = 3

#: Time between two copies of the results on disk, s.
_SAVE_INTERVAL: Final = 10.0

#: Number of consecutive crashes of all workers without progress after which a study stops.
_MAX_CONSECUTIVE_CRASHES: Final = 5

#: Approximate duration of full records, s, from which a trial is timed.
_MIN_TIMED_DURATION: Final = 10.0

#: Approximate duration of a trial, s.
_TRIAL_DURATIONS: Final[dict[CostClass, float]] = {
    "linear": 2e-6,
    "sampled": 4e-6,
    "readings": 1e-2,
    "full": 0.1,
}


class BatchResults:
    """The finished batches of a study and their results.

    keep: True: keep each trial.
    """

    def __init__(self, engine: StudyEngine, trials: int, *, keep: bool = False) -> None:
        self.trials, self.keep = trials, keep
        self.batch_size, self.coefficients = engine.batch_size, engine.coefficients
        count = -(-trials // self.batch_size)
        self.done = np.zeros(count, dtype=bool)
        self.sums = np.zeros((count, len(self.coefficients), engine.accumulator.width))
        self.values: dict[int, Array] = {}

    def trial_count(self, batch: int) -> int:
        """Return the number of trials of a batch that count."""
        return min(self.batch_size, self.trials - batch * self.batch_size)

    @property
    def trials_done(self) -> int:
        """Number of finished trials."""
        return sum(self.trial_count(int(batch)) for batch in np.flatnonzero(self.done))

    def record(self, first: int, sums: Array, values: list[Array]) -> None:
        """Record the results of a task from its first batch on; a repetition changes nothing."""
        for offset, row in enumerate(sums):
            batch = first + offset
            if self.done[batch]:
                continue
            self.sums[batch] = row
            if values:
                self.values[batch] = values[offset]
            self.done[batch] = True


def expected_duration(engine: StudyEngine, trials: int) -> float:
    """Return the approximate duration of trials on a single worker, s.

    Trials by whole records differ widely: if they matter, one trial is timed.
    """
    seconds = 0.0
    for analysis_engine in engine.analysis_engines:
        duration = _TRIAL_DURATIONS[analysis_engine.cost_class]
        if analysis_engine.cost_class == "full" and duration * trials > _MIN_TIMED_DURATION:
            draws = engine.truth.draw(random_stream(engine.seed, 0, TRUTH_STREAM), 1)
            for _ in range(2):  # the first loads what it needs
                start = time.perf_counter()
                analysis_engine.engine.run_trials(
                    draws, random_stream(engine.seed, 0, NOISE_STREAM)
                )
                duration = time.perf_counter() - start
        seconds += duration * trials
    return seconds


@lru_cache(maxsize=2)
def _unpickle(engine: bytes) -> StudyEngine:
    study_engine: StudyEngine = pickle.loads(engine)
    return study_engine


def run_task(engine: bytes, first: int, trials: tuple[int, ...], keep: bool) -> tuple[Array, Any]:
    """Run consecutive batches with the given numbers of trials."""
    study_engine = _unpickle(engine)
    batches = [study_engine.run_batch(first + i, n, keep=keep) for i, n in enumerate(trials)]
    return np.array([sums for sums, _ in batches]), [values for _, values in batches if keep]


def run_batches(
    engine: StudyEngine,
    batch_results: BatchResults,
    *,
    workers: Workers = SINGLE_PROCESS,
    pool: WorkerPool | None = None,
    progress: Callable[[int, int], None] | None = None,
    save: Callable[[], None] | None = None,
    batches_per_task: int | None = None,
) -> bool:
    """Run all unfinished batches.

    workers: Number of processes, or a cluster.
    pool: Running workers; None: start them. Workers that die are replaced.
    progress: Called with (trials done, trials in all).
    save: Called regularly and at the end, to save a copy of the results.
    batches_per_task: Number of batches in a task; by default about a third of a second's work.
    """
    cost = (
        sum(
            _TRIAL_DURATIONS[analysis_engine.cost_class]
            for analysis_engine in engine.analysis_engines
        )
        * engine.batch_size
    )
    size = batches_per_task or max(1, min(64, round(_TASK_DURATION / cost)))
    pickled = pickle.dumps(engine)
    try:
        reporter = _ProgressReporter(batch_results, progress, save)
        if workers.alone:
            _run_inline(pickled, batch_results, size, reporter)
        else:
            _run_in_pool(pickled, batch_results, size, pool, workers, reporter)
    except KeyboardInterrupt:
        pass
    finally:
        if save is not None:
            save()
    return bool(batch_results.done.all())


def _remaining_tasks(
    batch_results: BatchResults, size: int
) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Yield the first batch and the trial counts of each remaining task."""
    remaining = np.flatnonzero(np.logical_not(batch_results.done))
    start = 0
    while start < remaining.size:
        stop = start + 1
        while (
            stop < min(remaining.size, start + size) and remaining[stop] == remaining[stop - 1] + 1
        ):
            stop += 1
        trials = tuple(batch_results.trial_count(int(batch)) for batch in remaining[start:stop])
        yield int(remaining[start]), trials
        start = stop


def _run_inline(
    pickled: bytes, batch_results: BatchResults, size: int, report: _ProgressReporter
) -> None:
    for first, trials in list(_remaining_tasks(batch_results, size)):
        batch_results.record(first, *run_task(pickled, first, trials, batch_results.keep))
        report(sum(trials))


class _ProgressReporter:
    """Reports of progress, and updates of the copy on disk."""

    def __init__(
        self,
        batch_results: BatchResults,
        progress: Callable[[int, int], None] | None,
        save: Callable[[], None] | None,
    ) -> None:
        self.batch_results, self.progress, self.save = batch_results, progress, save
        self.trials_done, self.saved_at = batch_results.trials_done, time.monotonic()
        self(0)

    def __call__(self, trials: int) -> None:
        self.trials_done += trials
        if self.progress is not None:
            self.progress(self.trials_done, self.batch_results.trials)
        if self.save is not None and time.monotonic() - self.saved_at > _SAVE_INTERVAL:
            self.save()
            self.saved_at = time.monotonic()


def _run_in_pool(
    pickled: bytes,
    batch_results: BatchResults,
    size: int,
    pool: WorkerPool | None,
    workers: Workers,
    report: _ProgressReporter,
) -> None:
    crashes = 0
    crash_errors: tuple[type[BaseException], ...] = (BrokenProcessPool,)
    while not batch_results.done.all():
        done_before = int(batch_results.done.sum())
        try:
            with nullcontext(pool) if pool else worker_pool(workers, __name__) as current_pool:
                crash_errors = current_pool.death_errors
                _submit_tasks(current_pool, pickled, batch_results, size, report)
        except crash_errors as error:
            # A worker was killed, or ran out of memory. Its tasks are submitted again.
            pool = None
            crashes = 0 if int(batch_results.done.sum()) > done_before else crashes + 1
            if crashes >= _MAX_CONSECUTIVE_CRASHES:
                raise CounterspinError(
                    "the worker processes end immediately. Use fewer `workers`, or check "
                    "whether enough memory is free",
                    code="worker-failed",
                ) from error


def _submit_tasks(
    pool: WorkerPool,
    pickled: bytes,
    batch_results: BatchResults,
    size: int,
    report: _ProgressReporter,
) -> None:
    # A snapshot: entries made meanwhile must not change the remaining tasks.
    tasks = iter(list(_remaining_tasks(batch_results, size)))
    pending: dict[Future[tuple[Array, Any]], tuple[int, tuple[int, ...]]] = {}
    try:
        while True:
            ahead = _TASKS_AHEAD * pool.size
            while len(pending) < ahead and (task := next(tasks, None)) is not None:
                pending[pool.executor.submit(run_task, pickled, *task, batch_results.keep)] = task
            if not pending:
                return
            finished, _ = wait(pending, return_when=FIRST_COMPLETED)
            for future in finished:
                first, trials = pending.pop(future)
                batch_results.record(first, *future.result())
                report(sum(trials))
    finally:
        for future in pending:
            future.cancel()
