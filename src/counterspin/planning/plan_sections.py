"""Sections of ``PLAN.toml`` in addition to those that it shares with ``campaign.toml``.

A plan has no [[runs]], which it makes, and may go without [records]; it has [limits] and [goal].
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BeforeValidator, Field, PlainValidator

from counterspin.campaign.checking import Section
from counterspin.campaign.columns import RecordsSettings
from counterspin.campaign.kinds import (
    PositiveRatio,
    Schema,
    Seconds,
    SettingsSection,
    Text,
    described,
    positive,
    read_exactly,
    with_units,
)
from counterspin.campaign.quantity import attitude_rows
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
from counterspin.readings.entries import MOST_READINGS, MOST_RECORDS
from counterspin.readings.table import ReadingsSettings
from counterspin.triads.section import TriadSettings

#: Most attitudes among which is searched, which takes seconds, not minutes.
MOST_ATTITUDES: Final = 24


def _not_negative(value: float) -> float:
    if value < 0.0:
        raise ValueError("must not be negative")
    return value


def _one_or_more(value: float) -> float:
    # The functions of the angle are hardly separable within less than a revolution.
    if value < 1.0:
        raise ValueError("must be one revolution at least")
    return value


Rate = Annotated[float, read_exactly("rad/s"), AfterValidator(positive)]
SpinUp = Annotated[float, read_exactly("rad/s^2"), AfterValidator(positive)]
Force = Annotated[float, read_exactly("g"), AfterValidator(positive)]
Duration = Annotated[float, read_exactly("s"), AfterValidator(_not_negative)]


def _attitude(value: object) -> object:
    attitude_rows(value)
    return value


class LimitsSettings(SettingsSection):
    """[limits]: what the machine and the laboratory allow."""

    total_time: Seconds = described(
        "records, spin-up, settling and changes of attitude together", "700 s"
    )
    highest_rate: Rate | None = described(
        "largest size of the rate", "2 rad/s", None, absent="by `specific_force` or `rates`"
    )
    lowest_rate: Rate | None = described(
        "smallest size of the rate", "0.5 rad/s", None, absent="highest / 8"
    )
    rates: Annotated[list[Rate], Field(min_length=1, max_length=MOST_RECORDS)] | None = described(
        "the settings available, a list",
        ["0.25 rev/s", "0.5 rev/s"],
        None,
        absent="any rate between",
    )
    specific_force: Force | None = described(
        "largest centripetal force, in g", "1 g", None, absent="as the rates"
    )
    senses: Literal["one", "both"] = described("in which it turns", "both", "one")
    settling: Duration = described("time before each record", "10 s", 0.0, absent="0 s")
    spin_up: SpinUp | None = described(
        "angular acceleration; rate / acceleration is added to each run",
        "0.1 rad/s^2",
        None,
        absent="no time",
    )
    spin_down: SpinUp | None = described(
        "angular deceleration; rate / acceleration is added to each run",
        "0.1 rad/s^2",
        None,
        absent="no time",
    )
    fewest_revolutions: Annotated[PositiveRatio, AfterValidator(_one_or_more)] = described(
        "of a run, at least 1", 10, 5.0
    )
    longest_run: Seconds | None = described("of a record", "400 s", None, absent="the total time")
    runs: Annotated[int, Field(le=MOST_RECORDS), AfterValidator(positive)] = described(
        "largest number, at most 60", 14, 8
    )
    fewest_rates: Annotated[int, AfterValidator(positive)] | None = described(
        "how many different rates there must be, each at least 1.25 times the next; "
        "of `rates`, any that differ",
        3,
        None,
        absent="2, or 1 where the other limits leave no room for two",
    )
    attitudes: list[Annotated[Any, PlainValidator(_attitude)]] = described(
        "list, written as in `campaign.toml`",
        ["level", "90 deg about east"],
        absent="level only",
        default_factory=lambda: ["level"],
        min_length=1,
        max_length=MOST_ATTITUDES,
    )
    attitude_change: Duration = described("time for each", "5 min", 0.0, absent="0 s")
    sampling_rate: Annotated[float, read_exactly("Hz"), AfterValidator(positive)] = described(
        "of the records", "100 Hz", 50.0, absent="50 Hz"
    )


class StationsSettings(SettingsSection):
    """[[stations]]: readings that may be taken, one for each position or rate."""

    name: str = described("before the name of each reading", "tumble", "")
    motion: Literal["counter-rotating", "arm", "static"] = described(
        "how the instrument moves", "arm", "static"
    )
    positions: Annotated[int, Field(le=3600), AfterValidator(positive)] | None = described(
        "number of equally spaced angles at rest", 24, None
    )
    attitudes: Annotated[list[Any], Field(min_length=1)] | None = described(
        "in place of `positions`: a list, as in [campaigns](readings.md#keys)",
        ["level", "90 deg about east"],
        None,
    )
    attitude: Literal["unknown"] | None = described(
        "[poses](poses.md#which-poses-next) of a triad, set by hand", "unknown", None
    )
    up: Annotated[list[Text], Field(min_length=1)] | None = described(
        "of poses: the axes that point up, those with a minus down; where there are several, all "
        "of them equally",
        ["X", "-X", "Y - Z"],
        None,
        absent="each axis, every two and every three of them: 26",
    )
    about: Text = described("the axis about which they turn", "east", "north")
    u_angle: Annotated[float, read_exactly("rad"), AfterValidator(_not_negative)] = described(
        "random error of the dividing head at each position", "2 arcsec", 0.0, absent="0 rad"
    )
    rates: Annotated[list[Rate], Field(min_length=1)] | None = described(
        "of stations that turn: a list of rates", ["5 rad/s", "9.9 rad/s"], None
    )
    specific_forces: Annotated[list[Force], Field(min_length=1)] | None = described(
        "in place of `rates`: a list of centripetal forces", ["2 g", "10 g"], None
    )
    senses: Literal["one", "both"] = described("in which it turns", "both", "one")
    axes: dict[str, Any] | None = described(
        "as of a run with a reading", {"input": "inward", "pendulous": "up"}, None
    )
    mounting: str = described("as of a run with a reading", "in", "")
    u: Annotated[Text | dict[str, Text], BeforeValidator(with_units)] = described(
        "standard uncertainty of one reading, in g or the unit of `output`; with "
        "several accelerometers a table by name, or one for all",
        "2e-6 mA",
    )
    time: Duration = described("that one reading takes", "60 s", 0.0, absent="0 s")


class ReadingLimitsSettings(SettingsSection):
    """[limits]: how many readings there may be, and in which order."""

    readings: Annotated[int, Field(le=MOST_READINGS), AfterValidator(positive)] | None = described(
        "most of them", 60, None, absent="as the time"
    )
    total_time: Seconds | None = described(
        "of all readings; with it a target is reached in the least time, else with "
        "the fewest readings",
        "2 h",
        None,
        absent="as the number",
    )
    order: Literal["mirrored", "random", "listed"] = described(
        '`"mirrored"`: there and back, so that a linear drift cancels; `"random"`; `"listed"`',
        "random",
        "mirrored",
    )
    sampling_rate: Annotated[float, read_exactly("Hz"), AfterValidator(positive)] | None = (
        described("of the records in `[[runs]]`, if there are any", "50 Hz", None)
    )


class GoalSettings(SettingsSection):
    """[goal]: what the plan is for."""

    minimise: list[Text] | dict[str, Any] | None = described(
        'coefficients, as `["K_II"]`; of several in different units the sizes of u '
        'that count alike, as `{ K_II = "1e-8 g/g^2", K_I = "1e-6 g/g" }`',
        ["K_II"],
        None,
        absent="`target`",
    )
    target: dict[str, Any] | None = described(
        "sizes of u to reach in the least time, in place of `minimise`",
        {"K_II": "2e-8 g/g^2"},
        None,
        absent="`minimise`",
    )
    criterion: Literal["sum", "determinant"] = described(
        '`"sum"`: the mean of (u/size)² (c- or A-optimality); `"determinant"`: the '
        "volume of the ellipsoid (D-optimality)",
        "determinant",
        "sum",
    )


class _Sections(SettingsSection):
    """The goal of a plan, and the limits of the machine."""

    schema_version: Schema = described("version of this format", 1, alias="schema")
    campaign: Annotated[dict[str, Any], Section(CampaignSettings)] = described(
        "what a report says, as in a campaign",
        {"title": "A day at the centrifuge"},
        absent="empty",
        default_factory=dict,
    )
    site: Annotated[dict[str, Any], Section(SiteSettings)] = described(
        "where, as in a campaign", {}
    )
    accelerometers: Accelerometers = described(
        "one table for each, as in a campaign",
        {"Qx": {"input_axis": "east", "pendulous_axis": "down"}},
    )
    model: Annotated[dict[str, Any] | None, Section(ModelSettings)] = described(
        "what is asked for, and what is known, as in a campaign", {}, None, absent="the usual terms"
    )
    records: Annotated[dict[str, Any] | None, Section(RecordsSettings)] = described(
        "how files will be read, as in a campaign", {}, None
    )
    goal: Annotated[dict[str, Any], Section(GoalSettings)] = described(
        "what the plan is for", {"minimise": ["K_II"]}
    )


class PlanDocument(_Sections):
    """A plan of records."""

    limits: Annotated[dict[str, Any], Section(LimitsSettings)] = described(
        "what the machine and the laboratory allow", {}
    )
    centrifuge: Annotated[dict[str, Any], Section(CentrifugeSettings)] = described(
        "its size, as in a campaign", {}
    )
    noise: Annotated[dict[str, Any], Section(NoiseSettings)] = described(
        "of the records, as in a campaign; every size a number", {"displacement": "0.01 m"}
    )
    truth: Annotated[dict[str, Any] | None, Section(TruthSettings)] = described(
        "true values, for a simulation of the plan", {}, None
    )


class ReadingPlanDocument(_Sections):
    """A plan of readings."""

    limits: Annotated[dict[str, Any], Section(ReadingLimitsSettings)] = described(
        "how many readings there may be, and in which order", {}
    )
    centrifuge: Annotated[dict[str, Any] | None, Section(CentrifugeSettings)] = described(
        "its size, as in a campaign; needed where a station turns", {}, None
    )
    fixture: Annotated[dict[str, Any] | None, Section(FixtureSettings)] = described(
        "how well positions are set, as in a campaign", {}, None
    )
    noise: Annotated[dict[str, Any] | None, Section(NoiseSettings)] = described(
        "of the records of `runs`, as in a campaign", {}, None
    )
    triad: Annotated[dict[str, Any] | None, Section(TriadSettings)] = described(
        "three accelerometers of one sensor, as in a campaign", {}, None
    )
    runs: Runs = described(
        "records and readings that are taken in any case, as in a campaign",
        [],
        absent="none",
        default_factory=list,
    )
    readings: Annotated[dict[str, Any] | None, Section(ReadingsSettings)] = described(
        "a table of readings that are taken in any case, as in a campaign", {}, None
    )
    stations: Annotated[list[Any], Field(min_length=1), Section(list[StationsSettings])] = (
        described("readings that may be taken", [{"positions": 24, "u": "2e-6 g"}])
    )
