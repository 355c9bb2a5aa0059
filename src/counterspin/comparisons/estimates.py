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
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient, NominalOutput
from counterspin.comparability import (
    are_different,
    g_units_ratio,
    is_instrument_source,
    output_conversion,
    source_value,
)
from counterspin.comparisons.rerun import term_names
from counterspin.frozen import frozen
from counterspin.inference.distributions import chi_square_tail
from counterspin.physics.terms import mounting_name

#: Relative variance below which a difference of variances is a rounding error.
NEGLIGIBLE_VARIANCE: Final = 1e-9

#: Difference of two values, relative to u, that is a rounding error.
_ROUNDING_TOLERANCE: Final = 1e-6

#: Smallest share of a variance for which a shared source is named.
_MIN_VARIANCE_SHARE: Final = 1e-3


@frozen
class Relation:
    """Relation of two results: common records, efficient estimate, noise ratio."""

    #: Overlap of the records.
    overlap: Literal["same", "part", "independent"]
    #: Index of the result with the efficient estimate from the common data; None: unknown. The
    #: result with the smaller variance is then assumed to be efficient.
    efficient_index: Literal[0, 1] | None = None
    #: Whether both results weight the same records equally, so that noise shifts them equally.
    has_same_weights: bool = False
    #: Noise of the first result divided by the noise of the second, if both estimate it.
    noise_ratio: float = 1.0
    #: Whether independent results may share terms of the instrument, or of machine and site.
    is_same_instrument: bool = True
    is_same_machine: bool = True


def covariance_of_difference(
    first: Estimates, second: Estimates, relation: Relation
) -> tuple[Array, list[str]]:
    """Return the covariance of second minus first, and the names of the shared sources."""
    is_partial_overlap = relation.overlap == "part" and relation.efficient_index is None
    if relation.overlap == "independent" or is_partial_overlap:
        return _independent_covariance(first, second, relation)
    return _common_record_covariance(first, second, relation)


def _independent_covariance(
    first: Estimates, second: Estimates, relation: Relation
) -> tuple[Array, list[str]]:
    covariance = first.covariance + second.covariance
    shared_names = []
    for name, first_source in first.sources.items():
        second_source = second.sources.get(name)
        if (
            second_source is not None
            and (
                relation.is_same_instrument
                if is_instrument_source(name)
                else relation.is_same_machine
            )
            and not first_source.is_run_specific
            and first_source.has_same_statement(second_source)
        ):
            cross_covariance = np.outer(first_source.shifts, second_source.shifts)
            covariance = covariance - cross_covariance - cross_covariance.T
            if np.any(
                np.abs(np.diag(cross_covariance)) > _MIN_VARIANCE_SHARE * np.diag(first.covariance)
            ):
                shared_names.append(name)
    return covariance, shared_names


