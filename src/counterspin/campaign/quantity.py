"""Quantities, directions and attitudes as people write them, to SI and g-units.

A quantity is ``"VALUE UNIT"`` or ``"VALUE ± U UNIT"``. U is a standard uncertainty (k = 1);
``+/-`` and ``+-`` are the same as ``±``. Which units there are says `counterspin.units`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.campaign.validation import suggest_name
from counterspin.errors import InputError, OutOfRangeError
from counterspin.frozen import frozen
from counterspin.physics.accelerometer import DIRECTIONS, direction
from counterspin.units import expected_quantity, unit_factor

#: No quantity takes more characters.
_MAX_CHARACTERS: Final = 500

#: Sizes of measured quantities, in SI and g-units; squares of sizes outside could overflow.
_SIZE_RANGE: Final = (1e-60, 1e60)
#: Largest plausible sizes in some units. Larger angles do not resolve the fraction of a turn.
_LARGEST: Final = {"rad": 1e9, "s": 1e12}

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
#: A latitude as maps write it: degrees, minutes and seconds of arc, and a hemisphere.
_LATITUDE: Final = re.compile(
    r"([NS])?\s*(\d+(?:\.\d+)?)\s*(?:deg\b|°)?"
    r"(?:\s*(\d+(?:\.\d+)?)\s*(?:min\b|arcmin\b|['′])"
    r"(?:\s*(\d+(?:\.\d+)?)\s*(?:sec\b|s\b|arcsec\b|[\"″]))?)?\s*([NS])?"
)
_NOT_FINITE = re.compile(r"[+-]?(nan|inf|infinity)\b", re.IGNORECASE)


Shape = Literal["normal", "t", "rectangular", "triangular", "arcsine"]

#: Half-width over the standard deviation of the distributions with limits.
HALF_WIDTHS: Final[Mapping[Shape, float]] = {
    "rectangular": math.sqrt(3.0),
    "triangular": math.sqrt(6.0),
    "arcsine": math.sqrt(2.0),
}


@frozen
class InputDistribution:
    """Shape of the distribution of an input about its value."""

    shape: Shape = "normal"
    dof: float = math.inf  #: Degrees of freedom of Student's t; infinite of all others.


NORMAL: Final = InputDistribution()


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
    distribution
        The distribution about the value; normal by default.

    Examples
    --------
    >>> import counterspin as cs
    >>> print(cs.Quantity(2.5, 1e-5, "m"))
    2.5 ± 1e-05 m
    """

    value: float
    u: float
    unit: str
    distribution: InputDistribution = NORMAL

    def __str__(self) -> str:
        """Write the quantity so that `parse` reads the same numbers."""
        return f"{self.value!r} ± {self.u!r} {self.unit}"

    @property
    def written(self) -> str:
        """The quantity as a person writes it: without an uncertainty if it has none."""
        return str(self) if self.u else f"{self.value!r} {self.unit}"

    @property
    def document(self) -> str | dict[str, str | float]:
        """The quantity as a value of a document: a table if its distribution is not normal."""
        shape, unit = self.distribution.shape, self.unit
        if shape == "normal":
            return self.written
        table: dict[str, str | float] = {"value": f"{self.value!r} {unit}"}
        if shape == "t":
            return table | {"u": f"{self.u!r} {unit}", "dof": self.distribution.dof}
        return table | {
            "half_width": f"{self.u * HALF_WIDTHS[shape]!r} {unit}",
            "distribution": shape,
        }


@frozen
class HeadTurn:
    """A right-handed rotation of the level platform, such as that of a dividing head."""

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
    kind, accepted = expected_quantity(unit)
    if isinstance(text, Quantity):
        return _in_unit(text, unit, text.written, gravity)
    if not isinstance(text, str):
        if isinstance(text, bool) or not isinstance(text, int | float):
            raise InputError(
                f"must be {kind}, written as text with its unit ({accepted})", "wrong-type"
            )
        if not math.isfinite(text):
            raise OutOfRangeError(
                f"{text!r} is not a finite number; {kind} is required ({accepted})"
            )
        if unit == "1":
            raise InputError(f'a ratio must be written as text, such as "{text!r}"', "wrong-type")
        example = _with_unit(repr(text), unit, usual)
        raise InputError(f"has no unit; write {example} ({kind}: {accepted})", "missing-unit")
    if len(text) > _MAX_CHARACTERS:
        raise ValueError(
            f"a quantity may have at most {_MAX_CHARACTERS} characters, but this text has "
            f"{len(text)}"
        )
    clean = text.strip().replace("−", "-")
    if _NOT_FINITE.search(clean):
        raise OutOfRangeError(f"{text!r} is not a finite number; {kind} is required ({accepted})")
    if BARE.fullmatch(clean):
        example = _with_unit(clean, unit, usual)
        raise InputError(
            f"{text!r} has no unit; {kind} is required ({accepted}); write {example}",
            "missing-unit",
        )
    if re.match(r"[+-]?\d+,\d", clean):
        raise ValueError(f"{text!r} contains a comma; use a decimal point")
    match = _QUANTITY.fullmatch(clean)
    if match is None:
        raise ValueError(
            f'{text!r} is not a quantity; write "VALUE UNIT" or "VALUE ± U UNIT" '
            f"({kind}: {accepted})"
        )
    twice = _UNIT_TWICE.fullmatch(match[3])
    if match[2] is None and twice is not None:
        raise ValueError(f"{text!r} {_suggest_single_unit(match[1], twice, gravity)}")
    written = Quantity(float(match[1]), float(match[2] or 0.0), match[3])
    return _in_unit(written, unit, text, gravity)


