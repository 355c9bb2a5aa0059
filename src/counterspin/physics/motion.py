"""Exact motion of the platform of a double-turntable centrifuge.

The second turntable keeps the platform from rotating, so that all its points move on equal circles
and lever arms cancel. Vectors are east-north-up, SI, shape (n, 3); the spindle angle is measured
from east towards north.

Path errors: imbalance of the spindle and stretch of the arm change the radius; a tilt of the
spindle axis lifts and lowers the platform once per revolution; an eccentric encoder records a wrong
angle. The reference contains none of them, so every record does.

The specific force is in the frame of the table (`counterspin.physics.table`), which is
east-north-up unless the table turns in space.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.physics import quadrature
from counterspin.physics.conditions import AT_REFERENCE, RunConditions
from counterspin.physics.effects import TrajectoryError
from counterspin.physics.spindle import Spindle
from counterspin.physics.table import TableMotion
from counterspin.physics.terms import MOTION_TERMS

_MIN_DURATION: Final = float(np.finfo(float).tiny)

#: Largest number of times for which the motion is cached.
_CACHE_SIZE: Final = 16384

EARTH_RATE: Final = 7.292115e-5  #: rad/s, rotation rate of the Earth (WGS 84)


@frozen
class Site:
    """Site of the centrifuge.

    Attributes
    ----------
    gravity
        Plumb-line gravity, m/s^2. It is the unit "g" of every coefficient.
    latitude
        Geodetic latitude, rad.
    earth_rate
        Rotation rate of the Earth, rad/s; 0 leaves the Coriolis acceleration out.
    removed_gravity
        Gravity that the navigation computer subtracts, m/s^2; None: exactly that of the site.
    """

    gravity: float
    latitude: float
    earth_rate: float = EARTH_RATE
    removed_gravity: float | None = None

    @property
    def gravity_left(self) -> float:
        """Gravity that the navigation computer does not remove, upwards, m/s^2."""
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
        Site of the centrifuge.
    stretch
        Relative growth of the radius per centripetal acceleration, s^2/m.
    imbalance
        (n, c, s): change of the radius, c cos n theta + s sin n theta, m.
    axis_tilt
        Small right-handed rotations of the spindle axis about east and north, rad. To first
        order, they only change the height of the platform.
    conditions
        Start time and temperature of the run.
    coarse
        Whether integrals use few panels; see `counterspin.physics.quadrature.panel_edges`.
    table_ratio
        Angle of the table on the arm over the spindle angle; -1: no rotation in space.
    """

    spindle: Spindle
    radius: float
    site: Site
    stretch: float = 0.0
    imbalance: tuple[tuple[int, float, float], ...] = ()
    axis_tilt: tuple[float, float] = (0.0, 0.0)
    conditions: RunConditions = AT_REFERENCE
    coarse: bool = False
    table_ratio: float = -1.0

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
        """Return the correction that the computer subtracts (Eq. 10, 12), m/s^2, shape (n, 3).

        Coriolis acceleration plus the reaction to gravity, 2 Omega x v + (0, 0, g).
        """
        return self.at(t).harmful_acceleration

    def specific_force(self, t: Array) -> Array:
        """Return the specific force in the table's frame in m/s^2, shape (n, 3)."""
        return self.at(t).specific_force

    def velocity_of_specific_force(self, t: Array) -> Array:
        """Return the integral of the specific force from 0 to t in m/s, shape (n, 3); exact."""
        return self.at(t).velocity_of_specific_force


