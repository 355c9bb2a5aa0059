"""Poses of a triad in the joint fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.result_parts import Finding, TriadResult
from counterspin.campaign.description import Campaign
from counterspin.frozen import frozen
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import JointFit
from counterspin.readings.fitted import FittedReadings
from counterspin.readings.reading_groups import pose_groups
from counterspin.triads.checks import pose_findings
from counterspin.triads.groups import group_poses
from counterspin.triads.poses import TriadPoses
from counterspin.triads.record_poses import LocatedPose, campaign_poses, pooled_noise
from counterspin.triads.result import triad_result

#: An input axis that no pose turns below the level by more than asin of this was never down.
_MIN_VERTICAL_COSINE: Final = 0.3

#: Poses whose directions differ by less count as one direction in words, rad (3 deg).
_MIN_SEPARATION: Final = math.radians(3.0)


@frozen(eq=False)
class TriadInFit:
    """The triad of a campaign in the joint fit (a `TriadData`)."""

    campaign: Campaign

    @cached_property
    def poses(self) -> list[LocatedPose]:
        """Poses that were read, and those found in records."""
        return campaign_poses(self.campaign)

    def groups(self) -> Sequence[TriadPoses]:
        """Return the poses in groups with noise of one kind."""
        if not self.poses:
            return ()
        noise_within_poses = pooled_noise(self.poses, self.campaign.gravity.value)
        return group_poses(self.campaign, [pose.pose for pose in self.poses], noise_within_poses)

    def findings(self, fit: JointFit, groups: Sequence[FittedReadings]) -> list[Finding]:
        """Return the findings of tests of the residuals of poses."""
        # All accelerometers usually share the fit and the groups.
        key = (id(fit), *map(id, groups))
        if key not in self._findings_cache:
            self._findings_cache[key] = fit, groups, pose_findings(fit, groups)
        return self._findings_cache[key][2]

    @cached_property
    def _findings_cache(self) -> dict[tuple[int, ...], tuple[JointFit, Any, list[Finding]]]:
        """Fits and groups that were tested, by identity, with their findings."""
        return {}

    def advice(self, view: AccelerometerView) -> str:
        """Return the poses that would determine more of an accelerometer with poses only."""
        return pose_advice(view)

    def result(self, estimate: Estimate, groups: Sequence[FittedReadings]) -> TriadResult:
        """Return the triad as the result states it."""
        poses_by_name = {poses.pose[0].name: poses for poses in self.poses}
        return triad_result(self.campaign, estimate, groups, poses_by_name)


def pose_advice(view: AccelerometerView) -> str:
    """Return the poses that would determine more of an accelerometer that has poses only."""
    axes: dict[str, list[Array]] = {}
    for fitted_group in pose_groups(view):
        group = fitted_group.readings
        assert isinstance(group, TriadPoses)
        solved_poses = group.at(view.fit.model, view.fit.solution.estimate)
        for name, projections in zip(group.accelerometers, group.axes, strict=True):
            axes.setdefault(name, []).append(solved_poses.direction @ projections[0])
    n_poses, n_directions = _count_directions(view)
    free_count = sum(
        math.isinf(unknown.prior[1]) or unknown.uses_fallback_prior
        for unknown in view.fit.model.unknowns
    )
    sentences = []
    if n_poses < free_count:
        sentences.append(
            f" {n_poses} poses cannot determine {free_count} unknowns without a prior."
        )
    elif n_directions < free_count:
        sentences.append(
            f" The {n_poses} poses have only {n_directions} different directions, which cannot "
            f"determine {free_count} unknowns without a prior."
        )
    for direction, sign in (("up", -1.0), ("down", 1.0)):
        missing_directions = [
            name
            for name, projections in axes.items()
            if np.min(sign * np.concatenate(projections)) > -_MIN_VERTICAL_COSINE
        ]
        if missing_directions:
            sentences.append(
                f" In no pose does {' or '.join(missing_directions)} point {direction}."
            )
    return (
        "".join(sentences)
        + " Measure poses with directions spread over the whole sphere. Alternatively, request "
        "fewer coefficients in model.terms; the other coefficients then have default priors."
    )


def _count_directions(view: AccelerometerView) -> tuple[int, int]:
    """Return the number of poses, and of directions that differ by more than `_APART`."""
    directions: list[Array] = []
    n_poses = 0
    for fitted_group in pose_groups(view):
        group = fitted_group.readings
        assert isinstance(group, TriadPoses)
        n_poses += group.size
        for direction in group.at(view.fit.model, view.fit.solution.estimate).direction:
            if all(
                direction @ counted_direction < math.cos(_MIN_SEPARATION)
                for counted_direction in directions
            ):
                directions.append(direction)
    return n_poses, len(directions)
