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

from counterspin.arrays import Array, triangle_of
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
    choice: Chosen
    value: float  #: Its criterion (a logarithm, see `Criterion.value`).
    bound: float  #: What no choice within the limits can be below.
    price: float = 0.0  #: What the criterion gains for each further observation, where relaxed.

    @property
    def efficiency(self) -> float:
        """Smallest u that may be possible over the u of the choice; at most 1."""
        return math.exp(min(0.0, self.bound - self.value))


def relax(
    predictor: Predictor, limits: Limits, criterion: Criterion
) -> tuple[Design, Optimum[Array]]:
    """Solve the relaxation on a grid: the runs that it uses, and the number of each."""
    grid, steps = _first_grid(limits)
    possible = _possible(predictor, limits, grid)
    resources = (float(limits.runs), limits.total_time)
    solved = possible.relaxed(criterion, *resources)
    for level in range(1, _REFINEMENTS + 1):
        used = np.flatnonzero(solved.choice > ZERO_WEIGHT)
        finer = _refine_grid(limits, grid, used, steps * 0.5**level)
        if not finer.types:
            break
        grid = grid.joined(finer)
        possible = possible.joined(_possible(predictor, limits, finer))
        start = np.concatenate([solved.choice, np.zeros(len(finer.types))])
        solved = possible.relaxed(criterion, *resources, start)
    kept = np.flatnonzero(solved.choice > ZERO_WEIGHT)
    return grid.taken(kept.tolist()), replace(solved, choice=solved.choice[kept])


def _possible(predictor: Predictor, limits: Limits, runs: Design) -> Possibilities:
    blocks = predictor.information.blocks(runs.types, runs.rate, runs.revolutions)
    design = triangle_of(blocks[:, :, : predictor.p])
    nothing = np.zeros((*design.shape[:2], 0)), np.zeros((predictor.p, 0))
    cost = runs.duration + limits.overhead(runs.rate)
    return Possibilities(design, nothing[0], predictor.prior, nothing[1], cost)


def _first_grid(limits: Limits) -> tuple[Design, Array]:
    """Return a grid over all that is allowed, and its steps in log rate and log revolutions."""
    low, high = limits.rate
    if limits.settings:
        rates = np.array(limits.settings)
    elif high < low * (1.0 + 1e-9):
        rates = np.array([high])
    else:
        rates = np.geomspace(low, high, _GRID_RATES)
    rate, revolutions = [], []
    most = np.array([_most_revolutions(limits, float(w)) for w in rates])
    step = max(1e-9, math.log(max(2.0, float(most.max()) / limits.revolutions))) / _GRID_LENGTHS
    for w, longest in zip(rates, most, strict=True):
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


def _most_revolutions(limits: Limits, rate: float) -> float:
    available = limits.total_time - float(limits.overhead(np.array(rate)))
    return min(limits.longest_run, available) * rate / (2.0 * math.pi)


def _refine_grid(limits: Limits, grid: Design, used: Places, steps: Array) -> Design:
    """Return possible runs a step to each side of those in use."""
    low, high = limits.rate
    nearby: dict[tuple[RunType, float, float], None] = {}
    for index in used:
        for by_rate in (-1, 0, 1) if steps[0] > 0.0 else (0,):
            w = float(np.clip(grid.rate[index] * math.exp(by_rate * steps[0]), low, high))
            w = float(grid.rate[index]) if by_rate == 0 else w
            most = _most_revolutions(limits, w)
            for by_turns in (-1, 0, 1):
                turns = float(grid.revolutions[index]) * math.exp(by_turns * steps[1])
                turns = min(max(turns, limits.revolutions), most)
                if turns >= limits.revolutions:
                    nearby[grid.types[index], w, turns] = None
    known = set(zip(grid.types, grid.rate.tolist(), grid.revolutions.tolist(), strict=True))
    fresh = [key for key in nearby if key not in known]
    rate, turns_of = (np.array([key[i] for key in fresh]) for i in (1, 2))
    return Design(tuple(run_type for run_type, _, _ in fresh), rate, turns_of)


Places = npt.NDArray[np.intp]

