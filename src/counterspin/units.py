"""Units as people write them, to SI and g-units, and from those to SI as D-SI writes them.

Only the units of `UNITS` are known, in products, quotients and powers (``g/Hz^0.5``,
``m^-1 s^2``, ``deg/h/g``). A general unit library would be a trap here: it takes 50 Hz for
50 rad/s and ug for a microgram.

Three things are dimensions of their own. Angle is one, so that a rotation rate is not confused
with a relative drift in 1/s. The site's gravity g is one, so that coefficients stay in g-units.
Where the site's gravity is given, m/s^2 and g convert into each other.

A coefficient in g/g^n multiplies a_I^n where forces are counted in the site's own g. Counted in
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

#: Conventional gravity, m/s^2, where no site states its own.
STANDARD_GRAVITY: Final = 9.80665
#: Kelvin at 0 degC.
ZERO_CELSIUS: Final = 273.15

#: Temperature scales that may be written -> what is added to their numbers for K.
TEMPERATURE_SCALES: Final = {"degC": ZERO_CELSIUS, "°C": ZERO_CELSIUS, "K": 0.0}

#: Lowest and highest temperature at which an accelerometer works, K.
WORKING_TEMPERATURES: Final = (100.0, 600.0)

#: The dimensions.
BASES: Final = (
    "[length]",
    "[time]",
    "[angle]",
    "[gravity]",
    "[voltage]",
    "[current]",
    "[count]",
    "[temperature]",
)

#: Every unit that may be written, as (factor, unit in which the factor is).
#: A base unit's dimension stands in brackets.
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

#: What is wanted -> its name and the units to advise, for messages.
ADVICE: Final[Mapping[str, tuple[str, str]]] = {
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
    "m/s^2/s^0.5": ("a random walk of a bias", "ug/h^0.5, g/s^0.5, m/s^2/s^0.5"),
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

#: No unit takes more characters.
_MAX_CHARACTERS: Final = 500

# A name, perhaps with a power, the 1 of "1/s", or what joins them. Nothing else is evaluated.
_FACTOR = re.compile(
    r"\s*(?:([A-Za-z]+)(?:\^([+-]?\d{1,2}(?:\.\d{1,3})?))?|(?<![A-Za-z0-9])(1)(?=\s*(?:/|$))|([*/()]))\s*"
)


@lru_cache(maxsize=256)
def unit_factor(unit: str, wanted: str, *, gravity: float | None = None) -> float:
    """Return the factor by which a number in `unit` is multiplied to be in `wanted`.

    unit: A unit as written, such as ``deg/h/g``.
    wanted: The unit that the number shall have, such as ``rad/s/g``.
    gravity: The site's gravity in m/s^2, for conversions between g and m/s^2.
    """
    kind, accepted = advice(wanted)
    written = _plain(unit)
    names = _names(written, kind, accepted)
    if not names <= set(UNITS):
        unknown = ", ".join(sorted(repr(name) for name in names - set(UNITS)))
        raise InputError(f"unknown unit {unknown}; {kind} is required ({accepted})", "unknown-unit")
    if names & {"Hz", "kHz"} and "Hz" not in wanted:
        if wanted == "rad/s":
            raise InputError(
                f"{unit!r} is ambiguous for an angular rate: write rev/s for revolutions per "
                f"second, or rad/s ({accepted})",
                "wrong-unit",
            )
        raise InputError(f"{unit!r} is a frequency; {kind} is required ({accepted})", "wrong-unit")
    factor, dimension = _evaluate(written)
    wanted_factor, wanted_dimension = _evaluate(wanted)
    factor /= wanted_factor
    surplus = {base: dimension[base] - wanted_dimension[base] for base in BASES}
    # What is left over may be a power of (m/s^2)/g, which the site's gravity resolves.
    power = surplus["[length]"]
    of_gravity = dict.fromkeys(BASES, 0.0)
    of_gravity |= {"[length]": power, "[time]": -2.0 * power, "[gravity]": -power}
    if surplus != of_gravity or (power != 0.0 and gravity is None):
        raise InputError(
            f"{unit!r} is not a unit of {kind.split(' ', 1)[1]}; use {accepted}", "wrong-unit"
        )
    if power != 0.0 and gravity is not None:
        factor *= gravity**-power
    return factor


def converts(unit: str, wanted: str) -> bool:
    """Return whether a unit converts to a wanted one; an empty text does not."""
    try:
        return bool(unit) and unit_factor(unit, wanted, gravity=STANDARD_GRAVITY) != 0.0
    except ValueError:
        return False


def _plain(unit: str) -> str:
    """Return a unit without the signs that stand for others."""
    written = unit.strip().replace("**", "^").replace("µ", "u").replace("μ", "u")
    return written.replace("°", "deg").replace("·", "*").replace("²", "^2").replace("³", "^3")


def check_unit(unit: str) -> str:
    """Return a unit in which something is wanted, in plain signs; ValueError if it is none."""
    written = _plain(unit[:_MAX_CHARACTERS])
    wrong = f"{unit!r} is an unknown unit"
    try:
        known = _names(written, wrong, "m, V, mA, ...") <= set(UNITS)
        factor, _ = _evaluate(written) if known else (math.nan, {})
    except ValueError as error:
        raise ValueError(wrong) from error
    if not 0.0 < factor < math.inf:
        raise ValueError(wrong)
    return written


def same_unit(unit: str, other: str, *, gravity: float | None = None) -> bool:
    """Return whether two units are one, however they are written.

    gravity: The site's gravity in m/s^2, for g and m/s^2.
    """
    try:
        return math.isclose(unit_factor(unit, check_unit(other), gravity=gravity), 1.0)
    except ValueError:
        return False


def base_unit(unit: str) -> tuple[float, Mapping[str, float]]:
    """Return a unit's factor to the base units of `BASES`, and their powers."""
    return _evaluate(check_unit(unit))


