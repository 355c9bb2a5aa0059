"""What may stand in ``PLAN.toml`` beside the sections that it shares with ``campaign.toml``.

A plan has no [[runs]], which it makes, and may go without [records]; it has [limits] and [goal].
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field, PlainValidator

from counterspin.campaign.attitude import attitude_rows
from counterspin.campaign.kinds import (
    PositiveRatio,
    Schema,
    Seconds,
    SettingsSection,
    Text,
    positive,
    read_exactly,
)
from counterspin.campaign.resolved import MOST_READINGS, MOST_RECORDS

#: Most attitudes among which is searched, which takes seconds, not minutes.
MOST_ATTITUDES: Final = 24


def _not_negative(value: float) -> float:
    if value < 0.0:
        raise ValueError("must not be negative")
    return value


def _one_or_more(value: float) -> float:
    # Within less than a revolution what the angle does is hardly to be told apart.
    if value < 1.0:
        raise ValueError("must be one revolution at least")
    return value


Rate = Annotated[float, read_exactly("rad/s"), AfterValidator(positive)]
SpinUp = Annotated[float, read_exactly("rad/s^2"), AfterValidator(positive)]
Duration = Annotated[float, read_exactly("s"), AfterValidator(_not_negative)]


def _attitude(value: object) -> object:
    attitude_rows(value)
    return value


class PlanDocument(SettingsSection):
    """The sections that there may be; each is checked by its own model afterwards."""

    schema_version: Schema = Field(alias="schema")
    campaign: dict[str, Any] = Field(default_factory=dict)
    site: dict[str, Any]
    centrifuge: dict[str, Any]
    records: dict[str, Any] | None = None
    accelerometers: dict[str, Any] = Field(min_length=1)
    noise: dict[str, Any]
    model: dict[str, Any] | None = None
    truth: dict[str, Any] | None = None
    limits: dict[str, Any]
    goal: dict[str, Any]


class LimitsSettings(SettingsSection):
    """[limits]: what the machine and the laboratory allow."""

    total_time: Seconds
    highest_rate: Rate | None = None
    lowest_rate: Rate | None = None
    rates: Annotated[list[Rate], Field(min_length=1, max_length=MOST_RECORDS)] | None = None
    specific_force: Annotated[float, read_exactly("g"), AfterValidator(positive)] | None = None
    senses: Literal["one", "both"] = "one"
    settling: Duration = 0.0
    spin_up: SpinUp | None = None
    spin_down: SpinUp | None = None
    fewest_revolutions: Annotated[PositiveRatio, AfterValidator(_one_or_more)] = 5.0
    longest_run: Seconds | None = None
    runs: Annotated[int, AfterValidator(positive), Field(le=MOST_RECORDS)] = 8
    fewest_rates: Annotated[int, AfterValidator(positive)] | None = None
    attitudes: list[Annotated[Any, PlainValidator(_attitude)]] = Field(
        default_factory=lambda: ["level"], min_length=1, max_length=MOST_ATTITUDES
    )
    attitude_change: Duration = 0.0
    sampling_rate: Annotated[float, read_exactly("Hz"), AfterValidator(positive)] = 50.0


class ReadingPlanDocument(SettingsSection):
    """The sections of a plan of readings; each is checked by its own model afterwards."""

    schema_version: Schema = Field(alias="schema")
    campaign: dict[str, Any] = Field(default_factory=dict)
    site: dict[str, Any]
    centrifuge: dict[str, Any] | None = None
    accelerometers: dict[str, Any] = Field(min_length=1)
    model: dict[str, Any] | None = None
    records: dict[str, Any] | None = None
    noise: dict[str, Any] | None = None
    runs: list[Any] = Field(default_factory=list)
    stations: list[Any] = Field(min_length=1)
    limits: dict[str, Any]
    goal: dict[str, Any]


class StationsSettings(SettingsSection):
    """[[stations]]: readings that may be taken, one for each position or rate."""

    name: str = ""
    motion: Literal["counter-rotating", "arm", "static"] = "static"
    positions: Annotated[int, AfterValidator(positive), Field(le=3600)] | None = None
    attitudes: Annotated[list[Any], Field(min_length=1)] | None = None
    about: Text = "north"
    u_angle: Annotated[float, read_exactly("rad"), AfterValidator(_not_negative)] = 0.0
    rates: Annotated[list[Rate], Field(min_length=1)] | None = None
    specific_forces: (
        Annotated[
            list[Annotated[float, read_exactly("g"), AfterValidator(positive)]],
            Field(min_length=1),
        ]
        | None
    ) = None
    senses: Literal["one", "both"] = "one"
    axes: dict[str, Any] | None = None
    mounting: str = ""
    u: Text | dict[str, Text]
    time: Duration = 0.0


class ReadingLimitsSettings(SettingsSection):
    """[limits] of a plan of readings."""

    readings: Annotated[int, AfterValidator(positive), Field(le=MOST_READINGS)] | None = None
    total_time: Seconds | None = None
    order: Literal["mirrored", "random", "listed"] = "mirrored"
    sampling_rate: Annotated[float, read_exactly("Hz"), AfterValidator(positive)] | None = None


class GoalSettings(SettingsSection):
    """[goal]: what the plan is for; names and sizes are settled in `plan_file`."""

    minimise: list[Text] | dict[str, Any] | None = None
    target: dict[str, Any] | None = None
    criterion: Literal["sum", "determinant"] = "sum"
