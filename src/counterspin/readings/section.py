"""Section [readings]: keys of a table of readings."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import AfterValidator

from counterspin.campaign.columns import Sense, TableDialect
from counterspin.campaign.field_types import (
    SettingsSection,
    Text,
    check_axis,
    check_file_name,
    key_field,
)
from counterspin.campaign.runs import ReadingAxes
from counterspin.physics.conditions import STATED_CONDITIONS
from counterspin.physics.terms import MotionKind
from counterspin.records.format_registry import RECORD_FORMATS

#: Name of a column, or names of the columns with the repeats of one reading.
_ColumnNames = str | list[str]

#: File endings of tables of readings.
TABLE_ENDINGS: Final = tuple(e for e, form in RECORD_FORMATS.items() if form.holds_readings)

#: Columns of a table in addition to those of the readings.
COLUMNS: Final = (
    "name",
    "motion",
    "rate",
    "u_rate",
    "amplitude",
    "u_amplitude",
    "bias_acceleration",
    "attitude",
    "head",
    "input",
    "pendulous",
    *STATED_CONDITIONS,
    "mounting",
    "sense",
)


class _TableFile(SettingsSection):
    file: Annotated[Text, AfterValidator(check_file_name)] = key_field(
        f"name of the file ({', '.join(TABLE_ENDINGS)}); .xlsx requires the "
        "`excel` [extra](quickstart.md#extras)",
        "readings.csv",
    )


# The fields of the last base come first.
class MountingSettings(ReadingAxes):
    """[readings.mountings.NAME]: axes of a mounting, and the column of its readings."""

    reading: Text | None = key_field(
        "column with the readings of the mounting, if each mounting has a separate column",
        "inward_mA",
        None,
    )
    u: Text | None = key_field("column with the uncertainties of the readings", "u_inward_mA", None)


class ReadingsSettings(TableDialect, _TableFile):
    """[readings]: a table of readings, in place of many [[runs]]."""

    columns: dict[str, _ColumnNames | dict[str, _ColumnNames]] = key_field(
        f"column names, by key: `reading`, `u`, {', '.join(f'`{key}`' for key in COLUMNS)}",
        {"attitude": "angle_deg", "reading": "mA"},
        min_length=1,
    )
    u: Text | None = key_field(
        "standard uncertainty of readings without an entry in the column `u`",
        "2 uA",
        None,
        absent="estimated",
    )
    motion: MotionKind = key_field(
        "motion of every row, if no column specifies the motion", "arm", "static"
    )
    about: Annotated[Text, AfterValidator(check_axis)] = key_field(
        "axis of the angles in the column `attitude`", "east", "north"
    )
    attitude_unit: Text = key_field(
        "unit of the angles in the columns `attitude` and `head`", "arcmin", "deg"
    )
    u_attitude: Text | None = key_field(
        'random standard uncertainty of the angles in the column `attitude`, such as `"2 arcsec"`',
        "2 arcsec",
        None,
        absent="0",
    )
    rate_unit: Text = key_field(
        "unit of the column `rate`; `1/min` and `Hz` count revolutions. The column may also "
        "contain the period of revolution (`s`), or the acceleration (`g`, `m/s^2`) at the radius "
        "of `[centrifuge]`",
        "rpm",
        "rad/s",
    )
    u_rate: Text | None = key_field(
        "random standard uncertainty of rates without an entry in the column `u_rate` (unit: "
        "`rate_unit`)",
        "1e-5 rad/s",
        None,
        absent="the default",
    )
    amplitude_unit: Text = key_field(
        "unit of the columns `amplitude`, `u_amplitude` and `bias_acceleration`", "m/s^2", "g"
    )
    sense: Sense = key_field(
        "sense of rotation at a positive rate, seen from above, for rows without an "
        "entry in the column `sense`",
        "clockwise",
        "counterclockwise",
    )
    axes: ReadingAxes | None = key_field(
        "axes of rotating rows", {"input": "inward", "pendulous": "up"}, None, absent="`attitude`"
    )
    axes_at_rest: ReadingAxes | None = key_field(
        "directions of the axes for rows at rest",
        {"input": "up", "pendulous": "outward"},
        None,
        absent="`axes`",
    )
    mounting: str = key_field("mounting of every row", "in", "")
    merged: bool = key_field(
        "whether an empty cell of the column `mounting` repeats the cell above, as "
        "in a spreadsheet with merged cells",
        True,
        False,
    )
    mountings: dict[str, MountingSettings] = key_field(
        "directions of the axes for each mounting, in place of `axes`; also the column `reading` "
        "of each mounting, if each mounting has a separate column",
        {"in": {"input": "inward", "pendulous": "up"}},
        {},
    )
    attitude: Literal["unknown"] | None = key_field(
        "set to `unknown` if every row is a pose of a [triad](triads.md)",
        "unknown",
        None,
        absent="known",
    )
