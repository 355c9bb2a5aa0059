"""The joint fit problem of a campaign."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from campaigns import PLACE, SMALL, format_runs, replace_parts, write_description

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.joint_problem import JointProblem, make_noise, make_series
from counterspin.calibration.model import fixed_terms, make_unknowns
from counterspin.calibration.observed_runs import ObservedRun, Signal
from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.two_stage.method import make_request
from counterspin.campaign.description import read_campaign
from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.noise.model import ESTIMATE, Noise
from counterspin.physics.accelerometer import QX, Mounting
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.observation import LEVEL
from counterspin.physics.spindle import Spindle
from counterspin.physics.terms import ACCELEROMETER_TERMS, INPUTS, SHARED_TERMS, term
from counterspin.simulation.simulate import simulate

RADIUS, RATE, TIMING = 2.5, -2.0, 1e-3


#: Input axis raised by arcsin(0.8) above the horizontal.
RAISED = Mounting.from_axes([0.6, 0.0, 0.8], [0.8, 0.0, -0.6])


@pytest.mark.parametrize("mounting", [QX, RAISED], ids=["level", "raised"])
@pytest.mark.parametrize("observable", ["displacement", "velocity", "specific_force"])
def test_timing_noise_is_rms_slope_times_stamp_noise(observable, mounting):
    """The error of an output sampled with a delay is its slope times the delay."""
    channel = SimpleNamespace(in_g=False)
    accelerometer = SimpleNamespace(observable=observable, mounting=mounting, channel=channel)
    campaign = SimpleNamespace(
        noise=SimpleNamespace(timing=TIMING, angle=0.0),
        radius=SimpleNamespace(value=RADIUS),
        recording_of=lambda run: SimpleNamespace(recorder=""),
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
    (series,) = make_series(campaign, [run])
    slope = (series.reference(delay=1e-5) - series.reference(delay=-1e-5)) / 2e-5
    assert series.timing_noise == pytest.approx(TIMING * math.sqrt(np.mean(slope**2)), rel=1e-6)
    variance = np.maximum((TIMING * slope) ** 2, 0.02 * series.timing_noise**2)
    np.testing.assert_allclose(series.jitter_variance, variance, atol=1e-6 * series.timing_noise**2)
    white = series.whitener(Noise(series.timing_noise)).apply(np.ones(400))
    np.testing.assert_allclose(white, (variance + series.timing_noise**2) ** -0.5, rtol=1e-5)


def test_credible_sizes_follow_grade_of_accelerometer(tmp_path):
    of_qy = ('input_axis = "north"', 'input_axis = "north"\ngrade = "consumer"')
    campaign = read_campaign(write_description(tmp_path, replace_parts(SMALL, of_qy)))
    model = make_unknowns(campaign)
    for name, grade in (("Qx", "navigation"), ("Qy", "consumer")):
        unknowns = [u for u in model.unknowns if u.owner == name]
        perfect = [c for c in fixed_terms(campaign, model, name) if c.symbol in ACCELEROMETER_TERMS]
        assert {u.symbol for u in unknowns} >= {"K_F", "K_II", "K_III"}
        assert {c.symbol for c in perfect} >= {"K_OO", "delta_O"}
        for one in (*unknowns, *perfect):
            assert one.limit == term(one.symbol).sizes(grade).limit
        accelerometer = campaign.accelerometers[name]
        request = make_request(JointProblem(campaign), accelerometer, TwoStageOptions())
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
def test_force_in_g_or_current_depends_on_assumed_gravity(tmp_path, column, in_g):
    """Regression test: a current was treated as m/s^2, so u(g) was missing in u(K_I)."""
    old = 'displacement = { column = "east_m", unit = "m" }'
    output = 'output = { unit = "mA", sensitivity = "1.25 mA/g" }\n' if "uA" in column else ""
    campaign = read_campaign(
        write_description(tmp_path, replace_parts(SMALL, (old, output + column)))
    )
    assert campaign.accelerometers["Qx"].channel.in_g is in_g


def test_stamp_error_acts_through_slope_of_recorded_output():
    """After 400 s at 5 mg the platform moves at 20 m/s, five times the velocity of the harmonic."""
    motion = Trajectory(Spindle(math.pi / 2), RADIUS, Site(9.8, 0.8, earth_rate=0.0))
    time = np.arange(0.0, 400.0, 0.05)
    wave = 2e-3 * np.sin(motion.spindle.angle(time) + 0.3)
    series = ResidualSeries(
        accelerometer="Qx",
        run="run",
        trajectory=motion,
        mounting=QX,
        observable="displacement",
        attitude=LEVEL,
        time=time,
        time_sd=np.zeros(time.size),
        count=np.ones(time.size),
        spacing=0.05,
        error=0.5 * 0.049 * time**2 + wave,
    )
    arm = -RADIUS * math.pi / 2 * np.sin(motion.spindle.angle(time))
    own = 0.049 * time + 2e-3 * math.pi / 2 * np.cos(motion.spindle.angle(time) + 0.3)
    np.testing.assert_allclose(sum(series.slopes()), arm + own, atol=1e-6)


# The recorder's clock

ASKED = ["K_F", "K_I", "K_II"]
#: All terms except the clock.
ASSUMED = [
    symbol
    for symbol in (*ACCELEROMETER_TERMS, *SHARED_TERMS, *INPUTS)
    if symbol not in (*ASKED, "records.clock")
]
FORCE = f"""{PLACE}
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
specific_force = {{ column = "east", unit = "m/s^2" }}

