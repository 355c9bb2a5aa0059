"""Repeated values and time stamps in a log, and times in two columns.

A log that is faster than the sensor repeats values. A coarse clock, or packets of several samples,
repeat time stamps. Missing rows are lost samples. A time may be split into two columns: seconds and
nanoseconds, or GPS week and time of week.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array, median, quantile
from counterspin.errors import InputError, RecordError, error_code
from counterspin.frozen import frozen
from counterspin.records.outliers import estimate_resolution
from counterspin.records.unit_notation import bracketed_unit

#: Rows in which repeated values are detected.
_TEST_ROWS: Final = 100_000
#: Smallest fraction of repeated values, in addition to three times the fraction that is equal by
#: chance.
_MIN_REPEATED_FRACTION: Final = 2e-3
#: Largest fraction of samples equal by chance for which a changed value shows a new sample.
_MAX_CHANCE_FRACTION: Final = 0.02
#: Smallest fraction of the changes at one phase of a whole number of rows.
_MIN_PHASE_FRACTION: Final = 0.999
#: Ratio to the median step beyond which a step is an outlier.
_OUTLIER_STEPS: Final = 8.0
#: Smallest change of values, in steps of the resolution, except for smooth coarse signals.
_COARSE_STEPS: Final = 1.25
#: Largest number of rows per sample.
_MAX_ROWS: Final = 1000
#: Smallest number of changes for a decision.
_MIN_CHANGES: Final = 32

#: Largest step within a burst, relative to the mean step; smallest number of bursts, and smallest
#: fraction of pauses between bursts with different times.
_MAX_BURST_FRACTION: Final = 0.5
_MIN_BURSTS: Final = 4
_MIN_PAUSE_FRACTION: Final = 0.01
#: Largest fraction of rows that repeat the time of the preceding row with other values.
MAX_REPEATED_TIMES: Final = 0.05
#: Smallest number of time stamps to detect lost rows, and largest number of segments whose minimum
#: delays are compared.
_MIN_STAMPS: Final = 10
_MAX_FLOORS: Final = 40
#: Largest variance of second differences of minimum delays, rows^2; rounding causes 6 / 12.
_FLOOR_VARIANCE: Final = 1.5
#: Largest change between minimum delays, relative to the number of rows.
_MAX_FLOOR_CHANGE: Final = 0.005
#: Dickey-Fuller statistic that a random walk of 20 to 60 steps exceeds in 98 % of cases.
_WALK_LIMIT: Final = -4.7

#: Largest rounding error of a time that is not corrected, s.
_MAX_ROUNDING_ERROR: Final = 1e-9

Mask = npt.NDArray[np.bool_]


@frozen
class ValueHolding:
    """Pattern in which a log repeats the values of a slower sensor."""

    rows: float  #: Mean number of rows per sample.
    period: int  #: Rows per sample; 0: variable.
    phase: int  #: Row of the first new value, from 0, for a constant period.

    @classmethod
    def detect(cls, values: Array) -> ValueHolding | None:
        """Detect repeated values; None without them, ValueError if it cannot be decided.

        values: Logged values, NaN for empty cells, shape (n,).
        """
        sample = values[:_TEST_ROWS]
        finite_values = sample[np.isfinite(sample)]
        if finite_values.size < _MIN_CHANGES or np.ptp(finite_values) == 0.0:
            return None
        steps = np.diff(finite_values)
        nonzero_steps = steps[steps != 0.0]
        repeated_fraction = 1.0 - nonzero_steps.size / steps.size
        step_sizes = np.abs(nonzero_steps)
        typical_steps = step_sizes[step_sizes <= _OUTLIER_STEPS * median(step_sizes)]
        step = float(np.sqrt(np.mean(typical_steps**2)))
        p_repeat = min(1.0, estimate_resolution(finite_values) / (math.sqrt(2.0 * math.pi) * step))
        limit = 3.0 * p_repeat + 5.0 * math.sqrt(p_repeat / steps.size) + _MIN_REPEATED_FRACTION
        change_indices = np.flatnonzero(np.diff(sample, prepend=math.nan) != 0.0)[1:]
        # If samples are equal by chance, many differ from both neighbours.
        run_lengths = np.diff(change_indices)
        has_few_changes = (
            run_lengths.size < _MIN_CHANGES
            or step < _COARSE_STEPS * estimate_resolution(finite_values)
        )
        has_single_changes = has_few_changes or quantile(run_lengths, 0.01) < 2.0
        if (repeated_fraction <= limit and has_single_changes) or _has_constant_run(
            run_lengths, 1.0 / (1.0 - repeated_fraction)
        ):
            return None
        if period := _find_change_period(change_indices):
            return cls(float(period), period, int(change_indices[0]) % period)
        rows = 1.0 / (1.0 - repeated_fraction)
        if p_repeat > _MAX_CHANCE_FRACTION:
            raise InputError(
                f"the signal repeats {100.0 * repeated_fraction:.2g} % of its values at irregular "
                "intervals, which suggests a logging rate above the output rate of the sensor. The "
                "resolution is too coarse to tell repeated samples from samples that happen to be "
                "equal. Export each sample of the sensor only once",
                "irregular-time",
            )
        return cls(rows, 0, 0)

    def is_new(self, values: Array, first_row: int = 0, previous_value: float = math.nan) -> Mask:
        """Return the mask of rows with new values.

        first_row: Row of the first value, from 0.
        previous_value: Value before the first one; NaN without one.
        """
        if self.period:
            return np.asarray((np.arange(values.size) + first_row - self.phase) % self.period == 0)
        return np.asarray(np.diff(values, prepend=previous_value) != 0.0)


class RepeatedValues:
    """Handles repeated values in the signals of consecutive chunks.

    names: Columns of the signals.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._holding: list[ValueHolding | None] = []
        self.repeat_counts = [0] * len(names)  #: Repeated values of each signal.
        self._last_values = [math.nan] * len(names)
        self._first_row = 0

    def start(self, path: object, first_row: int, time: Array, signals: Sequence[Array]) -> None:
        """Detect repeated values in the first chunk; RecordError if it cannot be decided.

        Rows that repeat the time of the preceding row are ignored: the clock drops them.
        """
        self._first_row = first_row
        is_later = np.diff(time, prepend=math.nan) != 0.0
        for name, signal in zip(self._names, signals, strict=True):
            try:
                is_held = is_later.all() or ValueHolding.detect(signal[is_later]) is not None
                self._holding.append(ValueHolding.detect(signal) if is_held else None)
            except ValueError as error:
                raise RecordError(
                    f"{path}: column '{name}': {error}.", code=error_code(error)
                ) from None

    @property
    def has_repeats(self) -> bool:
        """Whether a signal repeats its values."""
        return any(self._holding)

    def blank(self, first_row: int, signals: Sequence[Array]) -> list[Array]:
        """Return the signals of a chunk with NaN for repeated values."""
        blanked_signals = list(signals)
        for index, (signal, holding) in enumerate(zip(signals, self._holding, strict=True)):
            if holding is None:
                continue
            is_new = holding.is_new(signal, first_row - self._first_row, self._last_values[index])
            is_repeat = ~is_new & ~np.isnan(signal)
            self.repeat_counts[index] += int(is_repeat.sum())
            self._last_values[index] = float(signal[-1])
            blanked_signals[index] = np.where(is_repeat, math.nan, signal)
        return blanked_signals

    def notes(self, rows: int) -> list[str]:
        """Return a note for each signal with repeated values; rows: number of rows."""
        fractions = (
            (name, count / rows)
            for name, count in zip(self._names, self.repeat_counts, strict=True)
        )
        return [
            f"column '{name}' repeats {100.0 * fraction:.3g} % of the values; the repetitions "
            "are not used"
            for name, fraction in fractions
            if fraction
        ]


