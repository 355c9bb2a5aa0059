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
from counterspin.inference.joint.fit import JointFit, relaxed_block, solve_blocks, solve_relaxed
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.least_squares import Block, Solution

#: A direction in which a credible change moves data by less than this part of their noise tells
#: nothing; one that the others predict this many times worse than the data see it tests nothing.
_BLIND_PART: Final = 1e-2
_PREDICTION_RATIO: Final = 1e3

#: Variances that differ by less than this part are the same but for rounding.
_ROUNDING: Final = 1e-9


@frozen
class OneMethod:
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


def agreements(fit: JointFit) -> dict[str, OneMethod]:
    """Compare the data of each motion with all the others; empty where all are of one."""
    kinds = list(dict.fromkeys(one.motion for one in fit.observations))
    return {kind: _agreement(fit, kind) for kind in kinds} if len(kinds) > 1 else {}


def _agreement(fit: JointFit, kind: str) -> OneMethod:
    model, whole = fit.model, fit.solution
    alone = fit.only([one.motion == kind for one in fit.observations])
    others = [
        block for block, one in zip(fit.blocks, fit.observations, strict=True) if one.motion != kind
    ]
    without = solve_blocks(others, model)
    # The whole is the better estimate of the two, so that variances subtract (Hausman); what is
    # considered moves both, and the shift by the difference.
    before, after = np.diag(without.least_covariance), np.diag(whole.least_covariance)
    moved = (without.sensitivity_considered - whole.sensitivity_considered) * whole.considered_sd
    spread = np.maximum(before - after, 0.0) + np.sum(moved**2, axis=1)
    if whole.covariance_unseen is not None:
        spread = spread + np.diag(whole.covariance_unseen)
    chi2, dof = _surprise(alone.blocks, others, model)
    return OneMethod(
        alone=alone,
        without=without,
        shift=without.estimate - whole.estimate,
        u_shift=np.sqrt(np.where(spread > _ROUNDING * before, spread, np.nan)),
        chi2=chi2,
        dof=dof,
    )


def _surprise(own: Sequence[Block], others: Sequence[Block], model: Unknowns) -> tuple[float, int]:
    """Return chi-square of what a kind says against the others' prediction, and its freedom."""
    predicted = solve_relaxed(others, model)
    blocks = [relaxed_block(block) for block in own]
    rows = np.vstack([block.factor for block in blocks])
    target = np.concatenate([block.target for block in blocks])
    terms = (*model.unknowns, *model.considered)
    credible = np.array([term.spread for term in terms])
    limits = np.array([term.limit for term in terms])
    seen, sizes, _ = np.linalg.svd(rows * np.minimum(credible, limits), full_matrices=False)
    seen = seen[:, sizes > _BLIND_PART]
    # Only what the kind says of the unknowns; its own scatter has tests of its own.
    innovation = seen.T @ (target - rows @ predicted.estimate)
    directions, spread, _ = np.linalg.svd(predicted.root_of(seen.T @ rows), full_matrices=True)
    spread = np.append(spread, np.zeros(innovation.size - spread.size))
    known = spread < _PREDICTION_RATIO
    pulls = (directions.T @ innovation)[known] / np.sqrt(1.0 + spread[known] ** 2)
    return float(pulls @ pulls), int(known.sum())
