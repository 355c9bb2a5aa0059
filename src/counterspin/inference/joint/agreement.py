"""Agreement of each run, and of slow residuals, with the other runs.

Each run is left out in turn. With all runs the estimate is the better one, so that the variance of
the shift is what the variance grows by (Hausman, Econometrica 46 (1978) 1251). Where the noise was
estimated, the shift has Student's distribution, and noise that the records do not show is part of
it, as of u itself.

Noise of the accelerometer is looked for in the slowest changes of a record, where a bend of the
record itself stands too: a slow error of one run makes the noise of all runs seem larger, and moves
what rests on that run by more than this noise allows. Noise acts in every run. So the whitened
residuals that cosines of a run can follow, up to where the record's own noise is the larger one,
are compared with those of the other runs: a quotient of chi-squares (Fisher's F), in which the
size of the noise cancels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.distributions import countable
from counterspin.inference.joint.alternatives import Alternative, beside_fit
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.found_noise import losses, uncertain
from counterspin.inference.joint.prepared import Prepared
from counterspin.inference.joint.summary import Jackknife
from counterspin.inference.least_squares import Solution
from counterspin.inference.noise.model import COMPONENTS
from counterspin.inference.noise.search import effective_dof
from counterspin.inference.noise.unseen_noise import Unseen, lengthened

#: Part of an unknown's u below which a shift's own uncertainty is rounding.
_LEAST_SHARE: Final = 1e-6


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
    """Return the change of each shift's variance per unit of each noise variance, (runs, 4).

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
    level, inverse[moved] = lengthened(unseen, variance[moved], slope[moved], inverse[moved])
    variance[moved] += level * slope[moved]
    return variance, inverse


# Slow residuals --------------------------------------------------------------------------------

#: Cosines beyond the last one that the accelerometer's noise dominates; most of all.
_FURTHER_COSINES: Final = 2
_MAX_COSINES: Final = 24

#: Singular value of columns of unit size below which the unknowns follow all of one.
_RANK_TOLERANCE: Final = 1e-4


@frozen
class SlowPart:
    """The slow part of one run's residuals, against those of the other runs."""

    run: str  #: The run.
    ratio: float  #: Its mean square over that of the others.
    p: float  #: Probability of as large a ratio or a larger one by chance, for this run alone.


def slow_parts(fit: JointFit, accelerometer: str) -> list[SlowPart]:
    """Compare the slow residuals of each run of an accelerometer with those of its others."""
    places = [i for i, part in enumerate(fit.prepared) if part.accelerometer == accelerometer]
    cosines = [
        Alternative("cosine", str(i), "cosine", {i: column})
        for i in places
        for column in _cosines(fit, fit.prepared[i])
    ]
    if len(places) < 2:
        return []
    held = beside_fit(fit, cosines)
    columns = held.columns / np.sqrt(held.before)
    found = []
    for i in places:
        own = columns[:, [other.owner == str(i) for other in cosines]]
        left, sizes, _ = np.linalg.svd(own, full_matrices=False)
        basis = left[:, sizes > _RANK_TOLERANCE]
        found.append((float(np.sum((basis.T @ held.residual) ** 2)), basis.shape[1]))
    return [_against(fit.prepared[i], found, k) for k, i in enumerate(places)]


def _against(prepared: Prepared, found: list[tuple[float, int]], k: int) -> SlowPart:
    from scipy.special import fdtrc

    own, freedom = found[k]
    rest = sum(energy for energy, _ in found) - own
    others = sum(count for _, count in found) - freedom
    if not freedom or not others or not rest > 0.0:
        return SlowPart(prepared.run, 1.0, 1.0)
    ratio = own / freedom / (rest / others)
    return SlowPart(prepared.run, ratio, float(fdtrc(freedom, others, ratio)))


def _cosines(fit: JointFit, prepared: Prepared) -> list[Array]:
    """Return cosines of half periods in a record, up to where its own noise is the larger one."""
    series = prepared.series
    noise = series.total(fit.noise[series.accelerometer])
    length = float(series.time[-1] - series.time[0])
    per_sample = length / float(np.sum(series.count))
    white = math.sqrt(noise.sample_variance * per_sample)
    count = _MAX_COSINES
    if (
        series.order
        and noise.random_walk < white * (math.pi * _MAX_COSINES / length) ** series.order
    ):
        corner = (noise.random_walk / white) ** (1.0 / series.order)
        count = min(_MAX_COSINES, math.ceil(corner * length / math.pi) + _FURTHER_COSINES)
    phase = math.pi * (series.time - series.time[0]) / length
    return [np.cos(j * phase) for j in range(1, count + 1)]
