"""Violations that axe-core reports for each page, in light and dark, on desktop and phone."""

import shutil
import sys
from pathlib import Path

import pytest
from chromium import needs_chromium
from served import PLACES

from counterspin.application import laboratory

#: `make setup` installs axe-core next to TypeScript if node is available.
AXE = Path(sys.prefix) / "typescript" / "node_modules" / "axe-core" / "axe.min.js"

pytestmark = [
    needs_chromium,
    pytest.mark.skipif(not AXE.is_file(), reason="no axe-core: make setup installs it, with npm"),
]

#: Rules of axe-core; a second scheme changes only colours.
RULES = {"type": "tag", "values": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]}
COLOURS = ["color-contrast"]

#: Width of the screen -> schemes with their rules.
SCHEMES = {1400: {"light": RULES, "dark": COLOURS}, 390: {"dark": RULES}}

#: Serious violations of the rules.
SERIOUS = """async (rules) => {
  const { violations } = await axe.run(document, { runOnly: rules, resultTypes: ["violations"] });
  return violations
    .filter((one) => ["serious", "critical"].includes(one.impact))
    .flatMap((one) => one.nodes.map((node) => `${one.id}: ${node.html}`));
}"""

#: Open folded elements; check only the first parts of large forms.
OPENED = """() => {
  for (const one of [...document.querySelectorAll("details")].slice(0, 40)) one.open = true;
}"""

TOUR = "sessionStorage.setItem('counterspin-tour', 'three')"


def go_to(tab, place):
    """Go to a page and wait until it is shown."""
    tab.evaluate(f"location.hash = {place!r}")
    tab.locator("main:not([aria-busy]) h1").wait_for()
    tab.wait_for_function("document.querySelector('main').ariaBusy === null")


def import_record(tab, path):
    """Import a file and give an invalid answer, which the page marks at its field."""
    go_to(tab, "/")
    tab.get_by_label("Folder for the new campaign").fill("mine")
    tab.get_by_label("Recorder files").set_input_files(path)
    tab.get_by_label("Local gravity", exact=True).fill("9,81 apples")
    tab.get_by_label("Latitude", exact=True).focus()
    tab.locator("[aria-invalid]").first.wait_for()


def visit_states(tab, app):
    """Show one state of the application after another, and yield its name."""
    shown_below = ("/campaign/three", "/certificate/three%2Fresult.json", "/compare")
    for place in (*PLACES, "/manual/glossary", "/"):
        if place not in shown_below:
            go_to(tab, place)
            yield place
    shutil.copy(app.folder.root / "three" / "result.json", app.folder.root / "b.json")
    go_to(tab, "/compare")
    for name in ("three/result.json", "b.json"):
        tab.get_by_role("checkbox", name=name).check()
    tab.get_by_text("Differences are relative to").wait_for()
    yield "a comparison"
    go_to(tab, "/certificate/three%2Fresult.json")
    tab.get_by_label("Certificate type").select_option("Amendment to CS-1")
    yield "an amendment"
    tab.evaluate(TOUR)
    go_to(tab, "/campaign/three")
    tab.get_by_role("dialog", name="Campaign tour").get_by_text("Next").click()
    yield "the tour"
    import_record(tab, next(app.folder.path("three").glob("*.csv")))
    yield "the columns of a file"
    go_to(tab, "/")
    tab.get_by_text("Continue the import of mine").wait_for()
    yield "an unfinished import"
    go_to(tab, "/import")
    tab.locator("[aria-invalid]").first.wait_for()
    yield "a continued import"


@pytest.mark.parametrize("width", SCHEMES, ids=["desktop", "phone"])
def test_axe_reports_no_serious_violation(open_window, app, width, monkeypatch):
    app.live.poll = lambda *_: {"html": "<p>Live</p>", "events": ["A run"], "complete": True}
    issued = [{"file": "three/certificate.xml", "identifier": "CS-1"}]
    monkeypatch.setattr(laboratory, "_issued_certificates", lambda *_: issued)
    tab = open_window("/")
    tab.set_viewport_size({"width": width, "height": 900})
    tab.evaluate(AXE.read_text(encoding="utf-8"))
    complaints = {}
    for state in visit_states(tab, app):
        tab.evaluate(OPENED)
        for scheme, rules in SCHEMES[width].items():
            tab.emulate_media(color_scheme=scheme)
            if violations := tab.evaluate(SERIOUS, rules):
                complaints[state, scheme] = violations
    assert complaints == {}
    # Both kinds of violations are detected.
    tab.evaluate("document.querySelector('main').append(document.createElement('button'))")
    assert [violation.split(":")[0] for violation in tab.evaluate(SERIOUS, RULES)] == [
        "button-name"
    ]
    tab.evaluate("document.querySelector('h1').style.color = 'var(--rule)'")
    assert [violation.split(":")[0] for violation in tab.evaluate(SERIOUS, COLOURS)] == [
        "color-contrast"
    ]
