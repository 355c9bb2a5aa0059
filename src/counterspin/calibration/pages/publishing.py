"""A report as a file: HTML, PDF or Markdown, by the ending of its name."""

from __future__ import annotations

import os
from datetime import UTC, date, datetime, time
from pathlib import Path
from typing import Final, Literal, overload

from counterspin.calibration.pages.full_report import document, identifier_of
from counterspin.calibration.result import Result
from counterspin.errors import CampaignError
from counterspin.reports.publication import Publication

#: What every file of one says that it is.
KIND: Final = "a calibration report"


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
    page, made = _publication(result, identifier), issued or issue_date()
    if kind == "pdf":
        return page.pdf(made)
    if kind not in ("html", "md"):
        raise CampaignError("report", [f"kind: {kind!r} is not html, md or pdf"])
    return page.text(f".{kind}", made)


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
    page = _publication(result, identifier)
    page.write(Path(path), issued or issue_date(), overwrite=overwrite)


def _publication(result: Result, identifier: str | None) -> Publication:
    return Publication(
        kind=KIND,
        title=result.title or "Calibration",
        identifier=identifier or identifier_of(result),
        blocks=document(result),
        version=result.provenance.version,
    )


def issue_date(text: str | None = None) -> datetime:
    """Return when a document is said to have been made.

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
