"""Columns of files: the tables of ``campaign.toml`` that name them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from counterspin.campaign.field_types import (
    STAMPS,
    Fraction,
    PositiveRatio,
    SettingsSection,
    Text,
    ZeroDirection,
    angle_unit,
    check_clock_error,
    check_encoding,
    force_or_output,
    is_unit,
    key_field,
    positive,
    read_exactly,
    temperature_scale,
    time_unit,
    uncertain_quantity,
    unit_of,
)
from counterspin.campaign.quantity import Quantity
from counterspin.errors import InputError
from counterspin.frozen import frozen
from counterspin.records.dialect import AUTODETECT, Dialect
from counterspin.records.record import ColumnSpec
from counterspin.units import unit_factor


@frozen
class Recording:
    """How a record is read: its time, its angle (or None), and how its file is written."""

    time: ColumnSpec
    angle: ColumnSpec | None
    dialect: Dialect = AUTODETECT
    temperature: ColumnSpec | None = None  #: Of the accelerometers; None: not recorded.
    recorder: str = ""  #: Whose clock it has; empty: that of all runs that name no other.
    clock: Quantity | None = None  #: By how much of itself that is fast; None: not stated.


class _Channel(SettingsSection):
    column: Text = key_field("name of the column in the file", "channel 1")


def spec_of(column: Any, wanted: str, gravity: float | None = None) -> ColumnSpec:
    """Return the column that a table with `column` and `unit` names, in an SI unit.

    gravity: The site's, m/s^2, of what may be recorded in g.
    """
    factor = unit_factor(column.unit, wanted, gravity=gravity) if column.unit else 1.0
    return ColumnSpec(column.column, factor, 0.0, column.unit, wanted, gravity)


class TimeChannel(SettingsSection):
    """``time``: the column that holds it, or how many rows there are a second."""

    column: Text | None = key_field(
        "name of the column in the file", "time_s", None, absent="counted from zero"
    )
    unit: Annotated[str, AfterValidator(time_unit)] | None = key_field(
        "unit of the column; `iso` for time stamps, which are converted to seconds since the "
        "first time stamp",
        "ms",
        None,
        absent="the unit in the file",
        kind="unit of time, `iso`",
    )
    sampling_rate: Annotated[float, read_exactly("Hz"), AfterValidator(positive)] | None = (
        key_field("number of rows per second, instead of a time column", "50 Hz", None)
    )

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        if (self.column is None) == (self.sampling_rate is None):
            raise InputError("give a column or a sampling_rate", "missing-key")
        if self.unit is not None and self.column is None:
            raise InputError(
                "a unit applies only to a column; remove the unit, or replace sampling_rate with "
                "a column",
                "conflicting-keys",
            )
        return self

    @property
    def spec(self) -> ColumnSpec:
        """The column, s."""
        if self.column is None:
            step = 1.0 / self.sampling_rate if self.sampling_rate else math.nan
            return ColumnSpec("", step, unit="s", target_unit="s", kind="rows")
        if self.unit == STAMPS:
            return ColumnSpec(self.column, unit=STAMPS, target_unit="s", kind="stamps")
        return spec_of(self, "s")


#: In which sense something counts, seen from above.
Sense = Literal["counterclockwise", "clockwise"]


class AngleChannel(_Channel):
    """``angle``: the column that holds the spindle's angle, or the times of its pulses."""

    pulses: bool = key_field(
        "whether the column contains the times, in `unit`, at which the arm passed `zero`",
        False,
        False,
    )
    unit: Annotated[str, AfterValidator(angle_unit)] | None = key_field(
        "unit of the column",
        "count",
        None,
        absent="the unit in the file",
        kind="unit of angle, `count`",
    )
    sense: Sense = key_field(
        "sense of rotation in which the encoder angle increases, seen from above",
        "clockwise",
        "counterclockwise",
    )
    zero: ZeroDirection = key_field(
        "direction of the arm when the encoder reads zero",
        "north",
        0.0,
        absent="0 (east)",
        kind="compass direction, or angle from east towards north",
    )
    per_revolution: PositiveRatio | None = key_field(
        "counts (or pulses) per revolution", 65536, None
    )

    @model_validator(mode="after")
    def _counts(self) -> Self:
        counted = self.unit is not None and is_unit(self.unit, "count")
        if counted and self.per_revolution is None:
            raise InputError(
                "counts need per_revolution, the number of counts per revolution", "missing-key"
            )
        if self.per_revolution is not None and not (counted or self.pulses):
            raise InputError(
                'per_revolution belongs to pulses, or to unit = "count"', "conflicting-keys"
            )
        return self

    @property
    def spec(self) -> ColumnSpec:
        """The column, rad; of pulses, their times in s."""
        if self.pulses:
            turn, pulses = self.per_revolution or 1.0, spec_of(self, "s")
            return replace(pulses, offset=self.zero, kind="pulses", per_revolution=turn)
        sense = -1.0 if self.sense == "clockwise" else 1.0
        if self.per_revolution is None:
            angle = spec_of(self, "rad")
            return replace(angle, factor=sense * angle.factor, offset=self.zero)
        counts = spec_of(self, "count")
        factor = sense * counts.factor * 2.0 * math.pi / self.per_revolution
        return replace(counts, factor=factor, offset=self.zero, target_unit="")


class TemperatureChannel(_Channel):
    """The column that holds the temperature of the accelerometers."""

    unit: Annotated[str, AfterValidator(temperature_scale)] | None = key_field(
        "unit of the column", "degC", None, absent="the unit in the file", kind="`degC`, `K`"
    )

    @property
    def spec(self) -> ColumnSpec:
        """The column, K."""
        return ColumnSpec(self.column, unit=self.unit, target_unit="K", kind="temperature")


