"""From exports to a description: what is guessed, and what is asked."""

import numpy as np
import polars as pl
import pytest
from raising import raises
from scipy.io import savemat
from workbooks import write_workbook

from counterspin.calibration.observed_runs import observe_runs
from counterspin.campaign.description import read_campaign
from counterspin.errors import CampaignError, CounterspinError
from counterspin.ingest.contents import read_files
from counterspin.ingest.description import make_turntable_draft, write_description

TIME = np.arange(1500) * 0.02
ANSWERS = {"gravity": "9.8066 m/s^2", "latitude": "45.75 deg", "radius": "2.5 m"}


def write_run(path, rate, columns):
    """Write a run that begins at 30 deg, seen by `columns` of the true angle."""
    theta = np.radians(30) + rate * TIME
    pl.DataFrame({"t_s": TIME, **columns(theta)}).write_csv(path)
    return path


def make_record_draft(files, **answers):
    return make_turntable_draft(read_files(files), ANSWERS | answers)


def axes(theta):
    return {"east_m": 2.5 * np.cos(theta), "north_m": 2.5 * np.sin(theta)}


@pytest.mark.parametrize("rate", [np.pi, -np.pi])
@pytest.mark.parametrize("sense", [1, -1])
def test_two_axes_determine_sense_and_zero_of_encoder(tmp_path, rate, sense):
    def columns(theta):
        azimuth = np.degrees(sense * (theta - np.radians(90))) % 360
        return {"azimuth": azimuth, **axes(theta)}

    files = [write_run(tmp_path / "a b.csv", rate, columns)]
    turntable_draft = make_turntable_draft(read_files(files))
    assert [q.key for q in turntable_draft.open_questions] == ["gravity", "latitude", "radius"]
    write_description(make_record_draft(files), tmp_path)
    campaign = read_campaign(tmp_path)
    assert campaign.angle.factor == pytest.approx(sense * np.radians(1))
    assert campaign.angle.offset == pytest.approx(np.pi / 2)
    (run,) = campaign.runs
    assert (run.name, run.rate) == ("a_b", pytest.approx(rate, rel=1e-12))
    assert run.record == tmp_path / "a b.csv"
    assert set(campaign.accelerometers) == {"Qx", "Qy"}


def test_oblique_zero_is_stated_in_degrees(tmp_path):
    def columns(theta):
        return {"angle_deg": np.degrees(theta) - 12.5, **axes(theta)}

    files = [write_run(tmp_path / "a.csv", np.pi, columns)]
    angle = make_record_draft(files).make_document(tmp_path)["records"]["angle"]
    assert angle == {"column": "angle_deg", "unit": "deg", "zero": "12.5000 deg"}


def test_velocity_phase_determines_sense(tmp_path):
    def columns(theta):
        east, north = -2.5 * -np.pi * np.sin(theta), 2.5 * -np.pi * np.cos(theta)
        return {"angle_rad": theta, "east [m/s]": east, "north [m/s]": north}

    files = [write_run(tmp_path / "a.csv", -np.pi, columns)]
    document = make_record_draft(files).make_document(tmp_path)
    assert "zero" not in document["records"]["angle"]
    assert document["runs"][0]["rate"] == "-0.5 rev/s"
    assert document["accelerometers"]["Qx"]["velocity"] == {"column": "east [m/s]", "unit": "m/s"}


def test_missing_information_is_asked(tmp_path):
    path = write_run(
        tmp_path / "a.csv", np.pi, lambda th: {"p": 2.5 * np.cos(th), "enc": 31415 * th}
    )
    keys = [question.key for question in make_turntable_draft(read_files([path])).open_questions]
    texts = ["gravity", "latitude", "radius", "per_revolution", "sense", "p is", "p unit", "p axis"]
    assert keys == texts
    with pytest.raises(CampaignError) as caught:
        make_record_draft([path], sense="left", nonsense="1").make_document(tmp_path)
    requested_keys = [line.partition(":")[0] for line in caught.value.problems]
    assert requested_keys == ["per_revolution", "p is", "p unit", "p axis", "sense", "nonsense"]
    more = {"per_revolution": "197386,9", "sense": "cw", "p is": "Weg", "p axis": "North"}
    document = make_record_draft([path], **more, **{"p unit": "m"}).make_document(
        tmp_path / "there"
    )
    assert document["records"]["angle"]["per_revolution"] == 197386.9
    assert document["records"]["angle"]["sense"] == "clockwise"
    assert document["accelerometers"]["Qy"]["input_axis"] == "north"
    assert document["runs"][0]["record"] == "../a.csv"


