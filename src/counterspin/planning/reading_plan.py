"""A plan of readings: which positions and rates, how often, and in which order.

The relaxation in which the numbers need not be whole is convex (`planning.candidate_set`). It is
rounded, and one reading after another is exchanged for a better one for as long as it gains.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.calibration.model import make_unknowns
from counterspin.campaign.description import Campaign
from counterspin.errors import CounterspinError, NotIdentifiableError
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.least_squares import Block
from counterspin.inference.priors import prior_correlation, whiten_priors
from counterspin.planning.candidate_set import CandidateSet, Optimum
from counterspin.planning.design import Criterion
from counterspin.planning.forecast import Forecast, expected_values, forecast
from counterspin.planning.limits import GAIN, RELAXATION
from counterspin.planning.result import (
    LimitResult,
    OtherPlan,
    PlanResult,
    other_plan,
    planned_readings,
    result_of,
)
from counterspin.planning.search import not_determined, words_of_missed_target
from counterspin.planning.stations import PossibleReading, ReadingPlan
from counterspin.readings.entries import MOST_READINGS
from counterspin.readings.groups import group_readings
from counterspin.readings.known_attitudes import Readings
from counterspin.readings.linear import rows_at
from counterspin.triads.groups import group_poses
from counterspin.triads.poses import TriadPoses

Counts = npt.NDArray[np.int64]

#: Smallest relative gain of u for which readings are exchanged, and the largest number of them.
_MIN_GAIN: Final = 1e-9
_MAX_EXCHANGES: Final = 400

#: Of at most so many possible readings the search begins from so many drawn numbers too.
_MAX_DRAWN_CANDIDATES: Final = 60
_DRAWS: Final = 6
#: Of so few readings that exchanges of one end in many places it begins from so many.
_SMALL_NUMBER: Final = 12
_DRAWS_SMALL_NUMBER: Final = 60
_SEED_OF_ROUNDING: Final = 1

#: A target is reached to rounding.
_ROUNDING: Final = 1e-9

#: Steps of the search for the least limit.
_BISECTIONS: Final = 12


def best_counts(
    candidates: CandidateSet, criterion: Criterion, max_count: float, time: float
) -> Optimum[Counts]:
    """Return the numbers with the smallest criterion.

    max_count, time: Largest sum of the numbers and of their times, s; one of them finite.
    """
    relaxed = candidates.relax(criterion, max_count, time)
    visited_keys: set[bytes] = set()
    results = [
        _exchange_readings(candidates, criterion, start, max_count, time, visited_keys)
        for start in _initial_counts(candidates, relaxed.design, max_count, time)
    ]
    value, counts = min(results, key=lambda end: end[0])
    return Optimum(counts, value, min(relaxed.bound, value))


def _initial_counts(
    candidates: CandidateSet, weight: Array, max_count: float, time: float
) -> list[Counts]:
    """Return numbers from which to exchange: some ends are worse than others.

    weight: The numbers that need not be whole, shape (n,).
    """
    rounded = np.floor(weight + 1e-6).astype(np.int64)
    draws = _DRAWS_SMALL_NUMBER if max_count <= _SMALL_NUMBER else _DRAWS
    rng, draws = (
        np.random.default_rng(_SEED_OF_ROUNDING),
        draws if weight.size <= _MAX_DRAWN_CANDIDATES else 0,
    )
    # Rounded; nothing, to which the best is added one by one; and drawn about the first.
    starts = [rounded.copy(), np.zeros_like(rounded), *(rounded.copy() for _ in range(draws))]
    for counts in (starts[0], *starts[2:]):
        remainders = (
            weight - rounded + (0.0 if counts is starts[0] else rng.uniform(size=weight.size))
        )
        for index in np.argsort(-remainders, kind="stable"):
            counts[index] += _allows_addition(candidates, counts, max_count, time)[index]
    return starts


def _exchange_readings(
    candidates: CandidateSet,
    criterion: Criterion,
    counts: Counts,
    max_count: float,
    time: float,
    visited_keys: set[bytes],
) -> tuple[float, Counts]:
    """Return the criterion and the numbers where no exchange of one reading gains any more.

    visited_keys: Counts that were reached from earlier starts. The search ends there, because their
        end is known; it adds the numbers that it reaches.
    """
    value = float(candidates.value(criterion, counts))
    for _ in range(_MAX_EXCHANGES):
        if counts.tobytes() in visited_keys:
            break
        visited_keys.add(counts.tobytes())
        lowest, best_counts = math.inf, counts
        for removed in (None, *np.flatnonzero(counts)):
            candidate = counts.copy()
            is_allowed = np.ones(counts.size, dtype=np.bool_)
            if removed is not None:
                candidate[removed] -= 1
                is_allowed[removed] = False
            is_allowed &= _allows_addition(candidates, candidate, max_count, time)
            if not is_allowed.any():
                continue
            values = np.where(
                is_allowed, candidates.values_with_addition(criterion, candidate), math.inf
            )
            best_index = int(np.argmin(values))
            if values[best_index] < lowest:
                lowest, best_counts = float(values[best_index]), candidate
                best_counts[best_index] += 1
        new_value = float(candidates.value(criterion, best_counts))
        if not new_value < value - _MIN_GAIN:
            break
        value, counts = new_value, best_counts
    return value, counts


def _allows_addition(
    candidates: CandidateSet, counts: Counts, max_count: float, time: float
) -> npt.NDArray[np.bool_]:
    """Return a mask of the observations that the limits allow once more, shape (n,)."""
    total_cost = float(candidates.cost @ counts) + candidates.cost
    return np.asarray(
        (float(counts.sum()) + 1.0 <= max_count) & (total_cost <= time * (1.0 + 1e-12))
    )


def least_counts(
    candidates: CandidateSet,
    criterion: Criterion,
    max_count: float,
    time: float,
    u_of: Callable[[Counts], Array],
) -> tuple[Optimum[Counts], float] | None:
    """Return the fewest readings, or the least time, with which every u is at most its scale.

    u_of: The forecast u of all unknowns of the criterion, in its order: effects of time make u
        larger than in `CandidateSet`.
    Returns: the choice; the part of the limit below which none can be. None if all of the limit
        does not suffice.
    """
    scales = np.array(criterion.scales)

    def meets_targets(chosen: Optimum[Counts]) -> bool:
        variance = np.diag(candidates.covariance(chosen.design))[list(criterion.indices)]
        is_met_by_search = bool(np.all(np.sqrt(variance) <= scales * (1.0 + _ROUNDING)))
        return is_met_by_search and bool(np.all(u_of(chosen.design) <= scales * (1.0 + _ROUNDING)))

    def limits(fraction: float) -> tuple[float, float] | None:
        if math.isfinite(time):
            return (
                (max_count, fraction * time)
                if fraction * time >= float(candidates.cost.min())
                else None
            )
        return (
            (count_limit, time)
            if (count_limit := math.floor(fraction * max_count + 1e-9))
            else None
        )

    optimum = best_counts(candidates, criterion, max_count, time)
    if not meets_targets(optimum):
        return None
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        scaled_limits = limits(middle)
        chosen = (
            None if scaled_limits is None else best_counts(candidates, criterion, *scaled_limits)
        )
        if chosen is not None and meets_targets(chosen):
            optimum, high = chosen, middle
        else:
            low = middle
    floor = 0.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (floor + high)
        scaled_limits = limits(middle)
        if scaled_limits is None or candidates.relax(criterion, *scaled_limits).bound > 0.0:
            floor = middle
        else:
            high = middle
    return optimum, floor


#: Seed of the random order; the campaign's file has the order itself.
_SEED: Final = 1


class ReadingSearch:
    """A plan's problem: which of the possible readings to take, and how often."""

    def __init__(self, plan: ReadingPlan) -> None:
        self.plan = plan
        self.limits = (plan.readings, plan.total_time)
        model = make_unknowns(plan.template)
        self.candidates = _candidate_set(plan, model)
        self.criterion = plan.goal.criterion_of([unknown.name for unknown in model.unknowns])

    def best(self) -> tuple[PlanResult, list[PossibleReading]]:
        """Find the readings for the plan's goal."""
        self._require_determined()
        optimum, least_fraction = self._optimum()
        prediction, cost = self.forecast(optimum.design), self.candidates.cost
        if least_fraction is None:
            # From the reported uncertainties: the search omits effects of time.
            names = [unknown.name for unknown in prediction.fit.model.unknowns]
            criterion = self.plan.goal.criterion_of(names)
            value = float(criterion.value(prediction.fit.solution.covariance))
            efficiency = math.exp(optimum.bound - value)
        elif math.isfinite(self.plan.total_time):
            efficiency = least_fraction * self.plan.total_time / float(cost @ optimum.design)
        else:
            efficiency = least_fraction * self.plan.readings / float(optimum.design.sum())
        fields = {
            "readings": planned_readings(_new_readings(self.plan, prediction.campaign)),
            "order": self.plan.order,
            "goal": self.plan.goal.met(min(1.0, efficiency)),
            "others": self._comparison_plans(optimum, prediction),
            "limits": self._active_limits(optimum),
        }
        result = result_of(prediction, None, float(cost @ optimum.design))
        return result.model_copy(update=fields), self._ordered_readings(optimum.design)

    def forecast(self, counts: Counts) -> Forecast:
        """Return the forecast of the campaign with these readings."""
        return _forecast_readings(self.plan, self._ordered_readings(counts))

    def _ordered_readings(self, counts: Counts) -> list[PossibleReading]:
        """Return readings in the order in which to take them; refused if they are too many."""
        if counts.sum() > MOST_READINGS:
            raise CounterspinError(
                f"{self.plan.path}: limits.total_time leaves time for {counts.sum():.3g} "
                f"readings, but a campaign may have at most {MOST_READINGS}; give "
                "limits.readings, or reduce the time",
                code="too-many-rows",
            )
        return [self.plan.candidates[index] for index in measurement_order(counts, self.plan.order)]

    def _require_determined(self) -> None:
        """Refuse a goal that all possible readings together do not determine."""
        assessment = _forecast_readings(self.plan, self.plan.candidates * 4).assessment
        by = "any number of these readings"
        missing_names, text = not_determined(assessment, self.plan.goal.sizes, by)
        if not missing_names:
            return
        if text.endswith(by) and all(r.motion == "static" for r in self.plan.template.readings):
            text += ", because at 1 g the squares of the specific force components add up to one"
        raise NotIdentifiableError(
            text + ". Allow other stations, such as an arm or other axes, or state priors for the "
            "other terms in [model.priors]."
        )

    def _optimum(self) -> tuple[Optimum[Counts], float | None]:
        """Return the readings, and for a target the part of the limit that it needs."""
        goal = self.plan.goal
        if goal.kind == "minimise":
            return best_counts(self.candidates, self.criterion, *self.limits), None

        def u_of(counts: Counts) -> Array:
            u = self.forecast(counts).u
            return np.array([u[name] for name in goal.sizes])

        optimum = least_counts(self.candidates, self.criterion, *self.limits, u_of)
        if optimum is not None:
            return optimum
        best_numbers = best_counts(self.candidates, self.criterion, *self.limits).design
        text = words_of_missed_target(
            self.forecast(best_numbers),
            goal.sizes,
            "no choice of readings within the limits",
            f"The best choice of {best_numbers.sum()} readings",
        )
        raise CounterspinError(text + ".", code="goal-not-reached")

    def _comparison_plans(self, optimum: Optimum[Counts], prediction: Forecast) -> list[OtherPlan]:
        """Return the plan that takes every possible reading equally often, or nearly."""
        size, number = optimum.design.size, int(optimum.design.sum())
        spread = np.floor(np.arange(number) * size / number).astype(np.int64)
        counts = np.bincount(spread, minlength=size)
        expected = self.forecast(counts)
        if not all(expected.assessment.determined[name] for name in self.plan.goal.sizes):
            return []
        often = "every reading equally often"
        text = often if number % size == 0 else "same number of readings, distributed evenly"
        time = float(self.candidates.cost @ counts)
        return [other_plan(text, time, prediction.u, expected.u, self.plan.goal.sizes)]

    def _active_limits(self, optimum: Optimum[Counts]) -> list[LimitResult]:
        """Return the gain from a tenth more of each limit; empty for a plan for a target."""
        if self.plan.goal.kind == "target":
            return []
        max_count, time = self.limits
        factor = 1.0 + RELAXATION
        relaxed = {
            "readings": (
                f"at most {max_count:.0f} readings",
                max_count,
                (np.ceil(max_count * factor), time),
            ),
            "total_time": (f"total time {time:.6g} s", time, (max_count, time * factor)),
        }
        lines = []
        for key, (text, limit, limits) in relaxed.items():
            if math.isfinite(limit):
                relaxed_value = best_counts(self.candidates, self.criterion, *limits).value
                gain = 1.0 - math.exp(relaxed_value - optimum.value)
                lines.append(LimitResult(key=key, words=text, binds=gain > GAIN, gain=gain))
        return [line for line in lines if line.binds]


