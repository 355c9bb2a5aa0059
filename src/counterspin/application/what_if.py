"""The uncertainty with better inputs: priors, further runs, and campaigns prepared for them."""

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
from counterspin.application.campaign_files import copy_campaign, free_name
from counterspin.application.commands import forecast_command
from counterspin.application.editing import parse_campaign_text, set_value
from counterspin.application.jobs import Job, Progress, report_progress
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

#: Sources that a page has room for.
_MAX_SOURCES: Final = 6

#: A way that leaves more than this part of the uncertainty is none.
_MAX_REMAINING_FRACTION: Final = 0.95


def what_if(
    app: AppState, name: str, accelerometer: str, known: dict[str, FiniteFloat] | None = None
) -> WhatIfAnswer:
    """Return u of the first requested coefficient, and its budget.

    name: The result's file.
    known: Source -> its standard uncertainty, SI or g-units; others stay as they are.
    """
    result_part = _accelerometer_result(app.result(name), accelerometer)
    symbol, update = _requested_update(result_part)
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
        "text": _format_u(u, result_part.coefficients[symbol].unit),
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
    """Return for each accelerometer the cheapest known ways to a smaller uncertainty.

    name: The campaign's folder.
    result: The result's file.
    """
    suggestions = _search_results(app, name)
    entries: list[Improvement] = []
    for owner, result_part in app.result(result).accelerometers.items():
        best_prior = next(_prior_improvements(app.result(result), owner), None)
        if best_prior is None:
            continue
        entries.append(
            {
                "accelerometer": owner,
                "stated": best_prior,
                "runs": None
                if suggestions is None
                else _run_improvement(suggestions.get(owner), result_part),
            }
        )
    return {
        "ways": entries,
        "searched": suggestions is not None,
        "has_runs": _has_records(app, name),
    }


def _has_records(app: AppState, name: str) -> bool:
    """Return whether a campaign can be read, and has runs that further runs can follow."""
    try:
        return bool(app.campaign(name).runs)
    except CounterspinError:
        return False


def _prior_improvements(result: Result, owner: str) -> Iterator[PriorImprovement]:
    """Yield the priors that may be stated, the one with the smallest remaining u first."""
    result_part = _accelerometer_result(result, owner)
    if result_part.what_if is None or not _requested_symbol(result_part):
        return
    symbol, update = _requested_update(result_part)
    unit, lines = result_part.coefficients[symbol].unit, result_part.budget[symbol]
    current_u = update.u(symbol, {})
    remaining_u = {}
    for line in lines:
        prior_u = update.known.get(line.source)
        if line.kind == "unstated" and prior_u is not None and _is_prior(line.source):
            remaining_u[line.source] = update.u(symbol, {line.source: IMPROVEMENT_FACTOR * prior_u})
    for source in sorted(remaining_u, key=lambda name: remaining_u[name]):
        if remaining_u[source] > _MAX_REMAINING_FRACTION * current_u:
            return
        improved_u, source_unit = (
            IMPROVEMENT_FACTOR * update.known[source],
            term(find_symbol(source)).unit,
        )
        yield {
            "symbol": symbol,
            "source": source,
            "words": describe_term(source),
            "known": _format_u(improved_u, source_unit),
            "now": _format_u(current_u, unit),
            "left": _format_u(remaining_u[source], unit),
        }


def _is_prior(source: str) -> bool:
    """Return whether [model.priors] states a source; inputs have other keys."""
    return is_term(source) and source not in INPUTS


def _run_improvement(
    suggestion: SuggestedRuns | None, result_part: AccelerometerResult
) -> RunImprovement | None:
    if suggestion is None:
        return None
    unit = result_part.coefficients[_requested_update(result_part)[0]].unit
    return {
        "attitude": suggestion.attitude,
        "count": len(suggestion.runs),
        "minutes": format_number(suggestion.seconds / 60.0, 2),
        "left": _format_u(suggestion.u, unit),
        "now": _format_u(suggestion.u_without, unit),
    }


def begin_search(app: AppState, name: str) -> JobEntry:
    """Start a search for helpful runs in another attitude; return the job."""
    path = app.description(name)
    campaign = app.campaign(name)
    _, store = app.cache.lookup(("ways", path), [path, *(run.record for run in campaign.runs)])

    def make(number: int) -> Job:
        return Job(number, name, "", forecast_command(path.parent), "forecast")

    return app.jobs.begin(make, run_search, path, on_done=store).to_dict()


