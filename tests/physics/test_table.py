"""A table that turns on the arm at another ratio than -1, against 40 digits of kinematics."""

import math
from dataclasses import replace

import mpmath
import numpy as np
import pytest

from counterspin.physics.accelerometer import Mounting
from counterspin.physics.motion import Site, Trajectory, encoder_error
from counterspin.physics.observation import columns, reference
from counterspin.physics.simulation import simulate_record
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import TERMS

SPINDLE = Spindle(4.0, start_angle=0.3, drift=2e-4, ripples=(Ripple(1, 4e-4, 0.7),))
SITE = Site(9.8066, math.radians(45.75))
TILTED = Mounting.from_axes([0.8, -0.36, 0.48], [0.0, 0.8, 0.6])
TIMES = np.array([0.1, 0.83, 2.7])
#: Truth of an accelerometer about which the design columns are the derivatives.
RATIOS = [-2.0, 0.0, 0.5, -1.0]


def force_by_position(ratio, earth_rate, lever_arm, axis, time):
    """Return the specific force along an axis: the position of a proof mass, differentiated twice.

    The position is that in a frame that does not turn with the Earth. What the package neglects,
    the Earth's centripetal acceleration on the radius, is removed.
    """
    mp = mpmath.mp
    rate, drift, start = (mp.mpf(x) for x in (SPINDLE.rate, SPINDLE.drift, SPINDLE.start_angle))
    (ripple,) = SPINDLE.ripples
    phase, amplitude = mp.mpf(ripple.phase), mp.mpf(ripple.amplitude)
    latitude, omega = mp.mpf(SITE.latitude), mp.mpf(earth_rate)
    pole = mp.matrix([0, mp.cos(latitude), mp.sin(latitude)])

    def rotate(about, angle, vector):
        cross = mp.matrix(
            [
                about[1] * vector[2] - about[2] * vector[1],
                about[2] * vector[0] - about[0] * vector[2],
                about[0] * vector[1] - about[1] * vector[0],
            ]
        )
        along = (about.T * vector)[0] * (1 - mp.cos(angle)) * about
        return mp.cos(angle) * vector + mp.sin(angle) * cross + along

    def angle(t):
        wave = mp.cos(rate * t + phase) - mp.cos(phase)
        return start + rate * t + drift * rate * t**2 / 2 - amplitude / rate * wave

    up = mp.matrix([0, 0, 1])

    def on_table(t, vector):
        return rotate(up, (1 + mp.mpf(ratio)) * angle(t), vector)

    def position(t):
        arm = mp.mpf(2.5) * mp.matrix([mp.cos(angle(t)), mp.sin(angle(t)), 0])
        return arm + on_table(t, mp.mpf(lever_arm) * axis)

    def in_space(t, component):
        return rotate(pole, omega * t, position(t))[component]

    t = mp.mpf(time)
    acceleration = mp.matrix([mp.diff(lambda s, c=c: in_space(s, c), t, 2) for c in range(3)])
    acceleration = rotate(pole, -omega * t, acceleration)
    place = position(t)
    centripetal = omega**2 * ((pole.T * place)[0] * pole - place)
    force = acceleration - centripetal + mp.mpf(SITE.gravity) * up
    return (on_table(t, axis).T * force)[0]


@pytest.mark.parametrize("earth_rate", [0.0, SITE.earth_rate])
@pytest.mark.parametrize("ratio", RATIOS)
def test_specific_force_is_second_derivative_of_position(ratio, earth_rate):
    lever_arm = 0.03
    site = replace(SITE, earth_rate=earth_rate)
    trajectory = Trajectory(SPINDLE, 2.5, site, table_ratio=ratio)
    axis = TILTED.input_axis
    motion = trajectory.at(TIMES)
    force = (motion.specific_force + lever_arm * motion.table.lever_arm_force(axis)) @ axis
    with mpmath.workdps(40):
        exact = mpmath.matrix([mpmath.mpf(float(x)) for x in axis])
        expected = [force_by_position(ratio, earth_rate, lever_arm, exact, float(t)) for t in TIMES]
    largest = np.abs(motion.specific_force).max()
    for value, wanted in zip(force.tolist(), expected, strict=True):
        assert abs(value - float(wanted)) < 1e-12 * largest


TERMS_AND_STEPS = {
    "K_F": 1e-3,
    "K_I": 1e-3,
    "K_II": 1e-4,
    "K_spin": 1e-5,
    "K_ang": 1e-2,
    "table.lever_arm": 1e-3,
    "table.harmonic.1.cos": 1e-5,
    "table.harmonic.2.sin": 1e-5,
    "table.axis_tilt.outward": 1e-5,
    "table.axis_tilt.forward": 1e-5,
    "platform.tilt.east": 1e-5,
    "platform.tilt.up": 1e-5,
    "platform.compliance.zy": 1e-6,
    "centrifuge.axis_tilt.north": 1e-5,
    "centrifuge.stretch": 1e-8,
    "centrifuge.imbalance.1.sin": 1e-5,
}


