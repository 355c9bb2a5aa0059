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

#: Smallest u of a prior in the likelihood, relative to the credible limit of the unknown.
_MIN_PRIOR_U: Final = 1e-12

#: Step of the logarithm of a variance.
_LOG_STEP: Final = 1e-3

_WALK_INDEX: Final = COMPONENTS.index("random_walk")


def estimate_noise_by_accelerometer(
    design_blocks: Sequence[DesignBlock], model: Unknowns, requests: Mapping[str, Noise]
) -> tuple[dict[str, Noise], dict[str, NoiseEstimate]]:
    """Return the noise of each accelerometer, given or estimated by restricted likelihood."""
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
    # More nuisance parameters are negligible in the records of a single accelerometer.
    design_blocks, model = compress_nuisance(design_blocks, model, {})
    # Considered terms are unknowns here; otherwise their effects would count as noise.
    unknowns, p = (*model.unknowns, *model.considered), len(model.unknowns)
    block_indices = [
        (*block.unknowns, *(p + index for index in block.considered)) for block in design_blocks
    ]
    used_indices = sorted({index for indices in block_indices for index in indices})
    records = [
        RecordData(
            block.series.time,
            block.series.order,
            np.column_stack([block.design, block.considered_design]),
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
    # Priors are data too; unknowns without a prior have the regularisation of the solution.
    used_unknowns = [unknowns[index] for index in used_indices]
    prior_sds = np.array(
        [max(unknown.prior_sd, _MIN_PRIOR_U * unknown.limit) for unknown in used_unknowns]
    )
    prior_means = np.array([unknown.prior_mean for unknown in used_unknowns])
    correlation = prior_correlation(used_unknowns)
    prior_rows = whiten_priors(np.eye(len(used_unknowns)), prior_sds, correlation)
    return estimate_noise(
        records, request, prior_rows, whiten_priors(prior_means, prior_sds, correlation)
    )


def information_losses(fit: JointFit, name: str) -> Array:
    """Return the information loss of each series per unit of each noise variance.

    Shape (series, 4, f, f), in the coordinates in which the total information is the identity
    (`Solution.covariance_root`); zero for the series of other accelerometers.
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
    """Return the covariance of the variances of each noise that is not exact, shape (4, 4)."""
    covariances: dict[str, Array] = {name: e.covariance for name, e in estimates.items()}
    for name, component in noise.items():
        if component.covariance:
            # Estimates from these records and from other records are of different components.
            covariances[name] = np.array(component.covariance) + covariances.get(name, 0.0)
    return covariances


def noise_level_dof(fit: JointFit, name: str) -> float:
    """Return the degrees of freedom of a noise level that is known from another record.

    Each variance has a share in the sum of squares of the whitened residuals: the derivative of the
    log-determinant of their covariance with respect to its logarithm. Bias instability has nearly
    none.
    """
    noise = fit.noise[name]
    if not noise.covariance:
        return math.inf
    series_list = [block.series for block in fit.design_blocks if block.accelerometer == name]
    row_equivalents = sum(_row_equivalents(series, noise) for series in series_list)
    gradient = np.zeros((1, len(COMPONENTS)))
    variances = np.array(noise.variances[: _WALK_INDEX + 1])
    np.divide(row_equivalents, variances, out=gradient[0, : _WALK_INDEX + 1], where=variances > 0.0)
    n_rows = sum(series.differences.n_rows for series in series_list)
    return float(effective_dof([n_rows], gradient, np.array(noise.covariance))[0])


def _row_equivalents(series: ResidualSeries, noise: Noise) -> Array:
    """Return the equivalent numbers of rows of white noise and of a random walk, shape (2,)."""
    upper, lower = math.exp(_LOG_STEP), math.exp(-_LOG_STEP)

    def log_determinant(white_factor: float, walk_factor: float) -> float:
        row_variance = white_factor * noise.sample_variance + series.jitter_variance
        return series.differences.factor(row_variance, walk_factor * noise.random_walk**2)[1]

    white_rows, walk_rows = (
        log_determinant(upper, 1.0) - log_determinant(lower, 1.0),
        log_determinant(1.0, upper) - log_determinant(1.0, lower),
    )
    return np.array([white_rows, walk_rows]) / (2.0 * _LOG_STEP)


def covariance_sensitivities(
    fit: JointFit, losses_by_name: Mapping[str, Array]
) -> dict[str, Array]:
    """Return the change of the covariance per unit of each noise variance, shape (4, p, p).

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
    """Return a fit with the uncertainty of estimated noise, and degrees of freedom, shape (p,).

    The weights do not change. The degrees of freedom follow Satterthwaite's formula, in which the
    inverses of several accelerometers add up. An undetected random walk that the records allow adds
    to the covariance. Considered terms, undetermined unknowns and exactly known unknowns are
    unchanged.

    sensitivities: Accelerometer -> change of the covariance per unit of each of `COMPONENTS`,
        shape (4, p, p).
    noise, estimates: Accelerometer -> its noise, and the estimate if it was estimated.
    dof: Degrees of freedom from other sources.
    """
    solution = fit.solution
    variance = np.diag(solution.covariance)
    inverse_dof = 1.0 / np.full(len(fit.model.unknowns), dof)
    for name, covariance in noise_covariances(noise, estimates).items():
        gradient = np.diagonal(sensitivities[name], axis1=1, axis2=2).T
        inverse_dof += 1.0 / effective_dof(variance, gradient, covariance)
    limits = np.array([unknown.limit for unknown in fit.model.unknowns])
    is_determined = (solution.u > 0.0) & (solution.u < limits)
    walks: dict[str, tuple[float, Array]] = {}
    for name, estimate in estimates.items():
        if estimate.undetected_walk is None:
            continue
        walk_sensitivity = np.where(
            np.outer(is_determined, is_determined), sensitivities[name][_WALK_INDEX], 0.0
        )
        diagonal = np.diag(walk_sensitivity)
        if not diagonal.any():
            continue
        determined_variance = np.where(is_determined, variance, 1.0)
        walk_variance, updated_inverse_dof = marginal_walk(
            estimate.undetected_walk, determined_variance, diagonal, inverse_dof
        )
        walks[name] = math.sqrt(walk_variance), walk_variance * walk_sensitivity
        inverse_dof = np.where(is_determined, updated_inverse_dof, inverse_dof)
    with np.errstate(divide="ignore"):
        total_dof = 1.0 / inverse_dof
    if not walks:
        return fit, total_dof
    added_covariance = np.sum([covariance for _, covariance in walks.values()], axis=0)
    inflated_solution = replace(solution, covariance_undetected=added_covariance)
    return replace(fit, solution=inflated_solution, undetected_walks=walks), total_dof


def inflate_for_noise(
    fit: JointFit, estimates: Mapping[str, NoiseEstimate]
) -> tuple[JointFit, Array, dict[str, Array]]:
    """Return a fit as in `inflate_covariance`, degrees of freedom, and `information_losses`."""
    names = noise_covariances(fit.noise, estimates)
    losses = {name: information_losses(fit, name) for name in names}
    inflated_fit, dof = inflate_covariance(
        fit, covariance_sensitivities(fit, losses), fit.noise, estimates
    )
    return inflated_fit, dof, losses


def undetected_walk_covariance(fit: JointFit, estimates: Mapping[str, NoiseEstimate]) -> Array:
    """Return the covariance that undetected walks may add to a fit, shape (p, p)."""
    walk_estimates = {
        name: estimate
        for name, estimate in estimates.items()
        if estimate.undetected_walk is not None
    }
    inflated_fit, *_ = inflate_for_noise(fit, walk_estimates)
    covariance = inflated_fit.solution.covariance_undetected
    return np.zeros_like(fit.solution.covariance) if covariance is None else covariance
