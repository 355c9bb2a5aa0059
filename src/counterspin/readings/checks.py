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
    equivalent_deviations,
    lack_of_fit_finding,
)
from counterspin.calibration.outcome import check_outlier_share, residual_of
from counterspin.calibration.result_parts import Finding
from counterspin.inference.diagnostics import CHI_SQUARE_SIGNIFICANCE, SIGNIFICANCE
from counterspin.inference.distributions import chi_square_tail
from counterspin.inference.joint.alternatives import Alternative
from counterspin.inference.joint.fit import JointFit, relax
from counterspin.loading import load_name
from counterspin.readings.fitted import FEWEST_FREEDOM, FittedReadings, Outlying
from counterspin.readings.known_attitudes import Readings
from counterspin.readings.means import RecordMean
from counterspin.readings.parts import parts_of, poses_of, readings_of
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
    Followed,
    Group,
    candidates,
    most_followed,
)
from counterspin.reports.numbers import format_number

#: Up to so many positions that are off may each be a mistake. More, and more than this share of
#: all, point to the model.
_MAX_LONE_POSITIONS: Final = 3
_MAX_LONE_SHARE: Final = 0.25

#: What hysteresis goes with, in words.
_CAME: Final = {
    APPROACH: "the side from which a position was approached",
    FORCE: "whether the force along the input axis had risen or fallen",
}

#: More standard deviations than this say no more: the others have hardly any noise.
_COUNTABLE: Final = 1000

#: Columns that the residuals of poses may follow.
POSE_PATTERNS: Final = "counterspin.triads.patterns:pose_candidates"

#: What findings about the poses of a triad are about.
TRIAD: Final = "triad"

#: Noise that is smaller than stated by this factor is worth a remark.
_OVERSTATED: Final = 1.1

#: Fewest degrees of freedom by which the size of residuals is compared with the stated noise.
_FEWEST_FOR_SIZE: Final = 0.5


def readings_fit(view: AccelerometerView) -> list[Finding]:
    """Return a finding for each motion whose residuals are not noise, or cannot be tested.

    Noise that was stated is what they are compared with; noise that was estimated shows a misfit
    where positions were read more than once. Beside that, whatever the noise, it is asked what the
    residuals follow. Both share the significance, and so do the motions. Single readings that stand
    out have findings of their own, but where many do and it is known what they follow.
    """
    parts = readings_of(view)
    level = 0.5 * SIGNIFICANCE
    followed = {place: one for place, one in _followed(view) if one.p * one.tests < level}
    too_few = _none_left(view) or _few_left(view)
    findings = [*too_few]
    for place, part in enumerate(parts):
        if not (too_few or part.stated) and part.tested_freedom < FEWEST_FREEDOM:
            findings.append(too_few_to_test(view.name, part))
        residual = residual_of([part])
        stated = math.isinf(part.noise_dof)
        p = residual.lack_of_fit_p if stated else part.misfit_of_positions
        sentences = []
        if p is not None and p < level / len(parts):
            said = (
                f"The residuals of the {part.label} do not agree with the stated noise"
                if stated
                else f"Positions of the {part.label} deviate more from the model than "
                "repeats of one position from each other"
            )
            sentences = [f"{said} (p = {p:.2g})."]
        general = lack_of_fit_finding(view.name, sentences, residual) if sentences else None
        outlying = lone_or_many(view.name, part)
        if place in followed:
            general = _explained(view.name, part, followed[place], general)
            if _positions(part.outlying()) > _most_lone(part):
                general, outlying = _with_many(general, part, outlying[0]), []
        findings += [general, *outlying] if general else outlying
    return findings


def _none_left(view: AccelerometerView) -> list[Finding]:
    """Return a finding where readings are no more than the coefficients that they alone tell."""
    free = [
        unknown.symbol
        for unknown in view.fit.model.unknowns
        if unknown.owner == view.name and math.isinf(unknown.prior[1])
    ]
    count = sum(part.readings.size for part in readings_of(view))
    if view.has_records or poses_of(view) or not readings_of(view) or count > len(free):
        return []
    text = (
        f"{count} readings cannot test the {len(free)} coefficients that they determine "
        f"({', '.join(free)}): the model fits them whatever is wrong. Take more readings."
    )
    return [Finding(code="unjudged-readings", subject=view.name, text=text)]


