"""Estimates of an accelerometer in two results, shared sources, and covariance of the difference.

Two estimates of the same records have most of their error in common. Where one of them is the best
linear unbiased estimate from the common data (the smaller of two nested models, or the result from
all records if the other uses some of them), the covariance of the two is its own variance, so that
variances subtract (J. A. Hausman, Econometrica 46 (1978) 1251, lemma 2.1). Considered terms
move each estimate by its own sensitivity. Results of other records share the sources with equal
statements: the radius, gravity, priors. A term that is not stated is the same for an instrument and
its machine in all their results, so results with the same default standard uncertainty share it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient
from counterspin.comparisons.rerun import terms_of
from counterspin.frozen import frozen
from counterspin.inference.distributions import chi_square_tail
from counterspin.physics.terms import TERMS, mounting_name

#: Part of a variance below which a difference of variances is rounding.
NEGLIGIBLE: Final = 1e-9

#: Part of u below which two values differ by rounding.
_ROUNDING: Final = 1e-6

#: Smallest share of a variance for which a shared source is named.
_MIN_SHARE: Final = 1e-3


@frozen
class Relation:
    """Relation of two results: common records, efficient estimate, noise ratio."""

    #: Overlap of their records.
    records: Literal["same", "part", "independent"]
    #: Index of the result whose estimate is efficient for the common data; None: unknown, and the
    #: one with the smaller variance is assumed efficient.
    efficient: Literal[0, 1] | None = None
    #: Whether both give the same weights to the same records, so that noise shifts them equally.
    same_weights: bool = False
    #: Noise of the first result over that of the second, if both estimate it.
    noise_ratio: float = 1.0


def covariance_of_difference(
    first: Estimates, second: Estimates, relation: Relation
) -> tuple[Array, list[str]]:
    """Return the covariance of second minus first, and the names of the shared sources."""
    partial_overlap = relation.records == "part" and relation.efficient is None
    if relation.records == "independent" or partial_overlap:
        return _independent_covariance(first, second)
    return _common_record_covariance(first, second, relation)


def _independent_covariance(first: Estimates, second: Estimates) -> tuple[Array, list[str]]:
    covariance = first.covariance + second.covariance
    shared = []
    for name, source in first.sources.items():
        counterpart = second.sources.get(name)
        if counterpart is not None and not source.of_run and source.same_statement(counterpart):
            cross = np.outer(source.shifts, counterpart.shifts)
            covariance = covariance - cross - cross.T
            if np.any(np.abs(np.diag(cross)) > _MIN_SHARE * np.diag(first.covariance)):
                shared.append(name)
    return covariance, shared


def _common_record_covariance(
    first: Estimates, second: Estimates, relation: Relation
) -> tuple[Array, list[str]]:
    efficient, inefficient = (first, second) if relation.efficient != 1 else (second, first)
    size = len(first.symbols)
    if not (first.complete and second.complete):
        # The sensitivities are unknown: considered terms are assumed to shift both equally.
        noise = [np.diag(e.covariance) - e.considered_u**2 for e in (first, second)]
        if relation.same_weights:
            noise = [np.zeros(size), np.zeros(size)]
        covariance = np.abs(noise[0] - noise[1]) + (first.considered_u - second.considered_u) ** 2
        return np.diag(covariance), []
    common, unshared = list[tuple[SharedSource, SharedSource]](), list[Array]()
    remeasured = list[tuple[Array, Array]]()
    shared = []
    for name, source in efficient.sources.items():
        counterpart = inefficient.sources.get(name)
        if source.estimated:
            # A new measurement does not belong to the common data.
            if counterpart is not None and counterpart.estimated and source.remeasured(counterpart):
                remeasured.append((source.shifts, counterpart.shifts))
        elif counterpart is not None and source.same_statement(counterpart):
            common.append((source, counterpart))
            shared.append(name)
        else:
            unshared.append(source.shifts)
    # Sources that the efficient result states differently or omits.
    unshared_shifts = [
        source.shifts
        for name, source in inefficient.sources.items()
        if not (source.estimated or name in shared or _is_estimated(efficient, name))
    ]
    remeasured_efficient, remeasured_inefficient = (
        covariance_of_shifts([pair[i] for pair in remeasured], size) for i in (0, 1)
    )
    inefficient_covariance = inefficient.covariance - remeasured_inefficient
    inefficient_covariance = inefficient_covariance - covariance_of_shifts(
        [*(counterpart.shifts for _, counterpart in common), *unshared_shifts], size
    )
    efficient_covariance = (
        efficient.covariance - remeasured_efficient - efficient.source_covariance(estimated=False)
    )
    if relation.noise_ratio != 1.0:
        ratio = relation.noise_ratio if efficient is second else 1.0 / relation.noise_ratio
        priors = efficient.source_covariance(estimated=True) - remeasured_efficient
        efficient_covariance = priors + ratio**2 * (efficient_covariance - priors)
    scale = np.sqrt(np.diag(first.covariance) + np.diag(second.covariance))
    excess = np.zeros((size, size))
    if not relation.same_weights:
        excess = _absolute_matrix(
            (inefficient_covariance - efficient_covariance) / np.outer(scale, scale)
        ) * np.outer(scale, scale)
    common_shifts = covariance_of_shifts(
        [counterpart.shifts - source.shifts for source, counterpart in common], size
    )
    return excess + common_shifts + covariance_of_shifts(
        [*unshared, *unshared_shifts], size
    ) + remeasured_efficient + remeasured_inefficient, shared


def _is_estimated(estimates: Estimates, name: str) -> bool:
    return name in estimates.sources and estimates.sources[name].estimated


def _absolute_matrix(matrix: Array) -> Array:
    """Return a symmetric matrix with the absolute values of its eigenvalues.

    Negative eigenvalues occur only if the estimate assumed efficient is not.
    """
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    values = np.where(np.abs(values) > NEGLIGIBLE, np.abs(values), 0.0)
    size: Array = (vectors * values) @ vectors.T
    return size


def chi_square(
    difference: Array, covariance: Array, scale: Array
) -> tuple[float, int, float | None]:
    """Return chi-square of a difference, its degrees of freedom and the probability of more.

    difference: Shape (p,).
    covariance: Covariance of the difference, shape (p, p); the degrees of freedom are the number
        of directions with non-negligible variance.
    scale: Standard uncertainties, relative to which a variance is negligible, shape (p,).
    """
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    significant = values > 2.0 * NEGLIGIBLE
    projection = vectors.T @ (difference / scale)
    chi2 = float(np.sum(projection[significant] ** 2 / values[significant]))
    dof = int(np.count_nonzero(significant))
    return chi2, dof, chi_square_tail(dof, chi2) if dof and math.isfinite(chi2) else None


@frozen(eq=False)
class SharedSource:
    """A source of uncertainty that shifts estimates."""

    estimated: bool  #: True: estimated with the data; False: considered.
    #: Value, if the result states it, and standard uncertainty.
    stated: tuple[float | None, float]
    shifts: Array  #: Signed shift of each estimate by its standard uncertainty, shape (p,).
    of_run: bool  #: Whether it belongs to one run or mounting, like a tilt or a misalignment.

    def same_statement(self, other: SharedSource) -> bool:
        """Return whether another source has the same statement, as far as the results state it."""
        return self.same_u(other) and not self.remeasured(other)

    def same_u(self, other: SharedSource) -> bool:
        """Return whether another source has the same standard uncertainty."""
        return bool(np.isclose(self.stated[1], other.stated[1], rtol=1e-9, atol=0.0))

    def remeasured(self, other: SharedSource) -> bool:
        """Return whether another source has a different value, which means a new measurement."""
        return None not in (self.stated[0], other.stated[0]) and self.stated[0] != other.stated[0]


@frozen(eq=False)
class Estimates:
    """Estimates of one accelerometer, p of them."""

    symbols: tuple[str, ...]  #: Symbols of the terms.
    value: Array  #: Shape (p,).
    covariance: Array  #: Total covariance, shape (p, p).
    #: Stated and default priors, considered terms, and recorded rotations, by name.
    sources: dict[str, SharedSource]
    #: Whether the sources and correlations are known; else only the sum of the considered terms is
    #: known, `considered_u`, and the covariance may lack correlations.
    complete: bool
    considered_u: Array  #: Root sum of squares of the considered terms, shape (p,).

    def source_covariance(self, *, estimated: bool) -> Array:
        """Return the covariance due to the estimated sources, or due to the considered ones."""
        if not self.complete and not estimated:
            return np.diag(self.considered_u**2)
        moves = [s.shifts for s in self.sources.values() if s.estimated is estimated]
        return covariance_of_shifts(moves, len(self.symbols))


def covariance_of_shifts(shifts: Sequence[Array], size: int) -> Array:
    """Return the covariance due to independent sources, shape (size, size)."""
    if not shifts:
        return np.zeros((size, size))
    stacked = np.stack(shifts)
    covariance: Array = stacked.T @ stacked
    return covariance


def g_units_ratio(symbol: str, gravity: float, other_gravity: float) -> float:
    """Return the factor that converts a term to g-units of another gravity.

    A coefficient of n factors is in g/g^n, and so is proportional to g^(1 - n).
    """
    return (
        (gravity / other_gravity) ** (1 - len(TERMS[symbol].effect.factors))
        if symbol in TERMS
        else 1.0
    )


def estimates_of(
    result: Result, name: str, symbols: Sequence[str], gravity: float | None = None
) -> Estimates:
    """Return the estimates of some of an accelerometer's terms from a result.

    gravity: Gravity of the g-units of the numbers, m/s^2; None: the result's own.
    """
    accelerometer = result.accelerometers[name]
    coefficients = [accelerometer.coefficients[symbol] for symbol in symbols]
    own_gravity = result.inputs.gravity
    target_gravity = own_gravity if gravity is None else gravity
    factor = np.array([g_units_ratio(s, own_gravity, target_gravity) for s in symbols])
    u = np.array([c.u or 0.0 for c in coefficients])
    correlation = np.eye(len(coefficients))
    stated = accelerometer.correlation
    known = stated is not None and set(symbols) <= set(stated.terms)
    if stated is not None and known:
        indices = [stated.terms.index(symbol) for symbol in symbols]
        correlation = np.array(stated.matrix)[np.ix_(indices, indices)]
    sources = {
        source: _scale_source(shared, factor)
        for source, shared in _sources(result, name, symbols).items()
    }
    return Estimates(
        symbols=tuple(symbols),
        value=factor * np.array([c.value or 0.0 for c in coefficients]),
        covariance=np.outer(factor * u, factor * u) * correlation,
        sources=sources,
        complete=known and all(accelerometer.budget.get(symbol) for symbol in symbols),
        considered_u=factor * np.array([_considered_u(result, c) for c in coefficients]),
    )


def _considered_u(result: Result, coefficient: Coefficient) -> float:
    """Return u due to possibly considered terms: of all priors in two stages, else zero."""
    if result.method != "two-stage":
        return 0.0
    return math.hypot(coefficient.u_stated or 0.0, coefficient.u_unstated or 0.0)


def _scale_source(source: SharedSource, factor: Array) -> SharedSource:
    return SharedSource(source.estimated, source.stated, source.shifts * factor, source.of_run)


def _sources(result: Result, name: str, symbols: Sequence[str]) -> dict[str, SharedSource]:
    accelerometer = result.accelerometers[name]
    sources: dict[str, SharedSource] = {}
    for index, symbol in enumerate(symbols):
        for line in accelerometer.budget.get(symbol, ()):
            if line.u is None or line.sensitivity is None:
                continue
            source = sources.get(line.source)
            if source is None:
                source = sources[line.source] = SharedSource(
                    # The encoder leaves the same uncertainty of a rotation in every fit.
                    estimated=line.kind in ("stated", "unstated"),
                    stated=(_value(result, name, line.source), line.u),
                    shifts=np.zeros(len(symbols)),
                    of_run=bool(mounting_name(line.source))
                    or any(line.source.startswith(f"{run}.") for run in result.runs),
                )
            source.shifts[index] = line.sensitivity * line.u
    return sources


def _value(result: Result, name: str, source: str) -> float | None:
    """Return the value of an input or of a prior, if the result states it."""
    inputs, accelerometer = result.inputs, result.accelerometers[name]
    stated = {
        "centrifuge.radius": inputs.radius,
        "site.gravity": inputs.gravity,
        "site.latitude": inputs.latitude,
    }
    if source in stated:
        return stated[source]
    if source in accelerometer.known:
        return accelerometer.known[source].value
    for known in result.rests_on:
        if known.name in (source, f"{name}.{source}"):
            return known.value
    coefficient = accelerometer.coefficients.get(source)
    return None if coefficient is None or coefficient.estimated else coefficient.value


def records_of(result: Result) -> frozenset[str]:
    """Return the checksums of the input files of a result, except its description."""
    return frozenset(
        checksum
        for file, checksum in result.provenance.inputs.items()
        if not file.endswith(".toml") and checksum.startswith("sha256:")
    )


def relation_of(
    name: str, results: tuple[Result, Result], estimates: tuple[Estimates, Estimates]
) -> tuple[Relation, list[str]]:
    """Return the relation of two results of an accelerometer, and the assumptions in words."""
    first, second = results
    records = records_of(first), records_of(second)
    assumed = []
    if not all(e.complete for e in estimates):
        assumed.append(
            "One of the results has no uncertainty budget or no correlations, so the "
            "comparison treats its coefficients as uncorrelated."
        )
    if not all(records):
        assumed.append(
            "One of the results does not list its records. The comparison assumes that the two "
            "results are independent."
        )
    if not records[0] & records[1]:
        assumed.append(
            "Values of radius, gravity and priors that both results state identically are "
            "treated as the same measurement. All other inputs are treated as independent."
        )
        return Relation("independent"), assumed
    overlap: Literal["same", "part"] = "same" if records[0] == records[1] else "part"
    efficient = _efficient_estimate(results, records, estimates)
    same_weights = (
        overlap == "same" and efficient is not None and _has_same_weights(name, results, estimates)
    )
    if efficient is None and overlap == "part":
        assumed.append(
            "The results share some records, but neither result uses all records of the other. "
            "The comparison assumes that the results are independent, which overestimates the "
            "uncertainty of a difference."
        )
    elif first.model != second.model:
        assumed.append(
            "One of the results was computed with the paper's equations as printed, which "
            "estimate a different quantity. The uncertainty of a difference is therefore of "
            "little use."
        )
    elif efficient is None:
        assumed.append(
            "The models are not nested, or the priors differ. The comparison assumes that the "
            "result with the smaller variance is the best estimate from these records, and "
            "subtracts the variances."
        )
    elif first.method != second.method:
        assumed.append(
            "The comparison assumes that the joint method gives the best estimate from these "
            "records, and subtracts the variances."
        )
    elif not same_weights and _estimated_noise(name, first) != _estimated_noise(name, second):
        assumed.append(
            "The two results state different noise. The variances were subtracted, but the "
            "weights also differ, so the uncertainty of the difference is approximate."
        )
    return Relation(overlap, efficient, same_weights, _noise_ratio(name, first, second)), assumed


def _efficient_estimate(
    results: tuple[Result, Result],
    records: tuple[frozenset[str], frozenset[str]],
    estimates: tuple[Estimates, Estimates],
) -> Literal[0, 1] | None:
    """Return the index of the best linear unbiased estimate from the common data, or None.

    It has all records of the other, no term that the other lacks, and the same priors.
    """
    first, second = results
    if first.model != second.model:
        return None
    if first.method != second.method:
        return (0 if first.method == "joint" else 1) if records[0] == records[1] else None
    first_sources, second_sources = (e.sources for e in estimates)
    if any(
        s.estimated and n in second_sources and not _same_prior(n, first_sources, second_sources)
        for n, s in first_sources.items()
    ):
        return None
    of_runs = set(first.runs) ^ set(second.runs)
    terms = [{term for term in terms_of(r) if term.split(".")[0] not in of_runs} for r in results]
    if records[0] >= records[1] and terms[0] <= terms[1]:
        return 0
    if records[1] >= records[0] and terms[1] <= terms[0]:
        return 1
    return None


def _same_prior(
    name: str, first: Mapping[str, SharedSource], second: Mapping[str, SharedSource]
) -> bool:
    counterpart = second[name]
    return (
        not counterpart.estimated
        or first[name].same_statement(counterpart)
        or first[name].remeasured(counterpart)
    )


def _has_same_weights(
    name: str, results: tuple[Result, Result], estimates: tuple[Estimates, Estimates]
) -> bool:
    first, second = results
    first_sources, second_sources = (e.sources for e in estimates)
    estimated = [
        {n for n, s in sources.items() if s.estimated}
        for sources in (first_sources, second_sources)
    ]
    return (
        first.method == second.method
        and first.model == second.model
        and first.provenance.options == second.provenance.options
        and terms_of(first) == terms_of(second)
        and estimated[0] == estimated[1]
        and all(first_sources[n].same_u(second_sources[n]) for n in estimated[0])
        and _estimated_noise(name, first) == _estimated_noise(name, second)
    )


def _estimated_noise(name: str, result: Result) -> dict[str, float | None]:
    """Return the noise sizes that affect the weights: none for white noise alone."""
    lines = result.accelerometers[name].noise
    if len(lines) == 1:
        return dict.fromkeys(lines)
    return {component: None if line.estimated else line.value for component, line in lines.items()}


def _noise_ratio(name: str, first: Result, second: Result) -> float:
    first_noise, second_noise = (result.accelerometers[name].noise for result in (first, second))
    if len(first_noise) != 1 or set(first_noise) != set(second_noise):
        return 1.0
    ((component, line),) = first_noise.items()
    return (
        line.value / second_noise[component].value
        if line.value and second_noise[component].value
        else 1.0
    )


def use_joint_check(
    name: str,
    results: tuple[Result, Result],
    estimates: tuple[Estimates, Estimates],
    covariance: Array,
) -> Array:
    """Return a covariance with the u of the difference that a joint result states."""
    for joint, two_stage in (results, results[::-1]):
        check = joint.accelerometers[name].two_stage
        coefficient = two_stage.accelerometers[name].coefficients.get("K_II")
        if (
            joint.method != "joint"
            or two_stage.method != "two-stage"
            or not check
            or not coefficient
        ):
            continue
        # The same estimate, except for the rounding of sums in each result.
        is_same_estimate = (
            coefficient.value is not None
            and abs(coefficient.value - check.value) <= _ROUNDING * check.u
        )
        if is_same_estimate and "K_II" in estimates[0].symbols:
            index = estimates[0].symbols.index("K_II")
            covariance = covariance.copy()
            covariance[index, index] = check.u_difference**2
    return covariance
