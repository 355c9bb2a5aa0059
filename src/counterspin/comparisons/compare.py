"""`counterspin compare`: comparison of results of different models, methods or campaigns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.calibration.findings import judge_result
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient, NominalOutput
from counterspin.comparability import describe_output_conversion
from counterspin.comparisons.estimates import (
    apply_joint_check,
    chi_square,
    covariance_of_difference,
    extract_estimates,
    record_checksums,
    relate_results,
)
from counterspin.comparisons.rerun import find_changes
from counterspin.comparisons.result import (
    ComparedCoefficient,
    ComparedEstimate,
    ComparedResult,
    PairAgreement,
    ResultComparison,
)
from counterspin.errors import CampaignError, UsageError

#: Variance of a difference, relative to the sum of variances, that is a rounding error.
_NEGLIGIBLE_VARIANCE: Final = 1e-9


def compare(*results: Result | Path | str, names: Sequence[str] | None = None) -> ResultComparison:
    """Compare results: values, differences and their uncertainty, changes.

    Each result is compared with the first result that contains the accelerometer. The covariance
    of two results includes common records, radius, gravity, and equal priors. If these are
    unknown, the comparison states its assumptions.

    Parameters
    ----------
    results
        Two or more results or result files.
    names
        Names of the results; None: file names or titles.

    Returns
    -------
    ResultComparison
        Values in g-units of the gravity of the first result.

    Raises
    ------
    CampaignError
        If there are fewer than two results, a different number of names, or no common
        accelerometer.
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
    loaded_results = [
        judge_result(result if isinstance(result, Result) else Result.read(result))
        for result in results
    ]
    result_names = list(names) if names is not None else name_results(results, loaded_results)
    accelerometer_names = dict.fromkeys(
        name for result in loaded_results for name in result.accelerometers
    )
    common_names = [
        name
        for name in accelerometer_names
        if sum(name in result.accelerometers for result in loaded_results) > 1
    ]
    if not common_names:
        names_text = "; ".join(
            f"{label}: {', '.join(result.accelerometers)}"
            for label, result in zip(result_names, loaded_results, strict=True)
        )
        raise CampaignError(
            "compare",
            [f"the results have no accelerometer in common ({names_text})"],
            code="results-not-comparable",
        )
    coefficients, agreements = [], []
    for name in common_names:
        accelerometer_coefficients, accelerometer_agreements = _compare_accelerometer(
            name, loaded_results, result_names
        )
        coefficients += accelerometer_coefficients
        agreements += accelerometer_agreements
    return ResultComparison(
        gravity=loaded_results[0].inputs.gravity,
        results=[
            ComparedResult(
                name=label,
                title=result.title,
                method=result.method,
                model=result.model,
                state=result.state,
                version=result.provenance.version,
                date=result.details.get("date"),
                gravity=_conversion_gravity(loaded_results, index),
                accelerometers=list(result.accelerometers),
            )
            for index, (label, result) in enumerate(zip(result_names, loaded_results, strict=True))
        ],
        coefficients=coefficients,
        agreements=agreements,
        changes=find_changes(loaded_results),
        unsealed=[
            name
            for name, result in zip(result_names, loaded_results, strict=True)
            if not result.sealed
        ],
    )


def name_results(inputs: Sequence[Result | Path | str], results: Sequence[Result]) -> list[str]:
    """Return the file or title of each result, numbered if not unique."""
    names = [
        (result.title or "result") if isinstance(input_result, Result) else str(input_result)
        for input_result, result in zip(inputs, results, strict=True)
    ]
    return [
        f"{name} ({number})" if names.count(name) > 1 else name
        for number, name in enumerate(names, 1)
    ]


def is_determined(coefficient: Coefficient | None) -> bool:
    """Return True if the records determine a coefficient."""
    return (
        coefficient is not None
        and coefficient.estimated
        and coefficient.value is not None
        and bool(coefficient.u)
    )


