"""The table of noise components: name, key of a description, symbol, unit and description.

A record contains the white noise of its samples, the white noise of the accelerometer, and the
noise of the accelerometer's bias. The conventions are those of IEEE Std 952.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from counterspin.frozen import frozen


@frozen
class NoiseComponent:
    """A row of the table of noise components."""

    #: Key of the size in a description; empty for the key of the observable (``displacement``).
    key: str
    symbol: str
    unit: str  #: SI unit of the size; empty for the unit of the observable.
    description: str
    #: The upper limit of a component that a record does not show decreases in proportion to this.
    limit_scale: str = ""


#: Field of `counterspin.inference.noise.model.Noise` -> component, in the order of the variances.
NOISE_COMPONENTS: Final[Mapping[str, NoiseComponent]] = {
    "white": NoiseComponent("", "", "", "white noise of the samples"),
    "random_walk": NoiseComponent(
        "acceleration", "N", "m/s^2/Hz^0.5", "white noise of the accelerometer"
    ),
    "flicker": NoiseComponent(
        "flicker",
        "B",
        "m/s^2",
        "flicker (bias instability)",
        "the square root of the length of the record",
    ),
    "bias_walk": NoiseComponent(
        "bias_walk", "K", "m/s^2/s^0.5", "bias random walk", "the length of the record"
    ),
}

#: Names of the components, in the order of `Noise.variances`.
COMPONENTS: Final = tuple(NOISE_COMPONENTS)

#: Names of the components of the bias, which make the noise coloured.
BIAS_COMPONENTS: Final = COMPONENTS[2:]

#: Key of a size that every observable has -> component.
COMPONENTS_BY_KEY: Final = {row.key: row for row in NOISE_COMPONENTS.values() if row.key}

#: Keys of the sizes of `BIAS_COMPONENTS`.
BIAS_KEYS: Final = tuple(NOISE_COMPONENTS[name].key for name in BIAS_COMPONENTS)


def size_keys(observable: str) -> dict[str, str]:
    """Return the key of the size of each component of a record, by component."""
    return {name: row.key or observable for name, row in NOISE_COMPONENTS.items()}
