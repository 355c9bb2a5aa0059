"""Plan of readings: their positions and rates, their counts and their order.

The relaxation with real counts is convex (`planning.candidate_set`). Its solution is rounded, and
readings are exchanged one at a time until the criterion no longer decreases.
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
from counterspin.planning.limits import MIN_GAIN, RELAXATION_FRACTION
from counterspin.planning.result import (
    LimitResult,
    OtherPlan,
    PlanResult,
    compare_plan,
    make_plan_result,
    planned_readings,
)
from counterspin.planning.search import describe_missed_target, describe_undetermined
from counterspin.planning.stations import CandidateReading, ReadingPlan
from counterspin.readings.entries import MAX_READINGS
from counterspin.readings.groups import group_readings
from counterspin.readings.known_attitudes import Readings
from counterspin.readings.linear import rows_at
from counterspin.triads.groups import group_poses
from counterspin.triads.poses import TriadPoses

Counts = npt.NDArray[np.int64]

#: Minimum relative gain of u of an exchange, and maximum number of exchanges.
_MIN_GAIN: Final = 1e-9
_MAX_EXCHANGES: Final = 400

#: Number of random starts, if the candidates are at most `_MAX_CANDIDATES_RANDOM_STARTS`.
_MAX_CANDIDATES_RANDOM_STARTS: Final = 60
_N_RANDOM_STARTS: Final = 6
#: Number of random starts for at most `_SMALL_COUNT` readings, which have more local optima.
_SMALL_COUNT: Final = 12
_N_SMALL_PLAN_STARTS: Final = 60
_ROUNDING_SEED: Final = 1

#: Relative tolerance of a target.
_RELATIVE_TOLERANCE: Final = 1e-9

#: Number of bisections in the search for the least limit.
_N_BISECTIONS: Final = 12


def best_counts(
    candidates: CandidateSet, criterion: Criterion, max_count: float, max_time: float
) -> Optimum[Counts]:
    """Return the counts with the smallest criterion.

    max_count, max_time: Maximum sum of the counts and of their times, s; one must be finite.
    """
    relaxed_optimum = candidates.relax(criterion, max_count, max_time)
    visited_keys: set[bytes] = set()
    results = [
        _exchange_readings(candidates, criterion, start, max_count, max_time, visited_keys)
        for start in _initial_counts(candidates, relaxed_optimum.design, max_count, max_time)
    ]
    value, counts = min(results, key=lambda result: result[0])
    return Optimum(counts, value, min(relaxed_optimum.bound, value))


def _initial_counts(
    candidates: CandidateSet, weights: Array, max_count: float, max_time: float
) -> list[Counts]:
    """Return several initial counts for the exchanges, which end in local optima.

    weights: Relaxed counts, shape (n,).
    """
    rounded_weights = np.floor(weights + 1e-6).astype(np.int64)
    n_random_starts = _N_SMALL_PLAN_STARTS if max_count <= _SMALL_COUNT else _N_RANDOM_STARTS
    if weights.size > _MAX_CANDIDATES_RANDOM_STARTS:
        n_random_starts = 0
    rng = np.random.default_rng(_ROUNDING_SEED)
    # Rounded counts; zeros, to which exchanges add readings one by one; random rounding.
    starts = [
        rounded_weights.copy(),
        np.zeros_like(rounded_weights),
        *(rounded_weights.copy() for _ in range(n_random_starts)),
    ]
    for counts in (starts[0], *starts[2:]):
        noise: Array | float = 0.0 if counts is starts[0] else rng.uniform(size=weights.size)
        remainders = weights - rounded_weights + noise
        for index in np.argsort(-remainders, kind="stable"):
            counts[index] += _allows_addition(candidates, counts, max_count, max_time)[index]
    return starts


def _exchange_readings(
    candidates: CandidateSet,
    criterion: Criterion,
    counts: Counts,
    max_count: float,
    max_time: float,
    visited_keys: set[bytes],
) -> tuple[float, Counts]:
    """Return the criterion and counts at a local optimum with respect to single exchanges.

    visited_keys: Counts that earlier starts reached, where the search stops, because the local
        optimum is known. The search adds the counts that it reaches.
    """
    value = float(candidates.value(criterion, counts))
    for _ in range(_MAX_EXCHANGES):
        if counts.tobytes() in visited_keys:
            break
        visited_keys.add(counts.tobytes())
        lowest_value, best_candidate = math.inf, counts
        for removed_index in (None, *np.flatnonzero(counts)):
            candidate_counts = counts.copy()
            is_allowed = np.ones(counts.size, dtype=np.bool_)
            if removed_index is not None:
                candidate_counts[removed_index] -= 1
                is_allowed[removed_index] = False
            is_allowed &= _allows_addition(candidates, candidate_counts, max_count, max_time)
            if not is_allowed.any():
                continue
            values = np.where(
                is_allowed, candidates.values_with_addition(criterion, candidate_counts), math.inf
            )
            best_index = int(np.argmin(values))
            if values[best_index] < lowest_value:
                lowest_value, best_candidate = float(values[best_index]), candidate_counts
                best_candidate[best_index] += 1
        new_value = float(candidates.value(criterion, best_candidate))
        if not new_value < value - _MIN_GAIN:
            break
        value, counts = new_value, best_candidate
    return value, counts


def _allows_addition(
    candidates: CandidateSet, counts: Counts, max_count: float, max_time: float
) -> npt.NDArray[np.bool_]:
    """Return a mask of the candidates that can be added within the limits, shape (n,)."""
    time = float(candidates.cost @ counts) + candidates.cost
    return np.asarray((float(counts.sum()) + 1.0 <= max_count) & (time <= max_time * (1.0 + 1e-12)))


def least_counts(
    candidates: CandidateSet,
    criterion: Criterion,
    max_count: float,
    max_time: float,
    forecast_u: Callable[[Counts], Array],
) -> tuple[Optimum[Counts], float] | None:
    """Return the fewest readings, or the least time, with which every u is at most its scale.

    forecast_u: Function that returns the forecast u of the parameters of the criterion. Effects of
        time make u larger than in `CandidateSet`.
    Returns: the optimum, and a lower bound of the required fraction of the limit. None if the
        limit does not suffice.
    """
    scales = np.array(criterion.scales)

    def meets_targets(optimum: Optimum[Counts]) -> bool:
        variance = np.diag(candidates.covariance(optimum.design))[list(criterion.indices)]
        is_met_by_search = bool(np.all(np.sqrt(variance) <= scales * (1.0 + _RELATIVE_TOLERANCE)))
        return is_met_by_search and bool(
            np.all(forecast_u(optimum.design) <= scales * (1.0 + _RELATIVE_TOLERANCE))
        )

    def scale_limits(fraction: float) -> tuple[float, float] | None:
        if math.isfinite(max_time):
            time = fraction * max_time
            return (max_count, time) if time >= float(candidates.cost.min()) else None
        count = math.floor(fraction * max_count + 1e-9)
        return (count, max_time) if count else None

    optimum = best_counts(candidates, criterion, max_count, max_time)
    if not meets_targets(optimum):
        return None
    low, high = 0.0, 1.0
    for _ in range(_N_BISECTIONS):
        middle = 0.5 * (low + high)
        limits = scale_limits(middle)
        candidate = None if limits is None else best_counts(candidates, criterion, *limits)
        if candidate is not None and meets_targets(candidate):
            optimum, high = candidate, middle
        else:
            low = middle
    lower_bound = 0.0
    for _ in range(_N_BISECTIONS):
        middle = 0.5 * (lower_bound + high)
        limits = scale_limits(middle)
        if limits is None or candidates.relax(criterion, *limits).bound > 0.0:
            lower_bound = middle
        else:
            high = middle
    return optimum, lower_bound


#: Seed of the random order.
_ORDER_SEED: Final = 1


class ReadingSearch:
    """Search for the optimal count of each candidate reading."""

    def __init__(self, plan: ReadingPlan) -> None:
        self.plan = plan
        self.limits = (plan.max_readings, plan.total_time)
        model = make_unknowns(plan.template)
        self.candidates = _make_candidate_set(plan, model)
        self.criterion = plan.goal.make_criterion([unknown.name for unknown in model.unknowns])

    def find_plan(self) -> tuple[PlanResult, list[CandidateReading]]:
        """Find the readings for the plan's goal."""
        self._require_determined()
        optimum, least_fraction = self._find_optimum()
        prediction, cost = self.forecast(optimum.design), self.candidates.cost
        if least_fraction is None:
            # The forecast includes effects of time, which the search neglects.
            names = [unknown.name for unknown in prediction.fit.model.unknowns]
            criterion = self.plan.goal.make_criterion(names)
            value = float(criterion.value(prediction.fit.solution.covariance))
            efficiency = math.exp(optimum.bound - value)
        elif math.isfinite(self.plan.total_time):
            efficiency = least_fraction * self.plan.total_time / float(cost @ optimum.design)
        else:
            efficiency = least_fraction * self.plan.max_readings / float(optimum.design.sum())
        fields = {
            "readings": planned_readings(_select_new_readings(self.plan, prediction.campaign)),
            "order": self.plan.order,
            "goal": self.plan.goal.with_efficiency(min(1.0, efficiency)),
            "others": self._comparison_plans(optimum, prediction),
            "limits": self._active_limits(optimum),
        }
        result = make_plan_result(prediction, None, float(cost @ optimum.design))
        return result.model_copy(update=fields), self._order_readings(optimum.design)

    def forecast(self, counts: Counts) -> Forecast:
        """Return the forecast of the campaign with these counts."""
        return _forecast_readings(self.plan, self._order_readings(counts))

    def _order_readings(self, counts: Counts) -> list[CandidateReading]:
        """Return the readings in measurement order; refuse too many readings."""
        if counts.sum() > MAX_READINGS:
            raise CounterspinError(
                f"{self.plan.path}: limits.total_time leaves time for {counts.sum():.3g} "
                f"readings, but a campaign may have at most {MAX_READINGS}; give "
                "limits.readings, or reduce the time",
                code="too-many-rows",
            )
        return [self.plan.candidates[index] for index in order_readings(counts, self.plan.order)]

    def _require_determined(self) -> None:
        """Refuse a goal that all candidate readings together do not determine."""
        assessment = _forecast_readings(self.plan, self.plan.candidates * 4).assessment
        data_text = "any number of these readings"
        missing_names, text = describe_undetermined(assessment, self.plan.goal.sizes, data_text)
        if not missing_names:
            return
        if text.endswith(data_text) and all(
            reading.motion == "static" for reading in self.plan.template.readings
        ):
            text += ", because at 1 g the squares of the specific force components add up to one"
        raise NotIdentifiableError(
            text + ". Allow other stations, such as an arm or other axes, or state priors for the "
            "other terms in [model.priors]."
        )

    def _find_optimum(self) -> tuple[Optimum[Counts], float | None]:
        """Return the optimum, and for a target the lower bound of the required limit fraction."""
        goal = self.plan.goal
        if goal.kind == "minimise":
            return best_counts(self.candidates, self.criterion, *self.limits), None

        def forecast_u(counts: Counts) -> Array:
            u = self.forecast(counts).u
            return np.array([u[name] for name in goal.sizes])

        optimum = least_counts(self.candidates, self.criterion, *self.limits, forecast_u)
        if optimum is not None:
            return optimum
        optimal_counts = best_counts(self.candidates, self.criterion, *self.limits).design
        text = describe_missed_target(
            self.forecast(optimal_counts),
            goal.sizes,
            "no choice of readings within the limits",
            f"The best choice of {optimal_counts.sum()} readings",
        )
        raise CounterspinError(text + ".", code="goal-not-reached")

    def _comparison_plans(self, optimum: Optimum[Counts], prediction: Forecast) -> list[OtherPlan]:
        """Return the plan with equal counts of all candidates, as far as possible."""
        n_candidates, n_readings = optimum.design.size, int(optimum.design.sum())
        indices = np.floor(np.arange(n_readings) * n_candidates / n_readings).astype(np.int64)
        counts = np.bincount(indices, minlength=n_candidates)
        even_forecast = self.forecast(counts)
        if not all(even_forecast.assessment.determined[name] for name in self.plan.goal.sizes):
            return []
        text = (
            "same number of readings, distributed evenly"
            if n_readings % n_candidates
            else "every reading equally often"
        )
        time = float(self.candidates.cost @ counts)
        return [compare_plan(text, time, prediction.u, even_forecast.u, self.plan.goal.sizes)]

    def _active_limits(self, optimum: Optimum[Counts]) -> list[LimitResult]:
        """Return the gain from relaxing each limit; empty for a plan with a target."""
        if self.plan.goal.kind == "target":
            return []
        max_count, max_time = self.limits
        factor = 1.0 + RELAXATION_FRACTION
        relaxed_limits = {
            "readings": (
                f"at most {max_count:.0f} readings",
                max_count,
                (np.ceil(max_count * factor), max_time),
            ),
            "total_time": (
                f"total time {max_time:.6g} s",
                max_time,
                (max_count, max_time * factor),
            ),
        }
        results = []
        for key, (text, limit, limits) in relaxed_limits.items():
            if math.isfinite(limit):
                relaxed_value = best_counts(self.candidates, self.criterion, *limits).value
                gain = 1.0 - math.exp(relaxed_value - optimum.value)
                results.append(LimitResult(key=key, words=text, binds=gain > MIN_GAIN, gain=gain))
        return [result for result in results if result.binds]


