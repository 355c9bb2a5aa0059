"""What speaks against poses at unknown attitudes: poses off the model, too few, all on one side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.diagnosis.reading_findings import (
    clause_of,
    group_of,
    lone_or_many,
    unjudged,
)
from counterspin.calibration.findings import (
    CONTRADICTION_SIGMAS,
    equivalent_deviations,
    lack_of_fit,
)
from counterspin.calibration.joint_view import AccelerometerView
from counterspin.calibration.readings import residual_of
from counterspin.calibration.result_parts import Finding
from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.inference.fitted_readings import FEWEST_FREEDOM, FittedReadings
from counterspin.inference.joint.fit import JointFit, relax
from counterspin.inference.pose_tests import pose_candidates
from counterspin.inference.poses import TriadPoses
from counterspin.inference.reading_tests import STEP, TERM, Followed, most_followed
from counterspin.reports.numbers import format_number

#: What findings about the poses of a triad are about.
TRIAD: Final = "triad"

#: An input axis that no pose turns below the level by more than asin of this was never down.
_DOWN: Final = 0.3

#: So many terms are named that explain residuals as well as the first.
_MOST_NAMED: Final = 4


def pose_findings(fit: JointFit, posed: Sequence[FittedReadings]) -> list[Finding]:
    """Return what speaks against the poses: residuals that are no noise, poses that stand out.

    fit: Which has them.
    """
    findings = []
    for part, followed in zip(posed, _followed(fit, posed), strict=True):
        if part.dof < FEWEST_FREEDOM:
            findings.append(unjudged(TRIAD, part))
        elif part.freedom < FEWEST_FREEDOM:
            findings.append(_few_left(part))
        residual = residual_of([part])
        p = residual.lack_of_fit_p
        if p is not None and p < 0.5 * SIGNIFICANCE / len(posed):
            said = f"The residuals of the {part.words} do not agree with the stated noise"
            findings.append(lack_of_fit(TRIAD, [f"{said} (p = {p:.2g})."], residual))
        findings += [_explained(part, followed)] if followed else []
        findings += lone_or_many(TRIAD, part)
    return findings


def _followed(fit: JointFit, posed: Sequence[FittedReadings]) -> list[Followed | None]:
    """Return for each group of poses what its residuals follow, beyond chance."""
    found: list[Followed | None] = [None] * len(posed)
    fit = relax(fit)
    judged = [k for k, part in enumerate(posed) if min(part.dof, part.freedom) >= FEWEST_FREEDOM]
    groups = [group_of(posed[k], posed[k].place_in(fit) or 0) for k in judged]
    unknown = {(u.owner, u.symbol): u for u in fit.model.unknowns}
    known = {key for key, u in unknown.items() if math.isfinite(u.prior[1])}
    columns = [
        tuple(pose_candidates(group.readings, group.place, fit, unknown, known))
        for group in groups
        if isinstance(group.readings, TriadPoses)
    ]
    for one in most_followed(fit, groups, columns) if judged else ():
        if one.p * one.tests < 0.5 * SIGNIFICANCE:
            found[judged[one.group]] = one
    return found


def _explained(part: FittedReadings, followed: Followed) -> Finding:
    """Return the finding that the residuals of poses follow something."""
    first = followed.alternatives[0]
    size = equivalent_deviations(followed.p)
    clause = clause_of(first)
    if first.kind == TERM:
        clause = clause.replace(first.symbol, first.name, 1)
        others = [other.name for other in followed.alternatives[1:] if other.kind == TERM]
        cure = f" So would {' or '.join(others[:_MOST_NAMED])}." if others else ""
    else:
        owners = dict.fromkeys(o.owner for o in followed.alternatives if o.kind == first.kind)
        clause += f", most in {' or '.join(owners)}"
        cure = (
            " Was the sensor knocked, or switched off?"
            if first.kind == STEP
            else (
                " Let the sensor warm up before, or ask for K_F.trend in model.terms"
                f"{', with the time of each pose' if first.symbol == 'order' else ''}."
            )
        )
    return Finding(
        code="lack-of-fit",
        subject=TRIAD,
        text=f"The residuals of the {part.words} {clause} (p = {followed.p:.2g}).{cure}",
        size=size,
        contradicts=size > CONTRADICTION_SIGMAS,
    )


def _few_left(part: FittedReadings) -> Finding:
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
        assert isinstance(group, TriadPoses)
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
