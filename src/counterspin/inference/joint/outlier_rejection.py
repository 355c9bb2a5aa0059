"""Outlier rejection and thinning: the rows that a joint fit uses.

Outliers are rejected round by round, and reinstated where another model explains them.

A low-pass filter of the recorder correlates the errors of neighbouring rows. So does a signal that
needs several samples to cross a quantisation step. The first fit assumes white noise, and would
understate the uncertainty. Rows further apart than the correlation time are independent and contain
nearly all information of the record.

Test: the variance of lag-k third differences rises with k and levels off beyond the filter's
correlation time. For independent rows it does not rise. For integrated noise of the accelerometer,
and for a slow misfit, it rises with every doubling of the lag, to twice, eight times or more. For a
vibration it rises and falls. All runs of an accelerometer have the same filter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import MAD_TO_SIGMA, Array, median
from counterspin.errors import ConvergenceError
from counterspin.inference.distributions import student_quantile
from counterspin.inference.joint.design_blocks import DesignBlock
from counterspin.inference.joint.fit import JointFit, solve_joint
from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.physics.spindle import Spindle

#: Expected number of good samples of a whole series that Gaussian noise loses.
FALSE_ALARMS: Final = 0.01

#: Samples on either side whose median is taken away: slow wander is not outlying. Where a walk is
#: larger than the white noise within the first, the second serves.
_MEDIAN_HALF_WIDTH: Final = 32
_NARROW_HALF_WIDTH: Final = 4

#: Ratio of the scales below which the second serves.
_WALK_RATIO: Final = 0.8

#: A step this much longer than usual is a gap.
_GAP_STEPS: Final = 1.5

#: Degrees of freedom of that scale for each independent sample.
_MAD_EFFICIENCY: Final = 0.37


def outlier_mask(
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
    n, is_present = residuals.size, np.isfinite(residuals)
    if np.count_nonzero(is_present) <= 2 * _MEDIAN_HALF_WIDTH:
        return np.zeros(n, dtype=bool)
    position = np.arange(float(n)) if time is None else time
    interpolated = np.interp(position, position[is_present], residuals[is_present])
    deviation = _local_deviation(interpolated, _MEDIAN_HALF_WIDTH) * weight
    scale, is_tested = _robust_sd(deviation[is_present]), is_present
    narrow_deviation = _local_deviation(interpolated, _NARROW_HALF_WIDTH) * weight
    if _robust_sd(narrow_deviation[is_present]) < _WALK_RATIO * scale:
        deviation, scale = narrow_deviation, _robust_sd(narrow_deviation[is_present])
        for step in (1, -1):
            end_scales = _end_scales((interpolated * weight)[::step])
            deviation[::step][: end_scales.size] /= np.maximum(end_scales / scale, 1.0)
        is_tested = is_present & ~_is_near_gap(position, _NARROW_HALF_WIDTH)
    scale = max(scale, floor)
    distance = np.where(is_tested, np.abs(deviation), 0.0)
    if scale == 0.0:
        # More than half of the residuals are alike (coarse steps): use the spread of the rest.
        scale = float(np.sqrt(np.mean(distance[is_tested] ** 2)))
    # Noise that wanders changes sign seldom, and its scale rests on as few distances.
    independent = 2 * np.count_nonzero(np.diff(np.signbit(deviation[is_present])))
    dof = max(_MAD_EFFICIENCY * independent, 1.0)
    threshold = -student_quantile(dof, 0.5 * FALSE_ALARMS / n)
    outliers: npt.NDArray[np.bool_] = distance > threshold * scale
    return outliers


def _is_near_gap(position: Array, half_width: int) -> npt.NDArray[np.bool_]:
    """Return the mask of the samples that have a gap within so many neighbours."""
    steps = np.diff(position)
    is_gap = np.append(steps > _GAP_STEPS * median(steps), False)
    gap_indices = np.flatnonzero(is_gap)
    is_near = np.zeros(position.size, dtype=bool)
    for k in range(-half_width + 1, half_width + 1):
        is_near[np.clip(gap_indices + k, 0, position.size - 1)] = True
    return is_near


def _robust_sd(deviations: Array) -> float:
    """Return the robust standard deviation."""
    return MAD_TO_SIGMA * median(np.abs(deviations))


def _local_deviation(residuals: Array, half_width_max: int) -> Array:
    """Return the deviation of each sample from its neighbours' median, in standard deviations.

    The neighbours are taken in pairs, one before the sample and one as far after it; of the pairs'
    means the median is taken. A slope, however steep, is no distance then, and the sample itself
    is not among them. Pairs are fewer near an end; the first four samples have a line through two
    medians instead. Distances are in units of what they are for white noise.
    """
    local, variance = np.empty(residuals.size), np.empty(residuals.size)
    inner = slice(half_width_max, residuals.size - half_width_max)
    # Every second pair of many serves as well and takes half of the time.
    pairs = (
        range(2, half_width_max + 1, 2)
        if half_width_max == _MEDIAN_HALF_WIDTH
        else range(1, half_width_max + 1)
    )
    local[inner], variance[inner] = _pair_median(residuals, pairs)
    for step in (1, -1):
        end, local_end, spread = residuals[::step], local[::step], variance[::step]
        for half_width in (16, 8, 4):
            if half_width < half_width_max:
                section = slice(half_width, 2 * half_width)
                local_end[section], spread[section] = _pair_median(
                    end[: 3 * half_width], range(1, half_width + 1)
                )
        near_median, far_median = median(end[4:10]), median(end[10:16])
        local_end[:4], spread[:4] = (
            near_median + (near_median - far_median) * _EXTRAPOLATION,
            _EXTRAPOLATION_VARIANCE,
        )
    return (residuals - local) / np.sqrt(1.0 + variance)


def _end_scales(values: Array) -> Array:
    """Return the standard deviation of the first four samples' deviations, from the series."""
    windows = np.lib.stride_tricks.sliding_window_view(values, 16)
    near, far = (np.median(windows[:, part], axis=1) for part in (slice(4, 10), slice(10, 16)))
    errors = windows[:, :4] - near[:, None] - (near - far)[:, None] * _EXTRAPOLATION
    return MAD_TO_SIGMA * np.median(np.abs(errors / np.sqrt(1.0 + _EXTRAPOLATION_VARIANCE)), axis=0)


