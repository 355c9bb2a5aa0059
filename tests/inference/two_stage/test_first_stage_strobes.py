"""Strobes: found where the reference is zero, interpolated, and their noise propagated."""

import math

import numpy as np
import pytest

from counterspin.errors import NotIdentifiableError, RecordError
from counterspin.inference.two_stage.first_stage import (
    by_angle,
    by_nominal_rate,
    first_stage,
    strobe_angle,
)
from counterspin.physics.accelerometer import Mounting, direction
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.observation import reference
from counterspin.physics.spindle import Ripple, Spindle

TURN = 2.0 * math.pi
OBLIQUE = (math.cos(0.7), math.sin(0.7), 0.0)


@pytest.mark.parametrize(
    ("axis", "angle"),
    [
        ("east", math.pi / 2),
        ("north", math.pi),
        ("west", 3 * math.pi / 2),
        ("south", 0.0),
        (OBLIQUE, 0.7 + math.pi / 2),
    ],
)
def test_strobe_angle_is_quarter_turn_past_axis(axis, angle):
    assert math.remainder(strobe_angle(direction(axis)) - angle, TURN) == pytest.approx(
        0, abs=1e-15
    )
    assert 0.0 <= strobe_angle(direction(axis)) < TURN


@pytest.mark.parametrize(("axis", "tilt"), [("up", "90.000"), ((1.0, 0.0, -0.01), "-0.573")])
def test_inclined_axis_raises(axis, tilt):
    with pytest.raises(NotIdentifiableError, match=rf"horizontal input axis.*{tilt} deg above"):
        strobe_angle(direction(axis))


def test_axis_within_one_milliradian_of_horizontal_is_accepted():
    assert strobe_angle(direction((1.0, 0.0, 9e-4))) == pytest.approx(math.pi / 2, abs=1e-15)


@pytest.mark.parametrize("axis", ["east", "north", "west", OBLIQUE])
@pytest.mark.parametrize("rate", [2.0, -2.0])
@pytest.mark.parametrize("start_angle", [0.0, 1.1, -4.0])
def test_strobes_are_zeros_of_reference(axis, rate, start_angle):
    spindle = Spindle(rate, 1e-5, (Ripple(1, 1e-3 * rate, 0.4),), start_angle)
    time = np.arange(0.0, 20.0 * TURN / 2.0, 0.02)
    slope, offset = 3.0, 0.2
    error = offset + slope * time  # which a straight line interpolates exactly
    strobes = by_angle(time, spindle.angle(time), error, strobe_angle(direction(axis)))

    motion = Trajectory(spindle, 2.5, Site(9.8, 0.8))
    mounting = Mounting.from_axes(axis, "down")
    # The angle is interpolated in a straight line as well: h^2/8 of its acceleration.
    off = 2.5 * 0.02**2 / 8 * (1e-3 * rate**2)
    assert np.abs(reference(motion, mounting, strobes.time)).max() < 1.01 * off
    # Always the same of the two zeros: in the positive sense the reference goes from plus to minus.
    velocity = reference(motion, mounting, strobes.time, "velocity")
    assert np.all(np.sign(velocity) == -np.sign(rate))
    turns = spindle.angle(strobes.time) / TURN
    np.testing.assert_allclose(np.abs(np.diff(turns)), 1.0, atol=2.0 * off / 2.5)
    assert strobes.time.size in (20, 21)
    np.testing.assert_allclose(strobes.error, offset + slope * strobes.time, rtol=1e-12)
    assert strobes.lost == 0


def test_strobes_of_paper_are_at_quarter_turn_plus_whole_turns():
    rate = math.pi / 2
    time = np.arange(20001) / 50.0  # 100 revolutions
    runs_by_rate = by_nominal_rate(time, rate, time**2, math.pi / 2)
    np.testing.assert_allclose(runs_by_rate.time, 1.0 + 4.0 * np.arange(100), rtol=1e-13)
    np.testing.assert_allclose(runs_by_rate.error, runs_by_rate.time**2, rtol=1e-12)
    np.testing.assert_allclose(runs_by_rate.noise_factor, 1.0, rtol=1e-9)