def _make_candidate_set(plan: ReadingPlan, model: Unknowns) -> CandidateSet:
    """Return the information of each candidate reading, and of the existing observations."""
    campaign = plan.template
    expected = expected_values(campaign, model.unknowns)
    names = [reading.name for reading in plan.candidates]
    accelerometers = list(campaign.accelerometers)
    readings = [reading for reading in campaign.readings if reading.name in names]
    poses = campaign.triad.poses if campaign.triad else ()
    poses = tuple(pose for pose in poses if pose[0].name in names)
    groups: list[Readings | TriadPoses] = [
        *group_readings(campaign, readings),
        *group_poses(campaign, poses),
    ]
    p, q = len(model.unknowns), len(model.considered)
    design = np.zeros((len(names), len(accelerometers), p))
    considered = np.zeros((len(names), len(accelerometers), q))
    for group, (design_rows, considered_rows) in zip(
        groups, rows_at(groups, model, expected), strict=True
    ):
        indices = [names.index(name) for name in group.names]
        # The three accelerometers of a pose together form a single row.
        row = 0 if isinstance(group, TriadPoses) else accelerometers.index(group.accelerometer)
        design[indices, row], considered[indices, row] = design_rows, considered_rows
    blocks = _existing_blocks(plan, model, expected)
    prior_sds = np.array([unknown.prior_sd for unknown in model.unknowns])
    prior_rows = whiten_priors(np.eye(p), prior_sds, prior_correlation(model.unknowns))
    considered_sds = np.array(model.considered_sds)
    return CandidateSet(
        design,
        considered * considered_sds,
        np.vstack([*(block.factor for block in blocks), prior_rows]),
        np.vstack([*(block.considered * considered_sds for block in blocks), np.zeros((p, q))]),
        np.array([reading.time for reading in plan.candidates]),
    )