def _pair_median(values: Array, distances: range) -> tuple[Array, float]:
    """Return the median of the means of pairs, an even number, about each sample that has them."""
    shortest, reach, step, half = distances[0], distances[-1], distances.step, len(distances) // 2
    windows = np.lib.stride_tricks.sliding_window_view(values, 2 * reach + 1)
    left, right = (
        windows[:, : reach - shortest + 1 : step],
        windows[:, : reach + shortest - 1 : -step],
    )
    # Short rows are sorted faster than they are parted, which is what a median would do.
    sums = np.add(left, right, order="C")
    sums.sort(axis=1)
    return 0.25 * (sums[:, half - 1] + sums[:, half]), 0.5 * _median_variance(len(distances))


def _median_variance(count: int) -> float:
    """Return the variance of the median of `count` Gaussian samples over that of one."""
    return 0.5 * math.pi / count


#: The line through the medians of samples 4 to 9 and 10 to 15 at the first four samples: how far
#: beyond the first median, in their distance, and the line's variance.
_EXTRAPOLATION: Final[Array] = np.array([6.5, 5.5, 4.5, 3.5]) / 6.0
_EXTRAPOLATION_VARIANCE: Final[Array] = (
    (1.0 + _EXTRAPOLATION) ** 2 + _EXTRAPOLATION**2
) * _median_variance(6)


# Rounds of rejection ---------------------------------------------------------------------------

