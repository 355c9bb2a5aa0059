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


def accelerometer_error(t):
    """Return the error of the accelerometers along east, north and up."""
    return BIAS + TREND * t + WAVE * np.sin(RATE * t)


def errors_without_coriolis():
    """Return velocity and displacement errors, shape (n, 3), integrated by hand."""
    t = TIMES[:, None]
    speed = START + BIAS * t + TREND * t**2 / 2 + WAVE * (1 - np.cos(RATE * t)) / RATE
    moved = OFFSET + START * t + BIAS * t**2 / 2 + TREND * t**3 / 6
    return speed, moved + WAVE * (RATE * t - np.sin(RATE * t)) / RATE**2


@pytest.fixture(scope="module")
def errors_with_coriolis():
    """Solve e'' = a - 2 Omega x e' numerically for the same errors."""
    solution = solve_ivp(
        lambda t, y: np.append(y[3:], accelerometer_error(t) - 2.0 * np.cross(OMEGA, y[3:])),
        (0.0, 400.0),
        np.append(OFFSET, START),
        method="DOP853",
        t_eval=TIMES,
        rtol=1e-13,
        atol=1e-12,
    )
    return solution.y[3:].T, solution.y[:3].T


def record_errors(errors, axes, observables):
    speed, moved = errors
    shown = {
        "velocity": speed,
        "displacement": moved,
        "specific_force": accelerometer_error(TIMES[:, None]),
    }
    return [
        AxisError(axis, name, TIMES, shown[name] @ axis)
        for axis, name in zip(axes, observables, strict=True)
    ]


@pytest.mark.parametrize(
    "observables",
    [("displacement",) * 3, ("velocity",) * 3, ("displacement", "velocity", "displacement")],
)
def test_correction_and_its_inverse_match_equation_of_motion(errors_with_coriolis, observables):
    platform = record_errors(errors_without_coriolis(), AXES, observables)
    own = record_errors(errors_with_coriolis, AXES, observables)
    back = computer_correction(SITE, own)
    for before, after, velocity_error, part in zip(
        platform, own, own_velocity_errors(SITE, platform), back, strict=True
    ):
        size = np.abs(before.error).max()
        # What the computer does is 1e-2 of the error, and of that all is found.
        assert np.abs(after.error - before.error).max() > 1e-3 * size
        np.testing.assert_allclose(velocity_error, after.error, rtol=0.0, atol=1e-9 * size)
        np.testing.assert_allclose(after.error + part, before.error, rtol=0.0, atol=1e-9 * size)


def test_correction_sign_matches_hand_calculation():
    """A velocity error v north removes 2 Omega sin L v east in excess."""
    north = AxisError(np.array([0.0, 1.0, 0.0]), "velocity", TIMES, np.full(TIMES.size, 0.1))
    east = AxisError(np.array([1.0, 0.0, 0.0]), "velocity", TIMES, np.zeros(TIMES.size))
    velocity_error, _ = own_velocity_errors(SITE, [east, north])
    assert velocity_error[-1] == pytest.approx(2.0 * OMEGA[2] * 0.1 * 400.0, rel=1e-3)
    np.testing.assert_allclose(coriolis(SITE) @ [0, 0.1, 0], 2 * np.cross(OMEGA, [0, 0.1, 0]))


def test_missing_rows_are_interpolated(errors_with_coriolis):
    own = record_errors(errors_with_coriolis, AXES, ("displacement",) * 3)
    whole = computer_correction(SITE, own)
    keep = np.ones(TIMES.size, dtype=bool)
    keep[3000:3100] = False  # five seconds of all
    short = [AxisError(a.input_axis, a.observable, TIMES[keep], a.error[keep]) for a in own]
    some = own[0].error.copy()
    some[5000:5010] = np.nan  # half a second of one
    short[0] = AxisError(AXES[0], "displacement", TIMES[keep], some[keep])
    for part, all_of_it in zip(computer_correction(SITE, short), whole, strict=True):
        np.testing.assert_allclose(part, all_of_it[keep], rtol=0.0, atol=2e-5)


def test_unrecorded_axis_is_treated_as_perfect_accelerometer():
    """Its error is the Coriolis acceleration of the other axes, which it changes in turn."""
    axes, names = np.eye(3), ("displacement", "displacement", "displacement")
    platform = record_errors(errors_without_coriolis(), axes, names)
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


def test_recorded_specific_force_is_not_corrected(errors_with_coriolis):
    names = ("specific_force", "displacement", "displacement")
    own = record_errors(errors_with_coriolis, np.eye(3), names)
    assert not computer_correction(SITE, own)[0].any()
    np.testing.assert_allclose(unobserved_projection(own), np.diag([1.0, 0.0, 0.0]), atol=1e-12)
    (alone,) = computer_correction(SITE, own[:1])
    assert not alone.any()
