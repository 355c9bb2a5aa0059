"""Conversion of units: from user input to SI and g-units, and from these to SI in D-SI notation.

Only the units of `UNITS` are known, in products, quotients and powers (``g/Hz^0.5``,
``m^-1 s^2``, ``deg/h/g``). A general unit library would be dangerous here: it takes 50 Hz for
50 rad/s and ug for a microgram.

Angle is a dimension of its own, so that a rotation rate is not confused with a relative drift in
1/s. The site's gravity g is another, so that coefficients stay in g-units. If the site's gravity
is given, m/s^2 and g are convertible.

A coefficient in g/g^n multiplies a_I^n if forces are in units of the site's g. With forces in
m/s^2 it is the same number times g^(1-n): K_II in g/g^2 becomes K_II/g in (m/s^2)/(m/s^2)^2,
which is s^2/m (SI brochure, 9th edition).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Final

from counterspin.errors import InputError
from counterspin.frozen import frozen

#: Conventional gravity, m/s^2, used if the site's gravity is not given.
STANDARD_GRAVITY: Final = 9.80665
#: Kelvin at 0 degC.
ZERO_CELSIUS: Final = 273.15

#: Accepted temperature scale -> offset to K.
TEMPERATURE_SCALES: Final = {"degC": ZERO_CELSIUS, "°C": ZERO_CELSIUS, "K": 0.0}

#: Lowest and highest temperature at which an accelerometer works, K.
OPERATING_TEMPERATURES: Final = (100.0, 600.0)

#: Base dimensions.
BASE_DIMENSIONS: Final = (
    "[length]",
    "[time]",
    "[angle]",
    "[gravity]",
    "[voltage]",
    "[current]",
    "[count]",
    "[temperature]",
)

#: Accepted unit -> (factor, unit of the factor). Dimensions of base units are in brackets.
UNITS: Final[Mapping[str, tuple[float, str]]] = {
    "m": (1.0, "[length]"),
    "s": (1.0, "[time]"),
    "rad": (1.0, "[angle]"),
    "g": (1.0, "[gravity]"),
    "V": (1.0, "[voltage]"),
    "A": (1.0, "[current]"),
    "count": (1.0, "[count]"),
    "K": (1.0, "[temperature]"),
    "mV": (1e-3, "V"),
    "uV": (1e-6, "V"),
    "mA": (1e-3, "A"),
    "uA": (1e-6, "A"),
    "nA": (1e-9, "A"),
    "pulse": (1.0, "count"),
    "Gal": (1e-2, "m/s^2"),
    "mGal": (1e-5, "m/s^2"),
    "mm": (1e-3, "m"),
    "um": (1e-6, "m"),
    "nm": (1e-9, "m"),
    "cm": (1e-2, "m"),
    "km": (1e3, "m"),
    "in": (0.0254, "m"),
    "ft": (0.3048, "m"),
    "ms": (1e-3, "s"),
    "us": (1e-6, "s"),
    "ns": (1e-9, "s"),
    "min": (60.0, "s"),
    "h": (3600.0, "s"),
    "d": (86400.0, "s"),
    "mrad": (1e-3, "rad"),
    "urad": (1e-6, "rad"),
    "nrad": (1e-9, "rad"),
    "deg": (math.pi / 180.0, "rad"),
    "gon": (math.pi / 200.0, "rad"),
    "arcmin": (math.pi / 10800.0, "rad"),
    "arcsec": (math.pi / 648000.0, "rad"),
    "rev": (2.0 * math.pi, "rad"),
    "rpm": (2.0 * math.pi / 60.0, "rad/s"),
    "mg": (1e-3, "g"),
    "ug": (1e-6, "g"),
    "ng": (1e-9, "g"),
    "Hz": (1.0, "1/s"),
    "kHz": (1e3, "1/s"),
    "ppm": (1e-6, ""),
    "ppb": (1e-9, ""),
}

#: Unit -> name of the quantity and suggested units, for messages.
QUANTITIES: Final[Mapping[str, tuple[str, str]]] = {
    "m": ("a length", "m, mm, um, km"),
    "s": ("a time", "s, ms, us, min, h"),
    "rad": ("an angle", "rad, mrad, urad, deg, arcmin, arcsec, rev"),
    "rad/s": ("an angular rate", "rad/s, deg/s, deg/h, rpm, rev/s"),
    "1/s": ("a relative drift", "1/s, 1/h, ppm/h"),
    "m/s": ("a velocity", "m/s, mm/s"),
    "m/s^2": ("an acceleration", "m/s^2, mm/s^2"),
    "Hz": ("a frequency", "Hz, kHz, 1/s"),
    "1": ("a dimensionless ratio", "1, ppm"),
    "m/s^2/Hz^0.5": ("a random-walk coefficient", "g/Hz^0.5, ug/Hz^0.5, m/s^2/Hz^0.5, m/s/s^0.5"),
    "m/s^2/s^0.5": ("a bias random walk", "ug/h^0.5, g/s^0.5, m/s^2/s^0.5"),
    "g": ("a specific force", "g, mg, ug"),
    "g/g": ("a scale factor", "g/g, ppm"),
    "g/g^2": ("a second-order coefficient", "g/g^2, mg/g^2, ug/g^2"),
    "g/g^3": ("a third-order coefficient", "g/g^3, mg/g^3, ug/g^3"),
    "g/g^4": ("a fourth-order coefficient", "g/g^4, ug/g^4, ng/g^4"),
    "g/g^5": ("a fifth-order coefficient", "g/g^5, ug/g^5, ng/g^5"),
    "g s^2/rad^2": ("a spin coefficient", "g s^2/rad^2, mg s^2/rad^2"),
    "g s^2/rad": ("a coefficient of angular acceleration", "g s^2/rad, mg s^2/rad"),
    "rad/s/g": ("a gyro g-sensitivity", "deg/h/g, rad/s/g"),
    "rad/s/g^2": ("a gyro g^2-sensitivity", "deg/h/g^2, rad/s/g^2"),
    "rad/g": ("a compliance", "arcsec/g, rad/g"),
    "s^2/m": ("a relative elongation per acceleration", "s^2/m, ppm/g"),
}

#: Largest number of characters of a unit.
_MAX_UNIT_LENGTH: Final = 500

# A name with an optional power, the 1 of "1/s", or an operator. Nothing else is evaluated.
_UNIT_FACTOR_PATTERN = re.compile(
    r"\s*(?:([A-Za-z]+)(?:\^([+-]?\d{1,2}(?:\.\d{1,3})?))?|(?<![A-Za-z0-9])(1)(?=\s*(?:/|$))|([*/()]))\s*"
)


@lru_cache(maxsize=256)
def unit_factor(unit: str, target_unit: str, *, gravity: float | None = None) -> float:
    """Return the factor that converts a number in `unit` to `target_unit`.

    unit: Unit as written, such as ``deg/h/g``.
    target_unit: Required unit, such as ``rad/s/g``.
    gravity: The site's gravity in m/s^2, for conversions between g and m/s^2.
    """
    quantity, accepted_units = expected_quantity(target_unit)
    expression = _to_ascii(unit)
    names = _unit_names(expression, quantity, accepted_units)
    if not names <= set(UNITS):
        unknown_names_text = ", ".join(sorted(repr(name) for name in names - set(UNITS)))
        raise InputError(
            f"unknown unit {unknown_names_text}; {quantity} is required ({accepted_units})",
            "unknown-unit",
        )
    if names & {"Hz", "kHz"} and "Hz" not in target_unit:
        if target_unit == "rad/s":
            raise InputError(
                f"{unit!r} is ambiguous for an angular rate: write rev/s for revolutions per "
                f"second, or rad/s ({accepted_units})",
                "wrong-unit",
            )
        raise InputError(
            f"{unit!r} is a frequency; {quantity} is required ({accepted_units})", "wrong-unit"
        )
    factor, dimension = _evaluate_unit(expression)
    target_factor, target_dimension = _evaluate_unit(target_unit)
    factor /= target_factor
    excess_dimension = {name: dimension[name] - target_dimension[name] for name in BASE_DIMENSIONS}
    # The excess may be a power of (m/s^2)/g, which the site's gravity resolves.
    length_power = excess_dimension["[length]"]
    gravity_dimension = dict.fromkeys(BASE_DIMENSIONS, 0.0)
    gravity_dimension |= {
        "[length]": length_power,
        "[time]": -2.0 * length_power,
        "[gravity]": -length_power,
    }
    if excess_dimension != gravity_dimension or (length_power != 0.0 and gravity is None):
        noun = quantity.split(" ", 1)[1]
        output_unit = noun.removeprefix("quantity in ")
        problem = (
            f"is not a unit of {noun}"
            if output_unit == noun
            else f"cannot be converted to {output_unit}"
        )
        raise InputError(
            f"{unit!r} {problem}; use {accepted_units}",
            "wrong-unit",
        )
    if length_power != 0.0 and gravity is not None:
        factor *= gravity**-length_power
    return factor


@lru_cache(maxsize=256)
def is_convertible(unit: str, target_unit: str) -> bool:
    """Return whether a unit is convertible to another one; an empty text is not."""
    try:
        return bool(unit) and unit_factor(unit, target_unit, gravity=STANDARD_GRAVITY) > 0.0
    except (KeyError, ValueError):  # KeyError: unknown target
        return False


def _to_ascii(unit: str) -> str:
    """Return a unit with special characters replaced: µ, °, ·, ², ³ and **."""
    expression = unit.strip().replace("**", "^").replace("µ", "u").replace("μ", "u")
    return expression.replace("°", "deg").replace("·", "*").replace("²", "^2").replace("³", "^3")


def normalise_unit(unit: str) -> str:
    """Return a unit in plain characters; ValueError if it is unknown."""
    expression = _to_ascii(unit[:_MAX_UNIT_LENGTH])
    problem = f"{unit!r} is an unknown unit"
    try:
        is_known = _unit_names(expression, problem, "m, V, mA, ...") <= set(UNITS)
        factor, _ = _evaluate_unit(expression) if is_known else (math.nan, {})
    except ValueError as error:
        raise ValueError(problem) from error
    if not 0.0 < factor < math.inf:
        raise ValueError(problem)
    return expression


def is_same_unit(unit: str, other_unit: str, *, gravity: float | None = None) -> bool:
    """Return whether two units are equal, regardless of their notation.

    gravity: The site's gravity in m/s^2, for comparing g and m/s^2.
    """
    try:
        return math.isclose(unit_factor(unit, normalise_unit(other_unit), gravity=gravity), 1.0)
    except ValueError:
        return False


def base_unit(unit: str) -> tuple[float, Mapping[str, float]]:
    """Return the factor of a unit to base units, and the powers of `BASE_DIMENSIONS`."""
    return _evaluate_unit(normalise_unit(unit))


def expected_quantity(unit: str) -> tuple[str, str]:
    """Return the name of the quantity with a unit, and the accepted units."""
    return QUANTITIES.get(unit, (f"a quantity in {unit}", unit))


def _unit_names(expression: str, quantity: str, accepted_units: str) -> set[str]:
    """Return the unit names in an expression; InputError if it is malformed."""
    if re.search(r"[*/]\s*[*/]", expression):
        raise InputError(
            f"{expression!r} is not a unit; {quantity} is required ({accepted_units})",
            "unknown-unit",
        )
    names, position = set(), 0
    while position < len(expression):
        match = _UNIT_FACTOR_PATTERN.match(expression, position)
        if match is None:
            raise InputError(
                f"{expression!r} is not a unit; {quantity} is required ({accepted_units})",
                "unknown-unit",
            )
        if match[1]:
            names.add(match[1])
        position = match.end()
    return names


@lru_cache(maxsize=256)
def _evaluate_unit(expression: str) -> tuple[float, Mapping[str, float]]:
    """Return factor to base units and dimension of an expression checked by `_unit_names`.

    Adjacent units are multiplied, as with a * between them.
    """
    factor, dimension = 1.0, dict.fromkeys(BASE_DIMENSIONS, 0.0)
    bracket_signs = [1.0]  # of open brackets: -1 in a denominator
    sign, needs_factor = 1.0, bool(expression.strip())
    for name, power, _, symbol in _UNIT_FACTOR_PATTERN.findall(expression):
        if symbol == "(":
            bracket_signs.append(bracket_signs[-1] * sign)
        elif (symbol and needs_factor) or (symbol == ")" and len(bracket_signs) == 1):
            raise _incomplete_unit_error(expression)
        elif symbol == ")":
            bracket_signs.pop()
        elif name:
            exponent = bracket_signs[-1] * sign * float(power or 1.0)
            named_factor, unit_dimension = _look_up_unit(name)
            factor *= _raise_to_power(named_factor, exponent)
            for base_dimension, base_power in unit_dimension.items():
                dimension[base_dimension] += base_power * exponent
        sign, needs_factor = -1.0 if symbol == "/" else 1.0, symbol in ("(", "*", "/")
    if needs_factor or len(bracket_signs) > 1:
        raise _incomplete_unit_error(expression)
    return factor, dimension


def _raise_to_power(base: float, exponent: float) -> float:
    try:
        return float(base**exponent)
    except OverflowError:
        return math.inf


def _look_up_unit(name: str) -> tuple[float, Mapping[str, float]]:
    """Return the factor to base units, and the dimension, of a unit in `UNITS`."""
    factor, definition = UNITS[name]
    if definition in BASE_DIMENSIONS:
        return factor, {definition: 1.0}
    definition_factor, dimension = _evaluate_unit(definition)
    return factor * definition_factor, dimension


def _incomplete_unit_error(expression: str) -> ValueError:
    return InputError(
        f"{expression!r} is not a unit: a factor or a parenthesis is missing", "unknown-unit"
    )


# Conversion to SI units ------------------------------------------------------------------------

_SI_FACTOR: Final = re.compile(r"(1|rad|m|s|g|Hz)(?:\^(\d))?")

#: Unit -> powers of radian, metre, second and g.
_SI_POWERS: Final = {
    "1": (0, 0, 0, 0),
    "rad": (1, 0, 0, 0),
    "m": (0, 1, 0, 0),
    "s": (0, 0, 1, 0),
    "Hz": (0, 0, -1, 0),
    "g": (0, 1, -2, 1),
}


#: Field of `SiUnit` -> its symbol.
_SI_SYMBOLS: Final = {"radian": "rad", "metre": "m", "second": "s", "ampere": "A", "volt": "V"}


@frozen
class SiUnit:
    """A product of powers of the radian, the metre, the second, the ampere and the volt."""

    radian: int = 0
    metre: int = 0
    second: int = 0
    ampere: int = 0
    volt: int = 0

    def __mul__(self, other: SiUnit) -> SiUnit:
        """Return the unit of a product."""
        return SiUnit(**{name: getattr(self, name) + getattr(other, name) for name in _SI_SYMBOLS})

    @property
    def dsi_text(self) -> str:
        r"""The unit in D-SI: ``\metre\tothe{-1}\second\tothe{2}``; ``\one`` for a number."""
        parts = (
            rf"\{name}" + ("" if power == 1 else rf"\tothe{{{power}}}")
            for name in _SI_SYMBOLS
            if (power := getattr(self, name))
        )
        return "".join(parts) or r"\one"

    @property
    def plain_text(self) -> str:
        """The unit in plain text: ``m^-1 s^2``; ``1`` for a number."""
        parts = (
            symbol + ("" if power == 1 else f"^{power}")
            for name, symbol in _SI_SYMBOLS.items()
            if (power := getattr(self, name))
        )
        return " ".join(parts) or "1"


def si_unit(unit: str) -> tuple[SiUnit, int]:
    """Return a unit in SI and the power of g (m/s^2) in the conversion.

    unit: Unit in a result: ``g/g^2``, ``rad/s/g``, ``m``, ``g s^2/rad``.
    """
    powers = [0, 0, 0, 0]
    numerator, *denominators = unit.split("/")
    for factor, sign in [
        *((factor, 1) for factor in numerator.split(" ")),
        *((factor, -1) for factor in denominators),
    ]:
        match = _SI_FACTOR.fullmatch(factor)
        if match is None:
            raise ValueError(f"{unit!r} is not a unit supported in certificates")
        exponent = int(match[2] or 1) * sign
        powers = [
            total + exponent * power
            for total, power in zip(powers, _SI_POWERS[match[1]], strict=True)
        ]
    radian, metre, second, gravity = powers
    return SiUnit(radian, metre, second), gravity


#: Dimension -> field of `SiUnit`; counts are numbers, and the power of g is separate.
_SI_FIELDS: Final = {
    "[angle]": "radian",
    "[length]": "metre",
    "[time]": "second",
    "[current]": "ampere",
    "[voltage]": "volt",
}


def instrument_unit_in_si(unit: str) -> tuple[float, SiUnit, int]:
    """Return an instrument's unit in SI: factor, unit, and power of g (m/s^2).

    1 mA/g is 1e-3 A/g, which is 1e-3 / g in A/(m/s^2).

    unit: Unit of the readings, such as ``mA`` or ``count/s``, or this unit over g.
    """
    factor, powers = base_unit(unit)
    gravity = powers["[gravity]"]
    field_powers = {field: powers[dimension] for dimension, field in _SI_FIELDS.items()}
    field_powers["metre"] += gravity
    field_powers["second"] -= 2.0 * gravity
    if powers["[temperature]"] or not all(
        power.is_integer() for power in (*field_powers.values(), gravity)
    ):
        raise ValueError(f"{unit!r} is not a product of integer powers of rad, m, s, A, V and g")
    converted_unit = SiUnit(**{field: int(power) for field, power in field_powers.items()})
    return factor, converted_unit, int(gravity)


def to_si(value: float, unit: str, gravity: float) -> float:
    """Convert a number to SI; `gravity` is the g of the unit, m/s^2."""
    return value * gravity ** si_unit(unit)[1]


def from_si(value: float, unit: str, gravity: float) -> float:
    """Convert a number in SI to the unit of a result; the inverse of `to_si`."""
    return value / gravity ** si_unit(unit)[1]
