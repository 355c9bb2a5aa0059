"""The manual within the application: its links resolve, and it explains all form sections."""

import re
import tomllib
from pathlib import Path

import pytest

from counterspin.application.form import campaign_form, lab_form
from counterspin.application.pages import MANUAL_PAGES, make_manual_page
from counterspin.application.served_folder import NotFoundError

ROOT = Path(__file__).parents[2]


def heading_anchors(name):
    """Return the anchors of the headings of a page."""
    return set(re.findall(r'<h\d id="([^"]+)">', make_manual_page(name)["html"]))


def require_target(address):
    name, mark, heading = address.partition("#")
    assert name in MANUAL_PAGES, address
    assert not mark or heading in heading_anchors(name), address


def test_wheel_contains_manual_pages():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    taken = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    place = "counterspin/application/documentation"
    assert taken == {f"docs/{name}.md": f"{place}/{name}.md" for name in MANUAL_PAGES}


@pytest.mark.parametrize("name", MANUAL_PAGES)
def test_manual_page_has_no_broken_link(name):
    page = make_manual_page(name)
    assert [one for one, _ in page["pages"]] == list(MANUAL_PAGES)
    assert dict(page["pages"])[name] == page["title"]
    assert page["html"].startswith("<h1 ")
    # The policy forbids inline styles; images come from the site; table alignment is exempt.
    assert re.findall(r"<img|<script|style=|&lt;!--", page["html"]) == []
    for address in re.findall(r'href="([^"]*)"', page["html"]):
        assert address.startswith("#/manual/")
        require_target(address.removeprefix("#/manual/"))


def test_unknown_manual_page_raises_not_found():
    for name in ("", "nowhere", "physics", "../README", "campaign.md"):
        with pytest.raises(NotFoundError):
            make_manual_page(name)


def flatten_fields(fields):
    for field in fields:
        yield field
        yield from flatten_fields(field.get("fields", []))


def test_form_sections_link_to_existing_manual_pages():
    links = {}
    for section in (*campaign_form(), *lab_form()):
        require_target(section["explained"])
        for field in flatten_fields(section["fields"]):
            help_text = field["help"]
            for words, address in field["links"]:
                require_target(address)
                _, separator, help_text = help_text.partition(words)
                assert separator, field
                links[section["key"], field["key"]] = address
    assert links["certificate", "ledger"] == "certificate#keep-a-ledger"
    assert links["accelerometers", "output"] == "readings"
    sections = {section["key"]: section["explained"] for section in campaign_form()}
    assert sections["records"] == "campaign#records"
    assert sections["readings"] == "readings#keys"
