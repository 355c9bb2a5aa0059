"""Samples of a sensor at rest, and their times if a log repeats time stamps or values."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array, median
from counterspin.frozen import frozen
from counterspin.records.sampling import ValueHolding, is_bursty, join_bursts, reconstruct_times

#: Largest fraction of rows that repeat a time with another value.
_MAX_RESTAMPED_FRACTION: Final = 1e-3
#: Fraction of the rows with a repeated time that also repeat the value, if rows are duplicated.
_MIN_DUPLICATE_FRACTION: Final = 0.9
#: Smallest number of equal values that are stuck, and probability of this number by chance.
_MIN_STUCK_ROWS: Final = 10
_STUCK_PROBABILITY: Final = 1e-6
#: Samples on either side of a long step whose mean times determine the number of lost samples.
_ADJACENT_SAMPLES: Final = 16


@frozen(eq=False)
class SensorSamples:
    """Samples of a sensor in a record."""

    time: Array  #: Times, s, counted if time stamps or values repeat, shape (m,).
    values: Array  #: Values, shape (m,); NaN: empty cell.
    repeated: int  #: Rows that repeat the previous value.
    restamped: int  #: Rows that repeat the previous time with another value.
    stuck: int = 0  #: Rows in long intervals of a constant value, whose values are NaN.

    @classmethod
    def from_rows(cls, time: Array, values: Array) -> SensorSamples:
        """Return the samples in rows; ValueError if their times cannot be determined.

        time: s, shape (n,), not decreasing.
        """
        time = join_bursts(time)
        is_same_time = np.diff(time) == 0.0
        is_same_row = is_same_time & ~(np.diff(values) != 0.0)
        # Duplicated rows; samples of a burst may be equal by chance.
        has_duplicates = (
            is_same_row.sum() > _MIN_DUPLICATE_FRACTION * is_same_time.sum()
            or not is_bursty(np.diff(time))
        )
        is_duplicate = np.append(False, is_same_row & has_duplicates)
        time, values = time[~is_duplicate], values[~is_duplicate]
        n_restamped = int(np.sum(np.diff(time) == 0.0))
        if n_restamped > _MAX_RESTAMPED_FRACTION * time.size:
            time = reconstruct_times(time, n_restamped)
        else:
            is_kept = np.append(True, np.diff(time) > 0.0)
            time, values = time[is_kept], values[is_kept]
        holding = ValueHolding.detect(values)
        if holding is None:
            is_stuck = _stuck_mask(values)
            return cls(
                time, np.where(is_stuck, math.nan, values), 0, n_restamped, int(is_stuck.sum())
            )
        row_interval = median(np.diff(time))
        is_new = holding.is_new(values) & np.isfinite(values)
        repeated = int(np.isfinite(values).sum() - is_new.sum())
        # Rows without a preceding loss determine the number of rows per sample.
        is_consecutive = np.append(False, np.diff(time) < 1.5 * row_interval)
        rows_per_sample = float(is_consecutive.sum() / np.sum(is_new & is_consecutive))
        time, values = time[is_new], values[is_new]
        if not holding.period:
            time = _even_times(time, rows_per_sample, row_interval)
        return cls(time, values, repeated, n_restamped)


def _stuck_mask(values: Array) -> npt.NDArray[np.bool_]:
    """Return the rows that repeat a value more often than equal samples do by chance."""
    is_equal = np.append(False, np.diff(values) == 0.0)
    lengths = np.diff(np.append(np.flatnonzero(~is_equal), values.size))
    repeat_counts = lengths[lengths > 1] - 1
    if repeat_counts.size in (0, lengths.size):
        return np.zeros(values.size, bool)
    # The median interval has as many equal samples as expected, unless there are few intervals.
    median_repeats = (
        median(repeat_counts.astype(float)) if repeat_counts.size >= _MIN_STUCK_ROWS else 1.0
    )
    repeat_probability = max(repeat_counts.size / lengths.size, 0.5 ** (1.0 / median_repeats))
    max_length = max(
        _MIN_STUCK_ROWS, math.log(_STUCK_PROBABILITY / values.size) / math.log(repeat_probability)
    )
    return np.asarray(is_equal & np.repeat(lengths > max_length, lengths))


def _even_times(time: Array, rows_per_sample: float, row_interval: float) -> Array:
    """Return the times of samples in a faster log, to within one row.

    rows_per_sample: Mean number of rows for a sample.
    row_interval: Time between rows, s.
    """
    step = rows_per_sample * row_interval
    is_long_step = np.diff(time) > (math.ceil(rows_per_sample) + 0.5) * row_interval
    segments = np.split(time, np.flatnonzero(is_long_step) + 1)
    segment_start = 0.0
    segment_indices: list[Array] = []
    for previous, segment in zip([segments[0], *segments], segments, strict=False):
        if segment_indices:
            # Equal successive samples and lost samples leave gaps in the index.
            last_times, first_times = previous[-_ADJACENT_SAMPLES:], segment[:_ADJACENT_SAMPLES]
            gap = (
                first_times.mean()
                - last_times.mean()
                - 0.5 * step * (first_times.size + last_times.size - 2)
            )
            segment_start += previous.size - 1 + max(1.0, np.round(gap / step))
        segment_indices.append(np.asarray(segment_start + np.arange(segment.size), np.float64))
    sample_indices = np.concatenate(segment_indices)
    slope, start = np.polyfit(sample_indices, time, 1)
    return np.asarray(start + slope * sample_indices)