def _candidate_set(plan: ReadingPlan, model: Unknowns) -> CandidateSet:
    """Return the information of each possible reading, and of the existing observations."""
    campaign = plan.template
    expected = expected_values(campaign, model.unknowns)
    names = [reading.name for reading in plan.candidates]
    accelerometers = list(campaign.accelerometers)
    readings = [r for r in campaign.readings if r.name in names]
    poses = campaign.triad.poses if campaign.triad else ()
    poses = tuple(pose for pose in poses if pose[0].name in names)
    groups: list[Readings | TriadPoses] = [
        *group_readings(campaign, readings),
        *group_poses(campaign, poses),
    ]
    p, q = len(model.unknowns), len(model.considered)
    design = np.zeros((len(names), len(accelerometers), p))
    fixed = np.zeros((len(names), len(accelerometers), q))
    for group, (design_rows, considered_rows) in zip(
        groups, rows_at(groups, model, expected), strict=True
    ):
        indices = [names.index(name) for name in group.names]
        # All three accelerometers of a pose together tell one thing.
        row = 0 if isinstance(group, TriadPoses) else accelerometers.index(group.accelerometer)
        design[indices, row], fixed[indices, row] = design_rows, considered_rows
    blocks = _existing_blocks(plan, model, expected)
    prior_sds = np.array([unknown.prior_sd for unknown in model.unknowns])
    priors = whiten_priors(np.eye(p), prior_sds, prior_correlation(model.unknowns))
    sizes = np.array(model.considered_sds)
    return CandidateSet(
        design,
        fixed * sizes,
        np.vstack([*(block.factor for block in blocks), priors]),
        np.vstack([*(block.considered * sizes for block in blocks), np.zeros((p, q))]),
        np.array([reading.time for reading in plan.candidates]),
    )


