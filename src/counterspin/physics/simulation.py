"""Records of an imperfect system without linearisation: the full Eq. 7 on a rotated platform.

Estimation uses columns that are linear in the coefficients (`counterspin.physics.observation`).
This module instead rotates the specific force by the full attitude error of the platform, applies
the complete error model and integrates, including products of small terms.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from counterspin.arrays import Array
from counterspin.physics import observation, quadrature
from counterspin.physics.accelerometer import Mounting, indicated
from counterspin.physics.conditions import RunConditions
from counterspin.physics.motion import Trajectory, perturb_trajectory
from counterspin.physics.spindle import Spindle
from counterspin.physics.terms import (
    CONDITION_TERMS,
    LEVER_ARM,
    PLATFORM_TERMS,
    TERMS,
    condition_of,
)


def attitude_error(
    trajectory: Trajectory,
    platform_values: Mapping[str, float],
    times: Array,
    attitude: Array = observation.LEVEL,
) -> Array:
    """Return the platform's attitude error psi(t) in the frame of the specific force.

    psi = tilt + drift t + D (integral of f)/g + E (integral of |f|^2)/g^2 + C f/g; an instrument
    on the counter-rotating table also rotates about up by the angle error of the table.

    trajectory: The motion; the tilt is that at t = 0.
    times: s, shape (n,).
    attitude: Rows: where the platform's x, y, z axes point, shape (3, 3).
    Returns: rotation vector in rad, shape (n, 3).
    """
    psi = np.zeros((times.size, 3))
    motion, g = trajectory.at(times), trajectory.site.gravity
    for symbol, value in platform_values.items():
        row = PLATFORM_TERMS[symbol].effect
        if row.kind in ("tilt", "table_axis"):
            psi += value * motion.table.tilt_axis(row)
            continue
        if row.kind == "table":
            psi[:, 2] += value * observation.table_angle_error(row, motion)
            continue
        if row.kind == "g_sensitivity":
            angle = motion.velocity_of_specific_force @ attitude[row.force_axis] / g
        elif row.kind == "compliance":
            angle = motion.specific_force @ attitude[row.force_axis] / g
        else:
            angle = times if row.kind == "drift" else motion.square_of_specific_force / g**2
        psi += value * angle[:, None] * attitude[row.axis]
    return psi


def simulate_record(
    trajectory: Trajectory,
    mounting: Mounting,
    coefficients: Mapping[str, float],
    shared_values: Mapping[str, float],
    times: Array,
    observable: str = "displacement",
    *,
    attitude: Array = observation.LEVEL,
) -> Array:
    """Return the noiseless record of the system along one input axis.

    The navigation computer knows its position and velocity at t = 0 exactly. For the recorded
    angle, see `counterspin.physics.motion.encoder_error`.

    mounting: Axes of the accelerometer in the level attitude.
    coefficients: Accelerometer terms by symbol, including slopes with conditions, g-units; the
        others are nominal.
    times: s, not negative, shape (n,).
    observable: ``displacement`` (m), ``velocity`` (m/s) or ``specific_force`` (m/s^2).
    Returns: shape (n,).
    """
    if mounting.response is not None:
        return _filtered_record(
            trajectory, mounting, coefficients, shared_values, times, observable, attitude
        )
    order = observation.ORDERS[observable]
    axes = mounting.turned(attitude)
    trajectory = perturb_trajectory(trajectory, shared_values)
    platform_values = {
        symbol: value for symbol, value in shared_values.items() if symbol in PLATFORM_TERMS
    }
    g = trajectory.site.gravity
    trend = sum(slope for symbol, slope in coefficients.items() if condition_of(symbol) == "time")
    conditions, all_coefficients = trajectory.conditions, coefficients
    coefficients = run_coefficients(coefficients, conditions, trajectory.centripetal)
    scale_error = coefficients.get("K_I", 1.0) - 1.0
    lever_arm = shared_values.get(LEVER_ARM, 0.0)

    def residual_force(t: Array) -> Array:
        """Return the error of the indicated force minus that of the scale factor, m/s^2."""
        motion = trajectory.at(t)
        force = proof_mass_force = motion.specific_force
        if lever_arm != 0.0:
            lever_arm_force = lever_arm * motion.table.lever_arm_force(axes.input_axis)
            proof_mass_force = force + lever_arm_force
        psi = attitude_error(trajectory, platform_values, t, attitude)
        sensed_force = _rotate_force(proof_mass_force, psi) / g
        rotation = motion.table.instrument_rotation(axes)
        sensor_output = indicated(axes, coefficients, sensed_force, rotation) + _change_since_start(
            all_coefficients, conditions, axes, sensed_force, t
        )
        return g * (sensor_output + trend * t) - (1.0 + scale_error) * (force @ axes.input_axis)

    # The contribution of the scale factor has an exact integral; a quadrature is less accurate.
    exact_output = observation.columns(
        trajectory, mounting, ["K_I"], times, observable, attitude=attitude
    )[:, 0]
    reference = observation.reference(trajectory, mounting, times, observable, attitude)
    if order == 0:
        return reference + scale_error * exact_output + residual_force(times)
    duration = max(float(times.max(initial=0.0)), np.finfo(float).tiny)
    breaks = conditions.breaks
    edges = quadrature.panel_edges(trajectory.spindle, duration, breaks)
    if any(row.effect.has_kink and coefficients.get(s, 0.0) for s, row in TERMS.items()):
        axis = axes.input_axis
        kinks = quadrature.sign_changes(lambda t: trajectory.specific_force(t) @ axis, edges)
        edges = quadrature.panel_edges(trajectory.spindle, duration, np.append(breaks, kinks))
    error = quadrature.integrate(lambda t: residual_force(t)[None], edges, times, order)[:, 0]
    return reference + scale_error * exact_output + error


def _filtered_record(
    trajectory: Trajectory,
    mounting: Mounting,
    coefficients: Mapping[str, float],
    shared_values: Mapping[str, float],
    times: Array,
    observable: str,
    attitude: Array,
) -> Array:
    """Return the record of an accelerometer with a frequency response, shape (n,)."""
    assert mounting.response is not None
    static = replace(mounting, response=None)

    def error(spindle: Spindle) -> Array:
        motion = replace(trajectory, spindle=spindle)
        values = coefficients, shared_values, times, observable
        record = simulate_record(motion, static, *values, attitude=attitude)
        return record - observation.reference(motion, static, times, observable, attitude)

    shifts = mounting.response.total_shifts(trajectory.spindle.rate)
    filtered_error = shifts.apply(trajectory.spindle, error)
    return filtered_error + observation.reference(trajectory, mounting, times, observable, attitude)


def _change_since_start(
    coefficients: Mapping[str, float],
    conditions: RunConditions,
    axes: Mounting,
    force: Array,
    times: Array,
) -> Array | float:
    """Return the change of the indication with conditions since the start of the run.

    force: Sensed force at the times, g, shape (n, 3).
    times: Times from the start of the run, s, shape (n,).
    Returns: g, shape (n,), or 0.
    """
    total: Array | float = 0.0
    for symbol, slope in coefficients.items():
        row = CONDITION_TERMS.get(symbol)
        if (
            row is None
            or slope == 0.0
            or row.effect.condition not in conditions.changing_conditions
        ):
            continue
        factors = row.effect.design_factors(conditions.at(times, 0.0))
        change = factors - row.effect.design_factor(conditions, 0.0)
        product = TERMS[row.effect.coefficient].effect.evaluate(axes.matrix @ force.T)
        total = total + slope * change * product
    return total


def run_coefficients(
    coefficients: Mapping[str, float], conditions: RunConditions, force: float
) -> dict[str, float]:
    """Return the coefficients at the start of a run, at its mean temperature."""
    values = {symbol: value for symbol, value in coefficients.items() if symbol in TERMS}
    for symbol, slope in coefficients.items():
        row = CONDITION_TERMS.get(symbol)
        if row is None or slope == 0.0:
            continue
        coefficient = row.effect.coefficient
        reference_value = values.get(coefficient, TERMS[coefficient].nominal)
        factor = row.effect.design_factor(conditions, force)
        values[coefficient] = reference_value + slope * factor
    return values


def _rotate_force(force: Array, psi: Array) -> Array:
    """Return the specific force in the axes of a platform rotated by psi (Rodrigues)."""
    angle = np.linalg.norm(psi, axis=1)[:, None]
    cross_product = np.cross(psi, force)
    double_cross_product = np.cross(psi, cross_product)
    # sin(x)/x and (1 - cos x)/x^2, in forms that are finite at x = 0
    rotated_force: Array = force - np.sinc(angle / np.pi) * cross_product
    rotated_force += 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * double_cross_product
    return rotated_force
