"""A plan of readings: which positions and rates, how often, and in which order.

The relaxation in which the numbers need not be whole is convex (`planning.possibilities`). It is
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
from counterspin.planning.design import Criterion
from counterspin.planning.forecast import Forecast, expected_values, forecast
from counterspin.planning.limits import GAIN, RELAXATION
from counterspin.planning.possibilities import Optimum, Possibilities
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
_GAIN: Final = 1e-9
_EXCHANGES: Final = 400

#: Of at most so many possible readings the search begins from so many drawn numbers too.
_FEW: Final = 60
_DRAWN: Final = 6
#: Of so few readings that exchanges of one end in many places it begins from so many.
_FEW_READINGS: Final = 12
_DRAWN_OF_FEW: Final = 60
_SEED_OF_ROUNDING: Final = 1

#: A target is reached to rounding.
_ROUNDING: Final = 1e-9

#: Steps of the search for the least limit.
_BISECTIONS: Final = 12


def best_counts(
    possible: Possibilities, criterion: Criterion, number: float, time: float
) -> Optimum[Counts]:
    """Return the numbers with the smallest criterion.

    number, time: Largest sum of the numbers and of their times, s; one of them finite.
    """
    relaxed = possible.relaxed(criterion, number, time)
    ends = [
        _exchange_readings(possible, criterion, start, number, time)
        for start in _starts(possible, relaxed.choice, number, time)
    ]
    value, counts = min(ends, key=lambda end: end[0])
    return Optimum(counts, value, min(relaxed.bound, value))


def _starts(possible: Possibilities, weight: Array, number: float, time: float) -> list[Counts]:
    """Return numbers from which to exchange: some ends are worse than others.

    weight: The numbers that need not be whole, shape (n,).
    """
    rounded = np.floor(weight + 1e-6).astype(np.int64)
    drawn = _DRAWN_OF_FEW if number <= _FEW_READINGS else _DRAWN
    rng, drawn = np.random.default_rng(_SEED_OF_ROUNDING), drawn if weight.size <= _FEW else 0
    # Rounded; nothing, to which the best is added one by one; and drawn about the first.
    starts = [rounded.copy(), np.zeros_like(rounded), *(rounded.copy() for _ in range(drawn))]
    for counts in (starts[0], *starts[2:]):
        first = weight - rounded + (0.0 if counts is starts[0] else rng.uniform(size=weight.size))
        for index in np.argsort(-first, kind="stable"):
            counts[index] += _allow_one_more(possible, counts, number, time)[index]
    return starts


def _exchange_readings(
    possible: Possibilities, criterion: Criterion, counts: Counts, number: float, time: float
) -> tuple[float, Counts]:
    """Return the criterion and the numbers where no exchange of one reading gains any more."""
    value = float(possible.value(criterion, counts))
    for _ in range(_EXCHANGES):
        lowest, better = math.inf, counts
        for gone in (None, *np.flatnonzero(counts)):
            candidate = counts.copy()
            fits = np.ones(counts.size, dtype=np.bool_)
            if gone is not None:
                candidate[gone] -= 1
                fits[gone] = False
            fits &= _allow_one_more(possible, candidate, number, time)
            if not fits.any():
                continue
            values = np.where(fits, possible.with_one_more(criterion, candidate), math.inf)
            best = int(np.argmin(values))
            if values[best] < lowest:
                lowest, better = float(values[best]), candidate
                better[best] += 1
        after = float(possible.value(criterion, better))
        if not after < value - _GAIN:
            break
        value, counts = after, better
    return value, counts


def _allow_one_more(
    possible: Possibilities, counts: Counts, number: float, time: float
) -> npt.NDArray[np.bool_]:
    """Return a mask of the observations that the limits allow once more, shape (n,)."""
    took = float(possible.cost @ counts) + possible.cost
    return np.asarray((float(counts.sum()) + 1.0 <= number) & (took <= time * (1.0 + 1e-12)))


def least_counts(
    possible: Possibilities,
    criterion: Criterion,
    number: float,
    time: float,
    u_of: Callable[[Counts], Array],
) -> tuple[Optimum[Counts], float] | None:
    """Return the fewest readings, or the least time, with which every u is at most its scale.

    u_of: The forecast u of all unknowns of the criterion, in its order: effects of time make u
        larger than in `Possibilities`.
    Returns: the choice; the part of the limit below which none can be. None if all of the limit
        does not suffice.
    """
    scales = np.array(criterion.scales)

    def reached(chosen: Optimum[Counts]) -> bool:
        variance = np.diag(possible.covariance(chosen.choice))[list(criterion.places)]
        near = bool(np.all(np.sqrt(variance) <= scales * (1.0 + _ROUNDING)))
        return near and bool(np.all(u_of(chosen.choice) <= scales * (1.0 + _ROUNDING)))

    def limits(part: float) -> tuple[float, float] | None:
        if math.isfinite(time):
            return (number, part * time) if part * time >= float(possible.cost.min()) else None
        return (most, time) if (most := math.floor(part * number + 1e-9)) else None

    best = best_counts(possible, criterion, number, time)
    if not reached(best):
        return None
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        within = limits(middle)
        chosen = None if within is None else best_counts(possible, criterion, *within)
        if chosen is not None and reached(chosen):
            best, high = chosen, middle
        else:
            low = middle
    floor = 0.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (floor + high)
        within = limits(middle)
        if within is None or possible.relaxed(criterion, *within).bound > 0.0:
            floor = middle
        else:
            high = middle
    return best, floor


#: Seed of the random order; the campaign's file has the order itself.
_SEED: Final = 1


class ReadingSearch:
    """A plan's problem: which of the possible readings to take, and how often."""

    def __init__(self, plan: ReadingPlan) -> None:
        self.plan = plan
        self.limits = (plan.readings, plan.total_time)
        model = make_unknowns(plan.stand_in)
        self.possible = _possibilities(plan, model)
        self.criterion = plan.goal.criterion_of([unknown.name for unknown in model.unknowns])

    def best(self) -> tuple[PlanResult, list[PossibleReading]]:
        """Find the readings for the plan's goal."""
        self._require_determined()
        chosen, floor = self._chosen()
        prediction, cost = self.forecast(chosen.choice), self.possible.cost
        if floor is None:
            # From the reported uncertainties: the search omits effects of time.
            names = [unknown.name for unknown in prediction.fit.model.unknowns]
            criterion = self.plan.goal.criterion_of(names)
            value = float(criterion.value(prediction.fit.solution.covariance))
            efficiency = math.exp(chosen.bound - value)
        elif math.isfinite(self.plan.total_time):
            efficiency = floor * self.plan.total_time / float(cost @ chosen.choice)
        else:
            efficiency = floor * self.plan.readings / float(chosen.choice.sum())
        fields = {
            "readings": planned_readings(_select_new(self.plan, prediction.campaign)),
            "order": self.plan.order,
            "goal": self.plan.goal.met(min(1.0, efficiency)),
            "others": self._others(chosen, prediction),
            "limits": self._limits(chosen),
        }
        result = result_of(prediction, None, float(cost @ chosen.choice))
        return result.model_copy(update=fields), self._in_order(chosen.choice)

    def forecast(self, counts: Counts) -> Forecast:
        """Return the forecast of the campaign with these readings."""
        return _forecast_of(self.plan, self._in_order(counts))

    def _in_order(self, counts: Counts) -> list[PossibleReading]:
        """Return readings in the order in which to take them; refused if they are too many."""
        if counts.sum() > MOST_READINGS:
            raise CounterspinError(
                f"{self.plan.path}: limits.total_time leaves time for {counts.sum():.3g} readings, "
                f"but a campaign has {MOST_READINGS} at most; state limits.readings, or reduce "
                "the time"
            )
        return [self.plan.possible[index] for index in in_order(counts, self.plan.order)]

    def _require_determined(self) -> None:
        """Refuse a goal that all possible readings together do not determine."""
        assessment = _forecast_of(self.plan, self.plan.possible * 4).assessment
        by = "any number of these readings"
        missing, text = not_determined(assessment, self.plan.goal.sizes, by)
        if not missing:
            return
        if text.endswith(by) and all(r.motion == "static" for r in self.plan.stand_in.readings):
            text += ": at 1 g the squares of the specific forces add up to one"
        raise NotIdentifiableError(
            text + ". Allow other stations, such as an arm or other axes, or state priors of the "
            "other terms in [model.priors]."
        )

    def _chosen(self) -> tuple[Optimum[Counts], float | None]:
        """Return the readings, and for a target the part of the limit that it needs."""
        goal = self.plan.goal
        if goal.kind == "minimise":
            return best_counts(self.possible, self.criterion, *self.limits), None

        def u_of(counts: Counts) -> Array:
            u = self.forecast(counts).u
            return np.array([u[name] for name in goal.sizes])

        least = least_counts(self.possible, self.criterion, *self.limits, u_of)
        if least is not None:
            return least
        best = best_counts(self.possible, self.criterion, *self.limits).choice
        text = words_of_missed_target(
            self.forecast(best),
            goal.sizes,
            "no choice of readings within the limits",
            f"The best, {best.sum()} readings,",
        )
        raise CounterspinError(text + ".")

    def _others(self, chosen: Optimum[Counts], prediction: Forecast) -> list[OtherPlan]:
        """Return the plan that takes every possible reading equally often, or nearly."""
        size, number = chosen.choice.size, int(chosen.choice.sum())
        spread = np.floor(np.arange(number) * size / number).astype(np.int64)
        counts = np.bincount(spread, minlength=size)
        expected = self.forecast(counts)
        if not all(expected.assessment.determined[name] for name in self.plan.goal.sizes):
            return []
        often = "every reading equally often"
        words = (
            often if number % size == 0 else "the same number of readings, spread evenly over all"
        )
        time = float(self.possible.cost @ counts)
        return [other_plan(words, time, prediction.u, expected.u, self.plan.goal.sizes)]

    def _limits(self, chosen: Optimum[Counts]) -> list[LimitResult]:
        """Return the gain from a tenth more of each limit; empty for a plan for a target."""
        if self.plan.goal.kind == "target":
            return []
        number, time = self.limits
        more = 1.0 + RELAXATION
        relaxed = {
            "readings": (f"{number:.0f} readings at most", number, (np.ceil(number * more), time)),
            "total_time": (f"total time {time:.6g} s", time, (number, time * more)),
        }
        lines = []
        for key, (words, limit, limits) in relaxed.items():
            if math.isfinite(limit):
                after = best_counts(self.possible, self.criterion, *limits).value
                gain = 1.0 - math.exp(after - chosen.value)
                lines.append(LimitResult(key=key, words=words, binds=gain > GAIN, gain=gain))
        return [line for line in lines if line.binds]


