"""Identifiability of the parameters.

Some coefficients have the same effect. While the platform is level, the bias K_F and K_PP have the
same column, and K_I and K_IP have opposite columns. IEEE Std 836 calls such terms "bucking". A rank
test misses most of these pairs, because Earth rate makes K_I and K_IP differ in the eleventh digit.
Therefore every term has a largest credible size, and a term whose uncertainty is not below this
size is undetermined, whatever the rank.

`assess` uses the data and the true priors, without the regularisation of `least_squares.solve`. It
names each set of terms that the data cannot separate, and the combination that they determine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace
from itertools import combinations
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array, triangular_factor
from counterspin.frozen import frozen
from counterspin.inference.least_squares import Solution

#: Information that stands for "none", relative to that of the column: small enough to exceed every
#: credible limit, and well above rounding.
_RELATIVE_FLOOR: Final = 1e-12

#: The data improve a prior if they reduce its variance by at least a tenth.
MAX_VARIANCE_RATIO: Final = 0.9

#: Terms that contribute less than this fraction of the u of a combination are omitted.
_NEGLIGIBLE_FRACTION: Final = 0.1

#: Terms whose columns correlate by more form a group, whatever their priors.
COLLINEAR_CORRELATION: Final = 1.0 - 1e-6

#: Terms whose columns correlate by more are near-collinear (IEEE Std 836: "bucking").
NEAR_COLLINEAR: Final = 0.95


#: Relative rounding of a covariance with confounded terms; and by how much the correlation that
#: selects pairs is lowered for it.
_COVARIANCE_ROUNDING: Final = 1e-4
_SCREENING_FACTOR: Final = 0.95

#: Above this correlation two terms are called inseparable.
_INSEPARABLE_CORRELATION: Final = 0.999


@frozen
class ConfoundedTerms:
    """Terms that the data cannot or can hardly separate, and the combination they determine."""

    terms: list[str]  #: Names of the terms, in the order of the unknowns.
    #: Correlation between the two estimates from the data alone, without the priors of the terms.
    #: For more than two terms, the largest magnitude among all pairs, with the other terms fixed.
    correlation: float
    #: Combination that the records determine, such as ``K_I - K_IP``. The combination omits each
    #: term that contributes less than a tenth of `u` at its largest credible size. Rounding of the
    #: weights changes the contribution of each term by at most a tenth of `u`.
    determined: str
    #: Exact weights in the order of `terms`; the weight of the first term is 1.
    weights: list[float] = field(default_factory=list)
    value: float | None = None  #: Estimate of the combination.
    u: float | None = None  #: Combined standard uncertainty of the combination.

    @property
    def inseparable(self) -> bool:
        """True if the records cannot separate the terms; False if they hardly can."""
        return abs(self.correlation) > _INSEPARABLE_CORRELATION

    def without_owner(self, owner: str) -> ConfoundedTerms:
        """Return the terms with the prefix of an owner removed."""
        prefix = f"{owner}."
        terms = [name.removeprefix(prefix) for name in self.terms]
        return replace(self, terms=terms, determined=self.determined.replace(prefix, ""))


@frozen
class Assessment:
    """Determined unknowns, and combinations of undetermined unknowns."""

    #: Symbol -> whether the data determine it: u is below the largest credible size, and the data
    #: reduce the variance of the prior by at least a tenth. The data never determine an exactly
    #: known parameter.
    determined: dict[str, bool]
    #: Standard uncertainties from data, priors and considered terms, without regularisation, shape
    #: (p,); huge for an unknown without information.
    u: Array
    #: Combinations of terms that cannot be separated.
    confounded: tuple[ConfoundedTerms, ...]


def assess(
    solution: Solution, symbols: Sequence[str], *, nominal: npt.ArrayLike | None = None
) -> Assessment:
    """Decide which unknowns are determined and name the sets that are confounded.

    Pairs of unknowns are named where their correlation, before their own priors, exceeds
    `NEAR_COLLINEAR` and their combination is known at least twice as well as they are.

    nominal: Nominal values, shape (p,), zeros by default: coefficient = nominal + estimate. They
        enter the values of combinations.
    References: IEEE Std 836, on near-collinear ("bucking") coefficients of centrifuge tests.
    """
    if solution.limits is None:
        raise ValueError("assess requires a solution that was computed with limits")
    p = len(symbols)
    if p > solution.estimate.size or np.isinf(solution.prior_sd[p:]).any():
        count = solution.estimate.size
        raise ValueError(
            f"{p} symbols for {count} unknowns: unknowns without a symbol need a prior"
        )
    nominal_values = np.zeros(p) if nominal is None else np.asarray(nominal, dtype=np.float64)
    limits, prior_sd = solution.limits[:p], solution.prior_sd[:p]
    free_indices = np.flatnonzero(prior_sd > 0)
    information = _Information(
        _project_onto_first_unknowns(solution, p)[:, free_indices],
        solution.whiten_priors(np.eye(solution.estimate.size))[np.ix_(free_indices, free_indices)],
        limits[free_indices],
    )
    covariance_root = information.covariance_root()

    variance = np.diag(solution.covariance_considered)[:p].copy()
    variance[free_indices] += np.sum(covariance_root**2, axis=1)
    if solution.covariance_undetected is not None:
        variance += np.diag(solution.covariance_undetected)[:p]
    is_determined = (
        (prior_sd > 0) & (variance < limits**2) & (variance <= MAX_VARIANCE_RATIO * prior_sd**2)
    )

    # The size of a coefficient such as K_I = 1.002 includes its nominal value.
    credible_sizes = information.limits + np.abs(nominal_values[free_indices])

    def describe_combination(weights: Array) -> tuple[ConfoundedTerms, float]:
        """Return a combination of the free unknowns, and its u over the largest u of its terms."""
        full_weights = np.zeros(solution.estimate.size)
        full_weights[free_indices] = weights
        contributions = np.abs(weights) * credible_sizes
        # An undetermined term always has its partner named.
        min_contribution = min(
            _NEGLIGIBLE_FRACTION * solution.combine(full_weights).u, np.sort(contributions)[-2]
        )
        terms = np.flatnonzero(contributions >= min_contribution)
        full_weights /= weights[terms[0]]
        combination = solution.combine(full_weights)
        names = [symbols[k] for k in free_indices[terms].tolist()]
        term_weights = full_weights[free_indices[terms]]
        confounded = ConfoundedTerms(
            terms=names,
            correlation=information.max_correlation(terms),
            determined=format_combination(
                names, term_weights, _NEGLIGIBLE_FRACTION * combination.u / credible_sizes[terms]
            ),
            weights=term_weights.tolist(),
            value=combination.value + float(full_weights[:p] @ nominal_values),
            u=combination.u,
        )
        return confounded, combination.u / float(
            np.max(np.abs(full_weights[:p]) * np.sqrt(variance))
        )

    undetermined = [
        i
        for i in range(free_indices.size)
        if np.linalg.norm(covariance_root[i]) >= information.limits[i]
    ]
    combinations = _determined_combinations(
        covariance_root, information.limits, undetermined, range(free_indices.size)
    )
    confounded_terms = [describe_combination(weights)[0] for weights in combinations]
    free_index = {symbols[k]: i for i, k in enumerate(free_indices.tolist())}
    groups = _merge_overlapping_sets(
        [[free_index[name] for name in item.terms] for item in confounded_terms]
    )

    pairs = information.collinear_pairs()
    collinear_groups = _merge_overlapping_sets(
        [pair for pair, correlation in pairs.items() if correlation > COLLINEAR_CORRELATION]
    )
    for group in [*collinear_groups, *map(list, pairs)]:
        if any(set(group) <= set(terms) for terms in groups):
            continue
        root_without_priors = information.covariance_root(without_priors=group)
        for weights in _determined_combinations(
            root_without_priors, information.limits, group, group
        ):
            item, ratio = describe_combination(weights)
            # A combination that is known hardly better than its terms carries no information.
            if group in collinear_groups or ratio < 0.5:
                confounded_terms.append(item)
                groups.append(group)
    return Assessment(
        determined={
            name: bool(is_term_determined)
            for name, is_term_determined in zip(symbols, is_determined, strict=True)
        },
        u=np.sqrt(variance),
        confounded=tuple(confounded_terms),
    )


def _project_onto_first_unknowns(solution: Solution, p: int) -> Array:
    """Return the information on the first unknowns; the others are projected out with priors."""
    # Exactly known unknowns need no projection.
    uncertain_indices = p + np.flatnonzero(solution.prior_sd[p:] > 0.0)
    n_uncertain = uncertain_indices.size
    if n_uncertain == 0:
        return solution.information[:, :p]
    data_rows = np.column_stack(
        [solution.information[:, uncertain_indices], solution.information[:, :p]]
    )
    priors = solution.whiten_priors(np.eye(solution.estimate.size))[uncertain_indices]
    prior_rows = np.column_stack([priors[:, uncertain_indices], priors[:, :p]])
    return triangular_factor(np.vstack([data_rows, prior_rows]))[n_uncertain:, n_uncertain:]


class _Information:
    """The data's square-root information and the priors' rows of the free unknowns."""

    def __init__(self, data: Array, priors: Array, limits: Array) -> None:
        self.data = triangular_factor(data)
        self.priors = priors
        self.limits = limits
        column_norms = np.sqrt(np.sum(self.data**2, axis=0) + np.sum(priors**2, axis=0))
        # A column without information is bounded in units of its limit.
        self.floor = _RELATIVE_FLOOR * np.maximum(column_norms, 1.0 / limits)

    def covariance_root(self, without_priors: Sequence[int] = ()) -> Array:
        """Return T, with T @ T.T the covariance from data and priors, omitting some priors."""
        priors = self.priors.copy()
        priors[list(without_priors)] = 0.0
        rows = np.vstack([self.data, priors, np.diag(self.floor)])
        inverse = np.linalg.solve(triangular_factor(rows), np.eye(self.floor.size))
        return np.asarray(inverse)

    def max_correlation(self, terms: npt.NDArray[np.intp]) -> float:
        """Return the largest pairwise correlation in a set, without the priors of the set."""
        columns = self._project_onto_sets(terms[None])[0]
        cosines = columns.T @ columns
        norms = np.sqrt(np.diag(cosines))
        cosines = cosines / np.outer(norms, norms)
        worst_pair = max(combinations(range(terms.size), 2), key=lambda pair: abs(cosines[pair]))
        # Columns with positive correlation have estimates with negative correlation.
        return float(np.clip(-cosines[worst_pair], -1.0, 1.0))

    def collinear_pairs(self) -> dict[tuple[int, int], float]:
        """Return pairs that the data observe but can hardly separate, without their own priors."""
        index = self._candidate_pairs()
        if not len(index):
            return {}
        columns = self._project_onto_sets(index)
        norms = np.linalg.norm(columns, axis=1)
        is_observed = (norms * self.limits[index] >= 1.0).all(axis=1)
        cosines = np.zeros(len(index))
        inner_products = np.abs(np.sum(columns[:, :, 0] * columns[:, :, 1], axis=1))
        np.divide(inner_products, norms[:, 0] * norms[:, 1], out=cosines, where=is_observed)
        return {
            (i, j): cosine_value
            for (i, j), cosine_value in zip(index.tolist(), cosines.tolist(), strict=True)
            if cosine_value > NEAR_COLLINEAR
        }

    def _candidate_pairs(self) -> npt.NDArray[np.intp]:
        """Return the pairs that may exceed `NEAR_COLLINEAR` within rounding, shape (pairs, 2).

        The inverse of a 2 x 2 block of the covariance is the information about its pair, with the
        pair's own priors (Schur complement). A single inverse thus serves all pairs. Subtracting
        the priors cancels digits, so it only selects pairs.
        """
        covariance_root = self.covariance_root()
        covariance = covariance_root @ covariance_root.T
        index = np.column_stack(np.triu_indices(self.limits.size, 1))
        i, j = index.T
        variances = np.diag(covariance)[index]
        uncorrelated_fractions = np.maximum(
            1.0 - covariance[i, j] ** 2 / variances.prod(axis=1), np.finfo(np.float64).eps
        )[:, None]
        information = 1.0 / (variances * uncorrelated_fractions)
        rounding = information * _COVARIANCE_ROUNDING / uncorrelated_fractions
        prior_information = (np.sum(self.priors**2, axis=0) + self.floor**2)[index]
        upper_bound = information - prior_information + rounding
        lower_bound = np.maximum(information - prior_information - rounding, 0.0)
        scale = variances.prod(axis=1) * uncorrelated_fractions[:, 0]
        cross_information = covariance[i, j] / scale
        is_observed = (upper_bound * self.limits[index] ** 2 >= 1.0).all(axis=1)
        is_collinear = cross_information**2 >= (
            _SCREENING_FACTOR * NEAR_COLLINEAR
        ) ** 2 * lower_bound.prod(axis=1)
        candidate_pairs: npt.NDArray[np.intp] = index[is_observed & is_collinear]
        return candidate_pairs

    def _project_onto_sets(self, index_sets: npt.NDArray[np.intp]) -> Array:
        """Return the square-root information on sets of s terms, shape (sets, s, s).

        All other unknowns are projected out, with their priors; the sets' own priors are omitted.
        """
        n_terms, set_size = self.floor.size, index_sets.shape[1]
        rows = np.vstack([self.data, self.priors, np.diag(self.floor)])
        batch = np.repeat(rows[None], len(index_sets), axis=0)
        start = self.data.shape[0]
        for column in index_sets.T:
            batch[np.arange(len(index_sets)), start + column] = 0.0
            batch[np.arange(len(index_sets)), start + n_terms + column, column] = 0.0
        is_last = np.zeros((len(index_sets), n_terms), dtype=np.bool_)
        is_last[np.arange(len(index_sets))[:, None], index_sets] = True
        row_order = np.argsort(is_last, axis=1, kind="stable")
        row_order[:, n_terms - set_size :] = index_sets
        ordered_batch = np.take_along_axis(batch, row_order[:, None, :], axis=2)
        return triangular_factor(ordered_batch)[
            :, n_terms - set_size : n_terms, n_terms - set_size :
        ]


def _determined_combinations(
    covariance_root: Array, limits: Array, undetermined: Sequence[int], candidates: Sequence[int]
) -> list[Array]:
    """Return the weights of combinations that are determined although their terms are not.

    From the last undetermined term to the first, a term becomes a pivot unless it is determined
    once the pivots are given. The residual of the regression of a term on the pivots is a
    determined combination. It is uncorrelated with the pivots, and therefore the best known.
    """
    norms = np.linalg.norm(covariance_root, axis=1)
    pivots: list[int] = []
    basis = np.empty((0, covariance_root.shape[1]))

    def project_out_basis(i: int) -> Array:
        projection: Array = covariance_root[i] - basis.T @ (basis @ covariance_root[i])
        residual_vector: Array = projection - basis.T @ (basis @ projection)  # against rounding
        return residual_vector

    def is_explained(i: int) -> bool:
        norm = np.linalg.norm(project_out_basis(i))
        return bool(norm < limits[i] and norm**2 < (1.0 - NEAR_COLLINEAR**2) * norms[i] ** 2)

    for i in sorted(undetermined, reverse=True):
        if not is_explained(i):
            norm = project_out_basis(i)
            basis = np.vstack([basis, norm / np.linalg.norm(norm)])
            pivots.append(i)

    combinations = []
    for i in candidates:
        if i in pivots or not is_explained(i):
            continue
        regressors = list(pivots)
        best_norm = float(np.linalg.norm(project_out_basis(i)))
        for k in pivots:  # omit terms that do not reduce the uncertainty
            fewer_pivots = [pivot for pivot in regressors if pivot != k]
            if (
                np.linalg.norm(
                    _regression_weights(covariance_root, i, fewer_pivots) @ covariance_root
                )
                <= (1.0 + _NEGLIGIBLE_FRACTION) * best_norm
            ):
                regressors = fewer_pivots
        if regressors:
            combinations.append(_regression_weights(covariance_root, i, regressors))
    return combinations


def _regression_weights(covariance_root: Array, i: int, regressors: Sequence[int]) -> Array:
    """Return the weights of unknown `i` minus its regression on others, shape (p,)."""
    weights = np.zeros(covariance_root.shape[0])
    weights[i] = 1.0
    if regressors:
        row_norms = np.linalg.norm(covariance_root[list(regressors)], axis=1)
        scaled_root = covariance_root[list(regressors)] / row_norms[:, None]
        weights[list(regressors)] = (
            -np.linalg.lstsq(scaled_root.T, covariance_root[i], rcond=None)[0] / row_norms
        )
    return weights


def _merge_overlapping_sets(index_sets: Sequence[Sequence[int]]) -> list[list[int]]:
    """Merge sets with common members into groups."""
    groups: list[set[int]] = []
    for members in index_sets:
        merged_group = set(members).union(*(group for group in groups if group & set(members)))
        groups = [group for group in groups if not group & merged_group] + [merged_group]
    return [sorted(group) for group in groups]


def format_combination(
    names: Sequence[str], weights: npt.ArrayLike, tolerance: npt.ArrayLike
) -> str:
    """Write a combination such as ``K_F + 1.1241 K_I``.

    names, weights: Names and weights of the terms, shape (n,).
    tolerance: Largest rounding error of each weight, shape (n,). The weights are written as whole
        numbers if all tolerances permit this, otherwise with the fewest digits.
    """
    coefficients = np.asarray(weights, dtype=np.float64)
    tolerances = np.broadcast_to(np.asarray(tolerance, dtype=np.float64), coefficients.shape)
    rounded_weights = np.round(coefficients)
    if (rounded_weights != 0).all() and (
        np.abs(coefficients - rounded_weights) <= tolerances
    ).all():
        coefficients = rounded_weights
    text = ""
    for name, weight, weight_tolerance in zip(
        names, coefficients.tolist(), tolerances.tolist(), strict=True
    ):
        magnitude = _format_number(abs(weight), weight_tolerance)
        term = name if magnitude == "1" else f"{magnitude} {name}"
        text += f" {'-' if weight < 0 else '+'} {term}"
    return text.removeprefix(" + ")


def _format_number(magnitude: float, tolerance: float) -> str:
    """Return a number with the fewest digits, four or more, that meet the tolerance."""
    for digits in range(4, 17):
        text = f"{magnitude:.{digits}g}"
        if abs(float(text) - magnitude) <= tolerance:
            return text
    return repr(magnitude)
