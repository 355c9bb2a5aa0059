"""Optimal campaign within limits, with integer numbers of runs and continuous rates and lengths.

The relaxed optimum (`counterspin.planning.candidate_set`) is rounded to integer numbers of runs in
several ways. All rates and lengths of each start are optimised together (SLSQP with exact
derivatives). Then runs are exchanged, removed or added. The relaxation bounds the distance to the
global optimum.
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
from counterspin.planning.candidate_set import Optimum, relax_design
from counterspin.planning.design import (
    Criterion,
    Design,
    Limits,
    RunType,
    fit_to_limits,
    scale_to_time,
)
from counterspin.planning.run_information import Predictor

#: Minimum relative gain of u (or of time) for a change of the plan.
_MIN_GAIN: Final = 2e-5
#: Passes of exchanges, and how many candidates are polished in each.
_N_PASSES: Final = 3
_MAX_POLISHED_DESIGNS: Final = 5
#: Minimum weight of a group in the relaxation, in runs, to get a run.
_MIN_RUN_WEIGHT: Final = 0.02
#: Relative difference in rate and length below which two runs are equal in exchanges.
_EQUAL_RUN_TOLERANCE: Final = 1e-3


def optimise(
    predictor: Predictor,
    limits: Limits,
    criterion: Criterion,
    *,
    relaxed_predictor: Predictor | None = None,
    start: Design | None = None,
) -> Optimum[Design]:
    """Find the plan with the smallest criterion value.

    relaxed_predictor: A predictor that estimates the considered terms; None: no considered terms.
    """
    if not limits.is_feasible:
        raise NotIdentifiableError(
            f"no run fits into {limits.total_time:.6g} s, because the shortest run takes "
            f"{limits.min_time:.6g} s with spin-up and settling",
            code="plan-infeasible",
        )
    relaxations = [
        (*relax_design(relaxed_predictor or predictor, run_limits, criterion), run_limits)
        for run_limits in _attitude_subsets(limits)
    ]
    relaxations.sort(key=lambda relaxation: relaxation[1].bound)
    best_pair: tuple[float, Design] | None = None
    for support, relaxed_optimum, subset_limits in relaxations:
        if best_pair is not None and relaxed_optimum.bound > best_pair[0] - _MIN_GAIN:
            break  # all further subsets have higher bounds
        starts = list(_integer_starts(support, relaxed_optimum, subset_limits))
        if (
            start is not None
            and (adjusted_start := fit_to_limits(start, subset_limits)) is not None
        ):
            starts = [adjusted_start, *starts[:1]]
        starts = starts or list(_fastest_starts(subset_limits))
        if not starts:
            continue
        local_pair = _polish_best(predictor, subset_limits, criterion, starts)
        local_pair = _exchange_runs(predictor, subset_limits, criterion, local_pair)
        if best_pair is None or local_pair[0] < best_pair[0] - _MIN_GAIN:
            best_pair = local_pair
    if best_pair is None:
        raise NotIdentifiableError(
            f"the search found no plan of at most {limits.max_runs} runs that fits into "
            f"{limits.total_time:.6g} s; allow more time",
            code="plan-infeasible",
        )
    value, design = _order_runs(predictor, criterion, *best_pair)
    return Optimum(design, value, min(relaxations[0][1].bound, value))


def _attitude_subsets(limits: Limits) -> Iterator[Limits]:
    """Yield the limits for each subset of attitudes, minus the time to change between them.

    If a change takes no time, yield only the limits with all attitudes.
    """
    attitudes = list(dict.fromkeys(run_type.attitude for run_type in limits.types))
    if limits.attitude_change == 0.0:
        yield limits
        return
    for n_attitudes in range(1, len(attitudes) + 1):
        available_time = limits.total_time - (n_attitudes - 1) * limits.attitude_change
        if available_time < limits.min_time or n_attitudes > limits.max_runs:
            return
        for subset in combinations(attitudes, n_attitudes):
            yield replace(
                limits,
                types=tuple(run_type for run_type in limits.types if run_type.attitude in subset),
                total_time=available_time,
                attitude_change=0.0,
            )


def _integer_starts(design: Design, optimum: Optimum[Array], limits: Limits) -> Iterator[Design]:
    """Yield starts with integer numbers of runs in place of the relaxed weights.

    design: Support of the relaxation.
    """
    groups: dict[tuple[RunType, float], list[int]] = {}
    for index, (run_type, rate) in enumerate(zip(design.types, design.rate, strict=True)):
        rate_key = float(rate) if limits.rate_settings else float(round(8.0 * math.log(rate)))
        groups.setdefault((run_type, rate_key), []).append(index)
    group_weights = np.array([optimum.design[index].sum() for index in groups.values()])
    run_types = [run_type for run_type, _ in groups]
    group_rates = np.array([design.rate[i[np.argmax(optimum.design[i])]] for i in groups.values()])
    group_revolutions = np.array(
        [np.average(design.revolutions[i], weights=optimum.design[i]) for i in groups.values()]
    )
    total_weight = float(group_weights.sum())
    run_totals = {
        min(limits.max_runs, max(1, n)) for n in (math.floor(total_weight), math.ceil(total_weight))
    }
    run_totals |= {limits.max_runs} if optimum.shadow_price > 0.0 else set()
    allocations = [
        _round_by_largest_remainder(group_weights, count)
        for count in sorted(run_totals, reverse=True)
    ]
    # A group with a fraction of a run may separate terms, so it may need a complete run.
    allocations += [_fill_empty_groups(group_weights, allocation) for allocation in allocations]
    for counts in allocations:
        count = int(counts.sum())
        indices = np.repeat(np.arange(group_weights.size), counts)
        types = tuple(run_types[i] for i in indices)
        # Each group takes as much time as in the relaxation.
        scaled_design = scale_to_time(
            Design(
                types,
                group_rates[indices],
                (group_revolutions * group_weights / np.maximum(counts, 1))[indices],
            ),
            limits,
        )
        if scaled_design is None:
            continue
        yield scaled_design
        types, count = scaled_design.types, len(scaled_design.types)
        if count < 2:
            continue
        # Some optima have many short runs, and a long run that determines drifts.
        for index in np.unique(indices, return_index=True)[1]:
            revolutions = scaled_design.revolutions.copy()
            revolutions[index] *= 3.0
            start = scale_to_time(Design(types, scaled_design.rate, revolutions), limits)
            if start is not None:
                yield start
        # Spread the rates, in case the relaxation has a single point in a flat optimum.
        spread_rates = np.geomspace(
            max(limits.rate_range[0], 0.5 * limits.rate_range[1]), limits.rate_range[1], count
        )
        if not limits.rate_settings:
            start = scale_to_time(Design(types, spread_rates, scaled_design.revolutions), limits)
            if start is not None:
                yield start


def _fastest_starts(limits: Limits) -> Iterator[Design]:
    """Yield starts at the highest rates, if the time is too short for the relaxed rates."""
    rate = np.array(limits.distinct_rates(limits.rate_range[1]))
    revolutions = np.full(rate.size, limits.min_revolutions)
    for run_type in dict.fromkeys(limits.types):
        start = scale_to_time(Design((run_type,) * rate.size, rate, revolutions), limits)
        if start is not None:
            yield start


def _round_by_largest_remainder(weights: Array, count: int) -> npt.NDArray[np.int64]:
    """Return integers proportional to the weights with the sum `count` (largest remainders)."""
    quotas = weights * (count / weights.sum())
    counts: npt.NDArray[np.int64] = np.floor(quotas).astype(np.int64)
    largest_remainders = np.argsort(-(quotas - counts), kind="stable")[: count - int(counts.sum())]
    counts[largest_remainders] += 1
    return counts


def _fill_empty_groups(weights: Array, counts: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the counts with at least 1 for each relevant group, taken from the largest groups."""
    new_counts = counts.copy()
    for index in np.flatnonzero((weights > _MIN_RUN_WEIGHT) & (counts == 0)):
        largest_group = int(np.argmax(new_counts))
        if new_counts[largest_group] > 1:
            new_counts[largest_group] -= 1
            new_counts[index] = 1
    return new_counts


