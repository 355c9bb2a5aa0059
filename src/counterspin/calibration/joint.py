"""The joint method: from observed runs to every coefficient that full records determine."""

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
from counterspin.calibration.findings import (
    not_determined_finding,
)
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.model import is_requested, stated_inputs
from counterspin.calibration.outcome import (
    Outcome,
    coefficient,
    confounded,
    confounded_platform,
    correlation,
    describe_instrument,
    full_correlation,
    in_output_units,
    mounting_radii,
    noise_lines,
    own_correlations,
    prior_information,
    residual,
    residual_columns,
    run_result,
)
from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    Finding,
)
from counterspin.campaign.settings import OBSERVABLES
from counterspin.inference.identifiability import Assessment
from counterspin.inference.joint.budget import budget
from counterspin.inference.joint.estimation import Estimate, estimate
from counterspin.inference.joint.unknowns import ROTATION, Unknown
from counterspin.inference.joint.what_if import what_if
from counterspin.physics.terms import TERMS

#: Rates whose ratio is smaller count as one rate.
_SAME_RATE: Final = 1.05

#: What determines a term of which nothing more is known.
_PRIOR: Final = " State a prior in [model.priors], or remove the term from model.terms."


def _as_deviation(unknown: Unknown, c: Coefficient) -> Coefficient:
    """Return an estimate as far as it is from what is stated of it: a shorter arm is no mistake."""
    stated = unknown.prior_mean
    return c if c.value is None else c.model_copy(update={"value": c.value - stated})


def fit_jointly(problem: JointProblem) -> Outcome:
    """Fit all records of a campaign together."""
    campaign, observed, model = problem.campaign, problem.observed, problem.model
    estimated, data = estimate_campaign(problem)
    assessment = estimated.fit.assessment
    views = [
        AccelerometerView(problem, estimated, assessment, name, data).with_groups(data.groups)
        for name in campaign.accelerometers
    ]
    contributions = data.contributions(views)
    shared = {
        unknown: coefficient(estimated, assessment, index)
        for index, unknown in enumerate(model.of_interest)
        if unknown.symbol not in TERMS and unknown.owner not in campaign.accelerometers
    } | _rotation_coefficients(estimated, assessment)
    deviations = (
        (unknown.symbol, unknown.name, _as_deviation(unknown, c)) for unknown, c in shared.items()
    )
    incredible_findings = list(check_shared_credibility(campaign.limit_of, deviations))
    shared |= mounting_radii(campaign, shared)
    outliers: dict[str, int] = {run.run.name: 0 for run in observed}
    for record, mask in zip(estimated.series, estimated.outliers, strict=True):
        outliers[record.run] += int(record.count[mask].sum())
    longest = max((float(record.time[-1]) for record in estimated.series), default=0.0)
    accelerometers = {
        view.name: _accelerometer_result(view, contributions[view.name]) for view in views
    }
    terms = {
        run.run.name: {u.symbol: c for u, c in shared.items() if u.owner == run.run.name}
        for run in observed
    }
    diagnose = find_diagnosis()
    diagnosis = diagnose(views, accelerometers) if diagnose else Diagnosis()
    rests_on = prior_information(estimated, stated_inputs(campaign))
    units = {
        name: OBSERVABLES[accelerometer.observable]
        for name, accelerometer in campaign.accelerometers.items()
    }
    return Outcome(
        model="exact",
        accelerometers=accelerometers,
        runs={
            name: run_result(
                run, terms=terms[name], fit=run_fit_tests(views, name), outliers=outliers[name]
            )
            for run in observed
            for name in [run.run.name]
        },
        platform={u.symbol: c for u, c in shared.items() if not u.owner},
        confounded=confounded_platform(assessment),
        correlation=full_correlation(estimated, assessment),
        rests_on=rests_on,
        findings=[
            *(
                not_determined_finding(
                    u.name, u.name, more=_PRIOR, requested=is_requested(campaign, u.symbol)
                )
                for u, c in shared.items()
                if c.value is None
            ),
            *check_drifts(shared, longest),
            *check_tilts(campaign, terms, accelerometers),
            *incredible_findings,
            *check_default_priors(rests_on),
            *(() if diagnose else find_prior_conflict(views[0])),
        ],
        causes=diagnosis.causes,
        remarks=(
            *(remark for contribution in contributions.values() for remark in contribution.remarks),
            *diagnosis.remarks,
            *data.remarks(views),
            *undetected_walk_remarks(views),
            *noise_remarks(views),
        ),
        residuals=residual_columns(estimated.fit, units),
        **data.fields(estimated),
    )


