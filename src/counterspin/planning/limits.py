"""Active limits of a plan, and the gain from relaxing each."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from counterspin.planning.design import Criterion, Design, Limits, allow_both_senses, scale_to_time
from counterspin.planning.optimisation import polish, shortest_plan
from counterspin.planning.result import LimitResult
from counterspin.planning.run_information import Predictor
from counterspin.planning.search import Search

#: Part of a limit by which it is relaxed, and the smallest relative gain of u that is reported.
RELAXATION: Final = 0.1
GAIN: Final = 5e-4

#: Relative distance from a limit at which a plan touches it.
_TOUCHING_DISTANCE: Final = 2e-3


class _Limit(NamedTuple):
    """A limit that a plan touches, or that takes of its time."""

    key: str
    text: str
    is_active: bool
    changes: dict[str, Any]  #: The fields of `Limits` that change if a limit is relaxed.


def active_limits(search: Search, design: Design) -> list[LimitResult]:
    """Return the binding limits and the gain from a tenth more of each, the largest gain first."""
    lines = []
    for limit in _candidate_limits(search, design):
        if limit.is_active:
            gain = _gain(search, limit.key, replace(search.limits, **limit.changes), design)
            if gain > GAIN or limit.key == "senses":
                binds = gain > GAIN
                lines.append(LimitResult(key=limit.key, words=limit.text, binds=binds, gain=gain))
    return sorted(lines, key=lambda line: -line.gain)


def _candidate_limits(search: Search, design: Design) -> Iterator[_Limit]:
    limits, more, less = search.limits, 1.0 + RELAXATION, 1.0 - RELAXATION
    low, high = limits.rate
    below, above = 1.0 - _TOUCHING_DISTANCE, 1.0 + _TOUCHING_DISTANCE
    time, longest = limits.total_time, limits.longest_run
    spent = search.plan.goal.kind == "minimise" and limits.time(design) > time * below
    yield _Limit(
        "total_time", f"total time {time:.6g} s", spent, {"total_time": limits.total_time * more}
    )
    settings = (*limits.settings, high * more) if limits.settings else ()
    yield _Limit(
        "rate",
        f"highest rate {high:.6g} rad/s",
        bool((design.rate > high * below).any()),
        {"rate": (low, high * more), "settings": settings},
    )
    yield _Limit(
        "lowest_rate",
        f"lowest rate {low:.6g} rad/s",
        not limits.settings and bool((design.rate < low * above).any()),
        {"rate": (low * less, high)},
    )
    rates, runs = limits.fewest_rates, limits.runs
    yield _Limit("fewest_rates", f"at least {rates} rates", rates > 1, {"fewest_rates": rates - 1})
    more_runs = {"runs": math.ceil(runs * more)}
    yield _Limit("runs", f"at most {runs} runs", len(design.types) >= runs, more_runs)
    words = {
        "settling": f"settling time {limits.settling:.4g} s per run",
        "spin_up": "spin-up and spin-down time",
        "attitude_change": f"attitude change time {limits.attitude_change:.4g} s",
    }
    several = len({run_type.attitude for run_type in design.types}) > 1
    for key, text in words.items():
        size = getattr(limits, key)
        touched = size > 0.0 and (several or key != "attitude_change")
        yield _Limit(key, text, touched, {key: size * less})
    yield _Limit(
        "revolutions",
        f"at least {limits.revolutions:g} revolutions",
        bool((design.revolutions < limits.revolutions * above).any()),
        {"revolutions": limits.revolutions * less},
    )
    yield _Limit(
        "longest_run",
        f"longest run {longest:.6g} s",
        longest < time and bool((design.duration > longest * below).any()),
        {"longest_run": longest * more},
    )
    yield _Limit("sampling_rate", f"sampling rate {search.plan.sampling_rate:.6g} Hz", True, {})
    one_sense = all(run_type.sense == 1 for run_type in limits.types)
    yield _Limit(
        "senses", "one sense of rotation", one_sense, {"types": allow_both_senses(limits).types}
    )


def _gain(search: Search, key: str, limits: Limits, design: Design) -> float:
    """Return the relative decrease of u (or of time) within relaxed limits."""
    predictor = search.predictor
    if search.plan.goal.kind == "target":
        before = math.log(search.limits.time(design))
    else:
        before = predictor.value(search.criterion, design)
    if key == "sampling_rate":
        faster = search.plan.sampling_rate * (1.0 + RELAXATION)
        predictor = Predictor(predictor.information.sampled_at(faster))
    starts = _relaxed_starts(search, key, limits, design)
    after = min(before, *(_improve(search, predictor, limits, start) for start in starts))
    return 1.0 - math.exp(after - before)


def _relaxed_starts(search: Search, key: str, limits: Limits, design: Design) -> list[Design]:
    """Return starting designs that use a relaxed limit where better lengths alone do not."""
    if key == "senses":
        turned = tuple(
            run_type._replace(sense=-run_type.sense) if index % 2 else run_type
            for index, run_type in enumerate(design.types)
        )
        return [design, replace(design, types=turned)]
    if key == "runs":
        addition_limits = limits.runs - len(design.types)
        # More of each type's shortest run: those are the ones there are many of.
        longest_first = np.argsort(-design.duration, kind="stable")
        run_types = {design.types[index]: index for index in longest_first}
        others = [
            Design(
                (run_type,) * addition_limits,
                np.repeat(design.rate[index], addition_limits),
                np.repeat(design.revolutions[index], addition_limits),
            )
            for run_type, index in run_types.items()
        ]
        return [design, *(design.concatenate(addition) for addition in others)]
    if key == "fewest_rates" and len(design.types) > 1:
        slower = search.limits.distinct_rate_runs(design.rate)[1:]
        return [design, *(design.without(index) for index in slower)]
    if key == "rate" and limits.settings:
        rate = np.where(design.rate == max(limits.settings[:-1]), limits.rate[1], design.rate)
        return [design, Design(design.types, rate, design.duration * rate / (2.0 * math.pi))]
    return [design]


def _improve(search: Search, predictor: Predictor, limits: Limits, design: Design) -> float:
    if search.plan.goal.kind == "target":
        singles = [
            Criterion((place,), (scale,))
            for place, scale in zip(search.criterion.indices, search.criterion.scales, strict=True)
        ]
        shorter = shortest_plan(predictor, limits, singles, design)
        meets_goal = all(predictor.value(single, shorter) < 1e-5 for single in singles)
        return math.log(limits.time(shorter)) if meets_goal else math.inf
    start = scale_to_time(design, limits) or design
    return polish(predictor, limits, search.criterion, start)[0]