def _possibilities(plan: ReadingPlan, model: Unknowns) -> Possibilities:
    """Return the information of each possible reading, and of the existing observations."""
    campaign = plan.stand_in
    expected = expected_values(campaign, model.unknowns)
    names = [reading.name for reading in plan.possible]
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
    for group, (design_rows, others) in zip(groups, rows_at(groups, model, expected), strict=True):
        places = [names.index(name) for name in group.names]
        # All three accelerometers of a pose together tell one thing.
        row = 0 if isinstance(group, TriadPoses) else accelerometers.index(group.accelerometer)
        design[places, row], fixed[places, row] = design_rows, others
    blocks = _existing_blocks(plan, model, expected)
    known = np.diag([1.0 / unknown.prior_sd for unknown in model.unknowns])
    sizes = np.array(model.considered_sds)
    return Possibilities(
        design,
        fixed * sizes,
        np.vstack([*(block.factor for block in blocks), known]),
        np.vstack([*(block.considered * sizes for block in blocks), np.zeros((p, q))]),
        np.array([reading.time for reading in plan.possible]),
    )


def _existing_blocks(plan: ReadingPlan, model: Unknowns, expected: Array) -> Sequence[Block]:
    """Return the information of the existing observations of the campaign."""
    if not plan.taken:
        return ()
    rate, campaign = plan.sampling_rate, plan.campaign_as_it_is()
    return forecast(campaign, sampling_rate=rate, model=model, expected=expected).fit.blocks


def _select_new(plan: ReadingPlan, campaign: Campaign) -> Campaign:
    """Return a planned campaign with the readings alone that are still to be taken."""
    before = len(plan.campaign_as_it_is().readings)
    triad = campaign.triad
    if triad is not None:
        triad = replace(triad, poses=triad.poses[len(plan.poses) :])
    return replace(campaign, readings=campaign.readings[before:], triad=triad)


def _forecast_of(plan: ReadingPlan, readings: Sequence[PossibleReading]) -> Forecast:
    """Return the forecast of a campaign with these readings."""
    return forecast(plan.campaign(readings), sampling_rate=plan.sampling_rate)


def in_order(counts: Counts, order: str) -> list[int]:
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
        places = np.flatnonzero(remaining)
        half += [int(i) for i in (places if forward else places[::-1])]
        remaining = remaining - (remaining > 0)
        forward = not forward
    middle = [int(index) for index in np.flatnonzero(counts % 2)]
    return [*half, *middle, *reversed(half)]
