"""Coefficients that change with a run's conditions: columns against the simulation and by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from counterspin.physics.accelerometer import QX, QZ
from counterspin.physics.effects import RunConditions
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.observation import ORDERS, columns, parabola
from counterspin.physics.simulation import changed, recorded
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import CONDITION_TERMS, TERMS, term

SITE = Site(9.8066, 0.7985)
SPINDLE = Spindle(-2.4, 3e-4, (Ripple(1, 4e-3, 0.8),), start_angle=0.5)
CONDITIONS = RunConditions(start=750.0, warmth=-1.7, direction=-0.5)
TRAJECTORY = Trajectory(SPINDLE, 2.5, SITE, conditions=CONDITIONS)
TIMES = np.linspace(0.0, 9.0, 181)


@pytest.mark.parametrize("mounting", [QX, QZ], ids=["level", "vertical"])
@pytest.mark.parametrize("observable", ORDERS)
@pytest.mark.parametrize("symbol", CONDITION_TERMS)
def test_column_is_what_the_simulation_adds(symbol, observable, mounting):
    others = {"K_F": 3e-3, "K_I": 1.002, "K_II": 2e-5}
    slope = 1e-5

    def at(size):
        truth = {**others, symbol: size}
        return recorded(TRAJECTORY, mounting, truth, {}, TIMES, observable)

    (shown,) = columns(TRAJECTORY, mounting, [symbol], TIMES, observable, scale_factor=1.3).T
    got = (at(slope) - at(-slope)) / (2 * slope)
    np.testing.assert_allclose(got, shown, rtol=0, atol=1e-9 * np.abs(shown).max())


def test_a_trend_goes_on_within_the_run():
    g, t, start = SITE.gravity, TIMES, 750.0
    by_hand = {
        "displacement": g * (start * t**2 / 2 + t**3 / 6),
        "velocity": g * (start * t + t**2 / 2),
        "specific_force": g * (start + t),
    }
    for observable, expected in by_hand.items():
        (shown,) = columns(TRAJECTORY, QX, ["K_F.trend"], TIMES, observable).T
        np.testing.assert_allclose(shown, expected, rtol=1e-14)


def test_on_the_way_down_hysteresis_is_half_of_it_less():
    (shown,) = columns(TRAJECTORY, QX, ["K_F.hysteresis"], TIMES).T
    np.testing.assert_allclose(shown, -0.5 * SITE.gravity * TIMES**2 / 2, rtol=1e-14)


def test_heating_is_the_mean_of_k_ii_and_nothing_of_its_harmonic():
    """a^2 has the mean of K_II's square twice over: on the average the two are one."""
    at = (QX, 2.4, 2.5, SITE.gravity)
    assert parabola("K_F.heating", *at) == pytest.approx(2 * parabola("K_II", *at), rel=1e-14)
    still = replace(TRAJECTORY, conditions=RunConditions(), spindle=Spindle(2.4))
    (shown,) = columns(still, QX, ["K_F.heating"], TIMES).T
    np.testing.assert_allclose(shown, parabola("K_F.heating", *at) * TIMES**2, rtol=1e-14)


def test_at_the_reference_nothing_changes():
    coefficients = {"K_F": 1e-3, **dict.fromkeys(CONDITION_TERMS, 1.0)}
    assert changed(coefficients, RunConditions(), 0.0) == {
        "K_F": 1e-3,
        **{s: TERMS[s].nominal for s in ("K_I", "K_II")},
    }
    assert changed({"K_I.temperature": 1e-4}, RunConditions(warmth=2.0), 0.0) == {"K_I": 1.0002}


@pytest.mark.parametrize("row", CONDITION_TERMS.values(), ids=CONDITION_TERMS)
def test_rows_are_those_of_the_tables(row):
    assert term(row.symbol) is row
    assert row.unit.startswith(TERMS[row.effect.coefficient].unit.partition("/")[0])
    assert 0 < row.typical < row.limit < math.inf
