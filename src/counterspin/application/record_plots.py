"""Plots of records and fits, checks of records, studies and simulations.

A screen has a few thousand columns of pixels. If a window has more rows, minimum and maximum of
each segment are drawn: outliers stay visible, and large records are drawn as fast as small ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import FiniteFloat

from counterspin.application.answers import (
    DurationAnswer,
    JobEntry,
    LiveAnswer,
    RecordAnswer,
    RecordOverview,
    RecordWindow,
    RunCheck,
)
from counterspin.application.app_state import AppState, FileCache
from counterspin.application.commands import (
    calibrate_command,
    check_command,
    simulate_command,
    study_command,
    watch_command,
)
from counterspin.application.jobs import Job, ProgressCallback, report_progress
from counterspin.application.served_folder import NotFoundError, RequestError
from counterspin.arrays import Array
from counterspin.calibration.observed_runs import record_columns
from counterspin.campaign.description import Campaign
from counterspin.campaign.documents import DESCRIPTION_NAME, load_document
from counterspin.campaign.runs import Run
from counterspin.campaign.settings import OBSERVABLES
from counterspin.errors import CounterspinError, ExistingFileError
from counterspin.frozen import frozen
from counterspin.monitoring.check import check
from counterspin.monitoring.run_state import resolve_goals
from counterspin.records.formats import read_scaled
from counterspin.reports.html import render_fragment
from counterspin.reports.typography import typeset_block


@frozen(eq=False)
class PlotColumns:
    """Columns of a record, or of its fit, in SI."""

    time: Array  #: Time, s, increasing, shape (n,); rows without a time are omitted.
    #: Names and units of the columns.
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: tuple[Array, ...]  #: Columns, each of shape (n,); NaN for empty cells.


#: Largest number of segments of a window.
MAX_WINDOW_SEGMENTS: Final = 4000

#: Number of cached records; each may have a million rows.
_MAX_RECORDS: Final = 4
_RECORD_CACHE: Final = FileCache(_MAX_RECORDS)


def record_overview(app: AppState, name: str, run: str, fit: bool = False) -> RecordAnswer:
    """Return columns, number of rows, first and last time, and used time range of a record.

    fit: Return data and fit of each accelerometer as columns; None before `begin_fit`.
    """
    campaign, run_description = _find_run(app, name, run)
    try:
        record = (
            get_fitted_run(app, name, run) if fit else _cached_record(campaign, run_description)
        )
    except NotFoundError:
        return {"overview": None}
    overview: RecordOverview = {
        "columns_per_plot": 2 if fit else 1,
        "columns": [
            {"name": column, "unit": unit}
            for column, unit in zip(record.names, record.units, strict=True)
        ],
        "rows": len(record.time),
        "first": float(record.time[0]),
        "last": float(record.time[-1]),
        "used": [time if math.isfinite(time) else None for time in run_description.time_range],
        "file": app.folder.name(run_description.record),
    }
    return {"overview": overview}


def record_window(
    app: AppState,
    name: str,
    run: str,
    low: FiniteFloat,
    high: FiniteFloat,
    parts: int = 1000,
    fit: bool = False,
) -> RecordWindow:
    """Return the values of a record between two times: all rows, or extremes of segments.

    name, run: The campaign's folder, and the run.
    low, high: First and last time, s.
    fit: As in `record_overview`.
    """
    record = get_fitted_run(app, name, run) if fit else _cached_record(*_find_run(app, name, run))
    # Include one more row on either side, so that lines continue to the edges of the window.
    start = max(int(np.searchsorted(record.time, low)) - 1, 0)
    stop = int(np.searchsorted(record.time, high, side="right")) + 1
    stop = max(min(stop, len(record.time)), start)
    parts = min(max(parts, 1), MAX_WINDOW_SEGMENTS)
    if stop - start <= 2 * parts:
        columns = [values[start:stop] for values in record.values]
        return _make_window(record.time[start:stop], columns, is_complete=True)
    edges = np.linspace(start, stop, parts + 1).astype(np.intp)
    starts, ends = record.time[edges[:-1]], record.time[edges[1:] - 1]
    time = np.stack([0.75 * starts + 0.25 * ends, 0.25 * starts + 0.75 * ends], axis=1).ravel()
    columns = [segment_extrema(values, edges).ravel() for values in record.values]
    return _make_window(time, columns, is_complete=False)


def segment_extrema(values: Array, edges: np.ndarray) -> Array:
    """Return minimum and maximum of each segment, shape (m, 2); NaN for empty segments.

    values: Shape (n,); NaN for missing values.
    edges: Start indices of the segments, and end of the last; increasing; shape (m + 1,).
    """
    segment_values, starts = values[: edges[-1]], edges[:-1]
    minimum = np.fmin.reduceat(segment_values, starts)
    maximum = np.fmax.reduceat(segment_values, starts)
    return np.stack([minimum, maximum], axis=1)


def _make_window(time: Array, columns: list[Array], *, is_complete: bool) -> RecordWindow:
    return {
        "time": [float(f"{seconds:.10g}") for seconds in time],
        "columns": [[_round_for_screen(value) for value in column] for column in columns],
        "is_complete": is_complete,
    }


def _round_for_screen(value: float) -> float | None:
    """Return a value rounded to the resolution of a screen."""
    return float(f"{value:.7g}") if math.isfinite(value) else None


def _find_run(app: AppState, name: str, run: str) -> tuple[Campaign, Run]:
    campaign = app.campaign(name)
    for candidate in campaign.runs:
        if candidate.name == run:
            return campaign, candidate
    raise NotFoundError(f"{name}: run {run!r} does not exist, or it has no record")


def _cached_record(campaign: Campaign, run: Run) -> PlotColumns:
    files = [campaign.path, run.record]
    return _RECORD_CACHE.get((campaign.path, run.name), files, lambda: _read_record(campaign, run))


def _read_record(campaign: Campaign, run: Run) -> PlotColumns:
    column_specs = record_columns(campaign, run)
    specs, names, units = [column_specs.time], [], []
    if column_specs.angle is not None:
        specs.append(column_specs.angle)
        names.append(column_specs.angle.name)
        units.append("rad")
    for accelerometer, spec in column_specs.signals.items():
        specs.append(spec)
        names.append(f"{accelerometer}: {spec.name}")
        units.append(OBSERVABLES[campaign.accelerometers[accelerometer].observable])
    dialect = campaign.recording_of(run).dialect
    time, *values = read_scaled(run.record, specs, dialect)
    valid_rows = np.flatnonzero(np.isfinite(time))
    if not len(valid_rows):
        raise CounterspinError(f"{run.record}: no row contains a time", code="no-rows")
    if len(valid_rows) < len(time) or np.any(np.diff(time) < 0.0):
        # A calibration refuses decreasing times; the plot sorts them.
        valid_rows = valid_rows[np.argsort(time[valid_rows], kind="stable")]
        time, values = time[valid_rows], [signal_values[valid_rows] for signal_values in values]
    return PlotColumns(time, tuple(names), tuple(units), tuple(values))


def check_run(app: AppState, name: str, run: str) -> RunCheck:
    """Return the check of a record as HTML, whether the record is good, and the command."""
    campaign = app.campaign(name)
    records = [candidate.record for candidate in campaign.runs if candidate.name == run]
    if not records:
        raise NotFoundError(f"{name}: run {run!r} does not exist, or it has no record")
    run_check = check(records[0], campaign, run=run)
    blocks = list(map(typeset_block, run_check.blocks()))
    return {
        "html": render_fragment(blocks, title=f"Check of {run}"),
        "good": run_check.good,
        "command": check_command(records[0], campaign.folder, run),
    }


def watch_state(app: AppState, name: str, goal: str = "") -> LiveAnswer:
    """Return the newest state of a campaign during recording, and the command.

    name: The campaign's folder.
    goal: Goal such as ``K_II 1e-8 g/g^2``; empty: none.
    """
    campaign = app.campaign(name)
    resolve_goals(campaign, [goal] if goal else [])  # raises an error for an invalid goal
    state = app.live.poll(campaign.path, goal)
    if "error" in state:
        state = {**state, "error": app.folder.relative_paths(state["error"])}
    return {**state, "command": watch_command(campaign.folder, goal)}


def begin_fit(app: AppState, name: str) -> JobEntry:
    """Start to fit a campaign's records for plots; return the job.

    name: The campaign's folder.
    """
    path = app.description_path(name)
    app.campaign(name).require_records("a plot of the fit")
    command = calibrate_command(path.parent, path.parent / "result.json", "joint", None)
    _, store = app.cache.lookup(*_fit_cache_key(app, name))

    def make_job(number: int) -> Job:
        return Job(number, name, "", command, "fit")

    return app.jobs.begin(make_job, run_fit, path, on_done=store).to_dict()


def get_fitted_run(app: AppState, name: str, run: str) -> PlotColumns:
    """Return data and fit of a run for each accelerometer; NotFoundError before `begin_fit`."""
    fitted_runs: Mapping[str, PlotColumns] | None = app.cache.lookup(*_fit_cache_key(app, name))[0]
    if fitted_runs is None or run not in fitted_runs:
        raise NotFoundError(
            f"{name}: the records of {run} have changed or have not been fitted yet"
        )
    return fitted_runs[run]


def _fit_cache_key(app: AppState, name: str) -> tuple[tuple[str, Path], list[Path]]:
    path = app.description_path(name)
    return ("fit", path), [path, *(run.record for run in app.campaign(name).runs)]


def run_fit(connection: Connection, campaign: Path) -> None:
    """Fit a campaign's records; report to `connection` as in `report_progress`."""

    def fit_records(_: ProgressCallback) -> dict[str, PlotColumns]:
        from counterspin.calibration.joint import estimate_campaign
        from counterspin.calibration.joint_problem import JointProblem
        from counterspin.calibration.observed_runs import add_recorded_conditions, observe_runs
        from counterspin.campaign.description import read_campaign
        from counterspin.threads import single_blas_thread

        with single_blas_thread():
            recorded_campaign = add_recorded_conditions(read_campaign(campaign))
            fit = estimate_campaign(
                JointProblem(recorded_campaign, list(observe_runs(recorded_campaign)))
            )[0].fit
            runs: dict[str, list[tuple[str, str, Array, Array, Array]]] = {}
            for design_block, residuals in zip(fit.design_blocks, fit.residuals, strict=True):
                series = design_block.series
                detrended_error = subtract_polynomial(series.time, series.error, series.order)
                # The same polynomial is subtracted from both, so their difference is the residual.
                runs.setdefault(series.run, []).append(
                    (
                        series.accelerometer,
                        series.observable,
                        series.time,
                        detrended_error,
                        detrended_error - residuals.unweighted,
                    )
                )
        return {run: _merge_columns(run_series) for run, run_series in runs.items()}

    report_progress(connection, fit_records)


