"""Calibration jobs in separate processes."""

import json

from served import wait_for_job


def test_calibration_job_reports_progress_and_writes_result(page, folder):
    result = folder / "three" / "result.json"
    before = json.loads(result.read_text())
    result.unlink()
    request = {"name": "three"}
    begun = page.post("/api/jobs", json=request).json()
    # A second click or a reloaded page finds the same job.
    assert page.post("/api/jobs", json=request).json()["number"] == begun["number"]
    job = wait_for_job(page, begun["number"])
    assert (job["state"], job["progress"]) == ("done", [3, 3])
    assert json.loads(result.read_text()) == before
    assert job["command"].startswith("counterspin calibrate ")


def test_failed_job_has_cause_and_stopped_job_leaves_no_file(page, folder):
    result = folder / "three" / "result.json"
    kept = result.read_bytes()
    (folder / "three" / "slow.csv").write_text("time_s\n1\n")
    first = page.post("/api/jobs", json={"name": "three"}).json()["number"]
    second = page.post("/api/jobs", json={"name": "three", "output": "b.json"}).json()["number"]
    page.request("DELETE", "/api/jobs", json={"number": second})
    assert wait_for_job(page, second)["state"] == "stopped"
    failed = wait_for_job(page, first)
    assert failed["state"] == "failed"
    assert failed["error"].startswith("three/slow.csv")
    assert result.read_bytes() == kept
    assert not (folder / "three" / "b.json").exists()


def test_killed_process_is_reported(page, monkeypatch):
    monkeypatch.setattr("counterspin.application.campaigns.run_calibration", exit)
    number = page.post("/api/jobs", json={"name": "three"}).json()["number"]
    assert "ended unexpectedly" in wait_for_job(page, number)["error"]


def test_process_start_failure_is_reported(page, monkeypatch):
    def raise_unavailable(_):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("multiprocessing.context.SpawnProcess.start", raise_unavailable)
    number = page.post("/api/jobs", json={"name": "three"}).json()["number"]
    assert "temporarily unavailable" in wait_for_job(page, number)["error"]
