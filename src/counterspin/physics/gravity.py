"""Normal gravity: the gravity that is expected at a site."""

from __future__ import annotations

import math
from typing import Final

_EQUATORIAL_GRAVITY: Final = 9.7803253359  #: m/s^2
_SOMIGLIANA_CONSTANT: Final = 0.00193185265241
_ECCENTRICITY_SQUARED: Final = 0.00669437999013
_SEMI_MAJOR_AXIS: Final = 6378137.0  #: m
_FLATTENING: Final = 1.0 / 298.257223563
_CENTRIFUGAL_RATIO: Final = 0.00344978650684  #: of centrifugal force and gravity at the equator

#: Heights between which a laboratory is expected, m: a mine, and a town in the mountains.
HEIGHT_RANGE: Final = (-500.0, 3000.0)

#: Latitudes that are tried between the equator and a pole: every tenth of a degree.
_LATITUDE_STEPS: Final = 900


def normal_gravity(latitude: float, height: float = 0.0) -> float:
    """Return normal gravity: Somigliana's formula, and free air above the ellipsoid.

    NIMA TR 8350.2, Department of Defense World Geodetic System 1984, 3rd edition (2000),
    Eq. 4-1 and 4-3, with the constants of its tables 3.3 and 3.4. Gravity as measured differs by
    anomalies of the ground, mostly less than 1e-3 m/s^2.

    latitude: Geodetic, rad.
    height: Above the ellipsoid, m.
    Returns: m/s^2.
    """
    sin_squared = math.sin(latitude) ** 2
    ellipsoid_gravity = (
        _EQUATORIAL_GRAVITY
        * (1.0 + _SOMIGLIANA_CONSTANT * sin_squared)
        / math.sqrt(1.0 - _ECCENTRICITY_SQUARED * sin_squared)
    )
    height_ratio = height / _SEMI_MAJOR_AXIS
    slope = 2.0 * (1.0 + _FLATTENING + _CENTRIFUGAL_RATIO - 2.0 * _FLATTENING * sin_squared)
    return ellipsoid_gravity * (1.0 - slope * height_ratio + 3.0 * height_ratio**2)


def gravity_range(latitude: float) -> tuple[float, float]:
    """Return the smallest and largest gravity in `HEIGHT_RANGE` at a latitude (rad), m/s^2."""
    min_height, max_height = HEIGHT_RANGE
    return normal_gravity(latitude, max_height), normal_gravity(latitude, min_height)


def latitude_range(gravity: float, anomaly: float) -> tuple[float, float]:
    """Return the smallest and largest latitude (rad), of either sign, with a gravity, m/s^2.

    At a height in `HEIGHT_RANGE`, within a gravity anomaly (m/s^2); NaN if there is none.
    """
    latitudes = [
        latitude
        for step in range(_LATITUDE_STEPS + 1)
        for latitude in [0.5 * math.pi * step / _LATITUDE_STEPS]
        if gravity_range(latitude)[0] - anomaly <= gravity <= gravity_range(latitude)[1] + anomaly
    ]
    return min(latitudes, default=math.nan), max(latitudes, default=math.nan)
