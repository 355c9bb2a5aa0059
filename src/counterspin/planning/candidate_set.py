"""Candidate observations: their information, cost and optimal counts, which need not be integers.

An observation is a run with an attitude, sense, rate and length, or a reading at a station. With
weights n_x >= 0, the information is M = M_0 + sum of n_x M_x, the limits on cost and count are
linear, and the criteria are convex in M. So every local optimum is global, it is at least as good
as any real plan, and the general equivalence theorem identifies it: with the gain of an
observation phi(x) = -d(criterion)/d(n_x), there are shadow prices of the cost and of an observation
with

    phi(x) <= price_cost * cost(x) + price_one      for every x, equality where n_x > 0.

The remainder of the inequality bounds the possible improvement by any plan.

For the bound, considered terms are estimated with their priors: the best estimator is at least as
good as one that does not estimate them, so the bound holds, and the problem stays convex.

References
----------
Silvey, Titterington and Torsney, Commun. Stat. A 7 (1978) 1379, the multiplicative algorithm;
Kiefer and Wolfowitz, The equivalence of two extremum problems, Canad. J. Math. 12 (1960) 363;
Cook and Fedorov, Constrained optimization of experimental design, Statistics 26 (1995) 129.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array, triangular_factor
from counterspin.frozen import frozen
from counterspin.planning.design import Criterion, Design, Limits, RunType
from counterspin.planning.run_information import Predictor

#: Numbers of rates and lengths on the first grid, if any rate is available.
_N_GRID_RATES: Final = 9
_N_GRID_LENGTHS: Final = 12
#: Number of refinements of the grid around its support.
_N_REFINEMENTS: Final = 4


DesignT = TypeVar("DesignT")


@frozen(eq=False)
class Optimum(Generic[DesignT]):
    """Optimal choice among candidate observations, with its criterion value and bound."""

    #: Runs, or the count of each candidate, shape (n,); relaxed counts need not be integers.
    design: DesignT
    value: float  #: Criterion value (a logarithm, see `Criterion.value`).
    bound: float  #: Lower bound of the criterion for any choice within the limits.
    #: Decrease of the criterion per additional observation, for a relaxed choice.
    shadow_price: float = 0.0

    @property
    def efficiency(self) -> float:
        """Ratio of the lower bound of u to the u of the choice; at most 1."""
        return math.exp(min(0.0, self.bound - self.value))


def relax_design(
    predictor: Predictor, limits: Limits, criterion: Criterion
) -> tuple[Design, Optimum[Array]]:
    """Solve the relaxation on a grid; return its support, and the optimal count of each run."""
    grid, grid_steps = _make_initial_grid(limits)
    candidates = _build_candidates(predictor, limits, grid)
    resources = (float(limits.max_runs), limits.total_time)
    solution = candidates.relax(criterion, *resources)
    for refinement in range(1, _N_REFINEMENTS + 1):
        support = np.flatnonzero(solution.design > MIN_WEIGHT)
        finer_grid = _refine_grid(limits, grid, support, grid_steps * 0.5**refinement)
        if not finer_grid.types:
            break
        grid = grid.concatenate(finer_grid)
        candidates = candidates.concatenate(_build_candidates(predictor, limits, finer_grid))
        initial_weights = np.concatenate([solution.design, np.zeros(len(finer_grid.types))])
        solution = candidates.relax(criterion, *resources, initial_weights)
    support = np.flatnonzero(solution.design > MIN_WEIGHT)
    return grid.select(support.tolist()), replace(solution, design=solution.design[support])


def _build_candidates(predictor: Predictor, limits: Limits, runs: Design) -> CandidateSet:
    blocks = predictor.information.blocks(runs.types, runs.rate, runs.revolutions)
    design = triangular_factor(blocks[:, :, : predictor.p])
    considered, prior_considered = np.zeros((*design.shape[:2], 0)), np.zeros((predictor.p, 0))
    cost = runs.duration + limits.overhead(runs.rate)
    return CandidateSet(design, considered, predictor.prior, prior_considered, cost)


def _make_initial_grid(limits: Limits) -> tuple[Design, Array]:
    """Return a grid over the limits, and its steps in log rate and log revolutions."""
    low, high = limits.rate_range
    if limits.rate_settings:
        rates = np.array(limits.rate_settings)
    elif high < low * (1.0 + 1e-9):
        rates = np.array([high])
    else:
        rates = np.geomspace(low, high, _N_GRID_RATES)
    grid_rates, grid_revolutions = [], []
    max_revolutions = np.array([_max_revolutions(limits, float(rate)) for rate in rates])
    length_step = (
        max(1e-9, math.log(max(2.0, float(max_revolutions.max()) / limits.min_revolutions)))
        / _N_GRID_LENGTHS
    )
    for rate, maximum in zip(rates, max_revolutions, strict=True):
        if maximum >= limits.min_revolutions * (1.0 - 1e-12):
            log_span = math.log(max(maximum / limits.min_revolutions, 1.0))
            log_ratios = np.linspace(0.0, log_span, math.ceil(log_span / length_step) + 1)
            grid_rates.append(np.full(log_ratios.size, rate))
            grid_revolutions.append(limits.min_revolutions * np.exp(log_ratios))
    rate, revolutions = np.concatenate(grid_rates), np.concatenate(grid_revolutions)
    n_types = len(limits.types)
    types = tuple(run_type for run_type in limits.types for _ in rate)
    rate_step = math.log(rates[-1] / rates[0]) / max(1, len(rates) - 1)
    grid = Design(types, np.tile(rate, n_types), np.tile(revolutions, n_types))
    return grid, np.array([0.0 if limits.rate_settings else rate_step, length_step])


def _max_revolutions(limits: Limits, rate: float) -> float:
    available_time = limits.total_time - float(limits.overhead(np.array(rate)))
    return min(limits.max_duration, available_time) * rate / (2.0 * math.pi)


def _refine_grid(limits: Limits, grid: Design, support: Indices, steps: Array) -> Design:
    """Return the new neighbours of the support on a finer grid."""
    low, high = limits.rate_range
    neighbours: dict[tuple[RunType, float, float], None] = {}
    for index in support:
        for rate_step in (-1, 0, 1) if steps[0] > 0.0 else (0,):
            rate = float(np.clip(grid.rate[index] * math.exp(rate_step * steps[0]), low, high))
            rate = float(grid.rate[index]) if rate_step == 0 else rate
            max_revolutions = _max_revolutions(limits, rate)
            for length_step in (-1, 0, 1):
                revolutions = float(grid.revolutions[index]) * math.exp(length_step * steps[1])
                revolutions = min(max(revolutions, limits.min_revolutions), max_revolutions)
                if revolutions >= limits.min_revolutions:
                    neighbours[grid.types[index], rate, revolutions] = None
    grid_keys = set(zip(grid.types, grid.rate.tolist(), grid.revolutions.tolist(), strict=True))
    new_keys = [key for key in neighbours if key not in grid_keys]
    new_rates, new_revolutions = (np.array([key[i] for key in new_keys]) for i in (1, 2))
    return Design(tuple(run_type for run_type, _, _ in new_keys), new_rates, new_revolutions)


Indices = npt.NDArray[np.intp]

#: Ridge of the scaled information: unknowns that are not determined get a large, finite variance.
_RIDGE: Final = 1e-12
#: Scaled variance above which a low-rank update of the covariance would lose precision.
_MAX_VARIANCE_RATIO: Final = 1e6
#: Steps of the multiplicative algorithm before the first gradient step, and the smallest weight to
#: keep, relative to the largest.
_N_INITIAL_STEPS: Final = 20
_MIN_INITIAL_FRACTION: Final = 0.03
#: Fraction of uniform weights in the mixture at which gains are computed.
_UNIFORM_FRACTION: Final = 1e-4
#: Largest number of gradient steps.
_N_GRADIENT_STEPS: Final = 30
#: Tolerance for points above an edge of the hull, relative to the largest gain.
_RELATIVE_TOLERANCE: Final = 1e-12
#: Weight below which a candidate is unused.
MIN_WEIGHT: Final = 1e-5
#: Relative gap of u to the bound at which the relaxation has converged.
_OPTIMALITY_GAP: Final = 3e-4


@frozen(eq=False)
class CandidateSet:
    """Information and cost of n candidate observations."""

    #: Rows with unit variance: columns of the unknowns, shape (n, b, p), and of the considered
    #: terms, each times its standard uncertainty, shape (n, b, q).
    design: Array
    considered: Array
    #: Rows of priors and existing observations, shapes (r, p) and (r, q).
    prior_design: Array
    prior_considered: Array
    cost: Array  #: Time of each observation, s, shape (n,); zero if the time is unlimited.

    def concatenate(self, other: CandidateSet) -> CandidateSet:
        """Return the candidates of both sets."""
        fields = ("design", "considered", "cost")
        design, considered, cost = (
            np.concatenate([getattr(self, field), getattr(other, field)]) for field in fields
        )
        return CandidateSet(design, considered, self.prior_design, self.prior_considered, cost)

    def covariance(self, counts: npt.ArrayLike) -> Array:
        """Return the covariance of the unknowns, shape (..., p, p), for counts (..., n)."""
        _, noise_covariance, considered_moments = self._scaled_moments(
            np.asarray(counts, dtype=np.float64)
        )
        contributions = noise_covariance @ considered_moments
        return np.asarray(noise_covariance + contributions @ np.swapaxes(contributions, -1, -2))

    def value(self, criterion: Criterion, counts: npt.ArrayLike) -> Array:
        """Return the criterion value for counts (..., n), see `Criterion.value`."""
        return criterion.value(self.covariance(counts))

    def values_with_addition(self, criterion: Criterion, counts: npt.ArrayLike) -> Array:
        """Return the criterion for counts (n,) plus one of each candidate, shape (n,).

        Each adds rows D to the information, which changes P to P - P D' (1 + D P D')^-1 D P.
        """
        n = np.asarray(counts, dtype=np.float64)
        scale, noise_covariance, considered_moments = self._scaled_moments(n)
        if np.max(np.diag(noise_covariance) / scale**2) > _MAX_VARIANCE_RATIO:
            return self.value(criterion, n + np.eye(n.size))
        indices, transpose = list(criterion.indices), np.swapaxes(self.design, 1, 2)
        projection = self.design @ noise_covariance
        gain = np.linalg.solve(np.eye(projection.shape[1]) + projection @ transpose, projection)
        new_rows = noise_covariance[indices] - np.swapaxes(projection[..., indices], 1, 2) @ gain
        contributions = new_rows @ considered_moments + new_rows @ transpose @ self.considered
        covariance = new_rows[..., indices] + contributions @ np.swapaxes(contributions, 1, 2)
        return replace(criterion, indices=tuple(range(len(indices)))).value(covariance)

    def _scaled_moments(self, counts: Array) -> tuple[Array, Array, Array]:
        """Return the scales of the unknowns, their noise covariance, and the considered moments.

        Shapes (..., p), (..., p, p) and (..., p, q).
        """
        columns = np.concatenate([self.design, self.considered], axis=2)
        p = self.design.shape[2]
        if counts.ndim == 1:  # avoids the products of each candidate
            rows = (np.sqrt(counts)[:, None, None] * columns).reshape(-1, columns.shape[2])
            moments = rows[:, :p].T @ rows
        else:
            moments = np.tensordot(counts, np.swapaxes(self.design, 1, 2) @ columns, axes=1)
        moments += self.prior_design.T @ np.hstack([self.prior_design, self.prior_considered])
        diagonal = np.arange(p)
        # Without scaling, columns of very different magnitude would lose precision.
        scale = 1.0 / np.sqrt(moments[..., diagonal, diagonal])
        outer_scale = scale[..., :, None] * scale[..., None, :]
        noise_covariance = (
            np.linalg.inv(moments[..., :p] * outer_scale + _RIDGE * np.eye(p)) * outer_scale
        )
        return scale, noise_covariance, moments[..., p:]

    def relax(
        self, criterion: Criterion, max_count: float, max_cost: float, start: Array | None = None
    ) -> Optimum[Array]:
        """Return the optimal counts, which need not be integers.

        max_count, max_cost: Maximum sum of the counts and of their costs, s; one must be finite.
        start: Initial weights, shape (n,).
        """
        cost = self.cost
        if not math.isfinite(max_cost):
            cost, max_cost = np.ones(len(cost)), max_count
        if not math.isfinite(max_count):
            max_count = max_cost / float(cost.min())
        prior_rows = np.hstack([self.prior_design, self.prior_considered])
        identity = np.eye(prior_rows.shape[1])[self.prior_design.shape[1] :]
        relaxation = _Relaxation(
            triangular_factor(np.vstack([prior_rows, identity])),
            criterion,
            np.concatenate([self.design, self.considered], axis=2),
            cost,
            max_cost,
            max_count,
        )
        return relaxation.solve(relaxation.initial_weights() if start is None else start)


class _Relaxation:
    """The criterion as a function of the weights, and the linear limits on them."""

    def __init__(
        self,
        prior: Array,
        criterion: Criterion,
        sqrt_information: Array,
        cost: Array,
        max_cost: float,
        max_count: float,
    ) -> None:
        self.prior = prior
        self.criterion = criterion
        self.sqrt_information, self.cost = sqrt_information, cost
        self.max_cost, self.max_count = max_cost, max_count

    def solve(self, weights: Array) -> Optimum[Array]:
        """Return the optimal weights, starting from `weights`."""
        value = self.value(weights)
        bound, shadow_price = -math.inf, 0.0
        for _ in range(_N_GRADIENT_STEPS):
            # Away from zero weights, all gains are finite. The bound holds for any weights.
            interior_weights = weights + _UNIFORM_FRACTION * (self.uniform_weights() - weights)
            interior_value, gains = self.value_and_gains(interior_weights)
            lp_weights, shadow_price = self.linear_optimum(gains)
            bound = max(
                bound, interior_value + float(gains @ interior_weights) - float(gains @ lp_weights)
            )
            if value - bound < _OPTIMALITY_GAP:
                break
            support = np.flatnonzero((weights > MIN_WEIGHT) | (lp_weights > MIN_WEIGHT))
            new_weights = self.optimise_support(support, weights, lp_weights)
            new_value = self.value(new_weights)
            if new_value > value - 0.01 * _OPTIMALITY_GAP:
                break  # any further decrease is rounding
            weights, value = new_weights, new_value
        return Optimum(weights, value, bound, shadow_price)

    def value(self, weights: Array) -> float:
        """Return the criterion value."""
        support = np.flatnonzero(weights > 0.0)
        return self._value_and_covariance(support, weights[support])[0]

    def value_and_gains(self, weights: Array) -> tuple[float, Array]:
        """Return the criterion value and its decrease per added observation, shape (n,)."""
        support = np.flatnonzero(weights > 0.0)
        value, covariance = self._value_and_covariance(support, weights[support])
        directions = covariance @ self.criterion.directions(covariance)
        return value, np.asarray(np.sum((self.sqrt_information @ directions) ** 2, axis=(1, 2)))

    def _value_and_covariance(self, support: Indices, weights: Array) -> tuple[float, Array]:
        rows = self.sqrt_information[support] * np.sqrt(weights)[:, None, None]
        matrix = np.vstack([rows.reshape(-1, self.prior.shape[1]), self.prior])
        inverse = np.linalg.inv(np.linalg.qr(matrix, mode="r"))
        covariance = inverse @ inverse.T
        return float(self.criterion.value(covariance)), covariance

    def initial_weights(self) -> Array:
        """Return initial weights from the multiplicative algorithm, starting at uniform weights.

        All candidates together determine every unknown that can be determined, so that the gains
        are finite.
        """
        resource_use, weights = self._resource_use(), self.uniform_weights()
        for _ in range(_N_INITIAL_STEPS):
            _, gains = self.value_and_gains(weights)
            weights = self._scale_to_limits(weights * np.sqrt(gains / resource_use))
        return self._scale_to_limits(
            np.where(weights > _MIN_INITIAL_FRACTION * weights.max(), weights, 0.0)
        )

    def uniform_weights(self) -> Array:
        """Return weights with which every candidate uses the same share of the limits."""
        return self._scale_to_limits(1.0 / self._resource_use())

    def _resource_use(self) -> Array:
        return self.cost / self.max_cost + 1.0 / self.max_count

    def _scale_to_limits(self, weights: Array) -> Array:
        """Return the weights, scaled to reach a limit."""
        used_fraction = max(
            float(self.cost @ weights) / self.max_cost, float(weights.sum()) / self.max_count
        )
        return weights / used_fraction

    def linear_optimum(self, gains: Array) -> tuple[Array, float]:
        """Return the weights with the largest total gain, and the shadow price of an observation.

        Solve a linear program with two limits. Its solution is on the upper convex hull of the
        gains over the costs, with the point (0, 0) added, so that at most two weights are not
        zero. The shadow price is the intercept of the edge of the hull at the mean cost.
        """
        hull_costs, hull_gains = np.append(self.cost, 0.0), np.append(gains, 0.0)
        mean_cost = self.max_cost / self.max_count
        lower_index, upper_index = gains.size, int(np.argmax(hull_gains))
        weights = np.zeros_like(hull_gains)
        if hull_costs[upper_index] <= mean_cost:  # only the count is limited
            weights[upper_index] = self.max_count
            return weights[:-1], float(hull_gains[upper_index])
        while True:
            slope = (hull_gains[upper_index] - hull_gains[lower_index]) / (
                hull_costs[upper_index] - hull_costs[lower_index]
            )
            intercepts = hull_gains - slope * hull_costs
            shadow_price = float(intercepts[lower_index])
            vertex_index = int(np.argmax(intercepts))
            if intercepts[vertex_index] <= shadow_price + _RELATIVE_TOLERANCE * hull_gains[
                upper_index
            ] or vertex_index in (lower_index, upper_index):
                break
            lower_index, upper_index = (
                (vertex_index, upper_index)
                if hull_costs[vertex_index] <= mean_cost
                else (lower_index, vertex_index)
            )
        weights[upper_index] = (
            self.max_count
            * (mean_cost - hull_costs[lower_index])
            / (hull_costs[upper_index] - hull_costs[lower_index])
        )
        weights[lower_index] = self.max_count - weights[upper_index]
        return weights[:-1], shadow_price

    def optimise_support(self, support: Indices, weights: Array, lp_weights: Array) -> Array:
        """Return the optimal weights on a support."""
        from scipy.optimize import minimize

        n_support = support.size
        start = weights[support] + 0.1 * (lp_weights[support] - weights[support])
        cost = self.cost[support]

        def objective(counts: Array) -> tuple[float, Array]:
            value, covariance = self._value_and_covariance(support, np.maximum(counts, 0.0))
            directions = covariance @ self.criterion.directions(covariance)
            return value, -np.sum((self.sqrt_information[support] @ directions) ** 2, axis=(1, 2))

        solution = minimize(
            objective,
            start,
            jac=True,
            method="SLSQP",
            bounds=[(0.0, None)] * n_support,
            constraints={
                "type": "ineq",
                "fun": lambda counts: np.array(
                    [1.0 - (cost @ counts) / self.max_cost, 1.0 - counts.sum() / self.max_count]
                ),
                "jac": lambda _: (
                    -np.vstack([cost / self.max_cost, np.full(n_support, 1.0 / self.max_count)])
                ),
            },
            options={"maxiter": 50, "ftol": 1e-8},
        )
        result = np.zeros_like(weights)
        result[support] = np.maximum(solution.x, 0.0)
        # Exceeding the limits by rounding must not count as a gain.
        used_fraction = max(
            float(self.cost @ result) / self.max_cost, float(result.sum()) / self.max_count, 1.0
        )
        return result / used_fraction
