"""Types of values in TOML documents, with their validators and JSON Schemas.

Validators convert quantities to SI and g-units. The function of a validator is a partial function
of the unit, so that a form can show the unit.
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
    parse_quantity,
    read_attitude,
    read_direction,
)
from counterspin.errors import InputError, OutOfRangeError, error_code
from counterspin.physics.accelerometer import DIRECTIONS
from counterspin.records.format_registry import RECORD_FORMATS
from counterspin.units import (
    OPERATING_TEMPERATURES,
    TEMPERATURE_SCALES,
    ZERO_CELSIUS,
    is_convertible,
    unit_factor,
)

#: Unit name of time stamps in ISO 8601.
TIME_STAMP_UNIT: Final = "iso"

#: Compass direction -> angle from east towards north, rad.
COMPASS_ANGLES: Final = {
    name: quarter * math.pi / 2.0 for quarter, name in enumerate(("east", "north", "west", "south"))
}

#: Value in [noise] of a component that is estimated from the residuals.
ESTIMATE: Final = "estimate"

_UNCERTAIN_TEMPERATURE: Final = re.compile(r"\s*(.*?)\s*(degC|°C|K)\s*")
_TEMPERATURE: Final = re.compile(r"\s*([+-]?\d+\.?\d*(?:[eE][+-]?\d+)?)\s*(degC|°C|K)\s*")

#: Largest absolute ratio of the table's angle to that of the arm.
_MAX_TABLE_RATIO: Final = 16

#: Bounds of gravity on Earth, m/s^2.
_GRAVITY_RANGE: Final = (9.0, 11.0)


def parse_exact(
    text: object, unit: str, gravity: float | None = None, likely_unit: str | None = None
) -> float:
    """Parse a quantity that must not have an uncertainty."""
    quantity = parse_quantity(text, unit, gravity=gravity, likely_unit=likely_unit)
    if quantity.u != 0.0:
        raise InputError(
            f"{text!r}: this entry must not have an uncertainty; remove the ±", "wrong-uncertainty"
        )
    return quantity.value


def _context_gravity(info: ValidationInfo) -> float | None:
    return (info.context or {}).get("gravity")


def _validate_quantity(
    unit: str, text: object, info: ValidationInfo, likely_unit: str | None = None
) -> Quantity:
    if isinstance(text, Mapping):
        return parse_prior(text, unit, gravity=_context_gravity(info))
    return parse_quantity(text, unit, gravity=_context_gravity(info), likely_unit=likely_unit)


def _validate_exact(
    unit: str, text: object, info: ValidationInfo, likely_unit: str | None = None
) -> float:
    return parse_exact(text, unit, gravity=_context_gravity(info), likely_unit=likely_unit)


def _validate_noise(unit: str, text: object, info: ValidationInfo) -> float | str:
    if text == ESTIMATE:
        return ESTIMATE
    level = parse_exact(text, unit, _context_gravity(info))
    if level < 0.0:
        raise OutOfRangeError('a standard deviation cannot be negative; give a value or "estimate"')
    return level


def _validate_coefficient(unit: str, text: object, info: ValidationInfo) -> float:
    """Parse a coefficient, which may also be in the unit of the output, such as mA/g."""
    output = (info.context or {}).get("output")
    if output is not None and unit.startswith("g"):
        with suppress(ValueError):
            return parse_exact(text, output.unit + unit.removeprefix("g")) / float(
                output.sensitivity
            )
    return parse_exact(text, unit, gravity=_context_gravity(info))


def _quantity_pattern(unit: str, *, has_uncertainty: bool = False) -> Any:
    """Return a text type with the pattern of a quantity in a unit, for schemas."""
    uncertainty_pattern = rf"({PLUS_MINUS}{NUMBER})?" if has_uncertainty else ""
    number_pattern = f"[+−-]?{NUMBER.removeprefix('[+-]?')}"
    pattern = rf"^\s*{number_pattern}{uncertainty_pattern}(\s+[^\s±]|[^\d\s.±]).*$"
    return Annotated[str, Field(pattern=pattern, json_schema_extra={"x-unit": unit})]


class QuantityValidator(PlainValidator):
    """Validator of quantities: a partial function whose first argument is the unit.

    A form shows that unit. The generic validator of pydantic would build a serialiser and a schema
    for each of a hundred keys, and inspect the function's arguments, when the first campaign is
    read. Here the function takes the `ValidationInfo`, and the schema is built only on request.
    """

    def __get_pydantic_core_schema__(
        self, source_type: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return pydantic's schema for a value."""
        return core_schema.with_info_plain_validator_function(self.func)  # type: ignore[arg-type]

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the JSON Schema of the text, or of the text and the table."""
        text = TypeAdapter(self.json_schema_input_type).json_schema()
        if not (isinstance(self.func, partial) and self.func.func is _validate_quantity):
            return text
        return {"anyOf": [text, TABLE_SCHEMA], "x-unit": text["x-unit"]}


class _IsQuantity:
    """A type that no document can contain, and that schemas therefore omit."""

    def __get_pydantic_core_schema__(
        self, source_type: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Return the schema of an instance of `Quantity`."""
        return core_schema.is_instance_schema(Quantity)