class SpindleState:
    """State of the spindle at given times, shape (n,); each quantity is computed once.

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
        """The angular rate, rad/s."""
        return self.spindle.angular_rate(self.t)

    @cached_property
    def angular_acceleration(self) -> Array:
        """The angular acceleration, rad/s^2."""
        return self.spindle.angular_acceleration(self.t)

    @cached_property
    def cosine(self) -> Array:
        """Cosine of the angle."""
        return np.cos(self.angle)

    @cached_property
    def sine(self) -> Array:
        """Sine of the angle."""
        return np.sin(self.angle)


def spindle_state(spindle: Spindle, t: Array) -> SpindleState:
    """Return the spindle state at given times; cached if the times are few.

    The accelerometers of a run share it, and so do trajectories with errors of radius or gravity.
    """
    if t.size > _CACHE_SIZE:
        return SpindleState(spindle, t)
    return _cached_spindle_state(spindle, t.tobytes(), t.shape)


@lru_cache(maxsize=64)
def _cached_spindle_state(spindle: Spindle, times: bytes, shape: tuple[int, ...]) -> SpindleState:
    return SpindleState(spindle, np.frombuffer(times).reshape(shape))


def motion_at(trajectory: Trajectory, t: Array) -> Motion:
    """Return the motion at given times, read-only; cached if the times are few.

    The accelerometers of a run share it.
    """
    if t.size > _CACHE_SIZE:
        return trajectory.at(t)
    return _cached_motion(trajectory, t.tobytes(), t.shape)


@lru_cache(maxsize=16)
def _cached_motion(trajectory: Trajectory, times: bytes, shape: tuple[int, ...]) -> Motion:
    return trajectory.at(np.frombuffer(times).reshape(shape))


class Motion:
    """The motion at given times; each quantity is computed once.

    The quantities are those of `Trajectory`, shape (n, 3).

    t: s, shape (n,).
    """

    def __init__(self, trajectory: Trajectory, t: Array) -> None:
        self.trajectory = trajectory
        self.t = np.asarray(t, dtype=float)

    @cached_property
    def spindle_state(self) -> SpindleState:
        """The spindle at these times."""
        return spindle_state(self.trajectory.spindle, self.t)

    @property
    def angle(self) -> Array:
        """The spindle's angle, rad, shape (n,)."""
        return self.spindle_state.angle

    @property
    def rate(self) -> Array:
        """The spindle's angular rate, rad/s, shape (n,)."""
        return self.spindle_state.rate

    @property
    def angular_acceleration(self) -> Array:
        """The spindle's angular acceleration, rad/s^2, shape (n,)."""
        return self.spindle_state.angular_acceleration

    @property
    def _outward(self) -> tuple[Array, Array]:
        return self.spindle_state.cosine, self.spindle_state.sine

    @cached_property
    def _radius_growth(self) -> tuple[Array, Array, Array] | None:
        """Growth of the radius, m, and its time derivatives; None if the radius is constant."""
        trajectory, w = self.trajectory, self.rate
        if trajectory.stretch == 0.0 and not trajectory.imbalance:
            return None
        spindle = trajectory.spindle
        theta, alpha = self.angle, self.angular_acceleration
        growth, speed, growth_acceleration = np.zeros((3, *self.t.shape))
        for n, c, s in trajectory.imbalance:
            cos, sin = np.cos(n * theta), np.sin(n * theta)
            slope, second_slope = n * (s * cos - c * sin), -(n**2) * (c * cos + s * sin)
            growth += c * cos + s * sin
            speed += w * slope
            growth_acceleration += alpha * slope + w**2 * second_slope
        scale = trajectory.stretch * trajectory.radius**2
        growth += scale * w**2
        speed += 2.0 * scale * w * alpha
        growth_acceleration += 2.0 * scale * (alpha**2 + w * spindle.angular_jerk(self.t))
        return growth, speed, growth_acceleration

    @cached_property
    def position(self) -> Array:
        """m, from the spindle axis."""
        cos, sin = self._outward
        position: Array = self.trajectory.radius * _vectors(cos, sin)
        if self._radius_growth is not None:
            position += _vectors(self._radius_growth[0] * cos, self._radius_growth[0] * sin)
        return self._tilt_level_vector(position)

    @cached_property
    def velocity(self) -> Array:
        """m/s, relative to the Earth."""
        cos, sin = self._outward
        speed = self.trajectory.radius * self.rate
        velocity = _vectors(-speed * sin, speed * cos)
        if self._radius_growth is not None:
            growth, outward, _ = self._radius_growth
            forward = growth * self.rate
            velocity += _vectors(outward * cos - forward * sin, outward * sin + forward * cos)
        return self._tilt_level_vector(velocity)

    @cached_property
    def acceleration(self) -> Array:
        """m/s^2, relative to the Earth."""
        cos, sin = self._outward
        squared_rate, alpha = self.rate**2, self.angular_acceleration
        inward = _vectors(squared_rate * cos + alpha * sin, squared_rate * sin - alpha * cos)
        acceleration: Array = -self.trajectory.radius * inward
        if self._radius_growth is not None:
            growth, speed, growth_acceleration = self._radius_growth
            outward = growth_acceleration - growth * squared_rate
            forward = 2.0 * speed * self.rate + growth * alpha
            acceleration += _vectors(outward * cos - forward * sin, outward * sin + forward * cos)
        return self._tilt_level_vector(acceleration)

    def _tilt_level_vector(self, vector: Array) -> Array:
        """Return a level vector, or its derivative, with the height due to the tilt of the axis."""
        east, north = self.trajectory.axis_tilt
        if east or north:
            vector[..., 2] = east * vector[..., 1] - north * vector[..., 0]
        return vector

    @cached_property
    def harmful_acceleration(self) -> Array:
        """m/s^2, Coriolis acceleration and the reaction to gravity."""
        harmful = self._coriolis(self.velocity)
        harmful[..., 2] += self.trajectory.site.gravity
        return harmful

    @cached_property
    def specific_force(self) -> Array:
        """m/s^2, in the frame of the table, which is east-north-up for a ratio of -1."""
        return self.table.rotate(self.acceleration + self.harmful_acceleration)

    @property
    def table(self) -> TableMotion:
        """Motion of the table, and of the instrument on it, in space."""
        turns = 1.0 + self.trajectory.table_ratio
        earth_rotation = self.trajectory.site.earth_rotation
        return TableMotion(turns, self.angle, self.rate, self.angular_acceleration, earth_rotation)

    @cached_property
    def velocity_of_specific_force(self) -> Array:
        """m/s, the integral of the specific force from t = 0."""
        start = self.trajectory.at(np.zeros(1))
        velocity_change = self.velocity - start.velocity
        velocity_change += self._coriolis(self.position - start.position)
        velocity_change[..., 2] += self.trajectory.site.gravity * self.t
        return velocity_change

    @cached_property
    def displacement_of_specific_force(self) -> Array:
        """m, the double integral of the specific force from t = 0.

        The double integral of the acceleration is the position minus its initial value and slope; a
        quadrature would be a small difference of large numbers. Only the Coriolis part, 2 Omega x
        (integral of the position), requires a quadrature.
        """
        t, start = self.t, self.trajectory.at(np.zeros(1))
        displacement = self.position - start.position - start.velocity * t[:, None]
        position_integral = self._integrate(lambda motion: motion.position.T[:2])
        position_integral -= start.position[:, :2] * t[:, None]
        east, north = 2.0 * position_integral.T
        _, rotation_north, rotation_up = self.trajectory.site.earth_rotation
        displacement[:, 0] -= rotation_up * north
        displacement[:, 1] += rotation_up * east
        displacement[:, 2] += 0.5 * self.trajectory.site.gravity * t**2 - rotation_north * east
        return np.asarray(displacement)

    @cached_property
    def square_of_specific_force(self) -> Array:
        """m^2/s^3, the integral of the squared specific force from t = 0, shape (n,)."""
        integral: Array = self._integrate(lambda m: np.sum(m.specific_force**2, axis=1)[None])
        return integral[:, 0]

    def _integrate(self, function: Callable[[Motion], Array]) -> Array:
        """Return integrals of k functions of the motion from t = 0, shape (n, k)."""
        end = max(float(np.max(self.t, initial=0.0)), _MIN_DURATION)
        edges = quadrature.panel_edges(self.trajectory.spindle, end, coarse=self.trajectory.coarse)
        return quadrature.integrate(lambda t: function(self.trajectory.at(t)), edges, self.t, 1)

    def _coriolis(self, vector: Array) -> Array:
        """Return 2 Omega x a vector."""
        _, north, up = 2.0 * self.trajectory.site.earth_rotation
        product = _vectors(-up * vector[..., 1], up * vector[..., 0], -north * vector[..., 0])
        if any(self.trajectory.axis_tilt):
            product[..., 0] += north * vector[..., 2]
        return product


