"""What axe-core says of every place of the page, in light and dark, on a app and on a phone."""

import sys
from pathlib import Path

import pytest
from chromium import needs_chromium
from served import PLACES

#: `make setup` installs it beside TypeScript, where there is node.
AXE = Path(sys.prefix) / "typescript" / "node_modules" / "axe-core" / "axe.min.js"

pytestmark = [
    needs_chromium,
    pytest.mark.skipif(not AXE.is_file(), reason="no axe-core: make setup installs it, with npm"),
]

#: Complaints that keep somebody from using the page.
SERIOUS = """async () => {
  const rules = { type: "tag", values: ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"] };
  const { violations } = await axe.run(document, { runOnly: rules });
  return violations
    .filter((one) => ["serious", "critical"].includes(one.impact))
    .flatMap((one) => one.nodes.map((node) => `${one.id}: ${node.html}`));
}"""

#: What is folded is a page's too; of a form with many keys the first parts stand for all.
OPENED = """() => {
  for (const one of [...document.querySelectorAll("details")].slice(0, 40)) one.open = true;
}"""


def bring_a_record(tab, path):
    """Bring a file, so that what is guessed of it is shown and mistakes stand at their fields."""
    tab.get_by_label("Folder of the new campaign").fill("mine")
    tab.get_by_label("The recorder's files").set_input_files(path)
    tab.get_by_label("Local gravity", exact=True).fill("9,81 apples")
    tab.get_by_label("Latitude", exact=True).focus()
    tab.locator("[aria-invalid]").first.wait_for()


@pytest.mark.parametrize("width", [1400, 390], ids=["app", "phone"])
def test_no_place_keeps_anybody_out(opened, app, width):
    app.live.poll = lambda *_: {"html": "<p>Live</p>", "events": ["A run"], "complete": True}
    tab = opened("/")
    tab.set_viewport_size({"width": width, "height": 900})
    tab.evaluate(AXE.read_text(encoding="utf-8"))
    complaints = {}
    for place in (*PLACES, "/", "/ with files"):
        if place == "/ with files":
            bring_a_record(tab, next(app.folder.path("three").glob("*.csv")))
        else:
            tab.evaluate(f"location.hash = {place!r}")
            tab.locator("main:not([aria-busy]) h1").wait_for()
            tab.wait_for_function("document.querySelector('main').ariaBusy === null")
        tab.evaluate(OPENED)
        for scheme in ("light", "dark"):
            tab.emulate_media(color_scheme=scheme)
            if found := tab.evaluate(SERIOUS):
                complaints[place, scheme] = found
    assert complaints == {}
    # It would have said so.
    tab.evaluate("document.querySelector('main').append(document.createElement('button'))")
    assert [one.split(":")[0] for one in tab.evaluate(SERIOUS)] == ["button-name"]
