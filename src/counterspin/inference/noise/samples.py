"""Samples of a sensor at rest: their times where stamps or values repeat in the rows of a log."""

from __future__ import annotations

from typing import Final

import numpy as np

from counterspin.arrays import Array, median
from counterspin.frozen import frozen
from counterspin.records.sampling import Holding

#: Part of the rows that may repeat a time with other values.
_DIFFERING_PART: Final = 1e-3


@frozen(eq=False)
class SensorSamples:
    """The samples of a sensor in a record."""

    time: Array  #: Their times, s, counted where stamps or values repeat, shape (m,).
    values: Array  #: Shape (m,), NaN where a cell is empty.
    repeated: int  #: Rows that repeat the value of the sample before.
    restamped: int  #: Rows that repeat the time of the row before with another value.

    @classmethod
    def of(cls, time: Array, values: Array) -> SensorSamples:
        """Return the samples in rows; ValueError if their times cannot be told.

        time: s, shape (n,), never falling.
        """
        same = np.diff(time) == 0.0
        again = np.append(False, same & ~(np.diff(values) != 0.0))
        # Whole rows that were written twice.
        time, values = time[~again], values[~again]
        restamped = int(np.sum(np.diff(time) == 0.0))
        if restamped > _DIFFERING_PART * time.size:
            time = _times_by_count(time, restamped)
        else:
            keep = np.append(True, np.diff(time) > 0.0)
            time, values = time[keep], values[keep]
        holding = Holding.of(values)
        if holding is None:
            return cls(time, values, 0, restamped)
        new = holding.new(values) & np.isfinite(values)
        repeated = int(np.isfinite(values).sum() - new.sum())
        time, values = time[new], values[new]
        if not holding.period:
            time = _times_at_even_steps(time, holding.rows)
        return cls(time, values, repeated, restamped)


def _times_by_count(time: Array, restamped: int) -> Array:
    """Return the times of rows whose stamps repeat: rows are even where none is lost."""
    bounds = np.append(np.flatnonzero(np.append(True, np.diff(time) > 0.0)), time.size)
    burst = float(np.quantile(np.diff(bounds), 0.999)) + 1.0
    lag = min(time.size - 1, max(64, round(16 * burst)))
    spans = time[lag:] - time[:-lag]
    step = median(spans) / lag
    # Where rows are lost, and so the record is cut.
    cuts = np.flatnonzero(np.diff(time) > (burst + 1.5) * step) + 1
    pieces = np.split(time, cuts)
    rows = sum(part.size - 1 for part in pieces)
    step = sum(float(part[-1] - part[0]) for part in pieces) / max(rows, 1)
    parts = []
    for part in pieces:
        size = min(lag, part.size - 1)
        deviation = part[size:] - part[: part.size - size] - size * step
        if size > 0 and np.abs(deviation).max() > (burst + 1.0) * step:
            raise ValueError(
                f"{restamped} of {time.size} rows repeat the time of the row before with other "
                "values, and samples are missing among them, so that rows cannot be counted; "
                "export finer time stamps"
            )
        parts.append(part[0] + step * np.arange(part.size))
    if len(parts) == 1 and time.size > 1:
        return np.linspace(time[0], time[-1], time.size)
    return np.concatenate(parts)


def _times_at_even_steps(time: Array, rows: float) -> Array:
    """Return the times of samples that a faster log saw at its next row, within one row."""
    steps = np.diff(time)
    usual = float(np.mean(steps[steps < 2.0 * median(steps)]))
    late = usual / rows  # of a row
    cuts = np.flatnonzero(steps > 1.5 * usual + late) + 1
    if not len(cuts):
        return np.linspace(time[0], time[-1], time.size)
    parts = np.split(time, cuts)
    return np.concatenate([part[0] + usual * np.arange(part.size) for part in parts])