def elapsed_time(time: Array, first_time: float, factor: float) -> Array:
    """Return the time since the first row, without the rounding error of times since 1970.

    factor: Factor from the unit of the file to s.
    """
    elapsed = time - first_time
    rounding_error = float(np.spacing(abs(first_time)))
    if rounding_error * factor < _MAX_ROUNDING_ERROR:
        return elapsed
    unit = 10.0 ** math.ceil(math.log10(4.0 * rounding_error))
    rounded = np.round(elapsed / unit) * unit
    is_decimal = np.nanmax(np.abs(rounded - elapsed), initial=0.0) <= rounding_error
    return np.asarray(rounded if is_decimal else elapsed)


def join_bursts(time: Array) -> Array:
    """Assign the time of the first row to all rows of a burst.

    The samples of a packet, stamped at arrival, have nearly equal times, followed by a pause. Other
    times are returned unchanged.
    """
    steps = np.diff(time)
    if not is_bursty(steps):
        return time
    is_first = np.append(True, steps > _MAX_BURST_FRACTION * float(np.mean(steps)))
    return np.asarray(time[np.flatnonzero(is_first)][np.cumsum(is_first) - 1])


def is_bursty(steps: Array) -> bool:
    """Return whether nondecreasing times, given by their steps, come in bursts."""
    if steps.size < _MIN_CHANGES or not (steps >= 0.0).all() or not steps.any():
        return False
    mean = float(np.mean(steps))
    n_pauses = int(np.sum(steps > _MAX_BURST_FRACTION * mean))
    min_pauses = _MIN_BURSTS if median(steps) == 0.0 else _MIN_PAUSE_FRACTION * steps.size
    return median(steps) < _MAX_BURST_FRACTION * mean and n_pauses >= min_pauses


