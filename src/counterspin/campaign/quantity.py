"""Parser of quantities, directions and attitudes, with conversion to SI and g-units.

A quantity is ``"VALUE UNIT"`` or ``"VALUE ± U UNIT"``. U is a standard uncertainty (k = 1);
``+/-`` and ``+-`` are the same as ``±``. `counterspin.units` defines the units.
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

#: Largest length of the text of a quantity.
_MAX_CHARACTERS: Final = 500

#: Bounds of magnitudes, in SI and g-units; squares of values outside could overflow.
_MAGNITUDE_RANGE: Final = (1e-60, 1e60)
#: Largest plausible magnitudes in some units. Larger angles do not resolve fractions of a turn.
_MAX_MAGNITUDES: Final = {"rad": 1e9, "s": 1e12}

#: Likely units of a number without a unit, if not the first accepted unit alone.
_LIKELY_UNITS: Final = {"rad": ("deg", "arcsec", "rad"), "rad/s": ("rad/s", "rev/s", "deg/s")}

NUMBER: Final = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
PLUS_MINUS: Final = r"\s*(?:±|\+/-|\+-)\s*"
_QUANTITY = re.compile(rf"({NUMBER})(?:{PLUS_MINUS}({NUMBER}))?(?:\s+|(?=[^\d.\s]))(.*)")
#: A number, with or without an uncertainty, that has no unit.
BARE_NUMBER: Final = re.compile(rf"{NUMBER}(?:{PLUS_MINUS}{NUMBER})?")
# After a value: its unit, and an uncertainty with or without another unit.
_REPEATED_UNIT = re.compile(rf"([^±]*?){PLUS_MINUS}({NUMBER})\s*([^±]*)")
#: A latitude in degrees, minutes and seconds of arc, with a hemisphere.
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
    dof: float = math.inf  #: Degrees of freedom of Student's t; infinite for other shapes.


NORMAL: Final = InputDistribution()


@frozen
class Quantity:
    """A value with its standard uncertainty.

    Attributes
    ----------
    value
        The value, in `unit`.
    u
        Standard uncertainty (k = 1), in `unit`; 0 for an exact value.
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
        """Format the quantity without loss of precision for `parse_quantity`."""
        return f"{self.value!r} ± {self.u!r} {self.unit}"

    @property
    def written(self) -> str:
        """The quantity as text, without ``± 0`` for an exact value."""
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
        """The turn as text."""
        return f"{self.angle.written} about {self.about}"


def parse_quantity(
    text: object, unit: str, *, gravity: float | None = None, likely_unit: str | None = None
) -> Quantity:
    """Parse ``"VALUE UNIT"`` or ``"VALUE ± U UNIT"``; convert a `Quantity` to the unit.

    gravity: Gravity of the site, m/s^2; with it, m/s^2 and g are convertible.
    likely_unit: Unit to suggest for a number without one; None: as in `_LIKELY_UNITS`.
    """
    description, accepted_units = expected_quantity(unit)
    if isinstance(text, Quantity):
        return _convert(text, unit, text.written, gravity)
    if not isinstance(text, str):
        if isinstance(text, bool) or not isinstance(text, int | float):
            raise InputError(
                f"must be {description}, written as text with its unit ({accepted_units})",
                "wrong-type",
            )
        if not math.isfinite(text):
            raise OutOfRangeError(
                f"{text!r} is not a finite number; {description} is required ({accepted_units})"
            )
        if unit == "1":
            raise InputError(f'a ratio must be written as text, such as "{text!r}"', "wrong-type")
        example = _suggest_unit(repr(text), unit, likely_unit)
        raise InputError(
            f"has no unit; write {example} ({description}: {accepted_units})", "missing-unit"
        )
    if len(text) > _MAX_CHARACTERS:
        raise ValueError(
            f"a quantity may have at most {_MAX_CHARACTERS} characters, but this text has "
            f"{len(text)}"
        )
    normalized_text = text.strip().replace("−", "-")
    if _NOT_FINITE.search(normalized_text):
        raise OutOfRangeError(
            f"{text!r} is not a finite number; {description} is required ({accepted_units})"
        )
    if BARE_NUMBER.fullmatch(normalized_text):
        example = _suggest_unit(normalized_text, unit, likely_unit)
        raise InputError(
            f"{text!r} has no unit; {description} is required ({accepted_units}); write {example}",
            "missing-unit",
        )
    if re.match(r"[+-]?\d+,\d", normalized_text):
        raise ValueError(f"{text!r} contains a comma; use a decimal point")
    match = _QUANTITY.fullmatch(normalized_text)
    if match is None:
        raise ValueError(
            f'{text!r} is not a quantity; write "VALUE UNIT" or "VALUE ± U UNIT" '
            f"({description}: {accepted_units})"
        )
    unit_match = _REPEATED_UNIT.fullmatch(match[3])
    if match[2] is None and unit_match is not None:
        raise ValueError(f"{text!r} {_suggest_single_unit(match[1], unit_match, gravity)}")
    quantity = Quantity(float(match[1]), float(match[2] or 0.0), match[3])
    return _convert(quantity, unit, text, gravity)


