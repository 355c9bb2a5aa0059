"""Joint fit of readings, of poses at unknown attitudes, and of records.

Readings are linearised at the estimate, iteratively until convergence. They become blocks of
square-root information, which are solved together with the blocks of records.
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
from counterspin.inference.joint.unknowns import Observation, Unknown, Unknowns
from counterspin.inference.least_squares import Solution
from counterspin.inference.noise.model import Noise
from counterspin.physics.terms import HEAD_HARMONICS
from counterspin.readings.fitted import MIN_DOF, FittedReadings, evaluate_positions
from counterspin.readings.linear import LinearReadings, ReadingGroup

U = TypeVar("U", bound=Unknown)

#: Largest number of iterations of derivatives and noise; usually two or three.
_MAX_ITERATIONS: Final = 100

#: Largest number of iterations of the noise alone, which may approach zero slowly.
_MAX_NOISE_ITERATIONS: Final = 200

#: Smallest ratio of estimated noise to the rms effect of the head angle. Otherwise, positions
#: without an effect of the head would count as exact. Sufficient repeats determine the noise.
_MIN_NOISE_TO_HEAD: Final = 0.3

#: Factor of a prior standard uncertainty that constrains a term to its prior.
_CONSTRAINT_FACTOR: Final = 1e-6

#: Numbers of iterations after which the step is halved, and halved again.
_HALVING_ITERATIONS: Final = (15, 60)

#: Largest deviation of the linearisation point from a prior, in largest credible sizes.
_MAX_DEVIATION_IN_LIMITS: Final = 10.0

#: Convergence: steps in standard uncertainties, and relative changes of the noise.
_STEP_TOLERANCE: Final = 1e-5
_NOISE_TOLERANCE: Final = 1e-6


@frozen
class ReadingsFit:
    """A solved problem with readings."""

    fit: JointFit  #: Joint fit of records, if there are any, and readings.
    groups: tuple[FittedReadings, ...]  #: Fitted groups, in the order of the readings.

    @property
    def solution(self) -> Solution:
        """Solution of the joint fit."""
        return self.fit.solution


def solve_readings(
    readings: Sequence[ReadingGroup], model: Unknowns, records: JointFit | None = None
) -> ReadingsFit:
    """Estimate a model from readings and records.

    A parameter of a triad that the directions of its poses do not determine gets its default prior
    in the model of the fit.

    model: Unknowns and considered terms; relevant inputs are radius, gravity and latitude.
    """
    first_fit = None
    for group in readings:
        if candidates := group.default_candidates(model):
            default_model = model.with_default_priors(candidates)
            first_fit = _solve_or_constrain(readings, default_model, records)
            unknowns = group.find_undetermined(first_fit.fit, model, candidates)
            model = model.with_default_priors(unknowns)
            break
    solution = _solve_or_constrain(readings, model, records, first_fit)
    return replace(
        solution, groups=tuple(group.evaluate(solution.fit) for group in solution.groups)
    )


def _solve_or_constrain(
    readings: Sequence[ReadingGroup],
    model: Unknowns,
    records: JointFit | None,
    start: ReadingsFit | None = None,
) -> ReadingsFit:
    """Solve a problem; if too few readings determine the noise, constrain terms that hide it.

    start: Fit with initial values; None: the prior means, or the ellipsoid of the poses.
    """
    try:
        return _solve(readings, model, records, start)
    except NotIdentifiableError as error:
        has_positioning_errors = any(group.u is None and any(group.position) for group in readings)
        constrained_models = [
            candidate
            for candidate in _constrained_models(readings, model)
            if has_positioning_errors or candidate != model
        ]
        last_error = error
    # Positioning errors without repeats, and nuisance terms with few readings or poses, hide the
    # noise. The residuals contain both, which gives an upper limit of the noise.
    groups_without_positioning = [group.without_positioning_errors() for group in readings]
    for constrained_model in constrained_models:
        try:
            noise_fit = _solve(groups_without_positioning, constrained_model, records, start)
        except NotIdentifiableError as error:
            last_error = error
        else:
            return _solve(readings, model, records, start, noise_fit)
    raise last_error


def _linearization_point(
    estimate: Array,
    solution: Solution,
    prior_means: Array,
    limits: Array,
    max_deviation: Array,
    pose_indices: Sequence[int],
) -> Array:
    """Return the linearisation point: the estimate, without undetermined and incredible values.

    Undetermined unknowns keep their prior means. For a triad, often only a combination is
    undetermined, such as a rotation about the vertical. Resetting all unknowns of this combination
    would also reset the angles between the axes, so they are combined with their limits as priors.

    max_deviation: Largest deviation of each unknown from its prior mean.
    pose_indices: Indices of the unknowns of a triad.
    """
    u = solution.u[: prior_means.size]
    point: Array = prior_means + np.clip(
        np.where(u < limits, estimate - prior_means, 0.0), -max_deviation, max_deviation
    )
    indices = [index for index in pose_indices if np.isfinite(u[index])]
    if (u < limits)[indices].all():
        return point
    scale, deviation = limits[indices], (estimate - prior_means)[indices]
    covariance = solution.covariance[np.ix_(indices, indices)]
    normalised = np.eye(len(indices)) + covariance / np.outer(scale, scale)
    point[indices] = prior_means[indices] + scale * np.linalg.solve(normalised, deviation / scale)
    return point


def _constrained_models(readings: Sequence[ReadingGroup], model: Unknowns) -> Iterator[Unknowns]:
    """Yield models with more and more constrained terms that hide the noise of data without u.

    For poses, all nuisance terms are constrained. For readings, harmonics of the dividing head with
    default priors are constrained first, then terms of the accelerometer with default priors.
    """
    groups_without_u = [group for group in readings if group.u is None]
    pose_accelerometers = {name for group in groups_without_u for name in group.triad}
    reading_accelerometers = {group.accelerometer for group in groups_without_u if not group.triad}
    for owners in (set(), reading_accelerometers) if reading_accelerometers else (set(),):

        def constrain(unknown: U, owners: Collection[str] = owners) -> U:
            hides_noise = unknown.owner in pose_accelerometers
            if unknown.has_default_prior and reading_accelerometers:
                hides_noise |= unknown.owner in owners or unknown.symbol.startswith(HEAD_HARMONICS)
            if not hides_noise or unknown.is_of_interest or math.isinf(unknown.prior[1]):
                return unknown
            return replace(unknown, prior=(unknown.prior[0], _CONSTRAINT_FACTOR * unknown.prior[1]))

        unknowns, considered = map(constrain, model.unknowns), map(constrain, model.considered)
        yield Unknowns(tuple(unknowns), tuple(considered))


def _solve(
    readings: Sequence[ReadingGroup],
    model: Unknowns,
    records: JointFit | None,
    start: ReadingsFit | None = None,
    noise_fit: ReadingsFit | None = None,
) -> ReadingsFit:
    """Solve a problem; the groups are not evaluated yet.

    start: See `_solve_or_constrain`.
    noise_fit: Fit whose noise is used; None: the noise is estimated.
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
    # A reading with the wrong sign could shift parameters with priors out of the linear range.
    has_prior = np.array([math.isfinite(unknown.prior[1]) for unknown in unknowns])
    max_deviation = np.where(has_prior, _MAX_DEVIATION_IN_LIMITS * limits, np.inf)
    noise = [_initial_noise(group) for group in readings]
    if (previous_fit := noise_fit or start) is not None:
        noise = [group.noise for group in previous_fit.groups]
    # Considered terms also affect the residuals. They are estimated with their priors while noise
    # and linearisation point are determined. Otherwise their effects would count as noise, or would
    # shift similar parameters far from their priors.
    variance = None
    is_single_group = records is None and len(readings) == 1
    n_free = sum(math.isinf(unknown.prior[1]) for unknown in unknowns) if is_single_group else 0
    pose_accelerometers = {name for group in readings for name in group.triad}
    pose_indices = [
        index
        for index, unknown in enumerate(model.unknowns)
        if unknown.owner in pose_accelerometers
    ]
    for iteration in range(_MAX_ITERATIONS):
        linear_groups = [group.linearize(model, point, variance) for group in readings]
        # The columns do not depend on the noise.
        for _ in range(_MAX_NOISE_ITERATIONS):
            weighted_groups = [
                linear.with_noise(noise_sd)
                for linear, noise_sd in zip(linear_groups, noise, strict=True)
            ]
            fit, previous = _joint_fit(records, weighted_groups, model), noise
            relaxed_groups = [
                linear.with_considered_estimated(len(model.unknowns)) for linear in weighted_groups
            ]
            if noise_fit is not None:
                break
            noise = [
                _update_noise(
                    group,
                    linear,
                    fit.solution_with_considered,
                    Unknowns(model.unknowns),
                    previous_noise,
                    n_free,
                )
                for group, linear, previous_noise in zip(
                    readings, relaxed_groups, previous, strict=True
                )
            ]
            changes = (
                abs(new_noise / last_noise - 1.0)
                for new_noise, last_noise in zip(noise, previous, strict=True)
            )
            if max(changes) < _NOISE_TOLERANCE:
                break
        solution = fit.solution_with_considered
        estimate, sd = solution.estimate[: prior_means.size], solution.u[: prior_means.size]
        new_point = _linearization_point(
            estimate, solution, prior_means, limits, max_deviation, pose_indices
        )
        variance = sd**2
        relative_moves = np.abs(new_point - point) / np.where(sd > 0, sd, 1.0)
        # Positioning errors may oscillate, so the step is halved, and later halved again.
        damping = 0.5 ** sum(iteration >= limit for limit in _HALVING_ITERATIONS)
        point = new_point if damping == 1.0 else point + damping * (new_point - point)
        if relative_moves.max(initial=0.0) < _STEP_TOLERANCE:
            break
    else:
        for group in readings:
            if reason := group.divergence_message(_MAX_ITERATIONS):
                raise ConvergenceError(reason)
        name = _worst_reading(readings, records, model)
        raise ConvergenceError(
            f"the fit of the readings did not converge in {_MAX_ITERATIONS} iterations. Check the "
            f'sign, the digits and the unit of "{name}", which deviates most from the others, and '
            "whether this reading was swapped with another one. If the reading is correct, state "
            "priors for the machine terms, or state the standard uncertainties of the readings"
        )
    dof = [
        linear.noise_dof(solution) + group.repeat_dof if group.u is None else math.inf
        for group, linear in zip(readings, relaxed_groups, strict=True)
    ]
    if noise_fit is not None:
        dof = [group.noise_dof for group in noise_fit.groups]
    estimated_noise = {
        linear.source: Noise(noise_sd)
        for group, linear, noise_sd in zip(readings, linear_groups, noise, strict=True)
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
        FittedReadings(group, linear, noise_sd, noise_dof)
        for group, linear, noise_sd, noise_dof in zip(
            readings, linear_groups, noise, dof, strict=True
        )
    )
    return ReadingsFit(fit, tuple(groups))


