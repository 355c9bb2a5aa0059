"""The best campaign within limits: whole runs, free rates and lengths.

From the relaxed optimum (`counterspin.planning.possibilities`) whole numbers of runs are made in
several ways; each start is improved in all rates and lengths at once (SLSQP, exact derivatives),
then by exchanging the attitude or sense of a run, leaving one out or adding one. The relaxation
says how far from any better plan the result can be.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.planning.design import Criterion, Design, Limits, Predictor, RunType
from counterspin.planning.polishing import brought_within, fitted_into, polish, shortest_plan
from counterspin.planning.possibilities import RelaxedOptimum, relax

#: Smallest relative gain of u (or of time) for which a plan is changed.
_GAIN: Final = 2e-5
#: Passes of exchanges, and how many candidates are polished in each.
_PASSES: Final = 3
_CANDIDATES_POLISHED: Final = 5
#: Weight, in runs, from which a group of the relaxation may get a whole run.
_WEIGHT_OF_A_RUN: Final = 0.02
#: Relative difference in rate and length below which the exchanges take two runs as equal.
_EQUAL_RUNS: Final = 1e-3


@frozen(eq=False)
class Optimum:
    """A plan and how good it is."""

    design: Design  #: The runs, longest last within each type.
    value: float  #: Its criterion, a logarithm.
    bound: float  #: What no plan within the limits can be below.

    @property
    def efficiency(self) -> float:
        """Smallest u that may be possible over the u of the plan; at most 1."""
        return math.exp(min(0.0, self.bound - self.value))


def optimise(
    predictor: Predictor,
    limits: Limits,
    criterion: Criterion,
    *,
    relaxing: Predictor | None = None,
    start: Design | None = None,
) -> Optimum:
    """Find the plan with the smallest criterion.

    relaxing: A predictor in which considered terms are estimated; None: there are none.
    """
    if not limits.possible:
        raise NotIdentifiableError(
            f"no run fits into {limits.total_time:.6g} s: the shortest takes "
            f"{limits.shortest:.6g} s with spin-up and settling"
        )
    choices = [
        (relax(relaxing or predictor, allowed, criterion), allowed) for allowed in _subsets(limits)
    ]
    choices.sort(key=lambda choice: choice[0].bound)
    best: tuple[float, Design] | None = None
    for relaxed, allowed in choices:
        if best is not None and relaxed.bound > best[0] - _GAIN:
            break  # nor can those that follow be better
        starts = list(_whole(relaxed, allowed))
        if start is not None and (near := brought_within(start, allowed)) is not None:
            starts = [near, *starts[:1]]
        if not starts:
            continue
        polished = _best_of(predictor, allowed, criterion, starts)
        exchanged = _exchange(predictor, allowed, criterion, polished)
        if best is None or exchanged[0] < best[0] - _GAIN:
            best = exchanged
    assert best is not None  # the choices hold one attitude alone, into which a run fits
    value, design = _in_order(predictor, criterion, *best)
    return Optimum(design, value, min(choices[0][0].bound, value))


def _subsets(limits: Limits) -> Iterator[Limits]:
    """Yield the limits for each choice of attitudes, the time to change between them taken off.

    If a change costs nothing, all attitudes together hold every choice.
    """
    attitudes = list(dict.fromkeys(run_type.attitude for run_type in limits.types))
    if limits.attitude_change == 0.0:
        yield limits
        return
    for count in range(1, len(attitudes) + 1):
        left = limits.total_time - (count - 1) * limits.attitude_change
        if left < limits.shortest or count > limits.runs:
            return
        for chosen in combinations(attitudes, count):
            yield replace(
                limits,
                types=tuple(run_type for run_type in limits.types if run_type.attitude in chosen),
                total_time=left,
                attitude_change=0.0,
            )


def _whole(relaxed: RelaxedOptimum, limits: Limits) -> Iterator[Design]:
    """Yield starts: whole runs in place of the relaxation's weights."""
    groups: dict[tuple[RunType, float], list[int]] = {}
    found = relaxed.support
    for index, (run_type, w) in enumerate(zip(found.types, found.rate, strict=True)):
        near = float(w) if limits.settings else float(round(8.0 * math.log(w)))
        groups.setdefault((run_type, near), []).append(index)
    weight = np.array([relaxed.weight[index].sum() for index in groups.values()])
    run_types = [run_type for run_type, _ in groups]
    rate = np.array([found.rate[i[np.argmax(relaxed.weight[i])]] for i in groups.values()])
    turns = np.array(
        [np.average(found.revolutions[i], weights=relaxed.weight[i]) for i in groups.values()]
    )
    total = float(weight.sum())
    totals = {min(limits.runs, max(1, n)) for n in (math.floor(total), math.ceil(total))}
    totals |= {limits.runs} if relaxed.price_run > 0.0 else set()
    shares = [_share(weight, count) for count in sorted(totals, reverse=True)]
    # A group that gets parts of a run may be what tells terms apart: then it needs a whole one.
    shares += [_at_least_one(weight, share) for share in shares]
    for runs in shares:
        count = int(runs.sum())
        chosen = np.repeat(np.arange(weight.size), runs)
        types = tuple(run_types[i] for i in chosen)
        # As much time in each group as the relaxation spends there.
        even = fitted_into(
            Design(types, rate[chosen], (turns * weight / np.maximum(runs, 1))[chosen]), limits
        )
        if even is None:
            continue
        yield even
        types, count = even.types, len(even.types)
        if count < 2:
            continue
        # Some optima have one long run that finds what drifts and many short ones.
        for index in np.unique(chosen, return_index=True)[1]:
            longer = even.revolutions.copy()
            longer[index] *= 3.0
            fitted = fitted_into(Design(types, even.rate, longer), limits)
            if fitted is not None:
                yield fitted
        # Rates apart, in case the relaxation has put all runs into one point of a flat optimum.
        spread = np.geomspace(max(limits.rate[0], 0.5 * limits.rate[1]), limits.rate[1], count)
        if not limits.settings:
            fitted = fitted_into(Design(types, spread, even.revolutions), limits)
            if fitted is not None:
                yield fitted