def _compare_accelerometer(
    name: str, results: Sequence[Result], result_names: Sequence[str]
) -> tuple[list[ComparedCoefficient], list[PairAgreement]]:
    """Compare the coefficients of an accelerometer in all results with those in the first."""
    indices = [index for index, result in enumerate(results) if name in result.accelerometers]
    first_index, *later_indices = indices
    first_coefficients = results[first_index].accelerometers[name].coefficients
    rows: dict[str, list[ComparedEstimate]] = {}
    units: dict[str, str] = {}
    for index in indices:
        for symbol, coefficient in results[index].accelerometers[name].coefficients.items():
            missing_estimate = ComparedEstimate(value=None, u=None)
            row = rows.setdefault(symbol, [missing_estimate] * len(results))
            units[symbol] = coefficient.unit
            if is_determined(coefficient):
                estimates = extract_estimates(
                    results[index], name, [symbol], _target_units(name, results, index)
                )
                row[index] = ComparedEstimate(
                    value=float(estimates.values[0]),
                    u=float(estimates.covariance[0, 0] ** 0.5),
                    dof=coefficient.dof,
                )
    agreements = []
    for index in later_indices:
        coefficients = results[index].accelerometers[name].coefficients
        terms = [
            symbol
            for symbol in first_coefficients
            if is_determined(first_coefficients[symbol]) and is_determined(coefficients.get(symbol))
        ]
        agreement, differences = _compare_pair(
            name, results, (first_index, index), terms, result_names
        )
        agreements.append(agreement)
        for symbol, (difference, u, z) in differences.items():
            changed_fields = {"difference": difference, "u_difference": u, "z": z}
            rows[symbol][index] = rows[symbol][index].model_copy(update=changed_fields)
    compared_coefficients = [
        ComparedCoefficient(accelerometer=name, term=symbol, unit=units[symbol], estimates=row)
        for symbol, row in rows.items()
    ]
    return compared_coefficients, agreements


def _shares_records(results: Sequence[Result], index: int) -> bool:
    """Return whether a result shares records with the first result, so is not converted.

    With shared records, a changed gravity or output is the subject of the comparison.
    """
    return bool(record_checksums(results[index]) & record_checksums(results[0]))


def _target_units(
    name: str, results: Sequence[Result], index: int
) -> tuple[float, NominalOutput | None] | None:
    """Return gravity and nominal output to convert to; None if the result is not converted."""
    if _shares_records(results, index):
        return None
    reference = next(result for result in results if name in result.accelerometers)
    return results[0].inputs.gravity, reference.accelerometers[name].nominal


def _conversion_gravity(results: Sequence[Result], index: int) -> float | None:
    """Return the gravity of a result if its numbers are converted, otherwise None."""
    result_gravity, gravity = results[index].inputs.gravity, results[0].inputs.gravity
    return None if result_gravity == gravity or _shares_records(results, index) else result_gravity


def _compare_pair(
    name: str,
    results: Sequence[Result],
    indices: tuple[int, int],
    terms: Sequence[str],
    result_names: Sequence[str],
) -> tuple[PairAgreement, dict[str, tuple[float, float, float | None]]]:
    first_estimates, second_estimates = (
        extract_estimates(results[index], name, terms, _target_units(name, results, index))
        for index in indices
    )
    first_result, second_result = (results[index] for index in indices)
    relation, assumptions = relate_results(
        name, (first_result, second_result), (first_estimates, second_estimates)
    )
    if not _shares_records(results, indices[1]):
        labels = result_names[indices[0]], result_names[indices[1]]
        assumptions += describe_output_conversion(name, (first_result, second_result), labels)
    covariance, sources = covariance_of_difference(first_estimates, second_estimates, relation)
    covariance = apply_joint_check(
        name, (first_result, second_result), (first_estimates, second_estimates), covariance
    )
    difference = second_estimates.values - first_estimates.values
    total_u = np.sqrt(np.diag(first_estimates.covariance) + np.diag(second_estimates.covariance))
    chi2, dof, p = chi_square(difference, covariance, total_u)
    differences = {}
    for i, symbol in enumerate(terms):
        variance = float(covariance[i, i])
        u = variance**0.5 if variance > _NEGLIGIBLE_VARIANCE * total_u[i] ** 2 else 0.0
        z = float(difference[i]) / u if u else None
        differences[symbol] = (float(difference[i]), u, z)
    agreement = PairAgreement(
        result=result_names[indices[1]],
        accelerometer=name,
        records=relation.overlap,
        terms=list(terms),
        chi2=chi2,
        dof=dof,
        p=p,
        shared=sorted(sources),
        assumed=assumptions,
    )
    return agreement, differences
