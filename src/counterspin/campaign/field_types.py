"""Kinds of values in TOML documents: how each is read, and what its JSON Schema says.

Quantities are converted to SI and g-units here. Each kind of quantity is a validator whose function
is partial in the unit, so that a form can show it.
"""

from __future__ import annotations

import codecs
import datetime
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path, PurePath
from typing import Annotated, Any, Final, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    PlainValidator,
    TypeAdapter,
    ValidationInfo,
)
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, PydanticUndefined, core_schema

from counterspin.campaign.distribution import TABLE_SCHEMA, parse_prior
from counterspin.campaign.documents import BACKSLASH_ADVICE
from counterspin.campaign.quantity import (
    NUMBER,
    PLUS_MINUS,
    Attitude,
    Quantity,
    parse,
    read_attitude,
    read_direction,
)
from counterspin.errors import InputError, OutOfRangeError, error_code
from counterspin.physics.accelerometer import DIRECTIONS
from counterspin.records.format_registry import RECORD_FORMATS
from counterspin.units import OPERATING_TEMPERATURES, TEMPERATURE_SCALES, ZERO_CELSIUS, unit_factor

#: Written as the unit of time stamps in ISO 8601.
STAMPS: Final = "iso"

#: Directions that the zero of an encoder may have, rad from east towards north.
COMPASS: Final = {
    name: quarter * math.pi / 2.0 for quarter, name in enumerate(("east", "north", "west", "south"))
}

#: Written in [noise] where a component is to be estimated from the residuals.
ESTIMATE: Final = "estimate"

_UNCERTAIN_TEMPERATURE: Final = re.compile(r"\s*(.*?)\s*(degC|°C|K)\s*")
_TEMPERATURE: Final = re.compile(r"\s*([+-]?\d+\.?\d*(?:[eE][+-]?\d+)?)\s*(degC|°C|K)\s*")

#: Largest size of the ratio of a table's angle to that of the arm.
_LARGEST_TABLE_RATIO: Final = 16

#: Gravity of any laboratory on Earth, m/s^2, with room to spare.
_GRAVITY_RANGE: Final = (9.0, 11.0)


def exact(text: object, unit: str, gravity: float | None = None, usual: str | None = None) -> float:
    """Read a quantity that must have no uncertainty."""
    quantity = parse(text, unit, gravity=gravity, usual=usual)
    if quantity.u != 0.0:
        raise InputError(
            f"{text!r}: this entry must not have an uncertainty; remove the ±", "wrong-uncertainty"
        )
    return quantity.value


def _gravity(info: ValidationInfo) -> float | None:
    return (info.context or {}).get("gravity")


def _parse_quantity(
    unit: str, text: object, info: ValidationInfo, usual: str | None = None
) -> Quantity:
    if isinstance(text, Mapping):
        return parse_prior(text, unit, gravity=_gravity(info))
    return parse(text, unit, gravity=_gravity(info), usual=usual)


def _parse_exact(unit: str, text: object, info: ValidationInfo, usual: str | None = None) -> float:
    return exact(text, unit, gravity=_gravity(info), usual=usual)


def _parse_noise(unit: str, text: object, info: ValidationInfo) -> float | str:
    if text == ESTIMATE:
        return ESTIMATE
    size = exact(text, unit, _gravity(info))
    if size < 0.0:
        raise OutOfRangeError('a standard deviation cannot be negative; give a value or "estimate"')
    return size


def _parse_truth(unit: str, text: object, info: ValidationInfo) -> float:
    """Read a coefficient, of an accelerometer with an output in its unit too, such as mA/g."""
    output = (info.context or {}).get("output")
    if output is not None and unit.startswith("g"):
        with suppress(ValueError):
            return exact(text, output.unit + unit.removeprefix("g")) / float(output.sensitivity)
    return exact(text, unit, gravity=_gravity(info))


