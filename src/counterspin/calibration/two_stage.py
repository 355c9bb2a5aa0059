"""The two-stage method: from observed runs to the paper's result for each accelerometer.

- `two_stage`, `TwoStageOutcome`: all of it
- `k_ii`: its K_II alone
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from counterspin.calibration.joint_parts import record_noise
from counterspin.calibration.left_out import two_stage_omissions, with_typical
from counterspin.calibration.observed import ObservedRun
from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.result import described
from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    Correlation,
    NoiseLine,
    ParabolaResult,
    Residual,
    countable,
)
from counterspin.calibration.two_stage_findings import (
    asked_only,
    confounded,
    findings,
    unmodelled,
)
from counterspin.calibration.two_stage_request import request_of
from counterspin.campaign.resolved import Accelerometer, Campaign
from counterspin.frozen import frozen
from counterspin.inference.distributions import chi_square_tail
from counterspin.inference.noise.model import NoiseModel
from counterspin.inference.noise.variance_components import VarianceComponents
from counterspin.inference.two_stage import strobes as strobing
from counterspin.inference.two_stage.first_stage import Parabola
from counterspin.inference.two_stage.found_noise import with_found_noise
from counterspin.inference.two_stage.request import DRIFT, RIPPLE, TwoStageRequest
from counterspin.inference.two_stage.second_stage import SecondStage, StrobedRun, second_stage
from counterspin.physics.terms import OWN_TERMS, is_term, term


@frozen
class TwoStageOutcome:
    """Both stages of one accelerometer: what the result says, and what it says it from."""

    result: AccelerometerResult
    parabolas: Mapping[str, ParabolaResult]
    runs: tuple[StrobedRun, ...]
    second: SecondStage


def two_stage(
    campaign: Campaign,
    observed: Sequence[ObservedRun],
    accelerometer: Accelerometer,
    options: TwoStageOptions,
    found: Mapping[str, VarianceComponents],
) -> TwoStageOutcome:
    """Apply the two-stage method to one accelerometer.

    Parameters
    ----------
    campaign, accelerometer
        The description and one of its accelerometers.
    observed
        The campaign's runs.
    options
        Model, weighting and so on.
    found
        Noise that the campaign does not state, by accelerometer: see
        `counterspin.calibration.two_stage_request.noise_found`.

    Returns
    -------
    TwoStageOutcome

    Raises
    ------
    NotIdentifiableError
        If the accelerometer's record is not a displacement along a horizontal axis, or there are
        fewer rates than unknowns.
    RecordError
        If a run has too few strobes.
    """
    components = found.get(accelerometer.name)
    request = request_of(campaign, accelerometer, options, components)
    ignored = unmodelled(campaign, accelerometer)
    runs, second = _both_stages(observed, accelerometer, request, ignored, components)
    unknowns = _unknowns(second, request)
    exact = options.model == "exact"
    omissions = two_stage_omissions(campaign, accelerometer.name, second, request) if exact else {}
    estimates = _coefficients(campaign, accelerometer, second, unknowns)
    coefficients = with_typical(estimates, omissions)
    parabolas = [run.parabola for run in runs]
    result = AccelerometerResult(
        coefficients={k: v for k, v in coefficients.items() if k not in (DRIFT, RIPPLE)},
        second_unknown={k: v for k, v in coefficients.items() if k in (DRIFT, RIPPLE)},
        correlation=_correlation(second, coefficients),
        confounded=confounded(second, unknowns),
        residual=_residual(parabolas, components),
        noise=_noise_lines(parabolas, request, components),
        left_out=omissions,
        findings=findings(campaign, accelerometer.name, runs, second, coefficients, options.model),
        **described(accelerometer, coefficients),
    )
    return TwoStageOutcome(
        result, {run.name: _parabola(run.parabola) for run in runs}, runs, second
    )


def _both_stages(
    observed: Sequence[ObservedRun],
    accelerometer: Accelerometer,
    request: TwoStageRequest,
    ignored: Sequence[str],
    components: VarianceComponents | None,
) -> tuple[tuple[StrobedRun, ...], SecondStage]:
    """Strobe the runs of one accelerometer, fit parabolas and resolve them.

    `ignored` are terms of which nothing is known and whose effects are wanted; `components` are
    those of noise that was found.
    """
    runs = tuple(_strobed(run, accelerometer, request) for run in observed)
    second = second_stage(runs, accelerometer.mounting, request, ignored=ignored)
    if DRIFT in second.symbols:
        # K_II grows with the rate's fourth power, and so along a drift that is now known.
        runs = tuple(_drifting(run, second.estimate(DRIFT)[0]) for run in runs)
        second = second_stage(runs, accelerometer.mounting, request, ignored=ignored)
    if components is not None:
        second = with_found_noise(second, runs, components)
    return runs, second


def k_ii(
    campaign: Campaign,
    observed: Sequence[ObservedRun],
    accelerometer: Accelerometer,
    options: TwoStageOptions,
    found: Mapping[str, VarianceComponents],
) -> tuple[Coefficient, SecondStage]:
    """Return the K_II of `two_stage` and where it comes from, without the rest of its result.

    Raises
    ------
    NotIdentifiableError, RecordError
        As `two_stage`.
    """
    # Whether K_II is alone depends on what was asked for beside it, and on nothing else.
    components = found.get(accelerometer.name)
    request = request_of(campaign, accelerometer, options, components)
    ignored = asked_only(campaign, accelerometer)
    _, second = _both_stages(observed, accelerometer, request, ignored, components)
    unknowns = _unknowns(second, request)
    return _coefficients(campaign, accelerometer, second, unknowns)["K_II"], second


def _drifting(run: StrobedRun, drift: float) -> StrobedRun:
    spindle = replace(run.trajectory.spindle, drift=drift)
    return replace(run, trajectory=replace(run.trajectory, spindle=spindle))


def _strobed(
    run: ObservedRun, accelerometer: Accelerometer, request: TwoStageRequest
) -> StrobedRun:
    error = run.signals[accelerometer.name].error
    turned = accelerometer.mounting.turned(run.run.attitude)
    phase = strobing.strobe_angle(turned.input_axis)
    time, count = run.record.time, run.record.count
    if run.rotation is None:
        strobes = strobing.by_nominal_rate(time, run.run.rate, error, phase, count)
    else:
        angle = run.trajectory.spindle.angle(time)
        strobes = strobing.by_angle(time, angle, error, phase, count)
    parabola = request.first_stage(strobes, run.trajectory)
    return StrobedRun(run.run.name, run.trajectory, parabola, run.run.attitude)


def _unknowns(second: SecondStage, request: TwoStageRequest) -> dict[str, Coefficient]:
    """Return the estimates of the second stage, determined or not."""
    estimates = {}
    solution = second.solution
    for index, symbol in enumerate(second.symbols):
        value, _ = second.estimate(symbol)
        u, dof = second.with_inputs(symbol, request)
        prior, considered = (
            math.sqrt(float(part[index, index]))
            for part in (solution.covariance_prior, solution.covariance_considered)
        )
        limit = second.request.limit_of(symbol) if is_term(symbol) else math.inf
        known = float(solution.prior_sd[index])
        ratio = symbol == RIPPLE and request.ripple == "ratio"
        estimates[symbol] = Coefficient(
            value=value,
            u=u,
            u_noise=float(second.u_noise[index]),
            u_prior=prior,
            u_considered=math.hypot(considered, *request.from_inputs(symbol, value)),
            dof=countable(dof),
            unit="1" if ratio else _unit(symbol),
            estimated=u < limit and not (math.isfinite(known) and u * u > 0.9 * known**2),
        )
    return estimates


def _coefficients(
    campaign: Campaign,
    accelerometer: Accelerometer,
    second: SecondStage,
    unknowns: Mapping[str, Coefficient],
) -> dict[str, Coefficient]:
    """Return what is determined, then the other terms of the model with what is known of them."""
    coefficients = {}
    for symbol, estimate in unknowns.items():
        # Asked to tell it from a term that acts exactly alike, the records say nothing.
        alone = not set(second.alike(symbol)) & set(campaign.model.terms)
        coefficients[symbol] = (
            estimate if estimate.estimated and alone else _known(accelerometer, symbol)
        )
    for symbol in campaign.model.terms:
        if symbol in OWN_TERMS and symbol not in coefficients:
            coefficients[symbol] = _known(accelerometer, symbol)
    return coefficients


def _known(accelerometer: Accelerometer, symbol: str) -> Coefficient:
    """Return a coefficient that the data do not determine: its prior, or nothing."""
    prior = accelerometer.priors.get(symbol)
    return Coefficient(
        value=prior.value if prior else None,
        u=prior.u if prior else None,
        unit=_unit(symbol),
        estimated=False,
    )


def _unit(symbol: str) -> str:
    units = {DRIFT: "1/s", RIPPLE: "rad/s"}
    return units.get(symbol) or term(symbol).unit


def _correlation(
    second: SecondStage, coefficients: Mapping[str, Coefficient]
) -> Correlation | None:
    chosen = [i for i, symbol in enumerate(second.symbols) if coefficients[symbol].estimated]
    if not chosen:
        return None
    covariance = second.solution.covariance[np.ix_(chosen, chosen)]
    u = np.sqrt(np.diag(covariance))
    matrix = covariance / np.outer(u, u)
    return Correlation(terms=[second.symbols[i] for i in chosen], matrix=matrix.tolist())


def _residual(parabolas: Sequence[Parabola], components: VarianceComponents | None) -> Residual:
    weighted = [p.residuals / p.strobes.noise_factor for p in parabolas]
    dof = sum(p.dof for p in parabolas)
    rms = math.sqrt(sum(float(np.sum(w**2)) for w in weighted) / dof)
    if components is not None or any(p.sigma_from_residuals for p in parabolas):
        return Residual(rms=rms, unit="m", dof=dof)
    chi2 = sum(p.chi2 for p in parabolas)
    return Residual(rms=rms, unit="m", dof=dof, chi2=chi2, lack_of_fit_p=chi_square_tail(dof, chi2))


def _noise_lines(
    parabolas: Sequence[Parabola],
    request: TwoStageRequest,
    components: VarianceComponents | None,
) -> dict[str, NoiseLine]:
    estimated = parabolas[0].sigma_from_residuals
    if components is not None and not estimated:
        return record_noise(components.noise, components, "displacement")
    dof = sum(p.dof for p in parabolas)
    sigma = math.sqrt(sum(p.sigma**2 * p.dof for p in parabolas) / dof)
    white = NoiseLine(
        value=sigma,
        u=sigma / math.sqrt(2.0 * dof) if estimated else None,
        unit="m",
        estimated=estimated,
    )
    if components is not None:
        return {**record_noise(components.noise, components, "displacement"), "displacement": white}
    walk = NoiseModel(0.0, request.random_walk or 0.0)
    return {"displacement": white, **record_noise(walk, None, "displacement")}


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