def _polish_best(
    predictor: Predictor, limits: Limits, criterion: Criterion, starts: Sequence[Design]
) -> tuple[float, Design]:
    """Polish the most promising starts."""
    ranked_starts = sorted(starts, key=lambda design: predictor.value(criterion, design))
    polished_pairs = [
        polish_design(predictor, limits, criterion, design)
        for design in ranked_starts[:_MAX_POLISHED_DESIGNS]
    ]
    return min(polished_pairs, key=lambda pair: pair[0])


def _exchange_runs(
    predictor: Predictor, limits: Limits, criterion: Criterion, best_pair: tuple[float, Design]
) -> tuple[float, Design]:
    """Exchange, remove or add runs until the criterion no longer decreases."""
    for _ in range(_N_PASSES):
        value, design = best_pair
        scaled_designs = (
            scale_to_time(candidate, limits) for candidate in _neighbour_designs(design, limits)
        )
        candidates = sorted(
            (candidate for candidate in scaled_designs if candidate is not None),
            key=lambda candidate: predictor.value(criterion, candidate),
        )
        polished_pairs = (
            polish_design(predictor, limits, criterion, candidate)
            for candidate in candidates[:_MAX_POLISHED_DESIGNS]
        )
        improvement = next((pair for pair in polished_pairs if pair[0] < value - _MIN_GAIN), None)
        if improvement is None:
            return best_pair
        best_pair = improvement
    return best_pair


