"""The files of a run, read as one file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from counterspin.arrays import Array, median
from counterspin.errors import InputError, RecordError
from counterspin.input import FileIdentity
from counterspin.records.column_file import ColumnFile, Columns, row_count
from counterspin.records.record import NominalMotion, RecordColumns

#: Smallest number of revolutions of a record, and of a record whose mean is a reading.
MIN_REVOLUTIONS = 3.0
MIN_REVOLUTIONS_OF_MEAN = 1.0
#: Largest mean number of revolutions between rows.
MAX_REVOLUTIONS_PER_ROW = 20.0
#: Largest number of revolutions of any record, and additional revolutions per row: the integration
#: of the motion takes some 0.03 MB per revolution.
MAX_REVOLUTIONS = 5000.0
EXTRA_REVOLUTIONS_PER_ROW = 1.0 / 16.0

#: Largest deviation of a pulse interval from a whole number of intervals.
_MAX_PULSE_DEVIATION = 0.2


def is_derived(columns: RecordColumns) -> bool:
    """Return True if a record has columns that no file contains."""
    angle = columns.angle
    return columns.time.kind == "rows" or (angle is not None and angle.kind == "pulses")


class RunFile:
    """Files of a record, presented to its reader as one file.

    rate: Stated rate of the spindle, rad/s.
    pulses: Times of the pulses, s on the record's time scale; None if the angle is a column.
    """

    def __init__(
        self,
        files: Sequence[ColumnFile],
        columns: RecordColumns,
        rate: float,
        pulses: Array | None = None,
    ) -> None:
        self._files = files
        self._columns = columns
        self._rate = rate
        self._pulses = pulses
        self._ends: list[int] = []
        self.path: Path = files[0].path
        self.identity: FileIdentity | None = files[0].identity
        descriptions = [file.format_description for file in files[:1] if file.format_description]
        if len(files) > 1:
            descriptions.append(f"{len(files)} concatenated files")
        if columns.time.kind == "rows":
            descriptions.append(
                f"time calculated from the row count, {columns.time.factor:.9g} s per row"
            )
        if pulses is not None:
            descriptions.append(f"angle interpolated between {len(pulses)} pulses")
        self.format_description = ", ".join(descriptions)

    def use_strict_parser(self) -> bool:
        """Switch all files to the strict parser; see `ColumnFile`."""
        has_switched = [file.use_strict_parser() for file in self._files]  # all of them
        return any(has_switched)

    def locate_row(self, row: int) -> str:
        """Return the location of a row, with the name of a continuation file."""
        start = 0
        for index, file in enumerate(self._files):
            end = self._ends[index] if index < len(self._ends) else math.inf
            if row < end:
                location = file.locate_row(row - start)
                return location if index == 0 else f"{file.path.name}, {location}"
            start = int(end)
        return f"row {row + 1}"

    def batches(self, names: Sequence[str]) -> Iterator[Columns]:
        """Yield columns, including derived ones, in consecutive batches."""
        time, angle = self._columns.time, self._columns.angle
        derived_names = {time.name} if time.kind == "rows" else set()
        if self._pulses is not None and angle is not None:
            derived_names |= {angle.name}
        columns_in_file = [name for name in names if name not in derived_names]
        ends, rows = [], 0
        for file in self._files:
            file.first_timestamp = file.first_timestamp or self._files[0].first_timestamp
            for batch in file.batches(columns_in_file):
                count = row_count(batch)
                if time.kind == "rows":
                    batch[time.name] = np.arange(rows, rows + count, dtype=float)
                if self._pulses is not None and angle is not None:
                    seconds = batch[time.name] * time.factor
                    batch[angle.name] = interpolate_pulses(
                        self._pulses, seconds, self._rate, angle.per_revolution
                    )
                rows += count
                yield batch
            ends.append(rows)
        self._ends = ends


def interpolate_pulses(pulses: Array, time: Array, rate: float, per_revolution: float) -> Array:
    """Interpolate the angle since the first pulse between pulses by parabolas, rad, shape (n,).

    This is exact for a linear change of the rate. NaN beyond the pulses by more than an interval.

    pulses: Times of the pulses, s, shape (m,).
    time: Times, s, shape (n,).
    rate: Stated rate, rad/s, signed.
    per_revolution: Pulses per revolution.
    """
    if len(pulses) < 3:
        raise InputError(f"{len(pulses)} pulses are too few to track the rotation", "too-few-rows")
    steps = np.diff(pulses)
    if (steps <= 0).any():
        index = int(np.flatnonzero(steps <= 0)[0]) + 2
        raise InputError(f"pulse {index} is not later than the preceding pulse", "time-backwards")
    interval = median(steps)
    expected_interval = 2 * math.pi / abs(rate) / per_revolution
    if abs(interval / expected_interval - 1) > 0.05:
        raise InputError(
            f"the pulses are {interval:.6g} s apart; at the stated rate, with {per_revolution:g} "
            f"pulses per revolution, the interval should be {expected_interval:.6g} s",
            "rate-mismatch",
        )
    # A missing pulse doubles an interval.
    pulse_counts = np.round(steps / interval)
    is_irregular = np.abs(steps / interval - pulse_counts) > _MAX_PULSE_DEVIATION
    if is_irregular.any() or (pulse_counts < 1).any():
        index = int(np.flatnonzero(is_irregular | (pulse_counts < 1))[0]) + 2
        raise InputError(
            f"pulse {index} comes {steps[index - 2]:.6g} s after the preceding pulse, instead of "
            f"{interval:.6g} s",
            "irregular-time",
        )
    pulse_step = math.copysign(2 * math.pi / per_revolution, rate)
    angles = pulse_step * np.concatenate([[0.0], np.cumsum(pulse_counts)])
    # Average the two parabolas through the ends of an interval, weighted by distance.
    indices = np.clip(np.searchsorted(pulses, time, side="right") - 1, 0, len(pulses) - 2)
    fraction = np.clip((time - pulses[indices]) / steps[indices], 0.0, 1.0)
    left = _interpolate_parabola(pulses, angles, np.clip(indices, 1, len(pulses) - 2), time)
    right = _interpolate_parabola(pulses, angles, np.clip(indices + 1, 1, len(pulses) - 2), time)
    angle: Array = (1.0 - fraction) * left + fraction * right
    is_outside = (time < pulses[0] - interval) | (time > pulses[-1] + interval)
    angle[is_outside] = np.nan
    return angle


def _interpolate_parabola(x: Array, y: Array, index: np.ndarray, position: Array) -> Array:
    """Interpolate by parabolas through three points around `index`, at `position` (Newton)."""
    x0, x1, x2 = x[index - 1], x[index], x[index + 1]
    slope = (y[index] - y[index - 1]) / (x1 - x0)
    second_difference = ((y[index + 1] - y[index]) / (x2 - x1) - slope) / (x2 - x0)
    result: Array = y[index - 1] + (position - x0) * (slope + (position - x1) * second_difference)
    return result


def check_length(path: object, rows: int, duration: float, motion: NominalMotion) -> None:
    """Raise RecordError for a record that is too short, or has too few rows per revolution.

    duration: Time from the first to the last row, s.
    """
    revolutions = duration * abs(motion.rate) / (2.0 * math.pi)
    is_constant = motion.has_constant_input
    min_revolutions = MIN_REVOLUTIONS_OF_MEAN if is_constant else MIN_REVOLUTIONS
    if motion.rate and revolutions < min_revolutions * (1.0 - 1e-9):
        raise RecordError(
            f"{path}: the record lasts {duration:.6g} s, which is {revolutions:.3g} revolutions "
            f"at the stated rate; the minimum is {min_revolutions:g}. Check the unit of the "
            "time column.",
            code="record-too-short",
        )
    if revolutions > MAX_REVOLUTIONS_PER_ROW * rows:
        raise RecordError(
            f"{path}: the record has {rows} rows in {revolutions:.4g} revolutions, which is too "
            "few to track the rotation. Check the unit of the time column.",
            code="too-few-rows",
        )
    max_revolutions = MAX_REVOLUTIONS + EXTRA_REVOLUTIONS_PER_ROW * rows
    if revolutions > max_revolutions and not is_constant:
        raise RecordError(
            f"{path}: the record has {rows} rows in {revolutions:.6g} revolutions. Each "
            f"revolution after the first {MAX_REVOLUTIONS:g} requires at least 16 rows. "
            "Check the unit of the time column, or shorten the record.",
            code="too-few-rows",
        )
