"""Own velocity in the Coriolis correction, against the equation of motion solved by SciPy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from counterspin.physics.motion import Site
from counterspin.physics.own_velocity import (
    AxisError,
    computer_correction,
    coriolis,
    own_velocity_errors,
    unobserved_projection,
)

SITE = Site(9.8066, 0.7985)
OMEGA = 7.292115e-5 * np.array([0.0, np.cos(0.7985), np.sin(0.7985)])
TIMES = np.linspace(0.0, 400.0, 8001)
OFFSET, START = np.array([0.02, -0.01, 0.03]), np.array([1e-3, 2e-3, -1e-3])
BIAS, TREND = np.array([0.05, -0.03, 0.02]), np.array([2e-6, 0.0, -5e-6])
WAVE, RATE = np.array([0.03, 0.02, 0.0]), 2.0

#: Three directions that are not at right angles.
AXES = np.array([[1.0, 0.0, 0.0], [0.6, 0.8, 0.0], [0.0, -0.6, 0.8]])


def wrong(t):
    """What the accelerometers sense wrongly, east-north-up."""
    return BIAS + TREND * t + WAVE * np.sin(RATE * t)


def with_platform():
    """Its integrals, by hand: velocity and displacement error, shape (n, 3)."""
    t = TIMES[:, None]
    speed = START + BIAS * t + TREND * t**2 / 2 + WAVE * (1 - np.cos(RATE * t)) / RATE
    moved = OFFSET + START * t + BIAS * t**2 / 2 + TREND * t**3 / 6
    return speed, moved + WAVE * (RATE * t - np.sin(RATE * t)) / RATE**2


@pytest.fixture(scope="module")
def with_own():
    """The same of e'' = a - 2 Omega x e', solved step by step."""
    solution = solve_ivp(
        lambda t, y: np.append(y[3:], wrong(t) - 2.0 * np.cross(OMEGA, y[3:])),
        (0.0, 400.0),
        np.append(OFFSET, START),
        method="DOP853",
        t_eval=TIMES,
        rtol=1e-13,
        atol=1e-12,
    )
    return solution.y[3:].T, solution.y[:3].T


def recorded(errors, axes, observables):
    speed, moved = errors
    shown = {"velocity": speed, "displacement": moved, "specific_force": wrong(TIMES[:, None])}
    return [
        AxisError(axis, name, TIMES, shown[name] @ axis)
        for axis, name in zip(axes, observables, strict=True)
    ]


@pytest.mark.parametrize(
    "observables",
    [("displacement",) * 3, ("velocity",) * 3, ("displacement", "velocity", "displacement")],
)
def test_both_ways_against_the_equation_of_motion(with_own, observables):
    platform = recorded(with_platform(), AXES, observables)
    own = recorded(with_own, AXES, observables)
    back = computer_correction(SITE, own)
    for before, after, found, part in zip(
        platform, own, own_velocity_errors(SITE, platform), back, strict=True
    ):
        size = np.abs(before.error).max()
        # What the computer does is 1e-2 of the error, and of that all is found.
        assert np.abs(after.error - before.error).max() > 1e-3 * size
        np.testing.assert_allclose(found, after.error, rtol=0.0, atol=1e-9 * size)
        np.testing.assert_allclose(after.error + part, before.error, rtol=0.0, atol=1e-9 * size)


def test_the_sign_by_hand():
    """Of an error v north, -2 Omega sin L v east is removed too much."""
    north = AxisError(np.array([0.0, 1.0, 0.0]), "velocity", TIMES, np.full(TIMES.size, 0.1))
    east = AxisError(np.array([1.0, 0.0, 0.0]), "velocity", TIMES, np.zeros(TIMES.size))
    found, _ = own_velocity_errors(SITE, [east, north])
    assert found[-1] == pytest.approx(2.0 * OMEGA[2] * 0.1 * 400.0, rel=1e-3)
    np.testing.assert_allclose(coriolis(SITE) @ [0, 0.1, 0], 2 * np.cross(OMEGA, [0, 0.1, 0]))


def test_rows_that_are_missing_are_found_from_the_others(with_own):
    own = recorded(with_own, AXES, ("displacement",) * 3)
    whole = computer_correction(SITE, own)
    keep = np.ones(TIMES.size, dtype=bool)
    keep[3000:3100] = False  # five seconds of all
    short = [AxisError(a.input_axis, a.observable, TIMES[keep], a.error[keep]) for a in own]
    some = own[0].error.copy()
    some[5000:5010] = np.nan  # half a second of one
    short[0] = AxisError(AXES[0], "displacement", TIMES[keep], some[keep])
    for part, all_of_it in zip(computer_correction(SITE, short), whole, strict=True):
        np.testing.assert_allclose(part, all_of_it[keep], rtol=0.0, atol=2e-5)


def test_an_axis_that_nobody_recorded_is_of_a_perfect_accelerometer():
    """Its error is then what the others' Coriolis acceleration makes, and acts on them again."""
    axes, names = np.eye(3), ("displacement", "displacement", "displacement")
    platform = recorded(with_platform(), axes, names)
    perfect = AxisError(axes[2], "displacement", TIMES, np.zeros(TIMES.size))
    own = own_velocity_errors(SITE, [*platform[:2], perfect])
    shown = [
        AxisError(one.input_axis, one.observable, TIMES, error)
        for one, error in zip(platform[:2], own[:2], strict=True)
    ]
    for before, after, part in zip(
        platform[:2], own[:2], computer_correction(SITE, shown), strict=True
    ):
        np.testing.assert_allclose(after + part, before.error, rtol=0.0, atol=1e-9 * 4000.0)
    np.testing.assert_allclose(unobserved_projection(shown), np.diag([0.0, 0.0, 1.0]), atol=1e-12)


def test_a_recorded_force_has_nothing_taken_away(with_own):
    names = ("specific_force", "displacement", "displacement")
    own = recorded(with_own, np.eye(3), names)
    assert not computer_correction(SITE, own)[0].any()
    np.testing.assert_allclose(unobserved_projection(own), np.diag([1.0, 0.0, 0.0]), atol=1e-12)
    (alone,) = computer_correction(SITE, own[:1])
    assert not alone.any()
