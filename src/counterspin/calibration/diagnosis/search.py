"""Search for the likely causes of a misfit, each tried on the records.

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
from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.checks.limits import check_credibility, check_default_priors
from counterspin.calibration.checks.priors import FindingText
from counterspin.calibration.checks.residuals import residual_findings
from counterspin.calibration.diagnosis.explanations import Explanation
from counterspin.calibration.diagnosis.noise import check_stated_noise, reweight_runs
from counterspin.calibration.diagnosis.ranking import (
    FALSE_ALARMS,
    STEPS,
    BestExplanation,
    find_best,
    min_equal_gain,
)
from counterspin.calibration.diagnosis.untested_inputs import (
    AlternativeMounting,
    find_better_mounting,
    fit_alternative_mountings,
    mounting_finding,
    undetermined_axis_remarks,
    untested_input_remarks,
)
from counterspin.calibration.extensions import Diagnosis
from counterspin.calibration.findings import (
    ACCOUNTABLE,
    CONTRADICTION_SIGMAS,
    Cause,
    check_statistics,
)
from counterspin.calibration.model import exact_inputs, fixed_terms, stated_inputs
from counterspin.calibration.outcome import (
    make_coefficient,
    noise_lines,
    prior_information,
    summarize_residuals,
)
from counterspin.calibration.result_parts import AccelerometerResult, Finding
from counterspin.campaign.description import Campaign
from counterspin.inference.diagnostics import (
    normal_equivalent,
)
from counterspin.inference.joint import mistakes
from counterspin.inference.joint.alternatives import (
    Alternative,
    ScoreTests,
    default_prior_alternatives,
    prior_alternatives,
    run_score_tests,
)
from counterspin.inference.joint.estimated_noise import undetected_walk_covariance
from counterspin.inference.joint.estimation import Estimate, reestimate
from counterspin.inference.joint.fit import JointFit, augment, estimate_considered
from counterspin.inference.joint.series import TIMING
from counterspin.inference.joint.unknowns import Unknown
from counterspin.inference.least_squares import NO_PRIOR
from counterspin.inference.noise.model import Noise
from counterspin.physics.gravity import gravity_range, latitudes_with
from counterspin.physics.terms import ACCELEROMETER_TERMS, INPUTS

#: Probability by chance below which the alternatives are tried.
_SUSPICION_P: Final = 0.01

#: Probability of a shift by chance below which they are tried, for a run that is left out or the
#: two-stage method; with many records, all shifts share `_SUSPICION_P`. That of 3 sigma.
_SUSPICION_SHIFT_P: Final = math.erfc(3.0 / math.sqrt(2.0))

#: Causes that are looked for, one after the other.
_MAX_CAUSES: Final = 3

#: Part of the first cause's size below which a further cause may only show that the first is
#: known to first order.
_MIN_RELATIVE_SIZE: Final = 0.03

#: How often a cause's columns are worked out again for its size.
_REFINEMENTS: Final = 4

#: How many of the explanations that are as good are named.
_MAX_RIVALS: Final = 3

#: Anomalies of the ground's gravity are mostly smaller, m/s^2.
_ANOMALY: Final = 1e-3

#: A latitude is likely as stated, or with the other sign, within so much, rad.
_LATITUDE: Final = math.radians(1.0)


def diagnose(
    views: Sequence[AccelerometerView], results: Mapping[str, AccelerometerResult]
) -> Diagnosis:
    """Return the causes of the findings on a joint fit, and remarks on claims it cannot check."""
    mountings = fit_alternative_mountings(views)
    return Diagnosis(
        find_causes(views, results, mountings),
        (*undetermined_axis_remarks(mountings), *untested_input_remarks(views)),
    )


def find_causes(
    views: Sequence[AccelerometerView],
    results: Mapping[str, AccelerometerResult],
    mountings: Sequence[AlternativeMounting] = (),
) -> tuple[Cause, ...]:
    """Return the causes of what is found against a joint fit, the main one first.

    mountings: The other mountings of accelerometers whose stated terms rest on them.
    """
    estimate = views[0].estimate
    groups = [group for view in views for group in view.groups]
    noise_known = not estimate.estimated_noise and all(group.has_external_noise for group in groups)
    relaxed_estimate = replace(
        estimate, fit=estimate_considered(estimate.fit), compressed_fit=None, information_losses={}
    )
    priors = prior_alternatives(relaxed_estimate.fit)
    mounting = find_better_mounting(mountings)
    # Beside readings alone, what nothing states is held to them at no cost too.
    tested = (
        priors
        if relaxed_estimate.fit.design_blocks
        else (*priors, *default_prior_alternatives(relaxed_estimate.fit))
    )
    if (
        not _is_suspicious(views, results)
        and mounting is None
        and (
            not tested
            or _smallest_p(run_score_tests(relaxed_estimate.fit, tested, noise_given=noise_known))
            > _SUSPICION_P
        )
    ):
        return ()
    alternatives = (
        tuple(_alternative_hypotheses(views, relaxed_estimate))
        if relaxed_estimate.fit.design_blocks
        else default_prior_alternatives(relaxed_estimate.fit)
    )
    priors, alternatives = (
        _with_input_ranges(views[0].campaign, candidates) for candidates in (priors, alternatives)
    )
    return (
        _search_causes(views, relaxed_estimate, priors, alternatives, noise_known, mounting)
        if priors or alternatives
        else ()
    )


def _search_causes(
    views: Sequence[AccelerometerView],
    estimate: Estimate,
    priors: Sequence[Alternative],
    alternatives: Sequence[Alternative],
    noise_known: bool,
    mounting: AlternativeMounting | None,
) -> tuple[Cause, ...]:
    """Return the causes among some alternatives, one beside the other.

    mounting: A mounting that fits better than the stated one; it has no parameter that could fit.
    """
    campaign = views[0].campaign
    estimate, noise_findings = reweight_runs(views, estimate)
    causes = [
        Cause(finding, (finding.subject,), _remaining_findings(views, estimate))
        for finding in noise_findings
    ]
    first_size = 0.0
    if mounting is not None:
        explanation = find_best(estimate, priors, alternatives, noise_known)
        if explanation is None or mounting.gain >= min_equal_gain(explanation.size**2):
            estimate = replace(estimate, fit=mounting.fit)
            views = [mounting.apply_to(view) for view in views]
            names = (mounting.view.name,)
            causes.append(
                Cause(mounting_finding(mounting), names, _remaining_findings(views, estimate))
            )
            first_size = math.sqrt(mounting.gain)
    for _ in range(_MAX_CAUSES):
        explanation = find_best(estimate, priors, alternatives, noise_known)
        if explanation is None or (causes and explanation.size < _MIN_RELATIVE_SIZE * first_size):
            break
        first_size = first_size or explanation.size
        corrected_estimate, explanation = _correct_cause(estimate, explanation, views)
        if not noise_known:
            # Beside the noise that is left without it, other causes may be wording from it.
            quieter = replace(estimate, fit=estimate.fit.with_noise(corrected_estimate.fit.noise))
            other_explanation = find_best(quieter, priors, alternatives, noise_known)
            if other_explanation is not None:
                corrected_estimate, explanation = _correct_cause(estimate, other_explanation, views)
            if not _is_robust(estimate, explanation):
                break
        if not explanation.outsized and not explanation.alternative.is_credible(explanation.value):
            # At its own size, beyond first order, it is not what it seemed to be.
            alternatives = [
                alternative
                for alternative in alternatives
                if alternative != explanation.alternative
            ]
            continue
        wording = Explanation(
            campaign, estimate.fit, explanation.alternative, explanation.value, explanation.u
        ).describe()
        causes.append(_make_cause(wording, explanation, views, estimate, corrected_estimate))
        estimate = corrected_estimate
    if noise_known:
        recorded_views = (replace(view, estimate=estimate) for view in views if view.has_records)
        wrong_noise_findings = (
            finding for view in recorded_views for finding in check_stated_noise(view)
        )
        by_size = sorted(wrong_noise_findings, key=lambda finding: -(finding.size or 0.0))
        causes += [Cause(finding, (finding.subject,), {}) for finding in by_size]
    return tuple(causes)


# Whether to look for causes at all


def _smallest_p(tests: ScoreTests) -> float:
    """Return the smallest probability of the tests, all of them counted."""
    if not tests.test_count:
        return 1.0
    return min(1.0, tests.test_count * tests.p(int(np.argmax(tests.z))))


def _is_suspicious(
    views: Sequence[AccelerometerView], results: Mapping[str, AccelerometerResult]
) -> bool:
    records = sum(1 for view in views for _ in view.records())
    for view in views:
        result = results[view.name]
        codes = {
            finding.code for finding in (*result.findings, *_check_view_statistics(view, result))
        }
        if codes & ACCOUNTABLE:
            return True
        shifts = [normal_equivalent(line.z, line.dof) for line in result.jackknife if line.z]
        shifts += [abs(result.two_stage.z)] if result.two_stage else []
        shift_p = min(_SUSPICION_SHIFT_P, _SUSPICION_P / max(records, 1))
        if any(math.erfc(z / math.sqrt(2.0)) < shift_p for z in shifts):
            return True
        if view.has_records and any(p < _SUSPICION_P / records for p in _run_p_values(view)):
            return True
    return False


def _run_p_values(view: AccelerometerView) -> Iterator[float]:
    """Yield probabilities of what an accelerometer's whitened residuals show of each run."""
    tests = view.diagnostics.runs
    for _, prepared, residuals in view.records():
        test = tests[prepared.run]
        yield 3.0 * mistakes.window_test_p(residuals.whitened)
        deviation = (test.chi2 - test.dof) / math.sqrt(2.0 * test.dof)
        yield 3.0 * math.erfc(abs(deviation) / math.sqrt(2.0))
        yield 3.0 * _harmonic_p(
            test.periodogram,
            test.rows,
            prepared.series.trajectory.spindle.rate,
            median(np.diff(prepared.series.time)),
            test.chi2 / test.dof,
        )


