"""Poses of a campaign's triad in groups by noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from counterspin.campaign.conditions import assumed_warmths, directions_of, mean_of, origin_of
from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import Reading
from counterspin.readings.groups import groups_of
from counterspin.readings.known_attitudes import Readings
from counterspin.triads.poses import TriadPoses


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
    assumed = assumed_warmths(found or firsts)
    stated = all(reading.u is not None for pose in poses for reading in pose)
    return TriadPoses(
        accelerometers=tuple(reading.accelerometer for reading in poses[0]),
        names=tuple(first.name for first in firsts),
        axes=np.array([reading.axes.matrix for reading in poses[0]]),
        gravity=campaign.site.gravity,
        value=np.array([[reading.value for reading in pose] for pose in poses]),
        u=np.array([[r.u for r in pose] for pose in poses], dtype=float) if stated else None,
        temperature=np.array(
            [
                mean_of(r.temperature) - warmth if r.temperature else assumed.get((r.name, 0), 0.0)
                for r in firsts
            ]
        ),
        time=np.array([(start if r.time is None else r.time) - start for r in firsts]),
        direction=np.array([ways.get(first.name, (0.0,))[0] for first in firsts]),
        repeats=np.array([float(min(reading.repeats for reading in pose)) for pose in poses]),
        scatter=np.array([sum(reading.scatter for reading in pose) for pose in poses]),
        in_si=np.array([[float(reading.in_si) for reading in pose] for pose in poses]),
        within=within,
        resolution=min(reading.resolution for pose in poses for reading in pose),
    )
