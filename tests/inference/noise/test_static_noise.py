"""The noise of records at rest: unbiased, with intervals that hold it."""

import math
import os

import numpy as np
import pytest

from counterspin.errors import NotIdentifiableError
from counterspin.inference.noise.components import Sampling
from counterspin.inference.noise.even_sampling import EvenlySampledData
from counterspin.inference.noise.model import Noise
from counterspin.inference.noise.simulation import draw_accelerometer_noise, draw_bias_noise
from counterspin.inference.noise.static_noise import estimate_static_noise

TRIALS = 400 if os.environ.get("COUNTERSPIN_FULL") else 8
STEP = 0.1
N, B = 1e-4, 3e-4


def found(recorded, kind, step=STEP):
    count = recorded.size - kind.order
    time = step * (np.arange(count) - 0.5 * count)
    return estimate_static_noise(
        [EvenlySampledData.from_samples(recorded, step, kind, time[:, None], 1)]
    )


def force(seed, n=1200, walk=0.0):
    rng = np.random.default_rng([7, seed])
    time = np.arange(n) * STEP
    return N / math.sqrt(STEP) * rng.standard_normal(n) + draw_bias_noise(
        rng, time, Noise(0.0, flicker=B, bias_walk=walk), 0
    )


def velocity(values):
    return np.concatenate([[0.0], np.cumsum(values) * STEP])


@pytest.fixture(scope="module")
def trials():
    return [found(velocity(force(seed)), Sampling(1, 0)) for seed in range(TRIALS)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "size"), [("random_walk", N), ("flicker", B)])
def test_sizes_are_unbiased_and_intervals_have_coverage(trials, name, size):
    """Mean within 3.5 of its standard deviations; 95 % intervals miss no more than 1 in 2000."""
    sizes = [trial.components[name] for trial in trials]
    ratio = np.array([one.variance for one in sizes]) / size**2
    assert abs(ratio.mean() - 1.0) < 3.5 * ratio.std() / math.sqrt(TRIALS)
    assert ratio.std() < 0.35
    missed = sum(not one.low <= size**2 <= one.high for one in sizes)
    # Binomial: P(more) < 5e-4.
    assert missed <= (3 if TRIALS == 8 else 37)


def test_absent_components_are_rarely_estimated(trials):
    """At most 5 in 100 of each: P(more) < 5e-4."""
    for name in ("white", "bias_walk"):
        kept = sum(trial.components[name].variance > 0.0 for trial in trials)
        assert kept <= (3 if TRIALS == 8 else 37)
        for new_trial in trials:
            component = new_trial.components[name]
            assert component.high > component.variance >= component.low
            assert component.variance > 0.0 or component.low == 0.0


def test_u_of_drift_matches_scatter(trials):
    z = np.array([trial.drift / trial.u_drift for trial in trials])
    assert abs(z.mean()) < 3.5 / math.sqrt(TRIALS)
    assert 0.6 < z.std() < 1.5


def test_bias_walk_is_separated_from_flicker():
    walk = 2e-4
    size = found(velocity(force(1, 4000, walk)), Sampling(1, 0)).components["bias_walk"]
    assert size.low <= walk**2 <= size.high
    assert size.variance > 0.0


@pytest.mark.parametrize("order", [1, 2])
def test_noise_of_velocities_and_displacements(order):
    """White noise of the record beside N and flicker of the sensor."""
    n = 6000
    rng = np.random.default_rng(order)
    time = np.arange(n) * STEP
    white, walk = {1: (2e-4, 5e-4), 2: (1e-4, 5e-4)}[order]
    recorded = draw_accelerometer_noise(rng, time, walk, order) + white * rng.standard_normal(n)
    recorded = recorded + draw_bias_noise(rng, time, Noise(0.0, flicker=B), order)
    sizes = found(recorded, Sampling(order, order)).components
    for name, size in (("white", white), ("random_walk", walk), ("flicker", B)):
        found_size = sizes[name]
        # Within 3.5 standard deviations, by the half-width of the interval in logarithms.
        half = math.log(found_size.high / found_size.variance)
        assert abs(math.log(found_size.variance / size**2)) < 3.5 / 1.96 * half
        assert half < 1.0


def test_quantisation_of_velocity_is_found_in_force():
    """A force that is differences of rounded velocities: q^2/12 in the velocity, IEEE Std 952."""
    q = 3e-5  # about what the velocity changes by from row to row
    rng = np.random.default_rng(3)
    true = np.cumsum(N * math.sqrt(STEP) * rng.standard_normal(20_000))
    size = found(q * np.round(true / q), Sampling(1, 0)).components["white"]
    assert size.low < q**2 / 12.0 < size.high


def test_bands_reveal_misfit():
    """A resonance: a wave of random phase about 1 Hz, ten times the noise there."""
    rng = np.random.default_rng(9)
    values = force(2)
    ring = np.zeros(values.size)
    for row in range(2, values.size):
        ring[row] = 1.6 * ring[row - 1] - 0.98 * ring[row - 2] + 1e-4 * rng.standard_normal()
    worst = max(found(velocity(values + ring), Sampling(1, 0)).bands, key=lambda b: b.ratio)
    assert worst.ratio > 1.5
    usual = found(velocity(values), Sampling(1, 0)).bands
    assert all(abs(band.ratio - 1.0) < 5.0 * math.sqrt(2.0 / band.count) for band in usual)


def test_too_few_samples_raise():
    with pytest.raises(NotIdentifiableError, match="too short"):
        found(velocity(force(1, 20)), Sampling(1, 0))