def advice(wanted: str) -> tuple[str, str]:
    """Return the name of what is in a unit, and the units to write it in."""
    return ADVICE.get(wanted, (f"a quantity in {wanted}", wanted))


def _names(written: str, kind: str, accepted: str) -> set[str]:
    """Return the unit names in an expression, having checked that it is nothing but one."""
    if re.search(r"[*/]\s*[*/]", written):
        raise InputError(
            f"{written!r} is not a unit; {kind} is required ({accepted})", "unknown-unit"
        )
    names, position = set(), 0
    while position < len(written):
        match = _FACTOR.match(written, position)
        if match is None:
            raise InputError(
                f"{written!r} is not a unit; {kind} is required ({accepted})", "unknown-unit"
            )
        if match[1]:
            names.add(match[1])
        position = match.end()
    return names


@lru_cache(maxsize=256)
def _evaluate(written: str) -> tuple[float, Mapping[str, float]]:
    """Return factor to base units and dimension of an expression that `_names` has checked.

    Units side by side are multiplied, as if there were a * between them.
    """
    factor, dimension = 1.0, dict.fromkeys(BASES, 0.0)
    senses = [1.0]  # of the brackets that are open: -1 for what is divided by
    sense, wanting = 1.0, bool(written.strip())
    for name, power, _, mark in _FACTOR.findall(written):
        if mark == "(":
            senses.append(senses[-1] * sense)
        elif (mark and wanting) or (mark == ")" and len(senses) == 1):
            raise _incomplete(written)
        elif mark == ")":
            senses.pop()
        elif name:
            exponent = senses[-1] * sense * float(power or 1.0)
            size, bases = _unit(name)
            factor *= _power(size, exponent)
            for base, of_base in bases.items():
                dimension[base] += of_base * exponent
        sense, wanting = -1.0 if mark == "/" else 1.0, mark in ("(", "*", "/")
    if wanting or len(senses) > 1:
        raise _incomplete(written)
    return factor, dimension


