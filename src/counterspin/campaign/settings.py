"""The keys of ``campaign.toml``, section by section, as strict pydantic models.

A key that is not here is a mistake. Quantities are converted to SI and g-units here; what needs
several sections (axes, priors, attitudes) is resolved in `description`.

The keys that name coefficients are not written here: they are made from the term tables.
"""

from __future__ import annotations

import codecs
import datetime
import math
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import PurePath
from typing import Annotated, Any, Final, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationInfo,
    create_model,
    model_validator,
)

from counterspin.campaign.attitude import attitude_rows, read_direction
from counterspin.campaign.quantity import Quantity, parse
from counterspin.campaign.toml_file import BACKSLASH_ADVICE
from counterspin.physics.terms import CONDITION_TERMS, SHARED_TERMS, TERMS
from counterspin.records.dialect import Dialect
from counterspin.records.formats import RECORD_FORMATS
from counterspin.units import unit_factor

#: Written as the unit of time stamps in ISO 8601.
STAMPS: Final = "iso"

#: Directions that the zero of an encoder may have, rad from east towards north.
COMPASS: Final = {
    name: quarter * math.pi / 2.0 for quarter, name in enumerate(("east", "north", "west", "south"))
}

#: What an accelerometer's record may hold -> its SI unit.
OBSERVABLES: Final = {"displacement": "m", "velocity": "m/s", "specific_force": "m/s^2"}

#: Gravity of any laboratory on Earth, m/s^2, with room to spare.
_GRAVITY_RANGE: Final = (9.0, 11.0)

#: Written in [noise] where a component is to be estimated from the residuals.
ESTIMATE: Final = "estimate"


def exact(text: object, unit: str, gravity: float | None = None, usual: str | None = None) -> float:
    """Read a quantity that must have no uncertainty."""
    quantity = parse(text, unit, gravity=gravity, usual=usual)
    if quantity.u != 0.0:
        raise ValueError(f"{text!r}: an uncertainty has no meaning here; leave out the ±")
    return quantity.value


def _gravity(info: ValidationInfo) -> float | None:
    return (info.context or {}).get("gravity")


def _parsed(unit: str, text: object, info: ValidationInfo, usual: str | None = None) -> Quantity:
    return parse(text, unit, gravity=_gravity(info), usual=usual)


def _parsed_exactly(
    unit: str, text: object, info: ValidationInfo, usual: str | None = None
) -> float:
    return exact(text, unit, gravity=_gravity(info), usual=usual)


def _parsed_noise(unit: str, text: object, info: ValidationInfo) -> float | str:
    if text == ESTIMATE:
        return ESTIMATE
    size = exact(text, unit, _gravity(info))
    if size < 0.0:
        raise ValueError('a standard deviation is not negative; or write "estimate"')
    return size


# Each is a partial function whose first argument is the unit, so that a form can show it.


def _uncertain(unit: str, usual: str | None = None) -> PlainValidator:
    return PlainValidator(partial(_parsed, unit, usual=usual))


def _part(text: object, info: ValidationInfo) -> Quantity:
    """Return a part of something; a number alone needs no unit."""
    try:
        return _parsed("1", text, info)
    except ValueError:
        return (
            _parsed("1", f"{text} 1", info) if isinstance(text, str) else _parsed("1", text, info)
        )


def read_exactly(unit: str, usual: str | None = None) -> PlainValidator:
    """Return the validator of a quantity without uncertainty; `usual` as of `parse`."""
    return PlainValidator(partial(_parsed_exactly, unit, usual=usual))


def positive(value: Any) -> Any:
    """Return a number or quantity that is greater than zero."""
    if (value.value if isinstance(value, Quantity) else value) <= 0.0:
        raise ValueError("must be greater than zero")
    return value


def _of_earth(value: Any) -> Any:
    positive(value)
    size = value.value if isinstance(value, Quantity) else value
    if not _GRAVITY_RANGE[0] < size < _GRAVITY_RANGE[1]:
        raise ValueError(
            f"{size:.6g} m/s^2 cannot be gravity on Earth, which is about 9.8 m/s^2; "
            "check the number and its unit"
        )
    return value


