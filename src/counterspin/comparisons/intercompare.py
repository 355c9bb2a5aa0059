"""`counterspin intercompare`: comparison of laboratories that calibrated the same instrument."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.findings import judge_result, refusal_reason
from counterspin.calibration.result import Result
from counterspin.campaign.validation import suggest_name
from counterspin.comparability import are_different, describe_output_conversion
from counterspin.comparisons.compare import is_determined, name_results
from counterspin.comparisons.consensus import (
    degrees_of_equivalence,
    largest_consistent_subsets,
    weighted_mean,
)
from counterspin.comparisons.estimates import (
    Estimates,
    Relation,
    covariance_of_difference,
    extract_estimates,
    laboratory_names,
    record_checksums,
    serial_numbers,
)
from counterspin.comparisons.result import (
    DegreeOfEquivalence,
    Intercomparison,
    PairwiseDegree,
    ReferenceValue,
)
from counterspin.errors import CampaignError

#: Significance level of the chi-square test (Cox 2002).
SIGNIFICANCE: Final = 0.05

#: Coverage factor of degrees of equivalence (Cox 2002).
COVERAGE_FACTOR: Final = 2.0

#: Largest number of laboratories: the search tests up to 2^n subsets.
MAX_LABORATORIES: Final = 16

#: Smallest eigenvalue of a correlation matrix from which weights are calculated.
_MIN_EIGENVALUE: Final = 1e-9


def intercompare(
    *results: Result | Path | str, coefficients: Sequence[str] | None = None
) -> Intercomparison:
    """Compare laboratories: reference value, consistency, degrees of equivalence.

    The reference value is the weighted mean of the largest subset of results that passes a
    chi-square test at 5 % (Cox, Metrologia 39 (2002) 589 and 44 (2007) 187). Common sources, such
    as the default prior of a term of the instrument, count as covariances.

    Parameters
    ----------
    results
        A result, or its file, from each of two to sixteen laboratories for the same instrument.
    coefficients
        Symbols of coefficients, such as ``K_II``; None: those that every result determines.

    Returns
    -------
    Intercomparison
        Values in g-units of the gravity of the first result.

    Raises
    ------
    CampaignError
        If the results cannot be compared: wrong number of results, common records, different
        instruments, or fewer than two results that determine a coefficient.
    RecordError
        If a file is not a result, or the records contradict the result.
    """
    if not 2 <= len(results) <= MAX_LABORATORIES:
        raise _comparison_error(
            f"give 2 to {MAX_LABORATORIES} results or their files, not {len(results)}"
        )
    loaded_results = [
        judge_result(result if isinstance(result, Result) else Result.read(result))
        for result in results
    ]
    names = _laboratory_names(results, loaded_results)
    laboratories = dict(zip(names, loaded_results, strict=True))
    _require_comparable(laboratories)
    accelerometers = _common_accelerometers(laboratories)
    reference_values = [
        _evaluate_reference_value(accelerometer, symbol, laboratories)
        for accelerometer in accelerometers
        for symbol in _compared_symbols(accelerometer, laboratories, coefficients)
    ]
    if not reference_values:
        raise _comparison_error("no coefficient is determined by all results")
    return Intercomparison(
        gravity=loaded_results[0].inputs.gravity,
        significance=SIGNIFICANCE,
        laboratories=list(laboratories),
        references=reference_values,
        assumed=[*_describe_assumptions(laboratories, accelerometers)],
        unsealed=[name for name, result in laboratories.items() if not result.sealed],
    )


def _comparison_error(text: str) -> CampaignError:
    return CampaignError("intercompare", [text], code="results-not-comparable")


def _laboratory_names(
    inputs: Sequence[Result | Path | str], results: Sequence[Result]
) -> list[str]:
    """Return the names of the laboratories; files or titles if they are missing or not unique."""
    stated_names = [result.details.get("laboratory", "") for result in results]
    return (
        stated_names
        if all(stated_names) and len({*stated_names}) == len(stated_names)
        else name_results(inputs, results)
    )


def _require_comparable(laboratories: Mapping[str, Result]) -> None:
    """Raise CampaignError if a result must not take part."""
    for name, first_result in laboratories.items():
        reason = refusal_reason(first_result, first_result.accelerometers)
        if first_result.model == "as-printed":
            reason = "the equations as printed yield half the true K_II"
        if reason is not None:
            raise _comparison_error(f"{name} cannot take part: {reason}")
    for (first_name, first_result), (second_name, second_result) in combinations(
        laboratories.items(), 2
    ):
        if record_checksums(first_result) & record_checksums(second_result):
            raise _comparison_error(
                f"{first_name} and {second_name} use the same records. Give a single result from "
                "each laboratory, or compare the two results with `compare`"
            )


def _common_accelerometers(laboratories: Mapping[str, Result]) -> list[str]:
    accelerometers = [result.accelerometers for result in laboratories.values()]
    names = [
        name
        for name in accelerometers[0]
        if all(name in result_accelerometers for result_accelerometers in accelerometers)
    ]
    if not names:
        names_text = "; ".join(
            f"{laboratory}: {', '.join(result.accelerometers)}"
            for laboratory, result in laboratories.items()
        )
        raise _comparison_error(f"the results have no accelerometer in common ({names_text})")
    for name in names:
        numbers = serial_numbers(name, list(laboratories.values()))
        if are_different(numbers):
            serial_text = ", ".join(sorted(number for number in set(numbers) if number))
            raise _comparison_error(f"{name} has different serial numbers: {serial_text}")
    return names


def _describe_assumptions(
    laboratories: Mapping[str, Result], accelerometers: Sequence[str]
) -> Iterator[str]:
    """Yield the assumptions on common sources, and the conversions of outputs."""
    unnamed_laboratories = [
        name for name, result in laboratories.items() if "laboratory" not in result.details
    ]
    if unnamed_laboratories:
        yield (
            f"The campaigns of {', '.join(unnamed_laboratories)} do not name a laboratory. "
            "The comparison treats identical values for the machine and the site as the same "
            "measurement."
        )
    (first_name, first_result), *other_results = laboratories.items()
    for accelerometer in accelerometers:
        for name, result in other_results:
            yield from describe_output_conversion(
                accelerometer, (first_result, result), (first_name, name)
            )


def _determining_laboratories(
    accelerometer: str, symbol: str, laboratories: Mapping[str, Result]
) -> dict[str, Result]:
    """Return the laboratories that determine a coefficient."""
    return {
        name: result
        for name, result in laboratories.items()
        if is_determined(result.accelerometers[accelerometer].coefficients.get(symbol))
    }


def _compared_symbols(
    accelerometer: str, laboratories: Mapping[str, Result], requested_symbols: Sequence[str] | None
) -> Iterator[str]:
    """Yield the requested coefficients once; by default, those that every result determines."""
    accelerometer_result = next(iter(laboratories.values())).accelerometers[accelerometer]
    known_symbols = dict.fromkeys(
        symbol
        for result in laboratories.values()
        for symbol in result.accelerometers[accelerometer].coefficients
    )
    for symbol in dict.fromkeys(
        accelerometer_result.coefficients if requested_symbols is None else requested_symbols
    ):
        if symbol not in known_symbols:
            hint = suggest_name(symbol, known_symbols)
            raise _comparison_error(
                f'no result has the coefficient "{symbol}" of {accelerometer}{hint}'
            )
        n_laboratories = len(_determining_laboratories(accelerometer, symbol, laboratories))
        if requested_symbols is not None and n_laboratories < 2:
            raise _comparison_error(f"fewer than two results determine {symbol} of {accelerometer}")
        if requested_symbols is not None or n_laboratories == len(laboratories):
            yield symbol


def _evaluate_reference_value(
    accelerometer: str, symbol: str, laboratories: Mapping[str, Result]
) -> ReferenceValue:
    result_by_laboratory = _determining_laboratories(accelerometer, symbol, laboratories)
    names, results = list(result_by_laboratory), list(result_by_laboratory.values())
    first_result = next(iter(laboratories.values()))
    units = first_result.inputs.gravity, first_result.accelerometers[accelerometer].nominal
    estimates = [extract_estimates(result, accelerometer, [symbol], units) for result in results]
    values = np.array([float(estimate.values[0]) for estimate in estimates])
    covariance, shared_names = _estimate_covariance(results, estimates)
    u = np.sqrt(np.diag(covariance))
    if np.linalg.eigvalsh(covariance / np.outer(u, u))[0] < _MIN_EIGENVALUE:
        raise _comparison_error(
            f"{symbol} of {accelerometer}: the results have no independent uncertainty, so their "
            f"weights are not defined (common sources: {', '.join(shared_names)})"
        )
    overall_mean = weighted_mean(values, covariance)
    subsets = largest_consistent_subsets(values, covariance, SIGNIFICANCE)
    degrees = [
        {"value": float(value), "u": float(u_value), "member": False}
        for value, u_value in zip(values, u, strict=True)
    ]
    if subsets:
        d, u_d = degrees_of_equivalence(values, covariance, subsets[0].weights)
        for i, degree in enumerate(degrees):
            expanded_u_d = COVERAGE_FACTOR * float(u_d[i])
            degree |= {"member": i in subsets[0].members, "d": float(d[i])}
            degree |= {"expanded_u_d": expanded_u_d}
            if expanded_u_d:
                degree |= {"e_n": float(d[i]) / expanded_u_d, "zeta": float(d[i] / u_d[i])}
    return ReferenceValue(
        accelerometer=accelerometer,
        term=symbol,
        unit=results[0].accelerometers[accelerometer].coefficients[symbol].unit,
        chi2=overall_mean.chi2,
        dof=values.size - 1,
        p=overall_mean.p or 0.0,
        consistent=bool(subsets) and len(subsets[0].members) == values.size,
        value=subsets[0].value if subsets else None,
        u=subsets[0].u if subsets else None,
        p_members=subsets[0].p if subsets else None,
        alternatives=[[names[i] for i in subset.members] for subset in subsets[1:]],
        shared=shared_names,
        degrees={
            name: DegreeOfEquivalence.model_validate(degree)
            for name, degree in zip(names, degrees, strict=True)
        },
        pairs=list(_pairwise_degrees(names, values, covariance)),
    )


def _pairwise_degrees(
    names: Sequence[str], values: Array, covariance: Array
) -> Iterator[PairwiseDegree]:
    for i, j in combinations(range(values.size), 2):
        d = float(values[j] - values[i])
        u = float(np.sqrt(covariance[i, i] + covariance[j, j] - 2.0 * covariance[i, j]))
        expanded_u_d = COVERAGE_FACTOR * u
        yield PairwiseDegree(
            first=names[i], second=names[j], d=d, expanded_u_d=expanded_u_d, e_n=d / expanded_u_d
        )


def _estimate_covariance(
    results: Sequence[Result], estimates: Sequence[Estimates]
) -> tuple[Array, list[str]]:
    """Return the covariance of the estimates, and the names of the common sources."""
    covariance = np.diag([float(estimate.covariance[0, 0]) for estimate in estimates])
    shared_names = dict[str, None]()
    laboratories = laboratory_names(results)
    for i, j in combinations(range(len(estimates)), 2):
        # Machine and site belong to a laboratory.
        relation = Relation(
            "independent", is_same_machine=not are_different([laboratories[i], laboratories[j]])
        )
        pair_covariance, source_names = covariance_of_difference(
            estimates[i], estimates[j], relation
        )
        shared_names |= dict.fromkeys(source_names)
        variance_sum = covariance[i, i] + covariance[j, j]
        covariance[i, j] = covariance[j, i] = 0.5 * (variance_sum - float(pair_covariance[0, 0]))
    return covariance, list(shared_names)
