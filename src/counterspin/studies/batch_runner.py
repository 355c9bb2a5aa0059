"""Run the trials of a study in batches, on one core, on many cores or on a cluster.

A task consists of several batches. The result of a batch depends only on its number, so that
results do not depend on the distribution of tasks. The tasks of a dead worker are submitted again.
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

#: Cost of a trial: ``linear``; ``sampled``, with sigma and the weights of the second stage from the
#: residuals; ``readings``; ``full``.
CostClass = Literal["linear", "sampled", "readings", "full"]

#: Trials per batch: they fit into a cache, and take a fraction of a second with slow engines.
_BATCH_SIZES: Final[dict[CostClass, int]] = {
    "linear": 8192,
    "sampled": 8192,
    "readings": 64,
    "full": 8,
}


@frozen
class TrialResults:
    """Results of an analysis in n trials."""

    estimate: Array  #: Estimates of the c coefficients, shape (c, n).
    u: Array  #: Combined standard uncertainties, shape (c, n).
    dof: Array  #: Effective degrees of freedom, shape (c, n); infinite for a given noise.


class TrialEngine(Protocol):
    """Interface of the engines that run the trials of one analysis."""

    def run_trials(self, draws: Draws, generator: np.random.Generator) -> TrialResults:
        """Return the results of the analysis for each draw of the true values, with new noise."""
        ...


@frozen
class JointRequest:
    """Options of the joint fit."""

    model: Unknowns  #: Unknowns, considered terms, uncertain inputs.
    noise: Mapping[str, Noise]  #: Noise by accelerometer, given or to be estimated.

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

    #: Name of the analysis, owner (empty for a platform term) and symbol.
    analysis: str
    owner: str
    symbol: str
    #: Cramer-Rao bound of the standard uncertainty; None if it does not exist.
    bound: float | None

    @property
    def name(self) -> str:
        """Owner and symbol, separated by a dot."""
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
    """True values, engines and accumulator of a study, for a worker."""

    truth: StudyTruth  #: True values.
    seed: int  #: Seed of the study.
    analysis_engines: tuple[AnalysisEngine, ...]  #: An engine for each analysis.
    accumulator: TrialAccumulator  #: The sums over the trials.

    @property
    def batch_size(self) -> int:
        """Trials in a batch."""
        return min(_BATCH_SIZES[analysis.cost_class] for analysis in self.analysis_engines)

    @property
    def coefficients(self) -> tuple[ReportedCoefficient, ...]:
        """Reported coefficients, in the order of a batch's rows."""
        return tuple(
            coefficient
            for analysis in self.analysis_engines
            for coefficient in analysis.coefficients
        )

    def run_batch(
        self, batch: int, n_trials: int, *, keep_trials: bool = False
    ) -> tuple[Array, Array | None]:
        """Run the trials of one batch.

        batch: Index of the batch, from 0.
        keep_trials: True: return each trial in addition.
        Returns: sums of each of c reported coefficients, shape (c, width); truth, estimate and u
            of each trial, shape (c, 3, n), or None.
        """
        draws = self.truth.draw(random_stream(self.seed, batch, TRUTH_STREAM), self.batch_size)
        covariate_values = [
            _covariate_values(draws, covariate)[:n_trials]
            for covariate in self.accumulator.covariates
        ]
        sums, values = [], []
        for analysis in self.analysis_engines:
            noise_generator = random_stream(self.seed, batch, NOISE_STREAM + analysis.noise_stream)
            # Full simulation is slow: run only the requested trials.
            simulated_draws = (
                draws.slice_trials(0, n_trials)
                if analysis.cost_class in ("full", "readings")
                else draws
            )
            results = analysis.engine.run_trials(simulated_draws, noise_generator)
            for row, coefficient in zip(analysis.rows, analysis.coefficients, strict=True):
                truth = draws.mean(coefficient.owner, coefficient.symbol)[:n_trials]
                estimate = results.estimate[row, :n_trials]
                u, dof = results.u[row, :n_trials], results.dof[row, :n_trials]
                sums.append(self.accumulator.accumulate(estimate, truth, u, dof, covariate_values))
                if keep_trials:
                    values.append(np.stack([truth, estimate, np.broadcast_to(u, truth.shape)]))
        return np.array(sums), np.array(values) if keep_trials else None


