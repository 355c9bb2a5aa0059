"""Time the drawing of a record in the page of `counterspin serve`, in Chromium.

    python benchmarks/page.py          # 100,000 and 1,000,000 rows; writes to build/benchmarks
    python benchmarks/page.py --keep   # for a release: updates benchmarks/results.json and the docs

Measured for each record: the first view, which reads its file, a later view, and a zoom, in
seconds from the click to the last curve; the fastest of three. Not part of `make bench`, because
it needs Chromium.
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

ROW_COUNTS = (100_000, 1_000_000)
N_REPEATS = 3

CAMPAIGN = (
    header("One record", EAST, NORTH)
    + """
[[runs]]
name = "run"
rate = "0.5 rev/s"
record = "run.csv"
"""
)


def write_campaign(folder: Path, n_rows: int) -> None:
    """Write a campaign with one record of `n_rows` rows."""
    folder.mkdir()
    (folder / "campaign.toml").write_text(CAMPAIGN, encoding="utf-8")
    t = np.arange(n_rows) / 1000.0
    noise = np.random.default_rng(1).normal(0.0, 0.01, (2, n_rows))
    east, north = 2.5 * np.cos(np.pi * t) + noise[0], 2.5 * np.sin(np.pi * t) + noise[1]
    np.savetxt(
        folder / "run.csv",
        np.column_stack([t, np.pi * t, east, north]),
        delimiter=",",
        header="time_s,angle_rad,east_m,north_m",
        comments="",
        fmt="%.7g",
    )


def time_view(tab, n_rows: int, name: str) -> float:
    """Return the seconds from the click on the records of a campaign to the last curve."""
    tab.evaluate("location.hash = '#/'")
    tab.get_by_role("heading", name="New campaign").wait_for()
    start = time.perf_counter()
    tab.evaluate(f"location.hash = '#/runs/{name}'")
    tab.get_by_text(f"({n_rows:,} rows in total)").wait_for()
    return time.perf_counter() - start


def time_zoom(tab) -> float:
    """Return the seconds from a click on "Zoom in" to the next picture."""
    start = time.perf_counter()
    with tab.expect_response(lambda response: "/api/record?" in response.url):
        tab.get_by_role("button", name="Zoom in").click()
    tab.evaluate("new Promise(requestAnimationFrame)")
    return time.perf_counter() - start


def main(keep: bool) -> None:
    from chromium import launch_chromium

    with tempfile.TemporaryDirectory() as parent, open_listener(0) as listener:
        folder = Path(parent)
        names = [(rows, f"{rows}-{k}") for rows in ROW_COUNTS for k in range(N_REPEATS)]
        for n_rows, name in names:
            write_campaign(folder / name, n_rows)
        credentials = Credentials(listener.getsockname()[1])
        server = make_server(AppState(ServedFolder(folder)), credentials)
        thread = threading.Thread(target=server.run, args=([listener],), daemon=True)
        thread.start()
        with launch_chromium() as browser:
            tab = browser.new_page(viewport={"width": 1280, "height": 1000})
            tab.goto(credentials.link)
            best_times: dict[int, list[float]] = {}
            for n_rows, name in names:
                times = time_view(tab, n_rows, name), time_view(tab, n_rows, name), time_zoom(tab)
                minima = map(min, times, best_times.get(n_rows, times))
                best_times[n_rows] = [round(seconds, 2) for seconds in minima]
        server.should_exit = True
        thread.join()
    table = Table(
        "Records in the application",
        "Each value is the time in seconds from a click on the records of a campaign until "
        "Chromium has drawn the last of three curves. The table gives the fastest of three "
        "measurements by `benchmarks/page.py`.",
        ["rows", "first view, including file reading", "later view", "zoom"],
        [[f"{rows:,}", *times] for rows, times in best_times.items()],
    )
    print(render([table]))
    save([table], keep)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", action="store_true", help="update the documentation")
    main(parser.parse_args().keep)
