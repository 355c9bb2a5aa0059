"""Rows of a table that are converted as columns equal rows that pass the model one by one."""

from dataclasses import fields

import numpy as np
import pytest
from reading_descriptions import ACCELEROMETER, format_site

import triads
from counterspin.campaign.description import read_campaign
from counterspin.errors import CampaignError
from counterspin.physics.accelerometer import Mounting

HEAD = format_site("1.0 m") + ACCELEROMETER
TUMBLE = """[readings]
file = "r.csv"
columns = { name = "p", attitude = "angle", temperature = "T", time = "t", reading = "mA", u = "u" }
about = "north"
u_attitude = "2 arcsec"
"""
ARM = """[readings]
file = "r.csv"
motion = "arm"
axes = { input = "inward", pendulous = "up" }
axes_at_rest = { input = "up", pendulous = "outward" }
columns = { rate = "rate", u_rate = "u_rate", reading = "mA" }
"""
VIBRATION = """[readings]
file = "r.csv"
motion = "vibration"
attitude_unit = "arcmin"
columns = { amplitude = "g", attitude = "angle", reading = "mA" }
"""


def read(folder, section, rows, head=HEAD):
    (folder / "r.csv").write_text("\n".join(rows), encoding="utf-8")
    (folder / "campaign.toml").write_text(head + section, encoding="utf-8")
    return read_campaign(folder)


def rounded_fields(reading):
    """Return the fields of a reading, numbers to 15 digits, without the number of its row."""

    def round_value(value):
        if isinstance(value, Mounting):
            return tuple(tuple(np.round(axis, 15) + 0.0) for axis in value.axes), value.response
        if isinstance(value, str) and value.startswith("reading "):
            return ""
        return f"{value:.15g}" if isinstance(value, float) else value

    return {part.name: round_value(getattr(reading, part.name)) for part in fields(reading)}


@pytest.mark.parametrize(
    ("section", "header", "rows"),
    [
        (TUMBLE, "p,angle,T,t,mA,u", ["a,0,23,0,1.25,1e-6", "b,90,23.5,60,0,1e-6"]),
        (TUMBLE, "p,angle,T,t,mA,u", ["a,30.5,23,9,1.2,1e-6", "b,-123,24,60,-0.3,2e-6"]),
        (TUMBLE, "p,angle,T,t,mA,u", ["a,30.5,,9,1.2,", "b,-123,,60,-0.30125,", "c,1,,61,7e-4,"]),
        (ARM, "rate,u_rate,mA", ["1.5,1e-6,0.31", "2.5,2e-6,0.9", "0,1e-6,1.25", "-3,1e-6,1.2"]),
        (VIBRATION, "g,angle,mA", ["1,600,1.25", "1,5400,0.1", "2,5400,0.2", "1,90,0.3"]),
    ],
)
def test_rows_together_equal_single_rows(tmp_path, section, header, rows):
    together = read(tmp_path, section, [header, *rows]).readings
    assert len(together) == len(rows)
    for row, reading in zip(rows, together, strict=True):
        (alone,) = read(tmp_path, section, [header, row]).readings
        assert rounded_fields(reading) == rounded_fields(alone)


def test_poses_together_equal_single_poses(tmp_path):
    section = """[readings]
file = "r.csv"
attitude = "unknown"
columns = { reading = { X = "x", Y = "y", Z = "z" } }
"""
    rows = ["0.1,-0.2,0.97", "-0.6,0.25,0.75", "0.3,0.8,-0.5"]
    poses = read(tmp_path, section, ["x,y,z", *rows], triads.format_description()).triad.poses
    assert len(poses) == 3
    for row, pose in zip(rows, poses, strict=True):
        (alone,) = read(tmp_path, section, ["x,y,z", row], triads.format_description()).triad.poses
        assert list(map(rounded_fields, pose)) == list(map(rounded_fields, alone))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("c,30,23,60,1e80,1e-6", "readings.\"r.csv line 4\".reading.A: '1e+80 ± 1e-06 mA' is"),
        ("c,30,23,60,1.2,-1e-6", "readings.\"r.csv line 4\".reading.A: '1.2 ± -1e-06 mA' has"),
        ("c,1e12,23,60,1.2,1e-6", 'readings."r.csv line 4".attitude: '),
        ("c,30,2300,60,1.2,1e-6", 'readings."r.csv line 4".temperature: 2300 degC is not'),
        ("c,30,23,1e14,1.2,1e-6", 'readings."r.csv line 4".time: '),
    ],
)
def test_row_outside_limits_raises_with_line(tmp_path, row, message):
    good = ["a,10,23,0,1.2,1e-6", "b,20,23,30,1.2,1e-6", "d,20,23,30,1.2,1e-6"]
    with pytest.raises(CampaignError) as caught:
        read(tmp_path, TUMBLE, ["p,angle,T,t,mA,u", *good[:2], row, good[2]])
    (problem,) = caught.value.problems
    assert problem.startswith(message)
