"""The plan page: changed limits and the best plan within them."""

import tomllib

import pytest
from campaigns import replace_parts
from planning_setups import PERFECT
from served import wait_for_job

from counterspin.application.plans import PLAN_SLIDERS, READING_PLAN_SLIDERS
from counterspin.planning.page import plan_blocks
from counterspin.planning.plan import plan, write_example
from counterspin.planning.plan_sections import LimitsSettings, ReadingLimitsSettings
from counterspin.reports.html import render_fragment
from counterspin.reports.typography import typeset_block


@pytest.fixture
def planned(page, folder):
    file = write_example(folder / "PLAN.toml")
    # Few runs are fast; u comes from the runs, which a plan can change.
    file.write_text(replace_parts(file.read_text(), ("runs = 14", "runs = 2"), *PERFECT))
    return page


def get_plan_page(page, name="PLAN.toml", **moved):
    """Return the page of a plan within changed limits, after its job."""
    request = {"name": name, "moved": moved}
    job = page.post("/api/plan-page", json=request).json()["job"]
    assert (job["kind"], job["output"]) == ("plan", "")
    assert wait_for_job(page, job["number"])["state"] == "done"
    return page.post("/api/plan-page", json=request).json()["html"]


def render_plan(result):
    return render_fragment(list(map(typeset_block, plan_blocks(result))), title=result.title)


def test_limits_have_names_of_plan_file(planned):
    assert PLAN_SLIDERS.keys() <= LimitsSettings.model_fields.keys()
    assert READING_PLAN_SLIDERS.keys() <= ReadingLimitsSettings.model_fields.keys()
    (listed,) = planned.get("/api/folder").json()["plans"]
    assert listed == {"name": "PLAN.toml", "title": "A day at the centrifuge"}
    body = planned.get("/api/plan", params={"name": "PLAN.toml"}).json()
    values = {limit["key"]: limit["value"] for limit in body["limits"]}
    assert (values["total_time"], values["settling"], values["runs"]) == (700.0, 10.0, 2)
    assert all(limit["low"] <= limit["value"] <= limit["high"] for limit in body["limits"])


@pytest.mark.slow
@pytest.mark.usefixtures("inline_jobs")
def test_plan_page_matches_command_within_changed_limits(planned, folder):
    shown = get_plan_page(planned, total_time=1400.0, highest_rate=5.0)
    file = folder / "PLAN.toml"
    text = file.read_text().replace('"700 s"', '"1400 s"')
    file.write_text(text.replace('highest_rate = "1 rev/s"', 'highest_rate = "0.795775 rev/s"'))
    result = plan(file).result
    assert render_plan(result) == shown
    assert "best plan in half the time" in shown
    # The plan file has changed, so the search is repeated.
    assert planned.post("/api/plan-page", json={"name": "PLAN.toml"}).json()["job"] is not None


@pytest.mark.usefixtures("inline_jobs")
def test_failed_plan_search_states_cause(planned, folder):
    refusal = planned.post("/api/plan-page", json={"name": "PLAN.toml", "moved": {"colour": 1.0}})
    assert refusal.json()["code"] == "request-refused"
    assert refusal.json()["error"].startswith("colour ")
    request = {"name": "PLAN.toml", "moved": {"total_time": 1e8}}
    file = folder / "PLAN.toml"
    walk = 'displacement = "0.01 m"\nacceleration = "3e-6 g/Hz^0.5"'
    file.write_text(file.read_text().replace('displacement = "0.01 m"', walk))
    job = wait_for_job(
        planned, planned.post("/api/plan-page", json=request).json()["job"]["number"]
    )
    assert job["state"] == "failed"
    assert "the search covers only" in job["error"]


def test_plan_search_can_be_stopped(planned):
    request = {"name": "PLAN.toml"}
    number = planned.post("/api/plan-page", json=request).json()["job"]["number"]
    # Another request finds the same job while it runs.
    assert planned.post("/api/plan-page", json=request).json()["job"]["number"] == number
    planned.request("DELETE", "/api/jobs", json={"number": number})
    assert wait_for_job(planned, number)["state"] == "stopped"


@pytest.mark.slow
@pytest.mark.usefixtures("inline_jobs")
def test_limits_are_in_units_of_plan_file(planned, folder):
    """The file has rev/s and minutes; the requests are in SI."""
    file = folder / "PLAN.toml"
    text = replace_parts(file.read_text(), ('settling = "10 s"', 'settling = "0.5 min"'))
    file.write_text(text.replace('highest_rate = "1 rev/s"', 'highest_rate = "60 rpm"'))
    body = planned.get("/api/plan", params={"name": "PLAN.toml"}).json()
    limits = {limit["key"]: limit for limit in body["limits"]}
    rate = limits["highest_rate"]
    assert (rate["unit"], rate["value"] / rate["factor"]) == ("rpm", pytest.approx(60.0))
    assert (limits["settling"]["unit"], limits["settling"]["factor"]) == ("min", 60.0)
    moved = {"highest_rate": 45.0 * rate["factor"], "settling": 15.0, "runs": 3.0}
    request = {"name": "PLAN.toml", "moved": moved, "folder": "planned"}
    number = planned.post("/api/planned", json=request).json()["number"]
    assert wait_for_job(planned, number)["state"] == "done"
    written = tomllib.loads(file.read_text())["limits"]
    assert (written["highest_rate"], written["settling"]) == ("45 rpm", "0.25 min")
    assert written["runs"] == 3