def _covariate_values(draws: Draws, covariate: BiasCovariate) -> Array:
    if covariate.symbol == DRIFT:
        return np.broadcast_to(draws.drift.mean(axis=0), draws.n_trials)
    ripple = np.hypot(draws.ripple_cos, draws.ripple_sin).mean(axis=0)
    return np.broadcast_to(ripple, draws.n_trials)


#: Duration of a task, s, and maximum number of pending tasks per worker.
_TASK_DURATION: Final = 0.3
_MAX_PENDING_TASKS: Final = 3

#: Time between saves of the results, s.
_SAVE_INTERVAL: Final = 10.0

#: Number of consecutive crashes of all workers without progress after which a study stops.
_MAX_CONSECUTIVE_CRASHES: Final = 5

#: Approximate total duration of trials with full records, s, above which a trial is timed.
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

    keep_trials: True: keep each trial.
    """

    def __init__(self, engine: StudyEngine, n_trials: int, *, keep_trials: bool = False) -> None:
        self.trials, self.keep_trials = n_trials, keep_trials
        self.batch_size, self.coefficients = engine.batch_size, engine.coefficients
        n_batches = -(-n_trials // self.batch_size)
        self.is_done = np.zeros(n_batches, dtype=bool)
        self.sums = np.zeros((n_batches, len(self.coefficients), engine.accumulator.width))
        self.values: dict[int, Array] = {}

    def trial_count(self, batch: int) -> int:
        """Return the number of requested trials of a batch."""
        return min(self.batch_size, self.trials - batch * self.batch_size)

    @property
    def trials_done(self) -> int:
        """Number of finished trials."""
        return sum(self.trial_count(int(batch)) for batch in np.flatnonzero(self.is_done))

    def store_task(self, first_batch: int, sums: Array, values: list[Array]) -> None:
        """Store the results of a task, unless its batches are finished already."""
        for offset, batch_sums in enumerate(sums):
            batch = first_batch + offset
            if self.is_done[batch]:
                continue
            self.sums[batch] = batch_sums
            if values:
                self.values[batch] = values[offset]
            self.is_done[batch] = True


def expected_duration(engine: StudyEngine, n_trials: int) -> float:
    """Return the approximate duration of trials on a single worker, s.

    The durations of trials with full records differ widely, so that a trial is timed.
    """
    total_seconds = 0.0
    for analysis in engine.analysis_engines:
        duration = _TRIAL_DURATIONS[analysis.cost_class]
        if analysis.cost_class == "full" and duration * n_trials > _MIN_TIMED_DURATION:
            draws = engine.truth.draw(random_stream(engine.seed, 0, TRUTH_STREAM), 1)
            for _ in range(2):  # the first one includes imports
                start_time = time.perf_counter()
                analysis.engine.run_trials(draws, random_stream(engine.seed, 0, NOISE_STREAM))
                duration = time.perf_counter() - start_time
        total_seconds += duration * n_trials
    return total_seconds


@lru_cache(maxsize=2)
def _unpickle_engine(pickled_engine: bytes) -> StudyEngine:
    study_engine: StudyEngine = pickle.loads(pickled_engine)
    return study_engine


def run_task(
    pickled_engine: bytes, first_batch: int, trial_counts: tuple[int, ...], keep_trials: bool
) -> tuple[Array, Any]:
    """Run consecutive batches with the given numbers of trials."""
    study_engine = _unpickle_engine(pickled_engine)
    batches = [
        study_engine.run_batch(first_batch + i, n, keep_trials=keep_trials)
        for i, n in enumerate(trial_counts)
    ]
    return np.array([sums for sums, _ in batches]), [values for _, values in batches if keep_trials]


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
    pool: Running workers; None: start them. Dead workers are replaced.
    progress: Function called with (trials done, total trials).
    save: Function called regularly and at the end, to save the results.
    batches_per_task: Number of batches in a task; None: about a third of a second of computation.
    """
    batch_duration = (
        sum(_TRIAL_DURATIONS[analysis.cost_class] for analysis in engine.analysis_engines)
        * engine.batch_size
    )
    task_size = batches_per_task or max(1, min(64, round(_TASK_DURATION / batch_duration)))
    pickled_engine = pickle.dumps(engine)
    try:
        reporter = _ProgressReporter(batch_results, progress, save)
        if workers.alone:
            _run_inline(pickled_engine, batch_results, task_size, reporter)
        else:
            _run_in_pool(pickled_engine, batch_results, task_size, pool, workers, reporter)
    except KeyboardInterrupt:
        pass
    finally:
        if save is not None:
            save()
    return bool(batch_results.is_done.all())


