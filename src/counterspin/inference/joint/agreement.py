"""Agreement of each run, and of slow residuals, with the other runs.

Each run is left out in turn. With all runs the estimate is the better one, so that the variance of
the shift is what the variance grows by (Hausman, Econometrica 46 (1978) 1251). Where the noise was
estimated, the shift has Student's distribution, and includes noise that the records do not show,
as u does.

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

#: Part of an unknown's u below which a shift's own uncertainty is rounding.
_MIN_RELATIVE_U: Final = 1e-6


def jackknife_runs(estimate: Estimate, index: int) -> list[Jackknife]:
    """Leave each run out in turn, where there are several, for one accelerometer's unknown."""
    unknown, u = estimate.fit.model.unknowns[index], float(estimate.fit.solution.u[index])
    run_names = list(dict.fromkeys(block.run for block in estimate.fit.design_blocks))
    shifts = {run: Jackknife(run) for run in run_names}
    # What nobody asks for need not be apart.
    fit = estimate.compressed_fit or estimate.fit
    runs = [
        run
        for run in run_names
        if (reduced_fit := fit.without_run(run)) is not None
        and float(reduced_fit.u[index]) < unknown.limit
    ]
    variance, dof = _shift_variances(estimate, fit, runs, index)
    for run, variance_of_shift, dof_of_shift in zip(
        runs, variance.tolist(), dof.tolist(), strict=True
    ):
        value = float(_solution_without(fit, run).estimate[index])
        shift = value - float(fit.solution.estimate[index])
        is_resolved = variance_of_shift > (_MIN_RELATIVE_U * u) ** 2
        shifts[run] = Jackknife(
            run,
            value,
            shift,
            shift / math.sqrt(variance_of_shift) if is_resolved else None,
            finite_dof(dof_of_shift) if is_resolved else None,
        )
    return list(shifts.values()) if len(run_names) > 1 else []


def _shift_variances(
    estimated: Estimate, fit: JointFit, runs: Sequence[str], index: int
) -> tuple[Array, Array]:
    """Return the variance of each run's shift and its degrees of freedom, shapes (runs,)."""
    variance = _base_variances(fit, runs, index)
    inverse = np.zeros(len(runs))
    owner = fit.model.unknowns[index].owner
    estimate = estimated.estimated_noise.get(owner)
    covariance = noise_covariances(estimated.fit.noise, estimated.estimated_noise).get(owner)
    if covariance is not None and runs:
        loss = estimated.information_losses.get(owner)
        slopes = shift_variance_sensitivities(
            fit, information_losses(fit, owner) if loss is None else loss, runs, index
        )
        inverse = 1.0 / effective_dof(variance, slopes, covariance)
        if estimate is not None and estimate.undetected_walk is not None:
            slope = slopes[:, COMPONENTS.index("random_walk")]
            variance, inverse = _add_undetected_walk(
                estimate.undetected_walk, variance, slope, inverse
            )
    with np.errstate(divide="ignore"):
        return variance, 1.0 / inverse


def _solution_without(fit: JointFit, run: str) -> Solution:
    solution = fit.without_run(run)
    if solution is None:
        raise ValueError(f"without {run}, no observations remain")
    return solution


def _base_variances(fit: JointFit, runs: Sequence[str], index: int) -> Array:
    """Return the variance of each run's shift, by noise that shows and by what is considered."""
    full = fit.solution
    variances = np.zeros(len(runs))
    for k, run in enumerate(runs):
        reduced_solution = _solution_without(fit, run)
        covariances = [s.covariance_noise + s.covariance_prior for s in (reduced_solution, full)]
        # What is considered moves both, and the shift by the difference.
        sensitivities = [s.sensitivity_considered[index] for s in (reduced_solution, full)]
        considered_shift = (sensitivities[0] - sensitivities[1]) * full.considered_sd
        difference = float(covariances[0][index, index] - covariances[1][index, index])
        variances[k] = max(difference, 0.0) + float(considered_shift @ considered_shift)
    return variances


