"""Reading of a record: samples are checked, cleaned and reduced to block means.

Records of any format and length are read once, in chunks: the time is checked against the encoder
(`clock`), outliers are rejected (`outliers`), and block means are computed (`reduction`). At the
end the amplitudes are checked (`signals`).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from counterspin.arrays import median
from counterspin.errors import RecordError, error_code
from counterspin.input import FileIdentity
from counterspin.records.clock import MAX_ANGLE, MAX_LISTED_ROWS, Clock
from counterspin.records.column_file import (
    Chunk,
    ColumnFile,
    Columns,
    chunk_size,
    iter_chunks,
    row_count,
)
from counterspin.records.dialect import AUTODETECT
from counterspin.records.formats import open_columns
from counterspin.records.isolation import run_isolated
from counterspin.records.memory import MemoryTable
from counterspin.records.outliers import detect_outliers
from counterspin.records.record import (
    ColumnSpec,
    Gap,
    NominalMotion,
    Outlier,
    Record,
    RecordColumns,
    RecordReport,
)
from counterspin.records.reduction import BlockAverager, BlockMeans, block_size, main_segment
from counterspin.records.run_file import RunFile, check_length, interpolate_pulses, is_derived
from counterspin.records.sampling import MAX_REPEATED_TIMES, RepeatedValues, elapsed_time
from counterspin.records.several_sensors import require_single_sensor
from counterspin.records.signals import (
    HarmonicFit,
    SignalSums,
    UnitChange,
    check_first_harmonic,
    find_changepoint,
    find_dropout,
    find_unit_change,
    fit_harmonics,
    residual_noise,
)

#: Largest fraction of empty cells in a column.
MAX_EMPTY_FRACTION = 0.05
#: Largest value in SI units; squares of larger values could overflow.
MAX_MAGNITUDE = 1e100
#: Smallest gap that isolates rows, in time steps, in addition to one revolution.
_ISOLATION_STEPS = 10


def read_record(
    path: str | Path | MemoryTable,
    columns: RecordColumns,
    motion: NominalMotion,
    *,
    block: Literal["auto"] | None = "auto",
) -> Record:
    """Read, check, clean and reduce one record.

    path: A .csv, .txt, .tsv, .parquet, .h5, .hdf5 or .mat file, or a table in memory.
    motion: Stated motion of the run.
    block: "auto" reduces a record with more than 2 samples per 1/64 revolution to block means; None
        keeps every sample.
    """
    record = path if isinstance(path, MemoryTable) else Path(path)
    pulse_times = None
    if columns.angle is not None and columns.angle.kind == "pulses":
        source = record if columns.pulses is None else columns.pulses
        pulse_times = run_isolated(_read_pulse_times, source, columns)
        if pulse_times is None:
            columns = replace(columns, angle=None)
    if columns.angle is not None and pulse_times is not None:
        try:
            times = pulse_times[0]
            interpolate_pulses(times, times[:0], motion.rate, columns.angle.per_revolution)
        except ValueError as error:
            raise RecordError(
                f"{source}: column '{columns.angle.name}': {error}.", code=error_code(error)
            ) from None
    return run_isolated(_read_file, record, columns, motion, block, pulse_times)


def _read_file(
    path: Path | MemoryTable,
    columns: RecordColumns,
    motion: NominalMotion,
    block: Literal["auto"] | None,
    pulses: tuple[np.ndarray, FileIdentity | None] | None,
) -> Record:
    times = pulses and pulses[0]
    with open_record(path, columns, motion.rate, times) as (file, resolved_columns, files):
        try:
            record = _read_checked(file, resolved_columns, motion, block)
        except RecordError:
            if not file.use_strict_parser():
                raise
            record = _read_checked(file, resolved_columns, motion, block)
        other_files = {other.path: other.identity for other in files[1:] if other.identity}
        if columns.pulses and pulses and pulses[1]:
            other_files[columns.pulses] = pulses[1]
        return replace(record, other_files=other_files) if other_files else record


@contextmanager
def open_record(
    path: Path | MemoryTable, columns: RecordColumns, rate: float, pulses: np.ndarray | None = None
) -> Iterator[tuple[ColumnFile | RunFile, RecordColumns, list[ColumnFile]]]:
    """Open a record; yield the file or run file, its resolved columns, and all files.

    rate, pulses: As in `RunFile`.
    """
    with ExitStack() as stack:
        files = [stack.enter_context(open_columns(path, columns.dialect))]
        files += [
            stack.enter_context(open_columns(continuation, columns.dialect))
            for continuation in columns.continuation_files
        ]
        columns = columns.drop_missing_angle(files[0])
        for record_file in files:
            record_file.timestamp_columns = columns.timestamp_columns
            record_file.require(columns.file_columns)
            require_single_sensor(record_file, columns.file_columns)
        columns = columns.resolve_units(files[0])
        if len(files) == 1 and not is_derived(columns):
            yield files[0], columns, files
            return
        columns = columns.rename_derived_columns()
        yield RunFile(files, columns, rate, pulses), columns, files


def _read_pulse_times(
    path: Path | MemoryTable, columns: RecordColumns
) -> tuple[np.ndarray, FileIdentity | None] | None:
    """Return the times of a record's pulses, s, and the identity of their file.

    Returns: None if the file has no such column and does not need it.
    """
    with open_columns(path, columns.dialect if columns.pulses is None else AUTODETECT) as file:
        spec = columns.drop_missing_angle(file).angle
        if spec is None:
            return None
        file.require([spec.name])
        spec = spec.resolve_unit(file)
        times = file.read_columns([spec.name])[spec.name]
        return times[np.isfinite(times)] * spec.factor, file.identity


@np.errstate(all="ignore")  # implausible values are rejected at the end
def _read_checked(
    file: ColumnFile | RunFile,
    columns: RecordColumns,
    motion: NominalMotion,
    block: Literal["auto"] | None,
) -> Record:
    """Read a file, and read it again without isolated rows at its ends."""
    reader = _RecordReader(file, columns, motion, block)
    blocks = reader.read(columns.time_range)
    segment = reader.main_segment(blocks)
    if segment is not None:
        reader = _RecordReader(file, columns, motion, block)
        start, end = columns.time_range
        blocks = reader.read((max(start, segment[0]), min(end, segment[1])))
    return reader.make_record(blocks)


class _RecordReader:
    """Reads one record chunk by chunk."""

    def __init__(
        self,
        file: ColumnFile | RunFile,
        columns: RecordColumns,
        motion: NominalMotion,
        block: Literal["auto"] | None,
    ) -> None:
        self._file = file
        self._columns = columns
        self._signals = list(columns.signals.values())
        self._motion = motion
        self._wants_blocks = block == "auto" and bool(motion.rate)
        self._clock = Clock(file.path, file.locate_row, motion.rate)
        self._sums = SignalSums(len(self._signals))
        self._rows = 0
        self._isolated_rows = 0
        self._rows_outside = 0
        self._empty_cells = [0] * len(self._signals)
        self._repeats = RepeatedValues([spec.name for spec in self._signals])
        self._outlier_counts = [0] * len(self._signals)
        self._listed_outliers: list[Outlier] = []
        self._first_time = 0.0  # in the unit of the file
        self._block = 1

    @property
    def _start_time(self) -> float:
        """The time of the first sample on the file's time scale, s."""
        return self._first_time * self._columns.time.factor

    def read(self, time_range: tuple[float, float] = (-np.inf, np.inf)) -> BlockMeans:
        """Read the file to its end, chunk by chunk.

        time_range: First and last time of the rows to use, s on the file's time scale.
        """
        chunks: list[BlockMeans] = []
        averager: BlockAverager | None = None
        for columns in iter_chunks(self._file.batches(self._columns.names), self._choose_rows):
            rows = row_count(columns)
            if not self._motion.has_constant_input:
                self._sums.add([columns[spec.name] for spec in self._signals])
            first_row, stop_row = self._row_range(columns, time_range)
            n_excluded = rows - (stop_row - first_row)
            out_of_range = (
                rows - _row_count(*self._row_range(columns, self._columns.time_range))
                if n_excluded
                else 0
            )
            self._rows_outside += out_of_range
            self._isolated_rows += n_excluded - out_of_range
            if first_row < stop_row:
                used_rows = slice(first_row, stop_row)
                used_columns = {name: column[used_rows] for name, column in columns.items()}
                if averager is None:
                    self._first_time = self._first_number(used_columns[self._columns.time.name])
                chunk = self._make_chunk(used_columns)
                if averager is None:
                    self._clock.start(chunk.time, chunk.angle)
                    self._repeats.start(
                        self._file.path, self._rows + first_row, chunk.time, chunk.signals
                    )
                    if self._repeats.has_repeats:
                        self._block = 1  # means over interpolated values would be biased
                    averager = BlockAverager(
                        self._block,
                        self._clock.step,
                        self._motion.signal_rate(self._clock.rate),
                        reject_outliers=not self._motion.is_multi_pose,
                    )
                signals = self._repeats.blank(self._rows + first_row, chunk.signals)
                chunk = Chunk(chunk.time, chunk.angle, signals)
                blocks = self._process_chunk(self._rows + first_row, chunk, averager)
                if blocks is not None:
                    chunks.append(blocks)
            self._rows += rows
        if averager is None:
            raise RecordError(
                f"{self._file.path}: none of the {self._rows} rows is in the selected part of the "
                "record."
                if self._rows
                else f"{self._file.path}: the file has column names, but no rows of data.",
                code="no-rows",
            )
        self._clock.finish()
        self._check_empty_rows()
        if not chunks:
            raise RecordError(f"{self._file.path}: the record has no usable rows.", code="no-rows")
        return BlockMeans.concatenate(chunks)

    def main_segment(self, blocks: BlockMeans) -> tuple[float, float] | None:
        """Return the time range, on the file's time scale, without isolated rows; or None."""
        rate = abs(self._motion.rate)
        revolution = 2 * np.pi / rate if rate else 0.0
        segment = main_segment(blocks, max(revolution, _ISOLATION_STEPS * self._clock.step))
        return segment and (segment[0] + self._start_time, segment[1] + self._start_time)

    def _row_range(self, columns: Columns, time_range: tuple[float, float]) -> tuple[int, int]:
        """Return start and stop of the rows inside a time range."""
        spec = self._columns.time
        if time_range == (-np.inf, np.inf):
            return 0, row_count(columns)
        time = columns[spec.name] * spec.factor
        rows_inside = np.flatnonzero(~((time < time_range[0]) | (time > time_range[1])))
        return (int(rows_inside[0]), int(rows_inside[-1]) + 1) if len(rows_inside) else (0, 0)

    def _choose_rows(self, columns: Columns) -> int:
        """Choose the block size from the first time steps; return the rows of a chunk."""
        spec = self._columns.time
        time = columns[spec.name][: chunk_size(1)] * spec.factor
        steps = np.diff(time[np.isfinite(time)])
        steps = steps[steps > 0]
        if self._wants_blocks and len(steps):
            self._block = block_size(median(steps), self._motion.signal_rate(self._motion.rate))
        return chunk_size(self._block)

    def _first_number(self, time: np.ndarray) -> float:
        finite_times = time[np.isfinite(time)]
        if not len(finite_times):
            raise RecordError(
                f"{self._file.path}: column '{self._columns.time.name}' does not start with "
                "numbers.",
                code="not-numeric",
            )
        return float(finite_times[0])

    def _make_chunk(self, columns: Columns) -> Chunk:
        """Return time since the start (s), angle (rad) and signals in the units of the file."""
        time, angle = self._columns.time, self._columns.angle
        seconds = columns[time.name]
        if self._first_time:
            seconds = elapsed_time(seconds, self._first_time, time.factor)
        return Chunk(
            _scale(seconds, time.factor),
            None if angle is None else _scale(columns[angle.name], angle.factor, angle.offset),
            [columns[spec.name] for spec in self._signals],
        )

    def _process_chunk(
        self, first_row: int, chunk: Chunk, averager: BlockAverager
    ) -> BlockMeans | None:
        usable = self._clock.accept(first_row, chunk)
        usable_chunk = usable.chunk
        if not len(usable_chunk):
            self._count_empty(first_row, chunk.signals)
            return None
        block_means = averager.average(usable_chunk, usable.unevenness)
        if not block_means.is_complete or usable.rows is not None:
            self._count_empty(first_row, chunk.signals)
        for index, outliers in enumerate(block_means.outliers):
            if len(outliers):
                rows = outliers if usable.rows is None else usable.rows[outliers]
                values = usable_chunk.signals[index][outliers]
                self._record_outliers(index, rows + first_row, usable_chunk.time[outliers], values)
        return block_means.blocks

    def _count_empty(self, first_row: int, signals: list[np.ndarray]) -> None:
        for signal_index, signal in enumerate(signals):
            self._empty_cells[signal_index] += int(np.isnan(signal).sum())
            infinite_rows = np.flatnonzero(np.isinf(signal))
            if len(infinite_rows):
                location = self._file.locate_row(first_row + int(infinite_rows[0]))
                raise RecordError(
                    f"{self._file.path}, {location}: column '{self._signals[signal_index].name}' "
                    "contains an infinite value.",
                    code="value-out-of-range",
                )

    def _record_outliers(
        self, index: int, rows: np.ndarray, times: np.ndarray, values: np.ndarray
    ) -> None:
        capacity = MAX_LISTED_ROWS - self._outlier_counts[index]
        self._outlier_counts[index] += len(rows)
        spec = self._signals[index]
        for row, time, value in zip(rows[: max(capacity, 0)], times, values, strict=False):
            si_value = float(value) * spec.factor + spec.offset
            self._listed_outliers.append(
                Outlier(spec.name, int(row) + 1, float(time) + self._start_time, si_value)
            )

    def _check_empty_rows(self) -> None:
        counts = self._count_empty_cells()
        if self._motion.is_multi_pose:
            # Columns of slower sensors have many empty cells; rests are detected in the others.
            counts = {self._columns.time.name: counts[self._columns.time.name]}
        for name, count in counts.items():
            if count > MAX_EMPTY_FRACTION * self._rows:
                raise RecordError(
                    f"{self._file.path}: column '{name}' has {count} empty cells in "
                    f"{self._rows} rows; at most {100 * MAX_EMPTY_FRACTION:.0f} % may be empty.",
                    code="empty-cells",
                )
        n_invalid = self._clock.findings.implausible_angles
        if self._columns.angle is not None and n_invalid > MAX_EMPTY_FRACTION * self._rows:
            raise RecordError(
                f"{self._file.path}: column '{self._columns.angle.name}' has {n_invalid} angles "
                f"above {MAX_ANGLE:g} rad in {self._rows} rows; at most "
                f"{100 * MAX_EMPTY_FRACTION:.0f} % are allowed. Check the unit of the column, or "
                "subtract the first value.",
                code="value-out-of-range",
            )
        n_differing = self._clock.findings.differing
        if n_differing > MAX_REPEATED_TIMES * self._rows:
            raise RecordError(
                f"{self._file.path}: {n_differing} of {self._rows} rows have the same time "
                "as the previous row, but different values. If no row is missing, state "
                "`sampling_rate`.",
                code="repeated-times",
            )

    def _count_empty_cells(self) -> dict[str, int]:
        counts = {self._columns.time.name: self._clock.findings.empty_time}
        if self._columns.angle is not None:
            counts[self._columns.angle.name] = self._clock.findings.empty_angle
        repeat_counts = self._repeats.repeat_counts
        for spec, empty, repeats in zip(
            self._signals, self._empty_cells, repeat_counts, strict=True
        ):
            counts[spec.name] = empty - repeats
        return counts

    def make_record(self, blocks: BlockMeans) -> Record:
        """Check the whole record and assemble it."""
        duration = float(blocks.time[-1] - blocks.time[0])
        check_length(self._file.path, self._rows, duration, self._motion)
        if blocks.angle is not None and self._columns.angle is not None:
            self._check_magnitude(self._columns.angle, blocks.angle)
        phase = self._motion.signal_phase(blocks.time, blocks.angle)
        signals: dict[str, np.ndarray] = {}
        moments_by_signal: dict[str, np.ndarray] = {}
        for index, (name, spec) in enumerate(self._columns.signals.items()):
            signal = _scale(blocks.signals[index], spec.factor, spec.offset)
            self._check_magnitude(spec, signal)
            if self._block > 1:
                signal = self._reject_outlying_blocks(blocks, index, signal)
            if not self._motion.has_constant_input:
                signal, fit = self._check_amplitude(index, name, blocks, phase, signal)
                noise = residual_noise(fit) * np.sqrt(median(blocks.count))
                batches = self._file.batches(self._columns.names)
                rows = ((batch[self._columns.time.name], batch[spec.name]) for batch in batches)
                moments = self._sums.coefficients(index, noise / spec.factor, rows)
                moments_by_signal[name] = moments * (spec.factor / noise)
            signals[name] = signal
        return Record(
            blocks.time,
            blocks.angle,
            signals,
            blocks.count,
            blocks.time_sd,
            self._start_time,
            self._make_report(blocks),
            self._file.identity,
            polynomials=moments_by_signal,
            angle_sd=blocks.angle_sd,
        )

    def _check_magnitude(self, spec: ColumnSpec, values: np.ndarray) -> None:
        max_magnitude = float(np.abs(values[~np.isnan(values)]).max(initial=0.0))
        if not max_magnitude < MAX_MAGNITUDE:
            raise RecordError(
                f"{self._file.path}: column '{spec.name}' contains implausible values of up to "
                f"{max_magnitude:.3g} in SI units.",
                code="value-out-of-range",
            )

    def _check_amplitude(
        self,
        index: int,
        accelerometer: str,
        blocks: BlockMeans,
        phase: np.ndarray,
        signal: np.ndarray,
    ) -> tuple[np.ndarray, HarmonicFit]:
        """Return a signal without dropouts, and its harmonic fit.

        RecordError if the amplitude changes or does not agree with the motion.
        """
        harmonic = self._motion.expected_harmonics.get(accelerometer)
        fit = fit_harmonics(phase, signal)
        no_rows = np.empty(0, dtype=int)
        dropout = no_rows if harmonic is None else find_dropout(fit, phase, signal)
        if len(dropout) > MAX_EMPTY_FRACTION * len(signal):
            start, end = blocks.time[dropout[0]], blocks.time[dropout[-1]]
            raise RecordError(
                f"{self._file.path}: column '{self._columns.signals[accelerometer].name}' does "
                f"not follow the rotation for {100 * len(dropout) / len(signal):.2g} % of the "
                f"record, between {start:.6g} s and {end:.6g} s after its start, but follows the "
                "rotation again afterwards. The channel may have failed temporarily. At most "
                f"{100 * MAX_EMPTY_FRACTION:.0f} % of the record may be affected. Use only the "
                "part of the record before the failure.",
                code="signal-dropout",
            )
        if len(dropout):
            dropout = dropout[~np.isnan(signal[dropout])]  # NaN samples are already counted
            self._outlier_counts[index] += int(blocks.count[dropout].sum())
            signal = signal.copy()
            signal[dropout] = np.nan
            fit = fit_harmonics(phase, signal)
        change = find_unit_change(fit, may_grow=harmonic is None)
        if change is not None:
            raise self._unit_change_error(accelerometer, fit, change, blocks.time, phase)
        if harmonic is not None:
            problem = check_first_harmonic(fit, harmonic, self._columns.angle is not None)
            if problem is not None:
                column = self._columns.signals[accelerometer].name
                raise RecordError(
                    f"{self._file.path}: column '{column}' {problem}.", code="wrong-scale"
                )
        return signal, fit

    def _unit_change_error(
        self,
        accelerometer: str,
        fit: HarmonicFit,
        change: UnitChange,
        block_times: np.ndarray,
        phase: np.ndarray,
    ) -> RecordError:
        """Return the error for a change of unit, with its location in the file."""
        # Samples near the change were rejected as outliers: read the file again.
        start = block_times[fit.first_sample[change.revolution_before]]
        end = block_times[fit.last_sample[change.revolution_after]]
        spec = self._columns.signals[accelerometer]
        rows: list[np.ndarray] = []
        times: list[np.ndarray] = []
        signals: list[np.ndarray] = []
        row = 0
        for columns in self._file.batches(self._columns.names):
            time = self._make_chunk(columns).time
            rows_inside = np.flatnonzero((time >= start) & (time <= end))
            rows.append(row + rows_inside)
            times.append(time[rows_inside])
            signals.append(_scale(columns[spec.name][rows_inside], spec.factor, spec.offset))
            row += len(time)
        angle = np.interp(np.concatenate(times), block_times, phase)
        index = min(find_changepoint(fit, change, angle, np.concatenate(signals)), len(angle) - 1)
        location = self._file.locate_row(int(np.concatenate(rows)[index]))
        return RecordError(
            f"{self._file.path}, {location}: column '{spec.name}' changes its unit or scale: "
            f"{change.description}. End the record before this row, or correct the column.",
            code="unit-change",
        )

    def _reject_outlying_blocks(
        self, blocks: BlockMeans, signal_index: int, signal: np.ndarray
    ) -> np.ndarray:
        """Reject block means that deviate from their neighbours (a burst, a dropout)."""
        weight = np.sqrt(blocks.count / self._block)
        step = self._clock.step * self._block
        unevenness = float(np.abs(np.diff(blocks.time) / step - 1).max(initial=0.0))
        # The mean of an incomplete block near a crest differs: such blocks are not compared.
        tested_values = np.where(blocks.count >= 0.9 * self._block, signal, np.nan)
        rate = self._motion.signal_rate(self._clock.rate)
        outliers = detect_outliers(blocks.time, tested_values, rate, step, unevenness, weight)
        if len(outliers):
            self._outlier_counts[signal_index] += int(blocks.count[outliers].sum())
            signal = signal.copy()
            signal[outliers] = np.nan
        return signal

    def _make_report(self, blocks: BlockMeans) -> RecordReport:
        findings = self._clock.findings
        names = [spec.name for spec in self._signals]
        outliers = dict(zip(names, self._outlier_counts, strict=True))
        listed_outliers = list(self._listed_outliers)
        rate = None
        if self._columns.angle is not None and blocks.angle is not None:
            name = self._columns.angle.name
            outliers = {name: findings.angle_outliers, **outliers}
            listed_outliers += [
                Outlier(name, row + 1, np.nan, np.nan) for row in findings.outlier_rows
            ]
            angle_advance = blocks.angle[-1] - blocks.angle[0]
            rate = float(angle_advance / (blocks.time[-1] - blocks.time[0]))
        descriptions = [self._file.format_description, *self._repeats.notes(self._rows)]
        return RecordReport(
            path=self._file.path,
            rows=self._rows,
            used=int(blocks.count.sum()),
            repeated=findings.repeated,
            differing=findings.differing,
            empty=self._count_empty_cells(),
            outliers=outliers,
            isolated=self._isolated_rows,
            listed=tuple(listed_outliers),
            gaps=tuple(Gap(gap.time + self._start_time, gap.length) for gap in findings.gaps),
            n_gaps=findings.n_gaps,
            wrapped=findings.wrapped,
            step=self._clock.step,
            rate=rate,
            block=self._block,
            format_description=", ".join(filter(None, descriptions)),
            outside=self._rows_outside,
        )


def _scale(values: np.ndarray, factor: float, offset: float = 0.0) -> np.ndarray:
    result = values if factor == 1 else values * factor
    return result + offset if offset else result


def _row_count(start: int, stop: int) -> int:
    return stop - start
