"""Conditions of runs, readings and poses: temperatures and times."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, islice
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import PoseRecord, Reading
from counterspin.campaign.runs import Run
from counterspin.frozen import frozen
from counterspin.inference.joint.series import CLOCK, RATE_CLOCK
from counterspin.physics.conditions import RunConditions

#: Assumed rise of the temperature during a series of runs, readings or poses that states none, K.
DEFAULT_WARMING: Final = 1.0

#: Condition of slopes with a temperature that is assumed to change.
ASSUMED_TEMPERATURE: Final = "assumed temperature"

#: A change of temperature back by less than this is none, K.
REVERSAL: Final = 2.0


@frozen
class ReferencePoint:
    """The reference of the campaign's temperatures (K) and times (s)."""

    temperature: float
    time: float


def timed_items(campaign: Campaign) -> list[Run | Reading | PoseRecord]:
    """Return all items that may state temperature and time: runs, readings, records of poses."""
    pose_records = campaign.triad.records if campaign.triad else ()
    return [*campaign.runs, *campaign.all_readings, *pose_records]


def temperatures_of(campaign: Campaign) -> list[float]:
    """Return all temperatures that were taken, K."""
    return [temperature for item in timed_items(campaign) for temperature in item.temperature or ()]


def profile_mean(profile: Sequence[float]) -> float:
    """Return the mean of a course over its length: the ends count half."""
    if len(profile) == 1:
        return profile[0]
    return (sum(profile) - 0.5 * (profile[0] + profile[-1])) / (len(profile) - 1)


def reference_point(campaign: Campaign) -> ReferencePoint:
    """Return the reference temperature, or the mean of all; and the time of what came first."""
    items = timed_items(campaign)
    means = [profile_mean(item.temperature) for item in items if item.temperature]
    temperature = campaign.reference_temperature
    if temperature is None:
        temperature = sum(means) / len(means) if means else 0.0
    time = min((item.time for item in items if item.time is not None), default=0.0)
    return ReferencePoint(temperature, time)


def temperature_directions(
    campaign: Campaign, pose_readings: Sequence[Reading] = ()
) -> dict[str, tuple[float, ...]]:
    """Return 1/2 for temperatures that were reached while rising, -1/2 while falling.

    They are in the order of the times of runs and readings if all state theirs, else in the order
    of the description. Without a reversal by `REVERSAL` nothing is determined, and nothing is
    returned.

    pose_readings: Readings of the poses in records, in place of these records.
    Returns: By the name of a run, reading or record, for each of its temperatures.
    """
    items = timed_items(campaign)
    if pose_readings:
        names = {item.name for item in items}
        items = [item for item in items if not isinstance(item, PoseRecord)]
        items += [item for item in pose_readings if item.name not in names]
    with_temperature = [item for item in items if item.temperature]
    if all(item.time is not None for item in with_temperature):
        with_temperature.sort(key=lambda item: item.time or 0.0)
    profiles = [item.temperature or () for item in with_temperature]
    directions = _change_directions(list(chain.from_iterable(profiles)))
    if len({direction for direction in directions if direction}) < 2:
        return {}
    halves = (0.5 * direction for direction in directions)
    pairs = zip(with_temperature, profiles, strict=True)
    return {item.name: tuple(islice(halves, len(profile))) for item, profile in pairs}


def _change_directions(temperatures: Sequence[float]) -> list[int]:
    """Return the direction of temperature change at each value (1 rising, -1 falling).

    The first value has the direction of the second.
    """
    directions, direction, start, extreme = [0] * len(temperatures), 0, 0, 0
    for index, temperature in enumerate(temperatures):
        change = temperature - temperatures[extreme]
        if direction == 0 and abs(change) >= REVERSAL:
            direction, extreme = (1 if change > 0.0 else -1), index
        elif direction and change * direction >= 0.0:
            extreme = index
        elif direction and abs(change) >= REVERSAL:
            # What came after the turning point was on the way back already.
            directions[start : extreme + 1] = [direction] * (extreme + 1 - start)
            start, direction, extreme = extreme + 1, -direction, index
    directions[start:] = [direction] * (len(directions) - start)
    return directions


def run_conditions(
    campaign: Campaign, lengths: Mapping[str, float] | None = None
) -> dict[str, RunConditions]:
    """Return the conditions of every run with a record.

    Where the runs do not say when they were made, they count as made one after the other, without
    a pause: the least that a trend can have done between them. Where no run states a temperature,
    the temperature is assumed to rise (`DEFAULT_WARMING`).

    lengths: Run -> length of its record, s; those that are not there are taken from the
        description.
    """
    timeline = RunTimeline(campaign)
    return {
        run.name: timeline.add(run, (lengths or {}).get(run.name, run.duration or 0.0))
        for run in campaign.runs
    }


class RunTimeline:
    """Conditions of the runs of a campaign, as the lengths of their records become known."""

    def __init__(self, campaign: Campaign) -> None:
        self._origin = reference_point(campaign)
        self._directions = temperature_directions(campaign)
        self._assumed = assumed_temperatures(campaign.runs)
        self._elapsed = 0.0

    def add(self, run: Run, length: float) -> RunConditions:
        """Return the conditions of the next run; length: of its record, s."""
        origin = self._origin
        start = self._elapsed if run.time is None else run.time - origin.time
        self._elapsed += length
        offsets = [temperature - origin.temperature for temperature in run.temperature or ()]
        directions = self._directions.get(run.name, (0.0,))
        mean = profile_mean(offsets) if offsets else 0.0
        offset = self._assumed.get((run.name, 0), mean)
        conditions = RunConditions(start, offset, directions[0])
        if len(offsets) < 2 or not length:
            return conditions
        reversals = (
            _refine_reversal(offsets, int(step_index))
            for step_index in np.flatnonzero(np.diff(directions))
        )
        step = length / (len(offsets) - 1)
        return replace(
            conditions,
            temperature_profile=tuple(offsets),
            length=length,
            reversal_times=tuple(step * step_index for step_index in reversals),
        )


