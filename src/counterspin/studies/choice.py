"""Competing analyses of a study, and the engine of each analysis.

The linear engine is valid under conditions. Each reason against it is a sentence.
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
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.joint.unknowns import RIPPLE, Unknown, Unknowns
from counterspin.inference.two_stage.model import TwoStageRequest
from counterspin.physics import observation
from counterspin.studies.description import StudyDescription
from counterspin.studies.draws import (
    DRIFT,
    NOISE_LEVELS,
    RIPPLE_AMPLITUDE,
    RIPPLE_PHASE,
    RIPPLE_RATIO,
    WHITE,
    Draws,
    StudyTruth,
)
from counterspin.studies.linear import (
    JointEngine,
    TwoStageEngine,
    bounds,
    fit_records,
    second_stage_without_noise,
)
from counterspin.studies.result import Driver, Tally
from counterspin.studies.whole_trials import FullEngine, TrialReadings, TrialRecords
from counterspin.studies.work import (
    Cost,
    EnginePart,
    JointRequest,
    ReportedCoefficient,
    StudyEngine,
)
from counterspin.studies.world import World, world_of

#: What the linear engine is called in a result.
_WORDS: Final = "linear"

EngineName = Literal["auto", "linear", "full"]


@frozen
class Analysis:
    """One of the competing analyses."""

    name: str  #: As the study calls it.
    owner: str  #: The accelerometer of a two-stage analysis; empty for the joint fit of all.
    request: TwoStageRequest | JointRequest  #: Options of the method.
    #: The joint fit of the same campaign, which estimates noise that is not stated.
    joint: JointRequest


def analyses_of(study: StudyDescription) -> tuple[Analysis, ...]:
    """Return the competing analyses: a two-stage analysis counts once for each accelerometer."""
    analyses = []
    for described in study.analyses:
        name, options, campaign = described.name, described.two_stage, described.campaign
        problem = JointProblem(campaign)
        joint = JointRequest(problem.model, problem.noise)
        if options is None:
            analyses.append(Analysis(name, "", joint, joint))
            continue
        if campaign.angle is None:
            raise NotIdentifiableError(
                f"{name}: a study of the two-stage method needs a recorded angle ([records] "
                "angle); without it study the joint fit alone ([study.analyses])"
            )
        for owner, accelerometer in campaign.accelerometers.items():
            request = make_request(problem, accelerometer, options)
            analyses.append(Analysis(name, owner, request, joint))
    return tuple(analyses)


def prepare(study: StudyDescription, seed: int, engine: EngineName = "auto") -> StudyEngine:
    """Choose and prepare an engine for each analysis of a study."""
    campaign = study.campaign
    truth = StudyTruth.of(campaign, study.varying)
    # Readings alone need no records, and so no world of them.
    read = campaign.readings or campaign.posed
    world = world_of(campaign) if campaign.runs or not read else None
    parts = []
    for analysis in analyses_of(study):
        if read:
            parts.append(_with_readings(campaign, world, truth, analysis, engine))
        else:
            assert world is not None
            parts.append(choose_engine(world, truth, analysis, engine))
        if not parts[-1].reported:
            raise NotIdentifiableError(f"{analysis.name}: the records determine no coefficient")
    return StudyEngine(truth, seed, tuple(parts), Tally(_drivers(truth)))


def _drivers(truth: StudyTruth) -> tuple[Driver, ...]:
    """Return the quantities against which the bias is shown: drift and ripple, if they vary."""
    drivers = []
    if truth.varies(DRIFT):
        drivers.append(Driver(DRIFT, *truth.bounds(DRIFT, 0)))
    if truth.varies(RIPPLE_RATIO, RIPPLE_AMPLITUDE):
        largest = max(map(abs, truth.bounds(RIPPLE_RATIO, 0)))
        drivers.append(Driver(RIPPLE_RATIO, 0.0, largest))
    return tuple(drivers)


def choose_engine(
    world: World, truth: StudyTruth, analysis: Analysis, engine: EngineName
) -> EnginePart:
    """Return the fastest engine that is valid for an analysis, or the requested engine."""
    if engine == "full":
        return _full(world, truth, analysis, "full records")
    request = analysis.request
    against = (
        against_joint(world, truth, request)
        if isinstance(request, JointRequest)
        else against_strobes(world, truth, request)
    )
    part = None if against else _linear(world, truth, analysis)
    if part is not None:
        against = _departures(world, truth, analysis, part)
    if against and engine == "linear":
        raise NotIdentifiableError(
            f'{analysis.name}: `engine="linear"` is not valid here: {"; ".join(against)}; '
            'use `engine="full"`, or omit `engine`'
        )
    if against or part is None:
        return _full(world, truth, analysis, f"full records ({against[0]})")
    return part


def _with_readings(
    campaign: Campaign,
    world: World | None,
    truth: StudyTruth,
    analysis: Analysis,
    engine: EngineName,
) -> EnginePart:
    """Return the engine of a campaign with readings, with or without records."""
    if engine == "linear":
        raise NotIdentifiableError(
            f'{analysis.name}: `engine="linear"` is not valid here: there are readings; '
            'use `engine="full"`, or omit `engine`'
        )
    try:
        readings = TrialReadings.of(campaign)
    except ValueError as error:
        raise NotIdentifiableError(f"{analysis.name}: {error}") from error
    words = "readings" if world is None else "full records and readings"
    return _full_joint(world, truth, analysis, analysis.joint, words, readings)


def _linear(world: World, truth: StudyTruth, analysis: Analysis) -> EnginePart:
    request = analysis.request
    if isinstance(request, JointRequest):
        return _joint(world, truth, analysis, request)
    made = TwoStageEngine.prepare(world, truth, request, analysis.owner)
    cost: Cost = "sampled" if request.sigma is None else "linear"
    rows, reported = _reported_unknowns(world, truth, analysis, request)
    return EnginePart(made, cost, _stream(world, analysis), _WORDS, rows, reported)


def _stream(world: World, analysis: Analysis) -> int:
    """Return a stream that two-stage analyses of one accelerometer share, and joint ones too."""
    names = list(world.mountings)
    return names.index(analysis.owner) if analysis.owner else len(names)


def _joint(
    world: World, truth: StudyTruth, analysis: Analysis, request: JointRequest
) -> EnginePart:
    made, lost = JointEngine.prepare(world, request, truth)
    least = bounds(truth, request.model, world)
    reported = _reported(analysis, [request.model.unknowns[place] for place in made.rows], least)
    rows, noise = tuple(range(len(reported))), _stream(world, analysis)
    return EnginePart(made, "linear", noise, _WORDS, rows, reported, lost)


def _full(world: World, truth: StudyTruth, analysis: Analysis, words: str) -> EnginePart:
    request = analysis.request
    if isinstance(request, JointRequest):
        return _full_joint(world, truth, analysis, request, words)
    rows, reported = _reported_unknowns(world, truth, analysis, request)
    made = FullEngine(world, request, analysis.joint, analysis.owner)
    return EnginePart(made, "full", _stream(world, analysis), words, rows, reported)


def _full_joint(
    world: World | None,
    truth: StudyTruth,
    analysis: Analysis,
    request: JointRequest,
    words: str,
    readings: TrialReadings | None = None,
) -> EnginePart:
    known = () if readings is None else readings.with_true_noise
    least = bounds(truth, request.model, world, known)
    unknowns = request.model.unknowns
    kept = tuple(place for place in request.reported if unknowns[place].name in least)
    lost = tuple(unknowns[place].name for place in request.reported if place not in kept)
    return EnginePart(
        engine=FullEngine(world, request, request, rows=kept, readings=readings),
        cost="readings" if world is None else "full",
        noise=0 if world is None or readings is not None else _stream(world, analysis),
        words=words,
        rows=tuple(range(len(kept))),
        reported=_reported(analysis, [unknowns[place] for place in kept], least),
        lost=lost,
    )


def _reported_unknowns(
    world: World, truth: StudyTruth, analysis: Analysis, request: TwoStageRequest
) -> tuple[tuple[int, ...], tuple[ReportedCoefficient, ...]]:
    """Return the reported unknowns of a two-stage analysis: all except the printed ripple."""
    symbols = list(request.unknowns)
    rows = tuple(row for row, symbol in enumerate(symbols) if symbol != RIPPLE)
    unknowns = [
        Unknown(analysis.owner, symbol, request.unknowns[symbol], request.limit_of(symbol))
        for symbol in (symbols[row] for row in rows)
    ]
    return rows, _reported(analysis, unknowns, bounds(truth, Unknowns(tuple(unknowns)), world))


def _reported(
    analysis: Analysis, unknowns: Sequence[Unknown], least: Mapping[str, float]
) -> tuple[ReportedCoefficient, ...]:
    return tuple(
        ReportedCoefficient(analysis.name, unknown.owner, unknown.symbol, least.get(unknown.name))
        for unknown in unknowns
    )


#: Largest noise of angle and time that is neglected, in parts of the displacement noise.
_LARGEST_OTHER_NOISE: Final = 0.01

#: Largest rms of what is no parabola in the residuals of strobes, in parts of the noise.
_LARGEST_REMAINDER: Final = 0.1

#: Trials whose true values are drawn, and compared with whole records.
_COMPARED: Final = 2

#: Largest difference that is allowed, in parts of u, and of u itself, relative. Such a bias lowers
#: a coverage of 95 % by 0.1 %, such a u changes it by 0.2 %.
_LARGEST_DEPARTURE: Final = 0.1
_LARGEST_CHANGE_OF_U: Final = 0.01


def _departures(world: World, truth: StudyTruth, analysis: Analysis, part: EnginePart) -> list[str]:
    """Return the reason against linear trials if whole records differ from them.

    The compared records have noise, which outlier rejection and other checks of residuals need.
    Its effect on the estimate is the same in all trials. For the joint fit, a single fit without
    rejection finds it at the mean true values.
    """
    request, engine = analysis.request, part.engine
    rows: tuple[int, ...] = ()
    if isinstance(request, TwoStageRequest):
        assert isinstance(engine, TwoStageEngine)
        reason = _against_residuals(world, truth, analysis, request)
        if reason:
            return reason
        sigma = request.sigma or truth.white
        request, engine = replace(request, sigma=sigma), replace(engine, sigma=sigma)
    else:
        assert isinstance(engine, JointEngine)
        rows = engine.rows
    full = FullEngine(world, request, analysis.joint, analysis.owner, rows)
    middle = truth.middle()
    departures, changes, noise = [], [], None
    for true in (middle, *_compared(truth)):
        draws = replace(true, white=middle.white, noise=middle.noise)
        slow = full.trials(draws, np.random.default_rng(0))
        fast = engine.trials(replace(draws, white=np.zeros(1)), np.random.default_rng(0))
        if noise is None:
            # The two-stage engine is exact at the mean true values.
            fitted = slow.estimate
            if isinstance(request, JointRequest):
                fitted = _fit_estimate(world, truth, request, draws, rows)
            noise = fitted - fast.estimate
        difference = (slow.estimate - noise - fast.estimate) / fast.u
        departures.append(float(np.abs(difference[list(part.rows)]).max()))
        changes.append(float(np.abs(slow.u / fast.u - 1.0)[list(part.rows)].max()))
    if max(departures) > _LARGEST_DEPARTURE:
        return [f"the analysis is not linear: whole records differ by {max(departures):.2g} u"]
    if max(changes) > _LARGEST_CHANGE_OF_U:
        return [f"the analysis is not linear: u of whole records differs by {max(changes):.1%}"]
    return []


def _fit_estimate(
    world: World, truth: StudyTruth, request: JointRequest, draws: Draws, rows: Sequence[int]
) -> Array:
    """Return the estimates of a single fit, nominal values added, shape (c, 1)."""
    records = TrialRecords.of(world, draws, np.random.default_rng(0))
    estimate = fit_records(records, request, truth).estimate
    nominal = [request.model.unknowns[row].nominal for row in rows]
    return np.asarray(estimate[list(rows), None] + np.array(nominal)[:, None])


def _compared(truth: StudyTruth) -> list[Draws]:
    """Return the drawn trials that are compared with whole records."""
    drawn = truth.draw(np.random.default_rng(2), _COMPARED)
    return [drawn.take(trial) for trial in range(_COMPARED)]


def _against_residuals(
    world: World, truth: StudyTruth, analysis: Analysis, request: TwoStageRequest
) -> list[str]:
    """Return the reason against sigma from residuals of strobes that are no parabola."""
    if request.sigma is not None:
        return []
    largest = max(
        float(np.std(parabola.residuals))
        for draws in (truth.middle(), *_compared(truth))
        for parabola in second_stage_without_noise(
            world, truth, request, analysis.owner, draws
        ).parabolas
    )
    if largest <= _LARGEST_REMAINDER * _white(truth):
        return []
    return [
        "sigma is estimated from residuals, which contain non-parabolic errors up to "
        f"{largest:.1e} m"
    ]


def against_strobes(world: World, truth: StudyTruth, request: TwoStageRequest) -> list[str]:
    """Return the reasons against the linear engine for the two-stage method; empty if valid."""
    reasons = _against(world, truth)
    if world.noise.random_walk > 0.0:
        reasons.append("the accelerometer's noise is not white in displacement")
    if request.random_walk is None:
        reasons.append("the accelerometer's noise has to be estimated")
    elif request.random_walk > 0.0:
        reasons.append("the noise that the analysis assumes is not white in displacement")
    speed = world.radius * max(abs(spindle.rate) for spindle in world.spindles)
    if request.timing * speed > _LARGEST_OTHER_NOISE * _white(truth):
        reasons.append("the noise of the recorded time that the analysis assumes is not negligible")
    return reasons


def against_joint(world: World, truth: StudyTruth, request: JointRequest) -> list[str]:
    """Return the reasons against the linear engine for the joint fit; empty if it is valid."""
    reasons = _against(world, truth)
    if truth.varies(DRIFT, RIPPLE_RATIO, RIPPLE_AMPLITUDE, RIPPLE_PHASE):
        reasons.append("the rotation varies, and with it the weights of every sample")
    given = {name: replace(noise, covariance=()) for name, noise in request.noise.items()}
    if any(noise.has_bias_instability for noise in given.values()):
        reasons.append("the noise that the analysis assumes wanders")
    if any(noise.to_estimate for noise in given.values()):
        reasons.append("the noise is estimated, so that the estimate is not linear")
        return reasons
    true = {name: world.noise_of(name) for name in given}
    if true == given and not truth.varies(WHITE):
        return reasons
    if any(noise.random_walk for noise in (*true.values(), *given.values())):
        reasons.append(
            "the true noise is neither white nor equal to the noise that the analysis assumes"
        )
    displacement = set(world.observables.values()) == {"displacement"}
    if len(set(given.values())) > 1 or not displacement:
        reasons.append("the accelerometers' assumed noises differ from the true one")
    return reasons


def _against(world: World, truth: StudyTruth) -> list[str]:
    reasons = (
        ["the bias wanders, which only complete records simulate"] if world.noise.wanders else []
    )
    if not world.angle_recorded:
        reasons.append("no angle is recorded, and the rotation has to be estimated")
    other_levels = NOISE_LEVELS.keys() - {WHITE}
    varying = [quantity.symbol for quantity in truth.varying if quantity.symbol in other_levels]
    if varying:
        reasons.append(f"{', '.join(varying)} varies, which only complete records simulate")
    if world.noise.quantisation > 0.0:
        reasons.append("quantisation is not Gaussian")
    fastest = max(abs(spindle.rate) for spindle in world.spindles)
    for observable in sorted(set(world.observables.values())):
        displaced = observable == "displacement"
        white = _white(truth) if displaced else world.noise.white_of(observable)
        if white <= 0.0:
            reasons.append("there is no white noise")
        # A derivative more with each integration less.
        amplitude = world.radius * fastest ** (2 - observation.ORDERS[observable])
        for size, words in (
            (amplitude * world.noise.angle, "angle"),
            (amplitude * fastest * world.noise.timing, "time"),
        ):
            if size > _LARGEST_OTHER_NOISE * white:
                reasons.append(f"the noise of the recorded {words} is not negligible")
    return reasons


def _white(truth: StudyTruth) -> float:
    """Return the smallest white noise that matters."""
    varying = [quantity for quantity in truth.varying if quantity.symbol == WHITE]
    if not varying:
        return truth.white
    draws = truth.draw(np.random.default_rng(0), 256)
    return float(draws.white.min())