def latitude_text(text: object) -> object:
    """Return ``45.75N`` or ``45 deg 45 min N`` in degrees, and any other value unchanged."""
    match = _LATITUDE.fullmatch(text.strip()) if isinstance(text, str) else None
    if match is None or (match[1] is None) == (match[5] is None):
        return text
    degrees, minutes, seconds = (float(part or 0.0) for part in match.groups()[1:4])
    if minutes >= 60.0 or seconds >= 60.0:
        raise ValueError(f"{text!r}: minutes and seconds of arc must be less than 60")
    sign = "-" if "S" in (match[1], match[5]) else ""
    return f"{sign}{degrees + minutes / 60.0 + seconds / 3600.0:.12g} deg"


def _in_unit(quantity: Quantity, unit: str, text: str, gravity: float | None) -> Quantity:
    """Return a quantity in a unit; ValueError, which quotes `text`, if it is not one."""
    kind, accepted = expected_quantity(unit)
    factor = unit_factor(quantity.unit, unit, gravity=gravity)
    value, u = quantity.value * factor, quantity.u * factor
    if not (math.isfinite(value) and math.isfinite(u)):
        raise OutOfRangeError(f"{text!r} is not a finite number; {kind} is required ({accepted})")
    if u < 0.0:
        raise InputError(f"{text!r} has a negative uncertainty", "wrong-uncertainty")
    largest = _LARGEST.get(unit, _SIZE_RANGE[1])
    if any(size and not _SIZE_RANGE[0] < size < largest for size in (abs(value), u)):
        raise OutOfRangeError(
            f"{text!r} is implausibly large or small; {kind} is required ({accepted})"
        )
    return Quantity(value, u, unit, quantity.distribution)


def within_limits(values: Array, unit: str) -> npt.NDArray[np.bool_]:
    """Return whether `parse` accepts values in SI or g-units, by their size."""
    sizes, largest = np.abs(values), _LARGEST.get(unit, _SIZE_RANGE[1])
    mask: npt.NDArray[np.bool_] = (sizes > _SIZE_RANGE[0]) & (sizes < largest) | (sizes == 0.0)
    return mask


def _with_unit(number: str, unit: str, usual: str | None) -> str:
    """Suggest the text of a number with its most likely unit."""
    scales = (usual,) if usual else _SCALES.get(unit, (expected_quantity(unit)[1].split(",")[0],))
    *others, last = (f'"{number} {scale}"' for scale in scales)
    return f"{', '.join(others)} or {last}, whichever applies" if others else last


def last_digit(written: str | Quantity) -> str:
    """Return one of the last digit of a quantity, as a quantity: ``0.001 mA`` of ``1.250 mA``."""
    text = written.written if isinstance(written, Quantity) else written
    clean = text.strip().replace("−", "-")
    match = re.match(r"[+-]?\d*\.?(\d*)(?:[eE]([+-]?\d+))?", clean)
    assert match is not None
    return f"1e{int(match[2] or 0) - len(match[1])}{clean[match.end() :]}"


def _suggest_single_unit(value: str, twice: re.Match[str], gravity: float | None) -> str:
    """Suggest the text of ``VALUE UNIT ± U UNIT`` with one unit."""
    unit, u, unit_of_u = twice.groups()
    try:
        same = float(u) * unit_factor(unit_of_u or unit, unit, gravity=gravity)
        example = f'"{value} ± {same:.12g} {unit}"'
    except (ValueError, KeyError):  # a unit that nobody knows, on either side
        example = '"VALUE ± U UNIT"'
    return f"has a unit before the ±; write the unit once, at the end: {example}"


#: Written for an attitude that nobody knows.
UNKNOWN: Final = "unknown"

#: What an attitude may look like, for messages.
NO_ATTITUDE: Final = (
    'is not an attitude; write "level", "90 deg about east" or { x = "east", y = "up" }'
)

TURN_WORDS = re.compile(r"(.+?)\s+about\s+(\w+)")