def _refine_reversal(profile: Sequence[float], index: int) -> float:
    """Return the reversal of a temperature profile whose extreme is at a place, in steps.

    That is the intersection of the lines before and after it, or the place itself near the ends.
    """
    if not 2 <= index < len(profile) - 2:
        return float(index)
    before_previous, previous, _, following, after_following = profile[index - 2 : index + 3]
    up, down = previous - before_previous, after_following - following
    if up == down:
        return float(index)
    shift = (following - previous - up - down) / (up - down)
    return index + min(max(shift, -1.0), 1.0)


def assumed_temperatures(series: Sequence[Run | Reading]) -> dict[tuple[str, int], float]:
    """Return the assumed temperatures of a series that states none, less the reference, K.

    They rise by the same step from member to member, by `DEFAULT_WARMING` in all. The order is that
    of the times if all state theirs, else that of the description.

    Returns: By the keys of `_member_keys`; empty where a member states its temperature, or of one
        member.
    """
    if len(series) < 2 or any(member.temperature is not None for member in series):
        return {}
    keys, order = _member_keys(series), list(range(len(series)))
    if all(member.time is not None for member in series):
        order.sort(key=lambda index: series[index].time or 0.0)
    offsets = DEFAULT_WARMING * np.linspace(-0.5, 0.5, len(series))
    return {keys[index]: offset for index, offset in zip(order, offsets.tolist(), strict=True)}


def _member_keys(series: Sequence[Run | Reading]) -> list[tuple[str, int]]:
    """Return name and number of each member: a table may name several readings alike."""
    seen: Counter[str] = Counter()
    keys = []
    for member in series:
        keys.append((member.name, seen[member.name]))
        seen[member.name] += 1
    return keys


def assumed_reading_temperatures(
    campaign: Campaign, readings: Sequence[Reading]
) -> Iterator[tuple[int, float]]:
    """Yield the places of readings whose temperature is assumed, and that, less the reference."""
    for name in campaign.accelerometers:
        series = [reading for reading in campaign.readings if reading.accelerometer == name]
        assumed = assumed_temperatures(series)
        indices = [
            position for position, reading in enumerate(readings) if reading.accelerometer == name
        ]
        for index, key in zip(
            indices, _member_keys([readings[position] for position in indices]), strict=True
        ):
            if key in assumed:
                yield index, assumed[key]


def relative_conditions(
    campaign: Campaign,
    readings: Sequence[Reading],
    assumed_temperatures: Sequence[float],
    directions: Mapping[str, tuple[float, ...]],
) -> dict[str, Array]:
    """Return the conditions of readings relative to the reference, by name, each of shape (n,).

    The centripetal force is zero, as at rest.

    assumed_temperatures: Of readings that state none, minus the reference temperature, K.
    directions: As in `temperature_directions`.
    """
    origin = reference_point(campaign)
    temperatures = [
        profile_mean(reading.temperature) - origin.temperature if reading.temperature else assumed
        for reading, assumed in zip(readings, assumed_temperatures, strict=True)
    ]
    times = [0.0 if r.time is None else r.time - origin.time for r in readings]
    return {
        "temperature": np.array(temperatures),
        "time": np.array(times),
        "direction": np.array([directions.get(r.name, (0.0,))[0] for r in readings]),
        "force": np.zeros(len(readings)),
    }


def has_assumed_warming(campaign: Campaign) -> bool:
    """Return whether a series of runs, readings or poses has assumed temperatures."""
    poses = campaign.triad.poses if campaign.triad else ()
    series = (campaign.runs, [pose[0] for pose in poses])
    warming = any(assumed_temperatures(members) for members in series)
    return warming or any(True for _ in assumed_reading_temperatures(campaign, campaign.readings))


def changing_conditions(campaign: Campaign) -> Iterator[str]:
    """Yield the conditions of slopes that change, and `ASSUMED_TEMPERATURE`."""
    if campaign.runs or any(reading.rate for reading in campaign.readings):
        yield "force"
    origin = reference_point(campaign)
    has_records = bool(campaign.runs) or bool(campaign.triad and campaign.triad.records)
    times = (item.time for item in timed_items(campaign))
    if has_records or any(time not in (None, origin.time) for time in times):
        yield "time"
    if temperature_directions(campaign):
        yield "direction"
    temperatures = set(temperatures_of(campaign))
    if any(run.temperature for run in campaign.runs):
        temperatures |= {
            origin.temperature + run.temperature_offset for run in run_conditions(campaign).values()
        }
    if temperatures - {origin.temperature}:
        yield "temperature"
    if has_assumed_warming(campaign):
        yield ASSUMED_TEMPERATURE


def rate_clock_input(campaign: Campaign, reading: Reading) -> tuple[str, str]:
    """Return recorder and symbol of the input that is the error of the clock of a rate."""
    is_shared = campaign.rate_clock is None and campaign.clock is not None
    return ("", CLOCK) if reading.by_clock or is_shared else ("", RATE_CLOCK)
