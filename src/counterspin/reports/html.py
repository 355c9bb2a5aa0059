"""Reports as a self-contained HTML file without requests, for screen, phone and paper.

Text, tables and static pictures need no script. With scripts, large plots become zoomable (uPlot,
inlined); the file includes their data, rounded to the resolution of a screen.
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
    VALUE_STYLES,
    Block,
    Card,
    Heading,
    Paragraph,
    Picture,
    Plot,
    Table,
)
from counterspin.reports.charts import is_zoomable, plot_json, render_svg
from counterspin.reports.typography import set_indices


def render_html(
    blocks: Sequence[Block],
    *,
    title: str,
    identifier: str,
    date: datetime,
    version: str,
    document_type: str = "a page",
) -> str:
    """Return blocks as one self-contained HTML file; the same blocks give the same text.

    title: Title of the window; also the heading, if the blocks have none of level 1.
    """
    title, identifier = escape_controls(title), escape_controls(identifier)
    page = _PageBuilder()
    summary, *chapters = page.make_chapters(blocks, title)
    has_heading = any(isinstance(block, Heading) and block.level == 1 for block in blocks)
    utc_date = date.astimezone(UTC)
    return (
        _template_environment()
        .get_template("report.html.jinja")
        .render(
            title=title,
            heading=None if has_heading else title,
            identifier=identifier,
            date=utc_date,
            day=f"{utc_date:%Y-%m-%d %H:%M} UTC",
            version=version,
            mark=file_mark(document_type),
            style=Markup(_report_style(page.zoomable)),
            page_mark=Markup(_css_string(identifier)),
            summary=summary["content"],
            chapters=chapters,
            tabbed=_has_tabs(blocks),
            uplot=Markup(_uplot_script()) if page.zoomable else None,
            script=Markup(_read_asset("report.js")),
        )
    )


def render_notebook_cell(blocks: Sequence[Block]) -> str:
    """Return blocks as HTML for a notebook cell, in the colours and font of its page."""
    content = _PageBuilder().make_items(blocks, "Result")
    style = Markup(_read_asset("cell.css").strip())
    template = _template_environment().get_template("cell.html.jinja")
    return template.render(content=content, style=style)


def render_fragment(blocks: Sequence[Block], *, title: str) -> str:
    """Return blocks as an HTML fragment of a page with `page_style` and `page_script`.

    Static pictures take long to draw: the fragment has ``data-place`` instead, the index of the
    picture, so that the page can request them one by one.
    """
    summary, *chapters = _PageBuilder(draws_pictures=False).make_chapters(blocks, title)
    template = _template_environment().get_template("part.html.jinja")
    return template.render(summary=summary["content"], chapters=chapters, tabbed=_has_tabs(blocks))


def page_style() -> str:
    """Return the CSS of a report, including that of its plots."""
    return _report_style(includes_uplot=True)


def page_script() -> str:
    """Return the scripts of the plots and of the report, which define `counterspin.draw`."""
    return f"{_uplot_script()}\n{_read_asset('report.js')}"


def _has_tabs(blocks: Iterable[Block]) -> bool:
    """Return whether chapters are tabs on a screen: in reports with cards."""
    return any(isinstance(block, Card) for block in blocks)


def _template_environment() -> Environment:
    environment = Environment(
        autoescape=True, loader=FunctionLoader(_read_asset), undefined=StrictUndefined
    )
    environment.filters["equation"] = _set_equation
    environment.filters["symbols"] = _set_symbols
    return environment


def _read_asset(name: str) -> str:
    return (resources.files("counterspin.reports") / "assets" / name).read_text(encoding="utf-8")


def _report_style(includes_uplot: bool) -> str:
    style = _read_asset("report.css").replace("/* dark.css */", _read_asset("dark.css").strip())
    return _read_asset("uplot/uPlot.min.css") + style if includes_uplot else style


def _uplot_script() -> str:
    # The licence must accompany every copy.
    return f"/*\n{_read_asset('uplot/LICENSE')}\n*/\n{_read_asset('uplot/uPlot.iife.min.js')}"


def _css_string(text: str) -> str:
    """Return a CSS string with all characters except letters and digits escaped."""
    safe_pattern = re.compile(r"[A-Za-z0-9]")
    return (
        '"'
        + "".join(
            character if safe_pattern.match(character) else f"\\{ord(character):x} "
            for character in text
        )
        + '"'
    )


class _PageBuilder:
    """Template data of the blocks of one page."""

    def __init__(self, *, draws_pictures: bool = True) -> None:
        self.used_ids: set[str] = set()
        self.zoomable = False
        self.draws_pictures = draws_pictures
        self.n_pictures = 0

    def make_chapters(self, blocks: Iterable[Block], title: str) -> list[dict[str, Any]]:
        """Return title, id and content of each chapter, after the content before the first."""
        chapters: list[tuple[dict[str, Any], list[Block]]] = [({"title": title}, [])]
        for block in blocks:
            if isinstance(block, Heading) and block.level == 2:
                chapters.append(({"title": block.text, "id": self.make_id(block.text)}, []))
            else:
                chapters[-1][1].append(block)
        return [
            chapter | {"content": self.make_items(chapter_blocks, chapter["title"])}
            for chapter, chapter_blocks in chapters
        ]

    def make_id(self, text: str) -> str:
        """Return an id that is unique in the page."""
        slug = re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "part"
        # The prefix avoids the ids of pictures and of the page.
        element_id, suffix_number = f"at-{slug}", 1
        while element_id in self.used_ids:
            suffix_number += 1
            element_id = f"at-{slug}-{suffix_number}"
        self.used_ids.add(element_id)
        return element_id

    def make_items(self, blocks: Iterable[Block], label: str) -> list[dict[str, Any]]:
        """Return the items of a chapter, with related neighbours merged."""
        items: list[dict[str, Any]] = []
        for item_type, group in groupby(blocks, _item_type):
            group_blocks = list(group)
            if item_type == "card":
                cards = [self.make_item(block, label) for block in group_blocks]
                items.append({"kind": "cards", "cards": cards})
            elif item_type in VALUE_STYLES:
                lines = [
                    _split_value(block.text)
                    for block in group_blocks
                    if isinstance(block, Paragraph)
                ]
                items.append({"kind": "answers", "style": item_type, "lines": lines})
            else:
                for block in group_blocks:
                    if isinstance(block, Heading):
                        label = block.text
                    items.append({"kind": item_type, **self.make_item(block, label)})
        return items

    def make_item(self, block: Block, label: str) -> dict[str, Any]:
        """Return the template's data for a block; `label` is the heading above it."""
        match block:
            case Heading():
                return {"block": block, "id": self.make_id(block.text)}
            case Table():
                return {"block": block, "label": f"Table: {label}"}
            case Paragraph():
                return {"block": block}
            case Card():
                return {"block": block, "id": self.make_id(f"card {block.title}")}
        return self.make_figure(block)

    def make_figure(self, picture: Picture) -> dict[str, Any]:
        """Return the static picture, and the data for zooming if it is zoomable."""
        figure: dict[str, Any] = {
            "block": picture,
            "id": self.make_id(picture.title),
            "data": None,
            "place": None,
        }
        if isinstance(picture, Plot) and is_zoomable(picture):
            self.zoomable = True
            figure["data"] = Markup(plot_json(picture))
        figure["svg"] = Markup(render_svg(picture, theme="page")) if self.draws_pictures else ""
        figure["place"] = None if self.draws_pictures else self.n_pictures
        self.n_pictures += 1
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


def _split_value(text: str) -> dict[str, str]:
    """Return a value, and in smaller type its other units and remarks."""
    main_text, *remarks = re.split(r" {2,}", text, maxsplit=1)
    name, *values = main_text.split(" = ")
    other_units = [f"= {value}" for value in values[1:]]
    return {"value": " = ".join([name, *values[:1]]), "remark": " ".join(other_units + remarks)}


def _set_equation(text: str) -> Markup:
    """Return an equation with symbols such as K_II set as a letter and its index."""
    return _set_html_indices(text, r"(delta|[^\W\d_])_([A-Za-z]+)(?![A-Za-z_]|\.\w)")


def _set_symbols(text: str) -> Markup:
    """Return prose with the symbols of coefficients set as a letter and its index."""
    return _set_html_indices(text)


def _set_html_indices(text: str, *symbol: str) -> Markup:
    def format_symbol(symbol_letter: str, index: str) -> str:
        # The hidden underscore makes K_II searchable and copyable.
        return f"{symbol_letter}<sub><i>_</i>{index}</sub>"

    return Markup(set_indices(str(Markup.escape(text)), format_symbol, *symbol))
