"""Columns of files: the tables of ``campaign.toml`` that name them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from counterspin.campaign.field_types import (
    TIME_STAMP_UNIT,
    Fraction,
    PositiveRatio,
    SettingsSection,
    Text,
    ZeroDirection,
    check_angle_unit,
    check_clock_error,
    check_encoding,
    check_output_unit,
    check_positive,
    check_temperature_unit,
    check_time_unit,
    convertible_unit,
    exact_quantity,
    key_field,
    uncertain_quantity,
)
from counterspin.campaign.quantity import Quantity
from counterspin.errors import InputError
from counterspin.frozen import frozen
from counterspin.records.dialect import AUTODETECT, Dialect
from counterspin.records.record import ColumnSpec
from counterspin.units import is_convertible, unit_factor


@frozen
class Recording:
    """Columns, format and recorder of a record."""

    time: ColumnSpec
    angle: ColumnSpec | None
    dialect: Dialect = AUTODETECT
    temperature: ColumnSpec | None = None  #: Accelerometer temperature; None: not recorded.
    recorder: str = ""  #: Name of the recorder; empty: the default recorder.
    clock: Quantity | None = None  #: Relative rate error of the clock; None: not stated.


class _Channel(SettingsSection):
    column: Text = key_field("name of the column in the file", "channel 1")


def make_column_spec(column: Any, target_unit: str, gravity: float | None = None) -> ColumnSpec:
    """Return the specification of a column, with its factor to the target unit.

    column: Settings with `column` and `unit`.
    gravity: Gravity of the site, m/s^2, for columns that may be in g.
    """
    factor = unit_factor(column.unit, target_unit, gravity=gravity) if column.unit else 1.0
    return ColumnSpec(column.column, factor, 0.0, column.unit, target_unit, gravity)


class TimeChannel(SettingsSection):
    """``time``: column of the time, or the sampling rate."""

    column: Text | None = key_field(
        "name of the column in the file", "time_s", None, absent="counted from zero"
    )
    unit: Annotated[str, AfterValidator(check_time_unit)] | None = key_field(
        "unit of the column; `iso` for time stamps, which are converted to seconds since the "
        "first time stamp",
        "ms",
        None,
        absent="the unit in the file",
        kind="unit of time, `iso`",
    )
    sampling_rate: Annotated[float, exact_quantity("Hz"), AfterValidator(check_positive)] | None = (
        key_field("number of rows per second, instead of a time column", "50 Hz", None)
    )

    @model_validator(mode="after")
    def _check_column_or_rate(self) -> Self:
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
        """Specification of the column, s."""
        if self.column is None:
            sample_interval = 1.0 / self.sampling_rate if self.sampling_rate else math.nan
            return ColumnSpec("", sample_interval, unit="s", target_unit="s", kind="rows")
        if self.unit == TIME_STAMP_UNIT:
            return ColumnSpec(self.column, unit=TIME_STAMP_UNIT, target_unit="s", kind="stamps")
        return make_column_spec(self, "s")


#: Sense of rotation, seen from above.
Sense = Literal["counterclockwise", "clockwise"]


class AngleChannel(_Channel):
    """``angle``: column of the spindle angle, or of the times of index pulses."""

    pulses: bool = key_field(
        "whether the column contains the times (in `unit`) at which the arm passed `zero`",
        False,
        False,
    )
    unit: Annotated[str, AfterValidator(check_angle_unit)] | None = key_field(
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
    def _check_counts(self) -> Self:
        is_counted = self.unit is not None and is_convertible(self.unit, "count")
        if is_counted and self.per_revolution is None:
            raise InputError(
                "counts require per_revolution, the number of counts per revolution", "missing-key"
            )
        if self.per_revolution is not None and not (is_counted or self.pulses):
            raise InputError(
                'per_revolution applies only to pulses and to unit = "count"', "conflicting-keys"
            )
        return self

    @property
    def spec(self) -> ColumnSpec:
        """Specification of the column, rad; for pulses, of their times in s."""
        if self.pulses:
            pulse_spec = make_column_spec(self, "s")
            pulses_per_revolution = self.per_revolution or 1.0
            return replace(
                pulse_spec, offset=self.zero, kind="pulses", per_revolution=pulses_per_revolution
            )
        sign = -1.0 if self.sense == "clockwise" else 1.0
        if self.per_revolution is None:
            angle = make_column_spec(self, "rad")
            return replace(angle, factor=sign * angle.factor, offset=self.zero)
        count_spec = make_column_spec(self, "count")
        factor = sign * count_spec.factor * 2.0 * math.pi / self.per_revolution
        return replace(count_spec, factor=factor, offset=self.zero, target_unit="")


class TemperatureChannel(_Channel):
    """``temperature``: column of the accelerometer temperature."""

    unit: Annotated[str, AfterValidator(check_temperature_unit)] | None = key_field(
        "unit of the column", "degC", None, absent="the unit in the file", kind="`degC`, `K`"
    )

    @property
    def spec(self) -> ColumnSpec:
        """Specification of the column, K."""
        return ColumnSpec(self.column, unit=self.unit, target_unit="K", kind="temperature")


class RowSelection(SettingsSection):
    """``select``: rows to read, selected by the value of a column."""

    column: Text = key_field("column that identifies the sensor", "device")
    value: Text = key_field("value of this column in the rows to read", "A")


class TableDialect(SettingsSection):
    """Format of a table of records or readings, as far as it is stated."""

    skip_lines: Annotated[int, Field(ge=0)] | None = key_field(
        "number of lines (or sheet rows) before the column names", 5, None, absent="detected"
    )
    delimiter: Literal[",", ";", "\t"] | None = key_field(
        "cell delimiter of a text file", ";", None, absent="detected", kind="`,` `;` or tab"
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
        "whether a row of units follows the column names", True, None, absent="detected"
    )
    skip_footer: Annotated[int, Field(ge=0)] | None = key_field(
        "number of lines (or sheet rows) after the data at the end of the file, such as a mean or "
        "a signature",
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
        """The stated format, as used by the readers of files."""
        field_names = Dialect.__dataclass_fields__
        options = {key: getattr(self, key) for key in field_names if hasattr(self, key)}
        if self.select is not None:
            options["select"] = (self.select.column, self.select.value)
        return Dialect(**options)


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
        kind="number ± or value ± in ppm",
    )
    cutoff_frequency: (
        Annotated[Quantity, uncertain_quantity("Hz"), AfterValidator(check_positive)] | None
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
        """The default recording of the runs."""
        clock_ratio = 1.0 if self.clock is None else 1.0 + self.clock.value
        time, angle = self.time.spec, None if self.angle is None else self.angle.spec
        if angle is not None and angle.kind == "pulses":
            angle = replace(angle, factor=angle.factor / clock_ratio)
        time = replace(time, factor=time.factor / clock_ratio)
        temperature = None if self.temperature is None else self.temperature.spec
        return Recording(time, angle, self.dialect, temperature, self.recorder or "", self.clock)


class DisplacementChannel(_Channel):
    """``displacement``: column of the displacement along the input axis."""

    unit: Annotated[str, convertible_unit("m")] | None = key_field(
        "unit of the column", "mm", None, absent="the unit in the file", kind="unit"
    )


class VelocityChannel(_Channel):
    """``velocity``: column of the velocity along the input axis."""

    unit: Annotated[str, convertible_unit("m/s")] | None = key_field(
        "unit of the column", "mm/s", None, absent="the unit in the file", kind="unit"
    )


class ForceChannel(_Channel):
    """``specific_force``: column of the specific force, or of an output such as a current."""

    unit: Annotated[str, AfterValidator(check_output_unit)] = key_field(
        "unit of the column", "mg", kind="unit"
    )
