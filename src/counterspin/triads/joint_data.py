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
from counterspin.triads.poses import TriadPoses, count_free
from counterspin.triads.record_poses import LocatedPose, campaign_poses, pooled_noise
from counterspin.triads.result import triad_result

#: An input axis counts as pointing down (or up) if it is steeper than asin of this in a pose.
_MIN_VERTICAL_COSINE: Final = 0.3

#: Directions closer than this count as one in messages, rad (3 deg).
_MIN_SEPARATION: Final = math.radians(3.0)


@frozen(eq=False)
class TriadInFit:
    """The triad of a campaign in the joint fit (a `TriadData`)."""

    campaign: Campaign

    @cached_property
    def poses(self) -> list[LocatedPose]:
        """Poses stated as readings, and poses detected in records."""
        return campaign_poses(self.campaign)

    def groups(self) -> Sequence[TriadPoses]:
        """Return the poses in groups with stated or estimated noise."""
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
        """Cache of the findings, by the identity of the fit and the groups."""
        return {}

    def advice(self, view: AccelerometerView) -> str:
        """Return the advice for an accelerometer with poses only."""
        return pose_advice(view)

    def result(self, estimate: Estimate, groups: Sequence[FittedReadings]) -> TriadResult:
        """Return the result for the triad."""
        poses_by_name = {pose.pose[0].name: pose for pose in self.poses}
        return triad_result(self.campaign, estimate, groups, poses_by_name)


def pose_advice(view: AccelerometerView) -> str:
    """Return advice on the poses that would determine more unknowns."""
    axes: dict[str, list[Array]] = {}
    for fitted_group in pose_groups(view):
        group = fitted_group.readings
        assert isinstance(group, TriadPoses)
        solved_poses = group.at(view.fit.model, view.fit.solution.estimate)
        for name, projections in zip(group.accelerometers, group.axes, strict=True):
            axes.setdefault(name, []).append(solved_poses.direction @ projections[0])
    n_poses, n_directions = _count_directions(view)
    n_free = count_free(view.fit.model)
    sentences = []
    if n_poses < n_free:
        sentences.append(f" {n_poses} poses cannot determine {n_free} unknowns without a prior.")
    elif n_directions < n_free:
        sentences.append(
            f" The {n_poses} poses have only {n_directions} different directions, which cannot "
            f"determine {n_free} unknowns without a prior."
        )
    for direction, sign in (("up", -1.0), ("down", 1.0)):
        unturned_names = [
            name
            for name, projections in axes.items()
            if np.min(sign * np.concatenate(projections)) > -_MIN_VERTICAL_COSINE
        ]
        if unturned_names:
            sentences.append(f" In no pose does {' or '.join(unturned_names)} point {direction}.")
    return (
        "".join(sentences)
        + " Measure poses with directions spread over the whole sphere. Alternatively, request "
        "fewer coefficients in model.terms; the other coefficients then have default priors."
    )


def _count_directions(view: AccelerometerView) -> tuple[int, int]:
    """Return the number of poses, and of directions at least `_MIN_SEPARATION` apart."""
    directions: list[Array] = []
    n_poses = 0
    for fitted_group in pose_groups(view):
        group = fitted_group.readings
        assert isinstance(group, TriadPoses)
        n_poses += group.size
        for direction in group.at(view.fit.model, view.fit.solution.estimate).direction:
            if all(direction @ other < math.cos(_MIN_SEPARATION) for other in directions):
                directions.append(direction)
    return n_poses, len(directions)
