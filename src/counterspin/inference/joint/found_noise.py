"""Noise found in the records of a joint fit, and what its own uncertainty leaves open."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.prepared import Prepared, condense
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.likelihood import RecordData
from counterspin.inference.noise.model import COMPONENTS, Noise, information_lost
from counterspin.inference.noise.search import FoundNoise, effective_dof, find_noise
from counterspin.inference.noise.unseen_noise import lengthened

#: Least u of a prior in the likelihood, in units of the unknown's credible limit.
_LEAST_PRIOR_U: Final = 1e-12

#: Part of a variance by which it is varied.
_SMALL: Final = 1e-3

_WALK: Final = COMPONENTS.index("random_walk")


def noise_of(
    prepared: Sequence[Prepared],
    model: Unknowns,
    requests: Mapping[str, Noise],
) -> tuple[dict[str, Noise], dict[str, FoundNoise]]:
    """Return each accelerometer's noise, given or by restricted maximum likelihood."""
    noise: dict[str, Noise] = {}
    found: dict[str, FoundNoise] = {}
    for name, request in requests.items():
        noise[name] = request
        if request.wanted:
            own = [part for part in prepared if part.accelerometer == name]
            found[name] = _found(own, model, request)
            noise[name] = found[name].noise
    return noise, found


def _found(prepared: Sequence[Prepared], model: Unknowns, request: Noise) -> FoundNoise:
    # These records tell less than all of them of what nobody asks for.
    prepared, model = condense(prepared, model, {})
    # What is considered is unknown here, or what it does to the records would be taken for noise.
    every, p = (*model.unknowns, *model.considered), len(model.unknowns)
    places = [(*part.unknowns, *(p + place for place in part.considered)) for part in prepared]
    used = sorted({index for own in places for index in own})
    records = [
        RecordData(
            part.series.time,
            part.series.order,
            np.column_stack([part.design, part.fixed]),
            part.series.error,
            part.series.count,
            part.series.block_spacing,
            [used.index(index) for index in own],
            part.series.trajectory.conditions.start,
            part.series.jitter_variance,
            part.series.relative,
        )
        for part, own in zip(prepared, places, strict=True)
    ]
    # Priors are data too; what has none is held as loosely as in the solution.
    chosen = [every[index] for index in used]
    spread = np.array([max(unknown.spread, _LEAST_PRIOR_U * unknown.limit) for unknown in chosen])
    means = np.array([unknown.prior_mean for unknown in chosen])
    return find_noise(records, request, np.diag(1.0 / spread), means / spread)


def losses(fit: JointFit, name: str) -> Array:
    """Return the loss of each series' information per unit of each noise variance.

    In the coordinates in which all information is the identity (`Solution.root_of`), (series,
    4, f, f); zero for other accelerometers' series.
    """
    root = fit.solution.root_of(np.eye(len(fit.model.unknowns)))
    lost = np.zeros((len(fit.prepared), len(COMPONENTS), root.shape[1], root.shape[1]))
    for place, part in enumerate(fit.prepared):
        if part.accelerometer == name:
            series, columns = part.series, part.design @ root[list(part.unknowns)]
            start = series.trajectory.conditions.start
            lost[place] = information_lost(
                series.differences, columns, fit.noise[name], start, series.jitter_variance
            )
    return lost


def uncertain(noise: Mapping[str, Noise], found: Mapping[str, FoundNoise]) -> dict[str, Array]:
    """Return the covariance of each noise's variances, (4, 4), of those that are not exact."""
    parts: dict[str, Array] = {name: one.covariance for name, one in found.items()}
    for name, one in noise.items():
        if one.covariance:
            # What is found here and what another record said are of different components.
            parts[name] = np.array(one.covariance) + parts.get(name, 0.0)
    return parts


