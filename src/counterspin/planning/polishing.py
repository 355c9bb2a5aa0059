"""Rates and lengths of given runs, improved all at once by SLSQP with exact derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from counterspin.arrays import Array
from counterspin.planning.design import Criterion, Design, Limits, Predictor


def brought_within(design: Design, limits: Limits) -> Design | None:
    """Return a design that is within the limits as it is, or the like of it that is; or None.

    Its longest runs are kept, each at the nearest rate that there is, with the lengths scaled into
    the time. None: there is no such design, or it has types of run that are not available.
    """
    if limits.hold(design):
        return design
    if not set(design.types) <= set(limits.types):
        return None
    kept = np.sort(np.argsort(-design.duration, kind="stable")[: limits.runs])
    rate = limits.nearest(design.rate[kept])
    types = tuple(design.types[index] for index in kept)
    duration = design.duration[kept]
    fitted = fitted_into(Design(types, rate, duration * rate / (2.0 * math.pi)), limits)
    return fitted if fitted is not None and limits.hold(fitted) else None


def fitted_into(design: Design, limits: Limits) -> Design | None:
    """Return the design with its lengths scaled into the time there is; None if none fits."""
    spread = _at_different_rates(design, limits)
    if spread is None:
        return None
    design = spread
    fixed = float(np.sum(limits.overhead(design.rate)))
    changes = limits.time(design) - float(np.sum(design.duration)) - fixed
    left = limits.total_time - fixed - changes
    fewest = limits.revolutions * 2.0 * math.pi / design.rate
    spare = left - float(fewest.sum())
    if spare < -1e-9 * limits.total_time:
        return None
    beyond = np.clip(design.duration, fewest, limits.longest_run) - fewest
    wanted = float(beyond.sum())
    scale = max(0.0, spare) / wanted if wanted > 0.0 else 0.0
    duration = np.minimum(fewest + scale * beyond, np.maximum(limits.longest_run, fewest))
    return replace(design, revolutions=duration * design.rate / (2.0 * math.pi))


def _at_different_rates(design: Design, limits: Limits) -> Design | None:
    """Return the design with its slowest runs moved to rates of their own, if there are too few.

    None if the limits do not allow it.
    """
    if len(limits.runs_apart(design.rate)) >= limits.fewest_rates:
        return design
    fastest = max(
        float(design.rate.max()),
        min(limits.rate[1], limits.rate[0] * limits.apart ** (limits.fewest_rates - 1)),
    )
    rates = limits.different_rates(fastest)
    if len(rates) < limits.fewest_rates or limits.fewest_rates > limits.runs:
        return None
    while len(design.types) < limits.fewest_rates:
        design = design.joined(Design(design.types[:1], design.rate[:1], design.revolutions[:1]))
    rate = design.rate.copy()
    order = np.argsort(-rate, kind="stable")
    rate[order[0]] = rates[0]
    rate[order[len(order) - len(rates) + 1 :]] = rates[1:]
    return Design(design.types, rate, design.duration * rate / (2.0 * math.pi))


def polish(
    predictor: Predictor, limits: Limits, criterion: Criterion, design: Design
) -> tuple[float, Design]:
    """Improve rates and lengths, the types of run being given."""
    variables = _Variables(limits, design)

    def objective(x: Array) -> tuple[float, Array]:
        value, by_rate, by_turns = predictor.sensitivities(variables.design(x), criterion)
        return value, variables.gradient(by_rate, by_turns)

    x = variables.solve(objective, [variables.time_left])
    improved = _shortened_to_fit(variables.design(x), limits)
    candidates = [improved]
    if limits.time(design) <= limits.total_time * (1.0 + 1e-9):
        candidates.append(design)
    valued = [(predictor.value(criterion, candidate), candidate) for candidate in candidates]
    return min(valued, key=lambda pair: pair[0])


class _Variables:
    """Log rates (if free) and log revolutions as one vector, with bounds and time."""

    def __init__(self, limits: Limits, design: Design) -> None:
        self.limits = limits
        self.start = design
        self.n = len(design.types)
        self.free = not limits.settings and limits.rate[1] > limits.rate[0] * (1.0 + 1e-9)
        self.apart = limits.runs_apart(design.rate) if limits.fewest_rates > 1 else []

    def design(self, x: Array) -> Design:
        rate = np.exp(x[: self.n]) if self.free else self.start.rate
        return Design(self.start.types, np.asarray(rate), np.asarray(np.exp(x[-self.n :])))

    def gradient(self, by_rate: Array, by_turns: Array) -> Array:
        return np.concatenate([by_rate, by_turns]) if self.free else by_turns

    def time(self, x: Array) -> tuple[float, Array]:
        """Return log(time / total time) and its gradient."""
        design = self.design(x)
        time = self.limits.time(design)
        of_rate = (-design.duration + self.limits.spin_up * design.rate) / time
        gradient = self.gradient(of_rate, design.duration / time)
        return math.log(time / self.limits.total_time), gradient

    def time_left(self, x: Array) -> tuple[Array, Array]:
        value, gradient = self.time(x)
        return np.array([-value]), -gradient[None]

    def solve(
        self,
        objective: Callable[[Array], tuple[float, Array]],
        constraints: Sequence[Callable[[Array], tuple[Array, Array]]],
    ) -> Array:
        """Minimise by SLSQP; constraints give values, to be positive, and their Jacobian."""
        from scipy.optimize import minimize

        limits, start = self.limits, self.start
        most = limits.longest_run * limits.rate[1] / (2.0 * math.pi)
        turns = (math.log(limits.revolutions), math.log(max(most, limits.revolutions)))
        rate = (math.log(limits.rate[0]), math.log(limits.rate[1]))
        bounds = [rate] * self.n * self.free + [turns] * self.n
        x = np.concatenate([np.log(start.rate)] * self.free + [np.log(start.revolutions)])
        low, high = np.array(bounds).T
        every = [*constraints, self.length_left]
        every += [self.rates_apart] if self.free and len(self.apart) > 1 else []

        def values(x: Array) -> Array:
            return np.concatenate([constraint(x)[0] for constraint in every])

        def slopes(x: Array) -> Array:
            return np.vstack([constraint(x)[1] for constraint in every])

        minimum = minimize(
            objective,
            np.clip(x, low, high),
            jac=True,
            method="SLSQP",
            bounds=bounds,
            constraints={"type": "ineq", "fun": values, "jac": slopes},
            options={"maxiter": 100, "ftol": 1e-8},
        )
        return np.asarray(np.clip(minimum.x, low, high))

    def length_left(self, x: Array) -> tuple[Array, Array]:
        """Return how far each record is below the longest allowed, as logarithms."""
        duration = self.design(x).duration
        eye = np.eye(self.n)
        return (
            np.log(self.limits.longest_run / duration),
            np.hstack([eye, -eye]) if self.free else -eye,
        )

    def rates_apart(self, x: Array) -> tuple[Array, Array]:
        """Return by how much rates that must differ do so more than they must, as logarithms."""
        slopes = np.zeros((len(self.apart) - 1, x.size))
        for row, (faster, slower) in enumerate(pairwise(self.apart)):
            slopes[row, [faster, slower]] = 1.0, -1.0
        return slopes @ x - math.log(self.limits.apart), slopes


def _shortened_to_fit(design: Design, limits: Limits) -> Design:
    """Return the design, shortened where rounding has put it over the time there is."""
    if limits.time(design) <= limits.total_time:
        return design
    return fitted_into(design, limits) or design


def shortest_plan(
    predictor: Predictor, limits: Limits, singles: Sequence[Criterion], design: Design
) -> Design:
    """Return the shortest plan of the same types of run that still meets every target."""
    variables = _Variables(limits, design)

    def below(x: Array) -> tuple[Array, Array]:
        plan = variables.design(x)
        values, slopes = [], []
        for single in singles:
            value, by_rate, by_turns = predictor.sensitivities(plan, single)
            values.append(-value)
            slopes.append(-variables.gradient(by_rate, by_turns))
        return np.array(values), np.array(slopes)

    return variables.design(variables.solve(variables.time, [below]))
