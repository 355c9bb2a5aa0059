"""From the units of a result to SI, and how D-SI writes them (SI brochure, 9th edition).

A coefficient in g/g^n multiplies a_I^n where forces are counted in the site's own g. Counted in
m/s^2 it is the same number times g^(1-n): K_II in g/g^2 becomes K_II/g in (m/s^2)/(m/s^2)^2,
which is s^2/m.
"""

from __future__ import annotations

import re
from typing import Final

from counterspin.frozen import frozen
from counterspin.units import base_unit

_FACTOR: Final = re.compile(r"(1|rad|m|s|g|Hz)(?:\^(\d))?")

#: A unit as powers of radian, metre, second, and g.
_POWERS: Final = {
    "1": (0, 0, 0, 0),
    "rad": (1, 0, 0, 0),
    "m": (0, 1, 0, 0),
    "s": (0, 0, 1, 0),
    "Hz": (0, 0, -1, 0),
    "g": (0, 1, -2, 1),
}


#: Field of `SiUnit` -> its symbol.
_SYMBOLS: Final = {"radian": "rad", "metre": "m", "second": "s", "ampere": "A", "volt": "V"}


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
        return SiUnit(**{name: getattr(self, name) + getattr(other, name) for name in _SYMBOLS})

    @property
    def text(self) -> str:
        r"""As D-SI writes it: ``\metre\tothe{-1}\second\tothe{2}``; ``\one`` for a number."""
        parts = (
            rf"\{name}" + ("" if power == 1 else rf"\tothe{{{power}}}")
            for name in _SYMBOLS
            if (power := getattr(self, name))
        )
        return "".join(parts) or r"\one"

    @property
    def words(self) -> str:
        """As people write it: ``m^-1 s^2``; ``1`` for a number."""
        parts = (
            symbol + ("" if power == 1 else f"^{power}")
            for name, symbol in _SYMBOLS.items()
            if (power := getattr(self, name))
        )
        return " ".join(parts) or "1"


def si_unit(unit: str) -> tuple[SiUnit, int]:
    """Return a unit in SI and the power of g (m/s^2) of the conversion.

    unit: As it stands in a result: ``g/g^2``, ``rad/s/g``, ``m``.
    """
    powers = [0, 0, 0, 0]
    for place, factor in enumerate(unit.split("/")):
        match = _FACTOR.fullmatch(factor)
        if match is None:
            raise ValueError(f"{unit!r} is not a unit supported in certificates")
        exponent = int(match[2] or 1) * (1 if place == 0 else -1)
        powers = [
            total + exponent * one for total, one in zip(powers, _POWERS[match[1]], strict=True)
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
        raise ValueError(f"{unit!r} is no product of whole powers of rad, m, s, A, V and g")
    return factor, SiUnit(**{field: int(power) for field, power in own.items()}), int(gravity)


def to_si(value: float, unit: str, gravity: float) -> float:
    """Return a number in SI; gravity in m/s^2 is the g of the unit."""
    return value * gravity ** si_unit(unit)[1]


def from_si(value: float, unit: str, gravity: float) -> float:
    """Return a number in the unit of a result from one in SI; the inverse of `to_si`."""
    return value / gravity ** si_unit(unit)[1]
