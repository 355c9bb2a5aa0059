"""How a study draws noise: that of whole records, or of the numbers that sum them up."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.physics import simulation

WHITE: Final = "noise.displacement"  #: of a sample, m

#: Level that may vary -> its unit and its field of `RecordNoise`.
NOISE_LEVELS: Final[Mapping[str, tuple[str, str]]] = {
    WHITE: ("m", "white"),
    "noise.acceleration": ("m/s^2/Hz^0.5", "random_walk"),
    "noise.flicker": ("m/s^2", "flicker"),
    "noise.bias_walk": ("m/s^2/s^0.5", "bias_walk"),
    "noise.quantisation": ("m", "quantisation"),
    "noise.angle": ("rad", "angle"),
    "noise.timing": ("s", "timing"),
}

#: Streams of a batch: the truth and the noise are drawn apart.
TRUTH_STREAM: Final = 0
NOISE_STREAM: Final = 1


def stream(seed: int, batch: int, which: int) -> np.random.Generator:
    """Return the random numbers of one batch, for its truth or for its noise.

    batch: Number of the batch, from 0.
    """
    sequence = np.random.SeedSequence(seed, spawn_key=(batch, which))
    return np.random.Generator(np.random.SFC64(sequence))


@frozen
class RecordNoise:
    """Noise of whole records."""

    white: float = 0.0  #: Standard deviation of a sample's displacement, m.
    random_walk: float = 0.0  #: Coefficient N of the accelerometer's white noise, m/s^2/Hz^0.5.
    quantisation: float = 0.0  #: Step of the recorded displacement, m.
    #: Standard deviations of a recorded angle and of a time stamp, rad and s.
    angle: float = 0.0
    timing: float = 0.0
    #: Wander of the accelerometer's bias: m/s^2, m/s^2/s^0.5.
    flicker: float = 0.0
    bias_walk: float = 0.0

    @property
    def wanders(self) -> bool:
        """Whether the bias wanders."""
        return self.flicker > 0.0 or self.bias_walk > 0.0

    def stamps(self, generator: np.random.Generator, times: Array) -> Array:
        """Return the time stamps of samples taken at these times, s."""
        return np.asarray(times + self.timing * generator.standard_normal(times.size))

    def angles(self, generator: np.random.Generator, angles: Array) -> Array:
        """Return these angles as they are recorded, rad."""
        return np.asarray(angles + self.angle * generator.standard_normal(angles.size))

    def displacements(
        self,
        generator: np.random.Generator,
        times: Array,
        displacements: Array,
        before: float = 0.0,
    ) -> Array:
        """Return these displacements, m, as recorded `before` s after a bias began to walk."""
        if self.wanders:
            displacements = displacements + simulation.bias_wander(
                generator, times, self.flicker, self.bias_walk, 2, before
            )
        walk = simulation.accelerometer_walk(generator, times, self.random_walk, 2)
        recorded = displacements + walk + self.white * generator.standard_normal(times.size)
        step = self.quantisation
        return np.asarray(np.round(recorded / step) * step if step > 0.0 else recorded)


def curvature_noise(
    generator: np.random.Generator, white: Array, sizes: Array, trials: int
) -> Array:
    """Return what white noise adds to b2, m/s^2, shape (runs, trials).

    white: Standard deviation of a strobe in each trial, m, shape (trials,) or (1,).
    sizes: sigma/u(b2) of each run, s^2, shape (runs, trials) or (runs, 1).
    """
    noise = generator.standard_normal((sizes.shape[0], trials))
    noise *= white / sizes
    return noise


def residual_variances(
    generator: np.random.Generator, white: Array, dof: Array, trials: int
) -> Array:
    """Return the variance that the residuals of each run show, m^2, shape (runs, trials).

    dof: Degrees of freedom of each run's residuals, shape (runs,).
    """
    variances = np.stack([generator.standard_gamma(0.5 * freedom, trials) for freedom in dof])
    variances *= 2.0 * white**2 / dof[:, None]
    return variances


def estimate_noise(
    generator: np.random.Generator, spread: Array, scale: Array | float, trials: int
) -> Array:
    """Return what noise adds to the estimates of a joint fit, shape (c, trials).

    spread: A square root of the estimates' covariance, shape (c, c).
    scale: True over assumed noise, shape (trials,) or one number.
    """
    noise: Array = spread @ generator.standard_normal((spread.shape[1], trials))
    noise *= scale
    return noise
