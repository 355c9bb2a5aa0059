"""Simulated noise against closed forms."""

import math

import numpy as np

from counterspin.inference.noise.components import MIN_FLICKER_FREQUENCY, flicker_autocovariance
from counterspin.inference.noise.model import Noise
from counterspin.inference.noise.simulation import draw_accelerometer_noise, draw_bias_noise


def test_random_walk_has_covariance_of_integrated_white_noise():
    rng = np.random.default_rng(8)
    times = np.array([1.0, 1.5, 3.0, 3.1, 6.0])
    t, walk, trials = times - 1.0, 3e-3, 20000
    early, late = np.minimum.outer(t, t), np.maximum.outer(t, t)
    expected = {1: walk**2 * early, 2: walk**2 * early**2 * (late / 2 - early / 6)}
    for order, covariance in expected.items():
        draws = np.array([draw_accelerometer_noise(rng, times, walk, order) for _ in range(trials)])
        assert not draws[:, 0].any()
        sample_covariance = draws.T @ draws / trials
        # Each product of two normals scatters by sqrt(var var + cov^2).
        size = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)) + covariance**2)
        assert np.all(np.abs(sample_covariance - covariance) <= 4.5 * size / math.sqrt(trials))
        assert np.all(np.abs(draws.mean(axis=0)) <= 4.5 * np.sqrt(np.diag(covariance) / trials))


def test_random_walk_of_specific_force_is_interval_mean():
    rng = np.random.default_rng(9)
    times = np.array([0.0, 0.1, 0.2, 0.6])
    draws = np.array([draw_accelerometer_noise(rng, times, 2e-3, 0) for _ in range(20000)])
    np.testing.assert_allclose(
        draws.var(axis=0), 2e-3**2 / np.array([0.1, 0.1, 0.1, 0.4]), rtol=4.5 * math.sqrt(2 / 20000)
    )
    apart = np.corrcoef(draws.T) - np.eye(4)
    assert np.abs(apart).max() < 4.5 / math.sqrt(20000)


def test_flicker_and_random_walk_have_closed_form_moments():
    """Compare the moments of 3000 draws of 64 samples with the closed forms."""
    rng = np.random.default_rng(1)
    times = np.arange(64) * 2.0
    flicker, walk = Noise(0.0, flicker=1.0), Noise(0.0, bias_walk=0.1)
    draw_wander = np.array([draw_bias_noise(rng, times, flicker, 0) for _ in range(3000)])
    sample_covariance = draw_wander.T @ draw_wander / len(draw_wander)
    exact = flicker_autocovariance(
        np.abs(times[:, None] - times), MIN_FLICKER_FREQUENCY, 0.5 / (times[1] - times[0])
    )
    # A variance of some 3.5 is known to 1.8 %.
    np.testing.assert_allclose(sample_covariance, exact, atol=0.07 * exact[0, 0])
    walks = np.array(
        [draw_bias_noise(rng, times, walk, 0, walk_duration=40.0) for _ in range(3000)]
    )
    expected = 0.01 * (40.0 + times)
    np.testing.assert_allclose(np.mean(walks**2, axis=0), expected, rtol=0.15)


def test_wander_is_integrated_once_per_observable_order():
    times = np.linspace(0.0, 50.0, 501)

    def draw_wander(order):
        noise = Noise(0.0, flicker=2.0, bias_walk=0.5)
        return draw_bias_noise(np.random.default_rng(3), times, noise, order, walk_duration=9.0)

    bias, velocity, position = (draw_wander(order) for order in (0, 1, 2))
    linear = np.concatenate([[0.0], np.cumsum(0.05 * (bias[1:] + bias[:-1]))])
    np.testing.assert_allclose(velocity, linear, rtol=1e-12, atol=1e-12)
    # By Simpson's rule the velocity's parabolas integrate exactly.
    middle = velocity[:-1] + 0.1 * (3 * bias[:-1] + bias[1:]) / 8
    steps = 0.1 * (velocity[:-1] + 4 * middle + velocity[1:]) / 6
    np.testing.assert_allclose(position, np.concatenate([[0.0], np.cumsum(steps)]), rtol=1e-10)
