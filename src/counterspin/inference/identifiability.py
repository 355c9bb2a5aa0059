"""Identifiability of parameters by the data, by name.

Some coefficients act alike: while the platform is level, the bias K_F and K_PP have the same
column, and K_I and K_IP the same but for the sign. IEEE Std 836 calls such terms "bucking". A
test of the rank misses most of it, because Earth rate makes a pair such as K_I and K_IP differ in
the eleventh digit. Hence the rule here: every term has a largest credible size, and a term whose
uncertainty is not below it is undetermined, whatever the rank.

`assess` therefore looks at the data and the true priors only, without the regularisation that
keeps `least_squares.solve` finite, and names each set of terms that the data cannot separate with
the combination that they do determine.
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

#: What stands for "no information": a factor of 1e12 below a column's own, far enough to exceed
#: every credible limit and still well above rounding.
_FLOOR: Final = 1e-12

#: The data improve a prior where they take away at least a tenth of its variance.
MAX_VARIANCE_RATIO: Final = 0.9

#: What the words leave out of a combination is below this part of its u, for any credible size.
_NEGLIGIBLE: Final = 0.1

#: Terms whose columns agree this well are taken together, whatever their priors.
COLLINEAR_CORRELATION: Final = 1.0 - 1e-6

#: Terms whose columns correlate by more are near-collinear (IEEE Std 836: "bucking").
NEAR_COLLINEAR: Final = 0.95


#: Relative rounding of a covariance with confounded terms; and by how much the correlation that
#: selects pairs is lowered for it.
_ROUNDING: Final = 1e-4
_SCREEN: Final = 0.95

#: Above this correlation two terms are called inseparable.
_INSEPARABLE_CORRELATION: Final = 0.999


@frozen
class ConfoundedTerms:
    """Terms that the data cannot tell apart, or hardly, and the combination they do determine."""

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

    def of(self, owner: str) -> ConfoundedTerms:
        """Return the same with an owner's terms named without it."""
        prefix = f"{owner}."
        terms = [name.removeprefix(prefix) for name in self.terms]
        return replace(self, terms=terms, determined=self.determined.replace(prefix, ""))


@frozen
class Assessment:
    """Determined unknowns, and the combinations behind those that are not."""

    #: For each symbol, whether the data determine it: u is below the largest credible size, and of
    #: a prior's variance at least a tenth is taken away. What is known exactly is not determined by
    #: the data.
    determined: dict[str, bool]
    #: Standard uncertainties from data, priors and considered terms, without regularisation, shape
    #: (p,); huge where nothing bounds the unknown.
    u: Array
    #: One entry for each combination that stands for terms which cannot be told apart.
    confounded: tuple[ConfoundedTerms, ...]


