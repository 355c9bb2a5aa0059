"""Table of noise components: unit, description, spectrum, covariance and simulation of each.

A record contains the white noise of its samples, the white noise of the accelerometer, and the
noise of the accelerometer's bias. The conventions are those of IEEE Std 952. White noise has a
banded whitener (`counterspin.inference.noise.model`). A new component of the bias needs a class
that derives from `BiasComponent`, a row of the table, a field of `Noise` and a key of [noise].
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import lru_cache
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen

#: Flicker has a longest period of a day; slower changes are part of the bias, Hz.
MIN_FLICKER_FREQUENCY: Final = 1.0 / 86400.0

#: Number of the slowest rows of a cosine transform whose covariance is computed.
SLOW_ROWS: Final = 64

#: Largest number of points of this covariance: 32 points per shortest period.
_MAX_POINTS: Final = 2048

#: Number of times for which slow harmonics are summed at once: there may be a hundred harmonics.
_TIMES_PER_BATCH: Final = 100_000


@frozen
class Sampling:
    """Composition of the samples of the specific force."""

    order: int  #: The samples are differences of this order of an observable with white noise.
    #: 2: second differences of a displacement, 1: differences of a velocity, which are means over a
    #: step; 0: points.
    averaging_order: int


class NoiseComponent(ABC):
    """A component of the noise of a record."""

    key = ""  #: Key of the size in a description; empty for the key of the observable.
    symbol = ""
    unit = ""  #: SI unit of the size; empty for the unit of the observable.
    description: str

    @abstractmethod
    def sampled_density(self, angle: Array, step: float, sampling: Sampling) -> Array:
        """Return the density of samples of the specific force for unit size, shape (m,).

        angle: 2 pi f step, above 0 and up to pi, shape (m,).
        step: Time between samples, s.
        Returns: Two-sided density over the step, so that white samples have their variance.
        """


class BiasComponent(NoiseComponent):
    """A component of the noise of the bias."""

    #: The upper limit of an undetected component decreases in proportion to this.
    limit_scale: str
    growth = 0.0  #: Variance of unit size that the bias accumulates per second before a record.

    @abstractmethod
    def inverse_density(self, w: float) -> float:
        """Return the inverse of the two-sided density of unit size at w rad/s."""

    @abstractmethod
    def covariance(self, times: Array, high: float) -> Array:
        """Return the covariance of the bias for unit size at even times of a record, (m, m).

        times: s from the start of the record, shape (m,).
        high: Highest frequency, Hz.
        """

    def transform_covariance(self, n: int, averaging_order: int) -> Array | None:  # noqa: ARG002
        """Return the covariance of the slowest rows of the cosine transform of n samples.

        None if the rows are independent.
        """
        return None

    @abstractmethod
    def draw(
        self, generator: np.random.Generator, times: Array, size: float, elapsed: float
    ) -> Array:
        """Draw the bias at even times, at least 2, shape (n,).

        elapsed: Time from the start of the process to the first time, s.
        """


class SampleNoise(NoiseComponent):
    """White noise of the samples of the observable."""

    description = "white noise of the samples"

    def sampled_density(self, angle: Array, step: float, sampling: Sampling) -> Array:
        """Return the density of differences of white samples."""
        return np.asarray((_squared_difference_gain(angle) / step**2) ** sampling.order)


class ForceNoise(NoiseComponent):
    """White noise of the specific force, which is a random walk of the velocity."""

    key, symbol, unit = "acceleration", "N", "m/s^2/Hz^0.5"
    description = "white noise of the accelerometer"

    def sampled_density(self, angle: Array, step: float, sampling: Sampling) -> Array:
        """Return the density of means over a step, or over a triangle of two steps."""
        return np.asarray(_mean_walk_gain(angle, 1 if sampling.order == 2 else 0) / step)


class Flicker(BiasComponent):
    """Flicker, with the density 1/(2 pi f): the floor of the Allan deviation is 0.664."""

    key, symbol, unit = "flicker", "B", "m/s^2"
    description = "flicker (bias instability)"
    limit_scale = "the square root of the length of the record"

    def inverse_density(self, w: float) -> float:
        """Return the angular frequency."""
        return w

    def sampled_density(self, angle: Array, step: float, sampling: Sampling) -> Array:  # noqa: ARG002
        """Return the density of the means, whose attenuation makes aliases negligible."""
        return np.asarray(_averaging_gain(angle, sampling.averaging_order) ** 2 / angle)

    def covariance(self, times: Array, high: float) -> Array:
        """Return the stationary covariance."""
        autocovariances = flicker_autocovariance(
            times - times[0], min(MIN_FLICKER_FREQUENCY, 0.1 * high), high
        )
        return _toeplitz(autocovariances)

    def transform_covariance(self, n: int, averaging_order: int) -> Array:
        """Return the covariance with the attenuation by the means."""
        covariance = _flicker_transform_covariance(min(n, _MAX_POINTS))
        angle = math.pi / n * np.arange(1.0, len(covariance) + 1.0)
        gain = _averaging_gain(angle, averaging_order)
        return (n / min(n, _MAX_POINTS)) * gain[:, None] * covariance * gain

    def draw(
        self,
        generator: np.random.Generator,
        times: Array,
        size: float,
        elapsed: float,  # noqa: ARG002 -- the process is stationary
    ) -> Array:
        """Draw a sum of harmonics with the variances of the spectrum.

        The periods range from a day to two samples: all lines of a record of eight times the
        length, and slower ones in bands of a tenth of a decade.
        """
        n, step = times.size, float(times[1] - times[0])
        n_lines = 8 * n
        k = np.arange(1, n_lines // 2)
        # Variance between the midpoints to the neighbouring lines: B^2/pi ln(f2/f1).
        sds = size * np.sqrt(np.log((k + 0.5) / (k - 0.5)) / math.pi)
        spectrum = np.zeros(n_lines // 2 + 1, dtype=complex)
        spectrum[k] = 0.5 * sds * (generator.standard_normal((2, k.size)).T @ [1.0, 1j])
        bias = np.fft.irfft(spectrum * n_lines, n_lines)[:n]
        min_frequency = 0.5 / (n_lines * step)
        lowest_frequency = min(MIN_FLICKER_FREQUENCY, 0.1 * min_frequency)
        edges = np.geomspace(
            lowest_frequency,
            min_frequency,
            2 + math.ceil(10.0 * math.log10(min_frequency / lowest_frequency)),
        )
        sds = size * np.sqrt(np.diff(np.log(edges)) / math.pi)
        w = 2.0 * math.pi * np.sqrt(edges[1:] * edges[:-1])[:, None]
        a, b = sds * generator.standard_normal((2, sds.size))
        for start in range(0, n, _TIMES_PER_BATCH):
            phases = w * (times[start : start + _TIMES_PER_BATCH] - times[0])
            bias[start : start + _TIMES_PER_BATCH] += a @ np.cos(phases) + b @ np.sin(phases)
        return bias


class BiasWalk(BiasComponent):
    """Random walk of the bias: its variance grows by 1 per second."""

    key, symbol, unit = "bias_walk", "K", "m/s^2/s^0.5"
    description = "bias random walk"
    limit_scale = "the length of the record"
    growth = 1.0

    def inverse_density(self, w: float) -> float:
        """Return the square of the angular frequency."""
        return w**2

    def sampled_density(self, angle: Array, step: float, sampling: Sampling) -> Array:
        """Return the exact density of means of a walk, with aliases."""
        gain = _mean_walk_gain(angle, sampling.averaging_order)
        return np.asarray(step / _squared_difference_gain(angle) * gain)

    def covariance(self, times: Array, high: float) -> Array:  # noqa: ARG002
        """Return the covariance of a walk from 0."""
        return np.minimum(times[:, None], times)

    def draw(
        self, generator: np.random.Generator, times: Array, size: float, elapsed: float
    ) -> Array:
        """Draw the sum of the steps, the first of which lasts for `elapsed`."""
        n, step = times.size, float(times[1] - times[0])
        steps = generator.standard_normal(n) * np.sqrt(np.append(elapsed, np.full(n - 1, step)))
        return size * np.cumsum(steps)


#: Field of `counterspin.inference.noise.model.Noise` -> component of the bias.
BIAS_COMPONENTS: Final[Mapping[str, BiasComponent]] = {
    "flicker": Flicker(),
    "bias_walk": BiasWalk(),
}

#: Field of `Noise` -> component, in the order of `Noise.variances`.
NOISE_COMPONENTS: Final[Mapping[str, NoiseComponent]] = {
    "white": SampleNoise(),
    "random_walk": ForceNoise(),
    **BIAS_COMPONENTS,
}

COMPONENTS: Final = tuple(NOISE_COMPONENTS)

#: Key of a size that every observable has -> component.
COMPONENTS_BY_KEY: Final = {row.key: row for row in NOISE_COMPONENTS.values() if row.key}

BIAS_COMPONENTS_BY_KEY: Final = {row.key: row for row in BIAS_COMPONENTS.values()}


def sampled_densities(angle: Array, step: float, sampling: Sampling) -> Array:
    """Return the densities of samples of the specific force for each component of unit size.

    angle, step: See `NoiseComponent.sampled_density`.
    Returns: (4, m).
    """
    rows = NOISE_COMPONENTS.values()
    return np.stack([row.sampled_density(angle, step, sampling) for row in rows])


def component_keys(observable: str) -> dict[str, str]:
    """Return the key of the size of each component of a record, by component."""
    return {name: row.key or observable for name, row in NOISE_COMPONENTS.items()}


def flicker_autocovariance(lag: Array, low: float, high: float) -> Array:
    """Return the autocovariance of flicker of B = 1 between two frequencies.

    2 int B^2/(2 pi f) cos(2 pi f tau) df = (Ci(2 pi high tau) - Ci(2 pi low tau)) B^2/pi.

    lag: tau, s, not negative.
    low, high: Hz.
    Returns: of the shape of `lag`.
    """
    from scipy.special import sici

    positive_lag = np.where(lag > 0.0, lag, 1.0)
    _, upper = sici(2.0 * math.pi * high * positive_lag)
    _, lower = sici(2.0 * math.pi * low * positive_lag)
    return np.where(lag > 0.0, upper - lower, math.log(high / low)) / math.pi


@lru_cache(maxsize=64)
def _flicker_transform_covariance(n_points: int) -> Array:
    """Return the covariance of the slowest rows of the transform of points of flicker."""
    from scipy.fft import dct

    # Slower flicker is part of the mean, which is unknown.
    lags = flicker_autocovariance(np.arange(n_points, dtype=float), 1e-3 / n_points, 0.5)
    rows = min(SLOW_ROWS, n_points - 1)
    half_transform = dct(_toeplitz(lags), type=2, norm="ortho", axis=0)[1 : rows + 1]
    covariance: Array = dct(half_transform, type=2, norm="ortho", axis=1)[:, 1 : rows + 1]
    return covariance


def _toeplitz(first_row: Array) -> Array:
    """Return the covariance of a stationary process from its autocovariance, (m, m)."""
    index = np.arange(first_row.size)
    covariance: Array = first_row[np.abs(index[:, None] - index)]
    return covariance


def _squared_difference_gain(angle: Array) -> Array:
    """Return the squared gain of a difference of successive samples."""
    return np.asarray(4.0 * np.sin(angle / 2.0) ** 2)


def _mean_walk_gain(angle: Array, averaging_order: int) -> Array:
    """Return the density of averaged steps of a walk over that of the steps, aliases included."""
    if averaging_order == 0:
        return np.ones(angle.size)
    if averaging_order == 1:
        return np.asarray((2.0 + np.cos(angle)) / 3.0)
    return np.asarray(11.0 / 20.0 + 13.0 / 30.0 * np.cos(angle) + np.cos(2.0 * angle) / 60.0)


def _averaging_gain(angle: Array, averaging_order: int) -> Array:
    """Return the gain of means over a step, or over a triangle of two steps, for a wave."""
    return np.asarray(np.sinc(angle / (2.0 * math.pi)) ** averaging_order)
