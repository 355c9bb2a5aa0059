"""Jobs for studies and simulated records."""

import pytest
from served import wait_for_job

from counterspin.studies.study import study


def run_job(page, body, **said):
    begun = page.post(f"/api/{body}", json={"name": "three"} | said)
    assert begun.status_code == 200, begun.text
    return wait_for_job(page, begun.json()["number"])


def test_study_job_reports_progress_and_writes_result(page, folder):
    job = run_job(page, "study", trials=6)
    assert (job["state"], job["kind"], job["progress"]) == ("done", "study", [6, 6])
    assert job["command"].startswith("counterspin study ")
    kept = folder / "three" / "study.json"
    assert kept.read_text() == study(folder / "three", trials=6).to_json()
    assert page.get("/api/campaign", params={"name": "three"}).json()["study"] == job["output"]
    body = page.get("/api/page", params={"kind": "study", "names": job["output"]}).json()
    assert "6 trials" in body["html"]
    assert "--trials=6" in body["command"]


def test_invalid_study_is_rejected_before_start(page, folder):
    description = folder / "three" / "campaign.toml"
    text = description.read_text()
    description.write_text(text + "[study.vary]\ncolour = 1\n")
    body = page.post("/api/study", json={"name": "three", "trials": 6}).json()
    assert any(problem.startswith("study.vary.colour") for problem in body["problems"])
    # The editor also shows the error at its key.
    request = {"file": "three/campaign.toml", "text": description.read_text()}
    wrong = page.post("/api/check", json=request).json()["problems"]
    assert [one["key"] for one in wrong] == ["study.vary.colour"] * len(wrong) != []


@pytest.mark.usefixtures("inline_jobs")
def test_study_duration_is_estimated_again_after_change(page, folder):
    job = page.post("/api/study-duration", json={"name": "three"}).json()["job"]
    assert (job["state"], job["kind"], job["output"]) == ("done", "estimate", "")
    answer = page.post("/api/study-duration", json={"name": "three"}).json()
    # No analysis of this campaign needs full records.
    duration = answer["duration"]
    assert (answer["job"], duration["slow_analyses"]) == (None, "")
    assert 0.0 < 1000 * duration["per_trial"] < 0.1
    assert duration["preparation"] > 0.0
    description = folder / "three" / "campaign.toml"
    description.write_text(description.read_text() + "\n")
    assert page.post("/api/study-duration", json={"name": "three"}).json()["job"] is not None


@pytest.mark.usefixtures("inline_jobs")
def test_records_are_simulated_into_new_folder(page, folder):
    job = run_job(page, "simulation", folder="again")
    assert (job["state"], job["output"]) == ("done", "again")
    # The description states the seed.
    assert (folder / "again" / "slow.csv").read_bytes() == (
        folder / "three" / "slow.csv"
    ).read_bytes()


@pytest.mark.usefixtures("inline_jobs")
@pytest.mark.parametrize(
    ("where", "status"), [("", 422), ("three", 422), ("../x", 403), ("slow.csv/x", 200)]
)
def test_simulation_does_not_overwrite_files_or_leave_folder(page, folder, where, status):
    (folder / "slow.csv").write_text("mine")
    request = {"name": "three", "folder": where}
    answered = page.post("/api/simulation", json=request)
    assert answered.status_code == status
    if status == 200:
        assert wait_for_job(page, answered.json()["number"])["state"] == "failed"
    assert (folder / "slow.csv").read_text() == "mine"


@pytest.mark.usefixtures("inline_jobs")
def test_simulation_rejects_records_outside_folder(page, folder):
    (folder / "a").mkdir()
    text = (folder / "three" / "campaign.toml").read_text()
    (folder / "a" / "campaign.toml").write_text(
        text.replace('record = "slow.csv"', 'record = "../slow.csv"')
    )
    assert page.post("/api/simulation", json={"name": "a", "folder": "b"}).status_code == 200
    (folder / "a" / "c").mkdir()
    (folder / "a" / "c" / "campaign.toml").write_text(
        text.replace('record = "slow.csv"', 'record = "../../slow.csv"')
    )
    response = page.post("/api/simulation", json={"name": "a/c", "folder": "b"})
    assert response.status_code == 422
    assert "outside the served folder" in response.text
