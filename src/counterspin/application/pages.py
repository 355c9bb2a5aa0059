"""Pages of other rooms' blocks, and of the documentation.

A page marks the table of keys that it explains: `<!-- keys: CLASS -->` above the table.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, cast

from counterspin.application.desk import (
    Desk,
    compare_command,
    forecast_command,
    history_command,
    report_command,
    study_command,
)
from counterspin.application.folder import NotThereError
from counterspin.application.jobs import Job, Progress, report_progress
from counterspin.errors import CampaignError, CounterspinError
from counterspin.frozen import frozen
from counterspin.reports.blocks import Block, Paragraph, Picture
from counterspin.reports.typography import typeset_block

if TYPE_CHECKING:
    from markdown_it.token import Token

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

_HERE: Final = Path(__file__).parent
#: In a package that was built they lie beside this file; in a checkout, in docs/.
_FOLDERS: Final = (_HERE / "documentation", _HERE.parents[2] / "docs")

_MARK: Final = re.compile(r"^(?:#+ (?P<heading>.*)|<!-- keys: (?P<model>\w+) -->)$", re.MULTILINE)
_COMMENT: Final = re.compile(r"^<!--.*?-->\n", re.MULTILINE | re.DOTALL)
_FORMULA: Final = re.compile(r"\$([^$\n]+)\$")


def anchor(heading: str) -> str:
    """Return the anchor of a heading, as Git hosts write it."""
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
    """Return class name -> the page, and the heading in it, with the table of its keys."""
    found: dict[str, str] = {}
    for name, text in _texts().items():
        here = name
        for mark in _MARK.finditer(text):
            if mark["heading"] is not None:
                here = f"{name}#{anchor(mark['heading'])}"
            else:
                found.setdefault(mark["model"], here)
    return found


def page_explaining(model: type) -> str | None:
    """Return the page, with ``#`` and heading, that explains the keys of a class."""
    return _places().get(model.__name__)


def address(link: str, page: str) -> str | None:
    """Return the address of a page's link; None if its target is not shown here."""
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
    """Yield the parts of a paragraph: links to pages shown here, and no pictures."""
    for token in tokens:
        if token.type == "link_open":
            to = address(str(token.attrs["href"]), name)
            token.attrs = {} if to is None else {"href": f"#/manual/{to}"}
        if token.type != "image":
            yield token


Kind = Literal["result", "comparison", "history", "forecast", "study"]


@frozen
class Calculation:
    """A page that takes long, and is made from the report of a job."""

    #: What its process does, and with which file; it tells a `PlanResult`.
    work: Callable[..., None]
    file: Path
    command: str  #: That prints or writes the same.


@frozen(eq=False)
class Page:
    """A page: its title, its blocks, and the command that prints or writes the same."""

    title: str
    blocks: Sequence[Block]
    command: str
    empty: bool = False  #: Whether it only says why there is nothing to show.


def _result(desk: Desk, names: Sequence[str], _: str) -> Page:
    from counterspin.calibration.pages.document import document

    result = desk.result(names[0])
    command = report_command(desk.file(names[0]))
    return Page(result.title or "Calibration", document(result), command)


def _comparison(desk: Desk, names: Sequence[str], _: str) -> Page:
    from counterspin.comparisons.compare import compare
    from counterspin.comparisons.page import comparison_blocks

    compared = compare(*map(desk.result, names), names=list(names))
    files = [desk.file(name) for name in names]
    return Page("Comparison", _typeset(list(comparison_blocks(compared))), compare_command(files))


def _history(desk: Desk, names: Sequence[str], term: str) -> Page:
    from counterspin.histories.history import history
    from counterspin.histories.page import history_blocks

    command = history_command(desk.folder.root, term)
    try:
        found = history([desk.file(name) for name in names], term=term)
    except CampaignError:
        raise
    except CounterspinError as error:
        # Results without serial numbers are no mistake: there is no history of them, and why.
        return Page("History", [Paragraph(str(error), "warning")], command, empty=True)
    return Page(f"History of {term}", _typeset(list(history_blocks(found))), command)


