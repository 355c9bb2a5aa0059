"""Records minus their reference with the fit, and the uncertainty with better inputs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from pydantic import FiniteFloat

from counterspin.application.desk import Desk, calibrate_command, forecast_command
from counterspin.application.editing import checked_campaign, with_value
from counterspin.application.folder import NotThereError
from counterspin.application.jobs import Job, Progress, report_progress
from counterspin.application.keeping import copy_campaign, free_name
from counterspin.arrays import Array
from counterspin.calibration.pages.uncertainty import IMPROVEMENT_FACTOR
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult
from counterspin.campaign.documents import DESCRIPTION_NAME, key_path, load_document
from counterspin.errors import CounterspinError
from counterspin.frozen import frozen
from counterspin.inference.joint.summary import WhatIf
from counterspin.physics.terms import (
    ACCELEROMETER_TERMS,
    INPUTS,
    description_of,
    is_term,
    symbol_of,
    term,
)
from counterspin.planning.recorded import SuggestedRuns
from counterspin.reports.numbers import field_unit, format_number, format_uncertainty
from counterspin.reports.typography import typeset


@frozen(eq=False)
class SeenRecord:
    """Columns of a record, or of its fit, in SI."""

    time: Array  #: s, increasing, shape (n,); rows without a time are left out.
    #: Of the columns.
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: tuple[Array, ...]  #: The columns, each of shape (n,); NaN where a cell is empty.


def begin_fit(desk: Desk, name: str) -> dict[str, Any]:
    """Start to fit a campaign's records for their pictures; return the job.

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
    """Fit a campaign's records; report to `there` as `processes.report_progress` does."""

    def work(_: Progress) -> dict[str, SeenRecord]:
        from counterspin.calibration.joint import estimate_campaign
        from counterspin.calibration.joint_problem import JointProblem
        from counterspin.calibration.observed_runs import observe, with_recorded_conditions
        from counterspin.campaign.description import read_campaign
        from counterspin.threads import one_blas_thread

        with one_blas_thread():
            read = with_recorded_conditions(read_campaign(campaign))
            fit = estimate_campaign(JointProblem(read, list(observe(read))))[0].fit
            runs: dict[str, list[tuple[str, str, Array, Array, Array]]] = {}
            for prepared, residuals in zip(fit.design_blocks, fit.residuals, strict=True):
                one = prepared.series
                flat = less_polynomial(one.time, one.error, one.order)
                # The same polynomial is taken from both: their difference is the residual.
                runs.setdefault(one.run, []).append(
                    (one.accelerometer, one.observable, one.time, flat, flat - residuals.unweighted)
                )
        return {run: _together(parts) for run, parts in runs.items()}

    report_progress(there, work)


def less_polynomial(time: Array, values: Array, degree: int) -> Array:
    """Return values minus their best polynomial, of the degree of the bias's effect."""
    scaled = time / max(float(np.max(np.abs(time))), 1e-300)
    powers = np.vander(scaled, degree + 1)
    return np.asarray(values - powers @ np.linalg.lstsq(powers, values, rcond=None)[0])


def _together(parts: list[tuple[str, str, Array, Array, Array]]) -> SeenRecord:
    """Return data and fit of all accelerometers at the union of their times."""
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


#: Sources that a page has room for.
_MOST: Final = 6

#: A way that leaves more than this part of the uncertainty is none.
_WORTH: Final = 0.95


def uncertainty_if(
    desk: Desk, name: str, accelerometer: str, known: dict[str, FiniteFloat] | None = None
) -> dict[str, Any]:
    """Return u of the first requested coefficient, and its budget.

    name: The result's file.
    known: Source -> its standard uncertainty, SI or g-units; others stay as they are.
    """
    found = _accelerometer(desk.result(name), accelerometer)
    symbol, update = _asked(found)
    try:
        parts = update.parts(symbol, known or {})
    except ValueError as error:
        raise CounterspinError(f"{accelerometer}: {error}") from error
    u = math.sqrt(sum(parts.values()))
    shown = sorted(update.known, key=lambda source: -parts[source])
    if not known:
        shown = [source for source in shown if parts[source] > 0.0][:_MOST]
    units = dict(zip(update.names, update.units, strict=True))
    return {
        "symbol": symbol,
        "u": u,
        "text": _size(u, found.coefficients[symbol].unit),
        "sources": [
            {
                "name": source,
                "words": description_of(source),
                "u": update.known[source],
                "factor": field_unit(units[source])[1],
                "unit": typeset(field_unit(units[source])[0]),
                "share": parts[source] / u**2,
            }
            for source in shown
        ],
    }