def assess(
    solution: Solution,
    symbols: Sequence[str],
    *,
    nominal: npt.ArrayLike | None = None,
) -> Assessment:
    """Decide which unknowns are determined and name the sets that are confounded.

    Pairs of unknowns are named where their correlation, before their own priors, exceeds
    `NEAR_COLLINEAR` and their combination is known at least twice as well as they are.

    nominal: What must be added to the estimates to get the coefficients named (1 for K_I where its
        unknown is K_I - 1), shape (p,); zeros by default. It enters the values of combinations.
    References: IEEE Std 836, on near-collinear ("bucking") coefficients of centrifuge tests.
    """
    if solution.limits is None:
        raise ValueError("assess needs a solution that was solved with limits")
    p = len(symbols)
    if p > solution.estimate.size or np.isinf(solution.prior_sd[p:]).any():
        count = solution.estimate.size
        raise ValueError(
            f"{p} symbols for {count} unknowns: unknowns without a symbol need a prior"
        )
    offset = np.zeros(p) if nominal is None else np.asarray(nominal, dtype=np.float64)
    limits, prior_sd = solution.limits[:p], solution.prior_sd[:p]
    free = np.flatnonzero(prior_sd > 0)
    problem = _Information(
        _project_onto_first(solution, p)[:, free],
        solution.whiten_priors(np.eye(solution.estimate.size))[np.ix_(free, free)],
        limits[free],
    )
    root = problem.root()

    variance = np.diag(solution.covariance_considered)[:p].copy()
    variance[free] += np.sum(root**2, axis=1)
    if solution.covariance_undetected is not None:
        variance += np.diag(solution.covariance_undetected)[:p]
    is_determined = (
        (prior_sd > 0) & (variance < limits**2) & (variance <= MAX_VARIANCE_RATIO * prior_sd**2)
    )

    # A coefficient such as K_I = 1.002 is as large as what its unknown leaves out, and more.
    scales = problem.limits + np.abs(offset[free])

    def describe(weights: Array) -> tuple[ConfoundedTerms, float]:
        """Return a combination of the free unknowns, and its u over the largest of its parts'."""
        full = np.zeros(solution.estimate.size)
        full[free] = weights
        contributions = np.abs(weights) * scales
        # An undetermined term always has its partner named.
        named_from = min(_NEGLIGIBLE * solution.combine(full).u, np.sort(contributions)[-2])
        terms = np.flatnonzero(contributions >= named_from)
        full /= weights[terms[0]]
        combination = solution.combine(full)
        names = [symbols[k] for k in free[terms].tolist()]
        groups = full[free[terms]]
        described_terms = ConfoundedTerms(
            terms=names,
            correlation=problem.correlation(terms),
            determined=write_combination(
                names, groups, _NEGLIGIBLE * combination.u / scales[terms]
            ),
            weights=groups.tolist(),
            value=combination.value + float(full[:p] @ offset),
            u=combination.u,
        )
        return described_terms, combination.u / float(np.max(np.abs(full[:p]) * np.sqrt(variance)))

    undetermined = [i for i in range(free.size) if np.linalg.norm(root[i]) >= problem.limits[i]]
    combinations = _determined_combinations(root, problem.limits, undetermined, range(free.size))
    confounded_terms = [describe(weights)[0] for weights in combinations]
    index = {symbols[k]: i for i, k in enumerate(free.tolist())}
    groups = _connected([[index[name] for name in item.terms] for item in confounded_terms])

    pairs = problem.collinear_pairs()
    collinear_groups = _connected(
        [pair for pair, count in pairs.items() if count > COLLINEAR_CORRELATION]
    )
    for group in [*collinear_groups, *map(list, pairs)]:
        if any(set(group) <= set(terms) for terms in groups):
            continue
        root_without_priors = problem.root(without_priors=group)
        for weights in _determined_combinations(root_without_priors, problem.limits, group, group):
            item, ratio = describe(weights)
            # Where priors decide more than the pair's combination, it says nothing.
            if group in collinear_groups or ratio < 0.5:
                confounded_terms.append(item)
                groups.append(group)
    return Assessment(
        determined={name: bool(yes) for name, yes in zip(symbols, is_determined, strict=True)},
        u=np.sqrt(variance),
        confounded=tuple(confounded_terms),
    )


def _project_onto_first(solution: Solution, p: int) -> Array:
    """Return the information about the first unknowns, the others projected out with priors."""
    # What is known exactly has nothing to be projected out.
    uncertain = p + np.flatnonzero(solution.prior_sd[p:] > 0.0)
    count = uncertain.size
    if count == 0:
        return solution.information[:, :p]
    rows = np.column_stack([solution.information[:, uncertain], solution.information[:, :p]])
    priors = solution.whiten_priors(np.eye(solution.estimate.size))[uncertain]
    known_columns = np.column_stack([priors[:, uncertain], priors[:, :p]])
    return triangular_factor(np.vstack([rows, known_columns]))[count:, count:]


