"""Directions and platform attitudes as they are written in a campaign."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.checking import did_you_mean
from counterspin.campaign.quantity import Turn, parse
from counterspin.frozen import frozen
from counterspin.physics.accelerometer import DIRECTIONS, direction

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
            raise ValueError(f'unknown direction "{value}"' + did_you_mean(value, DIRECTIONS))
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
    """Where a platform's axes point, and the dividing head that turned them there."""

    rows: Array  #: Of x, y, z in east-north-up, shape (3, 3); the identity when level.
    head: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: Its axis; zero without a turn.
    angle: float = 0.0  #: Of the turn, rad.
    u: float = 0.0  #: Its standard uncertainty, rad.
    unknown: bool = False  #: Of a pose that nobody knows, whose axes count as level.


def read_attitude(value: object) -> Attitude:
    """Return an attitude as it is written.

    value: ``"level"``, ``"unknown"``; a right-handed turn of the level platform such as ``"90 deg
        about east"`` (which takes y from north to up), or as a `Turn`; or a table of the directions
        of x and y, and of z if wanted.
    """
    if value in ("level", UNKNOWN):
        return Attitude(np.eye(3), unknown=value == UNKNOWN)
    if isinstance(value, str) and (match := TURN_WORDS.fullmatch(value.strip())) is not None:
        value = Turn(parse(match[1], "rad"), match[2])
    if isinstance(value, Turn):
        turn, axis = parse(value.angle, "rad"), read_direction(value.about)
        return Attitude(_turned(turn.value, np.array(axis)), axis, turn.value, turn.u)
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


def of_platform(attitude: Attitude) -> Attitude:
    """Return an attitude that a platform holds; ValueError of one that is uncertain or unknown."""
    if attitude.unknown:
        raise ValueError(NO_ATTITUDE)
    if attitude.u != 0.0:
        raise ValueError(
            "an attitude takes no uncertainty here; give platform.tilt a prior instead"
        )
    return attitude


def attitude_rows(value: object) -> Array:
    """Return where the axes of a platform point, shape (3, 3); `value` as of `read_attitude`."""
    return of_platform(read_attitude(value)).rows


def attitude_words(rows: Array) -> str:
    """Return an attitude in words.

    rows: Where the platform's axes point, shape (3, 3).
    """
    if np.allclose(rows, np.eye(3)):
        return "level"
    words = []
    for axis, row in zip("xyz", rows, strict=True):
        near = [name for name, there in DIRECTIONS.items() if np.allclose(row, there)]
        words.append(f"{axis} {near[0] if near else np.array2string(row, precision=4)}")
    return ", ".join(words)


def _turned(angle: float, axis: Array) -> Array:
    """Return the axes of the level platform after a right-handed turn (Rodrigues), as rows."""
    # A quarter turn leaves the axes exactly along the directions: cos(pi/2) is not quite zero.
    quarters = round(angle / (math.pi / 2.0))
    exact = math.isclose(angle, quarters * math.pi / 2.0, rel_tol=1e-12, abs_tol=1e-15)
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4] if exact else _cos_sin(angle)
    level = np.eye(3)
    return (
        cos * level
        + sin * np.cross(axis, level)
        + (1.0 - cos) * (level @ axis)[:, None] * axis[None, :]
    )


def _cos_sin(angle: float) -> tuple[float, float]:
    return math.cos(angle), math.sin(angle)
