"""`counterspin compare`: comparison of results of different models, methods or campaigns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.calibration.findings import judge_result
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient
from counterspin.comparisons.estimates import (
    by_the_joint_check,
    chi_square,
    covariance_of_difference,
    estimates_of,
    records_of,
    relation_of,
)
from counterspin.comparisons.rerun import changes
from counterspin.comparisons.result import (
    AgreementOfTwo,
    ComparedCoefficient,
    ComparedEstimate,
    ComparedResult,
    ResultComparison,
)
from counterspin.errors import CampaignError

#: A difference whose variance is below this part of the variances' sum has none.
_NO_VARIANCE: Final = 1e-9


def compare(*results: Result | Path | str, names: Sequence[str] | None = None) -> ResultComparison:
    """Compare results: values, differences and their uncertainty, changes.

    Each is compared with the first that has the accelerometer. The covariance of two results
    includes their common records, radius, gravity, and equal priors. If these are not known, the
    comparison states its assumptions.

    Parameters
    ----------
    results
        Two or more results or their files.
    names
        Name of each result; None: its file or title.

    Returns
    -------
    ResultComparison
        In g-units of the first result's gravity.

    Raises
    ------
    CampaignError
        If there are fewer than two results, not as many names, or no accelerometer in common.
    RecordError
        If a file is not a result.
    """
    if len(results) < 2:
        raise CampaignError("compare", ["give two or more results, or their files"])
    if names is not None and len(names) != len(results):
        raise CampaignError(
            "compare", [f"there are {len(results)} results and {len(names)} `names`"]
        )
    read = [judge_result(r if isinstance(r, Result) else Result.read(r)) for r in results]
    called = list(names) if names is not None else _names(results, read)
    names_in_results = dict.fromkeys(name for result in read for name in result.accelerometers)
    shared = [name for name in names_in_results if sum(name in r.accelerometers for r in read) > 1]
    if not shared:
        known = "; ".join(
            f"{n}: {', '.join(r.accelerometers)}" for n, r in zip(called, read, strict=True)
        )
        raise CampaignError("compare", [f"the results have no accelerometer in common ({known})"])
    coefficients, agreements = [], []
    for name in shared:
        table, agreements_of_name = _accelerometer(name, read, called)
        coefficients += table
        agreements += agreements_of_name
    return ResultComparison(
        gravity=read[0].inputs.gravity,
        results=[
            ComparedResult(
                name=label,
                title=result.title,
                method=result.method,
                model=result.model,
                state=result.state,
                version=result.provenance.version,
                date=result.details.get("date"),
                gravity=_conversion_gravity(read, place),
                accelerometers=list(result.accelerometers),
            )
            for place, (label, result) in enumerate(zip(called, read, strict=True))
        ],
        coefficients=coefficients,
        agreements=agreements,
        changes=changes(read),
        unsealed=[name for name, result in zip(called, read, strict=True) if not result.sealed],
    )


def _names(given: Sequence[Result | Path | str], results: Sequence[Result]) -> list[str]:
    """Return a name for each: its file or title, with its place where several are alike."""
    names = [
        (result.title or "result") if isinstance(g, Result) else str(g)
        for g, result in zip(given, results, strict=True)
    ]
    return [
        f"{name} ({place})" if names.count(name) > 1 else name
        for place, name in enumerate(names, 1)
    ]


def _determined(c: Coefficient | None) -> bool:
    return c is not None and c.estimated and c.value is not None and bool(c.u)


def _accelerometer(
    name: str, results: Sequence[Result], called: Sequence[str]
) -> tuple[list[ComparedCoefficient], list[AgreementOfTwo]]:
    """Return an accelerometer's coefficients, and its agreement in each result with the first."""
    having = [place for place, result in enumerate(results) if name in result.accelerometers]
    start, *later = having
    first = results[start].accelerometers[name].coefficients
    rows: dict[str, list[ComparedEstimate]] = {}
    units: dict[str, str] = {}
    for place in having:
        for symbol, c in results[place].accelerometers[name].coefficients.items():
            nothing = ComparedEstimate(value=None, u=None)
            row = rows.setdefault(symbol, [nothing] * len(results))
            units[symbol] = c.unit
            if _determined(c):
                gravity = results[0].inputs.gravity
                estimates = estimates_of(
                    results[place], name, [symbol], _units(results, place, gravity)
                )
                row[place] = ComparedEstimate(
                    value=float(estimates.value[0]),
                    u=float(estimates.covariance[0, 0] ** 0.5),
                    dof=c.dof,
                )
    agreements = []
    for place in later:
        coefficients = results[place].accelerometers[name].coefficients
        terms = [s for s in first if _determined(first[s]) and _determined(coefficients.get(s))]
        agreement, differences = _pair(name, results, (start, place), terms, called)
        agreements.append(agreement)
        for symbol, (difference, u, z) in differences.items():
            update = {"difference": difference, "u_difference": u, "z": z}
            rows[symbol][place] = rows[symbol][place].model_copy(update=update)
    table = [
        ComparedCoefficient(accelerometer=name, term=symbol, unit=units[symbol], estimates=row)
        for symbol, row in rows.items()
    ]
    return table, agreements


def _units(results: Sequence[Result], place: int, gravity: float) -> float | None:
    """Return the gravity to convert to; None where the same records were given another gravity.

    In that case the changed gravity is the subject of the comparison.
    """
    return None if records_of(results[place]) & records_of(results[0]) else gravity


def _conversion_gravity(results: Sequence[Result], place: int) -> float | None:
    """Return the gravity of a result whose numbers are converted; None where they stay."""
    own_gravity, gravity = results[place].inputs.gravity, results[0].inputs.gravity
    return (
        None if own_gravity == gravity or _units(results, place, gravity) is None else own_gravity
    )


def _pair(
    name: str,
    results: Sequence[Result],
    places: tuple[int, int],
    terms: Sequence[str],
    called: Sequence[str],
) -> tuple[AgreementOfTwo, dict[str, tuple[float, float, float | None]]]:
    gravity = results[0].inputs.gravity
    first_estimates, second_estimates = (
        estimates_of(results[place], name, terms, _units(results, place, gravity))
        for place in places
    )
    first, second = (results[place] for place in places)
    relation, assumed = relation_of(name, (first, second), (first_estimates, second_estimates))
    covariance, shared = covariance_of_difference(first_estimates, second_estimates, relation)
    covariance = by_the_joint_check(
        name, (first, second), (first_estimates, second_estimates), covariance
    )
    difference = second_estimates.value - first_estimates.value
    scale = np.sqrt(np.diag(first_estimates.covariance) + np.diag(second_estimates.covariance))
    chi2, dof, p = chi_square(difference, covariance, scale)
    differences = {}
    for i, symbol in enumerate(terms):
        variance = float(covariance[i, i])
        u = variance**0.5 if variance > _NO_VARIANCE * scale[i] ** 2 else 0.0
        z = float(difference[i]) / u if u else None
        differences[symbol] = (float(difference[i]), u, z)
    agreement = AgreementOfTwo(
        result=called[places[1]],
        accelerometer=name,
        records=relation.records,
        terms=list(terms),
        chi2=chi2,
        dof=dof,
        p=p,
        shared=sorted(shared),
        assumed=assumed,
    )
    return agreement, differences
