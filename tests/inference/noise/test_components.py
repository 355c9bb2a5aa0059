"""The table of noise components against the fields of the noise and the keys of [noise]."""

from dataclasses import fields

from counterspin.campaign.settings import OBSERVABLES, StatedNoise
from counterspin.inference.noise.components import BIAS_KEYS, COMPONENTS, size_keys
from counterspin.inference.noise.model import Noise


def test_each_component_is_a_field_of_the_noise_and_a_key_of_a_campaign():
    assert set(COMPONENTS) < {field.name for field in fields(Noise)}
    for observable in OBSERVABLES:
        keys = size_keys(observable)
        assert tuple(keys) == COMPONENTS
        assert set(keys.values()) <= set(StatedNoise.model_fields)
        assert set(BIAS_KEYS) < set(keys.values()) - {observable}


def test_sizes_by_key_become_the_components_of_a_record():
    sizes = {"displacement": 1.0, "velocity": 2.0, "specific_force": 3.0, "acceleration": 4.0}
    sizes |= {"flicker": 5.0, "bias_walk": 6.0, "quantisation": 7.0}
    assert Noise.from_sizes(sizes, "displacement") == Noise(1.0, 4.0, 7.0, 5.0, 6.0)
    # Only a displacement has steps.
    assert Noise.from_sizes(sizes, "velocity") == Noise(2.0, 4.0, 0.0, 5.0, 6.0)
