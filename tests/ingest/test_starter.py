"""The starter campaign: written once, whole, and good to simulate and calibrate as it stands."""

from typing import get_args

import pytest
from raising import raises
from scipy import stats

import counterspin as cs
from certificates import write_lab
from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.description import read_campaign
from counterspin.cli import main
from counterspin.errors import CounterspinError
from counterspin.ingest.starter import Test, init
from counterspin.physics.terms import TERMS
from counterspin.simulation.simulate import simulate
from counterspin.studies.study import study


def test_unchanged_starter_is_simulated_and_calibrated(tmp_path):
    path = init(tmp_path / "new" / "campaign")
    assert path == tmp_path / "new" / "campaign" / "campaign.toml"
    campaign = read_campaign(path)
    simulate(campaign, tmp_path / "made")
    qx = calibrate(tmp_path / "made", method="two-stage").accelerometers["Qx"]
    c, truth = qx.coefficients, campaign.simulation.truth.coefficients["Qx"]
    for symbol in ("K_II", "K_F"):
        assert abs(c[symbol].value - truth[symbol]) < 4 * c[symbol].u


def test_starter_has_comments_on_tables(tmp_path):
    text = init(tmp_path).read_text(encoding="utf-8")
    tables = [line for line in text.splitlines() if line.startswith("[")]
    assert {"[site]", "[centrifuge]", "[records]", "[noise]", "[model]", "[[runs]]"} <= {
        line.partition("#")[0].strip() for line in tables
    }
    assert sum("#" in line for line in text.splitlines()) > 20


#: What a certificate says of the test.
SAID = {
    "tumble": "Readings at rest in 24 positions: 24 readings",
    "arm": "Readings on the arm of a centrifuge (IEEE Std 836) at 6 rates, 3.132 to "
    "14.01 rad/s, one sense of rotation, 2 mountings (in, out): 24 readings",
    "double-turntable": "The item was mounted on a double-turntable centrifuge and",
}


@pytest.mark.slow
@pytest.mark.parametrize("test", [arg for arg in get_args(Test) if arg != "poses"])
def test_examples_run_from_init_to_certificate(tmp_path, test, capsys):
    """From init to the certificate; the study runs small, its coverage within what it allows."""
    own, folder = tmp_path / "own", tmp_path / "made"
    assert main(["init", str(own), "--test", test]) == 0
    assert main(["simulate", str(own), "-o", str(folder)]) == 0
    saved, page, certificate = (tmp_path / name for name in ("r.json", "r.html", "c.xml"))
    assert main(["calibrate", str(folder), "--json", str(saved)]) == 0
    truth = read_campaign(own).simulation.truth
    result = cs.read_result(saved)
    ((name, accelerometer),) = result.accelerometers.items()
    checked = {
        symbol: truth.coefficients[name].get(symbol, TERMS[symbol].nominal)
        for symbol in accelerometer.coefficients
        if symbol in TERMS
    }
    assert {"K_F", "K_I", "K_II"} <= set(checked)
    for symbol, value in checked.items():
        c = accelerometer.coefficients[symbol]
        # Beside unstated K_IP, tilt and drift, the records add nothing to what was known of these.
        assert c.estimated or symbol in ("K_F", "K_I")
        assert abs(c.value - value) < 4.0 * c.u
    assert main(["report", str(saved), "-o", str(page)]) == 0
    lab = write_lab(tmp_path)
    assert main(["certificate", str(saved), str(lab), "-o", str(certificate)]) == 0
    written = certificate.read_text("utf-8")
    assert SAID[test] in written
    of_records = test == "double-turntable"
    assert ("double-turntable" in written) == of_records
    assert ("In the unit of the readings" in written) == (not of_records)
    assert ("(IEEE Std 836)" in page.read_text("utf-8")) == (test == "arm")
    if accelerometer.readings:
        trials = 8
        coefficients = study(own, trials=trials).analyses["joint"].coefficients
        low, _ = stats.binom.interval(1.0 - 1e-5, trials, 0.95)
        for coefficient in coefficients.values():
            assert coefficient.covered[1] * trials >= low
            assert abs(coefficient.bias) < 5.0 * coefficient.se_bias
    capsys.readouterr()


def test_existing_reading_table_is_not_overwritten(tmp_path):
    (tmp_path / "readings.csv").write_text("mine", encoding="utf-8")
    with pytest.raises(CounterspinError, match=r"readings\.csv already exists; edit it"):
        init(tmp_path, "tumble")
    assert not (tmp_path / "campaign.toml").exists()
    with raises("wrong-usage", "`test`", "double-turntable, tumble, arm"):
        init(tmp_path, "centrifuge")
    with raises("wrong-usage", "log"):
        init(tmp_path, "poses")


def test_existing_description_is_not_overwritten(tmp_path):
    path = tmp_path / "campaign.toml"
    path.write_text("mine", encoding="utf-8")
    with raises("file-exists", "campaign.toml"):
        init(tmp_path)
    assert path.read_text(encoding="utf-8") == "mine"


def test_folder_that_cannot_be_created_raises(tmp_path):
    (tmp_path / "file").write_text("x", encoding="utf-8")
    for name, message in (("file", "is a file"), ("file/below", "cannot be created")):
        with pytest.raises(CounterspinError, match=message):
            init(tmp_path / name)


def test_command_line_prints_next_step(tmp_path, capsys):
    assert main(["init", str(tmp_path / "new")]) == 0
    out = capsys.readouterr().out
    assert f"counterspin simulate {tmp_path / 'new' / 'campaign.toml'} -o" in out
    assert "counterspin calibrate" in out
    assert main(["init", str(tmp_path / "new")]) == 1
    assert capsys.readouterr().err.startswith("counterspin: ")
