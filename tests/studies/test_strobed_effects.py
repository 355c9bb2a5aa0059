"""Strobed effects of many rotations at once, against the columns and the first stage themselves."""

import math
from dataclasses import replace

import numpy as np
import pytest

from counterspin.errors import ConvergenceError
from counterspin.inference.two_stage.first_stage import Strobes, first_stage, strobe_angle
from counterspin.physics import observation
from counterspin.physics.accelerometer import QX, QY
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import PLATFORM_TERMS, TERMS, term
from counterspin.studies.strobed_effects import (
    StrobedMotion,
    Surrogate,
    box_of,
    effects,
    obstacle,
)

SITE = Site(9.8, 0.8)
SMOOTH = tuple(symbol for symbol in (*TERMS, *PLATFORM_TERMS) if not obstacle(symbol))


def run(mounting, rate, revolutions=20, start=0.3, radius=2.5):
    spindle = Spindle(rate, ripples=(Ripple(3, 1e-5 * rate, 0.4),), start_angle=start)
    duration = revolutions * 2.0 * math.pi / abs(rate)
    phase = strobe_angle(mounting.input_axis)
    return StrobedMotion.of(spindle, duration, phase, mounting, observation.LEVEL, SITE, radius)


@pytest.mark.parametrize(("mounting", "rate"), [(QX, 1.5), (QY, -3.0)])
def test_effects_are_the_first_stage_of_the_columns(mounting, rate):
    ratio, phase, drift, radius = 3e-4, 0.7, 5e-7, 2.501
    motion = run(mounting, rate, radius=radius)
    found, size = effects(
        motion,
        SMOOTH,
        *(np.full(2, v) for v in (drift, ratio * math.cos(phase), ratio * math.sin(phase))),
    )
    spindle = Spindle(rate, drift, (Ripple(1, ratio * rate, phase), *motion.spindle.ripples), 0.3)
    times = spindle.time_at(motion.angles)
    parabola = first_stage(Strobes(times, np.zeros_like(times), np.ones_like(times), 0), 0.01)
    columns = observation.columns(Trajectory(spindle, radius, SITE), mounting, SMOOTH, times)
    expected = parabola.gain[2] @ columns
    # Columns are exact to 1e-12 of what they add up; b2 takes them with these weights.
    rounding = np.abs(parabola.gain[2]) @ np.abs(columns) * 1e-11
    assert np.all(np.abs(found[:, 0] - expected) <= rounding)
    assert np.array_equal(found[:, 0], found[:, 1])
    assert 0.01 / size[0] == pytest.approx(parabola.u_b2, rel=1e-12)


def test_constant_rate_gives_the_closed_form():
    motion = run(QX, math.pi, start=0.0)
    still = Site(9.8, 0.8, earth_rate=0.0)
    motion = replace(motion, spindle=Spindle(math.pi), site=still)
    found, _ = effects(motion, ["K_II", "K_F"], np.zeros(1), np.zeros(1), np.zeros(1))
    assert found[0, 0] == pytest.approx(2.5**2 * math.pi**4 / (4.0 * 9.8), rel=1e-12)
    assert found[1, 0] == pytest.approx(4.9, rel=1e-12)


def test_ripple_that_stops_the_spindle_is_refused():
    with pytest.raises(ConvergenceError, match="ripple"):
        effects(run(QX, 1.5), ["K_II"], np.zeros(1), np.full(1, 5.0), np.zeros(1))


def test_surrogate_is_exact_in_its_box_and_knows_where_it_ends():
    motion = run(QX, 2.0, revolutions=60)
    box = box_of(motion, np.array([[-3e-7, 3e-7], [-5e-4, 5e-4], [-5e-4, 5e-4]]))
    surrogate = Surrogate.fit(motion, ("K_II", "K_III", "K_F"), box)
    rng = np.random.default_rng(3)
    small = [c + h * rng.uniform(-1, 1, 40) for c, h in zip(box.centre, box.half, strict=True)]
    found, size = surrogate(small)
    exact, exact_size = effects(motion, ("K_II", "K_III", "K_F"), *small)
    assert np.abs(found - exact).max() < 1e-10 * np.abs(exact).max()
    assert np.abs(size / exact_size - 1.0).max() < 1e-10
    assert surrogate.holds(small).all()
    outside = [part.copy() for part in small]
    outside[1][0] = 6e-4
    assert surrogate.holds(outside).tolist() == [False] + [True] * 39


def test_box_is_cut_to_what_a_surrogate_may_hold():
    box = box_of(run(QX, 2.0), np.array([[-1.0, 1.0], [-0.1, 0.1], [0.0, 0.0]]))
    assert box.half[1] == pytest.approx(6e-4)
    assert box.half[0] < 1e-4
    assert box.varies.tolist() == [0, 1]


def test_terms_that_need_another_quadrature_are_named():
    platform = "does not act on a platform that keeps its attitude"
    kinked = dict.fromkeys(("K_OQ", "K_0_asym", "K_I_asym"), "has a kink")
    fifth = {"K_5": "has harmonics above the fourth"}
    rotating = dict.fromkeys(("K_spin", "K_ang"), platform)
    found = {symbol: why for symbol in TERMS if (why := obstacle(symbol))}
    assert found == kinked | fifth | rotating
    turning = {symbol for symbol in PLATFORM_TERMS if obstacle(symbol)}
    others = ("platform.g2_sensitivity", "table.")
    assert turning == {s for s in PLATFORM_TERMS if s.startswith(others)}
    assert term("K_II").effect.factors == ("I", "I")