def shift_variance_sensitivities(
    fit: JointFit, losses: Array, runs: Sequence[str], index: int
) -> Array:
    """Return the change of each shift's variance per unit of each noise variance, (runs, 4).

    Both estimates keep their weights. With C the covariance, and L what the information loses, the
    whole estimate's grows by C L C, that without the run by its own, and their covariance by the
    mixed product; the run itself has no part in the latter two.

    losses: `estimated_noise.information_losses` of the fit.
    """
    full = fit.solution
    unit = np.eye(len(fit.model.unknowns))
    full_root = full.covariance_root(unit[index : index + 1])[0]
    sensitivities = np.zeros((len(runs), losses.shape[1]))
    for k, run in enumerate(runs):
        reduced_solution = _solution_without(fit, run)
        # In the coordinates of the losses, in which the whole's own information is the identity.
        root_without = full.whiten_unknowns(reduced_solution.weighted_covariance[index])
        other_losses = losses[[block.run != run for block in fit.design_blocks]].sum(axis=0)
        root_change = root_without - full_root
        sensitivities[k] = (
            root_change @ other_losses @ root_change
            + full_root @ (losses.sum(axis=0) - other_losses) @ full_root
        )
    return sensitivities


def _add_undetected_walk(
    unseen: UndetectedWalk, variance: Array, slope: Array, inverse: Array
) -> tuple[Array, Array]:
    """Return variances of shifts and inverse degrees of freedom with a walk that does not show."""
    active = (variance > 0.0) & (slope > 0.0)
    if not active.any():
        return variance, inverse
    variance, inverse = variance.copy(), inverse.copy()
    level, inverse[active] = marginal_walk(unseen, variance[active], slope[active], inverse[active])
    variance[active] += level * slope[active]
    return variance, inverse


# Slow residuals --------------------------------------------------------------------------------

#: Cosines beyond the last one that the accelerometer's noise dominates; most of all.
_FURTHER_COSINES: Final = 2
_MAX_COSINES: Final = 24

#: Singular value of columns of unit size below which the unknowns follow all of one.
_RANK_TOLERANCE: Final = 1e-4


@frozen
class SlowResiduals:
    """The slow part of one run's residuals, against those of the other runs."""

    run: str  #: The run.
    ratio: float  #: Its mean square over that of the others.
    p: float  #: Probability of as large a ratio or a larger one by chance, for this run alone.


def compare_slow_residuals(fit: JointFit, accelerometer: str) -> list[SlowResiduals]:
    """Compare the slow residuals of each run of an accelerometer with those of its others."""
    indices = [
        i for i, block in enumerate(fit.design_blocks) if block.accelerometer == accelerometer
    ]
    cosines = [
        Alternative("cosine", str(i), "cosine", {i: column})
        for i in indices
        for column in _cosines(fit, fit.design_blocks[i])
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
    return [_f_test(fit.design_blocks[i], energies, k) for k, i in enumerate(indices)]


def _f_test(block: DesignBlock, energies: list[tuple[float, int]], k: int) -> SlowResiduals:
    from scipy.special import fdtrc

    run_energy, run_dof = energies[k]
    other_energy = sum(energy for energy, _ in energies) - run_energy
    other_dof = sum(count for _, count in energies) - run_dof
    if not run_dof or not other_dof or not other_energy > 0.0:
        return SlowResiduals(block.run, 1.0, 1.0)
    ratio = run_energy / run_dof / (other_energy / other_dof)
    return SlowResiduals(block.run, ratio, float(fdtrc(run_dof, other_dof, ratio)))


def _cosines(fit: JointFit, block: DesignBlock) -> list[Array]:
    """Return cosines of half periods in a record, up to where its own noise is the larger one."""
    series = block.series
    noise = series.total_noise(fit.noise[series.accelerometer])
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