def _harmonic_p(power: np.ndarray, rows: int, rate: float, interval: float, scale: float) -> float:
    """Return the probability of a wave as strong at the spindle's own frequency."""
    index = round(abs(rate) * interval * rows / (2.0 * math.pi)) - 1
    neighbours = power[max(index - 1, 0) : index + 2]
    if not neighbours.size or not scale > 0.0:
        return 1.0
    return min(1.0, neighbours.size * math.exp(-float(neighbours.max()) / scale))


# The alternatives


def _with_input_ranges(
    campaign: Campaign, alternatives: Sequence[Alternative]
) -> tuple[Alternative, ...]:
    """Return alternatives with what an input may be, which hangs on what is stated of it."""
    inputs = stated_inputs(campaign)
    ranges = {
        name: row.effect.bounds
        for name in inputs
        for symbol, row in INPUTS.items()
        if name == symbol or name.endswith(f".{symbol}")
    }
    gravity, latitude = campaign.gravity.value, campaign.latitude.value
    low, high = gravity_range(latitude)
    gravity_limits, excluded_range = (low - _ANOMALY, high + _ANOMALY), (0.0, 0.0)
    if gravity_limits[0] <= gravity <= gravity_limits[1]:  # else either may be the wrong one
        ranges["site.gravity"] = gravity_limits
        min_latitude, max_latitude = latitudes_with(gravity, _ANOMALY)
        # On either side of the equator, for its sign may be wrong.
        ranges["site.latitude"] = -max_latitude, max_latitude
        excluded_range = -min_latitude - latitude, min_latitude - latitude
    deviation_ranges = {
        name: (min_latitude - inputs[name].value, max_latitude - inputs[name].value)
        for name, (min_latitude, max_latitude) in ranges.items()
    }
    return tuple(
        replace(
            alternative,
            credible_range=deviation_ranges[alternative.name],
            excluded_range=excluded_range
            if alternative.name == "site.latitude"
            else alternative.excluded_range,
            likely_values=(0.0, -2.0 * latitude) if alternative.name == "site.latitude" else (),
            likely_tolerance=_LATITUDE,
            stated=inputs[alternative.name].value != 0.0,
        )
        if alternative.name in deviation_ranges
        else alternative
        for alternative in alternatives
    )


