"""How far the mean of a record is from that of the next one: white noise, flicker and a walk.

The scatter of a record's own stretches tells u of its mean where they are independent. Where the
level wanders they are alike, and u would be too small, of a walk by a factor of ten. So u is
what two records of this length, one after the other, differ by (over sqrt 2: the Allan deviation
at the record's length), of white noise with flicker (1/f) or with a random walk beside it, in all
proportions, each weighted with the restricted likelihood that the stretches' means give it
(Patterson and Thompson, Biometrika 58 (1971) 545). Flicker is that of Kasdin, Proc. IEEE 83
(1995) 802.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np

from counterspin.arrays import Array

#: Weight of white noise alone before the record is looked at; the rest is shared out evenly among
#: the logarithms of the proportions. With it u of white noise is 1.4 times too large in the
#: median, and covers a walk that a record hardly shows in four of five records.
_WHITE_ALONE: Final = 0.5

#: Variance of the mean by the wander over that by white noise.
_PROPORTIONS: Final = np.geomspace(0.1, 1e5, 13)


def u_of_mean(means: Array) -> float:
    """Return the standard uncertainty of the mean of a record.

    means: Of its stretches, equally long, one after the other, shape (n,), n >= 3.
    """
    count = means.size
    freedom = count - 1
    if not np.ptp(means) > 0.0:
        return 0.0
    scaled = means / means.std()
    weight, variance = [], []
    proportions = np.append(0.0, _PROPORTIONS)
    prior = np.append(_WHITE_ALONE, np.full(_PROPORTIONS.size, 0.5 * (1.0 - _WHITE_ALONE)))
    prior[1:] /= _PROPORTIONS.size
    for sizes, contrasts in _wanders(count):
        spread = 1.0 + proportions[:, None] * sizes
        squares = np.sum((scaled @ contrasts) ** 2 / spread, axis=1)
        log = -0.5 * np.log(spread).sum(axis=1) - 0.5 * freedom * np.log(squares)
        # White noise alone stands once in each of the two kinds.
        weight.append(log + np.log(np.append(0.5 * prior[0], prior[1:])))
        variance.append(squares / freedom * (1.0 + proportions) / count)
    likely = np.exp(np.concatenate(weight) - np.max(weight))
    found = float(likely @ np.concatenate(variance)) / float(likely.sum())
    return math.sqrt(found) * float(means.std())


@lru_cache(maxsize=8)
def _wanders(count: int) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return flicker and walk of n means: n-1 variances of uncorrelated contrasts, and these.

    Their scale is that at which the mean of all has the variance that white noise of unit
    variance gives it; shapes (n-1,) and (n, n-1).
    """
    steps = np.arange(1.0, 2.0 * count)
    response = np.append(1.0, np.cumprod((steps - 0.5) / steps))
    lag = np.subtract.outer(np.arange(2 * count), np.arange(2 * count))
    flicker = np.where(lag >= 0, response[np.abs(lag)], 0.0)
    walk = np.tril(np.ones((2 * count, 2 * count)))
    next_less_this = np.repeat([-1.0 / count, 1.0 / count], count)
    # Whatever has no mean: the last rows of an orthogonal matrix whose first is even.
    flat = np.linalg.svd(np.ones((1, count)))[2][1:].T
    found = []
    for shape in (flicker, walk):
        covariance = shape @ shape.T
        unit = 0.5 * float(next_less_this @ covariance @ next_less_this) * count
        sizes, turn = np.linalg.eigh(flat.T @ covariance[:count, :count] @ flat / unit)
        found.append((np.maximum(sizes, 0.0), flat @ turn))
    return found[0], found[1]
