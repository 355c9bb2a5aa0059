"""Noise estimated from the records of a joint fit, and the effect of its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.joint.design_blocks import DesignBlock, compress_nuisance
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.components import COMPONENTS
from counterspin.inference.noise.likelihood import RecordData
from counterspin.inference.noise.model import Noise, information_loss
from counterspin.inference.noise.search import NoiseEstimate, effective_dof, estimate_noise
from counterspin.inference.noise.undetected_walk import marginal_walk
from counterspin.inference.priors import prior_correlation, whiten_priors

#: Least u of a prior in the likelihood, in units of the unknown's credible limit.
_MIN_PRIOR_U: Final = 1e-12

#: Part of a variance by which it is varied.
_LOG_STEP: Final = 1e-3

_WALK: Final = COMPONENTS.index("random_walk")


def estimate_noise_by_accelerometer(
    design_blocks: Sequence[DesignBlock],
    model: Unknowns,
    requests: Mapping[str, Noise],
) -> tuple[dict[str, Noise], dict[str, NoiseEstimate]]:
    """Return each accelerometer's noise, given or by restricted maximum likelihood."""
    noise: dict[str, Noise] = {}
    estimates: dict[str, NoiseEstimate] = {}
    for name, request in requests.items():
        noise[name] = request
        if request.to_estimate:
            blocks = [block for block in design_blocks if block.accelerometer == name]
            estimates[name] = _estimate_noise(blocks, model, request)
            noise[name] = estimates[name].noise
    return noise, estimates


def _estimate_noise(
    design_blocks: Sequence[DesignBlock], model: Unknowns, request: Noise
) -> NoiseEstimate:
    # These records tell less than all of them of what nobody asks for.
    design_blocks, model = compress_nuisance(design_blocks, model, {})
    # What is considered is unknown here, or what it does to the records would be taken for noise.
    unknowns, p = (*model.unknowns, *model.considered), len(model.unknowns)
    block_indices = [
        (*block.unknowns, *(p + place for place in block.considered)) for block in design_blocks
    ]
    used_indices = sorted({index for indices in block_indices for index in indices})
    records = [
        RecordData(
            block.series.time,
            block.series.order,
            np.column_stack([block.design, block.fixed]),
            block.series.error,
            block.series.count,
            block.series.block_spacing,
            [used_indices.index(index) for index in indices],
            block.series.trajectory.conditions.start,
            block.series.jitter_variance,
            block.series.variance_ratio,
        )
        for block, indices in zip(design_blocks, block_indices, strict=True)
    ]
    # Priors are data too; what has none is held as loosely as in the solution.
    used_unknowns = [unknowns[index] for index in used_indices]
    prior_sds = np.array(
        [max(unknown.prior_sd, _MIN_PRIOR_U * unknown.limit) for unknown in used_unknowns]
    )
    means = np.array([unknown.prior_mean for unknown in used_unknowns])
    correlation = prior_correlation(used_unknowns)
    prior_rows = whiten_priors(np.eye(len(used_unknowns)), prior_sds, correlation)
    return estimate_noise(
        records, request, prior_rows, whiten_priors(means, prior_sds, correlation)
    )


def information_losses(fit: JointFit, name: str) -> Array:
    """Return the loss of each series' information per unit of each noise variance.

    In the coordinates in which all information is the identity (`Solution.covariance_root`),
    shape (series, 4, f, f); zero for other accelerometers' series.
    """
    root = fit.solution.covariance_root(np.eye(len(fit.model.unknowns)))
    losses = np.zeros((len(fit.design_blocks), len(COMPONENTS), root.shape[1], root.shape[1]))
    for block_index, block in enumerate(fit.design_blocks):
        if block.accelerometer == name:
            series, columns = block.series, block.design @ root[list(block.unknowns)]
            start = series.trajectory.conditions.start
            losses[block_index] = information_loss(
                series.differences, columns, fit.noise[name], start, series.jitter_variance
            )
    return losses


def noise_covariances(
    noise: Mapping[str, Noise], estimates: Mapping[str, NoiseEstimate]
) -> dict[str, Array]:
    """Return the covariance of each noise's variances, (4, 4), of those that are not exact."""
    covariances: dict[str, Array] = {
        name: component.covariance for name, component in estimates.items()
    }
    for name, component in noise.items():
        if component.covariance:
            # What is found here and what another record said are of different components.
            covariances[name] = np.array(component.covariance) + covariances.get(name, 0.0)
    return covariances


def noise_level_dof(fit: JointFit, name: str) -> float:
    """Return how well the level of a noise is known from another record, in degrees of freedom.

    Of the whitened residuals' sum of squares each variance makes a share, by which a change of its
    logarithm changes the log-determinant of their covariance. A wander makes nearly none.
    """
    noise = fit.noise[name]
    if not noise.covariance:
        return math.inf
    series_list = [block.series for block in fit.design_blocks if block.accelerometer == name]
    shares = sum(_row_equivalents(series, noise) for series in series_list)
    gradient, variances = np.zeros((1, len(COMPONENTS))), np.array(noise.variances[: _WALK + 1])
    np.divide(shares, variances, out=gradient[0, : _WALK + 1], where=variances > 0.0)
    rows = sum(series.differences.rows for series in series_list)
    return float(effective_dof([rows], gradient, np.array(noise.covariance))[0])


