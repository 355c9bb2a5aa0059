"""The transform of an even record at rest, against dense covariances made without it."""

import math

import numpy as np
import pytest

from counterspin.inference.noise import even_sampling
from counterspin.inference.noise.components import Flicker, Sampling, flicker_autocovariance
from counterspin.inference.noise.even_sampling import EvenlySampledData
from counterspin.inference.noise.likelihood import RestrictedLikelihood

STEP = 0.5

#: Variances of white noise, N^2, B^2 and K^2: each of them in turn is what matters.
UNITS = [
    (1e-2, 0.3, 0.5, 1e-3),
    (1e-2, 0.3, 0.05, 0.0),
    (1e-2, 0.02, 3.0, 1e-2),
    (1.0, 1.0, 0.0, 0.1),
]


def dense_covariances(n, order):
    """Of n samples of the specific force, by differences of what is recorded: four parts."""
    differences = np.eye(n + order)
    for _ in range(order):
        differences = np.diff(differences, axis=0) / STEP
    # Means over a step or over a triangle of two, by points inside.
    fine = 6
    times = (np.arange((n + 1) * fine) + 0.5) * STEP / fine
    mean = np.zeros((n, times.size))
    shape = np.ones(1)  # of specific force the samples are points
    for _ in range(order):
        shape = np.convolve(shape, np.full(fine, 1.0 / fine))
    for row in range(n):
        mean[row, row * fine : row * fine + shape.size] = shape
    double = 2.0 / 3.0 * np.eye(n) + (np.eye(n, k=1) + np.eye(n, k=-1)) / 6.0
    lags = flicker_autocovariance(times - times[0], 1e-8, 0.5 / STEP)
    index = np.arange(times.size)
    flicker = lags[np.abs(index[:, None] - index)]
    walk = np.minimum(times[:, None], times)
    velocity = (double if order == 2 else np.eye(n)) / STEP
    wander = (mean @ flicker @ mean.T, mean @ walk @ mean.T)
    return np.stack([differences @ differences.T, velocity, *wander])


def dense_likelihood(covariance, design, values):
    factor = np.linalg.cholesky(covariance)
    columns, rows = np.linalg.solve(factor, design), np.linalg.solve(factor, values)
    left = rows - columns @ np.linalg.lstsq(columns, rows, rcond=None)[0]
    log_det = 2.0 * np.log(np.diag(factor)).sum() + np.linalg.slogdet(columns.T @ columns)[1]
    return -(log_det + left @ left) / 2.0


@pytest.mark.parametrize("order", [0, 1, 2])
def test_likelihood_matches_dense_likelihood_up_to_constant(order):
    """A twentieth of what parts 95 % intervals, 1.92, and 1 % of larger differences."""
    n = 200
    ramp = np.linspace(-1.0, 1.0, n)
    parts = dense_covariances(n, order)
    covariances = np.tensordot(UNITS, parts, axes=1)
    truth = np.linalg.cholesky(covariances[0])
    force = truth @ np.random.default_rng(7).standard_normal(n)
    recorded = force
    for _ in range(order):
        recorded = np.concatenate([[0.0], np.cumsum(recorded) * STEP])
    data = EvenlySampledData.from_samples(recorded, STEP, Sampling(order, order), ramp[:, None], 1)
    likelihood = RestrictedLikelihood.from_records([data], None, None)
    design = np.column_stack([np.ones(n), data.design])
    log_likelihoods = np.array([likelihood.value(0.0, unit) for unit in UNITS])
    exact = np.array([dense_likelihood(covariance, design, force) for covariance in covariances])
    away = exact - exact[0]
    assert away.min() < -20.0
    np.testing.assert_allclose(log_likelihoods - log_likelihoods[0], away, rtol=0.01, atol=0.1)


def test_grouped_rows_match_single_rows(monkeypatch):
    rng = np.random.default_rng(3)
    values = np.cumsum(rng.standard_normal(6000)) * STEP
    ramp = np.linspace(-1.0, 1.0, 5999)[:, None]
    sizes = [(1e-3, 1.0, 1e-3, 1e-6), (1e-2, 0.9, 1e-2, 1e-5)]

    def gain():
        likelihood = RestrictedLikelihood.from_records(
            [EvenlySampledData.from_samples(values, STEP, Sampling(1, 1), ramp, 1)], None, None
        )
        return likelihood.value(0.0, sizes[1]) - likelihood.value(0.0, sizes[0]), likelihood

    grouped, likelihood = gain()
    monkeypatch.setattr(even_sampling, "_UNGROUPED_ROWS", 10**6)
    single, every = gain()
    assert likelihood.records[0].stack.shape[0] < 0.5 * every.records[0].stack.shape[0]
    assert grouped == pytest.approx(single, abs=0.02)


def test_flicker_rows_have_flicker_spectrum():
    """B^2 n/(pi k): 2/T apart from k/(2T), two-sided, B^2/(2 pi f)."""
    covariance = Flicker().transform_covariance(4096, 0)
    k = np.arange(20, 65)
    expected = 4096.0 / (math.pi * k)
    np.testing.assert_allclose(np.diagonal(covariance)[19:], expected, rtol=0.012)
    # Even and odd rows are those of the record's two halves alike and opposite.
    assert np.abs(covariance[::2, 1::2]).max() < 1e-9 * covariance.max()
