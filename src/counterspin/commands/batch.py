"""`counterspin calibrate DIR1 DIR2 ...`: many campaigns, one failure stopping no other.

- `calibrate_many`: all of them, on several cores or a cluster
- `Calibrated`: what became of one
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from counterspin.campaign.result import Result
from counterspin.commands.calibrate import Method, calibrate
from counterspin.commands.study_work import executor_of
from counterspin.commands.two_stage import TwoStageOptions
from counterspin.errors import CounterspinError

#: How often a campaign is begun whose worker dies.
_ATTEMPTS: Final = 2


@dataclass(frozen=True)
class Calibrated:
    """What became of one campaign.

    Attributes
    ----------
    directory
        As it was named.
    result
        Its result, or None.
    error
        Why there is none.
    """

    directory: Path
    result: Result | None
    error: str | None = None


def calibrate_many(
    directories: Sequence[Path],
    *,
    method: Method = "joint",
    options: TwoStageOptions | None = None,
    workers: int = 1,
    cluster: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Calibrated, ...]:
    """Calibrate campaigns independently of each other.

    Parameters
    ----------
    directories
        Their folders; on a cluster every worker must see them under these names.
    method, options
        As for `counterspin.commands.calibrate.calibrate`.
    workers, cluster
        As for `counterspin.commands.study.study`.
    progress
        Called with (campaigns done, campaigns in all).

    Returns
    -------
    tuple of Calibrated
        In the order of the folders.

    Raises
    ------
    CounterspinError
        If the cluster cannot be reached.
    """
    options = options or TwoStageOptions()
    done: dict[int, Calibrated] = {}

    def enter(index: int, outcome: Calibrated) -> None:
        done[index] = outcome
        if progress is not None:
            progress(len(done), len(directories))

    if workers == 1 and cluster is None:
        for index, directory in enumerate(directories):
            enter(index, attempt(directory, method, options))
    for round_ in range(_ATTEMPTS):
        left = [index for index in range(len(directories)) if index not in done]
        if not left:
            break
        # After a death each has a pool of its own: who kills a worker then harms nobody else.
        groups = [left] if round_ == 0 else [[index] for index in left]
        for group in groups:
            try:
                with executor_of(min(workers, len(group)), cluster) as (executor, _):
                    waiting = {
                        executor.submit(attempt, directories[i], method, options): i for i in group
                    }
                    for future in as_completed(waiting):
                        enter(waiting[future], future.result())
            except BrokenProcessPool:
                continue
    died = "the process that worked on it died; perhaps it ran out of memory"
    return tuple(
        done.get(index, Calibrated(directory, None, died))
        for index, directory in enumerate(directories)
    )


def attempt(directory: Path, method: Method, options: TwoStageOptions) -> Calibrated:
    """Calibrate one campaign; whatever goes wrong is told and not raised."""
    try:
        return Calibrated(directory, calibrate(directory, method=method, options=options))
    except CounterspinError as error:
        return Calibrated(directory, None, str(error))
    except Exception as error:
        # One campaign's fault must not stop the others.
        return Calibrated(directory, None, f"internal error ({type(error).__name__}: {error})")


def to_json(outcomes: Sequence[Calibrated]) -> str:
    """Return all results in one document, by folder."""
    found: dict[str, Any] = {
        str(one.directory): {"error": one.error}
        if one.result is None
        else json.loads(one.result.to_json())
        for one in outcomes
    }
    return json.dumps({"schema": 1, "campaigns": found}, indent=1, ensure_ascii=False) + "\n"