def has_shared_times(time: Array, columns: Sequence[Array]) -> bool:
    """Return whether different rows share times, or come in bursts.

    Equal rows, except for a counter, are duplicates.

    columns: Columns of the rows, of the same length.
    """
    steps = np.diff(time)
    is_repeated = steps == 0.0
    if is_bursty(steps) or (steps < 0.0).any() or not is_repeated.any() or is_repeated.all():
        return is_bursty(steps)
    changes = [change for column in columns if ((change := np.diff(column)) < 0.0).any()]
    differs = np.any([np.abs(change[is_repeated]) > 0.0 for change in changes], axis=0)
    return float(np.sum(differs)) > MAX_REPEATED_TIMES * steps.size


def estimate_row_rate(time: Array) -> float:
    """Estimate the rate of rows that share time stamps or come in bursts, Hz.

    ValueError if rows are lost, so that they cannot be counted.
    """
    timestamps = join_bursts(time)
    time_steps = np.diff(reconstruct_times(timestamps, int(np.sum(np.diff(timestamps) == 0.0))))
    if np.ptp(time_steps) > 0.5 * median(time_steps):
        raise InputError(
            "samples are missing among rows with equal time stamps; export time stamps with a "
            "finer resolution",
            "irregular-time",
        )
    return 1.0 / median(time_steps)


