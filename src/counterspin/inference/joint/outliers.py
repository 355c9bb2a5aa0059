"""Outliers among residuals: samples that the noise of their neighbours does not explain."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import SIGMA_OF_MAD, Array, median
from counterspin.inference.distributions import student_quantile

#: Expected number of good samples of a whole series that Gaussian noise loses.
FALSE_ALARMS: Final = 0.01

#: Samples on either side whose median is taken away: slow wander is not outlying. Where a walk is
#: larger than the white noise within the first, the second serves.
_MEDIAN_REACH: Final = 32
_NEAR_MEDIAN_REACH: Final = 4

#: Ratio of the scales below which the second serves.
_CALM_RATIO: Final = 0.8

#: A step this much longer than usual is a gap.
_GAP_STEPS: Final = 1.5

#: Degrees of freedom of that scale for each independent sample.
_MAD_EFFICIENCY: Final = 0.37


def outlying(
    residuals: Array, weight: Array, floor: float = 0.0, time: Array | None = None
) -> npt.NDArray[np.bool_]:
    """Return which residuals are outliers.

    A residual is one where its distance from the median of its neighbours exceeds what Gaussian
    noise of the series' own robust scale (median absolute deviation) reaches in `FALSE_ALARMS`
    samples of the whole series: 5 standard deviations for 20,000 samples. The caller fits again
    without them and asks again, until none is left; gross ones no longer mask the others then.

    Where a walk is larger than the white noise among the neighbours, fewer of them are asked. The
    samples at the ends, whose neighbours are all on one side, are then judged by what the same
    prediction misses elsewhere in the series, and those beside a gap are not judged.

    residuals: In time order, shape (n,); NaN where a sample has been left out already.
    weight: Inverse relative standard deviation of each residual, shape (n,).
    floor: Least credible standard deviation at weight 1, such as that of a quantisation step.
    time: Shape (n,), which shows the gaps; None: there are none.
    Returns: shape (n,); false where a sample has been left out already.
    """
    n, there = residuals.size, np.isfinite(residuals)
    if np.count_nonzero(there) <= 2 * _MEDIAN_REACH:
        return np.zeros(n, dtype=bool)
    place = np.arange(float(n)) if time is None else time
    filled = np.interp(place, place[there], residuals[there])
    signed = _apart(filled, _MEDIAN_REACH) * weight
    scale, judged = _scale(signed[there]), there
    nearer = _apart(filled, _NEAR_MEDIAN_REACH) * weight
    if _scale(nearer[there]) < _CALM_RATIO * scale:
        signed, scale = nearer, _scale(nearer[there])
        for step in (1, -1):
            wide = _scales_of_ends((filled * weight)[::step])
            signed[::step][: wide.size] /= np.maximum(wide / scale, 1.0)
        judged = there & ~_beside_a_gap(place, _NEAR_MEDIAN_REACH)
    scale = max(scale, floor)
    distance = np.where(judged, np.abs(signed), 0.0)
    if scale == 0.0:
        # More than half of the residuals are alike (coarse steps): use the spread of the rest.
        scale = float(np.sqrt(np.mean(distance[judged] ** 2)))
    # Noise that wanders changes sign seldom, and its scale rests on as few distances.
    independent = 2 * np.count_nonzero(np.diff(np.signbit(signed[there])))
    dof = max(_MAD_EFFICIENCY * independent, 1.0)
    threshold = -student_quantile(dof, 0.5 * FALSE_ALARMS / n)
    found: npt.NDArray[np.bool_] = distance > threshold * scale
    return found


def _beside_a_gap(place: Array, reach: int) -> npt.NDArray[np.bool_]:
    """Return which samples have neighbours within the reach that are farther off than usual."""
    steps = np.diff(place)
    wide = np.append(steps > _GAP_STEPS * median(steps), False)
    after = np.flatnonzero(wide)
    near = np.zeros(place.size, dtype=bool)
    for k in range(-reach + 1, reach + 1):
        near[np.clip(after + k, 0, place.size - 1)] = True
    return near


def _scale(signed: Array) -> float:
    """Return the robust standard deviation."""
    return SIGMA_OF_MAD * median(np.abs(signed))


def _apart(residuals: Array, reach: int) -> Array:
    """Return each sample's distance from where its neighbours say that it is.

    The neighbours are taken in pairs, one before the sample and one as far after it; of the pairs'
    means the median is taken. A slope, however steep, is no distance then, and the sample itself
    is not among them. Pairs are fewer near an end; the first four samples have a line through two
    medians instead. Distances are in units of what they are for white noise.
    """
    local, variance = np.empty(residuals.size), np.empty(residuals.size)
    inner = slice(reach, residuals.size - reach)
    # Every second pair of many serves as well and takes half of the time.
    pairs = range(2, reach + 1, 2) if reach == _MEDIAN_REACH else range(1, reach + 1)
    local[inner], variance[inner] = _of_pairs(residuals, pairs)
    for step in (1, -1):
        end, seen, spread = residuals[::step], local[::step], variance[::step]
        for fewer in (16, 8, 4):
            if fewer < reach:
                here = slice(fewer, 2 * fewer)
                seen[here], spread[here] = _of_pairs(end[: 3 * fewer], range(1, fewer + 1))
        near, far = median(end[4:10]), median(end[10:16])
        seen[:4], spread[:4] = near + (near - far) * _AHEAD, _AHEAD_VARIANCE
    return (residuals - local) / np.sqrt(1.0 + variance)


def _scales_of_ends(values: Array) -> Array:
    """Return the scale of the first four samples' distances, as the whole series shows it."""
    windows = np.lib.stride_tricks.sliding_window_view(values, 16)
    near, far = (np.median(windows[:, part], axis=1) for part in (slice(4, 10), slice(10, 16)))
    missed = windows[:, :4] - near[:, None] - (near - far)[:, None] * _AHEAD
    return SIGMA_OF_MAD * np.median(np.abs(missed / np.sqrt(1.0 + _AHEAD_VARIANCE)), axis=0)


def _of_pairs(values: Array, apart: range) -> tuple[Array, float]:
    """Return the median of the means of pairs, an even number, about each sample that has them."""
    first, reach, step, half = apart[0], apart[-1], apart.step, len(apart) // 2
    about = np.lib.stride_tricks.sliding_window_view(values, 2 * reach + 1)
    before, after = about[:, : reach - first + 1 : step], about[:, : reach + first - 1 : -step]
    # Short rows are sorted faster than they are parted, which is what a median would do.
    sums = np.add(before, after, order="C")
    sums.sort(axis=1)
    return 0.25 * (sums[:, half - 1] + sums[:, half]), 0.5 * _median_variance(len(apart))


def _median_variance(count: int) -> float:
    """Return the variance of the median of `count` Gaussian samples over that of one."""
    return 0.5 * math.pi / count


#: The line through the medians of samples 4 to 9 and 10 to 15 at the first four samples: how far
#: beyond the first median, in their distance, and the line's variance.
_AHEAD: Final[Array] = np.array([6.5, 5.5, 4.5, 3.5]) / 6.0
_AHEAD_VARIANCE: Final[Array] = ((1.0 + _AHEAD) ** 2 + _AHEAD**2) * _median_variance(6)
