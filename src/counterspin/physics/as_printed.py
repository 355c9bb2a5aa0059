"""The equations of the paper exactly as printed, separate from the exact physics.

Xie, Liu, Qiao, Pan and Ren, *Second-order coefficient calibration method of accelerometer in
platform inertial navigation system tested on double turntable centrifuge*. Several of its
printed expressions differ from the exact ones (``docs/paper.md`` derives each). A calibration uses
them only with the ``as-printed`` model; ``counterspin reproduce`` uses the others to reproduce the
figures of the paper.

The symbols are the paper's: one ripple of the spindle's first harmonic, spindle angle zero at
time zero, an accelerometer Qx pointing east.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from counterspin.arrays import Array

RippleModel = Literal["amplitude", "ratio"]


def specific_force_error(
    time: Array, *, rate: float, drift: float, ripple: float, phase: float, radius: float
) -> Array:
    """Return the specific force errors of Eq. 5 (east) and Eq. 6 (north), as printed.

    The tangential part of the east error has the printed plus sign. Both errors lack the part due
    to evaluating sine and cosine at the nominal instead of the true angle.

    time: Seconds since the spindle angle was zero, shape (n,).
    rate, drift: Nominal rate w0 in rad/s and its relative drift C in 1/s.
    ripple, phase: Amplitude w_p in rad/s and phase phi in rad of the rate's periodic fluctuation.
    radius: R0 in m.
    Returns: east and north errors in m/s^2, shape (n, 2).
    """
    nominal_angle = rate * time
    centripetal = (
        -2.0 * radius * (drift * rate**2 * time + rate * ripple * np.sin(nominal_angle + phase))
    )
    tangential = radius * (drift * rate + rate * ripple * np.cos(nominal_angle + phase))
    return np.column_stack(
        [
            centripetal * np.cos(nominal_angle) + tangential * np.sin(nominal_angle),
            centripetal * np.sin(nominal_angle) + tangential * np.cos(nominal_angle),
        ]
    )


def k_ii_integral(time: Array, rate: float, radius: float, gravity: float) -> Array:
    """Return the printed double integral of the K_II term (after Eq. 13).

    time: Seconds, shape (n,).
    rate, radius, gravity: w0 in rad/s, R0 in m, g in m/s^2.
    Returns: per unit of K_II, shape (n,). Its two parts have different dimensions: the part in t^2
        is in metres (twice the exact value), the harmonic part in metres per second squared.
    """
    scale = radius**2 * rate**4 / gravity
    return scale * (time**2 / 2.0 - np.cos(2.0 * rate * time) / 8.0 + 1.0 / 8.0)


def k_iii_integral(time: Array, rate: float, radius: float, gravity: float) -> Array:
    """Return the printed double integral of the K_III term (after Eq. 13).

    time: Seconds, shape (n,).
    rate, radius, gravity: w0 in rad/s, R0 in m, g in m/s^2.
    Returns: per unit of K_III, shape (n,), in metres per second squared as printed: the exact
        expression times w0^2.
    """
    scale = radius**3 * rate**6 / gravity**2
    angle = rate * time
    return scale * (np.cos(3.0 * angle) / 36.0 + 3.0 / 4.0 * np.cos(angle) - 7.0 / 9.0)


def k_ip_integral(time: Array, rate: float, radius: float) -> Array:
    """Return the printed double integral of the K_IP term (after Eq. 13), which is exact.

    time: Seconds, shape (n,).
    rate, radius: w0 in rad/s, R0 in m.
    Returns: per unit of K_IP, shape (n,), in metres.
    """
    return radius * (1.0 - np.cos(rate * time))


def strobe_error(
    time: Array,
    *,
    rate: float,
    drift: float,
    ripple: float,
    phase: float,
    radius: float,
    gravity: float,
    bias: float,
    scale_factor: float,
    second_order: float,
    radius_error: float = 0.0,
) -> Array:
    """Return the displacement error at the strobes, Eq. 15 as printed, without its noise.

    time: Strobe times in s, where w0 t = pi/2 + 2 k pi, shape (n,).
    gravity: g in m/s^2.
    bias, scale_factor, second_order: K_F in g, K_I in g/g, K_II in g/g^2.
    radius_error: Deviation of the radius from nominal, in m.
    Returns: shape (n,), in m. The last constant, 3/8 R0 sin(phi), is printed without w_p/w0.
    """
    curvature = strobe_curvature(
        rate=rate,
        ripple=ripple,
        phase=phase,
        radius=radius,
        gravity=gravity,
        bias=bias,
        scale_factor=scale_factor,
        second_order=second_order,
    )
    constant = scale_factor * (
        radius_error + 4.0 * radius * drift / rate
    ) + 3.0 / 8.0 * radius * math.sin(phase)
    slope = 2.0 * scale_factor * radius * drift
    error: Array = curvature * time**2 + slope * time + constant
    return error


def strobe_curvature(
    *,
    rate: float,
    ripple: float,
    phase: float,
    radius: float,
    gravity: float,
    bias: float,
    scale_factor: float,
    second_order: float,
) -> float:
    """Return b2, the coefficient of t^2 at the strobes, Eq. 19 as printed.

    bias, scale_factor, second_order: K_F in g, K_I in g/g, K_II in g/g^2.
    Returns: in m/s^2.
    """
    columns = second_stage_columns(np.array([rate]), radius, gravity, scale_factor)
    unknowns = np.array([second_order, ripple * math.sin(phase)])
    return float((columns @ unknowns)[0] + bias * gravity / 2.0)


def second_stage_columns(
    rates: Array,
    radius: float,
    gravity: float,
    scale_factor: float,
    ripple: RippleModel = "amplitude",
) -> Array:
    """Return the second stage's coefficient matrix, Eq. 26 as printed.

    rates: Nominal rates of the runs in rad/s, shape (m,).
    radius, gravity, scale_factor: R0 in m, g in m/s^2, K_I in g/g.
    ripple: Common property of the runs. With ``amplitude`` (Eq. 26), the second unknown is w_p
        sin(phi) in rad/s; with ``ratio`` (Table 2), it is (w_p/w0) sin(phi), dimensionless.
    Returns: columns of K_II (1/2 R0^2 w^4/g, twice the exact one) and of the ripple (-3/4 K_I R0 w,
        or w^2 for a common ratio), shape (m, 2), in m/s^2 per unit.
    """
    if ripple not in ("amplitude", "ratio"):
        raise ValueError(f"ripple must be 'amplitude' or 'ratio', not {ripple!r}")
    power = 1 if ripple == "amplitude" else 2
    return np.column_stack(
        [radius**2 * rates**4 / (2.0 * gravity), -3.0 / 4.0 * scale_factor * radius * rates**power]
    )
