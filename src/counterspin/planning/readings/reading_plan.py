"""A plan of readings: which positions and rates, how often, and in which order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.model import model_of
from counterspin.campaign.conditions import groups_of
from counterspin.campaign.description import Campaign
from counterspin.campaign.resolved import MOST_READINGS
from counterspin.campaign.triads.grouped import poses_together
from counterspin.errors import CounterspinError, NotIdentifiableError
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.linear_readings import Readings, rows_at
from counterspin.inference.poses import TriadPoses
from counterspin.planning.design import Criterion
from counterspin.planning.feasibility import missed, not_determined
from counterspin.planning.forecast import Forecast, expected_values, forecast
from counterspin.planning.plan_file import Goal
from counterspin.planning.possibilities import Possibilities
from counterspin.planning.predicted import planned_readings, result_of
from counterspin.planning.readings.counts import (
    Chosen,
    Counts,
    best_counts,
    least_counts,
)
from counterspin.planning.readings.stations import PossibleReading, ReadingPlan
from counterspin.planning.result import GoalResult, LimitResult, OtherPlan, PlanResult

#: Seed of the random order; the campaign's file has the order itself.
_SEED: Final = 1

#: Part by which a limit is relaxed, and the smallest gain of u that is reported.
_RELAXATION: Final = 0.1
_GAIN: Final = 5e-4


def plan_readings(described: ReadingPlan) -> tuple[PlanResult, list[PossibleReading]]:
    """Find the readings for a plan's goal."""
    _require_determined(described)
    possible, criterion = _problem(described)
    chosen, floor, prediction = _chosen(described, possible, criterion)
    readings = _in_order(described, chosen.counts)
    goal = described.goal
    if floor is None:
        # Of what is reported: what goes with time is unknown to the search.
        efficiency = math.exp(chosen.bound - _value(prediction, goal))
    elif math.isfinite(described.total_time):
        efficiency = floor * described.total_time / float(possible.cost @ chosen.counts)
    else:
        efficiency = floor * described.readings / float(chosen.counts.sum())
    result = result_of(prediction, None, sum(reading.time for reading in readings))
    return (
        result.model_copy(
            update={
                "readings": planned_readings(_new_of(described, prediction.campaign)),
                "order": described.order,
                "goal": GoalResult(
                    kind=goal.kind,
                    criterion=goal.criterion,
                    sizes=dict(goal.sizes),
                    efficiency=min(1.0, efficiency),
                ),
                "others": _others(described, possible, chosen, prediction),
                "limits": _limits(described, possible, criterion, chosen),
            }
        ),
        readings,
    )


def _chosen(
    described: ReadingPlan, possible: Possibilities, criterion: Criterion
) -> tuple[Chosen, float | None, Forecast]:
    """Return the readings, for a target the part of the limit that it needs, and the forecast."""
    limits, goal = (described.readings, described.total_time), described.goal
    if goal.kind == "minimise":
        chosen = best_counts(possible, criterion, *limits)
        return chosen, None, _forecast_of(described, _in_order(described, chosen.counts))

    def u_of(counts: Counts) -> Array:
        there = _forecast_of(described, _in_order(described, counts)).u
        return np.array([there[name] for name in goal.sizes])

    least = least_counts(possible, criterion, *limits, u_of)
    if least is not None:
        chosen, floor = least
        return chosen, floor, _forecast_of(described, _in_order(described, chosen.counts))
    best = _in_order(described, best_counts(possible, criterion, *limits).counts)
    text = missed(
        _forecast_of(described, best),
        goal.sizes,
        "no choice of readings within the limits",
        f"The best, {len(best)} readings,",
    )
    raise CounterspinError(text + ".")


def _in_order(described: ReadingPlan, counts: Counts) -> list[PossibleReading]:
    """Return readings in the order in which to take them; refused if they are too many."""
    if counts.sum() > MOST_READINGS:
        raise CounterspinError(
            f"{described.path}: limits.total_time leaves time for {counts.sum():.3g} readings, and "
            f"a campaign has {MOST_READINGS} at most; state limits.readings, or less time"
        )
    return [described.possible[index] for index in in_order(counts, described.order)]


def _value(prediction: Forecast, goal: Goal) -> float:
    """Return the criterion of a forecast, as of `Criterion.value`."""
    names = [unknown.name for unknown in prediction.fit.model.unknowns]
    return float(_criterion(goal, names).value(prediction.fit.solution.covariance))


def _criterion(goal: Goal, names: Sequence[str]) -> Criterion:
    places = tuple(names.index(name) for name in goal.sizes)
    return Criterion(places, tuple(goal.sizes.values()), goal.criterion)


