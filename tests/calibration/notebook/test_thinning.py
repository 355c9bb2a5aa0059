"""Thinned residuals show what all of them would: extremes, means, the spectrum's level, tails."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtri

from counterspin.calibration.notebook.thinning import (
    normal_quantiles,
    over_revolution,
    smoothed_spectrum,
    stretches,
)
from counterspin.inference.diagnostics import periodogram


@given(st.integers(1, 300), st.integers(1, 50), st.integers(0, 2**32 - 1))
def test_no_sample_falls_outside_its_stretch(n, count, seed):
    values = np.random.default_rng(seed).standard_normal(n)
    middle, low, high = stretches(np.arange(n) / 7.0, values, count)
    assert middle.size == min(n, count)
    assert (np.diff(middle) > 0).all()
    assert low.min() == values.min()
    assert high.max() == values.max()


def test_a_stretch_of_one_sample_is_that_sample():
    middle, low, high = stretches(np.array([0.0, 1.0, 5.0]), np.array([3.0, -1.0, 2.0]), 10)
    np.testing.assert_array_equal(middle, [0.0, 1.0, 5.0])
    np.testing.assert_array_equal(low, [3.0, -1.0, 2.0])
    np.testing.assert_array_equal(high, low)


def test_over_a_revolution_by_hand():
    angle = np.array([0.1, 0.2, 2 * np.pi + 0.3, np.pi + 0.1, -0.1])
    low, mean, high = over_revolution(angle, np.array([1.0, 2.0, 6.0, -4.0, 9.0]), 4)
    np.testing.assert_array_equal(low, [1.0, np.nan, -4.0, 9.0])
    np.testing.assert_array_equal(mean, [3.0, np.nan, -4.0, 9.0])
    np.testing.assert_array_equal(high, [6.0, np.nan, -4.0, 9.0])


def test_an_angle_that_rounding_takes_to_the_next_revolution_is_still_in_this_one():
    low, _, _ = over_revolution(np.array([-1e-20]), np.array([1.0]), 7)
    assert np.flatnonzero(np.isfinite(low)).size == 1


@pytest.mark.parametrize("n", [3, 4, 1000, 20001])
def test_spectrum_has_the_power_of_its_samples(n):
    """Parseval: the lines' powers, both signs, add up to the sum of squares less the ends'."""
    x = np.random.default_rng(n).standard_normal(n)
    frequency, power, each = smoothed_spectrum(
        periodogram(x), n * 0.5, 10**6
    )  # every line in a band of its own
    assert (each == 1).all()
    lines = (n - 1) // 2
    np.testing.assert_allclose(frequency, np.arange(1, lines + 1) / (n * 0.5))
    ends = x.sum() ** 2 / n
    if n % 2 == 0:
        ends += (x * (-1.0) ** np.arange(n)).sum() ** 2 / n
    assert 2 * power.sum() + ends == pytest.approx(x @ x)


def test_spectrum_of_a_line_stands_in_its_band():
    n, interval, cycles = 4096, 0.02, 200
    x = np.sin(2 * np.pi * cycles * np.arange(n) / n)
    frequency, power, each = smoothed_spectrum(periodogram(x), n * interval, 60)
    assert each.sum() == (n - 1) // 2
    peak = int(np.argmax(power))
    assert frequency[peak] == pytest.approx(cycles / (n * interval), rel=0.1)
    assert np.delete(power, peak).max() < 1e-20


def test_white_noise_has_power_one():
    n = 100_000
    x = np.random.default_rng(1).standard_normal(n)
    _, power, _ = smoothed_spectrum(periodogram(x), float(n), 10)
    # The last band holds more than half of the n/2 lines, each with standard deviation 1.
    assert power[-1] == pytest.approx(1.0, abs=4.0 / np.sqrt(n / 4))


def test_quantiles_keep_the_tails_and_are_blom_s_scores():
    x = np.random.default_rng(2).standard_normal(5000)
    normal, found = normal_quantiles(x, 50)
    assert found[0] == x.min()
    assert found[-1] == x.max()
    assert normal.size <= 50
    ranks = np.searchsorted(np.sort(x), found) + 1
    np.testing.assert_allclose(normal, ndtri((ranks - 0.375) / 5000.25))
    # Few samples: all of them.
    normal, found = normal_quantiles(np.array([2.0, -1.0, 0.5]), 50)
    np.testing.assert_array_equal(found, [-1.0, 0.5, 2.0])
    np.testing.assert_allclose(normal, [-normal[2], 0.0, normal[2]], atol=1e-15)