def subtract_polynomial(time: Array, values: Array, degree: int) -> Array:
    """Return values minus their least-squares polynomial."""
    scaled_time = time / max(float(np.max(np.abs(time))), 1e-300)
    powers = np.vander(scaled_time, degree + 1)
    return np.asarray(values - powers @ np.linalg.lstsq(powers, values, rcond=None)[0])


def _merge_columns(run_series: list[tuple[str, str, Array, Array, Array]]) -> PlotColumns:
    """Return data and fit of all accelerometers at the union of their times."""
    from counterspin.campaign.settings import OBSERVABLES

    trend_names = {"displacement": "parabola", "velocity": "line", "specific_force": "mean"}
    time = np.unique(np.concatenate([series_time for _, _, series_time, _, _ in run_series]))
    names, units, values = [], [], []
    for accelerometer, observable, series_time, data_values, fit_values in run_series:
        for label, series_values in (("data", data_values), ("fit", fit_values)):
            column = np.full(time.size, np.nan)
            column[np.searchsorted(time, series_time)] = series_values
            values.append(column)
            names.append(f"{accelerometer}: {label}, {trend_names[observable]} removed")
            units.append(OBSERVABLES[observable])
    return PlotColumns(time, tuple(names), tuple(units), tuple(values))


#: File name of a study in the campaign folder.
STUDY_NAME: Final = "study.json"


