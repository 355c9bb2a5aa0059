"""Noise that was found in the records: what its own uncertainty does to the second stage."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.noise.search import effective_dof
from counterspin.inference.noise.unseen_noise import Unseen, lengthened
from counterspin.inference.two_stage.first_stage import Parabola, walk_covariance
from counterspin.inference.two_stage.second_stage import SecondStage


def with_found_noise(second: SecondStage, covariance: Array, unseen: Unseen | None) -> SecondStage:
    """Return the second stage with what the estimate of its noise leaves open.

    The covariance is linear in the white variance and in N^2, the gains being what they are. So
    the degrees of freedom are Satterthwaite's, and a random walk that the records do not show but
    allow adds its share, as in the joint fit (`counterspin.inference.noise.unseen_noise`).

    covariance: Of the noise's variances, (4, 4).
    unseen: Sizes that the records allow a walk which they do not show; None: they show it.
    """
    by_white, by_walk = np.transpose([_by_noise(parabola) for parabola in second.parabolas])
    if second.parabolas[0].sigma_from_residuals:
        # The white noise has the degrees of freedom of the strobes' own residuals.
        by_white = np.zeros_like(by_white)
    fit, gain = second.fit, second.gain
    total = np.diag(fit.solution.covariance)
    gradient = gain**2 @ np.column_stack([by_white, by_walk])
    inverse = 1.0 / second.dof + 1.0 / effective_dof(total, gradient, covariance[:2, :2])
    limits = np.array([unknown.limit for unknown in fit.model.unknowns])
    known = (fit.solution.u > 0.0) & (fit.solution.u < limits) & (gradient[:, 1] > 0.0)
    if unseen is not None and known.any():
        gain = np.where(known[:, None], gain, 0.0)
        slope = (gain * by_walk) @ gain.T
        level, longer = lengthened(unseen, total[known], np.diag(slope)[known])
        share = total[known] / (total + level * np.diag(slope))[known]
        inverse[known] = share**2 * inverse[known] + 1.0 / longer
        hidden = {fit.prepared[0].accelerometer: (math.sqrt(level), level * slope)}
        solution = replace(fit.solution, covariance_unseen=level * slope)
        fit = replace(fit, solution=solution, unseen=hidden)
    with np.errstate(divide="ignore"):
        return replace(second, fit=fit, dof=1.0 / inverse)


def _by_noise(parabola: Parabola) -> tuple[float, float]:
    """Return what b2's variance grows by with the white variance and with N^2."""
    gain, strobes = parabola.gain[2], parabola.strobes
    white = float(np.sum((gain * strobes.noise_factor) ** 2))
    return white, float(gain @ walk_covariance(strobes.time) @ gain)
