"""Detection of poses in one long record: rest intervals of a three-axis sensor between motions.

At rest the values scatter by the noise of the sensor alone, in motion by far more. The level is
the standard deviation of all three axes together (the root of the sum of their variances) in a
window of about one second. An interval that stays below a threshold for long enough is a pose.
This is the detector of Tedaldi, Pretto and Menegatti (ICRA 2014, section IV), with a threshold
computed from the record.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.arrays import MAD_TO_SIGMA, Array, median
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.records.memory import MemoryTable
from counterspin.records.outliers import estimate_resolution
from counterspin.records.reading import read_record
from counterspin.records.record import NominalMotion, Record, RecordColumns

#: Default duration of the shortest pose, s.
MIN_DURATION: Final = 1.5

#: Window of the level, s, at most the shortest pose; and its minimum number of rows.
_WINDOW: Final = 1.0
_MIN_ROWS: Final = 8

#: Default threshold relative to the usual level at rest: twice, or four times the variance.
_THRESHOLD_RATIO: Final = 2.0

#: Ratio of the median levels in motion and at rest below which the threshold is in doubt.
MIN_CONTRAST: Final = 5.0

#: Scatter within a pose, relative to the threshold, above which the pose was hardly at rest.
_DRIFT_RATIO: Final = 3.0

#: Standard deviations beyond which one or two rows among their neighbours are spikes.
_SPIKE_SDS: Final = 10.0
#: Minimum number of rows for this standard deviation.
_MIN_SPIKE_ROWS: Final = 64

#: Fraction of rows at the largest or smallest value of an axis above which it is saturated.
_SATURATED_FRACTION: Final = 0.25

#: Histogram bins of the logarithm of the level, to separate rest from motion.
_N_BINS: Final = 256


@frozen(eq=False)
class StaticIntervals:
    """The k poses of a record with n rows; values are in the unit of its columns."""

    #: First and last time of each pose, s, shape (k,).
    start: Array
    end: Array
    #: Mean and standard deviation of the rows within each pose, shape (k, 3).
    mean: Array
    scatter: Array
    count: Array  #: Rows of each, shape (k,).
    threshold: float  #: Highest level at rest.
    time: Array  #: Of each row, s, shape (n,).
    #: Standard deviation of all three axes together in a window around each row, shape (n,); NaN
    #: for omitted rows (missing values and spikes).
    level: Array
    #: Ratio of the median levels in motion and at rest; infinite without motion.
    contrast: float
    #: Number of spikes within poses for each axis, shape (3,).
    spikes: Array
    rejected: tuple[str, ...] = ()  #: Rests that are no poses, each with the reason.

    def trace(self, max_points: int) -> tuple[Array, Array]:
        """Return at most `max_points` times, s, and the largest level around each, shapes (m,)."""
        is_valid = np.isfinite(self.level)
        time, level = self.time[is_valid], self.level[is_valid]
        starts = np.unique(np.linspace(0, len(level), max_points, endpoint=False).astype(int))
        return time[starts], np.maximum.reduceat(level, starts)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons to doubt the threshold, one sentence each."""
        messages = []
        if math.isinf(self.contrast):
            messages.append(
                "The record contains no motion, so the whole record is treated as rest."
            )
        elif self.contrast < MIN_CONTRAST:
            messages.append(
                "Rest and motion are not clearly separated: the scatter in motion is only "
                f"{self.contrast:.2g} times the scatter at rest. Compare the plot of the "
                f"scatter with the threshold of {self.threshold:.3g}. If a different threshold "
                "separates rest from motion better, specify that threshold."
            )
        total_scatter = np.sqrt((self.scatter**2).sum(axis=1))
        for index in np.flatnonzero(total_scatter > _DRIFT_RATIO * self.threshold)[:1]:
            messages.append(
                f"In the pose from {self.start[index]:.6g} s to {self.end[index]:.6g} s, the "
                f"readings scatter by {total_scatter[index]:.3g} over the whole interval, which "
                "is more than the noise explains. The sensor may have rotated slowly."
            )
        return tuple(messages)


