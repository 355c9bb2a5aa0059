"""Coloured noise of the bias: flicker (bias instability) and a random walk.

The bias has two-sided spectral densities B^2/(2 pi f) and K^2/(2 pi f)^2, those of IEEE Std 952:
the Allan deviation has a floor of 0.664 B, and the variance of the walk grows by K^2 a second.
Flicker below `MIN_FLICKER_FREQUENCY` is part of the bias. The noise of different runs is
independent; the walk starts with its variance accumulated since the start of the campaign.

Over a record of length T, the bias is a sum of cosines, cos(k pi t/T), k < r. The omitted part is
above r/(2T), where the other noise exceeds it a thousandfold (`basis_size`). The covariance of the
cosines is that of the process on a grid four times as fine, with the exact autocovariance of a 1/f
spectrum between two frequencies, a difference of cosine integrals. After the integrations of the
record, the cosines add a low-rank covariance U U' to whitened rows, which (1 + U U')^(-1/2)
whitens again.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.noise.components import BIAS_COMPONENTS

#: Ratio of bias noise to other noise at the highest frequency of the cosines.
_MIN_RELATIVE_DENSITY: Final = 1e-3

#: Smallest and largest number of cosines.
_BASIS_SIZE_RANGE: Final = (12, 256)

#: Grid points for each function.
_POINTS_PER_FUNCTION: Final = 4

#: Extension of the cosines beyond the record, relative to its length, because their slopes are
#: zero at both ends.
_OVERHANG_FRACTION: Final = 0.02

#: Eigenvalue of a whitened direction below which it is rounding error.
_MIN_EIGENVALUE: Final = 1e-9


#: Variances of the noise of a record: white noise of a sample with quantisation, in the squared
#: unit of the observable; N^2 of the accelerometer's white noise; B^2 and K^2.
Variances = tuple[float, ...]


def basis_length(last_time: float) -> float:
    """Return the length of the cosines for a record whose last row is at `last_time` s."""
    return (1.0 + _OVERHANG_FRACTION) * last_time


def basis_size(variances: Variances, spacing: float, length: float, order: int) -> int:
    """Return the number of cosines up to the frequency at which white noise covers the bias.

    spacing: Time between samples, s.
    length: Length of the record, s.
    """
    min_size, max_size = _BASIS_SIZE_RANGE
    white, white_force, *bias_variances = variances
    # The samples limit the number of cosines.
    max_size = max(min_size, min(max_size, math.floor(0.9 * length / spacing)))
    count = min_size
    while count < max_size:
        w = math.pi * count / length
        bias_density = sum(
            variance / component.inverse_density(w)
            for variance, component in zip(bias_variances, BIAS_COMPONENTS.values(), strict=True)
        )
        if bias_density <= _MIN_RELATIVE_DENSITY * (
            white * spacing * w ** (2 * order) + white_force
        ):
            break
        # A coarse sequence of numbers, so that covariances are reused from the cache.
        count = math.ceil(1.25 * count)
    return min(count, max_size)


def integrated_cosines(
    times: Array, samples: Array, spacing: Array, order: int, count: int, length: float
) -> Array:
    """Return the effect of each cosine of the bias on a record, shape (n, count).

    times, samples, spacing: Mean time of each row (s), number of samples in the mean, and time
        between the samples (s), shape (n,).
    """
    w = math.pi * np.arange(1, count) / length
    phase = times[:, None] * w
    rows = np.empty((times.size, count))
    rows[:, 0] = times**order / max(order, 1)
    # The mean of a cosine over the samples of a block.
    half_angle = 0.5 * spacing[:, None] * w
    averaging_gain = np.sin(samples[:, None] * half_angle) / (samples[:, None] * np.sin(half_angle))
    if order == 0:
        rows[:, 1:] = averaging_gain * np.cos(phase)
    elif order == 1:
        rows[:, 1:] = averaging_gain * np.sin(phase) / w
    else:
        rows[:, 1:] = (1.0 - averaging_gain * np.cos(phase)) / w**2
    return rows


@lru_cache(maxsize=256)
def _coefficient_covariances(count: int, length: float) -> tuple[Array, ...]:
    """Return the cosines' covariance for each bias component of unit size, (count, count)."""
    n_points = _POINTS_PER_FUNCTION * count
    positions = (np.arange(n_points) + 0.5) / n_points
    projection = 2.0 / n_points * np.cos(math.pi * np.outer(np.arange(count), positions))
    projection[0] *= 0.5
    max_frequency = n_points / (2.0 * length)
    covariances = (
        component.covariance(length * positions, max_frequency)
        for component in BIAS_COMPONENTS.values()
    )
    return tuple(projection @ covariance @ projection.T for covariance in covariances)


def coefficient_covariance(
    variances: Variances, count: int, length: float, walk_duration: float
) -> Array:
    """Return the cosines' covariance, shape (count, count).

    walk_duration: Duration of the walk of the bias before the record, s.
    """
    total, covariances = np.zeros((count, count)), _coefficient_covariances(count, length)
    components = BIAS_COMPONENTS.values()
    for variance, component, covariance in zip(variances[2:], components, covariances, strict=True):
        total += variance * covariance
        total[0, 0] += variance * component.growth * walk_duration
    return total


def coefficient_root(
    variances: Variances, count: int, length: float, walk_duration: float
) -> Array:
    """Return a square root of `coefficient_covariance`."""
    covariance = coefficient_covariance(variances, count, length, walk_duration)
    values, vectors = np.linalg.eigh(covariance)
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    return root


@frozen(eq=False)
class LowRankWhitener:
    """The inverse square root of 1 + U U' as an operator on rows."""

    directions: Array  #: U V, where U' U = V diag(size) V', shape (m, q).
    shrink: Array  #: ((1 + size)^(-1/2) - 1)/size, shape (q,).
    log_det: float  #: Log-determinant of 1 + U U'.

    @classmethod
    def from_root(cls, root: Array) -> LowRankWhitener:
        """Return the whitener for U, shape (m, r)."""
        eigenvalues, vectors = np.linalg.eigh(root.T @ root)
        is_significant = eigenvalues > _MIN_EIGENVALUE
        eigenvalues, vectors = eigenvalues[is_significant], vectors[:, is_significant]
        roots = np.sqrt(1.0 + eigenvalues)
        return cls(
            root @ vectors, -1.0 / (roots * (1.0 + roots)), float(np.log1p(eigenvalues).sum())
        )

    def apply(self, rows: Array) -> Array:
        """Return the rows, (m,) or (m, k), with unit covariance."""
        shrink = self.shrink if rows.ndim == 1 else self.shrink[:, None]
        whitened: Array = rows + self.directions @ (shrink * (self.directions.T @ rows))
        return whitened
