"""What is wrong, if something is: the likely causes of a misfit, each tried on the records.

Priors are always held to the records, for that is algebra on the solved equations. The other
mistakes that are likely are tried only where something is suspicious: residuals, runs or priors.
The best explanation is taken into the fit, with noise estimated again where it was estimated, and
the search goes on beside it until nothing explains anything better.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import median
from counterspin.calibration.checks.limits import beyond_typical, incredible
from counterspin.calibration.checks.priors import Wording
from counterspin.calibration.checks.residuals import residual_findings
from counterspin.calibration.diagnosis.noise import with_noise_by_run, wrong_noise
from counterspin.calibration.diagnosis.statements import (
    OtherMounting,
    better,
    other_mountings,
    unseen_axes,
    untested_statements,
    wrong_mounting,
)
from counterspin.calibration.diagnosis.words import Explanation
from counterspin.calibration.extensions import Diagnosis
from counterspin.calibration.findings import ACCOUNTABLE, CONTRADICTION_SIGMAS, Cause, from_numbers
from counterspin.calibration.model import assumed_inputs, assumed_of, inputs_of
from counterspin.calibration.outcome import coefficient, knowledge, noise_lines, residual
from counterspin.calibration.result_parts import AccelerometerResult, Finding
from counterspin.calibration.view import AccelerometerView
from counterspin.campaign.description import Campaign
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import (
    SIGNIFICANCE,
    normal_equivalent,
)
from counterspin.inference.joint import mistakes
from counterspin.inference.joint.alternatives import (
    Alternative,
    Scores,
    of_priors,
    of_unstated,
    scores,
)
from counterspin.inference.joint.estimation import Estimate, estimate_again
from counterspin.inference.joint.fit import JointFit, extended, relax
from counterspin.inference.joint.found_noise import unseen_covariance
from counterspin.inference.joint.series import TIMING
from counterspin.inference.joint.unknowns import Unknown
from counterspin.inference.least_squares import NO_PRIOR
from counterspin.inference.noise.model import Noise
from counterspin.physics.motion import gravity_range, latitudes_with
from counterspin.physics.terms import ACCELEROMETER_TERMS, INPUTS

#: Share of good campaigns in which a prior, or another alternative, is blamed all the same.
_FALSE_ALARMS: Final = 0.5 * SIGNIFICANCE

#: Probability by chance below which the alternatives are tried.
_SUSPICION_P: Final = 0.01

#: Shift of a run left out, or of the two-stage method, above which they are tried.
_SUSPICION_SHIFT: Final = 3.0

#: Causes that are looked for, one after the other.
_MAX_CAUSES: Final = 3

#: Chi-square by which an explanation must be better than another to exclude it.
_DECISIVE_CHI2: Final = 6.0

#: Part of the first cause's size below which a further cause may only show that the first is
#: known to first order.
_FIRST_ORDER_PART: Final = 0.03

#: How often a cause's columns are worked out again for its size.
_REFINEMENTS: Final = 4

#: How many of the explanations that are as good are named.
_MAX_RIVALS: Final = 3

#: And the part of it, for what an alternative does is known to first order.
_DECISIVE_PART: Final = 0.003

#: How many times its largest credible size a term may have where nothing credible explains as much.
_OUTSIZE: Final = 10.0

#: Anomalies of the ground's gravity are mostly smaller, m/s^2.
_ANOMALY: Final = 1e-3

#: A latitude is likely as stated, or with the other sign, within so much, rad.
_LATITUDE: Final = math.radians(1.0)

#: Steps that are tried in each record, and again about the best of them.
_STEPS: Final = 24

_KINDS_OF_PRIORS: Final = ("prior", "priors")

#: What comes first where the records cannot tell: what is stated is checked at no cost, and the
#: velocity of the Coriolis acceleration, all or nothing, is seldom as large by chance.
_FIRST_KINDS: Final = (mistakes.CORIOLIS, *_KINDS_OF_PRIORS)
_KINDS_WITH_A_TIME: Final = (mistakes.JUMP, mistakes.SLOPE, mistakes.BIAS_STEP)  # in a record


def diagnose(
    views: Sequence[AccelerometerView], results: Mapping[str, AccelerometerResult]
) -> Diagnosis:
    """Return the causes of the findings on a joint fit, and remarks on claims it cannot check."""
    mountings = other_mountings(views)
    return Diagnosis(
        causes_of(views, results, mountings),
        (*unseen_axes(mountings), *untested_statements(views)),
    )


def causes_of(
    views: Sequence[AccelerometerView],
    results: Mapping[str, AccelerometerResult],
    mountings: Sequence[OtherMounting] = (),
) -> tuple[Cause, ...]:
    """Return the causes of what is found against a joint fit, the main one first.

    mountings: The other mountings of accelerometers whose stated terms rest on them.
    """
    estimated = views[0].estimate
    read = [part for view in views for part in view.parts]
    given = not estimated.components and all(part.weighed for part in read)
    now = replace(estimated, fit=relax(estimated.fit), core=None, lost={})
    priors = of_priors(now.fit)
    turned = better(mountings)
    # Beside readings alone, what nothing states is held to them at no cost too.
    known = priors if now.fit.prepared else (*priors, *of_unstated(now.fit))
    if (
        not _is_suspicious(views, results)
        and turned is None
        and (not known or _least(scores(now.fit, known, noise_given=given)) > _SUSPICION_P)
    ):
        return ()
    others = tuple(_others(views, now)) if now.fit.prepared else of_unstated(now.fit)
    priors, others = (_possible(views[0].campaign, every) for every in (priors, others))
    return _causes(views, now, priors, others, given, turned) if priors or others else ()


def _causes(
    views: Sequence[AccelerometerView],
    now: Estimate,
    priors: Sequence[Alternative],
    others: Sequence[Alternative],
    given: bool,
    turned: OtherMounting | None,
) -> tuple[Cause, ...]:
    """Return the causes among some alternatives, one beside the other.

    turned: A mounting that fits better than the stated one; it has no parameter that could fit.
    """
    campaign = views[0].campaign
    now, off = with_noise_by_run(views, now)
    causes = [Cause(one, (one.subject,), _remaining(views, now)) for one in off]
    first = 0.0
    if turned is not None:
        explained = _best(now, priors, others, given)
        if explained is None or turned.gain >= _least_as_good(explained.size**2):
            now = replace(now, fit=turned.fit)
            views = [turned.seen_by(view) for view in views]
            own = (turned.view.name,)
            causes.append(Cause(wrong_mounting(turned), own, _remaining(views, now)))
            first = math.sqrt(turned.gain)
    for _ in range(_MAX_CAUSES):
        explained = _best(now, priors, others, given)
        if explained is None or (causes and explained.size < _FIRST_ORDER_PART * first):
            break
        first = first or explained.size
        after, explained = _put_right(now, explained, views)
        if not given:
            # Beside the noise that is left without it, other causes may be wording from it.
            calmer = replace(now, fit=now.fit.with_noise(after.fit.noise))
            again = _best(calmer, priors, others, given)
            if again is not None:
                after, explained = _put_right(now, again, views)
            if not _is_clear(now, explained):
                break
        if not explained.outsized and not explained.head.credible(explained.value):
            # At its own size, beyond first order, it is not what it seemed to be.
            others = [other for other in others if other != explained.head]
            continue
        wording = Explanation(
            campaign, now.fit, explained.head, explained.value, explained.u
        ).wording()
        causes.append(_cause(wording, explained, views, now, after))
        now = after
    if given:
        seen = (replace(view, estimate=now) for view in views if view.has_records)
        wrong = (one for view in seen for one in wrong_noise(view))
        by_size = sorted(wrong, key=lambda one: -(one.size or 0.0))
        causes += [Cause(one, (one.subject,), {}) for one in by_size]
    return tuple(causes)


# Whether to look for causes at all


def _least(held: Scores) -> float:
    """Return the smallest probability of the tests, all of them counted."""
    if not held.tested:
        return 1.0
    return min(1.0, held.tested * held.p(int(np.argmax(held.size))))


def _is_suspicious(
    views: Sequence[AccelerometerView], results: Mapping[str, AccelerometerResult]
) -> bool:
    records = sum(1 for view in views for _ in view.records())
    for view in views:
        result = results[view.name]
        codes = {finding.code for finding in (*result.findings, *_numbers(view, result))}
        if codes & ACCOUNTABLE:
            return True
        shifts = [normal_equivalent(line.z, line.dof) for line in result.jackknife if line.z]
        shifts += [abs(result.two_stage.z)] if result.two_stage else []
        if any(z > _SUSPICION_SHIFT for z in shifts):
            return True
        if view.has_records and any(p < _SUSPICION_P / records for p in _chances(view)):
            return True
    return False


def _chances(view: AccelerometerView) -> Iterator[float]:
    """Yield probabilities of what an accelerometer's whitened residuals show of each run."""
    tests = view.diagnostics.runs
    for _, prepared, residuals in view.records():
        test = tests[prepared.run]
        yield 3.0 * mistakes.window_excess(residuals.whitened)
        off = (test.chi2 - test.dof) / math.sqrt(2.0 * test.dof)
        yield 3.0 * math.erfc(abs(off) / math.sqrt(2.0))
        yield 3.0 * _wave(
            test.periodogram,
            test.rows,
            prepared.series.trajectory.spindle.rate,
            median(np.diff(prepared.series.time)),
            test.chi2 / test.dof,
        )