#: Masks of the outliers of each series.
RowMasks = tuple[npt.NDArray[np.bool_], ...]

_MAX_ROUNDS: Final = 20

#: Share of a record beyond which what was left out is looked at again.
_MANY_OUTLIERS: Final = 0.01


def no_outliers(series: Sequence[ResidualSeries]) -> RowMasks:
    """Return masks that exclude no row."""
    return tuple(np.zeros(record.time.size, dtype=bool) for record in series)


def select_rows(blocks: Sequence[DesignBlock], outliers: RowMasks) -> tuple[DesignBlock, ...]:
    """Return the columns without the outliers."""
    return tuple(
        block.drop_rows(mask) if mask.any() else block
        for block, mask in zip(blocks, outliers, strict=True)
    )


def reject_outliers(
    fit: JointFit,
    series: Sequence[ResidualSeries],
    requests: Mapping[str, Noise],
    outliers: RowMasks,
) -> tuple[JointFit, RowMasks]:
    """Reject outliers and refit until there are none.

    series: With all rows; `outliers` are those that the fit does not have.
    """
    for _ in range(_MAX_ROUNDS):
        new_outliers = find_outliers(fit, series, requests, outliers)
        if not any(mask.any() for mask in new_outliers):
            return fit, outliers
        mask_of_kept = tuple(
            mask[~previous_mask] for mask, previous_mask in zip(new_outliers, outliers, strict=True)
        )
        outliers = tuple(a | b for a, b in zip(outliers, new_outliers, strict=True))
        fit = solve_joint(select_rows(fit.design_blocks, mask_of_kept), fit.model, fit.noise)
    where = " and ".join(
        f"{block.run} ({block.accelerometer})"
        for block, mask in zip(fit.design_blocks, new_outliers, strict=True)
        if mask.any()
    )
    raise ConvergenceError(
        f"{where}: outliers were still found after {_MAX_ROUNDS} rounds of rejection, so the "
        "residuals are not noise about a smooth curve. Inspect the record for a jump in the "
        "clock or the displacement, or add the missing terms to the model"
    )


def reinstate_rows(
    fit: JointFit,
    full_problem: tuple[Sequence[DesignBlock], Unknowns],
    series: Sequence[ResidualSeries],
    requests: Mapping[str, Noise],
    outliers: RowMasks,
) -> tuple[JointFit, RowMasks]:
    """Reinstate rows that are not outliers under the new model.

    full_problem: The columns of all rows, and the model.
    """
    all_blocks, model = full_problem
    refit = solve_joint(select_rows(all_blocks, outliers), model, fit.noise)
    # The same estimate, held against all rows.
    outliers_now = find_outliers(
        replace(refit, observations=tuple(all_blocks)), series, requests, no_outliers(series)
    )
    if not any((mask & ~new).any() for mask, new in zip(outliers, outliers_now, strict=True)):
        return fit, outliers
    return solve_joint(select_rows(all_blocks, outliers_now), model, fit.noise), outliers_now


def has_many_outliers(outliers: RowMasks) -> bool:
    """Return whether more than 1 % of the rows of a series are outliers."""
    return any(mask.mean() > _MANY_OUTLIERS for mask in outliers)


def find_outliers(
    fit: JointFit,
    series: Sequence[ResidualSeries],
    requests: Mapping[str, Noise],
    outliers: RowMasks,
) -> RowMasks:
    """Return the masks of further outliers in each series."""
    new_masks = []
    for index, (block, mask) in enumerate(zip(fit.design_blocks, outliers, strict=True)):
        time, weight = series[index].time, np.sqrt(series[index].count)
        residuals = np.full(time.size, np.nan)
        residuals[~mask] = fit.residuals[index].unweighted
        stated_noise = requests[block.accelerometer].known
        if block.series.timing_noise > 0.0:
            weight = weight / _relative_sd(
                residuals * weight,
                stated_noise.white,
                block.series.timing_noise,
                series[index].jitter_variance * series[index].variance_ratio,
            )
        new_masks.append(
            outlier_mask(residuals, weight, stated_noise.quantisation / math.sqrt(12.0), time)
        )
    return tuple(new_masks)


