"""Simulated readings against closed forms written out by hand, one error at a time."""

import math

import numpy as np
import pytest
from campaigns import write_and_read_campaign

from counterspin.simulation.readings import (
    head_errors,
    simulate_mean_record,
    true_machine,
    true_readings,
)

G, LATITUDE, OMEGA = 9.8, 0.8, 7.292115e-5
R = 1.25
K_F, K_I, K_II, K_III = 2e-3, 1.0005, 1.5e-5, 2e-6
HEAD = f"""schema = 1
site = {{ gravity = "{G} m/s^2", latitude = "{LATITUDE} rad" }}
[centrifuge]
radius = "{R} m"
reference_temperature = "20 degC"
[records]
time = {{ column = "t", unit = "s" }}
[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"
output = {{ unit = "V", sensitivity = "2 V/g" }}
specific_force = {{ column = "volts", unit = "mV" }}
[truth.A]
K_F = "{K_F} g"
K_I = "{K_I} g/g"
K_II = "{K_II} g/g^2"
K_III = "{K_III} g/g^3"
[truth.noise]
reading = "0 V"
"""
STATIC = """[[runs]]
name = "tumble"
motion = "static"
attitude = "30 deg about north"
temperature = "23 degC"
time = "100 s"
reading = "?"
"""
ARM = """[[runs]]
name = "in"
motion = "arm"
rate = "-6 rad/s"
mounting = "in"
axes = { input = "inward", pendulous = "forward" }
temperature = "18 degC"
time = "40 s"
reading = "?"
"""


def simulate_values(folder, text, head=HEAD):
    readings, _ = true_readings(write_and_read_campaign(folder, head + text))
    return [reading.value for reading in readings]


def cubic(a):
    return K_F + K_I * a + K_II * a**2 + K_III * a**3


#: Of the arm at -6 rad/s, without and with a relative change of the radius.
def inward(change=0.0):
    return R * (1.0 + change) * (36.0 - 12.0 * OMEGA * math.sin(LATITUDE)) / G


A_IN, A_REST = inward(), math.cos(math.radians(30.0))
S = 4e-9 * R * 36.0
MACHINE = {
    "nothing": ("", cubic(A_REST), cubic(A_IN)),
    "radius": ('"centrifuge.radius.in" = "1 mm"', cubic(A_REST), cubic(inward(1e-3 / R))),
    "radius as such": ('"centrifuge.radius.in" = "1.251 m"', None, cubic(inward(1e-3 / R))),
    "stretch": ('"centrifuge.stretch" = "4e-9 s^2/m"', None, cubic(inward(S))),
    # The outer end sinks: about forward, inward turns by the angle towards up.
    "droop": (
        '"centrifuge.droop" = "1e-6 rad s^2"',
        cubic(A_REST),
        cubic(A_IN * math.cos(36e-6) + math.sin(36e-6)),
    ),
    "misalignment": (
        '"fixture.misalignment.in.forward" = "1 mrad"',
        None,
        cubic(A_IN * math.cos(1e-3) + math.sin(1e-3)),
    ),
    "zero of the head": ('"head.zero" = "1 mrad"', cubic(math.cos(math.pi / 6 + 1e-3)), None),
    "K_F by temperature": (
        '[truth.A]\n"K_F.temperature" = "5e-6 g/K"',
        cubic(A_REST) + 3 * 5e-6,
        cubic(A_IN) - 2 * 5e-6,
    ),
    "K_I by temperature, in volts": (
        '[truth.A]\n"K_I.temperature" = "4e-4 V/g/K"',
        cubic(A_REST) + 3 * 2e-4 * A_REST,
        cubic(A_IN) - 2 * 2e-4 * A_IN,
    ),
    "K_II by temperature": (
        '[truth.A]\n"K_II.temperature" = "1e-7 g/g^2/K"',
        cubic(A_REST) + 3 * 1e-7 * A_REST**2,
        cubic(A_IN) - 2 * 1e-7 * A_IN**2,
    ),
    "K_F by the square of temperature": (
        '[truth.A]\n"K_F.temperature.2" = "5e-6 g/K^2"',
        cubic(A_REST) + 9 * 5e-6,
        cubic(A_IN) + 4 * 5e-6,
    ),
    "K_I by the cube of temperature, in volts": (
        '[truth.A]\n"K_I.temperature.3" = "4e-4 V/g/K^3"',
        cubic(A_REST) + 27 * 2e-4 * A_REST,
        cubic(A_IN) - 8 * 2e-4 * A_IN,
    ),
    "heating": (
        '[truth.A]\n"K_F.heating" = "1e-7 g/g^2"',
        None,
        cubic(A_IN) + 1e-7 * (R * 36 / G) ** 2,
    ),
    # Time counts from the first reading.
    "trend": ('[truth.A]\n"K_F.trend" = "1e-8 g/s"', cubic(A_REST) + 60e-8, cubic(A_IN)),
}


