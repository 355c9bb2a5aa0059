"""The laboratory's data for a certificate: preview, profile."""

import tomllib

import pytest

from certificates import LAB
from counterspin.certificates.lab import example_text

RESULT = "three/result.json"
FILE = "three/LAB.toml"


def lab_of(page, file=FILE):
    return page.get("/api/lab", params={"file": file, "result": RESULT}).json()


def test_a_preview_shows_every_page_as_a_draft(page):
    # Evidence for what the result assumes does not block a preview.
    for text in (example_text(), LAB, ""):
        told = page.post(
            "/api/certificate-preview", json={"file": FILE, "result": RESULT, "text": text}
        ).json()
        assert len(told["pages"]) >= 2
        assert all(svg.startswith("<svg") for svg in told["pages"])


def test_a_preview_of_mistaken_data_names_the_mistake(page):
    text = LAB.replace('country = "DE"', 'country = "DD"')
    told = page.post(
        "/api/certificate-preview", json={"file": FILE, "result": RESULT, "text": text}
    )
    assert told.status_code == 422
    assert "laboratory.country" in told.json()["error"]


def test_entries_that_are_missing_are_found_beside_a_mistake(page):
    text = example_text().replace('"Exampletown"', "7", 1)
    said = {"file": FILE, "text": text, "result": RESULT}
    told = page.post("/api/check", json=said).json()
    assert [problem["key"] for problem in told["problems"]] == ["laboratory.city"]
    missing = {entry["key"] for entry in told["missing"]}
    assert {"laboratory.name", "item.model", "conditions.temperature"} < missing
    assert "laboratory.city" not in missing


def test_a_profile_fills_in_the_next_certificate(page, folder):
    assert lab_of(page)["profile"] is False
    text = LAB.replace('name = "Kunde"', 'name = "Example Customer"')
    assert page.post("/api/profile", json={"file": FILE, "text": text}).json() == {
        "file": "laboratory.toml"
    }
    kept = tomllib.loads((folder / "laboratory.toml").read_text("utf-8"))
    # Nothing of the item, of the customer or of one calibration.
    assert kept.keys() == {"certificate", "laboratory", "persons"}
    assert kept["certificate"] == {"language": "de", "traceability": "Rückgeführt auf das SI."}
    assert page.get("/api/folder").json()["labs"] == []
    told = lab_of(page)
    assert told["profile"] is True
    document = told["document"]
    assert document["laboratory"]["name"] == "Kalibrierlabor"
    assert [person["name"] for person in document["persons"]] == ["A. Erste", "B. Zweite"]
    missing = {entry["key"] for entry in told["missing"]}
    assert {"customer.name", "item.serial_number"} < missing
    assert not {key for key in missing if key.startswith(("laboratory", "persons"))}
    # The campaign states its day.
    assert document["certificate"]["begin"] == "2026-01-12"


def test_a_profile_of_the_template_is_refused(page, folder):
    told = page.post("/api/profile", json={"file": FILE, "text": example_text()})
    assert told.status_code == 422
    assert "Fill in the Laboratory section" in told.json()["error"]
    assert not (folder / "laboratory.toml").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[laboratory", "laboratory.toml: "),
        ("[[laboratory]]\nx = 1\n", "correct or remove this file"),
    ],
)
def test_a_profile_that_cannot_be_used_is_named(page, folder, text, words):
    (folder / "laboratory.toml").write_text(text)
    told = page.get("/api/lab", params={"file": FILE, "result": RESULT})
    assert told.status_code == 422
    assert words in told.json()["error"]


def test_a_profile_keeps_the_place_of_the_logo(page, folder):
    (folder / "three" / "logo.svg").write_text('<svg xmlns="http://www.w3.org/2000/svg"/>')
    text = LAB.replace('code = "D-K-1"', 'logo = "logo.svg"')
    page.post("/api/profile", json={"file": FILE, "text": text})
    kept = tomllib.loads((folder / "laboratory.toml").read_text("utf-8"))
    assert kept["laboratory"]["logo"] == "three/logo.svg"
    assert lab_of(page)["document"]["laboratory"]["logo"] == "logo.svg"
    assert lab_of(page, "LAB.toml")["document"]["laboratory"]["logo"] == "three/logo.svg"


def test_a_logo_outside_the_served_folder_is_refused(page):
    text = LAB.replace('code = "D-K-1"', 'logo = "../../logo.svg"')
    said = {"file": FILE, "text": text, "result": RESULT}
    told = page.post("/api/certificate-preview", json=said)
    assert told.status_code == 422
    assert "outside the served folder" in told.json()["error"]
