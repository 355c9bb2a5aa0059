"""Tests of the residuals of poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from counterspin.calibration.findings import (
    CONTRADICTION_SIGMAS,
    equivalent_deviations,
    lack_of_fit_finding,
)
from counterspin.calibration.outcome import residual_of
from counterspin.calibration.result_parts import Finding
from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.inference.joint.fit import JointFit, relax
from counterspin.readings.checks import (
    TRIAD,
    clause_of,
    columns_beside,
    group_of,
    lone_or_many,
    too_few_to_test,
)
from counterspin.readings.fitted import FEWEST_FREEDOM, FittedReadings
from counterspin.readings.patterns import STEP, TERM, Followed, most_followed
from counterspin.reports.numbers import format_number

#: So many terms are named that explain residuals of poses as well as the first.
_MOST_NAMED: Final = 4


def pose_findings(fit: JointFit, posed: Sequence[FittedReadings]) -> list[Finding]:
    """Return the findings against the poses: residuals that are not noise, and outlying poses.

    fit: Which has them.
    """
    findings = []
    for part, followed in zip(posed, _followed_by_poses(fit, posed), strict=True):
        if part.noise_dof < FEWEST_FREEDOM:
            findings.append(too_few_to_test(TRIAD, part))
        elif part.residual_dof < FEWEST_FREEDOM:
            findings.append(_few_poses_left(part))
        residual = residual_of([part])
        p = residual.lack_of_fit_p
        if p is not None and p < 0.5 * SIGNIFICANCE / len(posed):
            said = f"The residuals of the {part.label} do not agree with the stated noise"
            findings.append(lack_of_fit_finding(TRIAD, [f"{said} (p = {p:.2g})."], residual))
        findings += [_explained_poses(part, followed)] if followed else []
        findings += lone_or_many(TRIAD, part)
    return findings


def _followed_by_poses(fit: JointFit, posed: Sequence[FittedReadings]) -> list[Followed | None]:
    """Return for each group of poses what its residuals follow, beyond chance."""
    found: list[Followed | None] = [None] * len(posed)
    fit = relax(fit)
    testable = [k for k, part in enumerate(posed) if part.tested_freedom >= FEWEST_FREEDOM]
    groups = [group_of(posed[k], posed[k].place_in(fit) or 0) for k in testable]
    columns = [columns_beside(fit, group) for group in groups]
    for one in most_followed(fit, groups, columns) if testable else ():
        if one.p * one.tests < 0.5 * SIGNIFICANCE:
            found[testable[one.group]] = one
    return found


def _explained_poses(part: FittedReadings, followed: Followed) -> Finding:
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
        text=f"The residuals of the {part.label} {clause} (p = {followed.p:.2g}).{cure}",
        size=size,
        contradicts=size > CONTRADICTION_SIGMAS,
    )


def _few_poses_left(part: FittedReadings) -> Finding:
    left = format_number(part.residual_dof, 2) if part.residual_dof >= 0.05 else "no"
    text = (
        f"{part.readings.size} poses leave {left} degrees of freedom after the estimation: "
        "their residuals cannot be tested. Take more of them."
    )
    return Finding(code="unjudged-readings", subject=TRIAD, text=text)
