"""Selection of the rows for a joint fit: rows that noise explains and that are independent.

Outliers, which the noise of their neighbours does not explain, are left out round by round, and
taken back where another model explains them.

A filter of the recorder makes rows that are not independent. All weights begin with noise that is
white. Behind a low-pass filter, or where the signal needs several samples to cross a step of the
recorded numbers, rows beside each other have nearly the same error, and a fit that takes them as
independent claims too much. Rows further apart than the filter remembers are independent, and hold
nearly all that the record says.

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
import numpy.typing as npt

from counterspin.arrays import SIGMA_OF_MAD, Array, median
from counterspin.errors import ConvergenceError
from counterspin.inference.distributions import student_quantile
from counterspin.inference.joint.fit import JointFit, solve_joint
from counterspin.inference.joint.prepared import Prepared
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import Noise

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


# Rounds of rejection ---------------------------------------------------------------------------

#: Which rows of each series are left out.
Rows = tuple[npt.NDArray[np.bool_], ...]

_ROUNDS: Final = 20

#: Share of a record beyond which what was left out is looked at again.
_MANY: Final = 0.01


def nothing_left_out(series: Sequence[Series]) -> Rows:
    """Return that no row is left out."""
    return tuple(np.zeros(record.time.size, dtype=bool) for record in series)


def kept(prepared: Sequence[Prepared], outliers: Rows) -> tuple[Prepared, ...]:
    """Return columns without the rows that are left out."""
    return tuple(
        part.without(mask) if mask.any() else part
        for part, mask in zip(prepared, outliers, strict=True)
    )


def reject(
    fit: JointFit, series: Sequence[Series], requests: Mapping[str, Noise], outliers: Rows
) -> tuple[JointFit, Rows]:
    """Leave outliers out, refitting until there are none.

    series: With all rows; `outliers` are those that the fit does not have.
    """
    for _ in range(_ROUNDS):
        further = standing_out(fit, series, requests, outliers)
        if not any(mask.any() for mask in further):
            return fit, outliers
        new = tuple(mask[~before] for mask, before in zip(further, outliers, strict=True))
        outliers = tuple(a | b for a, b in zip(outliers, further, strict=True))
        fit = solve_joint(kept(fit.prepared, new), fit.model, fit.noise)
    where = " and ".join(
        f"{part.run} ({part.accelerometer})"
        for part, mask in zip(fit.prepared, further, strict=True)
        if mask.any()
    )
    raise ConvergenceError(
        f"{where}: outliers were still found after {_ROUNDS} rounds of rejection: the residuals "
        f"are not noise around a smooth curve; inspect the record for a jump of "
        "its clock or displacement, or add the missing terms to the model"
    )


def taken_back(
    fit: JointFit,
    everything: tuple[Sequence[Prepared], Unknowns],
    series: Sequence[Series],
    requests: Mapping[str, Noise],
    outliers: Rows,
) -> tuple[JointFit, Rows]:
    """Take back what no longer stands out of a fit with another model.

    everything: The columns of all rows, and the model.
    """
    whole, model = everything
    again = solve_joint(kept(whole, outliers), model, fit.noise)
    # The same estimate, held against all rows.
    standing = standing_out(
        replace(again, observations=tuple(whole)), series, requests, nothing_left_out(series)
    )
    if not any((mask & ~new).any() for mask, new in zip(outliers, standing, strict=True)):
        return fit, outliers
    return solve_joint(kept(whole, standing), model, fit.noise), standing


def many(outliers: Rows) -> bool:
    """Return whether so many rows of a series are left out that they are worth a second look."""
    return any(mask.mean() > _MANY for mask in outliers)


def standing_out(
    fit: JointFit, series: Sequence[Series], requests: Mapping[str, Noise], outliers: Rows
) -> Rows:
    """Return which rows of each series are outliers besides those that are left out already."""
    further = []
    for index, (part, mask) in enumerate(zip(fit.prepared, outliers, strict=True)):
        time, weight = series[index].time, np.sqrt(series[index].count)
        left = np.full(time.size, np.nan)
        left[~mask] = fit.residuals[index].plain
        known = requests[part.accelerometer].known
        if part.series.jitter > 0.0:
            weight = weight / _jittered(
                left * weight,
                known.white,
                part.series.jitter,
                series[index].jitter_variance * series[index].relative,
            )
        further.append(outlying(left, weight, known.quantisation / math.sqrt(12.0), time))
    return tuple(further)


def _jittered(residuals: Array, white: float, jitter: float, variance: Array) -> Array:
    """Return each row's standard deviation over the rms, noise of the time stamps being uneven.

    What is less than usual counts as half of it: such rows are compared with noisier neighbours.
    """
    scale = SIGMA_OF_MAD * float(np.nanmedian(np.abs(residuals)))
    even = max(white**2, scale**2 - jitter**2)
    ratio: Array = np.sqrt(np.maximum((even + variance) / (even + jitter**2), 0.5))
    return ratio


# Independent rows ------------------------------------------------------------------------------

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
    # A harmonic at or beyond half the sampling rate would follow the errors of the time stamps.
    turn = abs(series.trajectory.spindle.rate) * median(np.diff(last))
    highest = min(_HARMONICS, int(math.pi / turn) - 1)
    waves = [f(j * angle) for j in range(1, highest + 1) for f in (np.cos, np.sin)]
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
