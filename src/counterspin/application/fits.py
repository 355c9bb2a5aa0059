"""Records less their reference, with the joint fit: what the coefficients do, to be seen."""

from __future__ import annotations

from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from counterspin.application.commands import calibrate_command
from counterspin.application.desk import Desk
from counterspin.application.folder import NotThereError
from counterspin.application.jobs import Job
from counterspin.application.processes import Progress, report_progress
from counterspin.arrays import Array
from counterspin.frozen import frozen


@frozen(eq=False)
class SeenRecord:
    """Columns of a record, or of its fit, in SI."""

    time: Array  #: s, increasing, shape (n,); rows without a time are left out.
    #: Of the columns.
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: tuple[Array, ...]  #: The columns, each of shape (n,); NaN where a cell is empty.


def begin_fit(desk: Desk, name: str) -> dict[str, Any]:
    """Begin to fit a campaign's records for their pictures; return the job.

    name: The campaign's folder.
    """
    path = desk.description(name)
    desk.campaign(name).require_records("a picture of the fit")
    command = calibrate_command(path.parent, path.parent / "result.json", "joint", None)
    _, keep = desk.remembered.find(*_key(desk, name))

    def make(number: int) -> Job:
        return Job(number, name, "", command, "fit")

    return desk.jobs.begin(make, fit_into, path, then=keep).shown()


def fitted_run(desk: Desk, name: str, run: str) -> SeenRecord:
    """Return data and fit of a run, for each accelerometer; NotThereError before `begin_fit`."""
    known: Mapping[str, SeenRecord] | None = desk.remembered.find(*_key(desk, name))[0]
    if known is None or run not in known:
        raise NotThereError(f"{name}: the records of {run} are not fitted yet, or were changed")
    return known[run]


def _key(desk: Desk, name: str) -> tuple[tuple[str, Path], list[Path]]:
    path = desk.description(name)
    return ("fit", path), [path, *(run.record for run in desk.campaign(name).runs)]


def fit_into(there: Connection, campaign: Path) -> None:
    """Fit a campaign's records; `there` is told as of `processes.report_progress`."""

    def work(_: Progress) -> dict[str, SeenRecord]:
        from counterspin.calibration.joint import estimate_campaign
        from counterspin.calibration.joint_problem import JointProblem
        from counterspin.calibration.observed import observe, with_recorded_temperatures
        from counterspin.campaign.description import read_campaign
        from counterspin.workers import one_blas_thread

        with one_blas_thread():
            read = with_recorded_temperatures(read_campaign(campaign))
            fit = estimate_campaign(JointProblem(read, list(observe(read))))[0].fit
            runs: dict[str, list[tuple[str, str, Array, Array, Array]]] = {}
            for prepared, residuals in zip(fit.prepared, fit.residuals, strict=True):
                one = prepared.series
                flat = less_polynomial(one.time, one.error, one.order)
                # The same polynomial is taken from both: their difference is the residual.
                runs.setdefault(one.run, []).append(
                    (one.accelerometer, one.observable, one.time, flat, flat - residuals.plain)
                )
        return {run: _together(parts) for run, parts in runs.items()}

    report_progress(there, work)


def less_polynomial(time: Array, values: Array, degree: int) -> Array:
    """Return values less their best polynomial: that of a bias has as many powers as integrals."""
    scaled = time / max(float(np.max(np.abs(time))), 1e-300)
    powers = np.vander(scaled, degree + 1)
    return np.asarray(values - powers @ np.linalg.lstsq(powers, values, rcond=None)[0])


def _together(parts: list[tuple[str, str, Array, Array, Array]]) -> SeenRecord:
    """Return data and fit of all accelerometers at the times of any."""
    from counterspin.campaign.settings import OBSERVABLES

    taken = {"displacement": "parabola", "velocity": "line", "specific_force": "mean"}
    time = np.unique(np.concatenate([own for _, _, own, _, _ in parts]))
    names, units, values = [], [], []
    for accelerometer, observable, own, data, fitted in parts:
        for words, column in (("data", data), ("fit", fitted)):
            whole = np.full(time.size, np.nan)
            whole[np.searchsorted(time, own)] = column
            values.append(whole)
            names.append(f"{accelerometer}: {words} less its {taken[observable]}")
            units.append(OBSERVABLES[observable])
    return SeenRecord(time, tuple(names), tuple(units), tuple(values))