def _remaining_tasks(
    batch_results: BatchResults, task_size: int
) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Yield the first batch and the trial counts of each remaining task."""
    remaining_batches = np.flatnonzero(np.logical_not(batch_results.is_done))
    start = 0
    while start < remaining_batches.size:
        stop = start + 1
        while (
            stop < min(remaining_batches.size, start + task_size)
            and remaining_batches[stop] == remaining_batches[stop - 1] + 1
        ):
            stop += 1
        trial_counts = tuple(
            batch_results.trial_count(int(batch)) for batch in remaining_batches[start:stop]
        )
        yield int(remaining_batches[start]), trial_counts
        start = stop


def _run_inline(
    pickled_engine: bytes, batch_results: BatchResults, task_size: int, reporter: _ProgressReporter
) -> None:
    for first_batch, trial_counts in list(_remaining_tasks(batch_results, task_size)):
        batch_results.store_task(
            first_batch,
            *run_task(pickled_engine, first_batch, trial_counts, batch_results.keep_trials),
        )
        reporter(sum(trial_counts))


class _ProgressReporter:
    """Reports of progress, and regular saves of the results."""

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
    pickled_engine: bytes,
    batch_results: BatchResults,
    task_size: int,
    pool: WorkerPool | None,
    workers: Workers,
    reporter: _ProgressReporter,
) -> None:
    n_crashes = 0
    crash_errors: tuple[type[BaseException], ...] = (BrokenProcessPool,)
    while not batch_results.is_done.all():
        n_done_at_start = int(batch_results.is_done.sum())
        try:
            with nullcontext(pool) if pool else worker_pool(workers, __name__) as current_pool:
                crash_errors = current_pool.death_errors
                _submit_tasks(current_pool, pickled_engine, batch_results, task_size, reporter)
        except crash_errors as error:
            # A worker was killed, or ran out of memory. Its tasks are submitted again.
            pool = None
            n_crashes = 0 if int(batch_results.is_done.sum()) > n_done_at_start else n_crashes + 1
            if n_crashes >= _MAX_CONSECUTIVE_CRASHES:
                raise CounterspinError(
                    "the worker processes end immediately. Use fewer `workers`, or check "
                    "whether enough memory is free",
                    code="worker-failed",
                ) from error


def _submit_tasks(
    pool: WorkerPool,
    pickled_engine: bytes,
    batch_results: BatchResults,
    task_size: int,
    reporter: _ProgressReporter,
) -> None:
    # Finished tasks must not change the iterator.
    tasks = iter(list(_remaining_tasks(batch_results, task_size)))
    pending_tasks: dict[Future[tuple[Array, Any]], tuple[int, tuple[int, ...]]] = {}
    try:
        while True:
            max_pending = _MAX_PENDING_TASKS * pool.size
            while len(pending_tasks) < max_pending and (task := next(tasks, None)) is not None:
                pending_tasks[
                    pool.executor.submit(run_task, pickled_engine, *task, batch_results.keep_trials)
                ] = task
            if not pending_tasks:
                return
            done_futures, _ = wait(pending_tasks, return_when=FIRST_COMPLETED)
            for future in done_futures:
                first_batch, trial_counts = pending_tasks.pop(future)
                batch_results.store_task(first_batch, *future.result())
                reporter(sum(trial_counts))
    finally:
        for future in pending_tasks:
            future.cancel()