def _latitude(value: Quantity) -> Quantity:
    if abs(value.value) > math.pi / 2.0 * (1.0 + 1e-12):
        raise ValueError("a latitude lies between -90 deg and 90 deg")
    return value


def _rate(value: float) -> float:
    if value == 0.0:
        raise ValueError("the centrifuge must turn; the rate is zero")
    return value


def _noise_size(unit: str) -> PlainValidator:
    return PlainValidator(partial(_parsed_noise, unit))


def _ratio(value: object) -> float:
    """Read a plain number, or text in ppm."""
    if isinstance(value, str):
        return exact(value, "1")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError("must be a number")
    if not math.isfinite(value):
        raise ValueError("must be a finite number")
    return float(value)


def _rate_error(value: float) -> float:
    if abs(value) >= 0.5:
        raise ValueError("is relative to the nominal rate and must be below 0.5 in size")
    return value


def _unit_of(wanted: str) -> AfterValidator:
    def check(unit: str, info: ValidationInfo) -> str:
        unit_factor(unit, wanted, gravity=_gravity(info))
        return unit

    return AfterValidator(check)


#: What an accelerometer's output may be, beside a specific force.
OUTPUTS: Final = ("V", "A", "count", "count/s")


def _force_or_output(unit: str, info: ValidationInfo) -> str:
    for output in OUTPUTS:
        with suppress(ValueError):
            unit_factor(unit, output)
            return unit
    unit_factor(unit, "m/s^2", gravity=_gravity(info))
    return unit


def file_name(name: str) -> str:
    """Return a file's name; one whose backslashes TOML has taken for something else is refused."""
    if any(ord(character) < 32 for character in name):
        raise ValueError(
            f"{name!r} has a line break, tab or the like in it: in double quotation marks TOML "
            f"reads a backslash as the beginning of one; {BACKSLASH_ADVICE}"
        )
    return name


def record_file(name: str) -> str:
    """Return the name of a record that can be read by its ending."""
    file_name(name)
    if PurePath(name).suffix.lower() not in RECORD_FORMATS:
        raise ValueError(f'cannot read "{name}"; records end in {", ".join(RECORD_FORMATS)}')
    return name


def _date(value: object) -> str:
    if isinstance(value, datetime.date | datetime.datetime):
        return value.isoformat()
    if not isinstance(value, str):
        raise ValueError("must be a date, or text")
    return value


def _whole(value: object) -> object:
    """Refuse true and 1.0, which Python takes for 1."""
    return value if type(value) is int else None


Schema = Annotated[Literal[1], BeforeValidator(_whole)]
Text = Annotated[str, Field(min_length=1)]
Direction = Annotated[tuple[float, float, float], PlainValidator(read_direction)]
Ratio = Annotated[float, PlainValidator(_ratio)]
PositiveRatio = Annotated[Ratio, AfterValidator(positive)]
Seconds = Annotated[float, read_exactly("s"), AfterValidator(positive)]


