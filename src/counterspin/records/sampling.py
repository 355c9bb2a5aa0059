"""Tell the samples of a sensor from the rows of its log.

A log that is faster than the sensor repeats each value until the next one arrives. A clock that is
coarser than the rows, or packets of several samples, repeat time stamps. Rows that never arrive are
lost samples. A time may be split into two columns: seconds and nanoseconds, or GPS week and time of
week.
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
from counterspin.records.outliers import resolution
from counterspin.records.unit_notation import bracketed_unit

#: Rows that show whether values repeat.
_TEST_ROWS: Final = 100_000
#: Part of the rows that repeat a value beyond which these are repeats, in addition to three times
#: the part that is equal by chance.
_MIN_REPEATED_FRACTION: Final = 2e-3
#: Part of the samples that may be equal by chance where a change of the value tells a new sample.
_MAX_CHANCE_FRACTION: Final = 0.02
#: Part of the changes that are at one phase of a whole number of rows.
_MIN_PHASE_FRACTION: Final = 0.999
#: Steps that are so many times the median step are outliers.
_OUTLIER_STEPS: Final = 8.0
#: Steps of the resolution by which values change if they are not those of a smooth coarse signal.
_COARSE_STEPS: Final = 1.25
#: Most rows for a sample.
_MAX_ROWS: Final = 1000
#: Fewest rows that tell.
_MIN_CHANGES: Final = 32

#: Part of the mean step below which a step is within a burst; the fewest bursts that tell, and the
#: part of the steps between them where the times within a burst differ.
_MAX_BURST_FRACTION: Final = 0.5
_MIN_BURSTS: Final = 4
_MIN_PAUSE_FRACTION: Final = 0.01
#: Part of the rows that may repeat the time of the row before with other values.
MAX_REPEATED_TIMES: Final = 0.05
#: Fewest stamps that show whether rows are lost within them, and stretches of the record whose
#: least delays are compared.
_MIN_STAMPS: Final = 10
_FLOORS: Final = 40
#: Variance of the second difference of least delays, rows^2, above that of the rows' rounding,
#: which is 6 / 12.
_FLOOR_VARIANCE: Final = 1.5
#: Change from one least delay to the next, as a part of the rows, above which it does not tell.
_MAX_FLOOR_CHANGE: Final = 0.005
#: Statistic of Dickey and Fuller that a random walk of 20 to 60 steps exceeds in 98 % of cases.
_WALK_LIMIT: Final = -4.7

Mask = npt.NDArray[np.bool_]


@frozen
class ValueHolding:
    """The way in which a log repeats the values of a slower sensor."""

    rows: float  #: Mean number of rows for a sample.
    period: int  #: Rows for every sample; 0: the number varies.
    phase: int  #: Row of the first new value, from 0, where the period is not 0.

    @classmethod
    def detect(cls, values: Array) -> ValueHolding | None:
        """Return how values repeat; None if they do not. ValueError if it cannot be told.

        values: As logged, NaN where a cell is empty, shape (n,).
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
        chance_repeats = min(1.0, resolution(finite_values) / (math.sqrt(2.0 * math.pi) * step))
        limit = (
            3.0 * chance_repeats
            + 5.0 * math.sqrt(chance_repeats / steps.size)
            + _MIN_REPEATED_FRACTION
        )
        change_indices = np.flatnonzero(np.diff(sample, prepend=math.nan) != 0.0)[1:]
        # Of samples that are equal by chance, many differ from both neighbours.
        lengths = np.diff(change_indices)
        has_few_changes = lengths.size < _MIN_CHANGES or step < _COARSE_STEPS * resolution(
            finite_values
        )
        alternate = has_few_changes or quantile(lengths, 0.01) < 2.0
        if (repeated_fraction <= limit and alternate) or _is_constant_stretch(
            lengths, 1.0 / (1.0 - repeated_fraction)
        ):
            return None
        if period := _change_period(change_indices):
            return cls(float(period), period, int(change_indices[0]) % period)
        rows = 1.0 / (1.0 - repeated_fraction)
        if chance_repeats > _MAX_CHANCE_FRACTION:
            raise InputError(
                f"the signal repeats {100.0 * repeated_fraction:.2g} % of its values at "
                "irregular intervals, which suggests that the log is faster than the sensor. "
                "The resolution is too coarse to tell repeated samples from samples that happen "
                "to be equal. Export only the samples of the sensor",
                "irregular-time",
            )
        return cls(rows, 0, 0)

    def is_new(self, values: Array, first_row: int = 0, before: float = math.nan) -> Mask:
        """Return the rows with new values.

        first_row: Row of the first value, from 0.
        before: The value before the first one; NaN: none.
        """
        if self.period:
            return np.asarray((np.arange(values.size) + first_row - self.phase) % self.period == 0)
        return np.asarray(np.diff(values, prepend=before) != 0.0)


