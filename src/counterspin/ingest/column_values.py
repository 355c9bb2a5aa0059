"""Properties of the values of a column: steps, wrapping, row numbers and temperatures."""

from __future__ import annotations

import math
import re
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.ingest.contents import FileColumn
from counterspin.records.sampling import Mask, ValueHolding
from counterspin.units import unit_factor

#: Names of row number columns.
COUNTER_NAME: Final = re.compile(
    r"(?i)(no|nr|num|number|index|idx|scan|samples?|points?|rows?|zeile|lfd\.? ?nr|#)\.?( #\d+)?"
)
#: Names of temperature columns.
_TEMPERATURE_NAME: Final = re.compile(r"(?i)(.*[^a-z])?temp(erature?|eratur)?([^a-z].*|$)")
#: Temperature scale -> plausible range of an accelerometer's temperature.
_TEMPERATURE_RANGES: Final = {"degC": (-60.0, 150.0), "K": (210.0, 425.0)}
#: First word of the name of a time -> unit.
_UNIT_BY_FIRST_WORD: Final = {
    "seconds": "s",
    **dict.fromkeys(("millis", "milliseconds"), "ms"),
    **dict.fromkeys(("micros", "microseconds"), "us"),
    **dict.fromkeys(("nanos", "nanoseconds"), "ns"),
}
#: Ranges of serial days of Excel and datenum of MATLAB, 1990 to 2100; longest sampling interval.
_DAY_NUMBER_RANGES: Final = ((32874.0, 73051.0), (726834.0, 767011.0))
_MAX_STEP_DAYS: Final = 1e-3
#: Range of times since 1970, s: 2000 to 2100.
_EPOCH_RANGE: Final = (9.4e8, 4.1e9)
#: Tolerance of even time steps, relative to the median step.
_STEP_TOLERANCE: Final = 0.5
#: Relative tolerance of the rate at which an angle advances across a gap.
_RATE_TOLERANCE: Final = 0.01


def temperature_scale(column: FileColumn) -> str | None:
    """Return the scale of a temperature column; None for other columns, such as raw counts."""
    scale = column.unit or ("degC" if _TEMPERATURE_NAME.fullmatch(column.name) else "")
    min_temperature, max_temperature = _TEMPERATURE_RANGES.get(scale, (math.inf, -math.inf))
    values = column.values[np.isfinite(column.values)]
    return (
        scale
        if values.size and min_temperature < values.min() and values.max() < max_temperature
        else None
    )


def first_word_unit(name: str) -> str | None:
    """Return the unit of a time by the first word of its name, as in `seconds_elapsed`; or None."""
    first_word = re.split(r"[^a-z]", re.split(r"[/.]", name)[-1].lower())[0]
    return _UNIT_BY_FIRST_WORD.get(first_word)


def time_unit_from_values(time: FileColumn) -> str | None:
    """Return the unit of serial days and of times since 1970; None for other times."""
    first, last = float(np.nanmin(time.values)), float(np.nanmax(time.values))
    step = float(np.nanmedian(np.diff(time.values)))
    is_date = any(low < first and last < high for low, high in _DAY_NUMBER_RANGES)
    if is_date and step < _MAX_STEP_DAYS:
        return "d"
    for unit in ("s", "ms", "us", "ns"):
        factor = unit_factor(unit, "s")
        if _EPOCH_RANGE[0] < first * factor < _EPOCH_RANGE[1] and 0.0 < step * factor <= 1.0:
            return unit
    return None


def is_nondecreasing(values: Array) -> bool:
    """Return whether values never decrease, and increase between most rows."""
    steps = np.diff(values[np.isfinite(values)])
    return bool(len(steps) >= 8 and (steps >= 0.0).all() and has_distinct_times(values))


def has_distinct_times(times: Array) -> bool:
    """Return whether times increase between most rows."""
    steps = np.diff(times[np.isfinite(times)])
    return bool(len(steps) and np.mean(steps > 0.0) > 0.5)


def is_nominal(values: Array) -> bool:
    """Return whether all values are -1, 0 or 1: nominal orientations."""
    return bool(np.isin(values[np.isfinite(values)], (-1.0, 0.0, 1.0)).all())


