"""From exports to a description: what is guessed, and what is asked."""

import numpy as np
import polars as pl
import pytest

from counterspin.campaign.description import read_campaign
from counterspin.errors import CampaignError, CounterspinError
from counterspin.exports.description import described, draft, write_description

TIME = np.arange(1500) * 0.02
ANSWERS = {"gravity": "9.8066 m/s^2", "latitude": "45.75 deg", "radius": "2.5 m"}


def record(path, rate, columns):
    """Write a run that begins at 30 deg, seen by `columns` of the true angle."""
    theta = np.radians(30) + rate * TIME
    pl.DataFrame({"t_s": TIME, **columns(theta)}).write_csv(path)
    return path


def axes(theta):
    return {"east_m": 2.5 * np.cos(theta), "north_m": 2.5 * np.sin(theta)}


@pytest.mark.parametrize("rate", [np.pi, -np.pi])
@pytest.mark.parametrize("sense", [1, -1])
def test_two_axes_show_sense_and_zero_of_the_encoder(tmp_path, rate, sense):
    def columns(theta):
        azimuth = np.degrees(sense * (theta - np.radians(90))) % 360
        return {"azimuth": azimuth, **axes(theta)}

    found = draft([record(tmp_path / "a b.csv", rate, columns)])
    assert [q.key for q in found.questions] == ["gravity", "latitude", "radius"]
    write_description(found, ANSWERS, tmp_path)
    campaign = read_campaign(tmp_path)
    assert campaign.angle.factor == pytest.approx(sense * np.radians(1))
    assert campaign.angle.offset == pytest.approx(np.pi / 2)
    (run,) = campaign.runs
    assert (run.name, run.rate) == ("a_b", pytest.approx(rate, rel=1e-12))
    assert run.record == tmp_path / "a b.csv"
    assert set(campaign.accelerometers) == {"Qx", "Qy"}


def test_an_odd_zero_is_stated_in_degrees(tmp_path):
    def columns(theta):
        return {"angle_deg": np.degrees(theta) - 12.5, **axes(theta)}

    found = draft([record(tmp_path / "a.csv", np.pi, columns)])
    angle = described(found, ANSWERS, tmp_path)["records"]["angle"]
    assert angle == {"column": "angle_deg", "unit": "deg", "zero": "12.5000 deg"}


def test_velocities_are_ahead_of_displacements(tmp_path):
    def columns(theta):
        east, north = -2.5 * -np.pi * np.sin(theta), 2.5 * -np.pi * np.cos(theta)
        return {"angle_rad": theta, "east [m/s]": east, "north [m/s]": north}

    found = draft([record(tmp_path / "a.csv", -np.pi, columns)])
    document = described(found, ANSWERS, tmp_path)
    assert "zero" not in document["records"]["angle"]
    assert document["runs"][0]["rate"] == "-0.5 rev/s"
    assert document["accelerometers"]["Qx"]["velocity"] == {"column": "east [m/s]", "unit": "m/s"}


def test_what_files_do_not_say_is_asked(tmp_path):
    path = record(tmp_path / "a.csv", np.pi, lambda th: {"p": 2.5 * np.cos(th), "enc": 31415 * th})
    found = draft([path])
    keys = [question.key for question in found.questions]
    asked = ["gravity", "latitude", "radius", "per_revolution", "sense", "p is", "p unit", "p axis"]
    assert keys == asked
    with pytest.raises(CampaignError) as caught:
        described(found, ANSWERS | {"sense": "left", "nonsense": "1"}, tmp_path)
    told = [line.partition(":")[0] for line in caught.value.problems]
    assert told == ["per_revolution", "p is", "p unit", "p axis", "sense", "nonsense"]
    more = {"per_revolution": "197386.9", "sense": "clockwise", "p is": "displacement"}
    more |= {"p unit": "m", "p axis": "north"}
    document = described(found, ANSWERS | more, tmp_path / "there")
    assert document["records"]["angle"]["per_revolution"] == 197386.9
    assert document["accelerometers"]["Qy"]["input_axis"] == "north"
    assert document["runs"][0]["record"] == str(path)


def test_nothing_is_written_over_or_of_a_wrong_answer(tmp_path):
    found = draft([record(tmp_path / "a.csv", np.pi, lambda th: {"angle_rad": th, **axes(th)})])
    with pytest.raises(CampaignError, match=r"centrifuge.radius: '2.5' has no unit"):
        write_description(found, ANSWERS | {"radius": "2.5"}, tmp_path)
    (tmp_path / "campaign.toml").write_text("mine")
    with pytest.raises(CounterspinError, match=r"campaign.toml exists"):
        write_description(found, ANSWERS, tmp_path)
    assert (tmp_path / "campaign.toml").read_text() == "mine"
    with pytest.raises(CampaignError, match="name the files"):
        draft([])