#: Added to the scaled information, so that observations that do not determine all unknowns have a
#: large uncertainty and no infinite one.
_RIDGE: Final = 1e-12
#: Scaled variance of an unknown above which an update of the covariance would cost digits.
_ILL_CONDITIONED: Final = 1e6
#: Steps of the multiplicative algorithm before the first gradient step, and the least part of the
#: largest weight that is kept of them.
_FIRST_STEPS: Final = 20
_FIRST_PART: Final = 0.03
#: Part of everything that is mixed into weights where their gains are taken.
_MIXED_IN: Final = 1e-4
#: Largest number of gradient steps.
_GRADIENT_STEPS: Final = 30
#: Part of the largest gain by which another has to be above an edge of the hull to be off it.
_ROUNDING: Final = 1e-12
#: Smaller weights count as zero.
ZERO_WEIGHT: Final = 1e-5
#: Relative gap of u to the bound at which the relaxation is solved.
_GAP_OF_U: Final = 3e-4


@frozen(eq=False)
class Possibilities:
    """The information and the cost of each of n possible observations."""

    #: Rows of unit variance: columns of the unknowns and of considered terms, each of the latter
    #: times its standard uncertainty, shapes (n, b, p) and (n, b, q).
    design: Array
    fixed: Array
    #: Rows of prior knowledge and existing observations, shapes (r, p) and (r, q).
    known: Array
    known_fixed: Array
    cost: Array  #: Of each observation, s, shape (n,); zero where time does not count.

    def joined(self, other: Possibilities) -> Possibilities:
        """Return the observations of both."""
        parts = ("design", "fixed", "cost")
        design, fixed, cost = (
            np.concatenate([getattr(self, part), getattr(other, part)]) for part in parts
        )
        return Possibilities(design, fixed, self.known, self.known_fixed, cost)

    def covariance(self, counts: npt.ArrayLike) -> Array:
        """Return the covariance of the unknowns, shape (..., p, p), for numbers (..., n)."""
        _, inner, moved = self._parts(np.asarray(counts, dtype=np.float64))
        spread = inner @ moved
        return np.asarray(inner + spread @ np.swapaxes(spread, -1, -2))

    def value(self, criterion: Criterion, counts: npt.ArrayLike) -> Array:
        """Return a criterion, see `Criterion.value`."""
        return criterion.value(self.covariance(counts))

    def with_one_more(self, criterion: Criterion, counts: npt.ArrayLike) -> Array:
        """Return a criterion for numbers (n,) with one more of each observation, shape (n,).

        Each adds rows D to the information, so that P becomes P - P D' (1 + D P D')^-1 D P.
        """
        n = np.asarray(counts, dtype=np.float64)
        scale, inner, moved = self._parts(n)
        if np.max(np.diag(inner) / scale**2) > _ILL_CONDITIONED:
            return self.value(criterion, n + np.eye(n.size))
        places, turned = list(criterion.places), np.swapaxes(self.design, 1, 2)
        seen = self.design @ inner
        gain = np.linalg.solve(np.eye(seen.shape[1]) + seen @ turned, seen)
        rows = inner[places] - np.swapaxes(seen[..., places], 1, 2) @ gain
        spread = rows @ moved + rows @ turned @ self.fixed
        inside = rows[..., places] + spread @ np.swapaxes(spread, 1, 2)
        return replace(criterion, places=tuple(range(len(places)))).value(inside)

    def _parts(self, n: Array) -> tuple[Array, Array, Array]:
        """Return the scales of the unknowns, their noise covariance, and the considered moments.

        Shapes (..., p), (..., p, p) and (..., p, q).
        """
        both = np.concatenate([self.design, self.fixed], axis=2)
        p = self.design.shape[2]
        if n.ndim == 1:  # of the rows themselves, without their products one by one
            rows = (np.sqrt(n)[:, None, None] * both).reshape(-1, both.shape[2])
            moments = rows[:, :p].T @ rows
        else:
            moments = np.tensordot(n, np.swapaxes(self.design, 1, 2) @ both, axes=1)
        moments = moments + self.known.T @ np.hstack([self.known, self.known_fixed])
        diagonal = np.arange(p)
        # Scaled, or columns of very different size would cost digits.
        scale = 1.0 / np.sqrt(moments[..., diagonal, diagonal])
        outer = scale[..., :, None] * scale[..., None, :]
        inner = np.linalg.inv(moments[..., :p] * outer + _RIDGE * np.eye(p)) * outer
        return scale, inner, moments[..., p:]

    def relaxed(
        self, criterion: Criterion, number: float, total: float, start: Array | None = None
    ) -> Optimum[Array]:
        """Return the best numbers that need not be whole.

        number, total: Largest sum of the numbers and of their costs, s; one of them finite.
        start: Weights to begin from, shape (n,).
        """
        cost = self.cost
        if not math.isfinite(total):
            cost, total = np.ones(len(cost)), number
        if not math.isfinite(number):
            number = total / float(cost.min())
        known = np.hstack([self.known, self.known_fixed])
        identity = np.eye(known.shape[1])[self.known.shape[1] :]
        solved = _Relaxation(
            triangle_of(np.vstack([known, identity])),
            criterion,
            np.concatenate([self.design, self.fixed], axis=2),
            cost,
            total,
            number,
        )
        return solved.solve(solved.start() if start is None else start)


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
        self.root, self.cost = root, cost
        self.total, self.number = total, number

    def solve(self, weight: Array) -> Optimum[Array]:
        """Return the best weights, from some."""
        value = self.value(weight)
        bound, price = -math.inf, 0.0
        for _ in range(_GRADIENT_STEPS):
            # With a little of everything no gain is infinite at nothing: the bound holds anywhere.
            mixed = weight + _MIXED_IN * (self.even() - weight)
            current, gains = self.gain(mixed)
            best, price = self.most(gains)
            bound = max(bound, current + float(gains @ mixed) - float(gains @ best))
            if value - bound < _GAP_OF_U:
                break
            support = np.flatnonzero((weight > ZERO_WEIGHT) | (best > ZERO_WEIGHT))
            better = self.improved(support, weight, best)
            after = self.value(better)
            if after > value - 0.01 * _GAP_OF_U:
                break  # rounding is all that is left to gain
            weight, value = better, after
        return Optimum(weight, value, bound, price)

    def value(self, weight: Array) -> float:
        """Return the criterion."""
        used = np.flatnonzero(weight > 0.0)
        return self._solve(used, weight[used])[0]

    def gain(self, weight: Array) -> tuple[float, Array]:
        """Return the criterion and its decrease per added observation, shape (n,)."""
        used = np.flatnonzero(weight > 0.0)
        value, covariance = self._solve(used, weight[used])
        v = covariance @ self.criterion.directions(covariance)
        return value, np.asarray(np.sum((self.root @ v) ** 2, axis=(1, 2)))

    def _solve(self, used: Places, weight: Array) -> tuple[float, Array]:
        rows = self.root[used] * np.sqrt(weight)[:, None, None]
        stacked = np.vstack([rows.reshape(-1, self.prior.shape[1]), self.prior])
        inverse = np.linalg.inv(np.linalg.qr(stacked, mode="r"))
        covariance = inverse @ inverse.T
        return float(self.criterion.value(covariance)), covariance

    def start(self) -> Array:
        """Return starting weights: equal, then in proportion to the gain of each for its cost.

        From all of them everything is determined that can be, and the gains are finite: where a
        few leave something open, its price hides all else.
        """
        taken, weight = self._taken(), self.even()
        for _ in range(_FIRST_STEPS):
            _, phi = self.gain(weight)
            weight = self._within(weight * np.sqrt(phi / taken))
        return self._within(np.where(weight > _FIRST_PART * weight.max(), weight, 0.0))

    def even(self) -> Array:
        """Return weights by which everything takes as much of the limits."""
        return self._within(1.0 / self._taken())

    def _taken(self) -> Array:
        return self.cost / self.total + 1.0 / self.number

    def _within(self, weight: Array) -> Array:
        """Return weights of the same ratios that touch a limit."""
        over = max(float(self.cost @ weight) / self.total, float(weight.sum()) / self.number)
        return weight / over

    def most(self, phi: Array) -> tuple[Array, float]:
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
            above = gain - slope * cost
            price = float(above[lower])
            over = int(np.argmax(above))
            if above[over] <= price + _ROUNDING * gain[upper] or over in (lower, upper):
                break
            lower, upper = (over, upper) if cost[over] <= share else (lower, over)
        weight[upper] = self.number * (share - cost[lower]) / (cost[upper] - cost[lower])
        weight[lower] = self.number - weight[upper]
        return weight[:-1], price

    def improved(self, support: Places, weight: Array, best: Array) -> Array:
        """Return the best weights on a support."""
        from scipy.optimize import minimize

        count = support.size
        start = weight[support] + 0.1 * (best[support] - weight[support])
        cost = self.cost[support]

        def objective(n: Array) -> tuple[float, Array]:
            value, covariance = self._solve(support, np.maximum(n, 0.0))
            v = covariance @ self.criterion.directions(covariance)
            return value, -np.sum((self.root[support] @ v) ** 2, axis=(1, 2))

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
        over = max(float(self.cost @ result) / self.total, float(result.sum()) / self.number, 1.0)
        return result / over