def _joint_fit(
    records: JointFit | None, weighted_groups: Sequence[LinearReadings], model: Unknowns
) -> JointFit:
    """Return the joint fit of readings with given noise and of the records of another fit."""
    blocks = tuple(group.whitened_block() for group in weighted_groups)
    observations: tuple[Observation, ...] = tuple(weighted_groups)
    if records is not None:
        blocks = (*records.blocks[: len(records.design_blocks)], *blocks)
        observations = (*records.design_blocks, *observations)
    return JointFit(model, solve_blocks(blocks, model), observations, blocks, {})


def _worst_reading(
    readings: Sequence[ReadingGroup], records: JointFit | None, model: Unknowns
) -> str:
    """Return the name of the reading with the largest residual in a linear fit at the priors."""
    unknowns = (*model.unknowns, *model.considered)
    means = np.array([unknown.prior_mean for unknown in unknowns])
    linear_groups = [group.linearize(model, means, None).with_noise(1.0) for group in readings]
    solution = _joint_fit(records, linear_groups, model).solution
    worst_name, max_deviation = "", 0.0
    for group, linear_group in zip(readings, linear_groups, strict=True):
        index_sets = [(index,) for index in range(len(group.names))]
        positions = evaluate_positions(linear_group, index_sets, solution, model, None)
        for name, position in zip(group.names, positions, strict=True):
            deviation = abs(position.standardized)
            if deviation > max_deviation:
                worst_name, max_deviation = name, deviation
    return worst_name