def _wave(power: np.ndarray, rows: int, rate: float, interval: float, scale: float) -> float:
    """Return the probability of a wave as strong at the spindle's own frequency."""
    line = round(abs(rate) * interval * rows / (2.0 * math.pi)) - 1
    near = power[max(line - 1, 0) : line + 2]
    if not near.size or not scale > 0.0:
        return 1.0
    return min(1.0, near.size * math.exp(-float(near.max()) / scale))


# The alternatives


def _possible(campaign: Campaign, alternatives: Sequence[Alternative]) -> tuple[Alternative, ...]:
    """Return alternatives with what an input may be, which hangs on what is stated of it."""
    inputs = inputs_of(campaign)
    between = {
        name: row.effect.between
        for name in inputs
        for symbol, row in INPUTS.items()
        if name == symbol or name.endswith(f".{symbol}")
    }
    gravity, latitude = campaign.gravity.value, campaign.latitude.value
    low, high = gravity_range(latitude)
    here, beyond = (low - _ANOMALY, high + _ANOMALY), (0.0, 0.0)
    if here[0] <= gravity <= here[1]:  # else either may be the wrong one
        between["site.gravity"] = here
        least, most = latitudes_with(gravity, _ANOMALY)
        # On either side of the equator, for its sign may be wrong.
        between["site.latitude"] = -most, most
        beyond = -least - latitude, least - latitude
    possible = {
        name: (least - inputs[name].value, most - inputs[name].value)
        for name, (least, most) in between.items()
    }
    return tuple(
        replace(
            other,
            between=possible[other.name],
            but_between=beyond if other.name == "site.latitude" else other.but_between,
            likely=(0.0, -2.0 * latitude) if other.name == "site.latitude" else (),
            likely_within=_LATITUDE,
            stated=inputs[other.name].value != 0.0,
        )
        if other.name in possible
        else other
        for other in alternatives
    )