def estimate_campaign(problem: JointProblem) -> tuple[Estimate, ReadingData]:
    """Return the estimate from all data of a campaign, and the readings and poses in it."""
    campaign = problem.campaign
    if campaign.readings or campaign.triad:
        return join_readings(problem)
    return estimate(problem.series, problem.model, problem.noise), ReadingData()


def _rotation_coefficients(
    estimated: Estimate, assessment: Assessment
) -> dict[Unknown, Coefficient]:
    """Return the rotations that were found from the displacement, as the runs had them."""
    spindles = {record.run: record.trajectory.spindle for record in estimated.series}
    rotations = {}
    for index, unknown in enumerate(estimated.fit.model.unknowns):
        if unknown.symbol in ROTATION:
            step = coefficient(estimated, assessment, index)
            base = getattr(spindles[unknown.owner], unknown.symbol.removeprefix("spindle."))
            rotations[unknown] = step.model_copy(update={"value": base + (step.value or 0.0)})
    return rotations


def _accelerometer_result(
    view: AccelerometerView, contribution: Contribution
) -> AccelerometerResult:
    name, estimated = view.name, view.estimate
    coefficients = {
        symbol: coefficient(estimated, view.assessment, index)
        for symbol, index in view.indices.items()
    }
    budgets = {
        symbol: budget(estimated.fit, index, name)
        for symbol, index in view.indices.items()
        if coefficients[symbol].estimated
    }
    return AccelerometerResult(
        # The campaign's order is the user's; the table of terms has its own.
        coefficients={
            symbol: coefficients[symbol]
            for symbol in view.campaign.model.terms
            if symbol in coefficients
        },
        correlation=correlation(view),
        confounded=confounded(view),
        residual=residual(contribution.residual_view),
        noise=noise_lines(view),
        budget=budgets,
        what_if=what_if(estimated.fit, view.indices, budgets, name),
        jackknife=view.jackknife(),
        two_stage=compare_two_stage(view) if view.problem.observed else None,
        traces=thin_residuals(view),
        output=in_output_units(view.campaign, name, coefficients),
        prior_correlations=own_correlations(view.campaign, name),
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
    for symbol, c in coefficients.items():
        if c.value is None:
            data, advice = view.data.advice(view, symbol)
            yield not_determined_finding(
                f"{view.name}.{symbol}",
                symbol,
                data,
                advice or _suggest_data(view, symbol),
                requested=is_requested(view.campaign, symbol, view.name),
            )


def _suggest_data(view: AccelerometerView, symbol: str) -> str:
    """Return advice on data that would determine a term."""
    campaign = view.campaign
    rates = [abs(run.rate) for run in campaign.runs]
    rates += [abs(reading.rate) for reading in campaign.readings if reading.rate]
    if symbol in TERMS and rates and max(rates) < _SAME_RATE * min(rates):
        return " All runs have the same rate; add a run at another rate."
    return _PRIOR


# Checks


def run_fit_tests(
    views: Sequence[AccelerometerView], run: str
) -> dict[str, dict[str, float | str | None]]:
    """Return the tests of one run's residuals, by accelerometer."""
    fits: dict[str, dict[str, float | str | None]] = {}
    for view in views:
        if not view.has_records:
            continue
        tests = view.diagnostics
        test = tests.runs.get(run)
        if test is not None:
            fits[view.name] = {
                "rows": float(test.rows),
                "chi2": test.chi2,
                "dof": test.dof,
                "chi2_p": test.chi2_p if tests.noise_given else None,
                "sign_p": test.sign_p,
                "peak_frequency_hz": test.peak_frequency,
                "peak_p": test.peak_p,
            }
    return fits


def check_unrecorded_ripple(view: AccelerometerView) -> list[Finding]:
    """Return a finding where a ripple would move K_II and no angle was recorded to show it.

    A ripple shakes the platform along the tangent with R w^2 times its ratio. In displacement
    that leaves nothing behind; in velocity or specific force it stands where K_II does. Where the
    angle is recorded, what its noise hides is in the uncertainty.
    """
    index, campaign = view.k_ii, view.campaign
    if index is None or view.accelerometer.observable == "displacement":
        return []
    if campaign.angle is not None or (view.groups and not view.has_records):
        return []
    fastest = max(abs(run.rate) for run in campaign.runs)
    force = campaign.radius.value * fastest**2 / campaign.gravity.value
    u = float(view.fit.solution.u[index])
    text = (
        "The rate ripple is unknown, because the records contain no angle. A relative rate "
        f"ripple of {0.5 * u * force:.1g} would shift K_II by about u/2. The stated u does not "
        "include this shift. Record the angle, or calibrate with displacement records."
    )
    return [Finding(code="unseen-ripple", subject=f"{view.name}.K_II", text=text)]
