"""Records: columns, nominal motion, the samples read, and the report on reading them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import RecordError, error_code
from counterspin.frozen import frozen
from counterspin.input import FileIdentity
from counterspin.records.dialect import AUTODETECT, Dialect
from counterspin.records.signals import FirstHarmonic
from counterspin.units import TEMPERATURE_SCALES, base_unit, is_same_unit, unit_factor

if TYPE_CHECKING:
    from counterspin.records.column_file import ColumnFile


@frozen
class Gap:
    """Missing rows: the time of the last row before them and the time to the next row, s."""

    time: float
    length: float


@frozen
class Outlier:
    """A sample that was left out.

    Its column, data row (from 1), time in the file's clock (s) and value (SI); NaN where the file
    says too little of it.
    """

    column: str
    row: int
    time: float
    value: float


@frozen
class RecordReport:
    """Report on reading a record."""

    path: Path  #: The file.
    #: Rows of the file, and rows that entered the record.
    rows: int
    used: int
    #: Rows that repeat the time of the row before (dropped), and those of them whose other columns
    #: differ from it.
    repeated: int
    differing: int
    #: Column name -> count of empty cells, and of outlying ones. A row without time or angle is
    #: dropped; a cell of a signal is left out of its block, or NaN in a record of points.
    empty: dict[str, int]
    outliers: dict[str, int]
    #: Rows that were left out because they stand alone, before the first or after the last gap.
    isolated: int
    listed: tuple[Outlier, ...]  #: The first outliers, at most 100 for each column.
    #: The first hundred stretches of missing rows, and how many there are.
    gaps: tuple[Gap, ...]
    gap_count: int
    wrapped: bool  #: Whether the angle was unwrapped.
    #: Usual spacing of the samples, s; rate of the recorded angle, rad/s (None without one).
    step: float
    rate: float | None
    block: int  #: Samples that a full block holds; 1 for point samples.
    format_description: str = ""  #: Description of an unusual file format.
    outside: int = 0  #: Rows outside the time range that is used.

    def counts(self, outliers: int = 0) -> dict[str, int]:
        """Return the number of rows of each kind; `outliers`: detected after reading."""
        return {
            "rows": self.rows,
            "repeated": self.repeated,
            "empty": sum(self.empty.values()),
            "outliers": outliers + sum(self.outliers.values()),
            "gaps": self.gap_count,
            "block": self.block,
        }

    def notes(self) -> list[str]:
        """Return one plain sentence for each thing found, for warnings and reports."""
        notes = []
        if self.format_description:
            notes.append(f"Detected file format: {self.format_description}.")
        if self.outside:
            notes.append(f"{self.outside} rows outside the selected part were omitted.")
        if self.repeated:
            text = f", {self.differing} of them with different values" if self.differing else ""
            notes.append(f"{self.repeated} repeated rows were dropped{text}.")
        for column, count in self.empty.items():
            if count:
                notes.append(f"{count} empty cells in column '{column}' were omitted.")
        for column, count in self.outliers.items():
            if count:
                notes.append(f"{count} outliers in column '{column}' were rejected.")
        if self.isolated:
            text = "1 row separated" if self.isolated == 1 else f"{self.isolated} rows separated"
            verb = "was" if self.isolated == 1 else "were"
            notes.append(f"{text} from the others by a gap {verb} omitted.")
        if self.gap_count:
            longest = max(gap.length for gap in self.gaps)
            text = "1 gap" if self.gap_count == 1 else f"{self.gap_count} gaps"
            notes.append(f"{text} in the record; the longest lasts {longest:.6g} s.")
        return notes


def rejected_count(counts: Mapping[str, int]) -> int:
    """Return the number of unused samples in `RecordReport.counts`."""
    return counts["repeated"] + counts["empty"] + counts["outliers"]


#: Content of a column; see `ColumnSpec`.
ColumnKind = Literal["numbers", "stamps", "rows", "pulses", "temperature"]


@frozen
class ColumnSpec:
    """A column of a record file, and how its numbers become SI."""

    name: str  #: The column.
    #: The numbers are multiplied with `factor`, and `offset` (SI) is added.
    factor: float = 1.0
    offset: float = 0.0
    #: The unit that is stated of it (None: the file's own is taken), and the SI unit wanted;
    #: without the latter, for example for a current, the unit in the file is not compared.
    unit: str | None = None
    target_unit: str = ""
    gravity: float | None = None  #: m/s^2, where g and m/s^2 are to be converted.
    #: ``numbers``; ``stamps`` in ISO 8601; ``rows``, which are counted where there is no such
    #: column, `factor` being the time from one to the next; or ``pulses``: times at which the
    #: spindle passed `offset`, `per_revolution` of them a revolution; or ``temperature``, whose
    #: unit adds to the numbers.
    kind: ColumnKind = "numbers"
    #: Of pulses; negative where they are counted against the run's sense.
    per_revolution: float = 1.0

    @property
    def in_g(self) -> bool:
        """True if the numbers depend on the assumed gravity: recorded in g, or as a current."""
        if self.target_unit:
            return self.unit is not None and base_unit(self.unit)[1]["[gravity]"] != 0.0
        return bool(self.name)

    def to_file_units(self, values: Array) -> Array:
        """Return values in SI, converted to the numbers of the column."""
        file_values: Array = (values - self.offset) / self.factor
        return file_values

    @property
    def is_derived_column(self) -> bool:
        """True if the column is derived and no row of the file contains it."""
        return self.kind in ("rows", "pulses")

    def resolve_unit(self, file: ColumnFile) -> ColumnSpec:
        """Return the column with the unit that the file states, or compare that with it."""
        if not self.target_unit or self.kind in ("stamps", "rows"):
            return self
        file_unit = file.units.get(self.name, "")
        location = f"{file.path}: column '{self.name}'"
        if self.unit is None:
            if not file_unit:
                raise RecordError(
                    f"{location} has no unit in the file; state the unit in the campaign.",
                    code="missing-unit",
                )
            if self.kind == "temperature" and file_unit in TEMPERATURE_SCALES:
                return replace(self, unit=file_unit).resolve_unit(file)
            try:
                factor = unit_factor(file_unit, self.target_unit, gravity=self.gravity)
            except ValueError as error:
                raise RecordError(
                    f"{location} is in '{file_unit}' according to the file: {error}.",
                    code=error_code(error),
                ) from None
            # Beside the unit there may be a sense, or a clock that is known to be fast.
            return replace(self, factor=factor * self.factor, unit=file_unit)
        is_same = file_unit == self.unit or is_same_unit(file_unit, self.unit, gravity=self.gravity)
        if file_unit and file.units_row and not is_same:
            raise RecordError(
                f"{location} is in '{file_unit}' according to the units row of the file, but in "
                f"'{self.unit}' according to the campaign.",
                code="unit-mismatch",
            )
        if self.kind == "temperature":
            return replace(self, offset=TEMPERATURE_SCALES[self.unit])
        return self


@frozen
class RecordColumns:
    """Roles of the columns of a file."""

    #: Time and spindle angle (wrapped or not), or no angle.
    time: ColumnSpec
    angle: ColumnSpec | None
    signals: Mapping[str, ColumnSpec]  #: By accelerometer.
    dialect: Dialect = AUTODETECT  #: How the file is written, as far as that is known.
    #: From where to where the record is used, s in its own time; of stamps, and of rows that are
    #: counted, from the first row.
    time_range: tuple[float, float] = (-math.inf, math.inf)
    continuation_files: tuple[Path, ...] = ()  #: Files in which the record goes on.
    pulses: Path | None = None  #: The file that has the times of pulses; None: the record itself.
    needs_angle: bool = True  #: Whether a file without the column of the angle is refused.

    def required(self, file: ColumnFile) -> RecordColumns:
        """Return the columns without an angle that a file does not have and that is not needed."""
        angle = self.angle
        if angle is None or self.needs_angle or self.pulses or file.has_column(angle.name):
            return self
        return replace(self, angle=None)

    def resolve_units(self, file: ColumnFile) -> RecordColumns:
        """Return the columns with the units that the file states; see `ColumnSpec.resolve_unit`."""
        return replace(
            self,
            time=self.time.resolve_unit(file),
            angle=self.angle and self.angle.resolve_unit(file),
            signals={name: spec.resolve_unit(file) for name, spec in self.signals.items()},
        )

    def with_derived_names(self) -> RecordColumns:
        """Return the columns as `RunFile` yields them, under names that no file has."""
        time, angle = self.time, self.angle
        if time.kind == "rows":
            time = replace(time, name="(time from row count)")
        if angle is not None and angle.kind == "pulses":
            angle = replace(angle, name="(angle between pulses)", factor=1.0)
        return replace(self, time=time, angle=angle)

    @property
    def timestamp_columns(self) -> frozenset[str]:
        """The columns of time stamps."""
        return frozenset([self.time.name] if self.time.kind == "stamps" else [])

    @property
    def names(self) -> list[str]:
        """The columns that are read row by row, each once, including derived columns."""
        specs = [self.time, *([self.angle] if self.angle else []), *self.signals.values()]
        return list(dict.fromkeys(spec.name for spec in specs))

    @property
    def file_columns(self) -> list[str]:
        """The columns that a file contains."""
        specs = [spec for spec in (self.time, self.angle) if spec and spec.is_derived_column]
        return [name for name in self.names if name not in [spec.name for spec in specs]]


@frozen
class NominalMotion:
    """The stated motion of a run, against which its record is checked."""

    rate: float  #: rad/s; negative turns from north to east; 0 at rest.
    #: Accelerometer -> the wave that the motion puts into its signal; those without are not checked
    #: against it.
    expected_harmonics: Mapping[str, FirstHarmonic] = field(default_factory=dict)
    #: Whether the signal is one level, as at rest or on an arm, beside which its waves are small.
    constant_input: bool = False
    #: Waves of the signal in a revolution; negative if the force turns against the spindle.
    waves: float = 1.0
    #: Whether it is moved between rests in an unknown way, so that no sample counts as an outlier.
    multi_pose: bool = False

    def signal_rate(self, rate: float) -> float:
        """Return the rate of the spindle or of the signal's waves, whichever is faster, rad/s."""
        return rate * max(1.0, abs(self.waves))

    def signal_phase(self, time: np.ndarray, angle: np.ndarray | None) -> np.ndarray:
        """Return the phase of the signal's waves at times, by the nominal rate without an angle."""
        return self.waves * (self.rate * time if angle is None else angle)