def ways(desk: Desk, name: str, result: str) -> dict[str, Any]:
    """Return for each accelerometer the cheapest known ways to a smaller uncertainty.

    name: The campaign's folder.
    result: The result's file.
    """
    known = _searched(desk, name)
    told = []
    for owner, found in desk.result(result).accelerometers.items():
        stated = next(_stated(desk.result(result), owner), None)
        if stated is None:
            continue
        told.append(
            {
                "accelerometer": owner,
                "stated": stated,
                "runs": None if known is None else _shown(known.get(owner), found),
            }
        )
    return {"ways": told, "searched": known is not None, "has_runs": _has_records(desk, name)}


def _has_records(desk: Desk, name: str) -> bool:
    """Return whether a campaign can be read, and has runs that further runs can follow."""
    try:
        return bool(desk.campaign(name).runs)
    except CounterspinError:
        return False


def _stated(result: Result, owner: str) -> Iterator[dict[str, Any]]:
    """Yield the priors that may be stated, the one with the smallest remaining u first."""
    found = _accelerometer(result, owner)
    if found.what_if is None or not _symbol(found):
        return
    symbol, update = _asked(found)
    unit, lines = found.coefficients[symbol].unit, found.budget[symbol]
    now = update.u(symbol, {})
    left = {}
    for line in lines:
        known = update.known.get(line.source)
        if line.kind == "unstated" and known is not None and _is_prior(line.source):
            left[line.source] = update.u(symbol, {line.source: IMPROVEMENT_FACTOR * known})
    for source in sorted(left, key=lambda one: left[one]):
        if left[source] > _WORTH * now:
            return
        size, unit_of_source = (
            IMPROVEMENT_FACTOR * update.known[source],
            term(symbol_of(source)).unit,
        )
        yield {
            "symbol": symbol,
            "source": source,
            "words": description_of(source),
            "known": _size(size, unit_of_source),
            "now": _size(now, unit),
            "left": _size(left[source], unit),
        }


def _is_prior(source: str) -> bool:
    """Return whether [model.priors] states a source; inputs have other keys."""
    return is_term(source) and source not in INPUTS


def _shown(further: SuggestedRuns | None, found: AccelerometerResult) -> dict[str, Any] | None:
    if further is None:
        return None
    unit = found.coefficients[_asked(found)[0]].unit
    return {
        "attitude": further.attitude,
        "count": len(further.runs),
        "minutes": format_number(further.seconds / 60.0, 2),
        "left": _size(further.u, unit),
        "now": _size(further.u_without, unit),
    }


def begin_search(desk: Desk, name: str) -> dict[str, Any]:
    """Start a search for helpful runs in another attitude; return the job."""
    path = desk.description(name)
    campaign = desk.campaign(name)
    _, keep = desk.remembered.find(("ways", path), [path, *(run.record for run in campaign.runs)])

    def make(number: int) -> Job:
        return Job(number, name, "", forecast_command(path.parent), "forecast")

    return desk.jobs.begin(make, search_into, path, then=keep).shown()


def search_into(there: Connection, campaign: Path) -> None:
    """Search for helpful runs; report to `there` as `processes.report_progress` does."""

    def work(progress: Progress) -> dict[str, SuggestedRuns | None]:
        from counterspin.calibration.observed_runs import with_recorded_conditions
        from counterspin.campaign.description import read_campaign
        from counterspin.planning.recorded import observe_with_noise, suggest_runs

        read = with_recorded_conditions(read_campaign(campaign))
        observed, noise = observe_with_noise(read)
        found = {}
        for place, owner in enumerate(read.accelerometers):
            progress(place, len(read.accelerometers))
            symbol = "K_II" if "K_II" in read.model.terms else read.model.terms[0]
            found[owner] = suggest_runs(read, observed, noise, f"{owner}.{symbol}")
        return found

    report_progress(there, work)


