"""From a result to a certificate, by the page."""

import pytest

from counterspin.certificates.issuing import check_certificate
from counterspin.certificates.lab import write_example

SAID = {"result": "three/result.json", "lab": "LAB.toml", "output": "three/certificate.xml"}


@pytest.fixture
def with_lab(page, folder):
    lab = write_example(folder / "LAB.toml")
    # The campaign of the folder takes what it does not state as perfect.
    lab.write_text(lab.read_text() + '\n[evidence]\nall = "Type test 4714."\n')
    return page


def test_a_certificate_is_issued_once_and_can_be_taken_away(with_lab, folder):
    assert with_lab.get("/api/folder").json()["labs"] == ["LAB.toml"]
    made = with_lab.post("/api/certificate", json=SAID).json()
    assert made["accelerometers"] == ["Qx", "Qy"]
    assert any("example" in note for note in made["notes"])
    certified = check_certificate(folder / "three" / "certificate.xml").certified
    assert certified.identifier == made["identifier"]
    again = with_lab.post("/api/certificate", json=SAID)
    assert again.status_code == 422
    assert "replaces no file" in again.json()["error"]
    taken = with_lab.get("/api/file", params={"name": "three/certificate.xml"})
    assert taken.content == (folder / "three" / "certificate.xml").read_bytes()
    assert taken.headers["content-disposition"] == "attachment; filename*=UTF-8''certificate.xml"
    assert taken.headers["content-type"] == "application/octet-stream"


@pytest.mark.parametrize(
    ("change", "status"),
    [
        ({"lab": "nowhere.toml"}, 404),
        ({"lab": "three/campaign.toml"}, 422),
        ({"result": "three/slow.csv"}, 422),
        ({"output": "three/certificate.docx"}, 422),
        ({"output": "../certificate.xml"}, 403),
    ],
)
def test_what_cannot_be_certified_leaves_nothing(with_lab, folder, change, status):
    before = sorted(folder.rglob("*"))
    assert with_lab.post("/api/certificate", json=SAID | change).status_code == status
    assert sorted(folder.rglob("*")) == before


def test_records_are_not_given_away(page):
    assert page.get("/api/file", params={"name": "three/slow.csv"}).status_code == 403


@pytest.mark.parametrize(
    ("kind", "mark"), [("html", b"<!DOCTYPE html>"), ("md", b"# "), ("pdf", b"%PDF")]
)
def test_a_report_is_given_and_nothing_written(page, folder, kind, mark):
    before = sorted(folder.rglob("*"))
    told = page.get("/api/report", params={"name": "three/result.json", "kind": kind})
    assert told.content.startswith(mark)
    assert f"result.{kind}" in told.headers["content-disposition"]
    assert sorted(folder.rglob("*")) == before
