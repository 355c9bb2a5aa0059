"""The uncertainty with better priors or further runs, and campaigns prepared for them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, Literal

from pydantic import FiniteFloat

from counterspin.application.answers import (
    Improvement,
    Improvements,
    JobEntry,
    PreparedCopy,
    PriorImprovement,
    RunImprovement,
    WhatIfAnswer,
)
from counterspin.application.app_state import AppState
from counterspin.application.campaign_files import copy_campaign, find_free_name
from counterspin.application.commands import forecast_command
from counterspin.application.editing import parse_campaign_text, set_value
from counterspin.application.jobs import Job, ProgressCallback, report_progress
from counterspin.application.served_folder import NotFoundError
from counterspin.calibration.pages.uncertainty import IMPROVEMENT_FACTOR
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult
from counterspin.campaign.documents import DESCRIPTION_NAME, format_key_path, load_document
from counterspin.errors import CounterspinError, error_code
from counterspin.inference.joint.summary import WhatIf
from counterspin.physics.terms import (
    ACCELEROMETER_TERMS,
    INPUTS,
    describe_term,
    find_symbol,
    is_term,
    term,
)
from counterspin.planning.recorded import SuggestedRuns
from counterspin.reports.numbers import find_display_unit, format_number, format_uncertainty
from counterspin.reports.typography import typeset

#: Largest number of sources on a page.
_MAX_SOURCES: Final = 6

#: Largest ratio of the remaining to the current uncertainty of a useful improvement.
_MAX_REMAINING_FRACTION: Final = 0.95


def what_if(
    app: AppState, name: str, accelerometer: str, known: dict[str, FiniteFloat] | None = None
) -> WhatIfAnswer:
    """Return u of the first requested coefficient, and its budget.

    name: The result file.
    known: Source -> new standard uncertainty, SI or g-units; other sources are unchanged.
    """
    accelerometer_result = _require_accelerometer(app.result(name), accelerometer)
    symbol, update = _require_update(accelerometer_result)
    try:
        variances = update.parts(symbol, known or {})
    except ValueError as error:
        raise CounterspinError(f"{accelerometer}: {error}", code=error_code(error)) from error
    u = math.sqrt(sum(variances.values()))
    sources = sorted(update.known, key=lambda source: -variances[source])
    if not known:
        sources = [source for source in sources if variances[source] > 0.0][:_MAX_SOURCES]
    units = dict(zip(update.names, update.units, strict=True))
    return {
        "symbol": symbol,
        "u": u,
        "text": _format_u(u, accelerometer_result.coefficients[symbol].unit),
        "sources": [
            {
                "name": source,
                "words": describe_term(source),
                "u": update.known[source],
                "factor": find_display_unit(units[source])[1],
                "unit": typeset(find_display_unit(units[source])[0]),
                "share": variances[source] / u**2,
            }
            for source in sources
        ],
    }


def improvements(app: AppState, name: str, result: str) -> Improvements:
    """Return the most effective known improvements of each accelerometer.

    name: The campaign's folder.
    result: The result file.
    """
    suggestion_by_name = _get_search_results(app, name)
    entries: list[Improvement] = []
    for owner, accelerometer_result in app.result(result).accelerometers.items():
        best_prior = next(_prior_improvements(app.result(result), owner), None)
        if best_prior is None:
            continue
        entries.append(
            {
                "accelerometer": owner,
                "stated": best_prior,
                "runs": None
                if suggestion_by_name is None
                else _run_improvement(suggestion_by_name.get(owner), accelerometer_result),
            }
        )
    return {
        "ways": entries,
        "searched": suggestion_by_name is not None,
        "has_runs": _has_records(app, name),
    }


def _has_records(app: AppState, name: str) -> bool:
    """Return whether a campaign can be read and has runs."""
    try:
        return bool(app.campaign(name).runs)
    except CounterspinError:
        return False


def _prior_improvements(result: Result, owner: str) -> Iterator[PriorImprovement]:
    """Yield possible improvements of priors, in ascending order of the remaining u."""
    accelerometer_result = _require_accelerometer(result, owner)
    if accelerometer_result.what_if is None or not _requested_symbol(accelerometer_result):
        return
    symbol, update = _require_update(accelerometer_result)
    unit = accelerometer_result.coefficients[symbol].unit
    lines = accelerometer_result.budget[symbol]
    current_u = update.u(symbol, {})
    remaining_u_by_source = {}
    for line in lines:
        prior_u = update.known.get(line.source)
        if line.kind == "unstated" and prior_u is not None and _is_prior(line.source):
            remaining_u_by_source[line.source] = update.u(
                symbol, {line.source: IMPROVEMENT_FACTOR * prior_u}
            )
    for source in sorted(remaining_u_by_source, key=lambda name: remaining_u_by_source[name]):
        if remaining_u_by_source[source] > _MAX_REMAINING_FRACTION * current_u:
            return
        improved_u = IMPROVEMENT_FACTOR * update.known[source]
        source_unit = term(find_symbol(source)).unit
        yield {
            "symbol": symbol,
            "source": source,
            "words": describe_term(source),
            "assumed_u": _format_u(improved_u, source_unit),
            "current_u": _format_u(current_u, unit),
            "remaining_u": _format_u(remaining_u_by_source[source], unit),
        }


def _is_prior(source: str) -> bool:
    """Return whether a source can be stated in [model.priors]; inputs have other keys."""
    return is_term(source) and source not in INPUTS


def _run_improvement(
    suggestion: SuggestedRuns | None, accelerometer_result: AccelerometerResult
) -> RunImprovement | None:
    if suggestion is None:
        return None
    unit = accelerometer_result.coefficients[_require_update(accelerometer_result)[0]].unit
    return {
        "attitude": suggestion.attitude,
        "count": len(suggestion.runs),
        "minutes": format_number(suggestion.seconds / 60.0, 2),
        "remaining_u": _format_u(suggestion.u, unit),
        "current_u": _format_u(suggestion.u_without_runs, unit),
    }


def begin_search(app: AppState, name: str) -> JobEntry:
    """Start a search for helpful runs in another attitude; return the job."""
    path = app.description_path(name)
    campaign = app.campaign(name)
    _, store = app.cache.lookup(("ways", path), [path, *(run.record for run in campaign.runs)])

    def make_job(number: int) -> Job:
        return Job(number, name, "", forecast_command(path.parent), "forecast")

    return app.jobs.begin(make_job, run_search, path, on_done=store).to_dict()


def run_search(connection: Connection, campaign: Path) -> None:
    """Search for helpful runs; report to `connection` as in `report_progress`."""

    def search_runs(progress: ProgressCallback) -> dict[str, SuggestedRuns | None]:
        from counterspin.calibration.observed_runs import add_recorded_conditions
        from counterspin.campaign.description import read_campaign
        from counterspin.planning.recorded import observe_with_noise, suggest_runs

        recorded_campaign = add_recorded_conditions(read_campaign(campaign))
        observed_runs, noise = observe_with_noise(recorded_campaign)
        suggestions, terms = {}, recorded_campaign.model.terms
        for index, owner in enumerate(recorded_campaign.accelerometers):
            progress(index, len(recorded_campaign.accelerometers))
            symbol = "K_II" if "K_II" in terms else terms[0]
            suggestions[owner] = suggest_runs(
                recorded_campaign, observed_runs, noise, f"{owner}.{symbol}"
            )
        return suggestions

    report_progress(connection, search_runs)


def _get_search_results(app: AppState, name: str) -> dict[str, SuggestedRuns | None] | None:
    """Return the results of the search by accelerometer; None before the search."""
    path = app.description_path(name)
    try:
        files = [path, *(run.record for run in app.campaign(name).runs)]
    except CounterspinError:
        return None
    suggestions: dict[str, SuggestedRuns | None] | None = app.cache.lookup(("ways", path), files)[0]
    return suggestions


def apply_improvement(
    app: AppState, name: str, result: str, accelerometer: str, way: Literal["state", "runs"]
) -> PreparedCopy:
    """Copy a campaign and add an improvement to the copy; return the name of the copy.

    The ``key`` of the response is that of the value to be replaced by the user, or None.

    name: The campaign's folder.
    result: The result file.
    way: "state": add a prior, whose value must be replaced; "runs": add runs to be recorded.
    """
    source = app.description_path(name)
    description_text = app.folder.read(app.folder.name(source))
    text, key = description_text.text, None
    if way == "state":
        prior, suffix = _find_best_prior(app.result(result), accelerometer)
        text = set_value(text, ["model", "priors", prior[0]], prior[1])
        key = format_key_path(("model", "priors", prior[0]))
    else:
        suggestion = (_get_search_results(app, name) or {}).get(accelerometer)
        if suggestion is None:
            raise NotFoundError(
                f"{accelerometer}: no additional runs have been found; start the search first"
            )
        n_runs, suffix = len(load_document(source).get("runs", [])), "further-runs"
        for index, run in enumerate(suggestion.runs):
            text = set_value(text, ["runs", n_runs + index], run)
    if problems := parse_campaign_text(app, source, text).problems:
        raise CounterspinError(": ".join(problems[0]), code="invalid-value")
    copy_name = copy_campaign(app, name, find_free_name(app, f"{name}-{suffix}"))["name"]
    app.folder.write(f"{copy_name}/{DESCRIPTION_NAME}", text, description_text.version)
    return {"name": copy_name, "key": key}


def _find_best_prior(result: Result, accelerometer: str) -> tuple[tuple[str, str], str]:
    """Return key and text of the most effective prior, and its term."""
    improvement = next(_prior_improvements(result, accelerometer), None)
    if improvement is None:
        raise NotFoundError(
            f"{accelerometer}: specifying a single quantity more accurately would not reduce u"
        )
    source = improvement["source"]
    _, update = _require_update(_require_accelerometer(result, accelerometer))
    symbol = find_symbol(source)
    row = term(symbol)
    key = f"{accelerometer}.{source}" if symbol in ACCELEROMETER_TERMS else symbol
    prior_u = IMPROVEMENT_FACTOR * update.known[source]
    return (key, f"{row.nominal:g} ± {prior_u:.2g} {row.unit}"), symbol


def _require_accelerometer(result: Result, name: str) -> AccelerometerResult:
    if name not in result.accelerometers:
        raise NotFoundError(f"the result has no accelerometer {name!r}")
    return result.accelerometers[name]


def _requested_symbol(accelerometer_result: AccelerometerResult) -> str:
    """Return the first requested coefficient; empty if none is determined."""
    names = accelerometer_result.what_if.names if accelerometer_result.what_if else []
    symbols = [
        symbol
        for symbol in accelerometer_result.budget
        if symbol in names and symbol in accelerometer_result.coefficients
    ]
    return "K_II" if "K_II" in symbols else next(iter(symbols), "")


def _require_update(accelerometer_result: AccelerometerResult) -> tuple[str, WhatIf]:
    symbol = _requested_symbol(accelerometer_result)
    if accelerometer_result.what_if is None or not symbol:
        raise NotFoundError("the result does not list its sources of uncertainty; calibrate again")
    return symbol, accelerometer_result.what_if


def _format_u(u: float, unit: str) -> str:
    """Return an uncertainty in its display unit."""
    display_unit, factor = find_display_unit(unit)
    return typeset(f"{format_uncertainty(u * factor)} {display_unit}".strip())
