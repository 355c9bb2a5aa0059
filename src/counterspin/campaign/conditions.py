"""Conditions of runs, readings and poses: temperatures and times."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, islice
from typing import Final

import numpy as np

from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import PoseRecord, Reading
from counterspin.campaign.runs import Run
from counterspin.frozen import frozen
from counterspin.inference.joint.series import CLOCK, RATE_CLOCK
from counterspin.physics.effects import RunConditions

#: Assumed rise of the temperature during a series of runs, readings or poses that states none, K.
UNKNOWN_WARMING: Final = 1.0


#: A change of temperature back by less than this is none, K.
REVERSAL: Final = 2.0


@frozen
class Origin:
    """The reference of the campaign's temperatures (K) and times (s)."""

    temperature: float
    time: float


def dated_of(campaign: Campaign) -> list[Run | Reading | PoseRecord]:
    """Return all items that may state temperature and time: runs, readings, records of poses."""
    posed = campaign.triad.records if campaign.triad else ()
    return [*campaign.runs, *campaign.all_readings, *posed]


def temperatures_of(campaign: Campaign) -> list[float]:
    """Return all temperatures that were taken, K."""
    return [temperature for one in dated_of(campaign) for temperature in one.temperature or ()]


def mean_of(course: Sequence[float]) -> float:
    """Return the mean of a course over its length: the ends count half."""
    if len(course) == 1:
        return course[0]
    return (sum(course) - 0.5 * (course[0] + course[-1])) / (len(course) - 1)


def origin_of(campaign: Campaign) -> Origin:
    """Return the reference temperature, or the mean of all; and the time of what came first."""
    dated = dated_of(campaign)
    warmths = [mean_of(one.temperature) for one in dated if one.temperature]
    temperature = campaign.reference_temperature
    if temperature is None:
        temperature = sum(warmths) / len(warmths) if warmths else 0.0
    time = min((one.time for one in dated if one.time is not None), default=0.0)
    return Origin(temperature, time)


def directions_of(
    campaign: Campaign, found: Sequence[Reading] = ()
) -> dict[str, tuple[float, ...]]:
    """Return 1/2 for temperatures that were reached while rising, -1/2 while falling.

    They are in the order of the times of runs and readings if all state theirs, else in the order
    of the description. Without a reversal by `REVERSAL` nothing is determined, and nothing is
    returned.

    found: Values in the records, instead of the stated ones.
    Returns: By the name of a run, reading or record, for each of its temperatures.
    """
    dated = dated_of(campaign)
    if found:
        known = {one.name for one in dated}
        dated = [one for one in dated if not isinstance(one, PoseRecord)]
        dated += [one for one in found if one.name not in known]
    warm = [one for one in dated if one.temperature]
    if all(one.time is not None for one in warm):
        warm.sort(key=lambda one: one.time or 0.0)
    courses = [one.temperature or () for one in warm]
    ways = _ways(list(chain.from_iterable(courses)))
    if len({way for way in ways if way}) < 2:
        return {}
    halves = (0.5 * way for way in ways)
    every = zip(warm, courses, strict=True)
    return {one.name: tuple(islice(halves, len(course))) for one, course in every}


def _ways(temperatures: Sequence[float]) -> list[int]:
    """Return the direction of temperature change at each value (1 rising, -1 falling).

    The first value has the direction of the second.
    """
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
    a pause: the least that a trend can have done between them. Where no run states a temperature,
    the temperature is assumed to rise (`UNKNOWN_WARMING`).

    lengths: Run -> length of its record, s; those that are not there are taken from the
        description.
    """
    origin, ways = origin_of(campaign), directions_of(campaign)
    conditions, elapsed = {}, 0.0
    for run in campaign.runs:
        start = elapsed if run.time is None else run.time - origin.time
        length = (lengths or {}).get(run.name, run.duration or 0.0)
        warmths = [temperature - origin.temperature for temperature in run.temperature or ()]
        way = ways.get(run.name, (0.0,))
        one = RunConditions(start, mean_of(warmths) if warmths else 0.0, way[0])
        if len(warmths) > 1 and length:
            one = replace(one, temperature_profile=tuple(warmths), length=length)
            turned = (_turn(warmths, int(place)) for place in np.flatnonzero(np.diff(way)))
            step = length / (len(warmths) - 1)
            one = replace(one, reversal_times=tuple(step * place for place in turned))
        conditions[run.name] = one
        elapsed += length
    assumed = assumed_warmths(campaign.runs)
    return {
        name: replace(of_run, temperature_offset=assumed.get((name, 0), of_run.temperature_offset))
        for name, of_run in conditions.items()
    }


def _turn(course: Sequence[float], place: int) -> float:
    """Return the reversal of a temperature profile whose extreme is at a place, in steps.

    That is the intersection of the lines before and after it, or the place itself near the ends.
    """
    if not 2 <= place < len(course) - 2:
        return float(place)
    come, before, _, after, gone = course[place - 2 : place + 3]
    up, down = before - come, gone - after
    if up == down:
        return float(place)
    beside = (after - before - up - down) / (up - down)
    return place + min(max(beside, -1.0), 1.0)


def assumed_warmths(series: Sequence[Run | Reading]) -> dict[tuple[str, int], float]:
    """Return the assumed temperatures of a series that states none, less the reference, K.

    They rise by the same step from member to member, by `UNKNOWN_WARMING` in all. The order is that
    of the times if all state theirs, else that of the description.

    Returns: By the keys of `_keys`; empty where a member states its temperature, or of one member.
    """
    if len(series) < 2 or any(member.temperature is not None for member in series):
        return {}
    keys, places = _keys(series), list(range(len(series)))
    if all(member.time is not None for member in series):
        places.sort(key=lambda place: series[place].time or 0.0)
    warmths = UNKNOWN_WARMING * np.linspace(-0.5, 0.5, len(series))
    return {keys[place]: warmth for place, warmth in zip(places, warmths.tolist(), strict=True)}


def _keys(series: Sequence[Run | Reading]) -> list[tuple[str, int]]:
    """Return name and number of each member: a table may name several readings alike."""
    seen: Counter[str] = Counter()
    keys = []
    for member in series:
        keys.append((member.name, seen[member.name]))
        seen[member.name] += 1
    return keys


def assumed_of_readings(
    campaign: Campaign, readings: Sequence[Reading]
) -> Iterator[tuple[int, float]]:
    """Yield the places of readings whose temperature is assumed, and that, less the reference."""
    for name in campaign.accelerometers:
        series = [reading for reading in campaign.readings if reading.accelerometer == name]
        assumed = assumed_warmths(series)
        places = [k for k, reading in enumerate(readings) if reading.accelerometer == name]
        for place, key in zip(places, _keys([readings[k] for k in places]), strict=True):
            if key in assumed:
                yield place, assumed[key]


def has_assumed_warming(campaign: Campaign) -> bool:
    """Return whether a series of runs, readings or poses has assumed temperatures."""
    poses = campaign.triad.poses if campaign.triad else ()
    series = (campaign.runs, [pose[0] for pose in poses])
    warming = any(assumed_warmths(members) for members in series)
    return warming or any(True for _ in assumed_of_readings(campaign, campaign.readings))


def clock_of(campaign: Campaign, reading: Reading) -> tuple[str, str]:
    """Return recorder and symbol of the input that is the error of the clock of a rate."""
    recorded = reading.record is not None and campaign.angle is not None
    shared = campaign.rate_clock is None and campaign.clock is not None
    return ("", CLOCK) if recorded or shared else ("", RATE_CLOCK)
