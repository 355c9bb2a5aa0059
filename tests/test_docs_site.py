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
from pictures import mark_of

DOCS = Path(__file__).parents[1] / "docs"
NAVIGATION = runpy.run_path(str(DOCS / "extensions" / "navigation.py"))
FROM_CODE = runpy.run_path(str(DOCS / "extensions" / "from_code.py"))
GALLERY = DOCS / "gallery"
OWN_INDEX = GALLERY / "index.md"
QUESTIONS = sorted(set(GALLERY.glob("*.md")) - {OWN_INDEX})
INDEX = (DOCS / "index.md").read_text(encoding="utf-8")


def test_every_page_is_in_the_menu_once():
    pages = [page for listed in NAVIGATION["sections"](INDEX).values() for page in listed]
    there = {page.stem for page in DOCS.glob("*.md")} - {"index"}
    assert sorted(pages) == sorted(there | {"gallery/index"})


def test_every_page_of_the_gallery_is_listed_once():
    (pages,) = NAVIGATION["sections"]((GALLERY / "index.md").read_text(encoding="utf-8")).values()
    assert sorted(pages) == sorted(page.stem for page in GALLERY.glob("*.md") if page != OWN_INDEX)
    assert len(pages) >= 10


@pytest.mark.parametrize("page", QUESTIONS, ids=lambda page: page.stem)
def test_a_page_s_thumbnail_is_of_its_cells_and_has_its_words(page):
    """`make pictures` runs the cells and keeps the first picture."""
    name = f"gallery-{page.stem}.png"
    marked = struct.pack(">I", 8 + 16) + b"tEXtComment\0" + mark_of(page).encode()
    assert marked in (DOCS / "images" / name).read_bytes()
    (words,) = re.findall(rf"!\[(.*?)\]\(\.\./images/{name}\)", OWN_INDEX.read_text("utf-8"))
    first = re.search(r"alt: >-\n((?:      .+\n)+)", page.read_text(encoding="utf-8"))[1]
    assert words == " ".join(first.split())


@pytest.mark.parametrize("page", QUESTIONS, ids=lambda page: page.stem)
def test_a_page_of_the_gallery_is_run_and_its_pictures_have_words(page):
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
    assert {"Coefficient", "Finding", "Covariance", "SpindleFit", "Row"} <= told
    assert told.isdisjoint(cs.__all__)


def test_every_command_and_option_is_told():
    page = FROM_CODE["commands"]()
    for name in (name for name in cli.app if not name.startswith("-")):
        assert f"\n## counterspin {name}\n" in page
    assert "`--accept-misfit STR`" in page


@pytest.mark.parametrize("page", ["commands", "api", "api-parts", "trust"])
def test_pages_are_filled(page):
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    filled = FROM_CODE["filled"](text)
    assert len(filled) > len(text) + 800
    assert "made from the code:" not in filled


def test_the_page_on_trust_has_the_coverage_and_names_what_exists():
    text = (DOCS / "trust.md").read_text(encoding="utf-8")
    assert FROM_CODE["coverage"]().count("\n| joint |") >= 10
    assert "\n| joint | displacement | white noise, stated |" in FROM_CODE["filled"](text)
    named = re.findall(r"`(tests/[\w/.]+)`", text)
    assert len(named) > 10
    for path in named:
        assert (DOCS.parent / path).exists(), path


def test_the_page_on_trust_states_the_digits_that_are_tested():
    """Pontius, Longley and Filip: the fewest right digits of an estimate."""
    names = ("Pontius", "Longley", "Filip")
    digits = [-math.log10(case(f"NIST {name}").relative) for name in names]
    text = (DOCS / "trust.md").read_text(encoding="utf-8")
    told = re.search(
        r"to (\S+) digits for Pontius, (\S+) for Longley and (\S+) for the ill-conditioned Filip",
        text,
    )
    assert [float(one) for one in told.groups()] == pytest.approx(digits)


def test_the_extensions_read_without_sphinx():
    """Those two are used here, where the site's requirements may not be installed."""
    for name in ("navigation", "from_code"):
        text = (DOCS / "extensions" / f"{name}.py").read_text(encoding="utf-8")
        assert not re.search(r"^(from|import) (sphinx|docutils|myst)", text, re.MULTILINE)
