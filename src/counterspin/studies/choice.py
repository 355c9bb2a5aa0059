"""Competing analyses of a study, and the engine of each analysis.

Shortcuts apply under conditions: each reason against a shortcut is a sentence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.two_stage.method import make_request
from counterspin.campaign.description import Campaign
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.joint.series import TIMING
from counterspin.inference.joint.unknowns import RIPPLE, Unknown, Unknowns
from counterspin.inference.two_stage.model import TwoStageRequest
from counterspin.physics import observation
from counterspin.physics.terms import PLATFORM_TERMS, term
from counterspin.studies.description import StudyDescription
from counterspin.studies.draws import (
    DRIFT,
    NOISE_LEVELS,
    RIPPLE_AMPLITUDE,
    RIPPLE_PHASE,
    RIPPLE_RATIO,
    WHITE,
    StudyTruth,
    nominal,
    of_run,
)
from counterspin.studies.result import Driver, Tally
from counterspin.studies.shortcuts import JointEngine, TwoStageEngine, bounds, changes_by_inputs
from counterspin.studies.strobed_effects import Surrogate, box_of, obstacle
from counterspin.studies.whole_trials import FullEngine, TrialReadings
from counterspin.studies.work import (
    Cost,
    EnginePart,
    JointRequest,
    ReportedCoefficient,
    StudyEngine,
)
from counterspin.studies.world import World, world_of

EngineName = Literal["auto", "surrogate", "exact", "full"]

#: Largest share of draws outside its box with which a surrogate is worth having.
_LARGEST_SHARE_OUTSIDE: Final = 0.5


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
    """Return the fastest engine that is valid for an analysis, or the one asked for."""
    request = analysis.request
    against = (
        against_joint(world, truth, request)
        if isinstance(request, JointRequest)
        else against_strobes(world, truth, request, analysis.owner)
    )
    if against and engine in ("surrogate", "exact"):
        raise NotIdentifiableError(
            f'{analysis.name}: `engine="{engine}"` is not valid here: {"; ".join(against)}; '
            'use `engine="full"`, or omit `engine`'
        )
    if against and engine == "auto":
        return _full(world, truth, analysis, f"full records ({against[0]})")
    if engine == "full":
        return _full(world, truth, analysis, "full records")
    if isinstance(request, JointRequest):
        return _joint(world, truth, analysis, request)
    return _two_stage(world, truth, analysis, request, engine)


def _with_readings(
    campaign: Campaign,
    world: World | None,
    truth: StudyTruth,
    analysis: Analysis,
    engine: EngineName,
) -> EnginePart:
    """Return the engine of a campaign with readings, with or without records."""
    if engine in ("surrogate", "exact"):
        raise NotIdentifiableError(
            f'{analysis.name}: `engine="{engine}"` is not valid here: there are readings; '
            'use `engine="full"`, or omit `engine`'
        )
    try:
        readings = TrialReadings.of(campaign)
    except ValueError as error:
        raise NotIdentifiableError(f"{analysis.name}: {error}") from error
    words = "readings" if world is None else "full records and readings"
    return _full_joint(world, truth, analysis, analysis.joint, words, readings)


def _two_stage(
    world: World,
    truth: StudyTruth,
    analysis: Analysis,
    request: TwoStageRequest,
    engine: EngineName,
) -> EnginePart:
    motions = tuple(world.strobed(run, analysis.owner) for run in range(len(world.runs)))
    true = tuple(
        (owner, symbol)
        for owner, symbols in truth.symbols.items()
        if owner in ("", analysis.owner)
        for symbol in symbols
    )
    terms = [s for s in (*request.unknowns, *request.considered) if s != RIPPLE]
    symbols = tuple(dict.fromkeys([*(symbol for _, symbol in true), *terms]))
    surrogates: tuple[Surrogate, ...] | None = None
    cost: Cost
    cost, words = "exact", "sufficient statistics, exact quadrature"
    if engine != "exact":
        boxes = [box_of(motion, truth.small_bounds(run)) for run, motion in enumerate(motions)]
        fitted = tuple(
            Surrogate.fit(motion, symbols, box) for motion, box in zip(motions, boxes, strict=True)
        )
        outside = _share_outside(truth, fitted)
        if engine == "surrogate" or outside < _LARGEST_SHARE_OUTSIDE:
            surrogates = fitted
            cost, words = (
                "sampled" if request.sigma is None else "constant",
                "sufficient statistics",
            )
            if any(box.varies.size for box in boxes):
                error = max(surrogate.error for surrogate in fitted)
                cost = "surrogate"
                words += f", surrogate of degree 4 (error {error:.0e})"
            if outside:
                cost = "exact" if outside > 0.05 else cost
                words += f", exact quadrature for the {100.0 * outside:.2g} % outside its box"
    inputs = changes_by_inputs(world, truth, analysis.owner, symbols)
    made = TwoStageEngine(request, analysis.owner, motions, symbols, true, surrogates, inputs)
    rows, reported = _reported_unknowns(world, truth, analysis, request)
    return EnginePart(made, cost, _stream(world, analysis), words, rows, reported)


def _stream(world: World, analysis: Analysis) -> int:
    """Return a stream that two-stage analyses of one accelerometer share, and joint ones too."""
    names = list(world.mountings)
    return names.index(analysis.owner) if analysis.owner else len(names)


def _share_outside(truth: StudyTruth, surrogates: Sequence[Surrogate]) -> float:
    """Return the share of trials in which some run lies outside its surrogate's box."""
    draws = truth.draw(np.random.default_rng(1), 2000)
    inside = np.ones(draws.trials, dtype=bool)
    for run, surrogate in enumerate(surrogates):
        inside &= surrogate.holds(draws.small(run))
    return 1.0 - float(inside.mean())


