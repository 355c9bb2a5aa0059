"""Sections of ``PLAN.toml`` in addition to those that it shares with ``campaign.toml``.

A plan has no [[runs]], which it makes, and may go without [records]; it has [limits] and [goal].
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BeforeValidator, Field, PlainValidator

from counterspin.campaign.columns import RecordsSettings
from counterspin.campaign.field_types import (
    PositiveRatio,
    Schema,
    Seconds,
    SettingsSection,
    Text,
    check_axis,
    check_positive,
    exact_quantity,
    key_field,
    require_units,
)
from counterspin.campaign.quantity import read_attitude_matrix
from counterspin.campaign.resolution import Accelerometers, Runs
from counterspin.campaign.settings import (
    CampaignSettings,
    CentrifugeSettings,
    FixtureSettings,
    ModelSettings,
    NoiseSettings,
    SiteSettings,
)
from counterspin.campaign.truth import TruthSettings
from counterspin.campaign.validation import Section
from counterspin.errors import OutOfRangeError
from counterspin.readings.entries import MAX_READINGS, MAX_RECORDS
from counterspin.readings.section import ReadingsSettings
from counterspin.triads.section import TriadSettings

#: Most attitudes among which is searched, which takes seconds, not minutes.
MAX_ATTITUDES: Final = 24


def _check_not_negative(value: float) -> float:
    if value < 0.0:
        raise OutOfRangeError("must not be negative")
    return value


def _check_positive_count(value: float) -> float:
    # The functions of the angle are hardly separable within less than a revolution.
    if value < 1.0:
        raise OutOfRangeError("must be at least one revolution")
    return value


Rate = Annotated[float, exact_quantity("rad/s"), AfterValidator(check_positive)]
SpinUp = Annotated[float, exact_quantity("rad/s^2"), AfterValidator(check_positive)]
Force = Annotated[float, exact_quantity("g"), AfterValidator(check_positive)]
Duration = Annotated[float, exact_quantity("s"), AfterValidator(_check_not_negative)]


def _parse_attitude(value: object) -> object:
    read_attitude_matrix(value)
    return value


class LimitsSettings(SettingsSection):
    """[limits]: limits of the machine and the laboratory."""

    total_time: Seconds = key_field(
        "total time of records, spin-up, settling and changes of attitude", "700 s"
    )
    highest_rate: Rate | None = key_field(
        "highest rate (magnitude)", "2 rad/s", None, absent="from `specific_force` or `rates`"
    )
    lowest_rate: Rate | None = key_field(
        "lowest rate (magnitude)", "0.5 rad/s", None, absent="highest / 8"
    )
    rates: Annotated[list[Rate], Field(min_length=1, max_length=MAX_RECORDS)] | None = key_field(
        "list of the available rates",
        ["0.25 rev/s", "0.5 rev/s"],
        None,
        absent="any rate between the lowest and the highest rate",
    )
    specific_force: Force | None = key_field(
        "highest centripetal acceleration, in g",
        "1 g",
        None,
        absent="centripetal acceleration at the highest rate",
    )
    senses: Literal["one", "both"] = key_field("sense of rotation", "both", "one")
    settling: Duration = key_field("settling time before each record", "10 s", 0.0, absent="0 s")
    spin_up: SpinUp | None = key_field(
        "angular acceleration; counterspin adds rate / acceleration to the time of each run",
        "0.1 rad/s^2",
        None,
        absent="no time",
    )
    spin_down: SpinUp | None = key_field(
        "angular deceleration; counterspin adds rate / deceleration to the time of each run",
        "0.1 rad/s^2",
        None,
        absent="no time",
    )
    fewest_revolutions: Annotated[PositiveRatio, AfterValidator(_check_positive_count)] = key_field(
        "minimum number of revolutions of a run, at least 1", 10, 5.0
    )
    longest_run: Seconds | None = key_field(
        "maximum duration of a record", "400 s", None, absent="the total time"
    )
    runs: Annotated[int, Field(le=MAX_RECORDS), AfterValidator(check_positive)] = key_field(
        "maximum number of runs (at most 60)", 14, 8
    )
    fewest_rates: Annotated[int, AfterValidator(check_positive)] | None = key_field(
        "minimum number of different rates, each at least 1.25 times the next lower rate; "
        "rates in the list `rates` need only be different",
        3,
        None,
        absent="2, or 1 if the other limits do not allow two rates",
    )
    attitudes: list[Annotated[Any, PlainValidator(_parse_attitude)]] = key_field(
        "list of allowed attitudes, written as in `campaign.toml`",
        ["level", "90 deg about east"],
        absent="level only",
        default_factory=lambda: ["level"],
        min_length=1,
        max_length=MAX_ATTITUDES,
    )
    attitude_change: Duration = key_field(
        "time for each change of attitude", "5 min", 0.0, absent="0 s"
    )
    sampling_rate: Annotated[float, exact_quantity("Hz"), AfterValidator(check_positive)] = (
        key_field("sampling rate of the records", "100 Hz", 50.0, absent="50 Hz")
    )


class StationsSettings(SettingsSection):
    """[[stations]]: candidate readings, one for each position or rate."""

    name: str = key_field("prefix of the name of each reading", "tumble", "")
    motion: Literal["counter-rotating", "arm", "static"] = key_field(
        "motion of the instrument", "arm", "static"
    )
    positions: Annotated[int, Field(le=3600), AfterValidator(check_positive)] | None = key_field(
        "number of equally spaced angles at rest", 24, None
    )
    attitudes: Annotated[list[Any], Field(min_length=1)] | None = key_field(
        "list of attitudes, in place of `positions`, written as in [campaigns](readings.md#keys)",
        ["level", "90 deg about east"],
        None,
    )
    attitude: Literal["unknown"] | None = key_field(
        "`unknown` for [poses](poses.md#further-poses) of a triad that are set by hand",
        "unknown",
        None,
    )
    up: Annotated[list[Text], Field(min_length=1)] | None = key_field(
        "axes that point up in each pose; a minus sign means down; several axes in one entry make "
        "equal angles with the vertical",
        ["X", "-X", "Y - Z"],
        None,
        absent="26 poses: every axis, pair of axes and triple of axes",
    )
    about: Annotated[Text, AfterValidator(check_axis)] = key_field(
        "axis of rotation of the positions", "east", "north"
    )
    u_angle: Annotated[float, exact_quantity("rad"), AfterValidator(_check_not_negative)] = (
        key_field(
            "random error of the dividing head at each position", "2 arcsec", 0.0, absent="0 rad"
        )
    )
    rates: Annotated[list[Rate], Field(min_length=1)] | None = key_field(
        "list of rates of a rotating station", ["5 rad/s", "9.9 rad/s"], None
    )
    specific_forces: Annotated[list[Force], Field(min_length=1)] | None = key_field(
        "list of centripetal forces, in place of `rates`", ["2 g", "10 g"], None
    )
    senses: Literal["one", "both"] = key_field("sense of rotation", "both", "one")
    axes: dict[str, Any] | None = key_field(
        "directions of the axes, as for a run with a reading",
        {"input": "inward", "pendulous": "up"},
        None,
    )
    mounting: str = key_field("mounting, as for a run with a reading", "in", "")
    u: Annotated[Text | dict[str, Text], BeforeValidator(require_units)] = key_field(
        "standard uncertainty of one reading, in g or in the unit of `output`; one value for all "
        "accelerometers, or a table by name",
        "2e-6 mA",
    )
    time: Duration = key_field("time for one reading", "60 s", 0.0, absent="0 s")


class ReadingLimitsSettings(SettingsSection):
    """[limits]: limits on the number and order of readings."""

    readings: Annotated[int, Field(le=MAX_READINGS), AfterValidator(check_positive)] | None = (
        key_field("maximum number of readings", 60, None, absent="limited only by the time")
    )
    total_time: Seconds | None = key_field(
        "total time of all readings; if given, the plan reaches a target in the least time, "
        "otherwise with the fewest readings",
        "2 h",
        None,
        absent="limited only by the number of readings",
    )
    order: Literal["mirrored", "random", "listed"] = key_field(
        'order of the readings: random, as listed, or mirrored; `"mirrored"` repeats the sequence '
        "in reverse order, which cancels a linear drift",
        "random",
        "mirrored",
    )
    sampling_rate: Annotated[float, exact_quantity("Hz"), AfterValidator(check_positive)] | None = (
        key_field("sampling rate of the records in `[[runs]]`", "50 Hz", None)
    )


class GoalSettings(SettingsSection):
    """[goal]: objective of the plan."""

    minimise: list[Text] | dict[str, Any] | None = key_field(
        'coefficients whose u the plan minimises, such as `["K_II"]`; if their units differ, a '
        'table of values of u that are equally important, such as `{ K_II = "1e-8 g/g^2", '
        'K_I = "1e-6 g/g" }`',
        ["K_II"],
        None,
        absent="`target`",
    )
    target: dict[str, Any] | None = key_field(
        "values of u that the plan must reach in the least time, in place of `minimise`",
        {"K_II": "2e-8 g/g^2"},
        None,
        absent="`minimise`",
    )
    criterion: Literal["sum", "determinant"] = key_field(
        'quantity to minimise: `"sum"` is the mean of (u/size)² (c- or A-optimality), and '
        '`"determinant"` is the volume of the uncertainty ellipsoid (D-optimality)',
        "determinant",
        "sum",
    )


class _Sections(SettingsSection):
    """The goal of a plan, and the limits of the machine."""

    schema_version: Schema = key_field("version of this format", 1, alias="schema")
    campaign: Annotated[dict[str, Any], Section(CampaignSettings)] = key_field(
        "heading and identification of the report, as in a campaign",
        {"title": "A day at the centrifuge"},
        absent="empty",
        default_factory=dict,
    )
    site: Annotated[dict[str, Any], Section(SiteSettings)] = key_field(
        "location of the centrifuge, as in a campaign", {}
    )
    accelerometers: Accelerometers = key_field(
        "a table for each accelerometer, as in a campaign",
        {"Qx": {"input_axis": "east", "pendulous_axis": "down"}},
    )
    model: Annotated[dict[str, Any] | None, Section(ModelSettings)] = key_field(
        "requested terms and prior information, as in a campaign",
        {},
        None,
        absent="the usual terms",
    )
    records: Annotated[dict[str, Any] | None, Section(RecordsSettings)] = key_field(
        "format of the record files, as in a campaign", {}, None
    )
    goal: Annotated[dict[str, Any], Section(GoalSettings)] = key_field(
        "objective of the plan", {"minimise": ["K_II"]}
    )


class PlanDocument(_Sections):
    """A plan of records."""

    limits: Annotated[dict[str, Any], Section(LimitsSettings)] = key_field(
        "limits of the machine and the laboratory", {}
    )
    centrifuge: Annotated[dict[str, Any], Section(CentrifugeSettings)] = key_field(
        "dimensions of the centrifuge, as in a campaign", {}
    )
    noise: Annotated[dict[str, Any], Section(NoiseSettings)] = key_field(
        "noise of the records, as in a campaign; every value must be a number",
        {"displacement": "0.01 m"},
    )
    truth: Annotated[dict[str, Any] | None, Section(TruthSettings)] = key_field(
        "true values for a simulation of the plan", {}, None
    )


class ReadingPlanDocument(_Sections):
    """A plan of readings."""

    limits: Annotated[dict[str, Any], Section(ReadingLimitsSettings)] = key_field(
        "limits on the number and order of readings", {}
    )
    centrifuge: Annotated[dict[str, Any] | None, Section(CentrifugeSettings)] = key_field(
        "dimensions of the centrifuge, as in a campaign; required if a station rotates", {}, None
    )
    fixture: Annotated[dict[str, Any] | None, Section(FixtureSettings)] = key_field(
        "uncertainty of positions at rest, as in a campaign", {}, None
    )
    noise: Annotated[dict[str, Any] | None, Section(NoiseSettings)] = key_field(
        "format of the records of `runs`, as in a campaign", {}, None
    )
    triad: Annotated[dict[str, Any] | None, Section(TriadSettings)] = key_field(
        "three accelerometers of one sensor, as in a campaign", {}, None
    )
    runs: Runs = key_field(
        "records and readings that will be made regardless of the plan; same keys as in a campaign",
        [],
        absent="none",
        default_factory=list,
    )
    readings: Annotated[dict[str, Any] | None, Section(ReadingsSettings)] = key_field(
        (
            "a table of readings that will be made regardless of the plan; same keys as in a "
            "campaign"
        ),
        {},
        None,
    )
    stations: Annotated[list[Any], Field(min_length=1), Section(list[StationsSettings])] = (
        key_field("stations at which readings may be taken", [{"positions": 24, "u": "2e-6 g"}])
    )
