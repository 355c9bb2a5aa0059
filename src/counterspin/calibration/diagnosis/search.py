"""Search for the likely causes of a misfit.

Tests of priors need only the solved equations, so they are always made. Other likely mistakes are
tested only if residuals, runs or priors are suspicious. The search adds the best explanation to the
fit, estimates the noise again, and repeats until no further explanation is significant.
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
    FALSE_ALARM_RATE,
    STEP_COUNT,
    BestExplanation,
    find_best,
    min_equivalent_gain,
)
from counterspin.calibration.diagnosis.untested_inputs import (
    AlternativeMounting,
    find_better_mounting,
    fit_rotated_mountings,
    mounting_finding,
    undetermined_axis_remarks,
    untested_input_remarks,
)
from counterspin.calibration.extensions import Diagnosis
from counterspin.calibration.findings import (
    CONTRADICTION_SIGMAS,
    EXPLAINABLE_CODES,
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
from counterspin.inference.diagnostics import normal_equivalent
from counterspin.inference.joint import mistakes
from counterspin.inference.joint.alternatives import (
    Alternative,
    ScoreTests,
    default_prior_alternatives,
    prior_alternatives,
    rotation_alternatives,
    run_score_tests,
)
from counterspin.inference.joint.estimated_noise import undetected_walk_covariance
from counterspin.inference.joint.estimation import Estimate, reestimate
from counterspin.inference.joint.fit import JointFit, augment, estimate_considered
from counterspin.inference.joint.series import TIMING
from counterspin.inference.joint.unknowns import Unknown
from counterspin.inference.least_squares import NO_PRIOR
from counterspin.inference.noise.model import Noise
from counterspin.physics.gravity import gravity_range, latitude_range
from counterspin.physics.terms import ACCELEROMETER_TERMS, INPUTS

#: p-value below which the alternatives are tested.
_SUSPICION_P: Final = 0.01

#: p-value of a shift (omitted run, or two-stage method) below which they are tested: 3 sigma. With
#: many records, all shifts share `_SUSPICION_P`.
_SUSPICION_SHIFT_P: Final = math.erfc(3.0 / math.sqrt(2.0))

#: Largest number of causes.
_MAX_CAUSES: Final = 3

#: Smallest z of a further cause relative to the first one, whose effect is known to first order.
_MIN_RELATIVE_SIZE: Final = 0.03

#: Largest number of relinearisations of a cause.
_MAX_REFINEMENTS: Final = 4

#: Largest number of rivals in a text.
_MAX_RIVALS: Final = 3

#: Typical upper limit of gravity anomalies, m/s^2.
_GRAVITY_ANOMALY: Final = 1e-3

#: Tolerance about a likely latitude: the stated one, or the one with the opposite sign; rad.
_LATITUDE_TOLERANCE: Final = math.radians(1.0)


def diagnose(
    views: Sequence[AccelerometerView], results: Mapping[str, AccelerometerResult]
) -> Diagnosis:
    """Return the causes of the findings on a joint fit, and remarks on unverifiable inputs."""
    mountings = fit_rotated_mountings(views)
    return Diagnosis(
        find_causes(views, results, mountings),
        (*undetermined_axis_remarks(mountings), *untested_input_remarks(views)),
    )


def find_causes(
    views: Sequence[AccelerometerView],
    results: Mapping[str, AccelerometerResult],
    mountings: Sequence[AlternativeMounting] = (),
) -> tuple[Cause, ...]:
    """Return the causes of the findings on a joint fit, the main one first.

    mountings: Alternative mountings of accelerometers with stated cross-axis terms.
    """
    estimate = views[0].estimate
    groups = [group for view in views for group in view.groups]
    is_noise_known = not estimate.estimated_noise and all(
        group.has_external_noise for group in groups
    )
    relaxed_estimate = replace(
        estimate, fit=estimate_considered(estimate.fit), compressed_fit=None, information_losses={}
    )
    priors = prior_alternatives(relaxed_estimate.fit)
    mounting = find_better_mounting(mountings)
    # An error of the records may look like a rotation that differs from the recorded angle.
    # Without records, default priors are also tested from the solved equations.
    tested_alternatives = (
        (*priors, *rotation_alternatives(relaxed_estimate.fit))
        if relaxed_estimate.fit.design_blocks
        else (*priors, *default_prior_alternatives(relaxed_estimate.fit))
    )
    if (
        not _is_suspicious(views, results)
        and mounting is None
        and (
            not tested_alternatives
            or _smallest_p(
                run_score_tests(
                    relaxed_estimate.fit, tested_alternatives, noise_given=is_noise_known
                )
            )
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
        _set_ranges(views[0].campaign, candidates) for candidates in (priors, alternatives)
    )
    return (
        _search_causes(views, relaxed_estimate, priors, alternatives, is_noise_known, mounting)
        if priors or alternatives
        else ()
    )


def _search_causes(
    views: Sequence[AccelerometerView],
    estimate: Estimate,
    priors: Sequence[Alternative],
    alternatives: Sequence[Alternative],
    is_noise_known: bool,
    mounting: AlternativeMounting | None,
) -> tuple[Cause, ...]:
    """Return the causes among some alternatives, found one after the other.

    mounting: A mounting that fits better than the stated one; it has no adjustable parameter.
    """
    campaign = views[0].campaign
    estimate, noise_findings = reweight_runs(views, estimate)
    causes = [
        Cause(finding, (finding.subject,), _remaining_sizes(views, estimate))
        for finding in noise_findings
    ]
    first_z = 0.0
    if mounting is not None:
        explanation = find_best(estimate, priors, alternatives, is_noise_known)
        if explanation is None or mounting.gain >= min_equivalent_gain(explanation.z**2):
            estimate = replace(estimate, fit=mounting.fit)
            views = [mounting.apply_to(view) for view in views]
            names = (mounting.view.name,)
            causes.append(
                Cause(mounting_finding(mounting), names, _remaining_sizes(views, estimate))
            )
            first_z = math.sqrt(mounting.gain)
    for _ in range(_MAX_CAUSES):
        explanation = find_best(estimate, priors, alternatives, is_noise_known)
        if explanation is None or (causes and explanation.z < _MIN_RELATIVE_SIZE * first_z):
            break
        first_z = first_z or explanation.z
        corrected_estimate, explanation = _correct_cause(estimate, explanation, views)
        if not is_noise_known:
            # With the lower noise that remains, another cause may be the best explanation.
            quieter_estimate = replace(
                estimate, fit=estimate.fit.with_noise(corrected_estimate.fit.noise)
            )
            other_explanation = find_best(quieter_estimate, priors, alternatives, is_noise_known)
            if other_explanation is not None:
                corrected_estimate, explanation = _correct_cause(estimate, other_explanation, views)
            if not _is_robust(estimate, explanation):
                break
        if not explanation.is_too_large and not explanation.alternative.is_credible(
            explanation.value
        ):
            # Beyond first order, the estimate is not credible.
            alternatives = [
                alternative
                for alternative in alternatives
                if alternative != explanation.alternative
            ]
            continue
        finding_text = Explanation(
            campaign, estimate.fit, explanation.alternative, explanation.value, explanation.u
        ).describe()
        causes.append(_make_cause(finding_text, explanation, views, estimate, corrected_estimate))
        estimate = corrected_estimate
    if is_noise_known:
        record_views = (replace(view, estimate=estimate) for view in views if view.has_records)
        findings = (finding for view in record_views for finding in check_stated_noise(view))
        sorted_findings = sorted(findings, key=lambda finding: -(finding.size or 0.0))
        causes += [Cause(finding, (finding.subject,), {}) for finding in sorted_findings]
    return tuple(causes)


# Suspicion


def _smallest_p(tests: ScoreTests) -> float:
    """Return the smallest p-value, with the Bonferroni correction for all tests."""
    if not tests.n_tests:
        return 1.0
    return min(1.0, tests.n_tests * tests.p(int(np.argmax(tests.z))))


def _is_suspicious(
    views: Sequence[AccelerometerView], results: Mapping[str, AccelerometerResult]
) -> bool:
    n_records = sum(1 for view in views for _ in view.records())
    for view in views:
        result = results[view.name]
        codes = {finding.code for finding in (*result.findings, *_statistic_findings(view, result))}
        if codes & EXPLAINABLE_CODES:
            return True
        shifts = [normal_equivalent(line.z, line.dof) for line in result.jackknife if line.z]
        shifts += [abs(result.two_stage.z)] if result.two_stage else []
        shift_p = min(_SUSPICION_SHIFT_P, _SUSPICION_P / max(n_records, 1))
        if any(math.erfc(z / math.sqrt(2.0)) < shift_p for z in shifts):
            return True
        if view.has_records and any(p < _SUSPICION_P / n_records for p in _run_p_values(view)):
            return True
    return False


def _run_p_values(view: AccelerometerView) -> Iterator[float]:
    """Yield p-values of tests of an accelerometer's whitened residuals, run by run."""
    tests = view.diagnostics.runs
    for _, block, residuals in view.records():
        test = tests[block.run]
        yield 3.0 * mistakes.window_test_p(residuals.whitened)
        deviation = (test.chi2 - test.dof) / math.sqrt(2.0 * test.dof)
        yield 3.0 * math.erfc(abs(deviation) / math.sqrt(2.0))
        yield 3.0 * _harmonic_p(
            test.periodogram,
            test.rows,
            block.series.trajectory.spindle.rate,
            median(np.diff(block.series.time)),
            test.chi2 / test.dof,
        )


