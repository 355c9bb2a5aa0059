"""`counterspin study`: validation of the stated uncertainty of analyses by Monte Carlo."""

from __future__ import annotations

import hashlib
import time
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Final

import numpy as np

from counterspin._version import __version__
from counterspin.campaign.description import Campaign
from counterspin.errors import CounterspinError, CounterspinWarning
from counterspin.frozen import frozen
from counterspin.inference.joint.unknowns import unit_of
from counterspin.studies.batch_runner import (
    BatchResults,
    StudyEngine,
    expected_duration,
    run_batches,
    run_task,
)
from counterspin.studies.description import StudyDescription, read_study
from counterspin.studies.draws import OTHER_QUANTITY_UNITS, VariedQuantity
from counterspin.studies.engine_selection import EngineName, prepare_study
from counterspin.studies.folder import StudyFolder, StudyProgress
from counterspin.studies.result import (
    AnalysisResult,
    CoefficientResult,
    StudyResult,
    summarise,
    summarise_analyses,
)
from counterspin.threads import single_blas_thread
from counterspin.workers import SINGLE_PROCESS, Workers, worker_pool

#: Expected duration, s, above which a warning states the duration.
_WARNING_DURATION: Final = 30.0

#: Default number of trials for the estimate of the duration.
_N_TYPICAL_TRIALS: Final = 1000

#: Maximum number of trials; more would take days and too much memory.
_MAX_TRIALS: Final = 10**9

#: Maximum size of the stored sums, bytes.
_MAX_RESULT_BYTES: Final = 5 * 10**8