class SettingsSection(BaseModel):
    """A table of ``campaign.toml`` in which every key must be known."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, defer_build=True)


class DocumentSettings(SettingsSection):
    """The sections that there may be; each is checked by its own model afterwards."""

    schema_version: Schema = Field(alias="schema")
    campaign: dict[str, Any] = {}
    site: dict[str, Any]
    centrifuge: dict[str, Any] | None = None
    records: dict[str, Any] | None = None
    readings: dict[str, Any] | None = None
    accelerometers: dict[str, Any] = Field(min_length=1)
    noise: dict[str, Any] | None = None
    model: dict[str, Any] | None = None
    specification: dict[str, Any] | None = None
    runs: list[Any] = []
    simulation: dict[str, Any] | None = None
    truth: dict[str, Any] | None = None
    study: dict[str, Any] | None = None


class CampaignSettings(SettingsSection):
    """[campaign]: what a report says about the campaign; all free text, all optional."""

    title: Text | None = None
    serial_number: Text | None = None
    date: Annotated[str, PlainValidator(_date)] | None = None
    laboratory: Text | None = None
    operator: Text | None = None
    comment: Text | None = None


class SiteSettings(SettingsSection):
    """[site]: where the centrifuge stands."""

    gravity: Annotated[Quantity, _uncertain("m/s^2"), AfterValidator(_of_earth)]
    latitude: Annotated[Quantity, _uncertain("rad", "deg"), AfterValidator(_latitude)]
    removed_gravity: Annotated[float, read_exactly("m/s^2"), AfterValidator(_of_earth)] | None = (
        None
    )


class CentrifugeSettings(SettingsSection):
    """[centrifuge]: its size."""

    radius: Annotated[Quantity, _uncertain("m"), AfterValidator(positive)]
    stretch: Annotated[Quantity, _uncertain("s^2/m")] | None = None
    droop: Annotated[Quantity, _uncertain("rad s^2")] | None = None
    axis_tilt: Annotated[Quantity, _uncertain("rad", "arcsec")] | None = None
    reference_temperature: Text | None = None


class _Channel(SettingsSection):
    column: Text


def _time_unit(unit: str) -> str:
    if unit != STAMPS:
        unit_factor(unit, "s")
    return unit


def _angle_unit(unit: str, info: ValidationInfo) -> str:
    # Pulses are recorded by their times.
    if not (info.data.get("pulses") and _is_unit(unit, "s")) and not _is_unit(unit, "count"):
        unit_factor(unit, "rad")
    return unit


def _is_unit(unit: str, wanted: str) -> bool:
    with suppress(ValueError):
        return bool(unit_factor(unit, wanted))
    return False


def _zero(value: object) -> float:
    """Return the direction of an encoder's zero, rad from east towards north."""
    if isinstance(value, str) and value in COMPASS:
        return COMPASS[value]
    try:
        return exact(value, "rad", usual="deg")
    except ValueError as error:
        raise ValueError(f"{error}; or one of {', '.join(COMPASS)}") from None


def _encoding(name: str) -> str:
    try:
        codecs.lookup(name)
    except LookupError:
        raise ValueError(f'there is no encoding "{name}"; usual: utf-8, latin-1, utf-16') from None
    return name


class TimeChannel(SettingsSection):
    """The column that holds the time, or how many rows there are a second."""

    column: Text | None = None
    unit: Annotated[str, AfterValidator(_time_unit)] | None = None
    sampling_rate: Annotated[float, read_exactly("Hz"), AfterValidator(positive)] | None = None

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        if (self.column is None) == (self.sampling_rate is None):
            raise ValueError("give a column, or a sampling_rate")
        if self.unit is not None and self.column is None:
            raise ValueError("a unit belongs to a column; with sampling_rate there is none")
        return self


class AngleChannel(_Channel):
    """The column that holds the spindle's angle, or the times of its pulses."""

    pulses: bool = False
    unit: Annotated[str, AfterValidator(_angle_unit)] | None = None
    sense: Literal["counterclockwise", "clockwise"] = "counterclockwise"
    zero: Annotated[float, PlainValidator(_zero)] = 0.0
    per_revolution: Annotated[float, PlainValidator(_ratio), AfterValidator(positive)] | None = None

    @model_validator(mode="after")
    def _counts(self) -> Self:
        counted = self.unit is not None and _is_unit(self.unit, "count")
        if counted and self.per_revolution is None:
            raise ValueError("counts need per_revolution: how many make one revolution")
        if self.per_revolution is not None and not (counted or self.pulses):
            raise ValueError('per_revolution belongs to pulses, or to unit = "count"')
        return self


class TableDialect(SettingsSection):
    """How a table is written, as far as a person says it: of records and of readings alike."""

    skip_lines: Annotated[int, Field(ge=0)] | None = None
    delimiter: Literal[",", ";", "\t"] | None = None
    decimal: Literal[".", ","] | None = None
    encoding: Annotated[str, AfterValidator(_encoding)] | None = None
    units_row: bool | None = None
    sheet: Text | None = None

    @property
    def dialect(self) -> Dialect:
        """The same, as files are read."""
        keys = Dialect.__dataclass_fields__
        return Dialect(**{key: getattr(self, key) for key in keys if hasattr(self, key)})


class _TimeAndAngle(SettingsSection):
    time: TimeChannel
    angle: AngleChannel | None = None


