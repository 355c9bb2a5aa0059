"""What speaks against poses at unknown attitudes: poses off the model, too few, all on one side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.diagnosis.reading_findings import lone_or_many, unjudged
from counterspin.calibration.findings import lack_of_fit
from counterspin.calibration.joint_view import AccelerometerView
from counterspin.calibration.readings import FittedPoses, residual_of
from counterspin.calibration.result_parts import Finding
from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.inference.readings import FEWEST_FREEDOM
from counterspin.reports.numbers import format_number

#: What findings about the poses of a triad are about.
TRIAD: Final = "triad"

#: An input axis that no pose turns below the level by more than asin of this was never down.
_DOWN: Final = 0.3


def pose_findings(posed: Sequence[FittedPoses]) -> list[Finding]:
    """Return what speaks against the poses: residuals that are no noise, poses that stand out."""
    findings = []
    for part in posed:
        if part.dof < FEWEST_FREEDOM:
            findings.append(unjudged(TRIAD, part))
        elif part.freedom < FEWEST_FREEDOM:
            findings.append(_few_left(part))
        residual = residual_of([part])
        p = residual.lack_of_fit_p
        if p is not None and p < 0.5 * SIGNIFICANCE / len(posed):
            said = f"The residuals of the {part.words} do not agree with the stated noise"
            findings.append(lack_of_fit(TRIAD, [f"{said} (p = {p:.2g})."], residual))
        findings += lone_or_many(TRIAD, part)
    return findings


def _few_left(part: FittedPoses) -> Finding:
    left = format_number(part.freedom, 2) if part.freedom >= 0.05 else "no"
    text = (
        f"{part.readings.size} poses leave {left} degrees of freedom after the estimation: "
        "their residuals cannot be tested. Take more of them."
    )
    return Finding(code="unjudged-readings", subject=TRIAD, text=text)


def too_few_poses(view: AccelerometerView) -> str:
    """Return what poses would have to be added; empty where readings or records are there too."""
    if not view.poses or view.readings or view.has_records:
        return ""
    axes: dict[str, list[Array]] = {}
    for part in view.poses:
        group = part.readings
        there = group.at(view.fit.model, view.fit.solution.estimate)
        for name, own in zip(group.accelerometers, group.axes, strict=True):
            axes.setdefault(name, []).append(there.direction @ own[0])
    count = sum(part.readings.size for part in view.poses)
    free = sum(math.isinf(unknown.prior[1]) for unknown in view.fit.model.unknowns)
    said = []
    if count < free:
        said.append(f" {count} poses are fewer than the {free} unknowns without a prior.")
    for way, sign in (("up", -1.0), ("down", 1.0)):
        never = [name for name, own in axes.items() if np.min(sign * np.concatenate(own)) > -_DOWN]
        if never:
            said.append(f" No pose has {' or '.join(never)} pointing {way}.")
    return (
        "".join(said) + " Take poses whose directions are spread over the whole sphere, or ask for "
        "fewer coefficients in model.terms: the others then enter with their typical size."
    )