class RowSelection(SettingsSection):
    """Rows of a file that are read: those in which a column has a value."""

    column: Text = key_field("column that identifies the sensor", "device")
    value: Text = key_field("value of this column in the rows to read", "A")


class TableDialect(SettingsSection):
    """How a table is written, as far as a person says it: of records and of readings alike."""

    skip_lines: Annotated[int, Field(ge=0)] | None = key_field(
        "number of lines (or sheet rows) before the column names", 5, None, absent="detected"
    )
    delimiter: Literal[",", ";", "\t"] | None = key_field(
        "cell delimiter of a text file",
        ";",
        None,
        absent="detected",
        kind="`,` `;` or tab",
    )
    decimal: Literal[".", ","] | None = key_field(
        "decimal separator; required for a readings table with decimal commas",
        ",",
        None,
        absent="detected",
        kind="`.` or `,`",
    )
    encoding: Annotated[str, AfterValidator(check_encoding)] | None = key_field(
        "encoding of a text file", "latin-1", None, absent="detected"
    )
    units_row: bool | None = key_field(
        "whether a units row follows the column names", True, None, absent="detected"
    )
    skip_footer: Annotated[int, Field(ge=0)] | None = key_field(
        "number of lines (or sheet rows) at the end of the file that are not data, such as a "
        "mean or a signature",
        2,
        None,
        absent="none",
    )
    select: RowSelection | None = key_field(
        "rows to read from a file with several sensors, selected by the value of a column",
        {"column": "device", "value": "A"},
        None,
        absent="all",
    )
    sheet: Text | None = key_field("sheet of an Excel file", "Run 1", None, absent="the only one")

    @property
    def dialect(self) -> Dialect:
        """The same, as files are read."""
        keys = Dialect.__dataclass_fields__
        stated = {key: getattr(self, key) for key in keys if hasattr(self, key)}
        if self.select is not None:
            stated["select"] = (self.select.column, self.select.value)
        return Dialect(**stated)


class _TimeAndAngle(SettingsSection):
    time: TimeChannel = key_field("time of each row", {"column": "time_s", "unit": "s"})
    angle: AngleChannel | None = key_field(
        "spindle angle, wrapped or unwrapped",
        {"column": "angle_rad", "unit": "rad"},
        None,
        absent="nominal rate",
    )
    temperature: TemperatureChannel | None = key_field(
        "temperature of the accelerometers, for temperature slopes; at most a quarter of the "
        "cells in this column may be empty",
        {"column": "T", "unit": "degC"},
        None,
        absent="the temperature of each run",
    )


# The fields of the last base come first.
class RecordsSettings(TableDialect, _TimeAndAngle):
    """[records]: format of the record files."""

    group: Text | None = key_field(
        "group of an HDF5 or TDMS file, or structure of a MATLAB file, that contains the columns",
        "run1/data",
        None,
        absent="the only one",
    )
    timing_offset: Annotated[Quantity, uncertain_quantity("s")] | None = key_field(
        "angle delay: sampling time of the angle minus sampling time of the displacement "
        "in the same row",
        "0 ± 1e-5 s",
        None,
    )
    clock: Annotated[Fraction, AfterValidator(check_clock_error)] | None = key_field(
        "relative rate error of the recorder's clock; positive if the clock runs fast; see below",
        "0 ± 1e-7",
        None,
        kind="number ±, or in ppm",
    )
    cutoff_frequency: (
        Annotated[Quantity, uncertain_quantity("Hz"), AfterValidator(positive)] | None
    ) = key_field(
        "cutoff frequency (-3 dB) of the recorder's first-order low-pass filter; see "
        "[frequency response](#frequency-response)",
        "100 ± 5 Hz",
        None,
        absent="no filter",
    )
    recorder: Text | None = key_field(
        "name of the recorder, if there are several recorders; each recorder has a separate clock "
        "error",
        "B",
        None,
        absent="one for all",
    )
    reference: Literal["platform", "own velocity"] = key_field(
        "velocity from which the navigation computer calculates the Coriolis acceleration that it "
        "removes; see below",
        "own velocity",
        "platform",
    )

    @property
    def recording(self) -> Recording:
        """The recording of every run whose run states no other."""
        fast = 1.0 if self.clock is None else 1.0 + self.clock.value
        time, angle = self.time.spec, None if self.angle is None else self.angle.spec
        if angle is not None and angle.kind == "pulses":
            angle = replace(angle, factor=angle.factor / fast)
        time = replace(time, factor=time.factor / fast)
        warm = None if self.temperature is None else self.temperature.spec
        return Recording(time, angle, self.dialect, warm, self.recorder or "", self.clock)


class DisplacementChannel(_Channel):
    """``displacement``: the column that holds that along the input axis."""

    unit: Annotated[str, unit_of("m")] | None = key_field(
        "unit of the column", "mm", None, absent="the unit in the file", kind="unit"
    )


class VelocityChannel(_Channel):
    """``velocity``: the column that holds that along the input axis."""

    unit: Annotated[str, unit_of("m/s")] | None = key_field(
        "unit of the column", "mm/s", None, absent="the unit in the file", kind="unit"
    )


class ForceChannel(_Channel):
    """``specific_force``: the column that holds it, or an output such as a current."""

    unit: Annotated[str, AfterValidator(force_or_output)] = key_field(
        "unit of the column", "mg", kind="unit"
    )