#: A quantity that has already been parsed, such as a cell of a table.
ParsedQuantity = Annotated[Quantity, _IsQuantity()]


def uncertain_quantity(unit: str, likely_unit: str | None = None) -> PlainValidator:
    """Return the validator of a quantity; `likely_unit` as in `parse_quantity`."""
    return QuantityValidator(
        partial(_validate_quantity, unit, likely_unit=likely_unit),
        _quantity_pattern(unit, has_uncertainty=True),
    )


def parse_fraction(text: object, info: ValidationInfo) -> Quantity:
    """Parse a dimensionless quantity, with or without a unit such as ppm."""
    try:
        return _validate_quantity("1", text, info)
    except ValueError:
        return (
            _validate_quantity("1", f"{text} 1", info)
            if isinstance(text, str)
            else _validate_quantity("1", text, info)
        )


def check_clock_error(value: Quantity) -> Quantity:
    """Return the relative rate error of a clock, if it is plausible."""
    if abs(value.value) > 0.01:
        raise OutOfRangeError("a clock error above 1 % is implausible; check the unit of the time")
    return value


def exact_quantity(unit: str, likely_unit: str | None = None) -> PlainValidator:
    """Return the validator of an exact quantity; `likely_unit` as in `parse_quantity`."""
    return QuantityValidator(
        partial(_validate_exact, unit, likely_unit=likely_unit), _quantity_pattern(unit)
    )


def true_coefficient(unit: str) -> PlainValidator:
    """Return the validator of a true coefficient, in g-units or in units of the `output`."""
    return QuantityValidator(partial(_validate_coefficient, unit), _quantity_pattern(unit))


def check_positive(value: Any) -> Any:
    """Return a number or quantity if it is greater than zero."""
    if (value.value if isinstance(value, Quantity) else value) <= 0.0:
        raise OutOfRangeError("must be greater than zero")
    return value


def check_gravity(value: Any) -> Any:
    """Return a gravity if it is possible on the Earth's surface."""
    check_positive(value)
    magnitude = value.value if isinstance(value, Quantity) else value
    if not _GRAVITY_RANGE[0] < magnitude < _GRAVITY_RANGE[1]:
        raise OutOfRangeError(
            f"{magnitude:.6g} m/s^2 is not a possible value of gravity on Earth (about 9.8 "
            "m/s^2); check the number and its unit"
        )
    return value


def check_axis(value: str) -> str:
    """Return a name of a direction, if it is known."""
    read_direction(value)
    return value


def check_latitude(value: Any) -> Any:
    """Return an angle, or a quantity, if it can be a latitude."""
    magnitude = value.value if isinstance(value, Quantity) else value
    if abs(magnitude) > math.pi / 2.0 * (1.0 + 1e-12):
        raise OutOfRangeError("a latitude must be between -90 deg and 90 deg")
    return value