class _Information:
    """The data's square-root information and the priors' rows of the free unknowns."""

    def __init__(self, data: Array, priors: Array, limits: Array) -> None:
        self.data = triangular_factor(data)
        self.priors = priors
        self.limits = limits
        column_norms = np.sqrt(np.sum(self.data**2, axis=0) + np.sum(priors**2, axis=0))
        # Columns that the data do not see at all are bounded in units of their limits.
        self.floor = _FLOOR * np.maximum(column_norms, 1.0 / limits)

    def root(self, without_priors: Sequence[int] = ()) -> Array:
        """Return T with T @ T.T the covariance from data and priors, leaving some priors out."""
        priors = self.priors.copy()
        priors[list(without_priors)] = 0.0
        rows = np.vstack([self.data, priors, np.diag(self.floor)])
        inverse = np.linalg.solve(triangular_factor(rows), np.eye(self.floor.size))
        return np.asarray(inverse)

    def correlation(self, terms: npt.NDArray[np.intp]) -> float:
        """Largest pairwise correlation inside a set, before the set's own priors."""
        columns = self._project_onto_sets(terms[None])[0]
        cosine = columns.T @ columns
        norms = np.sqrt(np.diag(cosine))
        cosine = cosine / np.outer(norms, norms)
        worst_pair = max(combinations(range(terms.size), 2), key=lambda pair: abs(cosine[pair]))
        # Two columns that point the same way have estimates that work against each other.
        return float(np.clip(-cosine[worst_pair], -1.0, 1.0))

    def collinear_pairs(self) -> dict[tuple[int, int], float]:
        """Pairs that the data see one by one but hardly tell apart, before their own priors."""
        index = self._possibly_collinear_pairs()
        if not len(index):
            return {}
        columns = self._project_onto_sets(index)
        norms = np.linalg.norm(columns, axis=1)
        is_observed = (norms * self.limits[index] >= 1.0).all(axis=1)
        cosine = np.zeros(len(index))
        inner = np.abs(np.sum(columns[:, :, 0] * columns[:, :, 1], axis=1))
        np.divide(inner, norms[:, 0] * norms[:, 1], out=cosine, where=is_observed)
        return {
            (i, j): cosine_value
            for (i, j), cosine_value in zip(index.tolist(), cosine.tolist(), strict=True)
            if cosine_value > NEAR_COLLINEAR
        }

    def _possibly_collinear_pairs(self) -> npt.NDArray[np.intp]:
        """Return the pairs that may exceed `NEAR_COLLINEAR` within rounding, shape (pairs, 2).

        The inverse of a 2 x 2 block of the covariance is the information about its pair, with the
        pair's own priors (Schur complement). A single inverse thus serves all pairs. Subtracting
        the priors cancels digits, so it only selects pairs.
        """
        root = self.root()
        covariance = root @ root.T
        index = np.column_stack(np.triu_indices(self.limits.size, 1))
        i, j = index.T
        variances = np.diag(covariance)[index]
        uncorrelated_norms = np.maximum(
            1.0 - covariance[i, j] ** 2 / variances.prod(axis=1), np.finfo(np.float64).eps
        )[:, None]
        information = 1.0 / (variances * uncorrelated_norms)
        rounding = information * _ROUNDING / uncorrelated_norms
        own_priors = (np.sum(self.priors**2, axis=0) + self.floor**2)[index]
        upper_bound = information - own_priors + rounding
        lower_bound = np.maximum(information - own_priors - rounding, 0.0)
        inner = covariance[i, j] / (variances.prod(axis=1) * uncorrelated_norms[:, 0])
        is_observed = (upper_bound * self.limits[index] ** 2 >= 1.0).all(axis=1)
        collinear = inner**2 >= (_SCREEN * NEAR_COLLINEAR) ** 2 * lower_bound.prod(axis=1)
        candidates: npt.NDArray[np.intp] = index[is_observed & collinear]
        return candidates

    def _project_onto_sets(self, sets: npt.NDArray[np.intp]) -> Array:
        """Square-root information about sets of s terms, shape (sets, s, s).

        All other unknowns are projected out, with their priors; the sets' own priors are left out.
        """
        term_count, count = self.floor.size, sets.shape[1]
        rows = np.vstack([self.data, self.priors, np.diag(self.floor)])
        batch = np.repeat(rows[None], len(sets), axis=0)
        start = self.data.shape[0]
        for column in sets.T:
            batch[np.arange(len(sets)), start + column] = 0.0
            batch[np.arange(len(sets)), start + term_count + column, column] = 0.0
        is_last = np.zeros((len(sets), term_count), dtype=np.bool_)
        is_last[np.arange(len(sets))[:, None], sets] = True
        order = np.argsort(is_last, axis=1, kind="stable")
        order[:, term_count - count :] = sets
        ordered_batch = np.take_along_axis(batch, order[:, None, :], axis=2)
        return triangular_factor(ordered_batch)[
            :, term_count - count : term_count, term_count - count :
        ]


