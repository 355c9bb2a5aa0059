"""The documentation within the page, without a network: its pages, and what each explains.

Which page explains a table of keys stands in the page itself: `<!-- keys: CLASS -->` above it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from counterspin.application.folder import NotThereError

if TYPE_CHECKING:
    from markdown_it.token import Token

#: Pages that are shown, of those in docs/: what a file may hold, and what can be done here. What
#: is full of formulas is not among them.
PAGES: Final = (
    "application",
    "exports",
    "double-turntable",
    "tumble",
    "arm",
    "poses",
    "campaign",
    "readings",
    "triads",
    "noise",
    "result",
    "diagnosis",
    "conformity",
    "certificate",
    "history",
    "compare",
    "plan",
    "study",
    "quickstart",
)

_HERE: Final = Path(__file__).parent
#: In a package that was built they lie beside this file; in a checkout, in docs/.
_FOLDERS: Final = (_HERE / "documentation", _HERE.parents[2] / "docs")

_MARK: Final = re.compile(r"^(?:#+ (?P<heading>.*)|<!-- keys: (?P<model>\w+) -->)$", re.MULTILINE)
_COMMENT: Final = re.compile(r"^<!--.*?-->\n", re.MULTILINE | re.DOTALL)
_FORMULA: Final = re.compile(r"\$([^$\n]+)\$")


def anchor(heading: str) -> str:
    """Return how a heading is linked to, as Git hosts have it."""
    return re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-")


@cache
def _texts() -> Mapping[str, str]:
    """Return name -> Markdown of the pages; none in a package that lacks them."""
    folder = next((one for one in _FOLDERS if (one / f"{PAGES[0]}.md").is_file()), None)
    if folder is None:
        return {}
    return {name: (folder / f"{name}.md").read_text(encoding="utf-8") for name in PAGES}


@cache
def _places() -> Mapping[str, str]:
    """Return name of a class -> the page, and the heading in it, under which its keys stand."""
    found: dict[str, str] = {}
    for name, text in _texts().items():
        here = name
        for mark in _MARK.finditer(text):
            if mark["heading"] is not None:
                here = f"{name}#{anchor(mark['heading'])}"
            else:
                found.setdefault(mark["model"], here)
    return found


def explained(model: type) -> str | None:
    """Return the page, with ``#`` and heading, that explains the keys of a class."""
    return _places().get(model.__name__)


def address(link: str, page: str) -> str | None:
    """Return where a link of a page leads to; None: to nothing that is shown here."""
    name, mark, heading = link.partition("#")
    name = name.removesuffix(".md") or page
    return f"{name}{mark}{heading}" if name in _texts() else None


def manual_page(name: str) -> dict[str, Any]:
    """Return a page as HTML, and the names and titles of all; NotThereError if there is none."""
    texts = _texts()
    if name not in texts:
        raise NotThereError(f"there is no page {name} of the documentation")
    titles = {one: text.partition("\n")[0].removeprefix("# ") for one, text in texts.items()}
    return {"title": titles[name], "html": _html(name), "pages": list(titles.items())}


@cache
def _html(name: str) -> str:
    from markdown_it import MarkdownIt

    text = _FORMULA.sub(r"`\1`", _COMMENT.sub("", _texts()[name]))
    reader = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = reader.parse(text)
    for place, token in enumerate(tokens):
        if token.type == "heading_open":
            token.attrSet("id", anchor(tokens[place + 1].content))
        elif token.type in ("th_open", "td_open") and "style" in token.attrs:
            token.attrs = {"class": "right"}  # no style in a page stands beside its rules
        elif token.type == "inline":
            token.children = list(_inside(token.children or [], name))
    html = str(reader.renderer.render(tokens, reader.options, {}))
    # What is wider than a screen is moved by keyboard, too.
    html = html.replace("<pre>", '<pre tabindex="0">').replace("</table>", "</table></div>")
    box = '<div class="scroll" role="region" tabindex="0" aria-label="Table"><table>'
    return html.replace("<table>", box)


def _inside(tokens: list[Token], name: str) -> Iterator[Token]:
    """Yield what a paragraph consists of: links to where they lead here, and no pictures."""
    for token in tokens:
        if token.type == "link_open":
            to = address(str(token.attrs["href"]), name)
            token.attrs = {} if to is None else {"href": f"#/manual/{to}"}
        if token.type != "image":
            yield token
