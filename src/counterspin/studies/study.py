"""`counterspin study`: whether a campaign, analysed so, gives the uncertainty it claims."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Final

import numpy as np

from counterspin._version import __version__
from counterspin.campaign.description import Campaign
from counterspin.errors import CounterspinError, CounterspinWarning
from counterspin.inference.joint.unknowns import unit_of
from counterspin.studies.choice import EngineName, prepare
from counterspin.studies.description import StudyDescription, read_study
from counterspin.studies.draws import OTHERS, VariedQuantity
from counterspin.studies.folder import StudyFolder, StudyProgress
from counterspin.studies.result import (
    AnalysisResult,
    CoefficientResult,
    StudyResult,
    summarise,
    verdict_of,
)
from counterspin.studies.work import Ledger, StudyEngine, expected_duration, run_batches, work
from counterspin.threads import one_blas_thread
from counterspin.workers import ALONE, Workers, worker_pool

#: Hours of work above which a user is told before it begins.
_LONG_HOURS: Final = 0.5

#: More trials than this would take days, and their ledger much of the memory.
_MOST_TRIALS: Final = 10**9

#: Most bytes for the stored values of each batch of trials.
_LARGEST_LEDGER: Final = 5 * 10**8


@one_blas_thread()
def study(
    where: Path | str | Campaign | StudyDescription,
    *,
    trials: int | None = None,
    seed: int | None = None,
    engine: EngineName = "auto",
    workers: Workers = ALONE,
    output: StudyFolder | Path | str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> StudyResult:
    """Study a campaign by Monte Carlo.

    Parameters
    ----------
    where
        A campaign's folder or description, a study's file, or a campaign or study already read.
    trials, seed
        Values that replace those of the study.
    engine
        ``auto`` takes the fastest that is valid; ``linear`` and ``full`` are as docs/study.md
        describes them.
    workers
        Processes, or the workers of a Dask cluster.
    output
        Folder for ``study.json``, ``trials.parquet`` and the files for a resumption; None: write
        nothing.
    progress
        Called with (trials done, trials in all).

    Returns
    -------
    StudyResult
        The result does not depend on the number of workers. After an interruption from the
        keyboard it states this, and has the finished trials.

    Raises
    ------
    CampaignError
        If the description is wrong.
    NotIdentifiableError
        If the requested engine is not valid, or nothing can be determined.
    CounterspinError
        If the workers fail, or a file cannot be written or would be lost.

    Warns
    -----
    CounterspinWarning
        If it will take long, or if stored values of an earlier part are damaged.
    """
    description = where if isinstance(where, StudyDescription) else read_study(where)
    trials = description.trials if trials is None else trials
    if not 2 <= trials <= _MOST_TRIALS:
        raise CounterspinError(f"`trials` must be at least 2 and at most {_MOST_TRIALS:.0e}")
    if seed is not None and seed < 0:
        raise CounterspinError("`seed` must not be negative")
    folder = StudyFolder(output) if isinstance(output, Path | str) else output
    if folder is not None:
        folder.reserve()
    workers = workers.capped()
    # Workers start while the engine is prepared.
    with nullcontext() if workers.alone else worker_pool(workers, work.__module__) as pool:
        prepared = prepare(description, description.seed if seed is None else seed, engine)
        _refuse_full_ledger(prepared, trials)
        ledger = Ledger(prepared, trials, keep=folder is not None and folder.keep_trials)
        kept = None
        if folder is not None:
            kept = StudyProgress(folder.place, ledger, _fingerprint(prepared))
            if folder.resume:
                kept.resume()
            else:
                kept.clear()
        _warn_of_hours(prepared, trials - ledger.trials_done, pool.size if pool else 1)
        complete = run_batches(
            prepared,
            ledger,
            workers=workers,
            pool=pool,
            progress=progress,
            save=kept.save if kept else None,
        )
    result = _result(description, prepared, ledger, complete)
    if folder is not None and kept is not None:
        folder.write(result, ledger)
        if complete:
            kept.clear()
    return result


def _refuse_full_ledger(engine: StudyEngine, trials: int) -> None:
    """Raise CounterspinError if the stored values of all trials would fill the memory."""
    of_a_batch = 8 * engine.tally.width * len(engine.reported)
    most = _LARGEST_LEDGER // of_a_batch * engine.batch_size
    if trials > most:
        raise CounterspinError(
            f"{trials:.3g} `trials` need too much memory; this study can have at most {most:.3g}"
        )


def _warn_of_hours(engine: StudyEngine, trials: int, workers: int) -> None:
    hours = expected_duration(engine, trials) / workers / 3600.0
    if hours < _LONG_HOURS:
        return
    slow = [part for part in engine.parts if part.cost == "full"]
    why = "; ".join(f"{part.reported[0].analysis}: {part.words}" for part in slow)
    warnings.warn(
        f"{trials} trials will take about {hours:.1g} h"
        + (f" ({why})" if why else "")
        + "; use fewer `trials`, more `workers` or a `cluster` to shorten it; Ctrl-C ends "
        "it with a valid result of the completed trials",
        CounterspinWarning,
        stacklevel=4,
    )


def _fingerprint(engine: StudyEngine) -> str:
    """Return a checksum of everything that affects the result of a batch."""
    with np.printoptions(threshold=1_000_000, precision=17):
        return hashlib.sha256(repr((__version__, engine)).encode()).hexdigest()


def _result(
    description: StudyDescription, engine: StudyEngine, ledger: Ledger, complete: bool
) -> StudyResult:
    if not ledger.done.any():
        raise CounterspinError(
            "the study was stopped before the first batch of trials was complete"
        )
    sums = ledger.sums[ledger.done]
    coefficients: dict[str, dict[str, CoefficientResult]] = {}
    undetermined: dict[str, list[str]] = {}
    words: dict[str, str] = {}
    row = 0
    for part in engine.parts:
        # A two-stage analysis has an engine for each accelerometer.
        name = part.reported[0].analysis
        words.setdefault(name, part.words)
        undetermined.setdefault(name, []).extend(part.lost)
        for reported in part.reported:
            unit = unit_of(reported.symbol)
            called = reported.symbol + (f" of {reported.owner}" if reported.owner else "")
            coefficients.setdefault(name, {})[reported.name] = summarise(
                engine.tally, sums[:, row], called, unit, reported.bound
            )
            row += 1
    analyses = {
        name: AnalysisResult(
            engine=words[name],
            trustworthy=_all_of([c.trustworthy for c in results.values()]),
            coefficients=results,
            undetermined=undetermined[name],
        )
        for name, results in coefficients.items()
    }
    return StudyResult(
        title=description.campaign.title,
        trials=next(c.trials for results in coefficients.values() for c in results.values()),
        trials_asked=ledger.trials,
        complete=complete,
        seed=engine.seed,
        varying=[_in_words(varying) for varying in description.varying],
        analyses=analyses,
        verdict=verdict_of(analyses),
        provenance={"version": __version__},
    )


def _all_of(judged: list[bool | None]) -> bool | None:
    return None if None in judged else all(judged)


def _in_words(varying: VariedQuantity) -> str:
    name = f"{varying.owner}.{varying.symbol}" if varying.owner else varying.symbol
    unit = OTHERS.get(varying.symbol) or unit_of(varying.symbol)
    unit = "" if unit == "1" else f" {unit}"
    low, high = f"{varying.first:.6g}{unit}", f"{varying.second:.6g}{unit}"
    how = {
        "normal": f"normal, mean {low}, standard deviation {high}",
        "uniform": f"uniform from {low} to {high}",
        "fixed": low,
    }[varying.distribution]
    return f"{name}: {how}" + (", drawn separately for each run" if varying.per_run else "")