def normalize_latitude(text: object) -> object:
    """Convert ``45.75N`` or ``45 deg 45 min N`` to degrees; return other values unchanged."""
    match = _LATITUDE.fullmatch(text.strip()) if isinstance(text, str) else None
    if match is None or (match[1] is None) == (match[5] is None):
        return text
    degrees, minutes, seconds = (float(number or 0.0) for number in match.groups()[1:4])
    if minutes >= 60.0 or seconds >= 60.0:
        raise ValueError(f"{text!r}: minutes and seconds of arc must be less than 60")
    sign = "-" if "S" in (match[1], match[5]) else ""
    return f"{sign}{degrees + minutes / 60.0 + seconds / 3600.0:.12g} deg"


def _convert(quantity: Quantity, unit: str, text: str, gravity: float | None) -> Quantity:
    """Convert a quantity to a unit; a ValueError quotes `text`."""
    description, accepted_units = expected_quantity(unit)
    factor = unit_factor(quantity.unit, unit, gravity=gravity)
    value, u = quantity.value * factor, quantity.u * factor
    if not (math.isfinite(value) and math.isfinite(u)):
        raise OutOfRangeError(
            f"{text!r} is not a finite number; {description} is required ({accepted_units})"
        )
    if u < 0.0:
        raise InputError(f"{text!r} has a negative uncertainty", "wrong-uncertainty")
    max_magnitude = _MAX_MAGNITUDES.get(unit, _MAGNITUDE_RANGE[1])
    if any(
        magnitude and not _MAGNITUDE_RANGE[0] < magnitude < max_magnitude
        for magnitude in (abs(value), u)
    ):
        raise OutOfRangeError(
            f"{text!r} is implausibly large or small; {description} is required ({accepted_units})"
        )
    return Quantity(value, u, unit, quantity.distribution)


def is_plausible(values: Array, unit: str) -> npt.NDArray[np.bool_]:
    """Return whether `parse_quantity` accepts the magnitudes of values in SI or g-units."""
    magnitudes, max_magnitude = np.abs(values), _MAX_MAGNITUDES.get(unit, _MAGNITUDE_RANGE[1])
    mask: npt.NDArray[np.bool_] = (magnitudes > _MAGNITUDE_RANGE[0]) & (
        magnitudes < max_magnitude
    ) | (magnitudes == 0.0)
    return mask


def _suggest_unit(number: str, unit: str, likely_unit: str | None) -> str:
    """Suggest the text of a number with its most likely unit."""
    likely_units = (
        (likely_unit,)
        if likely_unit
        else _LIKELY_UNITS.get(unit, (expected_quantity(unit)[1].split(",")[0],))
    )
    *alternatives, last = (f'"{number} {candidate}"' for candidate in likely_units)
    return f"{', '.join(alternatives)} or {last}, whichever applies" if alternatives else last


def last_digit_step(quantity: str | Quantity) -> str:
    """Return the step of the last digit of a quantity, such as ``1e-3 mA`` for ``1.250 mA``."""
    text = quantity.written if isinstance(quantity, Quantity) else quantity
    normalized_text = text.strip().replace("−", "-")
    match = re.match(r"[+-]?\d*\.?(\d*)(?:[eE]([+-]?\d+))?", normalized_text)
    assert match is not None
    return f"1e{int(match[2] or 0) - len(match[1])}{normalized_text[match.end() :]}"


def _suggest_single_unit(value: str, unit_match: re.Match[str], gravity: float | None) -> str:
    """Suggest the text of ``VALUE UNIT ± U UNIT`` with one unit."""
    unit, u, u_unit = unit_match.groups()
    try:
        converted_u = float(u) * unit_factor(u_unit or unit, unit, gravity=gravity)
        example = f'"{value} ± {converted_u:.12g} {unit}"'
    except (ValueError, KeyError):  # an unknown unit, on either side
        example = '"VALUE ± U UNIT"'
    return f"has a unit before the ±; write the unit once, at the end: {example}"


#: Value of an unknown attitude.
UNKNOWN_ATTITUDE: Final = "unknown"

#: Message about an invalid attitude.
ATTITUDE_ADVICE: Final = (
    'is not an attitude; write "level", "90 deg about east" or { x = "east", y = "up" }'
)

TURN_PATTERN = re.compile(r"(.+?)\s+about\s+(\w+)")


def read_direction(value: object) -> tuple[float, float, float]:
    """Parse a direction; return its unit vector in east-north-up."""
    if isinstance(value, str):
        if value not in DIRECTIONS:
            raise ValueError(f'unknown direction "{value}"' + suggest_name(value, DIRECTIONS))
        return DIRECTIONS[value]
    is_numeric = isinstance(value, list) and all(
        isinstance(component, int | float) and not isinstance(component, bool)
        for component in value
    )
    if not isinstance(value, list) or not is_numeric:
        raise ValueError(f"must be one of {', '.join(DIRECTIONS)}, or [east, north, up]")
    unit_vector = direction(value)
    return float(unit_vector[0]), float(unit_vector[1]), float(unit_vector[2])