def check_zero_mean(value: Quantity) -> Quantity:
    """Return a quantity if its value is zero and its uncertainty is not."""
    if value.value != 0.0 or not value.u > 0.0:
        raise InputError(
            'must have the value zero and an uncertainty; write "0 ± 0.5 deg"', "wrong-uncertainty"
        )
    return value


def check_normal(value: Quantity) -> Quantity:
    """Return a quantity if its distribution is normal, as the errors of single readings are."""
    if value.distribution.shape != "normal":
        raise ValueError(
            "the random errors of individual readings are drawn from the normal distribution; "
            'write "VALUE ± U UNIT"'
        )
    return value


def noise_level(unit: str) -> PlainValidator:
    """Return the validator of a standard deviation, or of ``"estimate"``."""
    schema = _quantity_pattern(unit) | Literal["estimate"]
    return QuantityValidator(partial(_validate_noise, unit), schema)


def parse_ratio(value: object) -> float:
    """Parse a number, or text such as ``"5 ppm"``."""
    if isinstance(value, str):
        return parse_exact(value, "1")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError("must be a number", "not-numeric")
    if not math.isfinite(value):
        raise OutOfRangeError("must be a finite number")
    return float(value)


def parse_table_ratio(value: object) -> float:
    """Parse the ratio of the table's angle to that of the arm: a number, or a fraction as text."""
    try:
        if isinstance(value, bool):
            raise ValueError
        numerator, slash, denominator = str(value).partition("/")
        ratio = float(numerator) / (float(denominator) if slash else 1.0)
    except (ValueError, ZeroDivisionError):
        raise InputError("must be a number, or a fraction such as 1/2", "not-numeric") from None
    if not abs(ratio) <= _MAX_TABLE_RATIO:
        raise OutOfRangeError(f"must be between -{_MAX_TABLE_RATIO} and {_MAX_TABLE_RATIO}")
    return ratio


def check_rate_error(value: float) -> float:
    """Return a relative rate error if its magnitude is below 0.5."""
    if abs(value) >= 0.5:
        raise OutOfRangeError("is relative to the nominal rate; its magnitude must be below 0.5")
    return value


def _check_unit(target_unit: str, unit: str, info: ValidationInfo) -> str:
    unit_factor(unit, target_unit, gravity=_context_gravity(info))
    return unit


def convertible_unit(target_unit: str) -> AfterValidator:
    """Return the validator of a unit that converts to the target unit."""
    return AfterValidator(partial(_check_unit, target_unit))


#: Units of an accelerometer's output other than a specific force.
OUTPUT_UNITS: Final = ("V", "A", "count", "count/s")


def check_output_unit(unit: str, info: ValidationInfo) -> str:
    """Return a unit if it is that of a specific force, or of an output such as a current."""
    for output in OUTPUT_UNITS:
        with suppress(ValueError):
            unit_factor(unit, output)
            return unit
    unit_factor(unit, "m/s^2", gravity=_context_gravity(info))
    return unit


def check_file_name(name: str) -> str:
    """Return a file name if it has no control characters, which come from escaped backslashes."""
    if any(ord(character) < 32 for character in name):
        raise ValueError(
            f"{name!r} contains a line break, a tab or another control character, because TOML "
            "interprets a backslash in double quotation marks as an escape character; "
            f"{BACKSLASH_ADVICE}"
        )
    return name


def check_record_name(name: str) -> str:
    """Return the file name of a record if its extension is supported."""
    check_file_name(name)
    if PurePath(name).suffix.lower() not in RECORD_FORMATS:
        raise InputError(
            (
                f'"{name}" does not have a supported file type; the name of a record file must '
                f"end in {', '.join(RECORD_FORMATS)}"
            ),
            "wrong-file-ending",
        )
    return name


def _resolve_record(name: object, info: ValidationInfo) -> Path:
    """Return the path of a record file in the campaign's folder."""
    if not isinstance(name, str):
        raise InputError("must be a string", "wrong-type")
    if not name:
        raise InputError("must not be empty", "missing-value")
    folder: Path = (info.context or {}).get("folder", Path())
    return folder / check_record_name(name)


