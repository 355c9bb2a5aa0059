"""Inputs that are not what the description states: what records and readings then are."""

import math

import numpy as np
import pytest
from campaigns import SMALL, remove_table, replace_parts, write_and_read_campaign

from counterspin.errors import CampaignError
from counterspin.simulation.simulate import simulate, simulate_run

SILENT = replace_parts(
    remove_table(SMALL, "truth.noise"), ('[noise]\ndisplacement = "0.01 m"', "[noise]")
)
#: A steady spindle, so that closed forms hold.
STEADY = remove_table(SILENT, "truth.spindle")
TWO = replace_parts(
    STEADY,
    ('record = "slow.csv"', 'record = "slow.csv"\nrecords = { recorder = "B" }'),
    ("[records]", '[records]\nrecorder = "A"'),
)


def simulate_columns(folder, text, run=0):
    campaign = write_and_read_campaign(folder, text)
    return simulate_run(campaign, campaign.runs[run], np.random.default_rng(0))


def add_truth(table, text=STEADY):
    return f"{text}\n{table}\n"


def test_displacement_uses_true_radius_and_gravity(tmp_path):
    table = '[truth.centrifuge]\nradius = "2.501 m"\n[truth.site]\ngravity = "9.81 m/s^2"'
    bias = [("K_III = ", "# K_III = "), ("2.7e-5 g", "0 g"), ('K_I = "1.002 g/g"', "")]
    columns = simulate_columns(tmp_path, replace_parts(add_truth(table), *bias), run=1)
    t = columns["time_s"]
    start = 0.02 - 1e-3 * t
    expected = start + 2.501 * np.cos(math.pi * t) + 0.005 * 9.81 * t**2 / 2.0
    np.testing.assert_allclose(columns["east_m"], expected, rtol=0.0, atol=1e-10)


def test_delayed_angle_is_angle_of_later_time(tmp_path):
    columns = simulate_columns(
        tmp_path, add_truth('[truth.records]\ntiming_offset = "1e-3 s"'), run=2
    )
    expected = 2.0 * math.pi * (columns["time_s"] + 1e-3)
    np.testing.assert_allclose(columns["angle_rad"], expected, rtol=0.0, atol=1e-12)


def test_true_responses_delay_record(tmp_path):
    """Well below their natural frequencies, the delays are zeta/(pi f0) and 1/(2 pi fc)."""
    stated = replace_parts(STEADY, ("[accelerometers.Qx]\n", "[accelerometers.Qx]\nDAMPED"))
    stated = stated.replace("DAMPED", 'natural_frequency = "600 Hz"\ndamping = "0.5"\n')
    table = '[truth.records]\ncutoff_frequency = "200 Hz"'
    true = replace_parts(stated, ("[truth.Qx]\n", '[truth.Qx]\nnatural_frequency = "500 Hz"\n'))
    columns = simulate_columns(tmp_path, add_truth(table, true), run=2)
    t = columns["time_s"]
    waves = np.column_stack([np.cos(2.0 * math.pi * t), np.sin(2.0 * math.pi * t)])
    both = np.column_stack([waves, np.vander(t, 3), waves**2, waves**3])
    cosine, sine = np.linalg.lstsq(both, columns["east_m"], rcond=None)[0][:2]
    expected = 2.0 * math.pi * (0.5 / (math.pi * 500.0) + 1.0 / (2.0 * math.pi * 200.0))
    assert math.atan2(sine, cosine) == pytest.approx(expected, rel=1e-3)


def test_recorders_use_separate_clocks(tmp_path):
    table = '[truth.records]\nclock = { A = "20 ppm", B = "-5 ppm" }'
    for run, fast in ((0, -5e-6), (1, 2e-5)):
        columns = simulate_columns(tmp_path, add_truth(table, TWO), run)
        true = np.arange(columns["time_s"].size) / 20.0
        np.testing.assert_allclose(columns["time_s"], true * (1.0 + fast), rtol=1e-15)
        rate = (0.5 + 0.5 * run) * math.pi
        np.testing.assert_allclose(columns["angle_rad"], rate * true, rtol=1e-14, atol=1e-12)


