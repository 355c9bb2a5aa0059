"""Poses of a triad in the joint fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.result_parts import Finding, TriadResult
from counterspin.campaign.description import Campaign
from counterspin.frozen import frozen
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import JointFit
from counterspin.readings.fitted import FittedReadings
from counterspin.readings.parts import poses_of
from counterspin.triads.checks import pose_findings
from counterspin.triads.found_poses import FoundPose, campaign_poses, noise_within
from counterspin.triads.groups import poses_together
from counterspin.triads.poses import TriadPoses
from counterspin.triads.result import triad_result

#: An input axis that no pose turns below the level by more than asin of this was never down.
_DOWN: Final = 0.3

#: Poses whose directions differ by less count as one direction in words, rad (3 deg).
_APART: Final = math.radians(3.0)


@frozen(eq=False)
class TriadInFit:
    """The triad of a campaign in the joint fit, as of `counterspin.readings.joining.TriadData`."""

    campaign: Campaign

    @cached_property
    def poses(self) -> list[FoundPose]:
        """Poses that were read, and those found in records."""
        return campaign_poses(self.campaign)

    def groups(self) -> Sequence[TriadPoses]:
        """Return the poses in groups with noise of one kind."""
        if not self.poses:
            return ()
        within = noise_within(self.poses, self.campaign.gravity.value)
        return poses_together(self.campaign, [found.pose for found in self.poses], within)

    def findings(self, fit: JointFit, posed: Sequence[FittedReadings]) -> list[Finding]:
        """Return the findings of tests of the residuals of poses."""
        return pose_findings(fit, posed)

    def advice(self, view: AccelerometerView) -> str:
        """Return the poses that would determine more of an accelerometer with poses only."""
        return too_few_poses(view)

    def result(self, estimated: Estimate, parts: Sequence[FittedReadings]) -> TriadResult:
        """Return the triad as the result states it."""
        found = {found.pose[0].name: found for found in self.poses}
        return triad_result(self.campaign, estimated, parts, found)


def too_few_poses(view: AccelerometerView) -> str:
    """Return the poses that would determine more of an accelerometer that has poses only."""
    axes: dict[str, list[Array]] = {}
    for part in poses_of(view):
        group = part.readings
        assert isinstance(group, TriadPoses)
        there = group.at(view.fit.model, view.fit.solution.estimate)
        for name, own in zip(group.accelerometers, group.axes, strict=True):
            axes.setdefault(name, []).append(there.direction @ own[0])
    count, distinct = _count_directions(view)
    free = sum(math.isinf(u.prior[1]) or u.defaulted for u in view.fit.model.unknowns)
    said = []
    if count < free:
        said.append(f" {count} poses are fewer than the {free} unknowns without a prior.")
    elif distinct < free:
        said.append(
            f" The {count} poses have only {distinct} different directions, fewer than the {free} "
            "unknowns without a prior."
        )
    for way, sign in (("up", -1.0), ("down", 1.0)):
        never = [name for name, own in axes.items() if np.min(sign * np.concatenate(own)) > -_DOWN]
        if never:
            said.append(f" No pose has {' or '.join(never)} pointing {way}.")
    return (
        "".join(said) + " Take poses whose directions are spread over the whole sphere, or "
        "request fewer coefficients in model.terms: the others then enter with their default "
        "priors."
    )


def _count_directions(view: AccelerometerView) -> tuple[int, int]:
    """Return the number of poses, and of directions that differ by more than `_APART`."""
    found: list[Array] = []
    count = 0
    for part in poses_of(view):
        group = part.readings
        assert isinstance(group, TriadPoses)
        count += group.size
        for direction in group.at(view.fit.model, view.fit.solution.estimate).direction:
            if all(direction @ other < math.cos(_APART) for other in found):
                found.append(direction)
    return count, len(found)
