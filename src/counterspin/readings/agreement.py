"""Agreement of the test methods.

The data of a method are compared with the prediction from the other methods and the priors. This
tests all unknowns together, even if no method determines all of them. The shift of each unknown
without the method is computed in addition.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint.fit import (
    JointFit,
    estimate_considered_in_block,
    solve_blocks,
    solve_with_considered,
)
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.least_squares import Block, Solution

#: Directions in which a credible change of the unknowns is below this fraction of the noise are
#: ignored.
_MIN_SINGULAR_VALUE: Final = 1e-2

#: Directions that the other methods predict worse than this, in units of the noise, are ignored.
_MAX_PREDICTION_SD: Final = 1e3

#: Relative difference of variances that is rounding error.
_ROUNDING: Final = 1e-9


@frozen
class MethodFit:
    """Fits with and without a test method, and their agreement."""

    own_fit: JointFit  #: Fit of this method alone, with the priors.
    other_solution: Solution  #: Solution of the other methods, with the priors.
    shift: Array  #: Estimates without the method minus estimates from all data, shape (p,).
    #: Standard uncertainty of the shift, shape (p,); NaN if omitting the method changes nothing.
    u_shift: Array
    #: Chi-square of the differences between the data of the method and the prediction of the other
    #: methods, in all directions that both determine.
    chi2: float
    dof: int


def compare_motions(fit: JointFit) -> dict[str, MethodFit]:
    """Compare the data of each motion with all others; empty if there is only one motion."""
    motions = list(dict.fromkeys(observation.motion for observation in fit.observations))
    return {motion: _compare_motion(fit, motion) for motion in motions} if len(motions) > 1 else {}


def _compare_motion(fit: JointFit, motion: str) -> MethodFit:
    model, solution = fit.model, fit.solution
    method_fit = fit.subset([observation.motion == motion for observation in fit.observations])
    other_blocks = [
        block
        for block, observation in zip(fit.blocks, fit.observations, strict=True)
        if observation.motion != motion
    ]
    other_solution = solve_blocks(other_blocks, model)
    # The estimate from all data is efficient, so that the variances subtract (Hausman). Considered
    # terms shift both estimates, and the shift by the difference.
    other_variance = np.diag(other_solution.weighted_covariance)
    variance = np.diag(solution.weighted_covariance)
    sensitivity_shift = other_solution.sensitivity_considered - solution.sensitivity_considered
    considered_variance = np.sum((sensitivity_shift * solution.considered_sd) ** 2, axis=1)
    shift_variance = np.maximum(other_variance - variance, 0.0) + considered_variance
    if solution.covariance_undetected is not None:
        shift_variance = shift_variance + np.diag(solution.covariance_undetected)
    chi2, dof = _prediction_chi2(method_fit.blocks, other_blocks, model)
    return MethodFit(
        own_fit=method_fit,
        other_solution=other_solution,
        shift=other_solution.estimate - solution.estimate,
        u_shift=np.sqrt(
            np.where(shift_variance > _ROUNDING * other_variance, shift_variance, np.nan)
        ),
        chi2=chi2,
        dof=dof,
    )


def _prediction_chi2(
    method_blocks: Sequence[Block], other_blocks: Sequence[Block], model: Unknowns
) -> tuple[float, int]:
    """Return chi-square of a method against the prediction of the others, and its dof."""
    prediction = solve_with_considered(other_blocks, model)
    blocks = [estimate_considered_in_block(block) for block in method_blocks]
    rows = np.vstack([block.factor for block in blocks])
    target = np.concatenate([block.target for block in blocks])
    terms = (*model.unknowns, *model.considered)
    prior_sds = np.array([term.prior_sd for term in terms])
    limits = np.array([term.limit for term in terms])
    data_directions, singular_values, _ = np.linalg.svd(
        rows * np.minimum(prior_sds, limits), full_matrices=False
    )
    data_directions = data_directions[:, singular_values > _MIN_SINGULAR_VALUE]
    # Only the information on the unknowns is tested here, not the scatter of the method.
    innovation = data_directions.T @ (target - rows @ prediction.estimate)
    directions, prediction_sd, _ = np.linalg.svd(
        prediction.covariance_root(data_directions.T @ rows), full_matrices=True
    )
    prediction_sd = np.append(prediction_sd, np.zeros(innovation.size - prediction_sd.size))
    is_predicted = prediction_sd < _MAX_PREDICTION_SD
    innovation_sd = np.sqrt(1.0 + prediction_sd[is_predicted] ** 2)
    z = (directions.T @ innovation)[is_predicted] / innovation_sd
    return float(z @ z), int(is_predicted.sum())