class RepeatedValues:
    """Repeated values in the signals of a record, chunk after chunk.

    names: The columns of the signals.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._holding: list[ValueHolding | None] = []
        self._held = [0] * len(names)
        self._last = [math.nan] * len(names)
        self._first_row = 0
        self.blank = [0] * len(names)  #: Values of each signal that were replaced by NaN.

    def start(self, path: object, first_row: int, time: Array, signals: Sequence[Array]) -> None:
        """Find how values repeat in the first chunk; RecordError if it cannot be told.

        Rows that repeat the time of the row before are no evidence: the clock drops them.
        """
        self._first_row = first_row
        is_later = np.diff(time, prepend=math.nan) != 0.0
        for name, signal in zip(self._names, signals, strict=True):
            try:
                repeats = is_later.all() or ValueHolding.detect(signal[is_later]) is not None
                self._holding.append(ValueHolding.detect(signal) if repeats else None)
            except ValueError as error:
                raise RecordError(
                    f"{path}: column '{name}': {error}.", code=error_code(error)
                ) from None

    def fill(self, first_row: int, signals: Sequence[Array], interpolates: bool) -> list[Array]:
        """Return the signals of a chunk with repeated values replaced.

        interpolates: Whether they are interpolated between new values, as the mean of a block
            needs them; otherwise they are NaN.
        """
        filled_signals = list(signals)
        for index, (signal, holding) in enumerate(zip(signals, self._holding, strict=True)):
            if holding is None:
                continue
            is_new = holding.is_new(signal, first_row - self._first_row, self._last[index])
            is_repeat = ~is_new & ~np.isnan(signal)
            new_indices = np.flatnonzero(is_new & ~np.isnan(signal))
            self._held[index] += int(is_repeat.sum())
            self._last[index] = float(signal[-1])
            values = np.full(len(signal), math.nan)
            if interpolates and len(new_indices):
                values = np.interp(np.arange(len(signal)), new_indices, signal[new_indices])
            else:
                self.blank[index] += int(is_repeat.sum())
            filled_signals[index] = np.where(is_repeat, values, signal)
        return filled_signals

    def notes(self, rows: int) -> list[str]:
        """Return a statement on each signal that repeats its values, of so many rows."""
        fractions = (
            (name, count / rows) for name, count in zip(self._names, self._held, strict=True)
        )
        return [
            f"column '{name}' repeats {100.0 * fraction:.3g} % of its values; repeated values "
            "are not used"
            for name, fraction in fractions
            if fraction
        ]


def join_bursts(time: Array) -> Array:
    """Return times in which the rows of a burst have the time of its first row.

    Packets of samples that are stamped when they arrive have stamps close to each other, and then
    a pause. Other times are returned as they are.
    """
    steps = np.diff(time)
    if not is_bursty(steps):
        return time
    is_first = np.append(True, steps > _MAX_BURST_FRACTION * float(np.mean(steps)))
    return np.asarray(time[np.flatnonzero(is_first)][np.cumsum(is_first) - 1])


def is_bursty(steps: Array) -> bool:
    """Return whether rows come in bursts, by the steps of their times; these never fall."""
    if steps.size < _MIN_CHANGES or not (steps >= 0.0).all() or not steps.any():
        return False
    mean = float(np.mean(steps))
    pauses = int(np.sum(steps > _MAX_BURST_FRACTION * mean))
    fewest = _MIN_BURSTS if median(steps) == 0.0 else _MIN_PAUSE_FRACTION * steps.size
    return median(steps) < _MAX_BURST_FRACTION * mean and pauses >= fewest


def has_shared_times(time: Array, columns: Sequence[Array]) -> bool:
    """Return whether different rows share times, or come in bursts.

    Rows that are equal except for a counter were written twice.

    columns: Columns of the rows, of the same length.
    """
    steps = np.diff(time)
    is_repeated = steps == 0.0
    if is_bursty(steps) or (steps < 0.0).any() or not is_repeated.any() or is_repeated.all():
        return is_bursty(steps)
    changes = [change for column in columns if ((change := np.diff(column)) < 0.0).any()]
    differs = np.any([np.abs(change[is_repeated]) > 0.0 for change in changes], axis=0)
    return float(np.sum(differs)) > MAX_REPEATED_TIMES * steps.size


def row_rate(time: Array) -> float:
    """Return the rate of rows that share stamps or come in bursts, 1/s.

    ValueError if rows are lost, so that they cannot be counted.
    """
    stamps = join_bursts(time)
    steps = np.diff(count_times(stamps, int(np.sum(np.diff(stamps) == 0.0))))
    if np.ptp(steps) > 0.5 * median(steps):
        raise InputError(
            "samples are missing among rows with equal time stamps; export time stamps with a "
            "finer resolution",
            "irregular-time",
        )
    return 1.0 / median(steps)


def count_times(time: Array, restamped_count: int) -> Array:
    """Return the times of rows whose stamps repeat: rows are even where none is lost.

    Rows may be stamped late, but not early. The rows with the least delay follow the clock of the
    sensor.

    restamped_count: Number of rows with the time of the row before, for the message.
    """
    bounds = np.append(np.flatnonzero(np.append(True, np.diff(time) > 0.0)), time.size)
    burst = quantile(np.diff(bounds), 0.999) + 1.0
    lag = min(time.size - 1, max(64, round(16 * burst)))
    step = median(time[lag:] - time[:-lag]) / lag
    segments: list[Array] = np.split(time, _gap_indices(time, step, burst, lag))
    # The last row of a stamp has the least delay; the last stamp may lack rows.
    last_rows = [np.flatnonzero(np.diff(segment) > 0.0) for segment in segments]
    spans = [
        _clock_span(segment, last, step)
        for segment, last in zip(segments, last_rows, strict=True)
        if last.size > 1
    ]
    if not spans:
        raise InputError(
            "the times differ in too few rows, so the rows cannot be counted", "irregular-time"
        )
    count, duration = np.sum(spans, axis=0)
    step = float(duration / count)
    for segment, last in zip(segments, last_rows, strict=True):
        if _lacks_rows(segment[last] / step - last, segment.size):
            raise InputError(
                f"{restamped_count} of {time.size} rows repeat the time of the previous row "
                "with different values, and samples are missing or delayed too much, so the "
                "rows cannot be counted; export the times of the sensor with a finer "
                "resolution, or, if no sample is missing, give `sampling_rate`",
                "irregular-time",
            )
    delays = [segment - step * np.arange(segment.size) for segment in segments]
    offsets = [round(float(delay.min() - delays[0].min()) / step) for delay in delays]
    rows = [offset + np.arange(delay.size) for offset, delay in zip(offsets, delays, strict=True)]
    return np.asarray(delays[0].min() + step * np.concatenate(rows))


def _gap_indices(time: Array, step: float, burst: float, lag: int) -> list[int]:
    """Return the rows that follow a gap: the least delay is larger after it than before.

    After a pause without a loss, late rows arrive together.

    step, burst: Time from row to row, s, and most rows of a stamp.
    lag: Rows on either side that show the least delay.
    """
    delay = time - step * np.arange(time.size)
    pauses = np.diff(time, prepend=time[0]) - burst * step
    gaps: list[int] = []
    for row in np.flatnonzero(pauses > 3.0 * step).tolist():
        before = delay[max(row - lag, gaps[-1] if gaps else 0) : row]
        if delay[row : row + lag].min() - before.min() > 0.5 * pauses[row]:
            gaps.append(row)
    return gaps


def _clock_span(time: Array, rows: npt.NDArray[np.int_], step: float) -> tuple[int, float]:
    """Return the number of rows, and their duration, between two rows with little delay.

    rows: The last row of each stamp.
    step: Approximate time from row to row, s.
    """
    delay = time[rows] - step * rows
    third = max(1, rows.size // 3)
    first, last = rows[np.argmin(delay[:third])], rows[np.argmin(delay[-third:]) - third]
    return int(last - first), float(time[last] - time[first])


def _lacks_rows(delay: Array, rows: int) -> bool:
    """Return whether rows are lost within stamps, by the delay of the last row of each stamp, rows.

    The delay of late rows returns to its least value. A lost row shifts all later rows, so that the
    delay is a random walk. The test is that of Dickey and Fuller (J. Am. Stat. Assoc. 74 (1979)
    427) with a parabola, because the rate may change slowly.

    rows: Number of rows. Delays that are long against them do not tell.
    """
    if delay.size < _MIN_STAMPS:
        return False
    floor = np.array([np.min(part) for part in np.array_split(delay, min(_FLOORS, delay.size))])
    change, bend = np.diff(floor), np.diff(floor, 2)
    position = np.linspace(-1.0, 1.0, change.size)
    smooth = np.polynomial.polynomial.polyvander(position[1:], 2)
    residual = bend - smooth @ np.linalg.lstsq(smooth, bend, rcond=None)[0]
    if float(residual @ residual) < _FLOOR_VARIANCE * (bend.size - 3):
        return False
    if float(change @ change) > change.size * (_MAX_FLOOR_CHANGE * rows) ** 2:
        return True
    trend, factor = np.linalg.qr(
        np.column_stack([np.polynomial.polynomial.polyvander(position, 2), floor[:-1]])
    )
    shares = trend.T @ change
    scatter = change @ change - shares @ shares
    sign = math.copysign(1.0, factor[-1, -1])
    return bool(sign * shares[-1] > _WALK_LIMIT * math.sqrt(scatter / (change.size - 4)))


def _is_constant_stretch(lengths: npt.NDArray[np.int_], rows: float) -> bool:
    """Return True if a value repeats for a while, as in a dead or saturated channel."""
    long_stretches = lengths[lengths > 1]
    return bool(long_stretches.size == 0 or quantile(long_stretches, 0.95) > 3.0 * rows + 2.0)


def _change_period(change_indices: npt.NDArray[np.int_]) -> int:
    """Return the whole number of rows between changes, of which some may be missing; 0: none is."""
    lengths = np.diff(change_indices)
    if (
        lengths.size < _MIN_CHANGES
        or not 1 < (shortest := int(quantile(lengths, 0.01))) < _MAX_ROWS
    ):
        return 0
    for period in range(shortest, 1, -1):
        phase_count = np.bincount(change_indices % period).max()
        if phase_count >= _MIN_PHASE_FRACTION * change_indices.size:
            return period
    return 0


# Times in two columns ---------------------------------------------------------------------------

#: Unit -> its length, ns.
_LENGTHS: Final = {"week": 604_800_000_000_000, "s": 1_000_000_000, "ms": 1_000_000, "us": 1000}
_LENGTHS["ns"] = 1
#: Two columns with their units, as a description names them.
_SPLIT: Final = re.compile(
    rf"(.+) \[({'|'.join(_LENGTHS)})\] \+ (.+) \[({'|'.join(_LENGTHS)})\]", re.DOTALL
)
#: Unit of the coarse column -> its names.
_COARSE: Final = {
    "week": r"(?i)(?!.*of.?week).*(week|wk|(?<![a-z])wn)([ _]?(no|nr|num|number))?",
    "s": r"(?i)(.*[^a-z])?(secs?|seconds?|s|epoch|unix([ _]?time)?)|.*[a-z]Secs?",
}
#: Unit of the fine column -> its names within a second, and within a week.
_FINE: Final = {
    "ns": r"(?i)(.*[^a-z])?(n_?secs?|nano_?sec(ond)?s?|nanos?|ns)",
    "us": r"(?i)(.*[^a-z])?(u_?secs?|micro_?sec(ond)?s?|micros?|us)",
    "ms": r"(?i)(.*[^a-z])?(m_?secs?|milli_?sec(ond)?s?|millis?|ms|gms)",
}
_OF_WEEK: Final = (
    r"(?i).*(tow|sow|(?<![a-z])g?ms|milli|secs?|(time|seconds?).?of.?week)(?![a-z]{2}).*"
)
#: A bracketed unit at the end of a name.
_BRACKETS: Final = r"\s*[\[(][^\[\]()]*[\])]\s*$"
#: Seconds of a week.
_WEEK: Final = 604_800.0


@frozen
class SplitTime:
    """The two columns of a time, coarse and fine, and their units."""

    coarse: str
    coarse_unit: str
    fine: str
    fine_unit: str

    @classmethod
    def parse(cls, name: str) -> SplitTime | None:
        """Return the columns that a name such as ``sec [s] + nanosec [ns]`` states, or None."""
        match = _SPLIT.fullmatch(name)
        return cls(*match.groups()) if match else None

    @property
    def name(self) -> str:
        """The name by which a description states the time."""
        return f"{self.coarse} [{self.coarse_unit}] + {self.fine} [{self.fine_unit}]"

    def nanoseconds(
        self, columns: Mapping[str, Array]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        """Return the times, ns, and a mask of the rows that have one.

        Whole numbers keep nanoseconds, which seconds since 1970 as floating-point numbers lose.
        """
        coarse, fine = columns[self.coarse], columns[self.fine]
        is_valid = np.isfinite(coarse) & np.isfinite(fine)
        whole_units = np.floor(np.where(is_valid, coarse, 0.0))
        fraction = np.where(is_valid, coarse, 0.0) - whole_units
        coarse_size, fine_size = _LENGTHS[self.coarse_unit], _LENGTHS[self.fine_unit]
        small = np.round(fraction * coarse_size + np.where(is_valid, fine, 0.0) * fine_size).astype(
            np.int64
        )
        return whole_units.astype(np.int64) * coarse_size + small, is_valid


def find_split_time(columns: Mapping[str, Array]) -> SplitTime | None:
    """Return the time that two columns of numbers hold together; None without such columns."""
    for split_time in _candidate_pairs(columns):
        coarse, fine = columns[split_time.coarse], columns[split_time.fine]
        if coarse.size < 2 or coarse.size != fine.size:
            continue
        if not (np.isfinite(coarse).all() and np.isfinite(fine).all()):
            continue
        max_fine = _LENGTHS[split_time.coarse_unit] / _LENGTHS[split_time.fine_unit]
        is_within_range = (fine >= 0.0).all() and (fine < max_fine).all() and np.ptp(fine) > 0.0
        if not is_within_range or (coarse != np.floor(coarse)).any() or np.abs(coarse).max() > 4e9:
            continue
        time, _ = split_time.nanoseconds(columns)
        if (np.diff(time) >= 0).all():
            return split_time
    return None


def _candidate_pairs(columns: Mapping[str, Array]) -> Iterator[SplitTime]:
    """Yield pairs of columns with fitting names, those with a common beginning first."""
    unbracketed_names = {name: re.sub(_BRACKETS, "", name) for name in columns}
    weeks = [
        name for name, text in unbracketed_names.items() if re.fullmatch(_COARSE["week"], text)
    ]
    for week, name in product(weeks, columns):
        if name != week and re.fullmatch(_OF_WEEK, unbracketed_names[name]):
            unit = bracketed_unit(name)
            if unit not in _LENGTHS:
                unit = next(
                    (
                        u
                        for u, pattern in _FINE.items()
                        if re.fullmatch(pattern, unbracketed_names[name])
                    ),
                    "",
                )
            if not unit:
                unit = "ms" if np.nanmax(columns[name], initial=0.0) >= _WEEK else "s"
            yield SplitTime(week, "week", name, unit)
    seconds = [
        name
        for name, text in unbracketed_names.items()
        if re.fullmatch(_COARSE["s"], text) or bracketed_unit(name) == "s"
    ]
    pairs = [
        SplitTime(second, "s", name, unit)
        for second, name, (unit, pattern) in product(seconds, columns, _FINE.items())
        if name != second
        and (re.fullmatch(pattern, unbracketed_names[name]) or bracketed_unit(name) == unit)
    ]
    yield from sorted(pairs, key=lambda pair: -_common_prefix_length(pair.coarse, pair.fine))


def _common_prefix_length(first: str, second: str) -> int:
    """Return the number of characters with which two names begin alike."""
    pairs = zip(first, second, strict=False)
    return next((n for n, (a, b) in enumerate(pairs) if a != b), min(len(first), len(second)))
