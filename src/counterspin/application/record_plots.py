"""Plots and judgements of records; studies and simulations before recording.

A screen has some thousand columns of pixels. With more rows, each part of the window is drawn by
its least and greatest value: no outlier is lost, and a million rows take no longer than a thousand.
"""

from __future__ import annotations

import math
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import FiniteFloat

from counterspin.application.desk import (
    Desk,
    FileCache,
    check_command,
    simulate_command,
    study_command,
    watch_command,
)
from counterspin.application.folder import NotThereError
from counterspin.application.improving import SeenRecord, fitted_run
from counterspin.application.jobs import Job, Progress, report_progress
from counterspin.arrays import Array
from counterspin.calibration.observed_runs import record_columns
from counterspin.campaign.description import Campaign
from counterspin.campaign.documents import DESCRIPTION_NAME, load_document
from counterspin.campaign.runs import Run
from counterspin.campaign.settings import OBSERVABLES
from counterspin.errors import CounterspinError
from counterspin.monitoring.check import check
from counterspin.monitoring.run_state import resolve_goals
from counterspin.records.formats import read_scaled
from counterspin.reports.html import html_fragment
from counterspin.reports.typography import typeset_block

#: Most parts that a window is shown in.
MOST_PARTS: Final = 4000

#: Records that are kept; each may have a million rows.
_MAX_RECORDS: Final = 4
_RECORDS: Final = FileCache(_MAX_RECORDS)


def record_overview(desk: Desk, name: str, run: str, fit: bool = False) -> dict[str, Any]:
    """Return a record's columns, rows, first and last time, and its used part.

    fit: Return data and fit of each accelerometer as the columns, as of `improving.begin_fit`;
        before that ``fitted`` is false, and nothing else is returned.
    """
    campaign, found = _run(desk, name, run)
    try:
        record = fitted_run(desk, name, run) if fit else _record(campaign, found)
    except NotThereError:
        return {"fitted": False}
    return {
        "fitted": fit,
        "together": 2 if fit else 1,
        "columns": [
            {"name": column, "unit": unit}
            for column, unit in zip(record.names, record.units, strict=True)
        ],
        "rows": len(record.time),
        "first": float(record.time[0]),
        "last": float(record.time[-1]),
        "used": [limit if math.isfinite(limit) else None for limit in found.part],
        "file": desk.folder.name(found.record),
    }


def record_window(
    desk: Desk,
    name: str,
    run: str,
    low: FiniteFloat,
    high: FiniteFloat,
    parts: int = 1000,
    fit: bool = False,
) -> dict[str, Any]:
    """Return the values of a record between two times, row by row or as extremes of parts.

    name, run: The campaign's folder, and the run.
    low, high: First and last time, s.
    fit: As of `record_overview`.
    """
    record = fitted_run(desk, name, run) if fit else _record(*_run(desk, name, run))
    # One more on either side, so that lines leave the window.
    first = max(int(np.searchsorted(record.time, low)) - 1, 0)
    last = int(np.searchsorted(record.time, high, side="right")) + 1
    last = max(min(last, len(record.time)), first)
    parts = min(max(parts, 1), MOST_PARTS)
    if last - first <= 2 * parts:
        columns = [values[first:last] for values in record.values]
        return _shown(record.time[first:last], columns, whole=True)
    edges = np.linspace(first, last, parts + 1).astype(np.intp)
    begins, ends = record.time[edges[:-1]], record.time[edges[1:] - 1]
    time = np.stack([0.75 * begins + 0.25 * ends, 0.25 * begins + 0.75 * ends], axis=1).ravel()
    columns = [least_and_greatest(values, edges).ravel() for values in record.values]
    return _shown(time, columns, whole=False)


def least_and_greatest(values: Array, edges: np.ndarray) -> Array:
    """Return the least and the greatest value of each part, NaN for an empty part.

    values: Shape (n,); NaN for missing values.
    edges: The start of each part, and the end of the last; increasing; shape (m + 1,).
    """
    taken, begins = values[: edges[-1]], edges[:-1]
    least, greatest = np.fmin.reduceat(taken, begins), np.fmax.reduceat(taken, begins)
    return np.stack([least, greatest], axis=1)


def _shown(time: Array, columns: list[Array], *, whole: bool) -> dict[str, Any]:
    return {
        "time": [float(f"{t:.10g}") for t in time],
        "columns": [[_rounded(value) for value in column] for column in columns],
        "whole": whole,
    }


def _rounded(value: float) -> float | None:
    """Return a value rounded to the resolution of a screen."""
    return float(f"{value:.7g}") if math.isfinite(value) else None


def _run(desk: Desk, name: str, run: str) -> tuple[Campaign, Run]:
    campaign = desk.campaign(name)
    for found in campaign.runs:
        if found.name == run:
            return campaign, found
    raise NotThereError(f"{name}: there is no run {run!r} with a record")


