"""`counterspin intercompare`: comparison of laboratories that calibrated the same instrument."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.findings import judge_result, refusal_reason
from counterspin.calibration.result import Result
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
    estimates_of,
    records_of,
)
from counterspin.comparisons.result import (
    DegreeOfEquivalence,
    Intercomparison,
    PairwiseDegree,
    ReferenceValue,
)
from counterspin.errors import CampaignError
from counterspin.physics.terms import find_symbol, is_term, term

#: Significance of the chi-square test (Cox 2002).
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
        A result of each laboratory, or its file: two to sixteen, of the same instrument.
    coefficients
        Symbols of coefficients, such as ``K_II``; None: all that every result determines.

    Returns
    -------
    Intercomparison
        In g-units of the first result's gravity.

    Raises
    ------
    CampaignError
        If the results cannot be compared: too few or too many, common records, other instruments,
        or fewer than two that determine a coefficient.
    RecordError
        If a file is not a result, or its records contradict it.
    """
    if not 2 <= len(results) <= MAX_LABORATORIES:
        raise _error(f"give 2 to {MAX_LABORATORIES} results or their files, not {len(results)}")
    loaded = [judge_result(r if isinstance(r, Result) else Result.read(r)) for r in results]
    laboratories = dict(zip(_names(results, loaded), loaded, strict=True))
    _require_comparable(laboratories)
    references = [
        _reference_value(accelerometer, symbol, laboratories)
        for accelerometer in _common_accelerometers(laboratories)
        for symbol in _symbols(accelerometer, laboratories, coefficients)
    ]
    if not references:
        raise _error("the results have no coefficient that all of them determine")
    unnamed = [name for name, r in laboratories.items() if "laboratory" not in r.details]
    return Intercomparison(
        gravity=loaded[0].inputs.gravity,
        significance=SIGNIFICANCE,
        laboratories=list(laboratories),
        references=references,
        assumed=[
            f"The campaigns of {', '.join(unnamed)} do not name a laboratory. Identical "
            "statements about the machine and the site are treated as the same measurement."
        ]
        if unnamed
        else [],
        unsealed=[name for name, result in laboratories.items() if not result.sealed],
    )


def _error(text: str) -> CampaignError:
    return CampaignError("intercompare", [text], code="results-not-comparable")


def _names(given: Sequence[Result | Path | str], results: Sequence[Result]) -> list[str]:
    """Return the laboratories as the campaigns state them; if not all differ, files or titles."""
    stated = [result.details.get("laboratory", "") for result in results]
    return stated if all(stated) and len({*stated}) == len(stated) else name_results(given, results)


def _require_comparable(laboratories: Mapping[str, Result]) -> None:
    """Raise CampaignError for results that must not take part."""
    for name, result in laboratories.items():
        reason = refusal_reason(result, result.accelerometers)
        if result.model == "as-printed":
            reason = "the equations as printed yield half the true K_II"
        if reason is not None:
            raise _error(f"{name} cannot take part: {reason}")
    for (first, result), (second, other_result) in combinations(laboratories.items(), 2):
        if records_of(result) & records_of(other_result):
            raise _error(
                f"{first} and {second} use the same records. Give a single result from each "
                "laboratory, or compare the two results with `compare`"
            )


def _common_accelerometers(laboratories: Mapping[str, Result]) -> list[str]:
    accelerometers = [result.accelerometers for result in laboratories.values()]
    names = [name for name in accelerometers[0] if all(name in a for a in accelerometers)]
    if not names:
        listed = "; ".join(f"{n}: {', '.join(r.accelerometers)}" for n, r in laboratories.items())
        raise _error(f"the results have no accelerometer in common ({listed})")
    for name in names:
        serials = {a[name].serial_number for a in accelerometers} - {None}
        if len(serials) > 1:
            raise _error(
                f"{name} has different serial numbers: {', '.join(sorted(map(str, serials)))}"
            )
    return names


def _determining(
    accelerometer: str, symbol: str, laboratories: Mapping[str, Result]
) -> dict[str, Result]:
    """Return the laboratories that determine a coefficient."""
    return {
        name: result
        for name, result in laboratories.items()
        if is_determined(result.accelerometers[accelerometer].coefficients.get(symbol))
    }


