"""Reports of results as files, in a notebook, and as text or bytes."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Sequence
from datetime import UTC, date, datetime, time
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, cast, overload

from counterspin._version import __version__
from counterspin.errors import CampaignError, UsageError
from counterspin.frozen import frozen
from counterspin.loading import load_name
from counterspin.output import check_writable, file_mark, marked_file_type, write_atomically
from counterspin.reports.blocks import Block, Heading, Paragraph, Picture
from counterspin.reports.typography import typeset_block
from counterspin.results import ReportableResult, ResultFile, unsealed_sentences

#: Suffixes of report files.
FORMATS: Final = (".html", ".pdf", ".md")


def check_format(path: Path) -> str:
    """Return the format of a file name; CampaignError if it is not supported."""
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise CampaignError(
            "report",
            [f"{path}: the file name must end in .html, .pdf or .md"],
            code="wrong-file-ending",
        )
    return suffix


@frozen
class Publication:
    """Blocks of a report with its metadata."""

    kind: str  #: Description in its files, such as "a comparison".
    #: Title and identifier.
    title: str
    identifier: str
    blocks: Sequence[Block]  #: Blocks, the answer first.
    version: str = __version__  #: Version of the program that computed the result.

    def text(self, suffix: str, issued: datetime) -> str:
        """Return the report as ``.html`` or ``.md``, with a time of issue that has a time zone."""
        if suffix == ".html":
            from counterspin.reports.html import html

            return html(
                self.blocks,
                title=self.title,
                identifier=self.identifier,
                date=issued,
                version=self.version,
                kind=self.kind,
            )
        from counterspin.reports.markdown import markdown

        made = f"{issued.astimezone(UTC):%Y-%m-%d %H:%M} UTC"
        end = Paragraph(f"End of {self.identifier}, {made}.", "quiet")
        return f"{markdown(self.blocks)}\n<!-- {file_mark(self.kind)} -->\n\n{markdown([end])}"

    def pdf(self, issued: datetime) -> bytes:
        """Return the report as a PDF, with a time of issue that has a time zone."""
        from counterspin.reports.pdf import pdf

        return pdf(
            self.blocks,
            title=self.title,
            identifier=self.identifier,
            date=issued,
            kind=self.kind,
        )

    def write(self, path: Path, issued: datetime, *, overwrite: bool = False) -> None:
        """Write the report atomically.

        overwrite: Whether an existing report of this kind may be replaced; other files never are.
        """
        suffix, kind = check_format(path), partial(marked_file_type, self.kind)
        check_writable(path, kind, overwrite=overwrite)
        data = self.pdf(issued) if suffix == ".pdf" else self.text(suffix, issued).encode()
        write_atomically(path, lambda part: part.write_bytes(data), kind, overwrite=overwrite)


def publish(result: ReportableResult, identifier: str | None = None) -> Publication:
    """Return the report of a result, titled with its first heading.

    identifier: Identifier of the report; None: that of the result.
    """
    blocks = with_seal_warning(result, load_name(result.REPORT_BLOCKS or result.BLOCKS)(result))
    title = next(
        (block.text for block in blocks if isinstance(block, Heading)), result.DOCUMENT_TYPE
    )
    return Publication(result.report_type(), title, identifier or result.identifier, blocks)


def seal_warnings(result: ResultFile) -> list[Paragraph]:
    """Return the warning of a result whose file has no seal; nothing for a sealed result."""
    names = [] if result.sealed else [f"this {result.DOCUMENT_TYPE}"]
    return [Paragraph(sentence, "warning") for sentence in unsealed_sentences(names)]


def with_seal_warning(result: ResultFile, blocks: Iterable[Block]) -> list[Block]:
    """Return the blocks of a result, with a warning behind the title if its file has no seal."""
    whole = list(blocks)
    missing = [warning for warning in seal_warnings(result) if warning not in whole]
    after_title = 1 if whole and isinstance(whole[0], Heading) else 0
    return [*whole[:after_title], *missing, *whole[after_title:]]


def issue_date(text: str | None = None) -> datetime:
    """Return the date of issue of a document.

    text: A date or a date and time by ISO 8601, without a time zone in UTC. None: the seconds in
        ``SOURCE_DATE_EPOCH`` of the environment (reproducible-builds.org), or else now.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        if text is not None:
            if "T" not in text and " " not in text.strip():
                return datetime.combine(date.fromisoformat(text.strip()), time(), UTC)
            given = datetime.fromisoformat(text.strip())
            given = given if given.tzinfo else given.replace(tzinfo=UTC)
            # In UTC the year may be outside the calendar.
            given.astimezone(UTC)
            return given
        if epoch:
            return datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError) as error:
        source, given_text = ("`date`", text) if text is not None else ("SOURCE_DATE_EPOCH", epoch)
        raise CampaignError(
            source,
            [f"{given_text!r} is not a date: write 2026-03-01 or 2026-03-01T14:30:00+01:00"],
            code="invalid-date",
        ) from error
    return datetime.now(UTC).replace(microsecond=0)


