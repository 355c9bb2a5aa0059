"""The wave that a revolution makes."""

import numpy as np
import pytest

from counterspin.ingest.contents import find_frequency, fit_wave

TIME = np.arange(1000) * 0.02


def test_wave_is_found_with_drift_and_noise():
    noise = 0.3 * np.random.default_rng(1).standard_normal(1000)
    values = 2.5 * np.cos(2 * np.pi * 0.731 * TIME + 0.4) + 0.05 * TIME**2 - TIME + noise
    values[5] = np.nan
    # The variance of a frequency (Rife and Boorstyn): 6 s^2 / (pi^2 A^2 n T^2), here 1.5e-4 Hz.
    assert find_frequency(TIME, values) == pytest.approx(0.731, abs=1e-3)
    amplitude, phase = fit_wave(2 * np.pi * 0.731 * TIME, values)
    assert amplitude == pytest.approx(2.5, abs=0.06)  # 4 s sqrt(2 / n)
    assert phase == pytest.approx(0.4, abs=0.03)


@pytest.mark.parametrize("values", [TIME, TIME**2, np.ones(1000), np.cos(0.3 * TIME)])
def test_non_periodic_values_have_no_frequency(values):
    assert find_frequency(TIME, values) is None
    assert find_frequency(TIME, np.random.default_rng(2).standard_normal(1000)) is None
    assert find_frequency(TIME[:9], values[:9]) is None
