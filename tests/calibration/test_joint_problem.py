"""From a campaign to the joint fit's problem."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from campaigns import SMALL, changed, write

from counterspin.calibration.joint_problem import series_of
from counterspin.calibration.model import assumed_of, model_of
from counterspin.calibration.observed import ObservedRun, Signal
from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.two_stage_request import request_of
from counterspin.campaign.description import read_campaign
from counterspin.inference.joint.series import Series
from counterspin.inference.noise.model import Noise
from counterspin.physics.accelerometer import QX, Mounting
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.observation import LEVEL
from counterspin.physics.spindle import Spindle
from counterspin.physics.terms import OWN_TERMS, term

RADIUS, RATE, TIMING = 2.5, -2.0, 1e-3


#: Input axis raised out of the level by the angle whose sine is 0.8: what turns is level.
RAISED = Mounting.from_axes([0.6, 0.0, 0.8], [0.8, 0.0, -0.6])


@pytest.mark.parametrize("mounting", [QX, RAISED], ids=["level", "raised"])
@pytest.mark.parametrize("observable", ["displacement", "velocity", "specific_force"])
def test_noise_of_the_time_stamps_is_the_rms_slope_times_their_noise(observable, mounting):
    """Each output is sampled a little early or late: its error is its slope times the delay."""
    channel = SimpleNamespace(in_g=False)
    accelerometer = SimpleNamespace(observable=observable, mounting=mounting, channel=channel)
    campaign = SimpleNamespace(
        noise=SimpleNamespace(timing=TIMING), radius=SimpleNamespace(value=RADIUS)
    )
    times = np.arange(400) * math.pi / 200 / abs(RATE)  # one revolution
    record = SimpleNamespace(
        time=times,
        time_sd=np.zeros(400),
        count=np.ones(400),
        report=SimpleNamespace(step=float(times[1])),
    )
    trajectory = Trajectory(Spindle(RATE), RADIUS, Site(9.8, 0.8, earth_rate=0.0))
    run = ObservedRun(
        SimpleNamespace(name="run", rate=RATE, attitude=LEVEL),
        record,
        None,
        trajectory,
        {"Qx": Signal(accelerometer, np.zeros(400))},
    )
    (series,) = series_of(campaign, [run])
    slope = (series.reference(later=1e-5) - series.reference(later=-1e-5)) / 2e-5
    assert series.jitter == pytest.approx(TIMING * math.sqrt(np.mean(slope**2)), rel=1e-6)
    variance = np.maximum((TIMING * slope) ** 2, 0.02 * series.jitter**2)
    np.testing.assert_allclose(series.jitter_variance, variance, atol=1e-6 * series.jitter**2)
    white = series.whitener(Noise(series.jitter)).apply(np.ones(400))
    np.testing.assert_allclose(white, (variance + series.jitter**2) ** -0.5, rtol=1e-5)


def test_credible_sizes_of_unknowns_go_by_the_grade_of_their_accelerometer(tmp_path):
    of_qy = ('input_axis = "north"', 'input_axis = "north"\ngrade = "consumer"')
    campaign = read_campaign(write(tmp_path, changed(SMALL, of_qy)))
    for name, grade in (("Qx", "navigation"), ("Qy", "consumer")):
        asked = [u for u in model_of(campaign).unknowns if u.owner == name]
        perfect = [c for c in assumed_of(campaign, name) if c.symbol in OWN_TERMS]
        assert {u.symbol for u in asked} >= {"K_F", "K_II", "K_III"}
        assert {c.symbol for c in perfect} >= {"K_OO", "delta_O"}
        for one in (*asked, *perfect):
            assert one.limit == term(one.symbol).sizes(grade).limit
        request = request_of(campaign, campaign.accelerometers[name], TwoStageOptions(), None)
        assert request.limit_of("K_II") == term("K_II").sizes(grade).limit


@pytest.mark.parametrize(
    ("column", "in_g"),
    [
        ('displacement = { column = "east_m", unit = "mm" }', False),
        ('specific_force = { column = "f", unit = "m/s^2" }', False),
        ('specific_force = { column = "f", unit = "mm/s^2" }', False),
        ('specific_force = { column = "f", unit = "ug" }', True),
        ('specific_force = { column = "f", unit = "uA" }', True),
    ],
)
def test_a_force_in_g_or_as_a_current_has_the_gravity_assumed_in_it(tmp_path, column, in_g):
    """A record of a current was taken for one in m/s^2: an uncertain g then was not in u(K_I)."""
    old = 'displacement = { column = "east_m", unit = "m" }'
    output = 'output = { unit = "mA", sensitivity = "1.25 mA/g" }\n' if "uA" in column else ""
    campaign = read_campaign(write(tmp_path, changed(SMALL, (old, output + column))))
    assert campaign.accelerometers["Qx"].channel.in_g is in_g


def test_what_a_time_stamp_moves_is_the_slope_of_what_was_recorded():
    """5 mg for 400 s: the platform moves at 20 m/s then, five times as fast as the arm's wave."""
    motion = Trajectory(Spindle(math.pi / 2), RADIUS, Site(9.8, 0.8, earth_rate=0.0))
    time = np.arange(0.0, 400.0, 0.05)
    wave = 2e-3 * np.sin(motion.spindle.angle(time) + 0.3)
    series = Series(
        accelerometer="Qx",
        run="run",
        trajectory=motion,
        mounting=QX,
        observable="displacement",
        attitude=LEVEL,
        time=time,
        spread=np.zeros(time.size),
        count=np.ones(time.size),
        spacing=0.05,
        error=0.5 * 0.049 * time**2 + wave,
    )
    arm = -RADIUS * math.pi / 2 * np.sin(motion.spindle.angle(time))
    own = 0.049 * time + 2e-3 * math.pi / 2 * np.cos(motion.spindle.angle(time) + 0.3)
    np.testing.assert_allclose(sum(series.slopes()), arm + own, atol=1e-6)
