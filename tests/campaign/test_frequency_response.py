"""Stated frequency responses: keys, tables and errors."""

import math

import pytest

import counterspin as cs
from counterspin.calibration.model import inputs_by_owner
from counterspin.errors import CampaignError

BASE = """schema = 1
[site]
gravity = "9.8 m/s^2"
latitude = "45 deg"
[centrifuge]
radius = "2.5 m"
[records]
time = { column = "t", unit = "s" }
RECORDER
[accelerometers.Q]
input_axis = "east"
pendulous_axis = "down"
velocity = { column = "v", unit = "m/s" }
RESPONSE
[[runs]]
name = "fast"
rate = "1 rev/s"
record = "fast.csv"
"""

TABLE = (
    "frequency_Hz,gain,phase_deg,u_gain,u_phase_deg\n"
    "1,0.9999,-0.3,1e-5,0.01\n"
    "5,0.9975,-1.5,2e-5,0.05\n"
)


def make_response_campaign(folder, response="", recorder="", table=None):
    if table is not None:
        (folder / "response.csv").write_text(table)
    text = BASE.replace("RESPONSE", response).replace("RECORDER", recorder)
    (folder / "campaign.toml").write_text(text)
    return cs.read_campaign(folder)


def test_unstated_response_has_no_default(tmp_path):
    described = make_response_campaign(tmp_path)
    assert described.accelerometers["Q"].mounting.response is None
    assert not any("sensor" in symbol for _, symbol in inputs_by_owner(described))


def test_stated_response_has_inputs_with_uncertainty(tmp_path):
    described = make_response_campaign(
        tmp_path,
        'natural_frequency = "400 ± 20 Hz"\ndamping = "0.7 ± 0.1"',
        'cutoff_frequency = "100 ± 5 Hz"',
    )
    response = described.accelerometers["Q"].mounting.response
    assert (response.natural_frequency, response.damping) == (400.0, 0.7)
    assert response.cutoff_frequency == 100.0
    inputs = inputs_by_owner(described)
    assert inputs["Q", "sensor.natural_frequency"].u == 20.0
    assert inputs["Q", "sensor.damping"].u == 0.1
    assert inputs["", "records.cutoff_frequency"].u == 5.0


def test_table_is_read_with_checksum(tmp_path):
    described = make_response_campaign(tmp_path, 'frequency_response = "response.csv"', table=TABLE)
    table = described.accelerometers["Q"].mounting.response.table
    assert table.gain == (0.9999, 0.9975)
    assert table.phase[0] == pytest.approx(math.radians(-0.3))
    assert table.u_phase[1] == pytest.approx(math.radians(0.05))
    assert [file.name for file in described.table_checksums] == ["response.csv"]
    assert {s for _, s in inputs_by_owner(described)} >= {"sensor.gain", "sensor.phase"}


@pytest.mark.parametrize(
    ("response", "recorder", "table", "words"),
    [
        ('natural_frequency = "400 Hz"', "", None, "natural_frequency: requires damping as well"),
        ('damping = "0.7"', "", None, "damping: requires natural_frequency as well"),
        (
            'natural_frequency = "15 Hz"\ndamping = "1"',
            "",
            None,
            "below 20 times the highest rotation rate",
        ),
        ("", 'cutoff_frequency = "5 Hz"', None, "5 Hz is below 20 times"),
        ('frequency_response = "response.csv"', "", "frequency_Hz,gain\n1,1\n", "no column phase"),
        (
            'frequency_response = "response.csv"',
            "",
            TABLE.replace("0.9999", "-0.3"),
            r"gain must be a positive ratio to the static gain \(not dB\)",
        ),
        (
            'frequency_response = "response.csv"',
            "",
            TABLE.replace("0.9999", "x"),
            "response.csv, line 2: gain is not a number",
        ),
        (
            'frequency_response = "response.csv"',
            "",
            "frequency_Hz,gain,phase_deg\n0.1,1,0\n0.5,1,0\n",
            "ends at 0.5 Hz, which is below the highest rotation rate, 1 rev/s",
        ),
        (
            'frequency_response = "response.csv"\nnatural_frequency = "400 Hz"\ndamping = "0.7"',
            "",
            TABLE,
            "cannot be combined with natural_frequency; keep one",
        ),
    ],
)
def test_rejects_invalid_response(tmp_path, response, recorder, table, words):
    with pytest.raises(CampaignError, match=words):
        make_response_campaign(tmp_path, response, recorder, table)
