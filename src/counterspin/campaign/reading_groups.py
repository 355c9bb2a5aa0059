"""Readings of a campaign by accelerometer, motion and noise, as simulation and fit take them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from counterspin.campaign.conditions import origin_of
from counterspin.campaign.readings import Reading
from counterspin.campaign.resolved import Campaign
from counterspin.inference.readings import Readings
from counterspin.physics.station import Station


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
    origin = origin_of(campaign)
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
        value=np.array([r.value for r in readings]),
        u=None if first.u is None else np.array([r.u for r in readings], dtype=float),
        temperature=np.array(
            [(reference if r.temperature is None else r.temperature) - reference for r in readings]
        ),
        time=np.array([(start if r.time is None else r.time) - start for r in readings]),
        repeats=np.array([float(r.repeats) for r in readings]),
        scatter=np.array([r.scatter for r in readings]),
        in_si=np.array([float(r.in_si) for r in readings]),
    )
