"""The course of a temperature in a record.

A thermometer is slow, noisy to its last digit, and often read more seldom than the accelerometers.
Its course is the broken line between even times that fits its values best. Where a few values are
missing, the line continues straight.
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

#: Most values of a course.
MAX_KNOTS: Final = 64

#: Parts of a chunk of a record whose means are kept, and of the record whose means are fitted.
_SEGMENTS_PER_PIECE: Final = 256
_MAX_SEGMENTS: Final = 1024

#: Longest stretch without a value, as part of the record.
_MAX_GAP_FRACTION: Final = 0.25

#: Weight of a bend of the course beside the values', which decides only where there are none.
_STIFFNESS: Final = 1e-4


def read_temperature_profile(path: Path | MemoryTable, columns: RecordColumns) -> tuple[float, ...]:
    """Return the temperature in a record, K, at even times from its first row to its last.

    columns: Time, and the temperature as their only signal.
    Returns: One value of a temperature that did not change, else 2 to `MAX_KNOTS`.
    """
    return run_isolated(_read_profile, path, columns)


def _read_profile(path: Path | MemoryTable, columns: RecordColumns) -> tuple[float, ...]:
    with open_record(path, columns, 0.0) as (file, resolved, _):
        try:
            return _temperature_profile(file, resolved)
        except RecordError:
            if not file.use_strict_parser():
                raise
            return _temperature_profile(file, resolved)


def _temperature_profile(file: ColumnFile | RunFile, columns: RecordColumns) -> tuple[float, ...]:
    (spec,) = columns.signals.values()
    location = f"{file.path}: column '{spec.name}'"
    span, last, gap, rows = (math.inf, -math.inf), math.nan, (0.0, 0.0, 0.0), 0
    segments: list[Array] = []
    for chunk in iter_chunks(file.batches(columns.names), lambda _: chunk_size(1)):
        time, temperatures = (
            chunk[columns.time.name] * columns.time.factor,
            chunk[spec.name] + spec.offset,
        )
        infinite = np.flatnonzero(np.isinf(time))
        if len(infinite):
            row_location = file.locate_row(rows + int(infinite[0]))
            raise RecordError(
                f"{file.path}, {row_location}: the time is infinite.", code="value-out-of-range"
            )
        coldest, warmest = OPERATING_TEMPERATURES
        impossible = np.flatnonzero((temperatures < coldest) | (temperatures > warmest))
        if len(impossible):
            implausible, row_location = (
                float(temperatures[impossible[0]]),
                file.locate_row(rows + int(impossible[0])),
            )
            raise RecordError(
                f"{file.path}, {row_location}: column '{spec.name}' contains {implausible:.6g} "
                f"K ({implausible - ZERO_CELSIUS:.6g} degC), which is outside the operating "
                "range of any accelerometer. Check the unit of the column.",
                code="value-out-of-range",
            )
        rows += len(time)
        is_used = (time >= columns.time_range[0]) & (time <= columns.time_range[1])
        if not is_used.any():
            continue
        span = min(span[0], float(time[is_used].min())), max(span[1], float(time[is_used].max()))
        is_used &= np.isfinite(temperatures)
        t, x = time[is_used], temperatures[is_used]
        if not len(t):
            continue
        before = np.append(span[0] if math.isnan(last) else last, t)
        steps = np.diff(before)
        largest_gap = int(np.argmax(steps))
        gap = max(
            gap, (float(steps[largest_gap]), float(before[largest_gap]), float(t[largest_gap]))
        )
        last = float(t[-1])
        segments.append(_segment_means(np.stack([t, x, np.ones(len(t))]), _SEGMENTS_PER_PIECE))
    if not segments:
        raise RecordError(
            f"{location} contains no number in the selected part of the record.", code="no-rows"
        )
    gap = max(gap, (span[1] - last, last, span[1]))
    if gap[0] > _MAX_GAP_FRACTION * (span[1] - span[0]):
        raise RecordError(
            f"{location} contains no number from {gap[1]:.6g} s to {gap[2]:.6g} s, which is "
            "more than a quarter of the record. State the temperature of the run "
            "(`temperature`) instead of a column.",
            code="empty-cells",
        )
    values = np.concatenate(segments, axis=1)
    lowest, highest = float(values[1].min()), float(values[1].max())
    return _fit_broken_line(values, span) if highest > lowest else (lowest,)


def _segment_means(values: Array, segment_count: int) -> Array:
    """Return means of time and value over consecutive parts, and their weights, shape (3, m).

    values: Times, values and weights, shape (3, n).
    """
    n = values.shape[1]
    if n <= segment_count:
        return values
    starts = np.arange(segment_count) * n // segment_count
    weight = np.add.reduceat(values[2], starts)
    means = np.add.reduceat(values[:2] * values[2], starts, axis=1) / weight
    return np.concatenate([means, weight[None]])


def _fit_broken_line(values: Array, span: tuple[float, float]) -> tuple[float, ...]:
    """Return the values at even times of the broken line that fits best.

    values: Times (s), values and weights, shape (3, n).
    """
    time, value, weight = _segment_means(values, _MAX_SEGMENTS)
    count = min(MAX_KNOTS, max(2, time.size // 2))
    position = (time - span[0]) / (span[1] - span[0]) * (count - 1)
    knots = np.arange(count)
    basis = np.maximum(1.0 - np.abs(position[:, None] - knots), 0.0)
    root = np.sqrt(weight / weight.max())
    second_differences = _STIFFNESS * np.diff(np.eye(count), 2, axis=0)
    rows = np.concatenate([root[:, None] * basis, second_differences])
    mean = float(value.mean())
    target = np.append(root * (value - mean), np.zeros(len(second_differences)))
    return tuple((mean + np.linalg.lstsq(rows, target, rcond=None)[0]).tolist())
