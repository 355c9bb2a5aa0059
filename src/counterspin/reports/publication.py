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
REPORT_SUFFIXES: Final = (".html", ".pdf", ".md")


def require_report_format(path: Path) -> str:
    """Return the format of a file name; CampaignError if it is not supported."""
    suffix = path.suffix.lower()
    if suffix not in REPORT_SUFFIXES:
        raise CampaignError(
            "report",
            [f"{path}: the file name must end in .html, .pdf or .md"],
            code="wrong-file-ending",
        )
    return suffix


@frozen
class Publication:
    """Blocks of a report with its metadata."""

    document_type: str  #: Type in the mark of its files, such as "a comparison".
    #: Title and identifier.
    title: str
    identifier: str
    blocks: Sequence[Block]  #: Blocks, the answer first.
    version: str = __version__  #: Version of the program that computed the result.

    def text(self, suffix: str, issued: datetime) -> str:
        """Return the report as ``.html`` or ``.md``, with a time of issue that has a time zone."""
        if suffix == ".html":
            from counterspin.reports.html import render_html

            return render_html(
                self.blocks,
                title=self.title,
                identifier=self.identifier,
                date=issued,
                version=self.version,
                document_type=self.document_type,
            )
        from counterspin.reports.markdown import render_markdown

        issue_time = f"{issued.astimezone(UTC):%Y-%m-%d %H:%M} UTC"
        end_paragraph = Paragraph(f"End of {self.identifier}, {issue_time}.", "quiet")
        comment = f"<!-- {file_mark(self.document_type)} -->"
        return f"{render_markdown(self.blocks)}\n{comment}\n\n{render_markdown([end_paragraph])}"

    def pdf(self, issued: datetime) -> bytes:
        """Return the report as a PDF, with a time of issue that has a time zone."""
        from counterspin.reports.pdf import render_pdf

        return render_pdf(
            self.blocks,
            title=self.title,
            identifier=self.identifier,
            date=issued,
            document_type=self.document_type,
        )

    def write(self, path: Path, issued: datetime, *, overwrite: bool = False) -> None:
        """Write the report atomically.

        overwrite: Whether an existing report of this kind may be replaced; other files never are.
        """
        suffix = require_report_format(path)
        file_type = partial(marked_file_type, self.document_type)
        check_writable(path, file_type, overwrite=overwrite)
        data = self.pdf(issued) if suffix == ".pdf" else self.text(suffix, issued).encode()
        write_atomically(path, lambda file: file.write_bytes(data), file_type, overwrite=overwrite)


def make_publication(result: ReportableResult, identifier: str | None = None) -> Publication:
    """Return the report of a result, titled with its first heading.

    identifier: Identifier of the report; None: that of the result.
    """
    # The blocks of a report are typeset already, except names and checksums of files.
    page_blocks: Iterable[Block] = load_name(result.REPORT_BLOCKS or result.BLOCKS)(result)
    if not result.REPORT_BLOCKS:
        page_blocks = map(typeset_block, page_blocks)
    blocks = add_seal_warning(result, page_blocks)
    title = next((block.text for block in blocks if isinstance(block, Heading)), result.KIND)
    return Publication(result.report_kind(), title, identifier or result.identifier, blocks)


def seal_warnings(result: ResultFile) -> list[Paragraph]:
    """Return the warning on a result whose file has no seal; empty for a sealed result."""
    names = [] if result.sealed else [f"this {result.KIND}"]
    return [Paragraph(sentence, "warning") for sentence in unsealed_sentences(names)]


def add_seal_warning(result: ResultFile, blocks: Iterable[Block]) -> list[Block]:
    """Insert a warning after the title if the file of a result has no seal."""
    all_blocks = list(blocks)
    new_warnings = [warning for warning in seal_warnings(result) if warning not in all_blocks]
    insert_index = 1 if all_blocks and isinstance(all_blocks[0], Heading) else 0
    return [*all_blocks[:insert_index], *new_warnings, *all_blocks[insert_index:]]


