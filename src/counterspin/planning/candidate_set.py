"""Possible observations: their information, cost and best numbers, which need not be whole.

An observation is a run of an attitude, sense, rate and length, or a reading at a station. With
weights n_x >= 0 the information is M = M_0 + sum of n_x M_x, the limits on the cost and on the
number are linear, and the criteria are convex in M. So every local optimum is the global one, it is
no worse than any real plan, and the general equivalence theorem identifies it: with the gain of an
observation phi(x) = -d(criterion)/d(n_x) there are prices of the cost and of an observation with

    phi(x) <= price_cost * cost(x) + price_one      for every x, equality where n_x > 0.

The remainder of the inequality bounds the possible improvement by any plan.

Considered terms are taken as estimated there, with their priors: the best estimator is no worse
than one that leaves them out, so the bound holds, and the problem stays convex.

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

#: Rates and lengths on the first grid, where any rate may be set.
_GRID_RATES: Final = 9
_GRID_LENGTHS: Final = 12
#: How many times the grid is made finer about the runs that are in use.
_REFINEMENTS: Final = 4


Chosen = TypeVar("Chosen")


@frozen(eq=False)
class Optimum(Generic[Chosen]):
    """The best choice among possible observations, and its criterion value and bound."""

    #: Runs, longest last within each type; or how often each observation is made, shape (n,), in
    #: whole numbers or, relaxed, in numbers that need not be whole.
    design: Chosen
    value: float  #: Its criterion (a logarithm, see `Criterion.value`).
    bound: float  #: What no choice within the limits can be below.
    shadow_price: float = (
        0.0  #: What the criterion gains for each further observation, where relaxed.
    )

    @property
    def efficiency(self) -> float:
        """Smallest u that may be possible over the u of the choice; at most 1."""
        return math.exp(min(0.0, self.bound - self.value))


def relax(
    predictor: Predictor, limits: Limits, criterion: Criterion
) -> tuple[Design, Optimum[Array]]:
    """Solve the relaxation on a grid: the runs that it uses, and the number of each."""
    grid, steps = _initial_grid(limits)
    candidates = _candidate_runs(predictor, limits, grid)
    resources = (float(limits.runs), limits.total_time)
    solution = candidates.relax(criterion, *resources)
    for level in range(1, _REFINEMENTS + 1):
        used = np.flatnonzero(solution.design > ZERO_WEIGHT)
        finer_grid = _refine_grid(limits, grid, used, steps * 0.5**level)
        if not finer_grid.types:
            break
        grid = grid.concatenate(finer_grid)
        candidates = candidates.concatenate(_candidate_runs(predictor, limits, finer_grid))
        start = np.concatenate([solution.design, np.zeros(len(finer_grid.types))])
        solution = candidates.relax(criterion, *resources, start)
    selected = np.flatnonzero(solution.design > ZERO_WEIGHT)
    return grid.select(selected.tolist()), replace(solution, design=solution.design[selected])


def _candidate_runs(predictor: Predictor, limits: Limits, runs: Design) -> CandidateSet:
    blocks = predictor.information.blocks(runs.types, runs.rate, runs.revolutions)
    design = triangular_factor(blocks[:, :, : predictor.p])
    nothing = np.zeros((*design.shape[:2], 0)), np.zeros((predictor.p, 0))
    cost = runs.duration + limits.overhead(runs.rate)
    return CandidateSet(design, nothing[0], predictor.prior, nothing[1], cost)


def _initial_grid(limits: Limits) -> tuple[Design, Array]:
    """Return a grid over all that is allowed, and its steps in log rate and log revolutions."""
    low, high = limits.rate
    if limits.settings:
        rates = np.array(limits.settings)
    elif high < low * (1.0 + 1e-9):
        rates = np.array([high])
    else:
        rates = np.geomspace(low, high, _GRID_RATES)
    rate, revolutions = [], []
    max_revolutions = np.array([_max_revolutions(limits, float(w)) for w in rates])
    step = (
        max(1e-9, math.log(max(2.0, float(max_revolutions.max()) / limits.revolutions)))
        / _GRID_LENGTHS
    )
    for w, longest in zip(rates, max_revolutions, strict=True):
        if longest >= limits.revolutions * (1.0 - 1e-12):
            span = math.log(max(longest / limits.revolutions, 1.0))
            turns = limits.revolutions * np.exp(np.linspace(0.0, span, math.ceil(span / step) + 1))
            rate.append(np.full(turns.size, w))
            revolutions.append(turns)
    w, turns = np.concatenate(rate), np.concatenate(revolutions)
    several = len(limits.types)
    types = tuple(run_type for run_type in limits.types for _ in w)
    ratio = math.log(rates[-1] / rates[0]) / max(1, len(rates) - 1)
    grid = Design(types, np.tile(w, several), np.tile(turns, several))
    return grid, np.array([0.0 if limits.settings else ratio, step])


def _max_revolutions(limits: Limits, rate: float) -> float:
    available = limits.total_time - float(limits.overhead(np.array(rate)))
    return min(limits.longest_run, available) * rate / (2.0 * math.pi)


def _refine_grid(limits: Limits, grid: Design, support: Places, steps: Array) -> Design:
    """Return possible runs a step to each side of those in use."""
    low, high = limits.rate
    neighbours: dict[tuple[RunType, float, float], None] = {}
    for index in support:
        for rate_step in (-1, 0, 1) if steps[0] > 0.0 else (0,):
            w = float(np.clip(grid.rate[index] * math.exp(rate_step * steps[0]), low, high))
            w = float(grid.rate[index]) if rate_step == 0 else w
            max_revolutions = _max_revolutions(limits, w)
            for turn_step in (-1, 0, 1):
                turns = float(grid.revolutions[index]) * math.exp(turn_step * steps[1])
                turns = min(max(turns, limits.revolutions), max_revolutions)
                if turns >= limits.revolutions:
                    neighbours[grid.types[index], w, turns] = None
    grid_keys = set(zip(grid.types, grid.rate.tolist(), grid.revolutions.tolist(), strict=True))
    new_keys = [key for key in neighbours if key not in grid_keys]
    rate, new_turns = (np.array([key[i] for key in new_keys]) for i in (1, 2))
    return Design(tuple(run_type for run_type, _, _ in new_keys), rate, new_turns)


Places = npt.NDArray[np.intp]

#: Added to the scaled information, so that observations that do not determine all unknowns have a
#: large uncertainty and no infinite one.
_RIDGE: Final = 1e-12
#: Scaled variance of an unknown above which an update of the covariance would cost digits.
_ILL_CONDITIONED: Final = 1e6
#: Steps of the multiplicative algorithm before the first gradient step, and the least part of the
#: largest weight that is kept of them.
_INITIAL_STEPS: Final = 20
_MIN_INITIAL_FRACTION: Final = 0.03
#: Part of everything that is mixed into weights where their gains are taken.
_UNIFORM_FRACTION: Final = 1e-4
#: Largest number of gradient steps.
_GRADIENT_STEPS: Final = 30
#: Part of the largest gain by which another has to be above an edge of the hull to be off it.
_ROUNDING: Final = 1e-12
#: Smaller weights count as zero.
ZERO_WEIGHT: Final = 1e-5
#: Relative gap of u to the bound at which the relaxation is solved.
_OPTIMALITY_GAP: Final = 3e-4


@frozen(eq=False)
class CandidateSet:
    """The information and the cost of each of n possible observations."""

    #: Rows of unit variance: columns of the unknowns and of considered terms, each of the latter
    #: times its standard uncertainty, shapes (n, b, p) and (n, b, q).
    design: Array
    considered: Array
    #: Rows of prior knowledge and existing observations, shapes (r, p) and (r, q).
    known: Array
    known_considered: Array
    cost: Array  #: Of each observation, s, shape (n,); zero where time does not count.

    def concatenate(self, addition: CandidateSet) -> CandidateSet:
        """Return the observations of both."""
        fields = ("design", "considered", "cost")
        design, considered, cost = (
            np.concatenate([getattr(self, field), getattr(addition, field)]) for field in fields
        )
        return CandidateSet(design, considered, self.known, self.known_considered, cost)

    def covariance(self, counts: npt.ArrayLike) -> Array:
        """Return the covariance of the unknowns, shape (..., p, p), for numbers (..., n)."""
        _, inner, cross = self._scaled_moments(np.asarray(counts, dtype=np.float64))
        spread = inner @ cross
        return np.asarray(inner + spread @ np.swapaxes(spread, -1, -2))

    def value(self, criterion: Criterion, counts: npt.ArrayLike) -> Array:
        """Return a criterion, see `Criterion.value`."""
        return criterion.value(self.covariance(counts))

    def values_with_addition(self, criterion: Criterion, counts: npt.ArrayLike) -> Array:
        """Return a criterion for numbers (n,) with one more of each observation, shape (n,).

        Each adds rows D to the information, so that P becomes P - P D' (1 + D P D')^-1 D P.
        """
        n = np.asarray(counts, dtype=np.float64)
        scale, inner, cross = self._scaled_moments(n)
        if np.max(np.diag(inner) / scale**2) > _ILL_CONDITIONED:
            return self.value(criterion, n + np.eye(n.size))
        indices, transpose = list(criterion.indices), np.swapaxes(self.design, 1, 2)
        projection = self.design @ inner
        gain = np.linalg.solve(np.eye(projection.shape[1]) + projection @ transpose, projection)
        rows = inner[indices] - np.swapaxes(projection[..., indices], 1, 2) @ gain
        spread = rows @ cross + rows @ transpose @ self.considered
        block = rows[..., indices] + spread @ np.swapaxes(spread, 1, 2)
        return replace(criterion, indices=tuple(range(len(indices)))).value(block)

    def _scaled_moments(self, n: Array) -> tuple[Array, Array, Array]:
        """Return the scales of the unknowns, their noise covariance, and the considered moments.

        Shapes (..., p), (..., p, p) and (..., p, q).
        """
        columns = np.concatenate([self.design, self.considered], axis=2)
        p = self.design.shape[2]
        if n.ndim == 1:  # of the rows themselves, without their products one by one
            rows = (np.sqrt(n)[:, None, None] * columns).reshape(-1, columns.shape[2])
            moments = rows[:, :p].T @ rows
        else:
            moments = np.tensordot(n, np.swapaxes(self.design, 1, 2) @ columns, axes=1)
        moments = moments + self.known.T @ np.hstack([self.known, self.known_considered])
        diagonal = np.arange(p)
        # Scaled, or columns of very different size would cost digits.
        scale = 1.0 / np.sqrt(moments[..., diagonal, diagonal])
        outer = scale[..., :, None] * scale[..., None, :]
        inner = np.linalg.inv(moments[..., :p] * outer + _RIDGE * np.eye(p)) * outer
        return scale, inner, moments[..., p:]

    def relax(
        self, criterion: Criterion, max_count: float, max_cost: float, start: Array | None = None
    ) -> Optimum[Array]:
        """Return the best numbers that need not be whole.

        max_count, max_cost: Largest sum of the numbers and of their costs, s; one of them finite.
        start: Weights to begin from, shape (n,).
        """
        cost = self.cost
        if not math.isfinite(max_cost):
            cost, max_cost = np.ones(len(cost)), max_count
        if not math.isfinite(max_count):
            max_count = max_cost / float(cost.min())
        prior_rows = np.hstack([self.known, self.known_considered])
        identity = np.eye(prior_rows.shape[1])[self.known.shape[1] :]
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
        root: Array,
        cost: Array,
        total: float,
        number: float,
    ) -> None:
        self.prior = prior
        self.criterion = criterion
        self.sqrt_information, self.cost = root, cost
        self.total, self.number = total, number

    def solve(self, weight: Array) -> Optimum[Array]:
        """Return the best weights, from some."""
        value = self.value(weight)
        bound, price = -math.inf, 0.0
        for _ in range(_GRADIENT_STEPS):
            # With a little of everything no gain is infinite at nothing: the bound holds anywhere.
            interior = weight + _UNIFORM_FRACTION * (self.uniform_weights() - weight)
            current, gains = self.gain(interior)
            optimum, price = self.linear_optimum(gains)
            bound = max(bound, current + float(gains @ interior) - float(gains @ optimum))
            if value - bound < _OPTIMALITY_GAP:
                break
            support = np.flatnonzero((weight > ZERO_WEIGHT) | (optimum > ZERO_WEIGHT))
            new_weight = self.optimise_support(support, weight, optimum)
            new_value = self.value(new_weight)
            if new_value > value - 0.01 * _OPTIMALITY_GAP:
                break  # rounding is all that is left to gain
            weight, value = new_weight, new_value
        return Optimum(weight, value, bound, price)

    def value(self, weight: Array) -> float:
        """Return the criterion."""
        support = np.flatnonzero(weight > 0.0)
        return self._solve(support, weight[support])[0]

    def gain(self, weight: Array) -> tuple[float, Array]:
        """Return the criterion and its decrease per added observation, shape (n,)."""
        support = np.flatnonzero(weight > 0.0)
        value, covariance = self._solve(support, weight[support])
        v = covariance @ self.criterion.directions(covariance)
        return value, np.asarray(np.sum((self.sqrt_information @ v) ** 2, axis=(1, 2)))

    def _solve(self, support: Places, weight: Array) -> tuple[float, Array]:
        rows = self.sqrt_information[support] * np.sqrt(weight)[:, None, None]
        matrix = np.vstack([rows.reshape(-1, self.prior.shape[1]), self.prior])
        inverse = np.linalg.inv(np.linalg.qr(matrix, mode="r"))
        covariance = inverse @ inverse.T
        return float(self.criterion.value(covariance)), covariance

    def initial_weights(self) -> Array:
        """Return starting weights: equal, then in proportion to the gain of each for its cost.

        From all of them everything is determined that can be, and the gains are finite: where a
        few leave something open, its price hides all else.
        """
        resource_use, weight = self._resource_use(), self.uniform_weights()
        for _ in range(_INITIAL_STEPS):
            _, phi = self.gain(weight)
            weight = self._scale_to_limits(weight * np.sqrt(phi / resource_use))
        return self._scale_to_limits(
            np.where(weight > _MIN_INITIAL_FRACTION * weight.max(), weight, 0.0)
        )

    def uniform_weights(self) -> Array:
        """Return weights by which everything takes as much of the limits."""
        return self._scale_to_limits(1.0 / self._resource_use())

    def _resource_use(self) -> Array:
        return self.cost / self.total + 1.0 / self.number

    def _scale_to_limits(self, weight: Array) -> Array:
        """Return weights of the same ratios that touch a limit."""
        excess = max(float(self.cost @ weight) / self.total, float(weight.sum()) / self.number)
        return weight / excess

    def linear_optimum(self, phi: Array) -> tuple[Array, float]:
        """Return the weights that gain most by the gradient, and the price of an observation.

        A linear program of two limits. Of observations that take what there is for each of them on
        average, the best gain is on the upper hull of all gains over their costs, none at no cost
        among them: at most two share the limits. The price is where that edge meets no cost.
        """
        cost, gain = np.append(self.cost, 0.0), np.append(phi, 0.0)
        share = self.total / self.number
        lower, upper = phi.size, int(np.argmax(gain))
        weight = np.zeros_like(gain)
        if cost[upper] <= share:  # time is left
            weight[upper] = self.number
            return weight[:-1], float(gain[upper])
        while True:
            slope = (gain[upper] - gain[lower]) / (cost[upper] - cost[lower])
            intercept = gain - slope * cost
            price = float(intercept[lower])
            vertex = int(np.argmax(intercept))
            if intercept[vertex] <= price + _ROUNDING * gain[upper] or vertex in (lower, upper):
                break
            lower, upper = (vertex, upper) if cost[vertex] <= share else (lower, vertex)
        weight[upper] = self.number * (share - cost[lower]) / (cost[upper] - cost[lower])
        weight[lower] = self.number - weight[upper]
        return weight[:-1], price

    def optimise_support(self, support: Places, weight: Array, optimum: Array) -> Array:
        """Return the best weights on a support."""
        from scipy.optimize import minimize

        count = support.size
        start = weight[support] + 0.1 * (optimum[support] - weight[support])
        cost = self.cost[support]

        def objective(n: Array) -> tuple[float, Array]:
            value, covariance = self._solve(support, np.maximum(n, 0.0))
            v = covariance @ self.criterion.directions(covariance)
            return value, -np.sum((self.sqrt_information[support] @ v) ** 2, axis=(1, 2))

        minimum = minimize(
            objective,
            start,
            jac=True,
            method="SLSQP",
            bounds=[(0.0, None)] * count,
            constraints={
                "type": "ineq",
                "fun": lambda n: np.array(
                    [1.0 - (cost @ n) / self.total, 1.0 - n.sum() / self.number]
                ),
                "jac": lambda _: -np.vstack([cost / self.total, np.full(count, 1.0 / self.number)]),
            },
            options={"maxiter": 50, "ftol": 1e-8},
        )
        result = np.zeros_like(weight)
        result[support] = np.maximum(minimum.x, 0.0)
        # A step over the limits by rounding must not count as a gain.
        excess = max(float(self.cost @ result) / self.total, float(result.sum()) / self.number, 1.0)
        return result / excess