def _alternative_hypotheses(
    views: Sequence[AccelerometerView], estimate: Estimate
) -> Iterator[Alternative]:
    campaign, fit = views[0].campaign, estimate.fit
    model = views[0].problem.model
    angle = campaign.angle is not None
    yield from default_prior_alternatives(fit)
    # Of what acts on readings too, the records alone tell half of it.
    inputs = {
        s: campaign.typical_of(s)
        for s in exact_inputs(campaign)
        if s == TIMING or not campaign.readings
    }
    yield from mistakes.input_mistakes(fit, inputs)
    trends = {view.name: campaign.typical_of("K_F.trend", view.name) for view in views}
    yield from mistakes.record_mistakes(fit, trends, angle_recorded=angle)
    yield from mistakes.coriolis_mistakes(fit, uses_own_velocity=campaign.own_velocity)
    terms = {
        unknown: campaign.typical_of(unknown.symbol, unknown.owner)
        for view in views
        for unknown in fixed_terms(campaign, model, view.name)
        if not (campaign.readings and unknown.symbol in ACCELEROMETER_TERMS)
    }
    yield from mistakes.term_mistakes(fit, terms)
    yield from mistakes.changepoints(fit, STEPS)


def _is_robust(estimate: Estimate, explanation: BestExplanation) -> bool:
    """Return whether a cause is more than chance with noise that the records do not show."""
    variance = explanation.u**2
    if not explanation.alternative.columns:
        # Of a column the fit with it has said so already. The shift of priors is the sum of their
        # distances from the estimates, each weighted with the inverse of its own variance.
        gain = np.zeros(len(estimate.fit.model.unknowns))
        for index, step in explanation.alternative.prior_shifts.items():
            prior_sd = estimate.fit.model.unknowns[index].prior[1]
            gain[index] = step * variance / prior_sd**2 if prior_sd > 0.0 else 0.0
        variance += float(
            gain @ undetected_walk_covariance(estimate.fit, estimate.estimated_noise) @ gain
        )
    z = abs(explanation.value) / math.sqrt(variance)
    return math.erfc(z / math.sqrt(2.0)) * explanation.tests < FALSE_ALARMS