def _neighbour_designs(design: Design, limits: Limits) -> Iterator[Design]:
    """Yield the designs with one run changed; change only one of several equal runs."""
    visited_runs: list[tuple[RunType, float, float]] = []
    n = len(design.types)
    for index in range(n):
        run_type, rate = design.types[index], float(design.rate[index])
        revolutions = float(design.revolutions[index])
        if any(
            run_type == visited_type
            and abs(rate / visited_rate - 1.0) < _EQUAL_RUN_TOLERANCE
            and abs(revolutions / visited_revolutions - 1.0) < _EQUAL_RUN_TOLERANCE
            for visited_type, visited_rate, visited_revolutions in visited_runs
        ):
            continue
        visited_runs.append((run_type, rate, revolutions))
        for new_type in limits.types:
            if new_type != run_type:
                yield design.with_type(index, new_type)
        for setting in limits.rate_settings:
            if setting != rate:
                rates = design.rate.copy()
                rates[index] = setting
                new_revolutions = design.revolutions.copy()
                new_revolutions[index] *= setting / rate
                yield Design(design.types, rates, new_revolutions)
        if n > 1:
            yield design.without(index)
    if n < limits.max_runs:
        duration = float(np.median(design.duration))
        for run_type in limits.types:
            for rate in limits.rate_settings or limits.rate_range:
                revolutions = max(limits.min_revolutions, duration * rate / 6.3)
                addition = Design((run_type,), np.array([rate]), np.array([revolutions]))
                yield design.concatenate(addition)


def _order_runs(
    predictor: Predictor, criterion: Criterion, value: float, design: Design
) -> tuple[float, Design]:
    """Return the design with its runs in order of rate, or in a more informative order.

    With ascending rates in every other run and descending rates between them, a steady warming
    does not correlate with the rate.
    """
    sorted_design = _sort_runs(design)
    if not predictor.information.is_time_dependent:
        return value, sorted_design
    n = len(design.types)
    mirrored_design = sorted_design.select([*range(0, n, 2), *reversed(range(1, n, 2))])
    candidates = (sorted_design, mirrored_design, design)
    return min(
        ((predictor.value(criterion, candidate), candidate) for candidate in candidates),
        key=lambda pair: pair[0],
    )


def _sort_runs(design: Design) -> Design:
    """Return the runs sorted by first occurrence of their type, by rate and by length."""
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