def _others(views: Sequence[AccelerometerView], now: Estimate) -> Iterator[Alternative]:
    campaign, fit = views[0].campaign, now.fit
    model = views[0].problem.model
    angle = campaign.angle is not None
    yield from of_unstated(fit)
    # Of what acts on readings too, the records alone tell half of it.
    inputs = {
        s: campaign.typical_of(s)
        for s in assumed_inputs(campaign)
        if s == TIMING or not campaign.readings
    }
    yield from mistakes.of_inputs(fit, inputs)
    trends = {view.name: campaign.typical_of("K_F.trend", view.name) for view in views}
    yield from mistakes.of_records(fit, trends, angle_recorded=angle)
    yield from mistakes.of_coriolis(fit, own_velocity=campaign.own_velocity)
    terms = {
        other: campaign.typical_of(other.symbol, other.owner)
        for view in views
        for other in assumed_of(campaign, model, view.name)
        if not (campaign.readings and other.symbol in ACCELEROMETER_TERMS)
    }
    yield from mistakes.of_terms(fit, terms)
    yield from mistakes.jumps(fit, _STEPS)


@frozen
class _BestExplanation:
    """The best explanation, and those that are as good, each with the estimate of its parameter."""

    head: Alternative
    value: float
    u: float
    size: float
    rivals: tuple[tuple[Alternative, float], ...]
    tests: int
    dof: float | None
    outsized: bool


