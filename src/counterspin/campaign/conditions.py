"""Under which conditions runs were made: how warm, and when; and readings grouped with theirs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.campaign.description import Campaign
from counterspin.campaign.readings import Reading
from counterspin.campaign.resolved import Run
from counterspin.campaign.triads.declared import PoseRecord
from counterspin.frozen import frozen
from counterspin.inference.linear_readings import Readings
from counterspin.physics.effects import RunConditions
from counterspin.physics.station import Station

#: By how much it is assumed to become warmer in a campaign that records no temperature, K.
UNKNOWN_WARMING: Final = 1.0


#: A change of temperature back by less than this is none, K.
REVERSAL: Final = 2.0


@frozen
class Origin:
    """From where the campaign's temperatures (K) and times (s) count."""

    temperature: float
    time: float


def dated_of(campaign: Campaign) -> list[Run | Reading | PoseRecord]:
    """Return whatever may state a temperature and a time: runs, readings and records of poses."""
    posed = campaign.triad.records if campaign.triad else ()
    return [*campaign.runs, *campaign.all_readings, *posed]


def temperatures_of(campaign: Campaign) -> list[float]:
    """Return the temperatures that are stated, K."""
    return [one.temperature for one in dated_of(campaign) if one.temperature is not None]


def origin_of(campaign: Campaign) -> Origin:
    """Return the reference temperature, or the mean of all; and the time of what came first."""
    dated = dated_of(campaign)
    warmths = temperatures_of(campaign)
    temperature = campaign.reference_temperature
    if temperature is None:
        temperature = sum(warmths) / len(warmths) if warmths else 0.0
    time = min((one.time for one in dated if one.time is not None), default=0.0)
    return Origin(temperature, time)


def directions_of(campaign: Campaign) -> dict[str, float]:
    """Return 1/2 for runs and readings on the way up in temperature, -1/2 on the way down.

    They are in the order of their times where all state theirs, else in that of the description.
    Where the temperature never came back by `REVERSAL`, there is nothing to tell: none is returned.
    """
    warm = [one for one in dated_of(campaign) if one.temperature is not None]
    if all(one.time is not None for one in warm):
        warm.sort(key=lambda one: one.time or 0.0)
    ways = _ways([one.temperature or 0.0 for one in warm])
    if len({way for way in ways if way}) < 2:
        return {}
    return {one.name: 0.5 * way for one, way in zip(warm, ways, strict=True)}


def _ways(temperatures: Sequence[float]) -> list[int]:
    """Return whether each was reached on the way up (1) or down (-1); the first as the second."""
    ways, way, begin, extreme = [0] * len(temperatures), 0, 0, 0
    for place, temperature in enumerate(temperatures):
        change = temperature - temperatures[extreme]
        if way == 0 and abs(change) >= REVERSAL:
            way, extreme = (1 if change > 0.0 else -1), place
        elif way and change * way >= 0.0:
            extreme = place
        elif way and abs(change) >= REVERSAL:
            # What came after the turning point was on the way back already.
            ways[begin : extreme + 1] = [way] * (extreme + 1 - begin)
            begin, way, extreme = extreme + 1, -way, place
    ways[begin:] = [way] * (len(ways) - begin)
    return ways


def conditions_of(
    campaign: Campaign, lengths: Mapping[str, float] | None = None
) -> dict[str, RunConditions]:
    """Return the conditions of every run with a record.

    Where the runs do not say when they were made, they count as made one after the other, without
    a pause: the least that a trend can have done between them. Where none of them says how warm it
    was, it counts as having become warmer from run to run, by `UNKNOWN_WARMING` from the first to
    the last.

    lengths: Run -> length of its record, s; those that are not there are taken from the
        description.
    """
    origin, ways = origin_of(campaign), directions_of(campaign)
    conditions, elapsed = {}, 0.0
    for run in campaign.runs:
        start = elapsed if run.time is None else run.time - origin.time
        warmth = 0.0 if run.temperature is None else run.temperature - origin.temperature
        conditions[run.name] = RunConditions(start, warmth, ways.get(run.name, 0.0))
        elapsed += (lengths or {}).get(run.name, run.duration or 0.0)
    if all(run.temperature is None for run in campaign.runs):
        return _warming(conditions)
    return conditions


def _warming(conditions: Mapping[str, RunConditions]) -> dict[str, RunConditions]:
    """Return conditions with temperatures that nobody took: the same step from run to run."""
    last = len(conditions) - 1
    if last < 1:
        return dict(conditions)
    return {
        name: replace(of_run, warmth=UNKNOWN_WARMING * (place / last - 0.5))
        for place, (name, of_run) in enumerate(conditions.items())
    }


# Readings of a campaign by accelerometer, motion and noise, as simulation and fit take them


def groups_of(campaign: Campaign, readings: Sequence[Reading]) -> list[Readings]:
    """Return the readings by accelerometer, motion and whether their noise was stated."""
    keys = dict.fromkeys((r.accelerometer, r.motion, r.u is None) for r in readings)
    return [
        _group(
            campaign,
            [r for r in readings if (r.accelerometer, r.motion, r.u is None) == key],
        )
        for key in keys
    ]


def _group(campaign: Campaign, readings: Sequence[Reading]) -> Readings:
    first = readings[0]
    origin, ways = origin_of(campaign), directions_of(campaign)
    reference, start = origin.temperature, origin.time
    return Readings(
        accelerometer=first.accelerometer,
        motion=first.motion,
        names=tuple(r.name for r in readings),
        site=campaign.site,
        stations=tuple(
            Station(r.motion, r.axes, rate=r.rate, radius=campaign.radius.value if r.rate else 0.0)
            for r in readings
        ),
        mountings=tuple(r.mounting for r in readings),
        head=np.array([r.head for r in readings]),
        u_head=np.array([r.u_head for r in readings]),
        head_angle=np.array([r.head_angle for r in readings]),
        value=np.array([r.value for r in readings]),
        u=None if first.u is None else np.array([r.u for r in readings], dtype=float),
        temperature=np.array(
            [(reference if r.temperature is None else r.temperature) - reference for r in readings]
        ),
        time=np.array([(start if r.time is None else r.time) - start for r in readings]),
        direction=np.array([ways.get(r.name, 0.0) for r in readings]),
        repeats=np.array([float(r.repeats) for r in readings]),
        scatter=np.array([r.scatter for r in readings]),
        resolution=min(r.resolution for r in readings),
        position=tuple(r.position for r in readings),
        in_si=np.array([float(r.in_si) for r in readings]),
    )