def _joint(
    world: World, truth: StudyTruth, analysis: Analysis, request: JointRequest
) -> EnginePart:
    series = [
        world.series(run, name, truth.spindles[run])
        for run in range(len(world.runs))
        for name in world.mountings
    ]
    made, lost = JointEngine.prepare(series, request, truth)
    least = bounds(truth, request.model, world)
    reported = _reported(analysis, [request.model.unknowns[place] for place in made.rows], least)
    rows, noise = tuple(range(len(reported))), _stream(world, analysis)
    return EnginePart(made, "constant", noise, "sufficient statistics", rows, reported, lost)


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

#: Largest error of an input, in parts of itself, of the delay in rad: what it does is taken as
#: linear, which is off by six times as much of it at most (t^3 of a clock, R^3 of a radius).
_LARGEST_PART: Final = 1e-3

#: Largest error of second order, and largest one left in the residuals of a parabola, likewise.
_LARGEST_ERROR: Final = 0.1


def against_strobes(
    world: World, truth: StudyTruth, request: TwoStageRequest, owner: str
) -> list[str]:
    """Return the reasons against the two-stage method's sufficient statistics; empty if valid."""
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
    terms = [s for s in (*request.unknowns, *request.considered) if s != RIPPLE]
    symbols = [s for o, many in truth.symbols.items() if o in ("", owner) for s in many]
    for symbol in sorted({*symbols, *terms}):
        if why := obstacle(symbol):
            reasons.append(f"{symbol} {why}")
    if request.sigma is None and not reasons:
        residual = _largest_residual_rms(world, truth, owner)
        if residual > _LARGEST_ERROR * _white(truth):
            reasons.append(
                "sigma is estimated from residuals, which contain non-parabolic errors up to "
                f"{residual:.1e} m"
            )
    return reasons


def against_joint(world: World, truth: StudyTruth, request: JointRequest) -> list[str]:
    """Return the reasons against the joint fit's sufficient statistics; empty if they are valid."""
    reasons = _against(world, truth)
    if truth.varies(DRIFT, RIPPLE_RATIO, RIPPLE_AMPLITUDE, RIPPLE_PHASE):
        reasons.append("the rotation varies, and with it the weights of every sample")
    given = list(request.noise.values())
    if any(noise.has_bias_instability for noise in given):
        reasons.append("the noise that the analysis assumes wanders")
    if any(noise.to_estimate for noise in given):
        reasons.append("the noise is estimated, so that the estimate is not linear")
        return reasons
    assumed = {(noise.white, noise.random_walk) for noise in given}
    if len(assumed) > 1 and (truth.varies(WHITE) or {w for w, _ in assumed} != {truth.white}):
        reasons.append("the accelerometers' assumed noises differ from the true one")
    walks = {walk for _, walk in assumed}
    right = not truth.varies(WHITE) and assumed == {(truth.white, world.noise.random_walk)}
    if not right and (walks != {0.0} or world.noise.random_walk > 0.0):
        reasons.append(
            "the true noise is neither white nor equal to the noise that the analysis assumes"
        )
    return reasons