@pytest.mark.parametrize("ratio", [-2.0, 0.5])
@pytest.mark.parametrize("symbol", TERMS_AND_STEPS)
def test_columns_match_derivatives_of_simulated_output(symbol, ratio):
    """The simulation turns the force exactly; the columns are linear."""
    trajectory = Trajectory(SPINDLE, 2.5, SITE, table_ratio=ratio)
    step, row = TERMS_AND_STEPS[symbol], TERMS.get(symbol)
    attitude = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])

    def simulate_output(change):
        value = {symbol: change + (row.nominal if row else 0.0)}
        coefficients, shared = (value, {}) if row else ({}, value)
        args = trajectory, TILTED, coefficients, shared, TIMES, "specific_force"
        return simulate_record(*args, attitude=attitude)

    derivative = (simulate_output(step) - simulate_output(-step)) / (2.0 * step)
    (column,) = columns(trajectory, TILTED, [symbol], TIMES, "specific_force", attitude=attitude).T
    assert np.abs(column).max() > 1e-5
    np.testing.assert_allclose(column, derivative, rtol=1e-6, atol=2e-8 * np.abs(column).max())


@pytest.mark.parametrize("ratio", [-2.0, 0.5])
@pytest.mark.parametrize("quadrature", ["cos", "sin"])
def test_encoder_error_changes_force_and_table_angle(ratio, quadrature):
    """The record follows the true angle, the reference the recorded one."""
    symbol, size, step = f"encoder.harmonic.2.{quadrature}", 1e-6, 1e-5
    recorded = Trajectory(SPINDLE, 2.5, SITE, table_ratio=ratio)

    # A point of the motion is fixed by angle, rate and acceleration: those of the true angle are
    # the recorded ones without the error, which is a function of the angle.
    def without_error(t):
        angle = SPINDLE.angle(t)
        return angle - encoder_error({symbol: size}, angle)

    class TrueSpindle(Spindle):
        def angle(self, t):
            return without_error(t)

        def angular_rate(self, t):
            return (without_error(t + step) - without_error(t - step)) / (2.0 * step)

        def angular_acceleration(self, t):
            return super().angular_acceleration(t) + second_derivative_of_error(t)

    def second_derivative_of_error(t):
        error = [SPINDLE.angle(s) - without_error(s) for s in (t - 1e-3, t, t + 1e-3)]
        return -(error[0] - 2.0 * error[1] + error[2]) / 1e-6

    fields = {name: getattr(SPINDLE, name) for name in ("rate", "start_angle", "drift", "ripples")}
    true = replace(recorded, spindle=TrueSpindle(**fields))
    change = [reference(path, TILTED, TIMES, "specific_force") for path in (true, recorded)]
    (column,) = columns(recorded, TILTED, [symbol], TIMES, "specific_force").T
    np.testing.assert_allclose(
        column, (change[0] - change[1]) / size, rtol=1e-3, atol=1e-3 * np.abs(column).max()
    )


def test_table_of_ratio_zero_equals_arm():
    """The input axis points outwards: Station("arm") has the same force and K_spin."""
    from stations import Station

    trajectory = Trajectory(Spindle(4.0), 2.5, SITE, table_ratio=0.0)
    force = trajectory.specific_force(TIMES)
    on_arm = Station("arm", TILTED, rate=4.0, radius=2.5).force(SITE, 4.0 * TIMES)
    np.testing.assert_allclose(force, on_arm, rtol=1e-12, atol=1e-13)


def force_on_a_tilted_table(tilt, ratio, axis, time):
    """Return the force along an axis of a table whose own axis leans on the arm; 40 digits."""
    mp = mpmath.mp
    rate, radius, gravity = mp.mpf(4), mp.mpf(2.5), mp.mpf(SITE.gravity)

    def rotate(about, angle):
        x, y, z = about
        cross = mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return mp.eye(3) + mp.sin(angle) * cross + (1 - mp.cos(angle)) * cross**2

    def position(t, component):
        return radius * (mp.cos(rate * t), mp.sin(rate * t), mp.mpf(0))[component]

    t, up = mp.mpf(time), (0, 0, 1)
    size = mp.norm(mp.matrix(tilt))
    leaning = rotate([x / size for x in tilt] + [0], size)
    # The arm turns, its table axis leans, and the table turns about that axis.
    attitude = rotate(up, rate * t) * leaning * rotate(up, mp.mpf(ratio) * rate * t)
    acceleration = [mp.diff(lambda s, c=c: position(s, c), t, 2) for c in range(3)]
    force = mp.matrix(acceleration) + mp.matrix([0, 0, gravity])
    return ((attitude * axis).T * force)[0]


@pytest.mark.parametrize("ratio", [-1.0, -2.0, 0.5])
def test_table_axis_tilt_matches_rotated_instrument(ratio):
    site = replace(SITE, earth_rate=0.0)
    trajectory = Trajectory(Spindle(4.0), 2.5, site, table_ratio=ratio)
    tilt = (2e-5, -3e-5)
    symbols = ["table.axis_tilt.outward", "table.axis_tilt.forward"]
    record = simulate_record(
        trajectory, TILTED, {}, dict(zip(symbols, tilt, strict=True)), TIMES, "specific_force"
    )
    with mpmath.workdps(40):
        axis = mpmath.matrix([mpmath.mpf(float(x)) for x in TILTED.input_axis])
        exact_tilt = [mpmath.mpf(x) for x in tilt]
        expected = [force_on_a_tilted_table(exact_tilt, ratio, axis, float(t)) for t in TIMES]
        expected = [float(value) for value in expected]
    np.testing.assert_allclose(record, expected, rtol=1e-12, atol=1e-11)
