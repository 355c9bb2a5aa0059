"""Parameters of a triad that the directions of its poses do not determine.

Far from the true values, poses in few directions can seem to determine parameters that they do not:
wrong misalignments rotate each direction, and the rotated directions carry information. Therefore
the rank is computed at an estimate with default priors. A parameter counts as determined only if
the poses are linear in it over its own uncertainty (Bates and Watts, Nonlinear Regression Analysis
and Its Applications, 1988, section 7.1: curvature).
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

#: A parameter is undetermined if default priors of others contribute more than this fraction of
#: its own default standard uncertainty.
_MIN_PRIOR_FRACTION: Final = 0.5


def default_candidates(model: Unknowns, accelerometers: Collection[str]) -> tuple[Unknown, ...]:
    """Return the requested parameters of a triad that have only a default prior."""
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

    Each gets its default prior before the others are tested, because an undetermined parameter
    makes correlated parameters look undetermined too.

    fit: Fit of the model with the default priors of all candidates.
    model: Model without these priors.
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
            # Curvature counts only if it shifts the parameter noticeably against its prior.
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
        index = int(np.argmax(np.where(is_undetermined, relative_u, -1.0)))
        undetermined_unknowns.append(remaining[index])
    return undetermined_unknowns


def _prior_contributions(solution: Solution, model: Unknowns, indices: Sequence[int]) -> Array:
    """Return the contributions of default priors to the standard uncertainties."""
    is_default = [unknown.uses_fallback_prior for unknown in model.unknowns]
    weights = np.eye(len(model.unknowns))[indices]
    return np.array([np.linalg.norm(solution.combine(row).prior[is_default]) for row in weights])


def _curvature(fit: JointFit, solution: Solution, indices: Sequence[int]) -> Array:
    """Return the chi-square of the second-order change along each parameter.

    Each step is `_MOVE_SDS` standard uncertainties (noise only), so the linear change has the
    chi-square `_MOVE_SDS` squared.
    """
    noise = solution.covariance_noise
    u = np.sqrt(np.diag(noise)[indices])
    zeros = np.zeros((len(noise), len(u)))
    steps = _MOVE_SDS * np.divide(noise[:, indices], u, out=zeros, where=u > 0)
    chi2 = np.zeros(len(indices))
    for observation in fit.observations:
        if isinstance(observation, LinearReadings) and observation.group.triad:
            changes = observation.group.curvature(fit.model, fit.solution.estimate, steps)
            chi2 += np.sum((changes / observation.sigma[:, None]) ** 2, axis=0)
    return chi2
