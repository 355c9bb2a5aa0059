"""A plan of readings: which positions and rates, how often, and in which order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin._version import __version__
from counterspin.arrays import Array
from counterspin.calibration.model import assumed, model_of
from counterspin.calibration.result_parts import Provenance
from counterspin.campaign.conditions import groups_of
from counterspin.campaign.description import Campaign
from counterspin.campaign.questions import questions
from counterspin.campaign.resolved import MOST_READINGS
from counterspin.errors import CounterspinError, NotIdentifiableError
from counterspin.inference.joint.unknowns import Unknowns, unit_of
from counterspin.inference.linear_readings import rows_at
from counterspin.planning.design import Criterion
from counterspin.planning.forecast import Forecast, expected_values, forecast
from counterspin.planning.predicted import accelerometers_of, planned_readings, platform_of
from counterspin.planning.readings.counts import (
    Chosen,
    Counts,
    Possibilities,
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
    limits = (described.readings, described.total_time)
    goal = described.goal
    if goal.kind == "minimise":
        chosen, efficiency = best_counts(possible, criterion, *limits), None
    else:
        least = least_counts(possible, criterion, *limits)
        if least is None:
            raise _unreachable(described, best_counts(possible, criterion, *limits))
        chosen, floor = least
        used = float(possible.time @ chosen.counts) / limits[1]
        efficiency = floor / (used if math.isfinite(limits[1]) else chosen.counts.sum() / limits[0])
    if chosen.counts.sum() > MOST_READINGS:
        raise CounterspinError(
            f"{described.path}: limits.total_time leaves time for {chosen.counts.sum():.3g} "
            f"readings, and a campaign has {MOST_READINGS} at most; state limits.readings, or "
            "less time"
        )
    order = in_order(chosen.counts, described.order)
    readings = [described.possible[index] for index in order]
    prediction = _told(described, readings)
    return (
        PlanResult(
            title=described.stand_in.title,
            gravity=described.stand_in.site.gravity,
            radius=described.stand_in.radius.value,
            sampling_rate=None,
            total_time=sum(reading.time for reading in readings),
            runs=[],
            readings=planned_readings(_new_of(described, prediction.campaign)),
            order=described.order,
            accelerometers=accelerometers_of(prediction),
            platform=platform_of(prediction),
            assumed=list(assumed(prediction.campaign)),
            warnings=[question.text for question in questions(prediction.campaign)],
            goal=GoalResult(
                kind=goal.kind,
                criterion=goal.criterion,
                sizes=dict(goal.sizes),
                efficiency=math.exp(chosen.bound - chosen.value)
                if efficiency is None
                else min(1.0, efficiency),
            ),
            others=_others(described, possible, chosen, prediction),
            limits=_limits(described, possible, criterion, chosen),
            provenance=Provenance(version=__version__, inputs={}),
        ),
        readings,
    )


def _problem(described: ReadingPlan) -> tuple[Possibilities, Criterion]:
    """Return what each possible reading tells, and what is to be small."""
    campaign = described.stand_in
    model = model_of(campaign)
    expected = expected_values(campaign, model.unknowns)
    names = [reading.name for reading in described.possible]
    groups = groups_of(campaign, [r for r in campaign.readings if r.name in names])
    accelerometers = list(campaign.accelerometers)
    p, q = len(model.unknowns), len(model.considered)
    taken, taken_fixed = _taken(described, model, expected)
    design = np.zeros((len(names), len(accelerometers), p))
    fixed = np.zeros((len(names), len(accelerometers), q))
    for group, (own, others) in zip(groups, rows_at(groups, model, expected), strict=True):
        places = [names.index(name) for name in group.names]
        row = accelerometers.index(group.accelerometer)
        design[places, row], fixed[places, row] = own, others
    sought = [unknown.name for unknown in model.unknowns]
    goal = described.goal
    return (
        Possibilities(
            design,
            fixed * np.array(model.considered_sizes),
            np.array([1.0 / unknown.spread for unknown in model.unknowns]),
            np.array([reading.time for reading in described.possible]),
            taken,
            taken_fixed * np.array(model.considered_sizes),
        ),
        Criterion(
            tuple(sought.index(name) for name in goal.sizes),
            tuple(goal.sizes.values()),
            goal.criterion,
        ),
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
    blocks = [*there.fit.blocks, *there.fit.beside.values()]
    return (
        np.vstack([block.factor for block in blocks]),
        np.vstack([block.considered for block in blocks]),
    )


def _new_of(described: ReadingPlan, campaign: Campaign) -> Campaign:
    """Return a planned campaign with the readings alone that are still to be taken."""
    before = len(described.campaign_as_it_is().readings)
    return replace(campaign, readings=campaign.readings[before:])


def _told(described: ReadingPlan, readings: Sequence[PossibleReading]) -> Forecast:
    """Return what a calibration will say with these readings."""
    return forecast(described.campaign(readings), sampling_rate=described.sampling_rate)


def _require_determined(described: ReadingPlan) -> None:
    """Refuse a goal that all possible readings together do not determine."""
    many = described.possible * 4
    assessment = _told(described, many).assessment
    missing = [name for name in described.goal.sizes if not assessment.determined[name]]
    if not missing:
        return
    name = missing[0]
    text = f"{name} is not determined by any number of these readings"
    confounded = [item for item in assessment.confounded if name in item.terms]
    if confounded:
        text += f": only {confounded[0].determined} is"
    elif all(reading.motion == "static" for reading in described.stand_in.readings):
        text += ": at 1 g the squares of the specific forces add up to one"
    raise NotIdentifiableError(
        text + ". Allow other stations, such as an arm or other axes, or give what is known of the "
        "other terms in [model.priors]."
    )


def _unreachable(described: ReadingPlan, best: Chosen) -> CounterspinError:
    order = in_order(best.counts, described.order)
    u = _told(described, [described.possible[index] for index in order]).u
    goal = described.goal.sizes
    name = max(goal, key=lambda key: u[key] / goal[key])
    unit = unit_of(name.rpartition(".")[2])
    return CounterspinError(
        f"no choice of readings within the limits reaches u({name}) = {goal[name]:.3g} {unit}. "
        f"The best, {len(order)} readings, has {u[name]:.3g} {unit}."
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
    order = in_order(counts, described.order)
    there = _told(described, [described.possible[index] for index in order])
    if not all(there.assessment.determined[name] for name in names):
        return []
    return [
        OtherPlan(
            words="every reading equally often"
            if number % size == 0
            else "as many readings, spread evenly over all",
            total_time=float(possible.time @ counts),
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
