"""Make the pictures and examples of the documentation again: `make pictures`.

Everything comes from the commands that the documentation describes, with a fixed date, so that
only what has changed becomes another file. The screenshots need Chromium and Playwright; without
them the rest is made and the lack is said.
"""

import hashlib
import os
import re
import shutil
import sys
import tempfile
import threading
from contextlib import chdir
from pathlib import Path
from typing import Any

from counterspin.cli import main
from counterspin.reports.drawing import COLOURS

DOCS = Path(__file__).parent
IMAGES = DOCS / "images"
EXAMPLES = DOCS / "examples" / "three-rate"
DATE = "2026-03-01"

#: What the README shows of the report: the part of the page that is seen first.
VIEW = {"width": 1000, "height": 1180}
#: Of the application's window.
WINDOW = {"width": 1100, "height": 860}

GALLERY = DOCS / "gallery"
#: A cell of a page of the gallery.
CELL = re.compile(
    r"^```\{code-cell\} python3\n(?:---\n.*?^---\n)?(.*?)^```$", re.MULTILINE | re.DOTALL
)


def run(*words: str | Path) -> None:
    """Run one command of counterspin; stop where it fails."""
    status = main([str(word) for word in words])
    if status:
        sys.exit(status)


def draw_the_demonstration() -> None:
    """Draw the figure of the demonstration."""
    with tempfile.TemporaryDirectory() as folder:
        run("demo", "-o", folder)
        shutil.copy(Path(folder) / "displacement.svg", IMAGES)


def calibrate_the_example() -> None:
    """Simulate the example campaign and write its result."""
    with tempfile.TemporaryDirectory() as folder:
        run("simulate", EXAMPLES / "campaign.toml", "-o", folder)
        run("calibrate", folder, "--json", EXAMPLES / "result.json", "--overwrite")


def write_the_examples() -> None:
    """Write report and certificate of the example result."""
    result, lab = EXAMPLES / "result.json", EXAMPLES / "LAB.toml"
    for name in ("report.html", "report.pdf"):
        run("report", result, "-o", EXAMPLES / name, "--date", DATE, "--overwrite")
    for name in ("certificate.xml", "certificate.pdf"):
        (EXAMPLES / name).unlink(missing_ok=True)  # no command replaces a certificate
        run("certificate", result, lab, "-o", EXAMPLES / name)


