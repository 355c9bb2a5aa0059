"""Each run left out in turn: how far a coefficient moves, and how far it may.

With all runs the estimate is the better one, so that the variance of the shift is what the
variance grows by (Hausman, Econometrica 46 (1978) 1251). Where the noise was estimated, the shift
has Student's distribution, and noise that the records do not show is part of it, as of u itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.distributions import countable
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.found_noise import losses, uncertain
from counterspin.inference.least_squares import Solution
from counterspin.inference.noise.model import COMPONENTS
from counterspin.inference.noise.search import effective_dof
from counterspin.inference.noise.unseen_noise import Unseen, lengthened

#: Part of an unknown's u below which a shift's own uncertainty is rounding.
_LEAST_SHARE: Final = 1e-6


@frozen
class Jackknife:
    """What becomes of one unknown without a run."""

    run: str  #: The run left out.
    #: The estimate without it; None where the other runs do not determine the unknown.
    value: float | None = None
    shift: float | None = None  #: By how much that is more than the estimate of all runs.
    #: The shift over its own standard uncertainty; None where the run says next to nothing of the
    #: unknown, so that both are what rounding leaves of them.
    z: float | None = None
    dof: float | None = None  #: Effective degrees of freedom of that uncertainty; None is infinite.


def leave_out(estimated: Estimate, index: int) -> list[Jackknife]:
    """Leave each run out in turn, where there are several, for one accelerometer's unknown."""
    unknown, u = estimated.fit.model.unknowns[index], float(estimated.fit.solution.u[index])
    every = list(dict.fromkeys(prepared.run for prepared in estimated.fit.prepared))
    found = {run: Jackknife(run) for run in every}
    # What nobody asks for need not be apart.
    fit = estimated.core or estimated.fit
    runs = [
        run
        for run in every
        if (without := fit.without_run(run)) is not None and float(without.u[index]) < unknown.limit
    ]
    variance, dof = _spread(estimated, fit, runs, index)
    for run, square, freedom in zip(runs, variance.tolist(), dof.tolist(), strict=True):
        value = float(_solution_without(fit, run).estimate[index])
        shift = value - float(fit.solution.estimate[index])
        compared = square > (_LEAST_SHARE * u) ** 2
        found[run] = Jackknife(
            run,
            value,
            shift,
            shift / math.sqrt(square) if compared else None,
            countable(freedom) if compared else None,
        )
    return list(found.values()) if len(every) > 1 else []


def _spread(
    estimated: Estimate, fit: JointFit, runs: Sequence[str], index: int
) -> tuple[Array, Array]:
    """Return the variance of each run's shift and its degrees of freedom, shapes (runs,)."""
    variance = _variances(fit, runs, index)
    inverse = np.zeros(len(runs))
    owner = fit.model.unknowns[index].owner
    found = estimated.components.get(owner)
    covariance = uncertain(estimated.fit.noise, estimated.components).get(owner)
    if covariance is not None and runs:
        lost = estimated.lost.get(owner)
        slopes = growth(fit, losses(fit, owner) if lost is None else lost, runs, index)
        inverse = 1.0 / effective_dof(variance, slopes, covariance)
        if found is not None and found.unseen is not None:
            slope = slopes[:, COMPONENTS.index("random_walk")]
            variance, inverse = _with_unseen(found.unseen, variance, slope, inverse)
    with np.errstate(divide="ignore"):
        return variance, 1.0 / inverse


def _solution_without(fit: JointFit, run: str) -> Solution:
    solution = fit.without_run(run)
    if solution is None:
        raise ValueError(f"nothing is left without {run}")
    return solution


def _variances(fit: JointFit, runs: Sequence[str], index: int) -> Array:
    """Return the variance of each run's shift, by noise that shows and by what is considered."""
    whole = fit.solution
    variances = np.zeros(len(runs))
    for k, run in enumerate(runs):
        without = _solution_without(fit, run)
        parts = [s.covariance_noise + s.covariance_prior for s in (without, whole)]
        # What is considered moves both, and the shift by the difference.
        sensitivities = [s.sensitivity_considered[index] for s in (without, whole)]
        moved = (sensitivities[0] - sensitivities[1]) * whole.considered_sd
        spread = float(parts[0][index, index] - parts[1][index, index])
        variances[k] = max(spread, 0.0) + float(moved @ moved)
    return variances


def growth(fit: JointFit, lost: Array, runs: Sequence[str], index: int) -> Array:
    """Return what each variance of a noise adds to each shift's variance per unit, (runs, 4).

    Both estimates keep their weights. With C the covariance, and L what the information loses, the
    whole estimate's grows by C L C, that without the run by its own, and their covariance by the
    mixed product; the run itself has no part in the latter two.

    lost: `found_noise.losses` of the fit.
    """
    whole = fit.solution
    unit = np.eye(len(fit.model.unknowns))
    mine = whole.root_of(unit[index : index + 1])[0]
    grown = np.zeros((len(runs), lost.shape[1]))
    for k, run in enumerate(runs):
        without = _solution_without(fit, run)
        # In the coordinates of the losses, in which the whole's own information is the identity.
        theirs = whole.in_rows(without.least_covariance[index])
        rest = lost[[part.run != run for part in fit.prepared]].sum(axis=0)
        away = theirs - mine
        grown[k] = away @ rest @ away + mine @ (lost.sum(axis=0) - rest) @ mine
    return grown


def _with_unseen(
    unseen: Unseen, variance: Array, slope: Array, inverse: Array
) -> tuple[Array, Array]:
    """Return variances of shifts and inverse degrees of freedom with a walk that does not show."""
    moved = (variance > 0.0) & (slope > 0.0)
    if not moved.any():
        return variance, inverse
    variance, inverse = variance.copy(), inverse.copy()
    level, longer = lengthened(unseen, variance[moved], slope[moved])
    wider = variance[moved] + level * slope[moved]
    inverse[moved] = np.square(variance[moved] / wider) * inverse[moved] + 1.0 / longer
    variance[moved] = wider
    return variance, inverse
