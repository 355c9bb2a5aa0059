"""Pages of other rooms' blocks: words at once, pictures one by one."""

import shutil

import pytest

PAGE = {"kind": "result", "names": "three/result.json"}


def test_a_result_is_shown_with_the_report_s_words_and_pictures(page):
    told = page.get("/api/page", params=PAGE).json()
    assert "of Qx = " in told["html"]
    assert '<div class="still" data-place="0"></div>' in told["html"]
    assert "<script>" not in told["html"]
    query = PAGE | {"place": 0}
    picture = page.get("/api/picture", params=query)
    assert picture.headers["content-type"] == "image/svg+xml"
    assert picture.text.startswith("<svg")
    assert page.get("/api/picture", params=query | {"place": 99}).status_code == 404


def test_results_are_compared_and_followed(page, folder):
    shutil.copy(folder / "three" / "result.json", folder / "other.json")
    names = "three/result.json\nother.json"
    told = page.get("/api/page", params={"kind": "comparison", "names": names}).json()
    assert "What changed" in told["html"]
    assert told["command"].startswith("counterspin compare ")
    history = {"kind": "history", "names": "three/result.json", "term": "K_II"}
    told = page.get("/api/page", params=history).json()
    assert told["title"] == "History of K_II"
    assert "one result, with nothing to compare it with" in told["html"]


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
def test_what_is_no_page_is_refused(page, query, status):
    assert page.get("/api/page", params=query).status_code == status


def test_a_campaign_without_records_is_forecast(page, folder):
    (folder / "three" / "slow.csv").unlink()
    asked = {"kind": "forecast", "names": "three/campaign.toml"}
    told = page.get("/api/page", params=asked).json()
    assert "u(K<sub>" in told["html"]
    assert told["command"].startswith("counterspin plan --check ")
