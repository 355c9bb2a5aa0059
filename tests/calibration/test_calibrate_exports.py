"""Exports of recorders of different make lead to one result."""

import pytest
from exports import EXPORTS, campaign_folder, write_export

from counterspin.calibration.result import Result
from counterspin.cli import main


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