def _existing_blocks(plan: ReadingPlan, model: Unknowns, expected: Array) -> Sequence[Block]:
    """Return the information of the existing observations of the campaign."""
    if not plan.existing_runs:
        return ()
    rate, campaign = plan.sampling_rate, plan.existing_campaign()
    return forecast(campaign, sampling_rate=rate, model=model, expected=expected).fit.blocks


def _select_new_readings(plan: ReadingPlan, campaign: Campaign) -> Campaign:
    """Return the planned campaign with only its new readings."""
    n_existing = len(plan.existing_campaign().readings)
    triad = campaign.triad
    if triad is not None:
        triad = replace(triad, poses=triad.poses[len(plan.existing_poses) :])
    return replace(campaign, readings=campaign.readings[n_existing:], triad=triad)


def _forecast_readings(plan: ReadingPlan, readings: Sequence[CandidateReading]) -> Forecast:
    """Return the forecast of a campaign with these readings."""
    return forecast(plan.campaign(readings), sampling_rate=plan.sampling_rate)


def order_readings(counts: Counts, order: str) -> list[int]:
    """Return the indices of the candidate readings in measurement order.

    counts: Number of readings of each candidate, shape (n,).
    """
    if order == "listed":
        return [int(index) for index in np.repeat(np.arange(counts.size), counts)]
    if order == "random":
        all_indices = np.repeat(np.arange(counts.size), counts)
        return [int(i) for i in np.random.default_rng(_ORDER_SEED).permutation(all_indices)]
    # Pairs are symmetric about the middle; odd readings are in the middle.
    first_half: list[int] = []
    remaining_counts = counts // 2
    is_forward = True
    while remaining_counts.any():
        indices = np.flatnonzero(remaining_counts)
        first_half += [int(i) for i in (indices if is_forward else indices[::-1])]
        remaining_counts = remaining_counts - (remaining_counts > 0)
        is_forward = not is_forward
    middle = [int(index) for index in np.flatnonzero(counts % 2)]
    return [*first_half, *middle, *reversed(first_half)]