def reconstruct_times(time: Array, n_restamped: int) -> Array:
    """Reconstruct even times of rows with repeated time stamps.

    Rows may be stamped late, but not early. The rows with the smallest delay follow the clock of
    the sensor.

    n_restamped: Number of rows with the time of the preceding row, for the message.
    """
    bounds = np.append(np.flatnonzero(np.append(True, np.diff(time) > 0.0)), time.size)
    burst_rows = quantile(np.diff(bounds), 0.999) + 1.0
    lag = min(time.size - 1, max(64, round(16 * burst_rows)))
    step = median(time[lag:] - time[:-lag]) / lag
    segments: list[Array] = np.split(time, _find_gaps(time, step, burst_rows, lag))
    # The last row of a time stamp has the smallest delay; the last time stamp may be incomplete.
    last_rows = [np.flatnonzero(np.diff(segment) > 0.0) for segment in segments]
    spans = [
        _measure_clock_span(segment, last, step)
        for segment, last in zip(segments, last_rows, strict=True)
        if last.size > 1
    ]
    if not spans:
        raise InputError(
            "too few rows have different times, so the sampling interval cannot be determined",
            "irregular-time",
        )
    count, duration = np.sum(spans, axis=0)
    step = float(duration / count)
    for segment, last in zip(segments, last_rows, strict=True):
        if _lacks_rows(segment[last] / step - last, segment.size):
            raise InputError(
                f"{n_restamped} of {time.size} rows have the same time as the previous row, "
                "but different values, and samples are missing or excessively delayed, so the time "
                "cannot be calculated from the row count; export the times of the sensor with a "
                "finer resolution, or, if no sample is missing, give `sampling_rate`",
                "irregular-time",
            )
    delays = [segment - step * np.arange(segment.size) for segment in segments]
    offsets = [round(float(delay.min() - delays[0].min()) / step) for delay in delays]
    rows = [offset + np.arange(delay.size) for offset, delay in zip(offsets, delays, strict=True)]
    return np.asarray(delays[0].min() + step * np.concatenate(rows))


def _find_gaps(time: Array, step: float, burst_rows: float, lag: int) -> list[int]:
    """Return the rows that follow a gap, after which the minimum delay is larger.

    After a pause without lost rows, late rows arrive together.

    step, burst_rows: Time between rows, s, and largest number of rows per time stamp.
    lag: Number of rows on either side for the minimum delay.
    """
    delay = time - step * np.arange(time.size)
    pauses = np.diff(time, prepend=time[0]) - burst_rows * step
    gaps: list[int] = []
    for row in np.flatnonzero(pauses > 3.0 * step).tolist():
        previous_delays = delay[max(row - lag, gaps[-1] if gaps else 0) : row]
        if delay[row : row + lag].min() - previous_delays.min() > 0.5 * pauses[row]:
            gaps.append(row)
    return gaps