def _forecast(desk: Desk, names: Sequence[str], _: str) -> Calculation:
    file = desk.file(names[0])
    desk.campaign(desk.folder.name(file.parent))
    return Calculation(forecast_into, file, forecast_command(file.parent))


def forecast_into(there: Connection, file: Path) -> None:
    """Forecast a campaign, and report as `processes.report_progress` does."""

    def work(_: Progress) -> PlanResult:
        from counterspin.planning.plan import check

        return check(file)

    report_progress(there, work)


def _study(desk: Desk, names: Sequence[str], _: str) -> Page:
    from counterspin.reports.publication import with_seal_warning
    from counterspin.studies.page import report_blocks
    from counterspin.studies.result import StudyResult

    file = desk.file(names[0])
    found = StudyResult.read(file)
    blocks = _typeset(with_seal_warning(found, report_blocks(found)))
    return Page(found.title, blocks, study_command(file.parent, found.trials_asked, file))


def _typeset(blocks: Sequence[Block]) -> list[Block]:
    return list(map(typeset_block, blocks))


_MAKERS: Final[Mapping[Kind, Callable[[Desk, Sequence[str], str], Page | Calculation]]] = {
    "result": _result,
    "comparison": _comparison,
    "history": _history,
    "forecast": _forecast,
    "study": _study,
}


def page_of(desk: Desk, kind: Kind, names: Sequence[str], term: str) -> dict[str, Any]:
    """Return a page's title, its blocks as HTML, and its command; or the job that makes it."""
    from counterspin.reports.html import html_fragment

    made = _page(desk, kind, names, term)
    if isinstance(made, Job):
        return {"job": made.shown()}
    files = [desk.file(name) for name in names]
    text = desk.remembered.get(
        ("html", kind, *files, term),
        files,
        lambda: desk.folder.spoken(html_fragment(made.blocks, title=made.title)),
    )
    told: dict[str, Any] = {"title": made.title, "html": text, "command": made.command}
    told["empty"] = made.empty
    if kind == "result":
        from counterspin.calibration.findings import judge_result
        from counterspin.calibration.pages.card import STATE_WORDS

        result = judge_result(desk.result(names[0]))
        told["accelerometers"] = list(result.accelerometers)
        told["state"] = result.state
        told["words"] = STATE_WORDS[result.state] if result.state else "Not judged"
    return told


def picture_of(desk: Desk, kind: Kind, names: Sequence[str], term: str, place: int) -> str:
    """Return a picture of a page as SVG, by its place among them; as `page_of`."""
    from counterspin.reports.charts import svg

    made = _page(desk, kind, names, term)
    if isinstance(made, Job):
        raise NotThereError("the page of this picture is still being prepared")
    pictures = [block for block in made.blocks if isinstance(block, Picture)]
    if not 0 <= place < len(pictures):
        raise NotThereError(f"there is no picture {place}")
    files = [desk.file(name) for name in names]
    with desk.drawing:
        return desk.remembered.get(
            ("svg", kind, *files, term, place),
            files,
            lambda: str(svg(pictures[place], theme="page")),
        )


def _page(desk: Desk, kind: Kind, names: Sequence[str], term: str) -> Page | Job:
    """Return a cached page or a quickly made one, or the job that makes it."""
    files: list[Path] = [desk.file(name) for name in names]
    known, keep = desk.remembered.find(("page", kind, *files, term), files)
    if known is not None:
        return cast("Page", known)
    made = _MAKERS[kind](desk, names, term)
    if isinstance(made, Page):
        return keep(made)
    calculation = made

    def make(number: int) -> Job:
        return Job(number, names[0], "", calculation.command, "forecast")

    def show(found: PlanResult) -> None:
        from counterspin.planning.page import plan_blocks

        keep(Page(found.title, _typeset(plan_blocks(found)), calculation.command))

    return desk.jobs.begin(make, calculation.work, calculation.file, then=show)