def _against(world: World, truth: StudyTruth) -> list[str]:
    reasons = (
        ["the bias wanders, which only complete records simulate"] if world.noise.wanders else []
    )
    white = _white(truth)
    reasons += _far_inputs(world, truth)
    if not world.angle_recorded:
        reasons.append("no angle is recorded, and the rotation has to be estimated")
    other_levels = NOISE_LEVELS.keys() - {WHITE}
    varying = [quantity.symbol for quantity in truth.varying if quantity.symbol in other_levels]
    if varying:
        reasons.append(f"{', '.join(varying)} varies, which only complete records simulate")
    if world.noise.quantisation > 0.0:
        reasons.append("quantisation is not Gaussian")
    if white <= 0.0:
        reasons.append("there is no white noise")
    speed = world.radius * max(abs(spindle.rate) for spindle in world.spindles)
    for size, words in (
        (world.radius * world.noise.angle, "angle"),
        (speed * world.noise.timing, "time"),
    ):
        if size > _LARGEST_OTHER_NOISE * white:
            reasons.append(f"the noise of the recorded {words} is not negligible")
    second = _second_order(world, truth)
    if second > _LARGEST_ERROR * white:
        reasons.append(f"the platform turns so far that second-order effects reach {second:.1e} m")
    return reasons


def _far_inputs(world: World, truth: StudyTruth) -> list[str]:
    """Return a reason for each input whose deviation is too large for first order."""
    fastest = max(abs(spindle.rate) for spindle in world.spindles)
    sizes = {"centrifuge.radius": world.radius, "site.gravity": world.site.gravity}
    sizes[TIMING] = 1.0 / fastest
    parts = {
        term(symbol).words: truth.reach_of_input((recorder, symbol)) / sizes.get(symbol, 1.0)
        for recorder, symbol in truth.moving_inputs
    }
    return [
        f"the {words} is up to {part:.1e} from what is stated, and squares of more than "
        f"{_LARGEST_PART:.0e} count"
        for words, part in parts.items()
        if part > _LARGEST_PART
    ]


def _white(truth: StudyTruth) -> float:
    """Return the smallest white noise that matters."""
    varying = [quantity for quantity in truth.varying if quantity.symbol == WHITE]
    if not varying:
        return truth.white
    draws = truth.draw(np.random.default_rng(0), 256)
    return float(draws.white.min())


def _second_order(world: World, truth: StudyTruth) -> float:
    """Return the displacement due to the square of the platform's attitude error, m."""
    worst = 0.0
    for run, duration in enumerate(world.durations):
        turned = 0.0
        speed = 2.0 * world.radius * abs(world.spindles[run].rate)
        for symbol, row in PLATFORM_TERMS.items():
            turn = row.effect
            reach = [abs(truth.mean("", symbol))]
            bounds = [varying.reach for varying in truth.varying if varying.symbol == symbol]
            reach += [max(map(abs, low_high)) for low_high in bounds]
            vertical = (
                turn.force_axis is not None and abs(world.attitudes[run][turn.force_axis][2]) > 1e-9
            )
            force = 1.0 if vertical else speed**2 / (4.0 * world.radius * world.site.gravity)
            grows = {
                "tilt": 1.0,
                "table": 1.0,
                "drift": duration,
                "g_sensitivity": duration if vertical else speed / world.site.gravity,
                "g2_sensitivity": duration * (1.0 + force**2),
                "compliance": force,
            }[turn.kind]
            turned += max(reach) * grows
        worst = max(worst, 0.25 * world.site.gravity * turned**2 * duration**2)
    return worst


def _largest_residual_rms(world: World, truth: StudyTruth, owner: str) -> float:
    """Return the largest rms of the true errors in the strobes' residuals, m."""
    draws = truth.draw(np.random.default_rng(2), 8)
    worst = 0.0
    for run in range(len(world.runs)):
        strobed = world.strobed(run, owner)
        for trial in range(draws.trials):
            single = draws.take(trial)
            spindle = single.spindle(world.spindles[run], run)
            motion = world.true_trajectory(run, spindle, single)
            times = spindle.time_at(strobed.angles)
            keys = [key for key in single.values if key[0] in ("", owner)]
            columns = observation.columns(
                motion,
                world.mountings[owner],
                [symbol for _, symbol in keys],
                times,
                attitude=world.attitudes[run],
            )
            sizes = np.array([_size(single.values[key], key, run) for key in keys])
            worst = max(worst, _rms_about_parabola(times, columns @ sizes))
    return worst


def _size(values: Array, key: tuple[str, str], run: int) -> float:
    return float(of_run(values, run)[0]) - nominal(*key)


def _rms_about_parabola(times: Array, error: Array) -> float:
    scaled = np.vander(times / float(np.ptp(times)), 3)
    residual = error - scaled @ np.linalg.lstsq(scaled, error, rcond=None)[0]
    return math.sqrt(float(np.mean(residual**2)))