def _measure_clock_span(time: Array, rows: npt.NDArray[np.int_], step: float) -> tuple[int, float]:
    """Return number of rows and duration, s, between two rows with small delays.

    rows: Last row of each time stamp.
    step: Approximate time between rows, s.
    """
    delay = time[rows] - step * rows
    n_third = max(1, rows.size // 3)
    first, last = rows[np.argmin(delay[:n_third])], rows[np.argmin(delay[-n_third:]) - n_third]
    return int(last - first), float(time[last] - time[first])


def _lacks_rows(delay: Array, rows: int) -> bool:
    """Return whether rows are lost, from the delay of the last row of each time stamp, rows.

    The delay of late rows returns to its minimum. A lost row shifts all later rows, so that the
    delay is a random walk. The test is that of Dickey and Fuller (J. Am. Stat. Assoc. 74 (1979)
    427) with a parabola, because the rate may change slowly.

    rows: Number of rows; relatively long delays are inconclusive.
    """
    if delay.size < _MIN_STAMPS:
        return False
    min_delays = np.array(
        [
            np.min(delay_segment)
            for delay_segment in np.array_split(delay, min(_MAX_FLOORS, delay.size))
        ]
    )
    floor_changes, second_differences = np.diff(min_delays), np.diff(min_delays, 2)
    position = np.linspace(-1.0, 1.0, floor_changes.size)
    parabola_basis = np.polynomial.polynomial.polyvander(position[1:], 2)
    residuals = (
        second_differences
        - parabola_basis @ np.linalg.lstsq(parabola_basis, second_differences, rcond=None)[0]
    )
    if float(residuals @ residuals) < _FLOOR_VARIANCE * (second_differences.size - 3):
        return False
    if float(floor_changes @ floor_changes) > floor_changes.size * (_MAX_FLOOR_CHANGE * rows) ** 2:
        return True
    orthonormal, factor = np.linalg.qr(
        np.column_stack([np.polynomial.polynomial.polyvander(position, 2), min_delays[:-1]])
    )
    projections = orthonormal.T @ floor_changes
    rss = floor_changes @ floor_changes - projections @ projections
    sign = math.copysign(1.0, factor[-1, -1])
    return bool(sign * projections[-1] > _WALK_LIMIT * math.sqrt(rss / (floor_changes.size - 4)))


def _has_constant_run(lengths: npt.NDArray[np.int_], rows: float) -> bool:
    """Return True if one value repeats for a long time, as in a dead or saturated channel."""
    long_runs = lengths[lengths > 1]
    return bool(long_runs.size == 0 or quantile(long_runs, 0.95) > 3.0 * rows + 2.0)


def _find_change_period(change_indices: npt.NDArray[np.int_]) -> int:
    """Return the whole number of rows between changes, some of which may be missing; or 0."""
    run_lengths = np.diff(change_indices)
    if (
        run_lengths.size < _MIN_CHANGES
        or not 1 < (shortest_length := int(quantile(run_lengths, 0.01))) < _MAX_ROWS
    ):
        return 0
    for period in range(shortest_length, 1, -1):
        n_in_phase = np.bincount(change_indices % period).max()
        if n_in_phase >= _MIN_PHASE_FRACTION * change_indices.size:
            return period
    return 0


# Times in two columns ---------------------------------------------------------------------------

#: Unit -> length in ns.
_UNIT_NANOSECONDS: Final = {
    "week": 604_800_000_000_000,
    "s": 1_000_000_000,
    "ms": 1_000_000,
    "us": 1000,
}
_UNIT_NANOSECONDS["ns"] = 1
#: Name of a split time in a description: two columns with units.
_SPLIT_NAME: Final = re.compile(
    rf"(.+) \[({'|'.join(_UNIT_NANOSECONDS)})\] \+ (.+) \[({'|'.join(_UNIT_NANOSECONDS)})\]",
    re.DOTALL,
)
#: Unit of the coarse column -> pattern of its names.
_COARSE_NAMES: Final = {
    "week": r"(?i)(?!.*of.?week).*(week|wk|(?<![a-z])wn)([ _]?(no|nr|num|number))?",
    "s": r"(?i)(.*[^a-z])?(secs?|seconds?|s|epoch|unix([ _]?time)?)|.*[a-z]Secs?",
}
#: Unit of the fine column -> pattern of its names within a second; pattern within a week.
_FINE_NAMES: Final = {
    "ns": r"(?i)(.*[^a-z])?(n_?secs?|nano_?sec(ond)?s?|nanos?|ns)",
    "us": r"(?i)(.*[^a-z])?(u_?secs?|micro_?sec(ond)?s?|micros?|us)",
    "ms": r"(?i)(.*[^a-z])?(m_?secs?|milli_?sec(ond)?s?|millis?|ms|gms)",
}
_TIME_OF_WEEK_NAME: Final = (
    r"(?i).*(tow|sow|(?<![a-z])g?ms|milli|secs?|(time|seconds?).?of.?week)(?![a-z]{2}).*"
)
#: A bracketed unit at the end of a name.
_BRACKETED_UNIT: Final = r"\s*[\[(][^\[\]()]*[\])]\s*$"
#: Seconds of a week.
_WEEK_SECONDS: Final = 604_800.0


@frozen
class SplitTime:
    """A time in two columns, coarse and fine, with their units."""

    coarse: str
    coarse_unit: str
    fine: str
    fine_unit: str

    @classmethod
    def parse(cls, name: str) -> SplitTime | None:
        """Parse a name such as ``sec [s] + nanosec [ns]``; None for other names."""
        match = _SPLIT_NAME.fullmatch(name)
        return cls(*match.groups()) if match else None

    @property
    def name(self) -> str:
        """The name of the time in a description."""
        return f"{self.coarse} [{self.coarse_unit}] + {self.fine} [{self.fine_unit}]"

    def nanoseconds(
        self, columns: Mapping[str, Array]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        """Return the times, ns, and the mask of valid rows.

        Integers keep nanoseconds, which seconds since 1970 in floating point lose.
        """
        coarse, fine = columns[self.coarse], columns[self.fine]
        is_valid = np.isfinite(coarse) & np.isfinite(fine)
        whole_units = np.floor(np.where(is_valid, coarse, 0.0))
        fraction = np.where(is_valid, coarse, 0.0) - whole_units
        coarse_ns, fine_ns = _UNIT_NANOSECONDS[self.coarse_unit], _UNIT_NANOSECONDS[self.fine_unit]
        remainder_ns = np.round(
            fraction * coarse_ns + np.where(is_valid, fine, 0.0) * fine_ns
        ).astype(np.int64)
        return whole_units.astype(np.int64) * coarse_ns + remainder_ns, is_valid


def find_split_time(columns: Mapping[str, Array]) -> SplitTime | None:
    """Find two columns that together contain a time; or None."""
    for split_time in _candidate_pairs(columns):
        coarse, fine = columns[split_time.coarse], columns[split_time.fine]
        if coarse.size < 2 or coarse.size != fine.size:
            continue
        if not (np.isfinite(coarse).all() and np.isfinite(fine).all()):
            continue
        max_fine = (
            _UNIT_NANOSECONDS[split_time.coarse_unit] / _UNIT_NANOSECONDS[split_time.fine_unit]
        )
        is_within_range = (fine >= 0.0).all() and (fine < max_fine).all() and np.ptp(fine) > 0.0
        if not is_within_range or (coarse != np.floor(coarse)).any() or np.abs(coarse).max() > 4e9:
            continue
        time, _ = split_time.nanoseconds(columns)
        if (np.diff(time) >= 0).all():
            return split_time
    return None


def _candidate_pairs(columns: Mapping[str, Array]) -> Iterator[SplitTime]:
    """Yield pairs of columns with suitable names, those with a common prefix first."""
    unbracketed_names = {name: re.sub(_BRACKETED_UNIT, "", name) for name in columns}
    week_names = [
        name
        for name, text in unbracketed_names.items()
        if re.fullmatch(_COARSE_NAMES["week"], text)
    ]
    for week_name, name in product(week_names, columns):
        if name != week_name and re.fullmatch(_TIME_OF_WEEK_NAME, unbracketed_names[name]):
            unit = bracketed_unit(name)
            if unit not in _UNIT_NANOSECONDS:
                unit = next(
                    (
                        fine_unit
                        for fine_unit, pattern in _FINE_NAMES.items()
                        if re.fullmatch(pattern, unbracketed_names[name])
                    ),
                    "",
                )
            if not unit:
                unit = "ms" if np.nanmax(columns[name], initial=0.0) >= _WEEK_SECONDS else "s"
            yield SplitTime(week_name, "week", name, unit)
    second_names = [
        name
        for name, text in unbracketed_names.items()
        if re.fullmatch(_COARSE_NAMES["s"], text) or bracketed_unit(name) == "s"
    ]
    pairs = [
        SplitTime(second_name, "s", name, unit)
        for second_name, name, (unit, pattern) in product(
            second_names, columns, _FINE_NAMES.items()
        )
        if name != second_name
        and (re.fullmatch(pattern, unbracketed_names[name]) or bracketed_unit(name) == unit)
    ]
    yield from sorted(pairs, key=lambda pair: -_common_prefix_length(pair.coarse, pair.fine))


def _common_prefix_length(first: str, second: str) -> int:
    """Return the length of the common prefix of two names."""
    pairs = zip(first, second, strict=False)
    return next(
        (
            length
            for length, (first_character, second_character) in enumerate(pairs)
            if first_character != second_character
        ),
        min(len(first), len(second)),
    )
