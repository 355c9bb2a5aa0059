"""The best campaign within limits: whole runs, free rates and lengths.

From the relaxed optimum (`counterspin.planning.candidate_set`) whole numbers of runs are made in
several ways; each start is improved in all rates and lengths at once (SLSQP, exact derivatives),
then by exchanging the attitude or sense of a run, leaving one out or adding one. The relaxation
says how far from any better plan the result can be.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.errors import NotIdentifiableError
from counterspin.planning.candidate_set import Optimum, relax
from counterspin.planning.design import (
    Criterion,
    Design,
    Limits,
    RunType,
    fit_to_limits,
    scale_to_time,
)
from counterspin.planning.run_information import Predictor

#: Smallest relative gain of u (or of time) for which a plan is changed.
_MIN_GAIN: Final = 2e-5
#: Passes of exchanges, and how many candidates are polished in each.
_PASSES: Final = 3
_MAX_POLISHED: Final = 5
#: Weight, in runs, from which a group of the relaxation may get a whole run.
_WEIGHT_OF_A_RUN: Final = 0.02
#: Relative difference in rate and length below which the exchanges take two runs as equal.
_EQUAL_RUNS: Final = 1e-3


def optimise(
    predictor: Predictor,
    limits: Limits,
    criterion: Criterion,
    *,
    relaxing: Predictor | None = None,
    start: Design | None = None,
) -> Optimum[Design]:
    """Find the plan with the smallest criterion value.

    relaxing: A predictor in which considered terms are estimated; None: no term is considered.
    """
    if not limits.is_feasible:
        raise NotIdentifiableError(
            f"no run fits into {limits.total_time:.6g} s, because the shortest run takes "
            f"{limits.shortest_time:.6g} s with spin-up and settling",
            code="plan-infeasible",
        )
    choices = [
        (*relax(relaxing or predictor, run_limits, criterion), run_limits)
        for run_limits in _subsets(limits)
    ]
    choices.sort(key=lambda choice: choice[1].bound)
    best: tuple[float, Design] | None = None
    for support, relaxed, run_limits in choices:
        if best is not None and relaxed.bound > best[0] - _MIN_GAIN:
            break  # nor can those that follow be better
        starts = list(_integer_starts(support, relaxed, run_limits))
        if start is not None and (adjusted := fit_to_limits(start, run_limits)) is not None:
            starts = [adjusted, *starts[:1]]
        starts = starts or list(_fastest_starts(run_limits))
        if not starts:
            continue
        polished = _polish_best(predictor, run_limits, criterion, starts)
        exchanged = _exchange(predictor, run_limits, criterion, polished)
        if best is None or exchanged[0] < best[0] - _MIN_GAIN:
            best = exchanged
    if best is None:
        raise NotIdentifiableError(
            f"the search found no plan of at most {limits.runs} runs that fits into "
            f"{limits.total_time:.6g} s; allow more time",
            code="plan-infeasible",
        )
    value, design = _order_runs(predictor, criterion, *best)
    return Optimum(design, value, min(choices[0][1].bound, value))


def _subsets(limits: Limits) -> Iterator[Limits]:
    """Yield the limits for each choice of attitudes, the time to change between them taken off.

    If a change costs nothing, all attitudes together hold every choice.
    """
    attitudes = list(dict.fromkeys(run_type.attitude for run_type in limits.types))
    if limits.attitude_change == 0.0:
        yield limits
        return
    for count in range(1, len(attitudes) + 1):
        available = limits.total_time - (count - 1) * limits.attitude_change
        if available < limits.shortest_time or count > limits.runs:
            return
        for chosen in combinations(attitudes, count):
            yield replace(
                limits,
                types=tuple(run_type for run_type in limits.types if run_type.attitude in chosen),
                total_time=available,
                attitude_change=0.0,
            )


def _integer_starts(design: Design, relaxed: Optimum[Array], limits: Limits) -> Iterator[Design]:
    """Yield starts: whole runs in place of the relaxation's weights.

    design: The runs that the relaxation uses.
    """
    groups: dict[tuple[RunType, float], list[int]] = {}
    for index, (run_type, w) in enumerate(zip(design.types, design.rate, strict=True)):
        rate_group = float(w) if limits.settings else float(round(8.0 * math.log(w)))
        groups.setdefault((run_type, rate_group), []).append(index)
    weight = np.array([relaxed.design[index].sum() for index in groups.values()])
    run_types = [run_type for run_type, _ in groups]
    rate = np.array([design.rate[i[np.argmax(relaxed.design[i])]] for i in groups.values()])
    turns = np.array(
        [np.average(design.revolutions[i], weights=relaxed.design[i]) for i in groups.values()]
    )
    total_weight = float(weight.sum())
    totals = {
        min(limits.runs, max(1, n)) for n in (math.floor(total_weight), math.ceil(total_weight))
    }
    totals |= {limits.runs} if relaxed.shadow_price > 0.0 else set()
    shares = [_largest_remainder(weight, count) for count in sorted(totals, reverse=True)]
    # A group with a fraction of a run may separate terms: then it needs a complete run.
    shares += [_keep_each_group(weight, share) for share in shares]
    for runs in shares:
        count = int(runs.sum())
        indices = np.repeat(np.arange(weight.size), runs)
        types = tuple(run_types[i] for i in indices)
        # As much time in each group as the relaxation spends there.
        scaled = scale_to_time(
            Design(types, rate[indices], (turns * weight / np.maximum(runs, 1))[indices]), limits
        )
        if scaled is None:
            continue
        yield scaled
        types, count = scaled.types, len(scaled.types)
        if count < 2:
            continue
        # Some optima have one long run that determines drifts, and many short ones.
        for index in np.unique(indices, return_index=True)[1]:
            longer = scaled.revolutions.copy()
            longer[index] *= 3.0
            fitted = scale_to_time(Design(types, scaled.rate, longer), limits)
            if fitted is not None:
                yield fitted
        # Rates apart, in case the relaxation has put all runs into one point of a flat optimum.
        spread_rates = np.geomspace(
            max(limits.rate[0], 0.5 * limits.rate[1]), limits.rate[1], count
        )
        if not limits.settings:
            fitted = scale_to_time(Design(types, spread_rates, scaled.revolutions), limits)
            if fitted is not None:
                yield fitted


def _fastest_starts(limits: Limits) -> Iterator[Design]:
    """Yield starts at the highest rates, for a time that is too short at the relaxation's."""
    rate = np.array(limits.different_rates(limits.rate[1]))
    revolutions = np.full(rate.size, limits.revolutions)
    for run_type in dict.fromkeys(limits.types):
        fitted = scale_to_time(Design((run_type,) * rate.size, rate, revolutions), limits)
        if fitted is not None:
            yield fitted


