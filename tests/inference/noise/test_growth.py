"""What information loses to more noise: against whitening anew with a little more of it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from counterspin.inference.noise.growth import information_lost
from counterspin.inference.noise.model import COMPONENTS, Differences, Noise, whitener_of

RNG = np.random.default_rng(1)
TIMES = np.cumsum(RNG.uniform(0.05, 0.1, 300))
COLUMNS = np.column_stack([TIMES**2 / 2, np.cos(TIMES), RNG.normal(size=300)])
ADDED = np.linspace(0.0, 0.2, 300)


def information(noise, differences):
    """Start errors are differenced out where there is a walk, be it as small as can be."""
    walking = replace(noise, random_walk=max(noise.random_walk, 1e-12))
    rows = whitener_of(differences, walking, 5.0, ADDED).apply(COLUMNS)
    return rows.T @ rows


@pytest.mark.parametrize("relative", [1.0, 2.5])
@pytest.mark.parametrize("order", [2, 1, 0])
@pytest.mark.parametrize("noise", [Noise(0.3, 0.05), Noise(0.3), Noise(0.3, 0.05, 0.1, 0.02, 0.01)])
def test_it_is_the_derivative_of_the_information(order, noise, relative):
    differences = Differences.of(TIMES, order, 2, 0.02, relative)
    lost = information_lost(differences, COLUMNS, noise, 5.0, ADDED)
    for part, name in zip(lost, COMPONENTS, strict=True):
        level = getattr(noise, name) ** 2
        if name in COMPONENTS[2:] and not noise.wanders:
            assert not part.any()
            continue
        step = 1e-3 * level or 1e-9
        more = information(replace(noise, **{name: math.sqrt(level + step)}), differences)
        less = information(replace(noise, **{name: math.sqrt(max(level - step, 0.0))}), differences)
        slope = (less - more) / (2.0 * step if level else step)
        np.testing.assert_allclose(part, slope, rtol=0, atol=1e-4 * np.abs(part).max())
        assert np.linalg.eigvalsh(part)[0] > -1e-12 * np.abs(part).max()
