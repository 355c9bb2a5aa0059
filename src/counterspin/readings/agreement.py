"""Agreement of the data of each test method with those of the others.

The data of a method are compared with the prediction of the others and of everything that is known
beforehand. That is a test of all unknowns together, which no method alone has to determine.
The shift of each unknown without the method is stated in addition.
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

#: A direction in which a credible change moves data by less than this part of their noise tells
#: nothing; one that the others predict this many times worse than the data see it tests nothing.
_MIN_SINGULAR_VALUE: Final = 1e-2
_MAX_PREDICTION_SD: Final = 1e3

#: Variances that differ by less than this part are the same but for rounding.
_ROUNDING: Final = 1e-9


@frozen
class MethodFit:
    """One kind of data against the others."""

    #: What it says by itself, and what the others say, each with all that is known beforehand.
    alone: JointFit
    without: Solution
    shift: Array  #: Estimates without it less those of everything, shape (p,).
    #: Standard uncertainty of these, what both share counted once, shape (p,); NaN where leaving
    #: the kind out changes nothing.
    u_shift: Array
    #: Squares of what the kind says less what the others predict, over their variances, in as many
    #: directions as both know something of.
    chi2: float
    dof: int


def compare_motions(fit: JointFit) -> dict[str, MethodFit]:
    """Compare the data of each motion with all the others; empty where all are of one."""
    motions = list(dict.fromkeys(observation.motion for observation in fit.observations))
    return {motion: _compare_motion(fit, motion) for motion in motions} if len(motions) > 1 else {}


def _compare_motion(fit: JointFit, motion: str) -> MethodFit:
    model, solution = fit.model, fit.solution
    alone = fit.subset([observation.motion == motion for observation in fit.observations])
    other_blocks = [
        block
        for block, observation in zip(fit.blocks, fit.observations, strict=True)
        if observation.motion != motion
    ]
    without = solve_blocks(other_blocks, model)
    # The whole is the better estimate of the two, so that variances subtract (Hausman); what is
    # considered moves both, and the shift by the difference.
    variance_without, variance = (
        np.diag(without.weighted_covariance),
        np.diag(solution.weighted_covariance),
    )
    considered_shift = (
        without.sensitivity_considered - solution.sensitivity_considered
    ) * solution.considered_sd
    shift_variance = np.maximum(variance_without - variance, 0.0) + np.sum(
        considered_shift**2, axis=1
    )
    if solution.covariance_undetected is not None:
        shift_variance = shift_variance + np.diag(solution.covariance_undetected)
    chi2, dof = _prediction_chi2(alone.blocks, other_blocks, model)
    return MethodFit(
        alone=alone,
        without=without,
        shift=without.estimate - solution.estimate,
        u_shift=np.sqrt(
            np.where(shift_variance > _ROUNDING * variance_without, shift_variance, np.nan)
        ),
        chi2=chi2,
        dof=dof,
    )


def _prediction_chi2(
    method_blocks: Sequence[Block], other_blocks: Sequence[Block], model: Unknowns
) -> tuple[float, int]:
    """Return chi-square of what a kind says against the others' prediction, and its freedom."""
    predicted = solve_with_considered(other_blocks, model)
    blocks = [estimate_considered_in_block(block) for block in method_blocks]
    rows = np.vstack([block.factor for block in blocks])
    target = np.concatenate([block.target for block in blocks])
    terms = (*model.unknowns, *model.considered)
    prior_sds = np.array([term.prior_sd for term in terms])
    limits = np.array([term.limit for term in terms])
    directions_seen, singular_values, _ = np.linalg.svd(
        rows * np.minimum(prior_sds, limits), full_matrices=False
    )
    directions_seen = directions_seen[:, singular_values > _MIN_SINGULAR_VALUE]
    # Only what the kind says of the unknowns; its own scatter has tests of its own.
    innovation = directions_seen.T @ (target - rows @ predicted.estimate)
    directions, prediction_sd, _ = np.linalg.svd(
        predicted.covariance_root(directions_seen.T @ rows), full_matrices=True
    )
    prediction_sd = np.append(prediction_sd, np.zeros(innovation.size - prediction_sd.size))
    predicted_directions = prediction_sd < _MAX_PREDICTION_SD
    pulls = (directions.T @ innovation)[predicted_directions] / np.sqrt(
        1.0 + prediction_sd[predicted_directions] ** 2
    )
    return float(pulls @ pulls), int(predicted_directions.sum())
