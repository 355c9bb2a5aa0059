"""Readings of a campaign in groups by accelerometer, motion and noise, for simulation and fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from counterspin.campaign.conditions import (
    assumed_reading_temperatures,
    rate_clock_input,
    relative_conditions,
    temperature_directions,
)
from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import Reading
from counterspin.inference.joint.series import RATE
from counterspin.physics.station import Stations
from counterspin.readings.known_attitudes import Readings


def group_readings(campaign: Campaign, readings: Sequence[Reading]) -> list[Readings]:
    """Return readings grouped by accelerometer, motion and whether their noise was stated."""
    return [group for group, _ in numbered_groups(campaign, readings)]


def numbered_groups(
    campaign: Campaign, readings: Sequence[Reading]
) -> list[tuple[Readings, list[int]]]:
    """Return the groups of `group_readings`, each with the indices of its members."""
    assumed_temperatures = dict(assumed_reading_temperatures(campaign, readings))
    indices_by_group: dict[tuple[str, str, bool], list[int]] = {}
    for index, reading in enumerate(readings):
        key = (reading.accelerometer, reading.motion, reading.u is None)
        indices_by_group.setdefault(key, []).append(index)
    return [
        (
            _make_group(
                campaign,
                [readings[index] for index in indices],
                [assumed_temperatures.get(index, 0.0) for index in indices],
            ),
            indices,
        )
        for indices in indices_by_group.values()
    ]


def _make_group(
    campaign: Campaign, readings: Sequence[Reading], assumed_temperatures: Sequence[float]
) -> Readings:
    first_reading = readings[0]
    return Readings(
        accelerometer=first_reading.accelerometer,
        motion=first_reading.motion,
        names=tuple(r.name for r in readings),
        site=campaign.site,
        stations=Stations.at(
            first_reading.motion,
            np.array([r.axes.axes for r in readings]),
            rate=[
                r.measured_rate.value if r.measured_rate else r.rate * _rate_factor(campaign, r)
                for r in readings
            ],
            radius=[campaign.radius.value if r.rate else 0.0 for r in readings],
            amplitude=[r.amplitude for r in readings],
            bias_acceleration=[r.bias_acceleration for r in readings],
        ),
        mountings=tuple(r.mounting for r in readings),
        head=np.array([r.head for r in readings]),
        u_head=np.array([r.u_head for r in readings]),
        head_angle=np.array([r.head_angle for r in readings]),
        value=np.array([r.value for r in readings]),
        u=None if first_reading.u is None else np.array([r.u for r in readings], dtype=float),
        conditions=relative_conditions(
            campaign, readings, assumed_temperatures, temperature_directions(campaign)
        ),
        repeats=np.array([float(r.repeats) for r in readings]),
        scatter=np.array([r.scatter for r in readings]),
        resolution=min(r.resolution for r in readings),
        position=tuple(r.position for r in readings),
        in_si=np.array([float(r.in_si) for r in readings]),
        stated_sense=np.array([float(r.measured_rate is None) for r in readings]),
        stated_rates=tuple(r.rate for r in readings),
        u_rate=np.array([_relative_u_rate(campaign, r) for r in readings]),
        default_rate=np.array([float(not r.measured_rate and r.u_rate is None) for r in readings]),
        u_amplitude=np.array([r.u_amplitude for r in readings]),
        clocks=tuple(clock_name(campaign, r) for r in readings),
    )


def _rate_factor(campaign: Campaign, reading: Reading) -> float:
    """Return the ratio of the rate with corrected clock error to the stated rate."""
    clock = campaign.rate_clock or campaign.clock
    return 1.0 if clock is None or reading.uses_recorder_clock else 1.0 + clock.value


def clock_name(campaign: Campaign, reading: Reading) -> str:
    """Return the name of the input of the rate clock; empty at rest."""
    return ".".join(filter(None, rate_clock_input(campaign, reading))) if reading.rate else ""


def _relative_u_rate(campaign: Campaign, reading: Reading) -> float:
    """Return the relative random standard uncertainty of a rate."""
    if not reading.rate:
        return 0.0
    if reading.measured_rate is not None:
        return reading.measured_rate.u / abs(reading.measured_rate.value)
    if reading.u_rate is not None:
        return reading.u_rate / abs(reading.rate)
    # Estimated noise already contains the errors of the rates.
    is_unknown = reading.u is not None and not campaign.model.assumes(RATE)
    return campaign.typical_of(RATE) if is_unknown else 0.0