def read_poses(
    path: str | Path | MemoryTable,
    columns: RecordColumns,
    min_rest: float = MIN_DURATION,
    threshold: float | None = None,
) -> tuple[StaticIntervals, Record]:
    """Return the poses of a record of three signals, and the record with all its rows.

    min_rest, threshold: As in `find_poses`; the threshold is in the unit of the columns.
    """
    record = read_record(
        path, columns, NominalMotion(0.0, has_constant_input=True, is_multi_pose=True), block=None
    )
    values = np.column_stack(list(record.signals.values()))
    try:
        poses = find_poses(record.time + record.start_time, values, min_rest, threshold)
    except RecordError as error:
        raise RecordError(f"{path}: {error}", code=error.code) from None
    names = [spec.name for spec in columns.signals.values()]
    outliers = dict(zip(names, map(int, poses.spikes), strict=True))
    return poses, replace(record, report=replace(record.report, outliers=outliers))


def find_poses(
    time: Array, values: Array, min_rest: float = MIN_DURATION, threshold: float | None = None
) -> StaticIntervals:
    """Find the intervals in which a sensor is at rest.

    A gap of half a window ends a pose. Rows with missing values and single spikes are omitted.

    time: Increasing times, s, shape (n,).
    values: Values of the three axes in one unit, shape (n, 3); NaN if missing.
    min_rest: Shortest pose, s.
    threshold: Highest level at rest, in the unit of the values; computed if None.
    """
    valid_rows = np.flatnonzero(np.isfinite(time) & np.isfinite(values).all(axis=1))
    step = _sampling_step(time[valid_rows], min_rest)
    window = min(max(_WINDOW, _MIN_ROWS * step), min_rest)
    resolutions = np.array([estimate_resolution(axis) for axis in values[valid_rows].T])
    block_rows = max(_MIN_SPIKE_ROWS, round(window / step))
    spikes = _outlier_mask(values[valid_rows], block_rows, resolutions)
    is_regular = ~spikes.any(axis=1)
    spike_times, valid_rows = time[valid_rows[~is_regular]], valid_rows[is_regular]
    t, x = time[valid_rows], values[valid_rows]
    level = _rolling_sd(t, x, window)
    level_threshold = _default_threshold(level, resolutions) if threshold is None else threshold
    starts, ends = _find_intervals(t, level, level_threshold, min_rest, window, step)
    if not len(starts):
        raise RecordError(
            _no_interval_message(t, level, level_threshold, min_rest, window, step), code="no-rest"
        )
    contrast = _contrast(level, level_threshold, starts, ends)
    faults = _interval_faults(x, starts, ends, resolutions)
    rejections = tuple(
        f"The rest interval from {t[starts[index]]:.6g} s to {t[ends[index] - 1]:.6g} s was "
        f"rejected: {reason}"
        for index, reason in faults.items()
    )
    if len(faults) == len(starts):
        raise RecordError(
            "all rest intervals were rejected. " + " ".join(rejections), code="no-rest"
        )
    starts, ends = np.delete(starts, list(faults)), np.delete(ends, list(faults))
    interval_rows = [x[first:last] for first, last in zip(starts, ends, strict=True)]
    interval_indices = np.searchsorted(t[starts], spike_times) - 1
    is_in_interval = (interval_indices >= 0) & (
        spike_times < t[ends - 1][np.maximum(interval_indices, 0)]
    )
    levels = np.full(len(time), np.nan)
    levels[valid_rows] = level
    return StaticIntervals(
        start=t[starts],
        end=t[ends - 1],
        mean=np.array([rows.mean(axis=0) for rows in interval_rows]),
        scatter=np.array([rows.std(axis=0) for rows in interval_rows]),
        count=(ends - starts).astype(float),
        threshold=float(level_threshold),
        time=time,
        level=levels,
        contrast=contrast,
        spikes=spikes[~is_regular][is_in_interval].sum(axis=0).astype(float),
        rejected=rejections,
    )


