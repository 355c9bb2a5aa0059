"""Readings, and poses at unknown attitudes, as data of the joint fit.

The derivatives are taken at what readings and priors together say, and taken again there until it
settles. The readings become blocks of square-root information, which are solved together with the
blocks of records.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Final, TypeVar

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import ConvergenceError, NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.joint.fit import JointFit, solve_blocks
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.least_squares import Solution
from counterspin.inference.noise.model import Noise
from counterspin.physics.terms import HEAD_HARMONICS
from counterspin.readings.fitted import MIN_DOF, FittedReadings, evaluate_positions
from counterspin.readings.linear import LinearReadings, ReadingGroup

U = TypeVar("U", bound=Unknown)

#: Rounds in which derivatives and noise must settle; two or three are usual.
_ROUNDS: Final = 100

#: The same for the noise alone, which may approach zero slowly.
_NOISE_ROUNDS: Final = 200

#: Estimated noise is no smaller than this part of what the head's angle adds (rms), or the few
#: positions where the head adds nothing would be taken for exact. Enough repeats tell it.
_MIN_NOISE_TO_HEAD: Final = 0.3

#: Part of a standard uncertainty that is as good as none.
_CONSTRAINT_FACTOR: Final = 1e-6

#: Rounds in which an unknown goes all the way to where it is found.
_UNDAMPED_ROUNDS: Final = 15

#: How many times its largest credible size an unknown may have where derivatives are taken.
_MAX_LIMITS: Final = 10.0

#: Settled: nothing moves by more than this part of its uncertainty, no noise by this part.
_MAX_STEP: Final = 1e-5
_TOLERANCE: Final = 1e-6


@frozen
class ReadingsFit:
    """A solved problem with readings."""

    fit: JointFit  #: Of records, if there are any, and readings.
    groups: tuple[FittedReadings, ...]  #: The readings as they fit, in the order of the `Readings`.

    @property
    def solution(self) -> Solution:
        """Estimates less nominal."""
        return self.fit.solution


def solve_readings(
    readings: Sequence[ReadingGroup], model: Unknowns, records: JointFit | None = None
) -> ReadingsFit:
    """Estimate a model from readings, together with what records say.

    A requested parameter of a triad that the directions of its poses do not determine gets its
    default prior; the model of the fit says which.

    model: What is estimated and considered. Of the inputs radius, gravity and latitude count here.
    """
    first_fit = None
    for group in readings:
        if candidates := group.default_candidates(model):
            first_fit = _solve_or_constrain(
                readings, model.with_default_priors(candidates), records
            )
            undetermined_terms = group.undetermined(first_fit.fit, model, candidates)
            model = model.with_default_priors(undetermined_terms)
            break
    solved = _solve_or_constrain(readings, model, records, first_fit)
    return replace(solved, groups=tuple(group.evaluate(solved.fit) for group in solved.groups))


def _solve_or_constrain(
    readings: Sequence[ReadingGroup],
    model: Unknowns,
    records: JointFit | None,
    start: ReadingsFit | None = None,
) -> ReadingsFit:
    """Return the solved problem, with what hides the noise held where few readings tell both.

    start: A fit to begin with; None: the prior means, or the ellipsoid of the poses.
    """
    try:
        return _solve(readings, model, records, start)
    except NotIdentifiableError as error:
        set_by_hand = any(group.u is None and any(group.position) for group in readings)
        models = [
            candidate
            for candidate in _constrained_models(readings, model)
            if set_by_hand or candidate != model
        ]
        not_determined = error
    # Errors of positions that are hardly read twice hide the noise, and so do nuisance terms in few
    # readings or poses. The residuals show both together, which is an upper limit of the noise.
    without_settings = [group.without_setting_errors() for group in readings]
    for constrained in models:
        try:
            joint_noise = _solve(without_settings, constrained, records, start)
        except NotIdentifiableError as error:
            not_determined = error
        else:
            return _solve(readings, model, records, start, joint_noise)
    raise not_determined


def _linearization_point(
    estimate: Array,
    solution: Solution,
    prior_means: Array,
    limits: Array,
    max_deviation: Array,
    pose_indices: Sequence[int],
) -> Array:
    """Return where to take derivatives: what is not determined may be anything, and is no place.

    Nor is what is far beyond credible; the estimate may be, and is then found to be.

    Of a triad that is often a combination, such as a turn about the vertical: to leave out unknown
    by unknown would leave out the angles between its axes too. What is left of theirs is what the
    estimates are beside what is known, give or take the limits.

    max_deviation: Largest deviation of each unknown from its prior mean.
    pose_indices: Indices of the unknowns of a triad.
    """
    u = solution.u[: prior_means.size]
    point: Array = prior_means + np.clip(
        np.where(u < limits, estimate - prior_means, 0.0), -max_deviation, max_deviation
    )
    finite = [index for index in pose_indices if np.isfinite(u[index])]
    if (u < limits)[finite].all():
        return point
    scale = limits[finite]
    normalized = np.eye(len(finite)) + solution.covariance[np.ix_(finite, finite)] / np.outer(
        scale, scale
    )
    point[finite] = prior_means[finite] + scale * np.linalg.solve(
        normalized, (estimate - prior_means)[finite] / scale
    )
    return point


def _constrained_models(readings: Sequence[ReadingGroup], model: Unknowns) -> Iterator[Unknowns]:
    """Yield models that hold ever more terms that hide the noise of readings or poses without u.

    Of poses all nuisance terms are held. Of readings the waves of the dividing head that have
    default priors are held first, and then the accelerometer's terms that have default priors too.
    """
    without_u = [group for group in readings if group.u is None]
    pose_accelerometers = {name for group in without_u for name in group.triad}
    reading_accelerometers = {group.accelerometer for group in without_u if not group.triad}
    for owners in (set(), reading_accelerometers) if reading_accelerometers else (set(),):

        def held(other: U, owners: Collection[str] = owners) -> U:
            hides = other.owner in pose_accelerometers
            if other.has_default_prior and reading_accelerometers:
                hides |= other.owner in owners or other.symbol.startswith(HEAD_HARMONICS)
            if not hides or other.is_of_interest or math.isinf(other.prior[1]):
                return other
            return replace(other, prior=(other.prior[0], _CONSTRAINT_FACTOR * other.prior[1]))

        yield Unknowns(tuple(map(held, model.unknowns)), tuple(map(held, model.considered)))


def _solve(
    readings: Sequence[ReadingGroup],
    model: Unknowns,
    records: JointFit | None,
    start: ReadingsFit | None = None,
    joint_noise: ReadingsFit | None = None,
) -> ReadingsFit:
    """Return the solved problem, its groups not yet judged under the fit.

    start: As in `_solve_or_constrain`.
    joint_noise: Fit whose noise is used; None: the noise is estimated.
    """
    unknowns = [*model.unknowns, *model.considered]
    prior_means = np.array([unknown.prior_mean for unknown in unknowns])
    point = (
        prior_means
        if start is None
        else start.fit.solution_with_considered.estimate[: prior_means.size]
    )
    for group in readings if start is None else ():
        point = group.start(unknowns, point)
    limits = np.array([unknown.limit for unknown in unknowns])
    # One reading with the wrong sign drives what is known beforehand so far that nothing is linear.
    stated = np.array([math.isfinite(unknown.prior[1]) for unknown in unknowns])
    max_deviation = np.where(stated, _MAX_LIMITS * limits, np.inf)
    noise = [_initial_noise(group) for group in readings]
    if (known_noise := joint_noise or start) is not None:
        noise = [group.noise for group in known_noise.groups]
    # What is considered is in the residuals too. Noise and the point of the derivatives are found
    # beside it, as if it were estimated with its prior: else it would be taken for noise, and what
    # looks like it would leave its prior so far that derivatives there are not the machine's.
    variance = None
    is_single_group = records is None and len(readings) == 1
    free_count = sum(math.isinf(unknown.prior[1]) for unknown in unknowns) if is_single_group else 0
    pose_accelerometers = {name for group in readings for name in group.triad}
    pose_indices = [
        index for index, sd in enumerate(model.unknowns) if sd.owner in pose_accelerometers
    ]
    for count in range(_ROUNDS):
        parts = [group.linearize(model, point, variance) for group in readings]
        # The columns hold while only the noise is another.
        for _ in range(_NOISE_ROUNDS):
            weighted = [part.with_noise(size) for part, size in zip(parts, noise, strict=True)]
            fit, previous = _joint_fit(records, weighted, model), noise
            relaxed_parts = [
                part.with_considered_estimated(len(model.unknowns)) for part in weighted
            ]
            if joint_noise is not None:
                break
            noise = [
                _update_noise(
                    group,
                    part,
                    fit.solution_with_considered,
                    Unknowns(model.unknowns),
                    previous_noise,
                    free_count,
                )
                for group, part, previous_noise in zip(
                    readings, relaxed_parts, previous, strict=True
                )
            ]
            changes = (
                abs(updated / last_noise - 1.0)
                for updated, last_noise in zip(noise, previous, strict=True)
            )
            if max(changes) < _TOLERANCE:
                break
        solution = fit.solution_with_considered
        estimate, sd = solution.estimate[: prior_means.size], solution.u[: prior_means.size]
        index = _linearization_point(
            estimate, solution, prior_means, limits, max_deviation, pose_indices
        )
        variance = sd**2
        moves = np.abs(index - point) / np.where(sd > 0, sd, 1.0)
        # Positions that were set by hand may turn to and fro: then half of the way is taken.
        point = index if count < _UNDAMPED_ROUNDS else 0.5 * (point + index)
        if moves.max(initial=0.0) < _MAX_STEP:
            break
    else:
        for group in readings:
            if reason := group.divergence(_ROUNDS):
                raise ConvergenceError(reason)
        name = _largest_residual(readings, records, model)
        raise ConvergenceError(
            f"the fit of the readings did not converge in {_ROUNDS} rounds. Check the sign, "
            f'the digits and the unit of "{name}", which deviates most from the others, and '
            "whether this reading was swapped with another one. Otherwise, state priors for "
            "the machine terms, or state the standard uncertainties of the readings"
        )
    dof = [
        part.noise_dof(solution) + group.repeat_dof if group.u is None else math.inf
        for group, part in zip(readings, relaxed_parts, strict=True)
    ]
    if joint_noise is not None:
        dof = [group.noise_dof for group in joint_noise.groups]
    estimated_noise = {
        part.source: Noise(size)
        for group, part, size in zip(readings, parts, noise, strict=True)
        if group.u is None
    }
    fit = replace(fit, noise=estimated_noise)
    if records is not None:
        solution_with_walk = replace(
            fit.solution, covariance_undetected=records.solution.covariance_undetected
        )
        noises = {**records.noise, **estimated_noise}
        fit = replace(
            fit,
            solution=solution_with_walk,
            noise=noises,
            undetected_walks=records.undetected_walks,
        )
    groups = (
        FittedReadings(group, part, size, noise_dof)
        for group, part, size, noise_dof in zip(readings, parts, noise, dof, strict=True)
    )
    return ReadingsFit(fit, tuple(groups))


def _joint_fit(
    records: JointFit | None, weighted: Sequence[LinearReadings], model: Unknowns
) -> JointFit:
    """Return the fit of readings, with the noise that they have, beside the records of another."""
    reading_blocks, observations = (
        tuple(part.whitened_block() for part in weighted),
        tuple(weighted),
    )
    if records is None:
        return JointFit(
            model, solve_blocks(reading_blocks, model), observations, reading_blocks, {}
        )
    blocks = (*records.blocks[: len(records.design_blocks)], *reading_blocks)
    return JointFit(
        model, solve_blocks(blocks, model), (*records.design_blocks, *observations), blocks, {}
    )


def _largest_residual(
    readings: Sequence[ReadingGroup], records: JointFit | None, model: Unknowns
) -> str:
    """Return the name of the reading that is furthest off a fit with all that is known as it is."""
    prior_means = np.array(
        [parameter.prior_mean for parameter in (*model.unknowns, *model.considered)]
    )
    parts = [group.linearize(model, prior_means, None).with_noise(1.0) for group in readings]
    solution = _joint_fit(records, parts, model).solution
    name_of_largest, largest = "", 0.0
    for group, part in zip(readings, parts, strict=True):
        sets = [(index,) for index in range(len(group.names))]
        positions = evaluate_positions(part, sets, solution, model, None)
        for name, position in zip(group.names, positions, strict=True):
            deviation = abs(position.standardized)
            if deviation > largest:
                name_of_largest, largest = name, deviation
    return name_of_largest


def _initial_noise(group: ReadingGroup) -> float:
    """Return a noise to begin with: a millionth of the largest indication."""
    return 1e-6 * float(np.max(np.abs(group.value), initial=1e-3))


def _update_noise(
    group: ReadingGroup,
    part: LinearReadings,
    solution: Solution,
    model: Unknowns,
    previous: float,
    free_count: int,
) -> float:
    """Return the noise that the residuals show; its fixed point is the REML estimate.

    free_count: Number of unknowns that only the group determines.
    """
    if group.u is not None:
        return 1.0
    complements = 1.0 - part.leverages(solution)
    repeat_dof = group.repeat_dof
    if reason := group.lack_of_noise(
        float(complements.sum()) + repeat_dof, free_count, solution, model
    ):
        raise NotIdentifiableError(reason)
    # Where the head's part is known, the score of the rest: each reading by the share that it has.
    share = part.noise_share
    residuals = part.residuals(solution, model) / part.sigma
    sum_of_squares = float(share @ residuals**2) + float(group.scatter.sum()) / previous**2
    size = previous * math.sqrt(sum_of_squares / (float(share @ complements) + repeat_dof))
    if repeat_dof < MIN_DOF:
        size = max(size, _MIN_NOISE_TO_HEAD * float(np.sqrt(np.mean(part.head**2))))
    # Beside unstated terms a fit may follow every digit of readings without any noise.
    return max(size, group.noise_floor)
