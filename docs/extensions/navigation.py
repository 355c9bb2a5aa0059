"""Build the site menu from the tables of the index pages, so that there is no second list.

An index page (``index.md``) has sections with tables of links. The pages of each section, in the
order of their rows, form a group of the menu under the section heading.
"""

import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sphinx.application import Sphinx

_ROW = re.compile(r"^\| \[[^\]]*\]\(([\w./-]+)\.md\)", re.MULTILINE)


def find_sections(page: str) -> dict[str, list[str]]:
    """Return heading -> page names without suffix, from the tables of an index page."""
    alternating = re.split(r"^#{1,2} (.+)$", page, flags=re.MULTILINE)[1:]
    pages_by_heading = {
        heading: _ROW.findall(body) for heading, body in zip(*[iter(alternating)] * 2, strict=True)
    }
    return {heading: pages for heading, pages in pages_by_heading.items() if pages}


def add_menu(page: str) -> str:
    """Return an index page with its menu appended."""
    for heading, pages in find_sections(page).items():
        page_list = "\n".join(pages)
        page += f"\n```{{toctree}}\n:hidden:\n:caption: {heading}\n\n{page_list}\n```\n"
    return page


def _add_menu_to_index(app: "Sphinx", name: str, content: list[str]) -> None:  # noqa: ARG001 -- Sphinx's
    if Path(name).name == "index":
        content[0] = add_menu(content[0])


def setup(app: "Sphinx") -> dict[str, bool]:
    """Connect the extension to Sphinx."""
    app.connect("source-read", _add_menu_to_index)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
