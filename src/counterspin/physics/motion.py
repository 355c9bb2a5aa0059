"""Exact motion of a platform carried by a double-turntable centrifuge.

The second turntable keeps the platform's case from rotating, so every point of it moves on the
same circle and the lever arm inside the case cancels. Vectors are east-north-up, SI, shape
(n, 3); the spindle angle is measured from east towards north.

- `Site`: gravity, latitude and the Earth's rotation
- `Trajectory`: position, velocity, acceleration, specific force, harmful acceleration
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from counterspin.physics.accelerometer import Array
from counterspin.physics.spindle import Spindle

EARTH_RATE: Final = 7.292115e-5  #: rad/s, rotation rate of the Earth (WGS 84)


@dataclass(frozen=True)
class Site:
    """Where the centrifuge stands.

    Attributes
    ----------
    gravity
        Plumb-line gravity, m/s^2. It is the unit "g" of every coefficient.
    latitude
        Geodetic latitude, rad.
    earth_rate
        Rotation rate of the Earth, rad/s; 0 leaves the Coriolis acceleration out.
    """

    gravity: float
    latitude: float
    earth_rate: float = EARTH_RATE

    @property
    def earth_rotation(self) -> Array:
        """Earth rotation vector in east-north-up, rad/s, shape (3,)."""
        return self.earth_rate * np.array(
            [0.0, math.cos(self.latitude), math.sin(self.latitude)], dtype=float
        )


@dataclass(frozen=True)
class Trajectory:
    """The motion of the platform during one run.

    Attributes
    ----------
    spindle
        The angle model of the run.
    radius
        Distance of the platform from the spindle axis, m.
    site
        Where the centrifuge stands.
    """

    spindle: Spindle
    radius: float
    site: Site

    def position(self, t: Array) -> Array:
        """Return R (cos theta, sin theta, 0) in m, shape (n, 3)."""
        theta = self.spindle.angle(t)
        outward: Array = np.stack([np.cos(theta), np.sin(theta), np.zeros_like(theta)], -1)
        return self.radius * outward

    def velocity(self, t: Array) -> Array:
        """Return the velocity relative to the Earth in m/s, shape (n, 3)."""
        theta, rate = self.spindle.angle(t), self.spindle.angular_rate(t)
        along: Array = np.stack([-np.sin(theta), np.cos(theta), np.zeros_like(theta)], -1)
        return (self.radius * rate)[..., None] * along

    def acceleration(self, t: Array) -> Array:
        """Return the acceleration relative to the Earth in m/s^2, shape (n, 3).

        Centripetal and tangential parts with the instantaneous rate and angular acceleration;
        the first-order forms of Eq. 5 and 6 are in `counterspin.physics.as_printed` only.
        """
        theta, rate = self.spindle.angle(t), self.spindle.angular_rate(t)
        alpha = self.spindle.angular_acceleration(t)
        cos, sin = np.cos(theta), np.sin(theta)
        inward: Array = np.stack(
            [rate**2 * cos + alpha * sin, rate**2 * sin - alpha * cos, np.zeros_like(theta)], -1
        )
        return -self.radius * inward

    def harmful_acceleration(self, t: Array) -> Array:
        """Return what the navigation computer subtracts (Eq. 10, 12), m/s^2, shape (n, 3).

        Coriolis acceleration plus the reaction to gravity, 2 Omega x v + (0, 0, g).
        """
        harmful: Array = 2.0 * np.cross(self.site.earth_rotation, self.velocity(t))
        harmful[..., 2] += self.site.gravity
        return harmful

    def specific_force(self, t: Array) -> Array:
        """Return the specific force in m/s^2, shape (n, 3)."""
        return self.acceleration(t) + self.harmful_acceleration(t)

    def velocity_of_specific_force(self, t: Array) -> Array:
        """Return the integral of the specific force from 0 to t in m/s, shape (n, 3); exact."""
        zero = np.zeros(1)
        moved = self.position(t) - self.position(zero)
        up = np.array([0.0, 0.0, self.site.gravity])
        return (
            self.velocity(t)
            - self.velocity(zero)
            + 2.0 * np.cross(self.site.earth_rotation, moved)
            + up * np.asarray(t)[..., None]
        )
