"""Equations 5 to 19: coefficients as printed and from simulations by Eq. 7."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.physics import as_printed
from counterspin.physics.motion import Trajectory
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.reproduction.plan import (
    DRIFT_RATE,
    GRAVITY,
    RADIUS,
    RADIUS_ERROR,
    RATES,
    RIPPLE_PHASE,
    RIPPLE_RATIO,
    SITE,
    TABLE_1,
    Row,
    fit_first_stage,
    simulate_strobes,
)

RATE: Final = RATES[-1]
RIPPLE_AMPLITUDE: Final = RIPPLE_RATIO * RATE  #: w_p, rad/s
RIPPLE_UNIT: Final = RADIUS * RATE * RIPPLE_AMPLITUDE * math.sin(RIPPLE_PHASE)  #: R w0 w_p sin(phi)
_EXPANDED_TERMS: Final = ("K_II", "K_III", "K_IP")  #: of the expansion below Eq. 13
RECTIFICATION_UNIT: Final = RADIUS**2 * RATE**4 / GRAVITY  #: R^2 w0^4/g


def equation_rows() -> tuple[Row, ...]:
    """Return the rows of Eq. 5 to 19, in the order of the paper."""
    return (*_mean_force_rows(), *_expansion_rows(), *_ripple_and_drift_rows(), *_constant_rows())


def _mean_force_rows() -> tuple[Row, ...]:
    """Return the row of the mean of Eq. 5 over a revolution, without drift."""
    time = np.linspace(0.0, 2 * math.pi / RATE, 256, endpoint=False)
    spindle = Spindle(RATE, ripples=(Ripple(1, RIPPLE_AMPLITUDE, RIPPLE_PHASE),))
    exact_acceleration = Trajectory(spindle, RADIUS, SITE).acceleration(time)[:, 0]
    printed_acceleration = as_printed.specific_force_error(
        time, rate=RATE, drift=0.0, ripple=RIPPLE_AMPLITUDE, phase=RIPPLE_PHASE, radius=RADIUS
    )[:, 0]
    return (
        Row(
            "eq5.ripple_mean",
            "Eq. 5: mean east acceleration due to ripple",
            float(np.mean(printed_acceleration)) / RIPPLE_UNIT,
            float(np.mean(exact_acceleration)) / RIPPLE_UNIT,
            "R w0 w_p sin(phi)",
            "the tangential part has the wrong sign, and -sin(w0 t) d(theta) is omitted; the "
            "mean acceleration of a periodic motion is zero",
            "z.3f",
        ),
    )


def _expansion_rows() -> tuple[Row, ...]:
    """Return the rows of the expansions below Eq. 13, against runs with a single coefficient."""
    time, _ = simulate_strobes(RATE)
    k_ii_fit, k_iii_fit, k_ip_fit = (
        fit_first_stage(*simulate_strobes(RATE, truth={"K_I": 1.0, symbol: TABLE_1[symbol]}))
        for symbol in _EXPANDED_TERMS
    )
    printed_k_ii_fit = fit_first_stage(time, as_printed.k_ii_integral(time, RATE, RADIUS, GRAVITY))
    printed_k_iii_error = as_printed.k_iii_integral(time, RATE, RADIUS, GRAVITY)
    printed_k_ip_error = as_printed.k_ip_integral(time, RATE, RADIUS)
    return (
        Row(
            "eq13.k_ii_parabola",
            "Eq. 13: t^2 coefficient of K_II",
            printed_k_ii_fit.b2 / RECTIFICATION_UNIT,
            k_ii_fit.b2 / TABLE_1["K_II"] / RECTIFICATION_UNIT,
            "R^2 w0^4/g",
            "cos^2 has a mean of 1/2, and the double integral of 1/2 is t^2/4",
            ".4f",
        ),
        Row(
            "eq13.k_ii_constant",
            "Eq. 13: the K_II term is constant at the strobes, rate 2 pi rad/s",
            TABLE_1["K_II"] * float(printed_k_ii_fit.coefficients[0]),
            float(k_ii_fit.coefficients[0]),
            "m",
            "the division of the harmonic part by w0^2 is missing; the error affects only b0",
            ".3e",
        ),
        Row(
            "eq13.k_iii_constant",
            "Eq. 13: the K_III term is constant at the strobes, rate 2 pi rad/s",
            TABLE_1["K_III"] * float(np.mean(printed_k_iii_error)),
            float(k_iii_fit.coefficients[0]),
            "m",
            "the same division by w0^2 is missing; the error affects only b0",
            ".3e",
        ),
        Row(
            "eq13.k_ip_constant",
            "Eq. 13: K_IP constant at the strobes",
            TABLE_1["K_IP"] * float(np.mean(printed_k_ip_error)),
            float(k_ip_fit.coefficients[0]),
            "m",
            "agrees",
            ".3e",
        ),
    )


def _ripple_and_drift_rows() -> tuple[Row, ...]:
    """Return the rows of ripple and drift in Eq. 15 (nominal angle), and of b2 in Eq. 19."""
    steady_coefficients, ripple_coefficients, drift_coefficients = (
        _fit_simulated_strobes(ripple, drift)
        for ripple, drift in ((0.0, 0.0), (RIPPLE_AMPLITUDE, 0.0), (0.0, DRIFT_RATE))
    )
    printed_steady_coefficients, printed_ripple_coefficients, printed_drift_coefficients = (
        _fit_printed_strobes(ripple, drift, phase)
        for ripple, drift, phase in (
            (0.0, 0.0, 0.0),
            (RIPPLE_AMPLITUDE, 0.0, RIPPLE_PHASE),
            (0.0, DRIFT_RATE, 0.0),
        )
    )
    drift_unit = TABLE_1["K_I"] * RADIUS * DRIFT_RATE
    ripple_unit = TABLE_1["K_I"] * RIPPLE_UNIT
    printed_b2 = as_printed.strobe_curvature(
        rate=RATE,
        ripple=RIPPLE_AMPLITUDE,
        phase=RIPPLE_PHASE,
        radius=RADIUS,
        gravity=GRAVITY,
        bias=TABLE_1["K_F"],
        scale_factor=TABLE_1["K_I"],
        second_order=TABLE_1["K_II"],
    )
    return (
        Row(
            "eq15.ripple_parabola",
            "Eq. 15, 19: t^2 coefficient of ripple",
            float(printed_ripple_coefficients[2] - printed_steady_coefficients[2]) / ripple_unit,
            float(ripple_coefficients[2] - steady_coefficients[2]) / ripple_unit,
            "K_I R w0 w_p sin(phi)",
            "half the mean of Eq. 5 above; with the exact kinematics, the term vanishes",
            "z.3f",
        ),
        Row(
            "eq15.ripple_constant",
            "Eq. 15: ripple constant",
            float(printed_ripple_coefficients[0] - printed_steady_coefficients[0]),
            float(ripple_coefficients[0] - steady_coefficients[0]),
            "m",
            "the factor w_p/w0 is missing; the error affects only b0",
            ".3e",
        ),
        Row(
            "eq15.drift_slope",
            "Eq. 15: slope due to drift, nominal angle as reference",
            float(printed_drift_coefficients[1] - printed_steady_coefficients[1]) / drift_unit,
            float(drift_coefficients[1] - steady_coefficients[1]) / drift_unit,
            "K_I R C",
            "the drift makes the platform lead the nominal angle in proportion to t^2, not to t",
            "z.2f",
        ),
        Row(
            "eq15.drift_parabola",
            "Eq. 15: t^2 coefficient of drift, nominal angle as reference",
            float(printed_drift_coefficients[2] - printed_steady_coefficients[2])
            / drift_unit
            / RATE,
            float(drift_coefficients[2] - steady_coefficients[2]) / drift_unit / RATE,
            "K_I R C w0",
            (
                "a column proportional to w0 must absorb this coefficient; with a measured angle, "
                "the coefficient is zero"
            ),
            "z.2f",
        ),
        Row(
            "eq19.b2",
            "Eq. 19: b2 with Tables 1 and 2, 2 pi rad/s",
            printed_b2,
            fit_first_stage(*simulate_strobes(RATE)).b2,
            "m/s^2",
            "1/2 instead of 1/4 for K_II; both values include the bias of 0.004 g",
            ".6e",
        ),
    )


def _constant_rows() -> tuple[Row, ...]:
    """Return the rows of the constants of Eq. 15, which the first stage collects in b0."""
    scale_factor = TABLE_1["K_I"]
    term_constants = sum(
        fit_first_stage(
            *simulate_strobes(RATE, truth={"K_I": 1.0, symbol: TABLE_1[symbol]}, ripple_ratio=0.0)
        ).coefficients[0]
        for symbol in _EXPANDED_TERMS
    )
    steady_coefficients = _fit_simulated_strobes(0.0, 0.0)
    # The cube of the angle error stays below the constant at this drift.
    drift_rate = 0.1 * DRIFT_RATE
    drift_effect = _fit_simulated_strobes(0.0, drift_rate) - steady_coefficients
    radius_effect = _fit_simulated_strobes(0.0, 0.0, RADIUS_ERROR) - steady_coefficients
    drift_unit = scale_factor * RADIUS * drift_rate / RATE
    return (
        Row(
            "eq15.term_constants",
            "Eq. 15: K_II, K_III and K_IP constants, 2 pi rad/s",
            _printed_constant(second_order_term=TABLE_1["K_II"]),
            float(term_constants),
            "m",
            "Eq. 15 omits the constants of the expansion below Eq. 13; the error affects only b0",
            "z.3e",
        ),
        Row(
            "eq15.drift_constant",
            "Eq. 15: drift constant, nominal angle as reference",
            _printed_constant(drift=drift_rate) / drift_unit,
            float(drift_effect[0]) / drift_unit,
            "K_I R C/w0",
            "the centripetal acceleration alone gives -4, and the total acceleration gives 0; "
            "the error affects only b0",
            "z.2f",
        ),
        Row(
            "eq15.radius_constant",
            "Eq. 15: radius error constant",
            _printed_constant(radius_error=RADIUS_ERROR) / (scale_factor * RADIUS_ERROR),
            float(radius_effect[0]) / (scale_factor * RADIUS_ERROR),
            "K_I dr",
            "the integral of the radius term of Eq. 14 is K_I dr (cos(w0 t) - 1); the error "
            "affects only b0",
            "z.2f",
        ),
    )


def _fit_simulated_strobes(ripple: float, drift: float, radius_error: float = 0.0) -> Array:
    """Return b0, b1, b2 of a simulated run with K_I only and nominal angle, shape (3,)."""
    time, error = simulate_strobes(
        RATE,
        truth={"K_I": TABLE_1["K_I"]},
        ripple_ratio=ripple / RATE,
        drift=drift,
        uses_nominal_angle=True,
        radius_error=radius_error,
    )
    return fit_first_stage(time, error).coefficients


def _fit_printed_strobes(ripple: float, drift: float, phase: float) -> Array:
    """Return b0, b1, b2 of Eq. 15 for the same run, shape (3,)."""
    time, _ = simulate_strobes(RATE)
    return fit_first_stage(time, _printed_strobe_error(time, ripple, drift, phase)).coefficients


def _printed_constant(
    *, drift: float = 0.0, second_order_term: float = 0.0, radius_error: float = 0.0
) -> float:
    """Return the constant of Eq. 15 without ripple, in m."""
    start_time = np.zeros(1)
    (error,) = _printed_strobe_error(
        start_time, drift=drift, second_order=second_order_term, radius_error=radius_error
    )
    return float(error)


def _printed_strobe_error(
    time: Array,
    ripple: float = 0.0,
    drift: float = 0.0,
    phase: float = 0.0,
    second_order: float = 0.0,
    radius_error: float = 0.0,
) -> Array:
    """Return Eq. 15 as printed at 2 pi rad/s, without bias, shape of `time`."""
    return as_printed.strobe_error(
        time,
        rate=RATE,
        drift=drift,
        ripple=ripple,
        phase=phase,
        radius=RADIUS,
        gravity=GRAVITY,
        bias=0.0,
        scale_factor=TABLE_1["K_I"],
        second_order=second_order,
        radius_error=radius_error,
    )
