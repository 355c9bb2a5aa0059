"""Poses without a stated uncertainty, given the noise estimated in their fit, for a forecast."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from counterspin.calibration.model import model_of
from counterspin.calibration.posed.found_poses import noise_within, poses_of
from counterspin.campaign.description import Campaign
from counterspin.campaign.readings import Reading
from counterspin.campaign.triads.grouped import poses_together
from counterspin.inference.readings import solve_readings


def with_pose_noise(campaign: Campaign) -> Campaign:
    """Return a campaign each of whose poses has a value and a standard uncertainty.

    Those of records are found in them; the noise of those that state none is that of their fit.
    """
    if campaign.triad is None:
        return campaign
    found = poses_of(campaign)
    poses = [one.pose for one in found]
    blank = any(math.isnan(reading.value) for pose in poses for reading in pose)
    if blank or all(reading.u is not None for pose in poses for reading in pose):
        return campaign
    *_, group = poses_together(campaign, poses, noise_within(found, campaign.gravity.value))
    noise = solve_readings([group], model_of(campaign)).groups[0].noise
    noisy = tuple(_with_noise(pose, noise) for pose in poses)
    return replace(campaign, triad=replace(campaign.triad, poses=noisy, records=()))


def _with_noise(pose: Sequence[Reading], noise: float) -> tuple[Reading, ...]:
    """Return a pose with a noise, of one repeat, where it states none."""
    if all(reading.u is not None for reading in pose):
        return tuple(pose)
    repeats = min(reading.repeats for reading in pose)
    return tuple(replace(reading, u=noise / math.sqrt(repeats)) for reading in pose)
