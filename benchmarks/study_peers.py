"""A study's trials as they are done without this package's shortcuts.

- `Plan`: the paper's plan as numbers
- `brute_force`: every reading of every trial drawn, all trials of a chunk at once
- `one_by_one`: the same, a trial at a time with `numpy.linalg.lstsq`
- `with_uncertainties`: one analysis carried through the `uncertainties` package

The peers get from the package what is no part of the comparison: times of the strobes, the
readings without noise, what is known beforehand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

#: Trials worked on at once: readings of a run then fit a core's cache.
CHUNK = 1024

FACTORS = (1.0, 1.96, 2.5758)


@dataclass(frozen=True)
class Plan:
    """Three runs of 100 strobes, and a second stage for K_II and K_F.

    Attributes
    ----------
    times, readings
        Of each run: strobe times in s, displacement errors without noise in m.
    sigma
        Noise of a reading, m.
    columns
        b2 per unit of K_II and K_F, shape (2, runs).
    known
        b2 of what is known beforehand, shape (runs,).
    prior
        K_F and its standard uncertainty.
    truth
        K_II.
    """

    times: Sequence[np.ndarray]
    readings: Sequence[np.ndarray]
    sigma: float
    columns: np.ndarray
    known: np.ndarray
    prior: tuple[float, float]
    truth: float

    def first_stage(self) -> list[np.ndarray]:
        """Return of each run what the readings are multiplied with for b2."""
        return [np.linalg.pinv(np.vander(t, 3, increasing=True))[2] for t in self.times]

    def second_stage(self) -> tuple[np.ndarray, np.ndarray]:
        """Return what the runs' b2 and K_F's prior are multiplied with, (2, runs + 1); and u."""
        gains = self.first_stage()
        sigma_b2 = [self.sigma * math.sqrt(float(g @ g)) for g in gains]
        weights = 1.0 / np.array([*sigma_b2, self.prior[1]])
        rows = np.vstack([self.columns.T, [0.0, 1.0]]) * weights[:, None]
        covariance = np.linalg.inv(rows.T @ rows)
        return covariance @ rows.T * weights, np.sqrt(np.diag(covariance))

    def readings_to_k_ii(self) -> list[np.ndarray]:
        """Return of each run what the readings are multiplied with for K_II."""
        solve, _ = self.second_stage()
        return [w * g for w, g in zip(solve[0], self.first_stage(), strict=False)]


def brute_force(plan: Plan, trials: int, seed: int = 1) -> tuple[float, float, np.ndarray]:
    """Return mean and standard deviation of K_II, and how many intervals held the truth."""
    generator = np.random.Generator(np.random.SFC64(seed))
    gains, (solve, u) = plan.first_stage(), plan.second_stage()
    fixed = solve[0, -1] * plan.prior[0] - solve[0, :-1] @ plan.known
    buffers = [np.empty((CHUNK, t.size)) for t in plan.times]
    total, squares, covered = 0.0, 0.0, np.zeros(len(FACTORS))
    for start in range(0, trials, CHUNK):
        n = min(CHUNK, trials - start)
        k_ii = np.full(n, fixed)
        for run, buffer in enumerate(buffers):
            part = buffer[:n]
            generator.standard_normal(out=part)
            part *= plan.sigma
            part += plan.readings[run]
            k_ii += solve[0, run] * (part @ gains[run])
        error = k_ii - plan.truth
        total += float(error.sum())
        squares += float(error @ error)
        size = np.abs(error) / u[0]
        covered += [np.count_nonzero(size <= factor) for factor in FACTORS]
    mean = total / trials
    return mean + plan.truth, math.sqrt(squares / trials - mean**2), covered


def one_by_one(plan: Plan, trials: int, seed: int = 1) -> tuple[float, float]:
    """Return mean and standard deviation of K_II."""
    generator = np.random.default_rng(seed)
    designs = [np.vander(t, 3, increasing=True) for t in plan.times]
    gains = plan.first_stage()
    weights = [1.0 / (plan.sigma * math.sqrt(float(g @ g))) for g in gains]
    weights.append(1.0 / plan.prior[1])
    rows = np.vstack([plan.columns.T, [0.0, 1.0]]) * np.array(weights)[:, None]
    found = np.empty(trials)
    for trial in range(trials):
        b2 = []
        for design, clean in zip(designs, plan.readings, strict=True):
            readings = clean + plan.sigma * generator.standard_normal(clean.size)
            b2.append(np.linalg.lstsq(design, readings, rcond=None)[0][2])
        right = np.append(np.array(b2) - plan.known, plan.prior[0]) * weights
        found[trial] = np.linalg.lstsq(rows, right, rcond=None)[0][0]
    return float(found.mean()), float(found.std())


def with_uncertainties(plan: Plan, trials: int, seed: int = 1) -> float:
    """Return the u(K_II) that the `uncertainties` package propagates; each trial an analysis."""
    from uncertainties import ufloat

    generator = np.random.default_rng(seed)
    gains, (solve, _) = plan.first_stage(), plan.second_stage()
    k_ii = ufloat(*plan.prior)
    for _ in range(trials):
        k_ii = solve[0, -1] * ufloat(*plan.prior)
        for run, clean in enumerate(plan.readings):
            drawn = clean + plan.sigma * generator.standard_normal(clean.size)
            readings = np.array([ufloat(value, plan.sigma) for value in drawn])
            k_ii += solve[0, run] * (gains[run] @ readings - plan.known[run])
    return float(k_ii.std_dev)
