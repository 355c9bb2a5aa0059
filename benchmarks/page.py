"""How soon a record is drawn in the page of `counterspin serve`, in Chromium.

    python benchmarks/page.py          # 100,000 and 1,000,000 rows; in build/benchmarks too
    python benchmarks/page.py --keep   # for a release: into benchmarks/results.json and the docs

For each record: the first look, for which its file is read, a later one, and a zoom; seconds from
the click to the last curve, the fastest of three. It stands outside of `make bench`, for it needs
Chromium.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from counterspin.application.access_control import Credentials
from counterspin.application.app_state import AppState
from counterspin.application.served_folder import ServedFolder
from counterspin.application.server import make_server, open_listener
from header import EAST, NORTH, header
from table import Table, render, save

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

ROWS = (100_000, 1_000_000)
ROUNDS = 3

CAMPAIGN = (
    header("One record", EAST, NORTH)
    + """
[[runs]]
name = "run"
rate = "0.5 rev/s"
record = "run.csv"
"""
)


def make(folder: Path, rows: int) -> None:
    """Write a campaign with one record of so many rows."""
    folder.mkdir()
    (folder / "campaign.toml").write_text(CAMPAIGN, encoding="utf-8")
    t = np.arange(rows) / 1000.0
    noise = np.random.default_rng(1).normal(0.0, 0.01, (2, rows))
    east, north = 2.5 * np.cos(np.pi * t) + noise[0], 2.5 * np.sin(np.pi * t) + noise[1]
    np.savetxt(
        folder / "run.csv",
        np.column_stack([t, np.pi * t, east, north]),
        delimiter=",",
        header="time_s,angle_rad,east_m,north_m",
        comments="",
        fmt="%.7g",
    )


def drawn(tab, rows: int, name: str) -> float:
    """Return the seconds from the click on a campaign's records to their last curve."""
    tab.evaluate("location.hash = '#/'")
    tab.get_by_role("heading", name="New campaign").wait_for()
    begun = time.perf_counter()
    tab.evaluate(f"location.hash = '#/runs/{name}'")
    tab.get_by_text(f"({rows:,} rows in total)").wait_for()
    return time.perf_counter() - begun


def zoomed(tab) -> float:
    """Return the seconds from a click on zoom to the next picture."""
    begun = time.perf_counter()
    with tab.expect_response(lambda answer: "/api/record?" in answer.url):
        tab.get_by_role("button", name="Zoom in").click()
    tab.evaluate("new Promise(requestAnimationFrame)")
    return time.perf_counter() - begun


def main(keep: bool) -> None:
    from chromium import launch_chromium

    with tempfile.TemporaryDirectory() as place, open_listener(0) as listener:
        folder = Path(place)
        names = [(rows, f"{rows}-{k}") for rows in ROWS for k in range(ROUNDS)]
        for rows, name in names:
            make(folder / name, rows)
        credentials = Credentials(listener.getsockname()[1])
        server = make_server(AppState(ServedFolder(folder)), credentials)
        thread = threading.Thread(target=server.run, args=([listener],), daemon=True)
        thread.start()
        with launch_chromium() as browser:
            tab = browser.new_page(viewport={"width": 1280, "height": 1000})
            tab.goto(credentials.link)
            found: dict[int, list[float]] = {}
            for rows, name in names:
                times = drawn(tab, rows, name), drawn(tab, rows, name), zoomed(tab)
                best = map(min, times, found.get(rows, times))
                found[rows] = [round(seconds, 2) for seconds in best]
        server.should_exit = True
        thread.join()
    measured = Table(
        "Records in the application",
        "Each value is the time in seconds from a click on the records of a campaign until "
        "Chromium has drawn the last of three curves. The table gives the fastest of three "
        "measurements by `benchmarks/page.py`.",
        ["rows", "first view, including file reading", "later view", "zoom"],
        [[f"{rows:,}", *times] for rows, times in found.items()],
    )
    print(render([measured]))
    save([measured], keep)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", action="store_true", help="renew what docs quote")
    main(parser.parse_args().keep)
