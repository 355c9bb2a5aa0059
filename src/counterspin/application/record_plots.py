"""Records as they are seen through a window of time: fluid for any number of rows.

A screen has some thousand columns of pixels. Of more rows than that, each part of the window is
shown by its least and its greatest value, so that no outlier is lost and a million rows are as
quickly drawn as a thousand.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from pydantic import FiniteFloat

from counterspin.application.desk import Desk, FileCache
from counterspin.application.fits import SeenRecord, fitted_run
from counterspin.application.folder import NotThereError
from counterspin.arrays import Array
from counterspin.calibration.observed import record_columns
from counterspin.campaign.description import Campaign
from counterspin.campaign.runs import Run
from counterspin.campaign.settings import OBSERVABLES
from counterspin.errors import CounterspinError
from counterspin.records.tables import read_scaled

#: Most parts that a window is shown in.
MOST_PARTS: Final = 4000

#: Records that are kept; each may have a million rows.
_MAX_RECORDS: Final = 4
_RECORDS: Final = FileCache(_MAX_RECORDS)


def record_overview(desk: Desk, name: str, run: str, fit: bool = False) -> dict[str, Any]:
    """Return a record's columns, rows, first and last time, and what is used of it.

    fit: Whether its columns are data and fit of each accelerometer, as of `fits.begin_fit`.
    """
    campaign, found = _run(desk, name, run)
    record = fitted_run(desk, name, run) if fit else _record(campaign, found)
    return {
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
    """Return the least and the greatest value of each part, NaN where it has none.

    values: Shape (n,); NaN where there is none.
    edges: Where parts begin, and where the last one ends; increasing; shape (m + 1,).
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
    """Return a value to what any screen shows."""
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
