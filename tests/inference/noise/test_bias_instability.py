"""Wander of the bias: its spectrum, and the whitening against dense covariances made without it."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import toeplitz

from counterspin.inference.noise.bias_instability import (
    basis_size,
    coefficient_root,
)
from counterspin.inference.noise.components import MIN_FLICKER_FREQUENCY, flicker_autocovariance
from counterspin.inference.noise.model import Noise, make_whitener

LENGTH = 400.0


def test_autocovariance_matches_spectrum():
    low, high = 1e-3, 2.0
    for lag in (0.0, 0.1, 3.7, 250.0):
        direct, _ = quad(
            lambda u, lag=lag: math.cos(2 * math.pi * math.exp(u) * lag) / math.pi,
            math.log(low),
            math.log(high),
            limit=4000,
        )
        (autocovariance,) = flicker_autocovariance(np.array([lag]), low, high)
        assert autocovariance == pytest.approx(direct, abs=1e-8)


def test_allan_deviation_has_flicker_floor():
    """IEEE Std 952: sigma(tau) = B sqrt(2 ln 2/pi), whatever tau is."""
    for tau in (1.0, 10.0):
        # Allan variance of means over tau: 1/2 <(later - earlier)^2>.
        t = (np.arange(400) + 0.5) * tau / 400
        lags = np.abs(np.concatenate([t, t + tau])[:, None] - np.concatenate([t, t + tau]))
        covariance = flicker_autocovariance(lags, MIN_FLICKER_FREQUENCY, 100.0 / tau)
        means = np.concatenate([np.full(400, -1 / 400), np.full(400, 1 / 400)])
        allan = math.sqrt(0.5 * means @ covariance @ means)
        assert allan == pytest.approx(math.sqrt(2 * math.log(2) / math.pi), rel=0.01)


@pytest.mark.parametrize(
    ("levels", "power"), [((0, 0, 1, 0), 1), ((0, 0, 0, 1), 2)], ids=["flicker", "walk"]
)
def test_spectrum_of_cosines_matches_process(levels, power):
    """Within 4 % over the band that a record of this length has, from 4/T to 0.8 r/(2T)."""
    count, points = 64, 1600
    root = coefficient_root(tuple(map(float, levels)), count, LENGTH, walk_duration=0.0)
    times = (np.arange(points) + 0.5) * LENGTH / points
    bias = np.cos(math.pi * np.outer(times, np.arange(count)) / LENGTH) @ root
    window = 0.5 - 0.5 * np.cos(2 * math.pi * times / LENGTH)
    exact = (
        toeplitz(
            flicker_autocovariance(times - times[0], MIN_FLICKER_FREQUENCY, points / (2 * LENGTH))
        )
        if power == 1
        else np.minimum(times[:, None], times)
    )
    for line in (4, 6, 10, 16, 25):
        wave = np.exp(-2j * math.pi * line * times / LENGTH) * window
        density = float(np.sum(np.abs(wave @ bias) ** 2)) / points**2
        expected = float(np.real(wave @ exact @ wave.conj())) / points**2
        assert density == pytest.approx(expected, rel=0.04)
        # The spectrum itself, but for what the window brings from its neighbours.
        spectrum = (2 * math.pi * line / LENGTH) ** -float(power) / LENGTH
        assert expected == pytest.approx(spectrum * np.mean(window**2), rel=0.25)


def dense(order, noise, times, before, fine=3000):
    """Covariance of rows of point samples, by brute force on a fine grid of the bias."""
    grid = (np.arange(fine) + 0.5) * times[-1] / fine
    step = times[-1] / fine
    high = fine / (2 * times[-1])
    flicker = toeplitz(flicker_autocovariance(grid - grid[0], MIN_FLICKER_FREQUENCY, high))
    bias = noise.flicker**2 * flicker
    bias += noise.bias_walk**2 * (before + np.minimum(grid[:, None], grid))
    later = np.maximum(times[:, None] - grid, 0.0)
    seen = step * (later if order == 2 else (later > 0).astype(float))
    h = times[1]
    a, b = times[:, None], times
    least, most = np.minimum(a, b), np.maximum(a, b)
    walk = least if order == 1 else least**2 * (3 * most - least) / 6
    total = seen @ bias @ seen.T + noise.random_walk**2 * walk
    total += noise.sample_variance * np.eye(times.size)
    assert h > 0
    return total


@pytest.mark.parametrize("walk", [0.0, 2e-5], ids=["white", "with walk"])
@pytest.mark.parametrize("order", [1, 2])
def test_whitened_rows_have_unit_covariance(order, walk):
    times = np.linspace(0.0, 300.0, 151)
    noise = Noise({1: 1e-4, 2: 5e-3}[order], walk, 0.0, flicker=2e-5, bias_walk=1e-6)
    before = 500.0
    whitener = make_whitener(times, order, noise, walk_duration=before)
    operator = whitener.apply(np.eye(times.size))
    covariance = dense(order, noise, times, before)
    np.testing.assert_allclose(
        operator @ covariance @ operator.T, np.eye(whitener.n_rows), atol=6e-3
    )
    rows = whitener.differences.apply(np.eye(times.size))
    _, log_det = np.linalg.slogdet(rows @ covariance @ rows.T)
    assert whitener.log_det == pytest.approx(log_det, abs=3e-3 * times.size)
    # Without it, the wander would be most of what is taken for white noise.
    plain = make_whitener(times, order, Noise(noise.white, walk))
    added = np.diag(plain.apply(np.eye(times.size)) @ covariance @ plain.apply(np.eye(151)).T)
    assert added.max() > 2.0


def test_blocks_are_whitened_like_sample_means():
    """Specific force in blocks of ten: sd 1 for each whitened block of exact means."""
    fine = (np.arange(1000) + 0.5) * 0.1
    noise = Noise(1e-4, 0.0, 0.0, flicker=5e-5, bias_walk=0.0)
    covariance = noise.flicker**2 * flicker_autocovariance(
        np.abs(fine[:, None] - fine), MIN_FLICKER_FREQUENCY, 5.0
    ) + noise.white**2 * np.eye(fine.size)
    means = np.kron(np.eye(100), np.full((1, 10), 0.1))
    whitener = make_whitener(means @ fine, 0, noise, 10.0, 0.1)
    operator = whitener.apply(means)
    np.testing.assert_allclose(np.diag(operator @ covariance @ operator.T), 1.0, atol=0.03)


def test_larger_wander_needs_more_functions():
    quiet = basis_size((1e-4, 0.0, 1e-12, 0.0), 0.02, LENGTH, 2)
    loud = basis_size((1e-4, 0.0, 1e-8, 0.0), 0.02, LENGTH, 2)
    assert quiet < loud < 200
    # At the highest frequency the other noise is a thousand times the wander.
    w = math.pi * loud / LENGTH
    assert 1e-8 / w <= 1e-3 * 1e-4 * 0.02 * w**4