def _common_record_covariance(
    first: Estimates, second: Estimates, relation: Relation
) -> tuple[Array, list[str]]:
    efficient_estimates, inefficient_estimates = (
        (first, second) if relation.efficient_index != 1 else (second, first)
    )
    n_terms = len(first.symbols)
    if not (first.is_complete and second.is_complete):
        # The sensitivities are unknown: considered terms are assumed to shift both equally.
        noise_variances = [
            np.diag(estimates.covariance) - estimates.considered_u**2
            for estimates in (first, second)
        ]
        if relation.has_same_weights:
            noise_variances = [np.zeros(n_terms), np.zeros(n_terms)]
        covariance = (
            np.abs(noise_variances[0] - noise_variances[1])
            + (first.considered_u - second.considered_u) ** 2
        )
        return np.diag(covariance), []
    common_sources, efficient_only_shifts = list[tuple[SharedSource, SharedSource]](), list[Array]()
    unshared_shift_pairs = list[tuple[Array, Array]]()
    shared_names = []
    for name, efficient_source in efficient_estimates.sources.items():
        inefficient_source = inefficient_estimates.sources.get(name)
        if efficient_source.estimated:
            # A new measurement does not belong to the common data.
            if (
                inefficient_source is not None
                and inefficient_source.estimated
                and efficient_source.is_remeasured(inefficient_source)
            ):
                unshared_shift_pairs.append((efficient_source.shifts, inefficient_source.shifts))
        elif inefficient_source is not None and efficient_source.has_same_statement(
            inefficient_source
        ):
            common_sources.append((efficient_source, inefficient_source))
            shared_names.append(name)
        else:
            efficient_only_shifts.append(efficient_source.shifts)
    # Sources that the efficient result states differently or omits.
    inefficient_only_shifts = [
        inefficient_source.shifts
        for name, inefficient_source in inefficient_estimates.sources.items()
        if not (
            inefficient_source.estimated
            or name in shared_names
            or _is_estimated(efficient_estimates, name)
        )
    ]
    efficient_unshared_covariance, inefficient_unshared_covariance = (
        covariance_of_shifts([pair[i] for pair in unshared_shift_pairs], n_terms) for i in (0, 1)
    )
    inefficient_covariance = inefficient_estimates.covariance - inefficient_unshared_covariance
    inefficient_covariance = inefficient_covariance - covariance_of_shifts(
        [
            *(inefficient_source.shifts for _, inefficient_source in common_sources),
            *inefficient_only_shifts,
        ],
        n_terms,
    )
    efficient_covariance = (
        efficient_estimates.covariance
        - efficient_unshared_covariance
        - efficient_estimates.source_covariance(estimated=False)
    )
    if relation.noise_ratio != 1.0:
        noise_ratio = (
            relation.noise_ratio if efficient_estimates is second else 1.0 / relation.noise_ratio
        )
        prior_covariance = (
            efficient_estimates.source_covariance(estimated=True) - efficient_unshared_covariance
        )
        efficient_covariance = prior_covariance + noise_ratio**2 * (
            efficient_covariance - prior_covariance
        )
    uncertainties = np.sqrt(np.diag(first.covariance) + np.diag(second.covariance))
    excess_covariance = np.zeros((n_terms, n_terms))
    if not relation.has_same_weights:
        excess_covariance = _absolute_matrix(
            (inefficient_covariance - efficient_covariance) / np.outer(uncertainties, uncertainties)
        ) * np.outer(uncertainties, uncertainties)
    common_covariance = covariance_of_shifts(
        [
            inefficient_source.shifts - efficient_source.shifts
            for efficient_source, inefficient_source in common_sources
        ],
        n_terms,
    )
    return excess_covariance + common_covariance + covariance_of_shifts(
        [*efficient_only_shifts, *inefficient_only_shifts], n_terms
    ) + efficient_unshared_covariance + inefficient_unshared_covariance, shared_names


def _is_estimated(estimates: Estimates, source_name: str) -> bool:
    return source_name in estimates.sources and estimates.sources[source_name].estimated


def _absolute_matrix(matrix: Array) -> Array:
    """Return a symmetric matrix with the absolute values of its eigenvalues.

    Negative eigenvalues occur only if the estimate is wrongly assumed to be efficient.
    """
    eigenvalues, eigenvectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    eigenvalues = np.where(np.abs(eigenvalues) > NEGLIGIBLE_VARIANCE, np.abs(eigenvalues), 0.0)
    absolute_matrix: Array = (eigenvectors * eigenvalues) @ eigenvectors.T
    return absolute_matrix


def chi_square(
    differences: Array, covariance: Array, uncertainties: Array
) -> tuple[float, int, float | None]:
    """Return chi-square of differences, its degrees of freedom and p-value.

    differences: Shape (p,).
    covariance: Covariance of the difference, shape (p, p); the degrees of freedom are the number
        of directions with non-negligible variance.
    uncertainties: Standard uncertainties, relative to which a variance is negligible, shape (p,).
    """
    eigenvalues, eigenvectors = np.linalg.eigh(covariance / np.outer(uncertainties, uncertainties))
    is_significant = eigenvalues > 2.0 * NEGLIGIBLE_VARIANCE
    projection = eigenvectors.T @ (differences / uncertainties)
    chi2 = float(np.sum(projection[is_significant] ** 2 / eigenvalues[is_significant]))
    dof = int(np.count_nonzero(is_significant))
    return chi2, dof, chi_square_tail(dof, chi2) if dof and math.isfinite(chi2) else None


