"""Reports as one self-contained HTML file without requests, for screen, phone and paper.

Words, tables and still pictures need no script. With scripts, plots worth zooming become zoomable
(uPlot, inlined); the file includes their data, rounded to the resolution of a screen.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from importlib import resources
from itertools import groupby
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from counterspin.characters import escape_controls
from counterspin.output import file_mark
from counterspin.reports.blocks import (
    ANSWER_STYLES,
    Block,
    Card,
    Heading,
    Paragraph,
    Picture,
    Plot,
    Table,
)
from counterspin.reports.charts import can_zoom, plot_data, svg
from counterspin.reports.typography import set_indices


def html(
    blocks: Sequence[Block],
    *,
    title: str,
    identifier: str,
    date: datetime,
    version: str,
    kind: str = "a page",
) -> str:
    """Return blocks as one self-contained HTML file; the same blocks give the same text.

    title: Title of the window; also the heading, if the blocks have none of level 1.
    """
    title, identifier = escape_controls(title), escape_controls(identifier)
    page = _Page()
    summary, *chapters = page.chapters(blocks, title)
    has_heading = any(isinstance(block, Heading) and block.level == 1 for block in blocks)
    moment = date.astimezone(UTC)
    return (
        _environment()
        .get_template("report.html.jinja")
        .render(
            title=title,
            heading=None if has_heading else title,
            identifier=identifier,
            date=moment,
            day=f"{moment:%Y-%m-%d %H:%M} UTC",
            version=version,
            mark=file_mark(kind),
            style=Markup(_style(page.zoomable)),
            page_mark=Markup(_css_text(identifier)),
            summary=summary["content"],
            chapters=chapters,
            tabbed=_is_tabbed(blocks),
            uplot=Markup(_uplot()) if page.zoomable else None,
            script=Markup(_asset("report.js")),
        )
    )


def notebook_cell(blocks: Sequence[Block]) -> str:
    """Return blocks as HTML for a notebook cell, in the colours and font of its page."""
    content = _Page().items(blocks, "Result")
    style = Markup(_asset("cell.css").strip())
    return _environment().get_template("cell.html.jinja").render(content=content, style=style)


def html_fragment(blocks: Sequence[Block], *, title: str) -> str:
    """Return blocks as an HTML fragment of a page with `page_style` and `page_script`.

    Static pictures take long to draw: the fragment has ``data-place`` instead, the index of the
    picture, so that the page can request them one by one.
    """
    summary, *chapters = _Page(drawn=False).chapters(blocks, title)
    template = _environment().get_template("part.html.jinja")
    return template.render(summary=summary["content"], chapters=chapters, tabbed=_is_tabbed(blocks))


def page_style() -> str:
    """Return the style of a report, with that of its plots."""
    return _style(uplot=True)


def page_script() -> str:
    """Return the script of a report, after that of its plots; it offers `counterspin.draw`."""
    return f"{_uplot()}\n{_asset('report.js')}"


def _is_tabbed(blocks: Iterable[Block]) -> bool:
    """Return whether chapters are tabs on a screen: where cards have the answer."""
    return any(isinstance(block, Card) for block in blocks)


def _environment() -> Environment:
    environment = Environment(
        autoescape=True, loader=FunctionLoader(_asset), undefined=StrictUndefined
    )
    environment.filters["equation"] = _set_equation
    environment.filters["symbols"] = _set_symbols
    return environment


def _asset(name: str) -> str:
    return (resources.files("counterspin.reports") / "assets" / name).read_text(encoding="utf-8")


def _style(uplot: bool) -> str:
    style = _asset("report.css").replace("/* dark.css */", _asset("dark.css").strip())
    return _asset("uplot/uPlot.min.css") + style if uplot else style


def _uplot() -> str:
    # The licence must accompany every copy.
    return f"/*\n{_asset('uplot/LICENSE')}\n*/\n{_asset('uplot/uPlot.iife.min.js')}"


def _css_text(text: str) -> str:
    """Return a CSS string with all characters except letters and digits escaped."""
    plain = re.compile(r"[A-Za-z0-9]")
    return '"' + "".join(c if plain.match(c) else f"\\{ord(c):x} " for c in text) + '"'


class _Page:
    """Template data of the blocks of one page."""

    def __init__(self, *, drawn: bool = True) -> None:
        self.names: set[str] = set()
        self.zoomable = False
        self.drawn = drawn
        self.pictures = 0

    def chapters(self, blocks: Iterable[Block], title: str) -> list[dict[str, Any]]:
        """Return title, id and content of each chapter; first, without these, what precedes."""
        chapters: list[tuple[dict[str, Any], list[Block]]] = [({"title": title}, [])]
        for block in blocks:
            if isinstance(block, Heading) and block.level == 2:
                chapters.append(({"title": block.text, "id": self.name(block.text)}, []))
            else:
                chapters[-1][1].append(block)
        return [
            head | {"content": self.items(members, head["title"])} for head, members in chapters
        ]

    def name(self, text: str) -> str:
        """Return an id that is unique in the page."""
        words = re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "part"
        # The prefix avoids the ids of pictures and of the page.
        name, count = f"at-{words}", 1
        while name in self.names:
            count += 1
            name = f"at-{words}-{count}"
        self.names.add(name)
        return name

    def items(self, blocks: Iterable[Block], label: str) -> list[dict[str, Any]]:
        """Return the items of a chapter, with related neighbours merged."""
        items: list[dict[str, Any]] = []
        for kind, group in groupby(blocks, _item_type):
            members = list(group)
            if kind == "card":
                cards = [self.item(block, label) for block in members]
                items.append({"kind": "cards", "cards": cards})
            elif kind in ANSWER_STYLES:
                lines = [
                    _split_answer(block.text) for block in members if isinstance(block, Paragraph)
                ]
                items.append({"kind": "answers", "style": kind, "lines": lines})
            else:
                for block in members:
                    if isinstance(block, Heading):
                        label = block.text
                    items.append({"kind": kind, **self.item(block, label)})
        return items

    def item(self, block: Block, label: str) -> dict[str, Any]:
        """Return the template's data for a block; `label` is the heading above it."""
        match block:
            case Heading():
                return {"block": block, "id": self.name(block.text)}
            case Table():
                return {"block": block, "label": f"Table: {label}"}
            case Paragraph():
                return {"block": block}
            case Card():
                return {"block": block, "id": self.name(f"card {block.title}")}
        return self.figure(block)

    def figure(self, picture: Picture) -> dict[str, Any]:
        """Return the static picture, and the data for zooming if it is zoomable."""
        figure: dict[str, Any] = {
            "block": picture,
            "id": self.name(picture.title),
            "data": None,
            "place": None,
        }
        if isinstance(picture, Plot) and can_zoom(picture):
            self.zoomable = True
            figure["data"] = Markup(plot_data(picture))
        figure["svg"] = Markup(svg(picture, theme="page")) if self.drawn else ""
        figure["place"] = None if self.drawn else self.pictures
        self.pictures += 1
        return figure