def _row_equivalents(series: ResidualSeries, noise: Noise) -> Array:
    """Return how many rows' worth of the whitened squares white noise and a walk make, (2,)."""
    upper, lower = math.exp(_LOG_STEP), math.exp(-_LOG_STEP)

    def level(white: float, walk: float) -> float:
        row_variance = white * noise.sample_variance + series.jitter_variance
        return series.differences.factor(row_variance, walk * noise.random_walk**2)[1]

    by_white, by_walk = level(upper, 1.0) - level(lower, 1.0), level(1.0, upper) - level(1.0, lower)
    return np.array([by_white, by_walk]) / (2.0 * _LOG_STEP)


def covariance_sensitivities(
    fit: JointFit, losses_by_name: Mapping[str, Array]
) -> dict[str, Array]:
    """Return the change of the covariance per unit of each noise variance, (4, p, p).

    losses_by_name: Accelerometer -> `information_losses`.
    """
    root = fit.solution.covariance_root(np.eye(len(fit.model.unknowns)))
    return {name: root @ loss.sum(axis=0) @ root.T for name, loss in losses_by_name.items()}


def inflate_covariance(
    fit: JointFit,
    sensitivities: Mapping[str, Array],
    noise: Mapping[str, Noise],
    estimates: Mapping[str, NoiseEstimate],
    dof: float | Array = math.inf,
) -> tuple[JointFit, Array]:
    """Return a fit with what is left open of the variances of noises, and degrees of freedom, (p,).

    The weights are what they are. So the degrees of freedom of a variance are Satterthwaite's,
    those of several accelerometers adding up as their inverses, and a random walk that the records
    do not show but allow adds its share. Considered terms have no part in the weights: their part
    of the covariance stays as it is. Unknowns that are not determined, or known exactly, are left
    as they are.

    sensitivities: Accelerometer -> what each of `COMPONENTS` adds to the covariance per unit,
        (4, p, p).
    noise, estimates: By accelerometer: its noise; how well it is known, where it was estimated.
    dof: Degrees of freedom from all else.
    """
    solution = fit.solution
    variance, inverse = np.diag(solution.covariance), 1.0 / np.full(len(fit.model.unknowns), dof)
    for name, covariance in noise_covariances(noise, estimates).items():
        gradient = np.diagonal(sensitivities[name], axis1=1, axis2=2).T
        inverse += 1.0 / effective_dof(variance, gradient, covariance)
    limits = np.array([unknown.limit for unknown in fit.model.unknowns])
    is_determined = (solution.u > 0.0) & (solution.u < limits)
    walks: dict[str, tuple[float, Array]] = {}
    for name, estimate in estimates.items():
        if estimate.undetected_walk is None:
            continue
        slope = np.where(np.outer(is_determined, is_determined), sensitivities[name][_WALK], 0.0)
        diagonal = np.diag(slope)
        if not diagonal.any():
            continue
        determined_variance = np.where(is_determined, variance, 1.0)
        level, inverse_with_walk = marginal_walk(
            estimate.undetected_walk, determined_variance, diagonal, inverse
        )
        walks[name] = math.sqrt(level), level * slope
        inverse = np.where(is_determined, inverse_with_walk, inverse)
    with np.errstate(divide="ignore"):
        total_dof = 1.0 / inverse
    if not walks:
        return fit, total_dof
    added_covariance = np.sum([covariance for _, covariance in walks.values()], axis=0)
    wider = replace(solution, covariance_undetected=added_covariance)
    return replace(fit, solution=wider, undetected_walks=walks), total_dof


def inflate_for_noise(
    fit: JointFit, estimates: Mapping[str, NoiseEstimate]
) -> tuple[JointFit, Array, dict[str, Array]]:
    """Return a fit as in `inflate_covariance`, degrees of freedom, and `information_losses`."""
    names = noise_covariances(fit.noise, estimates)
    lost = {name: information_losses(fit, name) for name in names}
    wider, dof = inflate_covariance(fit, covariance_sensitivities(fit, lost), fit.noise, estimates)
    return wider, dof, lost


def undetected_walk_covariance(fit: JointFit, estimates: Mapping[str, NoiseEstimate]) -> Array:
    """Return the covariance that undetected walks may add to a fit, (p, p)."""
    with_walk = {
        name: estimate
        for name, estimate in estimates.items()
        if estimate.undetected_walk is not None
    }
    wider, *_ = inflate_for_noise(fit, with_walk)
    addition = wider.solution.covariance_undetected
    return np.zeros_like(fit.solution.covariance) if addition is None else addition
