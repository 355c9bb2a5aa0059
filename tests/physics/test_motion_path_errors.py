"""Errors of the path: against sympy's derivatives of the path, and against the motion itself."""

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

from counterspin.physics.accelerometer import QX, QY, Mounting
from counterspin.physics.closed_forms import parabola
from counterspin.physics.motion import Site, Trajectory, encoder_error, perturb_trajectory
from counterspin.physics.observation import ORDERS, columns, reference
from counterspin.physics.simulation import simulate_record
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import MOTION_TERMS

SITE = Site(9.8066, 0.7985)
SPINDLE = Spindle(-2.4, 3e-4, (Ripple(1, 4e-3, 0.8), Ripple(2, 3e-3, -1.0)), start_angle=0.5)
TRAJECTORY = Trajectory(SPINDLE, 2.5, SITE)
TIMES = np.linspace(0.0, 9.0, 181)

ERRORS = {
    "centrifuge.stretch": 2e-4,
    "centrifuge.imbalance.1.cos": 3e-3,
    "centrifuge.imbalance.1.sin": -2e-3,
    "centrifuge.imbalance.2.cos": 1e-3,
    "centrifuge.imbalance.2.sin": 4e-3,
}


def derive_path():
    """Differentiate the definition of the path: position, velocity and acceleration."""
    t = sp.symbols("t", real=True)
    w0 = SPINDLE.rate
    theta = SPINDLE.start_angle + w0 * t + SPINDLE.drift * w0 * t**2 / 2
    for r in SPINDLE.ripples:
        n_w0 = r.harmonic * w0
        theta -= r.amplitude / n_w0 * (sp.cos(n_w0 * t + r.phase) - math.cos(r.phase))
    rate = sp.diff(theta, t)
    radius = 2.5 * (1 + ERRORS["centrifuge.stretch"] * 2.5 * rate**2)
    for symbol, value in ERRORS.items():
        parts = symbol.split(".")
        if parts[1] == "imbalance":
            radius += value * getattr(sp, parts[3])(int(parts[2]) * theta)
    place = [radius * sp.cos(theta), radius * sp.sin(theta)]
    return [
        np.column_stack([sp.lambdify(t, sp.diff(x, t, order), "numpy")(TIMES) for x in place])
        for order in range(3)
    ]


def test_path_matches_definition():
    motion = perturb_trajectory(TRAJECTORY, ERRORS).at(TIMES)
    got = (motion.position, motion.velocity, motion.acceleration)
    for value, expected in zip(got, derive_path(), strict=True):
        np.testing.assert_allclose(value[:, :2], expected, rtol=0, atol=1e-13)
        assert not value[:, 2].any()


def test_path_without_errors_is_circle():
    assert perturb_trajectory(TRAJECTORY, {"platform.tilt.north": 1e-3}) is TRAJECTORY
    assert perturb_trajectory(TRAJECTORY, {"encoder.harmonic.1.cos": 1e-3}) is TRAJECTORY


