"""Regenerate the pictures and examples of the documentation: `make pictures`.

The documented commands generate everything with a fixed date, so that unchanged content gives
identical files. The screenshots need Chromium and Playwright; without Chromium, the script prints a
message and skips them.
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

#: Viewport of the report screenshot in the README, pixels.
REPORT_VIEWPORT = {"width": 1000, "height": 1180}
#: Viewport of the application screenshots, pixels.
APPLICATION_VIEWPORT = {"width": 1100, "height": 860}

GALLERY = DOCS / "gallery"
#: Code cell of a gallery page.
CODE_CELL = re.compile(
    r"^```\{code-cell\} python3\n(?:---\n.*?^---\n)?(.*?)^```$", re.MULTILINE | re.DOTALL
)


def run_command(*arguments: str | Path) -> None:
    """Run a counterspin command; exit if it fails."""
    status = main([str(argument) for argument in arguments])
    if status:
        sys.exit(status)


def draw_demonstration() -> None:
    """Draw the figure of the demonstration."""
    with tempfile.TemporaryDirectory() as folder:
        run_command("demo", "-o", folder)
        shutil.copy(Path(folder) / "displacement.svg", IMAGES)


def calibrate_example() -> None:
    """Simulate the example campaign and write its result."""
    with tempfile.TemporaryDirectory() as folder:
        run_command("simulate", EXAMPLES / "campaign.toml", "-o", folder)
        run_command("calibrate", folder, "--json", EXAMPLES / "result.json", "--overwrite")


def write_example_documents() -> None:
    """Write the report and certificate of the example result."""
    result, lab = EXAMPLES / "result.json", EXAMPLES / "LAB.toml"
    for name in ("report.html", "report.pdf"):
        run_command("report", result, "-o", EXAMPLES / name, "--date", DATE, "--overwrite")
    for name in ("certificate.xml", "certificate.pdf"):
        (EXAMPLES / name).unlink(missing_ok=True)  # commands never overwrite a certificate
        run_command("certificate", result, lab, "-o", EXAMPLES / name)


def draw_tutorial_figures() -> None:
    """Draw a record and the uncertainty budget of its result for the tutorial."""
    import numpy as np

    import counterspin as cs
    from counterspin.calibration.pages.pictures import budget_bars
    from counterspin.reports.blocks import Plot, PlotSeries
    from counterspin.reports.charts import save_figure

    campaign = cs.simulate(cs.read_campaign(EXAMPLES / "campaign.toml"))
    result = cs.calibrate(campaign)
    columns = dict(campaign.record_at(campaign.runs[-1].record).columns)
    time, displacement = (np.asarray(columns[name]) for name in ("time_s", "east_m"))
    is_shown = time <= 5.0
    record_plot = Plot(
        title="Five seconds of a record: the displacement to the east, one revolution a second",
        x_label="time, s",
        y_label="displacement, m",
        series=(PlotSeries("recorded", tuple(time[is_shown]), tuple(displacement[is_shown])),),
    )
    residuals = result.residuals("Qx", campaign.runs[-1].name)
    thinned = residuals.gather_every(max(1, residuals.height // 100))
    error_plot = Plot(
        title="The whole record minus the true motion, and the fit through it",
        x_label="time, s",
        y_label="error, m",
        series=(
            PlotSeries("recorded", tuple(thinned["time"]), tuple(thinned["error"]), kind="points"),
            PlotSeries("fitted", tuple(thinned["time"]), tuple(thinned["fitted"]), colour=1),
        ),
    )
    save_figure([record_plot, error_plot], IMAGES / "record.svg", overwrite=True)
    bars = budget_bars("Qx", result.accelerometers["Qx"], "K_II")
    assert bars is not None
    save_figure([bars], IMAGES / "budget.svg", overwrite=True)


def read_cells(page: Path) -> list[str]:
    """Return the code of the cells of a gallery page."""
    return CODE_CELL.findall(page.read_text(encoding="utf-8"))


def hash_cells(page: Path) -> str:
    """Return the hash of the cells of a page, stored in its thumbnail to detect changes."""
    return hashlib.sha256("\0".join(read_cells(page)).encode()).hexdigest()[:16]


def draw_thumbnails() -> None:
    """Run the gallery pages; save the first figure of each as a thumbnail."""
    import matplotlib as mpl
    from cycler import cycler

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    plt.rcParams["figure.constrained_layout.use"] = True
    plt.rcParams["axes.prop_cycle"] = cycler(color=COLOURS)
    for page in sorted(set(GALLERY.glob("*.md")) - {GALLERY / "index.md"}):
        namespace: dict[str, Any] = {}
        with chdir(GALLERY):
            for cell in read_cells(page):
                exec(compile(cell, page.name, "exec"), namespace)
                if plt.get_fignums():
                    break
        plt.figure(plt.get_fignums()[0])
        plt.gcf().set_size_inches(6.0, 3.4)
        image_file = IMAGES / f"gallery-{page.stem}.png"
        metadata = {"Software": None, "Comment": hash_cells(page)}
        plt.savefig(image_file, dpi=60, bbox_inches="tight", metadata=metadata)
        plt.close("all")


def take_screenshots() -> None:
    """Take screenshots of report and application."""
    chromium = os.environ.get("COUNTERSPIN_CHROMIUM") or shutil.which("chromium")
    if chromium is None:
        print("No screenshots: there is no Chromium (COUNTERSPIN_CHROMIUM may name one).")
        return
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        take_report_screenshots(browser)
        take_application_screenshots(browser)
        browser.close()


def take_report_screenshots(browser: Any) -> None:
    """Take screenshots of the example report in light and dark mode."""
    report_url = (EXAMPLES / "report.html").as_uri()
    for scheme in ("light", "dark"):
        page = browser.new_page(viewport=REPORT_VIEWPORT, color_scheme=scheme)
        page.goto(report_url)
        page.screenshot(path=IMAGES / f"report-{scheme}.png")
        page.close()


def take_application_screenshots(browser: Any) -> None:
    """Take screenshots of the application: an import preview and a result."""
    from counterspin.application.access_control import Credentials
    from counterspin.application.app_state import AppState
    from counterspin.application.served_folder import ServedFolder
    from counterspin.application.server import make_server, open_listener

    with tempfile.TemporaryDirectory() as parent, open_listener(0) as listener:
        folder = Path(parent) / "campaigns"
        run_command("simulate", EXAMPLES / "campaign.toml", "-o", folder / "first")
        run_command("calibrate", folder / "first", "--json", folder / "first" / "result.json")
        app, credentials = AppState(ServedFolder(folder)), Credentials(listener.getsockname()[1])
        server = make_server(app, credentials)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            page = browser.new_page(viewport=APPLICATION_VIEWPORT)
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
    draw_demonstration()
    calibrate_example()
    write_example_documents()
    draw_tutorial_figures()
    draw_thumbnails()
    take_screenshots()
