"""Residuals thinned for pictures: few points that show what many would."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from counterspin.arrays import Array
from counterspin.inference.distributions import normal_cdf, normal_quantile
from counterspin.physics.spindle import TURN


def stretches(time: Array, values: Array, count: int) -> tuple[Array, Array, Array]:
    """Return middle times, smallest and largest values of at most `count` stretches of samples.

    The stretches hold equally many samples, so that a gap in the record stays one, and no sample
    however far out is lost.

    time, values: Shape (n,), n >= 1, in the order of time.
    count: At least 1.
    """
    first = _distinct(np.arange(count) * time.size // count)
    last = np.append(first[1:], time.size) - 1
    return (
        0.5 * (time[first] + time[last]),
        np.minimum.reduceat(values, first),
        np.maximum.reduceat(values, first),
    )


def over_revolution(angle: Array, values: Array, parts: int) -> tuple[Array, Array, Array]:
    """Return smallest, mean and largest values in equal parts of a revolution, shape (parts,).

    angle: Of the spindle, rad, any revolution, shape (n,).
    values: Shape (n,).
    """
    place = np.minimum((np.mod(angle, TURN) * (parts / TURN)).astype(np.intp), parts - 1)
    count = np.bincount(place, minlength=parts)
    low, high = np.full(parts, np.inf), np.full(parts, -np.inf)
    np.minimum.at(low, place, values)
    np.maximum.at(high, place, values)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(place, values, minlength=parts) / count
    empty = count == 0
    low[empty], high[empty] = np.nan, np.nan
    return low, mean, high


def smoothed_spectrum(
    power: Array, length: float, count: int
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Return frequencies (Hz), mean power and lines of at most `count` bands; 1 is white noise.

    The bands are equally wide on a logarithmic scale.

    power: The periodogram of whitened residuals, from `counterspin.inference.diagnostics`, shape
        (m,).
    length: Of the record, s: the inverse of the first line's frequency.
    count: At least 1.
    """
    edges = _distinct(np.geomspace(1.0, power.size + 1.0, count + 1).astype(np.intp))
    first, width = edges[:-1], np.diff(edges)
    frequency = (first + 0.5 * (width - 1)) / length
    return frequency, np.add.reduceat(power[: edges[-1] - 1], first - 1) / width, width


def normal_quantiles(whitened: Array, count: int) -> tuple[Array, Array]:
    """Return at most `count` ordered residuals beside the normal scores that belong to them.

    Blom's scores, those of ranks (i - 3/8) / (n + 1/4); the ranks are chosen evenly along them,
    so that the tails are whole where the middle is thinned.

    whitened: Shape (n,), n >= 1.
    count: At least 2.
    Returns: shape (m,), m <= count.
    """
    n = whitened.size
    end = normal_quantile(0.625 / (n + 0.25))
    levels = np.linspace(end, -end, min(count, n)).tolist()
    wanted = np.array([normal_cdf(level) for level in levels]) * (n + 0.25) + 0.375
    ranks = _distinct(np.clip(np.rint(wanted), 1, n).astype(np.intp))
    normal = [normal_quantile(p) for p in ((ranks - 0.375) / (n + 0.25)).tolist()]
    return np.array(normal), np.sort(whitened)[ranks - 1]


def _distinct(ascending: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return each value once; `np.unique` would load the masked arrays at its first call."""
    distinct: NDArray[np.intp] = ascending[np.append(True, np.diff(ascending) > 0)]
    return distinct
