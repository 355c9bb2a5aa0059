"""A wrong description is not calibrated in silence: the radius is given as 2.6 m for 2.5 m."""

import json
import re

import pytest
from campaigns import SMALL, changed, write

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
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound")
    simulate(write(folder, SPECIFIED, "plan.toml"), folder / "records")
    return folder / "records"


def spoilt(sound, folder, *more):
    """Return the records with a description of another radius."""
    for record in sound.glob("*.csv"):
        (folder / record.name).write_bytes(record.read_bytes())
    text = changed(SPECIFIED, ('radius = "2.5 m"', 'radius = "2.6 m"'), *more)
    return write(folder, text).parent


@pytest.fixture(scope="module")
def wrong(sound, tmp_path_factory):
    return spoilt(sound, tmp_path_factory.mktemp("wrong"))


@pytest.fixture(scope="module")
def wrong_of_unknown_noise(sound, tmp_path_factory):
    stated = ('\n[noise]\ndisplacement = "0.01 m"\n', "")
    return spoilt(sound, tmp_path_factory.mktemp("wrong"), stated)


def calibrate(capsys, *words):
    status = cli.main(["calibrate", *map(str, words)])
    printed = capsys.readouterr()
    return status, " ".join(printed.out.split()), " ".join(printed.err.split())


def test_the_true_radius_is_good(sound, tmp_path, capsys):
    status, out, err = calibrate(capsys, sound, "--json", tmp_path / "r.json")
    assert (status, err) == (0, "")
    assert "contradict" not in out
    found = Result.read(tmp_path / "r.json")
    assert all(one.state != "contradicted" for one in found.accelerometers.values())
    assert all(one.conformity["K_II"].verdict == "pass" for one in found.accelerometers.values())


@pytest.mark.parametrize("noise", ["given", "estimated"])
def test_another_is_contradicted_everywhere(noise, request, tmp_path, capsys):
    wrong = request.getfixturevalue("wrong" if noise == "given" else "wrong_of_unknown_noise")
    status, out, err = calibrate(capsys, wrong, "--json", tmp_path / "r.json")
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
    assert {other["code"] for other in first["explains"]} & {"lack-of-fit", "noise-implausible"}
    assert first["contradicts"]
    for name, found in document["accelerometers"].items():
        assert found["state"] == "contradicted"
        assert [other["code"] for other in found["findings"]] == ["wrong-input"], name
        verdict = found["conformity"]["K_II"]
        assert verdict["verdict"] == "undecided"
        assert verdict["reason"].startswith("the records contradict the result")


def test_a_reason_lifts_it_and_is_kept(wrong, tmp_path, capsys):
    words = (wrong, "--json", tmp_path / "r.json", "--accept-misfit", REASON)
    status, out, err = calibrate(capsys, *words)
    assert (status, err) == (0, "")
    assert f"The misfit was accepted: {REASON}" in out
    found = Result.read(tmp_path / "r.json")
    assert (found.state, found.accepted_misfit) == ("contradicted", REASON)
    verdict = found.accelerometers["Qx"].conformity["K_II"]
    assert verdict.reason is None or "contradict" not in verdict.reason


def test_an_empty_reason_is_none(wrong, capsys):
    status, _, err = calibrate(capsys, wrong, "--accept-misfit", " ")
    assert status == 2
    assert "give the reason" in err


def test_of_several_campaigns_each_is_named(sound, wrong, tmp_path, capsys):
    words = (sound, wrong, "--json", tmp_path / "all.json")
    status, out, err = calibrate(capsys, *words)
    assert status == 1
    assert "the result of 1. " in err
    assert "the records contradict the result, so the result must not be used." in out
    assert out.count("contradicted") == 2
    assert BatchResult.read(tmp_path / "all.json").contradicted == [str(wrong)]
    assert calibrate(capsys, sound, wrong, "--accept-misfit", REASON)[0] == 0