# The fields of the last base come first.
class RecordsSettings(TableDialect, _TimeAndAngle):
    """[records]: how to read every run's file."""

    group: Text | None = None
    timing_offset: Annotated[Quantity, _uncertain("s")] | None = None
    clock: Annotated[Quantity, PlainValidator(_part)] | None = None
    reference: Literal["platform", "own velocity"] = "platform"


class DisplacementChannel(_Channel):
    """The column that holds the displacement along the input axis."""

    unit: Annotated[str, _unit_of("m")] | None = None


class VelocityChannel(_Channel):
    """The column that holds the velocity along the input axis."""

    unit: Annotated[str, _unit_of("m/s")] | None = None


class ForceChannel(_Channel):
    """The column that holds the indicated specific force, or an output such as a current."""

    unit: Annotated[str, AfterValidator(_force_or_output)]


class AxesSettings(SettingsSection):
    """The axes of an accelerometer; checked by themselves too, whatever else is wrong."""

    input_axis: Direction
    pendulous_axis: Direction
    output_axis: Direction | None = None


class OutputSettings(SettingsSection):
    """``output``: what an accelerometer's readings are in, and its nominal sensitivity."""

    unit: Text
    sensitivity: Text | None = None


class _AccelerometerKeys(AxesSettings):
    serial_number: Text | None = None
    grade: Literal["navigation", "tactical", "consumer"] = "navigation"
    output: OutputSettings | None = None
    sensitivity_prior: Text | None = None
    bias: Annotated[Quantity, _uncertain("g")] | None = None
    scale_factor: Annotated[Quantity, _uncertain("g/g")] | None = None
    displacement: DisplacementChannel | None = None
    velocity: VelocityChannel | None = None
    specific_force: ForceChannel | None = None


def _keys(units: dict[str, str], validator: Callable[[str], PlainValidator]) -> dict[str, Any]:
    """Return optional fields, one for each name, that read a quantity in its unit."""
    return {
        name: (Annotated[Quantity | float, validator(unit)] | None, None)
        for name, unit in units.items()
    }


_TERM_UNITS: Final = {row.symbol: row.unit for row in TERMS.values()}

#: [accelerometers.NAME]: its axes, its column and, by term symbol, the priors.
AccelerometerSettings = create_model(
    "AccelerometerSettings", __base__=_AccelerometerKeys, **_keys(_TERM_UNITS, _uncertain)
)


class NoiseSettings(SettingsSection):
    """[noise] and [truth.noise]: standard deviations a sample, SI."""

    displacement: Annotated[float | str, _noise_size("m")] = 0.0
    velocity: Annotated[float | str, _noise_size("m/s")] = 0.0
    specific_force: Annotated[float | str, _noise_size("m/s^2")] = 0.0
    acceleration: Annotated[float | str, _noise_size("m/s^2/Hz^0.5")] = 0.0
    flicker: Annotated[float | str, _noise_size("m/s^2")] = 0.0
    bias_walk: Annotated[float | str, _noise_size("m/s^2/s^0.5")] = 0.0
    quantisation: Annotated[float | str, _noise_size("m")] = 0.0
    angle: Annotated[float | str, _noise_size("rad")] = 0.0
    timing: Annotated[float | str, _noise_size("s")] = 0.0


def several(value: Any) -> Any:
    """Return a text by itself as a list of one."""
    return [value] if isinstance(value, str) else value


class ModelSettings(SettingsSection):
    """[model]; names and values are resolved in `terms`."""

    terms: list[Text] | None = None
    assume: Annotated[list[Text], BeforeValidator(several)] = []
    hold: list[Text] = []
    considered: list[Text] = []
    priors: dict[str, Any] = {}
    limits: dict[str, Any] = {}
    typical: dict[str, Any] = {}

    @property
    def held(self) -> tuple[str, list[str]]:
        """The key that names what is known but not adjusted, new or old, and the names."""
        return ("considered", self.considered) if self.considered else ("hold", self.hold)


class RippleSettings(SettingsSection):
    """One entry of ``ripple``: a periodic fluctuation, by ratio w_n/w0 or by amplitude."""

    harmonic: Annotated[int, AfterValidator(positive)] = 1
    ratio: Ratio | None = None
    amplitude: Annotated[float, read_exactly("rad/s")] | None = None
    phase: Annotated[float, read_exactly("rad", "deg")] = 0.0