def _existing_blocks(plan: ReadingPlan, model: Unknowns, expected: Array) -> Sequence[Block]:
    """Return the information of the existing observations of the campaign."""
    if not plan.taken:
        return ()
    rate, campaign = plan.sampling_rate, plan.campaign_as_it_is()
    return forecast(campaign, sampling_rate=rate, model=model, expected=expected).fit.blocks


def _new_readings(plan: ReadingPlan, campaign: Campaign) -> Campaign:
    """Return a planned campaign with the readings alone that are still to be taken."""
    before = len(plan.campaign_as_it_is().readings)
    triad = campaign.triad
    if triad is not None:
        triad = replace(triad, poses=triad.poses[len(plan.poses) :])
    return replace(campaign, readings=campaign.readings[before:], triad=triad)


def _forecast_readings(plan: ReadingPlan, readings: Sequence[PossibleReading]) -> Forecast:
    """Return the forecast of a campaign with these readings."""
    return forecast(plan.campaign(readings), sampling_rate=plan.sampling_rate)


def measurement_order(counts: Counts, order: str) -> list[int]:
    """Return the possible readings in the order in which to take them.

    counts: How often each is taken, shape (n,).
    """
    if order == "listed":
        return [int(index) for index in np.repeat(np.arange(counts.size), counts)]
    if order == "random":
        everything = np.repeat(np.arange(counts.size), counts)
        return [int(i) for i in np.random.default_rng(_SEED).permutation(everything)]
    # Pairs about the middle; an odd reading is in the middle.
    half: list[int] = []
    remaining = counts // 2
    forward = True
    while remaining.any():
        indices = np.flatnonzero(remaining)
        half += [int(i) for i in (indices if forward else indices[::-1])]
        remaining = remaining - (remaining > 0)
        forward = not forward
    middle = [int(index) for index in np.flatnonzero(counts % 2)]
    return [*half, *middle, *reversed(half)]