def draw_the_tutorial() -> None:
    """Draw a record, and what the uncertainty of its result consists of, for the tutorial."""
    import numpy as np

    import counterspin as cs
    from counterspin.calibration.pages.pictures import budget_bars
    from counterspin.reports.blocks import Plot, PlotSeries
    from counterspin.reports.charts import save_figure

    campaign = cs.simulate(cs.read_campaign(EXAMPLES / "campaign.toml"))
    result = cs.calibrate(campaign)
    columns = dict(campaign.record_at(campaign.runs[-1].record).columns)
    time, east = (np.asarray(columns[name]) for name in ("time_s", "east_m"))
    seconds = time <= 5.0
    recorded = Plot(
        title="Five seconds of a record: the displacement to the east, one revolution a second",
        x_label="time, s",
        y_label="displacement, m",
        series=(PlotSeries("recorded", tuple(time[seconds]), tuple(east[seconds])),),
    )
    residuals = result.residuals("Qx", campaign.runs[-1].name)
    some = residuals.gather_every(max(1, residuals.height // 100))
    error = Plot(
        title="The whole record minus the true motion, and the fit through it",
        x_label="time, s",
        y_label="error, m",
        series=(
            PlotSeries("recorded", tuple(some["time"]), tuple(some["error"]), kind="points"),
            PlotSeries("fitted", tuple(some["time"]), tuple(some["fitted"]), colour=1),
        ),
    )
    save_figure([recorded, error], IMAGES / "record.svg", overwrite=True)
    bars = budget_bars("Qx", result.accelerometers["Qx"], "K_II")
    assert bars is not None
    save_figure([bars], IMAGES / "budget.svg", overwrite=True)


def cells_of(page: Path) -> list[str]:
    """Return the code of a gallery page's cells."""
    return CELL.findall(page.read_text(encoding="utf-8"))


def mark_of(page: Path) -> str:
    """Return what a page's thumbnail carries: it shows whether the page has changed since."""
    return hashlib.sha256("\0".join(cells_of(page)).encode()).hexdigest()[:16]


def draw_the_thumbnails() -> None:
    """Run the pages of the gallery, and keep the first picture of each, small."""
    import matplotlib as mpl
    from cycler import cycler

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    plt.rcParams["figure.constrained_layout.use"] = True
    plt.rcParams["axes.prop_cycle"] = cycler(color=COLOURS)
    for page in sorted(set(GALLERY.glob("*.md")) - {GALLERY / "index.md"}):
        space: dict[str, Any] = {}
        with chdir(GALLERY):
            for cell in cells_of(page):
                exec(compile(cell, page.name, "exec"), space)
                if plt.get_fignums():
                    break
        plt.figure(plt.get_fignums()[0])
        plt.gcf().set_size_inches(6.0, 3.4)
        place = IMAGES / f"gallery-{page.stem}.png"
        said = {"Software": None, "Comment": mark_of(page)}
        plt.savefig(place, dpi=60, bbox_inches="tight", metadata=said)
        plt.close("all")


def photograph() -> None:
    """Take pictures of report and application as a browser shows them."""
    chromium = os.environ.get("COUNTERSPIN_CHROMIUM") or shutil.which("chromium")
    if chromium is None:
        print("No screenshots: there is no Chromium (COUNTERSPIN_CHROMIUM may name one).")
        return
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        photograph_the_report(browser)
        photograph_the_application(browser)
        browser.close()


def photograph_the_report(browser: Any) -> None:
    """Take pictures of the example report, light and dark."""
    page_of_report = (EXAMPLES / "report.html").as_uri()
    for scheme in ("light", "dark"):
        page = browser.new_page(viewport=VIEW, color_scheme=scheme)
        page.goto(page_of_report)
        page.screenshot(path=IMAGES / f"report-{scheme}.png")
        page.close()


def photograph_the_application(browser: Any) -> None:
    """Take pictures of the application: an import before it is written, and a result."""
    from counterspin.application.access_control import Credentials
    from counterspin.application.app_state import AppState
    from counterspin.application.served_folder import ServedFolder
    from counterspin.application.server import make_server, open_listener

    with tempfile.TemporaryDirectory() as place, open_listener(0) as listener:
        folder = Path(place) / "campaigns"
        run("simulate", EXAMPLES / "campaign.toml", "-o", folder / "first")
        run("calibrate", folder / "first", "--json", folder / "first" / "result.json")
        app, credentials = AppState(ServedFolder(folder)), Credentials(listener.getsockname()[1])
        server = make_server(app, credentials)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            page = browser.new_page(viewport=WINDOW)
            page.goto(credentials.link)
            page.get_by_label("Folder for the new campaign").fill("mine")
            records = sorted((folder / "first").glob("*.csv"))
            page.get_by_label("Recorder files").set_input_files(records)
            page.get_by_role("img", name="Double turntable").wait_for()
            page.locator("#view").screenshot(path=IMAGES / "application-import.png")
            page.goto(credentials.link.partition("#")[0] + "#/campaign/first")
            page.get_by_role("heading", name="Quality checks").wait_for()
            page.evaluate("scrollTo(0, 0)")
            page.screenshot(path=IMAGES / "application-result.png")
            page.close()
        finally:
            server.should_exit = True
            thread.join()
            app.close()


if __name__ == "__main__":
    os.environ["SOURCE_DATE_EPOCH"] = "1772323200"  # DATE, for the certificate
    IMAGES.mkdir(exist_ok=True)
    draw_the_demonstration()
    calibrate_the_example()
    write_the_examples()
    draw_the_tutorial()
    draw_the_thumbnails()
    photograph()
