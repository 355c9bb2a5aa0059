"""The two-stage method: from observed runs to the paper's result for each accelerometer."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.checks.limits import check_credibility
from counterspin.calibration.checks.residuals import undetected_walk_remarks
from counterspin.calibration.joint_problem import STATIC_NOISE_FUNCTION, JointProblem
from counterspin.calibration.model import fixed_terms
from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.outcome import (
    Outcome,
    accelerometer_correlation,
    add_static_uncertainty,
    confounded_terms,
    describe_instrument,
    make_coefficient,
    make_run_result,
    record_noise_lines,
)
from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    NoiseLine,
    ParabolaResult,
    Residual,
)
from counterspin.calibration.two_stage.findings import (
    check_strobes,
    check_two_stage,
    inseparable_sums,
    unstated_considered_symbols,
)
from counterspin.campaign.accelerometers import Accelerometer
from counterspin.campaign.description import Campaign
from counterspin.campaign.settings import StatedNoise
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.distributions import chi_square_tail
from counterspin.inference.identifiability import assess
from counterspin.inference.joint import encoder, estimation
from counterspin.inference.joint.budget import budget
from counterspin.inference.joint.estimation import Estimate, correct_series
from counterspin.inference.joint.series import ResidualSeries, rotation_column
from counterspin.inference.joint.unknowns import RIPPLE, ROTATION, Unknowns, unit_of
from counterspin.inference.joint.what_if import what_if
from counterspin.inference.noise.components import BIAS_COMPONENTS_BY_KEY
from counterspin.inference.noise.model import Noise
from counterspin.inference.noise.search import NoiseEstimate
from counterspin.inference.two_stage.first_stage import Parabola, strobe_angle
from counterspin.inference.two_stage.model import (
    DRIFT,
    TwoStageRequest,
    select_strobes,
    two_stage_model,
)
from counterspin.inference.two_stage.second_stage import (
    SecondStage,
    apply_noise_uncertainty,
    resolve,
)
from counterspin.loading import load_name
from counterspin.physics.terms import ACCELEROMETER_TERMS, SHARED_TERMS, TERMS

#: Terms that the second stage estimates.
_ESTIMATED_TERMS: Final = ("K_II", "K_F")


@frozen
class TwoStageOutcome:
    """Result of one accelerometer by the two-stage method, with both stages."""

    result: AccelerometerResult
    parabolas: Mapping[str, ParabolaResult]
    second_stage: SecondStage
    view: AccelerometerView


def calibrate_accelerometer(
    problem: JointProblem,
    accelerometer: Accelerometer,
    options: TwoStageOptions,
    noise_components: Mapping[str, NoiseEstimate],
    corrected_series: Sequence[ResidualSeries],
) -> TwoStageOutcome:
    """Apply the two-stage method to one accelerometer; arguments as in `two_stage_view`."""
    view, second_stage = two_stage_view(
        problem, accelerometer, options, noise_components, corrected_series
    )
    campaign, name, model = problem.campaign, accelerometer.name, second_stage.fit.model
    series = problem.accelerometer_series(name)
    estimates = {
        unknown.symbol: make_coefficient(view.estimate, view.assessment, index)
        for index, unknown in enumerate(model.unknowns)
    }
    if RIPPLE in estimates and options.ripple == "ratio":
        estimates[RIPPLE] = estimates[RIPPLE].model_copy(update={"unit": "1"})
    coefficients = estimates | {
        symbol: _prior_coefficient(accelerometer, symbol)
        for symbol in campaign.model.terms
        if symbol in ACCELEROMETER_TERMS and symbol not in estimates
    }
    indices = {
        unknown.symbol: index
        for index, unknown in enumerate(model.unknowns)
        if coefficients[unknown.symbol].estimated
    }
    budgets = {symbol: budget(second_stage.fit, index, name) for symbol, index in indices.items()}
    residual = _make_residual(second_stage.parabolas, view.estimate.estimated_noise.get(name))
    result = AccelerometerResult(
        coefficients={
            symbol: coefficient
            for symbol, coefficient in coefficients.items()
            if symbol not in (DRIFT, RIPPLE)
        },
        second_unknown={
            symbol: coefficient
            for symbol, coefficient in coefficients.items()
            if symbol in (DRIFT, RIPPLE)
        },
        correlation=accelerometer_correlation(view),
        confounded=[*confounded_terms(view), *inseparable_sums(view, second_stage, coefficients)],
        residual=residual,
        noise=add_static_uncertainty(
            _noise_lines(second_stage.parabolas, view),
            campaign,
            problem.noise[name],
            "displacement",
        ),
        budget=budgets,
        what_if=what_if(second_stage.fit, indices, budgets, name),
        findings=[
            *check_two_stage(view, second_stage, coefficients, options.model),
            *check_strobes(view, residual, second_stage.parabolas[0].sigma),
            *check_credibility(
                campaign.limit_of, name, {**coefficients, "K_I": _harmonic_scale_factor(series)}
            ),
        ],
        **describe_instrument(accelerometer, coefficients),
    )
    parabolas = {
        block.run: _make_parabola_result(parabola)
        for block, parabola in zip(
            second_stage.fit.design_blocks, second_stage.parabolas, strict=True
        )
    }
    return TwoStageOutcome(result, parabolas, second_stage, view)


def calibrate_two_stage(problem: JointProblem, options: TwoStageOptions) -> Outcome:
    """Apply the two-stage method to each accelerometer of a campaign."""
    campaign, observed_runs = problem.campaign, problem.observed_runs
    campaign.require_records("the two-stage method")
    noise, series = estimate_noise(problem)
    outcomes = {
        name: calibrate_accelerometer(problem, accelerometer, options, noise, series)
        for name, accelerometer in campaign.accelerometers.items()
    }
    return Outcome(
        model=options.model,
        accelerometers={name: outcome.result for name, outcome in outcomes.items()},
        runs={
            run.run.name: make_run_result(
                run,
                parabolas={
                    name: outcome.parabolas[run.run.name] for name, outcome in outcomes.items()
                },
            )
            for run in observed_runs
        },
        remarks=tuple(undetected_walk_remarks(outcome.view for outcome in outcomes.values())),
    )


def two_stage_view(
    problem: JointProblem,
    accelerometer: Accelerometer,
    options: TwoStageOptions,
    noise_components: Mapping[str, NoiseEstimate],
    corrected_series: Sequence[ResidualSeries],
    known_values: Mapping[tuple[str, str], tuple[float, float]] | None = None,
) -> tuple[AccelerometerView, SecondStage]:
    """Return the estimate as a joint fit of one accelerometer, and the stages of the method.

    noise_components: Estimated noise, by accelerometer.
    corrected_series: Series with corrected times, in the order of the problem.
    known_values: (owner, symbol) -> value and u of requested terms without a stated prior, from
        another fit of the records. None: default priors.
    """
    name, components = accelerometer.name, noise_components.get(accelerometer.name)
    request = make_request(problem, accelerometer, options, components)
    # All rows are used: noise one revolution apart is not correlated.
    all_series = [
        series.correct_times(corrected.corrected_fraction).with_timestamp_noise(
            corrected.timestamp_sd
        )
        for series, corrected in zip(problem.series, corrected_series, strict=True)
        if series.accelerometer == name
    ]
    selected_series, strobes = zip(*map(select_strobes, all_series), strict=True)
    parabolas = [
        request.first_stage(record_strobes, series.trajectory, series.timestamp_sd)
        for record_strobes, series in zip(strobes, selected_series, strict=True)
    ]
    joint_model = _add_priors(problem.campaign, problem.model, name, known_values)
    # Time-stamp jitter adds uncertainty to the rotation.
    rotation_terms = encoder.considered_terms(
        [series for series in selected_series if series.corrected_fraction > 0.0]
    )
    joint_model = replace(joint_model, considered=(*joint_model.considered, *rotation_terms))
    model = two_stage_model(joint_model, request, selected_series)
    second_stage = resolve(selected_series, parabolas, model, request)
    second_stage = apply_noise_uncertainty(second_stage, problem.noise[name], components)
    assessment = assess(second_stage.fit.solution, [unknown.name for unknown in model.unknowns])
    # A term is not determined if a requested term has the same effect.
    unstated_symbols = unstated_considered_symbols(problem.campaign, name, second_stage)
    symbols = [symbol for symbol in problem.campaign.model.terms if symbol in unstated_symbols]
    determined = {
        parameter.name: assessment.determined[parameter.name]
        and not second_stage.alike(parameter.symbol, symbols)
        for parameter in model.unknowns
    }
    estimate = Estimate(
        second_stage.fit,
        {} if components is None else {name: components},
        second_stage.dof,
        series=selected_series,
    )
    assessment = replace(assessment, determined=determined)
    return AccelerometerView(problem, estimate, assessment, name), second_stage


def _add_priors(
    campaign: Campaign,
    model: Unknowns,
    name: str,
    known_values: Mapping[tuple[str, str], tuple[float, float]] | None,
) -> Unknowns:
    """Return the joint model with priors for all terms that the two stages do not estimate.

    A requested term without a known value gets its default prior. Fixed terms become considered
    terms with u = 0; with known values, only the requested ones.
    """
    unknowns = []
    for parameter in model.unknowns:
        if not math.isfinite(parameter.prior[1]) and parameter.symbol not in (
            *_ESTIMATED_TERMS,
            *ROTATION,
        ):
            default_sd = campaign.typical_of(parameter.symbol, parameter.owner)
            prior = (known_values or {}).get(
                (parameter.owner, parameter.symbol), (parameter.nominal, default_sd)
            )
            unknowns.append(replace(parameter, prior=prior, has_default_prior=True))
        else:
            unknowns.append(parameter)
    keys = {
        (parameter.owner, parameter.symbol) for parameter in (*model.unknowns, *model.considered)
    }
    fixed_parameters = [
        parameter
        for parameter in fixed_terms(campaign, model, name)
        if (parameter.owner, parameter.symbol) not in keys
        and (known_values is None or parameter.symbol in campaign.model.terms)
    ]
    return Unknowns(tuple(unknowns), (*model.considered, *fixed_parameters))


def _prior_coefficient(accelerometer: Accelerometer, symbol: str) -> Coefficient:
    """Return a coefficient that is not estimated, with its prior if stated."""
    prior = accelerometer.priors.get(symbol)
    return Coefficient(
        value=prior.value if prior else None,
        u=prior.u if prior else None,
        unit=unit_of(symbol),
        estimated=False,
    )


def _harmonic_scale_factor(all_series: Iterable[ResidualSeries]) -> Coefficient:
    """Return K_I from the rotation harmonic, which strobes at whole revolutions do not contain.

    Other terms change it by about 1e-5, which is accurate enough for a credibility check.
    """
    columns = []
    for series in all_series:
        waves = [series.columns(["K_I"], 1.0)[:, 0]]
        if series.angle_error is None:  # The start angle is unknown.
            waves.append(rotation_column(series, ROTATION[0]))
        drifts = np.vander(series.time / series.time[-1], 4)
        signals = np.column_stack([*waves, series.error])
        signals -= drifts @ np.linalg.lstsq(drifts, signals, rcond=None)[0]
        scale_column, error = signals[:, 0], signals[:, -1]
        if series.angle_error is None:
            output = scale_column + error
            amplitudes = np.linalg.lstsq(signals[:, :-1], output, rcond=None)[0]
            scale_column = signals[:, :-1] @ amplitudes / np.linalg.norm(amplitudes)
            error = output - scale_column
        columns.append(np.column_stack([scale_column, error]))
    scale_column, error = np.concatenate(columns).T
    squared_norm = float(scale_column @ scale_column)
    scale_change = float(scale_column @ error) / squared_norm
    u = float(np.std(error - scale_change * scale_column)) / math.sqrt(squared_norm)
    value = TERMS["K_I"].nominal + scale_change
    return Coefficient(value=value, u=u, unit=unit_of("K_I"), estimated=True)


def _make_residual(parabolas: Sequence[Parabola], components: NoiseEstimate | None) -> Residual:
    weighted_residuals = [
        parabola.residuals / parabola.strobes.noise_factor for parabola in parabolas
    ]
    dof = sum(parabola.dof for parabola in parabolas)
    rms = math.sqrt(sum(float(np.sum(residuals**2)) for residuals in weighted_residuals) / dof)
    if components is not None or any(parabola.sigma_from_residuals for parabola in parabolas):
        return Residual(rms=rms, unit="m", dof=dof)
    chi2 = sum(parabola.chi2 for parabola in parabolas)
    return Residual(rms=rms, unit="m", dof=dof, chi2=chi2, lack_of_fit_p=chi_square_tail(dof, chi2))


def _noise_lines(parabolas: Sequence[Parabola], view: AccelerometerView) -> dict[str, NoiseLine]:
    is_estimated = parabolas[0].sigma_from_residuals
    components = view.estimate.estimated_noise.get(view.name)
    if components is not None and not is_estimated:
        return record_noise_lines(components.noise, components, "displacement")
    dof = sum(parabola.dof for parabola in parabolas)
    sigma = math.sqrt(sum(parabola.sigma**2 * parabola.dof for parabola in parabolas) / dof)
    white_line = NoiseLine(
        value=sigma,
        u=sigma / math.sqrt(2.0 * dof) if is_estimated else None,
        unit="m",
        estimated=is_estimated,
    )
    if components is not None:
        return {
            **record_noise_lines(components.noise, components, "displacement"),
            "displacement": white_line,
        }
    walk_noise = Noise(0.0, view.fit.noise[view.name].random_walk)
    return {"displacement": white_line, **record_noise_lines(walk_noise, None, "displacement")}


def _make_parabola_result(parabola: Parabola) -> ParabolaResult:
    b0, b1, b2 = (float(b) for b in parabola.coefficients)
    return ParabolaResult(
        b0=b0,
        b1=b1,
        b2=b2,
        u_b2=parabola.u_b2,
        sigma=parabola.sigma,
        sigma_from_residuals=parabola.sigma_from_residuals,
        strobes=parabola.strobes.time.size,
    )


# Requests


def make_request(
    problem: JointProblem,
    accelerometer: Accelerometer,
    options: TwoStageOptions,
    components: NoiseEstimate | None = None,
) -> TwoStageRequest:
    """Return the request of a campaign to the two-stage method for one accelerometer.

    components: Estimated noise, if the campaign states none.

    NotIdentifiableError: the record is not a displacement along a horizontal axis, or the bias
    drifts.
    """
    campaign, model = problem.campaign, problem.model
    if accelerometer.observable != "displacement":
        raise NotIdentifiableError(
            f"{accelerometer.name}: the two-stage method requires displacement records, but "
            f"this record contains the {accelerometer.observable.replace('_', ' ')}; use the "
            "joint method",
            code="method-not-applicable",
        )
    stated_noise = campaign.noise
    if campaign.rest is not None:
        stated_noise = load_name(STATIC_NOISE_FUNCTION)(campaign)[accelerometer.name].sizes
    if stated_noise is not None and stated_noise.wanders:
        key_list = ", ".join(f"noise.{key}" for key in BIAS_COMPONENTS_BY_KEY)
        raise NotIdentifiableError(
            f"{accelerometer.name}: the two-stage method cannot model a drifting bias "
            f"({key_list}); use the joint method",
            code="method-not-applicable",
        )
    for run in campaign.runs:
        strobe_angle(accelerometer.mounting.turned(run.attitude).input_axis)
    priors = {
        parameter.symbol: parameter.prior
        for parameter in (*model.unknowns, *model.considered)
        if math.isfinite(parameter.prior[1])
        and parameter.symbol
        in (ACCELEROMETER_TERMS if parameter.owner == accelerometer.name else SHARED_TERMS)
    }
    noise = problem.noise[accelerometer.name]
    request = TwoStageRequest(
        model=options.model,
        priors=priors,
        fit_bias=options.fit_bias,
        nominal_angle=campaign.angle is None,
        ripple=options.ripple,
        weighted=options.weighted,
        sigma=None if options.from_residuals else _displacement_noise(stated_noise),
        from_residuals=options.from_residuals,
        random_walk=None if "random_walk" in noise.to_estimate else noise.random_walk,
        timing=_stated_size(stated_noise, "timing") or 0.0,
        u_radius=campaign.radius.u / campaign.radius.value,
        u_gravity=campaign.gravity.u / campaign.gravity.value,
        limits={
            symbol: campaign.limit_of(symbol, accelerometer.name)
            for symbol in (*ACCELEROMETER_TERMS, *SHARED_TERMS)
        },
    )
    return request if components is None else request.with_noise(components.noise)


def _displacement_noise(noise: StatedNoise | None) -> float | None:
    """Return the displacement noise of a sample, m; None if it is not stated."""
    white_noise = _stated_size(noise, "displacement")
    step = _stated_size(noise, "quantisation") or 0.0
    return None if white_noise is None else math.hypot(white_noise, step / math.sqrt(12.0)) or None


def _stated_size(noise: StatedNoise | None, component: str) -> float | None:
    """Return a component of the stated noise; None if it is not a number."""
    stated_size = getattr(noise, component, None)
    return stated_size if isinstance(stated_size, float) else None


def is_walk_stated(noises: Mapping[str, Noise]) -> bool:
    """Return whether [noise] states the random walk of all accelerometers, zero included."""
    return not any("random_walk" in noise.to_estimate for noise in noises.values())


def estimate_noise(
    problem: JointProblem,
) -> tuple[Mapping[str, NoiseEstimate], Sequence[ResidualSeries]]:
    """Return the estimated noise of each accelerometer, and all series with corrected times.

    The noise is estimated by the joint fit, because one sample per revolution contains little
    information on it. It is empty if the random walk is stated.
    """
    if is_walk_stated(problem.noise):
        return {}, correct_series(problem.series, problem.model, problem.noise)
    estimate = estimation.estimate(problem.series, problem.model, problem.noise)
    return estimate.estimated_noise, estimate.series
