"""`counterspin study`: whether a campaign, analysed so, gives the uncertainty it claims.

- `study`: many trials of a campaign with known coefficients, and what its analyses make of them
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

from counterspin._version import __version__
from counterspin.errors import CounterspinError
from counterspin.output import make_folder, write_open, write_whole
from counterspin.physics.shared_terms import term
from counterspin.studies.choice import EngineName, prepare
from counterspin.studies.description import StudyDescription, read_study
from counterspin.studies.draws import OTHERS, Varying
from counterspin.studies.engine import StudyEngine
from counterspin.studies.result import (
    AnalysisResult,
    CoefficientResult,
    StudyResult,
    coefficient_result,
    verdict_of,
)
from counterspin.studies.tally import summarise
from counterspin.studies.work import Ledger, run_batches, work
from counterspin.workers import worker_pool

#: More trials than this would take days, and their ledger much of the memory.
_MOST_TRIALS: Final = 10**9


def study(
    where: Path | str | StudyDescription,
    *,
    trials: int | None = None,
    seed: int | None = None,
    engine: EngineName = "auto",
    workers: int = 1,
    cluster: str | None = None,
    output: Path | str | None = None,
    keep_trials: bool = False,
    resume: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> StudyResult:
    """Study a campaign by Monte Carlo.

    Parameters
    ----------
    where
        A campaign's folder or description, a study's file, or a study already read.
    trials, seed
        In place of the study's own.
    engine
        ``auto`` takes the fastest that is valid; ``surrogate``, ``exact`` and ``full`` are as
        docs/study.md describes them.
    workers
        Processes.
    cluster
        Address of a Dask scheduler, whose workers do the work in place of processes here.
    output
        Folder for ``study.json``, ``trials.parquet`` and what a resumption needs; None: nothing
        is written.
    keep_trials
        Whether every trial is written to ``trials.parquet``.
    resume
        Whether to go on with what was begun in `output`.
    progress
        Called with (trials done, trials in all).

    Returns
    -------
    StudyResult
        The same, whatever the number of workers. If it was interrupted from the keyboard it says
        so, and holds what was done.

    Raises
    ------
    CampaignError
        If the description is wrong.
    NotIdentifiableError
        If the engine asked for is not valid, or nothing can be determined.
    CounterspinError
        If the workers fail, or a file cannot be written.
    """
    description = where if isinstance(where, StudyDescription) else read_study(where)
    if keep_trials and output is None:
        raise CounterspinError("`keep_trials` needs a folder for them: `output`")
    if workers < 1:
        raise CounterspinError("`workers` must be at least 1")
    trials = description.trials if trials is None else trials
    if not 2 <= trials <= _MOST_TRIALS:
        raise CounterspinError(f"`trials` must be at least 2 and at most {_MOST_TRIALS:.0e}")
    if seed is not None and seed < 0:
        raise CounterspinError("`seed` must not be negative")
    alone = workers == 1 and cluster is None
    # Workers start while the engine is prepared.
    with nullcontext() if alone else worker_pool(workers, cluster, work.__module__) as pool:
        seed = description.seed if seed is None else seed
        prepared = prepare(description, seed, engine)
        folder = _folder(output)
        ledger = Ledger(
            prepared, trials, keep=keep_trials, folder=folder, fingerprint=_fingerprint(prepared)
        )
        if resume:
            ledger.resume()
        complete = run_batches(
            prepared, ledger, workers=workers, cluster=cluster, pool=pool, progress=progress
        )
    result = _result(description, prepared, ledger, complete)
    if folder is not None:
        _write(folder, result, prepared, ledger)
    return result


def _folder(output: Path | str | None) -> Path | None:
    if output is None:
        return None
    folder = Path(output)
    make_folder(folder)
    return folder


def _fingerprint(engine: StudyEngine) -> str:
    """Return a checksum of everything that decides what a batch gives."""
    with np.printoptions(threshold=1_000_000, precision=17):
        return hashlib.sha256(repr((__version__, engine)).encode()).hexdigest()


def _result(
    description: StudyDescription, engine: StudyEngine, ledger: Ledger, complete: bool
) -> StudyResult:
    if not ledger.done.any():
        raise CounterspinError("the study was stopped before a single batch of trials was done")
    sums = ledger.sums[ledger.done]
    drivers = [driver.symbol for driver in engine.tally.drivers]
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
            coefficients.setdefault(name, {})[reported.name] = coefficient_result(
                reported,
                term(reported.symbol).unit,
                summarise(engine.tally, sums[:, row]),
                drivers,
            )
            row += 1
    analyses = {
        name: AnalysisResult(
            engine=words[name],
            trustworthy=all(c.trustworthy for c in own.values()),
            coefficients=own,
            undetermined=undetermined[name],
        )
        for name, own in coefficients.items()
    }
    return StudyResult(
        title=description.campaign.title,
        trials=next(c.trials for own in coefficients.values() for c in own.values()),
        trials_asked=ledger.trials,
        complete=complete,
        seed=engine.seed,
        varying=[_in_words(varying) for varying in description.varying],
        analyses=analyses,
        verdict=verdict_of(analyses),
        provenance={"version": __version__},
    )


def _in_words(varying: Varying) -> str:
    name = f"{varying.owner}.{varying.symbol}" if varying.owner else varying.symbol
    unit = OTHERS.get(varying.symbol) or term(varying.symbol).unit
    unit = "" if unit == "1" else f" {unit}"
    low, high = f"{varying.first:.6g}{unit}", f"{varying.second:.6g}{unit}"
    how = {
        "normal": f"normal, mean {low}, standard deviation {high}",
        "uniform": f"uniform from {low} to {high}",
        "fixed": low,
    }[varying.kind]
    return f"{name}: {how}" + (", anew in each run" if varying.per_run else "")


def _write(folder: Path, result: StudyResult, engine: StudyEngine, ledger: Ledger) -> None:
    result.write(folder / "study.json")
    if ledger.keep:
        names = [f"{coefficient.analysis}.{coefficient.name}" for coefficient in engine.reported]
        write_whole(folder / "trials.parquet", lambda part: _parquet(part, names, ledger))
    if result.complete:
        ledger.clear()


def _parquet(path: Path, names: list[str], ledger: Ledger) -> None:
    """Write one row a trial: its number, and truth, estimate and u of each coefficient."""
    batches = np.flatnonzero(ledger.done)
    number = np.concatenate(
        [int(b) * ledger.size + np.arange(ledger.trials_of(int(b))) for b in batches]
    )
    columns = {"trial": pl.Series(number)}
    for place, name in enumerate(names):
        for part, word in enumerate(("truth", "estimate", "u")):
            values = [ledger.values[int(b)][place, part] for b in batches]
            columns[f"{name}.{word}"] = pl.Series(np.concatenate(values))
    write_open(path, pl.DataFrame(columns).write_parquet)
