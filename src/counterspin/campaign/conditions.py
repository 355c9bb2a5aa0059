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

#: Assumed temperature rise during a series of runs, readings or poses without temperatures, K.
DEFAULT_WARMING: Final = 1.0

#: Condition of slopes with a temperature that is assumed to change.
ASSUMED_TEMPERATURE: Final = "assumed temperature"

#: Smallest temperature change in the opposite direction that counts as a reversal, K.
MIN_REVERSAL: Final = 2.0


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
    """Return all stated temperatures, K."""
    return [temperature for item in timed_items(campaign) for temperature in item.temperature or ()]


def profile_mean(profile: Sequence[float]) -> float:
    """Return the time average of a profile at equal intervals (trapezoidal rule)."""
    if len(profile) == 1:
        return profile[0]
    return (sum(profile) - 0.5 * (profile[0] + profile[-1])) / (len(profile) - 1)


def reference_point(campaign: Campaign) -> ReferencePoint:
    """Return the reference temperature, by default the mean, and the earliest time."""
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
    """Return 1/2 for each temperature reached while rising, -1/2 while falling.

    The order is that of the stated times, if all items state one, or else that of the description.
    Without a reversal by at least `MIN_REVERSAL`, the result is empty.

    pose_readings: Readings of the poses in records, in place of these records.
    Returns: Name of a run, reading or record -> direction at each of its temperatures.
    """
    items = timed_items(campaign)
    if pose_readings:
        names = {item.name for item in items}
        items = [item for item in items if not isinstance(item, PoseRecord)]
        items += [item for item in pose_readings if item.name not in names]
    items_with_temperature = [item for item in items if item.temperature]
    if all(item.time is not None for item in items_with_temperature):
        items_with_temperature.sort(key=lambda item: item.time or 0.0)
    profiles = [item.temperature or () for item in items_with_temperature]
    directions = _change_directions(list(chain.from_iterable(profiles)))
    if len({direction for direction in directions if direction}) < 2:
        return {}
    half_directions = (0.5 * direction for direction in directions)
    pairs = zip(items_with_temperature, profiles, strict=True)
    return {item.name: tuple(islice(half_directions, len(profile))) for item, profile in pairs}


def _change_directions(temperatures: Sequence[float]) -> list[int]:
    """Return the direction of temperature change at each value (1 rising, -1 falling).

    The first value has the direction of the second.
    """
    directions, direction, segment_start, extreme_index = [0] * len(temperatures), 0, 0, 0
    for index, temperature in enumerate(temperatures):
        change = temperature - temperatures[extreme_index]
        if direction == 0 and abs(change) >= MIN_REVERSAL:
            direction, extreme_index = (1 if change > 0.0 else -1), index
        elif direction and change * direction >= 0.0:
            extreme_index = index
        elif direction and abs(change) >= MIN_REVERSAL:
            # The samples after the extreme belong to the new direction.
            directions[segment_start : extreme_index + 1] = [direction] * (
                extreme_index + 1 - segment_start
            )
            segment_start, direction, extreme_index = extreme_index + 1, -direction, index
    directions[segment_start:] = [direction] * (len(directions) - segment_start)
    return directions


def run_conditions(
    campaign: Campaign, lengths: Mapping[str, float] | None = None
) -> dict[str, RunConditions]:
    """Return the conditions of every run with a record.

    Runs without a stated time are assumed to follow each other without a pause, which is the
    smallest possible effect of a trend. If no run states a temperature, the temperature is assumed
    to rise by `DEFAULT_WARMING`.

    lengths: Run -> length of its record, s; by default, the stated duration.
    """
    timeline = RunTimeline(campaign)
    return {
        run.name: timeline.add(run, (lengths or {}).get(run.name, run.duration or 0.0))
        for run in campaign.runs
    }


class RunTimeline:
    """Computes the conditions of consecutive runs as the lengths of their records become known."""

    def __init__(self, campaign: Campaign) -> None:
        self._reference = reference_point(campaign)
        self._directions = temperature_directions(campaign)
        self._assumed_offsets = assumed_temperatures(campaign.runs)
        self._elapsed = 0.0

    def add(self, run: Run, length: float) -> RunConditions:
        """Return the conditions of the next run, whose record has a length in s."""
        reference = self._reference
        start = self._elapsed if run.time is None else run.time - reference.time
        self._elapsed += length
        offsets = [temperature - reference.temperature for temperature in run.temperature or ()]
        directions = self._directions.get(run.name, (0.0,))
        mean_offset = profile_mean(offsets) if offsets else 0.0
        initial_offset = self._assumed_offsets.get((run.name, 0), mean_offset)
        conditions = RunConditions(start, initial_offset, directions[0])
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
    """Return the position of a temperature reversal near a sample, in steps.

    This is the intersection of the lines before and after the extreme; near the ends, the extreme.
    """
    if not 2 <= index < len(profile) - 2:
        return float(index)
    before_previous, previous, _, following, after_following = profile[index - 2 : index + 3]
    slope_before, slope_after = previous - before_previous, after_following - following
    if slope_before == slope_after:
        return float(index)
    shift = (following - previous - slope_before - slope_after) / (slope_before - slope_after)
    return index + min(max(shift, -1.0), 1.0)