[noise]
specific_force = "1e-4 m/s^2"

[model]
assume = {ASSUMED}
terms = {ASKED}
{format_runs("slow", "middle", "fast")}
[simulation]
sampling_rate = "20 Hz"
seed = 1
revolutions = 20

[truth.Qx]
K_F = "0.005 g"
K_I = "1.002 g/g"
K_II = "2.7e-5 g/g^2"

[truth.noise]
specific_force = "1e-4 m/s^2"
"""
CLOCK = ("[records]\n", '[records]\nclock = "{} ± 1e-7"\n')


def set_clock(size):
    return replace_parts(FORCE, (CLOCK[0], CLOCK[1].format(size)))


def set_recorder(text, more=""):
    own = f'name = "fast"\nrecords = {{ recorder = "B"{more} }}'
    return replace_parts(text, ('name = "fast"', own))


def record_with_clocks(folder, **clocks):
    """Simulate the campaign with an exact clock and return records with other clocks."""
    simulate(write_description(folder, FORCE, "plan.toml"), folder, overwrite=True)
    for name, fast in clocks.items():
        path = folder / f"{name}.csv"
        head = path.read_text(encoding="utf-8").splitlines()[0]
        rows = np.loadtxt(path, delimiter=",", skiprows=1)
        rows[:, head.split(",").index("time_s")] *= 1.0 + fast
        np.savetxt(path, rows, delimiter=",", header=head, comments="", fmt="%.12g")


def calibrate_description(folder, text):
    write_description(folder, text)
    result = calibrate(folder)
    return result, result.accelerometers["Qx"].coefficients


def test_stated_clock_error_is_corrected(tmp_path):
    """The relative error of K_I is twice the clock error (physics.md), and zero if stated."""
    fast = 1e-3
    record_with_clocks(tmp_path)
    _, right = calibrate_description(tmp_path, set_clock("0"))
    record_with_clocks(tmp_path, slow=fast, middle=fast, fast=fast)
    result, stated = calibrate_description(
        tmp_path, set_clock("1000 ppm").replace("ppm ± 1e-7", "± 0.1 ppm")
    )
    assert result.state == "good"
    for symbol, c in stated.items():
        assert abs(c.value - right[symbol].value) < 0.01 * c.u
    _, ignored = calibrate_description(tmp_path, set_clock("0"))
    off = ignored["K_I"].value - right["K_I"].value
    assert off == pytest.approx(2.0 * fast * 1.002, rel=2e-3)  # and its square


@pytest.mark.parametrize(
    "time",
    ['sampling_rate = "20 Hz"', 'column = "time_s"', 'column = "time_s", unit = "ms"'],
)
def test_clock_error_acts_for_all_time_formats(tmp_path, time):
    """Row numbers also follow a clock, whose unit may be in the file."""
    text = replace_parts(FORCE, ('column = "time_s", unit = "s"', time))
    right, fast = (
        read_campaign(
            write_description(tmp_path, text.replace(CLOCK[0], CLOCK[1].format(size)))
        ).time
        for size in ("0", "1e-3")
    )
    file = SimpleNamespace(path="f", units={"time_s": "ms"}, units_row=True)
    right, fast = (channel.resolve_unit(file).factor for channel in (right, fast))
    assert right / fast == pytest.approx(1.001, rel=1e-12)


def test_two_recorders_have_separate_clocks(tmp_path):
    """The error of 200 ppm belongs to one clock, and both clocks are in u."""
    record_with_clocks(tmp_path)
    _, right = calibrate_description(tmp_path, FORCE)
    record_with_clocks(tmp_path, fast=2e-4)
    description, _ = calibrate_description(tmp_path, FORCE)
    assert description.state == "contradicted"
    text = set_recorder(FORCE, ', clock = "0.0002 ± 1e-7"')
    result, two = calibrate_description(tmp_path, text)
    assert result.state == "good"
    clocks = {row.name: row for row in result.rests_on if row.name.endswith("records.clock")}
    assert clocks["records.clock"].kind == "unstated"
    assert clocks["B.records.clock"].kind == "stated"
    assert clocks["B.records.clock"].value == pytest.approx(2e-4)
    for symbol, c in two.items():
        assert abs(c.value - right[symbol].value) < 0.1 * right[symbol].u


def test_default_errors_of_two_clocks_are_independent_in_u(tmp_path):
    """With a clock per run, u(K_I) is below 2 x 2e-5, the value for a common clock.

    The noise is negligible, so the runs differ only by their clocks.
    """
    record_with_clocks(tmp_path)
    _, one = calibrate_description(tmp_path, FORCE)
    result, two = calibrate_description(tmp_path, set_recorder(FORCE))
    assert one["K_I"].u == pytest.approx(4e-5, rel=0.02)
    assert two["K_I"].u == pytest.approx(4e-5 / math.sqrt(2.0), rel=0.02)
    assert {row.name for row in result.rests_on} == {"records.clock", "B.records.clock"}


def test_wrongly_exact_clock_of_recorder_is_named(tmp_path):
    record_with_clocks(tmp_path, fast=2e-4)
    text = set_recorder(FORCE).replace("assume = [", "assume = ['records.clock', ")
    result, _ = calibrate_description(tmp_path, text)
    assert "B.records.clock" in {
        name for finding in result.findings for name in (finding.subject, *finding.as_well)
    }


CAMPAIGN = """schema = 1
site = {{ gravity = "9.8 m/s^2", latitude = "45 deg" }}
centrifuge = {{ radius = "2.5 m" }}
records = {{ time = {{ column = "t", unit = "s" }} }}
noise = {{ {noise} }}
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
displacement = {{ column = "x", unit = "m" }}
[[runs]]
name = "slow"
rate = "0.25 rev/s"
record = "run1.csv"
"""


@pytest.mark.parametrize(
    ("noise", "white", "walk"),
    [
        ('acceleration = "0 g/Hz^0.5"', ESTIMATE, 0.0),
        ('acceleration = "0 g/Hz^0.5", flicker = "0 ug"', ESTIMATE, 0.0),
        ('displacement = "0 m"', ESTIMATE, ESTIMATE),
        ('angle = "1e-6 rad"', ESTIMATE, ESTIMATE),
        ('displacement = "1 cm"', 0.01, 0.0),
    ],
)
def test_walk_stated_as_zero_is_not_estimated(tmp_path, noise, white, walk):
    """Unstated noise is estimated, except the walk that the description excludes."""
    (tmp_path / "campaign.toml").write_text(CAMPAIGN.format(noise=noise), encoding="utf-8")
    (of_qx,) = make_noise(read_campaign(tmp_path)).values()
    assert (of_qx.white, of_qx.random_walk) == (white, walk)