def _harmonic_p(power: np.ndarray, n_rows: int, rate: float, step: float, scale: float) -> float:
    """Return the p-value of the periodogram at the rotation frequency."""
    index = round(abs(rate) * step * n_rows / (2.0 * math.pi)) - 1
    nearby_power = power[max(index - 1, 0) : index + 2]
    if not nearby_power.size or not scale > 0.0:
        return 1.0
    return min(1.0, nearby_power.size * math.exp(-float(nearby_power.max()) / scale))


# The alternatives


def _set_ranges(campaign: Campaign, alternatives: Sequence[Alternative]) -> tuple[Alternative, ...]:
    """Return the alternatives with credible ranges of inputs, relative to their stated values."""
    inputs = stated_inputs(campaign)
    ranges = {
        name: row.effect.bounds
        for name in inputs
        for symbol, row in INPUTS.items()
        if name == symbol or name.endswith(f".{symbol}")
    }
    gravity, latitude = campaign.gravity.value, campaign.latitude.value
    low, high = gravity_range(latitude)
    gravity_limits, excluded_range = (low - _GRAVITY_ANOMALY, high + _GRAVITY_ANOMALY), (0.0, 0.0)
    if gravity_limits[0] <= gravity <= gravity_limits[1]:  # otherwise either may be wrong
        ranges["site.gravity"] = gravity_limits
        min_latitude, max_latitude = latitude_range(gravity, _GRAVITY_ANOMALY)
        # On both hemispheres, because the sign may be wrong.
        ranges["site.latitude"] = -max_latitude, max_latitude
        excluded_range = -min_latitude - latitude, min_latitude - latitude
    deviation_ranges = {
        name: (lower - inputs[name].value, upper - inputs[name].value)
        for name, (lower, upper) in ranges.items()
    }
    return tuple(
        replace(
            alternative,
            credible_range=deviation_ranges[alternative.name],
            excluded_range=excluded_range
            if alternative.name == "site.latitude"
            else alternative.excluded_range,
            likely_values=(0.0, -2.0 * latitude) if alternative.name == "site.latitude" else (),
            likely_tolerance=_LATITUDE_TOLERANCE,
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
    has_angle = campaign.angle is not None
    yield from default_prior_alternatives(fit)
    # Inputs that also affect readings cannot be tested on the records alone.
    inputs = {
        symbol: campaign.typical_of(symbol)
        for symbol in exact_inputs(campaign)
        if symbol == TIMING or not campaign.readings
    }
    yield from mistakes.input_mistakes(fit, inputs)
    default_trends = {view.name: campaign.typical_of("K_F.trend", view.name) for view in views}
    yield from mistakes.record_mistakes(fit, default_trends, has_recorded_angle=has_angle)
    yield from mistakes.coriolis_mistakes(fit, uses_own_velocity=campaign.own_velocity)
    if not campaign.readings:
        yield from mistakes.hemisphere_mistakes(fit)
    terms = {
        unknown: campaign.typical_of(unknown.symbol, unknown.owner)
        for view in views
        for unknown in fixed_terms(campaign, model, view.name)
        if not (campaign.readings and unknown.symbol in ACCELEROMETER_TERMS)
    }
    yield from mistakes.term_mistakes(fit, terms)
    yield from mistakes.changepoints(fit, STEP_COUNT)


def _is_robust(estimate: Estimate, explanation: BestExplanation) -> bool:
    """Return whether a cause remains significant with noise that the records cannot confirm."""
    variance = explanation.u**2
    if not explanation.alternative.columns:
        # For a column, the corrected fit includes this noise. The shift of priors is the weighted
        # sum of their distances from the estimates, with inverse variances as weights.
        gain = np.zeros(len(estimate.fit.model.unknowns))
        for index, prior_shift in explanation.alternative.prior_shifts.items():
            prior_sd = estimate.fit.model.unknowns[index].prior[1]
            gain[index] = prior_shift * variance / prior_sd**2 if prior_sd > 0.0 else 0.0
        variance += float(
            gain @ undetected_walk_covariance(estimate.fit, estimate.estimated_noise) @ gain
        )
    z = abs(explanation.value) / math.sqrt(variance)
    return math.erfc(z / math.sqrt(2.0)) * explanation.n_tests < FALSE_ALARM_RATE


def _correct_cause(
    estimate: Estimate, explanation: BestExplanation, views: Sequence[AccelerometerView]
) -> tuple[Estimate, BestExplanation]:
    """Return the estimate corrected for a cause, and the cause with its final parameter."""
    noise_models = views[0].problem.noise
    alternative = explanation.alternative
    if not alternative.columns:
        unknowns = list(estimate.fit.model.unknowns)
        for index, step in alternative.prior_shifts.items():
            value, u = unknowns[index].prior
            unknowns[index] = replace(unknowns[index], prior=(value + step * explanation.value, u))
        model = replace(estimate.fit.model, unknowns=tuple(unknowns))
        return _reestimate(
            estimate, replace(estimate.fit, model=model).with_noise({}), noise_models
        ), explanation
    value, corrected_estimate = explanation.value, estimate
    for _ in range(_MAX_REFINEMENTS):
        limit = 10.0 * math.hypot(value, explanation.u)
        added_unknown = Unknown("", alternative.name, NO_PRIOR, limit)
        corrected_estimate = replace(
            estimate, fit=augment(estimate.fit, [added_unknown], [alternative.columns])
        )
        value = float(corrected_estimate.fit.solution.estimate[-1])
        refinement = mistakes.evaluate_alternative(corrected_estimate.fit, alternative, value)
        if refinement is alternative:
            break
        alternative = refinement
    corrected_estimate = _reestimate(estimate, corrected_estimate.fit, noise_models)
    solution = corrected_estimate.fit.solution
    u = float(solution.u[-1])
    return corrected_estimate, replace(
        explanation, alternative=alternative, value=float(solution.estimate[-1]), u=u
    )


def _reestimate(estimate: Estimate, fit: JointFit, noise_models: Mapping[str, Noise]) -> Estimate:
    if not estimate.estimated_noise:
        dof = np.full(len(fit.model.unknowns), math.inf)
        return replace(estimate, fit=fit, dof=dof, compressed_fit=None, information_losses={})
    return reestimate(estimate, fit, noise_models)


# Findings on causes


def _make_cause(
    finding_text: FindingText,
    explanation: BestExplanation,
    views: Sequence[AccelerometerView],
    previous_estimate: Estimate,
    corrected_estimate: Estimate,
) -> Cause:
    campaign = views[0].campaign
    affected_names = _affected_accelerometers(explanation.alternative, views, previous_estimate)
    text = finding_text.text
    max_shift = 0.0
    for view in views:
        for symbol, index in view.indices.items():
            if not view.assessment.determined[f"{view.name}.{symbol}"]:
                continue
            shift = float(
                corrected_estimate.fit.solution.estimate[index]
                - previous_estimate.fit.solution.estimate[index]
            )
            max_shift = max(max_shift, abs(shift) / float(view.fit.solution.u[index]))
    rivals = [
        Explanation(campaign, previous_estimate.fit, alternative, value, 1.0).describe()
        for alternative, value in explanation.rivals
    ]
    if rivals:
        names = [rival.name for rival in rivals[:_MAX_RIVALS]]
        n_unnamed = len(rivals) - len(names)
        names += [f"{n_unnamed} more" if n_unnamed > 1 else "one more"] if n_unnamed else []
        subject = "These causes" if len(rivals) > 1 else "This cause"
        text += f" {subject} would explain the records equally well: {'; '.join(names)}."
    is_decisive = normal_equivalent(explanation.z, explanation.dof) > CONTRADICTION_SIGMAS
    contradicts = is_decisive and (max_shift > 1.0 or explanation.alternative.kind == "prior")
    return Cause(
        Finding(
            code=finding_text.code,
            subject=finding_text.subject,
            text=text,
            size=explanation.z,
            contradicts=contradicts,
            as_well=list(dict.fromkeys(rival.subject for rival in rivals)),
        ),
        affected_names,
        _remaining_sizes(views, corrected_estimate),
    )


def _remaining_sizes(
    views: Sequence[AccelerometerView], estimate: Estimate
) -> Mapping[tuple[str, str], float]:
    """Return (code, subject) -> size of the findings on a corrected fit."""
    findings = [finding for view in views for finding in _check_view(_update_view(view, estimate))]
    findings += check_default_priors(prior_information(estimate, stated_inputs(views[0].campaign)))
    return {(finding.code, finding.subject): finding.size or math.inf for finding in findings}


def _affected_accelerometers(
    alternative: Alternative, views: Sequence[AccelerometerView], estimate: Estimate
) -> tuple[str, ...]:
    names = [view.name for view in views]
    if alternative.columns:
        affected_names = {
            estimate.fit.design_blocks[index].accelerometer
            for index, column in alternative.columns.items()
            if column.any()
        }
        return tuple(name for name in names if name in affected_names)
    return (alternative.owner,) if alternative.owner in names else tuple(names)


def _update_view(view: AccelerometerView, estimate: Estimate) -> AccelerometerView:
    """Return a view of another estimate, with the residuals of the readings updated."""
    groups = [group.evaluate(estimate.fit) for group in view.groups]
    return replace(view, estimate=estimate).select_groups(groups)


def _check_view(view: AccelerometerView) -> Iterator[Finding]:
    yield from residual_findings(view)
    yield from _statistic_findings(view, None)
    coefficients = {
        symbol: make_coefficient(view.estimate, view.assessment, index)
        for symbol, index in view.indices.items()
        if f"{view.name}.{symbol}" in view.assessment.determined  # without former considered terms
    }
    for finding in check_credibility(view.campaign.limit_of, view.name, coefficients):
        yield from (finding, *finding.explains)


def _statistic_findings(
    view: AccelerometerView, result: AccelerometerResult | None
) -> Iterator[Finding]:
    """Yield the statistical findings on one accelerometer; result: None: computed from the view."""
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
