"""Under which conditions runs were made: how warm, and when; and readings grouped with theirs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain, islice
from typing import Final

import numpy as np

from counterspin.campaign.description import Campaign
from counterspin.campaign.readings import Reading
from counterspin.campaign.runs import Run
from counterspin.campaign.triad import PoseRecord
from counterspin.frozen import frozen
from counterspin.inference.joint.series import CLOCK, RATE_CLOCK
from counterspin.inference.linear_readings import RATE, Readings
from counterspin.inference.poses import TriadPoses
from counterspin.physics.effects import RunConditions
from counterspin.physics.station import Station

#: By how much it is assumed to become warmer in a campaign that records no temperature, K.
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
        length = (lengths or {}).get(run.name, run.duration or 0.0)
        warmths = [temperature - origin.temperature for temperature in run.temperature or ()]
        way = ways.get(run.name, (0.0,))
        one = RunConditions(start, mean_of(warmths) if warmths else 0.0, way[0])
        if len(warmths) > 1 and length:
            one = replace(one, course=tuple(warmths), length=length)
            turned = (_turn(warmths, int(place)) for place in np.flatnonzero(np.diff(way)))
            step = length / (len(warmths) - 1)
            one = replace(one, turns=tuple(step * place for place in turned))
        conditions[run.name] = one
        elapsed += length
    if all(run.temperature is None for run in campaign.runs):
        return _warming(conditions)
    return conditions


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


def _warming(conditions: Mapping[str, RunConditions]) -> dict[str, RunConditions]:
    """Return conditions with assumed temperatures: the same step from run to run."""
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
            Station(
                r.motion,
                r.axes,
                rate=r.measured.value if r.measured else r.rate * _rate_factor(campaign, r),
                radius=campaign.radius.value if r.rate else 0.0,
            )
            for r in readings
        ),
        mountings=tuple(r.mounting for r in readings),
        head=np.array([r.head for r in readings]),
        u_head=np.array([r.u_head for r in readings]),
        head_angle=np.array([r.head_angle for r in readings]),
        value=np.array([r.value for r in readings]),
        u=None if first.u is None else np.array([r.u for r in readings], dtype=float),
        temperature=np.array(
            [mean_of(r.temperature) - reference if r.temperature else 0.0 for r in readings]
        ),
        time=np.array([(start if r.time is None else r.time) - start for r in readings]),
        direction=np.array([ways.get(r.name, (0.0,))[0] for r in readings]),
        repeats=np.array([float(r.repeats) for r in readings]),
        scatter=np.array([r.scatter for r in readings]),
        resolution=min(r.resolution for r in readings),
        position=tuple(r.position for r in readings),
        in_si=np.array([float(r.in_si) for r in readings]),
        stated_sense=np.array([float(r.measured is None) for r in readings]),
        stated_rates=tuple(r.rate for r in readings),
        u_rate=np.array([_relative_u_rate(campaign, r) for r in readings]),
        default_rate=np.array([float(not r.measured and r.u_rate is None) for r in readings]),
        clocks=tuple(name_of_clock(campaign, r) for r in readings),
    )


def clock_of(campaign: Campaign, reading: Reading) -> tuple[str, str]:
    """Return recorder and symbol of the input that is the error of the clock of a rate."""
    recorded = reading.record is not None and campaign.angle is not None
    shared = campaign.rate_clock is None and campaign.clock is not None
    return ("", CLOCK) if recorded or shared else ("", RATE_CLOCK)


def _rate_factor(campaign: Campaign, reading: Reading) -> float:
    """Return the rate by a clock whose stated error is corrected over the stated rate."""
    clock = campaign.rate_clock or campaign.clock
    return 1.0 if clock is None or reading.by_clock else 1.0 + clock.value


def name_of_clock(campaign: Campaign, reading: Reading) -> str:
    """Return the name of that input; empty where nothing turns."""
    return ".".join(filter(None, clock_of(campaign, reading))) if reading.rate else ""


def _relative_u_rate(campaign: Campaign, reading: Reading) -> float:
    """Return the random standard uncertainty of a rate, relative."""
    if not reading.rate:
        return 0.0
    if reading.measured is not None:
        return reading.measured.u / abs(reading.measured.value)
    if reading.u_rate is not None:
        return reading.u_rate / abs(reading.rate)
    # An estimated noise contains the errors of the rates already.
    unknown = reading.u is not None and not campaign.model.assumes(RATE)
    return campaign.typical_of(RATE) if unknown else 0.0


# Poses of a triad, grouped likewise


def all_groups(campaign: Campaign) -> list[Readings | TriadPoses]:
    """Return all readings of a campaign, those of poses behind the others."""
    poses = campaign.triad.poses if campaign.triad else ()
    return [*groups_of(campaign, campaign.readings), *poses_together(campaign, poses)]


def poses_together(
    campaign: Campaign, poses: Sequence[Sequence[Reading]], within: float = 0.0
) -> list[TriadPoses]:
    """Return poses grouped by whether their noise was stated, for all three axes.

    within: Noise from the rows within poses, for poses that state none, g.
    """
    stated = [all(reading.u is not None for reading in pose) for pose in poses]
    kinds = {
        known: [pose for pose, own in zip(poses, stated, strict=True) if own is known]
        for known in (True, False)
    }
    return [
        one_group(campaign, own, 0.0 if known else within, [pose[0] for pose in poses])
        for known, own in kinds.items()
        if own
    ]


def one_group(
    campaign: Campaign,
    poses: Sequence[Sequence[Reading]],
    within: float = 0.0,
    found: Sequence[Reading] = (),
) -> TriadPoses:
    """Return poses as one group, whose noise is stated if the noise of all of them is.

    found: One reading of every existing pose, if these are not all.
    """
    firsts = [pose[0] for pose in poses]
    origin, ways = origin_of(campaign), directions_of(campaign, found or firsts)
    warmth, start = origin.temperature, origin.time
    stated = all(reading.u is not None for pose in poses for reading in pose)
    return TriadPoses(
        accelerometers=tuple(reading.accelerometer for reading in poses[0]),
        names=tuple(first.name for first in firsts),
        axes=np.array([reading.axes.matrix for reading in poses[0]]),
        gravity=campaign.site.gravity,
        value=np.array([[reading.value for reading in pose] for pose in poses]),
        u=np.array([[r.u for r in pose] for pose in poses], dtype=float) if stated else None,
        temperature=np.array(
            [mean_of(r.temperature) - warmth if r.temperature else 0.0 for r in firsts]
        ),
        time=np.array([(start if r.time is None else r.time) - start for r in firsts]),
        direction=np.array([ways.get(first.name, (0.0,))[0] for first in firsts]),
        repeats=np.array([float(min(reading.repeats for reading in pose)) for pose in poses]),
        scatter=np.array([sum(reading.scatter for reading in pose) for pose in poses]),
        in_si=np.array([[float(reading.in_si) for reading in pose] for pose in poses]),
        within=within,
        resolution=min(reading.resolution for pose in poses for reading in pose),
    )
