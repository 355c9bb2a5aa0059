"""The site's structure, without building it: menu, reference, gallery. `make docs` builds it."""

import math
import re
import runpy
import struct
from pathlib import Path

import pytest

import counterspin as cs
from counterspin import cli
from counterspin.validation.cases import case
from pictures import hash_cells

DOCS = Path(__file__).parents[1] / "docs"
NAVIGATION = runpy.run_path(str(DOCS / "extensions" / "navigation.py"))
FROM_CODE = runpy.run_path(str(DOCS / "extensions" / "from_code.py"))
GALLERY = DOCS / "gallery"
OWN_INDEX = GALLERY / "index.md"
QUESTIONS = sorted(set(GALLERY.glob("*.md")) - {OWN_INDEX})
INDEX = (DOCS / "index.md").read_text(encoding="utf-8")


def test_menu_lists_every_page_once():
    pages = [page for listed in NAVIGATION["find_sections"](INDEX).values() for page in listed]
    there = {page.stem for page in DOCS.glob("*.md")} - {"index"}
    assert sorted(pages) == sorted(there | {"gallery/index"})


def test_gallery_lists_every_page_once():
    (pages,) = NAVIGATION["find_sections"](
        (GALLERY / "index.md").read_text(encoding="utf-8")
    ).values()
    assert sorted(pages) == sorted(page.stem for page in GALLERY.glob("*.md") if page != OWN_INDEX)
    assert len(pages) >= 10


@pytest.mark.parametrize("page", QUESTIONS, ids=lambda page: page.stem)
def test_thumbnail_matches_cells_and_description_of_page(page):
    """`make pictures` runs the cells and stores the first picture."""
    name = f"gallery-{page.stem}.png"
    marked = struct.pack(">I", 8 + 16) + b"tEXtComment\0" + hash_cells(page).encode()
    assert marked in (DOCS / "images" / name).read_bytes()
    (words,) = re.findall(rf"!\[(.*?)\]\(\.\./images/{name}\)", OWN_INDEX.read_text("utf-8"))
    first = re.search(r"alt: >-\n((?:      .+\n)+)", page.read_text(encoding="utf-8"))[1]
    assert words == " ".join(first.split())


@pytest.mark.parametrize("page", QUESTIONS, ids=lambda page: page.stem)
def test_gallery_page_is_executed_and_pictures_have_text(page):
    text = page.read_text(encoding="utf-8")
    assert text.startswith("---\nfile_format: mystnb\n")
    cells = re.findall(r"^```\{code-cell\} python3\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    drawing = [cell for cell in cells if re.search(r"plt\.\w+\(|\.plot\w*\(|axes\.", cell)]
    assert drawing
    for cell in drawing:
        words = re.match(r"---\nmystnb:\n  image:\n    alt: >-\n((?:      .+\n)+)---\n", cell)
        assert words, cell
        assert len(words[1].split()) >= 10
    assert any("tags: [remove-cell]" in cell and "assert " in cell for cell in cells)
    for cell in cells:
        code = re.sub(r"\A---\n.*?^---\n", "", cell, flags=re.MULTILINE | re.DOTALL)
        compile(code, page.name, "exec")


def test_menu_has_headings_of_index():
    menu = NAVIGATION["add_menu"]("# T\n\n## Do\n\n| p | f |\n|---|---|\n| [A](a.md) | a |\n")
    assert ":caption: Do\n\na\n" in menu
    assert menu.count("toctree") == 1


def test_reference_lists_every_public_name_once():
    page = FROM_CODE["public_names"]()
    named = re.findall(r"^\.\. auto\w+:: counterspin\.(\w+)$", page, re.MULTILINE)
    assert sorted(named) == cs.__all__


def test_reference_groups_match_docstring():
    groups = FROM_CODE["groups"]()
    assert "calibrate" in groups["Commands as functions"]
    assert "TERMS" in groups["Physics"]
    assert "RecordError" in groups["Errors and warnings"]


def test_reference_describes_returned_objects():
    qualnames = {part.__qualname__ for part in FROM_CODE["parts"]()}
    assert {"Coefficient", "Finding", "Covariance", "SpindleFit", "Row"} <= qualnames
    assert qualnames.isdisjoint(cs.__all__)


def test_reference_describes_all_commands_and_options():
    page = FROM_CODE["commands"]()
    for name in (name for name in cli.app if not name.startswith("-")):
        assert f"\n## counterspin {name}\n" in page
    assert "`--accept-misfit STR`" in page


@pytest.mark.parametrize("page", ["commands", "api", "api-parts", "trust"])
def test_placeholders_of_pages_are_filled(page):
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    filled = FROM_CODE["filled"](text)
    assert len(filled) > len(text) + 800
    assert "made from the code:" not in filled


def test_trust_page_has_coverage_table_and_existing_names():
    text = (DOCS / "trust.md").read_text(encoding="utf-8")
    assert FROM_CODE["coverage"]().count("\n| joint |") >= 10
    assert "\n| joint | displacement | white noise, stated |" in FROM_CODE["filled"](text)
    named = re.findall(r"`(tests/[\w/.]+)`", text)
    assert len(named) > 10
    for path in named:
        assert (DOCS.parent / path).exists(), path


def test_trust_page_states_tested_digits():
    """Check the minimum number of correct digits for Pontius, Longley and Filip."""
    names = ("Pontius", "Longley", "Filip")
    digits = [-math.log10(case(f"NIST {name}").relative_tolerance) for name in names]
    text = (DOCS / "trust.md").read_text(encoding="utf-8")
    match = re.search(
        r"to (\S+) digits for Pontius, (\S+) for Longley and (\S+) for the ill-conditioned Filip",
        text,
    )
    assert [float(group) for group in match.groups()] == pytest.approx(digits)


def test_extensions_do_not_import_sphinx():
    """Those two are used here, where the site's requirements may not be installed."""
    for name in ("navigation", "from_code"):
        text = (DOCS / "extensions" / f"{name}.py").read_text(encoding="utf-8")
        assert not re.search(r"^(from|import) (sphinx|docutils|myst)", text, re.MULTILINE)
