"""Vectorised Kalman filter of a doubly integrated random walk.

Second differences of (walk + white noise) have a five-diagonal covariance. A Cholesky factor from
its entries loses the walk: if its contribution N^2 h^3 relative to 6 sigma^2 is near 1e-16, the
factor is wrong or does not exist, although the walk still matters over 1e4 samples. The Kalman
filter computes the same factor from the covariance of the state, accurately for any ratio including
zero and infinity. Its Riccati recursion is associative (Sarkka and Garcia-Fernandez, "Temporal
parallelization of Bayesian smoothers", IEEE Trans. Automatic Control 66 (2021) 299, Lemma 8), so a
prefix scan computes it in O(n) array operations. For few rows, a sequential loop is faster. Equal
successive rows, which most records consist of, need less: the element of k equal rows maps the
covariances after the first k rows to those after the next k rows, until the covariance converges.

State: position and velocity at the last sample of a block, with no prior information.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from counterspin.arrays import Array
from counterspin.frozen import frozen

#: Largest number of unequal rows for the sequential loop.
MAX_SEQUENTIAL_ROWS: Final = 1000

#: Smallest number of equal rows for doubling: 2 to this power.
_N_DOUBLINGS: Final = 6
_MIN_SEGMENT_ROWS: Final = 2**_N_DOUBLINGS

#: Relative tolerance of equal steps and blocks, because times are rounded.
_RELATIVE_TOLERANCE: Final = 1e-9

#: Relative change of the covariance below which it has converged.
_CONVERGENCE_TOLERANCE: Final = 1e-15


@frozen
class BlockSpans:
    """Sample positions of each row; a row is the mean of the samples of its block."""

    time: Array  #: Mean time of the samples, s, increasing, shape (n,).
    count: Array  #: Number of samples, shape (n,).
    half_length: Array  #: Time from the mean time to the last sample, s, shape (n,).
    variance: Array  #: Variance of the times u of the samples about the mean time, s^2, shape (n,).
    mean_distance: Array  #: Mean of abs(u - u') over all pairs of samples, s, shape (n,).
    mean_cube: Array  #: Mean of abs(u - u')^3, s^3, shape (n,).

    @classmethod
    def from_blocks(cls, time: Array, count: Array, spacing: Array) -> BlockSpans:
        """Return blocks of `count` regular samples about `time`."""
        squared_count = count**2
        return cls(
            time=time,
            count=count,
            half_length=(count - 1) * spacing / 2,
            variance=(squared_count - 1) * spacing**2 / 12,
            mean_distance=(squared_count - 1) / (3 * count) * spacing,
            mean_cube=(squared_count - 1) * (3 * squared_count - 2) / (30 * count) * spacing**3,
        )

    @cached_property
    def times_since_last(self) -> tuple[Array, Array]:
        """Times from the last sample before a row to its mean time and its last sample, s, (n,)."""
        last_times = self.time + self.half_length
        start_time = self.time[0] - self.half_length[0]
        previous_last_times = np.concatenate(([start_time], last_times[:-1]))
        return self.time - previous_last_times, last_times - previous_last_times

    @cached_property
    def is_change(self) -> NDArray[np.bool_]:
        """Mask of the rows from the second on that differ from the previous row, (n-1,)."""
        _, step = self.times_since_last
        is_change: NDArray[np.bool_] = np.diff(self.count) != 0.0
        for durations in (step, self.half_length):
            is_change |= np.abs(np.diff(durations)) > _RELATIVE_TOLERANCE * step[1:]
        is_change[:2] = True
        return is_change


@frozen
class Innovations:
    """Innovations of rows 2 .. n-1; the first two rows determine the state."""

    variance: Array  #: Variance of a row about its prediction, shape (n-2,).
    gain: Array  #: Change of position and velocity per unit of innovation, shape (2, n-2).
    ahead: Array  #: Time from the previous last sample to the mean time of the row, s, (n,).
    step: Array  #: Time from the previous last sample to the last sample of the row, s, (n,).


def filter_walk(
    blocks: BlockSpans,
    white: float | Array,
    walk: float,
    max_sequential_rows: int = MAX_SEQUENTIAL_ROWS,
) -> Innovations:
    """Return innovation variances and gains of a doubly integrated walk with white noise.

    blocks: n >= 3 rows.
    white: White-noise variance of a sample, m^2, of all rows or of each, (n,).
    walk: Square of the random-walk coefficient, N^2, (m/s^2)^2/Hz; not both zero.
    """
    to_mean, to_end = blocks.times_since_last
    row_variance = white / blocks.count
    # Each of the first two rows is a segment of its own.
    changes = (
        blocks.is_change
        if np.ndim(white) == 0
        else blocks.is_change | (np.diff(row_variance) != 0.0)
    )
    starts = np.append(0, 1 + np.flatnonzero(changes))
    sizes = np.diff(starts, append=to_end.size)
    uses_scan = sizes[sizes < _MIN_SEGMENT_ROWS].sum() > max_sequential_rows
    if uses_scan:
        starts, sizes = np.arange(to_end.size), np.ones(to_end.size, dtype=np.intp)
    first_rows, last_rows = starts, starts + sizes - 1
    d = (to_mean[first_rows] + to_mean[last_rows]) / 2
    s = (to_end[first_rows] + to_end[last_rows]) / 2

    # For a walk z(s) that starts at rest at the previous last sample:
    # E z(s) z(s') = [|s - s'|^3 - s^3 - s'^3 + 3 s s' (s + s')]/12, averaged over the block.
    block_variance = blocks.variance[first_rows]
    second_moment = d**2 + block_variance
    noise = row_variance[first_rows] + walk * (d**3 / 3 + blocks.mean_cube[first_rows] / 12)
    cross_position = walk * (s * second_moment / 2 - d**3 / 6 - d * block_variance / 2)
    cross_velocity = walk * second_moment / 2
    if not noise[0] > 0:  # a single first sample without white noise determines its position
        noise[0] = np.finfo(float).tiny ** 0.5

    # Covariance of position and velocity that the walk adds over the step.
    process_noise = (walk * s**3 / 3, walk * s**2 / 2, walk * s)
    parameters = np.stack([d, s, noise, cross_position, cross_velocity, *process_noise])
    if uses_scan:
        covariances = _state_covariance(
            _prefix_scan(np.stack(_scan_elements(*parameters)))[:, 1:-1]
        )
        return Innovations(*_innovations(covariances, list(parameters[:5, 2:])), to_mean, to_end)
    initial_covariance = _state_covariance(
        _combine(_scan_elements(*parameters[:, 0]), _scan_elements(*parameters[:, 1]))
    ).tolist()
    covariances = _predicted_covariances(
        initial_covariance, parameters.T[2:].tolist(), sizes[2:].tolist()
    )
    innovations = _innovations(covariances, list(np.repeat(parameters[:5, 2:], sizes[2:], axis=1)))
    return Innovations(*innovations, to_mean, to_end)


def _innovations(covariances: Array, row_parameters: Sequence[Any]) -> tuple[Array, Array]:
    """Return innovation variances and gains of rows from the covariance before each row."""
    p11, p12, p22 = covariances
    d, s, noise, cross_position, cross_velocity = row_parameters
    position = p11 + d * p12
    velocity = p12 + d * p22
    variance = position + d * velocity + noise
    gain = np.stack([position + s * velocity + cross_position, velocity + cross_velocity])
    return variance, gain / variance


def _scan_elements(
    to_mean: Any,
    to_end: Any,
    noise: Any,
    cross_position: Any,
    cross_velocity: Any,
    *process_noise: Any,
) -> list[Any]:
    """Return the scan element of each row, ten numbers or arrays: A, C and J of `_combine`."""
    return [
        1 - cross_position / noise,
        to_end - cross_position * to_mean / noise,
        -cross_velocity / noise,
        1 - cross_velocity * to_mean / noise,
        process_noise[0] - cross_position**2 / noise,
        process_noise[1] - cross_position * cross_velocity / noise,
        process_noise[2] - cross_velocity**2 / noise,
        1 / noise,
        to_mean / noise,
        to_mean**2 / noise,
    ]


def _state_covariance(combined_elements: Any) -> Array:
    """Return the covariance of the state after each row, A J^-1 A' + C, shape (3, n).

    combined_elements: Combined elements of the rows up to each row.
    """
    a11, a12, a21, a22, c11, c12, c22, j11, j12, j22 = combined_elements
    determinant = j11 * j22 - j12**2
    i11, i12, i22 = j22 / determinant, -j12 / determinant, j11 / determinant
    return np.stack(
        [
            a11 * (a11 * i11 + a12 * i12) + a12 * (a11 * i12 + a12 * i22) + c11,
            a11 * (a21 * i11 + a22 * i12) + a12 * (a21 * i12 + a22 * i22) + c12,
            a21 * (a21 * i11 + a22 * i12) + a22 * (a21 * i12 + a22 * i22) + c22,
        ]
    )


def _predicted_covariances(
    covariance: list[float], segment_parameters: list[list[float]], segment_sizes: list[int]
) -> Array:
    """Return the covariance before each row of segments of equal rows, shape (3, n).

    covariance: Covariance before the first row.
    segment_parameters: Parameters of `_scan_elements` for each segment.
    segment_sizes: Number of rows of each segment.
    """
    covariance_blocks: list[Array] = []
    pending: list[list[float]] = []
    for parameters, size in zip(segment_parameters, segment_sizes, strict=True):
        if size <= _MIN_SEGMENT_ROWS:
            stepwise = _stepwise_covariances(covariance, parameters, size)
            covariance = stepwise.pop()
            pending += stepwise
        else:
            repeated = _repeated_covariances(covariance, parameters, size)
            covariance_blocks += [np.reshape(pending, (-1, 3)).T, repeated[:, :-1]]
            pending, covariance = [], repeated[:, -1].tolist()
    return np.hstack([*covariance_blocks, np.reshape(pending, (-1, 3)).T])


def _repeated_covariances(covariance: list[float], parameters: list[float], size: int) -> Array:
    """Return the covariance before each of many equal rows, and after them, (3, size + 1).

    The first rows are computed sequentially; then the number of rows doubles in each step.

    parameters: Parameters of `_scan_elements`.
    """
    covariances = np.empty((3, size + 1))
    covariances[:, : _MIN_SEGMENT_ROWS + 1] = np.transpose(
        _stepwise_covariances(covariance, parameters, _MIN_SEGMENT_ROWS)
    )
    element, n_computed = _scan_elements(*parameters), _MIN_SEGMENT_ROWS
    for _ in range(_N_DOUBLINGS):
        element = _combine(element, element)
    while n_computed <= size:
        count = min(n_computed, size + 1 - n_computed)
        covariances[:, n_computed : n_computed + count] = _propagate(
            covariances[:, :count], element
        )
        n_computed += count
        current, previous = covariances[:, n_computed - 1], covariances[:, n_computed - count]
        if np.all(np.abs(current - previous) <= _CONVERGENCE_TOLERANCE * np.abs(current)):
            covariances[:, n_computed:] = current[:, None]
            break
        element = _combine(element, element)
    return covariances


def _stepwise_covariances(
    covariance: list[float], parameters: list[float], size: int
) -> list[list[float]]:
    """Return the covariance before each of some equal rows, and after them, sequentially.

    Python numbers are faster here than small arrays.
    """
    p11, p12, p22 = covariance
    d, s, noise, cross_position, cross_velocity, q11, q12, q22 = parameters
    covariances = [covariance]
    for _ in range(size):
        position_covariance = p11 + d * p12
        velocity_covariance = p12 + d * p22
        variance = position_covariance + d * velocity_covariance + noise
        position_gain = (position_covariance + s * velocity_covariance + cross_position) / variance
        velocity_gain = (velocity_covariance + cross_velocity) / variance
        p11 += s * (2.0 * p12 + s * p22) + q11 - position_gain**2 * variance
        p12 += s * p22 + q12 - position_gain * velocity_gain * variance
        p22 += q22 - velocity_gain**2 * variance
        covariances.append([p11, p12, p22])
    return covariances


def _prefix_scan(elements: Array) -> Array:
    """Return the cumulative combinations of elements, shape (10, n)."""
    n = elements.shape[1]
    if n == 1:
        return elements
    pairs = _prefix_scan(np.stack(_combine(elements[:, 0 : n - 1 : 2], elements[:, 1::2])))
    running = np.empty_like(elements)
    running[:, 0] = elements[:, 0]
    running[:, 1::2] = pairs
    even = elements[:, 2::2]
    running[:, 2::2] = _combine(pairs[:, : even.shape[1]], even)
    return running


def _combine(first: Any, second: Any) -> list[Any]:
    """Combine the elements of two successive intervals of the record.

    An element is (A, C, J): state after = A x state before + noise with covariance C; J is the
    information on the state before. C and J are symmetric and stored as (11, 12, 22).
    """
    a11, a12, a21, a22, c11, c12, c22, j11, j12, j22 = first
    b11, b12, b21, b22, _, _, _, k11, k12, k22 = second
    m11 = 1 + c11 * k11 + c12 * k12
    m12 = c11 * k12 + c12 * k22
    m21 = c12 * k11 + c22 * k12
    m22 = 1 + c12 * k12 + c22 * k22
    det_c = c11 * c22 - c12**2
    det_k = k11 * k22 - k12**2
    scale = 1 / (m11 + m22 - 1 + det_c * det_k)  # 1/det(I + C K)

    # B (I + C K)^-1
    e11 = (b11 * m22 - b12 * m21) * scale
    e12 = (b12 * m11 - b11 * m12) * scale
    e21 = (b21 * m22 - b22 * m21) * scale
    e22 = (b22 * m11 - b21 * m12) * scale
    # (K^-1 + C)^-1 without inverting K, which may be singular
    g11 = (k11 + det_k * c22) * scale
    g12 = (k12 - det_k * c12) * scale
    g22 = (k22 + det_k * c11) * scale

    return [
        e11 * a11 + e12 * a21,
        e11 * a12 + e12 * a22,
        e21 * a11 + e22 * a21,
        e21 * a12 + e22 * a22,
        *_propagate(first[4:7], second),
        j11 + a11 * (a11 * g11 + 2 * a21 * g12) + a21**2 * g22,
        j12 + a12 * (a11 * g11 + a21 * g12) + a22 * (a11 * g12 + a21 * g22),
        j22 + a12 * (a12 * g11 + 2 * a22 * g12) + a22**2 * g22,
    ]


def _propagate(covariances: Any, element: Any) -> list[Any]:
    """Return covariances of the state after an element: A (P^-1 + J)^-1 A' + C."""
    p11, p12, p22 = covariances
    a11, a12, a21, a22, c11, c12, c22, j11, j12, j22 = element
    det_p = p11 * p22 - p12**2
    det_j = j11 * j22 - j12**2
    scale = 1 / (1 + p11 * j11 + 2 * p12 * j12 + p22 * j22 + det_p * det_j)
    f11 = (p11 + det_p * j22) * scale
    f12 = (p12 - det_p * j12) * scale
    f22 = (p22 + det_p * j11) * scale
    return [
        c11 + a11 * (a11 * f11 + 2 * a12 * f12) + a12**2 * f22,
        c12 + a21 * (a11 * f11 + a12 * f12) + a22 * (a11 * f12 + a12 * f22),
        c22 + a21 * (a21 * f11 + 2 * a22 * f12) + a22**2 * f22,
    ]
