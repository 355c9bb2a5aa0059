"""Equations 5 to 19: printed coefficients and those of the simulation of Eq. 7."""

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
RIPPLE: Final = RIPPLE_RATIO * RATE  #: w_p, rad/s
RIPPLE_UNIT: Final = RADIUS * RATE * RIPPLE * math.sin(RIPPLE_PHASE)  #: R w0 w_p sin(phi)
_EXPANDED_TERMS: Final = ("K_II", "K_III", "K_IP")  #: of the expansion under Eq. 13
RECTIFIED: Final = RADIUS**2 * RATE**4 / GRAVITY  #: R^2 w0^4/g


def coefficients() -> tuple[Row, ...]:
    """Return the rows of the comparison, in the order of the paper's equations."""
    return (*_mean_force(), *_integrals(), *_strobes(), *_constants())


def _mean_force() -> tuple[Row, ...]:
    """Return the rows of Eq. 5, averaged over a revolution, without drift."""
    turn = np.linspace(0.0, 2 * math.pi / RATE, 256, endpoint=False)
    spindle = Spindle(RATE, ripples=(Ripple(1, RIPPLE, RIPPLE_PHASE),))
    exact = Trajectory(spindle, RADIUS, SITE).acceleration(turn)[:, 0]
    printed = as_printed.specific_force_error(
        turn, rate=RATE, drift=0.0, ripple=RIPPLE, phase=RIPPLE_PHASE, radius=RADIUS
    )[:, 0]
    return (
        Row(
            "eq5.ripple_mean",
            "Eq. 5: mean east acceleration due to ripple",
            float(np.mean(printed)) / RIPPLE_UNIT,
            float(np.mean(exact)) / RIPPLE_UNIT,
            "R w0 w_p sin(phi)",
            "the tangential part has the wrong sign, and -sin(w0 t) d(theta) is omitted; a "
            "periodic motion has no mean acceleration",
            "z.3f",
        ),
    )


def _integrals() -> tuple[Row, ...]:
    """Return the rows of the expansions under Eq. 13, against runs of a single coefficient."""
    time, _ = simulate_strobes(RATE)
    k_ii, k_iii, k_ip = (
        fit_first_stage(*simulate_strobes(RATE, truth={"K_I": 1.0, symbol: TABLE_1[symbol]}))
        for symbol in _EXPANDED_TERMS
    )
    printed_k_ii = fit_first_stage(time, as_printed.k_ii_integral(time, RATE, RADIUS, GRAVITY))
    printed_k_iii = as_printed.k_iii_integral(time, RATE, RADIUS, GRAVITY)
    printed_k_ip = as_printed.k_ip_integral(time, RATE, RADIUS)
    return (
        Row(
            "eq13.k_ii_parabola",
            "Eq. 13: t^2 coefficient of K_II",
            printed_k_ii.b2 / RECTIFIED,
            k_ii.b2 / TABLE_1["K_II"] / RECTIFIED,
            "R^2 w0^4/g",
            "cos^2 has the mean 1/2, and the double integral of 1/2 is t^2/4",
            ".4f",
        ),
        Row(
            "eq13.k_ii_constant",
            "Eq. 13: K_II constant at the strobes, 2 pi rad/s",
            TABLE_1["K_II"] * float(printed_k_ii.coefficients[0]),
            float(k_ii.coefficients[0]),
            "m",
            "the division of the harmonic part by w0^2 is missing; the error affects only b0",
            ".3e",
        ),
        Row(
            "eq13.k_iii_constant",
            "Eq. 13: K_III constant at the strobes, 2 pi rad/s",
            TABLE_1["K_III"] * float(np.mean(printed_k_iii)),
            float(k_iii.coefficients[0]),
            "m",
            "the same division by w0^2 is missing; the error affects only b0",
            ".3e",
        ),
        Row(
            "eq13.k_ip_constant",
            "Eq. 13: K_IP constant at the strobes",
            TABLE_1["K_IP"] * float(np.mean(printed_k_ip)),
            float(k_ip.coefficients[0]),
            "m",
            "agrees",
            ".3e",
        ),
    )


