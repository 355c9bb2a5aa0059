"""What two results have in common: records, models, weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from counterspin.arrays import Array
from counterspin.calibration.result import Result
from counterspin.comparisons.changes import terms_of
from counterspin.comparisons.common import Relation
from counterspin.comparisons.estimates import Estimates, SharedSource


def records_of(result: Result) -> frozenset[str]:
    """Return the checksums of the files that a result rests on, but for its description."""
    return frozenset(
        checksum
        for file, checksum in result.provenance.inputs.items()
        if not file.endswith(".toml") and checksum.startswith("sha256:")
    )


def relation_of(
    name: str, results: tuple[Result, Result], estimates: tuple[Estimates, Estimates]
) -> tuple[Relation, list[str]]:
    """Return how two results of an accelerometer are related, and in words what is assumed."""
    first, second = results
    records = records_of(first), records_of(second)
    assumed = []
    if not all(e.complete for e in estimates):
        assumed.append(
            "One of the results has no uncertainty budget or no correlations, "
            "so the terms are compared as if they were uncorrelated."
        )
    if not all(records):
        assumed.append("A result names no records: the two are assumed independent.")
    if not records[0] & records[1]:
        assumed.append(
            "Radius, gravity and priors that both results state alike count "
            "as one measurement; everything else is assumed independent."
        )
        return Relation("independent"), assumed
    kind: Literal["same", "part"] = "same" if records[0] == records[1] else "part"
    better = _better(results, records, estimates)
    alike = kind == "same" and better is not None and _alike(name, results, estimates)
    if better is None and kind == "part":
        assumed.append(
            "Some records are common, but neither result uses all records of the "
            "other: they are assumed independent, which overestimates u of a difference."
        )
    elif first.model != second.model:
        assumed.append(
            "One of the results is from the equations as printed, which estimate something else: "
            "u of a difference has little meaning."
        )
    elif better is None:
        assumed.append(
            "Neither model is part of the other, or the priors differ: the result with the "
            "smaller variance is assumed to be the best estimate from these records, "
            "so that the variances subtract."
        )
    elif first.method != second.method:
        assumed.append(
            "The joint method is assumed to be the best estimate from these records, "
            "so that the variances subtract."
        )
    elif not alike and _noise(name, first) != _noise(name, second):
        assumed.append(
            "The stated noise differs: the variances are subtracted although "
            "the weights differ too."
        )
    return Relation(kind, better, alike, _noise_ratio(name, first, second)), assumed


def _better(
    results: tuple[Result, Result],
    records: tuple[frozenset[str], frozenset[str]],
    estimates: tuple[Estimates, Estimates],
) -> Literal[0, 1] | None:
    """Return which result is the best linear unbiased estimate of what both rest on, if either is.

    It has all records of the other, no term that the other lacks, and the same is known beforehand.
    """
    first, second = results
    if first.model != second.model:
        return None
    if first.method != second.method:
        return (0 if first.method == "joint" else 1) if records[0] == records[1] else None
    one, two = (e.sources for e in estimates)
    if any(s.estimated and n in two and not _same_prior(n, one, two) for n, s in one.items()):
        return None
    of_runs = set(first.runs) ^ set(second.runs)
    terms = [{term for term in terms_of(r) if term.split(".")[0] not in of_runs} for r in results]
    if records[0] >= records[1] and terms[0] <= terms[1]:
        return 0
    if records[1] >= records[0] and terms[1] <= terms[0]:
        return 1
    return None


def _same_prior(
    name: str, one: Mapping[str, SharedSource], two: Mapping[str, SharedSource]
) -> bool:
    its = two[name]
    return not its.estimated or one[name].is_as(its) or one[name].is_another(its)


def _alike(
    name: str, results: tuple[Result, Result], estimates: tuple[Estimates, Estimates]
) -> bool:
    first, second = results
    one, two = (e.sources for e in estimates)
    estimated = [{n for n, s in sources.items() if s.estimated} for sources in (one, two)]
    return (
        first.method == second.method
        and first.model == second.model
        and first.provenance.options == second.provenance.options
        and terms_of(first) == terms_of(second)
        and estimated[0] == estimated[1]
        and all(one[n].is_as_sure_as(two[n]) for n in estimated[0])
        and _noise(name, first) == _noise(name, second)
    )


def _noise(name: str, result: Result) -> dict[str, float | None]:
    """Return what decides the weights: the sizes, but of white noise alone none."""
    lines = result.accelerometers[name].noise
    if len(lines) == 1:
        return dict.fromkeys(lines)
    return {part: None if line.estimated else line.value for part, line in lines.items()}


def _noise_ratio(name: str, first: Result, second: Result) -> float:
    one, two = (result.accelerometers[name].noise for result in (first, second))
    if len(one) != 1 or set(one) != set(two):
        return 1.0
    ((part, line),) = one.items()
    return line.value / two[part].value if line.value and two[part].value else 1.0


def by_the_joint_check(
    name: str,
    results: tuple[Result, Result],
    estimates: tuple[Estimates, Estimates],
    covariance: Array,
) -> Array:
    """Return a covariance with the u that a joint result itself states of the two methods."""
    for joint, other in (results, results[::-1]):
        check = joint.accelerometers[name].two_stage
        theirs = other.accelerometers[name].coefficients.get("K_II")
        if joint.method == "joint" and other.method == "two-stage" and check and theirs:
            symbols = estimates[0].symbols
            if "K_II" in symbols and theirs.value == check.value:
                place = symbols.index("K_II")
                covariance = covariance.copy()
                covariance[place, place] = check.u_difference**2
    return covariance
