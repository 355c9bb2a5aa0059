"""Records: columns, nominal motion, samples, and the report on their reading."""

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
    """A rejected sample.

    Column, data row (from 1), time on the file's time scale (s) and value (SI); NaN if unknown.
    """

    column: str
    row: int
    time: float
    value: float


@frozen
class RecordReport:
    """Report on reading a record."""

    path: Path  #: The file.
    #: Rows of the file, and rows used in the record.
    rows: int
    used: int
    #: Dropped rows that repeat the time of the preceding row, and those of them with different
    #: values.
    repeated: int
    differing: int
    #: Column -> number of empty cells, and of outliers. A row without time or angle is dropped; a
    #: cell of a signal is omitted from its block, or NaN in a record of single samples.
    empty: dict[str, int]
    outliers: dict[str, int]
    #: Omitted rows that are isolated before the first or after the last gap.
    isolated: int
    listed: tuple[Outlier, ...]  #: The first outliers, at most 100 for each column.
    #: The first hundred gaps, and the number of gaps.
    gaps: tuple[Gap, ...]
    n_gaps: int
    wrapped: bool  #: Whether the angle was unwrapped.
    #: Typical time step, s; rate of the recorded angle, rad/s (None without an angle).
    step: float
    rate: float | None
    block: int  #: Samples in a full block; 1 for single samples.
    format_description: str = ""  #: Description of an unusual file format.
    outside: int = 0  #: Rows outside the used time range.

    def counts(self, outliers: int = 0) -> dict[str, int]:
        """Return finding -> count; `outliers`: number of outliers detected after reading."""
        return {
            "rows": self.rows,
            "repeated": self.repeated,
            "empty": sum(self.empty.values()),
            "outliers": outliers + sum(self.outliers.values()),
            "gaps": self.n_gaps,
            "block": self.block,
        }

    def notes(self) -> list[str]:
        """Return one sentence for each finding, for warnings and reports."""
        notes = []
        if self.format_description:
            notes.append(f"Detected file format: {self.format_description}.")
        if self.outside:
            notes.append(
                _omission_note(self.outside, "row", " outside the selected part", "omitted")
            )
        if self.repeated:
            text = f", {self.differing} of them with different values" if self.differing else ""
            notes.append(_omission_note(self.repeated, "repeated row", "", f"dropped{text}"))
        for column, count in self.empty.items():
            if count:
                notes.append(
                    _omission_note(count, "empty cell", f" in column '{column}'", "omitted")
                )
        for column, count in self.outliers.items():
            if count:
                notes.append(_omission_note(count, "outlier", f" in column '{column}'", "rejected"))
        if self.isolated:
            location = " separated from the other rows by a gap"
            notes.append(_omission_note(self.isolated, "row", location, "omitted"))
        if self.n_gaps:
            longest = max(gap.length for gap in self.gaps)
            text = "1 gap" if self.n_gaps == 1 else f"{self.n_gaps} gaps"
            notes.append(f"{text} in the record; the longest lasts {longest:.6g} s.")
        return notes


def _omission_note(count: int, noun: str, location: str, participle: str) -> str:
    """Return a sentence such as "2 outliers in column 'a' were rejected."."""
    subject, verb = (noun, "was") if count == 1 else (f"{noun}s", "were")
    return f"{count} {subject}{location} {verb} {participle}."


def rejected_count(counts: Mapping[str, int]) -> int:
    """Return the number of unused samples in `RecordReport.counts`."""
    return counts["repeated"] + counts["empty"] + counts["outliers"]


#: Content of a column; see `ColumnSpec`.
ColumnKind = Literal["numbers", "stamps", "rows", "pulses", "temperature"]