def read_direction(value: object) -> tuple[float, float, float]:
    """Return the unit vector in east-north-up."""
    if isinstance(value, str):
        if value not in DIRECTIONS:
            raise ValueError(f'unknown direction "{value}"' + suggest_name(value, DIRECTIONS))
        return DIRECTIONS[value]
    numbers = isinstance(value, list) and all(
        isinstance(c, int | float) and not isinstance(c, bool) for c in value
    )
    if not isinstance(value, list) or not numbers:
        raise ValueError(f"must be one of {', '.join(DIRECTIONS)}, or [east, north, up]")
    vec = direction(value)
    return float(vec[0]), float(vec[1]), float(vec[2])


@frozen(eq=False)
class Attitude:
    """The directions of a platform's axes, and the dividing head that turned them."""

    rows: Array  #: Of x, y, z in east-north-up, shape (3, 3); the identity when level.
    head: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: Its axis; zero without a turn.
    angle: float = 0.0  #: Of the turn, rad.
    u: float = 0.0  #: Its standard uncertainty, rad.
    unknown: bool = False  #: Of a pose that nobody knows, whose axes count as level.


def read_attitude(value: object) -> Attitude:
    """Return an attitude as it is written.

    value: ``"level"``, ``"unknown"``; a right-handed turn of the level platform such as ``"90 deg
        about east"`` (which takes y from north to up), or as a `HeadTurn`; or a table of the
        directions of x and y, and of z if wanted.
    """
    if value in ("level", UNKNOWN):
        return Attitude(np.eye(3), unknown=value == UNKNOWN)
    if isinstance(value, str) and (match := TURN_WORDS.fullmatch(value.strip())) is not None:
        value = HeadTurn(parse(match[1], "rad"), match[2])
    if isinstance(value, HeadTurn):
        turn, axis = parse(value.angle, "rad"), read_direction(value.about)
        rows = rotate_axes(np.array(turn.value), np.array(axis))
        return Attitude(rows, axis, turn.value, turn.u)
    if not isinstance(value, Mapping) or not {"x", "y"} <= set(value) <= {"x", "y", "z"}:
        raise ValueError(NO_ATTITUDE)
    x, y = (np.array(read_direction(value[axis])) for axis in "xy")
    if abs(float(x @ y)) > 1e-6:
        raise ValueError("the axes x and y must be at right angles")
    y = y - (x @ y) * x
    y /= np.linalg.norm(y)
    z = np.cross(x, y)
    if "z" in value:
        agreement = float(np.array(read_direction(value["z"])) @ z)
        if agreement < -1.0 + 1e-6:
            raise ValueError("the axes are left-handed: x cross y must be z")
        if agreement < 1.0 - 1e-6:
            raise ValueError("the axis z must be at right angles to x and y")
    return Attitude(np.stack([x, y, z]))


def platform_attitude(attitude: Attitude) -> Attitude:
    """Return an attitude that a platform holds; ValueError of one that is uncertain or unknown."""
    if attitude.unknown:
        raise ValueError(NO_ATTITUDE)
    if attitude.u != 0.0:
        raise InputError(
            "an attitude must not have an uncertainty here; state a prior for platform.tilt "
            "instead",
            "wrong-uncertainty",
        )
    return attitude


def attitude_rows(value: object) -> Array:
    """Return the directions of a platform's axes, shape (3, 3); `value` as in `read_attitude`."""
    return platform_attitude(read_attitude(value)).rows


def attitude_words(rows: Array) -> str:
    """Return an attitude in words.

    rows: Directions of the platform's axes, shape (3, 3).
    """
    if np.allclose(rows, np.eye(3)):
        return "level"
    words = []
    for axis, row in zip("xyz", rows, strict=True):
        near = [name for name, there in DIRECTIONS.items() if np.allclose(row, there)]
        numbers = ", ".join(f"{round(float(part), 4) + 0.0:g}" for part in row)
        words.append(f"{axis} {near[0] if near else f'[{numbers}]'}")
    return ", ".join(words)


def rotate_axes(angle: Array, axis: Array) -> Array:
    """Return the axes of the level platform after right-handed turns (Rodrigues), as rows.

    angle: Of the turns, rad, shape (...,).
    axis: Unit vector, shape (3,).
    Returns: shape (..., 3, 3).
    """
    # A quarter turn leaves the axes exactly along the directions: cos(pi/2) is not quite zero.
    quarters = np.rint(angle / (math.pi / 2.0))
    error = np.abs(angle - quarters * math.pi / 2.0)
    is_exact = error <= np.maximum(1e-12 * np.abs(angle), 1e-15)
    quarter = quarters.astype(int) % 4
    cos = np.where(is_exact, np.array([1.0, 0.0, -1.0, 0.0])[quarter], np.cos(angle))
    sin = np.where(is_exact, np.array([0.0, 1.0, 0.0, -1.0])[quarter], np.sin(angle))
    x, y, z = axis
    across = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    cos, sin = cos[..., None, None], sin[..., None, None]
    rows: Array = cos * np.eye(3) + sin * across + (1.0 - cos) * np.outer(axis, axis)
    return rows