def test_answers_override_guesses(tmp_path):
    def columns(theta):
        return {"phi": np.degrees(theta), **axes(theta), "temp_m": np.cos(theta)}

    files = [write_run(tmp_path / "a.csv", np.pi, columns)]
    assert make_turntable_draft(read_files(files)).common_guess.angle.column == "phi"
    record_draft = make_record_draft(
        files, **{"temp_m is": "unused", "east_m axis": "W", "north_m is": "ignore"}, sense="ccw"
    )
    document = record_draft.make_document(tmp_path)
    assert list(document["accelerometers"]) == ["Qx"]
    assert document["accelerometers"]["Qx"]["input_axis"] == "west"
    assert document["records"]["angle"]["zero"] == "west"
    alone = make_record_draft(files, angle="none", rate="30 deg/s", **{"temp_m is": "unused"})
    assert alone.problems == ("rate: not one of the questions: gravity, latitude, radius, sense",)


def test_answered_unit_determines_rate_of_runs(tmp_path):
    """Without waves in the signals, the counts of the angle determine the rate of each run."""
    paths = []
    for name, rate in (("a", 0.5), ("b", -1.0)):
        frame = {"t_s": TIME, "enc": 1e3 * rate * TIME, "p": 0.0 * TIME}
        pl.DataFrame(frame).write_csv(tmp_path / f"{name}.csv")
        paths.append(tmp_path / f"{name}.csv")
    keys = {question.key for question in make_turntable_draft(read_files(paths)).open_questions}
    assert {"angle unit", "rate", "signal"} <= keys
    answers = {"angle unit": "count", "per_revolution": "1000", "sense": "ccw", "signal": "p"}
    more = {"p is": "displacement", "p unit": "m", "p axis": "east"}
    document = make_record_draft(paths, **answers, **more).make_document(tmp_path)
    assert [run["rate"] for run in document["runs"]] == ["0.5 rev/s", "-1 rev/s"]


def test_stated_sampling_rates_are_used(tmp_path):
    theta = np.pi * TIME
    pos = np.column_stack([axes(theta)["east_m"], axes(theta)["north_m"]])
    rec = {"phi": theta[:, None], "pos": pos, "fs": 50.0, "rpm": 30.0, "note": "arm"}
    savemat(tmp_path / "a.mat", {"rec": rec})
    turntable_draft = make_turntable_draft(read_files([tmp_path / "a.mat"]))
    assert [signal.column for signal in turntable_draft.common_guess.signals] == ["pos.1", "pos.2"]
    assert {"fs", "rpm"} <= set(turntable_draft.common_guess.unused_columns)
    answers = {"angle unit": "rad", "sense": "ccw", "pos.1 unit": "m", "pos.2 unit": "m"}
    more = {"pos.1 axis": "east", "pos.2 axis": "north"}
    document = make_record_draft([tmp_path / "a.mat"], **answers, **more).make_document(tmp_path)
    assert document["records"]["time"] == {"sampling_rate": "50 Hz"}
    assert document["runs"][0]["rate"] == "0.5 rev/s"
    write_description(make_record_draft([tmp_path / "a.mat"], **answers, **more), tmp_path)
    assert read_campaign(tmp_path).runs[0].rate == pytest.approx(np.pi)


def test_existing_file_and_invalid_answer_raise(tmp_path):
    files = [write_run(tmp_path / "a.csv", np.pi, lambda th: {"angle_rad": th, **axes(th)})]
    with raises("wrong-unit", "radius:", "'s'"):
        write_description(make_record_draft(files, radius="2.5 s"), tmp_path)
    (tmp_path / "campaign.toml").write_text("mine")
    with pytest.raises(CounterspinError, match=r"campaign.toml already exists"):
        write_description(make_record_draft(files), tmp_path)
    assert (tmp_path / "campaign.toml").read_text() == "mine"
    with pytest.raises(CampaignError, match="give the run files"):
        make_turntable_draft([])


def test_sheets_of_workbook_may_be_runs(tmp_path):
    def sheet(rate):
        theta = rate * TIME
        columns = [TIME, theta, 2.5 * np.cos(theta), 2.5 * np.sin(theta)]
        return [["t_s", "angle_rad", "east_m", "north_m"], *np.column_stack(columns).tolist()]

    book = {"slow": sheet(np.pi), "fast": sheet(2 * np.pi)}
    path = write_workbook(tmp_path / "runs.xlsx", book)
    answers = ANSWERS | {"sheet": "all"}
    write_description(make_turntable_draft(read_files([path], answers), answers), tmp_path / "camp")
    campaign = read_campaign(tmp_path / "camp")
    assert [run.rate for run in campaign.runs] == pytest.approx([np.pi, 2 * np.pi])
    assert {run.record for run in campaign.runs} == {tmp_path / "camp" / ".." / "runs.xlsx"}
    rates = [run.rotation.spindle.rate for run in observe_runs(campaign)]
    assert rates == pytest.approx([np.pi, 2 * np.pi], rel=1e-6)


def test_excluded_angle_is_not_signal(tmp_path):
    def columns(theta):
        return {"angle_deg": np.degrees(theta) % 360, **axes(theta)}

    record_draft = make_record_draft(
        [write_run(tmp_path / "a.csv", np.pi, columns)], angle="none", sense="ccw"
    )
    assert record_draft.open_questions == []
    assert record_draft.common_guess.unused_columns == ("angle_deg",)
