"""The site's structure, without building it: menu, reference, gallery. `make docs` builds it."""

import re
import runpy
from pathlib import Path

import pytest

import counterspin as cs
from counterspin import cli

DOCS = Path(__file__).parents[1] / "docs"
NAVIGATION = runpy.run_path(str(DOCS / "extensions" / "navigation.py"))
FROM_CODE = runpy.run_path(str(DOCS / "extensions" / "from_code.py"))
INDEX = (DOCS / "index.md").read_text(encoding="utf-8")


def test_every_page_is_in_the_menu_once():
    pages = [page for listed in NAVIGATION["sections"](INDEX).values() for page in listed]
    there = {page.stem for page in DOCS.glob("*.md")} - {"index"}
    assert sorted(pages) == sorted(there)


def test_the_menu_has_the_headings_of_the_index():
    menu = NAVIGATION["with_menu"]("# T\n\n## Do\n\n| p | f |\n|---|---|\n| [A](a.md) | a |\n")
    assert ":caption: Do\n\na\n" in menu
    assert menu.count("toctree") == 1


def test_every_public_name_is_in_the_reference_once():
    page = FROM_CODE["public_names"]()
    named = re.findall(r"^\.\. auto\w+:: counterspin\.(\w+)$", page, re.MULTILINE)
    assert sorted(named) == cs.__all__


def test_names_stand_in_the_groups_of_the_docstring():
    groups = FROM_CODE["groups"]()
    assert "calibrate" in groups["The commands, as functions"]
    assert "TERMS" in groups["The physics, from the ground up"]
    assert "RecordError" in groups["Mistakes"]


def test_what_objects_offer_is_told_too():
    told = {part.__qualname__ for part in FROM_CODE["parts"]()}
    assert {"Coefficient", "Finding", "Covariance", "RunResiduals", "SpindleFit", "Row"} <= told
    assert told.isdisjoint(cs.__all__)


def test_every_command_and_option_is_told():
    page = FROM_CODE["commands"]()
    for name in (name for name in cli.app if not name.startswith("-")):
        assert f"\n## counterspin {name}\n" in page
    assert "`--accept-misfit STR`" in page


@pytest.mark.parametrize("page", ["commands", "api", "api-parts"])
def test_pages_are_filled(page):
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    assert len(FROM_CODE["filled"](text)) > len(text) + 2000


def test_the_extensions_read_without_sphinx():
    """Those two are used here, where the site's requirements may not be installed."""
    for name in ("navigation", "from_code"):
        text = (DOCS / "extensions" / f"{name}.py").read_text(encoding="utf-8")
        assert not re.search(r"^(from|import) (sphinx|docutils|myst)", text, re.MULTILINE)
