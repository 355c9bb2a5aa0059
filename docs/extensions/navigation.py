"""The site's menu: the tables of an index page are its menu, so that there is no second list.

An index page (``index.md``) has sections with tables of links. The pages of each section, in the
order of their rows, become a part of the menu under the section's heading.
"""

import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sphinx.application import Sphinx

_ROW = re.compile(r"^\| \[[^\]]*\]\(([\w./-]+)\.md\)", re.MULTILINE)


def sections(page: str) -> dict[str, list[str]]:
    """Return heading -> pages, without their ending, of the tables of an index page."""
    parts = re.split(r"^#{1,2} (.+)$", page, flags=re.MULTILINE)[1:]
    found = {heading: _ROW.findall(body) for heading, body in zip(*[iter(parts)] * 2, strict=True)}
    return {heading: pages for heading, pages in found.items() if pages}


def with_menu(page: str) -> str:
    """Return an index page with its menu."""
    for heading, pages in sections(page).items():
        listed = "\n".join(pages)
        page += f"\n```{{toctree}}\n:hidden:\n:caption: {heading}\n\n{listed}\n```\n"
    return page


def _on_read(app: "Sphinx", name: str, content: list[str]) -> None:  # noqa: ARG001 -- Sphinx's
    if Path(name).name == "index":
        content[0] = with_menu(content[0])


def setup(app: "Sphinx") -> dict[str, bool]:
    """Have index pages changed as they are read."""
    app.connect("source-read", _on_read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