def minimise_time(
    predictor: Predictor,
    limits: Limits,
    criterion: Criterion,
    *,
    relaxed_predictor: Predictor | None = None,
) -> Optimum[Design] | None:
    """Find the shortest plan in which u of each unknown of interest is at most its scale.

    Returns: None if no plan within the limits reaches the targets. The criterion's value and bound
        are logarithms of the time in s.
    """
    sum_criterion = replace(criterion, combination="sum")
    single_criteria = [
        Criterion((i,), (scale,))
        for i, scale in zip(sum_criterion.indices, sum_criterion.scales, strict=True)
    ]

    def worst_excess(design: Design) -> float:
        covariance = predictor.covariance(design.types, design.rate, design.revolutions)
        return max(float(target.value(covariance)) for target in single_criteria)

    design = optimise(predictor, limits, sum_criterion, relaxed_predictor=relaxed_predictor).design
    if worst_excess(design) > 0.0 and len(single_criteria) > 1:
        # Increase the weight of the worst parameter until all reach their targets.
        for _ in range(8):
            u_ratios = predictor.u(design)[list(sum_criterion.indices)] / np.array(criterion.scales)
            scales = np.array(sum_criterion.scales) / np.sqrt(u_ratios)
            sum_criterion = replace(sum_criterion, scales=tuple(float(scale) for scale in scales))
            _, design = polish_design(predictor, limits, sum_criterion, design)
            if worst_excess(design) <= 0.0:
                break
    if worst_excess(design) > 1e-9:
        return None
    bound = _lower_time_bound(
        relaxed_predictor or predictor, limits, replace(criterion, combination="sum")
    )
    best_design = find_shortest_plan(predictor, limits, single_criteria, design)
    time = bound
    for _ in range(4):
        optimum = optimise(
            predictor,
            replace(limits, total_time=max(time, limits.min_time)),
            sum_criterion,
            relaxed_predictor=relaxed_predictor,
        )
        candidate = find_shortest_plan(predictor, limits, single_criteria, optimum.design)
        if worst_excess(candidate) <= 1e-6 and limits.campaign_time(
            candidate
        ) < limits.campaign_time(best_design) * (1.0 - _MIN_GAIN):
            best_design = candidate
        time = 0.5 * (time + limits.campaign_time(best_design))
    _, best_design = _order_runs(
        predictor, sum_criterion, predictor.value(sum_criterion, best_design), best_design
    )
    return Optimum(best_design, math.log(limits.campaign_time(best_design)), math.log(bound))


def _lower_time_bound(predictor: Predictor, limits: Limits, criterion: Criterion) -> float:
    """Return a lower bound of the time of plans with a criterion of 0, by bisection."""
    low, high = math.log(limits.min_time), math.log(limits.total_time)
    for _ in range(10):
        log_time = 0.5 * (low + high)
        _, relaxed_optimum = relax_design(
            predictor, replace(limits, total_time=math.exp(log_time)), criterion
        )
        low, high = (log_time, high) if relaxed_optimum.bound > 0.0 else (low, log_time)
    return math.exp(low)


def polish_design(
    predictor: Predictor, limits: Limits, criterion: Criterion, design: Design
) -> tuple[float, Design]:
    """Optimise rates and lengths for fixed types of runs; return the criterion and the design."""
    variables = _Variables(limits, design)

    def objective(x: Array) -> tuple[float, Array]:
        value, rate_gradient, revolution_gradient = predictor.sensitivities(
            variables.design(x), criterion
        )
        return value, variables.join_gradients(rate_gradient, revolution_gradient)

    x = variables.solve(objective, [variables.time_margin])
    polished_design = _shorten_to_fit(variables.design(x), limits)
    candidates = [polished_design]
    if limits.campaign_time(design) <= limits.total_time * (1.0 + 1e-9):
        candidates.append(design)
    pairs = [(predictor.value(criterion, candidate), candidate) for candidate in candidates]
    return min(pairs, key=lambda pair: pair[0])