@pytest.mark.parametrize("observable", ORDERS)
@pytest.mark.parametrize("mounting", [QX, QY], ids=["Qx", "Qy"])
def test_radius_columns_match_simulation(mounting, observable):
    """The motion is linear in the radius, so columns and simulation agree at any size."""
    table = columns(TRAJECTORY, mounting, list(ERRORS), TIMES, observable)
    signal = simulate_record(TRAJECTORY, mounting, {}, ERRORS, TIMES, observable)
    expected = signal - reference(TRAJECTORY, mounting, TIMES, observable)
    np.testing.assert_allclose(
        table @ np.array(list(ERRORS.values())), expected, rtol=0, atol=2e-12
    )
    # What is recorded through a scale factor is larger by it.
    scaled = columns(TRAJECTORY, mounting, list(ERRORS), TIMES, observable, scale_factor=1.25)
    np.testing.assert_allclose(scaled, 1.25 * table, rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("observable", ORDERS)
@pytest.mark.parametrize("symbol", [s for s in MOTION_TERMS if s.startswith("encoder")])
def test_encoder_columns_match_derivatives_of_reference(symbol, observable):
    """Compare the record with the reference of a spindle that follows the encoder angle."""
    step = 1e-4
    error = MOTION_TERMS[symbol].effect

    def simulate_misread_angle(size):
        """Return the true motion less the reference's, whose angle is theta + size wave(theta)."""
        t = sp.symbols("t", real=True)
        theta = 0.5 - 2.4 * t + 0.01 * sp.sin(1.3 * t)
        wave = getattr(sp, error.quadrature)(error.harmonic * theta)
        order = 2 - ORDERS[observable]
        change = []
        for angle in (theta, theta + size * wave):
            place = [2.5 * sp.cos(angle), 2.5 * sp.sin(angle)]
            motion = [sp.lambdify(t, sp.diff(x, t, order), "numpy")(TIMES) for x in place]
            if order == 2:
                v = [sp.lambdify(t, sp.diff(x, t), "numpy")(TIMES) for x in place]
                motion[0] = motion[0] - 2.0 * SITE.earth_rotation[2] * v[1]
            change.append(motion[0])
        return change[0] - change[1]

    # The same rotation for counterspin, about the recorded angle.
    spindle = Spindle(-2.4, 0.0, (), 0.5)
    moving = replace(TRAJECTORY, spindle=spindle)

    class Swinging(Spindle):
        def angle(self, t):
            return 0.5 - 2.4 * t + 0.01 * np.sin(1.3 * t)

        def angular_rate(self, t):
            return -2.4 + 0.013 * np.cos(1.3 * t)

        def angular_acceleration(self, t):
            return -0.0169 * np.sin(1.3 * t)

    moving = replace(moving, spindle=Swinging(-2.4))
    derivative = (simulate_misread_angle(step) - simulate_misread_angle(-step)) / (2 * step)
    got = columns(moving, QX, [symbol], TIMES, observable)[:, 0]
    np.testing.assert_allclose(got, derivative, rtol=0, atol=2e-6 * np.abs(got).max())


@pytest.mark.parametrize("observable", ORDERS)
def test_axis_tilt_columns_match_simulation(observable):
    """The tilt affects a vertical accelerometer; a level one only through the Earth's rate."""
    tilt = {"centrifuge.axis_tilt.east": 2e-3, "centrifuge.axis_tilt.north": -3e-3}
    qz = Mounting.from_axes("up", "east")
    for mounting in (qz, QX):
        table = columns(TRAJECTORY, mounting, list(tilt), TIMES, observable)
        signal = simulate_record(TRAJECTORY, mounting, {}, tilt, TIMES, observable)
        expected = signal - reference(TRAJECTORY, mounting, TIMES, observable)
        np.testing.assert_allclose(
            table @ np.array(list(tilt.values())), expected, rtol=0, atol=2e-12
        )
    if observable == "displacement":
        theta = SPINDLE.angle(TIMES)
        height = columns(TRAJECTORY, qz, list(tilt), TIMES) @ np.array(list(tilt.values()))
        expected = 2.5 * (2e-3 * np.sin(theta) + 3e-3 * np.cos(theta))
        np.testing.assert_allclose(height, expected, rtol=0, atol=1e-14)
        assert not columns(TRAJECTORY, QX, list(tilt), TIMES).any()


def test_eccentric_encoder_error_matches_formula():
    angle = np.linspace(-7.0, 7.0, 101)
    shared = {"encoder.harmonic.1.sin": 3e-6, "encoder.harmonic.2.cos": -1e-6, "K_F": 1.0}
    expected = 3e-6 * np.sin(angle) - 1e-6 * np.cos(2 * angle)
    np.testing.assert_allclose(encoder_error(shared, angle), expected, rtol=0, atol=1e-20)


def test_columns_match_closed_forms_at_constant_rate():
    """An error of the first harmonic appears as a second harmonic and a constant."""
    rate, radius, phase = 2.0, 2.5, 0.7
    steady = Trajectory(Spindle(rate), radius, SITE)
    theta = rate * TIMES
    weights = np.array([math.cos(phase), math.sin(phase)])
    imbalance = [f"centrifuge.imbalance.1.{wave}" for wave in ("cos", "sin")]
    got = columns(steady, QX, imbalance, TIMES) @ weights
    expected = 0.5 * (np.cos(2 * theta - phase) + math.cos(phase))
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-14)
    # The recorded angle is ahead by sin(theta + phase): the reference is, the record is not.
    eccentric = [f"encoder.harmonic.1.{wave}" for wave in ("sin", "cos")]
    got = columns(steady, QX, eccentric, TIMES) @ weights
    expected = -0.5 * radius * (np.cos(2 * theta + phase) - math.cos(phase))
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-14)
    got = columns(steady, QX, ["centrifuge.stretch"], TIMES)[:, 0]
    np.testing.assert_allclose(got, radius**2 * rate**2 * np.cos(theta), rtol=0, atol=1e-13)


@pytest.mark.parametrize("symbol", MOTION_TERMS)
def test_path_errors_have_no_parabola(symbol):
    steady = Trajectory(Spindle(2.0), 2.5, Site(9.8, 0.8, earth_rate=0.0))
    turns = math.pi * np.arange(1, 6)
    position = columns(steady, QX, [symbol], turns)[:, 0]
    np.testing.assert_allclose(position - position[0], 0.0, atol=1e-12)
    assert parabola(symbol, QX, 2.0, 2.5, 9.8) == 0.0


def test_imbalance_equals_encoder_harmonic_except_at_start():
    """The first harmonics produce second harmonics in every accelerometer and observable."""
    steady = Trajectory(Spindle(2.0), 2.5, Site(9.8, 0.8, earth_rate=0.0))
    for mounting in (QX, QY):
        for observable in ("displacement", "velocity"):
            shown = columns(
                steady,
                mounting,
                ["centrifuge.imbalance.1.cos", "encoder.harmonic.1.sin"],
                TIMES,
                observable,
            )
            sum_of_both = 2.5 * shown[:, 0] + shown[:, 1]
            np.testing.assert_allclose(sum_of_both, sum_of_both[0], rtol=0, atol=1e-12)
