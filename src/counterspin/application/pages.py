"""Pages with the blocks of results, and pages of the documentation.

In the documentation, `<!-- keys: CLASS -->` above a table marks the keys of a class.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, cast

from counterspin.application.answers import ManualPage, PageContent
from counterspin.application.app_state import AppState
from counterspin.application.commands import (
    compare_command,
    forecast_command,
    history_command,
    report_command,
    study_command,
)
from counterspin.application.jobs import Job, ProgressCallback, report_progress
from counterspin.application.served_folder import NotFoundError
from counterspin.errors import CampaignError, CounterspinError, RecordError
from counterspin.frozen import frozen
from counterspin.reports.blocks import Block, Paragraph, Picture
from counterspin.reports.typography import typeset_block

if TYPE_CHECKING:
    from markdown_it.token import Token

    from counterspin.calibration.result import Result
    from counterspin.planning.result import PlanResult


#: Pages of docs/ shown in the application: file formats and instructions, but no pages with many
#: formulas.
MANUAL_PAGES: Final = (
    "application",
    "glossary",
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

_PACKAGE_FOLDER: Final = Path(__file__).parent
#: Next to this file in a built package; docs/ in a checkout.
_DOCS_FOLDERS: Final = (_PACKAGE_FOLDER / "documentation", _PACKAGE_FOLDER.parents[2] / "docs")

_HEADING_OR_KEY_TABLE: Final = re.compile(
    r"^(?:#+ (?P<heading>.*)|<!-- keys: (?P<model>\w+) -->)$", re.MULTILINE
)
_COMMENT: Final = re.compile(r"^<!--.*?-->\n", re.MULTILINE | re.DOTALL)
_FORMULA: Final = re.compile(r"\$([^$\n]+)\$")


def make_anchor(heading: str) -> str:
    """Return the anchor of a heading, as on GitHub."""
    return re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-")


@cache
def _read_page_texts() -> Mapping[str, str]:
    """Return name -> Markdown of the pages; empty if the package lacks the documentation."""
    folder = next(
        (
            candidate
            for candidate in _DOCS_FOLDERS
            if (candidate / f"{MANUAL_PAGES[0]}.md").is_file()
        ),
        None,
    )
    if folder is None:
        return {}
    return {name: (folder / f"{name}.md").read_text(encoding="utf-8") for name in MANUAL_PAGES}


@cache
def _find_table_addresses() -> Mapping[str, str]:
    """Return class name -> address of the table of its keys: page and anchor."""
    addresses: dict[str, str] = {}
    for name, text in _read_page_texts().items():
        current_address = name
        for match in _HEADING_OR_KEY_TABLE.finditer(text):
            if match["heading"] is not None:
                current_address = f"{name}#{make_anchor(match['heading'])}"
            else:
                addresses.setdefault(match["model"], current_address)
    return addresses


def find_page_of_model(model: type) -> str | None:
    """Return the address of the table of the keys of a class: page, ``#`` and anchor."""
    return _find_table_addresses().get(model.__name__)


def resolve_page_link(link: str, page: str) -> str | None:
    """Return the address of a link in a page; None if its target is not in the application."""
    name, separator, heading = link.partition("#")
    name = name.removesuffix(".md") or page
    return f"{name}{separator}{heading}" if name in _read_page_texts() else None


def make_manual_page(name: str) -> ManualPage:
    """Return a page as HTML, and names and titles of all pages; NotFoundError if unknown."""
    text_by_page = _read_page_texts()
    if name not in text_by_page:
        raise NotFoundError(f"the documentation has no page {name}")
    title_by_page = {
        page_name: text.partition("\n")[0].removeprefix("# ")
        for page_name, text in text_by_page.items()
    }
    return {
        "title": title_by_page[name],
        "html": _render_manual_page(name),
        "pages": list(title_by_page.items()),
    }


