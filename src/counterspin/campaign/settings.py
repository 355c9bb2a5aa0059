"""Keys of ``campaign.toml`` by section, as strict pydantic models.

Unknown keys are mistakes. The models convert quantities to SI and g-units; values that depend on
several sections (axes, priors, attitudes) are resolved in `resolution`.

The keys for coefficients are generated from the term tables.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Annotated, Any, Final

from pydantic import AfterValidator, BeforeValidator, PlainValidator, ValidationInfo

from counterspin.campaign.field_types import (
    DateOrText,
    Fraction,
    SettingsSection,
    Temperature,
    Text,
    TextList,
    check_clock_error,
    check_gravity,
    check_latitude,
    check_positive,
    check_record_name,
    check_zero_mean,
    exact_quantity,
    key_field,
    noise_level,
    parse_exact,
    uncertain_quantity,
)
from counterspin.campaign.quantity import Quantity, normalize_latitude
from counterspin.errors import InputError, OutOfRangeError
from counterspin.inference.noise.components import BIAS_COMPONENTS_BY_KEY, COMPONENTS_BY_KEY
from counterspin.physics.terms import Term
from counterspin.units import normalise_unit, unit_factor

#: Recorded quantity of an accelerometer -> SI unit.
OBSERVABLES: Final = {"displacement": "m", "velocity": "m/s", "specific_force": "m/s^2"}

#: Key of [noise] -> SI unit.
NOISE_UNITS: Final[dict[str, str]] = {
    **OBSERVABLES,
    **{key: row.unit for key, row in COMPONENTS_BY_KEY.items()},
    "quantisation": "m",
    "angle": "rad",
    "timing": "s",
}


class CampaignSettings(SettingsSection):
    """[campaign]: heading and identification for reports; optional free text."""

    title: Text | None = key_field(
        "heading of the report", "Spring campaign", None, absent="name of the folder"
    )
    serial_number: Text | None = key_field("serial number of the platform", "A-17", None)
    date: DateOrText | None = key_field(
        "date of the campaign", datetime.date(2026, 3, 1), None, kind="date or text"
    )
    laboratory: Text | None = key_field("place of the campaign", "Hall 3", None)
    mounting: Text | None = key_field(
        "label of the mounting; use a new label each time the accelerometers are removed and "
        "remounted",
        "2026-03 B",
        None,
    )
    turn_on: Text | None = key_field(
        "label of the power cycle; use a new label each time the accelerometers are switched off "
        "and on",
        "2026-03-01 a",
        None,
    )
    operator: Text | None = key_field("operator", "N. N.", None)
    comment: Text | None = key_field("remarks", "after repair", None)


class SiteSettings(SettingsSection):
    """[site]: gravity and latitude of the centrifuge."""

    gravity: Annotated[Quantity, uncertain_quantity("m/s^2"), AfterValidator(check_gravity)] = (
        key_field(
            "local gravity (magnitude along the plumb line); also defines g in all g-units",
            "9.8066 ± 1e-5 m/s^2",
        )
    )
    latitude: Annotated[
        Quantity,
        uncertain_quantity("rad", "deg"),
        BeforeValidator(normalize_latitude),
        AfterValidator(check_latitude),
    ] = key_field("latitude, used for the components of the Earth's rotation", "45.75 ± 0.001 deg")
    removed_gravity: (
        Annotated[float, exact_quantity("m/s^2"), AfterValidator(check_gravity)] | None
    ) = key_field(
        "constant value of gravity that the navigation computer subtracts; see below",
        "9.80665 m/s^2",
        None,
        absent="gravity of the site",
    )


class CentrifugeSettings(SettingsSection):
    """[centrifuge]: dimensions and errors of the centrifuge."""

    radius: Annotated[Quantity, uncertain_quantity("m"), AfterValidator(check_positive)] = (
        key_field("radius from the spindle axis to the centre of the platform", "2.5 ± 1e-5 m")
    )
    stretch: Annotated[Quantity, uncertain_quantity("s^2/m")] | None = key_field(
        "relative increase in radius per m/s^2 of centripetal acceleration; if absent, 0 with the "
        "default standard uncertainty",
        "0 ± 5e-9 s^2/m",
        None,
    )
    droop: Annotated[Quantity, uncertain_quantity("rad s^2")] | None = key_field(
        "rotation about the forward axis, divided by the square of the rate; positive if the "
        "outer end moves down; if absent, 0 with the default standard uncertainty",
        "0 ± 1e-8 rad s^2",
        None,
    )
    axis_tilt: Annotated[Quantity, uncertain_quantity("rad", "arcsec")] | None = key_field(
        "tilt of the spindle axis about east and about north; if absent, 0 with the default "
        "standard uncertainty",
        "0 ± 5 arcsec",
        None,
    )
    clock: Annotated[Fraction, AfterValidator(check_clock_error)] | None = key_field(
        "relative rate error of the clock that measures the rates of readings; positive if the "
        "clock runs fast. By default, counterspin uses the clock of `[records]` or, if that is not "
        "stated either, the default standard uncertainty",
        "0 ± 2 ppm",
        None,
        kind="number ± or value ± in ppm",
    )
    strapped: bool = key_field(
        "whether the recorded accelerometers are strapped to the counter-rotating table. If true, "
        "table errors rotate them; if false, a platform maintains their attitude",
        True,
        False,
    )
    reference_temperature: Temperature | None = key_field(
        "reference temperature of the temperature slopes; by default, the mean of all temperatures",
        "23 degC",
        None,
        kind="text",
    )


class FixtureSettings(SettingsSection):
    """[fixture]: uncertainty of positions at rest."""

    position: (
        Annotated[Quantity, uncertain_quantity("rad"), AfterValidator(check_zero_mean)] | None
    ) = key_field(
        "angular error of a [position at rest](readings.md#positions-set-by-hand), about "
        "east and about north; common to all readings in that position",
        "0 ± 0.5 deg",
        None,
    )


def _parse_sensitivity(value: object, info: ValidationInfo) -> float:
    """Parse the nominal output per g, which may be omitted for an output in g."""
    unit = info.data.get("unit")
    if unit is None:
        return math.nan  # already reported
    if value is None:
        try:
            return unit_factor("g", unit)
        except ValueError:
            example = 1.25
            with suppress(ValueError):
                example = unit_factor("g", unit, gravity=9.80665)
            raise InputError(
                f'is missing; give the nominal output, such as "{example:g} {unit}/g"',
                "missing-key",
            ) from None
    sensitivity = parse_exact(value, f"{unit}/g")
    if sensitivity == 0.0:
        raise OutOfRangeError("must not be zero")
    return sensitivity


def _parse_zero_output(value: object, info: ValidationInfo) -> float:
    """Parse the nominal output at zero specific force."""
    unit = info.data.get("unit")
    return 0.0 if unit is None else parse_exact(value, unit)


class Output(SettingsSection):
    """``output``: unit of an accelerometer's readings, nominal sensitivity and zero."""

    unit: Annotated[Text, AfterValidator(normalise_unit)] = key_field("unit of the readings", "mA")
    # Number in that unit per g.
    sensitivity: Annotated[float, PlainValidator(_parse_sensitivity, Text)] = key_field(
        "nominal sensitivity, required unless the output is in g-units; K_I is the true "
        "sensitivity divided by this value",
        "1.25 mA/g",
        None,
        absent="exactly 1 if the output is in `g`, `mg` or a similar unit",
        kind="text",
        validate_default=True,
    )
    zero: Annotated[float, PlainValidator(_parse_zero_output, Text)] = key_field(
        "nominal output at zero specific force; K_F is the true output minus this value",
        "4 mA",
        0.0,
        absent="0",
        kind="text",
    )

    def to_g(self, reading: Any) -> Any:
        """Convert readings to g by the nominal sensitivity and zero; same shape."""
        return (reading - self.zero) / self.sensitivity

    def from_g(self, force: Any) -> Any:
        """Convert forces in g to outputs by the nominal sensitivity and zero; same shape."""
        return self.zero + self.sensitivity * force


