"""Exports of recorders of different make lead to one result."""

import pytest

from counterspin.calibration.result import Result
from counterspin.cli import main
from exports import EXPORTS, campaign_folder, write_export


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return campaign_folder(tmp_path_factory.mktemp("exports"))


def calibrated(folder):
    assert main(["calibrate", str(folder), "--json", str(folder / "result.json")]) == 0
    return Result.read(folder / "result.json")


@pytest.fixture(scope="module")
def reference(plain):
    return calibrated(plain).accelerometers["Qx"].coefficients["K_II"]


@pytest.mark.parametrize("name", EXPORTS)
def test_every_export_gives_the_same_result(tmp_path, plain, reference, name):
    write_export(plain, tmp_path / "lab", EXPORTS[name])
    found = calibrated(tmp_path / "lab").accelerometers["Qx"].coefficients["K_II"]
    assert abs(found.value - reference.value) < 0.01 * reference.u
    assert found.u == pytest.approx(reference.u, rel=1e-3)


def test_a_run_is_left_out_by_command_as_by_the_description(tmp_path, plain, capsys):
    saved = tmp_path / "without.json"
    words = ["calibrate", str(plain), "--without", "slow"]
    assert main([*words, "--json", str(saved)]) in (0, 1)
    result = Result.read(saved)
    assert list(result.runs) == ["fast"]
    assert result.provenance.options == ["--without=slow"]
    assert result.provenance.in_memory == {}
    assert set(result.provenance.inputs) == {"campaign.toml", "fast.csv"}
    assert "Left out on request: slow." in result.warnings
    text = (plain / "campaign.toml").read_text(encoding="utf-8")
    (tmp_path / "campaign.toml").write_text(
        text.replace('name = "slow"', 'name = "slow"\nskip = true'), encoding="utf-8"
    )
    (tmp_path / "fast.csv").write_bytes((plain / "fast.csv").read_bytes())
    again = calibrated(tmp_path)
    assert again.accelerometers["Qx"].coefficients == result.accelerometers["Qx"].coefficients
    capsys.readouterr()
    assert main([*words[:2], "--without", "solw"]) == 2
    assert 'there is no "solw"; did you mean "slow"?' in capsys.readouterr().err
    assert main([*words, str(plain)]) == 2
