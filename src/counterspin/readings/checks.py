"""Tests of the residuals of readings, and remarks on the noise of readings."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from counterspin.arrays import median
from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.findings import CONTRADICTION_SIGMAS, lack_of_fit_finding, two_sided_z
from counterspin.calibration.outcome import check_outlier_share, summarize_group_residuals
from counterspin.calibration.result_parts import Finding
from counterspin.inference.diagnostics import CHI_SQUARE_SIGNIFICANCE, SIGNIFICANCE
from counterspin.inference.distributions import chi_square_tail
from counterspin.inference.joint.alternatives import Alternative
from counterspin.inference.joint.fit import JointFit, estimate_considered
from counterspin.loading import load_name
from counterspin.readings.fitted import MIN_DOF, FittedReadings, OutlyingReadings
from counterspin.readings.known_attitudes import Readings
from counterspin.readings.means import RecordMean
from counterspin.readings.patterns import (
    APPROACH,
    ASYMMETRY,
    BEND,
    DRIFT,
    FORCE,
    HEAD,
    HYSTERESIS,
    RANGE,
    REVERSED,
    SCALE,
    SENSE,
    STEP,
    SWING,
    TERM,
    TURN,
    WARM_UP,
    WAVE,
    Pattern,
    ResidualGroup,
    best_patterns,
    candidate_columns,
)
from counterspin.readings.reading_groups import groups_of_view, pose_groups, reading_groups
from counterspin.reports.numbers import format_number

#: Largest number of outlying positions that are reported individually, and this as a fraction of
#: all readings. More outliers indicate an error of the model.
_MAX_SINGLE_POSITIONS: Final = 3
_MAX_SINGLE_SHARE: Final = 0.25

#: Degrees of freedom below which messages state that none remain.
_MIN_STATED_DOF: Final = 0.05

#: Kind of hysteresis -> its cause in a message.
_HYSTERESIS_CAUSES: Final = {
    APPROACH: "the direction from which a position was approached",
    FORCE: "the sense in which the specific force along the input axis changed before the reading",
}

#: Largest number of standard deviations in a message.
_MAX_SHOWN_SIGMAS: Final = 1000

#: Function that yields the candidate patterns of poses.
POSE_CANDIDATES: Final = "counterspin.triads.patterns:pose_candidates"

#: Subject of findings about the poses of a triad.
TRIAD: Final = "triad"

#: Ratio of stated to observed noise above which there is a remark.
_MAX_NOISE_RATIO: Final = 1.1

#: Smallest degrees of freedom for a comparison of the residuals with the stated noise.
_MIN_DOF_FOR_SIZE: Final = 0.5


def check_readings(view: AccelerometerView) -> list[Finding]:
    """Return findings of each motion whose residuals are not noise, or cannot be tested.

    Residuals are compared with the stated noise, or with the scatter of repeated positions if the
    noise was estimated. In addition, they are tested for patterns. These tests share the
    significance level, also among the motions. Outlying readings have findings of their own,
    unless there are many and a pattern explains them.
    """
    groups = reading_groups(view)
    level = 0.5 * SIGNIFICANCE
    patterns = {
        index: pattern
        for index, pattern in find_patterns(view.fit, reading_groups(view))
        if pattern.p * pattern.tests < level
    }
    redundancy_findings = _check_redundancy(view) or _check_residual_dof(view)
    findings = [*redundancy_findings]
    for index, group in enumerate(groups):
        if not (redundancy_findings or group.stated) and group.tested_dof < MIN_DOF:
            findings.append(untestable_finding(view.name, group))
        residual = summarize_group_residuals([group])
        is_noise_stated = math.isinf(group.noise_dof)
        p = residual.lack_of_fit_p if is_noise_stated else group.position_misfit_p
        sentences = []
        if p is not None and p < level / len(groups):
            statement = (
                f"The residuals of the {group.label} are not consistent with the stated noise"
                if is_noise_stated
                else f"In the {group.label}, the positions deviate more from the model than "
                "repeated readings of the same position differ from each other"
            )
            sentences = [f"{statement} (p = {p:.2g})."]
        lack_of_fit = lack_of_fit_finding(view.name, sentences, residual) if sentences else None
        outlier_list = outlier_findings(view.name, group)
        if index in patterns:
            lack_of_fit = _pattern_finding(view.name, group, patterns[index], lack_of_fit)
            if _count_positions(group.outliers()) > _max_single_outliers(group):
                lack_of_fit, outlier_list = _merge_outliers(lack_of_fit, group, outlier_list[0]), []
        findings += [lack_of_fit, *outlier_list] if lack_of_fit else outlier_list
    return findings


def _check_redundancy(view: AccelerometerView) -> list[Finding]:
    """Return a finding if the number of readings does not exceed that of free coefficients."""
    free_symbols = [
        unknown.symbol
        for unknown in view.fit.model.unknowns
        if unknown.owner == view.name and math.isinf(unknown.prior[1])
    ]
    count = sum(group.readings.size for group in reading_groups(view))
    if (
        view.has_records
        or pose_groups(view)
        or not reading_groups(view)
        or count > len(free_symbols)
    ):
        return []
    count_text = "One reading" if count == 1 else f"{count} readings"
    coefficients_text = (
        f"the coefficient that it determines ({free_symbols[0]})"
        if count == len(free_symbols) == 1
        else f"the {len(free_symbols)} coefficients that they determine ({', '.join(free_symbols)})"
    )
    text = (
        f"{count_text} cannot test {coefficients_text}, because the model would fit the readings "
        "exactly, whatever their errors. Take more readings."
    )
    return [Finding(code="unjudged-readings", subject=view.name, text=text)]


def _check_residual_dof(view: AccelerometerView) -> list[Finding]:
    """Return a finding if readings with stated noise leave too few degrees of freedom."""
    stated_groups = [group for group in reading_groups(view) if math.isinf(group.noise_dof)]
    dof = sum(group.residual_dof for group in stated_groups)
    if any(any(group.readings.position) for group in stated_groups):
        # Positioning errors absorb residuals, but their priors limit them.
        dof = sum(group.readings.size for group in stated_groups) - _parameter_dof(view)
    if view.has_records or pose_groups(view) or len(stated_groups) < len(reading_groups(view)):
        return []
    if dof >= MIN_DOF:
        return []
    count = sum(group.readings.size for group in stated_groups)
    text = (
        f"After the fit of {count} readings, {remaining_dof_clause(dof)}, so patterns "
        "in the residuals, such as a drift, hysteresis or a "
        f"missing term, cannot be detected{_detection_clause(dof)}. Take more readings, or "
        "state priors for more terms."
    )
    return [Finding(code="unjudged-readings", subject=view.name, text=text)]


def _parameter_dof(view: AccelerometerView) -> float:
    """Return the degrees of freedom of an accelerometer's own unknowns.

    An unknown with a prior counts by the relative reduction of its variance.
    """
    pairs = zip(view.fit.model.unknowns, view.fit.solution.u.tolist(), strict=True)
    return sum(
        1.0 - min(u / unknown.prior[1], 1.0) ** 2 if unknown.prior[1] > 0.0 else 0.0
        for unknown, u in pairs
        if unknown.owner == view.name
    )


def _detection_clause(dof: float) -> str:
    """Return a clause on the smallest residuals that chi-square detects."""
    if dof <= 0.5:
        return ", and the scatter cannot be compared with the stated uncertainty"
    from scipy.special import chdtri

    ratio = math.sqrt(float(chdtri(dof, 0.5 * SIGNIFICANCE)) / dof)
    ratio_text = format_number(ratio, 2)
    return f", and residuals reveal errors only above {ratio_text} times the stated uncertainty"


def remaining_dof_clause(dof: float) -> str:
    """Return a clause on the degrees of freedom of residuals."""
    text = format_number(dof, 2) if dof >= _MIN_STATED_DOF else "no"
    noun_and_verb = "degree of freedom remains" if text == "1" else "degrees of freedom remain"
    return f"{text} {noun_and_verb}"


def untestable_finding(name: str, group: FittedReadings) -> Finding:
    """Return the finding that too few degrees of freedom remain to test the residuals."""
    text = (
        f"After the fit of {group.readings.size} {group.label} without a stated uncertainty, "
        f"{remaining_dof_clause(group.tested_dof)}, so the residuals "
        "cannot be tested. State the uncertainty of the readings, or take more readings."
    )
    return Finding(code="unjudged-readings", subject=name, text=text)


def find_patterns(fit: JointFit, groups: Sequence[FittedReadings]) -> Iterator[tuple[int, Pattern]]:
    """Yield the index of each group with a pattern in its residuals, and the pattern."""
    fit = estimate_considered(fit)
    residual_groups = {
        index: residual_group(group, observation_index)
        for index, group in enumerate(groups)
        if (observation_index := group.index_in(fit)) is not None and group.tested_dof >= MIN_DOF
    }
    if not residual_groups:
        return
    columns = [pattern_columns(fit, group) for group in residual_groups.values()]
    indices = list(residual_groups)
    for pattern in best_patterns(fit, list(residual_groups.values()), columns):
        yield indices[pattern.group], pattern


def pattern_columns(fit: JointFit, group: ResidualGroup) -> tuple[Alternative, ...]:
    """Return the candidate patterns of the residuals of readings or poses."""
    readings = group.readings
    has_prior = {(u.owner, u.symbol): math.isfinite(u.prior[1]) for u in fit.model.unknowns}
    if readings.triad:
        stated_keys = {key for key, is_stated in has_prior.items() if is_stated}
        return tuple(load_name(POSE_CANDIDATES)(readings, group.index, fit, has_prior, stated_keys))
    assert isinstance(readings, Readings)
    name = readings.accelerometer
    estimated_symbols = {symbol for owner, symbol in has_prior if owner in (name, "")}
    stated_symbols = {
        symbol for (owner, symbol), is_stated in has_prior.items() if owner == name and is_stated
    }
    return tuple(candidate_columns(readings, group.index, estimated_symbols, stated_symbols))


def residual_group(group: FittedReadings, index: int) -> ResidualGroup:
    """Return the residuals of readings or poses for pattern tests.

    index: Index of the group among the observations of the fit.
    """
    readings, is_estimated = group.readings, not group.has_external_noise
    outlier_indices = tuple(sorted({i for outlier in group.outliers() for i in outlier.indices}))
    return ResidualGroup(
        readings,
        index,
        group.sigma,
        group.linear.noise_share if is_estimated else np.ones(readings.size),
        # With estimated noise, chi-square equals its degrees of freedom.
        group.noise_dof if is_estimated else group.chi2,
        group.noise_dof if is_estimated else group.residual_dof,
        is_estimated,
        float(readings.scatter.sum()) / group.noise**2 if is_estimated else 0.0,
        outlier_indices if len(outlier_indices) <= _max_single_outliers(group) else (),
    )


def _pattern_finding(
    name: str, group: FittedReadings, pattern: Pattern, lack_of_fit: Finding | None
) -> Finding:
    """Return the finding of a pattern in the residuals, the best explanation first."""
    best = pattern.alternatives[0]
    z = two_sided_z(pattern.p)
    text = f"The residuals of the {group.label} {pattern_clause(best)} (p = {pattern.p:.2g})."
    alternative_terms = [
        alternative.symbol for alternative in pattern.alternatives if alternative.kind == TERM
    ]
    if best.kind == TERM:
        alternative_terms = alternative_terms[1:]
    if best.kind == WAVE:
        clause = " or ".join(alternative_terms)
        clause = f", or {clause} in the accelerometer," if clause else ""
        text += f" A head error that varies with the angle{clause} would have this effect."
    elif alternative_terms:
        text += f" {' or '.join(alternative_terms)} would have the same effect."
    clauses = dict.fromkeys(
        pattern_clause(alternative)
        for alternative in pattern.alternatives[1:]
        if alternative.kind not in (TERM, WAVE)
    )
    text += "".join(f" Alternatively, the residuals {clause}." for clause in clauses)
    if lack_of_fit is not None:
        text += f" {lack_of_fit.text}"
    return Finding(
        code="lack-of-fit",
        subject=name,
        text=text,
        size=z,
        contradicts=z > CONTRADICTION_SIGMAS
        or (lack_of_fit is not None and lack_of_fit.contradicts),
    )


def pattern_clause(alternative: Alternative) -> str:
    """Return the predicate of a sentence on residuals that have a pattern."""
    basis = {"order": "the order of the readings", "angle": "the head angle"}.get(
        alternative.symbol.rpartition(" ")[2], "the time of reading"
    )
    return {
        WAVE: (
            f"follow {alternative.symbol}, where phi is the head angle measured from the "
            "position with the input axis up"
        ),
        HEAD: f"have the pattern of a head error {alternative.symbol.partition(' ')[2]} per "
        "revolution",
        TERM: f"follow {alternative.symbol}, more than the model allows",
        DRIFT: f"drift with {basis}",
        WARM_UP: f"settle with {basis}, as during a warm-up",
        BEND: f"drift with {basis} and reverse",
        SCALE: f"have a scale factor that drifts with {basis}",
        TURN: f"have the pattern of a rotation of the positions that increases with {basis}",
        SWING: (
            f"oscillate {alternative.symbol.partition(' ')[2].partition(' ')[0]} times with {basis}"
        ),
        ASYMMETRY: (
            f"have the pattern of a {alternative.symbol} that is different for negative "
            "specific forces"
        ),
        RANGE: f"have the pattern of a gain that changes above {alternative.symbol}, as "
        "between two ranges of a meter",
        STEP: f'have a step that starts at "{alternative.symbol}"',
        SENSE: "depend on the sense of rotation of the machine",
        REVERSED: f"have the pattern of {alternative.symbol}",
        HYSTERESIS: f"depend on {_HYSTERESIS_CAUSES.get(alternative.symbol)} (hysteresis)",
    }[alternative.kind]


def outlier_findings(name: str, group: FittedReadings) -> list[Finding]:
    """Return a finding for each outlying position, or a single finding if there are many."""
    outliers = group.outliers()
    if _count_positions(outliers) <= _max_single_outliers(group):
        return [_outlier_finding(group, name, outlier) for outlier in outliers]
    worst_finding = _outlier_finding(group, name, max(outliers, key=lambda outlier: abs(outlier.z)))
    text = (
        f"{_count_readings(outliers)} of {group.readings.size} {group.label} deviate from the "
        "model, which suggests an error in the model rather than in individual readings. "
        f"{worst_finding.text}"
    )
    return [worst_finding.model_copy(update={"text": text})]


def _merge_outliers(finding: Finding, group: FittedReadings, outlier: Finding) -> Finding:
    """Return the finding of a pattern, extended by the outliers that it explains."""
    count = _count_readings(group.outliers())
    count_text = f"{count} of {group.readings.size} {group.label} deviate from the model."
    changes = {
        "text": f"{finding.text} {count_text}",
        "size": max(finding.size or 0.0, outlier.size or 0.0),
        "contradicts": finding.contradicts or outlier.contradicts,
    }
    return finding.model_copy(update=changes)


def _max_single_outliers(group: FittedReadings) -> float:
    return max(_MAX_SINGLE_POSITIONS, _MAX_SINGLE_SHARE * group.readings.size)


def _count_readings(outliers: Sequence[OutlyingReadings]) -> int:
    """Count the outlying readings, alone or with those of their position."""
    return len({index for outlier in outliers for index in outlier.indices})


def _count_positions(outliers: Sequence[OutlyingReadings]) -> int:
    """Count the outlying positions; a reading within an outlying position does not count."""
    sets = [set(outlier.indices) for outlier in outliers]
    return sum(not any(indices < superset for superset in sets) for indices in sets)


def _outlier_finding(group: FittedReadings, name: str, outlier: OutlyingReadings) -> Finding:
    noun = "pose" if group.readings.motion == "poses" else "position"
    deviations = (
        f"{abs(outlier.z):.1f}"
        if abs(outlier.z) < _MAX_SHOWN_SIGMAS
        else f"more than {_MAX_SHOWN_SIGMAS}"
    )
    return Finding(
        code="outlying-reading",
        subject=f"{name}.{outlier.name}",
        text=f'The {noun} "{outlier.name}" deviates from the model by '
        f"{format_number(outlier.residual * 1e6, 3)} ug, {deviations} standard "
        f"deviations. Check this reading{_rate_clause(group)}, or look for a missing term.",
        size=abs(outlier.z),
        contradicts=abs(outlier.z) > CONTRADICTION_SIGMAS and math.isinf(group.noise_dof),
    )


def _rate_clause(group: FittedReadings) -> str:
    return " and the rate" if group.readings.motion in ("arm", "counter-rotating") else ""


def rounding_remarks(views: Sequence[AccelerometerView]) -> Iterator[str]:
    """Yield a remark for each motion in which the noise is only rounding."""
    for view in views:
        for group in reading_groups(view):
            if group.readings.u is None and group.has_external_noise:
                noise_text = format_number(group.readings.noise_floor * 1e6, 2)
                yield (
                    f"{view.name}: the {group.label} fit the model to the last digit, so "
                    f"counterspin assumes that the noise is a rounding error of {noise_text} ug. "
                    "If the noise is larger, state it with each reading (±)."
                )


def record_outlier_findings(
    name: str, means: Mapping[tuple[str, str], RecordMean]
) -> list[Finding]:
    """Return a finding for each averaged record that lost many rows."""
    return [
        finding
        for (owner, reading), mean in means.items()
        if owner == name
        for finding in check_outlier_share(f"{name}.{reading}", mean.report.counts())
    ]


def overstated_noise_remarks(
    views: Sequence[AccelerometerView], means: Collection[tuple[str, str]]
) -> Iterator[str]:
    """Yield a remark for each group of readings or poses with overstated noise.

    u is then too large, which is no reason to reject the result.

    means: Accelerometer and name of each reading that is the mean of a record.
    """
    stated_groups = {
        id(group.readings): group
        for view in views
        for group in groups_of_view(view)
        if group.stated
    }
    for group in stated_groups.values():
        scale, dof = group.linear.noise_moments(views[0].fit.solution)
        if dof < _MIN_DOF_FOR_SIZE:
            continue
        chi2 = float(np.sum((group.residuals / group.sigma) ** 2))
        ratio = math.sqrt(chi2 / (scale * dof))
        p = 1.0 - chi_square_tail(dof, chi2 / scale)
        if p >= CHI_SQUARE_SIGNIFICANCE / len(stated_groups) or ratio * _MAX_NOISE_RATIO > 1.0:
            continue
        u = median(group.sigma)
        scatter_text, stated_text = (f"{format_number(1e6 * sd, 2)} ug" for sd in (ratio * u, u))
        name = TRIAD if group.readings.triad else group.readings.accelerometer
        if all((name, reading) in means for reading in group.readings.names):
            origin = "uncertainty computed from the records,"
            advice = (
                "If all records settle or drift in the same way, omit that part with `start` or "
                "`stop`."
            )
        else:
            origin = "stated uncertainty of"
            advice = (
                "State the noise of individual readings, and state errors common to all readings "
                "as priors."
            )
        yield (
            f"{name}: the {group.label} scatter by {scatter_text}, {format_number(ratio, 2)} "
            f"times the {origin} {stated_text}. The reported uncertainty u is too large. {advice}"
        )
