"""Readings in a campaign: both ways to write them give the same; each slip is one message."""

import math

import numpy as np
import polars as pl
import pytest

from counterspin.campaign.description import read_campaign
from counterspin.errors import CampaignError

HEAD = """schema = 1
site = { gravity = "9.8 m/s^2", latitude = "45 deg" }
[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"
output = { unit = "mA", sensitivity = "1.25 mA/g" }
"""
ARM = """[centrifuge]
radius = "1.0 ± 1e-3 m"
"""
RUN = """[[runs]]
name = "tumble 30"
motion = "static"
attitude = "30 ± 0.001 deg about north"
reading = "1.082532 ± 2e-6 mA"
"""
ON_ARM = """[[runs]]
name = "in"
motion = "arm"
rate = "9.9 rad/s"
mounting = "in"
axes = { input = "inward", pendulous = "up" }
reading = "12.5 ± 2e-6 mA"
temperature = "23.4 degC"
"""


def read(folder, text):
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return read_campaign(folder)


def problems(folder, text):
    with pytest.raises(CampaignError) as caught:
        read(folder, text)
    return caught.value.problems


def test_a_run_with_a_reading(tmp_path):
    (reading,) = read(tmp_path, HEAD + RUN).readings
    assert reading.value == pytest.approx(1.082532 / 1.25)
    assert reading.u == pytest.approx(2e-6 / 1.25)
    assert reading.u_head == pytest.approx(math.radians(0.001))
    assert reading.head == (0.0, 1.0, 0.0)
    # About north, up turns towards east.
    np.testing.assert_allclose(reading.axes.axes[0], [0.5, 0.0, math.sqrt(0.75)], atol=1e-12)


def test_a_run_on_the_arm(tmp_path):
    reading = read(tmp_path, HEAD + ARM + RUN + ON_ARM).readings[1]
    assert (reading.motion, reading.rate, reading.mounting) == ("arm", 9.9, "in")
    assert reading.axes.axes[:2] == ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert reading.temperature == pytest.approx(296.55)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_table_says_the_same_as_runs(tmp_path, suffix):
    frame = pl.DataFrame({"p": ["tumble 30"], "deg": [30], "mA": [1.082532], "u": [2e-6]})
    if suffix == ".csv":
        frame.write_csv(tmp_path / "readings.csv")
    else:
        frame.write_parquet(tmp_path / "readings.parquet")
    table = f"""[readings]
file = "readings{suffix}"
columns = {{ name = "p", attitude = "deg", reading = "mA", u = "u" }}
"""
    (reading,) = read(tmp_path, HEAD + table).readings
    (written,) = read(tmp_path, HEAD + RUN.replace(" ± 0.001", "")).readings
    assert reading == written


def test_a_reading_without_its_uncertainty_has_none(tmp_path):
    (reading,) = read(tmp_path, HEAD + RUN.replace(" ± 2e-6", "")).readings
    assert reading.u is None


SLIPS = {
    "a static run with a rate": (
        HEAD + RUN + 'rate = "1 rad/s"\n',
        "runs[0].rate: a static run does not turn",
    ),
    "an arm without a rate": (
        HEAD + ARM + ON_ARM.replace('rate = "9.9 rad/s"\n', ""),
        "runs[0].rate: is missing",
    ),
    "an arm without axes": (
        HEAD + ARM + ON_ARM.replace("axes", "# axes"),
        "runs[0]: on an arm the axes follow from no attitude",
    ),
    "another unit": (
        HEAD + RUN.replace("2e-6 mA", "2e-6 V"),
        "runs[0].reading: 'V' is not a unit of quantity in mA",
    ),
    "a sensitivity of another unit": (
        HEAD.replace("1.25 mA/g", "1.25 V/g") + RUN,
        "accelerometers.A.output.sensitivity:",
    ),
    "no centrifuge": (HEAD + ON_ARM, "centrifuge: is missing"),
    "no reading": (
        HEAD + RUN.replace("reading =", "# reading ="),
        "runs[0]: give one of reading and record",
    ),
    "a direction of another frame": (
        HEAD + ARM + ON_ARM.replace("inward", "east"),
        'runs[0]: no direction is called "east" here',
    ),
    "no such file": (
        HEAD + '[readings]\nfile = "none.csv"\ncolumns = { reading = "mA" }\n',
        "readings.file: none.csv cannot be read",
    ),
    "a term that no reading shows": (
        HEAD + '[model]\nterms = ["K_F", "centrifuge.droop"]\n' + RUN,
        'no reading shows "centrifuge.droop"',
    ),
    "a mounting that is not there": (
        HEAD + ARM + '[model]\nterms = ["K_F", "centrifuge.radius.inn"]\n' + ON_ARM,
        'did you mean "centrifuge.radius.in"?',
    ),
    "considered without a prior": (
        HEAD + '[model]\nterms = ["K_F"]\nconsidered = ["head.zero"]\n' + RUN,
        '"head.zero" is considered, but there is no prior for it',
    ),
    "no temperature": (
        HEAD + RUN + 'temperature = "warm"\n',
        "runs[0].temperature: 'warm' is not a temperature",
    ),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_each_slip_is_told_with_its_key(tmp_path, slip):
    text, message = SLIPS[slip]
    assert any(message in line for line in problems(tmp_path, text)), problems(tmp_path, text)


def test_a_table_without_a_named_column_is_told(tmp_path):
    (tmp_path / "r.csv").write_text("angle,mA\n0,1.25\n", encoding="utf-8")
    text = HEAD + '[readings]\nfile = "r.csv"\ncolumns = { attitude = "angel", reading = "mA" }\n'
    (line,) = problems(tmp_path, text)
    assert 'r.csv has no column "angel"; did you mean "angle"?' in line


def test_an_empty_cell_is_told_with_its_row(tmp_path):
    (tmp_path / "r.csv").write_text("angle,mA\n0,1.25\n30,\n", encoding="utf-8")
    text = HEAD + '[readings]\nfile = "r.csv"\ncolumns = { attitude = "angle", reading = "mA" }\n'
    (line,) = problems(tmp_path, text)
    assert line.startswith('readings."r.csv row 2".reading.A:')