def term_keys(
    rows: Mapping[str, Term[Any]], make_validator: Callable[[str], PlainValidator]
) -> dict[str, Any]:
    """Return an optional field for each term name, which validates a quantity in its unit."""
    # Types are expensive to create, and dozens of terms share a few units.
    type_by_unit = {
        unit: Annotated[Quantity | float, make_validator(unit)] | None
        for unit in dict.fromkeys(row.unit for row in rows.values())
    }
    return {
        name: (
            type_by_unit[row.unit],
            key_field(row.words, _format_example(row, make_validator), None),
        )
        for name, row in rows.items()
    }


def _format_example(row: Term[Any], make_validator: Callable[[str], PlainValidator]) -> str:
    """Return an example for a term: its prior, or its true value."""
    if make_validator is uncertain_quantity:
        return f"{row.nominal:g} ± {row.typical:g} {row.unit}".replace("e-0", "e-")
    return f"{row.nominal + row.typical:.9g} {row.unit}".replace("e-0", "e-")


class StatedNoise(SettingsSection):
    """[noise] and [truth.noise]: standard deviations per sample, SI."""

    displacement: Annotated[float | str, noise_level("m")] = key_field(
        "white noise per sample of a recorded displacement", "0.01 m", 0.0, kind="quantity, m"
    )
    velocity: Annotated[float | str, noise_level("m/s")] = key_field(
        "white noise per sample of a recorded velocity", "1e-4 m/s", 0.0, kind="quantity, m/s"
    )
    specific_force: Annotated[float | str, noise_level("m/s^2")] = key_field(
        "white noise per sample of a recorded specific force",
        "10 ug",
        0.0,
        kind="quantity, m/s^2 or g",
    )
    acceleration: Annotated[float | str, noise_level("m/s^2/Hz^0.5")] = key_field(
        "white noise of the accelerometer: velocity random walk coefficient N, "
        "which gives a velocity variance of N^2 t",
        "estimate",
        0.0,
        kind="quantity, m/s^2/Hz^0.5 or g/Hz^0.5",
    )
    flicker: Annotated[float | str, noise_level("m/s^2")] = key_field(
        "bias instability B: the minimum of the Allan deviation is 0.664 B",
        "2 ug",
        0.0,
        kind="quantity, m/s^2 or g",
    )
    bias_walk: Annotated[float | str, noise_level("m/s^2/s^0.5")] = key_field(
        "bias random walk K: the variance of the bias grows by K^2 per second",
        "0.5 ug/h^0.5",
        0.0,
        kind="quantity, m/s^2/s^0.5 or g/s^0.5",
    )
    quantisation: Annotated[float | str, noise_level("m")] = key_field(
        "resolution of the recorded displacement", "1 mm", 0.0, kind="quantity, m"
    )
    angle: Annotated[float | str, noise_level("rad")] = key_field(
        "encoder noise, which the calibration estimates unless the time stamps have jitter",
        "1e-6 rad",
        0.0,
        kind="quantity, rad",
    )
    timing: Annotated[float | str, noise_level("s")] = key_field(
        "standard deviation of the time stamp errors (jitter)", "1 us", 0.0, kind="quantity, s"
    )

    @property
    def wanders(self) -> bool:
        """True if the bias wanders, or if its wander is estimated."""
        return any(getattr(self, key) != 0.0 for key in BIAS_COMPONENTS_BY_KEY)


