"""Limits that are moved: the best plan within them, at once."""

import tomllib

import pytest
from campaigns import changed
from planning_setups import PERFECT
from served import wait

from counterspin.application.plans import LONGEST_TIME, PLAN_KEYS, READING_PLAN_KEYS
from counterspin.planning.plan import plan, write_example
from counterspin.planning.plan_sections import LimitsSettings, ReadingLimitsSettings


@pytest.fixture
def planned(page, folder):
    file = write_example(folder / "PLAN.toml")
    # The fewer, the sooner; and u is that of the runs, which a plan can change.
    file.write_text(changed(file.read_text(), ("runs = 14", "runs = 4"), *PERFECT))
    return page


def tried(page, name="PLAN.toml", **moved):
    for _ in range(60):
        answered = page.post("/api/plan-try", json={"name": name, "moved": moved})
        assert answered.is_success, answered.text
        if "busy" not in answered.json():
            return answered.json()
    raise AssertionError("no answer")


def refused(page, **moved):
    """Return why there is no plan within limits."""
    for _ in range(60):
        answered = page.post("/api/plan-try", json={"name": "PLAN.toml", "moved": moved})
        if answered.status_code == 422:
            return answered.json()["error"]
        assert answered.json() == {"busy": True}
    raise AssertionError("no answer")


def test_limits_have_the_names_of_the_plan_s_file(planned):
    assert PLAN_KEYS.keys() <= LimitsSettings.model_fields.keys()
    assert READING_PLAN_KEYS.keys() <= ReadingLimitsSettings.model_fields.keys()
    (listed,) = planned.get("/api/folder").json()["plans"]
    assert listed == {"name": "PLAN.toml", "title": "A day at the centrifuge"}
    told = planned.get("/api/plan", params={"name": "PLAN.toml"}).json()
    values = {limit["key"]: limit["value"] for limit in told["limits"]}
    assert (values["total_time"], values["settling"], values["runs"]) == (700.0, 10.0, 4)
    assert all(limit["low"] <= limit["value"] <= limit["high"] for limit in told["limits"])


def test_it_is_the_command_s_plan_within_the_moved_limits(planned, folder):
    """The command searches anew, rounds rates and durations, and forecasts with real columns."""
    told = tried(planned, total_time=1400.0, highest_rate=5.0)
    file = folder / "PLAN.toml"
    text = file.read_text().replace('"700 s"', '"1400 s"')
    file.write_text(text.replace('highest_rate = "1 rev/s"', 'highest_rate = "5 rad/s"'))
    found = plan(file).result
    # Durations are written in steps of 0.1 s, some 1e-3 of them.
    assert told["u"][0]["u"] == pytest.approx(
        found.accelerometers["Qx"].coefficients["K_II"].u, rel=1e-3
    )
    assert told["u"][0]["name"] == "K_II of Qx"
    assert len(told["runs"]) == len(found.runs)
    assert told["time"] <= 1400.0 * (1.0 + 1e-9)


def test_more_time_is_better_and_few_runs_are_few(planned):
    u = [tried(planned, total_time=time)["u"][0]["u"] for time in (350.0, 700.0, 1400.0)]
    assert u == sorted(u, reverse=True)
    assert len(tried(planned, runs=2.0)["runs"]) <= 2
    assert "no such limit" in refused(planned, colour=1.0)


def test_one_process_answers_until_it_is_stopped_or_the_file_changes(planned, desk, folder):
    tried(planned)
    (first,) = desk.live._views.values()
    tried(planned, runs=2.0)
    assert list(desk.live._views.values()) == [first]
    file = folder / "PLAN.toml"
    file.write_text(file.read_text().replace("runs = 4", "runs = 3"))
    assert len(tried(planned)["runs"]) <= 3
    assert not first.worker.is_alive
    planned.request("DELETE", "/api/plan-try", json={"name": "PLAN.toml"})
    assert not desk.live._views


