"""The list of campaigns in the folder with their states."""

import json
import os
import time

import numpy as np
import pytest
from campaigns import SMALL, write_description
from results import seal_document

from counterspin.application.campaigns import to_json
from counterspin.calibration.calibrate import calibrate
from triads import compute_indications, draw_directions, write_pose_campaign


def campaign_state(page, name="three"):
    (campaign,) = (c for c in page.get("/api/folder").json()["campaigns"] if c["name"] == name)
    return campaign["state"]


def test_campaign_is_listed_with_its_result(page):
    body = page.get("/api/folder").json()
    (campaign,) = body["campaigns"]
    assert (campaign["name"], campaign["runs"]) == ("three", 3)
    assert campaign["instruments"] == ["Qx", "Qy"]
    (result,) = campaign["results"]
    assert campaign["state"] == result["state"]
    assert result["answers"][0]["name"] == "K_II of Qx"
    assert "µg/g²" in result["answers"][0]["text"]
    assert body["results"] == []
    assert {"name": "K_OO", "words": "second-order output-axis coefficient"} in body["terms"]


def test_result_without_k_ii_is_listed_with_first_coefficients(page, folder):
    values = compute_indications(draw_directions(15, np.random.default_rng(1)))
    write_pose_campaign(folder / "triad", values)
    result = calibrate(folder / "triad")
    result.write(folder / "triad" / "result.json")
    first = {name: next(iter(a.coefficients)) for name, a in result.accelerometers.items()}
    assert "K_II" not in first.values()
    campaigns = page.get("/api/folder").json()["campaigns"]
    (entry,) = (c["results"][0] for c in campaigns if c["name"] == "triad")
    names = [f"{symbol} of {name}" for name, symbol in first.items()]
    assert [answer["name"] for answer in entry["answers"]] == names


def test_poses_count_as_runs(page, folder):
    write_pose_campaign(
        folder / "triad", compute_indications(draw_directions(15, np.random.default_rng(1)))
    )
    runs = {c["name"]: c["runs"] for c in page.get("/api/folder").json()["campaigns"]}
    assert runs == {"three": 3, "triad": 15}


def test_state_changes_with_files(page, folder):
    three = folder / "three"
    calibrated = campaign_state(page)
    assert calibrated in ("good", "reservations")
    later = time.time() + 10.0
    os.utime(three / "fast.csv", (later, later))
    assert campaign_state(page) == "changed"
    result = three / "result.json"
    os.utime(result, (later, later))
    assert campaign_state(page) == calibrated
    description = three / "campaign.toml"
    text = description.read_text()
    description.write_text(f"{text}\n# looked at\n")
    assert campaign_state(page) == "changed"
    description.write_text(text.replace('"2.5 m"', '"2.5 kg"'))
    assert campaign_state(page) == "mistakes"
    body = page.get("/api/campaign", params={"name": "three"}).json()
    assert [m for m in body["mistakes"] if m.startswith("centrifuge.radius: ")] == body["mistakes"]
    assert [run["name"] for run in body["run_list"]] == ["slow", "middle", "fast"]
    description.write_text(text)
    result.write_text("{}")
    assert campaign_state(page) == "not calibrated"
    (three / "slow.csv").unlink()
    assert campaign_state(page) == "records missing"


def test_main_result_is_listed_first_unless_damaged(page, folder):
    own = folder / "three" / "result.json"
    document = json.loads(own.read_text())
    now = own.stat().st_mtime
    for later, (name, method) in enumerate([("b", "joint"), ("c", "joint"), ("d", "two-stage")], 1):
        other = own.with_name(f"{name}.json")
        other.write_text(seal_document(document | {"method": method}))
        os.utime(other, (now + later, now + later))

    def result_names():
        (campaign,) = page.get("/api/folder").json()["campaigns"]
        return [result["name"].removeprefix("three/") for result in campaign["results"]]

    assert result_names() == ["result.json", "c.json", "b.json", "d.json"]
    own.write_text(json.dumps(document | {"gravity": -9.8}))
    assert result_names() == ["c.json", "b.json", "d.json", "result.json"]


