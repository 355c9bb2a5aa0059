"""Motion in space of a table that turns on the arm, and of the instrument on it.

The table turns on the arm by a ratio times the spindle angle. At a ratio of -1 it keeps its
orientation in space. At other ratios it rotates about up, and the specific force is given in the
frame of the table, which is east-north-up at a spindle angle of zero.
"""

from __future__ import annotations

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.effects import AttitudeError


def rotate_about_up(vectors: Array, angle: Array) -> Array:
    """Return vectors (..., 3) in a frame rotated about up by an angle (...), rad."""
    cos, sin = np.cos(angle), np.sin(angle)
    east, north, up = np.moveaxis(vectors, -1, 0)
    return np.stack([cos * east + sin * north, cos * north - sin * east, up], axis=-1)


@frozen
class TableMotion:
    """Motion of the table at n times."""

    turns: float  #: Turns in space per turn of the spindle: 1 plus the ratio.
    #: Angle of the spindle and its derivatives, rad, rad/s and rad/s^2, shape (n,).
    angle: Array
    rate: Array
    angular_acceleration: Array
    earth_rotation: Array  #: In east-north-up, rad/s, shape (3,).

    def rotate(self, vectors: Array) -> Array:
        """Return east-north-up vectors, shape (n, ..., 3), in the frame of the table."""
        if self.turns == 0.0:
            return vectors
        angle = (self.turns * self.angle).reshape(-1, *[1] * (vectors.ndim - 2))
        return rotate_about_up(vectors, angle)

    def rotate_axis(self, axis: Array) -> Array:
        """Return an east-north-up vector, shape (3,), in the frame of the table, shape (n, 3)."""
        return self.rotate(np.broadcast_to(axis, (self.angle.size, 3)))

    def tilt_axis(self, tilt: AttitudeError) -> Array:
        """Return the axis of a tilt in the frame of the table, shape (n, 3).

        The axis is fixed in space, or on the arm if the table's axis is tilted.
        """
        axis = np.eye(3)[tilt.axis]
        if tilt.kind == "tilt":
            return self.rotate_axis(axis)
        angle = (self.turns - 1.0) * self.angle
        return rotate_about_up(np.broadcast_to(axis, (angle.size, 3)), angle)

    def force_change(self, force: Array, force_change_enu: Array, angle_change: Array) -> Array:
        """Return the change of the specific force due to a change of the spindle angle.

        force: Specific force in the frame of the table, shape (n, 3).
        force_change_enu: Change of the force in east-north-up, shape (n, ..., 3).
        angle_change: Change of the spindle angle, which also turns the table, rad, shape (n, ...).
        Returns: in the frame of the table, shape (n, ..., 3).
        """
        if self.turns == 0.0:
            return force_change_enu
        force_derivative = np.cross([0.0, 0.0, self.turns], force)
        force_derivative = force_derivative.reshape(-1, *[1] * (force_change_enu.ndim - 2), 3)
        rotation: Array = angle_change[..., None] * force_derivative
        return self.rotate(force_change_enu) - rotation

    def lever_arm_force(self, direction: Array) -> Array:
        """Return the specific force per metre of distance from the table axis to the proof mass.

        direction: Direction of the distance, unit vector in the frame of the table, shape (3,).
        Returns: in the frame of the table, 1/s^2, shape (n, 3).
        """
        forward = np.cross([0.0, 0.0, 1.0], direction)
        inward = np.cross([0.0, 0.0, 1.0], forward)
        rate = (self.turns * self.rate)[:, None]
        acceleration = (self.turns * self.angular_acceleration)[:, None]
        coriolis = 2.0 * rate * np.cross(self.rotate_axis(self.earth_rotation), forward)
        force: Array = rate**2 * inward + acceleration * forward + coriolis
        return force

    def instrument_rotation(self, axes: Mounting) -> Array | None:
        """Return w_I, w_P (rad/s) and dw_O/dt (rad/s^2) of an instrument, shape (3, n).

        The Earth's rate is neglected.

        Returns: None if the table does not rotate in space.
        """
        if self.turns == 0.0:
            return None
        up = self.turns * axes.matrix[:, 2]
        return np.stack([up[0] * self.rate, up[1] * self.rate, up[2] * self.angular_acceleration])