def _relative_sd(residuals: Array, white: float, jitter: float, variance: Array) -> Array:
    """Return each row's standard deviation over the rms, noise of the time stamps being uneven.

    What is less than usual counts as half of it: such rows are compared with noisier neighbours.
    """
    scale = MAD_TO_SIGMA * float(np.nanmedian(np.abs(residuals)))
    even = max(white**2, scale**2 - jitter**2)
    ratio: Array = np.sqrt(np.maximum((even + variance) / (even + jitter**2), 0.5))
    return ratio


# Independent rows ------------------------------------------------------------------------------

#: Fewest independent rows of all runs, and of one.
_MIN_ROWS: Final = 60
_MIN_ROWS_PER_RUN: Final = 8

#: Ratio of variances that shows correlation: this, and so many times its standard uncertainty,
#: which is 1.5 over the root of the number of rows.
_MIN_VARIANCE_RATIO: Final = 1.5
_THRESHOLD_SDS: Final = 8.0

#: Parts of a lag from it to its double, and the ratio of two variances over them below which they
#: stay.
_LAG_FACTORS: Final = (1.0, 1.25, 1.5, 1.75, 2.0)
_PLATEAU_RATIO: Final = 1.4

#: Ratio of the first two variances below which rows are independent, whatever comes later.
_GROWTH_RATIO: Final = 1.1

#: Standard deviations beyond which a third difference is an outlier's.
_CLIP_SDS: Final = 5.0

#: Harmonics of the spindle, and powers of time, that are no noise: an encoder that errs four times
#: a revolution makes five, K_OQ makes seven that show.
_HARMONICS: Final = 8
#: Eigenvalue below which a combination of these is none, relative to the largest.
_MIN_EIGENVALUE: Final = 1e-12
_POLYNOMIAL_TERMS: Final = 4


def thin_rows(fit: JointFit, series: Sequence[ResidualSeries]) -> tuple[ResidualSeries, ...]:
    """Thin the rows of series to independent ones.

    fit: Of these series, with all of their rows.
    """
    thinned_series = list(series)
    for name in dict.fromkeys(record.accelerometer for record in series):
        indices = [i for i, record in enumerate(series) if record.accelerometer == name]
        spacing = {i: median(np.diff(series[i].time)) for i in indices}
        row_residuals = {i: fit.residuals[i].unweighted * np.sqrt(series[i].count) for i in indices}
        if _is_correlated(row_residuals, spacing):
            correlation_time = _correlation_time(
                {i: remove_harmonics(series[i], row_residuals[i]) for i in indices}, spacing
            )
        else:
            correlation_time = 0.0
        for i in indices if correlation_time else ():
            step = min(
                round(correlation_time / spacing[i]), series[i].time.size // _MIN_ROWS_PER_RUN
            )
            thinned_series[i] = _take_every(series[i], max(step, 1))
    return tuple(thinned_series)


def _take_every(series: ResidualSeries, step: int) -> ResidualSeries:
    if step == 1:
        return series
    return replace(series.drop_rows(np.arange(series.time.size) % step > 0), thinning=step)


def _is_correlated(residuals: Mapping[int, Array], spacing: Mapping[int, float]) -> bool:
    """Return whether third differences grow from the shortest lag to its double."""
    lag = max(spacing.values())
    steps = {i: max(round(lag / spacing[i]), 1) for i in residuals}
    return any(
        _third_difference_variance(values, 2 * steps[i])
        > _GROWTH_RATIO * _third_difference_variance(values, steps[i])
        for i, values in residuals.items()
    )