@single_blas_thread()
def study(
    where: Path | str | Campaign | StudyDescription,
    *,
    trials: int | None = None,
    seed: int | None = None,
    engine: EngineName = "auto",
    workers: Workers = SINGLE_PROCESS,
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
        ``auto`` selects the fastest valid engine; docs/study.md describes ``linear`` and ``full``.
    workers
        Processes, or the workers of a Dask cluster.
    output
        Folder for ``study.json``, ``trials.parquet`` and the files for a resumption; None: write
        nothing.
    progress
        Function called with (trials done, total trials).

    Returns
    -------
    StudyResult
        The result does not depend on the number of workers. After an interruption from the
        keyboard, it contains the finished trials and states the interruption.

    Raises
    ------
    CampaignError
        If the description is wrong.
    NotIdentifiableError
        If the requested engine is not valid, or the data do not determine any coefficient.
    CounterspinError
        If the workers fail, or a file cannot be written or would be lost.

    Warns
    -----
    CounterspinWarning
        If the study will take long, or saved batches are damaged.
    """
    description = where if isinstance(where, StudyDescription) else read_study(where)
    trials = description.trials if trials is None else trials
    if not 2 <= trials <= _MAX_TRIALS:
        raise CounterspinError(
            f"`trials` must be at least 2 and at most {_MAX_TRIALS:.0e}", code="wrong-usage"
        )
    if seed is not None and seed < 0:
        raise CounterspinError("`seed` must not be negative", code="wrong-usage")
    folder = StudyFolder(output) if isinstance(output, Path | str) else output
    if folder is not None:
        folder.reserve()
    workers = workers.capped()
    # Workers start during the preparation of the engine.
    with nullcontext() if workers.alone else worker_pool(workers, run_task.__module__) as pool:
        seed = description.seed if seed is None else seed
        study_engine = prepare_study(description, seed, engine)
        _check_memory(study_engine, trials)
        batch_results = BatchResults(
            study_engine, trials, keep_trials=folder is not None and folder.keep_trials
        )
        study_progress = None
        if folder is not None:
            study_progress = StudyProgress(
                folder.directory, batch_results, _fingerprint(study_engine)
            )
            if folder.resume:
                study_progress.resume()
            else:
                study_progress.clear()
        _warn_about_duration(
            study_engine, trials - batch_results.trials_done, pool.size if pool else 1
        )
        is_complete = run_batches(
            study_engine,
            batch_results,
            workers=workers,
            pool=pool,
            progress=progress,
            save=study_progress.save if study_progress else None,
        )
    result = _make_result(description, study_engine, batch_results, is_complete)
    if folder is not None and study_progress is not None:
        folder.write(result, batch_results)
        if is_complete:
            study_progress.clear()
    return result


def _check_memory(engine: StudyEngine, n_trials: int) -> None:
    """Raise CounterspinError if the stored sums of all batches require too much memory."""
    batch_bytes = 8 * engine.accumulator.width * len(engine.coefficients)
    max_trials = _MAX_RESULT_BYTES // batch_bytes * engine.batch_size
    if n_trials > max_trials:
        raise CounterspinError(
            f"{n_trials:.3g} `trials` require too much memory; this study may have at most "
            f"{max_trials:.3g}",
            code="too-many-rows",
        )


def _warn_about_duration(engine: StudyEngine, n_trials: int, n_workers: int) -> None:
    seconds = expected_duration(engine, n_trials) / n_workers
    if seconds < _WARNING_DURATION:
        return
    reason = _describe_slow_analyses(engine)
    text = (
        f"{n_trials} trials will take about {_format_duration(seconds)}"
        + (f" ({reason})" if reason else "")
        + "; to reduce this time, use fewer `trials`, more `workers` or a `cluster`. Ctrl-C stops "
        "the study and keeps a valid result for the completed trials"
    )
    warnings.warn(CounterspinWarning(text, code="long-study"), stacklevel=4)


def _describe_slow_analyses(engine: StudyEngine) -> str:
    """Return the analyses that require full records, with the reasons."""
    return "; ".join(
        f"{analysis.coefficients[0].analysis}: {analysis.description}"
        for analysis in engine.analysis_engines
        if analysis.cost_class == "full"
    )


def _format_duration(seconds: float) -> str:
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:.1g} h"


@frozen
class StudyDuration:
    """The expected duration of a study on one processor core."""

    preparation: float  #: Duration before the first trial, s.
    per_trial: float  #: Duration of a trial, s.
    slow_analyses: str  #: Analyses that need full records, with the reasons; empty without one.


@single_blas_thread()
def estimate_duration(where: Path) -> StudyDuration:
    """Return the expected duration of a study after its preparation; time a slow trial."""
    start_time = time.perf_counter()
    description = read_study(where)
    study_engine = prepare_study(description, description.seed)
    preparation = time.perf_counter() - start_time
    seconds_per_trial = expected_duration(study_engine, _N_TYPICAL_TRIALS) / _N_TYPICAL_TRIALS
    return StudyDuration(preparation, seconds_per_trial, _describe_slow_analyses(study_engine))


def _fingerprint(engine: StudyEngine) -> str:
    """Return a checksum of everything that affects the result of a batch."""
    with np.printoptions(threshold=1_000_000, precision=17):
        return hashlib.sha256(repr((__version__, engine)).encode()).hexdigest()


def _make_result(
    description: StudyDescription,
    engine: StudyEngine,
    batch_results: BatchResults,
    is_complete: bool,
) -> StudyResult:
    if not batch_results.is_done.any():
        raise CounterspinError(
            "the study was stopped before it had completed the first batch of trials",
            code="stopped",
        )
    sums = batch_results.sums[batch_results.is_done]
    coefficients: dict[str, dict[str, CoefficientResult]] = {}
    undetermined: dict[str, list[str]] = {}
    engine_descriptions: dict[str, str] = {}
    row = 0
    for analysis in engine.analysis_engines:
        # A two-stage analysis has an engine for each accelerometer.
        name = analysis.coefficients[0].analysis
        engine_descriptions.setdefault(name, analysis.description)
        undetermined.setdefault(name, []).extend(analysis.undetermined)
        for coefficient in analysis.coefficients:
            unit = unit_of(coefficient.symbol)
            coefficient_name = coefficient.symbol + (
                f" of {coefficient.owner}" if coefficient.owner else ""
            )
            coefficients.setdefault(name, {})[coefficient.name] = summarise(
                engine.accumulator, sums[:, row], coefficient_name, unit, coefficient.bound
            )
            row += 1
    analyses = {
        name: AnalysisResult(
            engine=engine_descriptions[name],
            trustworthy=_combine_verdicts(
                [coefficient.trustworthy for coefficient in results.values()]
            ),
            coefficients=results,
            undetermined=undetermined[name],
        )
        for name, results in coefficients.items()
    }
    return StudyResult(
        title=description.campaign.title,
        trials=next(
            coefficient.trials
            for results in coefficients.values()
            for coefficient in results.values()
        ),
        trials_asked=batch_results.trials,
        complete=is_complete,
        seed=engine.seed,
        varying=[_describe_quantity(quantity) for quantity in description.varied_quantities],
        analyses=analyses,
        verdict=summarise_analyses(analyses),
        provenance={"version": __version__},
    )


def _combine_verdicts(verdicts: list[bool | None]) -> bool | None:
    return None if None in verdicts else all(verdicts)


def _describe_quantity(quantity: VariedQuantity) -> str:
    unit = OTHER_QUANTITY_UNITS.get(quantity.symbol) or unit_of(quantity.symbol)
    unit = "" if unit == "1" else f" {unit}"
    first_text = f"{quantity.first_parameter:.6g}{unit}"
    second_text = f"{quantity.second_parameter:.6g}{unit}"
    text = {
        "normal": f"normal, mean {first_text}, standard deviation {second_text}",
        "uniform": f"uniform from {first_text} to {second_text}",
        "fixed": first_text,
    }[quantity.distribution]
    scope = ", drawn separately for each run" if quantity.is_per_run else ""
    return f"{quantity.name}: {text}{scope}"