def _few_left(view: AccelerometerView) -> list[Finding]:
    """Return a finding where readings of stated noise leave too little to test them by."""
    stated = [part for part in readings_of(view) if math.isinf(part.noise_dof)]
    freedom = sum(part.residual_dof for part in stated)
    if any(any(part.readings.position) for part in stated):
        # Errors of setting a position take up residuals, but they are held to their stated size.
        freedom = sum(part.readings.size for part in stated) - _taken_up(view)
    if view.has_records or poses_of(view) or len(stated) < len(readings_of(view)):
        return []
    if freedom >= FEWEST_FREEDOM:
        return []
    count = sum(part.readings.size for part in stated)
    left = format_number(freedom, 2)
    text = (
        f"{count} readings leave {left} degree{'' if left == '1' else 's'} of freedom after the "
        f"estimation: a pattern in them, such as a drift, hysteresis or a missing term, cannot "
        f"be recognised{_noticed_from(freedom)}. Take more of them, or state what is known of "
        f"more terms."
    )
    return [Finding(code="unjudged-readings", subject=view.name, text=text)]


def _taken_up(view: AccelerometerView) -> float:
    """Return how many degrees of freedom an accelerometer's own unknowns take up.

    Of one with a prior the part by which the readings lessen its variance.
    """
    known = zip(view.fit.model.unknowns, view.fit.solution.u.tolist(), strict=True)
    return sum(
        1.0 - min(u / unknown.prior[1], 1.0) ** 2 if unknown.prior[1] > 0.0 else 0.0
        for unknown, u in known
        if unknown.owner == view.name
    )


def _noticed_from(freedom: float) -> str:
    """Return in words how large residuals must be for chi-square to call them no noise."""
    if freedom <= 0.5:
        return ", nor whether their scatter agrees with the stated uncertainty"
    from scipy.special import chdtri

    times = math.sqrt(float(chdtri(freedom, 0.5 * SIGNIFICANCE)) / freedom)
    least = format_number(times, 2)
    return f", and residuals are noticed only above {least} times the stated uncertainty"


def too_few_to_test(name: str, part: FittedReadings) -> Finding:
    """Return the finding that hardly any freedom is left to test residuals by."""
    text = (
        f"{part.readings.size} {part.label} without a stated uncertainty leave "
        f"{format_number(part.tested_freedom, 2)} degrees of freedom after the estimation: their "
        "residuals cannot be tested. State their uncertainty, or take more of them."
    )
    return Finding(code="unjudged-readings", subject=name, text=text)


def _followed(view: AccelerometerView) -> Iterator[tuple[int, Followed]]:
    """Yield what the residuals of each motion follow most: its place, and what it is."""
    fit = relax(view.fit)
    testable = {
        place: part
        for place, part in enumerate(readings_of(view))
        if part.place_in(fit) is not None and part.tested_freedom >= FEWEST_FREEDOM
    }
    if not testable:
        return
    groups = [group_of(part, part.place_in(fit) or 0) for part in testable.values()]
    columns = [columns_beside(fit, group) for group in groups]
    places = list(testable)
    for one in most_followed(fit, groups, columns):
        yield places[one.group], one


def columns_beside(fit: JointFit, group: Group) -> tuple[Alternative, ...]:
    """Return the columns that the residuals of readings or poses may follow, beside a fit."""
    readings = group.readings
    unknown = {(u.owner, u.symbol): math.isfinite(u.prior[1]) for u in fit.model.unknowns}
    if readings.triad:
        known = {key for key, stated in unknown.items() if stated}
        return tuple(load_name(POSE_PATTERNS)(readings, group.place, fit, unknown, known))
    assert isinstance(readings, Readings)
    name = readings.accelerometer
    acting = {symbol for owner, symbol in unknown if owner in (name, "")}
    own = {symbol for (owner, symbol), stated in unknown.items() if owner == name and stated}
    return tuple(candidates(readings, group.place, acting, own))


