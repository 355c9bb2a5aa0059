"""A report as a file: HTML, PDF or Markdown, by the ending of its name.

- `report`: a result's report as text or bytes; `write_report`: to a file
- `file_kind`: how its own files are known again
- `issue_date`: when it is said to have been made
"""

from __future__ import annotations

import os
from datetime import UTC, date, datetime, time
from pathlib import Path
from typing import Any, Final, Literal, overload

from counterspin.calibration.pages.full_report import document, identifier_of
from counterspin.calibration.result import Result
from counterspin.errors import CampaignError
from counterspin.output import FileKind, holds, reserve, write_text, write_whole
from counterspin.reports.blocks import Paragraph

#: Endings of the files that are written.
FORMATS: Final = (".html", ".pdf", ".md")


#: Stands in the place of a calibration's title in a report that compares several.
COMPARISON_TITLE: Final = "Comparison of results"

#: What stands in a report of each.
_MARKS: Final = {
    ".html": b'name="generator" content="counterspin',
    ".pdf": b"counterspin",
    ".md": b"counterspin calibrate",
}


def file_kind(path: Path) -> FileKind:
    """Return what `write_report` writes under a name, so that its own reports are known again."""
    marked, attached = holds(_MARKS[check_format(path)]), holds(b"/EmbeddedFile")
    compares = holds(COMPARISON_TITLE.encode())

    def recognises(place: Path) -> bool:
        # A certificate's PDF says the same of its making, and carries its XML.
        own = marked(place) and not attached(place) and not compares(place)
        return own and place.suffix.lower() == path.suffix.lower()

    return FileKind("a report of counterspin", recognises)


def check_format(path: Path) -> str:
    """Return the format that a file's name asks for; CampaignError if there is no such format."""
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise CampaignError("report", [f"{path}: name the file .html, .pdf or .md"])
    return suffix


@overload
def report(
    result: Result,
    kind: Literal["html", "md"] = "html",
    *,
    identifier: str | None = None,
    issued: datetime | None = None,
) -> str: ...
@overload
def report(
    result: Result,
    kind: Literal["pdf"],
    *,
    identifier: str | None = None,
    issued: datetime | None = None,
) -> bytes: ...
def report(
    result: Result,
    kind: Literal["html", "md", "pdf"] = "html",
    *,
    identifier: str | None = None,
    issued: datetime | None = None,
) -> str | bytes:
    """Return the full report of a result: text, or bytes of a PDF.

    Parameters
    ----------
    result
        What `calibrate` returned, or what was read from its JSON.
    kind
        ``html``, ``md`` or ``pdf``.
    identifier, issued
        As of `write_report`.

    Raises
    ------
    CampaignError
        If there is no such kind.
    """
    blocks = document(result)
    known_by = identifier or identifier_of(result)
    made = issued or issue_date()
    title = result.title or "Calibration"
    if kind == "html":
        from counterspin.reports.html import html

        version = result.provenance.version
        return html(blocks, title=title, identifier=known_by, date=made, version=version)
    if kind == "pdf":
        from counterspin.reports.pdf import pdf

        return pdf(blocks, title=title, identifier=known_by, date=made)
    if kind != "md":
        raise CampaignError("report", [f"kind: {kind!r} is not html, md or pdf"])
    from counterspin.reports.markdown import markdown

    end = Paragraph(f"End of {known_by}, {made.astimezone(UTC):%Y-%m-%d %H:%M} UTC.", "quiet")
    return markdown([*blocks, end])


def write_report(
    result: Result,
    path: Path | str,
    *,
    identifier: str | None = None,
    issued: datetime | None = None,
    overwrite: bool = False,
) -> None:
    """Write the full report of a result.

    Parameters
    ----------
    result
        What `calibrate` returned, or what was read from its JSON.
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
    path = Path(path)
    suffix = check_format(path)
    reserve(path, lambda: file_kind(path), overwrite=overwrite)
    kind: Any = suffix.removeprefix(".")
    made: str | bytes = report(result, kind, identifier=identifier, issued=issued)
    if isinstance(made, bytes):
        write_whole(path, lambda part: part.write_bytes(made))
    else:
        write_text(path, made)


def issue_date(text: str | None = None) -> datetime:
    """Return when a document is said to have been made.

    Parameters
    ----------
    text
        A date or a date and time by ISO 8601, without a time zone in UTC. None: the seconds in
        ``SOURCE_DATE_EPOCH`` of the environment (reproducible-builds.org), or else now.

    Raises
    ------
    CampaignError
        If it is no such date.
    """
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        if text is not None:
            if "T" not in text and " " not in text.strip():
                return datetime.combine(date.fromisoformat(text.strip()), time(), UTC)
            given = datetime.fromisoformat(text.strip())
            given = given if given.tzinfo else given.replace(tzinfo=UTC)
            # It is shown in UTC, where the year may be one that no calendar has.
            given.astimezone(UTC)
            return given
        if epoch:
            return datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError) as error:
        source, given_text = ("`date`", text) if text is not None else ("SOURCE_DATE_EPOCH", epoch)
        raise CampaignError(
            source, [f"{given_text!r} is no date: write 2026-03-01 or 2026-03-01T14:30:00+01:00"]
        ) from error
    return datetime.now(UTC).replace(microsecond=0)
