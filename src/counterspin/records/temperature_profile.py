"""Temperature profile of a record.

A thermometer is slow, has noise in its last digit, and is often sampled at a lower rate than the
accelerometers. The profile is the piecewise linear function between even times that fits its values
best. Across missing values, it is linear.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import RecordError
from counterspin.records.column_file import ColumnFile, chunk_size, iter_chunks
from counterspin.records.isolation import run_isolated
from counterspin.records.memory import MemoryTable
from counterspin.records.reading import open_record
from counterspin.records.record import RecordColumns
from counterspin.records.run_file import RunFile
from counterspin.units import OPERATING_TEMPERATURES, ZERO_CELSIUS

#: Largest number of values of a profile.
MAX_KNOTS: Final = 64

#: Number of segments of a chunk whose means are kept, and of the record whose means are fitted.
_SEGMENTS_PER_PIECE: Final = 256
_MAX_SEGMENTS: Final = 1024

#: Longest gap without a value, relative to the record.
_MAX_GAP_FRACTION: Final = 0.25

#: Weight of second differences, which determine the profile only where values are missing.
_STIFFNESS: Final = 1e-4


def read_temperature_profile(path: Path | MemoryTable, columns: RecordColumns) -> tuple[float, ...]:
    """Read the temperature of a record, K, at even times from its first to its last row.

    columns: Time, and the temperature as the only signal.
    Returns: One value for a constant temperature, or else 2 to `MAX_KNOTS` values.
    """
    return run_isolated(_read_profile, path, columns)


def _read_profile(path: Path | MemoryTable, columns: RecordColumns) -> tuple[float, ...]:
    with open_record(path, columns, 0.0) as (file, resolved_columns, _):
        try:
            return _compute_profile(file, resolved_columns)
        except RecordError:
            if not file.use_strict_parser():
                raise
            return _compute_profile(file, resolved_columns)


def _compute_profile(file: ColumnFile | RunFile, columns: RecordColumns) -> tuple[float, ...]:
    (column_spec,) = columns.signals.values()
    location = f"{file.path}: column '{column_spec.name}'"
    time_span, last_time, longest_gap, rows = (math.inf, -math.inf), math.nan, (0.0, 0.0, 0.0), 0
    segments: list[Array] = []
    for chunk in iter_chunks(file.batches(columns.names), lambda _: chunk_size(1)):
        time = chunk[columns.time.name] * columns.time.factor
        temperatures = chunk[column_spec.name] + column_spec.offset
        infinite_rows = np.flatnonzero(np.isinf(time))
        if len(infinite_rows):
            row_location = file.locate_row(rows + int(infinite_rows[0]))
            raise RecordError(
                f"{file.path}, {row_location}: the time is infinite.", code="value-out-of-range"
            )
        min_temperature, max_temperature = OPERATING_TEMPERATURES
        implausible_rows = np.flatnonzero(
            (temperatures < min_temperature) | (temperatures > max_temperature)
        )
        if len(implausible_rows):
            temperature = float(temperatures[implausible_rows[0]])
            row_location = file.locate_row(rows + int(implausible_rows[0]))
            raise RecordError(
                f"{file.path}, {row_location}: column '{column_spec.name}' contains "
                f"{temperature:.6g} K ({temperature - ZERO_CELSIUS:.6g} degC), which is outside "
                "the operating range of any accelerometer. Check the unit of the column.",
                code="value-out-of-range",
            )
        rows += len(time)
        is_used = (time >= columns.time_range[0]) & (time <= columns.time_range[1])
        if not is_used.any():
            continue
        time_span = (
            min(time_span[0], float(time[is_used].min())),
            max(time_span[1], float(time[is_used].max())),
        )
        is_used &= np.isfinite(temperatures)
        used_times, used_temperatures = time[is_used], temperatures[is_used]
        if not len(used_times):
            continue
        previous_times = np.append(time_span[0] if math.isnan(last_time) else last_time, used_times)
        steps = np.diff(previous_times)
        largest_gap_index = int(np.argmax(steps))
        longest_gap = max(
            longest_gap,
            (
                float(steps[largest_gap_index]),
                float(previous_times[largest_gap_index]),
                float(used_times[largest_gap_index]),
            ),
        )
        last_time = float(used_times[-1])
        segments.append(
            _segment_means(
                np.stack([used_times, used_temperatures, np.ones(len(used_times))]),
                _SEGMENTS_PER_PIECE,
            )
        )
    if not segments:
        raise RecordError(
            f"{location} contains no number in the selected part of the record.", code="no-rows"
        )
    longest_gap = max(longest_gap, (time_span[1] - last_time, last_time, time_span[1]))
    if longest_gap[0] > _MAX_GAP_FRACTION * (time_span[1] - time_span[0]):
        raise RecordError(
            f"{location} contains no number from {longest_gap[1]:.6g} s to {longest_gap[2]:.6g} s, "
            "which is more than a quarter of the record. State the temperature of the run "
            "(`temperature`) instead of a column.",
            code="empty-cells",
        )
    values = np.concatenate(segments, axis=1)
    lowest, highest = float(values[1].min()), float(values[1].max())
    return _fit_broken_line(values, time_span) if highest > lowest else (lowest,)


def _segment_means(values: Array, n_segments: int) -> Array:
    """Return means of time and value over consecutive segments, and their weights, shape (3, m).

    values: Times, values and weights, shape (3, n).
    """
    n = values.shape[1]
    if n <= n_segments:
        return values
    starts = np.arange(n_segments) * n // n_segments
    weight = np.add.reduceat(values[2], starts)
    means = np.add.reduceat(values[:2] * values[2], starts, axis=1) / weight
    return np.concatenate([means, weight[None]])


def _fit_broken_line(values: Array, time_span: tuple[float, float]) -> tuple[float, ...]:
    """Return the values at even times of the best piecewise linear fit.

    values: Times (s), values and weights, shape (3, n).
    """
    time, value, weight = _segment_means(values, _MAX_SEGMENTS)
    count = min(MAX_KNOTS, max(2, time.size // 2))
    position = (time - time_span[0]) / (time_span[1] - time_span[0]) * (count - 1)
    knots = np.arange(count)
    basis = np.maximum(1.0 - np.abs(position[:, None] - knots), 0.0)
    sqrt_weights = np.sqrt(weight / weight.max())
    second_differences = _STIFFNESS * np.diff(np.eye(count), 2, axis=0)
    rows = np.concatenate([sqrt_weights[:, None] * basis, second_differences])
    mean = float(value.mean())
    target = np.append(sqrt_weights * (value - mean), np.zeros(len(second_differences)))
    return tuple((mean + np.linalg.lstsq(rows, target, rcond=None)[0]).tolist())