class NoiseSettings(StatedNoise):
    """[noise]: noise levels, or a static record from which they are estimated."""

    rest: Annotated[Text, AfterValidator(check_record_name)] | None = key_field(
        "record at rest from which counterspin estimates the noise components that this table "
        "omits",
        "rest.csv",
        None,
        alias="from",
    )


class ModelSettings(SettingsSection):
    """[model]: requested terms and priors."""

    terms: list[Text] | None = key_field(
        "requested terms; each term is a row of the result",
        ["K_F", "K_II", "platform.tilt"],
        None,
        absent="K_F, K_I, K_II, K_III",
        kind="list of terms",
    )
    assume: TextList = key_field(
        "terms and inputs that are assumed to be perfect and do not contribute to u, unless a "
        "prior is stated",
        ["K_OO", "platform.*"],
        [],
        absent="none",
        kind='list of terms and inputs, or `"all"`',
    )
    hold: list[Text] = key_field(
        "terms and inputs whose values the fit does not adjust, but whose uncertainties "
        "contribute to u (considered parameters, Schmidt)",
        ["K_PP"],
        [],
        absent="none",
        kind="list of terms and inputs",
    )
    considered: list[Text] = key_field(
        "former name of `hold`", ["K_PP"], [], absent="none", kind="list of terms"
    )
    priors: dict[str, Any] = key_field(
        "priors, keyed by term; the terms need not be requested; a table specifies [a "
        "distribution](methods.md#distributions-and-monte-carlo)",
        {"platform.tilt": "0 ± 0.5 arcsec", "Qx.K_PP": "0 ± 2e-6 g/g^2"},
        {},
        absent="none",
    )
    limits: dict[str, Any] = key_field(
        "largest credible magnitude, by term",
        {"K_II": "1e-3 g/g^2"},
        {},
        absent="by [grade](physics.md#sources-of-the-typical-sizes)",
    )
    typical: dict[str, Any] = key_field(
        "default standard uncertainty, by term, for terms without a prior",
        {"platform.tilt": "0.2 arcsec"},
        {},
        absent="by grade",
    )

    @property
    def held_terms(self) -> tuple[str, list[str]]:
        """The key of the considered terms, new or former, and their names."""
        return ("considered", self.considered) if self.considered else ("hold", self.hold)