def test_a_search_that_has_no_room_fails_in_a_sentence(planned, folder):
    file = folder / "PLAN.toml"
    text = file.read_text().replace('"700 s"', '"1e8 s"')
    walk = 'displacement = "0.01 m"\nacceleration = "3e-6 g/Hz^0.5"'
    file.write_text(text.replace('displacement = "0.01 m"', walk))
    assert "the search is limited" in refused(planned)


def test_more_time_than_is_tabulated_is_searched_anew(planned, folder):
    file = folder / "PLAN.toml"
    text = file.read_text()
    longer = tried(planned, total_time=7200.0)
    assert longer["time"] <= 7200.0 * (1.0 + 1e-9)
    file.write_text(text.replace('total_time = "700 s"', 'total_time = "7200 s"'))
    (expected, found) = (tried(planned)["u"][0]["u"], longer["u"][0]["u"])
    assert found == pytest.approx(expected, rel=1e-3)


def test_limits_move_less_far_where_runs_would_become_too_long(planned, folder):
    file = folder / "PLAN.toml"
    file.write_text(file.read_text().replace('"700 s"', '"20000 s"'))
    told = planned.get("/api/plan", params={"name": "PLAN.toml"}).json()
    high = {
        limit["key"]: limit["high"] / limit["value"] for limit in told["limits"] if limit["value"]
    }
    assert high["total_time"] == pytest.approx(LONGEST_TIME / 20000.0)
    assert 1.1 < high["highest_rate"] < 1.2


def test_limits_move_in_the_units_of_the_file(planned, folder):
    """rev/s and minutes, as a person wrote them; what is asked is in SI."""
    file = folder / "PLAN.toml"
    text = changed(file.read_text(), ('settling = "10 s"', 'settling = "0.5 min"'))
    file.write_text(text.replace('highest_rate = "1 rev/s"', 'highest_rate = "60 rpm"'))
    told = planned.get("/api/plan", params={"name": "PLAN.toml"}).json()
    limits = {limit["key"]: limit for limit in told["limits"]}
    rate = limits["highest_rate"]
    assert (rate["unit"], rate["value"] / rate["factor"]) == ("rpm", pytest.approx(60.0))
    assert told["rate"]["unit"] == "rpm"
    assert (limits["settling"]["unit"], limits["settling"]["factor"]) == ("min", 60.0)
    moved = {"highest_rate": 45.0 * rate["factor"], "settling": 15.0, "runs": 3.0}
    said = {"name": "PLAN.toml", "moved": moved, "folder": "planned"}
    number = planned.post("/api/planned", json=said).json()["number"]
    assert wait(planned, number)["state"] == "done"
    written = tomllib.loads(file.read_text())["limits"]
    assert (written["highest_rate"], written["settling"]) == ("45 rpm", "0.25 min")
    assert written["runs"] == 3


def test_poses_are_planned_as_the_command_plans_them(page, folder):
    page.post("/api/plan", json={"name": "POSES.toml", "example": "poses"})
    told = page.get("/api/plan", params={"name": "POSES.toml"}).json()
    assert (told["of"], told["title"]) == ("readings", "Poses of a sensor")
    (limit,) = told["limits"]
    assert (limit["key"], limit["value"], limit["low"], limit["high"]) == ("readings", 18, 4, 72)
    found = tried(page, "POSES.toml", readings=12.0)
    file = folder / "POSES.toml"
    text = file.read_text()
    said = {"name": "POSES.toml", "moved": {"readings": 12.0}, "folder": "poses"}
    number = page.post("/api/planned", json=said).json()["number"]
    assert wait(page, number)["state"] == "done"
    assert file.read_text() == text.replace("readings = 18", "readings = 12")
    command = plan(file)
    assert [line["u"] for line in found["u"]] == pytest.approx(
        [command.u[f"{axis}.K_F"] for axis in "XYZ"], rel=1e-9
    )
    assert sum(reading["number"] for reading in found["readings"]) == 12
    runs = tomllib.loads((folder / "poses" / "campaign.toml").read_text())["runs"]
    assert len(runs) == 12
    taken = sorted(run["name"].partition(" ")[2] for run in runs)
    assert taken == sorted(
        name for one in found["readings"] for name in [one["name"]] * one["number"]
    )