def parse_issue_date(text: str | None = None) -> datetime:
    """Return the date of issue of a document.

    text: A date or a date and time by ISO 8601, without a time zone in UTC. None: the seconds in
        ``SOURCE_DATE_EPOCH`` of the environment (reproducible-builds.org), or else now.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        if text is not None:
            if "T" not in text and " " not in text.strip():
                return datetime.combine(date.fromisoformat(text.strip()), time(), UTC)
            issue_date = datetime.fromisoformat(text.strip())
            issue_date = issue_date if issue_date.tzinfo else issue_date.replace(tzinfo=UTC)
            # In UTC the year may be outside the calendar.
            issue_date.astimezone(UTC)
            return issue_date
        if epoch:
            return datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError) as error:
        source, date_text = ("`date`", text) if text is not None else ("SOURCE_DATE_EPOCH", epoch)
        raise CampaignError(
            source,
            [f"{date_text!r} is not a date: write 2026-03-01 or 2026-03-01T14:30:00+01:00"],
            code="invalid-date",
        ) from error
    return datetime.now(UTC).replace(microsecond=0)


#: Largest number of text lines in a cell; `print_result` and the report show all.
MAX_CELL_LINES: Final = 20

_TEXT_WIDTH: Final = 100


def short_text(blocks: Sequence[Block]) -> str:
    """Return blocks as text of at most `MAX_CELL_LINES` lines, with the number of omitted lines."""
    from rich.console import Console

    from counterspin.reports.text import Report

    console = Console(file=io.StringIO(), width=_TEXT_WIDTH, highlight=False, color_system=None)
    with console.capture() as capture:
        console.print(Report(list(blocks)))
    lines = [line.rstrip() for line in capture.get().rstrip().split("\n")]
    if len(lines) <= MAX_CELL_LINES:
        return "\n".join(lines)
    n_omitted = len(lines) - MAX_CELL_LINES + 1
    return "\n".join([*lines[: MAX_CELL_LINES - 1], f"... {n_omitted} more lines"])


def draw_on_axes(pictures: Sequence[Picture], axes: Any = None) -> list[Any]:
    """Draw pictures in the style of the reports on axes of Matplotlib.

    axes: One matplotlib.axes.Axes, or one for each picture. None: stacked axes of a new figure,
        which a notebook shows.
    """
    import numpy as np

    from counterspin.reports.drawing import PAPER_COLOURS, draw_on_axes, drawing_parameters

    figure = None
    if axes is None:
        import matplotlib.pyplot as plt

        # The first figure loads the notebook's backend, which sets parameters permanently, so
        # create it before the temporary parameters of the reports.
        figure_size, background = (7.0, 2.6 * len(pictures)), PAPER_COLOURS["ground"]
        figure = plt.figure(figsize=figure_size, facecolor=background, layout="constrained")
    with drawing_parameters(PAPER_COLOURS):
        if figure is not None:
            axes = figure.subplots(len(pictures), 1)
        axes_list = list(np.atleast_1d(np.asarray(axes, dtype=object)).ravel())
        if len(axes_list) != len(pictures):
            raise ValueError(f"{len(axes_list)} axes were given for {len(pictures)} plots")
        for picture, axes_item in zip(pictures, axes_list, strict=True):
            draw_on_axes(axes_item, cast("Picture", typeset_block(picture)))
    return axes_list


def _require_publication(result: ReportableResult, identifier: str | None) -> Publication:
    """Return the report of a result; TypeError for anything else."""
    if not isinstance(result, ReportableResult):
        raise TypeError(f"give a counterspin result, not {result!r} ({type(result).__name__})")
    publication: Publication = result.publication(identifier)
    return publication


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
        Result of a function of counterspin, or read from its JSON file: a calibration, a plan, a
        study, a history and so on.
    kind
        ``html``, ``md`` or ``pdf``.
    identifier, issued
        As in `write_report`.

    Returns
    -------
    str or bytes
        The report; bytes for ``pdf``.

    Raises
    ------
    CampaignError
        If `kind` is unknown.
    """
    publication = _require_publication(result, identifier)
    issue_time = issued or parse_issue_date()
    if kind == "pdf":
        return publication.pdf(issue_time)
    if kind not in ("html", "md"):
        raise UsageError("report", [f"kind: {kind!r} is not html, md or pdf"])
    return publication.text(f".{kind}", issue_time)


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
        Result of a function of counterspin, or read from its JSON file: a calibration, a plan, a
        study, a history and so on.
    path
        Output file; its suffix selects the format: .html, .pdf or .md.
    identifier
        Identifier of the report; None: derived from the result.
    issued
        Time of issue, with its time zone; None: SOURCE_DATE_EPOCH, or now.
    overwrite
        Whether an existing report may be replaced; other files never are.

    Raises
    ------
    CampaignError
        If the format is unknown.
    CounterspinError
        If another file exists at the path, or the report cannot be written; no partial file is left
        behind.
    """
    publication = _require_publication(result, identifier)
    publication.write(Path(path), issued or parse_issue_date(), overwrite=overwrite)
