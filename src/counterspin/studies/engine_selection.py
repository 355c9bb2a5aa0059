"""Competing analyses of a study, and the engine of each analysis.

The linear engine is valid under conditions. Each obstacle is a sentence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.two_stage.method import make_request
from counterspin.campaign.description import Campaign
from counterspin.errors import NotIdentifiableError, error_code
from counterspin.frozen import frozen
from counterspin.inference.joint.unknowns import RIPPLE, Unknown, Unknowns
from counterspin.inference.noise.components import BIAS_COMPONENTS_BY_KEY
from counterspin.inference.two_stage.model import TwoStageRequest
from counterspin.physics import observation
from counterspin.studies.batch_runner import (
    AnalysisEngine,
    CostClass,
    JointRequest,
    ReportedCoefficient,
    StudyEngine,
)
from counterspin.studies.description import StudyDescription
from counterspin.studies.draws import (
    DRIFT,
    NOISE_LEVEL_UNITS,
    RIPPLE_AMPLITUDE,
    RIPPLE_PHASE,
    RIPPLE_RATIO,
    WHITE_NOISE,
    Draws,
    StudyTruth,
)
from counterspin.studies.full_simulation import FullEngine, TrialReadings, TrialRecords
from counterspin.studies.linear_engines import (
    JointEngine,
    TwoStageEngine,
    fit_records,
    lower_bounds,
    noise_free_second_stage,
)
from counterspin.studies.result import BiasCovariate, TrialAccumulator
from counterspin.studies.simulation_setup import SimulationSetup, make_setup

#: Description of the linear engine in a result.
_LINEAR_DESCRIPTION: Final = "linear"

EngineName = Literal["auto", "linear", "full"]


@frozen
class Analysis:
    """One of the competing analyses."""

    name: str  #: Name of the analysis in the study.
    owner: str  #: Accelerometer of a two-stage analysis; empty for a joint fit.
    request: TwoStageRequest | JointRequest  #: Options of the method.
    #: Joint fit of the same campaign, which estimates unstated noise.
    joint_request: JointRequest


def list_analyses(study: StudyDescription) -> tuple[Analysis, ...]:
    """Return the competing analyses, with a two-stage analysis for each accelerometer."""
    analyses = []
    for description in study.analyses:
        name, options, campaign = description.name, description.two_stage, description.campaign
        problem = JointProblem(campaign)
        joint_request = JointRequest(problem.model, problem.noise)
        if options is None:
            analyses.append(Analysis(name, "", joint_request, joint_request))
            continue
        if campaign.angle is None:
            raise NotIdentifiableError(
                f"{name}: a study of the two-stage method requires a recorded angle ([records] "
                "angle); without an angle, study only the joint fit ([study.analyses])",
                code="method-not-applicable",
            )
        for owner, accelerometer in campaign.accelerometers.items():
            request = make_request(problem, accelerometer, options)
            analyses.append(Analysis(name, owner, request, joint_request))
    return tuple(analyses)


def prepare_study(study: StudyDescription, seed: int, engine: EngineName = "auto") -> StudyEngine:
    """Choose and prepare an engine for each analysis of a study."""
    campaign = study.campaign
    truth = StudyTruth.from_campaign(campaign, study.varied_quantities)
    # A campaign with only readings has no setup of records.
    has_readings = campaign.readings or campaign.posed
    setup = make_setup(campaign) if campaign.runs or not has_readings else None
    engines = []
    for analysis in list_analyses(study):
        if has_readings:
            engines.append(_reading_engine(campaign, setup, truth, analysis, engine))
        else:
            assert setup is not None
            engines.append(choose_engine(setup, truth, analysis, engine))
        if not engines[-1].coefficients:
            raise NotIdentifiableError(
                f"{analysis.name}: the records do not determine any coefficient",
                code="not-determined",
            )
    return StudyEngine(truth, seed, tuple(engines), TrialAccumulator(_bias_covariates(truth)))


def _bias_covariates(truth: StudyTruth) -> tuple[BiasCovariate, ...]:
    """Return the covariates of the bias: drift and ripple, if they vary."""
    covariates = []
    if truth.varies(DRIFT):
        covariates.append(BiasCovariate(DRIFT, *truth.bounds(DRIFT, 0)))
    if truth.varies(RIPPLE_RATIO, RIPPLE_AMPLITUDE):
        max_ratio = max(map(abs, truth.bounds(RIPPLE_RATIO, 0)))
        covariates.append(BiasCovariate(RIPPLE_RATIO, 0.0, max_ratio))
    return tuple(covariates)


def choose_engine(
    setup: SimulationSetup, truth: StudyTruth, analysis: Analysis, engine: EngineName
) -> AnalysisEngine:
    """Return the fastest engine that is valid for an analysis, or the requested engine."""
    if engine == "full":
        return _full_engine(setup, truth, analysis, "full records")
    request = analysis.request
    obstacles = (
        find_joint_obstacles(setup, truth, request)
        if isinstance(request, JointRequest)
        else find_two_stage_obstacles(setup, truth, request)
    )
    linear_engine = None if obstacles else _linear_engine(setup, truth, analysis)
    if linear_engine is not None:
        obstacles = _find_nonlinearity(setup, truth, analysis, linear_engine)
    if obstacles and engine == "linear":
        raise NotIdentifiableError(
            f'{analysis.name}: `engine="linear"` cannot be used for this study: '
            f'{"; ".join(obstacles)}; use `engine="full"`, or omit `engine`',
            code="method-not-applicable",
        )
    if obstacles or linear_engine is None:
        return _full_engine(setup, truth, analysis, f"full records ({obstacles[0]})")
    return linear_engine


def _reading_engine(
    campaign: Campaign,
    setup: SimulationSetup | None,
    truth: StudyTruth,
    analysis: Analysis,
    engine: EngineName,
) -> AnalysisEngine:
    """Return the engine of a campaign with readings, with or without records."""
    if engine == "linear":
        raise NotIdentifiableError(
            f'{analysis.name}: `engine="linear"` cannot be used for readings; use '
            '`engine="full"`, or omit `engine`',
            code="method-not-applicable",
        )
    try:
        readings = TrialReadings.from_campaign(campaign)
    except ValueError as error:
        raise NotIdentifiableError(f"{analysis.name}: {error}", code=error_code(error)) from error
    description = "readings" if setup is None else "full records and readings"
    return _full_joint_engine(setup, truth, analysis, analysis.joint_request, description, readings)


def _linear_engine(setup: SimulationSetup, truth: StudyTruth, analysis: Analysis) -> AnalysisEngine:
    request = analysis.request
    if isinstance(request, JointRequest):
        return _linear_joint_engine(setup, truth, analysis, request)
    two_stage_engine = TwoStageEngine.prepare(setup, truth, request, analysis.owner)
    cost_class: CostClass = "sampled" if request.sigma is None else "linear"
    rows, coefficients = _reported_unknowns(setup, truth, analysis, request)
    return AnalysisEngine(
        two_stage_engine,
        cost_class,
        _noise_stream(setup, analysis),
        _LINEAR_DESCRIPTION,
        rows,
        coefficients,
    )


def _noise_stream(setup: SimulationSetup, analysis: Analysis) -> int:
    """Return the noise stream of an analysis.

    Two-stage analyses of an accelerometer share a stream, and joint analyses share another one.
    """
    names = list(setup.mountings)
    return names.index(analysis.owner) if analysis.owner else len(names)


def _linear_joint_engine(
    setup: SimulationSetup, truth: StudyTruth, analysis: Analysis, request: JointRequest
) -> AnalysisEngine:
    joint_engine, undetermined_names = JointEngine.prepare(setup, request, truth)
    bounds = lower_bounds(truth, request.model, setup)
    coefficients = _reported_coefficients(
        analysis, [request.model.unknowns[index] for index in joint_engine.rows], bounds
    )
    rows, noise_stream = tuple(range(len(coefficients))), _noise_stream(setup, analysis)
    return AnalysisEngine(
        joint_engine,
        "linear",
        noise_stream,
        _LINEAR_DESCRIPTION,
        rows,
        coefficients,
        undetermined_names,
    )


def _full_engine(
    setup: SimulationSetup, truth: StudyTruth, analysis: Analysis, description: str
) -> AnalysisEngine:
    request = analysis.request
    if isinstance(request, JointRequest):
        return _full_joint_engine(setup, truth, analysis, request, description)
    rows, coefficients = _reported_unknowns(setup, truth, analysis, request)
    full_engine = FullEngine(setup, request, analysis.joint_request, analysis.owner)
    return AnalysisEngine(
        full_engine, "full", _noise_stream(setup, analysis), description, rows, coefficients
    )


def _full_joint_engine(
    setup: SimulationSetup | None,
    truth: StudyTruth,
    analysis: Analysis,
    request: JointRequest,
    description: str,
    readings: TrialReadings | None = None,
) -> AnalysisEngine:
    noisy_readings = () if readings is None else readings.groups_with_true_noise
    bounds = lower_bounds(truth, request.model, setup, noisy_readings)
    unknowns = request.model.unknowns
    determined_indices = tuple(
        index for index in request.reported_indices if unknowns[index].name in bounds
    )
    undetermined_names = tuple(
        unknowns[index].name
        for index in request.reported_indices
        if index not in determined_indices
    )
    return AnalysisEngine(
        engine=FullEngine(setup, request, request, rows=determined_indices, readings=readings),
        cost_class="readings" if setup is None else "full",
        noise_stream=0 if setup is None or readings is not None else _noise_stream(setup, analysis),
        description=description,
        rows=tuple(range(len(determined_indices))),
        coefficients=_reported_coefficients(
            analysis, [unknowns[index] for index in determined_indices], bounds
        ),
        undetermined=undetermined_names,
    )


def _reported_unknowns(
    setup: SimulationSetup, truth: StudyTruth, analysis: Analysis, request: TwoStageRequest
) -> tuple[tuple[int, ...], tuple[ReportedCoefficient, ...]]:
    """Return the rows of the reported unknowns of a two-stage analysis, and their coefficients."""
    symbols = list(request.unknowns)
    rows = tuple(row for row, symbol in enumerate(symbols) if symbol != RIPPLE)
    unknowns = [
        Unknown(analysis.owner, symbol, request.unknowns[symbol], request.limit_of(symbol))
        for symbol in (symbols[row] for row in rows)
    ]
    return rows, _reported_coefficients(
        analysis, unknowns, lower_bounds(truth, Unknowns(tuple(unknowns)), setup)
    )


def _reported_coefficients(
    analysis: Analysis, unknowns: Sequence[Unknown], bounds: Mapping[str, float]
) -> tuple[ReportedCoefficient, ...]:
    return tuple(
        ReportedCoefficient(analysis.name, unknown.owner, unknown.symbol, bounds.get(unknown.name))
        for unknown in unknowns
    )


#: Largest negligible noise of angle and time, relative to the displacement noise.
_MAX_NEGLECTED_NOISE: Final = 0.01

#: Largest rms of non-parabolic residuals of strobes, relative to the noise.
_MAX_RESIDUAL_RMS: Final = 0.1

#: Number of random trials that are compared with full records.
_N_COMPARED_TRIALS: Final = 2

#: Largest allowed difference of the estimate, relative to u, and relative difference of u. Such a
#: bias reduces a coverage of 95 % by 0.1 %; such a difference of u changes it by 0.2 %.
_MAX_ESTIMATE_DIFFERENCE: Final = 0.1
_MAX_U_DIFFERENCE: Final = 0.01


def _find_nonlinearity(
    setup: SimulationSetup, truth: StudyTruth, analysis: Analysis, linear_engine: AnalysisEngine
) -> list[str]:
    """Return the obstacle to linear trials if full records give different results.

    The compared records have noise, which outlier rejection and other checks of residuals need.
    Its effect on the estimate is the same in all trials. For the joint fit, a single fit without
    rejection at the mean true values determines it.
    """
    request, engine = analysis.request, linear_engine.engine
    rows: tuple[int, ...] = ()
    if isinstance(request, TwoStageRequest):
        assert isinstance(engine, TwoStageEngine)
        obstacles = _find_residual_obstacles(setup, truth, analysis, request)
        if obstacles:
            return obstacles
        sigma = request.sigma or truth.white_noise
        request, engine = replace(request, sigma=sigma), replace(engine, sigma=sigma)
    else:
        assert isinstance(engine, JointEngine)
        rows = engine.rows
    full_engine = FullEngine(setup, request, analysis.joint_request, analysis.owner, rows)
    mean_draws = truth.mean_draw()
    estimate_differences, u_differences, noise_effect = [], [], None
    for trial_draws in (mean_draws, *_comparison_draws(truth)):
        draws = replace(
            trial_draws, white_noise=mean_draws.white_noise, noise_levels=mean_draws.noise_levels
        )
        full_results = full_engine.run_trials(draws, np.random.default_rng(0))
        linear_results = engine.run_trials(
            replace(draws, white_noise=np.zeros(1)), np.random.default_rng(0)
        )
        if noise_effect is None:
            # The two-stage engine is exact at the mean true values.
            fitted_estimate = full_results.estimate
            if isinstance(request, JointRequest):
                fitted_estimate = _fit_estimate(setup, truth, request, draws, rows)
            noise_effect = fitted_estimate - linear_results.estimate
        difference = (
            full_results.estimate - noise_effect - linear_results.estimate
        ) / linear_results.u
        estimate_differences.append(float(np.abs(difference[list(linear_engine.rows)]).max()))
        u_differences.append(
            float(np.abs(full_results.u / linear_results.u - 1.0)[list(linear_engine.rows)].max())
        )
    if max(estimate_differences) > _MAX_ESTIMATE_DIFFERENCE:
        return [
            "the analysis is not linear: the estimates from full records differ by "
            f"{max(estimate_differences):.2g} u"
        ]
    if max(u_differences) > _MAX_U_DIFFERENCE:
        return [
            "the analysis is not linear: u from full records differs by "
            f"{100 * max(u_differences):.1f} %"
        ]
    return []


def _fit_estimate(
    setup: SimulationSetup,
    truth: StudyTruth,
    request: JointRequest,
    draws: Draws,
    rows: Sequence[int],
) -> Array:
    """Return the estimates of a single fit including nominal values, shape (c, 1)."""
    records = TrialRecords.from_draws(setup, draws, np.random.default_rng(0))
    estimate = fit_records(records, request, truth).estimate
    nominal_values = [request.model.unknowns[row].nominal for row in rows]
    return np.asarray(estimate[list(rows), None] + np.array(nominal_values)[:, None])


def _comparison_draws(truth: StudyTruth) -> list[Draws]:
    """Return the random trials that are compared with full records."""
    draws = truth.draw(np.random.default_rng(2), _N_COMPARED_TRIALS)
    return [draws.select_trial(trial) for trial in range(_N_COMPARED_TRIALS)]


def _find_residual_obstacles(
    setup: SimulationSetup, truth: StudyTruth, analysis: Analysis, request: TwoStageRequest
) -> list[str]:
    """Return the obstacle to sigma from residuals if they contain non-parabolic errors."""
    if request.sigma is not None:
        return []
    max_rms = max(
        float(np.std(parabola.residuals))
        for draws in (truth.mean_draw(), *_comparison_draws(truth))
        for parabola in noise_free_second_stage(
            setup, truth, request, analysis.owner, draws
        ).parabolas
    )
    if max_rms <= _MAX_RESIDUAL_RMS * _min_white_noise(truth):
        return []
    return [
        "sigma is estimated from the residuals, and the residuals contain non-parabolic errors "
        f"of up to {max_rms:.1e} m"
    ]


def find_two_stage_obstacles(
    setup: SimulationSetup, truth: StudyTruth, request: TwoStageRequest
) -> list[str]:
    """Return the obstacles to the linear engine for the two-stage method; empty if valid."""
    obstacles = _find_common_obstacles(setup, truth)
    if setup.noise["acceleration"] > 0.0:
        obstacles.append("the accelerometer's noise is not white in displacement")
    if request.random_walk is None:
        obstacles.append("the noise of the accelerometer must be estimated")
    elif request.random_walk > 0.0:
        obstacles.append("the noise assumed in the analysis is not white in displacement")
    max_speed = setup.radius * max(abs(spindle.rate) for spindle in setup.spindles)
    if request.timing * max_speed > _MAX_NEGLECTED_NOISE * _min_white_noise(truth):
        obstacles.append("the time-stamp jitter assumed in the analysis is not negligible")
    return obstacles


def find_joint_obstacles(
    setup: SimulationSetup, truth: StudyTruth, request: JointRequest
) -> list[str]:
    """Return the obstacles to the linear engine for the joint fit; empty if it is valid."""
    obstacles = _find_common_obstacles(setup, truth)
    if truth.varies(DRIFT, RIPPLE_RATIO, RIPPLE_AMPLITUDE, RIPPLE_PHASE):
        obstacles.append("the rotation varies, so the weights of all samples vary too")
    assumed_noise = {name: replace(noise, covariance=()) for name, noise in request.noise.items()}
    if any(noise.has_bias_instability for noise in assumed_noise.values()):
        obstacles.append("the noise assumed in the analysis includes drift")
    if any(noise.to_estimate for noise in assumed_noise.values()):
        obstacles.append(
            "the noise is estimated, which makes the estimates of the coefficients nonlinear"
        )
        return obstacles
    true_noise = {name: setup.true_noise(name) for name in assumed_noise}
    if true_noise == assumed_noise and not truth.varies(WHITE_NOISE):
        return obstacles
    if any(noise.random_walk for noise in (*true_noise.values(), *assumed_noise.values())):
        obstacles.append(
            "the true noise is not white, or it differs from the noise assumed in the analysis"
        )
    is_displacement = set(setup.observables.values()) == {"displacement"}
    if len(set(assumed_noise.values())) > 1 or not is_displacement:
        obstacles.append("the noise assumed for the accelerometers differs from the true noise")
    return obstacles


def _find_common_obstacles(setup: SimulationSetup, truth: StudyTruth) -> list[str]:
    obstacles = (
        ["the bias drifts, and only full records can simulate this drift"]
        if any(setup.noise[key] > 0.0 for key in BIAS_COMPONENTS_BY_KEY)
        else []
    )
    if not setup.has_angle:
        obstacles.append("no angle is recorded, so the rotation must be estimated")
    other_levels = NOISE_LEVEL_UNITS.keys() - {WHITE_NOISE}
    varied_levels = [
        quantity.symbol for quantity in truth.varied_quantities if quantity.symbol in other_levels
    ]
    if varied_levels:
        obstacles.append(
            f"{', '.join(varied_levels)} varies, and only full records can simulate this variation"
        )
    if setup.noise["quantisation"] > 0.0:
        obstacles.append("quantisation noise is not Gaussian")
    max_rate = max(abs(spindle.rate) for spindle in setup.spindles)
    for observable in sorted(set(setup.observables.values())):
        is_displacement = observable == "displacement"
        white_noise = _min_white_noise(truth) if is_displacement else setup.noise[observable]
        if white_noise <= 0.0:
            obstacles.append("the description contains no white noise")
        # Each integration fewer is a derivative more.
        amplitude = setup.radius * max_rate ** (2 - observation.ORDERS[observable])
        for output_noise, column in (
            (amplitude * setup.noise["angle"], "angle"),
            (amplitude * max_rate * setup.noise["timing"], "time"),
        ):
            if output_noise > _MAX_NEGLECTED_NOISE * white_noise:
                obstacles.append(f"the noise of the recorded {column} is not negligible")
    return obstacles


def _min_white_noise(truth: StudyTruth) -> float:
    """Return the smallest white noise of the trials."""
    if not any(quantity.symbol == WHITE_NOISE for quantity in truth.varied_quantities):
        return truth.white_noise
    draws = truth.draw(np.random.default_rng(0), 256)
    return float(draws.white_noise.min())