def _vectors(east: Array, north: Array, up: Array | None = None) -> Array:
    """Return components of shape (n,) as vectors, shape (n, 3); `up` is zero by default."""
    components = np.empty((3, *east.shape))
    components[0], components[1] = east, north
    components[2] = 0.0 if up is None else up
    return components.transpose(*range(1, components.ndim), 0)


# Path errors -----------------------------------------------------------------------------------


def perturb_trajectory(trajectory: Trajectory, values: Mapping[str, float]) -> Trajectory:
    """Return the trajectory with errors of radius and axis applied."""
    errors = [(MOTION_TERMS[s].effect, value) for s, value in values.items() if s in MOTION_TERMS]
    imbalance = tuple(
        (error.harmonic, value, 0.0) if error.quadrature == "cos" else (error.harmonic, 0.0, value)
        for error, value in errors
        if error.kind == "imbalance" and value != 0.0
    )
    stretch = values.get("centrifuge.stretch", 0.0)
    axis_tilt = (
        values.get("centrifuge.axis_tilt.east", 0.0),
        values.get("centrifuge.axis_tilt.north", 0.0),
    )
    if not imbalance and stretch == 0.0 and axis_tilt == (0.0, 0.0):
        return trajectory
    return replace(trajectory, stretch=stretch, imbalance=imbalance, axis_tilt=axis_tilt)