def test_strobe_midway_between_two_samples_has_half_the_variance():
    time = np.arange(200) * 0.1
    runs_by_rate = by_nominal_rate(time, TURN, time, TURN * 0.55)
    np.testing.assert_allclose(runs_by_rate.noise_factor, math.sqrt(0.5), rtol=1e-9)
    quarter = by_nominal_rate(time, TURN, time, TURN * 0.525)
    np.testing.assert_allclose(quarter.noise_factor, math.hypot(0.75, 0.25), rtol=1e-9)


@pytest.mark.parametrize("rate", [TURN, -TURN])
def test_strobe_on_sample_needs_no_neighbours(rate):
    time = np.arange(101) / 20.0
    alone = np.full(time.size, np.nan)
    alone[::20] = 7.0
    runs_by_rate = by_nominal_rate(time, rate, alone, 0.0)
    np.testing.assert_allclose(runs_by_rate.time, np.arange(6.0), atol=1e-12)
    np.testing.assert_allclose(runs_by_rate.error, 7.0)
    np.testing.assert_allclose(runs_by_rate.noise_factor, 1.0)
    assert runs_by_rate.lost == 0


def test_blocks_of_samples_have_noise_of_mean():
    time = np.arange(200) * 0.1
    count = np.where(np.arange(200) % 2 == 0, 4.0, 9.0)
    runs_by_rate = by_nominal_rate(time, TURN, time, TURN * 0.55, count)
    np.testing.assert_allclose(runs_by_rate.noise_factor, 0.5 * math.sqrt(1 / 4 + 1 / 9), rtol=1e-9)


def test_strobes_near_missing_samples_and_gaps_are_counted_as_lost():
    time = np.arange(1000) * 0.1
    error = time.copy()
    error[[105, 106]] = np.nan  # between them lies the strobe at 10.55 s
    gap = (time > 30.0) & (time < 33.0)  # the strobes at 30.55, 31.55 and 32.55 s
    runs_by_rate = by_nominal_rate(time[~gap], TURN, error[~gap], TURN * 0.55)
    expected = [k + 0.55 for k in range(100) if k not in (10, 30, 31, 32)]
    np.testing.assert_allclose(runs_by_rate.time, expected, rtol=1e-12)
    assert runs_by_rate.lost == 4


def test_noisy_angle_has_no_duplicate_strobes():
    rng = np.random.default_rng(5)
    time = np.arange(2000) * 0.01
    angle = TURN * time + 0.05 * rng.standard_normal(time.size)  # steps back now and then
    strobes = by_angle(time, angle, time, 1.0)
    np.testing.assert_allclose(strobes.time, np.arange(20) + 1.0 / TURN, atol=0.05)


@pytest.mark.parametrize("revolutions", [0.1, 3.0])
def test_too_few_strobes_raise(revolutions):
    time = np.linspace(0.0, revolutions, 1 + int(50 * revolutions))
    with pytest.raises(RecordError, match=rf"only {int(revolutions)} of the 4 strobes"):
        by_nominal_rate(time, TURN, time, 1.0)


def test_u_of_b2_matches_scatter():
    # Strobes that fall anywhere between samples: weights that were not propagated would claim
    # up to 1.41 times too much.
    rng = np.random.default_rng(11)
    time = np.arange(1300) * 0.049
    trials, sigma = 4000, 0.01
    b2 = np.empty(trials)
    for k in range(trials):
        noise = sigma * rng.standard_normal(time.size)
        fitted = first_stage(by_nominal_rate(time, TURN, noise, math.pi / 2), sigma)
        b2[k] = fitted.b2
    # A standard deviation from n draws scatters by 1/sqrt(2 n) = 1.1 %.
    assert np.std(b2) / fitted.u_b2 == pytest.approx(1.0, abs=4.0 / math.sqrt(2.0 * trials))
    assert abs(np.mean(b2)) < 4.0 * fitted.u_b2 / math.sqrt(trials)
    assert np.mean(fitted.strobes.noise_factor) < 0.9
