"""Noise that was found in the records: what its own uncertainty does to the second stage.

- `with_found_noise`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.noise.unseen_noise import lengthened
from counterspin.inference.noise.variance_components import VarianceComponents, effective_dof
from counterspin.inference.two_stage.first_stage import Parabola, walk_covariance
from counterspin.inference.two_stage.second_stage import SecondStage, StrobedRun


def with_found_noise(
    second: SecondStage, runs: Sequence[StrobedRun], components: VarianceComponents
) -> SecondStage:
    """Return the second stage with what the estimate of its noise leaves open.

    The covariance is linear in the white variance and in N^2, the gains being what they are. So
    the degrees of freedom are Satterthwaite's, and a random walk that the records do not show but
    allow adds its share, as in the joint fit
    (`counterspin.inference.noise.unseen_noise`).

    Parameters
    ----------
    second
        Resolved with this noise.
    runs
        What it was resolved from.
    components
        Of the accelerometer's records.
    """
    by_white, by_walk = np.transpose([_by_noise(run.parabola) for run in runs])
    if runs[0].parabola.sigma_from_residuals:
        # The white noise has the degrees of freedom of the strobes' own residuals.
        by_white = np.zeros_like(by_white)
    solution = second.solution
    noise, total = np.diag(solution.covariance_noise), np.diag(solution.covariance)
    gradient = second.gain**2 @ np.column_stack([by_white, by_walk])
    inverse = 1.0 / second.dof + 1.0 / effective_dof(noise, gradient, components.covariance)
    limits = np.array([second.request.limit_of(symbol) for symbol in second.symbols])
    known = (solution.u > 0.0) & (solution.u < limits) & (gradient[:, 1] > 0.0)
    if components.unseen is None or not known.any():
        return replace(second, dof=_reciprocal(inverse))
    gain = np.where(known[:, None], second.gain, 0.0)
    slope = (gain * by_walk) @ gain.T
    noise, total, diagonal = (part[known] for part in (noise, total, np.diag(slope)))
    level, longer = lengthened(components.unseen, total, diagonal)
    added = level * diagonal
    # Of the whole variance first, then of the part that is noise.
    whole = inverse[known] * np.square(noise / (total + added)) + 1.0 / longer
    inverse[known] = whole * np.square((total + added) / (noise + added))
    return replace(
        second,
        dof=_reciprocal(inverse),
        solution=replace(solution, covariance_unseen=level * slope),
    )


def _by_noise(parabola: Parabola) -> tuple[float, float]:
    """Return what b2's variance grows by with the white variance and with N^2."""
    gain, strobes = parabola.gain[2], parabola.strobes
    white = float(np.sum((gain * strobes.noise_factor) ** 2))
    return white, float(gain @ walk_covariance(strobes.time) @ gain)


def _reciprocal(inverse: Array) -> Array:
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / inverse)
