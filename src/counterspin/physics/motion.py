"""Exact motion of a platform carried by a double-turntable centrifuge.

The second turntable keeps the platform's case from rotating, so every point of it moves on the
same circle and the lever arm inside the case cancels. Vectors are east-north-up, SI, shape
(n, 3); the spindle angle is measured from east towards north.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.physics import quadrature
from counterspin.physics.effects import AT_REFERENCE, RunConditions
from counterspin.physics.spindle import Spindle

_TINY: Final = float(np.finfo(float).tiny)

#: Times up to which the motion at them is kept for a while.
_MOST_KEPT: Final = 16384

EARTH_RATE: Final = 7.292115e-5  #: rad/s, rotation rate of the Earth (WGS 84)


@frozen
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
    removed_gravity
        Gravity that the navigation computer takes away, m/s^2; None: the very one of the site,
        whatever that is.
    """

    gravity: float
    latitude: float
    earth_rate: float = EARTH_RATE
    removed_gravity: float | None = None

    @property
    def gravity_left(self) -> float:
        """What the navigation computer leaves of gravity, upwards, m/s^2."""
        return 0.0 if self.removed_gravity is None else self.gravity - self.removed_gravity

    @property
    def earth_rotation(self) -> Array:
        """Earth rotation vector in east-north-up, rad/s, shape (3,)."""
        return self.earth_rate * np.array(
            [0.0, math.cos(self.latitude), math.sin(self.latitude)], dtype=float
        )


@frozen
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
    stretch
        Relative growth of the radius per centripetal acceleration, s^2/m.
    imbalance
        (n, c, s): the radius is longer by c cos n theta + s sin n theta, m.
    axis_tilt
        Small right-handed turns of the spindle's axis about east and north, rad. To first order:
        the platform is lifted by the tilt times its position, and its level position stays.
    conditions
        When the run began, and how warm it was.
    coarse
        Whether integrals along it are for shapes, `counterspin.physics.quadrature.panel_edges`.
    """

    spindle: Spindle
    radius: float
    site: Site
    stretch: float = 0.0
    imbalance: tuple[tuple[int, float, float], ...] = ()
    axis_tilt: tuple[float, float] = (0.0, 0.0)
    conditions: RunConditions = AT_REFERENCE
    coarse: bool = False

    @property
    def centripetal(self) -> float:
        """Centripetal force at the spindle's rate, g."""
        return self.radius * self.spindle.rate**2 / self.site.gravity

    def at(self, t: Array) -> Motion:
        """Return the motion at times in s, shape (n,)."""
        return Motion(self, t)

    def position(self, t: Array) -> Array:
        """Return r (cos theta, sin theta, 0) in m, shape (n, 3); r is the radius where exact."""
        return self.at(t).position

    def velocity(self, t: Array) -> Array:
        """Return the velocity relative to the Earth in m/s, shape (n, 3)."""
        return self.at(t).velocity

    def acceleration(self, t: Array) -> Array:
        """Return the acceleration relative to the Earth in m/s^2, shape (n, 3).

        Centripetal and tangential parts with the instantaneous rate and angular acceleration;
        the first-order forms of Eq. 5 and 6 are in `counterspin.physics.as_printed` only.
        """
        return self.at(t).acceleration

    def harmful_acceleration(self, t: Array) -> Array:
        """Return what the navigation computer subtracts (Eq. 10, 12), m/s^2, shape (n, 3).

        Coriolis acceleration plus the reaction to gravity, 2 Omega x v + (0, 0, g).
        """
        return self.at(t).harmful_acceleration

    def specific_force(self, t: Array) -> Array:
        """Return the specific force in m/s^2, shape (n, 3)."""
        return self.at(t).specific_force

    def velocity_of_specific_force(self, t: Array) -> Array:
        """Return the integral of the specific force from 0 to t in m/s, shape (n, 3); exact."""
        return self.at(t).velocity_of_specific_force


