"""The table of noise components against the fields of the noise and the keys of [noise]."""

from dataclasses import fields

import numpy as np
import pytest

from counterspin.campaign.settings import OBSERVABLES, StatedNoise
from counterspin.inference.noise.components import (
    BIAS_COMPONENTS,
    BIAS_COMPONENTS_BY_KEY,
    COMPONENTS,
    Sampling,
    component_keys,
)
from counterspin.inference.noise.model import Noise


def test_component_is_field_of_noise_and_key_of_campaign():
    assert set(COMPONENTS) < {field.name for field in fields(Noise)}
    for observable in OBSERVABLES:
        keys = component_keys(observable)
        assert tuple(keys) == COMPONENTS
        assert set(keys.values()) <= set(StatedNoise.model_fields)
        assert set(BIAS_COMPONENTS_BY_KEY) < set(keys.values()) - {observable}


def test_noise_from_sizes_by_key():
    sizes = {"displacement": 1.0, "velocity": 2.0, "specific_force": 3.0, "acceleration": 4.0}
    sizes |= {"flicker": 5.0, "bias_walk": 6.0, "quantisation": 7.0}
    assert Noise.from_sizes(sizes, "displacement") == Noise(1.0, 4.0, 7.0, 5.0, 6.0)
    # Only a displacement has steps.
    assert Noise.from_sizes(sizes, "velocity") == Noise(2.0, 4.0, 0.0, 5.0, 6.0)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_density_of_slow_samples_is_density_of_bias(order):
    """At a hundredth of the sampling rate, means and aliases change a density by less than 1 %."""
    step, angle = 0.2, 2.0 * np.pi * 0.01
    for component in BIAS_COMPONENTS.values():
        sampled = component.sampled_density(np.array([angle]), step, Sampling(order, order))[0]
        assert step * sampled == pytest.approx(
            1.0 / component.inverse_density(angle / step), rel=0.01
        )
