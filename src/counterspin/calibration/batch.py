"""`counterspin calibrate DIR1 DIR2 ...`: calibrate campaigns independently of each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from pydantic import field_serializer

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.options import Method, TwoStageOptions
from counterspin.calibration.result import Result
from counterspin.errors import CounterspinError
from counterspin.results import ReportableResult, ResultPart
from counterspin.workers import SINGLE_PROCESS, Workers, worker_pool


class FailedCampaign(ResultPart):
    """Error of a campaign without a result."""

    error: str


class BatchResult(ReportableResult):
    """Results and errors of campaigns, by folder as named."""

    BLOCKS: ClassVar[str] = "counterspin.calibration.pages.document:batch_blocks"
    KIND: ClassVar[str] = "summary of several campaigns"

    campaigns: dict[str, Result | FailedCampaign]

    @field_serializer("campaigns", when_used="json")
    def _serialize_campaigns(
        self, campaigns: dict[str, Result | FailedCampaign]
    ) -> dict[str, Result | FailedCampaign]:
        """Seal each result, so that it equals a separately written file."""
        return {
            folder: outcome.with_seal() if isinstance(outcome, Result) else outcome
            for folder, outcome in campaigns.items()
        }

    @property
    def failed(self) -> dict[str, str]:
        """The errors of the campaigns that have no result, by folder."""
        return {
            folder: outcome.error
            for folder, outcome in self.campaigns.items()
            if isinstance(outcome, FailedCampaign)
        }

    @property
    def contradicted(self) -> list[str]:
        """The folders of contradicted results without an accepted misfit."""
        return [
            folder
            for folder, outcome in self.campaigns.items()
            if isinstance(outcome, Result)
            and outcome.state == "contradicted"
            and outcome.accepted_misfit is None
        ]

    @property
    def not_determined(self) -> list[str]:
        """The folders of results in which a requested coefficient is not determined."""
        return [
            folder
            for folder, outcome in self.campaigns.items()
            if isinstance(outcome, Result) and outcome.state == "not-determined"
        ]


def calibrate_many(
    directories: Sequence[Path],
    *,
    method: Method = "joint",
    options: TwoStageOptions | None = None,
    accept_misfit: str | None = None,
    without: Sequence[str] = (),
    workers: Workers = SINGLE_PROCESS,
    progress: Callable[[int, int], None] | None = None,
) -> BatchResult:
    """Calibrate campaigns independently of each other.

    progress: Called with (campaigns done, campaigns in all).
    """
    arguments = (method, options or TwoStageOptions(), accept_misfit, tuple(without))
    directories = list(dict.fromkeys(directories))
    outcomes: dict[int, Result | FailedCampaign] = {}

    def record_outcome(index: int, outcome: Result | FailedCampaign) -> None:
        outcomes[index] = outcome
        if progress is not None:
            progress(len(outcomes), len(directories))

    indices = range(len(directories))
    if workers.alone:
        for index in indices:
            record_outcome(index, try_to_calibrate(directories[index], *arguments))
    else:

        def run_pool(jobs_to_run: Sequence[int], n_processes: int) -> list[int]:
            jobs = {index: (directories[index], *arguments) for index in jobs_to_run}
            return _run_pool(jobs, replace(workers, processes=n_processes), record_outcome)

        try:
            # Retry interrupted campaigns one by one, so that a crash affects no other campaign.
            for index in run_pool(indices, workers.capped().processes):
                if run_pool([index], 1):
                    reason = (
                        "the process of this campaign crashed twice, possibly because it "
                        "ran out of memory"
                    )
                    record_outcome(index, FailedCampaign(error=reason))
        except CounterspinError as error:
            # The cluster is lost. Keep the finished outcomes.
            if not outcomes:
                raise
            for index in indices:
                if index not in outcomes:
                    record_outcome(index, FailedCampaign(error=str(error)))
    return BatchResult(campaigns={str(directories[index]): outcomes[index] for index in indices})


def _run_pool(
    jobs: Mapping[int, tuple[Path, Method, TwoStageOptions, str | None, tuple[str, ...]]],
    workers: Workers,
    record_outcome: Callable[[int, Result | FailedCampaign], None],
) -> list[int]:
    """Run jobs in parallel, and return the indices of the jobs that a crash interrupted."""
    interrupted_jobs: list[int] = []
    remaining_jobs = list(jobs)
    crash_errors: tuple[type[BaseException], ...] = (BrokenProcessPool,)
    while remaining_jobs:
        pending_jobs: dict[Future[Result | FailedCampaign], int] = {}
        pool_workers = replace(workers, processes=min(workers.processes, len(remaining_jobs)))
        try:
            with worker_pool(pool_workers, __name__) as pool:
                crash_errors = pool.death_errors
                while remaining_jobs or pending_jobs:
                    # At most one job per worker, so that a crash interrupts few jobs.
                    while remaining_jobs and len(pending_jobs) < pool.size:
                        pending_jobs[
                            pool.executor.submit(try_to_calibrate, *jobs[remaining_jobs[0]])
                        ] = remaining_jobs[0]
                        del remaining_jobs[0]
                    finished_jobs, _ = wait(pending_jobs, return_when=FIRST_COMPLETED)
                    for future in finished_jobs:
                        index = pending_jobs.pop(future)
                        try:
                            record_outcome(index, future.result())
                        except crash_errors:
                            interrupted_jobs.append(index)
        except crash_errors:
            # A crash stops all processes of a pool; other workers of a cluster continue.
            interrupted_jobs += pending_jobs.values()
    return interrupted_jobs


def try_to_calibrate(
    directory: Path,
    method: Method,
    options: TwoStageOptions,
    accept_misfit: str | None,
    without: tuple[str, ...],
) -> Result | FailedCampaign:
    """Calibrate one campaign; return errors as text instead of raising them."""
    try:
        return calibrate(
            directory, method=method, options=options, accept_misfit=accept_misfit, without=without
        )
    except CounterspinError as error:
        return FailedCampaign(error=str(error))
    except Exception as error:
        # An internal error must not stop the other campaigns.
        return FailedCampaign(error=f"internal error ({type(error).__name__}: {error})")
