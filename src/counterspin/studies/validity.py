"""What competes in a study, and where shortcuts hold: each reason against one is a sentence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.two_stage import request_of
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.joint.series import TIMING
from counterspin.inference.joint.unknowns import RIPPLE, ROTATION, Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.inference.two_stage.model import TwoStageRequest
from counterspin.physics import observation
from counterspin.physics.terms import OWN_TERMS, PLATFORM_TERMS, term
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
from counterspin.studies.strobed_effects import obstacle
from counterspin.studies.world import World


@frozen
class JointRequest:
    """What is asked of the joint fit."""

    model: Unknowns  #: Unknowns, considered terms, uncertain inputs.
    noise: Mapping[str, Noise]  #: Accelerometer -> its noise, given or to be estimated.

    @property
    def reported(self) -> list[int]:
        """Places of the unknowns that a study reports: those asked for that the runs share."""
        return [
            place
            for place, unknown in enumerate(self.model.unknowns)
            if unknown.asked
            and not (unknown.unstated and unknown.prior[1] >= unknown.limit)
            and (
                unknown.symbol in OWN_TERMS
                or (not unknown.owner and unknown.symbol not in ROTATION)
            )
        ]


@frozen
class Analysis:
    """One competitor."""

    name: str  #: As the study calls it.
    owner: str  #: The accelerometer of a two-stage analysis; empty for the joint fit of all.
    request: TwoStageRequest | JointRequest  #: What is asked of the method.
    #: The joint fit of the same campaign, which finds the noise that nobody states.
    joint: JointRequest


def analyses_of(study: StudyDescription) -> tuple[Analysis, ...]:
    """Return what competes: a two-stage analysis is one for each accelerometer."""
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
            request = request_of(problem, accelerometer, options)
            analyses.append(Analysis(name, owner, request, joint))
    return tuple(analyses)


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
    """Return why the two-stage method's sufficient statistics do not serve; empty if they do."""
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
    asked = [s for s in (*request.unknowns, *request.considered) if s != RIPPLE]
    symbols = [s for o, many in truth.symbols.items() if o in ("", owner) for s in many]
    for symbol in sorted({*symbols, *asked}):
        if why := obstacle(symbol):
            reasons.append(f"{symbol} {why}")
    if request.sigma is None and not reasons:
        left = _left_by_the_parabola(world, truth, owner)
        if left > _LARGEST_ERROR * _white(truth):
            reasons.append(
                "sigma is taken from residuals in which errors that are no parabola reach "
                f"{left:.1e} m"
            )
    return reasons


def against_joint(world: World, truth: StudyTruth, request: JointRequest) -> list[str]:
    """Return why the joint fit's sufficient statistics do not serve; empty if they do."""
    reasons = _against(world, truth)
    if truth.varies(DRIFT, RIPPLE_RATIO, RIPPLE_AMPLITUDE, RIPPLE_PHASE):
        reasons.append("the rotation varies, and with it the weights of every sample")
    given = list(request.noise.values())
    if any(noise.wanders for noise in given):
        reasons.append("the noise that the analysis assumes wanders")
    if any(noise.wanted for noise in given):
        reasons.append("the noise is estimated, so that the estimate is not linear")
        return reasons
    assumed = {(noise.white, noise.random_walk) for noise in given}
    if len(assumed) > 1 and (truth.varies(WHITE) or {w for w, _ in assumed} != {truth.white}):
        reasons.append("the accelerometers' assumed noises differ from the true one")
    walks = {walk for _, walk in assumed}
    right = not truth.varies(WHITE) and assumed == {(truth.white, world.noise.random_walk)}
    if not right and (walks != {0.0} or world.noise.random_walk > 0.0):
        reasons.append("the true noise is neither white nor what the analysis assumes")
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
    other = [quantity.symbol for quantity in truth.varying if quantity.symbol in other_levels]
    if other:
        reasons.append(f"{', '.join(other)} varies, which only complete records simulate")
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
    """Return which inputs are so far from what is stated that their squares count."""
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
    """Return what the square of the platform's attitude error adds to the displacement, m."""
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
                "drift": duration,
                "g_sensitivity": duration if vertical else speed / world.site.gravity,
                "g2_sensitivity": duration * (1.0 + force**2),
                "compliance": force,
            }[turn.kind]
            turned += max(reach) * grows
        worst = max(worst, 0.25 * world.site.gravity * turned**2 * duration**2)
    return worst


def _left_by_the_parabola(world: World, truth: StudyTruth, owner: str) -> float:
    """Return the rms of what true errors leave in the strobes' residuals at most, m."""
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
            worst = max(worst, _rms_beside_parabola(times, columns @ sizes))
    return worst


def _size(values: Array, key: tuple[str, str], run: int) -> float:
    return float(of_run(values, run)[0]) - nominal(*key)


def _rms_beside_parabola(times: Array, error: Array) -> float:
    scaled = np.vander(times / float(np.ptp(times)), 3)
    left = error - scaled @ np.linalg.lstsq(scaled, error, rcond=None)[0]
    return math.sqrt(float(np.mean(left**2)))
