"""A wrong description is reported: the radius is stated as 2.6 m instead of 2.5 m."""

import json
import re

import pytest
from campaigns import SMALL, replace_parts, write_description

from counterspin import cli
from counterspin.calibration.batch import BatchResult
from counterspin.calibration.result import Result
from counterspin.simulation.simulate import simulate

REASON = "radius measured again: 2.6 m it is"
SPECIFIED = (
    SMALL
    + """
[specification]
K_II = "abs <= 50 ug/g^2"
"""
)


@pytest.fixture(scope="module")
def sound_records(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound")
    simulate(write_description(folder, SPECIFIED, "plan.toml"), folder / "records")
    return folder / "records"


def change_radius(sound_records, folder, *more):
    """Return the records with a description that states another radius."""
    for record in sound_records.glob("*.csv"):
        (folder / record.name).write_bytes(record.read_bytes())
    text = replace_parts(SPECIFIED, ('radius = "2.5 m"', 'radius = "2.6 m"'), *more)
    return write_description(folder, text).parent


@pytest.fixture(scope="module")
def wrong_radius(sound_records, tmp_path_factory):
    return change_radius(sound_records, tmp_path_factory.mktemp("wrong"))


@pytest.fixture(scope="module")
def wrong_radius_unknown_noise(sound_records, tmp_path_factory):
    stated = ('\n[noise]\ndisplacement = "0.01 m"\n', "")
    return change_radius(sound_records, tmp_path_factory.mktemp("wrong"), stated)


def run_calibrate(capsys, *words):
    status = cli.main(["calibrate", *map(str, words)])
    printed = capsys.readouterr()
    return status, " ".join(printed.out.split()), " ".join(printed.err.split())


def test_true_radius_is_good(sound_records, tmp_path, capsys):
    status, out, err = run_calibrate(capsys, sound_records, "--json", tmp_path / "r.json")
    assert (status, err) == (0, "")
    assert "contradict" not in out
    result = Result.read(tmp_path / "r.json")
    assert all(
        accelerometer.state != "contradicted" for accelerometer in result.accelerometers.values()
    )
    assert all(
        accelerometer.conformity["K_II"].verdict == "pass"
        for accelerometer in result.accelerometers.values()
    )


@pytest.mark.parametrize("noise", ["given", "estimated"])
def test_wrong_radius_is_contradicted_in_all_outputs(noise, request, tmp_path, capsys):
    wrong = request.getfixturevalue(
        "wrong_radius" if noise == "given" else "wrong_radius_unknown_noise"
    )
    status, out, err = run_calibrate(capsys, wrong, "--json", tmp_path / "r.json")
    assert status == 1
    assert "a radius of the centrifuge " in err
    assert err.endswith("--accept-misfit REASON")
    assert out.startswith(f"{wrong.name} The records contradict this result (centrifuge.radius). ")
    assert "95 %" not in out
    document = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    assert document["state"] == "contradicted"
    assert document["accepted_misfit"] is None
    first = document["findings"][0]
    assert (first["code"], first["subject"]) == ("wrong-input", "centrifuge.radius")
    assert re.search(r"a radius of the centrifuge of (2\.499\d+|2\.500\d+) ±", first["text"])
    assert {finding["code"] for finding in first["explains"]} & {"lack-of-fit", "noise-implausible"}
    assert first["contradicts"]
    for name, accelerometer in document["accelerometers"].items():
        assert accelerometer["state"] == "contradicted"
        assert [finding["code"] for finding in accelerometer["findings"]] == ["wrong-input"], name
        verdict = accelerometer["conformity"]["K_II"]
        assert verdict["verdict"] == "undecided"
        assert verdict["reason"].startswith("the records contradict the result")


def test_accepted_misfit_exits_with_0_and_is_stored(wrong_radius, tmp_path, capsys):
    words = (wrong_radius, "--json", tmp_path / "r.json", "--accept-misfit", REASON)
    status, out, err = run_calibrate(capsys, *words)
    assert (status, err) == (0, "")
    assert f"The misfit was accepted: {REASON}" in out
    result = Result.read(tmp_path / "r.json")
    assert (result.state, result.accepted_misfit) == ("contradicted", REASON)
    verdict = result.accelerometers["Qx"].conformity["K_II"]
    assert verdict.reason is None or "contradict" not in verdict.reason


def test_rejects_empty_reason(wrong_radius, capsys):
    status, _, err = run_calibrate(capsys, wrong_radius, "--accept-misfit", " ")
    assert status == 2
    assert "state the reason" in err


def test_contradicted_campaign_of_batch_is_named(sound_records, wrong_radius, tmp_path, capsys):
    words = (sound_records, wrong_radius, "--json", tmp_path / "all.json")
    status, out, err = run_calibrate(capsys, *words)
    assert status == 1
    assert "the result of 1. " in err
    assert "the records contradict the result. Do not use it." in out
    assert out.count("contradicted") == 2
    assert BatchResult.read(tmp_path / "all.json").contradicted == [str(wrong_radius)]
    assert run_calibrate(capsys, sound_records, wrong_radius, "--accept-misfit", REASON)[0] == 0