def _item_type(block: Block) -> str:
    match block:
        case Heading():
            return "heading"
        case Paragraph(style="answer" | "reserved" as style):
            return style
        case Paragraph():
            return "paragraph"
        case Table():
            return "table"
        case Card():
            return "card"
    return "figure"


def _split_answer(text: str) -> dict[str, str]:
    """Return a value, and in smaller type its other units and remarks."""
    estimate, *remarks = re.split(r" {2,}", text, maxsplit=1)
    name, *values = estimate.split(" = ")
    more = [f"= {value}" for value in values[1:]]
    return {"value": " = ".join([name, *values[:1]]), "remark": " ".join(more + remarks)}


def _set_equation(text: str) -> Markup:
    """Return an equation with symbols such as K_II set as a letter and its index."""
    return _set_indices(text, r"(delta|[^\W\d_])_([A-Za-z]+)(?![A-Za-z_]|\.\w)")


def _set_symbols(text: str) -> Markup:
    """Return prose with the symbols of coefficients set as a letter and its index."""
    return _set_indices(text)


def _set_indices(text: str, *symbol: str) -> Markup:
    def index(letter: str, index: str) -> str:
        # The hidden underscore makes K_II searchable and copyable.
        return f"{letter}<sub><i>_</i>{index}</sub>"

    return Markup(set_indices(str(Markup.escape(text)), index, *symbol))
