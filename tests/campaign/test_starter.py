"""The starter campaign: written once, whole, and good to simulate and calibrate as it stands."""

import pytest

from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.description import read_campaign
from counterspin.campaign.simulation import simulate
from counterspin.campaign.starter import init
from counterspin.cli import main
from counterspin.errors import CounterspinError


def test_starter_can_be_simulated_and_calibrated_as_it_stands(tmp_path):
    path = init(tmp_path / "new" / "campaign")
    assert path == tmp_path / "new" / "campaign" / "campaign.toml"
    campaign = read_campaign(path)
    simulate(campaign, tmp_path / "made")
    found = calibrate(tmp_path / "made", method="two-stage").accelerometers["Qx"]
    c, truth = found.coefficients, campaign.simulation.truth.coefficients["Qx"]
    for symbol in ("K_II", "K_F"):
        assert abs(c[symbol].value - truth[symbol]) < 4 * c[symbol].u


def test_starter_says_what_each_table_is_for(tmp_path):
    text = init(tmp_path).read_text(encoding="utf-8")
    tables = [line for line in text.splitlines() if line.startswith("[")]
    assert {"[site]", "[centrifuge]", "[records]", "[noise]", "[model]", "[[runs]]"} <= {
        line.partition("#")[0].strip() for line in tables
    }
    assert sum("#" in line for line in text.splitlines()) > 20


def test_description_that_is_there_stays(tmp_path):
    path = tmp_path / "campaign.toml"
    path.write_text("mine", encoding="utf-8")
    with pytest.raises(CounterspinError, match=r"campaign\.toml exists; edit it, or choose"):
        init(tmp_path)
    assert path.read_text(encoding="utf-8") == "mine"


def test_folder_that_cannot_be_made_is_an_error(tmp_path):
    (tmp_path / "file").write_text("x", encoding="utf-8")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(CounterspinError, match="cannot be made"):
            init(folder)


def test_command_line_tells_what_to_do_next(tmp_path, capsys):
    assert main(["init", str(tmp_path / "new")]) == 0
    told = capsys.readouterr().out
    assert f"counterspin simulate {tmp_path / 'new' / 'campaign.toml'} -o" in told
    assert "counterspin calibrate" in told
    assert main(["init", str(tmp_path / "new")]) == 1
    assert capsys.readouterr().err.startswith("counterspin: ")
