"""Predicted uncertainty with better prior information, and the campaigns prepared from it."""

import pytest
from served import InlineJobs

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.result import Result
from counterspin.campaign.description import read_campaign
from counterspin.campaign.documents import load_document

CAMPAIGN = {"name": "three", "result": "three/result.json"}
QX = {"name": "three/result.json", "accelerometer": "Qx"}


@pytest.fixture
def result(folder):
    """State realistic prior information and return the result."""
    file = folder / "three" / "campaign.toml"
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace('assume = "all"', ""), encoding="utf-8")
    assert load_document(file).get("model", {}).get("assume") is None
    calibration = calibrate(folder / "three")
    calibration.write(folder / "three" / "result.json", overwrite=True)
    return calibration


def test_predicted_uncertainty_matches_recalibration(page, folder, result):
    body = page.post("/api/what-if", json=QX).json()
    k_ii = result.accelerometers["Qx"].coefficients["K_II"]
    assert (body["symbol"], body["u"]) == ("K_II", pytest.approx(k_ii.u, rel=1e-9))
    first = body["sources"][0]
    assert (first["name"], first["words"]) == ("K_OO", "second-order output-axis coefficient")
    assert 0.5 < first["share"] < 1.0 >= sum(source["share"] for source in body["sources"])
    better = page.post("/api/what-if", json=QX | {"known": {"K_OO": 1e-7}}).json()
    stated = read_campaign(folder / "three").change(
        {"model": {"priors": {"Qx.K_OO": "0 ± 1e-7 g/g^2"}}}
    )
    again = calibrate(stated).accelerometers["Qx"].coefficients["K_II"]
    # The refitted noise differs in the sixth digit.
    assert better["u"] == pytest.approx(again.u, rel=1e-4)
    (now,) = (source for source in better["sources"] if source["name"] == "K_OO")
    assert now["share"] < 0.1 * first["share"]


@pytest.mark.parametrize(
    ("message", "status"),
    [
        ({"accelerometer": "Qz"}, 404),
        ({"known": {"K_OO": 0.0}}, 422),
        ({"known": {"K_F": 1e-9}}, 422),
        ({"known": {"K_OO": "nan"}}, 400),
    ],
)
def test_invalid_what_if_value_is_rejected(page, result, message, status):
    assert page.post("/api/what-if", json=QX | message).status_code == status


def test_stated_value_is_prepared_in_copy(page, folder, result):
    body = page.get("/api/ways", params=CAMPAIGN).json()
    assert body["has_runs"]
    page.post("/api/campaign", json={"name": "rest", "test": "tumble"})
    readings = page.get("/api/ways", params=CAMPAIGN | {"name": "rest"}).json()
    assert not readings["has_runs"]
    assert [improvement["accelerometer"] for improvement in body["ways"]] == ["Qx", "Qy"]
    stated = body["ways"][0]["stated"]
    assert (stated["source"], stated["assumed_u"]) == ("K_OO", "0.20 µg/g²")
    before = (folder / "three" / "campaign.toml").read_bytes()
    data = page.post("/api/way", json=CAMPAIGN | {"accelerometer": "Qx", "way": "state"}).json()
    assert data == {"name": "three-K_OO", "key": 'model.priors."Qx.K_OO"'}
    prior = load_document(folder / "three-K_OO" / "campaign.toml")["model"]["priors"]
    assert prior == {"Qx.K_OO": "0 ± 2e-07 g/g^2"}
    assert (folder / "three" / "campaign.toml").read_bytes() == before
    left = calibrate(folder / "three-K_OO").accelerometers["Qx"].coefficients["K_II"].u
    assert stated["remaining_u"] == f"{left * 1e6:.2g} µg/g²"
    # A second copy gets a different name.
    again = page.post("/api/way", json=CAMPAIGN | {"accelerometer": "Qx", "way": "state"}).json()
    assert again["name"] == "three-K_OO-2"


def test_additional_runs_are_searched_and_prepared(page, app, folder, result):
    way = CAMPAIGN | {"accelerometer": "Qx", "way": "runs"}
    assert page.post("/api/way", json=way).status_code == 404
    app.jobs = InlineJobs()
    assert page.post("/api/ways", json={"name": "three"}).json()["state"] == "done"
    body = page.get("/api/ways", params=CAMPAIGN).json()
    assert body["searched"]
    runs = body["ways"][0]["runs"]
    assert runs["attitude"].startswith(("90 deg about", "180 deg about"))
    assert page.post("/api/way", json=way).json() == {"name": "three-further-runs", "key": None}
    campaign = read_campaign(folder / "three-further-runs")
    assert len(campaign.runs) == 3 + runs["count"]
    assert page.get("/api/campaign", params={"name": "three-further-runs"}).json()["missing"]


def test_result_with_assumed_inputs_has_no_improvement(page, folder):
    assert Result.read(folder / "three" / "result.json").assumed
    assert page.get("/api/ways", params=CAMPAIGN).json()["ways"] == []
    way = CAMPAIGN | {"accelerometer": "Qx", "way": "state"}
    assert page.post("/api/way", json=way).status_code == 404