@pytest.mark.parametrize("name", MACHINE)
def test_machine_error_changes_readings_by_closed_form(tmp_path, name):
    line, at_rest, on_arm = MACHINE[name]
    if line.startswith("[truth.A]"):
        more, line = line.removeprefix("[truth.A]\n"), ""
    else:
        more = ""
    head = HEAD.replace("[truth.A]", f"[truth.A]\n{more}")
    tumble, arm = simulate_values(tmp_path, f"[truth.machine]\n{line}\n{STATIC}{ARM}", head)
    assert tumble == pytest.approx(at_rest or cubic(A_REST), rel=1e-13)
    # The mean of the vertical Coriolis force's square, through K_III and the turn of the axis, is
    # below 1e-12 g.
    assert arm == pytest.approx(on_arm or cubic(A_IN), rel=1e-11)


def test_head_error_is_shared_by_accelerometers_of_position(tmp_path):
    second = '[accelerometers.B]\ninput_axis = "up"\npendulous_axis = "west"\n'
    second += 'specific_force = { column = "other", unit = "g" }\n'
    run = STATIC.replace("30 deg", "30 ± 0.01 deg").replace('"?"', '{ A = "?", B = "?" }')
    runs = "".join(run.replace("tumble", f"{i}") for i in range(200))
    text = HEAD.replace("[truth.A]", f"{second}[truth.A]").replace(
        '"0 V"', '{ A = "0 V", B = "0 g" }'
    )
    readings, errors = true_readings(write_and_read_campaign(tmp_path, text + runs))
    a, b = errors[::2], errors[1::2]
    np.testing.assert_array_equal(a, b)
    assert abs(a.std() / math.radians(0.01) - 1.0) < 5.0 / 20.0
    expected = np.cos(math.pi / 6 + a)
    np.testing.assert_allclose([r.value for r in readings[1::2]], expected, rtol=1e-13)


def test_table_rows_with_same_name_are_separate_positions(tmp_path):
    campaign = write_and_read_campaign(tmp_path, HEAD + STATIC.replace("30 deg", "30 ± 0.01 deg"))
    (reading,) = campaign.readings
    first, second = head_errors([reading, reading], np.random.default_rng(1))
    assert first != second


def test_arm_record_has_harmonic_of_earth_rate(tmp_path):
    run = ARM.replace('reading = "?"', 'record = "in.csv"\nrevolutions = 10')
    run = run.replace('pendulous = "forward"', 'pendulous = "up"')
    text = HEAD + '[simulation]\nsampling_rate = "20 Hz"\n' + run
    text = text.replace(f'K_III = "{K_III} g/g^3"', 'K_IP = "1e-3 g/g^2"')
    campaign = write_and_read_campaign(tmp_path, text)
    time, angle, force = simulate_mean_record(campaign, campaign.readings[0], 0.0)
    assert time[-1] == pytest.approx(20 * math.pi / 6, abs=0.05)
    np.testing.assert_array_equal(angle, -6.0 * time)
    up = 1.0 + 2.0 * R * -6.0 * OMEGA * math.cos(LATITUDE) * np.sin(angle) / G
    expected = K_F + K_I * A_IN + K_II * A_IN**2 + 1e-3 * A_IN * up
    np.testing.assert_allclose(force / G, expected, rtol=1e-14)


SPINDLE = """[truth.spindle]
rate_error = 0.01
drift = "2e-4 1/s"
ripple = [{ harmonic = 2, ratio = 3e-3, phase = "40 deg" }]
start_angle = "20 deg"
"""
W0 = -6.0 * 1.01


def closed_forms(t):
    """Return angle, rate and acceleration of the spindle in closed form."""
    wave, phase = 2.0 * W0 * t + math.radians(40.0), math.radians(40.0)
    angle = math.radians(20.0) + W0 * (t + 1e-4 * t**2)
    angle -= 3e-3 / 2.0 * (np.cos(wave) - math.cos(phase))
    rate = W0 * (1.0 + 2e-4 * t + 3e-3 * np.sin(wave))
    return angle, rate, W0 * (2e-4 + 3e-3 * 2.0 * W0 * np.cos(wave))