@cache
def _render_manual_page(name: str) -> str:
    from markdown_it import MarkdownIt

    text = _FORMULA.sub(r"`\1`", _COMMENT.sub("", _read_page_texts()[name]))
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(text)
    for index, token in enumerate(tokens):
        if token.type == "heading_open":
            token.attrSet("id", make_anchor(tokens[index + 1].content))
        elif token.type in ("th_open", "td_open") and "style" in token.attrs:
            token.attrs = {"class": "right"}  # the content security policy forbids inline styles
        elif token.type == "inline":
            token.children = list(_filter_tokens(token.children or [], name))
    html = str(parser.renderer.render(tokens, parser.options, {}))
    # Wide content must be scrollable by keyboard.
    html = html.replace("<pre>", '<pre tabindex="0">').replace("</table>", "</table></div>")
    table_start = '<div class="scroll" role="region" tabindex="0" aria-label="Table"><table>'
    return html.replace("<table>", table_start)


def _filter_tokens(tokens: list[Token], name: str) -> Iterator[Token]:
    """Yield the tokens of a paragraph without images, with links to other pages resolved."""
    for token in tokens:
        if token.type == "link_open":
            target = resolve_page_link(str(token.attrs["href"]), name)
            token.attrs = {} if target is None else {"href": f"#/manual/{target}"}
        if token.type != "image":
            yield token


PageType = Literal["result", "comparison", "history", "forecast", "study"]


@frozen
class PageCalculation:
    """A page that is computed by a job."""

    #: Function of the process, which reports a `PlanResult`, and its argument.
    function: Callable[..., None]
    file: Path
    command: str  #: Equivalent command.


@frozen(eq=False)
class Page:
    """A page: title, blocks, and equivalent command."""

    title: str
    blocks: Sequence[Block]
    command: str
    empty: bool = False  #: Whether the page only states why there is no content.


def _make_result_page(app: AppState, names: Sequence[str], _: str) -> Page:
    from counterspin.calibration.pages.document import full_report_blocks

    result = app.result(names[0])
    command = report_command(app.file(names[0]))
    return Page(result.title or "Calibration", full_report_blocks(result), command)


def _make_comparison_page(app: AppState, names: Sequence[str], _: str) -> Page:
    from counterspin.comparisons.compare import compare
    from counterspin.comparisons.page import comparison_blocks

    comparison = compare(*map(app.result, names), names=list(names))
    files = [app.file(name) for name in names]
    return Page(
        "Comparison", _typeset_blocks(list(comparison_blocks(comparison))), compare_command(files)
    )


def _make_history_page(app: AppState, names: Sequence[str], term: str) -> Page:
    from counterspin.histories.history import history
    from counterspin.histories.page import history_blocks

    command = history_command(app.folder.root, term)
    try:
        coefficient_history = history([app.file(name) for name in names], term=term)
    except CampaignError:
        raise
    except CounterspinError as error:
        # Results without serial numbers are not an error: the page states that there is no history.
        return Page("History", [Paragraph(str(error), "warning")], command, empty=True)
    blocks = _typeset_blocks(list(history_blocks(coefficient_history)))
    return Page(f"History of {term}", blocks, command)


def _make_forecast_page(app: AppState, names: Sequence[str], _: str) -> PageCalculation:
    file = app.file(names[0])
    app.campaign(app.folder.name(file.parent))
    return PageCalculation(run_forecast, file, forecast_command(file.parent))


def run_forecast(connection: Connection, file: Path) -> None:
    """Forecast a campaign, and report as `report_progress` does."""

    def compute_forecast(_: ProgressCallback) -> PlanResult:
        from counterspin.planning.plan import check

        return check(file)

    report_progress(connection, compute_forecast)


def _make_study_page(app: AppState, names: Sequence[str], _: str) -> Page:
    from counterspin.reports.publication import add_seal_warning
    from counterspin.studies.page import report_blocks
    from counterspin.studies.result import StudyResult

    file = app.file(names[0])
    result = StudyResult.read(file)
    blocks = _typeset_blocks(add_seal_warning(result, report_blocks(result)))
    return Page(result.title, blocks, study_command(file.parent, result.trials_asked, file))


