"""Simulated records against an ordinary differential equation that shares no code with them."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from counterspin.physics.accelerometer import QX, QY, QZ, Mounting
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.observation import LEVEL, columns, reference
from counterspin.physics.simulation import (
    attitude_error,
    simulate_record,
)
from counterspin.physics.spindle import Ripple, Spindle

G, LATITUDE, EARTH, RADIUS = 9.8066, 0.7985, 7.292115e-5, 2.5
SITE = Site(G, LATITUDE, EARTH)

# Larger than any instrument's, so that products of small terms show.
COEFFICIENTS = {
    "K_F": 0.005,
    "K_I": 1.002,
    "K_II": 3e-4,
    "K_III": -2e-4,
    "K_4": 1e-5,
    "K_IP": 4e-4,
    "K_IO": -3e-4,
    "K_PO": 2e-4,
    "K_PP": -4e-4,
    "K_OO": 5e-4,
    "K_OQ": 2e-4,
    "delta_O": 3e-3,
    "delta_P": -2e-3,
}
PLATFORM = {
    "platform.tilt.east": 2e-3,
    "platform.tilt.north": -1e-3,
    "platform.tilt.up": 3e-3,
    "platform.drift.east": 1e-5,
    "platform.drift.north": -2e-5,
    "platform.drift.up": 3e-5,
    "platform.g_sensitivity.xx": 1e-5,
    "platform.g_sensitivity.xz": -2e-5,
    "platform.g_sensitivity.yx": 3e-5,
    "platform.g_sensitivity.zx": -4e-5,
    "platform.g_sensitivity.zy": 5e-5,
    "platform.g2_sensitivity.north": 3e-6,
    "platform.g2_sensitivity.up": -2e-6,
    "platform.compliance.xy": 2e-5,
    "platform.compliance.yz": -4e-5,
    "platform.compliance.zx": 3e-5,
    "platform.compliance.zy": 5e-5,
}
RIPPLES = (Ripple(1, 2e-3, 0.5), Ripple(3, -1e-3, 2.0))
TURNED = Rotation.from_euler("xyz", [90, 20, -50], degrees=True).as_matrix()


def solve_differential_equation(spindle, mounting, coefficients, platform, times, attitude):
    """Integrate rotation, attitude and navigation computer together: (force, velocity, place).

    Every formula is written out here again: Eq. 1, the motion on a circle, Eq. 7.
    """
    w0, k = spindle.rate, {"K_I": 1.0, **coefficients}
    axes = np.array(mounting.axes) @ attitude
    earth = EARTH * np.array([0.0, math.cos(LATITUDE), math.sin(LATITUDE)])
    tilt, drift, squared = np.zeros(3), np.zeros(3), np.zeros(3)
    sensitivity, compliance = np.zeros((3, 3)), np.zeros((3, 3))
    for symbol, value in platform.items():
        kind, which = symbol.split(".")[1:]
        if kind in ("g_sensitivity", "compliance"):
            matrix = {"g_sensitivity": sensitivity, "compliance": compliance}[kind]
            matrix["xyz".index(which[0]), "xyz".index(which[1])] = value
        else:
            vector = {"tilt": tilt, "drift": drift, "g2_sensitivity": squared}[kind]
            vector[["east", "north", "up"].index(which)] = value

    def motion(t, theta):
        rate = w0 * (1 + spindle.drift * t)
        rate += sum(r.amplitude * math.sin(r.harmonic * w0 * t + r.phase) for r in spindle.ripples)
        change = w0 * spindle.drift + sum(
            r.amplitude * r.harmonic * w0 * math.cos(r.harmonic * w0 * t + r.phase)
            for r in spindle.ripples
        )
        out = np.array([math.cos(theta), math.sin(theta), 0.0])
        along = np.array([-math.sin(theta), math.cos(theta), 0.0])
        velocity = RADIUS * rate * along
        harmful = 2 * np.cross(earth, velocity) + [0.0, 0.0, G]
        return rate, velocity, RADIUS * (change * along - rate**2 * out) + harmful, harmful

    def sense_force(force, psi):
        psi = psi + attitude.T @ compliance @ attitude @ force / G
        i, p, o = axes @ Rotation.from_rotvec(psi).as_matrix().T @ force / G
        return G * (
            k.get("K_F", 0)
            + k["K_I"] * i
            + k.get("K_II", 0) * i**2
            + k.get("K_III", 0) * i**3
            + k.get("K_4", 0) * i**4
            + k.get("K_IP", 0) * i * p
            + k.get("K_IO", 0) * i * o
            + k.get("K_PO", 0) * p * o
            + k.get("K_PP", 0) * p**2
            + k.get("K_OO", 0) * o**2
            + k.get("K_OQ", 0) * i * abs(i)
            + k.get("delta_O", 0) * p
            - k.get("delta_P", 0) * o
        )

    def change(t, state):
        theta, psi, speed = state[0], state[1:4], state[4]
        rate, _, force, harmful = motion(t, theta)
        turning = attitude.T @ (
            drift + sensitivity @ attitude @ force / G + squared * (force @ force) / G**2
        )
        return np.array([rate, *turning, sense_force(force, psi) - axes[0] @ harmful, speed])

    theta0 = spindle.start_angle
    place = RADIUS * np.array([math.cos(theta0), math.sin(theta0), 0.0])
    start = [theta0, *tilt, axes[0] @ motion(0.0, theta0)[1], axes[0] @ place]
    path = solve_ivp(
        change,
        (0.0, times[-1]),
        start,
        method="DOP853",
        t_eval=times,
        rtol=1e-12,
        atol=1e-13,
        max_step=0.05,
    )
    state = path.y.T
    force = [sense_force(motion(t, s[0])[2], s[1:4]) for t, s in zip(times, state, strict=True)]
    return {"specific_force": np.array(force), "velocity": state[:, 4], "displacement": state[:, 5]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mounting", "attitude", "rate", "start_angle"),
    [
        (QX, LEVEL, 3.0, 0.0),
        (QX, LEVEL, -3.0, 0.4),
        (QY, LEVEL, 3.0, -1.0),
        (QZ, LEVEL, 3.0, 0.0),
        (QX, TURNED, -2.0, 0.0),
        (Mounting.from_axes([0.6, 0.8, 0.0], [0.0, 0.0, 1.0]), TURNED, 3.0, 2.0),
    ],
    ids=["Qx", "Qx the other sense", "Qy", "Qz", "Qx turned", "oblique turned"],
)
def test_record_matches_differential_equation(mounting, attitude, rate, start_angle):
    spindle = Spindle(rate, 2e-4, RIPPLES, start_angle)
    times = np.linspace(0.0, 8.0, 41)
    smooth = {symbol: value for symbol, value in COEFFICIENTS.items() if symbol != "K_OQ"}
    motion = Trajectory(spindle, RADIUS, SITE)
    # An equation solver steps over the kink of K_OQ with an error that is all its own.
    for coefficients, tolerance in ((smooth, 1e-12), (COEFFICIENTS, 3e-8)):
        expected = solve_differential_equation(
            spindle, mounting, coefficients, PLATFORM, times, attitude
        )
        for observable, values in expected.items():
            record = simulate_record(
                motion, mounting, coefficients, PLATFORM, times, observable, attitude=attitude
            )
            np.testing.assert_allclose(record, values, rtol=0.0, atol=tolerance)


def test_perfect_system_records_reference():
    motion = Trajectory(Spindle(2.0, 1e-4, RIPPLES, 0.3), RADIUS, SITE)
    times = np.linspace(0.0, 30.0, 301)
    for observable in ("displacement", "velocity", "specific_force"):
        record = simulate_record(motion, QX, {}, {}, times, observable)
        np.testing.assert_allclose(
            record, reference(motion, QX, times, observable), rtol=0.0, atol=1e-13
        )


def test_small_errors_match_columns():
    motion = Trajectory(Spindle(2.0, 1e-6, RIPPLES), RADIUS, SITE)
    times = np.linspace(0.0, 30.0, 31)
    rounding = 1e-13  # of forces of 20 m/s^2, summed twice over 30 s
    for symbol, value in COEFFICIENTS.items():
        error = simulate_record(motion, QX, {symbol: value}, {}, times) - reference(
            motion, QX, times
        )
        column = columns(motion, QX, [symbol], times)[:, 0]
        expected = (value - (1.0 if symbol == "K_I" else 0.0)) * column
        np.testing.assert_allclose(error, expected, rtol=1e-12, atol=rounding)
    small = 1e-9
    for symbol in PLATFORM:
        error = simulate_record(motion, QX, {}, {symbol: small}, times) - reference(
            motion, QX, times
        )
        column = columns(motion, QX, [symbol], times)[:, 0]
        second_order = (small * 30.0) ** 2 * G * 30.0**2
        np.testing.assert_allclose(error, small * column, rtol=0.0, atol=rounding + second_order)


def test_attitude_error_adds_tilt_drift_and_g_sensitivity():
    motion = Trajectory(Spindle(2.0), RADIUS, SITE)
    times = np.array([0.0, math.pi])  # after one revolution only gravity is left of the force
    psi = attitude_error(
        motion,
        {
            "platform.tilt.east": 1e-3,
            "platform.drift.up": 1e-5,
            "platform.g_sensitivity.yz": 2e-5,
        },
        times,
    )
    expected = [[1e-3, 0.0, 0.0], [1e-3, 2e-5 * math.pi, 1e-5 * math.pi]]
    np.testing.assert_allclose(psi, expected, rtol=1e-12, atol=1e-18)