class _Variables:
    """Log rates (if free) and log revolutions as one vector, with bounds and time."""

    def __init__(self, limits: Limits, design: Design) -> None:
        self.limits = limits
        self.start = design
        self.n = len(design.types)
        self.has_free_rates = not limits.rate_settings and limits.rate_range[1] > limits.rate_range[
            0
        ] * (1.0 + 1e-9)
        self.distinct_runs = limits.distinct_rate_runs(design.rate) if limits.min_rates > 1 else []

    def design(self, x: Array) -> Design:
        rate = np.exp(x[: self.n]) if self.has_free_rates else self.start.rate
        return Design(self.start.types, np.asarray(rate), np.asarray(np.exp(x[-self.n :])))

    def join_gradients(self, rate_gradient: Array, revolution_gradient: Array) -> Array:
        if not self.has_free_rates:
            return revolution_gradient
        return np.concatenate([rate_gradient, revolution_gradient])

    def log_time(self, x: Array) -> tuple[float, Array]:
        """Return log(time / total time) and its gradient."""
        design = self.design(x)
        time = self.limits.campaign_time(design)
        rate_gradient = (-design.duration + self.limits.spin_up * design.rate) / time
        gradient = self.join_gradients(rate_gradient, design.duration / time)
        return math.log(time / self.limits.total_time), gradient

    def time_margin(self, x: Array) -> tuple[Array, Array]:
        value, gradient = self.log_time(x)
        return np.array([-value]), -gradient[None]

    def solve(
        self,
        objective: Callable[[Array], tuple[float, Array]],
        constraints: Sequence[Callable[[Array], tuple[Array, Array]]],
    ) -> Array:
        """Minimise by SLSQP; each constraint returns non-negative margins and their Jacobian."""
        from scipy.optimize import minimize

        limits, start = self.limits, self.start
        max_revolutions = limits.max_duration * limits.rate_range[1] / (2.0 * math.pi)
        revolution_bounds = (
            math.log(limits.min_revolutions),
            math.log(max(max_revolutions, limits.min_revolutions)),
        )
        rate_bounds = (math.log(limits.rate_range[0]), math.log(limits.rate_range[1]))
        bounds = [rate_bounds] * self.n * self.has_free_rates + [revolution_bounds] * self.n
        x = np.concatenate([np.log(start.rate)] * self.has_free_rates + [np.log(start.revolutions)])
        low, high = np.array(bounds).T
        all_constraints = [*constraints, self.length_margins]
        all_constraints += (
            [self.rate_ratio_margins] if self.has_free_rates and len(self.distinct_runs) > 1 else []
        )

        def constraint_values(x: Array) -> Array:
            return np.concatenate([constraint(x)[0] for constraint in all_constraints])

        def constraint_jacobian(x: Array) -> Array:
            return np.vstack([constraint(x)[1] for constraint in all_constraints])

        solution = minimize(
            objective,
            np.clip(x, low, high),
            jac=True,
            method="SLSQP",
            bounds=bounds,
            constraints={"type": "ineq", "fun": constraint_values, "jac": constraint_jacobian},
            options={"maxiter": 100, "ftol": 1e-8},
        )
        return np.asarray(np.clip(solution.x, low, high))

    def length_margins(self, x: Array) -> tuple[Array, Array]:
        """Return log(maximum / duration) of each record, and the Jacobian."""
        duration = self.design(x).duration
        identity = np.eye(self.n)
        return (
            np.log(self.limits.max_duration / duration),
            np.hstack([identity, -identity]) if self.has_free_rates else -identity,
        )

    def rate_ratio_margins(self, x: Array) -> tuple[Array, Array]:
        """Return log(ratio / minimum) of adjacent rates, and the Jacobian."""
        jacobian = np.zeros((len(self.distinct_runs) - 1, x.size))
        for row, (faster, slower) in enumerate(pairwise(self.distinct_runs)):
            jacobian[row, [faster, slower]] = 1.0, -1.0
        return jacobian @ x - math.log(self.limits.min_rate_ratio), jacobian


def _shorten_to_fit(design: Design, limits: Limits) -> Design:
    """Return the design, shortened if rounding made it exceed the total time."""
    if limits.campaign_time(design) <= limits.total_time:
        return design
    return scale_to_time(design, limits) or design


def find_shortest_plan(
    predictor: Predictor, limits: Limits, single_criteria: Sequence[Criterion], design: Design
) -> Design:
    """Return the shortest plan with the same types of runs that meets every target."""
    variables = _Variables(limits, design)

    def target_margins(x: Array) -> tuple[Array, Array]:
        trial = variables.design(x)
        margins, gradients = [], []
        for criterion in single_criteria:
            value, rate_gradient, revolution_gradient = predictor.sensitivities(trial, criterion)
            margins.append(-value)
            gradients.append(-variables.join_gradients(rate_gradient, revolution_gradient))
        return np.array(margins), np.array(gradients)

    return variables.design(variables.solve(variables.log_time, [target_margins]))
