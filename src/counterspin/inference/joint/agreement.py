"""Agreement of each run, and of slow residuals, with the other runs.

Each run is omitted in turn. The estimate from all runs is efficient, so that the variance of the
shift is the increase of the variance of the estimate (Hausman, Econometrica 46 (1978) 1251). With
estimated noise, the shift has Student's distribution and, like u, includes undetected noise.

The noise of an accelerometer is estimated from the slowest changes of its records. A slow error of
one run therefore increases the estimated noise of all runs, and shifts coefficients that depend on
this run by more than this noise allows. Noise acts in every run. Therefore the slow whitened
residuals of a run, projected onto cosines, are compared with those of the other runs in an F test,
in which the size of the noise cancels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.distributions import finite_dof
from counterspin.inference.joint.alternatives import Alternative, project_columns
from counterspin.inference.joint.design_blocks import DesignBlock
from counterspin.inference.joint.estimated_noise import information_losses, noise_covariances
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.summary import Jackknife
from counterspin.inference.least_squares import Solution
from counterspin.inference.noise.components import COMPONENTS
from counterspin.inference.noise.search import effective_dof
from counterspin.inference.noise.undetected_walk import UndetectedWalk, marginal_walk

#: Fraction of the u of an unknown below which the uncertainty of a shift is rounding error.
_MIN_RELATIVE_U: Final = 1e-6


def jackknife_runs(estimate: Estimate, index: int) -> list[Jackknife]:
    """Return the shift of an unknown without each run; empty for a single run."""
    unknown, u = estimate.fit.model.unknowns[index], float(estimate.fit.solution.u[index])
    run_names = list(dict.fromkeys(block.run for block in estimate.fit.design_blocks))
    shifts = {run: Jackknife(run) for run in run_names}
    # Nuisance parameters may be compressed here.
    fit = estimate.compressed_fit or estimate.fit
    determined_runs = [
        run
        for run in run_names
        if (reduced_fit := fit.without_run(run)) is not None
        and float(reduced_fit.u[index]) < unknown.limit
    ]
    variances, dofs = _shift_variances(estimate, fit, determined_runs, index)
    for run, shift_variance, shift_dof in zip(
        determined_runs, variances.tolist(), dofs.tolist(), strict=True
    ):
        estimate_without_run = float(_solve_without_run(fit, run).estimate[index])
        shift = estimate_without_run - float(fit.solution.estimate[index])
        is_resolved = shift_variance > (_MIN_RELATIVE_U * u) ** 2
        shifts[run] = Jackknife(
            run,
            estimate_without_run,
            shift,
            shift / math.sqrt(shift_variance) if is_resolved else None,
            finite_dof(shift_dof) if is_resolved else None,
        )
    return list(shifts.values()) if len(run_names) > 1 else []


def _shift_variances(
    estimate: Estimate, fit: JointFit, runs: Sequence[str], index: int
) -> tuple[Array, Array]:
    """Return the variance of each run's shift and its degrees of freedom, shapes (runs,)."""
    variances = _known_shift_variances(fit, runs, index)
    inverse_dofs = np.zeros(len(runs))
    owner = fit.model.unknowns[index].owner
    noise_estimate = estimate.estimated_noise.get(owner)
    covariance = noise_covariances(estimate.fit.noise, estimate.estimated_noise).get(owner)
    if covariance is not None and runs:
        losses = estimate.information_losses.get(owner)
        sensitivities = shift_variance_sensitivities(
            fit, information_losses(fit, owner) if losses is None else losses, runs, index
        )
        inverse_dofs = 1.0 / effective_dof(variances, sensitivities, covariance)
        if noise_estimate is not None and noise_estimate.undetected_walk is not None:
            walk_sensitivities = sensitivities[:, COMPONENTS.index("random_walk")]
            variances, inverse_dofs = _add_undetected_walk(
                noise_estimate.undetected_walk, variances, walk_sensitivities, inverse_dofs
            )
    with np.errstate(divide="ignore"):
        return variances, 1.0 / inverse_dofs


def _solve_without_run(fit: JointFit, run: str) -> Solution:
    solution = fit.without_run(run)
    if solution is None:
        raise ValueError(f"without {run}, no observations remain")
    return solution


def _known_shift_variances(fit: JointFit, runs: Sequence[str], index: int) -> Array:
    """Return the variance of each shift due to detected noise, priors and considered terms."""
    full_solution = fit.solution
    variances = np.zeros(len(runs))
    for k, run in enumerate(runs):
        reduced_solution = _solve_without_run(fit, run)
        covariances = [
            s.covariance_noise + s.covariance_prior for s in (reduced_solution, full_solution)
        ]
        # A considered term shifts both estimates.
        sensitivities = [s.sensitivity_considered[index] for s in (reduced_solution, full_solution)]
        considered_shift = (sensitivities[0] - sensitivities[1]) * full_solution.considered_sd
        variance_difference = float(covariances[0][index, index] - covariances[1][index, index])
        variances[k] = max(variance_difference, 0.0) + float(considered_shift @ considered_shift)
    return variances


