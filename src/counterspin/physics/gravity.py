"""Normal gravity: the gravity that is expected at a site."""

from __future__ import annotations

import math
from typing import Final

_EQUATOR: Final = 9.7803253359  #: m/s^2
_SOMIGLIANA: Final = 0.00193185265241
_ECCENTRICITY_SQUARED: Final = 0.00669437999013
_SEMI_MAJOR_AXIS: Final = 6378137.0  #: m
_FLATTENING: Final = 1.0 / 298.257223563
_RATIO: Final = 0.00344978650684  #: of centrifugal force and gravity at the equator

#: Heights between which a laboratory is expected, m: a mine, and a town in the mountains.
HEIGHTS: Final = (-500.0, 3000.0)

#: Latitudes that are tried between the equator and a pole: every tenth of a degree.
_STEPS: Final = 900


def normal_gravity(latitude: float, height: float = 0.0) -> float:
    """Return normal gravity: Somigliana's formula, and free air above the ellipsoid.

    NIMA TR 8350.2, Department of Defense World Geodetic System 1984, 3rd edition (2000),
    Eq. 4-1 and 4-3, with the constants of its tables 3.3 and 3.4. Gravity as measured differs by
    anomalies of the ground, mostly less than 1e-3 m/s^2.

    latitude: Geodetic, rad.
    height: Above the ellipsoid, m.
    Returns: m/s^2.
    """
    square = math.sin(latitude) ** 2
    on_ellipsoid = (
        _EQUATOR * (1.0 + _SOMIGLIANA * square) / math.sqrt(1.0 - _ECCENTRICITY_SQUARED * square)
    )
    ratio = height / _SEMI_MAJOR_AXIS
    slope = 2.0 * (1.0 + _FLATTENING + _RATIO - 2.0 * _FLATTENING * square)
    return on_ellipsoid * (1.0 - slope * ratio + 3.0 * ratio**2)


def gravity_range(latitude: float) -> tuple[float, float]:
    """Return the smallest and the largest gravity of `HEIGHTS` at a latitude (rad), m/s^2."""
    lowest, highest = HEIGHTS
    return normal_gravity(latitude, highest), normal_gravity(latitude, lowest)


def latitudes_with(gravity: float, anomaly: float) -> tuple[float, float]:
    """Return the smallest and the largest latitude (rad), of either sign, with a gravity, m/s^2.

    At one of `HEIGHTS`, and but for an anomaly of the ground (m/s^2). Not a number where there is
    none.
    """
    latitudes = [
        latitude
        for step in range(_STEPS + 1)
        for latitude in [0.5 * math.pi * step / _STEPS]
        if gravity_range(latitude)[0] - anomaly <= gravity <= gravity_range(latitude)[1] + anomaly
    ]
    return min(latitudes, default=math.nan), max(latitudes, default=math.nan)