@frozen
class ColumnSpec:
    """A column of a record file, and its conversion to SI."""

    name: str  #: Name of the column.
    #: The numbers are multiplied by `factor`, and `offset` (SI) is added.
    factor: float = 1.0
    offset: float = 0.0
    #: Stated unit (None: that in the file), and SI unit; without the latter, such as for a current,
    #: the unit in the file is not compared.
    unit: str | None = None
    target_unit: str = ""
    gravity: float | None = None  #: Gravity to convert between g and m/s^2, m/s^2.
    #: ``numbers``; ``stamps``: time stamps in ISO 8601; ``rows``: row count, with the time step
    #: `factor`; ``pulses``: times at which the spindle passed `offset`, `per_revolution` times a
    #: revolution; ``temperature``: with a temperature unit.
    kind: ColumnKind = "numbers"
    per_revolution: float = 1.0  #: Pulses per revolution.

    @property
    def in_g(self) -> bool:
        """True if the SI values depend on gravity: recorded in g, or as a current."""
        if self.target_unit:
            return self.unit is not None and base_unit(self.unit)[1]["[gravity]"] != 0.0
        return bool(self.name)

    def to_file_units(self, values: Array) -> Array:
        """Convert values in SI to the numbers of the column."""
        file_values: Array = (values - self.offset) / self.factor
        return file_values

    @property
    def is_derived_column(self) -> bool:
        """True if the column is derived and not in the file."""
        return self.kind in ("rows", "pulses")

    def resolve_unit(self, file: ColumnFile) -> ColumnSpec:
        """Return the column with the unit in the file, which must agree with a stated unit."""
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
            # `factor` may already contain a sense, or the error of a clock.
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

    time: ColumnSpec  #: Column of the time.
    angle: ColumnSpec | None  #: Column of the spindle angle (wrapped or not); or None.
    signals: Mapping[str, ColumnSpec]  #: Accelerometer -> column.
    dialect: Dialect = AUTODETECT  #: Stated format of the file.
    #: Start and end of the used part, s on the record's time scale; for time stamps and counted
    #: rows, from the first row.
    time_range: tuple[float, float] = (-math.inf, math.inf)
    continuation_files: tuple[Path, ...] = ()  #: Files in which the record continues.
    pulses: Path | None = None  #: File with the times of pulses; None: the record itself.
    needs_angle: bool = True  #: Whether a missing column of the angle is an error.

    def drop_missing_angle(self, file: ColumnFile) -> RecordColumns:
        """Return the columns without the angle, if it is missing in a file and not needed."""
        angle = self.angle
        if angle is None or self.needs_angle or self.pulses or file.has_column(angle.name):
            return self
        return replace(self, angle=None)

    def resolve_units(self, file: ColumnFile) -> RecordColumns:
        """Return the columns with the units in the file; see `ColumnSpec.resolve_unit`."""
        return replace(
            self,
            time=self.time.resolve_unit(file),
            angle=self.angle and self.angle.resolve_unit(file),
            signals={name: spec.resolve_unit(file) for name, spec in self.signals.items()},
        )

    def rename_derived_columns(self) -> RecordColumns:
        """Return the columns with names for derived columns, as `RunFile` yields them."""
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
        """The names of all columns, each once, including derived columns."""
        specs = [self.time, *([self.angle] if self.angle else []), *self.signals.values()]
        return list(dict.fromkeys(spec.name for spec in specs))

    @property
    def file_columns(self) -> list[str]:
        """The columns that a file contains."""
        specs = [spec for spec in (self.time, self.angle) if spec and spec.is_derived_column]
        return [name for name in self.names if name not in [spec.name for spec in specs]]


@frozen
class NominalMotion:
    """The stated motion of a run, with which its record is compared."""

    rate: float  #: Rate, rad/s; negative for rotation from north to east; 0 at rest.
    #: Accelerometer -> expected first harmonic of its signal; others are not checked.
    expected_harmonics: Mapping[str, FirstHarmonic] = field(default_factory=dict)
    #: Whether the input is constant, as at rest or on an arm, with small harmonics.
    has_constant_input: bool = False
    #: Periods of the signal per revolution; negative if the force rotates against the spindle.
    waves: float = 1.0
    #: Whether the sensor is moved between poses, so that no sample is an outlier.
    is_multi_pose: bool = False

    def signal_rate(self, rate: float) -> float:
        """Return the rate of the spindle or of the signal, whichever is larger, rad/s."""
        return rate * max(1.0, abs(self.waves))

    def signal_phase(self, time: np.ndarray, angle: np.ndarray | None) -> np.ndarray:
        """Return the phase of the signal, rad, from the angle or else from the nominal rate."""
        return self.waves * (self.rate * time if angle is None else angle)


@frozen
class Record:
    """The record of a run: single samples or block means in SI units, arrays (n,)."""

    time: np.ndarray  #: Time since the first sample, s; mean time for a block.
    angle: np.ndarray | None  #: Unwrapped angle, rad; None without an angle column.
    #: Accelerometer -> displacement, velocity or specific force (m, m/s, m/s^2); NaN without valid
    #: samples.
    signals: dict[str, np.ndarray]
    count: np.ndarray  #: Samples in each block; 1 for a single sample.
    time_sd: np.ndarray  #: Standard deviation of the times in each block, s; 0 for a single sample.
    start_time: float  #: Time of the first sample on the file's time scale, s.
    report: RecordReport  #: Findings.
    identity: FileIdentity | None  #: Identity of the file; None for a record in memory.
    #: Identities of further files: continuations, and the file of the pulses.
    other_files: Mapping[Path, FileIdentity] = field(default_factory=dict)
    #: Accelerometer -> coefficients of its whole column along 1, t and t^2, and size of its ends,
    #: divided by the noise of one row, shape (4,); NaN: unknown. See `SignalSums.coefficients`.
    polynomials: Mapping[str, np.ndarray] = field(default_factory=dict)
    #: Standard deviation of the angles in each block, rad; NaN if it follows from `time_sd`.
    angle_sd: np.ndarray | None = None
