"""The report of any result: HTML, PDF or Markdown, as a file or returned."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Literal, overload

from counterspin.errors import CampaignError
from counterspin.reports.publication import issue_date
from counterspin.reports.shown import ShownResult


@overload
def report(
    result: ShownResult,
    kind: Literal["html", "md"] = "html",
    *,
    identifier: str | None = None,
    issued: datetime | None = None,
) -> str: ...
@overload
def report(
    result: ShownResult,
    kind: Literal["pdf"],
    *,
    identifier: str | None = None,
    issued: datetime | None = None,
) -> bytes: ...
def report(
    result: ShownResult,
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
        As of `write_report`.

    Raises
    ------
    CampaignError
        If there is no such kind.
    """
    page, made = result.publication(identifier), issued or issue_date()
    if kind == "pdf":
        return page.pdf(made)
    if kind not in ("html", "md"):
        raise CampaignError("report", [f"kind: {kind!r} is not html, md or pdf"])
    return page.text(f".{kind}", made)


def write_report(
    result: ShownResult,
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
    result.write_report(path, identifier=identifier, issued=issued, overwrite=overwrite)