def level_dof(fit: JointFit, name: str) -> float:
    """Return how well the level of a noise is known from another record, in degrees of freedom.

    Of the whitened residuals' sum of squares each variance makes a share, by which a change of its
    logarithm changes the log-determinant of their covariance. A wander makes nearly none.
    """
    noise = fit.noise[name]
    if not noise.covariance:
        return math.inf
    own = [part.series for part in fit.prepared if part.accelerometer == name]
    shares = sum(_shares(series, noise) for series in own)
    gradient, variances = np.zeros((1, len(COMPONENTS))), np.array(noise.variances[: _WALK + 1])
    np.divide(shares, variances, out=gradient[0, : _WALK + 1], where=variances > 0.0)
    rows = sum(series.differences.rows for series in own)
    return float(effective_dof([rows], gradient, np.array(noise.covariance))[0])


def _shares(series: Series, noise: Noise) -> Array:
    """Return how many rows' worth of the whitened squares white noise and a walk make, (2,)."""
    more, less = math.exp(_SMALL), math.exp(-_SMALL)

    def level(white: float, walk: float) -> float:
        own = white * noise.sample_variance + series.jitter_variance
        return series.differences.factor(own, walk * noise.random_walk**2)[1]

    by_white, by_walk = level(more, 1.0) - level(less, 1.0), level(1.0, more) - level(1.0, less)
    return np.array([by_white, by_walk]) / (2.0 * _SMALL)


def growth_of(fit: JointFit, lost: Mapping[str, Array]) -> dict[str, Array]:
    """Return the change of the covariance per unit of each noise variance, (4, p, p).

    lost: Accelerometer -> `losses`.
    """
    root = fit.solution.root_of(np.eye(len(fit.model.unknowns)))
    return {name: root @ own.sum(axis=0) @ root.T for name, own in lost.items()}


def widened(
    fit: JointFit,
    growth: Mapping[str, Array],
    noise: Mapping[str, Noise],
    found: Mapping[str, FoundNoise],
    dof: float | Array = math.inf,
) -> tuple[JointFit, Array]:
    """Return a fit with what is left open of the variances of noises, and degrees of freedom, (p,).

    The weights are what they are. So the degrees of freedom of a variance are Satterthwaite's,
    those of several accelerometers adding up as their inverses, and a random walk that the records
    do not show but allow adds its share. Considered terms have no part in the weights: their part
    of the covariance stays as it is. Unknowns that are not determined, or known exactly, are left
    as they are.

    growth: Accelerometer -> what each of `COMPONENTS` adds to the covariance per unit, (4, p, p).
    noise, found: By accelerometer: its noise; how well it is known, where it was estimated.
    dof: Degrees of freedom from all else.
    """
    solution = fit.solution
    variance, inverse = np.diag(solution.covariance), 1.0 / np.full(len(fit.model.unknowns), dof)
    for name, covariance in uncertain(noise, found).items():
        gradient = np.diagonal(growth[name], axis1=1, axis2=2).T
        inverse += 1.0 / effective_dof(variance, gradient, covariance)
    limits = np.array([unknown.limit for unknown in fit.model.unknowns])
    known = (solution.u > 0.0) & (solution.u < limits)
    walks: dict[str, tuple[float, Array]] = {}
    for name, one in found.items():
        if one.unseen is None:
            continue
        slope = np.where(np.outer(known, known), growth[name][_WALK], 0.0)
        diagonal = np.diag(slope)
        if not diagonal.any():
            continue
        own = np.where(known, variance, 1.0)
        level, longer = lengthened(one.unseen, own, diagonal, inverse)
        walks[name] = math.sqrt(level), level * slope
        inverse = np.where(known, longer, inverse)
    with np.errstate(divide="ignore"):
        freedom = 1.0 / inverse
    if not walks:
        return fit, freedom
    added = np.sum([covariance for _, covariance in walks.values()], axis=0)
    wider = replace(solution, covariance_unseen=added)
    return replace(fit, solution=wider, unseen=walks), freedom


def unseen_covariance(fit: JointFit, found: Mapping[str, FoundNoise]) -> Array:
    """Return the covariance that undetected walks may add to a fit, (p, p)."""
    hidden = {name: one for name, one in found.items() if one.unseen is not None}
    lost = {name: losses(fit, name) for name in uncertain(fit.noise, hidden)}
    wider, _ = widened(fit, growth_of(fit, lost), fit.noise, hidden)
    added = wider.solution.covariance_unseen
    return np.zeros_like(fit.solution.covariance) if added is None else added
