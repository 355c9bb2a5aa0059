"""What is known beforehand, held to the runs: against what they and all else that is known say.

As `counterspin.inference.joint.alternatives` does it for the joint fit: what is considered is
estimated too, and each prior is left out in turn (Baarda's w-test).

- `HeldPrior`, `held_priors`
"""

from __future__ import annotations

import math

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import LEAST_PART_LEFT
from counterspin.inference.two_stage.second_stage import SecondStage


@frozen
class HeldPrior:
    """One prior, or those of a term that every run has anew, taken together.

    Attributes
    ----------
    symbol
        The term.
    run
        Whose it is; empty for what the runs share, and for all runs together.
    stated, spread
        As it is known beforehand; of all runs together their mean and the u of one.
    excess, u
        By how much it is more than what everything else says, and the standard uncertainty of this.
    """

    symbol: str
    run: str
    stated: float
    spread: float
    excess: float
    u: float


def held_priors(second: SecondStage) -> list[HeldPrior]:
    """Hold every prior to the runs and to the other priors.

    Parameters
    ----------
    second
        The second stage; its noise is taken as it stands there.
    """
    solution = second.solution
    owners = [*(("", symbol) for symbol in second.symbols), *second.considered]
    spread = np.append(solution.prior_sd, solution.considered_sd)
    stated = np.append(solution.prior_mean, second.assumed)
    # The estimate is where the residuals are taken; what is considered, as it was assumed.
    ahead = np.append(solution.prior_mean - solution.estimate, np.zeros(second.assumed.size))
    free = spread > 0.0
    known = np.flatnonzero(free & np.isfinite(spread))
    runs = np.column_stack([second.design, second.fixed]) / second.sigma[:, None]
    beside = np.zeros((known.size, spread.size))
    beside[np.arange(known.size), known] = 1.0 / spread[known]
    rows = np.vstack([runs, beside])[:, free]
    target = np.append(second.misfit, ahead[known] / spread[known])
    followed, sizes, _ = np.linalg.svd(rows / np.linalg.norm(rows, axis=0), full_matrices=False)
    followed = followed[:, sizes > LEAST_PART_LEFT * sizes.max(initial=0.0)]

    def left_of(column: Array) -> Array:
        return np.asarray(column - followed @ (followed.T @ column))

    residual = left_of(target)
    together: dict[tuple[str, str], list[int]] = {owners[k]: [k] for k in known.tolist()}
    for k in known.tolist():
        if owners[k][0]:
            together.setdefault(("", owners[k][1]), []).append(k)
    held = []
    for (run, symbol), places in together.items():
        column = np.zeros(target.size)
        for k in places:
            column[second.sigma.size + int(np.flatnonzero(known == k)[0])] = 1.0 / spread[k]
        own = left_of(column)
        square = float(own @ own)
        if square > LEAST_PART_LEFT * float(column @ column):
            held.append(
                HeldPrior(
                    symbol,
                    run,
                    float(np.mean(stated[places])),
                    float(np.mean(spread[places])),
                    float(own @ residual) / square,
                    1.0 / math.sqrt(square),
                )
            )
    return held