def _typeset_blocks(blocks: Sequence[Block]) -> list[Block]:
    return list(map(typeset_block, blocks))


_PAGE_MAKERS: Final[
    Mapping[PageType, Callable[[AppState, Sequence[str], str], Page | PageCalculation]]
] = {
    "result": _make_result_page,
    "comparison": _make_comparison_page,
    "history": _make_history_page,
    "forecast": _make_forecast_page,
    "study": _make_study_page,
}


def make_page_content(
    app: AppState, kind: PageType, names: Sequence[str], term: str
) -> PageContent:
    """Return title, HTML and command of a page, or the job that computes it."""
    from counterspin.reports.html import render_fragment

    page = _get_page_or_job(app, kind, names, term)
    content: PageContent = {
        "job": None,
        "title": "",
        "html": "",
        "command": "",
        "empty": False,
        "accelerometers": [],
        "state": "",
        "words": "",
        "refusal": "",
    }
    if isinstance(page, Job):
        content["job"] = page.to_dict()
        return content
    files = [app.file(name) for name in names]
    text = app.cache.get(
        ("html", kind, *files, term),
        files,
        lambda: app.folder.relative_paths(render_fragment(page.blocks, title=page.title)),
    )
    content["title"], content["html"], content["command"] = page.title, text, page.command
    content["empty"] = page.empty
    if kind == "result":
        from counterspin.calibration.findings import judge_result
        from counterspin.calibration.pages.card import STATE_NAMES

        result = judge_result(app.result(names[0]))
        content["accelerometers"] = list(result.accelerometers)
        content["state"] = result.state or ""
        content["words"] = STATE_NAMES[result.state] if result.state else "Not assessed"
        content["refusal"] = _find_certificate_refusal(result)
    return content


def _find_certificate_refusal(result: Result) -> str:
    """Return why no accelerometer of a result can be certified; empty if any can."""
    from counterspin.certificates.build import check_certifiable

    reasons = []
    for name in result.accelerometers:
        try:
            check_certifiable(result, [name])
        except RecordError as error:
            reasons.append(str(error))
        else:
            return ""
    if result.state == "contradicted":
        return (
            "The records contradict this result. Find the cause and calibrate again, or accept "
            "the misfit and state the reason."
        )
    return reasons[0] if reasons else ""


def render_page_picture(
    app: AppState, kind: PageType, names: Sequence[str], term: str, index: int
) -> str:
    """Return a picture of a page as SVG; `index` is its index among the pictures of the page."""
    from counterspin.reports.charts import render_svg

    page = _get_page_or_job(app, kind, names, term)
    if isinstance(page, Job):
        raise NotFoundError("the page with this plot is still being prepared")
    pictures = [block for block in page.blocks if isinstance(block, Picture)]
    if not 0 <= index < len(pictures):
        raise NotFoundError(f"plot {index} does not exist")
    files = [app.file(name) for name in names]
    with app.drawing:
        return app.cache.get(
            ("svg", kind, *files, term, index),
            files,
            lambda: str(render_svg(pictures[index], theme="page")),
        )


def _get_page_or_job(app: AppState, kind: PageType, names: Sequence[str], term: str) -> Page | Job:
    """Return a page, from the cache if possible, or the job that computes it."""
    files: list[Path] = [app.file(name) for name in names]
    cached_page, store = app.cache.lookup(("page", kind, *files, term), files)
    if cached_page is not None:
        return cast("Page", cached_page)
    page = _PAGE_MAKERS[kind](app, names, term)
    if isinstance(page, Page):
        return store(page)
    calculation = page

    def make_job(number: int) -> Job:
        return Job(number, names[0], "", calculation.command, "forecast")

    def store_page(plan_result: PlanResult) -> None:
        from counterspin.planning.page import plan_blocks

        store(
            Page(plan_result.title, _typeset_blocks(plan_blocks(plan_result)), calculation.command)
        )

    return app.jobs.begin(make_job, calculation.function, calculation.file, on_done=store_page)
