"""Intervals of the noise where rows are not the sensor's samples, in seeded trials."""

import os

import numpy as np
import pytest
from scipy.stats import binom

from counterspin.inference.noise import static_noise
from counterspin.inference.noise.static_noise import analyse, split_segments

FULL = bool(os.environ.get("COUNTERSPIN_FULL"))
STEP, SIGMA, SAMPLES, TRIALS = 0.01, 1e-3, 800, 250 if FULL else 8


def lost(part):
    def log(rng, time, values):
        keep = rng.random(time.size) > part
        return time[keep], values[keep]

    return log


def repeated(ratio):
    def log(_, time, values):
        rows = np.arange(int(time.size * ratio))
        places = np.minimum((rows / ratio).astype(int), time.size - 1)
        return rows * STEP / ratio, values[places]

    return log


def repeated_and_lost(rng, time, values):
    return lost(0.1)(rng, *repeated(2.5)(rng, time, values))


def restamped(_, time, values):
    place = np.arange(time.size)
    return time[place - (place % 3 == 2)], values


def in_bursts(rng, time, values):
    """Packets of 8 samples, stamped when they arrive, up to one sample late."""
    packet = np.arange(time.size) // 8
    return (8 * packet + rng.random(time.size)[packet]) * STEP, values


@pytest.mark.slow
@pytest.mark.parametrize(
    "log",
    [lost(0.05), lost(0.2), repeated(2.0), repeated(2.5), repeated_and_lost, restamped, in_bursts],
    ids=["5 % lost", "20 % lost", "2 rows", "2.5 rows", "lost rows", "stamps repeat", "bursts"],
)
def test_intervals_of_white_noise_have_coverage(monkeypatch, log):
    """The coverage falls below the bound with a probability of 1e-4."""
    monkeypatch.setattr(
        static_noise, "_upper_limit", lambda *_: np.inf
    )  # of what is not seen: it takes long
    hold, ratios = 0, []
    for seed in range(TRIALS):
        rng = np.random.default_rng(seed)
        time = np.arange(SAMPLES) * STEP
        values = 9.8 + SIGMA * rng.standard_normal(SAMPLES)
        noise = analyse(split_segments(*log(rng, time, values)), 0).noise
        white = noise.components["random_walk"]
        true = SIGMA**2 * STEP
        hold += white.low <= true <= white.high
        ratios.append(white.variance / true)
        assert noise.components["flicker"].variance == 0.0 or noise.components["flicker"].low == 0.0
    assert hold >= binom.ppf(1e-4, TRIALS, 0.95)
    # The variance of so many samples is known to sqrt(2 / n); the bound is four of its errors.
    assert abs(np.mean(ratios) - 1.0) < 4.0 * np.sqrt(2.0 / (0.8 * SAMPLES * TRIALS))
