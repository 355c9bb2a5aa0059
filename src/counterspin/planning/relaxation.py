"""The convex relaxation of a plan: the best numbers of runs where these need not be whole.

Over a grid of possible runs (attitude, sense, rate, length) with weights n_x >= 0, the
information is M = M_0 + sum of n_x M_x, the limits on time and on the number of runs are linear,
and the criteria are convex in M. So every local optimum is the global one, it is no worse than any
real plan, and the general equivalence theorem identifies it: with the gain of a run
phi(x) = -d(criterion)/d(n_x) there are prices of time and of a run such that

    phi(x) <= price_time * cost(x) + price_run      for every x, equality where n_x > 0.

What is left of the inequality bounds what any plan at all could do better.

Considered terms are taken as estimated here, with their priors: the best estimator is no worse
than one that leaves them out, so the bound holds, and the problem stays convex.

References
----------
Silvey, Titterington and Torsney, Commun. Stat. A 7 (1978) 1379, the multiplicative algorithm;
Kiefer and Wolfowitz, The equivalence of two extremum problems, Canad. J. Math. 12 (1960) 363;
Cook and Fedorov, Constrained optimization of experimental design, Statistics 26 (1995) 129.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array, triangle_of
from counterspin.frozen import frozen
from counterspin.planning.design import Criterion, Limits, Predictor, RunType

Places = npt.NDArray[np.intp]

#: Rates and lengths on the first grid, where any rate may be set.
_GRID_RATES: Final = 9
_GRID_LENGTHS: Final = 12
#: How many times the grid is made finer about the runs that are in use.
_REFINEMENTS: Final = 4
#: Steps of the multiplicative algorithm before the first gradient step, and the least part of the
#: largest weight that is kept of them.
_FIRST_STEPS: Final = 20
_FIRST_PART: Final = 0.03
#: Part of everything that is mixed into weights where their gains are taken.
_MIXED_IN: Final = 1e-4
#: Largest number of gradient steps on one grid.
_GRADIENT_STEPS: Final = 30
#: Smaller weights, in runs, count as zero.
_ZERO_WEIGHT: Final = 1e-5
#: Relative gap of u to the bound at which the relaxation is solved.
_GAP_OF_U: Final = 3e-4


@frozen(eq=False)
class Relaxed:
    """The relaxed optimum."""

    #: Its support: kinds of run and how many of each, the weights not whole numbers.
    types: tuple[RunType, ...]
    rate: Array
    revolutions: Array
    weight: Array
    value: float  #: Its criterion (a logarithm, see `Criterion.value`).
    #: What no plan can be below: `value` less the gap that the equivalence theorem leaves, over all
    #: runs of the grid.
    bound: float
    price_run: float  #: What the criterion gains for each further run.


@frozen(eq=False)
class _Grid:
    """Possible runs: kinds, information about the scaled unknowns (n, p, p), cost in s."""

    types: tuple[RunType, ...]
    rate: Array
    revolutions: Array
    root: Array
    cost: Array

    def joined(self, other: _Grid) -> _Grid:
        """Return the runs of both."""
        return _Grid(
            self.types + other.types,
            *(
                np.concatenate([getattr(self, part), getattr(other, part)])
                for part in ("rate", "revolutions", "root", "cost")
            ),
        )


def relax(predictor: Predictor, limits: Limits, criterion: Criterion, fineness: int = 1) -> Relaxed:
    """Solve the relaxation on a grid."""
    grid, steps = _first_grid(predictor, limits, fineness)
    problem, resources = (predictor.prior, criterion), (limits.total_time, float(limits.runs))
    solved = _Weights(*problem, grid.root, grid.cost, *resources)
    weight = solved.start()
    weight, solution = _solve(solved, weight)
    for level in range(1, _REFINEMENTS + 1):
        used = np.flatnonzero(weight > _ZERO_WEIGHT)
        finer = _finer(predictor, limits, grid, used, steps * 0.5**level)
        if not len(finer.types):
            break
        grid = grid.joined(finer)
        solved = _Weights(*problem, grid.root, grid.cost, *resources)
        weight = np.concatenate([weight, np.zeros(len(finer.types))])
        weight, solution = _solve(solved, weight)
    kept = np.flatnonzero(weight > _ZERO_WEIGHT)
    value, bound, price_run = solution
    return Relaxed(
        tuple(grid.types[i] for i in kept),
        grid.rate[kept],
        grid.revolutions[kept],
        weight[kept],
        value,
        bound,
        price_run,
    )


def allocate(
    prior: Array, criterion: Criterion, root: Array, cost: Array, total: float, count: float
) -> tuple[Array, float, float]:
    """Solve the relaxation for given possibilities: how often each is to be had.

    prior: Square-root information beforehand, shape (p, p).
    Returns: numbers that need not be whole, shape (n,); the criterion; what no whole numbers can be
        below.
    """
    solved = _Weights(prior, criterion, root, cost, total, count)
    weight, (value, bound, _) = _solve(solved, solved.start())
    return weight, value, bound


def _solve(solved: _Weights, weight: Array) -> tuple[Array, tuple[float, float, float]]:
    """Return the best weights; their criterion, the bound and the price of a run."""
    value = solved.value(weight)
    bound, price_run = -math.inf, 0.0
    for _ in range(_GRADIENT_STEPS):
        # With a little of everything no gain is infinite at nothing: the bound holds anywhere.
        mixed = weight + _MIXED_IN * (solved.even() - weight)
        here, gains = solved.gain(mixed)
        best, price_run = solved.most(gains)
        bound = max(bound, here + float(gains @ mixed) - float(gains @ best))
        if value - bound < _GAP_OF_U:
            break
        support = np.flatnonzero((weight > _ZERO_WEIGHT) | (best > _ZERO_WEIGHT))
        better = solved.improved(support, weight, best)
        after = solved.value(better)
        if after > value - 0.01 * _GAP_OF_U:
            break  # rounding is all that is left to gain
        weight, value = better, after
    return weight, (value, bound, price_run)


def _first_grid(predictor: Predictor, limits: Limits, fineness: int) -> tuple[_Grid, Array]:
    """Return a grid over all that is allowed, and its steps in log rate and log revolutions."""
    low, high = limits.rate
    if limits.settings:
        rates = np.array(limits.settings)
    elif high < low * (1.0 + 1e-9):
        rates = np.array([high])
    else:
        rates = np.geomspace(low, high, _GRID_RATES * fineness)
    rate, revolutions = [], []
    most = np.array([_most_revolutions(limits, float(w)) for w in rates])
    step = max(1e-9, math.log(max(2.0, float(most.max()) / limits.revolutions)))
    step /= _GRID_LENGTHS * fineness
    for w, longest in zip(rates, most, strict=True):
        if longest >= limits.revolutions * (1.0 - 1e-12):
            span = math.log(max(longest / limits.revolutions, 1.0))
            turns = limits.revolutions * np.exp(np.linspace(0.0, span, math.ceil(span / step) + 1))
            rate.append(np.full(turns.size, w))
            revolutions.append(turns)
    w, turns = np.concatenate(rate), np.concatenate(revolutions)
    several = len(limits.types)
    types = tuple(kind for kind in limits.types for _ in w)
    grid = _made(predictor, limits, types, np.tile(w, several), np.tile(turns, several))
    ratio = math.log(rates[-1] / rates[0]) / max(1, len(rates) - 1)
    return grid, np.array([0.0 if limits.settings else ratio, step])


def _most_revolutions(limits: Limits, rate: float) -> float:
    left = limits.total_time - float(limits.overhead(np.array(rate)))
    return min(limits.longest_run, left) * rate / (2.0 * math.pi)


def _finer(predictor: Predictor, limits: Limits, grid: _Grid, used: Places, steps: Array) -> _Grid:
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
    types = tuple(kind for kind, _, _ in fresh)
    rate, turns_of = (np.array([key[i] for key in fresh]) for i in (1, 2))
    return _made(predictor, limits, types, rate, turns_of)


def _made(
    predictor: Predictor,
    limits: Limits,
    types: tuple[RunType, ...],
    rate: Array,
    revolutions: Array,
) -> _Grid:
    cost = 2.0 * math.pi * revolutions / rate + limits.overhead(rate) if types else rate
    root = triangle_of(predictor.information.blocks(types, rate, revolutions)[:, :, : predictor.p])
    return _Grid(types, rate, revolutions, root, np.asarray(cost))


class _Weights:
    """The criterion as a function of the weights, and the linear limits on them."""

    def __init__(
        self,
        prior: Array,
        criterion: Criterion,
        root: Array,
        cost: Array,
        total: float,
        count: float,
    ) -> None:
        self.prior = prior
        self.criterion = criterion
        self.root, self.cost = root, cost
        self.total, self.runs = total, count

    def value(self, weight: Array) -> float:
        """Return the criterion."""
        used = np.flatnonzero(weight > 0.0)
        return self._solve(used, weight[used])[0]

    def gain(self, weight: Array) -> tuple[float, Array]:
        """Return the criterion and what each possible run would take off it, shape (n,)."""
        used = np.flatnonzero(weight > 0.0)
        value, covariance = self._solve(used, weight[used])
        v = covariance @ self.criterion.directions(covariance)
        return value, np.asarray(np.sum((self.root @ v) ** 2, axis=(1, 2)))

    def _solve(self, used: Places, weight: Array) -> tuple[float, Array]:
        rows = self.root[used] * np.sqrt(weight)[:, None, None]
        stacked = np.vstack([rows.reshape(-1, self.prior.shape[0]), self.prior])
        inverse = np.linalg.inv(np.linalg.qr(stacked, mode="r"))
        covariance = inverse @ inverse.T
        return float(self.criterion.value(covariance)), covariance

    def start(self) -> Array:
        """Return weights to start from: all alike, then by what each gains for what it takes.

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
        return self.cost / self.total + 1.0 / self.runs

    def _within(self, weight: Array) -> Array:
        """Return weights of the same ratios that touch a limit."""
        over = max(float(self.cost @ weight) / self.total, float(weight.sum()) / self.runs)
        return weight / over

    def most(self, phi: Array) -> tuple[Array, float]:
        """Return the weights that gain most by the gradient, and the price of a run."""
        from scipy.optimize import linprog

        scale = float(np.max(phi)) or 1.0
        rows = np.vstack([self.cost, np.ones_like(phi)])
        program = linprog(-phi / scale, A_ub=rows, b_ub=[self.total, self.runs], method="highs")
        return np.asarray(program.x), -float(program.ineqlin.marginals[1]) * scale

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
                    [1.0 - (cost @ n) / self.total, 1.0 - n.sum() / self.runs]
                ),
                "jac": lambda _: np.vstack([-cost / self.total, np.full(count, -1.0 / self.runs)]),
            },
            options={"maxiter": 50, "ftol": 1e-8},
        )
        result = np.zeros_like(weight)
        result[support] = np.maximum(minimum.x, 0.0)
        # A step over the limits by rounding must not count as a gain.
        over = max(float(self.cost @ result) / self.total, float(result.sum()) / self.runs, 1.0)
        return result / over