def test_stated_clock_is_default_true_clock(tmp_path):
    stated = replace_parts(STEADY, ("[records]", '[records]\nclock = "12 ± 0.5 ppm"'))
    columns = simulate_columns(tmp_path, stated)
    true = np.arange(columns["time_s"].size) / 20.0
    np.testing.assert_allclose(columns["time_s"], true * (1.0 + 1.2e-5), rtol=1e-15)
    other = simulate_columns(tmp_path, add_truth('[truth.records]\nclock = "-3 ppm"', stated))
    np.testing.assert_allclose(other["time_s"], true * (1.0 - 3e-6), rtol=1e-15)


def test_record_in_g_uses_true_gravity(tmp_path):
    force = replace_parts(
        STEADY,
        ('displacement = { column = "east_m", unit = "m" }', ""),
        (
            'pendulous_axis = "down"\nscale_factor = "1.002 g/g"',
            'pendulous_axis = "south"\nspecific_force = { column = "up_g", unit = "g" }',
        ),
        ('input_axis = "east"', 'input_axis = "up"'),
        ('K_I = "1.002 g/g"\n', ""),
        ('K_II = "2.7e-5 g/g^2"\nK_III = "3e-6 g/g^3"\n', ""),
        ('start_velocity = "-1e-3 m/s"', ""),
    )
    texts = {"stated": force, "true": add_truth('[truth.site]\ngravity = "9.82 m/s^2"', force)}
    up_gs = {name: simulate_columns(tmp_path / name, text)["up_g"] for name, text in texts.items()}
    # The mean Coriolis force of whole revolutions is zero.
    for values in up_gs.values():
        assert values[:-1].mean() == pytest.approx(1.005, abs=1e-12)


ARM = """
schema = 1
[site]
gravity = "9.8066 m/s^2"
latitude = "0 deg"
[centrifuge]
radius = "1 m"
[accelerometers.X]
input_axis = "up"
pendulous_axis = "east"
[simulation]
[truth.X]
[[runs]]
name = "a"
motion = "arm"
axes = { input = "inward", pendulous = "down" }
rate = "10 rad/s"
reading = "10 ± 1e-12 UNIT"
"""


@pytest.mark.parametrize(("unit", "per_g"), [("g", 1.0), ("m/s^2", 9.82)])
def test_arm_reading_uses_true_radius_and_gravity(tmp_path, unit, per_g):
    table = '[truth.site]\ngravity = "9.82 m/s^2"\n[truth.centrifuge]\nradius = "1.001 m"'
    text = ARM.replace("UNIT", unit)
    (tmp_path / "true").mkdir()
    read = {}
    for name, one in (("stated", text), ("true", add_truth(table, text))):
        campaign = simulate(write_and_read_campaign(tmp_path / name, one))
        read[name] = campaign.readings[0].value
    # The file has the accelerometer's g; in m/s^2 it is read with the gravity that is stated.
    assert read["stated"] == pytest.approx(100.0 / 9.8066, rel=1e-11)
    expected = 100.1 / 9.82 * (per_g / 9.8066 if unit != "g" else 1.0)
    assert read["true"] == pytest.approx(expected, rel=1e-11)


def test_invalid_true_input_raises_once(tmp_path):
    tables = (
        '[truth.centrifuge]\nradius = "-1 m"\n[truth.site]\nlatitude = "95 deg"\n'
        '[truth.records]\nclock = { B = "5 ppm" }'
    )
    with pytest.raises(CampaignError) as error:
        write_and_read_campaign(tmp_path, add_truth(tables))
    words = str(error.value)
    assert words.count("truth.centrifuge.radius: must be greater than zero") == 1
    assert words.count("truth.site.latitude") == 1
    assert (
        'truth.records.clock.B: no run uses this recorder; write recorder = "B" in [records]'
        in (words)
    )


def test_columns_of_other_recorder_are_written_as_read(tmp_path):
    other = 'records = { recorder = "B", time = { column = "t", unit = "ms" } }'
    own = replace_parts(STEADY, ('record = "slow.csv"', f'record = "slow.csv"\n{other}'))
    columns = simulate_columns(tmp_path, own)
    assert columns["t"][-1] == pytest.approx(1000.0 * 80.0)
    files = simulate(write_and_read_campaign(tmp_path, own), tmp_path / "out")
    assert files[0].read_text().startswith("t,angle_rad,east_m,north_m")