def parse_temperature(value: object) -> float:
    """Parse a temperature; return it in K."""
    if isinstance(value, Quantity):
        return _to_kelvin(value.value, value.unit)
    if not isinstance(value, str):
        raise InputError("must be a string", "wrong-type")
    match = _TEMPERATURE.fullmatch(value)
    if match is None:
        raise ValueError(f'{value!r} is not a temperature; write "23.4 degC" or "296.5 K"')
    return _to_kelvin(float(match[1]), match[2])


def _to_kelvin(value: float, scale: str) -> float:
    """Convert a temperature to K; ValueError if it is not plausible for an accelerometer."""
    kelvin = value + TEMPERATURE_SCALES[scale]
    min_temperature, max_temperature = OPERATING_TEMPERATURES
    if not min_temperature <= kelvin <= max_temperature:
        raise OutOfRangeError(
            f"{value:g} {scale} is not plausible for an accelerometer; check the unit "
            f"({min_temperature - ZERO_CELSIUS:.5g} to {max_temperature - ZERO_CELSIUS:.5g} degC "
            "are accepted)"
        )
    return kelvin


def parse_temperatures(value: object) -> tuple[float, ...]:
    """Parse one temperature, or a list of consecutive ones; return them in K."""
    if not isinstance(value, list):
        return (parse_temperature(value),)
    if not value:
        raise InputError("must have at least one temperature", "missing-value")
    return tuple(parse_temperature(item) for item in value)


def check_temperature_unit(unit: str) -> str:
    """Return the temperature scale of a unit, ``K`` or ``degC``."""
    if unit not in TEMPERATURE_SCALES:
        raise InputError(f"'{unit}' is not a temperature unit; use degC or K", "unknown-unit")
    return "K" if unit == "K" else "degC"


def parse_uncertain_temperature(text: str) -> Quantity:
    """Parse a temperature with its standard uncertainty; return it in K."""
    match = _UNCERTAIN_TEMPERATURE.fullmatch(text)
    if match is None:
        raise ValueError(f'{text!r} is not a temperature; write "23.4 ± 0.5 degC" or "296.5 K"')
    quantity = parse_quantity(f"{match[1]} 1", "1")
    return Quantity(_to_kelvin(quantity.value, match[2]), quantity.u, "K")


def format_date(value: object) -> str:
    """Return a date in ISO 8601, or text unchanged."""
    if isinstance(value, datetime.date | datetime.datetime):
        return value.isoformat()
    if not isinstance(value, str):
        raise InputError("must be a date, or text", "invalid-date")
    return value


def _reject_non_integer(value: object) -> object:
    """Return an integer, or None for values equal to an integer, such as true and 1.0."""
    return value if type(value) is int else None


#: Key path of a mistake, its message, and the names of the other keys that it involves.
Contradiction = tuple[tuple[str | int, ...], str, *tuple[str, ...]]


class SettingsSection(BaseModel):
    """A table of ``campaign.toml`` in which every key must be known.

    Values derived from other tables, such as the column of an accelerometer in SI with the site's
    gravity, are private attributes with a property.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, defer_build=True)

    def replace_private(self, **values: object) -> Self:
        """Return a copy of the table with private attributes, by the names of their properties."""
        copy = self.model_copy()
        for name, value in values.items():
            setattr(copy, f"_{name}", value)
        return copy

    def contradictions(self) -> Iterator[Contradiction]:
        """Yield contradictions between keys that are valid individually."""
        yield from ()

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Yield keys and private attributes with their values."""
        yield from super().__repr_args__()
        yield from (self.__pydantic_private__ or {}).items()


def check_time_unit(unit: str) -> str:
    """Return a unit if it is one of time, or that of time stamps."""
    if unit != TIME_STAMP_UNIT:
        unit_factor(unit, "s")
    return unit


def check_angle_unit(unit: str, info: ValidationInfo) -> str:
    """Return a unit if it is one of angle or counts, or of time for pulses."""
    # Pulses are recorded by their times.
    if not (info.data.get("pulses") and is_convertible(unit, "s")) and not is_convertible(
        unit, "count"
    ):
        unit_factor(unit, "rad")
    return unit