def _power(size: float, exponent: float) -> float:
    try:
        return float(size**exponent)
    except OverflowError:
        return math.inf


def _unit(name: str) -> tuple[float, Mapping[str, float]]:
    """Return factor to base units and dimension of a unit of `UNITS`."""
    factor, base = UNITS[name]
    if base in BASES:
        return factor, {base: 1.0}
    of_base, dimension = _evaluate(base)
    return factor * of_base, dimension


def _incomplete(written: str) -> ValueError:
    return InputError(
        f"{written!r} is not a unit: a factor or a parenthesis is missing", "unknown-unit"
    )


# As SI units alone -----------------------------------------------------------------------------

_SI_FACTOR: Final = re.compile(r"(1|rad|m|s|g|Hz)(?:\^(\d))?")

#: A unit as powers of radian, metre, second, and g.
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
    def text(self) -> str:
        r"""As D-SI writes it: ``\metre\tothe{-1}\second\tothe{2}``; ``\one`` for a number."""
        parts = (
            rf"\{name}" + ("" if power == 1 else rf"\tothe{{{power}}}")
            for name in _SI_SYMBOLS
            if (power := getattr(self, name))
        )
        return "".join(parts) or r"\one"

    @property
    def words(self) -> str:
        """As people write it: ``m^-1 s^2``; ``1`` for a number."""
        parts = (
            symbol + ("" if power == 1 else f"^{power}")
            for name, symbol in _SI_SYMBOLS.items()
            if (power := getattr(self, name))
        )
        return " ".join(parts) or "1"


def si_unit(unit: str) -> tuple[SiUnit, int]:
    """Return a unit in SI and the power of g (m/s^2) of the conversion.

    unit: As it stands in a result: ``g/g^2``, ``rad/s/g``, ``m``, ``g s^2/rad``.
    """
    powers = [0, 0, 0, 0]
    above, *below = unit.split("/")
    for factor, sign in [*((f, 1) for f in above.split(" ")), *((f, -1) for f in below)]:
        match = _SI_FACTOR.fullmatch(factor)
        if match is None:
            raise ValueError(f"{unit!r} is not a unit supported in certificates")
        exponent = int(match[2] or 1) * sign
        powers = [
            total + exponent * one for total, one in zip(powers, _SI_POWERS[match[1]], strict=True)
        ]
    radian, metre, second, gravity = powers
    return SiUnit(radian, metre, second), gravity


#: Base of a unit -> its field in `SiUnit`; counts are numbers, and g is a power of its own.
_FIELDS: Final = {
    "[angle]": "radian",
    "[length]": "metre",
    "[time]": "second",
    "[current]": "ampere",
    "[voltage]": "volt",
}


def own_unit(unit: str) -> tuple[float, SiUnit, int]:
    """Return an instrument's own unit in SI: factor, unit, and power of g (m/s^2).

    1 mA/g is 1e-3 A/g, which is 1e-3 / g in A/(m/s^2).

    unit: Of its readings, such as ``mA`` or ``count/s``, or that over g.
    """
    factor, powers = base_unit(unit)
    gravity = powers["[gravity]"]
    own = {field: powers[base] for base, field in _FIELDS.items()}
    own["metre"] += gravity
    own["second"] -= 2.0 * gravity
    if powers["[temperature]"] or not all(power.is_integer() for power in (*own.values(), gravity)):
        raise ValueError(f"{unit!r} is not a product of integer powers of rad, m, s, A, V and g")
    return factor, SiUnit(**{field: int(power) for field, power in own.items()}), int(gravity)


def to_si(value: float, unit: str, gravity: float) -> float:
    """Return a number in SI; gravity in m/s^2 is the g of the unit."""
    return value * gravity ** si_unit(unit)[1]


def from_si(value: float, unit: str, gravity: float) -> float:
    """Return a number in the unit of a result from one in SI; the inverse of `to_si`."""
    return value / gravity ** si_unit(unit)[1]
