"""A campaign that is followed, as long as somebody looks."""

import shutil
import time

from counterspin.application import live


def look(page, until):
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        told = page.get("/api/watch", params={"name": "three"}).json()
        if until(told):
            return told
        time.sleep(0.1)
    raise AssertionError(told)


def test_what_is_new_is_told(page, folder):
    three = folder / "three"
    shutil.move(three / "fast.csv", folder / "later.csv")
    told = look(page, lambda told: told["html"])
    assert "slow" in told["html"]
    assert told["command"].startswith("counterspin watch ")
    before = told["html"]
    shutil.move(folder / "later.csv", three / "fast.csv")
    assert look(page, lambda told: told["html"] != before)


def test_nobody_is_followed_whom_nobody_looks_at(desk, page, monkeypatch):
    monkeypatch.setattr(live, "UNSEEN_SECONDS", 0.2)
    page.get("/api/watch", params={"name": "three"})
    (view,) = desk.live._views.values()
    # Of two threads that wait for a process at once, one is told nothing of its end.
    deadline = time.monotonic() + 30.0
    while desk.live._views and time.monotonic() < deadline:
        time.sleep(0.02)
    with desk.live._lock:
        assert not view.process.is_alive()