class Turning:
    """The spindle at some times, shape (n,) each; what rests on the angle is worked out once.

    t: s, shape (n,).
    """

    def __init__(self, spindle: Spindle, t: Array) -> None:
        self.spindle = spindle
        self.t = t

    @cached_property
    def angle(self) -> Array:
        """The angle, rad."""
        return self.spindle.angle(self.t)

    @cached_property
    def rate(self) -> Array:
        """Its rate, rad/s."""
        return self.spindle.angular_rate(self.t)

    @cached_property
    def angular_acceleration(self) -> Array:
        """Its angular acceleration, rad/s^2."""
        return self.spindle.angular_acceleration(self.t)

    @cached_property
    def cosine(self) -> Array:
        """That of the angle."""
        return np.cos(self.angle)

    @cached_property
    def sine(self) -> Array:
        """That of the angle."""
        return np.sin(self.angle)


def turning(spindle: Spindle, t: Array) -> Turning:
    """Return the spindle at some times: the same object for the same times, if they are few.

    The accelerometers of a run share it, and so do all paths along which the spindle may carry
    them: what an error of the radius does, or of gravity, is the difference of two of them.
    """
    if t.size > _MOST_KEPT:
        return Turning(spindle, t)
    return _kept(spindle, t.tobytes(), t.shape)


@lru_cache(maxsize=64)
def _kept(spindle: Spindle, times: bytes, shape: tuple[int, ...]) -> Turning:
    return Turning(spindle, np.frombuffer(times).reshape(shape))


def motion_at(trajectory: Trajectory, t: Array) -> Motion:
    """Return the motion at some times, not to be changed: the same object for the same few times.

    The accelerometers of a run share it.
    """
    if t.size > _MOST_KEPT:
        return trajectory.at(t)
    return _kept_motion(trajectory, t.tobytes(), t.shape)


@lru_cache(maxsize=16)
def _kept_motion(trajectory: Trajectory, times: bytes, shape: tuple[int, ...]) -> Motion:
    return trajectory.at(np.frombuffer(times).reshape(shape))