def test_arm_record_follows_true_spindle(tmp_path):
    """Compare all three specific forces of the arm with the documented formula."""
    run = ARM.replace('reading = "?"', 'record = "in.csv"\nrevolutions = 10')
    run = run.replace('pendulous = "forward"', 'pendulous = "up"')
    text = HEAD.replace(
        "[accelerometers", 'angle = { column = "a", unit = "rad" }\n[accelerometers'
    )
    text += '[simulation]\nsampling_rate = "20 Hz"\n' + SPINDLE + run
    text = text.replace(f'K_III = "{K_III} g/g^3"', 'K_IP = "1e-3 g/g^2"\ndelta_P = "0.01 rad"\n')
    text += '[truth.records]\ntiming_offset = "3 ms"\n'
    text += '[truth.encoder]\nharmonic = { 1 = { sin = "1 mrad" } }\n'
    campaign = write_and_read_campaign(tmp_path, text)
    time, recorded, force = simulate_mean_record(campaign, campaign.readings[0], 0.0)
    later = closed_forms(time + 3e-3)[0]
    np.testing.assert_allclose(recorded, later + 1e-3 * np.sin(later), rtol=0, atol=1e-12)
    angle, w, alpha = closed_forms(time)
    inward = R * (w**2 + 2.0 * w * OMEGA * math.sin(LATITUDE)) / G
    up = 1.0 + 2.0 * R * w * OMEGA * math.cos(LATITUDE) * np.sin(angle) / G
    perfect = K_F + K_I * inward + K_II * inward**2 + 1e-3 * inward * up
    # delta_P turns the input axis towards the output axis or away from it, which is forward.
    across = (force / G - perfect) / (R * alpha / G)
    np.testing.assert_allclose(np.abs(across), 0.01, rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "rate"),
    [
        ("ripple = [{ ratio = 0.03 }]", lambda t: 6.0 * (1.0 + 0.03 * np.sin(6.0 * t))),
        ('drift = "1e-3 1/s"', lambda t: 6.0 * (1.0 + 1e-3 * t)),
        ("rate_error = 0.01", lambda t: np.full_like(t, 6.06)),
    ],
)
def test_arm_reading_uses_mean_square_of_true_rate(tmp_path, text, rate):
    """Use 20 revolutions, stated for all runs or for a single run."""
    run = ARM.replace('reading = "?"', 'reading = "?"\nrevolutions = 20')
    length = 20.0 * 2.0 * math.pi / 6.0
    t = (np.arange(200_000) + 0.5) * length / 200_000
    expected = indicate_force(-math.sqrt(np.mean(rate(t) ** 2)))
    common = f"[truth.spindle]\n{text}\n{run}"
    own = f"[truth.spindle]\nstart_angle = '5 deg'\n{run}truth = {{ {text} }}\n"
    for described in (common, own):
        assert simulate_values(tmp_path, described) == [pytest.approx(expected, rel=1e-9)]


def indicate_force(w):
    inward = R * (w**2 + 2.0 * w * OMEGA * math.sin(LATITUDE)) / G
    return K_F + K_I * inward + K_II * inward**2 + K_III * inward**3


# Positions that are set by hand

SET = '[fixture]\nposition = "0 ± 1 deg"\n'


def describe_face(name, attitude):
    return f'[[runs]]\nname = "{name}"\nmotion = "static"\nattitude = "{attitude}"\nreading = "?"\n'


def test_positioning_error_is_shared_within_position_only(tmp_path):
    level = "90 deg about north"
    first, again, upside = simulate_values(
        tmp_path,
        SET
        + describe_face("a", level)
        + describe_face("b", level)
        + describe_face("c", "-90 deg about north"),
    )
    assert first == again
    assert first != pytest.approx(simulate_values(tmp_path, describe_face("a", level))[0], abs=1e-4)
    # Were both turned by the same angle, their mean would be the bias and a square.
    assert 0.5 * (first + upside) != pytest.approx(K_F, abs=1e-4)


def test_positioning_error_rotates_instrument_about_axis(tmp_path):
    """A setting error about north turns an east-pointing input axis downwards."""
    true = (
        '[truth.machine]\n"fixture.position.1" = "0 rad"\n"fixture.position.1.north" = "0.01 rad"\n'
    )
    (indication,) = simulate_values(tmp_path, SET + true + describe_face("a", "90 deg about north"))
    a = -math.sin(0.01)
    assert indication == pytest.approx(K_F + K_I * a + K_II * a**2 + K_III * a**3, abs=1e-12)


def test_positioning_errors_have_stated_size(tmp_path):
    text = (
        HEAD
        + SET
        + "".join(describe_face(str(k), f"{3.6 * k} deg about north") for k in range(100))
    )
    drawn = [
        size
        for symbol, size in true_machine(write_and_read_campaign(tmp_path, text)).items()
        if "position" in symbol
    ]
    assert len(drawn) == 200
    # Four standard deviations of the estimate of so many.
    assert np.std(drawn) == pytest.approx(math.radians(1.0), rel=4.0 / math.sqrt(2 * 200))
