"""The joint method: estimate all coefficients in one fit of all records."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from counterspin.calibration.accelerometer_view import AccelerometerView, Contribution, ReadingData
from counterspin.calibration.checks.limits import (
    check_credibility,
    check_default_priors,
    check_shared_credibility,
)
from counterspin.calibration.checks.priors import find_prior_conflict
from counterspin.calibration.checks.residuals import (
    noise_remarks,
    residual_findings,
    undetected_walk_remarks,
)
from counterspin.calibration.checks.small_angles import check_drifts, check_tilts
from counterspin.calibration.extensions import (
    Diagnosis,
    compare_two_stage,
    find_diagnosis,
    join_readings,
    thin_residuals,
)
from counterspin.calibration.findings import not_determined_finding
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.model import is_requested, stated_inputs
from counterspin.calibration.outcome import (
    Outcome,
    accelerometer_correlation,
    confounded_platform_terms,
    confounded_terms,
    convert_to_output_units,
    describe_instrument,
    full_correlation,
    make_coefficient,
    make_run_result,
    mounting_radii,
    noise_lines,
    prior_correlations,
    prior_information,
    residual_tables,
    summarize_residuals,
)
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient, Finding
from counterspin.campaign.settings import OBSERVABLES
from counterspin.inference.identifiability import Assessment
from counterspin.inference.joint import estimation
from counterspin.inference.joint.budget import budget
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.unknowns import ROTATION, Unknown
from counterspin.inference.joint.what_if import what_if
from counterspin.physics.terms import TERMS

#: Rates with a smaller ratio count as the same rate.
_MIN_RATE_RATIO: Final = 1.05

#: Advice for a term that no further data would determine.
_PRIOR_ADVICE: Final = " State a prior in [model.priors], or remove the term from model.terms."


def _subtract_prior_mean(unknown: Unknown, coefficient: Coefficient) -> Coefficient:
    """Return a coefficient as a deviation from its prior mean."""
    if coefficient.value is None:
        return coefficient
    return coefficient.model_copy(update={"value": coefficient.value - unknown.prior_mean})


def fit_jointly(problem: JointProblem) -> Outcome:
    """Fit all records of a campaign together."""
    campaign, observed_runs, model = problem.campaign, problem.observed_runs, problem.model
    estimate, reading_data = estimate_campaign(problem)
    assessment = estimate.fit.assessment
    views = [
        AccelerometerView(problem, estimate, assessment, name, reading_data).select_groups(
            reading_data.groups
        )
        for name in campaign.accelerometers
    ]
    contributions = reading_data.contributions(views)
    shared_coefficients = {
        unknown: make_coefficient(estimate, assessment, index)
        for index, unknown in enumerate(model.of_interest)
        if unknown.symbol not in TERMS and unknown.owner not in campaign.accelerometers
    } | _rotation_parameters(estimate, assessment)
    deviations = (
        (unknown.symbol, unknown.name, _subtract_prior_mean(unknown, coefficient))
        for unknown, coefficient in shared_coefficients.items()
    )
    credibility_findings = list(check_shared_credibility(campaign.limit_of, deviations))
    shared_coefficients |= mounting_radii(campaign, shared_coefficients)
    outliers: dict[str, int] = {run.run.name: 0 for run in observed_runs}
    for series, mask in zip(estimate.series, estimate.outliers, strict=True):
        outliers[series.run] += int(series.count[mask].sum())
    duration = max((float(series.time[-1]) for series in estimate.series), default=0.0)
    accelerometers = {
        view.name: _make_accelerometer_result(view, contributions[view.name]) for view in views
    }
    terms_by_run = {
        run.run.name: {
            unknown.symbol: coefficient
            for unknown, coefficient in shared_coefficients.items()
            if unknown.owner == run.run.name
        }
        for run in observed_runs
    }
    diagnose = find_diagnosis()
    diagnosis = diagnose(views, accelerometers) if diagnose else Diagnosis()
    prior_knowledge = prior_information(estimate, stated_inputs(campaign))
    units = {
        name: OBSERVABLES[accelerometer.observable]
        for name, accelerometer in campaign.accelerometers.items()
    }
    return Outcome(
        model="exact",
        accelerometers=accelerometers,
        runs={
            name: make_run_result(
                run,
                terms=terms_by_run[name],
                fit=run_fit_tests(views, name),
                n_outliers=outliers[name],
            )
            for run in observed_runs
            for name in [run.run.name]
        },
        platform={
            unknown.symbol: coefficient
            for unknown, coefficient in shared_coefficients.items()
            if not unknown.owner
        },
        confounded=confounded_platform_terms(assessment),
        correlation=full_correlation(estimate, assessment),
        rests_on=prior_knowledge,
        findings=[
            *(
                not_determined_finding(
                    unknown.name,
                    unknown.name,
                    advice=_PRIOR_ADVICE,
                    is_requested=is_requested(campaign, unknown.symbol),
                )
                for unknown, coefficient in shared_coefficients.items()
                if coefficient.value is None
            ),
            *check_drifts(shared_coefficients, duration),
            *check_tilts(campaign, terms_by_run, accelerometers),
            *credibility_findings,
            *check_default_priors(prior_knowledge),
            *(() if diagnose else find_prior_conflict(views[0])),
        ],
        causes=diagnosis.causes,
        remarks=(
            *(remark for contribution in contributions.values() for remark in contribution.remarks),
            *diagnosis.remarks,
            *reading_data.remarks(views),
            *undetected_walk_remarks(views),
            *noise_remarks(views),
        ),
        residuals=residual_tables(estimate.fit, units),
        **reading_data.result_fields(estimate),
    )


def estimate_campaign(problem: JointProblem) -> tuple[Estimate, ReadingData]:
    """Return the estimate from all data of a campaign, and its readings and poses."""
    campaign = problem.campaign
    if campaign.readings or campaign.triad:
        return join_readings(problem)
    return estimation.estimate(problem.series, problem.model, problem.noise), ReadingData()


def _rotation_parameters(estimate: Estimate, assessment: Assessment) -> dict[Unknown, Coefficient]:
    """Return the rotation parameters that the fit estimated from the displacement."""
    spindles = {series.run: series.trajectory.spindle for series in estimate.series}
    rotations = {}
    for index, unknown in enumerate(estimate.fit.model.unknowns):
        if unknown.symbol in ROTATION:
            change = make_coefficient(estimate, assessment, index)
            rate = getattr(spindles[unknown.owner], unknown.symbol.removeprefix("spindle."))
            rotations[unknown] = change.model_copy(update={"value": rate + (change.value or 0.0)})
    return rotations


def _make_accelerometer_result(
    view: AccelerometerView, contribution: Contribution
) -> AccelerometerResult:
    name, estimate = view.name, view.estimate
    coefficients = {
        symbol: make_coefficient(estimate, view.assessment, index)
        for symbol, index in view.indices.items()
    }
    budgets = {
        symbol: budget(estimate.fit, index, name)
        for symbol, index in view.indices.items()
        if coefficients[symbol].estimated
    }
    return AccelerometerResult(
        # In the order of the campaign, not of the table of terms.
        coefficients={
            symbol: coefficients[symbol]
            for symbol in view.campaign.model.terms
            if symbol in coefficients
        },
        correlation=accelerometer_correlation(view),
        confounded=confounded_terms(view),
        residual=summarize_residuals(contribution.residual_view),
        noise=noise_lines(view),
        budget=budgets,
        what_if=what_if(estimate.fit, view.indices, budgets, name),
        jackknife=view.jackknife(),
        two_stage=compare_two_stage(view) if view.problem.observed_runs else None,
        traces=thin_residuals(view),
        output=convert_to_output_units(view.campaign, name, coefficients),
        prior_correlations=prior_correlations(view.campaign, name),
        findings=[
            *contribution.findings,
            *residual_findings(contribution.residual_view),
            *check_unrecorded_ripple(view),
            *_undetermined_findings(view, coefficients),
            *check_credibility(view.campaign.limit_of, name, coefficients),
        ],
        **contribution.fields,
        **describe_instrument(view.accelerometer, coefficients),
    )


def _undetermined_findings(
    view: AccelerometerView, coefficients: Mapping[str, Coefficient]
) -> Iterator[Finding]:
    for symbol, coefficient in coefficients.items():
        if coefficient.value is None:
            data_name, advice = view.reading_data.advice(view, symbol)
            yield not_determined_finding(
                f"{view.name}.{symbol}",
                symbol,
                data_name,
                advice or _suggest_data(view, symbol),
                is_requested=is_requested(view.campaign, symbol, view.name),
            )


def _suggest_data(view: AccelerometerView, symbol: str) -> str:
    """Return advice on determining a term."""
    campaign = view.campaign
    rates = [abs(run.rate) for run in campaign.runs]
    rates += [abs(reading.rate) for reading in campaign.readings if reading.rate]
    if symbol in TERMS and rates and max(rates) < _MIN_RATE_RATIO * min(rates):
        return " All runs have the same rate; add a run at another rate."
    return _PRIOR_ADVICE


# Checks


def run_fit_tests(
    views: Sequence[AccelerometerView], run: str
) -> dict[str, dict[str, float | str | None]]:
    """Return the tests of one run's residuals, by accelerometer."""
    tests_by_name: dict[str, dict[str, float | str | None]] = {}
    for view in views:
        if not view.has_records:
            continue
        diagnostics = view.diagnostics
        test = diagnostics.runs.get(run)
        if test is not None:
            tests_by_name[view.name] = {
                "rows": float(test.rows),
                "chi2": test.chi2,
                "dof": test.dof,
                "chi2_p": test.chi2_p if diagnostics.noise_given else None,
                "sign_p": test.sign_p,
                "peak_frequency_hz": test.peak_frequency,
                "peak_p": test.peak_p,
            }
    return tests_by_name


def check_unrecorded_ripple(view: AccelerometerView) -> list[Finding]:
    """Return a finding if a rate ripple could bias K_II and no angle was recorded.

    A ripple accelerates the platform along the tangent by R w^2 times the relative ripple. In
    velocity or specific force this effect is confounded with K_II; in displacement it is not.
    """
    index, campaign = view.k_ii_index, view.campaign
    if index is None or view.accelerometer.observable == "displacement":
        return []
    if campaign.angle is not None or (view.groups and not view.has_records):
        return []
    max_rate = max(abs(run.rate) for run in campaign.runs)
    force = campaign.radius.value * max_rate**2 / campaign.gravity.value
    u = float(view.fit.solution.u[index])
    text = (
        "The rate ripple is unknown, because the records contain no angle. A relative rate "
        f"ripple of {0.5 * u * force:.1g} would shift K_II by about u/2. The stated u does not "
        "include this shift. Record the angle, or calibrate with displacement records."
    )
    return [Finding(code="unseen-ripple", subject=f"{view.name}.K_II", text=text)]