def _symbols(
    accelerometer: str, laboratories: Mapping[str, Result], requested: Sequence[str] | None
) -> Iterator[str]:
    """Yield the requested coefficients; by default those that every result determines."""
    first = next(iter(laboratories.values())).accelerometers[accelerometer]
    for symbol in first.coefficients if requested is None else requested:
        count = len(_determining(accelerometer, symbol, laboratories))
        if requested is not None and count < 2:
            raise _error(f"fewer than two results determine {symbol} of {accelerometer}")
        if requested is not None or count == len(laboratories):
            yield symbol


def _reference_value(
    accelerometer: str, symbol: str, laboratories: Mapping[str, Result]
) -> ReferenceValue:
    chosen = _determining(accelerometer, symbol, laboratories)
    names, results = list(chosen), list(chosen.values())
    gravity = next(iter(laboratories.values())).inputs.gravity
    estimates = [estimates_of(result, accelerometer, [symbol], gravity) for result in results]
    values = np.array([float(e.value[0]) for e in estimates])
    covariance, shared = _covariance(results, estimates)
    u = np.sqrt(np.diag(covariance))
    if np.linalg.eigvalsh(covariance / np.outer(u, u))[0] < _MIN_EIGENVALUE:
        raise _error(
            f"{symbol} of {accelerometer}: the results have no independent uncertainty, so their "
            f"weights are not defined (common sources: {', '.join(shared)})"
        )
    overall = weighted_mean(values, covariance)
    subsets = largest_consistent_subsets(values, covariance, SIGNIFICANCE)
    degrees = [
        {"value": float(value), "u": float(u_value), "member": False}
        for value, u_value in zip(values, u, strict=True)
    ]
    if subsets:
        d, u_d = degrees_of_equivalence(values, covariance, subsets[0].weights)
        for i, degree in enumerate(degrees):
            expanded = COVERAGE_FACTOR * float(u_d[i])
            degree |= {"member": i in subsets[0].members, "d": float(d[i])}
            degree |= {"expanded_u_d": expanded}
            if expanded:
                degree |= {"e_n": float(d[i]) / expanded, "zeta": float(d[i] / u_d[i])}
    return ReferenceValue(
        accelerometer=accelerometer,
        term=symbol,
        unit=results[0].accelerometers[accelerometer].coefficients[symbol].unit,
        chi2=overall.chi2,
        dof=values.size - 1,
        p=overall.p or 0.0,
        consistent=bool(subsets) and len(subsets[0].members) == values.size,
        value=subsets[0].value if subsets else None,
        u=subsets[0].u if subsets else None,
        p_members=subsets[0].p if subsets else None,
        alternatives=[[names[i] for i in subset.members] for subset in subsets[1:]],
        shared=shared,
        degrees={
            name: DegreeOfEquivalence.model_validate(degree)
            for name, degree in zip(names, degrees, strict=True)
        },
        pairs=list(_pairs(names, values, covariance)),
    )


def _pairs(names: Sequence[str], values: Array, covariance: Array) -> Iterator[PairwiseDegree]:
    for i, j in combinations(range(values.size), 2):
        d = float(values[j] - values[i])
        u = float(np.sqrt(covariance[i, i] + covariance[j, j] - 2.0 * covariance[i, j]))
        expanded = COVERAGE_FACTOR * u
        yield PairwiseDegree(
            first=names[i], second=names[j], d=d, expanded_u_d=expanded, e_n=d / expanded
        )


def _covariance(
    results: Sequence[Result], estimates: Sequence[Estimates]
) -> tuple[Array, list[str]]:
    """Return the covariance of the results' estimates, and the names of the common sources."""
    covariance = np.diag([float(e.covariance[0, 0]) for e in estimates])
    shared = dict[str, None]()
    laboratories = [result.details.get("laboratory") for result in results]
    for i, j in combinations(range(len(estimates)), 2):
        pair = estimates[i], estimates[j]
        if None not in (laboratories[i], laboratories[j]) and laboratories[i] != laboratories[j]:
            pair = _sources_of_instrument(pair[0]), _sources_of_instrument(pair[1])
        of_difference, sources = covariance_of_difference(*pair, Relation("independent"))
        shared |= dict.fromkeys(sources)
        total = covariance[i, i] + covariance[j, j]
        covariance[i, j] = covariance[j, i] = 0.5 * (total - float(of_difference[0, 0]))
    return covariance, list(shared)


def _sources_of_instrument(estimates: Estimates) -> Estimates:
    """Return the estimates without the sources of machine and site, which a laboratory owns."""
    kept = {
        name: source
        for name, source in estimates.sources.items()
        if is_term(find_symbol(name)) and term(find_symbol(name)).scope == "accelerometer"
    }
    return replace(estimates, sources=kept)