def group_of(part: FittedReadings, place: int) -> Group:
    """Return readings or poses as they are tested.

    place: Among the observations of the fit.
    """
    readings, estimated = part.readings, not part.has_external_noise
    lone = tuple(sorted({place for one in part.outlying() for place in one.places}))
    return Group(
        readings,
        place,
        part.sigma,
        part.linear.noise_share if estimated else np.ones(readings.size),
        # The noise that is estimated is such that they are what is expected.
        part.noise_dof if estimated else part.chi2,
        part.noise_dof if estimated else part.residual_dof,
        estimated,
        float(readings.scatter.sum()) / part.noise**2 if estimated else 0.0,
        lone if len(lone) <= _most_lone(part) else (),
    )


def _explained(
    name: str, part: FittedReadings, followed: Followed, general: Finding | None
) -> Finding:
    """Return the finding that residuals follow something, the best explanation first."""
    first = followed.alternatives[0]
    size = equivalent_deviations(followed.p)
    text = f"The residuals of the {part.label} {clause_of(first)} (p = {followed.p:.2g})."
    terms = [other.symbol for other in followed.alternatives if other.kind == TERM]
    if first.kind == TERM:
        terms = terms[1:]
    if first.kind == WAVE:
        made = f", or {' or '.join(terms)} in the accelerometer," if terms else ""
        text += f" An error of the head that varies with its angle{made} would have this effect."
    elif terms:
        text += f" {' or '.join(terms)} would have the same effect."
    others = dict.fromkeys(
        clause_of(other) for other in followed.alternatives[1:] if other.kind not in (TERM, WAVE)
    )
    text += "".join(f" Equally well, they {clause}." for clause in others)
    if general is not None:
        text += f" {general.text}"
    return Finding(
        code="lack-of-fit",
        subject=name,
        text=text,
        size=size,
        contradicts=size > CONTRADICTION_SIGMAS or (general is not None and general.contradicts),
    )


def clause_of(other: Alternative) -> str:
    """Return the description of residuals that follow a column, as the end of a sentence."""
    when = {
        "order": "the order in which they were taken",
        "angle": "the angle of the head",
    }.get(other.symbol.rpartition(" ")[2], "the time of reading")
    return {
        WAVE: f"follow {other.symbol}, phi being the angle of the head from input axis up",
        HEAD: f"look like an error of the head {other.symbol.partition(' ')[2]} a turn",
        TERM: f"follow {other.symbol}, more than the model allows",
        DRIFT: f"drift with {when}",
        WARM_UP: f"settle with {when}, as after a warm-up",
        BEND: f"drift and reverse with {when}",
        SCALE: f"have a scale that drifts with {when}",
        TURN: f"look like positions that rotate steadily with {when}",
        SWING: f"swing {other.symbol.partition(' ')[2].partition(' ')[0]} times with {when}",
        ASYMMETRY: f"look like a {other.symbol} that differs for negative forces",
        RANGE: f"look like a gain that changes above {other.symbol}, as between ranges of a meter",
        STEP: f'step, from "{other.symbol}" on',
        SENSE: "depend on the sense in which the machine turned",
        REVERSED: "look like a rotation in the other sense than stated",
        HYSTERESIS: f"depend on {_CAME.get(other.symbol)} (hysteresis)",
    }[other.kind]


def lone_or_many(name: str, part: FittedReadings) -> list[Finding]:
    """Return a finding for each position that stands out, or one where many do."""
    far_off = part.outlying()
    if _positions(far_off) <= _most_lone(part):
        return [_outlying(part, name, one) for one in far_off]
    worst = _outlying(part, name, max(far_off, key=lambda one: abs(one.z)))
    text = (
        f"{_count(far_off)} of {part.readings.size} {part.label} deviate from the model: so many "
        f"suggest a fault of the model rather than of single readings. {worst.text}"
    )
    return [worst.model_copy(update={"text": text})]