def _correct_cause(
    estimate: Estimate, explanation: BestExplanation, views: Sequence[AccelerometerView]
) -> tuple[Estimate, BestExplanation]:
    """Return the estimate with a cause allowed for, and the cause as it is then."""
    requests = views[0].problem.noise
    alternative = explanation.alternative
    if not alternative.columns:
        unknowns = list(estimate.fit.model.unknowns)
        for index, step in alternative.prior_shifts.items():
            value, u = unknowns[index].prior
            unknowns[index] = replace(unknowns[index], prior=(value + step * explanation.value, u))
        model = replace(estimate.fit.model, unknowns=tuple(unknowns))
        return _reestimate(
            estimate, replace(estimate.fit, model=model).with_noise({}), requests
        ), explanation
    value, corrected = explanation.value, estimate
    for _ in range(_REFINEMENTS):
        limit = 10.0 * math.hypot(value, explanation.u)
        added_unknown = Unknown("", alternative.name, NO_PRIOR, limit)
        corrected = replace(
            estimate, fit=augment(estimate.fit, [added_unknown], [alternative.columns])
        )
        value = float(corrected.fit.solution.estimate[-1])
        refined = mistakes.evaluate_alternative(corrected.fit, alternative, value)
        if refined is alternative:
            break
        alternative = refined
    corrected = _reestimate(estimate, corrected.fit, requests)
    solution = corrected.fit.solution
    u = float(solution.u[-1])
    return corrected, replace(
        explanation, alternative=alternative, value=float(solution.estimate[-1]), u=u
    )


def _reestimate(estimate: Estimate, fit: JointFit, requests: Mapping[str, Noise]) -> Estimate:
    if not estimate.estimated_noise:
        dof = np.full(len(fit.model.unknowns), math.inf)
        return replace(estimate, fit=fit, dof=dof, compressed_fit=None, information_losses={})
    return reestimate(estimate, fit, requests)


