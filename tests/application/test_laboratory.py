"""Laboratory data for a certificate: preview and profile."""

import tomllib

import pytest

from certificates import LAB
from counterspin.certificates.lab import example_text

RESULT = "three/result.json"
FILE = "three/LAB.toml"


def get_lab(page, file=FILE):
    return page.get("/api/lab", params={"file": file, "result": RESULT}).json()


def test_preview_shows_all_pages_as_draft(page):
    # Missing evidence for assumed terms does not block a preview.
    for text in (example_text(), LAB, ""):
        body = page.post(
            "/api/certificate-preview", json={"file": FILE, "result": RESULT, "text": text}
        ).json()
        assert len(body["pages"]) >= 2
        assert all(svg.startswith("<svg") for svg in body["pages"])


def test_preview_of_invalid_data_names_key(page):
    text = LAB.replace('country = "DE"', 'country = "DD"')
    response = page.post(
        "/api/certificate-preview", json={"file": FILE, "result": RESULT, "text": text}
    )
    assert response.status_code == 422
    assert "laboratory.country" in response.json()["error"]


def test_missing_entries_are_listed_despite_invalid_entry(page):
    text = example_text().replace('"Exampletown"', "7", 1)
    request = {"file": FILE, "text": text, "result": RESULT}
    body = page.post("/api/check", json=request).json()
    assert [problem["key"] for problem in body["problems"]] == ["laboratory.city"]
    missing = {entry["key"] for entry in body["missing"]}
    assert {"laboratory.name", "item.model", "conditions.temperature"} < missing
    assert "laboratory.city" not in missing


def test_profile_prefills_next_certificate(page, folder):
    assert get_lab(page)["profile"] is False
    text = LAB.replace('name = "Kunde"', 'name = "Example Customer"')
    assert page.post("/api/profile", json={"file": FILE, "text": text}).json() == {
        "file": "laboratory.toml"
    }
    kept = tomllib.loads((folder / "laboratory.toml").read_text("utf-8"))
    # No data of the item, the customer or a single calibration.
    assert kept.keys() == {"certificate", "laboratory", "persons"}
    assert kept["certificate"] == {"language": "de", "traceability": "Rückgeführt auf das SI."}
    assert page.get("/api/folder").json()["labs"] == []
    body = get_lab(page)
    assert body["profile"] is True
    document = body["document"]
    assert document["laboratory"]["name"] == "Kalibrierlabor"
    assert [person["name"] for person in document["persons"]] == ["A. Erste", "B. Zweite"]
    missing = {entry["key"] for entry in body["missing"]}
    assert {"customer.name", "item.serial_number"} < missing
    assert not {key for key in missing if key.startswith(("laboratory", "persons"))}
    # The campaign states its date.
    assert document["certificate"]["begin"] == "2026-01-12"


def test_profile_with_template_values_is_rejected(page, folder):
    response = page.post("/api/profile", json={"file": FILE, "text": example_text()})
    assert response.status_code == 422
    assert "Fill in the Laboratory section" in response.json()["error"]
    assert not (folder / "laboratory.toml").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[laboratory", "laboratory.toml: "),
        ("[[laboratory]]\nx = 1\n", "correct or remove this file"),
    ],
)
def test_invalid_profile_is_named(page, folder, text, words):
    (folder / "laboratory.toml").write_text(text)
    response = page.get("/api/lab", params={"file": FILE, "result": RESULT})
    assert response.status_code == 422
    assert words in response.json()["error"]


def test_profile_path_of_logo_stays_valid(page, folder):
    (folder / "three" / "logo.svg").write_text('<svg xmlns="http://www.w3.org/2000/svg"/>')
    text = LAB.replace('code = "D-K-1"', 'logo = "logo.svg"')
    page.post("/api/profile", json={"file": FILE, "text": text})
    kept = tomllib.loads((folder / "laboratory.toml").read_text("utf-8"))
    assert kept["laboratory"]["logo"] == "three/logo.svg"
    assert get_lab(page)["document"]["laboratory"]["logo"] == "logo.svg"
    assert get_lab(page, "LAB.toml")["document"]["laboratory"]["logo"] == "three/logo.svg"


def test_logo_outside_served_folder_is_rejected(page):
    text = LAB.replace('code = "D-K-1"', 'logo = "../../logo.svg"')
    request = {"file": FILE, "text": text, "result": RESULT}
    response = page.post("/api/certificate-preview", json=request)
    assert response.status_code == 422
    assert "outside the served folder" in response.json()["error"]