def _sampling_step(time: Array, min_rest: float) -> float:
    """Return the median sampling step, s; RecordError if the rows cannot contain a rest interval.

    Rows with the same time, as from a coarse clock, do not count.
    """
    if not min_rest > 0.0:
        raise RecordError(
            f"the duration of a rest interval must be positive, but it is {min_rest:g} s.",
            code="wrong-usage",
        )
    if len(time) < _MIN_ROWS:
        raise RecordError(
            f"Only {len(time)} rows have all three values, which is too few to detect a pose.",
            code="record-too-short",
        )
    steps = np.diff(time)
    if (steps < 0.0).any():
        raise RecordError(
            f"the time decreases after {time[np.argmax(steps < 0.0)]:.6g} s.", code="time-backwards"
        )
    if not steps.any():
        raise RecordError("all rows have the same time.", code="no-rows")
    length, step = float(time[-1] - time[0]), median(steps[steps > 0.0])
    if length + step < min_rest * (1.0 - 1e-9):
        raise RecordError(
            f"the record lasts {length:.4g} s, which is less than one rest interval of "
            f"{min_rest:g} s. Check the unit of the time or the sampling rate, or specify a "
            "shorter rest interval.",
            code="record-too-short",
        )
    if not _MIN_ROWS * step <= min_rest * (1.0 + 1e-9):
        raise RecordError(
            f"the rows are {step:.4g} s apart, so a rest interval of {min_rest:g} s contains fewer "
            f"than {_MIN_ROWS} rows. Check the unit of the time or the sampling rate, or "
            "specify a longer rest interval.",
            code="too-few-rows",
        )
    return step


