"""Errors of the path: the centrifuge does not carry the platform where the recorded angle says.

A spindle out of balance and an arm that stretches change the radius; a spindle whose axis is tilted
lifts and lowers the platform once a revolution; an eccentric encoder records another angle than the
spindle's. None of these is in the reference, so all show in every record.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from counterspin.arrays import Array
from counterspin.physics.effects import PathError
from counterspin.physics.motion import Motion, Trajectory, motion_at
from counterspin.physics.terms import MOTION_TERMS


def true_trajectory(trajectory: Trajectory, shared: Mapping[str, float]) -> Trajectory:
    """Return the path with the errors of radius and axis, where there are any."""
    errors = [(MOTION_TERMS[s].effect, value) for s, value in shared.items() if s in MOTION_TERMS]
    imbalance = tuple(
        (error.harmonic, value, 0.0) if error.quadrature == "cos" else (error.harmonic, 0.0, value)
        for error, value in errors
        if error.kind == "imbalance" and value != 0.0
    )
    stretch = shared.get("centrifuge.stretch", 0.0)
    tilt = (
        shared.get("centrifuge.axis_tilt.east", 0.0),
        shared.get("centrifuge.axis_tilt.north", 0.0),
    )
    if not imbalance and stretch == 0.0 and tilt == (0.0, 0.0):
        return trajectory
    return replace(trajectory, stretch=stretch, imbalance=imbalance, axis_tilt=tilt)


def encoder_error(shared: Mapping[str, float], angle: Array) -> Array:
    """Return the recorded angle less the true one in rad, shape (n,).

    angle: The true angle, rad, shape (n,).
    """
    total = np.zeros_like(angle)
    for symbol, value in shared.items():
        if symbol not in MOTION_TERMS or value == 0.0:
            continue
        error = MOTION_TERMS[symbol].effect
        if error.kind == "encoder":
            wave = np.cos if error.quadrature == "cos" else np.sin
            total += value * wave(error.harmonic * angle)
    return total


def path_change(symbol: str, circle: Motion, order: int) -> Array:
    """Return the true motion less that of the circle at the recorded angle.

    order: 2 for the position, 1 for the velocity, 0 for the specific force.
    Returns: per unit of the term, in east-north-up, shape (n, 3).
    """
    if (error := MOTION_TERMS[symbol].effect).kind == "encoder":
        return _turned_back(error, circle, order)
    # The motion is linear in radius and tilt: a whole unit of the error shows its derivative.
    moved = motion_at(true_trajectory(circle.trajectory, {symbol: 1.0}), circle.t)
    change: Array
    if order == 2:
        change = moved.position - circle.position
    elif order == 1:
        change = moved.velocity - circle.velocity
    else:
        change = moved.specific_force - circle.specific_force
    return change


def _turned_back(error: PathError, circle: Motion, order: int) -> Array:
    """Return what the encoder's error makes of the motion: the true angle is behind by it.

    In the level the platform is at R e^(i theta), a unit of the error takes it by
    -i R q e^(i theta), q being the wave, and its velocity and acceleration by the derivatives.
    """
    trajectory, n, turning = circle.trajectory, error.harmonic, circle.turning
    rate, acceleration = circle.rate, circle.angular_acceleration
    turned = turning.cosine + 1j * turning.sine
    times_n = turned
    for _ in range(n - 1):
        times_n = times_n * turned
    cos, sin = times_n.real, times_n.imag
    # wave and its derivative by the angle's n-fold
    wave, slope = (cos, -sin) if error.quadrature == "cos" else (sin, cos)

    def change(order: int) -> Array:
        if order == 2:
            along = wave
        elif order == 1:
            along = n * rate * slope + 1j * rate * wave
        else:
            curve = n * acceleration * slope - (n * rate) ** 2 * wave
            along = curve + 2j * n * rate**2 * slope + (1j * acceleration - rate**2) * wave
        level = -1j * trajectory.radius * along * turned
        return np.column_stack([level.real, level.imag, np.zeros(wave.size)])

    if order > 0:
        return change(order)
    return change(0) + 2.0 * np.cross(trajectory.site.earth_rotation, change(1))