@pytest.mark.slow
@pytest.mark.usefixtures("inline_jobs")
def test_plan_page_of_poses_matches_command(page, folder):
    page.post("/api/plan", json={"name": "POSES.toml", "example": "poses"})
    file = folder / "POSES.toml"
    # Few terms are fast.
    file.write_text(file.read_text() + '[model]\nassume = "all"\nterms = ["K_F", "K_I"]\n')
    body = page.get("/api/plan", params={"name": "POSES.toml"}).json()
    assert body["title"] == "Poses of a sensor"
    (limit,) = body["limits"]
    assert (limit["key"], limit["value"], limit["low"], limit["high"]) == ("readings", 18, 4, 72)
    shown = get_plan_page(page, "POSES.toml", readings=12.0)
    text = file.read_text()
    request = {"name": "POSES.toml", "moved": {"readings": 12.0}, "folder": "poses"}
    number = page.post("/api/planned", json=request).json()["number"]
    assert wait_for_job(page, number)["state"] == "done"
    assert file.read_text() == text.replace("readings = 18", "readings = 12")
    assert render_plan(plan(file).result) == shown
    runs = tomllib.loads((folder / "poses" / "campaign.toml").read_text())["runs"]
    assert len(runs) == 12


def test_plan_file_can_be_edited(planned, folder):
    body = planned.get("/api/plan-text", params={"name": "PLAN.toml"}).json()
    assert [section["key"] for section in body["form"]][:2] == ["goal", "limits"]
    assert body["problems"] == []
    request = {"file": "PLAN.toml", "text": body["text"], "path": ["limits", "settling"]}
    wrong = planned.post("/api/change", json=request | {"value": "10 kg"}).json()
    ((key, words),) = ((problem["key"], problem["words"]) for problem in wrong["problems"])
    assert key == "limits.settling"
    assert "kg" in words
    good = planned.post("/api/change", json=request | {"value": "20 s"}).json()
    assert good["problems"] == []
    payload = {"file": "PLAN.toml", "text": good["text"], "version": body["version"]}
    assert planned.put("/api/text", json=payload).is_success
    limits = planned.get("/api/plan", params={"name": "PLAN.toml"}).json()["limits"]
    assert {limit["key"]: limit["value"] for limit in limits}["settling"] == 20.0
    refusal = planned.put("/api/text", json=payload | {"text": "schema = 1"})
    assert "nothing was saved" in refusal.json()["error"]
    (folder / "other.toml").write_text("schema = 1\n")
    assert planned.get("/api/plan-text", params={"name": "other.toml"}).status_code == 403
    other = payload | {"file": "other.toml"}
    request = {"file": "other.toml", "text": "a = 1"}
    assert planned.post("/api/check", json=request).status_code == 403
    assert planned.put("/api/text", json=other).status_code == 403


@pytest.mark.usefixtures("inline_jobs")
def test_limits_and_planned_campaign_are_written(planned, folder):
    request = {"name": "PLAN.toml", "moved": {"total_time": 600.0}, "folder": "planned"}
    body = planned.post("/api/planned", json=request).json()
    assert body["command"].startswith("counterspin plan ")
    assert body["output"] == "planned"
    assert wait_for_job(planned, body["number"])["state"] == "done"
    text = (folder / "PLAN.toml").read_text()
    assert tomllib.loads(text)["limits"]["total_time"] == "600 s"
    assert "# includes records, spin-up, settling and changes of attitude" in text
    assert (folder / "planned" / "campaign.toml").is_file()
    again = planned.post("/api/planned", json=request)
    assert again.status_code == 422
    assert "exists" in again.json()["error"]


def test_example_plan_is_created_and_other_file_type_rejected(page, folder):
    assert page.post("/api/plan", json={"name": "a.toml"}).is_success
    assert page.post("/api/plan", json={"name": "a.toml"}).status_code == 422
    assert page.post("/api/plan", json={"name": "a.csv"}).status_code == 422
    assert page.post("/api/plan", json={"name": "my plan"}).json() == {"name": "my plan.toml"}
    query = {"name": "three/campaign.toml"}
    assert page.get("/api/plan", params=query).status_code == 422


@pytest.mark.slow
@pytest.mark.usefixtures("inline_jobs")
def test_failed_plan_changes_no_file(planned, folder):
    file = folder / "PLAN.toml"
    before = file.read_text()
    request = {"name": "PLAN.toml", "moved": {"total_time": 1.0}, "folder": "planned"}
    # A plan whose folder cannot be created changes no file either.
    other = request | {"moved": {"total_time": 600.0}, "folder": "three/slow.csv"}
    for body in (request, other):
        number = planned.post("/api/planned", json=body).json()["number"]
        assert wait_for_job(planned, number)["state"] == "failed"
        assert file.read_text() == before
    assert not (folder / "planned").exists()


def test_stopped_plan_changes_no_file(planned, folder):
    before = (folder / "PLAN.toml").read_text()
    request = {"name": "PLAN.toml", "moved": {"total_time": 600.0}, "folder": "planned"}
    number = planned.post("/api/planned", json=request).json()["number"]
    planned.request("DELETE", "/api/jobs", json={"number": number})
    assert wait_for_job(planned, number)["state"] == "stopped"
    assert (folder / "PLAN.toml").read_text() == before
    assert not (folder / "planned").exists()