@frozen(eq=False)
class SharedSource:
    """A source of uncertainty that shifts estimates."""

    estimated: bool  #: True: estimated with the data; False: considered.
    #: Value, if the result states it, and standard uncertainty.
    value_and_u: tuple[float | None, float]
    shifts: Array  #: Signed shift of each estimate by its standard uncertainty, shape (p,).
    is_run_specific: bool  #: Whether the source belongs to one run or mounting, such as a tilt.

    def has_same_statement(self, other_source: SharedSource) -> bool:
        """Return whether another source has the same u and not a different value."""
        return self.has_same_u(other_source) and not self.is_remeasured(other_source)

    def has_same_u(self, other_source: SharedSource) -> bool:
        """Return whether another source has the same standard uncertainty."""
        return bool(
            np.isclose(self.value_and_u[1], other_source.value_and_u[1], rtol=1e-9, atol=0.0)
        )

    def is_remeasured(self, other_source: SharedSource) -> bool:
        """Return whether another source has a different value and so is a new measurement."""
        return (
            None not in (self.value_and_u[0], other_source.value_and_u[0])
            and self.value_and_u[0] != other_source.value_and_u[0]
        )


@frozen(eq=False)
class Estimates:
    """Estimates of one accelerometer, p of them."""

    symbols: tuple[str, ...]  #: Symbols of the terms.
    values: Array  #: Shape (p,).
    covariance: Array  #: Total covariance, shape (p, p).
    #: Stated and default priors, considered terms, and recorded rotations, by name.
    sources: dict[str, SharedSource]
    #: Whether the sources and correlations are known; if not, only `considered_u` is known, and
    #: the covariance may lack correlations.
    is_complete: bool
    considered_u: Array  #: Root sum of squares of the considered terms, shape (p,).

    def source_covariance(self, *, estimated: bool) -> Array:
        """Return the covariance due to the estimated sources, or due to the considered ones."""
        if not self.is_complete and not estimated:
            return np.diag(self.considered_u**2)
        shifts = [
            source.shifts for source in self.sources.values() if source.estimated is estimated
        ]
        return covariance_of_shifts(shifts, len(self.symbols))


def covariance_of_shifts(shifts: Sequence[Array], n_terms: int) -> Array:
    """Return the covariance due to independent sources, shape (n_terms, n_terms)."""
    if not shifts:
        return np.zeros((n_terms, n_terms))
    stacked_shifts = np.stack(shifts)
    covariance: Array = stacked_shifts.T @ stacked_shifts
    return covariance


def extract_estimates(
    result: Result,
    name: str,
    symbols: Sequence[str],
    units: tuple[float, NominalOutput | None] | None = None,
) -> Estimates:
    """Extract the estimates of some terms of an accelerometer from a result.

    units: Gravity, m/s^2, and nominal output to which the numbers are converted; None: those of
        the result.
    """
    accelerometer = result.accelerometers[name]
    coefficients = [accelerometer.coefficients[symbol] for symbol in symbols]
    gravity = result.inputs.gravity
    target_gravity, target_output = units or (gravity, accelerometer.nominal)
    conversion = output_conversion(accelerometer.nominal, gravity, target_output, target_gravity)
    ratios = conversion.ratio * np.array(
        [g_units_ratio(symbol, gravity, target_gravity) for symbol in symbols]
    )
    u = np.array([coefficient.u or 0.0 for coefficient in coefficients])
    correlation_matrix = np.eye(len(coefficients))
    correlation = accelerometer.correlation
    has_correlations = correlation is not None and set(symbols) <= set(correlation.terms)
    if correlation is not None and has_correlations:
        indices = [correlation.terms.index(symbol) for symbol in symbols]
        correlation_matrix = np.array(correlation.matrix)[np.ix_(indices, indices)]
    sources = {
        source: _scale_source(unscaled_source, ratios)
        for source, unscaled_source in _extract_sources(result, name, symbols).items()
    }
    return Estimates(
        symbols=tuple(symbols),
        values=ratios * np.array([coefficient.value or 0.0 for coefficient in coefficients])
        + [conversion.shift(symbol) for symbol in symbols],
        covariance=np.outer(ratios * u, ratios * u) * correlation_matrix,
        sources=sources,
        is_complete=has_correlations
        and all(accelerometer.budget.get(symbol) for symbol in symbols),
        considered_u=ratios
        * np.array([_considered_u(result, coefficient) for coefficient in coefficients]),
    )


def _considered_u(result: Result, coefficient: Coefficient) -> float:
    """Return u due to considered terms: u of all priors for the two-stage method, else zero."""
    if result.method != "two-stage":
        return 0.0
    return math.hypot(coefficient.u_stated or 0.0, coefficient.u_unstated or 0.0)


def _scale_source(source: SharedSource, ratios: Array) -> SharedSource:
    return SharedSource(
        source.estimated, source.value_and_u, source.shifts * ratios, source.is_run_specific
    )