#: Largest number of text lines in a cell; `print_result` and the report show all.
MAX_LINES: Final = 20

_WIDTH: Final = 100


def short_text(blocks: Sequence[Block]) -> str:
    """Return blocks as text of at most `MAX_LINES` lines, with the number of omitted lines."""
    from rich.console import Console

    from counterspin.reports.text import Report

    console = Console(file=io.StringIO(), width=_WIDTH, highlight=False, color_system=None)
    with console.capture() as capture:
        console.print(Report(list(blocks)))
    lines = [line.rstrip() for line in capture.get().rstrip().split("\n")]
    if len(lines) <= MAX_LINES:
        return "\n".join(lines)
    return "\n".join([*lines[: MAX_LINES - 1], f"... {len(lines) - MAX_LINES + 1} more lines"])


def draw_on_axes(pictures: Sequence[Picture], axes: Any = None) -> list[Any]:
    """Draw pictures in the style of the reports on axes of Matplotlib.

    axes: One matplotlib.axes.Axes, or one for each picture. None: stacked axes of a new figure,
        which a notebook shows.
    """
    import numpy as np

    from counterspin.reports.drawing import PAPER_COLOURS, draw_on_axes, settings

    figure = None
    if axes is None:
        import matplotlib.pyplot as plt

        # The first figure loads the notebook's backend, whose settings must remain: so create it
        # before the temporary settings of the reports.
        size, ground = (7.0, 2.6 * len(pictures)), PAPER_COLOURS["ground"]
        figure = plt.figure(figsize=size, facecolor=ground, layout="constrained")
    with settings(PAPER_COLOURS):
        if figure is not None:
            axes = figure.subplots(len(pictures), 1)
        own = list(np.atleast_1d(np.asarray(axes, dtype=object)).ravel())
        if len(own) != len(pictures):
            raise ValueError(f"{len(own)} axes were given for {len(pictures)} plots")
        for picture, place in zip(pictures, own, strict=True):
            draw_on_axes(place, cast("Picture", typeset_block(picture)))
    return own


def _publication_of(result: ReportableResult, identifier: str | None) -> Publication:
    """Return the report of a result; TypeError for anything else."""
    if not isinstance(result, ReportableResult):
        raise TypeError(f"give a counterspin result, not {result!r} ({type(result).__name__})")
    page: Publication = result.publication(identifier)
    return page


@overload
def report(
    result: ReportableResult,
    kind: Literal["html", "md"] = "html",
    *,
    identifier: str | None = None,
    issued: datetime | None = None,
) -> str: ...
@overload
def report(
    result: ReportableResult,
    kind: Literal["pdf"],
    *,
    identifier: str | None = None,
    issued: datetime | None = None,
) -> bytes: ...
def report(
    result: ReportableResult,
    kind: Literal["html", "md", "pdf"] = "html",
    *,
    identifier: str | None = None,
    issued: datetime | None = None,
) -> str | bytes:
    """Return the report of a result: text, or bytes of a PDF.

    Parameters
    ----------
    result
        What a function of counterspin returned, or what was read from its JSON: a calibration,
        a plan, a study, a history and so on.
    kind
        ``html``, ``md`` or ``pdf``.
    identifier, issued
        As in `write_report`.

    Raises
    ------
    CampaignError
        If there is no such kind.
    """
    page = _publication_of(result, identifier)
    made = issued or issue_date()
    if kind == "pdf":
        return page.pdf(made)
    if kind not in ("html", "md"):
        raise UsageError("report", [f"kind: {kind!r} is not html, md or pdf"])
    return page.text(f".{kind}", made)


def write_report(
    result: ReportableResult,
    path: Path | str,
    *,
    identifier: str | None = None,
    issued: datetime | None = None,
    overwrite: bool = False,
) -> None:
    """Write the report of a result.

    Parameters
    ----------
    result
        What a function of counterspin returned, or what was read from its JSON: a calibration,
        a plan, a study, a history and so on.
    path
        The file; its ending says the format: .html, .pdf or .md.
    identifier
        What the report is known by; None: one that follows from the result.
    issued
        When it was made, with its time zone; None: as `issue_date` has it.
    overwrite
        Whether an earlier report may be replaced; nothing else is.

    Raises
    ------
    CampaignError
        If there is no such format.
    CounterspinError
        If a file is in the way or it cannot be written; nothing is left behind then.
    """
    page = _publication_of(result, identifier)
    page.write(Path(path), issued or issue_date(), overwrite=overwrite)