def _share(weight: Array, count: int) -> npt.NDArray[np.int64]:
    """Return whole numbers of a given sum nearest to proportional (largest remainders)."""
    exact = weight * (count / weight.sum())
    whole: npt.NDArray[np.int64] = np.floor(exact).astype(np.int64)
    rest = np.argsort(-(exact - whole), kind="stable")[: count - int(whole.sum())]
    whole[rest] += 1
    return whole


def _at_least_one(weight: Array, runs: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the runs with one for each group of some weight, taken from the largest groups."""
    changed = runs.copy()
    for index in np.flatnonzero((weight > _WEIGHT_OF_A_RUN) & (runs == 0)):
        largest = int(np.argmax(changed))
        if changed[largest] > 1:
            changed[largest] -= 1
            changed[index] = 1
    return changed


def _best_of(
    predictor: Predictor, limits: Limits, criterion: Criterion, starts: Sequence[Design]
) -> tuple[float, Design]:
    """Polish the most promising starts."""
    ranked = sorted(starts, key=lambda design: predictor.value(criterion, design))
    polished = [
        polish(predictor, limits, criterion, design) for design in ranked[:_CANDIDATES_POLISHED]
    ]
    return min(polished, key=lambda pair: pair[0])


def _exchange(
    predictor: Predictor, limits: Limits, criterion: Criterion, best: tuple[float, Design]
) -> tuple[float, Design]:
    """Exchange, leave out or add runs for as long as it gains."""
    for _ in range(_PASSES):
        value, design = best
        fitted = (fitted_into(other, limits) for other in _neighbours(design, limits))
        candidates = sorted(
            (other for other in fitted if other is not None),
            key=lambda other: predictor.value(criterion, other),
        )
        polished = (
            polish(predictor, limits, criterion, other)
            for other in candidates[:_CANDIDATES_POLISHED]
        )
        better = next((pair for pair in polished if pair[0] < value - _GAIN), None)
        if better is None:
            return best
        best = better
    return best


def _neighbours(design: Design, limits: Limits) -> Iterator[Design]:
    """Yield the designs with one run changed; of runs that are alike, only one is."""
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
        for other in limits.types:
            if other != run_type:
                yield design.with_type(index, other)
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
                yield design.joined(Design((run_type,), np.array([rate]), np.array([turns])))


def _in_order(
    predictor: Predictor, criterion: Criterion, value: float, design: Design
) -> tuple[float, Design]:
    """Return the design with its runs in order of rate, or in what order tells more, if one does.

    Up with every other run and down with the rest, a steady warming looks like no rate.
    """
    ordered = _ordered(design)
    if not predictor.information.dated:
        return value, ordered
    n = len(design.types)
    mirrored = ordered.taken([*range(0, n, 2), *reversed(range(1, n, 2))])
    tried = (ordered, mirrored, design)
    return min(((predictor.value(criterion, one), one) for one in tried), key=lambda pair: pair[0])


def _ordered(design: Design) -> Design:
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
    return design.taken(order)


def least_time(
    predictor: Predictor,
    limits: Limits,
    criterion: Criterion,
    *,
    relaxing: Predictor | None = None,
) -> Optimum | None:
    """Find the shortest plan in which u of each unknown of interest is at most its scale.

    Returns: none if no plan within the limits reaches the targets. The criterion's value and bound
        are logarithms of the time in s.
    """
    targets = replace(criterion, combination="sum")
    singles = [Criterion((i,), (s,)) for i, s in zip(targets.places, targets.scales, strict=True)]

    def misses(design: Design) -> float:
        covariance = predictor.covariance(design.types, design.rate, design.revolutions)
        return max(float(single.value(covariance)) for single in singles)

    design = optimise(predictor, limits, targets, relaxing=relaxing).design
    if misses(design) > 0.0 and len(singles) > 1:
        # The mean hides the worst: give it more weight until all are below their targets.
        for _ in range(8):
            ratio = predictor.u(design)[list(targets.places)] / np.array(criterion.scales)
            scales = np.array(targets.scales) / np.sqrt(ratio)
            targets = replace(targets, scales=tuple(float(s) for s in scales))
            _, design = polish(predictor, limits, targets, design)
            if misses(design) <= 0.0:
                break
    if misses(design) > 1e-9:
        return None
    bound = _relaxed_time(relaxing or predictor, limits, replace(criterion, combination="sum"))
    best = shortest_plan(predictor, limits, singles, design)
    time = bound
    for _ in range(4):
        tried = optimise(
            predictor,
            replace(limits, total_time=max(time, limits.shortest)),
            targets,
            relaxing=relaxing,
        )
        shorter = shortest_plan(predictor, limits, singles, tried.design)
        if misses(shorter) <= 1e-6 and limits.time(shorter) < limits.time(best) * (1.0 - _GAIN):
            best = shorter
        time = 0.5 * (time + limits.time(best))
    _, best = _in_order(predictor, targets, predictor.value(targets, best), best)
    return Optimum(best, math.log(limits.time(best)), math.log(bound))


def _relaxed_time(predictor: Predictor, limits: Limits, criterion: Criterion) -> float:
    """Return a time below which no plan reaches a criterion of 0, by bisection."""
    low, high = math.log(limits.shortest), math.log(limits.total_time)
    for _ in range(10):
        middle = 0.5 * (low + high)
        bound = relax(predictor, replace(limits, total_time=math.exp(middle)), criterion).bound
        low, high = (middle, high) if bound > 0.0 else (low, middle)
    return math.exp(low)