def _strobes() -> tuple[Row, ...]:
    """Compare Eq. 15 and 19: effects of ripple and drift, with the nominal angle, and b2 itself."""
    steady, rippled, drifting = (
        _spindle_effect(ripple, drift)
        for ripple, drift in ((0.0, 0.0), (RIPPLE, 0.0), (0.0, DRIFT_RATE))
    )
    printed_steady, printed_rippled, printed_drifting = (
        _printed_spindle_effect(ripple, drift, phase)
        for ripple, drift, phase in (
            (0.0, 0.0, 0.0),
            (RIPPLE, 0.0, RIPPLE_PHASE),
            (0.0, DRIFT_RATE, 0.0),
        )
    )
    drift_unit = TABLE_1["K_I"] * RADIUS * DRIFT_RATE
    ripple_unit = TABLE_1["K_I"] * RIPPLE_UNIT
    printed_b2 = as_printed.strobe_curvature(
        rate=RATE,
        ripple=RIPPLE,
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
            float(printed_rippled[2] - printed_steady[2]) / ripple_unit,
            float(rippled[2] - steady[2]) / ripple_unit,
            "K_I R w0 w_p sin(phi)",
            "half the mean of Eq. 5 above; with the exact kinematics it vanishes",
            "z.3f",
        ),
        Row(
            "eq15.ripple_constant",
            "Eq. 15: ripple constant",
            float(printed_rippled[0] - printed_steady[0]),
            float(rippled[0] - steady[0]),
            "m",
            "the factor w_p/w0 is missing; the error affects only b0",
            ".3e",
        ),
        Row(
            "eq15.drift_slope",
            "Eq. 15: slope due to drift, nominal angle as reference",
            float(printed_drifting[1] - printed_steady[1]) / drift_unit,
            float(drifting[1] - steady[1]) / drift_unit,
            "K_I R C",
            "the drift makes the platform lead the nominal angle in proportion to t^2, not to t",
            "z.2f",
        ),
        Row(
            "eq15.drift_parabola",
            "Eq. 15: t^2 coefficient of drift, nominal angle as reference",
            float(printed_drifting[2] - printed_steady[2]) / drift_unit / RATE,
            float(drifting[2] - steady[2]) / drift_unit / RATE,
            "K_I R C w0",
            (
                "a column proportional to w0 must absorb this coefficient, which is zero with a "
                "measured angle"
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


def _constants() -> tuple[Row, ...]:
    """Return the rows of Eq. 15's constants, which the first stage collects in b0."""
    scale_factor = TABLE_1["K_I"]
    terms = sum(
        fit_first_stage(
            *simulate_strobes(RATE, truth={"K_I": 1.0, symbol: TABLE_1[symbol]}, ripple_ratio=0.0)
        ).coefficients[0]
        for symbol in _EXPANDED_TERMS
    )
    steady = _spindle_effect(0.0, 0.0)
    # The cube of the angle error stays below the constant at this drift.
    drift_rate = 0.1 * DRIFT_RATE
    drift = _spindle_effect(0.0, drift_rate) - steady
    radius = _spindle_effect(0.0, 0.0, RADIUS_ERROR) - steady
    drift_unit = scale_factor * RADIUS * drift_rate / RATE
    return (
        Row(
            "eq15.term_constants",
            "Eq. 15: K_II, K_III and K_IP constants, 2 pi rad/s",
            _printed_constant(second_order=TABLE_1["K_II"]),
            float(terms),
            "m",
            "Eq. 15 omits the constants of the expansion below Eq. 13; the error affects only b0",
            "z.3e",
        ),
        Row(
            "eq15.drift_constant",
            "Eq. 15: drift constant, nominal angle as reference",
            _printed_constant(drift=drift_rate) / drift_unit,
            float(drift[0]) / drift_unit,
            "K_I R C/w0",
            "the centripetal part by itself gives -4, and the complete acceleration gives 0; "
            "the error affects only b0",
            "z.2f",
        ),
        Row(
            "eq15.radius_constant",
            "Eq. 15: radius error constant",
            _printed_constant(radius_error=RADIUS_ERROR) / (scale_factor * RADIUS_ERROR),
            float(radius[0]) / (scale_factor * RADIUS_ERROR),
            "K_I dr",
            "the integral of the radius term of Eq. 14 is K_I dr (cos(w0 t) - 1); the error "
            "affects only b0",
            "z.2f",
        ),
    )


def _spindle_effect(ripple: float, drift: float, radius_error: float = 0.0) -> Array:
    """Return b0, b1, b2 of a simulated run with a scale factor only, nominal angle, shape (3,)."""
    time, error = simulate_strobes(
        RATE,
        truth={"K_I": TABLE_1["K_I"]},
        ripple_ratio=ripple / RATE,
        drift=drift,
        nominal_reference=True,
        radius_error=radius_error,
    )
    return fit_first_stage(time, error).coefficients


def _printed_spindle_effect(ripple: float, drift: float, phase: float) -> Array:
    """Return b0, b1, b2 of Eq. 15 for such a run, shape (3,)."""
    time, _ = simulate_strobes(RATE)
    return fit_first_stage(time, _printed_error(time, ripple, drift, phase)).coefficients


def _printed_constant(
    *, drift: float = 0.0, second_order: float = 0.0, radius_error: float = 0.0
) -> float:
    """Return the constant of Eq. 15 without ripple, in m."""
    at_zero = np.zeros(1)
    (error,) = _printed_error(
        at_zero, drift=drift, second_order=second_order, radius_error=radius_error
    )
    return float(error)


def _printed_error(
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
