"""Trials of a study without the sufficient statistics of this package.

- `Plan`: numbers of the paper's plan
- `fit_chunks`: draw every reading of every trial; analyse the trials in chunks
- `fit_with_lstsq`: draw and analyse one trial at a time with `numpy.linalg.lstsq`
- `propagate_uncertainties`: analyse one trial at a time with the `uncertainties` package

The peers obtain from the package what is not part of the comparison: strobe times, noiseless
readings and priors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

#: Trials in a chunk, so that the readings of a run fit into the cache of a core.
CHUNK_SIZE = 1024

COVERAGE_FACTORS = (1.0, 1.96, 2.5758)


@dataclass(frozen=True)
class Plan:
    """Plan of three runs of 100 strobes, with a second stage for K_II and K_F.

    Attributes
    ----------
    times, readings
        By run: strobe times in s, and noiseless displacement errors in m.
    sigma
        Standard deviation of a reading, m.
    curvature_columns
        b2 per unit of K_II and K_F, shape (2, runs).
    known_curvatures
        b2 of the known scale factor, shape (runs,).
    prior
        Value of K_F and its standard uncertainty.
    truth
        True K_II.
    """

    times: Sequence[np.ndarray]
    readings: Sequence[np.ndarray]
    sigma: float
    curvature_columns: np.ndarray
    known_curvatures: np.ndarray
    prior: tuple[float, float]
    truth: float

    def first_stage_gains(self) -> list[np.ndarray]:
        """Return the factors of the readings in b2, by run."""
        return [np.linalg.pinv(np.vander(t, 3, increasing=True))[2] for t in self.times]

    def second_stage_gains(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors of b2 and of the prior of K_F, shape (2, runs + 1), and u."""
        gains = self.first_stage_gains()
        sigma_b2 = [self.sigma * math.sqrt(float(g @ g)) for g in gains]
        weights = 1.0 / np.array([*sigma_b2, self.prior[1]])
        rows = np.vstack([self.curvature_columns.T, [0.0, 1.0]]) * weights[:, None]
        covariance = np.linalg.inv(rows.T @ rows)
        return covariance @ rows.T * weights, np.sqrt(np.diag(covariance))

    def k_ii_weights(self) -> list[np.ndarray]:
        """Return the factors of the readings in K_II, by run."""
        second_gains, _ = self.second_stage_gains()
        return [w * g for w, g in zip(second_gains[0], self.first_stage_gains(), strict=False)]


def fit_chunks(plan: Plan, n_trials: int, seed: int = 1) -> tuple[float, float, np.ndarray]:
    """Return mean and standard deviation of K_II, and the number of intervals with the truth."""
    rng = np.random.Generator(np.random.SFC64(seed))
    gains, (solution_matrix, u) = plan.first_stage_gains(), plan.second_stage_gains()
    prior_term = (
        solution_matrix[0, -1] * plan.prior[0] - solution_matrix[0, :-1] @ plan.known_curvatures
    )
    buffers = [np.empty((CHUNK_SIZE, t.size)) for t in plan.times]
    error_sum, square_sum, n_covered = 0.0, 0.0, np.zeros(len(COVERAGE_FACTORS))
    for start in range(0, n_trials, CHUNK_SIZE):
        n = min(CHUNK_SIZE, n_trials - start)
        k_ii = np.full(n, prior_term)
        for run, buffer in enumerate(buffers):
            readings = buffer[:n]
            rng.standard_normal(out=readings)
            readings *= plan.sigma
            readings += plan.readings[run]
            k_ii += solution_matrix[0, run] * (readings @ gains[run])
        errors = k_ii - plan.truth
        error_sum += float(errors.sum())
        square_sum += float(errors @ errors)
        normalised_errors = np.abs(errors) / u[0]
        n_covered += [np.count_nonzero(normalised_errors <= factor) for factor in COVERAGE_FACTORS]
    mean = error_sum / n_trials
    return mean + plan.truth, math.sqrt(square_sum / n_trials - mean**2), n_covered


def fit_with_lstsq(plan: Plan, n_trials: int, seed: int = 1) -> tuple[float, float]:
    """Return mean and standard deviation of K_II."""
    rng = np.random.default_rng(seed)
    vandermondes = [np.vander(t, 3, increasing=True) for t in plan.times]
    gains = plan.first_stage_gains()
    weights = [1.0 / (plan.sigma * math.sqrt(float(g @ g))) for g in gains]
    weights.append(1.0 / plan.prior[1])
    rows = np.vstack([plan.curvature_columns.T, [0.0, 1.0]]) * np.array(weights)[:, None]
    estimates = np.empty(n_trials)
    for trial in range(n_trials):
        b2 = []
        for design, noiseless in zip(vandermondes, plan.readings, strict=True):
            readings = noiseless + plan.sigma * rng.standard_normal(noiseless.size)
            b2.append(np.linalg.lstsq(design, readings, rcond=None)[0][2])
        observations = np.append(np.array(b2) - plan.known_curvatures, plan.prior[0]) * weights
        estimates[trial] = np.linalg.lstsq(rows, observations, rcond=None)[0][0]
    return float(estimates.mean()), float(estimates.std())


def propagate_uncertainties(plan: Plan, n_trials: int, seed: int = 1) -> float:
    """Return u(K_II) of the last of `n_trials` analyses with the `uncertainties` package."""
    from uncertainties import ufloat

    rng = np.random.default_rng(seed)
    gains, (solution_matrix, _) = plan.first_stage_gains(), plan.second_stage_gains()
    k_ii = ufloat(*plan.prior)
    for _ in range(n_trials):
        k_ii = solution_matrix[0, -1] * ufloat(*plan.prior)
        for run, noiseless in enumerate(plan.readings):
            values = noiseless + plan.sigma * rng.standard_normal(noiseless.size)
            readings = np.array([ufloat(value, plan.sigma) for value in values])
            k_ii += solution_matrix[0, run] * (gains[run] @ readings - plan.known_curvatures[run])
    return float(k_ii.std_dev)