def test_damaged_result_is_listed_as_damaged(page, folder):
    file = folder / "three" / "result.json"
    file.write_text(file.read_text().replace('"gravity": 9', '"gravity": -9', 1))
    (campaign,) = page.get("/api/folder").json()["campaigns"]
    assert campaign["results"][0]["state"] == "damaged"
    assert campaign["results"][0]["words"].startswith("three/result.json ")


def test_example_campaign_is_created(page, folder):
    body = page.post("/api/campaign", json={"name": "a/new", "test": "tumble"}).json()
    assert body["command"].startswith("counterspin init ")
    assert (folder / "a" / "new" / "readings.csv").is_file()
    assert campaign_state(page, "a/new") == "not calibrated"
    again = page.post("/api/campaign", json={"name": "a/new"})
    assert again.status_code == 422
    assert "exists" in again.json()["error"]
    assert page.post("/api/campaign", json={"name": "../new"}).status_code == 403


@pytest.mark.parametrize("record", ["../outside.csv", "/etc/hostname", "link.csv"])
def test_record_outside_folder_is_not_read(page, folder, record):
    (folder.parent / "outside.csv").write_text("time_s\n1\n")
    (folder / "three" / "link.csv").symlink_to(folder.parent / "outside.csv")
    name = record.replace("../", "../../")
    write_description(folder / "three", SMALL.replace("slow.csv", name), "campaign.toml")
    body = page.get("/api/campaign", params={"name": "three"}).json()
    assert "outside the served folder" in body["mistakes"][
        0
    ] or "the name of a record file must end" in str(body)
    assert page.post("/api/jobs", json={"name": "three"}).status_code == 422


@pytest.mark.parametrize(
    ("method", "path", "message", "status"),
    [
        ("GET", "/api/nothing", None, 404),
        ("GET", "/api/campaign?name=nowhere", None, 404),
        ("GET", "/api/campaign?name=../served/three", None, 403),
        ("GET", "/api/campaign", None, 400),
        ("GET", "/api/folder?more=1", None, 400),
        ("POST", "/api/jobs", b"{", 400),
        ("POST", "/api/jobs", b"[1]", 400),
        ("POST", "/api/jobs", b'{"name": "three", "output": "../x.json"}', 422),
        ("POST", "/api/jobs", b'{"name": "three", "output": "campaign.toml"}', 422),
        ("DELETE", "/api/jobs", b'{"number": 7}', 422),
        ("PATCH", "/api/folder", b"", 405),
        ("POST", "/", b"", 405),
        ("GET", "/assets/..%2finterface.py", None, 404),
        ("GET", "/assets/server.py", None, 404),
    ],
)
def test_invalid_request_returns_error_without_traceback(page, method, path, message, status):
    answered = page.request(method, path, content=message)
    assert answered.status_code == status
    assert "Traceback" not in answered.text


def test_surrogates_and_nan_are_encoded_as_json():
    text = to_json({"name": "\udcff.json", "u": [1.0, float("inf"), float("nan")]})
    assert json.loads(text) == {"name": "\udcff.json", "u": [1.0, None, None]}
    assert text.isascii()


def test_pipe_and_undecodable_file_name_are_skipped(page, folder):
    os.mkfifo(folder / "three" / "pipe.json")
    with open(os.path.join(os.fsencode(folder), b"\xff.json"), "w") as file:  # noqa: PTH118, PTH123
        file.write("{}")
    assert campaign_state(page) in ("good", "reservations")
    # A name that no file can have is rejected with a message.
    for request in ({"name": "\ud800"}, {"name": "a/" * 2000}):
        response = page.post("/api/campaign", content=json.dumps(request))
        assert response.status_code == 403, response.text
