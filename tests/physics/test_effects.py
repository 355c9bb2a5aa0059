"""Coefficients that change with a run's conditions: columns against the simulation and by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from counterspin.physics.accelerometer import QX, QZ
from counterspin.physics.closed_forms import parabola
from counterspin.physics.conditions import RunConditions
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.observation import ORDERS, columns
from counterspin.physics.simulation import run_coefficients, simulate_record
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import CONDITION_TERMS, TERMS, term

SITE = Site(9.8066, 0.7985)
SPINDLE = Spindle(-2.4, 3e-4, (Ripple(1, 4e-3, 0.8),), start_angle=0.5)
CONDITIONS = RunConditions(start=750.0, temperature_offset=-1.7, direction=-0.5)
TRAJECTORY = Trajectory(SPINDLE, 2.5, SITE, conditions=CONDITIONS)
TIMES = np.linspace(0.0, 9.0, 181)


#: Warmer, then colder than at its start; known to be on its way up first.
WITHIN = replace(
    CONDITIONS,
    direction=0.5,
    temperature_profile=(-2.0, 1.0, -0.5, -3.0),
    length=8.0,
    reversal_times=(8.0 / 3.0,),
)


@pytest.mark.parametrize("conditions", [CONDITIONS, WITHIN], ids=["one temperature", "a course"])
@pytest.mark.parametrize("mounting", [QX, QZ], ids=["level", "vertical"])
@pytest.mark.parametrize("observable", ORDERS)
@pytest.mark.parametrize("symbol", CONDITION_TERMS)
def test_column_matches_simulation(symbol, observable, mounting, conditions):
    others = {"K_F": 3e-3, "K_I": 1.002, "K_II": 2e-5}
    slope, trajectory = 1e-5, replace(TRAJECTORY, conditions=conditions)

    def at(size):
        truth = {**others, symbol: size}
        return simulate_record(trajectory, mounting, truth, {}, TIMES, observable)

    (shown,) = columns(trajectory, mounting, [symbol], TIMES, observable, scale_factor=1.3).T
    got = (at(slope) - at(-slope)) / (2 * slope)
    np.testing.assert_allclose(got, shown, rtol=0, atol=1e-9 * np.abs(shown).max())


def test_trend_continues_within_run():
    g, t, start = SITE.gravity, TIMES, 750.0
    by_hand = {
        "displacement": g * (start * t**2 / 2 + t**3 / 6),
        "velocity": g * (start * t + t**2 / 2),
        "specific_force": g * (start + t),
    }
    for observable, expected in by_hand.items():
        (shown,) = columns(TRAJECTORY, QX, ["K_F.trend"], TIMES, observable).T
        np.testing.assert_allclose(shown, expected, rtol=1e-14)


#: A ramp of the temperature, from `BEGIN` by `RISE` K a second, over the times.
BEGIN, RISE = -3.0, 0.75
RAMP = RunConditions(
    temperature_offset=BEGIN + 0.5 * RISE * TIMES[-1],
    temperature_profile=(BEGIN, BEGIN + RISE * TIMES[-1]),
    length=TIMES[-1],
)


@pytest.mark.parametrize("power", [1, 2, 3])
def test_temperature_ramp_of_bias_matches_closed_form(power):
    """Of (T0 + b t)^p the integrals are (T0 + b t)^(p+1)/(b (p+1)), and so on."""
    g, warm = SITE.gravity, BEGIN + RISE * TIMES
    once = (warm ** (power + 1) - BEGIN ** (power + 1)) / (RISE * (power + 1))
    twice = (warm ** (power + 2) - BEGIN ** (power + 2)) / (RISE**2 * (power + 1) * (power + 2))
    twice -= BEGIN ** (power + 1) / (RISE * (power + 1)) * TIMES
    by_hand = {"specific_force": warm**power, "velocity": once, "displacement": twice}
    symbol = "K_F.temperature" + (f".{power}" if power > 1 else "")
    ramped = replace(TRAJECTORY, conditions=RAMP)
    for observable, expected in by_hand.items():
        (shown,) = columns(ramped, QX, [symbol], TIMES, observable).T
        np.testing.assert_allclose(
            shown, g * expected, rtol=0, atol=1e-12 * g * abs(expected).max()
        )


def test_temperature_ramp_of_scale_factor_matches_closed_form():
    """S'' = -R w^2 (T0 + b t) cos wt, without the Earth's rotation: integrated by parts."""
    rate, radius = 2.4, 2.5
    turning = Trajectory(Spindle(rate), radius, replace(SITE, earth_rate=0.0), conditions=RAMP)
    t, warm = TIMES, BEGIN + RISE * TIMES
    wave, crossed = np.cos(rate * t), np.sin(rate * t)
    by_hand = {
        "specific_force": -radius * rate**2 * warm * wave,
        "velocity": -radius * rate * (warm * crossed + RISE * (wave - 1.0) / rate),
        "displacement": radius * (warm * wave - BEGIN - 2.0 * RISE / rate * crossed + RISE * t),
    }
    for observable, expected in by_hand.items():
        (shown,) = columns(turning, QX, ["K_I.temperature"], t, observable).T
        np.testing.assert_allclose(shown, expected, rtol=0, atol=2e-12 * abs(expected).max())


