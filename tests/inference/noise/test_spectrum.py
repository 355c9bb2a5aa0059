"""Spectrum and lines of records whose spectrum and lines are known."""

import math

import numpy as np
import pytest

from counterspin.inference.noise.components import Sampling
from counterspin.inference.noise.model import Noise
from counterspin.inference.noise.simulation import draw_bias_noise
from counterspin.inference.noise.spectrum import find_lines, spectrum

STEP = 0.01


def noise(seed, n=20_000):
    return 1e-3 * np.random.default_rng(seed).standard_normal(n)


def test_white_noise_has_constant_density():
    """Of some forty intervals of 95 % at most 6 miss: 1.5 % of such records have more."""
    density = 1e-6 * STEP
    points = spectrum(noise(1), STEP, Sampling(1, 0), (0.0, density, 0.0, 0.0))
    missed = [point for point in points if not point.low <= density <= point.high]
    assert len(points) > 25
    assert [point.expected for point in points] == pytest.approx([density] * len(points))
    assert len(missed) <= 6
    assert points[0].frequency < 0.2
    assert points[-1].frequency > 40.0
    total = sum(point.density * point.dof for point in points) / sum(p.dof for p in points)
    assert total == pytest.approx(density, rel=0.03)


def test_noise_has_no_lines():
    for seed in range(8):
        rng, components = np.random.default_rng(seed), Noise(0.0, flicker=5e-4, bias_walk=1e-5)
        wander = draw_bias_noise(rng, np.arange(20_000) * STEP, components, 0)
        record = noise(seed) + wander
        lines, remainder = find_lines(record, STEP)
        assert lines == []
        assert remainder is record


def test_lines_of_white_noise_are_as_rare_as_stated():
    """The noise floor at low frequencies is a median of few values."""
    rng = np.random.default_rng(1)
    records = rng.standard_normal((400, 2_000))
    assert sum(bool(find_lines(record, STEP)[0]) for record in records) <= 2


def test_lines_are_found_with_uncertainty():
    """z of 20 trials: the mean within 4 of its standard deviations, the rms within 3 of its."""
    time = np.arange(20_000) * STEP
    z = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        record = noise(100 + seed) + draw_bias_noise(rng, time, Noise(0.0, flicker=2e-4), 0)
        record += 2e-4 * np.cos(2.0 * math.pi * 12.3456 * time + seed)
        record += 5e-4 * np.sin(2.0 * math.pi * 49.98 * time)
        lines, remainder = find_lines(record, STEP)
        first, second = sorted(lines, key=lambda line: line.frequency)
        z.append(
            [
                (first.frequency - 12.3456) / first.u_frequency,
                (first.amplitude - 2e-4) / first.u,
                (second.frequency - 49.98) / second.u_frequency,
                (second.amplitude - 5e-4) / second.u,
            ]
        )
        assert find_lines(remainder, STEP)[0] == []
    assert np.all(np.abs(np.mean(z, axis=0)) < 4.0 / math.sqrt(20.0))
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert np.all((rms > 0.55) & (rms < 1.5))


def test_short_record_has_no_lines():
    record = np.cos(np.arange(100.0))
    assert find_lines(record, STEP) == ([], record)