def _record(campaign: Campaign, run: Run) -> SeenRecord:
    files = [campaign.path, run.record]
    return _RECORDS.get((campaign.path, run.name), files, lambda: _read(campaign, run))


def _read(campaign: Campaign, run: Run) -> SeenRecord:
    columns = record_columns(campaign, run)
    specs, names, units = [columns.time], [], []
    if columns.angle is not None:
        specs.append(columns.angle)
        names.append(columns.angle.name)
        units.append("rad")
    for accelerometer, spec in columns.signals.items():
        specs.append(spec)
        names.append(f"{accelerometer}: {spec.name}")
        units.append(OBSERVABLES[campaign.accelerometers[accelerometer].observable])
    dialect = campaign.recording_of(run).dialect
    time, *values = read_scaled(run.record, specs, dialect)
    known = np.flatnonzero(np.isfinite(time))
    if not len(known):
        raise CounterspinError(f"{run.record}: no row has a time")
    if len(known) < len(time) or np.any(np.diff(time) < 0.0):
        # What runs backwards is refused by a calibration; here it is shown in the order of time.
        known = known[np.argsort(time[known], kind="stable")]
        time, values = time[known], [column[known] for column in values]
    return SeenRecord(time, tuple(names), tuple(units), tuple(values))


def run_judgement(desk: Desk, name: str, run: str) -> dict[str, Any]:
    """Return the judgement of a run's record as HTML, whether it is good, and the command."""
    campaign = desk.campaign(name)
    records = [found.record for found in campaign.runs if found.name == run]
    if not records:
        raise NotThereError(f"{name}: there is no run {run!r} with a record")
    checked = check(records[0], campaign, run=run)
    blocks = list(map(typeset_block, checked.blocks()))
    return {
        "html": html_fragment(blocks, title=f"Check of {run}"),
        "good": checked.good,
        "command": check_command(records[0], campaign.folder, run),
    }


def campaign_state(desk: Desk, name: str, goal: str = "") -> dict[str, Any]:
    """Return the newest state of a campaign whose records grow, and the command.

    name: The campaign's folder.
    goal: Such as ``K_II 1e-8 g/g^2``; empty: none.
    """
    campaign = desk.campaign(name)
    resolve_goals(campaign, [goal] if goal else [])  # a mistake is told before anything is begun
    told = desk.live.look(campaign.path, goal)
    if "error" in told:
        told = told | {"error": desk.folder.spoken(told["error"])}
    return told | {"command": watch_command(campaign.folder, goal)}


#: Where a study of a campaign is kept, in its folder.
STUDY_NAME: Final = "study.json"


def begin_study(desk: Desk, name: str, trials: int) -> dict[str, Any]:
    """Start to study a campaign; return the job.

    name: The campaign's folder; the result replaces its ``study.json``.
    """
    from counterspin.studies.description import read_study

    path = desk.description(name)
    desk.campaign(name)
    read_study(path)
    place = desk.folder.path(f"{name}/{STUDY_NAME}" if name else STUDY_NAME)
    command = study_command(path.parent, trials, place)

    def make(number: int) -> Job:
        return Job(number, name, desk.folder.name(place), command, "study")

    return desk.jobs.begin(make, study_into, path, place, trials).shown()


def study_into(there: Connection, campaign: Path, output: Path, trials: int) -> None:
    """Study a campaign and write its result; report to `there` as `report_progress` does."""

    def work(progress: Progress) -> None:
        from counterspin.output import reserve
        from counterspin.studies.result import StudyResult
        from counterspin.studies.study import study

        reserve(output, StudyResult.file_kind, overwrite=True)
        study(campaign, trials=trials, progress=progress).write(output, overwrite=True)

    report_progress(there, work)


def begin_simulation(desk: Desk, name: str, folder: str) -> dict[str, Any]:
    """Start to make the records of a campaign, in another folder; return the job.

    name: The campaign's folder.
    """
    path = desk.description(name)
    desk.campaign(name)
    place = desk.place(folder)
    if not folder:
        raise CounterspinError("give the folder of the simulated records a name")
    if (place / DESCRIPTION_NAME).exists():
        raise CounterspinError(f"{folder} holds a campaign already; name another folder")
    desk.require_inside(place, load_document(path))
    command = simulate_command(path.parent, place)

    def make(number: int) -> Job:
        return Job(number, name, desk.folder.name(place), command, "simulation")

    return desk.jobs.begin(make, simulate_into, path, place).shown()


def simulate_into(there: Connection, campaign: Path, folder: Path) -> None:
    """Make a campaign's records in a folder; report to `there` as `report_progress` does."""

    def work(progress: Progress) -> None:
        from counterspin.simulation.simulate import simulate

        simulate(campaign, folder, progress=progress)

    report_progress(there, work)
