"""Samples of a sensor at rest: their times where stamps or values repeat in the rows of a log."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array, median
from counterspin.frozen import frozen
from counterspin.records.sampling import ValueHolding, is_bursty, join_bursts, reconstruct_times

#: Part of the rows that may repeat a time with other values.
_DIFFERING_PART: Final = 1e-3
#: Part of the rows with the time of the row before that have its value too where rows are doubled.
_TWICE_PART: Final = 0.9
#: Fewest rows of one value that are stuck, and the probability that a record has so many by chance.
_MIN_STUCK_ROWS: Final = 10
_STUCK_PROBABILITY: Final = 1e-6
#: Samples on either side of a long step whose mean times show how many samples it lacks.
_ADJACENT_SAMPLES: Final = 16


@frozen(eq=False)
class SensorSamples:
    """The samples of a sensor in a record."""

    time: Array  #: Their times, s, counted where stamps or values repeat, shape (m,).
    values: Array  #: Shape (m,), NaN where a cell is empty.
    repeated: int  #: Rows that repeat the value of the sample before.
    restamped: int  #: Rows that repeat the time of the row before with another value.
    stuck: int = 0  #: Rows in long stretches of one value, whose values are NaN.

    @classmethod
    def of(cls, time: Array, values: Array) -> SensorSamples:
        """Return the samples in rows; ValueError if their times cannot be told.

        time: s, shape (n,), never falling.
        """
        time = join_bursts(time)
        same = np.diff(time) == 0.0
        equal = same & ~(np.diff(values) != 0.0)
        # Whole rows that were written twice; samples of a burst may be equal by chance.
        twice = equal.sum() > _TWICE_PART * same.sum() or not is_bursty(np.diff(time))
        again = np.append(False, equal & twice)
        time, values = time[~again], values[~again]
        restamped = int(np.sum(np.diff(time) == 0.0))
        if restamped > _DIFFERING_PART * time.size:
            time = reconstruct_times(time, restamped)
        else:
            keep = np.append(True, np.diff(time) > 0.0)
            time, values = time[keep], values[keep]
        holding = ValueHolding.detect(values)
        if holding is None:
            stuck = _stuck_rows(values)
            return cls(time, np.where(stuck, math.nan, values), 0, restamped, int(stuck.sum()))
        row = median(np.diff(time))
        new = holding.is_new(values) & np.isfinite(values)
        repeated = int(np.isfinite(values).sum() - new.sum())
        # Rows that follow the row before without a loss show how often a new value comes.
        follows = np.append(False, np.diff(time) < 1.5 * row)
        rows = float(follows.sum() / np.sum(new & follows))
        time, values = time[new], values[new]
        if not holding.period:
            time = _times_at_even_steps(time, rows, row)
        return cls(time, values, repeated, restamped)


def _stuck_rows(values: Array) -> npt.NDArray[np.bool_]:
    """Return the rows that repeat a value more often than equal samples do by chance."""
    is_equal = np.append(False, np.diff(values) == 0.0)
    lengths = np.diff(np.append(np.flatnonzero(~is_equal), values.size))
    repeats = lengths[lengths > 1] - 1
    if repeats.size in (0, lengths.size):
        return np.zeros(values.size, bool)
    # The median stretch has as many equal samples as chance makes, unless there are few stretches.
    typical = median(repeats.astype(float)) if repeats.size >= _MIN_STUCK_ROWS else 1.0
    chance = max(repeats.size / lengths.size, 0.5 ** (1.0 / typical))
    longest = max(_MIN_STUCK_ROWS, math.log(_STUCK_PROBABILITY / values.size) / math.log(chance))
    return np.asarray(is_equal & np.repeat(lengths > longest, lengths))


def _times_at_even_steps(time: Array, rows: float, row: float) -> Array:
    """Return the times of samples that a faster log saw at its next row, within one row.

    rows: Mean number of rows for a sample.
    row: Time from one row to the next, s.
    """
    step = rows * row
    long = np.diff(time) > (math.ceil(rows) + 0.5) * row
    parts = np.split(time, np.flatnonzero(long) + 1)
    place = 0.0
    index: list[Array] = []
    for before, part in zip([parts[0], *parts], parts, strict=False):
        if index:
            # Samples that equal the one before, and samples that are lost, leave places free.
            last, first = before[-_ADJACENT_SAMPLES:], part[:_ADJACENT_SAMPLES]
            gap = first.mean() - last.mean() - 0.5 * step * (first.size + last.size - 2)
            place += before.size - 1 + max(1.0, np.round(gap / step))
        index.append(np.asarray(place + np.arange(part.size), np.float64))
    places = np.concatenate(index)
    slope, start = np.polyfit(places, time, 1)
    return np.asarray(start + slope * places)