def _determined_combinations(
    root: Array,
    limits: Array,
    undetermined: Sequence[int],
    candidates: Sequence[int],
) -> list[Array]:
    """Find the combinations that are determined although their terms are not.

    Going from the last loose term to the first, a term is either set aside, or it is determined
    once those set aside are given; then what is left of it, after regression on them, is the
    combination sought, uncorrelated with those set aside and so the best known.
    """
    norms = np.linalg.norm(root, axis=1)
    pivots: list[int] = []
    basis = np.empty((0, root.shape[1]))

    def residual(i: int) -> Array:
        projection: Array = root[i] - basis.T @ (basis @ root[i])
        residual_vector: Array = projection - basis.T @ (basis @ projection)  # against rounding
        return residual_vector

    def explained(i: int) -> bool:
        norm = np.linalg.norm(residual(i))
        return bool(norm < limits[i] and norm**2 < (1.0 - NEAR_COLLINEAR**2) * norms[i] ** 2)

    for i in sorted(undetermined, reverse=True):
        if not explained(i):
            norm = residual(i)
            basis = np.vstack([basis, norm / np.linalg.norm(norm)])
            pivots.append(i)

    combinations = []
    for i in candidates:
        if i in pivots or not explained(i):
            continue
        pivot_terms = list(pivots)
        best_norm = float(np.linalg.norm(residual(i)))
        for k in pivots:  # a term that does not help is not named
            candidates_left = [pivot for pivot in pivot_terms if pivot != k]
            if (
                np.linalg.norm(_regress(root, i, candidates_left) @ root)
                <= (1.0 + _NEGLIGIBLE) * best_norm
            ):
                pivot_terms = candidates_left
        if pivot_terms:
            combinations.append(_regress(root, i, pivot_terms))
    return combinations


def _regress(root: Array, i: int, regressors: Sequence[int]) -> Array:
    """Weights of unknown ``i`` minus its regression on ``regressors``."""
    weights = np.zeros(root.shape[0])
    weights[i] = 1.0
    if regressors:
        scale = np.linalg.norm(root[list(regressors)], axis=1)
        scaled_root = root[list(regressors)] / scale[:, None]
        weights[list(regressors)] = -np.linalg.lstsq(scaled_root.T, root[i], rcond=None)[0] / scale
    return weights


def _connected(sets: Sequence[Sequence[int]]) -> list[list[int]]:
    """Join sets that share a member into groups."""
    groups: list[set[int]] = []
    for members in sets:
        union = set(members).union(*(group for group in groups if group & set(members)))
        groups = [group for group in groups if not group & union] + [union]
    return [sorted(group) for group in groups]


def write_combination(names: Sequence[str], weights: npt.ArrayLike, slack: npt.ArrayLike) -> str:
    """Write a combination such as ``K_F + 1.1241 K_I``.

    names, weights: Of the terms, shape (n,).
    slack: How far each weight may be rounded, shape (n,): whole numbers where all of them allow it,
        else the fewest digits.
    """
    exact = np.asarray(weights, dtype=np.float64)
    tolerance = np.broadcast_to(np.asarray(slack, dtype=np.float64), exact.shape)
    rounded_weights = np.round(exact)
    if (rounded_weights != 0).all() and (np.abs(exact - rounded_weights) <= tolerance).all():
        exact = rounded_weights
    text = ""
    for name, weight, error in zip(names, exact.tolist(), tolerance.tolist(), strict=True):
        size = _format_number(abs(weight), error)
        text += f" {'-' if weight < 0 else '+'} " + (name if size == "1" else f"{size} {name}")
    return text.removeprefix(" + ")


def _format_number(magnitude: float, error: float) -> str:
    """Return a number with the fewest digits, four at least, that err by no more than this."""
    for digits in range(4, 17):
        text = f"{magnitude:.{digits}g}"
        if abs(float(text) - magnitude) <= error:
            return text
    return repr(magnitude)