def parse_zero_direction(value: object) -> float:
    """Parse the direction of an encoder's zero; return it in rad from east towards north."""
    if isinstance(value, str) and value in COMPASS_ANGLES:
        return COMPASS_ANGLES[value]
    try:
        return parse_exact(value, "rad", likely_unit="deg")
    except ValueError as error:
        raise InputError(
            f"{error}; or give one of {', '.join(COMPASS_ANGLES)}", error_code(error)
        ) from None


def check_encoding(name: str) -> str:
    """Return the name of an encoding if it exists."""
    try:
        codecs.lookup(name)
    except LookupError:
        raise InputError(
            f'unknown encoding "{name}"; common ones: utf-8, latin-1, utf-16', "unknown-choice"
        ) from None
    return name


def require_units(value: Any, info: ValidationInfo) -> Any:
    """Return quantities unchanged; reject a number without a unit and suggest one.

    The suggested unit is that of the name in the context's `units`, their only unit, or else g.
    """
    units: Mapping[str, str] = (info.context or {}).get("units", {})
    default_unit = next(iter(units.values())) if len(set(units.values())) == 1 else "g"
    values = value if isinstance(value, Mapping) else {"": value}
    for name, entries in values.items():
        for entry in entries if isinstance(entries, list) else [entries]:
            if isinstance(entry, int | float) and not isinstance(entry, bool):
                unit = units.get(name, default_unit)
                example = f'"{entry!r} {unit}"'
                raise InputError(
                    f"has no unit; write the quantity as text, such as {example}", "missing-unit"
                )
    return value


def wrap_in_list(value: Any) -> Any:
    """Return a list with a single text; return other values unchanged."""
    return [value] if isinstance(value, str) else value


Schema = Annotated[Literal[1], BeforeValidator(_reject_non_integer)]
Text = Annotated[str, Field(min_length=1)]
Components = Annotated[list[float], Field(min_length=3, max_length=3)]
Direction = Annotated[
    tuple[float, float, float],
    PlainValidator(read_direction, Literal[tuple(DIRECTIONS)] | Components),
]
AttitudeField = Annotated[Attitude, PlainValidator(read_attitude, Text | dict[str, Any])]
Ratio = Annotated[float, PlainValidator(parse_ratio, float | _quantity_pattern("1"))]
TableRatio = Annotated[float, PlainValidator(parse_table_ratio, float | Text)]
DateOrText = Annotated[str, PlainValidator(format_date, str | datetime.date)]
Fraction = Annotated[Quantity, PlainValidator(parse_fraction, str)]
ZeroDirection = Annotated[
    float, PlainValidator(parse_zero_direction, Literal[tuple(COMPASS_ANGLES)] | str)
]
TextList = Annotated[list[Text], BeforeValidator(wrap_in_list, Text | list[Text])]
PositiveRatio = Annotated[Ratio, AfterValidator(check_positive)]
Temperature = Annotated[float, PlainValidator(parse_temperature, Text)]
Temperatures = Annotated[tuple[float, ...], PlainValidator(parse_temperatures, Text | list[Text])]
RecordFile = Annotated[Path, PlainValidator(_resolve_record, Text)]
Seconds = Annotated[float, exact_quantity("s"), AfterValidator(check_positive)]


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
    """Return a pydantic field with its documentation, example and form hints.

    meaning: Meaning of the key, in Markdown.
    example: Value as read from TOML.
    absent: Effect of leaving the key out, if the default does not show it.
    kind: Form of the value, if the type does not show it.
    applies_to: Tables that have the key, if not all tables of the class.
    options: Options of `pydantic.Field`.
    """
    extra_texts = {"x-absent": absent, "x-kind": kind, "x-of": applies_to}
    json_schema_extra: Any = {name: text for name, text in extra_texts.items() if text}
    return Field(
        default,
        description=meaning,
        examples=[example],
        json_schema_extra=json_schema_extra,
        **options,
    )


def field_extra(field: FieldInfo) -> dict[str, str]:
    """Return the form hints that `key_field` stored in a field."""
    extra: Any = field.json_schema_extra or {}
    return dict(extra)
