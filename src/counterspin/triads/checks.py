"""Statistical tests of the residuals of poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from counterspin.calibration.findings import CONTRADICTION_SIGMAS, lack_of_fit_finding, two_sided_z
from counterspin.calibration.outcome import summarize_group_residuals
from counterspin.calibration.result_parts import Finding
from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.inference.joint.fit import JointFit
from counterspin.readings.checks import (
    TRIAD,
    find_patterns,
    outlier_findings,
    pattern_clause,
    remaining_dof_clause,
    untestable_finding,
)
from counterspin.readings.fitted import MIN_DOF, FittedReadings
from counterspin.readings.patterns import STEP, TERM, Pattern

#: Largest number of alternative terms in a message.
_MAX_TERMS: Final = 4


def pose_findings(fit: JointFit, groups: Sequence[FittedReadings]) -> list[Finding]:
    """Return the findings on poses: lack of fit, patterns in the residuals, and outliers."""
    findings = []
    patterns = {
        index: pattern
        for index, pattern in find_patterns(fit, groups)
        if pattern.p * pattern.tests < 0.5 * SIGNIFICANCE
    }
    for index, group in enumerate(groups):
        if group.noise_dof < MIN_DOF:
            findings.append(untestable_finding(TRIAD, group))
        elif group.residual_dof < MIN_DOF:
            findings.append(_check_residual_dof(group))
        residual = summarize_group_residuals([group])
        p = residual.lack_of_fit_p
        if p is not None and p < 0.5 * SIGNIFICANCE / len(groups):
            clause = f"The residuals of the {group.label} are not consistent with the stated noise"
            findings.append(lack_of_fit_finding(TRIAD, [f"{clause} (p = {p:.2g})."], residual))
        findings += [_pattern_finding(group, patterns[index])] if index in patterns else []
        findings += outlier_findings(TRIAD, group)
    return findings


def _pattern_finding(group: FittedReadings, pattern: Pattern) -> Finding:
    """Return the finding of a pattern in the residuals of poses."""
    best = pattern.alternatives[0]
    z = two_sided_z(pattern.p)
    clause = pattern_clause(best)
    if best.kind == TERM:
        clause = clause.replace(best.symbol, best.name, 1)
        other_terms = [
            alternative.name for alternative in pattern.alternatives[1:] if alternative.kind == TERM
        ]
        remedy = (
            f" {' or '.join(other_terms[:_MAX_TERMS])} would have the same effect."
            if other_terms
            else ""
        )
    else:
        owners = dict.fromkeys(
            candidate.owner for candidate in pattern.alternatives if candidate.kind == best.kind
        )
        clause += f", mainly in {' or '.join(owners)}"
        remedy = (
            " Check whether the sensor was knocked or switched off."
            if best.kind == STEP
            else (
                " Let the sensor warm up before the test, or add K_F.trend to "
                f"model.terms{', with the time of each pose' if best.symbol == 'order' else ''}."
            )
        )
    return Finding(
        code="lack-of-fit",
        subject=TRIAD,
        text=f"The residuals of the {group.label} {clause} (p = {pattern.p:.2g}).{remedy}",
        size=z,
        contradicts=z > CONTRADICTION_SIGMAS,
    )


def _check_residual_dof(group: FittedReadings) -> Finding:
    text = (
        f"After the fit of {group.readings.size} poses, "
        f"{remaining_dof_clause(group.residual_dof)}, so the residuals cannot be tested. "
        "Measure more poses."
    )
    return Finding(code="unjudged-readings", subject=TRIAD, text=text)
