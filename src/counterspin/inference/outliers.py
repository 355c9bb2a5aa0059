"""Outliers among residuals: samples that the noise of their neighbours does not explain.

- `outlying`: one pass over the residuals of one series
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from counterspin.physics.accelerometer import Array

#: Expected number of good samples of a whole series that Gaussian noise loses.
FALSE_ALARMS: Final = 0.01

#: Samples on either side whose median is taken away: slow wander is not outlying.
_REACH: Final = 32

#: Standard deviation of a Gaussian over its median absolute deviation.
_MAD: Final = 1.4826

#: Degrees of freedom of that scale for each independent sample.
_MAD_EFFICIENCY: Final = 0.37


def outlying(residuals: Array, weight: Array, floor: float = 0.0) -> npt.NDArray[np.bool_]:
    """Return which residuals are outliers.

    A residual is one where its distance from the median of its neighbours exceeds what Gaussian
    noise of the series' own robust scale (median absolute deviation) reaches in `FALSE_ALARMS`
    samples of the whole series: 5 standard deviations for 20,000 samples. The caller fits again
    without them and asks again, until none is left; gross ones no longer mask the others then.
    Where a walk dwarfs the white noise within `_REACH` samples, it may be taken for outliers.

    Parameters
    ----------
    residuals
        In time order, shape (n,).
    weight
        Inverse relative standard deviation of each residual, shape (n,).
    floor
        Least credible standard deviation at weight 1, such as that of a quantisation step.

    Returns
    -------
    array of bool
        Shape (n,).
    """
    n = residuals.size
    if n < 2 * _REACH:
        return np.zeros(n, dtype=bool)
    local, variance = _wander(residuals)
    signed = (residuals - local) * weight / np.sqrt(1.0 + variance)
    distance = np.abs(signed)
    scale = max(_MAD * float(np.median(distance)), floor)
    if scale == 0.0:
        # More than half of the residuals are alike (coarse steps): use the spread of the rest.
        scale = float(np.sqrt(np.mean(distance**2)))
    # Noise that wanders changes sign seldom, and its scale rests on as few distances.
    independent = 2 * np.count_nonzero(np.diff(np.signbit(signed)))
    dof = max(_MAD_EFFICIENCY * independent, 1.0)
    threshold = -float(stdtrit(dof, 0.5 * FALSE_ALARMS / n))
    found: npt.NDArray[np.bool_] = distance > threshold * scale
    return found


def _wander(residuals: Array) -> tuple[Array, Array]:
    """Return where each sample's neighbours say that it is, and that value's relative variance.

    The neighbours are taken in pairs, one before the sample and one as far after it; of the pairs'
    means the median is taken. A slope, however steep, is no distance then, and the sample itself
    is not among them. Pairs are fewer near an end; the first four samples have a line through two
    medians instead.
    """
    local, variance = np.empty(residuals.size), np.empty(residuals.size)
    if residuals.size > 2 * _REACH:
        # Every second pair serves as well and takes half of the time.
        inner = slice(_REACH, residuals.size - _REACH)
        local[inner], variance[inner] = _of_pairs(residuals, range(2, _REACH + 1, 2))
    for step in (1, -1):
        end, seen, spread = residuals[::step], local[::step], variance[::step]
        for reach in (16, 8, 4):
            here = slice(reach, 2 * reach)
            seen[here], spread[here] = _of_pairs(end[: 3 * reach], range(1, reach + 1))
        near, far = np.median(end[4:10]), np.median(end[10:16])
        ahead = (6.5 - np.arange(4)) / 6.0
        seen[:4] = near + (near - far) * ahead
        spread[:4] = ((1.0 + ahead) ** 2 + ahead**2) * _median_variance(6)
    return local, variance


def _of_pairs(values: Array, apart: range) -> tuple[Array, float]:
    """Return the median of the means of pairs about each sample that has them all."""
    reach, n = apart[-1], values.size
    means = np.empty((n - 2 * reach, len(apart)))
    for column, k in enumerate(apart):
        means[:, column] = values[reach - k : n - reach - k] + values[reach + k : n - reach + k]
    return 0.5 * np.median(means, axis=1), 0.5 * _median_variance(len(apart))


def _median_variance(count: int) -> float:
    """Return the variance of the median of `count` Gaussian samples over that of one."""
    return 0.5 * math.pi / count
