"""Pages of other rooms' blocks, and of the documentation.

A page marks the table of keys that it explains: `<!-- keys: CLASS -->` above the table.
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
from counterspin.application.jobs import Job, Progress, report_progress
from counterspin.application.served_folder import NotFoundError
from counterspin.errors import CampaignError, CounterspinError, RecordError
from counterspin.frozen import frozen
from counterspin.reports.blocks import Block, Paragraph, Picture
from counterspin.reports.typography import typeset_block

if TYPE_CHECKING:
    from markdown_it.token import Token

    from counterspin.calibration.result import Result
    from counterspin.planning.result import PlanResult


#: Pages that are shown, of those in docs/: what a file may hold, and what can be done here. What
#: is full of formulas is not among them.
PAGES: Final = (
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
#: In a package that was built they lie beside this file; in a checkout, in docs/.
_DOCUMENTATION_FOLDERS: Final = (
    _PACKAGE_FOLDER / "documentation",
    _PACKAGE_FOLDER.parents[2] / "docs",
)

_HEADING_OR_KEYS: Final = re.compile(
    r"^(?:#+ (?P<heading>.*)|<!-- keys: (?P<model>\w+) -->)$", re.MULTILINE
)
_COMMENT: Final = re.compile(r"^<!--.*?-->\n", re.MULTILINE | re.DOTALL)
_FORMULA: Final = re.compile(r"\$([^$\n]+)\$")


def anchor(heading: str) -> str:
    """Return the anchor of a heading, as Git hosts write it."""
    return re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-")


@cache
def _page_texts() -> Mapping[str, str]:
    """Return name -> Markdown of the pages; none in a package that lacks them."""
    folder = next(
        (
            candidate
            for candidate in _DOCUMENTATION_FOLDERS
            if (candidate / f"{PAGES[0]}.md").is_file()
        ),
        None,
    )
    if folder is None:
        return {}
    return {name: (folder / f"{name}.md").read_text(encoding="utf-8") for name in PAGES}


@cache
def _key_table_addresses() -> Mapping[str, str]:
    """Return class name -> the page, and the heading in it, with the table of its keys."""
    addresses: dict[str, str] = {}
    for name, text in _page_texts().items():
        current = name
        for match in _HEADING_OR_KEYS.finditer(text):
            if match["heading"] is not None:
                current = f"{name}#{anchor(match['heading'])}"
            else:
                addresses.setdefault(match["model"], current)
    return addresses


def page_explaining(model: type) -> str | None:
    """Return the page, with ``#`` and heading, that explains the keys of a class."""
    return _key_table_addresses().get(model.__name__)


def page_address(link: str, page: str) -> str | None:
    """Return the address of a page's link; None if its target is not shown here."""
    name, separator, heading = link.partition("#")
    name = name.removesuffix(".md") or page
    return f"{name}{separator}{heading}" if name in _page_texts() else None


def manual_page(name: str) -> ManualPage:
    """Return a page as HTML, and the names and titles of all; NotThereError if there is none."""
    texts = _page_texts()
    if name not in texts:
        raise NotFoundError(f"the documentation has no page {name}")
    titles = {
        page_name: text.partition("\n")[0].removeprefix("# ") for page_name, text in texts.items()
    }
    return {"title": titles[name], "html": _page_html(name), "pages": list(titles.items())}


@cache
def _page_html(name: str) -> str:
    from markdown_it import MarkdownIt

    text = _FORMULA.sub(r"`\1`", _COMMENT.sub("", _page_texts()[name]))
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(text)
    for index, token in enumerate(tokens):
        if token.type == "heading_open":
            token.attrSet("id", anchor(tokens[index + 1].content))
        elif token.type in ("th_open", "td_open") and "style" in token.attrs:
            token.attrs = {"class": "right"}  # no style in a page stands beside its rules
        elif token.type == "inline":
            token.children = list(_paragraph_tokens(token.children or [], name))
    html = str(parser.renderer.render(tokens, parser.options, {}))
    # What is wider than a screen is moved by keyboard, too.
    html = html.replace("<pre>", '<pre tabindex="0">').replace("</table>", "</table></div>")
    table_start = '<div class="scroll" role="region" tabindex="0" aria-label="Table"><table>'
    return html.replace("<table>", table_start)


def _paragraph_tokens(tokens: list[Token], name: str) -> Iterator[Token]:
    """Yield the parts of a paragraph: links to pages shown here, and no pictures."""
    for token in tokens:
        if token.type == "link_open":
            target = page_address(str(token.attrs["href"]), name)
            token.attrs = {} if target is None else {"href": f"#/manual/{target}"}
        if token.type != "image":
            yield token


Kind = Literal["result", "comparison", "history", "forecast", "study"]


@frozen
class PageCalculation:
    """A page that takes long, and is made from the report of a job."""

    #: What its process does, and with which file; it tells a `PlanResult`.
    function: Callable[..., None]
    file: Path
    command: str  #: That prints or writes the same.