def remove_harmonics(series: ResidualSeries, residuals: Array) -> Array:
    """Remove a trend and the spindle's harmonics from residuals, shape (n,) or (k, n).

    The total variance of white noise is preserved.

    residuals: Of a series' last n rows, more than there are shapes of these.
    """
    times = series.time[-residuals.shape[-1] :]
    regressors, inverse = _harmonic_regressors(series.trajectory.spindle, times.tobytes())
    regressor_count, count = regressors.shape
    fitted_harmonics = (inverse @ (regressors @ residuals.T)).T @ regressors
    return np.asarray((residuals - fitted_harmonics) * math.sqrt(count / (count - regressor_count)))


@lru_cache(maxsize=1)
def _harmonic_regressors(spindle: Spindle, time_bytes: bytes) -> tuple[Array, Array]:
    """Return trend and harmonics at times, rows, and the inverse of their Gram matrix.

    Accelerometers of a run usually share the times.
    """
    times = np.frombuffer(time_bytes)
    # A harmonic at or beyond half the sampling rate would follow the errors of the time stamps.
    angle_step = abs(spindle.rate) * median(np.diff(times))
    highest = min(_HARMONICS, int(math.pi / angle_step) - 1)
    phasor = np.exp(1j * spindle.angle(times))
    waves = np.cumprod(np.broadcast_to(phasor, (max(highest, 0), times.size)), axis=0)
    powers = np.cumprod(np.broadcast_to(times / times[-1], (_POLYNOMIAL_TERMS - 1, times.size)), 0)
    regressors = np.concatenate([np.ones((1, times.size)), powers, waves.real, waves.imag])
    # Ten times as fast as a decomposition of the regressors, which are few and of similar size.
    inverse = np.linalg.pinv(regressors @ regressors.T, rcond=_MIN_EIGENVALUE, hermitian=True)
    return regressors, inverse


def _correlation_time(residuals: Mapping[int, Array], spacing: Mapping[int, float]) -> float:
    """Return twice the lag at which the variance levels off, s; 0 without correlation."""
    rows = sum(values.size for values in residuals.values())
    min_ratio = max(_MIN_VARIANCE_RATIO, 1.0 + _THRESHOLD_SDS * 1.5 / math.sqrt(rows))
    lag = max(spacing.values())
    lag_one = {
        i: _third_difference_variance(values, max(round(lag / spacing[i]), 1))
        for i, values in residuals.items()
    }

    def growth(lag: float) -> tuple[float, float]:
        """Return the variance over that of the first lag, and the number of independent rows."""
        steps = {i: max(round(lag / spacing[i]), 1) for i in residuals}
        selected = {
            i: k for i, k in steps.items() if residuals[i].size >= 6 * k and lag_one[i] > 0.0
        }
        counts = {i: residuals[i].size / k for i, k in selected.items()}
        total = sum(counts.values())
        weighted_ratio = sum(
            counts[i] * _third_difference_variance(residuals[i], k) / lag_one[i]
            for i, k in selected.items()
        )
        return weighted_ratio / max(total, 1.0), total

    while True:
        ratios_and_counts = [growth(factor * lag) for factor in _LAG_FACTORS]
        if ratios_and_counts[-1][1] < _MIN_ROWS:
            return 0.0
        ratios = [ratio for ratio, _ in ratios_and_counts]
        if max(ratios) < _PLATEAU_RATIO * min(ratios):
            return 2.0 * lag if ratios[-1] > min_ratio else 0.0
        lag *= 2.0


def _third_difference_variance(residuals: Array, step: int) -> float:
    """Return the variance of a row from third differences over a step, outliers clipped."""
    differences = (
        residuals[3 * step :]
        - 3.0 * residuals[2 * step : -step]
        + 3.0 * residuals[step : -2 * step]
    )
    differences = differences - residuals[: -3 * step]
    if not differences.size:
        return 0.0
    limit = _CLIP_SDS * MAD_TO_SIGMA * median(np.abs(differences))
    return float(np.mean(np.clip(differences, -limit, limit) ** 2) / 20.0)