def _written_form(unit: str, *, uncertain: bool = False) -> Any:
    """Return the written form of a quantity in a unit, for schemas."""
    spread = rf"({PLUS_MINUS}{NUMBER})?" if uncertain else ""
    number = f"[+−-]?{NUMBER.removeprefix('[+-]?')}"
    pattern = rf"^\s*{number}{spread}(\s+[^\s±]|[^\d\s.±]).*$"
    return Annotated[str, Field(pattern=pattern, json_schema_extra={"x-unit": unit})]


class Quantities(PlainValidator):
    """The reader of quantities: a partial function whose first argument is the unit.

    A form shows that unit. Pydantic would build a serialiser and the schema of the written form for
    each of a hundred keys when the first campaign is read, and inspect the function's arguments.
    Here the function takes the `ValidationInfo`, and only schemas request the written form.
    """

    def __get_pydantic_core_schema__(
        self, source_type: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return pydantic's schema for a value."""
        return core_schema.with_info_plain_validator_function(self.func)  # type: ignore[arg-type]

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the JSON Schema of what is written."""
        text = TypeAdapter(self.json_schema_input_type).json_schema()
        if not (isinstance(self.func, partial) and self.func.func is _parse_quantity):
            return text
        return {"anyOf": [text, TABLE_SCHEMA], "x-unit": text["x-unit"]}


class _IsQuantity:
    """A type that no document can contain, and that schemas therefore omit."""

    def __get_pydantic_core_schema__(
        self, source_type: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return that it is a `Quantity`."""
        return core_schema.is_instance_schema(Quantity)


#: A number of a table, which has its unit already.
ParsedQuantity = Annotated[Quantity, _IsQuantity()]


def uncertain_quantity(unit: str, usual: str | None = None) -> PlainValidator:
    """Return the validator of a quantity with its uncertainty; `usual` as in `parse`."""
    return Quantities(
        partial(_parse_quantity, unit, usual=usual), _written_form(unit, uncertain=True)
    )


def parse_fraction(text: object, info: ValidationInfo) -> Quantity:
    """Return a fraction; a number alone needs no unit."""
    try:
        return _parse_quantity("1", text, info)
    except ValueError:
        return (
            _parse_quantity("1", f"{text} 1", info)
            if isinstance(text, str)
            else _parse_quantity("1", text, info)
        )


def check_clock_error(value: Quantity) -> Quantity:
    """Return the relative error of a clock's rate, if it is one."""
    if abs(value.value) > 0.01:
        raise OutOfRangeError("a clock error above 1 % is implausible; check the unit of the time")
    return value


def read_exactly(unit: str, usual: str | None = None) -> PlainValidator:
    """Return the validator of a quantity without uncertainty; `usual` as in `parse`."""
    return Quantities(partial(_parse_exact, unit, usual=usual), _written_form(unit))


def coefficient(unit: str) -> PlainValidator:
    """Return the validator of a true coefficient, in g-units or those of the `output`."""
    return Quantities(partial(_parse_truth, unit), _written_form(unit))


def positive(value: Any) -> Any:
    """Return a number or quantity that is greater than zero."""
    if (value.value if isinstance(value, Quantity) else value) <= 0.0:
        raise OutOfRangeError("must be greater than zero")
    return value


def check_gravity(value: Any) -> Any:
    """Return a gravity that is possible on Earth's surface."""
    positive(value)
    size = value.value if isinstance(value, Quantity) else value
    if not _GRAVITY_RANGE[0] < size < _GRAVITY_RANGE[1]:
        raise OutOfRangeError(
            f"{size:.6g} m/s^2 cannot be gravity on Earth, which is about 9.8 m/s^2; "
            "check the number and its unit"
        )
    return value


def check_latitude(value: Any) -> Any:
    """Return an angle, or a quantity that is one, that is a latitude."""
    size = value.value if isinstance(value, Quantity) else value
    if abs(size) > math.pi / 2.0 * (1.0 + 1e-12):
        raise OutOfRangeError("a latitude must be between -90 deg and 90 deg")
    return value


def check_zero_mean(value: Quantity) -> Quantity:
    """Refuse what is not about zero, or has no uncertainty."""
    if value.value != 0.0 or not value.u > 0.0:
        raise InputError(
            'must have the value zero and an uncertainty; write "0 ± 0.5 deg"', "wrong-uncertainty"
        )
    return value


def check_normal(value: Quantity) -> Quantity:
    """Refuse a distribution of a quantity whose errors in single readings are taken as normal."""
    if value.distribution.shape != "normal":
        raise ValueError(
            "the random errors of individual readings are drawn from the normal distribution; "
            'write "VALUE ± U UNIT"'
        )
    return value


def noise_size(unit: str) -> PlainValidator:
    """Return the validator of a standard deviation, or of the wish to have it estimated."""
    written = _written_form(unit) | Literal["estimate"]
    return Quantities(partial(_parse_noise, unit), written)


def parse_ratio(value: object) -> float:
    """Read a plain number, or text in ppm."""
    if isinstance(value, str):
        return exact(value, "1")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError("must be a number", "not-numeric")
    if not math.isfinite(value):
        raise OutOfRangeError("must be a finite number")
    return float(value)


def parse_table_ratio(value: object) -> float:
    """Read the ratio of a table's angle to that of the arm: a number, or a fraction as text."""
    try:
        if isinstance(value, bool):
            raise ValueError
        numerator, slash, denominator = str(value).partition("/")
        ratio = float(numerator) / (float(denominator) if slash else 1.0)
    except (ValueError, ZeroDivisionError):
        raise InputError("must be a number, or a fraction such as 1/2", "not-numeric") from None
    if not abs(ratio) <= _LARGEST_TABLE_RATIO:
        raise OutOfRangeError(f"must be between -{_LARGEST_TABLE_RATIO} and {_LARGEST_TABLE_RATIO}")
    return ratio


def small_rate_error(value: float) -> float:
    """Return an error of the rate that leaves it a rate."""
    if abs(value) >= 0.5:
        raise OutOfRangeError("is relative to the nominal rate; its magnitude must be below 0.5")
    return value


def _check_unit(wanted: str, unit: str, info: ValidationInfo) -> str:
    unit_factor(unit, wanted, gravity=_gravity(info))
    return unit


def unit_of(wanted: str) -> AfterValidator:
    """Return the validator of a unit's name, of one dimension."""
    return AfterValidator(partial(_check_unit, wanted))


#: What an accelerometer's output may be, beside a specific force.
OUTPUTS: Final = ("V", "A", "count", "count/s")


def force_or_output(unit: str, info: ValidationInfo) -> str:
    """Return the unit of a specific force, or of an output such as a current."""
    for output in OUTPUTS:
        with suppress(ValueError):
            unit_factor(unit, output)
            return unit
    unit_factor(unit, "m/s^2", gravity=_gravity(info))
    return unit


def file_name(name: str) -> str:
    """Return a file's name; refuse one whose backslashes TOML has read as escapes."""
    if any(ord(character) < 32 for character in name):
        raise ValueError(
            f"{name!r} contains a line break, a tab or another control character, because TOML "
            "interprets a backslash in double quotation marks as an escape character; "
            f"{BACKSLASH_ADVICE}"
        )
    return name


def record_file(name: str) -> str:
    """Return the name of a record that can be read by its ending."""
    file_name(name)
    if PurePath(name).suffix.lower() not in RECORD_FORMATS:
        raise InputError(
            (
                f'"{name}" is not a supported file type; the names of record files end in '
                f"{', '.join(RECORD_FORMATS)}"
            ),
            "wrong-file-ending",
        )
    return name


def _in_folder(name: object, info: ValidationInfo) -> Path:
    """Return a record's file, in the campaign's folder."""
    if not isinstance(name, str):
        raise InputError("must be a string", "wrong-type")
    if not name:
        raise InputError("must not be empty", "missing-value")
    folder: Path = (info.context or {}).get("folder", Path())
    return folder / record_file(name)


def parse_temperature(value: object) -> float:
    """Return a temperature, K."""
    if isinstance(value, Quantity):
        return _to_kelvin(value.value, value.unit)
    if not isinstance(value, str):
        raise InputError("must be a string", "wrong-type")
    match = _TEMPERATURE.fullmatch(value)
    if match is None:
        raise ValueError(f'{value!r} is not a temperature; write "23.4 degC" or "296.5 K"')
    return _to_kelvin(float(match[1]), match[2])


def _to_kelvin(value: float, scale: str) -> float:
    """Return a temperature in K; ValueError if no accelerometer works at it."""
    kelvin = value + TEMPERATURE_SCALES[scale]
    coldest, warmest = OPERATING_TEMPERATURES
    if not coldest <= kelvin <= warmest:
        raise OutOfRangeError(
            f"{value:g} {scale} is not plausible for an accelerometer; check the unit "
            f"({coldest - ZERO_CELSIUS:.5g} to {warmest - ZERO_CELSIUS:.5g} degC are accepted)"
        )
    return kelvin


def parse_temperatures(value: object) -> tuple[float, ...]:
    """Return one temperature or several in turn, K."""
    if not isinstance(value, list):
        return (parse_temperature(value),)
    if not value:
        raise InputError("must have at least one temperature", "missing-value")
    return tuple(parse_temperature(item) for item in value)


def temperature_scale(unit: str) -> str:
    """Return the scale of a column of temperatures."""
    if unit not in TEMPERATURE_SCALES:
        raise InputError(f"'{unit}' is not a temperature unit; use degC or K", "unknown-unit")
    return "K" if unit == "K" else "degC"


def parse_uncertain_temperature(text: str) -> Quantity:
    """Return a temperature with its standard uncertainty, K."""
    match = _UNCERTAIN_TEMPERATURE.fullmatch(text)
    if match is None:
        raise ValueError(f'{text!r} is not a temperature; write "23.4 ± 0.5 degC" or "296.5 K"')
    number = parse(f"{match[1]} 1", "1")
    return Quantity(_to_kelvin(number.value, match[2]), number.u, "K")


def date_or_text(value: object) -> str:
    """Return a date as text, or the written text instead."""
    if isinstance(value, datetime.date | datetime.datetime):
        return value.isoformat()
    if not isinstance(value, str):
        raise InputError("must be a date, or text", "invalid-date")
    return value


def _strict_integer(value: object) -> object:
    """Refuse true and 1.0, which Python takes for 1."""
    return value if type(value) is int else None


#: Where it is, what is wrong there, and the other keys on which that hangs: names in the file.
Contradiction = tuple[tuple[str | int, ...], str, *tuple[str, ...]]


class SettingsSection(BaseModel):
    """A table of ``campaign.toml`` in which every key must be known.

    What other tables say of it, such as the column of an accelerometer in SI by the site's gravity,
    are private attributes, each with a property: no key of the file, and part of the object.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, defer_build=True)

    def with_private(self, **values: object) -> Self:
        """Return the table with what other tables say of it, by the properties' names."""
        copy = self.model_copy()
        for name, value in values.items():
            setattr(copy, f"_{name}", value)
        return copy

    def contradictions(self) -> Iterator[Contradiction]:
        """Yield what is wrong among its keys, each of which is right by itself."""
        yield from ()

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Yield what the object is made of: its keys, and what other tables say."""
        yield from super().__repr_args__()
        yield from (self.__pydantic_private__ or {}).items()


def time_unit(unit: str) -> str:
    """Return a unit of time, or the unit of time stamps."""
    if unit != STAMPS:
        unit_factor(unit, "s")
    return unit


def angle_unit(unit: str, info: ValidationInfo) -> str:
    """Return a unit of angle or of counts; of pulses, one of time."""
    # Pulses are recorded by their times.
    if not (info.data.get("pulses") and is_unit(unit, "s")) and not is_unit(unit, "count"):
        unit_factor(unit, "rad")
    return unit


def is_unit(unit: str, wanted: str) -> bool:
    """Return whether a unit has the required dimension."""
    with suppress(ValueError):
        return bool(unit_factor(unit, wanted))
    return False


def direction_of_zero(value: object) -> float:
    """Return the direction of an encoder's zero, rad from east towards north."""
    if isinstance(value, str) and value in COMPASS:
        return COMPASS[value]
    try:
        return exact(value, "rad", usual="deg")
    except ValueError as error:
        raise InputError(
            f"{error}; or give one of {', '.join(COMPASS)}", error_code(error)
        ) from None


def check_encoding(name: str) -> str:
    """Return the name of an existing encoding."""
    try:
        codecs.lookup(name)
    except LookupError:
        raise InputError(
            f'unknown encoding "{name}"; common ones: utf-8, latin-1, utf-16', "unknown-choice"
        ) from None
    return name


def require_units(value: Any, info: ValidationInfo) -> Any:
    """Return quantities as they are written; a number alone is refused, with the likely unit.

    That is the one of the context's `units` by name, of which there may be only one, or else g.
    """
    units: Mapping[str, str] = (info.context or {}).get("units", {})
    default_unit = next(iter(units.values())) if len(set(units.values())) == 1 else "g"
    values = value if isinstance(value, Mapping) else {"": value}
    for name, items in values.items():
        for item in items if isinstance(items, list) else [items]:
            if isinstance(item, int | float) and not isinstance(item, bool):
                unit = units.get(name, default_unit)
                example = f'"{item!r} {unit}"'
                raise InputError(
                    f"has no unit; write the quantity as text, such as {example}",
                    "missing-unit",
                )
    return value


def as_list(value: Any) -> Any:
    """Return a single text as a list."""
    return [value] if isinstance(value, str) else value


Schema = Annotated[Literal[1], BeforeValidator(_strict_integer)]
Text = Annotated[str, Field(min_length=1)]
Components = Annotated[list[float], Field(min_length=3, max_length=3)]
Direction = Annotated[
    tuple[float, float, float],
    PlainValidator(read_direction, Literal[tuple(DIRECTIONS)] | Components),
]
AttitudeField = Annotated[Attitude, PlainValidator(read_attitude, Text | dict[str, Any])]
Ratio = Annotated[float, PlainValidator(parse_ratio, float | _written_form("1"))]
TableRatio = Annotated[float, PlainValidator(parse_table_ratio, float | Text)]
DateOrText = Annotated[str, PlainValidator(date_or_text, str | datetime.date)]
Fraction = Annotated[Quantity, PlainValidator(parse_fraction, str)]
ZeroDirection = Annotated[float, PlainValidator(direction_of_zero, Literal[tuple(COMPASS)] | str)]
TextList = Annotated[list[Text], BeforeValidator(as_list, Text | list[Text])]
PositiveRatio = Annotated[Ratio, AfterValidator(positive)]
Temperature = Annotated[float, PlainValidator(parse_temperature, Text)]
Temperatures = Annotated[tuple[float, ...], PlainValidator(parse_temperatures, Text | list[Text])]
RecordFile = Annotated[Path, PlainValidator(_in_folder, Text)]
Seconds = Annotated[float, read_exactly("s"), AfterValidator(positive)]


def key_field(
    meaning: str,
    example: Any,
    default: Any = PydanticUndefined,
    *,
    absent: str = "",
    kind: str = "",
    applies_to: str = "",
    **options: Any,
) -> Any:
    """Return a field with the texts of its documentation, schema and form.

    meaning: Meaning of the key, in Markdown.
    example: Value as read from TOML.
    absent: Effect of leaving the key out, if the default does not show it.
    kind: Form of the value, if the type does not show it.
    applies_to: Tables that have the key, if not all tables of the class.
    options: Options of `pydantic.Field`.
    """
    schema_extra = {"x-absent": absent, "x-kind": kind, "x-of": applies_to}
    extra: Any = {name: words for name, words in schema_extra.items() if words}
    return Field(
        default, description=meaning, examples=[example], json_schema_extra=extra, **options
    )


def extra_of(field: FieldInfo) -> dict[str, str]:
    """Return the extra data of a field from `key_field`, besides its meaning and its example."""
    extra: Any = field.json_schema_extra or {}
    return dict(extra)
