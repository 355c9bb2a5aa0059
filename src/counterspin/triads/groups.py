"""Groups of poses with stated or estimated noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from counterspin.campaign.conditions import (
    assumed_temperatures,
    relative_conditions,
    temperature_directions,
)
from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import Reading
from counterspin.readings.groups import group_readings
from counterspin.readings.known_attitudes import Readings
from counterspin.triads.poses import TriadPoses


def all_groups(campaign: Campaign) -> list[Readings | TriadPoses]:
    """Return all readings of a campaign in groups, followed by the poses."""
    poses = campaign.triad.poses if campaign.triad else ()
    return [*group_readings(campaign, campaign.readings), *group_poses(campaign, poses)]


def group_poses(
    campaign: Campaign, poses: Sequence[Sequence[Reading]], noise_within_poses: float = 0.0
) -> list[TriadPoses]:
    """Return the poses with stated uncertainties as one group, and the others as another.

    noise_within_poses: Noise estimated within poses, for poses without a stated one, g.
    """
    groups = []
    for is_stated, noise in ((True, 0.0), (False, noise_within_poses)):
        members = [p for p in poses if all(r.u is not None for r in p) is is_stated]
        if members:
            groups.append(make_group(campaign, members, noise, [pose[0] for pose in poses]))
    return groups


def make_group(
    campaign: Campaign,
    poses: Sequence[Sequence[Reading]],
    noise_within_poses: float = 0.0,
    all_readings: Sequence[Reading] = (),
) -> TriadPoses:
    """Return poses as one group; its noise is stated if that of each reading is.

    all_readings: One reading of each pose of the campaign; default: of these poses.
    """
    first_readings = [pose[0] for pose in poses]
    directions = temperature_directions(campaign, all_readings or first_readings)
    assumed_offsets = assumed_temperatures(all_readings or first_readings)
    assumed_temperatures_of_poses = [
        assumed_offsets.get((reading.name, 0), 0.0) for reading in first_readings
    ]
    is_stated = all(reading.u is not None for pose in poses for reading in pose)
    return TriadPoses(
        accelerometers=tuple(reading.accelerometer for reading in poses[0]),
        names=tuple(first_reading.name for first_reading in first_readings),
        axes=np.array([reading.axes.matrix for reading in poses[0]]),
        gravity=campaign.site.gravity,
        value=np.array([[reading.value for reading in pose] for pose in poses]),
        u=np.array([[r.u for r in pose] for pose in poses], dtype=float) if is_stated else None,
        conditions=relative_conditions(
            campaign, first_readings, assumed_temperatures_of_poses, directions
        ),
        repeats=np.array([float(min(reading.repeats for reading in pose)) for pose in poses]),
        scatter=np.array([sum(reading.scatter for reading in pose) for pose in poses]),
        in_si=np.array([[float(reading.in_si) for reading in pose] for pose in poses]),
        noise_within_poses=noise_within_poses,
        resolution=min(reading.resolution for pose in poses for reading in pose),
    )