def _with_many(misfit: Finding, part: FittedReadings, worst: Finding) -> Finding:
    """Return a misfit of known shape with the many positions that it puts off the model."""
    many = f"{_count(part.outlying())} of {part.readings.size} {part.label} deviate from the model."
    said = {
        "text": f"{misfit.text} {many}",
        "size": max(misfit.size or 0.0, worst.size or 0.0),
        "contradicts": misfit.contradicts or worst.contradicts,
    }
    return misfit.model_copy(update=said)


def _most_lone(part: FittedReadings) -> float:
    return max(_MAX_LONE_POSITIONS, _MAX_LONE_SHARE * part.readings.size)


def _count(far_off: Sequence[Outlying]) -> int:
    """Count the outlying readings, alone or with those of their position."""
    return len({place for one in far_off for place in one.places})


def _positions(far_off: Sequence[Outlying]) -> int:
    """Return how many positions are off: a reading that is named beside its own is none more."""
    whole = [set(one.places) for one in far_off]
    return sum(1 for one in whole if not any(one < other for other in whole))


def _outlying(part: FittedReadings, name: str, one: Outlying) -> Finding:
    what = "pose" if part.readings.motion == "poses" else "position"
    deviations = f"{abs(one.z):.1f}" if abs(one.z) < _COUNTABLE else f"more than {_COUNTABLE}"
    return Finding(
        code="outlying-reading",
        subject=f"{name}.{one.name}",
        text=f'The {what} "{one.name}" deviates from the model by '
        f"{format_number(one.residual * 1e6, 3)} ug, {deviations} standard deviations: "
        f"check this reading{_and_rate(part)}, or look for a missing term.",
        size=abs(one.z),
        contradicts=abs(one.z) > CONTRADICTION_SIGMAS and math.isinf(part.noise_dof),
    )


def _and_rate(part: FittedReadings) -> str:
    return " and its rate" if part.readings.motion in ("arm", "counter-rotating") else ""


def no_more_than_rounded(views: Sequence[AccelerometerView]) -> Iterator[str]:
    """Yield a remark for each motion in which readings show no more noise than their digits."""
    for view in views:
        for part in readings_of(view):
            if part.readings.u is None and part.has_external_noise:
                size = format_number(part.readings.least_noise * 1e6, 2)
                yield (
                    f"{view.name}: the {part.label} follow the model to their last digit. Their "
                    f"noise is assumed to be rounding, {size} ug; if it is larger, "
                    "state it with each reading (±)."
                )


def outliers_of_means(name: str, means: Mapping[tuple[str, str], RecordMean]) -> list[Finding]:
    """Return a finding for each record whose mean is a reading and that lost many rows."""
    return [
        finding
        for (owner, reading), mean in means.items()
        if owner == name
        for finding in check_outlier_share(f"{name}.{reading}", mean.report.counts())
    ]


def overstated_noise(views: Sequence[AccelerometerView]) -> Iterator[str]:
    """Yield a remark for each group of readings or poses that scatters less than is stated.

    u is then too large, which speaks against nothing.
    """
    stated = {id(part.readings): part for view in views for part in parts_of(view) if part.stated}
    for part in stated.values():
        scale, dof = part.linear.moments_of_noise(views[0].fit.solution)
        if dof < _FEWEST_FOR_SIZE:
            continue
        squares = float(np.sum((part.residuals / part.sigma) ** 2))
        times = math.sqrt(squares / (scale * dof))
        p = 1.0 - chi_square_tail(dof, squares / scale)
        if p >= CHI_SQUARE_SIGNIFICANCE / len(stated) or times * _OVERSTATED > 1.0:
            continue
        u = median(part.sigma)
        shown, said = (f"{format_number(1e6 * size, 2)} ug" for size in (times * u, u))
        name = TRIAD if part.readings.triad else part.readings.accelerometer
        yield (
            f"{name}: the {part.label} scatter by {shown}, {format_number(times, 2)} times "
            f"the stated uncertainty of {said}. u is too large. "
            "State the noise of single readings, and errors that all of them share as priors."
        )