def encoder_error(values: Mapping[str, float], angle: Array) -> Array:
    """Return the recorded angle minus the true angle in rad, shape (n,).

    angle: The true angle, rad, shape (n,).
    """
    total = np.zeros_like(angle)
    for symbol, value in values.items():
        if symbol not in MOTION_TERMS or value == 0.0:
            continue
        error = MOTION_TERMS[symbol].effect
        if error.kind == "encoder":
            quadrature_function = np.cos if error.quadrature == "cos" else np.sin
            total += value * quadrature_function(error.harmonic * angle)
    return total


def trajectory_sensitivity(symbol: str, circle: Motion, order: int) -> Array:
    """Return the true motion minus the motion on the circle at the recorded angle.

    order: 2 for the position, 1 for the velocity, 0 for the specific force.
    Returns: per unit of the term, in east-north-up, shape (n, 3).
    """
    if (error := MOTION_TERMS[symbol].effect).kind == "encoder":
        return _encoder_sensitivity(error, circle, order)
    # The motion is linear in radius and tilt, so a unit of the error gives its derivative.
    perturbed_motion = motion_at(perturb_trajectory(circle.trajectory, {symbol: 1.0}), circle.t)
    change: Array
    if order == 2:
        change = perturbed_motion.position - circle.position
    elif order == 1:
        change = perturbed_motion.velocity - circle.velocity
    else:
        change = perturbed_motion.specific_force - circle.specific_force
    return change


def _encoder_sensitivity(error: TrajectoryError, circle: Motion, order: int) -> Array:
    """Return the change of the motion by an encoder error, by which the true angle lags.

    The horizontal position is R e^(i theta). A unit of the error with harmonic q changes it by
    -i R q e^(i theta), and velocity and acceleration by the derivatives.
    """
    trajectory, n, spindle_state = circle.trajectory, error.harmonic, circle.spindle_state
    rate, acceleration = circle.rate, circle.angular_acceleration
    phasor = spindle_state.cosine + 1j * spindle_state.sine
    phasor_n = phasor
    for _ in range(n - 1):
        phasor_n = phasor_n * phasor
    cos, sin = phasor_n.real, phasor_n.imag
    # The wave and its derivative by n times the angle.
    wave, slope = (cos, -sin) if error.quadrature == "cos" else (sin, cos)

    def change(order: int) -> Array:
        if order == 2:
            tangential = wave
        elif order == 1:
            tangential = n * rate * slope + 1j * rate * wave
        else:
            curvature = n * acceleration * slope - (n * rate) ** 2 * wave
            tangential = curvature + 2j * n * rate**2 * slope
            tangential += (1j * acceleration - rate**2) * wave
        level_vector = -1j * trajectory.radius * tangential * phasor
        return np.column_stack([level_vector.real, level_vector.imag, np.zeros(wave.size)])

    if order > 0:
        return change(order)
    force_change = change(0) + 2.0 * np.cross(trajectory.site.earth_rotation, change(1))
    return circle.table.force_change(circle.specific_force, force_change, -wave)
