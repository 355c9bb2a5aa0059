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
    chi_square,
    covariance_of_difference,
    estimates_of,
    records_of,
    relation_of,
    use_joint_check,
)
from counterspin.comparisons.rerun import find_changes
from counterspin.comparisons.result import (
    AgreementOfTwo,
    ComparedCoefficient,
    ComparedEstimate,
    ComparedResult,
    ResultComparison,
)
from counterspin.errors import CampaignError, UsageError

#: Part of the sum of variances below which the variance of a difference is rounding.
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
        raise UsageError("compare", ["give two or more results, or their files"])
    if names is not None and len(names) != len(results):
        raise UsageError(
            "compare",
            [
                f"{len(results)} results and {len(names)} `names` were given; give one name for "
                "each result"
            ],
        )
    loaded = [judge_result(r if isinstance(r, Result) else Result.read(r)) for r in results]
    result_names = list(names) if names is not None else name_results(results, loaded)
    names_in_results = dict.fromkeys(name for result in loaded for name in result.accelerometers)
    shared = [
        name for name in names_in_results if sum(name in r.accelerometers for r in loaded) > 1
    ]
    if not shared:
        available = "; ".join(
            f"{n}: {', '.join(r.accelerometers)}" for n, r in zip(result_names, loaded, strict=True)
        )
        raise CampaignError(
            "compare",
            [f"the results have no accelerometer in common ({available})"],
            code="results-not-comparable",
        )
    coefficients, agreements = [], []
    for name in shared:
        table, agreements_of_name = _compare_accelerometer(name, loaded, result_names)
        coefficients += table
        agreements += agreements_of_name
    return ResultComparison(
        gravity=loaded[0].inputs.gravity,
        results=[
            ComparedResult(
                name=label,
                title=result.title,
                method=result.method,
                model=result.model,
                state=result.state,
                version=result.provenance.version,
                date=result.details.get("date"),
                gravity=_conversion_gravity(loaded, index),
                accelerometers=list(result.accelerometers),
            )
            for index, (label, result) in enumerate(zip(result_names, loaded, strict=True))
        ],
        coefficients=coefficients,
        agreements=agreements,
        changes=find_changes(loaded),
        unsealed=[
            name for name, result in zip(result_names, loaded, strict=True) if not result.sealed
        ],
    )


def name_results(given: Sequence[Result | Path | str], results: Sequence[Result]) -> list[str]:
    """Return a name for each result: its file or title, numbered if not unique."""
    names = [
        (result.title or "result") if isinstance(g, Result) else str(g)
        for g, result in zip(given, results, strict=True)
    ]
    return [
        f"{name} ({number})" if names.count(name) > 1 else name
        for number, name in enumerate(names, 1)
    ]


def is_determined(c: Coefficient | None) -> bool:
    """Return True if the records determine a coefficient."""
    return c is not None and c.estimated and c.value is not None and bool(c.u)


def _compare_accelerometer(
    name: str, results: Sequence[Result], result_names: Sequence[str]
) -> tuple[list[ComparedCoefficient], list[AgreementOfTwo]]:
    """Return an accelerometer's coefficients, and the agreement of each result with the first."""
    indices = [index for index, result in enumerate(results) if name in result.accelerometers]
    start, *later = indices
    first = results[start].accelerometers[name].coefficients
    rows: dict[str, list[ComparedEstimate]] = {}
    units: dict[str, str] = {}
    for index in indices:
        for symbol, c in results[index].accelerometers[name].coefficients.items():
            missing = ComparedEstimate(value=None, u=None)
            row = rows.setdefault(symbol, [missing] * len(results))
            units[symbol] = c.unit
            if is_determined(c):
                gravity = results[0].inputs.gravity
                estimates = estimates_of(
                    results[index], name, [symbol], _target_gravity(results, index, gravity)
                )
                row[index] = ComparedEstimate(
                    value=float(estimates.value[0]),
                    u=float(estimates.covariance[0, 0] ** 0.5),
                    dof=c.dof,
                )
    agreements = []
    for index in later:
        coefficients = results[index].accelerometers[name].coefficients
        terms = [s for s in first if is_determined(first[s]) and is_determined(coefficients.get(s))]
        agreement, differences = _compare_pair(name, results, (start, index), terms, result_names)
        agreements.append(agreement)
        for symbol, (difference, u, z) in differences.items():
            update = {"difference": difference, "u_difference": u, "z": z}
            rows[symbol][index] = rows[symbol][index].model_copy(update=update)
    table = [
        ComparedCoefficient(accelerometer=name, term=symbol, unit=units[symbol], estimates=row)
        for symbol, row in rows.items()
    ]
    return table, agreements


def _target_gravity(results: Sequence[Result], index: int, gravity: float) -> float | None:
    """Return the gravity to convert to; None if the results share records.

    With shared records, a changed gravity is the subject of the comparison.
    """
    return None if records_of(results[index]) & records_of(results[0]) else gravity


def _conversion_gravity(results: Sequence[Result], index: int) -> float | None:
    """Return the gravity of a result whose numbers are converted; None if they are not."""
    own_gravity, gravity = results[index].inputs.gravity, results[0].inputs.gravity
    return (
        None
        if own_gravity == gravity or _target_gravity(results, index, gravity) is None
        else own_gravity
    )


def _compare_pair(
    name: str,
    results: Sequence[Result],
    indices: tuple[int, int],
    terms: Sequence[str],
    result_names: Sequence[str],
) -> tuple[AgreementOfTwo, dict[str, tuple[float, float, float | None]]]:
    gravity = results[0].inputs.gravity
    first_estimates, second_estimates = (
        estimates_of(results[index], name, terms, _target_gravity(results, index, gravity))
        for index in indices
    )
    first, second = (results[index] for index in indices)
    relation, assumed = relation_of(name, (first, second), (first_estimates, second_estimates))
    covariance, shared = covariance_of_difference(first_estimates, second_estimates, relation)
    covariance = use_joint_check(
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
        result=result_names[indices[1]],
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