def has_even_steps(values: Array) -> bool:
    """Return whether values increase in even steps, as time does."""
    steps = np.diff(values[np.isfinite(values)])
    if len(steps) < 8 or not (steps >= 0).all():
        return False
    median_step = float(np.median(steps))
    return bool(
        median_step > 0.0
        and np.mean(np.abs(steps - median_step) < _STEP_TOLERANCE * median_step) > 0.9
    )


def is_row_counter(column: FileColumn) -> bool:
    """Return whether a column contains row numbers."""
    return bool(COUNTER_NAME.fullmatch(column.name)) or bool(
        column.values[0] in (0.0, 1.0) and (np.diff(column.values) == 1.0).all()
    )


def unwrap_values(values: Array, time: Array) -> tuple[Array, float | None] | None:
    """Return unwrapped values and their period (None: not wrapped); None if they do not advance.

    Outliers and repeated values become NaN. Lost and repeated rows are recognised by the time.
    """
    rows = np.flatnonzero(np.isfinite(values) & np.isfinite(time))
    if rows.size < max(16, 0.8 * len(values)):
        return None
    steps = np.diff(values[rows])
    median_step = float(np.median(steps))
    scatter = float(np.median(np.abs(steps - median_step)))
    if median_step == 0.0 or scatter > 0.3 * abs(median_step):
        return None
    tolerance = 0.9 * abs(median_step) + 10.0 * scatter
    rows = rows[~_is_repeat_or_outlier(steps, median_step, tolerance)]
    steps, durations = np.diff(values[rows]), np.diff(time[rows])
    expected_steps = np.full(steps.size, median_step)
    if has_even_steps(time):
        expected_steps *= durations / np.median(durations)
    # A wrap is a jump against the motion, by one period or, across a gap, by several.
    jumps = (expected_steps - steps) * np.sign(median_step)
    is_wrap = jumps > tolerance + _RATE_TOLERANCE * np.abs(expected_steps)
    period = None
    unwrapped = np.full(len(values), np.nan)
    turn_counts = np.zeros(steps.size)
    if is_wrap.any():
        period = float(np.median(jumps[is_wrap]))
        turns = jumps[is_wrap] / period
        if is_wrap.mean() > 0.4 or not (np.abs(turns - np.round(turns)) < 0.1).mean() > 0.9:
            return None
        turn_counts[is_wrap] = np.round(turns) * np.sign(median_step)
    unwrapped[rows] = values[rows] + (period or 0.0) * np.concatenate(
        [[0.0], np.cumsum(turn_counts)]
    )
    return unwrapped, period


def _is_repeat_or_outlier(steps: Array, median_step: float, tolerance: float) -> Mask:
    """Return which values repeat the previous value or are outliers, shape (n,).

    steps: Steps between the values, shape (n - 1,).
    tolerance: Largest deviation of a step from the median step.
    """
    is_jump = np.abs(steps - median_step) > tolerance
    # The steps before and after an outlier add up to two ordinary steps.
    is_pair = np.abs(steps[:-1] + steps[1:] - 2.0 * median_step) <= tolerance
    is_dropped = np.concatenate([[False], steps == 0.0])
    is_dropped[1:-1] |= is_jump[:-1] & is_jump[1:] & is_pair
    return is_dropped


def without_repeats(values: Array) -> Array:
    """Return values with NaN where a faster log repeats them, which would delay the signal."""
    try:
        holding = ValueHolding.detect(values)
    except ValueError:
        return values
    return values if holding is None else np.where(holding.is_new(values), values, np.nan)


def round_counts(period: float) -> float | None:
    """Return the counts per revolution, a power of two or a round number; None if none is near."""
    round_numbers = [2.0**n for n in range(8, 33)] + [
        digit * 10.0**n for n in range(2, 9) for digit in (1.0, 1.2, 1.8, 2.0, 2.5, 3.6, 4.0, 5.0)
    ]
    nearest_number = min(round_numbers, key=lambda counts: abs(counts / period - 1.0))
    return nearest_number if abs(nearest_number / period - 1.0) < 1e-3 else None