def _outlier_mask(values: Array, block_rows: int, resolutions: Array) -> np.ndarray:
    """Return a mask of spikes: single or paired values far from their neighbours, shape (n, 3).

    The deviation is that from a running median of five, because `counterspin.records.outliers`
    would reject the ends of motions by hand, which are not smooth.

    block_rows: Number of rows per estimate of the scatter.
    """
    padded_values = np.pad(values, ((2, 2), (0, 0)), mode="reflect")
    a, b, c, d, e = (padded_values[offset : offset + len(values)] for offset in range(5))
    # The median of five is the median of the centre and the two middle values of the others.
    low_median = np.maximum(np.minimum(a, b), np.minimum(d, e))
    high_median = np.minimum(np.maximum(a, b), np.maximum(d, e))
    deviation = np.abs(
        c - np.clip(c, np.minimum(low_median, high_median), np.maximum(low_median, high_median))
    )
    block_rows = min(block_rows, len(deviation))
    blocks = deviation[: len(deviation) // block_rows * block_rows].reshape(-1, block_rows, 3)
    # The upper quartile, because every fifth value is its own median and has no deviation.
    quantile_index = 3 * block_rows // 4
    scale = np.partition(blocks, quantile_index, axis=1)[:, quantile_index] * MAD_TO_SIGMA / 2.0
    # A smooth motion is its own median: if it fills most of a block, the next block counts.
    scale = np.maximum(scale, np.maximum(np.roll(scale, 1, axis=0), np.roll(scale, -1, axis=0)))
    limits = _SPIKE_SDS * scale + 1.5 * resolutions
    limits = limits[np.minimum(np.arange(len(deviation)) // block_rows, len(limits) - 1)]
    return np.asarray(deviation > limits)


def _rolling_sd(time: Array, values: Array, window: float) -> Array:
    """Return the standard deviation of three axes together in a window around each row, (n,).

    A window overlaps at most two blocks of rows. The cumulative sums are within blocks, about the
    mean of each block: sums over a whole long record would lose the noise in rounding.
    """
    # Rows at half a window are included in spite of rounding.
    half_width = 0.5 * window * (1.0 + 1e-9)
    first_row = np.searchsorted(time, time - half_width, side="left")
    end_row = np.searchsorted(time, time + half_width, side="right")
    block_size = int((end_row - first_row).max())
    n_blocks = -(-len(time) // block_size)
    edges = np.minimum(np.arange(n_blocks + 1) * block_size, len(time))
    means = np.add.reduceat(values, edges[:-1], axis=0) / np.diff(edges)[:, None]
    block = np.arange(len(time)) // block_size
    deviations = values - means[block]
    padded_values = np.zeros((n_blocks * block_size, 4))
    padded_values[: len(time), :3] = deviations
    padded_values[: len(time), 3] = (deviations**2).sum(axis=1)
    sums = np.zeros((n_blocks, block_size + 1, 4))
    np.cumsum(padded_values.reshape(n_blocks, block_size, 4), axis=1, out=sums[:, 1:])
    first_block = first_row // block_size
    boundary_row = np.minimum(end_row, (first_block + 1) * block_size)
    first_sums = (
        sums[first_block, boundary_row - first_block * block_size]
        - sums[first_block, first_row - first_block * block_size]
    )
    second_block = np.minimum(first_block + 1, n_blocks - 1)
    second_sums = sums[second_block, np.maximum(end_row - second_block * block_size, 0)]
    second_sums[end_row == boundary_row] = 0.0
    # Pooled sum of squares: within both blocks, and between their means.
    n_first, n_second = boundary_row - first_row, end_row - boundary_row
    sum_of_squares = first_sums[:, 3] - (first_sums[:, :3] ** 2).sum(axis=1) / n_first
    sum_of_squares += second_sums[:, 3] - (second_sums[:, :3] ** 2).sum(axis=1) / np.maximum(
        n_second, 1
    )
    mean_difference = means[first_block] + first_sums[:, :3] / n_first[:, None]
    mean_difference = (
        mean_difference
        - means[second_block]
        - second_sums[:, :3] / np.maximum(n_second, 1)[:, None]
    )
    sum_of_squares += (mean_difference**2).sum(axis=1) * n_first * n_second / (n_first + n_second)
    n_rows = end_row - first_row
    level = np.sqrt(np.maximum(sum_of_squares, 0.0) / np.maximum(n_rows - 1, 1))
    # So few rows can agree by chance.
    level[n_rows < _MIN_ROWS // 2] = np.inf
    return np.asarray(level)


def _default_threshold(level: Array, resolutions: Array) -> float:
    """Return twice the median level at rest.

    Otsu's method separates rest from motion in the logarithm of the level: it maximises the
    variance between both groups (IEEE Trans. Syst. Man Cybern. 9 (1979) 62).
    """
    finite_levels = level[np.isfinite(level)]
    # Flicker of the last digit in each axis is not motion.
    resolution_floor = float(np.sqrt((resolutions**2).sum()))
    positive_levels = finite_levels[finite_levels > 0.0]
    if not len(positive_levels):
        return resolution_floor
    # Identical values, with a level near zero, must not become a group of their own.
    log_levels = np.log(np.maximum(finite_levels, 0.1 * np.quantile(positive_levels, 0.05)))
    counts, edges = np.histogram(log_levels, bins=_N_BINS)
    centres = 0.5 * (edges[1:] + edges[:-1])
    lower_counts, sums = np.cumsum(counts)[:-1], np.cumsum(counts * centres)[:-1]
    upper_counts, upper_sums = len(log_levels) - lower_counts, (counts * centres).sum() - sums
    with np.errstate(invalid="ignore", divide="ignore"):
        between_variance = (
            lower_counts * upper_counts * (sums / lower_counts - upper_sums / upper_counts) ** 2
        )
    boundary = (
        edges[1 + int(np.nanargmax(between_variance))]
        if np.isfinite(between_variance).any()
        else edges[-1]
    )
    static_level = math.exp(median(log_levels[log_levels <= boundary]))
    return max(_THRESHOLD_RATIO * static_level, resolution_floor)


def _find_intervals(
    time: Array, level: Array, threshold: float, min_rest: float, window: float, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first row of each rest interval, and the row after its last."""
    is_quiet = level <= threshold
    is_gap = np.append(np.diff(time) > 0.5 * window, True)
    is_first = is_quiet & np.append(True, is_gap[:-1] | ~is_quiet[:-1])
    is_last = is_quiet & (is_gap | ~np.append(is_quiet[1:], False))
    starts, ends = np.flatnonzero(is_first), np.flatnonzero(is_last) + 1
    is_long = time[ends - 1] - time[starts] + step >= min_rest * (1.0 - 1e-9)
    return starts[is_long], ends[is_long]


def _contrast(level: Array, threshold: float, starts: np.ndarray, ends: np.ndarray) -> float:
    """Return the ratio of the median levels in motion and at rest; infinite without motion."""
    motion_levels = level[(level > threshold) & np.isfinite(level)]
    interval_edges = np.zeros(len(level) + 1)
    np.add.at(interval_edges, starts, 1.0)
    np.add.at(interval_edges, ends, -1.0)
    static_level = median(level[np.cumsum(interval_edges)[:-1] > 0.0])
    return median(motion_levels) / static_level if len(motion_levels) and static_level else math.inf


def _no_interval_message(
    time: Array, level: Array, threshold: float, min_rest: float, window: float, step: float
) -> str:
    """Return the error message without rest intervals, with the level of the quietest interval."""
    message = (
        f"no rest interval of {min_rest:g} s was found below the threshold of {threshold:.3g}."
    )
    levels = np.unique(level[np.isfinite(level)])
    low, high = 0, len(levels)
    while low < high:
        midpoint = (low + high) // 2
        if len(_find_intervals(time, level, float(levels[midpoint]), min_rest, window, step)[0]):
            high = midpoint
        else:
            low = midpoint + 1
    if low == len(levels):
        return f"{message} Every interval of this length in the record contains a gap."
    starts, ends = _find_intervals(time, level, float(levels[low]), min_rest, window, step)
    return (
        f"{message} The quietest interval, from {time[starts[0]]:.6g} s to "
        f"{time[ends[0] - 1]:.6g} s, stays below {levels[low]:.3g}. Use a higher threshold "
        "to include this interval, or a shorter minimum duration to use a quieter part."
    )


def _interval_faults(
    values: Array, starts: np.ndarray, ends: np.ndarray, resolutions: Array
) -> dict[int, str]:
    """Return the reasons to reject intervals, by index: constant or saturated values."""
    scatter = [values[a:b].std(axis=0) for a, b in zip(starts, ends, strict=True)]
    median_scatter = np.median(scatter, axis=0)
    # With scatter below the resolution, equal values are normal.
    is_testable = median_scatter > 2.0 * resolutions
    extremes = np.stack([values.min(axis=0), values.max(axis=0)])
    faults = {}
    for index, (start, end) in enumerate(zip(starts, ends, strict=True)):
        if median_scatter.any() and (values[start:end] == values[start]).all():
            faults[index] = (
                "all values are identical, which suggests that the recorder had stopped."
            )
            continue
        extreme_fraction = (values[start:end, None] == extremes).mean(axis=0).max(axis=0)
        saturated_axes = np.flatnonzero(is_testable & (extreme_fraction > _SATURATED_FRACTION))
        if len(saturated_axes):
            axis = saturated_axes[0]
            faults[index] = (
                f"{100 * extreme_fraction[axis]:.0f} % of the values along axis {axis + 1} are the "
                "largest or smallest of the record, which suggests that the range was exceeded."
            )
            continue
        is_constant = (values[start:end] == values[start]).all(axis=0)
        constant_axes = np.flatnonzero(is_testable & is_constant)
        if len(constant_axes):
            faults[index] = (
                f"axis {constant_axes[0] + 1} does not change while other axes do, which "
                "suggests that this axis had failed."
            )
    return faults