class Motion:
    """The motion at some times; what several quantities rest on is worked out once.

    The quantities are those of `Trajectory`, shape (n, 3).

    t: s, shape (n,).
    """

    def __init__(self, trajectory: Trajectory, t: Array) -> None:
        self.trajectory = trajectory
        self.t = np.asarray(t, dtype=float)

    @cached_property
    def turning(self) -> Turning:
        """The spindle at these times."""
        return turning(self.trajectory.spindle, self.t)

    @property
    def angle(self) -> Array:
        """The spindle's angle, rad, shape (n,)."""
        return self.turning.angle

    @property
    def rate(self) -> Array:
        """Its rate, rad/s, shape (n,)."""
        return self.turning.rate

    @property
    def angular_acceleration(self) -> Array:
        """Its angular acceleration, rad/s^2, shape (n,)."""
        return self.turning.angular_acceleration

    @property
    def _outward(self) -> tuple[Array, Array]:
        return self.turning.cosine, self.turning.sine

    @cached_property
    def _growth(self) -> tuple[Array, Array, Array] | None:
        """Radius less the trajectory's, m, and its time derivatives; None where there is none."""
        trajectory, w = self.trajectory, self.rate
        if trajectory.stretch == 0.0 and not trajectory.imbalance:
            return None
        spindle = trajectory.spindle
        theta, alpha = self.angle, self.angular_acceleration
        growth, speed, curve = np.zeros((3, *self.t.shape))
        for n, c, s in trajectory.imbalance:
            cos, sin = np.cos(n * theta), np.sin(n * theta)
            slope, bend = n * (s * cos - c * sin), -(n**2) * (c * cos + s * sin)
            growth += c * cos + s * sin
            speed += w * slope
            curve += alpha * slope + w**2 * bend
        scale = trajectory.stretch * trajectory.radius**2
        growth += scale * w**2
        speed += 2.0 * scale * w * alpha
        curve += 2.0 * scale * (alpha**2 + w * spindle.angular_jerk(self.t))
        return growth, speed, curve

    @cached_property
    def position(self) -> Array:
        """m, from the spindle axis."""
        cos, sin = self._outward
        position: Array = self.trajectory.radius * _vectors(cos, sin)
        if self._growth is not None:
            position += _vectors(self._growth[0] * cos, self._growth[0] * sin)
        return self._lifted(position)

    @cached_property
    def velocity(self) -> Array:
        """m/s, relative to the Earth."""
        cos, sin = self._outward
        speed = self.trajectory.radius * self.rate
        velocity = _vectors(-speed * sin, speed * cos)
        if self._growth is not None:
            growth, outward, _ = self._growth
            forward = growth * self.rate
            velocity += _vectors(outward * cos - forward * sin, outward * sin + forward * cos)
        return self._lifted(velocity)

    @cached_property
    def acceleration(self) -> Array:
        """m/s^2, relative to the Earth."""
        cos, sin = self._outward
        squared, alpha = self.rate**2, self.angular_acceleration
        inward = _vectors(squared * cos + alpha * sin, squared * sin - alpha * cos)
        acceleration: Array = -self.trajectory.radius * inward
        if self._growth is not None:
            growth, speed, curve = self._growth
            outward = curve - growth * squared
            forward = 2.0 * speed * self.rate + growth * alpha
            acceleration += _vectors(outward * cos - forward * sin, outward * sin + forward * cos)
        return self._lifted(acceleration)

    def _lifted(self, level: Array) -> Array:
        """Return a vector of the level plane, or its derivative, as the tilted axis lifts it."""
        east, north = self.trajectory.axis_tilt
        if east or north:
            level[..., 2] = east * level[..., 1] - north * level[..., 0]
        return level

    @cached_property
    def harmful_acceleration(self) -> Array:
        """m/s^2, Coriolis acceleration and the reaction to gravity."""
        harmful = self._turned_by_earth(self.velocity)
        harmful[..., 2] += self.trajectory.site.gravity
        return harmful

    @cached_property
    def specific_force(self) -> Array:
        """m/s^2."""
        return self.acceleration + self.harmful_acceleration

    @cached_property
    def velocity_of_specific_force(self) -> Array:
        """m/s, the integral of the specific force from t = 0."""
        start = self.trajectory.at(np.zeros(1))
        gained = self.velocity - start.velocity
        gained += self._turned_by_earth(self.position - start.position)
        gained[..., 2] += self.trajectory.site.gravity * self.t
        return gained

    @cached_property
    def square_of_specific_force(self) -> Array:
        """m^2/s^3, the integral of the squared specific force from t = 0, shape (n,)."""
        trajectory, end = self.trajectory, max(float(np.max(self.t, initial=0.0)), _TINY)

        def squared(t: Array) -> Array:
            sum_of_squares: Array = np.sum(trajectory.specific_force(t) ** 2, axis=1)
            return sum_of_squares[None]

        edges = quadrature.panel_edges(trajectory.spindle, end, coarse=trajectory.coarse)
        total: Array = quadrature.integrate(squared, edges, self.t, 1)[:, 0]
        return total

    def _turned_by_earth(self, vector: Array) -> Array:
        """Return 2 Omega x a vector."""
        _, north, up = 2.0 * self.trajectory.site.earth_rotation
        turned = _vectors(-up * vector[..., 1], up * vector[..., 0], -north * vector[..., 0])
        if any(self.trajectory.axis_tilt):
            turned[..., 0] += north * vector[..., 2]
        return turned


def _vectors(east: Array, north: Array, up: Array | None = None) -> Array:
    """Return components of shape (n,) as vectors, shape (n, 3); level ones without the third."""
    components = np.empty((3, *east.shape))
    components[0], components[1] = east, north
    components[2] = 0.0 if up is None else up
    return components.transpose(*range(1, components.ndim), 0)
