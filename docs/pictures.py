"""Make the pictures and examples of the documentation again: `make pictures`.

Everything comes from the commands that the documentation describes, with a fixed date, so that
only what has changed becomes another file. The screenshots need Chromium and Playwright; without
them the rest is made and the lack is said.
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path

from counterspin.cli import main
from counterspin.reports.machine.drawings import DRAWINGS, machine_svg

DOCS = Path(__file__).parent
IMAGES = DOCS / "images"
EXAMPLES = DOCS / "examples" / "three-rate"
DATE = "2026-03-01"

#: What the README shows of the report: the part of the page that is seen first.
VIEW = {"width": 1000, "height": 1180}


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


def draw_the_machine() -> None:
    """Write the drawings of the machine."""
    for name in DRAWINGS:
        (IMAGES / f"machine-{name}.svg").write_text(machine_svg(name), encoding="utf-8")


def draw_the_plan() -> None:
    """Draw the figures of the example plan where what it does not state is perfect."""
    with tempfile.TemporaryDirectory() as folder:
        example = Path(folder) / "PLAN.toml"
        run("plan", "--init", example)
        text = example.read_text(encoding="utf-8")
        for line in ('assume = "all"', "fewest_rates = 1"):
            text = text.replace(f"# {line}", line)
        example.write_text(text, encoding="utf-8")
        run("plan", example, "--figures", IMAGES, "--overwrite")


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


def photograph_the_report() -> None:
    """Take pictures of the example report as a browser shows it, light and dark."""
    chromium = os.environ.get("COUNTERSPIN_CHROMIUM") or shutil.which("chromium")
    if chromium is None:
        print("No screenshots: there is no Chromium (COUNTERSPIN_CHROMIUM may name one).")
        return
    from playwright.sync_api import sync_playwright

    page_of_report = (EXAMPLES / "report.html").as_uri()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for scheme in ("light", "dark"):
            page = browser.new_page(viewport=VIEW, color_scheme=scheme)  # type: ignore[arg-type]
            page.goto(page_of_report)
            page.screenshot(path=IMAGES / f"report-{scheme}.png")
            page.close()
        browser.close()


if __name__ == "__main__":
    os.environ["SOURCE_DATE_EPOCH"] = "1772323200"  # DATE, for the certificate
    IMAGES.mkdir(exist_ok=True)
    draw_the_machine()
    draw_the_demonstration()
    draw_the_plan()
    calibrate_the_example()
    write_the_examples()
    photograph_the_report()