def _best(
    now: Estimate, priors: Sequence[Alternative], others: Sequence[Alternative], given: bool
) -> _BestExplanation | None:
    """Return the best explanation; None if no explanation is significant."""
    every = (*priors, *others)
    held = scores(now.fit, every, noise_given=given)
    place = _largest(held)
    if held.alternatives[place].kind in _KINDS_WITH_A_TIME:
        # Now that it is known where about it is, where exactly?
        about = held.alternatives[place]
        (i,) = about.columns
        time = now.fit.prepared[i].series.time
        cell = float(time[-1] - time[0]) / _STEPS
        every = (*every, *mistakes.jumps(now.fit, 2 * _STEPS, about, cell))
        held = scores(now.fit, every, noise_given=given)
        place = _largest(held)
    if not _is_significant(held, place):
        # The priors have fewer tests, and so a lower threshold.
        place = _largest(held, _KINDS_OF_PRIORS)
        if not _is_significant(held, place):
            return None
    return _with_rivals(held, _outsized(held, place), given)


def _outsized(held: Scores, place: int) -> int:
    """Return the term larger than credible that explains more than the best one, or that one.

    It is asked only where the best credible one is more than chance, so that nothing is blamed in
    more good campaigns.
    """
    sizes = [size if _is_outsized(held, k) else 0.0 for k, size in enumerate(held.size.tolist())]
    largest = int(np.argmax(sizes))
    return largest if _least_as_good(sizes[largest] ** 2) > held.size[place] ** 2 else place


def _is_outsized(held: Scores, place: int) -> bool:
    other = held.alternatives[place]
    size = abs(float(held.value[place]))
    return other.kind == "term" and other.between[1] < size <= _OUTSIZE * other.between[1]


def _least_as_good(best: float) -> float:
    """Return the least gain in chi-square that is as good as the best one."""
    return max(best * (1.0 - _DECISIVE_PART) - _DECISIVE_CHI2, 0.0)


def _largest(held: Scores, kinds: Sequence[str] = ()) -> int:
    """Return which credible alternative, of some kinds or of any, explains most."""
    asked = [
        size if (not kinds or other.kind in kinds) and _credible(held, k) else -1.0
        for k, (other, size) in enumerate(zip(held.alternatives, held.size.tolist(), strict=True))
    ]
    return int(np.argmax(asked))


def _is_significant(held: Scores, place: int) -> bool:
    return held.p(place) * _tests(held, place) < _FALSE_ALARMS


def _tests(held: Scores, place: int) -> int:
    """Return how many alternatives share the significance of one of them."""
    of_priors = held.alternatives[place].kind in _KINDS_OF_PRIORS
    tests = sum(
        1
        for other, u in zip(held.alternatives, held.u.tolist(), strict=True)
        if math.isfinite(u) and (other.kind in _KINDS_OF_PRIORS) == of_priors
    )
    return max(tests, 1)