# What is said


def _make_cause(
    wording: FindingText,
    explanation: BestExplanation,
    views: Sequence[AccelerometerView],
    previous: Estimate,
    corrected: Estimate,
) -> Cause:
    campaign = views[0].campaign
    affected_views = _affected_accelerometers(explanation.alternative, views, previous)
    text = wording.text
    max_shift = 0.0
    for view in views:
        for symbol, index in view.indices.items():
            if not view.assessment.determined[f"{view.name}.{symbol}"]:
                continue
            shift = float(
                corrected.fit.solution.estimate[index] - previous.fit.solution.estimate[index]
            )
            max_shift = max(max_shift, abs(shift) / float(view.fit.solution.u[index]))
    rivals = [
        Explanation(campaign, previous.fit, alternative, value, 1.0).describe()
        for alternative, value in explanation.rivals
    ]
    if rivals:
        names = [rival.name for rival in rivals[:_MAX_RIVALS]]
        unnamed_count = len(rivals) - len(names)
        names += (
            [f"{unnamed_count} more" if unnamed_count > 1 else "one more"] if unnamed_count else []
        )
        these = "These causes" if len(rivals) > 1 else "This cause"
        text += f" {these} would explain the records equally well: {'; '.join(names)}."
    is_decisive = normal_equivalent(explanation.size, explanation.dof) > CONTRADICTION_SIGMAS
    contradicts = is_decisive and (max_shift > 1.0 or explanation.alternative.kind == "prior")
    return Cause(
        Finding(
            code=wording.code,
            subject=wording.subject,
            text=text,
            size=explanation.size,
            contradicts=contradicts,
            as_well=list(dict.fromkeys(rival.subject for rival in rivals)),
        ),
        affected_views,
        _remaining_findings(views, corrected),
    )


def _remaining_findings(
    views: Sequence[AccelerometerView], estimate: Estimate
) -> Mapping[tuple[str, str], float]:
    """Return code, subject and size of what the checks still find in another fit."""
    findings = [
        finding for view in views for finding in _check_view(_evaluate_view(view, estimate))
    ]
    findings += check_default_priors(prior_information(estimate, stated_inputs(views[0].campaign)))
    return {(finding.code, finding.subject): finding.size or math.inf for finding in findings}


def _affected_accelerometers(
    alternative: Alternative, views: Sequence[AccelerometerView], estimate: Estimate
) -> tuple[str, ...]:
    names = [view.name for view in views]
    if alternative.columns:
        affected = {
            estimate.fit.design_blocks[index].accelerometer
            for index, column in alternative.columns.items()
            if column.any()
        }
        return tuple(name for name in names if name in affected)
    return (alternative.owner,) if alternative.owner in names else tuple(names)


def _evaluate_view(view: AccelerometerView, estimate: Estimate) -> AccelerometerView:
    """Return a view of a relaxed fit, with the readings as they fit that."""
    groups = [group.evaluate(estimate.fit) for group in view.groups]
    return replace(view, estimate=estimate).select_groups(groups)


def _check_view(view: AccelerometerView) -> Iterator[Finding]:
    yield from residual_findings(view)
    yield from _check_view_statistics(view, None)
    coefficients = {
        symbol: make_coefficient(view.estimate, view.assessment, index)
        for symbol, index in view.indices.items()
        if f"{view.name}.{symbol}" in view.assessment.determined  # not what was considered before
    }
    for finding in check_credibility(view.campaign.limit_of, view.name, coefficients):
        yield from (finding, *finding.explains)


def _check_view_statistics(
    view: AccelerometerView, result: AccelerometerResult | None
) -> Iterator[Finding]:
    """Yield findings from the numbers of a fit for one accelerometer."""
    judged_result = result or AccelerometerResult(
        coefficients={},
        correlation=None,
        residual=summarize_residuals(view),
        noise=noise_lines(view),
        jackknife=view.jackknife(),
    )
    campaign = view.campaign
    yield from check_statistics(
        view.name, judged_result, campaign.gravity.value, len(campaign.accelerometers)
    )