def _largest_remainder(weight: Array, count: int) -> npt.NDArray[np.int64]:
    """Return whole numbers of a given sum nearest to proportional (largest remainders)."""
    exact = weight * (count / weight.sum())
    counts: npt.NDArray[np.int64] = np.floor(exact).astype(np.int64)
    largest = np.argsort(-(exact - counts), kind="stable")[: count - int(counts.sum())]
    counts[largest] += 1
    return counts


def _keep_each_group(weight: Array, runs: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the runs with one for each group of some weight, taken from the largest groups."""
    new_runs = runs.copy()
    for index in np.flatnonzero((weight > _WEIGHT_OF_A_RUN) & (runs == 0)):
        largest = int(np.argmax(new_runs))
        if new_runs[largest] > 1:
            new_runs[largest] -= 1
            new_runs[index] = 1
    return new_runs


def _polish_best(
    predictor: Predictor, limits: Limits, criterion: Criterion, starts: Sequence[Design]
) -> tuple[float, Design]:
    """Polish the most promising starts."""
    ranked_starts = sorted(starts, key=lambda design: predictor.value(criterion, design))
    polished = [
        polish(predictor, limits, criterion, design) for design in ranked_starts[:_MAX_POLISHED]
    ]
    return min(polished, key=lambda pair: pair[0])


def _exchange(
    predictor: Predictor, limits: Limits, criterion: Criterion, best: tuple[float, Design]
) -> tuple[float, Design]:
    """Exchange, leave out or add runs for as long as it gains."""
    for _ in range(_PASSES):
        value, design = best
        fitted = (scale_to_time(candidate, limits) for candidate in _neighbours(design, limits))
        candidates = sorted(
            (candidate for candidate in fitted if candidate is not None),
            key=lambda candidate: predictor.value(criterion, candidate),
        )
        polished = (
            polish(predictor, limits, criterion, candidate)
            for candidate in candidates[:_MAX_POLISHED]
        )
        better = next((pair for pair in polished if pair[0] < value - _MIN_GAIN), None)
        if better is None:
            return best
        best = better
    return best


def _neighbours(design: Design, limits: Limits) -> Iterator[Design]:
    """Yield the designs with one run changed; of equal runs, change only one."""
    seen: list[tuple[RunType, float, float]] = []
    n = len(design.types)
    for index in range(n):
        run_type, rate = design.types[index], float(design.rate[index])
        turns = float(design.revolutions[index])
        if any(
            run_type == k
            and abs(rate / w - 1.0) < _EQUAL_RUNS
            and abs(turns / t - 1.0) < _EQUAL_RUNS
            for k, w, t in seen
        ):
            continue
        seen.append((run_type, rate, turns))
        for new_type in limits.types:
            if new_type != run_type:
                yield design.with_type(index, new_type)
        for setting in limits.settings:
            if setting != rate:
                rates = design.rate.copy()
                rates[index] = setting
                lengths = design.revolutions.copy()
                lengths[index] *= setting / rate
                yield Design(design.types, rates, lengths)
        if n > 1:
            yield design.without(index)
    if n < limits.runs:
        for run_type in limits.types:
            rates = np.array(limits.settings or limits.rate)
            for rate in rates:
                turns = max(limits.revolutions, float(np.median(design.duration)) * rate / 6.3)
                yield design.concatenate(Design((run_type,), np.array([rate]), np.array([turns])))


def _order_runs(
    predictor: Predictor, criterion: Criterion, value: float, design: Design
) -> tuple[float, Design]:
    """Return the design with its runs in order of rate, or in a more informative order.

    Up with every other run and down with the rest, a steady warming looks like no rate.
    """
    sorted_design = _sort_runs(design)
    if not predictor.information.dated:
        return value, sorted_design
    n = len(design.types)
    mirrored_design = sorted_design.select([*range(0, n, 2), *reversed(range(1, n, 2))])
    candidates = (sorted_design, mirrored_design, design)
    return min(
        ((predictor.value(criterion, candidate), candidate) for candidate in candidates),
        key=lambda pair: pair[0],
    )


def _sort_runs(design: Design) -> Design:
    """Return the runs by type as they were met, then by rate and length."""
    run_types = list(dict.fromkeys(design.types))
    order = sorted(
        range(len(design.types)),
        key=lambda i: (
            run_types.index(design.types[i]),
            round(float(design.rate[i]), 9),
            design.duration[i],
        ),
    )
    return design.select(order)


def least_time(
    predictor: Predictor,
    limits: Limits,
    criterion: Criterion,
    *,
    relaxing: Predictor | None = None,
) -> Optimum[Design] | None:
    """Find the shortest plan in which u of each unknown of interest is at most its scale.

    Returns: None if no plan within the limits reaches the targets. The criterion's value and bound
        are logarithms of the time in s.
    """
    targets = replace(criterion, combination="sum")
    singles = [Criterion((i,), (s,)) for i, s in zip(targets.indices, targets.scales, strict=True)]

    def misses(design: Design) -> float:
        covariance = predictor.covariance(design.types, design.rate, design.revolutions)
        return max(float(single.value(covariance)) for single in singles)

    design = optimise(predictor, limits, targets, relaxing=relaxing).design
    if misses(design) > 0.0 and len(singles) > 1:
        # The mean hides the worst: give it more weight until all are below their targets.
        for _ in range(8):
            ratio = predictor.u(design)[list(targets.indices)] / np.array(criterion.scales)
            scales = np.array(targets.scales) / np.sqrt(ratio)
            targets = replace(targets, scales=tuple(float(s) for s in scales))
            _, design = polish(predictor, limits, targets, design)
            if misses(design) <= 0.0:
                break
    if misses(design) > 1e-9:
        return None
    bound = _lower_bound_of_time(
        relaxing or predictor, limits, replace(criterion, combination="sum")
    )
    best = shortest_plan(predictor, limits, singles, design)
    time = bound
    for _ in range(4):
        scaled = optimise(
            predictor,
            replace(limits, total_time=max(time, limits.shortest_time)),
            targets,
            relaxing=relaxing,
        )
        shorter = shortest_plan(predictor, limits, singles, scaled.design)
        if misses(shorter) <= 1e-6 and limits.time(shorter) < limits.time(best) * (1.0 - _MIN_GAIN):
            best = shorter
        time = 0.5 * (time + limits.time(best))
    _, best = _order_runs(predictor, targets, predictor.value(targets, best), best)
    return Optimum(best, math.log(limits.time(best)), math.log(bound))


def _lower_bound_of_time(predictor: Predictor, limits: Limits, criterion: Criterion) -> float:
    """Return a time below which no plan reaches a criterion of 0, by bisection."""
    low, high = math.log(limits.shortest_time), math.log(limits.total_time)
    for _ in range(10):
        middle = 0.5 * (low + high)
        _, relaxed = relax(predictor, replace(limits, total_time=math.exp(middle)), criterion)
        low, high = (middle, high) if relaxed.bound > 0.0 else (low, middle)
    return math.exp(low)


def polish(
    predictor: Predictor, limits: Limits, criterion: Criterion, design: Design
) -> tuple[float, Design]:
    """Improve rates and lengths for given types of run."""
    variables = _Variables(limits, design)

    def objective(x: Array) -> tuple[float, Array]:
        value, by_rate, by_turns = predictor.sensitivities(variables.design(x), criterion)
        return value, variables.gradient(by_rate, by_turns)

    x = variables.solve(objective, [variables.time_margin])
    improved = _shorten_to_fit(variables.design(x), limits)
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
        self.apart = limits.distinct_rate_runs(design.rate) if limits.fewest_rates > 1 else []

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

    def time_margin(self, x: Array) -> tuple[Array, Array]:
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
        all_constraints = [*constraints, self.length_margins]
        all_constraints += [self.rate_ratio_margins] if self.free and len(self.apart) > 1 else []

        def values(x: Array) -> Array:
            return np.concatenate([constraint(x)[0] for constraint in all_constraints])

        def slopes(x: Array) -> Array:
            return np.vstack([constraint(x)[1] for constraint in all_constraints])

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

    def length_margins(self, x: Array) -> tuple[Array, Array]:
        """Return the margin of each record to the longest allowed, as logarithms."""
        duration = self.design(x).duration
        eye = np.eye(self.n)
        return (
            np.log(self.limits.longest_run / duration),
            np.hstack([eye, -eye]) if self.free else -eye,
        )

    def rate_ratio_margins(self, x: Array) -> tuple[Array, Array]:
        """Return the excess of rate ratios over the required ratio, as logarithms."""
        slopes = np.zeros((len(self.apart) - 1, x.size))
        for row, (faster, slower) in enumerate(pairwise(self.apart)):
            slopes[row, [faster, slower]] = 1.0, -1.0
        return slopes @ x - math.log(self.limits.min_rate_ratio), slopes


def _shorten_to_fit(design: Design, limits: Limits) -> Design:
    """Return the design, shortened where rounding has put it over the available time."""
    if limits.time(design) <= limits.total_time:
        return design
    return scale_to_time(design, limits) or design


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