def _problem(described: ReadingPlan) -> tuple[Possibilities, Criterion]:
    """Return what each possible reading tells, and what is to be small."""
    campaign = described.stand_in
    model = model_of(campaign)
    expected = expected_values(campaign, model.unknowns)
    names = [reading.name for reading in described.possible]
    accelerometers = list(campaign.accelerometers)
    readings = [r for r in campaign.readings if r.name in names]
    poses = campaign.triad.poses if campaign.triad else ()
    poses = tuple(pose for pose in poses if pose[0].name in names)
    groups: list[Readings | TriadPoses] = [
        *groups_of(campaign, readings),
        *poses_together(campaign, poses),
    ]
    p, q = len(model.unknowns), len(model.considered)
    taken, taken_fixed = _taken(described, model, expected)
    design = np.zeros((len(names), len(accelerometers), p))
    fixed = np.zeros((len(names), len(accelerometers), q))
    for group, (own, others) in zip(groups, rows_at(groups, model, expected), strict=True):
        places = [names.index(name) for name in group.names]
        # All three accelerometers of a pose together tell one thing.
        row = 0 if isinstance(group, TriadPoses) else accelerometers.index(group.accelerometer)
        design[places, row], fixed[places, row] = own, others
    return (
        Possibilities(
            design,
            fixed * np.array(model.considered_sizes),
            np.vstack([taken, np.diag([1.0 / unknown.spread for unknown in model.unknowns])]),
            np.vstack([taken_fixed * np.array(model.considered_sizes), np.zeros((p, q))]),
            np.array([reading.time for reading in described.possible]),
        ),
        _criterion(described.goal, [unknown.name for unknown in model.unknowns]),
    )


def _taken(described: ReadingPlan, model: Unknowns, expected: Array) -> tuple[Array, Array]:
    """Return the rows of what the campaign has already, of unknowns and of what is considered."""
    if not described.taken:
        return np.zeros((0, len(model.unknowns))), np.zeros((0, len(model.considered)))
    there = forecast(
        described.campaign_as_it_is(),
        sampling_rate=described.sampling_rate,
        model=model,
        expected=expected,
    )
    return (
        np.vstack([block.factor for block in there.fit.blocks]),
        np.vstack([block.considered for block in there.fit.blocks]),
    )


def _new_of(described: ReadingPlan, campaign: Campaign) -> Campaign:
    """Return a planned campaign with the readings alone that are still to be taken."""
    before = len(described.campaign_as_it_is().readings)
    triad = campaign.triad
    if triad is not None:
        triad = replace(triad, poses=triad.poses[len(described.poses) :])
    return replace(campaign, readings=campaign.readings[before:], triad=triad)


def _forecast_of(described: ReadingPlan, readings: Sequence[PossibleReading]) -> Forecast:
    """Return the forecast of a campaign with these readings."""
    return forecast(described.campaign(readings), sampling_rate=described.sampling_rate)


def _require_determined(described: ReadingPlan) -> None:
    """Refuse a goal that all possible readings together do not determine."""
    many = described.possible * 4
    assessment = _forecast_of(described, many).assessment
    by = "any number of these readings"
    missing, text = not_determined(assessment, described.goal.sizes, by)
    if not missing:
        return
    if text.endswith(by) and all(r.motion == "static" for r in described.stand_in.readings):
        text += ": at 1 g the squares of the specific forces add up to one"
    raise NotIdentifiableError(
        text + ". Allow other stations, such as an arm or other axes, or give what is known of the "
        "other terms in [model.priors]."
    )


def in_order(counts: Counts, order: str) -> list[int]:
    """Return the possible readings in the order in which to take them.

    counts: How often each is taken, shape (n,).
    """
    if order == "listed":
        return [int(index) for index in np.repeat(np.arange(counts.size), counts)]
    if order == "random":
        everything = np.repeat(np.arange(counts.size), counts)
        return [int(i) for i in np.random.default_rng(_SEED).permutation(everything)]
    # Pairs about the middle; what is there once more stands in the middle itself.
    half: list[int] = []
    left = counts // 2
    forward = True
    while left.any():
        places = np.flatnonzero(left)
        half += [int(i) for i in (places if forward else places[::-1])]
        left = left - (left > 0)
        forward = not forward
    middle = [int(index) for index in np.flatnonzero(counts % 2)]
    return [*half, *middle, *reversed(half)]


def _others(
    described: ReadingPlan, possible: Possibilities, chosen: Chosen, prediction: Forecast
) -> list[OtherPlan]:
    """Return the plan that takes every possible reading equally often, or nearly."""
    size = chosen.counts.size
    number = int(chosen.counts.sum())
    spread = np.floor(np.arange(number) * size / number).astype(np.int64)
    counts = np.bincount(spread, minlength=size)
    names = list(described.goal.sizes)
    there = _forecast_of(described, _in_order(described, counts))
    if not all(there.assessment.determined[name] for name in names):
        return []
    return [
        OtherPlan(
            words="every reading equally often"
            if number % size == 0
            else "as many readings, spread evenly over all",
            total_time=float(possible.cost @ counts),
            u={name: there.u[name] for name in names},
            ratio={name: prediction.u[name] / there.u[name] for name in names},
        )
    ]


def _limits(
    described: ReadingPlan, possible: Possibilities, criterion: Criterion, chosen: Chosen
) -> list[LimitResult]:
    """Return what a tenth more of each limit would gain; of a target nothing limits the rest."""
    if described.goal.kind == "target":
        return []
    number, time = described.readings, described.total_time
    more = 1.0 + _RELAXATION
    lines = []
    relaxed: list[tuple[str, str, tuple[float, float]]] = []
    if math.isfinite(number):
        words = f"{number:.0f} readings at most"
        relaxed.append(("readings", words, (math.ceil(number * more), time)))
    if math.isfinite(time):
        relaxed.append(("total_time", f"total time {time:.6g} s", (number, time * more)))
    for key, words, limits in relaxed:
        gain = 1.0 - math.exp(best_counts(possible, criterion, *limits).value - chosen.value)
        lines.append(LimitResult(key=key, words=words, binds=gain > _GAIN, gain=max(0.0, gain)))
    return [line for line in lines if line.binds]