def begin_study(app: AppState, name: str, trials: int) -> JobEntry:
    """Start to study a campaign; return the job.

    name: The campaign's folder; the result replaces its ``study.json``.
    """
    from counterspin.studies.description import read_study

    path = app.description_path(name)
    app.campaign(name)
    read_study(path)
    target = app.folder.path(f"{name}/{STUDY_NAME}" if name else STUDY_NAME)
    command = study_command(path.parent, trials, target)

    def make_job(number: int) -> Job:
        return Job(number, name, app.folder.name(target), command, "study")

    return app.jobs.begin(make_job, run_study, path, target, trials).to_dict()


def get_study_duration(app: AppState, name: str) -> DurationAnswer:
    """Return the expected duration of a study on one core, or the job that estimates it.

    name: The campaign's folder.
    """
    from counterspin.studies.description import read_study

    path = app.description_path(name)
    files = [path, *(run.record for run in app.campaign(name).runs)]
    duration, store = app.cache.lookup(("duration", path), files)
    if duration is not None:
        return {
            "job": None,
            "duration": {
                "preparation": duration.preparation,
                "per_trial": duration.per_trial,
                "slow_analyses": duration.slow_analyses,
            },
        }
    read_study(path)
    command = study_command(path.parent, 1000, path.parent / STUDY_NAME)

    def make_job(number: int) -> Job:
        return Job(number, name, "", command, "estimate")

    job = app.jobs.begin(make_job, run_duration_estimate, path, on_done=store)
    return {"job": job.to_dict(), "duration": None}