@frozen(eq=False)
class Page:
    """A page: its title, its blocks, and the command that prints or writes the same."""

    title: str
    blocks: Sequence[Block]
    command: str
    empty: bool = False  #: Whether it only says why there is nothing to show.


def _result_page(app: AppState, names: Sequence[str], _: str) -> Page:
    from counterspin.calibration.pages.document import full_report_blocks

    result = app.result(names[0])
    command = report_command(app.file(names[0]))
    return Page(result.title or "Calibration", full_report_blocks(result), command)


def _comparison_page(app: AppState, names: Sequence[str], _: str) -> Page:
    from counterspin.comparisons.compare import compare
    from counterspin.comparisons.page import comparison_blocks

    comparison = compare(*map(app.result, names), names=list(names))
    files = [app.file(name) for name in names]
    return Page("Comparison", _typeset(list(comparison_blocks(comparison))), compare_command(files))


def _history_page(app: AppState, names: Sequence[str], term: str) -> Page:
    from counterspin.histories.history import history
    from counterspin.histories.page import history_blocks

    command = history_command(app.folder.root, term)
    try:
        tracked = history([app.file(name) for name in names], term=term)
    except CampaignError:
        raise
    except CounterspinError as error:
        # Results without serial numbers are no mistake: there is no history of them, and why.
        return Page("History", [Paragraph(str(error), "warning")], command, empty=True)
    return Page(f"History of {term}", _typeset(list(history_blocks(tracked))), command)


def _forecast_page(app: AppState, names: Sequence[str], _: str) -> PageCalculation:
    file = app.file(names[0])
    app.campaign(app.folder.name(file.parent))
    return PageCalculation(run_forecast, file, forecast_command(file.parent))


def run_forecast(connection: Connection, file: Path) -> None:
    """Forecast a campaign, and report as `report_progress` does."""

    def work(_: Progress) -> PlanResult:
        from counterspin.planning.plan import check

        return check(file)

    report_progress(connection, work)


def _study_page(app: AppState, names: Sequence[str], _: str) -> Page:
    from counterspin.reports.publication import add_seal_warning
    from counterspin.studies.page import report_blocks
    from counterspin.studies.result import StudyResult

    file = app.file(names[0])
    result = StudyResult.read(file)
    blocks = _typeset(add_seal_warning(result, report_blocks(result)))
    return Page(result.title, blocks, study_command(file.parent, result.trials_asked, file))


def _typeset(blocks: Sequence[Block]) -> list[Block]:
    return list(map(typeset_block, blocks))


_PAGE_MAKERS: Final[
    Mapping[Kind, Callable[[AppState, Sequence[str], str], Page | PageCalculation]]
] = {
    "result": _result_page,
    "comparison": _comparison_page,
    "history": _history_page,
    "forecast": _forecast_page,
    "study": _study_page,
}


def page_content(app: AppState, kind: Kind, names: Sequence[str], term: str) -> PageContent:
    """Return a page's title, its blocks as HTML, and its command; or the job that makes it."""
    from counterspin.reports.html import render_fragment

    page = _page_or_job(app, kind, names, term)
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
        content["refusal"] = _certificate_refusal(result)
    return content


def _certificate_refusal(result: Result) -> str:
    """Return why no accelerometer of a result can be certified; empty if one can."""
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


def page_picture(app: AppState, kind: Kind, names: Sequence[str], term: str, index: int) -> str:
    """Return a picture of a page as SVG; `index` counts the pictures of the page."""
    from counterspin.reports.charts import render_svg

    page = _page_or_job(app, kind, names, term)
    if isinstance(page, Job):
        raise NotFoundError("the page with this plot is still being prepared")
    pictures = [block for block in page.blocks if isinstance(block, Picture)]
    if not 0 <= index < len(pictures):
        raise NotFoundError(f"the plot {index} does not exist")
    files = [app.file(name) for name in names]
    with app.drawing:
        return app.cache.get(
            ("svg", kind, *files, term, index),
            files,
            lambda: str(render_svg(pictures[index], theme="page")),
        )


def _page_or_job(app: AppState, kind: Kind, names: Sequence[str], term: str) -> Page | Job:
    """Return a cached page or a quickly made one, or the job that makes it."""
    files: list[Path] = [app.file(name) for name in names]
    cached, store = app.cache.lookup(("page", kind, *files, term), files)
    if cached is not None:
        return cast("Page", cached)
    page = _PAGE_MAKERS[kind](app, names, term)
    if isinstance(page, Page):
        return store(page)
    calculation = page

    def make_job(number: int) -> Job:
        return Job(number, names[0], "", calculation.command, "forecast")

    def store_page(plan_result: PlanResult) -> None:
        from counterspin.planning.page import plan_blocks

        store(Page(plan_result.title, _typeset(plan_blocks(plan_result)), calculation.command))

    return app.jobs.begin(make_job, calculation.function, calculation.file, on_done=store_page)
