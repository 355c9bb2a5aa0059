"""Tests of the residuals of readings, and remarks on their noise."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from counterspin.arrays import median
from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.findings import (
    CONTRADICTION_SIGMAS,
    lack_of_fit_finding,
    two_sided_z,
)
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

#: Up to so many positions that are off may each be a mistake. More, and more than this share of
#: all, point to the model.
_MAX_SINGLE_POSITIONS: Final = 3
_MAX_SINGLE_SHARE: Final = 0.25

#: What hysteresis goes with, in words.
_HYSTERESIS_CAUSES: Final = {
    APPROACH: "the direction from which a position was approached",
    FORCE: "the sense in which the specific force along the input axis changed before the reading",
}

#: More standard deviations than this say no more: the others have hardly any noise.
_MAX_SHOWN_SIGMAS: Final = 1000

#: Columns that the residuals of poses may follow.
POSE_PATTERNS: Final = "counterspin.triads.patterns:pose_candidates"

#: What findings about the poses of a triad are about.
TRIAD: Final = "triad"

#: Noise that is smaller than stated by this factor is worth a remark.
_MAX_NOISE_RATIO: Final = 1.1

#: Fewest degrees of freedom by which the size of residuals is compared with the stated noise.
_MIN_DOF_FOR_SIZE: Final = 0.5


def check_readings(view: AccelerometerView) -> list[Finding]:
    """Return a finding for each motion whose residuals are not noise, or cannot be tested.

    Noise that was stated is what they are compared with; noise that was estimated shows a misfit
    where positions were read more than once. Beside that, whatever the noise, it is asked what the
    residuals follow. Both share the significance, and so do the motions. Single readings that stand
    out have findings of their own, but where many do and it is known what they follow.
    """
    groups = reading_groups(view)
    level = 0.5 * SIGNIFICANCE
    patterns = {
        index: pattern
        for index, pattern in find_patterns(view.fit, reading_groups(view))
        if pattern.p * pattern.tests < level
    }
    too_few = _check_redundancy(view) or _check_residual_dof(view)
    findings = [*too_few]
    for index, group in enumerate(groups):
        if not (too_few or group.stated) and group.tested_dof < MIN_DOF:
            findings.append(untestable_finding(view.name, group))
        residual = summarize_group_residuals([group])
        noise_stated = math.isinf(group.noise_dof)
        p = residual.lack_of_fit_p if noise_stated else group.position_misfit_p
        sentences = []
        if p is not None and p < level / len(groups):
            statement = (
                f"The residuals of the {group.label} are not consistent with the stated noise"
                if noise_stated
                else f"In the {group.label}, the positions deviate more from the model than "
                "repeated readings of the same position differ from each other"
            )
            sentences = [f"{statement} (p = {p:.2g})."]
        general = lack_of_fit_finding(view.name, sentences, residual) if sentences else None
        outlier_list = outlier_findings(view.name, group)
        if index in patterns:
            general = _pattern_finding(view.name, group, patterns[index], general)
            if _count_positions(group.outliers()) > _max_single_outliers(group):
                general, outlier_list = _merge_outliers(general, group, outlier_list[0]), []
        findings += [general, *outlier_list] if general else outlier_list
    return findings


def _check_redundancy(view: AccelerometerView) -> list[Finding]:
    """Return a finding where readings are no more than the coefficients that they alone tell."""
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
    text = (
        f"{count} readings cannot test the {len(free_symbols)} coefficients that they determine "
        f"({', '.join(free_symbols)}), because the model would fit the readings regardless of "
        "any error. Take more readings."
    )
    return [Finding(code="unjudged-readings", subject=view.name, text=text)]


def _check_residual_dof(view: AccelerometerView) -> list[Finding]:
    """Return a finding where readings of stated noise leave too little to test them by."""
    stated = [group for group in reading_groups(view) if math.isinf(group.noise_dof)]
    dof = sum(group.residual_dof for group in stated)
    if any(any(group.readings.position) for group in stated):
        # Errors of setting a position take up residuals, but they are held to their stated size.
        dof = sum(group.readings.size for group in stated) - _parameter_dof(view)
    if view.has_records or pose_groups(view) or len(stated) < len(reading_groups(view)):
        return []
    if dof >= MIN_DOF:
        return []
    count = sum(group.readings.size for group in stated)
    dof_text = format_number(dof, 2)
    remaining = "degree of freedom remains" if dof_text == "1" else "degrees of freedom remain"
    text = (
        f"After the fit of {count} readings, {dof_text} {remaining}, so patterns "
        "in the residuals, such as a drift, hysteresis or a "
        f"missing term, cannot be detected{_detection_clause(dof)}. Take more readings, or "
        "state priors for more terms."
    )
    return [Finding(code="unjudged-readings", subject=view.name, text=text)]


def _parameter_dof(view: AccelerometerView) -> float:
    """Return how many degrees of freedom an accelerometer's own unknowns take up.

    Of one with a prior the part by which the readings lessen its variance.
    """
    pairs = zip(view.fit.model.unknowns, view.fit.solution.u.tolist(), strict=True)
    return sum(
        1.0 - min(u / unknown.prior[1], 1.0) ** 2 if unknown.prior[1] > 0.0 else 0.0
        for unknown, u in pairs
        if unknown.owner == view.name
    )


def _detection_clause(dof: float) -> str:
    """Return in words how large residuals must be for chi-square to call them no noise."""
    if dof <= 0.5:
        return ", nor can the scatter be compared with the stated uncertainty"
    from scipy.special import chdtri

    ratio = math.sqrt(float(chdtri(dof, 0.5 * SIGNIFICANCE)) / dof)
    ratio_text = format_number(ratio, 2)
    return f", and residuals reveal errors only above {ratio_text} times the stated uncertainty"


def untestable_finding(name: str, group: FittedReadings) -> Finding:
    """Return the finding that hardly any freedom is left to test residuals by."""
    text = (
        f"After the fit of {group.readings.size} {group.label} without a stated uncertainty, "
        f"{format_number(group.tested_dof, 2)} degrees of freedom remain, so the residuals "
        "cannot be tested. State the uncertainty of the readings, or take more readings."
    )
    return Finding(code="unjudged-readings", subject=name, text=text)


def find_patterns(fit: JointFit, groups: Sequence[FittedReadings]) -> Iterator[tuple[int, Pattern]]:
    """Yield the index of each group of readings or poses, and the pattern of its residuals."""
    fit = estimate_considered(fit)
    residual_groups = {
        index: residual_group(group, place)
        for index, group in enumerate(groups)
        if (place := group.index_in(fit)) is not None and group.tested_dof >= MIN_DOF
    }
    if not residual_groups:
        return
    columns = [pattern_columns(fit, group) for group in residual_groups.values()]
    indices = list(residual_groups)
    for pattern in best_patterns(fit, list(residual_groups.values()), columns):
        yield indices[pattern.group], pattern


def pattern_columns(fit: JointFit, group: ResidualGroup) -> tuple[Alternative, ...]:
    """Return the columns that the residuals of readings or poses may follow, beside a fit."""
    readings = group.readings
    unknown = {
        (term.owner, term.symbol): math.isfinite(term.prior[1]) for term in fit.model.unknowns
    }
    if readings.triad:
        stated_keys = {key for key, stated in unknown.items() if stated}
        return tuple(load_name(POSE_PATTERNS)(readings, group.index, fit, unknown, stated_keys))
    assert isinstance(readings, Readings)
    name = readings.accelerometer
    present = {symbol for owner, symbol in unknown if owner in (name, "")}
    stated_symbols = {
        symbol for (owner, symbol), stated in unknown.items() if owner == name and stated
    }
    return tuple(candidate_columns(readings, group.index, present, stated_symbols))


def residual_group(group: FittedReadings, index: int) -> ResidualGroup:
    """Return readings or poses as they are tested.

    index: Index of the group among the observations of the fit.
    """
    readings, is_estimated = group.readings, not group.has_external_noise
    outlying = tuple(sorted({index for outlier in group.outliers() for index in outlier.indices}))
    return ResidualGroup(
        readings,
        index,
        group.sigma,
        group.linear.noise_share if is_estimated else np.ones(readings.size),
        # The noise that is estimated is such that they are what is expected.
        group.noise_dof if is_estimated else group.chi2,
        group.noise_dof if is_estimated else group.residual_dof,
        is_estimated,
        float(readings.scatter.sum()) / group.noise**2 if is_estimated else 0.0,
        outlying if len(outlying) <= _max_single_outliers(group) else (),
    )


def _pattern_finding(
    name: str, group: FittedReadings, pattern: Pattern, general: Finding | None
) -> Finding:
    """Return the finding that residuals follow something, the best explanation first."""
    first = pattern.alternatives[0]
    deviations = two_sided_z(pattern.p)
    text = f"The residuals of the {group.label} {pattern_clause(first)} (p = {pattern.p:.2g})."
    terms = [alternative.symbol for alternative in pattern.alternatives if alternative.kind == TERM]
    if first.kind == TERM:
        terms = terms[1:]
    if first.kind == WAVE:
        alternatives_text = f", or {' or '.join(terms)} in the accelerometer," if terms else ""
        text += (
            f" A head error that varies with the angle{alternatives_text} would have this effect."
        )
    elif terms:
        text += f" {' or '.join(terms)} would have the same effect."
    clauses = dict.fromkeys(
        pattern_clause(alternative)
        for alternative in pattern.alternatives[1:]
        if alternative.kind not in (TERM, WAVE)
    )
    text += "".join(f" Alternatively, the residuals {clause}." for clause in clauses)
    if general is not None:
        text += f" {general.text}"
    return Finding(
        code="lack-of-fit",
        subject=name,
        text=text,
        size=deviations,
        contradicts=deviations > CONTRADICTION_SIGMAS
        or (general is not None and general.contradicts),
    )


def pattern_clause(alternative: Alternative) -> str:
    """Return the description of residuals that follow a column, as the end of a sentence."""
    when = {
        "order": "the order of the readings",
        "angle": "the head angle",
    }.get(alternative.symbol.rpartition(" ")[2], "the time of reading")
    return {
        WAVE: (
            f"follow {alternative.symbol}, where phi is the head angle measured from the "
            "position with the input axis up"
        ),
        HEAD: f"have the pattern of a head error {alternative.symbol.partition(' ')[2]} per "
        "revolution",
        TERM: f"follow {alternative.symbol}, more than the model allows",
        DRIFT: f"drift with {when}",
        WARM_UP: f"settle with {when}, as during a warm-up",
        BEND: f"drift with {when} and reverse",
        SCALE: f"have a scale factor that drifts with {when}",
        TURN: f"have the pattern of positions that rotate more and more with {when}",
        SWING: (
            f"oscillate {alternative.symbol.partition(' ')[2].partition(' ')[0]} times with {when}"
        ),
        ASYMMETRY: (
            f"have the pattern of a {alternative.symbol} that is different for negative "
            "specific forces"
        ),
        RANGE: f"have the pattern of a gain that changes above {alternative.symbol}, as "
        "between two ranges of a meter",
        STEP: f'have a step that starts at "{alternative.symbol}"',
        SENSE: "depend on the sense of rotation of the machine",
        REVERSED: "have the pattern of a rotation opposite to the stated sense",
        HYSTERESIS: f"depend on {_HYSTERESIS_CAUSES.get(alternative.symbol)} (hysteresis)",
    }[alternative.kind]


def outlier_findings(name: str, group: FittedReadings) -> list[Finding]:
    """Return a finding for each position that stands out, or one where many do."""
    outliers = group.outliers()
    if _count_positions(outliers) <= _max_single_outliers(group):
        return [_outlier_finding(group, name, outlier) for outlier in outliers]
    largest_finding = _outlier_finding(
        group, name, max(outliers, key=lambda outlier: abs(outlier.z))
    )
    text = (
        f"{_count_readings(outliers)} of {group.readings.size} {group.label} deviate from the "
        "model, which suggests an error in the model rather than in individual readings. "
        f"{largest_finding.text}"
    )
    return [largest_finding.model_copy(update={"text": text})]


def _merge_outliers(finding: Finding, group: FittedReadings, outlier: Finding) -> Finding:
    """Return a misfit of known shape with the many positions that it puts off the model."""
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
    """Return how many positions are off: a reading that is named beside its own is none more."""
    index_sets = [set(outlier.indices) for outlier in outliers]
    return sum(1 for outlier in index_sets if not any(outlier < larger for larger in index_sets))


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
    """Yield a remark for each motion in which readings show no more noise than their digits."""
    for view in views:
        for group in reading_groups(view):
            if group.readings.u is None and group.has_external_noise:
                size = format_number(group.readings.noise_floor * 1e6, 2)
                yield (
                    f"{view.name}: the {group.label} fit the model to the last digit, so "
                    f"counterspin assumes that the noise is a rounding error of {size} ug. If "
                    "the noise is larger, state it with each reading (±)."
                )


def record_outlier_findings(
    name: str, means: Mapping[tuple[str, str], RecordMean]
) -> list[Finding]:
    """Return a finding for each record whose mean is a reading and that lost many rows."""
    return [
        finding
        for (owner, reading), mean in means.items()
        if owner == name
        for finding in check_outlier_share(f"{name}.{reading}", mean.report.counts())
    ]


def overstated_noise_remarks(views: Sequence[AccelerometerView]) -> Iterator[str]:
    """Yield a remark for each group of readings or poses that scatters less than is stated.

    u is then too large, which speaks against nothing.
    """
    stated = {
        id(group.readings): group
        for view in views
        for group in groups_of_view(view)
        if group.stated
    }
    for group in stated.values():
        scale, dof = group.linear.noise_moments(views[0].fit.solution)
        if dof < _MIN_DOF_FOR_SIZE:
            continue
        chi2 = float(np.sum((group.residuals / group.sigma) ** 2))
        ratio = math.sqrt(chi2 / (scale * dof))
        p = 1.0 - chi_square_tail(dof, chi2 / scale)
        if p >= CHI_SQUARE_SIGNIFICANCE / len(stated) or ratio * _MAX_NOISE_RATIO > 1.0:
            continue
        u = median(group.sigma)
        scatter_text, stated_text = (
            f"{format_number(1e6 * size, 2)} ug" for size in (ratio * u, u)
        )
        name = TRIAD if group.readings.triad else group.readings.accelerometer
        yield (
            f"{name}: the {group.label} scatter by {scatter_text}, {format_number(ratio, 2)} "
            f"times the stated uncertainty of {stated_text}. The reported uncertainty u is too "
            "large. State the noise of individual readings, and state errors common to all "
            "readings as priors."
        )
