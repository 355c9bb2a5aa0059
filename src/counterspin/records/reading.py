"""Records: the samples of one run, read from a file, checked, cleaned and reduced.

- `ColumnSpec`: a column of the file and its unit
- `read_record`: file -> `Record`, or a `RecordError` that names the file and the line
- `Record`: point samples, or means over blocks of at most 1/64 revolution, in SI units
- `RecordReport` (of `record_report`): what was found on the way, counted and listed

Whatever the format and the length, a record passes once through memory, in pieces: its clock is
checked against the encoder (`record_clock`), outliers are found among their neighbours (`spikes`)
and the rest is averaged (`reduction`). At the end the amplitudes are checked (`record_amplitude`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from counterspin.errors import RecordError
from counterspin.records.amplitude import Waves, against_reference, change_of_unit, switch, waves
from counterspin.records.clock import LISTED, Clock
from counterspin.records.column_file import ColumnFile, Columns
from counterspin.records.formats import open_columns
from counterspin.records.reduction import Blocks, Reducer, block_size, in_pieces, joined, piece_size
from counterspin.records.report import Gap, Outlier, RecordReport
from counterspin.records.spikes import find_spikes

#: More empty cells than this part of a run's rows refuse the record.
MOST_EMPTY = 0.05
#: Fewest revolutions of a record.
FEWEST_REVOLUTIONS = 3.0


@dataclass(frozen=True)
class ColumnSpec:
    """A column of a record file: its name and the factor that turns its unit into SI."""

    name: str
    factor: float = 1.0


@dataclass(frozen=True)
class Record:
    """One run: point samples or block means, in SI units. Arrays (n,).

    Attributes
    ----------
    time
        s since the first sample; of a block, the mean time of its samples.
    angle
        rad, unwrapped; None when the file has no angle column.
    signals
        Accelerometer -> displacement, velocity or specific force (m, m/s, m/s^2); NaN where that
        accelerometer has no good sample.
    count
        Samples in each block; 1 is a point sample.
    time_sd
        s, standard deviation of the times inside each block; 0 for a point.
    start_time
        s, the first sample's time in the file's own clock.
    report
        What was found.
    """

    time: np.ndarray
    angle: np.ndarray | None
    signals: dict[str, np.ndarray]
    count: np.ndarray
    time_sd: np.ndarray
    start_time: float
    report: RecordReport


def read_record(
    path: str | Path,
    time: ColumnSpec,
    angle: ColumnSpec | None,
    signals: Mapping[str, ColumnSpec],
    *,
    nominal_rate: float,
    radius: float,
    input_axes: Mapping[str, np.ndarray] | None = None,
    block: Literal["auto"] | None = "auto",
) -> Record:
    """Read, check, clean and reduce one record.

    Parameters
    ----------
    path
        A .csv, .parquet, .h5, .hdf5 or .mat file.
    time, angle
        The columns of time and spindle angle (wrapped or not), or no angle.
    signals
        Accelerometer -> its column.
    nominal_rate
        The run's stated rate, rad/s; negative turns from north to east.
    radius
        m.
    input_axes
        Accelerometer -> (3,) unit vector in east, north, up, for those whose signal is a
        displacement: its swing about the axis is then checked against the radius.
    block
        "auto" reduces a record that is denser than 2 samples per 1/64 revolution to block means;
        None keeps every sample.

    Raises
    ------
    RecordError
        The file is missing, empty or unreadable, a column is missing, a cell holds text or an
        infinite value, time runs backwards, the clock or the angle jumps, the angle's rate is not
        the run's, more than 5 % of a column are empty, a unit changes on the way, or there are
        fewer than three revolutions.
    """
    path = Path(path)
    specs = [time, *([angle] if angle else []), *signals.values()]
    names = list(dict.fromkeys(spec.name for spec in specs))
    file = open_columns(path, names)
    reading = _RecordReader(file, specs, angle is not None, nominal_rate, block)
    blocks = reading.run()
    duration = float(blocks.time[-1] - blocks.time[0])
    revolutions = duration * abs(nominal_rate) / (2 * np.pi)
    if revolutions < FEWEST_REVOLUTIONS:
        raise RecordError(
            f"{path}: the record lasts {duration:.6g} s, {revolutions:.3g} revolutions at the "
            f"run's rate; at least {FEWEST_REVOLUTIONS:g} are needed. "
            "Check the unit of the time column."
        )
    return reading.record(blocks, list(signals), radius, input_axes)


class _RecordReader:
    """The state of reading one file."""

    def __init__(
        self,
        file: ColumnFile,
        specs: list[ColumnSpec],
        has_angle: bool,
        nominal_rate: float,
        block: Literal["auto"] | None,
    ) -> None:
        self._file = file
        self._specs = specs
        self._places = [file.names.index(spec.name) for spec in specs]
        self._has_angle = has_angle
        self._signals = specs[2 if has_angle else 1 :]
        self._nominal_rate = nominal_rate
        self._wants_blocks = block == "auto"
        self._clock = Clock(file.path, file.locate, nominal_rate)
        self._rows = 0
        self._empty = [0] * len(self._signals)
        self._outliers = [0] * len(self._signals)
        self._listed: list[Outlier] = []
        self.start_time = 0.0
        self.block = 1

    def run(self) -> Blocks:
        """Read the file to its end."""
        parts: list[Blocks] = []
        reducer: Reducer | None = None
        for piece in in_pieces(self._file.batches(), self._places, self._choose_size):
            if reducer is None:
                self.start_time = self._first_time(piece[0])
            columns = self._in_si(piece)
            if reducer is None:
                self._clock.start(columns[0], columns[1] if self._has_angle else None)
                reducer = Reducer(self.block, self._clock.step, self._clock.rate)
            blocks = self._take(columns, reducer)
            self._rows += len(columns[0])
            if blocks is not None:
                parts.append(blocks)
        if reducer is None:
            raise RecordError(f"{self._file.path}: the file names its columns, but has no rows.")
        self._clock.finish()
        self._refuse_empty()
        if not parts:
            raise RecordError(f"{self._file.path}: no row of the record can be used.")
        return Blocks.joined(parts)

    def _choose_size(self, columns: Columns) -> int:
        """Choose the block from the spacing of the first rows; return the rows to a piece."""
        time = columns[0][: piece_size(1)] * self._specs[0].factor
        steps = np.diff(time[np.isfinite(time)])
        steps = steps[steps > 0]
        if self._wants_blocks and len(steps):
            self.block = block_size(float(np.median(steps)), self._nominal_rate)
        return piece_size(self.block)

    def _first_time(self, time: np.ndarray) -> float:
        finite = time[np.isfinite(time)]
        if not len(finite):
            raise RecordError(
                f"{self._file.path}: column '{self._specs[0].name}' has no numbers at its start."
            )
        return float(finite[0])

    def _in_si(self, piece: Columns) -> Columns:
        """Return time from the record's start (s), the angle (rad) and the signals as filed."""
        columns = list(piece)
        if self.start_time:
            columns[0] = columns[0] - self.start_time
        for place in range(2 if self._has_angle else 1):
            factor = self._specs[place].factor
            if factor != 1:
                columns[place] = columns[place] * factor
        return columns

    def _take(self, columns: Columns, reducer: Reducer) -> Blocks | None:
        accepted = self._clock.accept(self._rows, columns, self._has_angle)
        good, first = accepted.columns, len(columns) - len(self._signals)
        if not len(good[0]):
            self._count_empty(columns[first:])
            return None
        blocks, outliers, complete = reducer.reduce(good, self._has_angle, accepted.unevenness)
        if not complete or accepted.rows is not None:
            self._count_empty(columns[first:])
        for place, found in enumerate(outliers):
            if len(found):
                rows = found if accepted.rows is None else accepted.rows[found]
                self._note_outliers(
                    place, rows + self._rows, good[0][found], good[first + place][found]
                )
        return blocks

    def _count_empty(self, signals: Columns) -> None:
        for place, signal in enumerate(signals):
            self._empty[place] += int(np.isnan(signal).sum())
            infinite = np.flatnonzero(np.isinf(signal))
            if len(infinite):
                where = self._file.locate(self._rows + int(infinite[0]))
                raise RecordError(
                    f"{self._file.path}, {where}: column '{self._signals[place].name}' "
                    "holds an infinite value."
                )

    def _note_outliers(
        self, place: int, rows: np.ndarray, times: np.ndarray, values: np.ndarray
    ) -> None:
        room = LISTED - self._outliers[place]
        self._outliers[place] += len(rows)
        name, factor = self._signals[place].name, self._signals[place].factor
        start = self.start_time * self._specs[0].factor
        for row, time, value in zip(rows[: max(room, 0)], times, values, strict=False):
            self._listed.append(
                Outlier(name, int(row) + 1, float(time) + start, float(value) * factor)
            )

    def _refuse_empty(self) -> None:
        found = self._clock.found
        for name, count in self._empty_counts().items():
            if count > MOST_EMPTY * self._rows:
                raise RecordError(
                    f"{self._file.path}: column '{name}' has {count} empty cells in "
                    f"{self._rows} rows; at most {MOST_EMPTY:.0%} may be empty."
                )
        if found.differing > MOST_EMPTY * self._rows:
            raise RecordError(
                f"{self._file.path}: {found.differing} of {self._rows} rows repeat the time of "
                "the row before with other values; the time column may be too coarse."
            )

    def _empty_counts(self) -> dict[str, int]:
        counts = {self._specs[0].name: self._clock.found.empty_time}
        if self._has_angle:
            counts[self._specs[1].name] = self._clock.found.empty_angle
        counts.update(zip((s.name for s in self._signals), self._empty, strict=True))
        return counts

    def record(
        self,
        blocks: Blocks,
        accelerometers: list[str],
        radius: float,
        input_axes: Mapping[str, np.ndarray] | None,
    ) -> Record:
        """Check the signals as a whole and assemble the record."""
        angle = blocks.angle
        phase = self._nominal_rate * blocks.time if angle is None else angle
        signals: dict[str, np.ndarray] = {}
        for place, name in enumerate(accelerometers):
            spec = self._signals[place]
            signal = blocks.signals[place] * spec.factor
            if self.block > 1:
                signal = self._without_odd_blocks(blocks, place, signal)
            found = waves(phase, signal)
            change = change_of_unit(found)
            if change is not None:
                raise self._changed(place, blocks, phase, found, *change)
            if input_axes is not None and name in input_axes:
                axis = np.asarray(input_axes[name], dtype=float)
                wrong = against_reference(found, radius, axis, angle is not None)
                if wrong is not None:
                    raise RecordError(f"{self._file.path}: column '{spec.name}' {wrong}.")
            signals[name] = signal
        return Record(
            blocks.time,
            angle,
            signals,
            blocks.count,
            blocks.time_sd,
            self.start_time * self._specs[0].factor,
            self._report(blocks),
        )

    def _changed(
        self,
        place: int,
        blocks: Blocks,
        phase: np.ndarray,
        found: Waves,
        before: int,
        after: int,
        words: str,
    ) -> RecordError:
        """Say at which line of the file a signal changes its unit."""
        # Samples about the change were taken for outliers: look at the file again.
        ends = blocks.time[found.first[before]], blocks.time[found.last[after]]
        spec = self._signals[place]
        rows: list[np.ndarray] = []
        parts: list[Columns] = []
        row = 0
        for batch in self._file.batches():
            columns = self._in_si([batch[place] for place in self._places])
            inside = np.flatnonzero((columns[0] >= ends[0]) & (columns[0] <= ends[1]))
            if len(inside):
                signal = columns[len(columns) - len(self._signals) + place] * spec.factor
                parts.append([columns[0][inside], signal[inside]])
                rows.append(row + inside)
            row += len(batch[0])
        time, signal = joined(parts)
        angle = np.interp(time, blocks.time, phase)
        at = min(switch(found, before, after, angle, signal), len(time) - 1)
        return RecordError(
            f"{self._file.path}, {self._file.locate(int(np.concatenate(rows)[at]))}: column "
            f"'{spec.name}' changes its unit or its scale: {words}. "
            "Cut the record here or correct the column."
        )

    def _without_odd_blocks(self, blocks: Blocks, place: int, signal: np.ndarray) -> np.ndarray:
        """Leave out block means that stand off from their neighbours (a burst, a dead stretch)."""
        weight = np.sqrt(blocks.count / self.block)
        step = self._clock.step * self.block
        unevenness = float(np.abs(np.diff(blocks.time) / step - 1).max(initial=0.0))
        # The mean over a shorter piece of a wave's crest is another: such blocks are not compared.
        judged = np.where(blocks.count >= 0.9 * self.block, signal, np.nan)
        odd = find_spikes(blocks.time, judged, self._clock.rate, step, unevenness, weight)
        if len(odd):
            self._outliers[place] += int(blocks.count[odd].sum())
            signal = signal.copy()
            signal[odd] = np.nan
        return signal

    @staticmethod
    def _measured_rate(blocks: Blocks) -> float | None:
        if blocks.angle is None:
            return None
        return float((blocks.angle[-1] - blocks.angle[0]) / (blocks.time[-1] - blocks.time[0]))

    def _report(self, blocks: Blocks) -> RecordReport:
        found = self._clock.found
        outliers = dict(zip((s.name for s in self._signals), self._outliers, strict=True))
        listed = list(self._listed)
        if self._has_angle:
            name = self._specs[1].name
            outliers = {name: found.angle_outliers, **outliers}
            listed += [Outlier(name, row + 1, np.nan, np.nan) for row in found.outlier_rows]
        start = self.start_time * self._specs[0].factor
        return RecordReport(
            path=self._file.path,
            rows=self._rows,
            used=int(blocks.count.sum()),
            repeated=found.repeated,
            differing=found.differing,
            empty=self._empty_counts(),
            outliers=outliers,
            listed=tuple(listed),
            gaps=tuple(Gap(gap.time + start, gap.length) for gap in found.gaps),
            gap_count=found.gap_count,
            wrapped=found.wrapped,
            step=self._clock.step,
            rate=self._measured_rate(blocks),
            block=self.block,
        )