def _with_rivals(held: Scores, place: int, given: bool) -> _BestExplanation:
    every = held.alternatives
    least = _least_as_good(float(held.size[place]) ** 2)
    as_good = [
        k
        for k in range(len(every))
        if held.size[k] ** 2 > least and (_credible(held, k) or _is_outsized(held, k))
    ]
    # Steps differ by where they are only: the best one stands for those of its record.
    as_good = [k for k in as_good if k == place or every[k].kind not in _KINDS_WITH_A_TIME] or [
        place
    ]

    slack = float(held.size[place]) ** 2 - least

    def plausible(k: int) -> tuple[bool, bool, bool, float, bool, int]:
        # What is short of the best by all that is allowed is short of it by a decisive chi-square.
        short = _DECISIVE_CHI2 * (float(held.size[place]) ** 2 - float(held.size[k]) ** 2) / slack
        evidence = (
            mistakes.log_evidence(every[k], float(held.value[k]), float(held.u[k])) - 0.5 * short
        )
        # Of what rounding alone tells apart, what the whole campaign has comes first.
        weight, own = round(-evidence, 6), bool(every[k].owner)
        doubtful = every[k].farfetched(float(held.value[k]))
        return _is_outsized(held, k), doubtful, every[k].kind not in _FIRST_KINDS, weight, own, k

    first, *rivals = sorted(as_good, key=plausible)
    return _BestExplanation(
        every[first],
        float(held.value[first]),
        float(held.u[first]),
        float(held.size[first]),
        tuple((every[k], float(held.value[k])) for k in rivals),
        _tests(held, first),
        None if given else held.dof,
        _is_outsized(held, first),
    )


def _is_clear(now: Estimate, explained: _BestExplanation) -> bool:
    """Return whether a cause is more than chance with noise that the records do not show."""
    variance = explained.u**2
    if not explained.head.columns:
        # Of a column the fit with it has said so already. The shift of priors is the sum of their
        # distances from the estimates, each weighted with the inverse of its own variance.
        gain = np.zeros(len(now.fit.model.unknowns))
        for place, moved in explained.head.priors.items():
            spread = now.fit.model.unknowns[place].prior[1]
            gain[place] = moved * variance / spread**2 if spread > 0.0 else 0.0
        variance += float(gain @ unseen_covariance(now.fit, now.components) @ gain)
    size = abs(explained.value) / math.sqrt(variance)
    return math.erfc(size / math.sqrt(2.0)) * explained.tests < _FALSE_ALARMS


def _credible(held: Scores, place: int) -> bool:
    """Return whether an alternative would be no larger than it may credibly be."""
    return held.alternatives[place].credible(float(held.value[place]))


def _put_right(
    now: Estimate, explained: _BestExplanation, views: Sequence[AccelerometerView]
) -> tuple[Estimate, _BestExplanation]:
    """Return the estimate with a cause allowed for, and the cause as it is then."""
    requests = views[0].problem.noise
    head = explained.head
    if not head.columns:
        unknowns = list(now.fit.model.unknowns)
        for place, moved in head.priors.items():
            value, u = unknowns[place].prior
            unknowns[place] = replace(unknowns[place], prior=(value + moved * explained.value, u))
        model = replace(now.fit.model, unknowns=tuple(unknowns))
        return _again(now, replace(now.fit, model=model).with_noise({}), requests), explained
    value, after = explained.value, now
    for _ in range(_REFINEMENTS):
        limit = 10.0 * math.hypot(value, explained.u)
        own = Unknown("", head.name, NO_PRIOR, limit)
        after = replace(now, fit=extended(now.fit, [own], [head.columns]))
        value = float(after.fit.solution.estimate[-1])
        refined = mistakes.at_size(after.fit, head, value)
        if refined is head:
            break
        head = refined
    after = _again(now, after.fit, requests)
    solution = after.fit.solution
    u = float(solution.u[-1])
    return after, replace(explained, head=head, value=float(solution.estimate[-1]), u=u)


