"""Checks of a record's time against its encoder angle.

`Clock.accept` checks a chunk of a record and returns the usable rows, with the angle unwrapped.
Time never decreases; rows with equal times are merged; missing rows are gaps. Across a gap the
angle must advance with the time. An angle that does not fit its neighbours is an outlier if the
angle returns soon, or else a jump, which raises an error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from counterspin.arrays import MAD_TO_SIGMA, empty_aligned, median
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.records.column_file import Chunk
from counterspin.records.outliers import upper_median
from counterspin.records.record import Gap

#: Largest number of gaps, and of rows of each finding, that are listed; all are counted.
MAX_LISTED_ROWS = 100
_REVOLUTION = 2 * math.pi
#: Tolerance of an angle step relative to its neighbours, in robust standard deviations.
_RESIDUAL_SDS = 10.0
#: Deviating angle steps are attributed to the encoder's resolution if they are more frequent than
#: this fraction, or else up to this size, rad.
_COMMON_FRACTION = 0.01
_ENCODER_STEP_RAD = 1e-3
#: Largest plausible angle, rad, some 10^8 revolutions. Floating-point numbers beyond 1e16 do not
#: resolve fractions of a revolution, so that no test of the advance could reject them.
MAX_ANGLE = 1e9
#: Smallest time step that is a gap, in typical steps.
_GAP_STEPS = 1.5
#: Largest relative change of the rate across a gap.
_MAX_RATE_CHANGE = 1e-3
#: Largest gap in revolutions: for a longer gap, the rate change exceeds a quarter of a revolution.
_MAX_GAP_REVOLUTIONS = 250
#: Ratios of measured to nominal rate caused by a mistaken unit, and hints.
_UNIT_MISTAKES = (
    (180 / math.pi, "Is the angle column in degrees?"),
    (math.pi / 180, "Is the angle column in radians?"),
    (2 * math.pi, "Is the angle column in radians rather than revolutions?"),
    (1 / (2 * math.pi), "Is the angle column in revolutions?"),
    (360.0, "Is the angle column in degrees rather than revolutions?"),
    (1 / 360, "Is the angle column in revolutions rather than degrees?"),
    (1e-3, "Is the time column in milliseconds?"),
    (1e3, "Is the time column in seconds rather than milliseconds?"),
    (1e-6, "Is the time column in microseconds?"),
    (1e6, "Is the time column in seconds rather than microseconds?"),
    (1e-9, "Is the time column in nanoseconds?"),
    (
        1 / 60,
        "Is the time column in seconds rather than minutes, or is the stated rate per minute?",
    ),
    (60.0, "Is the time column in minutes, or is the stated rate per minute?"),
)


@dataclass
class ClockFindings:
    """Findings in the time and angle columns (counts of rows)."""

    repeated: int = 0
    differing: int = 0
    empty_time: int = 0
    empty_angle: int = 0
    angle_outliers: int = 0
    implausible_angles: int = 0
    outlier_rows: list[int] = field(default_factory=list)
    gaps: list[Gap] = field(default_factory=list)
    n_gaps: int = 0
    wrapped: bool = False


@frozen
class UsableRows:
    """The usable rows of a chunk: `rows` are indices in the chunk, None if all are used.

    `chunk` contains these rows, with the angle unwrapped; `unevenness` is the largest relative
    deviation of a time step from the typical one.
    """

    rows: np.ndarray | None
    chunk: Chunk
    unevenness: float


class Clock:
    """Checks time and angle of consecutive chunks.

    nominal_rate: Stated rate of the run, rad/s, signed.
    """

    def __init__(self, path: object, locate: Callable[[int], str], nominal_rate: float) -> None:
        self._path = path
        self._locate = locate
        self.rate = nominal_rate
        self.step = math.nan
        self.findings = ClockFindings()
        self._last_time = math.nan
        self._last_angle = math.nan
        self._last_values: list[float] = []
        self._steps = empty_aligned(0)
        # First row of a current dropout of the angle, its time, and the message.
        self._dropout_row: int | None = None
        self._dropout_time = math.nan
        self._dropout_message = ""

    def _fail(self, row: int, problem: str, code: str) -> RecordError:
        return RecordError(f"{self._path}, {self._locate(row)}: {problem}", code=code)

    def start(self, time: np.ndarray, angle: np.ndarray | None) -> None:
        """Estimate time step and rate from the first chunk; RecordError for a wrong rate."""
        is_valid = np.isfinite(time) if angle is None else np.isfinite(time) & np.isfinite(angle)
        valid_time = time[is_valid]
        steps = np.diff(valid_time)
        if not (steps > 0).any():
            if (steps < 0).any():
                row = int(np.flatnonzero(is_valid)[np.flatnonzero(steps < 0)[0] + 1])
                raise self._fail(row, "the time decreases.", "time-backwards")
            raise RecordError(
                f"{self._path}: fewer than two rows have different times.", code="no-rows"
            )
        self.step = median(steps[steps > 0])
        if angle is None:
            return
        valid_angle = angle[is_valid]
        nominal_rate = self.rate
        # Differences over an eighth of a revolution are long compared with the encoder's noise and
        # step, but short enough that the median applies to wrapped and unwrapped angles.
        max_lag = max(1, len(valid_time) // 4)
        lag = int(np.clip(_REVOLUTION / 8 / abs(nominal_rate * self.step), 1, max_lag))
        spans = valid_time[lag:] - valid_time[:-lag]
        is_typical = (spans > 0) & (spans < _GAP_STEPS * lag * self.step)
        angle_steps, spans = (valid_angle[lag:] - valid_angle[:-lag])[is_typical], spans[is_typical]
        measured_rate = median(angle_steps / spans)
        ratio = measured_rate / nominal_rate
        if abs(ratio - 1) > 0.05:
            raise RecordError(
                f"{self._path}: {_rate_mismatch_message(measured_rate, nominal_rate)}",
                code="rate-mismatch",
            )
        rate_deviation = _wrap_angle(angle_steps - nominal_rate * spans)
        self.rate = nominal_rate + median(rate_deviation / spans)

    def accept(self, first_row: int, chunk: Chunk) -> UsableRows:
        """Check one chunk."""
        usable_rows = self._accept_complete_chunk(chunk) or self._accept_rows(first_row, chunk)
        accepted_chunk = usable_rows.chunk
        if len(accepted_chunk):
            last = -1 if usable_rows.rows is None else int(usable_rows.rows[-1])
            self._last_values = [float(column[last]) for column in chunk.columns]
            self._last_time = float(accepted_chunk.time[-1])
            if accepted_chunk.angle is not None:
                self._last_angle = float(accepted_chunk.angle[-1])
                span = self._last_time - float(accepted_chunk.time[0])
                if abs(self.rate) * span > 1.0:
                    self.rate = (self._last_angle - float(accepted_chunk.angle[0])) / span
        return usable_rows

    def _accept_complete_chunk(  # noqa: PLR0911 - each failed test leads to the check of single rows
        self, chunk: Chunk
    ) -> UsableRows | None:
        """Accept a whole chunk if it needs no corrections (NaN fails every test)."""
        time, angle = chunk.time, chunk.angle
        if len(time) < 2:
            return None
        steps = self._differences(time)
        shortest_step, longest_step = float(steps.min()), float(steps.max())
        if not (shortest_step > 0 and longest_step < _GAP_STEPS * self.step):
            return None
        unevenness = max(longest_step / self.step - 1, 1 - shortest_step / self.step)
        elapsed = self.step if math.isnan(self._last_time) else time[0] - self._last_time
        if not 0 < elapsed < _GAP_STEPS * self.step:
            return None
        if angle is None:
            return UsableRows(None, chunk, unevenness)
        if self._dropout_row is not None:
            return None
        angle_advance = self._differences(angle)
        min_advance, max_advance = float(angle_advance.min()), float(angle_advance.max())
        if not (min_advance > -MAX_ANGLE and max_advance < MAX_ANGLE and abs(angle[0]) < MAX_ANGLE):
            return None
        sample = angle_advance[:: max(1, len(angle_advance) // 512)]
        typical_advance = upper_median(sample)
        tolerance = _step_tolerance(_wrap_angle(sample - typical_advance), angle)
        # Indices at which the angle is wrapped, and revolutions to add from there on.
        wrap_indices, turns = np.zeros(1, dtype=int), np.zeros(1)
        if not (
            min_advance >= typical_advance - tolerance
            and max_advance <= typical_advance + tolerance
        ):
            misfit_indices = np.flatnonzero(np.abs(angle_advance - typical_advance) > tolerance)
            n_wraps = np.round((typical_advance - angle_advance[misfit_indices]) / _REVOLUTION)
            if not (
                np.abs(angle_advance[misfit_indices] + _REVOLUTION * n_wraps - typical_advance)
                <= tolerance
            ).all():
                return None
            wrap_indices = np.append(wrap_indices, misfit_indices + 1)
            turns = np.append(turns, np.cumsum(n_wraps))
        if not math.isnan(self._last_time):
            expected_angle = self._last_angle + self.rate * elapsed
            previous_turns = float(np.round((expected_angle - angle[0]) / _REVOLUTION))
            if abs(float(angle[0]) + _REVOLUTION * previous_turns - expected_angle) > tolerance:
                return None
            turns = turns + previous_turns
        if len(turns) > 1 or turns[0]:
            segment_lengths = np.diff(wrap_indices, append=len(angle))
            unwrapped = angle + np.repeat(_REVOLUTION * turns, segment_lengths)
            self.findings.wrapped = True
            chunk = Chunk(time, unwrapped, chunk.signals)
        return UsableRows(None, chunk, unevenness)

    def _differences(self, column: np.ndarray) -> np.ndarray:
        """Return the steps of a column, in an array that the next call overwrites."""
        if len(self._steps) < len(column) - 1:
            self._steps = empty_aligned(len(column) - 1)
        steps = self._steps[: len(column) - 1]
        np.subtract(column[1:], column[:-1], out=steps)
        return steps

    def _accept_rows(self, first_row: int, chunk: Chunk) -> UsableRows:
        """Check a chunk row by row."""
        time = chunk.time
        for column, label in ((time, "time"), (chunk.angle, "angle")):
            if column is not None and np.isinf(column).any():
                row = first_row + int(np.flatnonzero(np.isinf(column))[0])
                raise self._fail(row, f"the {label} is infinite.", "value-out-of-range")
        has_time = ~np.isnan(time)
        self.findings.empty_time += int((~has_time).sum())
        rows = np.flatnonzero(has_time)
        last_time = self._last_time
        steps = np.diff(time[rows], prepend=last_time)
        if (steps < 0).any():
            index = int(np.flatnonzero(steps < 0)[0])
            previous_time = self._last_time if index == 0 else float(time[rows[index - 1]])
            raise self._fail(
                first_row + int(rows[index]),
                f"the time decreases from {previous_time:.9g} s to {time[rows[index]]:.9g} s, "
                "measured from the start of the record.",
                "time-backwards",
            )
        rows = self._drop_repeats(chunk, rows, steps)
        self._record_gaps(first_row + rows, time[rows], last_time)
        if chunk.angle is not None:
            has_number = ~np.isnan(chunk.angle[rows])
            self.findings.empty_angle += int((~has_number).sum())
            rows = self._plausible_rows(first_row, rows[has_number], chunk.angle)
            is_fitting, angle = self._unwrap_angle(first_row, rows, time[rows], chunk.angle[rows])
            rows = rows[is_fitting]
        selected_rows = chunk[rows]
        if chunk.angle is not None:
            selected_rows = Chunk(selected_rows.time, angle[is_fitting], selected_rows.signals)
        unevenness = float(np.abs(np.diff(selected_rows.time) / self.step - 1).max(initial=0.0))
        return UsableRows(rows, selected_rows, unevenness)

    def _plausible_rows(self, first_row: int, rows: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Return the rows whose angle is plausible; count the others as outliers."""
        is_large = np.abs(angle[rows]) > MAX_ANGLE
        if is_large.any():
            self.findings.implausible_angles += int(is_large.sum())
            self._record_angle_outliers(first_row + rows[is_large])
        plausible_rows: np.ndarray = rows[~is_large]
        return plausible_rows

    def _drop_repeats(self, chunk: Chunk, rows: np.ndarray, steps: np.ndarray) -> np.ndarray:
        repeats = np.flatnonzero(steps == 0)
        if not len(repeats):
            return rows
        differs = np.zeros(len(repeats), dtype=bool)
        for index, column in enumerate(chunk.columns):
            repeated_values = column[rows[repeats]]
            first_values = column[rows[repeats - 1]]
            if repeats[0] == 0:
                first_values[0] = self._last_values[index]
            differs |= (repeated_values != first_values) & ~(
                np.isnan(repeated_values) & np.isnan(first_values)
            )
        self.findings.repeated += len(repeats)
        self.findings.differing += int(differs.sum())
        return np.delete(rows, repeats)

    def _record_gaps(self, rows: np.ndarray, time: np.ndarray, last_time: float) -> None:
        steps = np.diff(time, prepend=last_time)
        for index in np.flatnonzero(steps > _GAP_STEPS * self.step):
            duration = float(steps[index])
            revolutions = duration * abs(self.rate) / _REVOLUTION
            if revolutions > _MAX_GAP_REVOLUTIONS:
                raise self._fail(
                    int(rows[index]),
                    f"no rows were recorded for {duration:.6g} s ({revolutions:.4g} revolutions), "
                    "a gap too long for the rotation to be tracked. End the record before the gap.",
                    "time-gap",
                )
            self.findings.n_gaps += 1
            if len(self.findings.gaps) < MAX_LISTED_ROWS:
                self.findings.gaps.append(Gap(float(time[index]) - duration, duration))

    def _unwrap_angle(
        self, first_row: int, rows: np.ndarray, time: np.ndarray, angle: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Unwrap the angle along the expected advance; mark the samples that fit it."""
        is_fitting = np.ones(len(rows), dtype=bool)
        if not len(rows):
            return is_fitting, angle
        steps = np.diff(time)
        misfits = _wrap_angle(np.diff(angle) - self.rate * steps)
        typical_misfit = median(misfits) if len(misfits) else 0.0
        base_tolerance = _step_tolerance(misfits - typical_misfit, angle) + abs(typical_misfit)

        def excess_misfit(indices: np.ndarray, start_time: float, start_angle: float) -> np.ndarray:
            elapsed = time[indices] - start_time
            rate_tolerance = (
                _MAX_RATE_CHANGE
                * abs(self.rate)
                * np.maximum(elapsed - _GAP_STEPS * self.step, 0.0)
            )
            deviation = _wrap_angle(angle[indices] - start_angle - self.rate * elapsed)
            excess: np.ndarray = np.abs(deviation) - base_tolerance - rate_tolerance
            return excess

        overdue = np.maximum(steps - _GAP_STEPS * self.step, 0.0)
        is_misfit = np.abs(misfits) > base_tolerance + _MAX_RATE_CHANGE * abs(self.rate) * overdue
        if math.isnan(self._last_angle):
            # Start at the first sample that agrees with its successor.
            start = int(np.argmin(is_misfit)) if len(is_misfit) else 0
            is_fitting[:start] = False
            last_index, index = start, start + 1
            last_time, last_angle = float(time[start]), float(angle[start])
        else:
            last_index, index = -1, 0
            last_time, last_angle = self._last_time, self._last_angle
        breaks = np.flatnonzero(is_misfit) + 1
        max_dropout = max(_REVOLUTION / 4 / abs(self.rate), 8 * self.step)
        while True:
            if last_index >= 0:
                break_index = np.searchsorted(breaks, last_index + 1)
                if break_index == len(breaks):
                    break
                index = int(breaks[break_index])
                last_time, last_angle = float(time[index - 1]), float(angle[index - 1])
            # `index` may not fit the last valid sample: search the first one that does.
            dropout_start = float(time[index] if self._dropout_row is None else self._dropout_time)
            stop = int(np.searchsorted(time, dropout_start + max_dropout, side="right"))
            # Nearly always, one of the next few samples fits.
            for search_stop in (min(index + 32, stop), stop):
                fitting_indices = np.flatnonzero(
                    excess_misfit(np.arange(index, search_stop), last_time, last_angle) <= 0
                )
                if len(fitting_indices):
                    break
            if len(fitting_indices):
                last_index = index + int(fitting_indices[0])
                is_fitting[index:last_index] = False
                self._dropout_row = None
                continue
            if self._dropout_row is None:
                elapsed = float(time[index]) - last_time
                deviation = float(_wrap_angle(angle[index] - last_angle - self.rate * elapsed))
                self._start_dropout(first_row + int(rows[index]), dropout_start, elapsed, deviation)
            if stop < len(rows):
                raise self._jump_error()
            is_fitting[index:] = False
            break
        self._record_angle_outliers(first_row + rows[~is_fitting])
        return is_fitting, self._unwrap_turns(time, angle, is_fitting)

    def _record_angle_outliers(self, rows: np.ndarray) -> None:
        self.findings.angle_outliers += len(rows)
        capacity = MAX_LISTED_ROWS - len(self.findings.outlier_rows)
        self.findings.outlier_rows += [int(row) for row in rows[:capacity]]

    def _unwrap_turns(
        self, time: np.ndarray, angle: np.ndarray, is_fitting: np.ndarray
    ) -> np.ndarray:
        angle = angle.copy()
        fitting_time, fitting_angle = time[is_fitting], angle[is_fitting]
        if not len(fitting_time):
            return angle
        elapsed, advance = np.diff(fitting_time), np.diff(fitting_angle)
        turns = np.append(0.0, np.cumsum(np.round((self.rate * elapsed - advance) / _REVOLUTION)))
        if not math.isnan(self._last_angle):
            expected_angle = self._last_angle + self.rate * (fitting_time[0] - self._last_time)
            turns += np.round((expected_angle - fitting_angle[0]) / _REVOLUTION)
        if turns.any():
            self.findings.wrapped = True
        angle[is_fitting] = fitting_angle + _REVOLUTION * turns
        return angle

    def finish(self) -> None:
        """Raise RecordError if the record ends with more than a few misfitting angles."""
        if (
            self._dropout_row is not None
            and self.findings.angle_outliers
            and self._count_dropout_rows() > 3
        ):
            raise self._jump_error()

    def _start_dropout(self, row: int, time: float, elapsed: float, misfit: float) -> None:
        self._dropout_row, self._dropout_time = row, time
        self._dropout_message = _jump_message(elapsed, self.step, misfit, self.rate)

    def _jump_error(self) -> RecordError:
        return self._fail(self._dropout_row or 0, self._dropout_message, "time-jump")

    def _count_dropout_rows(self) -> int:
        return sum(row >= (self._dropout_row or 0) for row in self.findings.outlier_rows)


def _step_tolerance(misfits: np.ndarray, angle: np.ndarray) -> float:
    """Return the tolerance of an angle step, rad: noise, encoder step and rounding."""
    magnitudes = np.abs(misfits)
    rounding_error = 1e-10 + 8 * np.finfo(float).eps * float(abs(angle[0]) + abs(angle[-1]))
    significant_magnitudes = magnitudes[magnitudes > rounding_error]
    encoder_step = float(significant_magnitudes.min()) if len(significant_magnitudes) else 0.0
    if len(significant_magnitudes) <= max(4, _COMMON_FRACTION * len(magnitudes)):
        # An encoder step recurs, a jump does not: a jump must not widen its own tolerance.
        encoder_step = min(encoder_step, _ENCODER_STEP_RAD)
    # Near a gap, or with an uneven clock, deviations may be smaller than the encoder step.
    n_rare_misfits = int(_COMMON_FRACTION * len(magnitudes)) + 4
    if n_rare_misfits < len(magnitudes):
        largest_common_misfit = float(np.partition(magnitudes, -n_rare_misfits)[-n_rare_misfits])
        encoder_step = max(encoder_step, min(largest_common_misfit, _ENCODER_STEP_RAD))
    return (
        _RESIDUAL_SDS * MAD_TO_SIGMA * upper_median(magnitudes) + 3 * encoder_step + rounding_error
        if len(magnitudes)
        else rounding_error
    )


def _wrap_angle(angle: np.ndarray) -> np.ndarray:
    return angle - _REVOLUTION * np.round(angle / _REVOLUTION)


def _rate_mismatch_message(measured_rate: float, nominal_rate: float) -> str:
    """Return a message about a rate (rad/s) that differs from the nominal one, with a hint."""
    ratio = measured_rate / nominal_rate
    message = (
        f"the angle advances at {measured_rate:.6g} rad/s, but the run's rate is "
        f"{nominal_rate:.6g} rad/s."
    )
    if abs(ratio + 1) < 0.05:
        return message + (
            " The angle changes in the opposite sense to the stated rate: reverse the sign of the "
            "rate or of the angle column."
        )
    mistaken_ratio, hint = min(_UNIT_MISTAKES, key=lambda mistake: abs(abs(ratio) / mistake[0] - 1))
    if abs(abs(ratio) / mistaken_ratio - 1) < 0.05:
        return f"{message} {hint}"
    return (
        message
        + " The two rates must agree within 5 %: check the stated rate and the units of the record."
    )


def _jump_message(elapsed: float, step: float, misfit: float, rate: float) -> str:
    """Return a message about a jump of time or angle between two rows.

    elapsed, step: Time between the rows, and typical time step, s.
    misfit: Deviation of the angle from its expected advance, rad.
    rate: rad/s.
    """
    if abs(elapsed / step - 1) < 0.2:
        return (
            f"the angle differs by {misfit:.4g} rad from the extrapolation of the preceding "
            "rows, and the difference persists. End the record before this row."
        )
    return (
        f"the clock jumps: time advances by {elapsed:.6g} s over one row, but the angle "
        f"advances only by the amount expected in {elapsed + misfit / rate:.6g} s. End the record "
        "before this row."
    )
