"""A campaign at one rate does not determine K_II, and its result has a state that says so."""

import json

import pytest
from campaigns import SMALL, format_runs, replace_parts, write_description

import counterspin as cs
from counterspin import cli
from counterspin.simulation.simulate import simulate

_THREE = format_runs("slow", "middle", "fast")
ONE_RATE = replace_parts(SMALL, (_THREE, _THREE[: _THREE.index("[[runs]]", 2)]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("one-rate")
    simulate(write_description(place, ONE_RATE, "plan.toml"), place / "records")
    return place / "records"


def calibrate_changed(folder, tmp_path, *changes):
    """Return the result of the records with a changed description."""
    for record in folder.glob("*.csv"):
        (tmp_path / record.name).write_bytes(record.read_bytes())
    return cs.calibrate(write_description(tmp_path, replace_parts(ONE_RATE, *changes)).parent)


def test_undetermined_result_is_written_with_exit_status_1(folder, tmp_path, capsys):
    status = cli.main(["calibrate", str(folder), "--json", str(tmp_path / "r.json")])
    printed = capsys.readouterr()
    out, err = " ".join(printed.out.split()), " ".join(printed.err.split())
    assert status == 1
    assert err == (
        "counterspin: Qx.K_II is not determined: The records do not determine K_II, and no prior "
        "is stated for K_II. All runs have the same rate; add a run at another rate."
    )
    assert "The result for Qx is not fully determined by the data: " in out
    assert "Passed checks" not in out
    document = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    assert document["state"] == document["accelerometers"]["Qy"]["state"] == "not-determined"
    assert document["findings"][0]["undetermined"]


def test_batch_with_undetermined_result_exits_with_1(folder, tmp_path, capsys):
    copy = tmp_path / "copy"
    copy.mkdir()
    for file in folder.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    assert cli.main(["calibrate", str(folder), str(copy)]) == 1
    printed = " ".join(capsys.readouterr().err.split())
    assert "the data of 2 of 2 campaigns do not determine all requested terms" in printed


def test_undetermined_usual_term_is_information_unless_requested(folder, tmp_path):
    # With K_F and K_III known, or not requested, one rate determines K_II.
    bias = ('scale_factor = "1.002 g/g"', 'scale_factor = "1.002 g/g"\nbias = "0.005 ± 1e-7 g"')
    other = ('scale_factor = "0.999 g/g"', 'scale_factor = "0.999 g/g"\nbias = "-0.003 ± 1e-7 g"')
    usual = calibrate_changed(folder, tmp_path, bias, other)
    assert usual.coefficient("Qx.K_II").estimated
    assert usual.coefficient("Qx.K_III").value is None
    assert usual.state == "reservations"
    named = ('assume = "all"', 'assume = "all"\nterms = ["K_F", "K_I", "K_II", "K_III"]')
    assert calibrate_changed(folder, tmp_path, bias, other, named).state == "not-determined"
    # A term that is not requested has no finding.
    fewer = ('assume = "all"', 'assume = "all"\nterms = ["K_F", "K_I", "K_II"]')
    assert calibrate_changed(folder, tmp_path, bias, other, fewer).state != "not-determined"
