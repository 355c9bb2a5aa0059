"""Parameters of a triad that the directions of its poses do not determine.

Far from the truth, poses in few directions seem to determine what they do not: the misalignments
that a fit has found turn every direction, and the turned directions then carry information. So the
rank is taken at an estimate with default priors, and a parameter counts as determined only if the
poses are linear in it over its own uncertainty (Bates and Watts, Nonlinear Regression Analysis and
Its Applications, 1988, section 7.1: curvature).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.joint.fit import JointFit, solve_blocks
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.least_squares import Solution
from counterspin.readings.linear import LinearReadings

#: Standard uncertainties by which a parameter is moved to test whether the poses are linear in it.
_MOVE_SDS: Final = 2.0

#: A parameter follows default priors of others if they contribute more than this part of its own.
_MIN_PRIOR_FRACTION: Final = 0.5


def default_candidates(model: Unknowns, accelerometers: Collection[str]) -> tuple[Unknown, ...]:
    """Return the requested parameters of a triad that have a default prior and no other."""
    return tuple(
        unknown
        for unknown in model.of_interest
        if unknown.owner in accelerometers
        and math.isinf(unknown.prior[1])
        and math.isfinite(unknown.default_sd)
    )


def undetermined_parameters(
    fit: JointFit, model: Unknowns, candidates: Sequence[Unknown]
) -> list[Unknown]:
    """Return the parameters that poses do not determine, the least determined first.

    Each gets its default prior before the others are judged, because an undetermined parameter
    makes those that it correlates with look undetermined too.

    fit: Of the model with the default priors of all candidates.
    model: Without these priors.
    """
    undetermined_unknowns: list[Unknown] = []
    while len(undetermined_unknowns) < len(candidates):
        current_model = model.with_default_priors(undetermined_unknowns)
        solution = solve_blocks(fit.blocks, current_model)
        remaining = [unknown for unknown in candidates if unknown not in undetermined_unknowns]
        indices = [model.unknowns.index(unknown) for unknown in remaining]
        limits = np.array([unknown.limit for unknown in remaining])
        is_undetermined = solution.u[indices] >= limits
        default_sds = np.array([unknown.default_sd for unknown in remaining])
        if not is_undetermined.any():
            curvature = _curvature(fit, solution, indices)
            # A bend that moves a parameter by little of its default prior leaves it determined.
            is_significant = (
                solution.u[indices] * np.sqrt(curvature) / _MOVE_SDS
                > _MIN_PRIOR_FRACTION * default_sds
            )
            is_undetermined = (curvature > _MOVE_SDS**2) & is_significant
        if not is_undetermined.any() and undetermined_unknowns:
            is_undetermined = (
                _prior_contributions(solution, current_model, indices)
                > _MIN_PRIOR_FRACTION * default_sds
            )
        if not is_undetermined.any():
            break
        relative_u = solution.u[indices] / default_sds
        undetermined_unknowns.append(
            remaining[int(np.argmax(np.where(is_undetermined, relative_u, -1.0)))]
        )
    return undetermined_unknowns


def _prior_contributions(solution: Solution, model: Unknowns, indices: Sequence[int]) -> Array:
    """Return the parts of the uncertainties that default priors of other parameters contribute."""
    has_fallback_prior = [unknown.uses_fallback_prior for unknown in model.unknowns]
    weights = np.eye(len(model.unknowns))[indices]
    return np.array(
        [np.linalg.norm(solution.combine(row).prior[has_fallback_prior]) for row in weights]
    )


def _curvature(fit: JointFit, solution: Solution, indices: Sequence[int]) -> Array:
    """Return the chi-square of the second-order changes over each parameter's own uncertainty.

    The linear change has the chi-square `_MOVE_SDS` squared. The steps are those of noise alone.
    """
    noise = solution.covariance_noise
    u = np.sqrt(np.diag(noise)[indices])
    steps = _MOVE_SDS * np.divide(
        noise[:, indices], u, out=np.zeros((len(noise), len(u))), where=u > 0
    )
    chi2 = np.zeros(len(indices))
    for observation in fit.observations:
        if isinstance(observation, LinearReadings) and observation.group.triad:
            changes = observation.group.curvature(fit.model, fit.solution.estimate, steps)
            chi2 += np.sum((changes / observation.sigma[:, None]) ** 2, axis=0)
    return chi2