def run_search(connection: Connection, campaign: Path) -> None:
    """Search for helpful runs; report to `connection` as `report_progress` does."""

    def work(progress: Progress) -> dict[str, SuggestedRuns | None]:
        from counterspin.calibration.observed_runs import add_recorded_conditions
        from counterspin.campaign.description import read_campaign
        from counterspin.planning.recorded import observe_with_noise, suggest_runs

        campaign_conditions = add_recorded_conditions(read_campaign(campaign))
        observed, noise = observe_with_noise(campaign_conditions)
        suggestions = {}
        for index, owner in enumerate(campaign_conditions.accelerometers):
            progress(index, len(campaign_conditions.accelerometers))
            symbol = (
                "K_II"
                if "K_II" in campaign_conditions.model.terms
                else campaign_conditions.model.terms[0]
            )
            suggestions[owner] = suggest_runs(
                campaign_conditions, observed, noise, f"{owner}.{symbol}"
            )
        return suggestions

    report_progress(connection, work)


def _search_results(app: AppState, name: str) -> dict[str, SuggestedRuns | None] | None:
    """Return the results of the search by accelerometer; None without a search."""
    path = app.description(name)
    try:
        files = [path, *(run.record for run in app.campaign(name).runs)]
    except CounterspinError:
        return None
    suggestions: dict[str, SuggestedRuns | None] | None = app.cache.lookup(("ways", path), files)[0]
    return suggestions


def apply_improvement(
    app: AppState, name: str, result: str, accelerometer: str, way: Literal["state", "runs"]
) -> PreparedCopy:
    """Copy a campaign and write a way to a smaller uncertainty into the copy; return its name.

    The answer's ``key`` is that of the value to be replaced, or None.

    name: The campaign's folder.
    result: The result's file.
    way: A prior, whose value is to be replaced by a measured one; or runs to be recorded.
    """
    source = app.description(name)
    description_text = app.folder.read(app.folder.name(source))
    text, key = description_text.text, None
    if way == "state":
        prior, suffix = _best_prior(app.result(result), accelerometer)
        text = set_value(text, ["model", "priors", prior[0]], prior[1])
        key = format_key_path(("model", "priors", prior[0]))
    else:
        suggestion = (_search_results(app, name) or {}).get(accelerometer)
        if suggestion is None:
            raise NotFoundError(
                f"{accelerometer}: no additional runs have been found; start the search first"
            )
        run_count, suffix = len(load_document(source).get("runs", [])), "further-runs"
        for index, run in enumerate(suggestion.runs):
            text = set_value(text, ["runs", run_count + index], run)
    if problems := parse_campaign_text(app, source, text).problems:
        raise CounterspinError(": ".join(problems[0]), code="invalid-value")
    copy = copy_campaign(app, name, free_name(app, f"{name}-{suffix}"))["name"]
    app.folder.write(f"{copy}/{DESCRIPTION_NAME}", text, description_text.version)
    return {"name": copy, "key": key}


def _best_prior(result: Result, accelerometer: str) -> tuple[tuple[str, str], str]:
    """Return the key and the text of the most helpful prior, and its term."""
    improvement = next(_prior_improvements(result, accelerometer), None)
    if improvement is None:
        raise NotFoundError(
            f"{accelerometer}: no single quantity would reduce u if it were specified more "
            "accurately"
        )
    source, (_, update) = (
        improvement["source"],
        _requested_update(_accelerometer_result(result, accelerometer)),
    )
    symbol = find_symbol(source)
    row = term(symbol)
    key = f"{accelerometer}.{source}" if symbol in ACCELEROMETER_TERMS else symbol
    prior_u = IMPROVEMENT_FACTOR * update.known[source]
    return (key, f"{row.nominal:g} ± {prior_u:.2g} {row.unit}"), symbol


def _accelerometer_result(result: Result, name: str) -> AccelerometerResult:
    if name not in result.accelerometers:
        raise NotFoundError(f"the result has no accelerometer {name!r}")
    return result.accelerometers[name]


def _requested_symbol(result_part: AccelerometerResult) -> str:
    """Return the first requested coefficient; empty if none is determined."""
    names = result_part.what_if.names if result_part.what_if else []
    requested = [
        symbol
        for symbol in result_part.budget
        if symbol in names and symbol in result_part.coefficients
    ]
    return "K_II" if "K_II" in requested else next(iter(requested), "")


def _requested_update(result_part: AccelerometerResult) -> tuple[str, WhatIf]:
    symbol = _requested_symbol(result_part)
    if result_part.what_if is None or not symbol:
        raise NotFoundError("the result does not list its sources of uncertainty; calibrate again")
    return symbol, result_part.what_if


def _format_u(u: float, unit: str) -> str:
    """Return an uncertainty in the unit of the field."""
    shown, factor = find_display_unit(unit)
    return typeset(f"{format_uncertainty(u * factor)} {shown}".strip())