def assumed_temperatures(series: Sequence[Run | Reading]) -> dict[tuple[str, int], float]:
    """Return the assumed temperatures of a series without stated ones, minus the reference, K.

    They rise in equal steps, by `DEFAULT_WARMING` in total. The order is that of the stated times,
    if all members state one, or else that of the description.

    Returns: Key of `_member_keys` -> temperature; empty if a member states its temperature, or if
        the series has fewer than two members.
    """
    if len(series) < 2 or any(member.temperature is not None for member in series):
        return {}
    keys, time_order = _member_keys(series), list(range(len(series)))
    if all(member.time is not None for member in series):
        time_order.sort(key=lambda index: series[index].time or 0.0)
    offsets = DEFAULT_WARMING * np.linspace(-0.5, 0.5, len(series))
    return {keys[index]: offset for index, offset in zip(time_order, offsets.tolist(), strict=True)}


def _member_keys(series: Sequence[Run | Reading]) -> list[tuple[str, int]]:
    """Return the name of each member, and its number among the members of the same name."""
    name_counts: Counter[str] = Counter()
    keys = []
    for member in series:
        keys.append((member.name, name_counts[member.name]))
        name_counts[member.name] += 1
    return keys


def assumed_reading_temperatures(
    campaign: Campaign, readings: Sequence[Reading]
) -> Iterator[tuple[int, float]]:
    """Yield index and assumed temperature of readings, minus the reference, K."""
    for name in campaign.accelerometers:
        series = [reading for reading in campaign.readings if reading.accelerometer == name]
        offset_by_key = assumed_temperatures(series)
        reading_indices = [
            index for index, reading in enumerate(readings) if reading.accelerometer == name
        ]
        for index, key in zip(
            reading_indices,
            _member_keys([readings[index] for index in reading_indices]),
            strict=True,
        ):
            if key in offset_by_key:
                yield index, offset_by_key[key]


def relative_conditions(
    campaign: Campaign,
    readings: Sequence[Reading],
    assumed_temperatures: Sequence[float],
    directions: Mapping[str, tuple[float, ...]],
) -> dict[str, Array]:
    """Return the conditions of readings relative to the reference, by name, each of shape (n,).

    The centripetal force is zero, as at rest.

    assumed_temperatures: Temperatures of readings that state none, minus the reference, K.
    directions: As in `temperature_directions`.
    """
    reference = reference_point(campaign)
    temperatures = [
        profile_mean(reading.temperature) - reference.temperature
        if reading.temperature
        else assumed_temperature
        for reading, assumed_temperature in zip(readings, assumed_temperatures, strict=True)
    ]
    times = [0.0 if reading.time is None else reading.time - reference.time for reading in readings]
    return {
        "temperature": np.array(temperatures),
        "time": np.array(times),
        "direction": np.array([directions.get(reading.name, (0.0,))[0] for reading in readings]),
        "force": np.zeros(len(readings)),
    }


def has_assumed_warming(campaign: Campaign) -> bool:
    """Return whether a series of runs, readings or poses has assumed temperatures."""
    poses = campaign.triad.poses if campaign.triad else ()
    series = (campaign.runs, [pose[0] for pose in poses])
    has_assumption = any(assumed_temperatures(members) for members in series)
    return has_assumption or any(
        True for _ in assumed_reading_temperatures(campaign, campaign.readings)
    )


def changing_conditions(campaign: Campaign) -> Iterator[str]:
    """Yield the conditions that vary in a campaign, and `ASSUMED_TEMPERATURE`."""
    if campaign.runs or any(reading.rate for reading in campaign.readings):
        yield "force"
    reference = reference_point(campaign)
    has_records = bool(campaign.runs) or bool(campaign.triad and campaign.triad.records)
    times = (item.time for item in timed_items(campaign))
    if has_records or any(time not in (None, reference.time) for time in times):
        yield "time"
    if temperature_directions(campaign):
        yield "direction"
    temperatures = set(temperatures_of(campaign))
    if any(run.temperature for run in campaign.runs):
        temperatures |= {
            reference.temperature + run.temperature_offset
            for run in run_conditions(campaign).values()
        }
    if temperatures - {reference.temperature}:
        yield "temperature"
    if has_assumed_warming(campaign):
        yield ASSUMED_TEMPERATURE


def rate_clock_input(campaign: Campaign, reading: Reading) -> tuple[str, str]:
    """Return recorder and symbol of the input for the error of the clock that measures a rate."""
    is_shared = campaign.rate_clock is None and campaign.clock is not None
    return ("", CLOCK) if reading.uses_recorder_clock or is_shared else ("", RATE_CLOCK)