def _initial_noise(group: ReadingGroup) -> float:
    """Return the initial noise: a millionth of the largest indication."""
    return 1e-6 * float(np.max(np.abs(group.value), initial=1e-3))


def _update_noise(
    group: ReadingGroup,
    linear_group: LinearReadings,
    solution: Solution,
    model: Unknowns,
    previous_noise: float,
    n_free: int,
) -> float:
    """Return an update of the noise from the residuals; its fixed point is the REML estimate.

    n_free: Number of unknowns that only the group determines.
    """
    if group.u is not None:
        return 1.0
    complements = 1.0 - linear_group.leverages(solution)
    repeat_dof = group.repeat_dof
    if reason := group.insufficient_noise_message(
        float(complements.sum()) + repeat_dof, n_free, solution, model
    ):
        raise NotIdentifiableError(reason)
    # The head's variance is known; each reading counts with the noise share of its variance.
    noise_share = linear_group.noise_share
    residuals = linear_group.residuals(solution, model) / linear_group.sigma
    squares = float(noise_share @ residuals**2) + float(group.scatter.sum()) / previous_noise**2
    sd = previous_noise * math.sqrt(squares / (float(noise_share @ complements) + repeat_dof))
    if repeat_dof < MIN_DOF:
        sd = max(sd, _MIN_NOISE_TO_HEAD * float(np.sqrt(np.mean(linear_group.other_sd**2))))
    # With default priors, a fit may follow noiseless readings to the last digit.
    return max(sd, group.noise_floor)
