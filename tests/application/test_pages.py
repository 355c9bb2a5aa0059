"""Pages of results, comparisons and forecasts: text first, plots on request."""

import re
import shutil

import pytest
from campaigns import replace_parts
from served import wait_for_job

from counterspin.calibration.calibrate import calibrate

PAGE = {"kind": "result", "names": "three/result.json"}


def test_result_page_has_text_and_plots_of_report(page):
    body = page.get("/api/page", params=PAGE).json()
    assert '<h2 id="at-card-qx">Qx</h2>' in body["html"]
    assert (body["state"], body["words"]) == ("reservations", "With reservations")
    assert re.search('<div class="still"[^>]* data-place="0"></div>', body["html"])
    assert "<script>" not in body["html"]
    query = PAGE | {"place": 0}
    picture = page.get("/api/picture", params=query)
    assert picture.headers["content-type"] == "image/svg+xml"
    assert picture.text.startswith("<svg")
    assert page.get("/api/picture", params=query | {"place": 99}).status_code == 404


def test_contradicted_result_states_why_not_certifiable(page, folder):
    assert page.get("/api/page", params=PAGE).json()["refusal"] == ""
    file, result = folder / "three" / "campaign.toml", folder / "three" / "result.json"
    file.write_text(replace_parts(file.read_text(), ('"0.01 m"', '"0.001 m"')))
    calibrate(file).write(result, overwrite=True)
    refused = page.get("/api/page", params=PAGE).json()
    assert refused["state"] == "contradicted"
    assert refused["refusal"].startswith("The records contradict this result.")
    calibrate(file, accept_misfit="bench test").write(result, overwrite=True)
    assert page.get("/api/page", params=PAGE).json()["refusal"] == ""


def test_results_are_compared_and_shown_as_history(page, folder):
    shutil.copy(folder / "three" / "result.json", folder / "other.json")
    names = "three/result.json\nother.json"
    body = page.get("/api/page", params={"kind": "comparison", "names": names}).json()
    assert "Changes" in body["html"]
    assert body["command"].startswith("counterspin compare ")
    history = {"kind": "history", "names": "three/result.json", "term": "K_II"}
    body = page.get("/api/page", params=history).json()
    assert body["title"] == "History of K_II"
    assert "There is only one result; a comparison requires at least two" in body["html"]
    assert "three/result.json" in body["html"]
    assert str(folder) not in body["html"]


def test_history_without_usable_results_is_empty_page(page):
    request = {"kind": "history", "names": "three/result.json", "term": "K_OQ"}
    response = page.get("/api/page", params=request)
    assert response.status_code == 200
    assert response.json()["empty"] is True
    assert ": the result has no K" in response.json()["html"]
    assert not page.get("/api/page", params=PAGE).json()["empty"]


@pytest.mark.parametrize(
    ("query", "status"),
    [
        (PAGE | {"kind": "nothing"}, 400),
        (PAGE | {"kind": "study"}, 422),
        (PAGE | {"names": "three/campaign.toml"}, 422),
        (PAGE | {"names": "nowhere.json"}, 404),
        (PAGE | {"names": "../served/three/result.json"}, 403),
        (PAGE | {"kind": "comparison"}, 422),
        (PAGE | {"kind": "history", "term": "K_9"}, 422),
    ],
)
def test_invalid_page_query_is_rejected(page, query, status):
    assert page.get("/api/page", params=query).status_code == status


def test_campaign_without_records_shows_forecast(page, folder):
    (folder / "three" / "slow.csv").unlink()
    request = {"kind": "forecast", "names": "three/campaign.toml"}
    picture = page.get("/api/picture", params=request | {"place": 0})
    assert picture.status_code == 404
    # A second request finds the running job.
    jobs = [page.get("/api/page", params=request).json()["job"] for _ in range(2)]
    assert {(job["number"], job["kind"]) for job in jobs} == {(1, "forecast")}
    assert wait_for_job(page, 1)["state"] == "done"
    body = page.get("/api/page", params=request).json()
    assert "u(K<sub>" in body["html"]
    assert body["command"].startswith("counterspin plan --check ")


def test_forecast_exceeding_memory_fails_with_message(page, folder):
    """The forecast would need 15 GB of memory."""
    (folder / "endless").mkdir()
    text = (folder / "three" / "campaign.toml").read_text().replace("drift =", "# drift =")
    text = text.replace('rate = "0.5 rev/s"', 'rate = "1e-9 rev/s"')
    (folder / "endless" / "campaign.toml").write_text(text)
    request = {"kind": "forecast", "names": "endless/campaign.toml"}
    number = page.get("/api/page", params=request).json()["job"]["number"]
    job = wait_for_job(page, number)
    assert job["state"] == "failed"
    assert "at 1e-09 rev/s" in job["error"]