def run_duration_estimate(connection: Connection, campaign: Path) -> None:
    """Estimate the duration of a study; report to `connection` as in `report_progress`."""

    def estimate_study_duration(_: ProgressCallback) -> Any:
        from counterspin.studies.study import estimate_duration

        return estimate_duration(campaign)

    report_progress(connection, estimate_study_duration)


def run_study(connection: Connection, campaign: Path, output: Path, trials: int) -> None:
    """Study a campaign and write the result; report to `connection` as in `report_progress`."""

    def run_and_write(progress: ProgressCallback) -> None:
        from counterspin.output import check_writable
        from counterspin.studies.result import StudyResult
        from counterspin.studies.study import study

        check_writable(output, StudyResult.file_kind, overwrite=True)
        study(campaign, trials=trials, progress=progress).write(output, overwrite=True)

    report_progress(connection, run_and_write)


def begin_simulation(app: AppState, name: str, folder: str) -> JobEntry:
    """Start to simulate the records of a campaign in another folder; return the job.

    name: The campaign's folder.
    """
    path = app.description_path(name)
    app.campaign(name)
    target = app.target_path(folder)
    if not folder:
        raise RequestError("enter a folder name for the simulated records")
    if (target / DESCRIPTION_NAME).exists():
        raise ExistingFileError(f"{folder} already contains a campaign; choose another folder")
    app.require_inside(target, load_document(path))
    command = simulate_command(path.parent, target)

    def make_job(number: int) -> Job:
        return Job(number, name, app.folder.name(target), command, "simulation")

    return app.jobs.begin(make_job, run_simulation, path, target).to_dict()


def run_simulation(connection: Connection, campaign: Path, folder: Path) -> None:
    """Simulate a campaign's records in a folder; report as in `report_progress`."""

    def simulate_records(progress: ProgressCallback) -> None:
        from counterspin.simulation.simulate import simulate

        simulate(campaign, folder, progress=progress)

    report_progress(connection, simulate_records)
