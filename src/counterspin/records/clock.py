"""The clock of a record, and the encoder as its witness.

`Clock.accept` takes a chunk of a record and returns the rows that can be used, with the angle
unwrapped. Time never decreases; rows with the same time are one row; missing rows are gaps.
The encoder is the witness of the clock: across a gap the angle must have advanced with the time,
and a sample that does not fit its neighbours is dropped when the angle comes back, and is a jump,
which is refused, when it does not.
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

#: Most gaps, and most rows of each kind of finding, that are listed; all are counted.
LISTED = 100
_TURN = 2 * math.pi
#: Robust standard deviations that a step of the angle may stray from its neighbours.
_RESIDUAL_SDS = 10.0
#: Steps of the angle that stand off are taken for the encoder's own, whatever their size, if they
#: are more than this part of all; otherwise up to this size, rad.
_COMMON_PART = 0.01
_ENCODER_STEP_RAD = 1e-3
#: Largest plausible angle, rad, some 10^8 revolutions. Floating-point numbers beyond 1e16 do not
#: resolve the fraction of a turn, so that no test of the advance rejects them.
MAX_ANGLE = 1e9
#: A time step longer than this many usual ones is a gap.
_GAP_STEPS = 1.5
#: The part of the advance across a gap by which the rate may have changed meanwhile.
_GAP_RATE_CHANGE = 1e-3
#: Revolutions of a gap beyond which that is a quarter of one, and the angle's turns are lost.
_GAP_REVOLUTIONS = 250
#: Ratios of measured to nominal rate that come of a mistaken unit, and what to say.
_UNIT_SLIPS = (
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
    (1 / 60, "Is the time column in seconds rather than minutes, or is the rate given per minute?"),
    (60.0, "Is the time column in minutes, or is the rate given per minute?"),
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
    gap_count: int = 0
    wrapped: bool = False


@frozen
class UsableRows:
    """The usable rows of a chunk: `rows` are places in the chunk, None when all are used.

    `chunk` is the chunk at those rows, with the angle unwrapped; `unevenness` is the largest
    deviation of a time step from the usual one, relative to it.
    """

    rows: np.ndarray | None
    chunk: Chunk
    unevenness: float


class Clock:
    """Checks time and angle, chunk after chunk.

    nominal_rate: The run's stated rate, rad/s, signed.
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
        # The first row of a run of unfitting angles that is still open, its time, and its fault.
        self._lost: int | None = None
        self._lost_time = math.nan
        self._lost_words = ""

    def _fail(self, row: int, description: str, code: str) -> RecordError:
        return RecordError(f"{self._path}, {self._locate(row)}: {description}", code=code)

    def start(self, time: np.ndarray, angle: np.ndarray | None) -> None:
        """Take the spacing and the rate from the first chunk; refuse a wrong rate or unit."""
        is_valid = np.isfinite(time) if angle is None else np.isfinite(time) & np.isfinite(angle)
        t = time[is_valid]
        steps = np.diff(t)
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
        a = angle[is_valid]
        nominal = self.rate
        # Differences over an eighth of a revolution: long against the encoder's noise and step,
        # short against a turn, so that one median serves wrapped and unwrapped angles.
        lag = int(np.clip(_TURN / 8 / abs(nominal * self.step), 1, max(1, len(t) // 4)))
        spans = t[lag:] - t[:-lag]
        is_typical = (spans > 0) & (spans < _GAP_STEPS * lag * self.step)
        angle_steps, spans = (a[lag:] - a[:-lag])[is_typical], spans[is_typical]
        measured_rate = median(angle_steps / spans)
        ratio = measured_rate / nominal
        if abs(ratio - 1) > 0.05:
            raise RecordError(
                f"{self._path}: {_rate_mismatch_message(measured_rate, nominal)}",
                code="rate-mismatch",
            )
        rate_deviation = _wrap(angle_steps - nominal * spans)
        self.rate = nominal + median(rate_deviation / spans)

    def accept(self, first_row: int, chunk: Chunk) -> UsableRows:
        """Check one chunk."""
        usable = self._accept_complete_chunk(chunk) or self._accept_rows(first_row, chunk)
        accepted_chunk = usable.chunk
        if len(accepted_chunk):
            last = -1 if usable.rows is None else int(usable.rows[-1])
            self._last_values = [float(column[last]) for column in chunk.columns]
            self._last_time = float(accepted_chunk.time[-1])
            if accepted_chunk.angle is not None:
                self._last_angle = float(accepted_chunk.angle[-1])
                span = self._last_time - float(accepted_chunk.time[0])
                if abs(self.rate) * span > 1.0:
                    self.rate = (self._last_angle - float(accepted_chunk.angle[0])) / span
        return usable

    def _accept_complete_chunk(  # noqa: PLR0911 - each test hands over to the row-by-row judgement
        self, chunk: Chunk
    ) -> UsableRows | None:
        """Take the chunk as it stands, if nothing in it needs attention (NaN fails every test)."""
        time, angle = chunk.time, chunk.angle
        if len(time) < 2:
            return None
        steps = self._differences(time)
        shortest, longest = float(steps.min()), float(steps.max())
        if not (shortest > 0 and longest < _GAP_STEPS * self.step):
            return None
        unevenness = max(longest / self.step - 1, 1 - shortest / self.step)
        elapsed = self.step if math.isnan(self._last_time) else time[0] - self._last_time
        if not 0 < elapsed < _GAP_STEPS * self.step:
            return None
        if angle is None:
            return UsableRows(None, chunk, unevenness)
        if self._lost is not None:
            return None
        angle_advance = self._differences(angle)
        low, high = float(angle_advance.min()), float(angle_advance.max())
        if not (low > -MAX_ANGLE and high < MAX_ANGLE and abs(angle[0]) < MAX_ANGLE):
            return None
        sample = angle_advance[:: max(1, len(angle_advance) // 512)]
        typical_advance = upper_median(sample)
        tolerance = _tolerance(_wrap(sample - typical_advance), angle)
        # Where the angle has been wrapped, and the turns to add from there on.
        wrap_indices, revolutions = np.zeros(1, dtype=int), np.zeros(1)
        if not (low >= typical_advance - tolerance and high <= typical_advance + tolerance):
            misfit_indices = np.flatnonzero(np.abs(angle_advance - typical_advance) > tolerance)
            wrap_count = np.round((typical_advance - angle_advance[misfit_indices]) / _TURN)
            if not (
                np.abs(angle_advance[misfit_indices] + _TURN * wrap_count - typical_advance)
                <= tolerance
            ).all():
                return None
            wrap_indices, revolutions = (
                np.append(wrap_indices, misfit_indices + 1),
                np.append(revolutions, np.cumsum(wrap_count)),
            )
        if not math.isnan(self._last_time):
            expected = self._last_angle + self.rate * elapsed
            before = float(np.round((expected - angle[0]) / _TURN))
            if abs(float(angle[0]) + _TURN * before - expected) > tolerance:
                return None
            revolutions = revolutions + before
        if len(revolutions) > 1 or revolutions[0]:
            lengths = np.diff(wrap_indices, append=len(angle))
            unwrapped = angle + np.repeat(_TURN * revolutions, lengths)
            self.findings.wrapped = True
            chunk = Chunk(time, unwrapped, chunk.signals)
        return UsableRows(None, chunk, unevenness)

    def _differences(self, column: np.ndarray) -> np.ndarray:
        """Return the steps of a column, in an array that the next call writes over."""
        if len(self._steps) < len(column) - 1:
            self._steps = empty_aligned(len(column) - 1)
        steps = self._steps[: len(column) - 1]
        np.subtract(column[1:], column[:-1], out=steps)
        return steps

    def _accept_rows(self, first_row: int, chunk: Chunk) -> UsableRows:
        """Judge a chunk row by row."""
        time = chunk.time
        for column, label in ((time, "time"), (chunk.angle, "angle")):
            if column is not None and np.isinf(column).any():
                row = first_row + int(np.flatnonzero(np.isinf(column))[0])
                raise self._fail(row, f"the {label} is infinite.", "value-out-of-range")
        has_time = ~np.isnan(time)
        self.findings.empty_time += int((~has_time).sum())
        rows = np.flatnonzero(has_time)
        before = self._last_time
        steps = np.diff(time[rows], prepend=before)
        if (steps < 0).any():
            index = int(np.flatnonzero(steps < 0)[0])
            previous = self._last_time if index == 0 else float(time[rows[index - 1]])
            raise self._fail(
                first_row + int(rows[index]),
                f"the time decreases, from {previous:.9g} s to {time[rows[index]]:.9g} s after "
                "the start of the record.",
                "time-backwards",
            )
        rows = self._drop_repeats(chunk, rows, steps)
        self._note_gaps(first_row + rows, time[rows], before)
        if chunk.angle is not None:
            has_number = ~np.isnan(chunk.angle[rows])
            self.findings.empty_angle += int((~has_number).sum())
            rows = self._plausible_rows(first_row, rows[has_number], chunk.angle)
            is_fitting, unwrapped = self._unwrap_angle(
                first_row, rows, time[rows], chunk.angle[rows]
            )
            rows = rows[is_fitting]
        selected_rows = chunk[rows]
        if chunk.angle is not None:
            selected_rows = Chunk(selected_rows.time, unwrapped[is_fitting], selected_rows.signals)
        unevenness = float(np.abs(np.diff(selected_rows.time) / self.step - 1).max(initial=0.0))
        return UsableRows(rows, selected_rows, unevenness)

    def _plausible_rows(self, first_row: int, rows: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Return the rows whose angle is plausible; count the others as outliers."""
        is_large = np.abs(angle[rows]) > MAX_ANGLE
        if is_large.any():
            self.findings.implausible_angles += int(is_large.sum())
            self._note_angle_outliers(first_row + rows[is_large])
        plausible: np.ndarray = rows[~is_large]
        return plausible

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

    def _note_gaps(self, rows: np.ndarray, time: np.ndarray, before: float) -> None:
        steps = np.diff(time, prepend=before)
        for index in np.flatnonzero(steps > _GAP_STEPS * self.step):
            length = float(steps[index])
            revolutions = length * abs(self.rate) / _TURN
            if revolutions > _GAP_REVOLUTIONS:
                raise self._fail(
                    int(rows[index]),
                    f"no rows were recorded for {length:.6g} s ({revolutions:.4g} revolutions), "
                    "which is too long to track the rotation. End the record before the gap.",
                    "time-gap",
                )
            self.findings.gap_count += 1
            if len(self.findings.gaps) < LISTED:
                self.findings.gaps.append(Gap(float(time[index]) - length, length))

    def _unwrap_angle(
        self, first_row: int, rows: np.ndarray, time: np.ndarray, angle: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Unwrap the angle along the expected advance; mark the samples that fit it."""
        is_fitting = np.ones(len(rows), dtype=bool)
        if not len(rows):
            return is_fitting, angle
        steps = np.diff(time)
        misfits = _wrap(np.diff(angle) - self.rate * steps)
        typical_misfit = median(misfits) if len(misfits) else 0.0
        base = _tolerance(misfits - typical_misfit, angle) + abs(typical_misfit)

        def excess_misfit(indices: np.ndarray, time0: float, angle0: float) -> np.ndarray:
            elapsed = time[indices] - time0
            tolerance = (
                _GAP_RATE_CHANGE
                * abs(self.rate)
                * np.maximum(elapsed - _GAP_STEPS * self.step, 0.0)
            )
            deviation = _wrap(angle[indices] - angle0 - self.rate * elapsed)
            excess: np.ndarray = np.abs(deviation) - base - tolerance
            return excess

        overdue = np.maximum(steps - _GAP_STEPS * self.step, 0.0)
        is_misfit = np.abs(misfits) > base + _GAP_RATE_CHANGE * abs(self.rate) * overdue
        if math.isnan(self._last_angle):
            # Begin at the first sample that its successor agrees with.
            start = int(np.argmin(is_misfit)) if len(is_misfit) else 0
            is_fitting[:start] = False
            last_index, index = start, start + 1
            last_time, last_angle = float(time[start]), float(angle[start])
        else:
            last_index, index = -1, 0
            last_time, last_angle = self._last_time, self._last_angle
        breaks = np.flatnonzero(is_misfit) + 1
        patience = max(_TURN / 4 / abs(self.rate), 8 * self.step)
        while True:
            if last_index >= 0:
                where = np.searchsorted(breaks, last_index + 1)
                if where == len(breaks):
                    break
                index = int(breaks[where])
                last_time, last_angle = float(time[index - 1]), float(angle[index - 1])
            # `index` may not fit the last good sample: look for the first one that does.
            lost_since = float(time[index] if self._lost is None else self._lost_time)
            stop = int(np.searchsorted(time, lost_since + patience, side="right"))
            # Nearly always one of the next few does.
            for end in (min(index + 32, stop), stop):
                fitting_indices = np.flatnonzero(
                    excess_misfit(np.arange(index, end), last_time, last_angle) <= 0
                )
                if len(fitting_indices):
                    break
            if len(fitting_indices):
                last_index = index + int(fitting_indices[0])
                is_fitting[index:last_index] = False
                self._lost = None
                continue
            if self._lost is None:
                elapsed = float(time[index]) - last_time
                deviation = float(_wrap(angle[index] - last_angle - self.rate * elapsed))
                self._start_dropout(first_row + int(rows[index]), lost_since, elapsed, deviation)
            if stop < len(rows):
                raise self._jump_error()
            is_fitting[index:] = False
            break
        self._note_angle_outliers(first_row + rows[~is_fitting])
        return is_fitting, self._unwrap_turns(time, angle, is_fitting)

    def _note_angle_outliers(self, rows: np.ndarray) -> None:
        self.findings.angle_outliers += len(rows)
        capacity = LISTED - len(self.findings.outlier_rows)
        self.findings.outlier_rows += [int(row) for row in rows[:capacity]]

    def _unwrap_turns(self, time: np.ndarray, angle: np.ndarray, good: np.ndarray) -> np.ndarray:
        angle = angle.copy()
        t, a = time[good], angle[good]
        if not len(t):
            return angle
        gone, advance = np.diff(t), np.diff(a)
        revolutions = np.append(0.0, np.cumsum(np.round((self.rate * gone - advance) / _TURN)))
        if not math.isnan(self._last_angle):
            expected = self._last_angle + self.rate * (t[0] - self._last_time)
            revolutions += np.round((expected - a[0]) / _TURN)
        if revolutions.any():
            self.findings.wrapped = True
        angle[good] = a + _TURN * revolutions
        return angle

    def finish(self) -> None:
        """Refuse a record that ends on angles which do not fit, unless they are a few."""
        if self._lost is not None and self.findings.angle_outliers and self._open_rows() > 3:
            raise self._jump_error()

    def _start_dropout(self, row: int, time: float, elapsed: float, misfit: float) -> None:
        self._lost, self._lost_time = row, time
        self._lost_words = _jump_message(elapsed, self.step, misfit, self.rate)

    def _jump_error(self) -> RecordError:
        return self._fail(self._lost or 0, self._lost_words, "time-jump")

    def _open_rows(self) -> int:
        return sum(row >= (self._lost or 0) for row in self.findings.outlier_rows)


def _tolerance(misfits: np.ndarray, angle: np.ndarray) -> float:
    """Return the tolerance of a step of the angle: noise, the encoder's step, rounding."""
    magnitude = np.abs(misfits)
    rounding = 1e-10 + 8 * np.finfo(float).eps * float(abs(angle[0]) + abs(angle[-1]))
    significant = magnitude[magnitude > rounding]
    quantum = float(significant.min()) if len(significant) else 0.0
    if len(significant) <= max(4, _COMMON_PART * len(magnitude)):
        # An encoder's step shows again and again, a jump once: it must not excuse itself.
        quantum = min(quantum, _ENCODER_STEP_RAD)
    # Beside a gap, or by an uneven clock, strays may be less than the step, which is common too.
    rare_count = int(_COMMON_PART * len(magnitude)) + 4
    if rare_count < len(magnitude):
        largest_common = float(np.partition(magnitude, -rare_count)[-rare_count])
        quantum = max(quantum, min(largest_common, _ENCODER_STEP_RAD))
    return (
        _RESIDUAL_SDS * MAD_TO_SIGMA * upper_median(magnitude) + 3 * quantum + rounding
        if len(magnitude)
        else rounding
    )


def _wrap(angle: np.ndarray) -> np.ndarray:
    return angle - _TURN * np.round(angle / _TURN)


def _rate_mismatch_message(measured_rate: float, nominal_rate: float) -> str:
    """Say that the angle does not advance at the run's rate (rad/s), and what may be the cause."""
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
    slip, hint = min(_UNIT_SLIPS, key=lambda slip_and_hint: abs(abs(ratio) / slip_and_hint[0] - 1))
    if abs(abs(ratio) / slip - 1) < 0.05:
        return f"{message} {hint}"
    return (
        message
        + " The two rates must agree within 5 %: check the stated rate and the units of the record."
    )


def _jump_message(elapsed: float, step: float, misfit: float, rate: float) -> str:
    """Say that time and angle part company between two rows.

    elapsed, step: The time between the rows, and the usual one, s.
    misfit: Deviation of the angle from its expected advance, rad.
    rate: rad/s.
    """
    if abs(elapsed / step - 1) < 0.2:
        return (
            f"the angle differs by {misfit:.4g} rad from the extrapolation of the preceding "
            "rows, and does not return. End the record before this row."
        )
    return (
        f"the clock jumps: time advances by {elapsed:.6g} s over one row, but the angle "
        f"advances only as much as expected in {elapsed + misfit / rate:.6g} s. End the record "
        "before this row."
    )