def test_a_plan_s_file_is_edited_and_stays_a_plan(planned, folder):
    told = planned.get("/api/plan-text", params={"name": "PLAN.toml"}).json()
    assert [section["key"] for section in told["form"]][:2] == ["goal", "limits"]
    assert told["problems"] == []
    asked = {"file": "PLAN.toml", "text": told["text"], "path": ["limits", "settling"]}
    wrong = planned.post("/api/change", json=asked | {"value": "10 kg"}).json()
    ((key, words),) = ((one["key"], one["words"]) for one in wrong["problems"])
    assert key == "limits.settling"
    assert "kg" in words
    good = planned.post("/api/change", json=asked | {"value": "20 s"}).json()
    assert good["problems"] == []
    said = {"file": "PLAN.toml", "text": good["text"], "version": told["version"]}
    assert planned.put("/api/text", json=said).is_success
    limits = planned.get("/api/plan", params={"name": "PLAN.toml"}).json()["limits"]
    assert {one["key"]: one["value"] for one in limits}["settling"] == 20.0
    refusal = planned.put("/api/text", json=said | {"text": "schema = 1"})
    assert "nothing was saved" in refusal.json()["error"]
    (folder / "other.toml").write_text("schema = 1\n")
    assert planned.get("/api/plan-text", params={"name": "other.toml"}).status_code == 403
    other = said | {"file": "other.toml"}
    asked = {"file": "other.toml", "text": "a = 1"}
    assert planned.post("/api/check", json=asked).status_code == 403
    assert planned.put("/api/text", json=other).status_code == 403


def test_limits_and_the_campaign_are_written(planned, folder):
    said = {"name": "PLAN.toml", "moved": {"total_time": 600.0}, "folder": "planned"}
    made = planned.post("/api/planned", json=said).json()
    assert made["command"].startswith("counterspin plan ")
    assert made["output"] == "planned"
    assert wait(planned, made["number"])["state"] == "done"
    text = (folder / "PLAN.toml").read_text()
    assert tomllib.loads(text)["limits"]["total_time"] == "600 s"
    assert "# records, spin-up, settling and changes of attitude" in text
    assert (folder / "planned" / "campaign.toml").is_file()
    again = planned.post("/api/planned", json=said)
    assert again.status_code == 422
    assert "exists" in again.json()["error"]


def test_an_example_and_what_is_no_plan(page, folder):
    assert page.post("/api/plan", json={"name": "a.toml"}).is_success
    assert page.post("/api/plan", json={"name": "a.toml"}).status_code == 422
    assert page.post("/api/plan", json={"name": "a.csv"}).status_code == 422
    query = {"name": "three/campaign.toml"}
    assert page.get("/api/plan", params=query).status_code == 422


def test_a_plan_that_cannot_be_made_changes_no_file(planned, folder):
    file = folder / "PLAN.toml"
    before = file.read_text()
    said = {"name": "PLAN.toml", "moved": {"total_time": 1.0}, "folder": "planned"}
    # Nor does one whose folder cannot be made.
    other = said | {"moved": {"total_time": 600.0}, "folder": "three/slow.csv"}
    for asked in (said, other):
        number = planned.post("/api/planned", json=asked).json()["number"]
        assert wait(planned, number)["state"] == "failed"
        assert file.read_text() == before
    assert not (folder / "planned").exists()


def test_one_that_is_stopped_changes_no_file(planned, folder):
    before = (folder / "PLAN.toml").read_text()
    said = {"name": "PLAN.toml", "moved": {"total_time": 600.0}, "folder": "planned"}
    number = planned.post("/api/planned", json=said).json()["number"]
    planned.request("DELETE", "/api/jobs", json={"number": number})
    assert wait(planned, number)["state"] == "stopped"
    assert (folder / "PLAN.toml").read_text() == before
    assert not (folder / "planned").exists()