def test_hysteresis_changes_sign_at_temperature_reversal():
    """The temperature rises until t1 (plus one half) and then falls (minus one half)."""
    turned = 3.3
    up = replace(TRAJECTORY, conditions=RunConditions(direction=0.5, reversal_times=(turned,)))
    (shown,) = columns(up, QX, ["K_F.hysteresis"], TIMES).T
    since = np.maximum(TIMES - turned, 0.0)
    by_hand = SITE.gravity * (0.25 * TIMES**2 - 0.5 * since**2)
    np.testing.assert_allclose(shown, by_hand, rtol=0, atol=1e-12 * abs(by_hand).max())


def test_hysteresis_of_cooling_is_minus_one_half():
    (shown,) = columns(TRAJECTORY, QX, ["K_F.hysteresis"], TIMES).T
    np.testing.assert_allclose(shown, -0.5 * SITE.gravity * TIMES**2 / 2, rtol=1e-14)


def test_self_heating_has_parabola_of_k_ii_without_harmonic():
    """The mean of a^2 is twice that of a_I^2, so the parabolas are proportional."""
    at = (QX, 2.4, 2.5, SITE.gravity)
    assert parabola("K_F.heating", *at) == pytest.approx(2 * parabola("K_II", *at), rel=1e-14)
    still = replace(TRAJECTORY, conditions=RunConditions(), spindle=Spindle(2.4))
    (shown,) = columns(still, QX, ["K_F.heating"], TIMES).T
    np.testing.assert_allclose(shown, parabola("K_F.heating", *at) * TIMES**2, rtol=1e-14)


def test_coefficients_are_nominal_at_reference_conditions():
    coefficients = {"K_F": 1e-3, **dict.fromkeys(CONDITION_TERMS, 1.0)}
    assert run_coefficients(coefficients, RunConditions(), 0.0) == {
        "K_F": 1e-3,
        **{s: TERMS[s].nominal for s in ("K_I", "K_II")},
    }
    assert run_coefficients(
        {"K_I.temperature": 1e-4}, RunConditions(temperature_offset=2.0), 0.0
    ) == {"K_I": 1.0002}


@pytest.mark.parametrize("row", CONDITION_TERMS.values(), ids=CONDITION_TERMS)
def test_rows_are_rows_of_term_tables(row):
    assert term(row.symbol) is row
    assert row.unit.startswith(TERMS[row.effect.coefficient].unit.partition("/")[0])
    assert 0 < row.typical < row.limit < math.inf
