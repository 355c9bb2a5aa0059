"""The documentation within the page: links lead to something, and each section is explained."""

import re
import tomllib
from pathlib import Path

import pytest

from counterspin.application.form import campaign_form, lab_form
from counterspin.application.pages import PAGES, manual_page
from counterspin.application.served_folder import NotFoundError

ROOT = Path(__file__).parents[2]


def headings(name):
    """Return what may stand behind the ``#`` of a link to a page."""
    return set(re.findall(r'<h\d id="([^"]+)">', manual_page(name)["html"]))


def require_there(address):
    name, mark, heading = address.partition("#")
    assert name in PAGES, address
    assert not mark or heading in headings(name), address


def test_a_built_package_holds_the_pages():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    taken = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    place = "counterspin/application/documentation"
    assert taken == {f"docs/{name}.md": f"{place}/{name}.md" for name in PAGES}


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_shown_without_a_link_to_nowhere(name):
    page = manual_page(name)
    assert [one for one, _ in page["pages"]] == list(PAGES)
    assert dict(page["pages"])[name] == page["title"]
    assert page["html"].startswith("<h1 ")
    # Its rules forbid styles in an element; pictures are the site's; a mark of a table is none.
    assert re.findall(r"<img|<script|style=|&lt;!--", page["html"]) == []
    for address in re.findall(r'href="([^"]*)"', page["html"]):
        assert address.startswith("#/manual/")
        require_there(address.removeprefix("#/manual/"))


def test_what_is_none_of_the_pages_is_not_shown():
    for name in ("", "nowhere", "physics", "../README", "campaign.md"):
        with pytest.raises(NotFoundError):
            manual_page(name)


def inside(fields):
    for one in fields:
        yield one
        yield from inside(one.get("fields", []))


def test_every_section_of_a_form_is_explained_and_links_of_its_help_lead_on():
    links = {}
    for section in (*campaign_form(), *lab_form()):
        require_there(section["explained"])
        for one in inside(section["fields"]):
            rest = one["help"]
            for words, address in one["links"]:
                require_there(address)
                _, found, rest = rest.partition(words)
                assert found, one
                links[section["key"], one["key"]] = address
    assert links["certificate", "ledger"] == "certificate#keep-a-ledger"
    assert links["accelerometers", "output"] == "readings"
    sections = {one["key"]: one["explained"] for one in campaign_form()}
    assert sections["records"] == "campaign#records"
    assert sections["readings"] == "readings#keys"
