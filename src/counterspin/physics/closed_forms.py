"""Closed forms at constant rate: the t^2 coefficient of each term's displacement (Eq. 19)."""

from __future__ import annotations

import math

import numpy as np

from counterspin.arrays import Array
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.conditions import AT_REFERENCE
from counterspin.physics.effects import AttitudeError, Slope, SpecificForceProduct
from counterspin.physics.terms import term


def parabola(symbol: str, mounting: Mounting, rate: float, radius: float, gravity: float) -> float:
    """Return the t^2 coefficient of a term's displacement at constant rate, in closed form.

    Without Earth rate, from start angle 0, in the level attitude, for a horizontal input axis
    with the pendulous axis vertical. This is the corrected content of Eq. 19: K_II enters with
    1/4, not 1/2.

    symbol: A term of the table; those without a parabola give 0 (drift grows with t^3).
    rate, radius, gravity: rad/s (signed), m, m/s^2.
    Returns: m/s^2 per unit coefficient.
    """
    matrix = mounting.matrix
    if abs(matrix[0, 2]) > 1e-9 or abs(abs(matrix[1, 2]) - 1.0) > 1e-9:
        raise ValueError(
            "closed forms require a horizontal input axis and a vertical pendulous axis"
        )
    force = radius * rate**2 / gravity
    match term(symbol).effect:
        case Slope() as slope:
            return 0.5 * gravity * slope.design_factor(AT_REFERENCE, force)
        case SpecificForceProduct(requires_rotation=False) as product:
            vertical_factor = float(matrix[1, 2]) ** product.factors.count(
                "P"
            )  # a_P is -1 with P down
            horizontal_factor = force ** (product.degree - product.factors.count("P"))
            return (
                0.5
                * gravity
                * product.weight
                * vertical_factor
                * horizontal_factor
                * _mean_over_revolution(product)
            )
        case AttitudeError() as attitude_error:
            return _platform_parabola(attitude_error, matrix, rate, radius, gravity)
    return 0.0  # the path comes back to where it was after each revolution


def _platform_parabola(
    effect: AttitudeError, matrix: Array, rate: float, radius: float, gravity: float
) -> float:
    force = radius * rate**2 / gravity
    rotation_sensitivity = np.cross(np.eye(3)[effect.axis], matrix[0])
    if effect.kind == "tilt":
        return 0.5 * gravity * float(rotation_sensitivity[2])
    if effect.kind == "g_sensitivity" and effect.force_axis in (0, 1):
        # psi follows the velocity gained since the start. About the vertical it turns the
        # centripetal force, and the product has a mean where the two directions cross;
        # about a horizontal axis the start velocity stays behind as a tilt against gravity.
        tangential = float(np.cross(np.eye(3)[effect.force_axis], rotation_sensitivity)[2])
        start_velocity = radius * rate if effect.force_axis == 1 else 0.0
        return (
            0.25 * radius * rate * force * tangential
            - 0.5 * float(rotation_sensitivity[2]) * start_velocity
        )
    if effect.kind == "table" and effect.harmonic == 1:
        # The centripetal force turns with the table's error: half of it stays in the mean.
        cross_component = -matrix[0, 1] if effect.quadrature == "cos" else matrix[0, 0]
        return -0.25 * radius * rate**2 * float(cross_component)
    if effect.kind == "compliance" and effect.force_axis is not None:
        # Gravity leans the platform for good; a level force comes round with what it turns.
        is_level = effect.force_axis < 2
        return (
            0.5
            * gravity
            * float(rotation_sensitivity[effect.force_axis])
            * (0.5 * force**2 if is_level else 1.0)
        )
    return 0.0


def _mean_over_revolution(product: SpecificForceProduct) -> float:
    """Return the mean of a product over a revolution: a_I is a cosine there, a_O a sine."""
    i, o = product.power, product.factors.count("O")
    if not product.is_even or o % 2:
        return 0.0
    # The beta integral, (i-1)!! (o-1)!! / (i+o)!! in terms of gamma functions.
    gamma_product = math.gamma((i + 1) / 2) * math.gamma((o + 1) / 2)
    return gamma_product / (math.pi * math.gamma((i + o) / 2 + 1))