class SpindleTruthSettings(SettingsSection):
    """[truth.spindle]: how the spindle really turns."""

    drift: Annotated[float, read_exactly("1/s")] | None = None
    ripple: list[RippleSettings] | None = None
    start_angle: Annotated[float, read_exactly("rad", "deg")] | None = None
    rate_error: Annotated[Ratio, AfterValidator(_rate_error)] | None = None


def _truth_tables(name: str, units: dict[str, str]) -> type[SettingsSection]:
    """Return a table with a key for each name; of a name with dots, tables within it."""
    tables: dict[str, dict[str, str]] = {}
    leaves: dict[str, str] = {}
    for key, unit in units.items():
        head, _, rest = key.partition(".")
        if rest:
            tables.setdefault(head, {})[rest] = unit
        else:
            leaves[key] = unit
    fields = _keys(leaves, read_exactly) | {
        key: (_truth_tables(f"{name}_{key}", inner) | None, None) for key, inner in tables.items()
    }
    return create_model(name, __base__=SettingsSection, **fields)


def _shared_units(family: str) -> dict[str, str]:
    """Return the units of the shared terms of a family, by their names within it."""
    return {
        symbol.removeprefix(family): row.unit
        for symbol, row in SHARED_TERMS.items()
        if symbol.startswith(family)
    }


#: [truth.platform]: ``tilt.north``, ``drift.up``, ``g_sensitivity.zx`` and so on.
PlatformTruthSettings = _truth_tables("PlatformTruthSettings", _shared_units("platform."))
#: [truth.centrifuge]: ``stretch``, ``imbalance.1.cos`` and so on.
CentrifugeTruthSettings = _truth_tables("CentrifugeTruthSettings", _shared_units("centrifuge."))
#: [truth.encoder]: ``harmonic.1.cos`` and so on.
EncoderTruthSettings = _truth_tables("EncoderTruthSettings", _shared_units("encoder."))

#: ``truth`` of one run: what differs from [truth.spindle], and the run's own tilt.
RunTruthSettings = create_model(
    "RunTruthSettings",
    __base__=SpindleTruthSettings,
    **{"tilt": (_truth_tables("True_tilt", _shared_units("platform.tilt.")) | None, None)},  # type: ignore[call-overload]
)


class _AccelerometerTruthKeys(SettingsSection):
    start_offset: Annotated[float, read_exactly("m")] = 0.0
    start_velocity: Annotated[float, read_exactly("m/s")] = 0.0


#: [truth.NAME]: the true coefficients of one accelerometer.
AccelerometerTruthSettings = create_model(
    "AccelerometerTruthSettings",
    __base__=_AccelerometerTruthKeys,
    **_keys(_TERM_UNITS | {row.symbol: row.unit for row in CONDITION_TERMS.values()}, read_exactly),
)


class SimulationSettings(SettingsSection):
    """[simulation]: how `counterspin simulate` samples."""

    sampling_rate: Annotated[float, read_exactly("Hz"), AfterValidator(positive)] = 50.0
    seed: Annotated[int, Field(ge=0)] = 1
    revolutions: PositiveRatio = 100.0


class RunSettings(SettingsSection):
    """[[runs]]: one run."""

    name: Text
    rate: Annotated[float, read_exactly("rad/s"), AfterValidator(_rate)]
    record: Annotated[Text, AfterValidator(record_file)]
    attitude: Annotated[Any, PlainValidator(attitude_rows)] = Field(
        default_factory=lambda: attitude_rows("level")
    )
    duration: Seconds | None = None
    revolutions: PositiveRatio | None = None
    temperature: Text | None = None
    time: Annotated[float, read_exactly("s")] | None = None
    continued_in: list[Annotated[Text, AfterValidator(record_file)]] = []
    pulses: Annotated[Text, AfterValidator(record_file)] | None = None
    records: dict[str, Any] | None = None
    skip: bool = False
    start: Annotated[float, read_exactly("s")] | None = None
    stop: Annotated[float, read_exactly("s")] | None = None
    truth: dict[str, Any] | None = None
