"""The Kalman filter of a doubly integrated walk, for all samples at once.

Second differences of (walk + white noise) have a five-diagonal covariance. Its Cholesky factor
could be computed from its entries, but those forget the walk: where its share of an entry,
N^2 h^3 against 6 sigma^2, nears 1e-16 the factor is wrong or does not exist, while over 1e4 samples
the walk still matters at 1e-16. The Kalman filter computes the same factor from the *state's*
covariance and loses nothing at any ratio, zero and infinity included. Its Riccati recursion is a
chain of associative steps (Sarkka and Garcia-Fernandez, "Temporal parallelization of Bayesian
smoothers", IEEE Trans. Automatic Control 66 (2021) 299, Lemma 8), so a prefix scan runs it in
O(n) whole-array operations. Of few rows, where each such operation costs more than its numbers, row
after row is quicker.

State: position and velocity at a block's last sample. Nothing is assumed of the first state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen

#: Rows up to which the filter runs row after row.
FEW_ROWS: Final = 1000


@frozen
class BlockSpans:
    """Where the samples of each row lie; a row is the mean of the samples of its block."""

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
    last = blocks.time + blocks.half
    before = np.concatenate(([blocks.time[0] - blocks.half[0]], last[:-1]))
    ahead = blocks.time - before
    step = last - before

    # For a walk that starts at rest at `before`, z(s) its double integral:
    # E z(s) z(s') = [|s - s'|^3 - s^3 - s'^3 + 3 s s' (s + s')]/12, averaged over the block.
    second_moment = ahead**2 + blocks.variance
    noise = white / blocks.count + walk * (ahead**3 / 3 + blocks.mean_cube / 12)
    cross_position = walk * (step * second_moment / 2 - ahead**3 / 6 - ahead * blocks.variance / 2)
    cross_velocity = walk * second_moment / 2
    if not noise[0] > 0:  # a single first sample without white noise tells its position exactly
        noise[0] = np.finfo(float).tiny ** 0.5

    # What the walk adds to position and velocity over the step.
    added = (walk * step**3 / 3, walk * step**2 / 2, walk * step)
    given = (ahead, step, noise, cross_position, cross_velocity, *added)
    if blocks.time.size <= few_rows:
        first = _covariance(_prefix(_elements(*(part[:2] for part in given)))[:, 1:])
        seen = _in_turn([float(part[0]) for part in first], *(part[2:].tolist() for part in given))
        return Innovations(seen[0], seen[1:], ahead, step)
    p11, p12, p22 = _covariance(_prefix(_elements(*given))[:, 1:-1])
    d, s, noise, cross_position, cross_velocity = (part[2:] for part in given[:5])
    seen_position = p11 + d * p12
    seen_velocity = p12 + d * p22
    variance = seen_position + d * seen_velocity + noise
    gain = np.stack(
        [seen_position + s * seen_velocity + cross_position, seen_velocity + cross_velocity]
    )
    return Innovations(variance, gain / variance, ahead, step)


def _elements(
    ahead: Array,
    step: Array,
    noise: Array,
    cross_position: Array,
    cross_velocity: Array,
    *added: Array,
) -> Array:
    """Return each row as a stretch of the record, (10, n): its A, C and J."""
    return np.stack(
        [
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
    )


def _covariance(running: Array) -> tuple[Array, Array, Array]:
    """Return the state's covariance after each row, from nothing known: A J^-1 A' + C."""
    a11, a12, a21, a22, c11, c12, c22, j11, j12, j22 = running
    determinant = j11 * j22 - j12**2
    i11, i12, i22 = j22 / determinant, -j12 / determinant, j11 / determinant
    return (
        a11 * (a11 * i11 + a12 * i12) + a12 * (a11 * i12 + a12 * i22) + c11,
        a11 * (a21 * i11 + a22 * i12) + a12 * (a21 * i12 + a22 * i22) + c12,
        a21 * (a21 * i11 + a22 * i12) + a22 * (a21 * i12 + a22 * i22) + c22,
    )


def _in_turn(first: Sequence[float], *rows: list[float]) -> Array:
    """Return variance and gains of rows, (3, n), from the covariance before the first of them.

    The lists are those of `_elements`. Numbers of Python: they are quicker than arrays of one.
    """
    p11, p12, p22 = first
    seen = []
    for d, s, noise, cross_position, cross_velocity, q11, q12, q22 in zip(*rows, strict=True):
        seen_position = p11 + d * p12
        seen_velocity = p12 + d * p22
        variance = seen_position + d * seen_velocity + noise
        of_position = (seen_position + s * seen_velocity + cross_position) / variance
        of_velocity = (seen_velocity + cross_velocity) / variance
        seen.append((variance, of_position, of_velocity))
        p11 += s * (2.0 * p12 + s * p22) + q11 - of_position**2 * variance
        p12 += s * p22 + q12 - of_position * of_velocity * variance
        p22 += q22 - of_velocity**2 * variance
    return np.array(seen).reshape(-1, 3).T


def _prefix(elements: Array) -> Array:
    """(10, n) elements -> (10, n) their running combinations."""
    n = elements.shape[1]
    if n == 1:
        return elements
    pairs = _prefix(_combine(elements[:, 0 : n - 1 : 2], elements[:, 1::2]))
    running = np.empty_like(elements)
    running[:, 0] = elements[:, 0]
    running[:, 1::2] = pairs
    even = elements[:, 2::2]
    running[:, 2::2] = _combine(pairs[:, : even.shape[1]], even)
    return running


def _combine(early: Array, late: Array) -> Array:
    """Two stretches of the record become one.

    A stretch is (A, C, J): state after = A x state before + noise of covariance C; the stretch
    tells J of the state before. C and J are symmetric and stored as (11, 12, 22).
    """
    a11, a12, a21, a22, c11, c12, c22, j11, j12, j22 = early
    b11, b12, b21, b22, d11, d12, d22, k11, k12, k22 = late
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
    # (C^-1 + K)^-1 and (K^-1 + C)^-1 without inverting C or K, which may be singular
    f11 = (c11 + det_c * k22) * scale
    f12 = (c12 - det_c * k12) * scale
    f22 = (c22 + det_c * k11) * scale
    g11 = (k11 + det_k * c22) * scale
    g12 = (k12 - det_k * c12) * scale
    g22 = (k22 + det_k * c11) * scale

    return np.stack(
        [
            e11 * a11 + e12 * a21,
            e11 * a12 + e12 * a22,
            e21 * a11 + e22 * a21,
            e21 * a12 + e22 * a22,
            d11 + b11 * (b11 * f11 + 2 * b12 * f12) + b12**2 * f22,
            d12 + b21 * (b11 * f11 + b12 * f12) + b22 * (b11 * f12 + b12 * f22),
            d22 + b21 * (b21 * f11 + 2 * b22 * f12) + b22**2 * f22,
            j11 + a11 * (a11 * g11 + 2 * a21 * g12) + a21**2 * g22,
            j12 + a12 * (a11 * g11 + a21 * g12) + a22 * (a11 * g12 + a21 * g22),
            j22 + a12 * (a12 * g11 + 2 * a22 * g12) + a22**2 * g22,
        ]
    )
