"""Quantities as people write them, ``"VALUE UNIT"`` or ``"VALUE ± U UNIT"``, to SI and g-units.

U is a standard uncertainty (k = 1); ``+/-`` and ``+-`` are the same as ``±``. Which units there
are says `counterspin.units`.
"""

from __future__ import annotations

import math
import re
from typing import Final

from counterspin.frozen import frozen
from counterspin.units import advice, unit_factor

#: No quantity takes more characters.
_MAX_CHARACTERS: Final = 500

#: Sizes of measured quantities, in SI and g-units; squares of sizes outside could overflow.
_SIZE_RANGE: Final = (1e-60, 1e60)

#: Units of which none is the likely one of a number alone; of others it is the first accepted.
_SCALES: Final = {
    "rad": ("deg", "arcsec", "rad"),
    "rad/s": ("rad/s", "rev/s", "deg/s"),
}

NUMBER: Final = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
PLUS_MINUS: Final = r"\s*(?:±|\+/-|\+-)\s*"
_QUANTITY = re.compile(rf"({NUMBER})(?:{PLUS_MINUS}({NUMBER}))?(?:\s+|(?=[^\d.\s]))(.*)")
#: A number, with or without an uncertainty, that has no unit.
BARE: Final = re.compile(rf"{NUMBER}(?:{PLUS_MINUS}{NUMBER})?")
# After a value: its unit, and an uncertainty with or without its own.
_UNIT_TWICE = re.compile(rf"([^±]*?){PLUS_MINUS}({NUMBER})\s*([^±]*)")
_NOT_FINITE = re.compile(r"[+-]?(nan|inf|infinity)\b", re.IGNORECASE)


@frozen
class Quantity:
    """A value with its standard uncertainty.

    Attributes
    ----------
    value
        The value, in `unit`.
    u
        Its standard uncertainty (k = 1), in `unit`; 0 for a value that is taken as exact.
    unit
        SI or g-units, such as ``m``, ``rad/s`` or ``g/g^2``.

    Examples
    --------
    >>> import counterspin as cs
    >>> print(cs.Quantity(2.5, 1e-5, "m"))
    2.5 ± 1e-05 m
    """

    value: float
    u: float
    unit: str

    def __str__(self) -> str:
        """Write the quantity so that `parse` reads the same numbers."""
        return f"{self.value!r} ± {self.u!r} {self.unit}"

    @property
    def written(self) -> str:
        """The same as a person writes it: without an uncertainty where there is none."""
        return str(self) if self.u else f"{self.value!r} {self.unit}"


@frozen
class Turn:
    """A right-handed turn of the level platform, as of a dividing head."""

    angle: Quantity  #: In a unit of angle.
    about: str  #: A direction.

    @property
    def written(self) -> str:
        """The turn as a person writes it."""
        return f"{self.angle.written} about {self.about}"


def parse(
    text: object, unit: str, *, gravity: float | None = None, usual: str | None = None
) -> Quantity:
    """Read ``"VALUE UNIT"`` or ``"VALUE ± U UNIT"``; a `Quantity` is one that was read already.

    gravity: The site's gravity in m/s^2; with it, m/s^2 serves where g is wanted and the other way.
    usual: The unit that a number without one is most likely in; None: what `_SCALES` say.
    """
    kind, accepted = advice(unit)
    if isinstance(text, Quantity):
        return _in_unit(text, unit, text.written, gravity)
    if not isinstance(text, str):
        if isinstance(text, bool) or not isinstance(text, int | float):
            raise ValueError(f"must be {kind}, written as text with its unit ({accepted})")
        if not math.isfinite(text):
            raise ValueError(f"{text!r} is not a finite number; {kind} is needed ({accepted})")
        example = _with_unit(repr(text), unit, usual)
        raise ValueError(f"a number without its unit; write {example} ({kind}: {accepted})")
    if len(text) > _MAX_CHARACTERS:
        raise ValueError(
            f"a quantity has at most {_MAX_CHARACTERS} characters; this has {len(text)}"
        )
    clean = text.strip().replace("−", "-")
    if _NOT_FINITE.search(clean):
        raise ValueError(f"{text!r} is not a finite number; {kind} is needed ({accepted})")
    if BARE.fullmatch(clean):
        example = _with_unit(clean, unit, usual)
        raise ValueError(f"{text!r} has no unit; {kind} is needed ({accepted}); write {example}")
    if re.match(r"[+-]?\d+,\d", clean):
        raise ValueError(f"{text!r} contains a comma; write decimals with a point")
    match = _QUANTITY.fullmatch(clean)
    if match is None:
        raise ValueError(
            f'{text!r} is not a quantity; write "VALUE UNIT" or "VALUE ± U UNIT" '
            f"({kind}: {accepted})"
        )
    twice = _UNIT_TWICE.fullmatch(match[3])
    if match[2] is None and twice is not None:
        raise ValueError(f"{text!r} {_unit_once(match[1], twice, gravity)}")
    written = Quantity(float(match[1]), float(match[2] or 0.0), match[3])
    return _in_unit(written, unit, text, gravity)


def _in_unit(quantity: Quantity, unit: str, text: str, gravity: float | None) -> Quantity:
    """Return a quantity in a unit; ValueError of one that is none, which `text` quotes."""
    kind, accepted = advice(unit)
    factor = unit_factor(quantity.unit, unit, gravity=gravity)
    value, u = quantity.value * factor, quantity.u * factor
    if not (math.isfinite(value) and math.isfinite(u)):
        raise ValueError(f"{text!r} is not a finite number; {kind} is needed ({accepted})")
    if u < 0.0:
        raise ValueError(f"{text!r} has a negative uncertainty")
    if any(size and not _SIZE_RANGE[0] < size < _SIZE_RANGE[1] for size in (abs(value), u)):
        raise ValueError(f"{text!r} is implausibly large or small; {kind} is needed ({accepted})")
    return Quantity(value, u, unit)


def _with_unit(number: str, unit: str, usual: str | None) -> str:
    """Say how a number is written with the unit that it is most likely in."""
    scales = (usual,) if usual else _SCALES.get(unit, (advice(unit)[1].split(",")[0],))
    *others, last = (f'"{number} {scale}"' for scale in scales)
    return f"{', '.join(others)} or {last}, whichever applies" if others else last


def last_digit(written: str | Quantity) -> str:
    """Return one of the last digit of a quantity, as a quantity: ``0.001 mA`` of ``1.250 mA``."""
    text = written.written if isinstance(written, Quantity) else written
    clean = text.strip().replace("−", "-")
    match = re.match(r"[+-]?\d*\.?(\d*)(?:[eE]([+-]?\d+))?", clean)
    assert match is not None
    return f"1e{int(match[2] or 0) - len(match[1])}{clean[match.end() :]}"


def _unit_once(value: str, twice: re.Match[str], gravity: float | None) -> str:
    """Say how ``VALUE UNIT ± U UNIT`` is written with one unit."""
    unit, u, unit_of_u = twice.groups()
    try:
        same = float(u) * unit_factor(unit_of_u or unit, unit, gravity=gravity)
        example = f'"{value} ± {same:.12g} {unit}"'
    except (ValueError, KeyError):  # a unit that nobody knows, on either side
        example = '"VALUE ± U UNIT"'
    return f"has a unit before its ±; write the unit once, at the end: {example}"
