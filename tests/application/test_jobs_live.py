"""The live view of a campaign runs only while a page polls it."""

import re
import shutil
import time

import pytest
from served import run_inline

from counterspin.application import jobs
from counterspin.monitoring.result import WatchState


def poll_until(page, until):
    deadline = time.monotonic() + 300.0
    while time.monotonic() < deadline:
        body = page.get("/api/watch", params={"name": "three"}).json()
        if until(body):
            return body
        time.sleep(0.1)
    raise AssertionError(body)


def test_live_view_reports_new_samples(page, folder):
    three = folder / "three"
    shutil.move(three / "fast.csv", folder / "later.csv")
    response = poll_until(page, lambda told: told["html"])
    assert "slow" in response["html"]
    assert response["command"].startswith("counterspin watch ")
    before = response["html"]
    reached = response["reached"]
    assert [quantity["name"] for quantity in reached["u"]] == ["Qx.K_II, µg/g²", "Qy.K_II, µg/g²"]
    # Six revolutions at 0.25 and 0.5 rev/s.
    assert reached["minutes"] == pytest.approx(36.0 / 60.0, rel=1e-2)
    shown = re.findall(r"± ([\d.]+) µg/g²", response["html"])
    assert [float(f"{quantity['u']:.2g}") for quantity in reached["u"]] == list(map(float, shown))
    shutil.move(folder / "later.csv", three / "fast.csv")
    assert poll_until(page, lambda told: told["html"] != before)


def test_live_event_is_listed_once(monkeypatch):
    """The page lists it."""
    event = "slow.csv was replaced."
    state = WatchState(
        title="By hand",
        runs=[],
        coefficients=[],
        goals=[],
        events=[event],
        trouble=None,
        complete=True,
    )
    monkeypatch.setattr("counterspin.monitoring.watch.watch", lambda *_, **__: [state])
    (_, message), *_ = run_inline(jobs.run_live_view, None, "")
    assert message["events"] == [event]
    assert event not in message["html"]
    assert message["html"].count("Every run has reached the duration stated in the campaign.") == 1


def test_live_worker_stops_without_viewers(app, page, monkeypatch):
    monkeypatch.setattr(jobs, "VIEW_TIMEOUT", 0.2)
    page.get("/api/watch", params={"name": "three"})
    (view,) = app.live._views.values()
    # If two threads wait for a process, only one is notified of its end.
    deadline = time.monotonic() + 300.0
    while app.live._views and time.monotonic() < deadline:
        time.sleep(0.02)
    with app.live._lock:
        assert not view.worker.is_alive


@pytest.mark.parametrize("goal", ["0.001", "K_II", "K_9 1e-8 g/g^2", "K_II 1e-8 m"])
def test_invalid_goal_is_rejected_before_start(app, page, goal):
    answered = page.get("/api/watch", params={"name": "three", "goal": goal})
    assert answered.status_code == 422
    error = answered.json()["error"]
    assert error.startswith("goal: ")
    assert goal.split()[0] in error
    assert not app.live._views