@frozen(eq=False)
class Attitude:
    """The directions of a platform's axes, and the dividing head that turned them."""

    rows: Array  #: Axes x, y, z in east-north-up, shape (3, 3); the identity when level.
    #: Axis of the dividing head; zero without a turn.
    head_axis: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angle: float = 0.0  #: Angle of the turn, rad.
    u: float = 0.0  #: Standard uncertainty of the angle, rad.
    is_unknown: bool = False  #: Whether the attitude is unknown; its axes are then those of level.


def read_attitude(value: object) -> Attitude:
    """Parse an attitude.

    value: ``"level"``, ``"unknown"``; a right-handed turn of the level platform such as ``"90 deg
        about east"`` (which rotates y from north to up), or a `HeadTurn`; or a table with the
        directions of x and y, and optionally of z.
    """
    if value in ("level", UNKNOWN_ATTITUDE):
        return Attitude(np.eye(3), is_unknown=value == UNKNOWN_ATTITUDE)
    if isinstance(value, str) and (match := TURN_PATTERN.fullmatch(value.strip())) is not None:
        value = HeadTurn(parse_quantity(match[1], "rad"), match[2])
    if isinstance(value, HeadTurn):
        turn, axis = parse_quantity(value.angle, "rad"), read_direction(value.about)
        matrix = rotate_axes(np.array(turn.value), np.array(axis))
        return Attitude(matrix, axis, turn.value, turn.u)
    if not isinstance(value, Mapping) or not {"x", "y"} <= set(value) <= {"x", "y", "z"}:
        raise ValueError(ATTITUDE_ADVICE)
    x, y = (np.array(read_direction(value[axis])) for axis in "xy")
    if abs(float(x @ y)) > 1e-6:
        raise ValueError("the axes x and y must be at right angles")
    y = y - (x @ y) * x
    y /= np.linalg.norm(y)
    z = np.cross(x, y)
    if "z" in value:
        cosine = float(np.array(read_direction(value["z"])) @ z)
        if cosine < -1.0 + 1e-6:
            raise ValueError("the axes are left-handed: x cross y must be z")
        if cosine < 1.0 - 1e-6:
            raise ValueError("the axis z must be at right angles to x and y")
    return Attitude(np.stack([x, y, z]))


def check_platform_attitude(attitude: Attitude) -> Attitude:
    """Return the attitude of a platform; ValueError if it is uncertain or unknown."""
    if attitude.is_unknown:
        raise ValueError(ATTITUDE_ADVICE)
    if attitude.u != 0.0:
        raise InputError(
            "an attitude must not have an uncertainty here; state a prior for platform.tilt "
            "instead",
            "wrong-uncertainty",
        )
    return attitude


def read_attitude_matrix(value: object) -> Array:
    """Return the axes of a platform as rows, shape (3, 3); `value` as in `read_attitude`."""
    return check_platform_attitude(read_attitude(value)).rows


def describe_attitude(matrix: Array) -> str:
    """Describe an attitude in words.

    matrix: Axes of the platform as rows, shape (3, 3).
    """
    if np.allclose(matrix, np.eye(3)):
        return "level"
    axis_texts = []
    for axis, row in zip("xyz", matrix, strict=True):
        names = [name for name, unit_vector in DIRECTIONS.items() if np.allclose(row, unit_vector)]
        components = ", ".join(f"{round(float(component), 4) + 0.0:g}" for component in row)
        axis_texts.append(f"{axis} {names[0] if names else f'[{components}]'}")
    return ", ".join(axis_texts)


def rotate_axes(angle: Array, axis: Array) -> Array:
    """Return the axes of the level platform after right-handed turns (Rodrigues), as rows.

    angle: Angles of the turns, rad, shape (...,).
    axis: Unit vector, shape (3,).
    Returns: shape (..., 3, 3).
    """
    # A quarter turn leaves the axes exactly along the directions: cos(pi/2) is not quite zero.
    quarter_turns = np.rint(angle / (math.pi / 2.0))
    remainder = np.abs(angle - quarter_turns * math.pi / 2.0)
    is_exact = remainder <= np.maximum(1e-12 * np.abs(angle), 1e-15)
    quadrant = quarter_turns.astype(int) % 4
    cos = np.where(is_exact, np.array([1.0, 0.0, -1.0, 0.0])[quadrant], np.cos(angle))
    sin = np.where(is_exact, np.array([0.0, 1.0, 0.0, -1.0])[quadrant], np.sin(angle))
    x, y, z = axis
    cross_matrix = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    cos, sin = cos[..., None, None], sin[..., None, None]
    matrices: Array = cos * np.eye(3) + sin * cross_matrix + (1.0 - cos) * np.outer(axis, axis)
    return matrices
