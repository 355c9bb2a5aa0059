"""The relaxed optimum of a plan of records: over a grid of runs that is made finer where it counts.

Which runs of the grid, and how many of each, says `counterspin.planning.possibilities`.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from counterspin.arrays import Array, triangle_of
from counterspin.frozen import frozen
from counterspin.planning.design import Criterion, Design, Limits, Predictor, RunType
from counterspin.planning.possibilities import ZERO_WEIGHT, Places, Possibilities

#: Rates and lengths on the first grid, where any rate may be set.
_GRID_RATES: Final = 9
_GRID_LENGTHS: Final = 12
#: How many times the grid is made finer about the runs that are in use.
_REFINEMENTS: Final = 4


@frozen(eq=False)
class RelaxedOptimum:
    """The relaxed optimum."""

    support: Design  #: Its runs.
    weight: Array  #: How many of each, not whole numbers, shape (n,).
    value: float  #: Its criterion (a logarithm, see `Criterion.value`).
    bound: float  #: What no plan can be below, over all runs of the grid.
    price_run: float  #: What the criterion gains for each further run.


def relax(predictor: Predictor, limits: Limits, criterion: Criterion) -> RelaxedOptimum:
    """Solve the relaxation on a grid."""
    grid, steps = _first_grid(limits)
    possible = _possible(predictor, limits, grid)
    resources = (float(limits.runs), limits.total_time)
    solved = possible.relaxed(criterion, *resources)
    for level in range(1, _REFINEMENTS + 1):
        used = np.flatnonzero(solved.weight > ZERO_WEIGHT)
        finer = _finer(limits, grid, used, steps * 0.5**level)
        if not finer.types:
            break
        grid = grid.joined(finer)
        possible = possible.joined(_possible(predictor, limits, finer))
        start = np.concatenate([solved.weight, np.zeros(len(finer.types))])
        solved = possible.relaxed(criterion, *resources, start)
    kept = np.flatnonzero(solved.weight > ZERO_WEIGHT)
    return RelaxedOptimum(grid.taken(kept.tolist()), solved.weight[kept], *solved[1:])


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
    types = tuple(one for one in limits.types for _ in w)
    ratio = math.log(rates[-1] / rates[0]) / max(1, len(rates) - 1)
    grid = Design(types, np.tile(w, several), np.tile(turns, several))
    return grid, np.array([0.0 if limits.settings else ratio, step])


def _most_revolutions(limits: Limits, rate: float) -> float:
    left = limits.total_time - float(limits.overhead(np.array(rate)))
    return min(limits.longest_run, left) * rate / (2.0 * math.pi)


def _finer(limits: Limits, grid: Design, used: Places, steps: Array) -> Design:
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
    return Design(tuple(one for one, _, _ in fresh), rate, turns_of)