def shift_variance_sensitivities(
    fit: JointFit, losses: Array, runs: Sequence[str], index: int
) -> Array:
    """Return the change of each shift's variance per unit of each noise variance, (runs, 4).

    Both estimates keep their weights. With covariance C and information loss L, the variance of an
    estimate grows by C L C, and the covariance of both estimates by the mixed product. Only the
    variance of the estimate from all runs contains the loss of the omitted run.

    losses: `estimated_noise.information_losses` of the fit.
    """
    full_solution = fit.solution
    identity = np.eye(len(fit.model.unknowns))
    full_root = full_solution.covariance_root(identity[index : index + 1])[0]
    sensitivities = np.zeros((len(runs), losses.shape[1]))
    for k, run in enumerate(runs):
        reduced_solution = _solve_without_run(fit, run)
        # In the coordinates of the losses, in which the information of all runs is the identity.
        reduced_root = full_solution.whiten_unknowns(reduced_solution.weighted_covariance[index])
        other_losses = losses[[block.run != run for block in fit.design_blocks]].sum(axis=0)
        root_change = reduced_root - full_root
        sensitivities[k] = (
            root_change @ other_losses @ root_change
            + full_root @ (losses.sum(axis=0) - other_losses) @ full_root
        )
    return sensitivities


def _add_undetected_walk(
    walk: UndetectedWalk, variances: Array, sensitivities: Array, inverse_dofs: Array
) -> tuple[Array, Array]:
    """Return variances of shifts and inverse degrees of freedom with an undetected walk."""
    is_affected = (variances > 0.0) & (sensitivities > 0.0)
    if not is_affected.any():
        return variances, inverse_dofs
    variances, inverse_dofs = variances.copy(), inverse_dofs.copy()
    walk_variance, inverse_dofs[is_affected] = marginal_walk(
        walk, variances[is_affected], sensitivities[is_affected], inverse_dofs[is_affected]
    )
    variances[is_affected] += walk_variance * sensitivities[is_affected]
    return variances, inverse_dofs


# Slow residuals --------------------------------------------------------------------------------

#: Number of cosines after the last one that the noise of the accelerometer dominates.
_EXTRA_COSINES: Final = 2
_MAX_COSINES: Final = 24

#: Singular value of unit columns below which the unknowns explain a combination completely.
_RANK_TOLERANCE: Final = 1e-4


@frozen
class SlowResiduals:
    """Comparison of the slow residuals of a run with those of the other runs."""

    run: str  #: Name of the run.
    ratio: float  #: Mean square of the run over that of the other runs.
    p: float  #: Probability of a ratio at least this large by chance, for this run alone.


def compare_slow_residuals(fit: JointFit, accelerometer: str) -> list[SlowResiduals]:
    """Compare the slow residuals of each run of an accelerometer with those of its other runs."""
    indices = [
        i for i, block in enumerate(fit.design_blocks) if block.accelerometer == accelerometer
    ]
    cosines = [
        Alternative("cosine", str(i), "cosine", {i: column})
        for i in indices
        for column in _slow_cosines(fit, fit.design_blocks[i])
    ]
    if len(indices) < 2:
        return []
    projection = project_columns(fit, cosines)
    columns = projection.columns / np.sqrt(projection.squared_norms)
    energies = []
    for i in indices:
        run_columns = columns[:, [cosine.owner == str(i) for cosine in cosines]]
        left_vectors, singular_values, _ = np.linalg.svd(run_columns, full_matrices=False)
        basis = left_vectors[:, singular_values > _RANK_TOLERANCE]
        energies.append((float(np.sum((basis.T @ projection.residual) ** 2)), basis.shape[1]))
    return [_compare_energies(fit.design_blocks[i], energies, k) for k, i in enumerate(indices)]


def _compare_energies(
    block: DesignBlock, energies: list[tuple[float, int]], k: int
) -> SlowResiduals:
    from scipy.special import fdtrc

    run_energy, run_dof = energies[k]
    other_energy = sum(energy for energy, _ in energies) - run_energy
    other_dof = sum(count for _, count in energies) - run_dof
    if not run_dof or not other_dof or not other_energy > 0.0:
        return SlowResiduals(block.run, 1.0, 1.0)
    ratio = run_energy / run_dof / (other_energy / other_dof)
    return SlowResiduals(block.run, ratio, float(fdtrc(run_dof, other_dof, ratio)))


def _slow_cosines(fit: JointFit, block: DesignBlock) -> list[Array]:
    """Return cosines of half periods of a record, up to the corner frequency of its noise."""
    series = block.series
    noise = series.total_noise(fit.noise[series.accelerometer])
    duration = float(series.time[-1] - series.time[0])
    sample_interval = duration / float(np.sum(series.count))
    white_density = math.sqrt(noise.sample_variance * sample_interval)
    n_cosines = _MAX_COSINES
    if (
        series.order
        and noise.random_walk < white_density * (math.pi * _MAX_COSINES / duration) ** series.order
    ):
        corner_frequency = (noise.random_walk / white_density) ** (1.0 / series.order)
        n_cosines = min(
            _MAX_COSINES, math.ceil(corner_frequency * duration / math.pi) + _EXTRA_COSINES
        )
    phase = math.pi * (series.time - series.time[0]) / duration
    return [np.cos(j * phase) for j in range(1, n_cosines + 1)]
