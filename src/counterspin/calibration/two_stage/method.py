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
from counterspin.calibration.joint_problem import STATIC_NOISE, JointProblem
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
    check_strobe_noise,
    check_two_stage,
    inseparable_sums,
    unstated_considered,
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
from counterspin.inference.joint.series import ResidualSeries
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
from counterspin.inference.two_stage.second_stage import SecondStage, resolve, with_estimated_noise
from counterspin.loading import load_name
from counterspin.physics.terms import ACCELEROMETER_TERMS, SHARED_TERMS, TERMS

#: What the second stage estimates of an accelerometer.
_ESTIMATED: Final = ("K_II", "K_F")


@frozen
class TwoStageOutcome:
    """Both stages of one accelerometer: what the result says, and what it says it from."""

    result: AccelerometerResult
    parabolas: Mapping[str, ParabolaResult]
    second: SecondStage
    view: AccelerometerView


def calibrate_accelerometer(
    problem: JointProblem,
    accelerometer: Accelerometer,
    options: TwoStageOptions,
    noise_components: Mapping[str, NoiseEstimate],
    corrected_series: Sequence[ResidualSeries],
) -> TwoStageOutcome:
    """Apply the two-stage method to one accelerometer; arguments as in `two_stage_view`."""
    view, second = two_stage_view(
        problem, accelerometer, options, noise_components, corrected_series
    )
    campaign, name, model = problem.campaign, accelerometer.name, second.fit.model
    records = problem.accelerometer_series(name)
    unknowns = {
        unknown.symbol: make_coefficient(view.estimate, view.assessment, index)
        for index, unknown in enumerate(model.unknowns)
    }
    if RIPPLE in unknowns and options.ripple == "ratio":
        unknowns[RIPPLE] = unknowns[RIPPLE].model_copy(update={"unit": "1"})
    others = [s for s in campaign.model.terms if s in ACCELEROMETER_TERMS and s not in unknowns]
    known = {symbol: _prior_coefficient(accelerometer, symbol) for symbol in others}
    coefficients = {**unknowns, **known}
    indices = {
        unknown.symbol: index
        for index, unknown in enumerate(model.unknowns)
        if coefficients[unknown.symbol].estimated
    }
    budgets = {symbol: budget(second.fit, index, name) for symbol, index in indices.items()}
    residual_size = _residual(second.parabolas, view.estimate.estimated_noise.get(name))
    result = AccelerometerResult(
        coefficients={k: v for k, v in coefficients.items() if k not in (DRIFT, RIPPLE)},
        second_unknown={k: v for k, v in coefficients.items() if k in (DRIFT, RIPPLE)},
        correlation=accelerometer_correlation(view),
        confounded=[*confounded_terms(view), *inseparable_sums(view, second, coefficients)],
        residual=residual_size,
        noise=add_static_uncertainty(
            _noise_lines(second.parabolas, view), campaign, problem.noise[name], "displacement"
        ),
        budget=budgets,
        what_if=what_if(second.fit, indices, budgets, name),
        findings=[
            *check_two_stage(view, second, coefficients, options.model),
            *check_strobe_noise(view, residual_size, second.parabolas[0].sigma),
            *check_credibility(
                campaign.limit_of, name, {**coefficients, "K_I": _harmonic_scale_factor(records)}
            ),
        ],
        **describe_instrument(accelerometer, coefficients),
    )
    parabolas = {
        prepared.run: _parabola(parabola)
        for prepared, parabola in zip(second.fit.design_blocks, second.parabolas, strict=True)
    }
    return TwoStageOutcome(result, parabolas, second, view)


