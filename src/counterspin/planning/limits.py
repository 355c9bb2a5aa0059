"""Active limits of a plan, and the gain from relaxing each."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from counterspin.planning.design import Criterion, Design, Limits, allow_both_senses, scale_to_time
from counterspin.planning.optimisation import find_shortest_plan, polish_design
from counterspin.planning.result import LimitResult
from counterspin.planning.run_information import Predictor
from counterspin.planning.search import Search

#: Fraction by which each limit is relaxed, and the smallest relative gain of u in the report.
RELAXATION_FRACTION: Final = 0.1
MIN_GAIN: Final = 5e-4

#: Relative distance from a limit within which the limit is active.
_ACTIVITY_TOLERANCE: Final = 2e-3


class _Limit(NamedTuple):
    """A candidate for an active limit."""

    key: str
    text: str
    is_active: bool
    changes: dict[str, Any]  #: Fields of `Limits` that change if the limit is relaxed.


def active_limits(search: Search, design: Design) -> list[LimitResult]:
    """Return the binding limits with the gain from relaxing each, largest gain first."""
    results = []
    for limit in _candidate_limits(search, design):
        if limit.is_active:
            limits = replace(search.limits, **limit.changes)
            gain = _relaxation_gain(search, limit.key, limits, design)
            binds = gain > MIN_GAIN
            if binds or limit.key == "senses":
                results.append(LimitResult(key=limit.key, words=limit.text, binds=binds, gain=gain))
    return sorted(results, key=lambda result: -result.gain)


def _candidate_limits(search: Search, design: Design) -> Iterator[_Limit]:
    limits, increase, decrease = search.limits, 1.0 + RELAXATION_FRACTION, 1.0 - RELAXATION_FRACTION
    low, high = limits.rate_range
    lower_factor, upper_factor = 1.0 - _ACTIVITY_TOLERANCE, 1.0 + _ACTIVITY_TOLERANCE
    total_time, max_duration = limits.total_time, limits.max_duration
    is_time_exhausted = (
        search.plan.goal.kind == "minimise"
        and limits.campaign_time(design) > total_time * lower_factor
    )
    yield _Limit(
        "total_time",
        f"total time {total_time:.6g} s",
        is_time_exhausted,
        {"total_time": limits.total_time * increase},
    )
    rate_settings = (*limits.rate_settings, high * increase) if limits.rate_settings else ()
    yield _Limit(
        "rate",
        f"highest rate {high:.6g} rad/s",
        bool((design.rate > high * lower_factor).any()),
        {"rate_range": (low, high * increase), "rate_settings": rate_settings},
    )
    yield _Limit(
        "lowest_rate",
        f"lowest rate {low:.6g} rad/s",
        not limits.rate_settings and bool((design.rate < low * upper_factor).any()),
        {"rate_range": (low * decrease, high)},
    )
    min_rates, max_runs = limits.min_rates, limits.max_runs
    yield _Limit(
        "fewest_rates", f"at least {min_rates} rates", min_rates > 1, {"min_rates": min_rates - 1}
    )
    changes = {"max_runs": math.ceil(max_runs * increase)}
    yield _Limit("runs", f"at most {max_runs} runs", len(design.types) >= max_runs, changes)
    text_by_key = {
        "settling": f"settling time {limits.settling:.4g} s per run",
        "spin_up": "spin-up and spin-down time",
        "attitude_change": f"attitude change time {limits.attitude_change:.4g} s",
    }
    has_several_attitudes = len({run_type.attitude for run_type in design.types}) > 1
    for key, text in text_by_key.items():
        limit_value = getattr(limits, key)
        is_active = limit_value > 0.0 and (has_several_attitudes or key != "attitude_change")
        yield _Limit(key, text, is_active, {key: limit_value * decrease})
    yield _Limit(
        "revolutions",
        f"at least {limits.min_revolutions:g} revolutions",
        bool((design.revolutions < limits.min_revolutions * upper_factor).any()),
        {"min_revolutions": limits.min_revolutions * decrease},
    )
    yield _Limit(
        "longest_run",
        f"longest run {max_duration:.6g} s",
        max_duration < total_time and bool((design.duration > max_duration * lower_factor).any()),
        {"max_duration": max_duration * increase},
    )
    yield _Limit("sampling_rate", f"sampling rate {search.plan.sampling_rate:.6g} Hz", True, {})
    has_one_sense = all(run_type.sense == 1 for run_type in limits.types)
    yield _Limit(
        "senses", "one sense of rotation", has_one_sense, {"types": allow_both_senses(limits).types}
    )


def _relaxation_gain(search: Search, key: str, limits: Limits, design: Design) -> float:
    """Return the relative decrease of u (or of time) within relaxed limits."""
    predictor = search.predictor
    if search.plan.goal.kind == "target":
        current_value = math.log(search.limits.campaign_time(design))
    else:
        current_value = predictor.value(search.criterion, design)
    if key == "sampling_rate":
        sampling_rate = search.plan.sampling_rate * (1.0 + RELAXATION_FRACTION)
        predictor = Predictor(predictor.information.with_sampling_rate(sampling_rate))
    starts = _relaxed_starts(search, key, limits, design)
    relaxed_value = min(
        current_value, *(_optimised_value(search, predictor, limits, start) for start in starts)
    )
    return 1.0 - math.exp(relaxed_value - current_value)


def _relaxed_starts(search: Search, key: str, limits: Limits, design: Design) -> list[Design]:
    """Return initial designs that use a relaxed limit, where new durations alone do not."""
    if key == "senses":
        alternating_types = tuple(
            run_type._replace(sense=-run_type.sense) if index % 2 else run_type
            for index, run_type in enumerate(design.types)
        )
        return [design, replace(design, types=alternating_types)]
    if key == "runs":
        n_added = limits.max_runs - len(design.types)
        # Repeat the shortest run of each type: optimal plans have many short runs.
        indices_by_duration = np.argsort(-design.duration, kind="stable")
        index_by_type = {design.types[index]: index for index in indices_by_duration}
        additions = [
            Design(
                (run_type,) * n_added,
                np.repeat(design.rate[index], n_added),
                np.repeat(design.revolutions[index], n_added),
            )
            for run_type, index in index_by_type.items()
        ]
        return [design, *(design.concatenate(addition) for addition in additions)]
    if key == "fewest_rates" and len(design.types) > 1:
        slower_runs = search.limits.distinct_rate_runs(design.rate)[1:]
        return [design, *(design.without(index) for index in slower_runs)]
    if key == "rate" and limits.rate_settings:
        rate = np.where(
            design.rate == max(limits.rate_settings[:-1]), limits.rate_range[1], design.rate
        )
        return [design, Design(design.types, rate, design.duration * rate / (2.0 * math.pi))]
    return [design]


def _optimised_value(search: Search, predictor: Predictor, limits: Limits, design: Design) -> float:
    """Return the logarithm of u (or of time) of a design, optimised within limits."""
    if search.plan.goal.kind == "target":
        single_criteria = [
            Criterion((index,), (scale,))
            for index, scale in zip(search.criterion.indices, search.criterion.scales, strict=True)
        ]
        shortest_design = find_shortest_plan(predictor, limits, single_criteria, design)
        meets_goal = all(
            predictor.value(criterion, shortest_design) < 1e-5 for criterion in single_criteria
        )
        return math.log(limits.campaign_time(shortest_design)) if meets_goal else math.inf
    start = scale_to_time(design, limits) or design
    return polish_design(predictor, limits, search.criterion, start)[0]