def _again(now: Estimate, fit: JointFit, requests: Mapping[str, Noise]) -> Estimate:
    if not now.components:
        dof = np.full(len(fit.model.unknowns), math.inf)
        return replace(now, fit=fit, dof=dof, core=None, lost={})
    return estimate_again(now, fit, requests)


# What is said


def _cause(
    wording: Wording,
    explained: _BestExplanation,
    views: Sequence[AccelerometerView],
    before: Estimate,
    after: Estimate,
) -> Cause:
    campaign = views[0].campaign
    concerned = _concerned(explained.head, views, before)
    text = wording.text
    moved = 0.0
    for view in views:
        for symbol, place in view.places.items():
            if not view.assessment.determined[f"{view.name}.{symbol}"]:
                continue
            shift = float(after.fit.solution.estimate[place] - before.fit.solution.estimate[place])
            moved = max(moved, abs(shift) / float(view.fit.solution.u[place]))
    rivals = [
        Explanation(campaign, before.fit, other, value, 1.0).wording()
        for other, value in explained.rivals
    ]
    if rivals:
        names = [rival.name for rival in rivals[:_MAX_RIVALS]]
        more = len(rivals) - len(names)
        names += [f"{more} more" if more > 1 else "one more"] if more else []
        text += f" The records would fit equally well with another {' or '.join(names)}."
    far = normal_equivalent(explained.size, explained.dof) > CONTRADICTION_SIGMAS
    contradicts = far and (moved > 1.0 or explained.head.kind == "prior")
    return Cause(
        Finding(
            code=wording.code,
            subject=wording.subject,
            text=text,
            size=explained.size,
            contradicts=contradicts,
            as_well=list(dict.fromkeys(rival.subject for rival in rivals)),
        ),
        concerned,
        _remaining(views, after),
    )


def _remaining(
    views: Sequence[AccelerometerView], after: Estimate
) -> Mapping[tuple[str, str], float]:
    """Return code, subject and size of what the checks still find in another fit."""
    found = [finding for view in views for finding in _checked(_seen_again(view, after))]
    found += beyond_typical(knowledge(after, inputs_of(views[0].campaign)))
    return {(finding.code, finding.subject): finding.size or math.inf for finding in found}


def _concerned(
    head: Alternative, views: Sequence[AccelerometerView], now: Estimate
) -> tuple[str, ...]:
    names = [view.name for view in views]
    if head.columns:
        shown = {now.fit.prepared[i].accelerometer for i, c in head.columns.items() if c.any()}
        return tuple(name for name in names if name in shown)
    return (head.owner,) if head.owner in names else tuple(names)


def _seen_again(view: AccelerometerView, after: Estimate) -> AccelerometerView:
    """Return a view of a relaxed fit, with the readings as they fit that."""
    parts = [part.under(after.fit) for part in view.parts]
    return replace(view, estimate=after).with_parts(parts)


def _checked(view: AccelerometerView) -> Iterator[Finding]:
    yield from residual_findings(view)
    yield from _numbers(view, None)
    own = {
        symbol: coefficient(view.estimate, view.assessment, place)
        for symbol, place in view.places.items()
        if f"{view.name}.{symbol}" in view.assessment.determined  # not what was considered before
    }
    for finding in incredible(view.campaign.limit_of, view.name, own):
        yield from (finding, *finding.explains)


def _numbers(view: AccelerometerView, result: AccelerometerResult | None) -> Iterator[Finding]:
    """Yield what follows from the numbers of a fit as one accelerometer sees it."""
    seen = result or AccelerometerResult(
        coefficients={},
        correlation=None,
        residual=residual(view),
        noise=noise_lines(view),
        jackknife=view.jackknife(),
    )
    campaign = view.campaign
    yield from from_numbers(view.name, seen, campaign.gravity.value, len(campaign.accelerometers))
