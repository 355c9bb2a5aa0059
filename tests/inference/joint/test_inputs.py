"""What a record shows of uncertain inputs."""

import numpy as np
import pytest

from counterspin.inference.joint.inputs import TIMING, input_column
from counterspin.inference.joint.series import Series
from counterspin.physics.accelerometer import QX
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.observation import LEVEL
from counterspin.physics.spindle import Spindle

G, RADIUS, RATE, START = 9.8, 2.5, -5.0, 0.7
ERRORS = {"K_F": 1e-3, "K_I": 1e-3, "K_II": 3e-4, "K_III": -2e-4}


@pytest.mark.parametrize("observable", ["specific_force", "velocity"])
def test_a_delay_of_the_angle_delays_what_the_errors_make_of_the_motion_too(observable):
    """By the output's own slope: minus its derivative at fixed start.

    Along the east axis a = -(R w^2/g) cos(w t + start) in g, and the accelerometer indicates a
    plus the polynomial of a that its errors are.
    """
    t = np.arange(60) * 0.02
    series = Series(
        accelerometer="Qx",
        run="run1",
        trajectory=Trajectory(
            Spindle(RATE, start_angle=START), RADIUS, Site(G, 0.8, earth_rate=0.0)
        ),
        mounting=QX,
        observable=observable,
        attitude=LEVEL,
        time=t,
        spread=np.zeros(t.size),
        count=np.ones(t.size),
        spacing=0.02,
        error=np.zeros(t.size),
    )
    table = dict(zip(ERRORS, series.columns(list(ERRORS), 1.0).T, strict=True))
    column = input_column(series, TIMING, 1.001, ERRORS, table)

    def force(t):
        return -RADIUS * RATE**2 / G * np.cos(RATE * t + START)

    def error(t):
        a = force(t)
        return G * (1e-3 * a + 3e-4 * a**2 - 2e-4 * a**3)

    if observable == "velocity":
        of_reference = -G * force(t)
        of_errors = -(error(t) - error(0.0))
    else:
        slope = RADIUS * RATE**3 / G * np.sin(RATE * t + START)
        of_reference = -G * slope
        a = force(t)
        of_errors = -G * (1e-3 + 2 * 3e-4 * a - 3 * 2e-4 * a**2) * slope
    # A difference over 1e-5 rad is off by half of it, and by rounding over it.
    np.testing.assert_allclose(
        column - of_reference, of_errors, atol=2e-5 * np.abs(of_reference).max()
    )
    assert np.abs(of_errors).max() > 100 * 2e-5 * np.abs(of_reference).max()