def _extract_sources(result: Result, name: str, symbols: Sequence[str]) -> dict[str, SharedSource]:
    accelerometer = result.accelerometers[name]
    sources: dict[str, SharedSource] = {}
    for index, symbol in enumerate(symbols):
        for line in accelerometer.budget.get(symbol, ()):
            if line.u is None or line.sensitivity is None:
                continue
            source = sources.get(line.source)
            if source is None:
                source = sources[line.source] = SharedSource(
                    # A rotation from the encoder has the same uncertainty in every fit.
                    estimated=line.kind in ("stated", "unstated"),
                    value_and_u=(source_value(result, name, line.source), line.u),
                    shifts=np.zeros(len(symbols)),
                    is_run_specific=bool(mounting_name(line.source))
                    or any(line.source.startswith(f"{run}.") for run in result.runs),
                )
            source.shifts[index] = line.sensitivity * line.u
    return sources


def record_checksums(result: Result) -> frozenset[str]:
    """Return the checksums of the input files of a result, except the campaign description."""
    return frozenset(
        checksum
        for file, checksum in result.provenance.inputs.items()
        if not file.endswith(".toml") and checksum.startswith("sha256:")
    )


def relate_results(
    name: str, results: tuple[Result, Result], estimates: tuple[Estimates, Estimates]
) -> tuple[Relation, list[str]]:
    """Return the relation of two results of an accelerometer, and the assumptions as text."""
    first_result, second_result = results
    checksums = record_checksums(first_result), record_checksums(second_result)
    assumptions = []
    if not all(pair_estimates.is_complete for pair_estimates in estimates):
        assumptions.append(
            "One of the results has no uncertainty budget or no correlations, so the "
            "comparison treats its coefficients as uncorrelated."
        )
    if not all(checksums):
        assumptions.append(
            "One of the results does not list its records. The comparison assumes that the two "
            "results are independent."
        )
    if not checksums[0] & checksums[1]:
        relation = Relation(
            "independent",
            is_same_instrument=not are_different(serial_numbers(name, results)),
            is_same_machine=not are_different(laboratory_names(results)),
        )
        assumptions += _describe_independence(name, results, relation)
        return relation, assumptions
    overlap: Literal["same", "part"] = "same" if checksums[0] == checksums[1] else "part"
    efficient_index = _efficient_result_index(results, checksums, estimates)
    has_same_weights = (
        overlap == "same"
        and efficient_index is not None
        and _has_same_weights(name, results, estimates)
    )
    if efficient_index is None and overlap == "part":
        assumptions.append(
            "The results share some records, but neither result uses all records of the other. "
            "The comparison assumes that the results are independent, which overestimates the "
            "uncertainty of a difference."
        )
    elif first_result.model != second_result.model:
        assumptions.append(
            "One of the results was computed with the paper's equations as printed, which "
            "estimate a different quantity. The uncertainty of a difference is therefore not "
            "meaningful."
        )
    elif efficient_index is None:
        assumptions.append(
            "The models are not nested, or the priors differ. The comparison assumes that the "
            "result with the smaller variance is the best estimate from these records, and "
            "subtracts the variances."
        )
    elif first_result.method != second_result.method:
        assumptions.append(
            "The comparison assumes that the joint method gives the best estimate from these "
            "records, and subtracts the variances."
        )
    elif not has_same_weights and _estimated_noise(name, first_result) != _estimated_noise(
        name, second_result
    ):
        assumptions.append(
            "The two results state different noise. The comparison subtracts the variances, but "
            "the weights also differ, so the uncertainty of the difference is approximate."
        )
    return Relation(
        overlap, efficient_index, has_same_weights, _noise_ratio(name, first_result, second_result)
    ), assumptions


def serial_numbers(name: str, results: Sequence[Result]) -> list[str | None]:
    """Return the serial numbers of an accelerometer; of the campaigns if it has none."""
    numbers = [result.accelerometers[name].serial_number for result in results]
    campaign_numbers = [result.details.get("serial_number") for result in results]
    return numbers if any(numbers) else campaign_numbers


def laboratory_names(results: Sequence[Result]) -> list[str | None]:
    """Return the laboratories that the campaigns state."""
    return [result.details.get("laboratory") for result in results]


