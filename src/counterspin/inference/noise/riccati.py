"""The Kalman filter of a doubly integrated walk, for all samples at once.

Second differences of (walk + white noise) have a five-diagonal covariance. Its Cholesky factor
could be computed from its entries, but those forget the walk: where its share of an entry,
N^2 h^3 against 6 sigma^2, nears 1e-16 the factor is wrong or does not exist, while over 1e4 samples
the walk still matters at 1e-16. The Kalman filter computes the same factor from the *state's*
covariance and loses nothing at any ratio, zero and infinity included. Its Riccati recursion is a
chain of associative steps (Sarkka and Garcia-Fernandez, "Temporal parallelization of Bayesian
smoothers", IEEE Trans. Automatic Control 66 (2021) 299, Lemma 8), so a prefix scan runs it in
O(n) whole-array operations. Of few rows, where each such operation costs more than its numbers,
row after row is quicker. Rows alike, which are most of a usual record, need less: k of them in a
row are one stretch wherever they stand, which takes the covariances after the first k rows, all at
once, to those after the next k; and once the covariance has settled, it stays.

State: position and velocity at a block's last sample. Nothing is assumed of the first state.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from counterspin.arrays import Array
from counterspin.frozen import frozen

#: Rows without others alike beside them up to which the filter runs row after row.
FEW_ROWS: Final = 1000

#: Fewest rows alike that are taken as such: one, so many times doubled.
_DOUBLINGS: Final = 6
_MIN_SEGMENT_ROWS: Final = 2**_DOUBLINGS

#: Steps and blocks are alike to this part: times have been rounded.
_RELATIVE_TOLERANCE: Final = 1e-9

#: The covariance has settled when a stretch changes it by less than this part.
_SETTLED: Final = 1e-15


@frozen
class BlockSpans:
    """Sample positions of each row; a row is the mean of the samples of its block."""

    time: Array  #: (n,) mean time of the samples, s, increasing.
    count: Array  #: (n,) how many samples.
    half: Array  #: (n,) from the mean time to the last sample, s.
    variance: Array  #: (n,) mean of u^2, u being a sample's time from the block's mean time, s^2.
    mean_distance: Array  #: (n,) mean of abs(u - u') over all pairs of samples of the block, s.
    mean_cube: Array  #: (n,) mean of abs(u - u')^3, s^3.

    @classmethod
    def of(cls, time: Array, count: Array, spacing: Array) -> BlockSpans:
        """Blocks of `count` evenly spaced samples about `time`."""
        squared = count**2
        return cls(
            time=time,
            count=count,
            half=(count - 1) * spacing / 2,
            variance=(squared - 1) * spacing**2 / 12,
            mean_distance=(squared - 1) / (3 * count) * spacing,
            mean_cube=(squared - 1) * (3 * squared - 2) / (30 * count) * spacing**3,
        )

    @cached_property
    def since_last(self) -> tuple[Array, Array]:
        """From the last sample before each row to its mean time and its last sample, s, (n,)."""
        last = self.time + self.half
        before = np.concatenate(([self.time[0] - self.half[0]], last[:-1]))
        return self.time - before, last - before

    @cached_property
    def changes(self) -> NDArray[np.bool_]:
        """Mask of the rows from the second on that differ from the previous row, (n-1,)."""
        _, step = self.since_last
        new: NDArray[np.bool_] = np.diff(self.count) != 0.0
        for part in (step, self.half):
            new |= np.abs(np.diff(part)) > _RELATIVE_TOLERANCE * step[1:]
        new[:2] = True
        return new


@frozen
class Innovations:
    """The filter of rows 2 .. n-1 (the first two rows only find the state)."""

    variance: Array  #: (n-2,) variance of a row about its prediction from the rows before it.
    gain: Array  #: (2, n-2) what one unit of that difference adds to position and velocity.
    ahead: Array  #: (n,) time from the last sample of the row before to this row's mean time, s.
    step: Array  #: (n,) time from the last sample of the row before to this row's last sample, s.


def filter_walk(
    blocks: BlockSpans, white: float | Array, walk: float, few_rows: int = FEW_ROWS
) -> Innovations:
    """Innovation variances and gains for a doubly integrated walk seen through white noise.

    blocks: n >= 3 rows.
    white: White variance per sample, m^2, of all rows or of each, (n,).
    walk: Square of the random-walk coefficient, N^2, (m/s^2)^2/Hz; not both zero.
    """
    ahead, step = blocks.since_last
    row_variance = white / blocks.count
    # Each of the first two rows is a stretch of its own.
    changes = (
        blocks.changes if np.ndim(white) == 0 else blocks.changes | (np.diff(row_variance) != 0.0)
    )
    starts = np.append(0, 1 + np.flatnonzero(changes))
    sizes = np.diff(starts, append=step.size)
    scanned = sizes[sizes < _MIN_SEGMENT_ROWS].sum() > few_rows
    if scanned:
        starts, sizes = np.arange(step.size), np.ones(step.size, dtype=np.intp)
    first, final = starts, starts + sizes - 1
    d, s = (ahead[first] + ahead[final]) / 2, (step[first] + step[final]) / 2

    # For a walk that starts at rest at `before`, z(s) its double integral:
    # E z(s) z(s') = [|s - s'|^3 - s^3 - s'^3 + 3 s s' (s + s')]/12, averaged over the block.
    spread = blocks.variance[first]
    second_moment = d**2 + spread
    noise = row_variance[first] + walk * (d**3 / 3 + blocks.mean_cube[first] / 12)
    cross_position = walk * (s * second_moment / 2 - d**3 / 6 - d * spread / 2)
    cross_velocity = walk * second_moment / 2
    if not noise[0] > 0:  # a single first sample without white noise tells its position exactly
        noise[0] = np.finfo(float).tiny ** 0.5

    # What the walk adds to position and velocity over the step.
    added = (walk * s**3 / 3, walk * s**2 / 2, walk * s)
    parameters = np.stack([d, s, noise, cross_position, cross_velocity, *added])
    if scanned:
        states = _covariance(_prefix(np.stack(_elements(*parameters)))[:, 1:-1])
        return Innovations(*_innovations(states, list(parameters[:5, 2:])), ahead, step)
    state = _covariance(
        _combine(_elements(*parameters[:, 0]), _elements(*parameters[:, 1]))
    ).tolist()
    states = _predicted_covariances(state, parameters.T[2:].tolist(), sizes[2:].tolist())
    innovations = _innovations(states, list(np.repeat(parameters[:5, 2:], sizes[2:], axis=1)))
    return Innovations(*innovations, ahead, step)


def _innovations(states: Array, row: Sequence[Any]) -> tuple[Array, Array]:
    """Return variances and gains of rows, from the covariance before each of them."""
    p11, p12, p22 = states
    d, s, noise, cross_position, cross_velocity = row
    position = p11 + d * p12
    velocity = p12 + d * p22
    variance = position + d * velocity + noise
    gain = np.stack([position + s * velocity + cross_position, velocity + cross_velocity])
    return variance, gain / variance


def _elements(
    ahead: Any, step: Any, noise: Any, cross_position: Any, cross_velocity: Any, *added: Any
) -> list[Any]:
    """Return each row as a stretch of the record, ten numbers or arrays: its A, C and J."""
    return [
        1 - cross_position / noise,
        step - cross_position * ahead / noise,
        -cross_velocity / noise,
        1 - cross_velocity * ahead / noise,
        added[0] - cross_position**2 / noise,
        added[1] - cross_position * cross_velocity / noise,
        added[2] - cross_velocity**2 / noise,
        1 / noise,
        ahead / noise,
        ahead**2 / noise,
    ]


def _covariance(running: Any) -> Array:
    """Return the state's covariance after each row, from nothing known: A J^-1 A' + C, (3, n).

    running: The stretch from the first row to each, as `_combine` makes them.
    """
    a11, a12, a21, a22, c11, c12, c22, j11, j12, j22 = running
    determinant = j11 * j22 - j12**2
    i11, i12, i22 = j22 / determinant, -j12 / determinant, j11 / determinant
    return np.stack(
        [
            a11 * (a11 * i11 + a12 * i12) + a12 * (a11 * i12 + a12 * i22) + c11,
            a11 * (a21 * i11 + a22 * i12) + a12 * (a21 * i12 + a22 * i22) + c12,
            a21 * (a21 * i11 + a22 * i12) + a22 * (a21 * i12 + a22 * i22) + c22,
        ]
    )


def _predicted_covariances(state: list[float], rows: list[list[float]], sizes: list[int]) -> Array:
    """Return the covariance before each row of stretches of rows alike, (3, n).

    state: Before the first row.
    rows: What `_elements` takes, of each stretch.
    sizes: How many rows each stretch has.
    """
    parts: list[Array] = []
    pending: list[list[float]] = []
    for row, size in zip(rows, sizes, strict=True):
        if size <= _MIN_SEGMENT_ROWS:
            stepwise = _stepwise_covariances(state, row, size)
            state = stepwise.pop()
            pending += stepwise
        else:
            repeated = _repeated_covariances(state, row, size)
            parts += [np.reshape(pending, (-1, 3)).T, repeated[:, :-1]]
            pending, state = [], repeated[:, -1].tolist()
    return np.hstack([*parts, np.reshape(pending, (-1, 3)).T])


def _repeated_covariances(state: list[float], row: list[float], size: int) -> Array:
    """Return the covariance before each of many rows alike, and after them, (3, size + 1).

    Of the first rows one by one, then of as many more at once as there are.

    row: What `_elements` takes.
    """
    states = np.empty((3, size + 1))
    states[:, : _MIN_SEGMENT_ROWS + 1] = np.transpose(
        _stepwise_covariances(state, row, _MIN_SEGMENT_ROWS)
    )
    stretch, done = _elements(*row), _MIN_SEGMENT_ROWS
    for _ in range(_DOUBLINGS):
        stretch = _combine(stretch, stretch)
    while done <= size:
        count = min(done, size + 1 - done)
        states[:, done : done + count] = _propagate(states[:, :count], stretch)
        done += count
        current, previous = states[:, done - 1], states[:, done - count]
        if np.all(np.abs(current - previous) <= _SETTLED * np.abs(current)):
            states[:, done:] = current[:, None]
            break
        stretch = _combine(stretch, stretch)
    return states


def _stepwise_covariances(state: list[float], row: list[float], size: int) -> list[list[float]]:
    """Return the covariance before each of some rows alike, and after them, one by one.

    In numbers of Python, which are quicker than arrays of a few.
    """
    p11, p12, p22 = state
    d, s, noise, cross_position, cross_velocity, q11, q12, q22 = row
    states = [state]
    for _ in range(size):
        seen_position = p11 + d * p12
        seen_velocity = p12 + d * p22
        variance = seen_position + d * seen_velocity + noise
        position_gain = (seen_position + s * seen_velocity + cross_position) / variance
        velocity_gain = (seen_velocity + cross_velocity) / variance
        p11 += s * (2.0 * p12 + s * p22) + q11 - position_gain**2 * variance
        p12 += s * p22 + q12 - position_gain * velocity_gain * variance
        p22 += q22 - velocity_gain**2 * variance
        states.append([p11, p12, p22])
    return states


def _prefix(elements: Array) -> Array:
    """(10, n) elements -> (10, n) their running combinations."""
    n = elements.shape[1]
    if n == 1:
        return elements
    pairs = _prefix(np.stack(_combine(elements[:, 0 : n - 1 : 2], elements[:, 1::2])))
    running = np.empty_like(elements)
    running[:, 0] = elements[:, 0]
    running[:, 1::2] = pairs
    even = elements[:, 2::2]
    running[:, 2::2] = _combine(pairs[:, : even.shape[1]], even)
    return running


def _combine(early: Any, late: Any) -> list[Any]:
    """Two stretches of the record become one.

    A stretch is (A, C, J): state after = A x state before + noise of covariance C; the stretch
    tells J of the state before. C and J are symmetric and stored as (11, 12, 22).
    """
    a11, a12, a21, a22, c11, c12, c22, j11, j12, j22 = early
    b11, b12, b21, b22, _, _, _, k11, k12, k22 = late
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
        *_propagate(early[4:7], late),
        j11 + a11 * (a11 * g11 + 2 * a21 * g12) + a21**2 * g22,
        j12 + a12 * (a11 * g11 + a21 * g12) + a22 * (a11 * g12 + a21 * g22),
        j22 + a12 * (a12 * g11 + 2 * a22 * g12) + a22**2 * g22,
    ]


def _propagate(states: Any, stretch: Any) -> list[Any]:
    """Return covariances of the state as they are a stretch later: A (P^-1 + J)^-1 A' + C."""
    p11, p12, p22 = states
    a11, a12, a21, a22, c11, c12, c22, j11, j12, j22 = stretch
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