@frozen
class Record:
    """One run: point samples or block means, in SI units. Arrays (n,)."""

    time: np.ndarray  #: s since the first sample; of a block, the mean time of its samples.
    angle: np.ndarray | None  #: rad, unwrapped; None when the file has no angle column.
    #: Accelerometer -> displacement, velocity or specific force (m, m/s, m/s^2); NaN where that
    #: accelerometer has no good sample.
    signals: dict[str, np.ndarray]
    count: np.ndarray  #: Samples in each block; 1 is a point sample.
    time_sd: np.ndarray  #: s, standard deviation of the times inside each block; 0 for a point.
    start_time: float  #: s, the first sample's time in the file's own clock.
    report: RecordReport  #: What was found.
    identity: FileIdentity | None  #: Which file it was read from; None of a record in memory.
    #: Likewise of further files: those in which it goes on, and that of its pulses.
    other_files: Mapping[Path, FileIdentity] = field(default_factory=dict)
    #: Accelerometer -> parts of its whole column along 1, t and t^2, and of its end rows, over the
    #: noise of one row, shape (4,); NaN where nothing tells it. See `SignalSums.coefficients`.
    polynomials: Mapping[str, np.ndarray] = field(default_factory=dict)
    #: rad, standard deviation of the angles inside each block; NaN where `time_sd` tells it.
    angle_sd: np.ndarray | None = None