def _describe_independence(
    name: str, results: Sequence[Result], relation: Relation
) -> Iterator[str]:
    """Yield the assumptions about common inputs of independent results."""
    if not relation.is_same_instrument:
        numbers = " and ".join(map(str, serial_numbers(name, results)))
        yield (
            f"The serial numbers of {name} differ ({numbers}). The comparison treats the results "
            "as results of different instruments, whose terms are independent."
        )
    if not relation.is_same_machine:
        laboratories = " and ".join(map(str, laboratory_names(results)))
        yield (
            f"The laboratories differ ({laboratories}). The comparison treats their machines and "
            "sites as independent."
        )
    common_inputs = {
        (True, True): "values of radius, gravity and priors",
        (True, False): "priors of the instrument",
        (False, True): "values of radius and gravity, and priors of the machine,",
    }.get((relation.is_same_instrument, relation.is_same_machine))
    if common_inputs is None:
        yield "The comparison treats all inputs as independent."
    else:
        yield (
            f"The comparison treats all inputs as independent, except {common_inputs} that both "
            "results state identically: it treats these as the same measurement."
        )


def _efficient_result_index(
    results: tuple[Result, Result],
    checksums: tuple[frozenset[str], frozenset[str]],
    estimates: tuple[Estimates, Estimates],
) -> Literal[0, 1] | None:
    """Return the index of the best linear unbiased estimate from the common data, or None.

    The best estimate uses all records of the other result, no additional term, and the same priors.
    """
    first, second = results
    if first.model != second.model:
        return None
    if first.method != second.method:
        return (0 if first.method == "joint" else 1) if checksums[0] == checksums[1] else None
    first_sources, second_sources = (result_estimates.sources for result_estimates in estimates)
    if any(
        source.estimated
        and source_name in second_sources
        and not _has_same_prior(source_name, first_sources, second_sources)
        for source_name, source in first_sources.items()
    ):
        return None
    unshared_runs = set(first.runs) ^ set(second.runs)
    terms = [
        {term for term in term_names(result) if term.split(".")[0] not in unshared_runs}
        for result in results
    ]
    if checksums[0] >= checksums[1] and terms[0] <= terms[1]:
        return 0
    if checksums[1] >= checksums[0] and terms[1] <= terms[0]:
        return 1
    return None


def _has_same_prior(
    name: str, first: Mapping[str, SharedSource], second: Mapping[str, SharedSource]
) -> bool:
    second_source = second[name]
    return (
        not second_source.estimated
        or first[name].has_same_statement(second_source)
        or first[name].is_remeasured(second_source)
    )


def _has_same_weights(
    name: str, results: tuple[Result, Result], estimates: tuple[Estimates, Estimates]
) -> bool:
    first, second = results
    first_sources, second_sources = (result_estimates.sources for result_estimates in estimates)
    estimated_names = [
        {source_name for source_name, source in sources.items() if source.estimated}
        for sources in (first_sources, second_sources)
    ]
    return (
        first.method == second.method
        and first.model == second.model
        and first.provenance.options == second.provenance.options
        and term_names(first) == term_names(second)
        and estimated_names[0] == estimated_names[1]
        and all(
            first_sources[source_name].has_same_u(second_sources[source_name])
            for source_name in estimated_names[0]
        )
        and _estimated_noise(name, first) == _estimated_noise(name, second)
    )


def _estimated_noise(name: str, result: Result) -> dict[str, float | None]:
    """Return the noise levels that affect the weights: none for white noise alone."""
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


def apply_joint_check(
    name: str,
    results: tuple[Result, Result],
    estimates: tuple[Estimates, Estimates],
    covariance: Array,
) -> Array:
    """Replace the variance of K_II by the variance of the difference in the joint result."""
    for joint_result, two_stage_result in (results, results[::-1]):
        joint_check = joint_result.accelerometers[name].two_stage
        coefficient = two_stage_result.accelerometers[name].coefficients.get("K_II")
        if (
            joint_result.method != "joint"
            or two_stage_result.method != "two-stage"
            or not joint_check
            or not coefficient
        ):
            continue
        # The same estimate, except for the rounding of sums in each result.
        is_same_estimate = (
            coefficient.value is not None
            and abs(coefficient.value - joint_check.value) <= _ROUNDING_TOLERANCE * joint_check.u
        )
        if is_same_estimate and "K_II" in estimates[0].symbols:
            index = estimates[0].symbols.index("K_II")
            covariance = covariance.copy()
            covariance[index, index] = joint_check.u_difference**2
    return covariance
