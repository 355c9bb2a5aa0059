"""u of a record's mean: what the next record differs by, whatever the noise."""

import math

import numpy as np
import pytest

from counterspin.records.mean_scatter import u_of_mean

TRIALS, STRETCHES, EACH = 400, 64, 16


def white(rng):
    return rng.normal(size=2 * STRETCHES * EACH)


def flicker(rng):
    """1/f noise by fractional integration of white noise (Kasdin 1995)."""
    steps = np.arange(1.0, 2 * STRETCHES * EACH)
    response = np.append(1.0, np.cumprod((steps - 0.5) / steps))
    size = 2 * response.size
    return np.fft.irfft(np.fft.rfft(white(rng), size) * np.fft.rfft(response, size))[: size // 2]


def walk(rng):
    return np.cumsum(white(rng))


@pytest.mark.parametrize(
    ("noise", "least"),
    [
        (white, 0.95),
        (flicker, 0.95),
        (walk, 0.88),
        (lambda rng: 3.0 * white(rng) + flicker(rng), 0.93),
        (lambda rng: white(rng) + 0.005 * walk(rng), 0.77),
    ],
    ids=["white", "flicker", "walk", "white and flicker", "a walk that hardly shows"],
)
def test_it_covers_the_mean_of_the_next_record(noise, least):
    """Differences within 2 u sqrt 2 at least as often as stated, less 3 standard errors of 400."""
    rng = np.random.default_rng(1)
    covered, sizes, differences = 0, [], []
    for _ in range(TRIALS):
        first, then = noise(rng).reshape(2, STRETCHES, EACH).mean(axis=2)
        u, difference = u_of_mean(first), first.mean() - then.mean()
        covered += abs(difference) < 2.0 * math.sqrt(2.0) * u
        sizes.append(u)
        differences.append(difference)
    assert covered > TRIALS * least - 3.0 * math.sqrt(TRIALS * least * (1.0 - least))
    # And it is of the size of what it covers, not as large as would cover anything.
    true = math.sqrt(np.mean(np.square(differences)) / 2.0)
    assert 0.5 < np.median(sizes) / true < 1.9


def test_white_noise_costs_half_as_much_again_at_most():
    rng = np.random.default_rng(2)
    found = [u_of_mean(rng.normal(size=STRETCHES)) for _ in range(TRIALS)]
    assert 1.0 < np.median(found) * math.sqrt(STRETCHES) < 1.6


def test_it_goes_with_the_scale_and_not_with_the_level():
    means = np.random.default_rng(3).normal(size=20)
    assert u_of_mean(5.0 + 1e-6 * means) == pytest.approx(1e-6 * u_of_mean(means), rel=1e-6)
    assert u_of_mean(np.full(20, 9.8)) == 0.0