def _searched(desk: Desk, name: str) -> dict[str, SuggestedRuns | None] | None:
    """Return the results of the search by accelerometer; None without a search."""
    path = desk.description(name)
    try:
        files = [path, *(run.record for run in desk.campaign(name).runs)]
    except CounterspinError:
        return None
    known: dict[str, SuggestedRuns | None] | None = desk.remembered.find(("ways", path), files)[0]
    return known


def prepare_way(
    desk: Desk, name: str, result: str, accelerometer: str, way: Literal["state", "runs"]
) -> dict[str, Any]:
    """Copy a campaign and write a way to a smaller uncertainty into the copy; return its name.

    The answer's ``key`` is that of the value to be replaced, or None.

    name: The campaign's folder.
    result: The result's file.
    way: A prior, whose value is to be replaced by a measured one; or runs to be recorded.
    """
    source = desk.description(name)
    before = desk.folder.read(desk.folder.name(source))
    text, key = before.text, None
    if way == "state":
        prior, ending = _prior(desk.result(result), accelerometer)
        text = with_value(text, ["model", "priors", prior[0]], prior[1])
        key = key_path(("model", "priors", prior[0]))
    else:
        further = (_searched(desk, name) or {}).get(accelerometer)
        if further is None:
            raise NotThereError(
                f"{accelerometer}: no further runs were found; search for them first"
            )
        first, ending = len(load_document(source).get("runs", [])), "further-runs"
        for place, run in enumerate(further.runs):
            text = with_value(text, ["runs", first + place], run)
    if problems := checked_campaign(desk, source, text).problems:
        raise CounterspinError(": ".join(problems[0]))
    copy = copy_campaign(desk, name, free_name(desk, f"{name}-{ending}"))["name"]
    desk.folder.write(f"{copy}/{DESCRIPTION_NAME}", text, before.version)
    return {"name": copy, "key": key}


def _prior(result: Result, accelerometer: str) -> tuple[tuple[str, str], str]:
    """Return the key and the text of the most helpful prior, and its term."""
    stated = next(_stated(result, accelerometer), None)
    if stated is None:
        raise NotThereError(f"{accelerometer}: stating one thing more would not reduce its u")
    source, (_, update) = stated["source"], _asked(_accelerometer(result, accelerometer))
    symbol = symbol_of(source)
    row = term(symbol)
    key = f"{accelerometer}.{source}" if symbol in ACCELEROMETER_TERMS else symbol
    size = IMPROVEMENT_FACTOR * update.known[source]
    return (key, f"{row.nominal:g} ± {size:.2g} {row.unit}"), symbol


def _accelerometer(result: Result, name: str) -> AccelerometerResult:
    if name not in result.accelerometers:
        raise NotThereError(f"the result has no accelerometer {name!r}")
    return result.accelerometers[name]


def _symbol(found: AccelerometerResult) -> str:
    """Return the first requested coefficient; empty if none is determined."""
    names = found.what_if.names if found.what_if else []
    asked = [symbol for symbol in found.budget if symbol in names and symbol in found.coefficients]
    return "K_II" if "K_II" in asked else next(iter(asked), "")


def _asked(found: AccelerometerResult) -> tuple[str, WhatIf]:
    symbol = _symbol(found)
    if found.what_if is None or not symbol:
        raise NotThereError(
            "the result does not state what its uncertainty depends on; calibrate again"
        )
    return symbol, found.what_if


def _size(u: float, unit: str) -> str:
    """Return an uncertainty in the unit of the field."""
    shown, factor = field_unit(unit)
    return typeset(f"{format_uncertainty(u * factor)} {shown}".strip())
