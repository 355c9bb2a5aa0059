"""The motion on the double turntable, against sympy and against an inertial frame."""

import math

import numpy as np
import pytest
import sympy as sp

from counterspin.physics.motion import EARTH_RATE, Site, Trajectory
from counterspin.physics.spindle import Ripple, Spindle

SITE = Site(gravity=9.80665, latitude=0.8)
TRAJECTORY = Trajectory(
    Spindle(2.0, 1e-4, (Ripple(1, 0.02, 0.4), Ripple(2, 0.01, -1.0)), start_angle=0.6), 2.5, SITE
)
REVERSED = Trajectory(
    Spindle(-6.0, -2e-4, (Ripple(3, 0.05, 2.0),), start_angle=-2.0), 1.7, Site(9.78, -0.5)
)
BOTH = pytest.mark.parametrize("trajectory", [TRAJECTORY, REVERSED], ids=["forward", "reversed"])
TIMES = np.linspace(0.0, 9.0, 31)

t = sp.symbols("t", real=True)


def symbolic_position(trajectory):
    """R (cos theta, sin theta, 0) with the angle of Eq. 2 written out."""
    s = trajectory.spindle
    w0 = sp.Float(s.rate, 30)
    theta = sp.Float(s.start_angle, 30) + w0 * t + sp.Float(s.drift, 30) * w0 * t**2 / 2
    for r in s.ripples:
        phase = sp.Float(r.phase, 30)
        turning = sp.cos(r.harmonic * w0 * t + phase) - sp.cos(phase)
        theta -= sp.Float(r.amplitude, 30) / (r.harmonic * w0) * turning
    return trajectory.radius * sp.Matrix([sp.cos(theta), sp.sin(theta), 0])


def evaluate_vector(vector, times=TIMES):
    function = sp.lambdify(t, list(vector), "numpy")
    return np.stack([np.broadcast_to(x, times.shape) for x in function(times)], -1)


@BOTH
def test_position_velocity_and_acceleration_match_derivatives(trajectory):
    position = symbolic_position(trajectory)
    for order, method in enumerate(
        (trajectory.position, trajectory.velocity, trajectory.acceleration)
    ):
        got = method(TIMES)
        assert got.shape == (TIMES.size, 3)
        expected = evaluate_vector(sp.diff(position, t, order))
        # Roundings of an angle below 60 rad, times R w^order.
        scale = trajectory.radius * abs(trajectory.spindle.rate) ** order
        np.testing.assert_allclose(got, expected, rtol=0, atol=5e-14 * scale)


@BOTH
def test_harmful_acceleration_is_coriolis_plus_gravity_reaction(trajectory):
    latitude = trajectory.site.latitude
    east, north, _ = trajectory.velocity(TIMES).T
    # 2 Omega x v component by component (Eq. 10, 12) for a level motion.
    expected = np.stack(
        [
            -2 * EARTH_RATE * math.sin(latitude) * north,
            2 * EARTH_RATE * math.sin(latitude) * east,
            trajectory.site.gravity - 2 * EARTH_RATE * math.cos(latitude) * east,
        ],
        -1,
    )
    np.testing.assert_allclose(trajectory.harmful_acceleration(TIMES), expected, atol=1e-14)


def test_spindle_at_rest_has_upward_specific_force():
    slow = Trajectory(Spindle(1e-9), 2.5, SITE)
    np.testing.assert_allclose(slow.specific_force(np.zeros(1)), [[0, 0, 9.80665]], atol=1e-12)


def test_coriolis_acceleration_is_zero_without_earth_rate():
    still = Trajectory(TRAJECTORY.spindle, 2.5, Site(9.8, 0.8, earth_rate=0.0))
    np.testing.assert_array_equal(
        still.harmful_acceleration(TIMES), np.tile([0.0, 0.0, 9.8], (TIMES.size, 1))
    )


@BOTH
def test_specific_force_is_inertial_acceleration_minus_gravitation(trajectory):
    """First principles: no Coriolis formula, only a rotating Earth watched from outside.

    The platform's path is turned into a frame that does not rotate and differentiated there.
    Gravitation is the plumb-line gravity less the centrifugal acceleration at the spindle axis.
    What then remains is the centrifugal acceleration across the radius, which the model leaves
    out: Omega x (Omega x r), at most Omega^2 R = 1.3e-8 m/s^2.
    """
    site = trajectory.site
    spin = sp.Float(site.earth_rate, 30)
    slat, clat = math.sin(site.latitude), math.cos(site.latitude)
    # Columns: east, north, up at longitude 0 in Earth-fixed axes.
    local = sp.Matrix([[0, -slat, clat], [1, 0, 0], [0, clat, slat]])
    cos, sin = sp.cos(spin * t), sp.sin(spin * t)
    turn = sp.Matrix([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    axis = sp.Matrix([6.4e6 * clat, 0, 6.3e6 * slat])  # where the centrifuge stands
    inertial = turn * (axis + local * symbolic_position(trajectory))
    acceleration = evaluate_vector(sp.diff(inertial, t, 2))
    rotation = np.array(sp.lambdify(t, turn * local, "numpy")(0.0), dtype=float)
    angles = site.earth_rate * TIMES
    omega = np.array([0.0, 0.0, site.earth_rate])
    place = np.array(axis, dtype=float).ravel()
    plumb = -site.gravity * rotation[:, 2]
    gravitation = plumb + np.cross(omega, np.cross(omega, place))
    expected = np.empty((TIMES.size, 3))
    for k, angle in enumerate(angles):
        c, s = math.cos(angle), math.sin(angle)
        back = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])  # inertial to Earth-fixed
        expected[k] = rotation.T @ (back @ acceleration[k] - gravitation)
    local_omega = site.earth_rotation
    neglected = np.cross(local_omega, np.cross(local_omega, trajectory.position(TIMES)))
    assert 0.1 < np.abs(neglected).max() / (EARTH_RATE**2 * trajectory.radius) <= 1.0
    np.testing.assert_allclose(
        trajectory.specific_force(TIMES) + neglected, expected, rtol=0, atol=2e-12
    )


@BOTH
def test_velocity_is_integral_of_specific_force(trajectory):
    nodes, weights = np.polynomial.legendre.leggauss(160)
    for end in (0.5, 2.0, 5.0):
        force = trajectory.specific_force(0.5 * end * (1 + nodes))
        expected = 0.5 * end * (weights @ force)
        got = trajectory.velocity_of_specific_force(np.array([0.0, end]))
        np.testing.assert_array_equal(got[0], 0.0)
        np.testing.assert_allclose(got[1], expected, rtol=0, atol=1e-11)


def test_acceleration_is_equal_at_every_point_of_case():
    """The outer table turns by theta, the inner by -theta: a lever arm in the case cancels."""
    theta = sp.Function("theta")(t)

    def table(angle):
        c, s = sp.cos(angle), sp.sin(angle)
        return sp.Matrix([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    R, *arm = sp.symbols("R x y z", real=True)
    point = table(theta) * (sp.Matrix([R, 0, 0]) + table(-theta) * sp.Matrix(arm))
    centre = R * sp.Matrix([sp.cos(theta), sp.sin(theta), 0])
    assert sp.simplify(sp.diff(point - centre, t)) == sp.zeros(3, 1)