def calibrate_two_stage(problem: JointProblem, options: TwoStageOptions) -> Outcome:
    """Apply the two-stage method to each accelerometer of a campaign."""
    campaign, observed = problem.campaign, problem.observed_runs
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
                    name: stage_result.parabolas[run.run.name]
                    for name, stage_result in outcomes.items()
                },
            )
            for run in observed
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
    corrected_series: The records at corrected times, in the order of the problem's.
    known_values: Owner and symbol -> value and u, of requested terms without a stated prior,
        from another fit of the records. Default: their typical sizes.
    """
    name, components = accelerometer.name, noise_components.get(accelerometer.name)
    request = make_request(problem, accelerometer, options, components)
    # Rows that the joint fit leaves out are not correlated a revolution apart.
    records = [
        record.correct_times(corrected.corrected_fraction).with_timestamp_noise(
            corrected.timestamp_sd
        )
        for record, corrected in zip(problem.series, corrected_series, strict=True)
        if record.accelerometer == name
    ]
    series, strobes = zip(*map(select_strobes, records), strict=True)
    parabolas = [
        request.first_stage(record_strobes, record.trajectory, record.timestamp_sd)
        for record_strobes, record in zip(strobes, series, strict=True)
    ]
    joint_model = _with_priors(problem.campaign, problem.model, name, known_values)
    # Time stamps that scatter leave the rotation less certain than the strobes' noise tells.
    rotation = encoder.considered_terms(
        [record for record in series if record.corrected_fraction > 0.0]
    )
    joint_model = replace(joint_model, considered=(*joint_model.considered, *rotation))
    model = two_stage_model(joint_model, request, series)
    second = resolve(series, parabolas, model, request)
    second = with_estimated_noise(second, problem.noise[name], components)
    assessment = assess(second.fit.solution, [unstated.name for unstated in model.unknowns])
    # Asked to tell it from a term that acts exactly alike, the records say nothing.
    unstated = unstated_considered(problem.campaign, name, second)
    requested = [symbol for symbol in problem.campaign.model.terms if symbol in unstated]
    determined = {
        parameter.name: assessment.determined[parameter.name]
        and not second.alike(parameter.symbol, requested)
        for parameter in model.unknowns
    }
    estimated = Estimate(
        second.fit, {} if components is None else {name: components}, second.dof, series=series
    )
    assessment = replace(assessment, determined=determined)
    return AccelerometerView(problem, estimated, assessment, name), second


def _with_priors(
    campaign: Campaign,
    model: Unknowns,
    name: str,
    known_values: Mapping[tuple[str, str], tuple[float, float]] | None,
) -> Unknowns:
    """Return the joint model with something known of all that two stages do not estimate.

    A requested term without a stated value has its typical size, if nothing is known of it. The
    size also counts where all terms are assumed to be perfect. What is assumed to be perfect is
    held as exactly that, for what it may be like: beside another fit only what is asked for.
    """
    unknowns = []
    for parameter in model.unknowns:
        if not math.isfinite(parameter.prior[1]) and parameter.symbol not in (
            *_ESTIMATED,
            *ROTATION,
        ):
            typical = campaign.typical_of(parameter.symbol, parameter.owner)
            prior = (known_values or {}).get(
                (parameter.owner, parameter.symbol), (parameter.nominal, typical)
            )
            unknowns.append(replace(parameter, prior=prior, has_default_prior=True))
        else:
            unknowns.append(parameter)
    present = {
        (parameter.owner, parameter.symbol) for parameter in (*model.unknowns, *model.considered)
    }
    fixed = [
        parameter
        for parameter in fixed_terms(campaign, model, name)
        if (parameter.owner, parameter.symbol) not in present
        and (known_values is None or parameter.symbol in campaign.model.terms)
    ]
    return Unknowns(tuple(unknowns), (*model.considered, *fixed))


def _prior_coefficient(accelerometer: Accelerometer, symbol: str) -> Coefficient:
    """Return a coefficient that is not estimated: its prior, or nothing."""
    prior = accelerometer.priors.get(symbol)
    return Coefficient(
        value=prior.value if prior else None,
        u=prior.u if prior else None,
        unit=unit_of(symbol),
        estimated=False,
    )


def _harmonic_scale_factor(records: Iterable[ResidualSeries]) -> Coefficient:
    """Return the K_I of the records' waves, which strobes at whole revolutions do not see.

    Other terms add some 1e-5 to a wave: it is near enough to tell whether it is credible.
    """
    columns = []
    for record in records:
        slow = np.vander(record.time / record.time[-1], 4)
        pair = np.column_stack([record.columns(["K_I"], 1.0)[:, 0], record.error])
        columns.append(pair - slow @ np.linalg.lstsq(slow, pair, rcond=None)[0])
    columns_of_scale, error = np.concatenate(columns).T
    strength = float(columns_of_scale @ columns_of_scale)
    step = float(columns_of_scale @ error) / strength
    u = float(np.std(error - step * columns_of_scale)) / math.sqrt(strength)
    value = TERMS["K_I"].nominal + step
    return Coefficient(value=value, u=u, unit=unit_of("K_I"), estimated=True)


def _residual(parabolas: Sequence[Parabola], components: NoiseEstimate | None) -> Residual:
    weighted = [p.residuals / p.strobes.noise_factor for p in parabolas]
    dof = sum(p.dof for p in parabolas)
    rms = math.sqrt(sum(float(np.sum(w**2)) for w in weighted) / dof)
    if components is not None or any(p.sigma_from_residuals for p in parabolas):
        return Residual(rms=rms, unit="m", dof=dof)
    chi2 = sum(p.chi2 for p in parabolas)
    return Residual(rms=rms, unit="m", dof=dof, chi2=chi2, lack_of_fit_p=chi_square_tail(dof, chi2))


def _noise_lines(parabolas: Sequence[Parabola], view: AccelerometerView) -> dict[str, NoiseLine]:
    estimated = parabolas[0].sigma_from_residuals
    components = view.estimate.estimated_noise.get(view.name)
    if components is not None and not estimated:
        return record_noise_lines(components.noise, components, "displacement")
    dof = sum(p.dof for p in parabolas)
    sigma = math.sqrt(sum(p.sigma**2 * p.dof for p in parabolas) / dof)
    white = NoiseLine(
        value=sigma,
        u=sigma / math.sqrt(2.0 * dof) if estimated else None,
        unit="m",
        estimated=estimated,
    )
    if components is not None:
        return {
            **record_noise_lines(components.noise, components, "displacement"),
            "displacement": white,
        }
    walk = Noise(0.0, view.fit.noise[view.name].random_walk)
    return {"displacement": white, **record_noise_lines(walk, None, "displacement")}


def _parabola(parabola: Parabola) -> ParabolaResult:
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


# What a campaign asks of the method


def make_request(
    problem: JointProblem,
    accelerometer: Accelerometer,
    options: TwoStageOptions,
    components: NoiseEstimate | None = None,
) -> TwoStageRequest:
    """Return the request of a campaign to the two-stage method for one accelerometer.

    `components` is noise that was found, where the campaign states none. It raises
    NotIdentifiableError if the record is not a displacement along a horizontal axis, or the bias
    wanders.
    """
    campaign, model = problem.campaign, problem.model
    if accelerometer.observable != "displacement":
        raise NotIdentifiableError(
            f"{accelerometer.name}: the two-stage method requires displacement records, but "
            f"this record contains the {accelerometer.observable.replace('_', ' ')}; use the "
            "joint method",
            code="method-not-applicable",
        )
    stated = campaign.noise
    if campaign.rest is not None:
        stated = load_name(STATIC_NOISE)(campaign)[accelerometer.name].sizes
    if stated is not None and stated.wanders:
        keys = ", ".join(f"noise.{key}" for key in BIAS_COMPONENTS_BY_KEY)
        raise NotIdentifiableError(
            f"{accelerometer.name}: the two-stage method cannot model a drifting bias ({keys}); "
            "use the joint method",
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
        sigma=None if options.from_residuals else _sigma(stated),
        from_residuals=options.from_residuals,
        random_walk=None if "random_walk" in noise.to_estimate else noise.random_walk,
        timing=_stated_size(stated, "timing") or 0.0,
        u_radius=campaign.radius.u / campaign.radius.value,
        u_gravity=campaign.gravity.u / campaign.gravity.value,
        limits={
            symbol: campaign.limit_of(symbol, accelerometer.name)
            for symbol in (*ACCELEROMETER_TERMS, *SHARED_TERMS)
        },
    )
    return request if components is None else request.with_noise(components.noise)


def _sigma(noise: StatedNoise | None) -> float | None:
    """Return the displacement noise of a sample, m; None where it is not stated."""
    white = _stated_size(noise, "displacement")
    step = _stated_size(noise, "quantisation") or 0.0
    return None if white is None else math.hypot(white, step / math.sqrt(12.0)) or None


def _stated_size(noise: StatedNoise | None, component: str) -> float | None:
    """Return a component of the stated noise; None where it is not a number."""
    size = getattr(noise, component, None)
    return size if isinstance(size, float) else None


def walk_is_stated(noises: Mapping[str, Noise]) -> bool:
    """Return whether the accelerometers' own noise is known, as the joint method has it.

    It is where [noise] states it, zero included; a [noise] that states no noise at all leaves
    all of it to be found.
    """
    return not any("random_walk" in noise.to_estimate for noise in noises.values())


def estimate_noise(
    problem: JointProblem,
) -> tuple[Mapping[str, NoiseEstimate], Sequence[ResidualSeries]]:
    """Return each accelerometer's noise where the random walk is not stated, and all records.

    One sample a revolution tells little of the noise: it is that of the joint fit, from all
    samples. The records are at the times that their angles correct.
    """
    if walk_is_stated(problem.noise):
        return {}, correct_series(problem.series, problem.model, problem.noise)
    estimated = estimation.estimate(problem.series, problem.model, problem.noise)
    return estimated.estimated_noise, estimated.series
