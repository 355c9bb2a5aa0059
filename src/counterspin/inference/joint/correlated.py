"""Rows that are not independent, as a filter of the recorder makes them: only some are used.

All weights begin with noise that is white. Behind a low-pass filter, or where the signal needs
several samples to cross a step of the recorded numbers, rows beside each other have nearly the
same error, and a fit that takes them as independent claims too much. Rows further apart than the
filter remembers are independent, and hold nearly all that the record says.

The sign of it: third differences of the residuals over a lag grow with the lag and then stay, where
the filter has forgotten. Those of independent rows do not grow. Those of noise of the
accelerometer, which is integrated, and of a slow misfit, grow with every doubling of the lag, to
twice, eight times or more, and those of a vibration come and go. All runs of an accelerometer are
behind the same filter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import SIGMA_OF_MAD, Array, median
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.series import Series

#: Fewest independent rows of all runs, and of one.
_FEWEST: Final = 60
_FEWEST_OF_ONE: Final = 8

#: Ratio of variances that shows correlation: this, and so many times its standard uncertainty,
#: which is 1.5 over the root of the number of rows.
_LEAST_RATIO: Final = 1.5
_SIGMAS: Final = 8.0

#: Parts of a lag from it to its double, and the ratio of two variances over them below which they
#: stay.
_PARTS: Final = (1.0, 1.25, 1.5, 1.75, 2.0)
_STAYS: Final = 1.4

#: Ratio of the first two variances below which rows are independent, whatever comes later.
_GROWS: Final = 1.1

#: Standard deviations beyond which a third difference is an outlier's.
_CLIP: Final = 5.0

#: Harmonics of the spindle, and powers of time, that are no noise: an encoder that errs four times
#: a revolution makes five, K_OQ makes seven that show.
_HARMONICS: Final = 8
_POWERS: Final = 4


def independent(fit: JointFit, series: Sequence[Series]) -> tuple[Series, ...]:
    """Return series with as many of their rows as are independent.

    fit: Of these series, with all of their rows.
    """
    thinned = list(series)
    for name in dict.fromkeys(one.accelerometer for one in series):
        places = [i for i, one in enumerate(series) if one.accelerometer == name]
        spacing = {i: median(np.diff(series[i].time)) for i in places}
        plain = {i: fit.residuals[i].plain * np.sqrt(series[i].count) for i in places}
        if _grows(plain, spacing):
            memory = _memory({i: without_waves(series[i], plain[i]) for i in places}, spacing)
        else:
            memory = 0.0
        for i in places if memory else ():
            step = min(round(memory / spacing[i]), series[i].time.size // _FEWEST_OF_ONE)
            thinned[i] = _every(series[i], max(step, 1))
    return tuple(thinned)


def _every(series: Series, step: int) -> Series:
    if step == 1:
        return series
    return replace(series.without(np.arange(series.time.size) % step > 0), every=step)


def _grows(left: Mapping[int, Array], spacing: Mapping[int, float]) -> bool:
    """Return whether third differences grow at all from the shortest lag to its double."""
    lag = max(spacing.values())
    steps = {i: max(round(lag / spacing[i]), 1) for i in left}
    return any(_size(one, 2 * steps[i]) > _GROWS * _size(one, steps[i]) for i, one in left.items())


def without_waves(series: Series, residuals: Array) -> Array:
    """Return residuals without what is slow or goes with the spindle, shape (n,).

    White noise keeps its variance, as a whole.

    residuals: Of a series' last n rows, more than there are shapes of these.
    """
    last = series.time[-residuals.size :]
    angle = series.trajectory.spindle.angle(last)
    waves = [f(j * angle) for j in range(1, _HARMONICS + 1) for f in (np.cos, np.sin)]
    shapes = np.column_stack([*np.vander(last / last[-1], _POWERS).T, *waves])
    found = np.linalg.lstsq(shapes, residuals, rcond=None)[0]
    count, gone = shapes.shape
    return np.asarray((residuals - shapes @ found) * math.sqrt(count / (count - gone)))


def _memory(left: Mapping[int, Array], spacing: Mapping[int, float]) -> float:
    """Return after what time noise is forgotten, s; 0 where it is not remembered, or for ever."""
    rows = sum(one.size for one in left.values())
    least = max(_LEAST_RATIO, 1.0 + _SIGMAS * 1.5 / math.sqrt(rows))
    lag = max(spacing.values())
    first = {i: _size(one, max(round(lag / spacing[i]), 1)) for i, one in left.items()}

    def growth(lag: float) -> tuple[float, float]:
        """Return how many times as large as over the first lag, and of how many rows."""
        steps = {i: max(round(lag / spacing[i]), 1) for i in left}
        used = {i: k for i, k in steps.items() if left[i].size >= 6 * k and first[i] > 0.0}
        counts = {i: left[i].size / k for i, k in used.items()}
        total = sum(counts.values())
        grown = sum(counts[i] * _size(left[i], k) / first[i] for i, k in used.items())
        return grown / max(total, 1.0), total

    while True:
        sizes = [growth(part * lag) for part in _PARTS]
        if sizes[-1][1] < _FEWEST:
            return 0.0
        sizes_only = [size for size, _ in sizes]
        if max(sizes_only) < _STAYS * min(sizes_only):
            return 2.0 * lag if sizes_only[-1] > least else 0.0
        lag *= 2.0


def _size(left: Array, step: int) -> float:
    """Return the variance of a row from third differences over a step, outliers clipped."""
    third = left[3 * step :] - 3.0 * left[2 * step : -step] + 3.0 * left[step : -2 * step]
    third = third - left[: -3 * step]
    if not third.size:
        return 0.0
    limit = _CLIP * SIGMA_OF_MAD * median(np.abs(third))
    return float(np.mean(np.clip(third, -limit, limit) ** 2) / 20.0)
