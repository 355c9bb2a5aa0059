"""Pages of ours as files: HTML, PDF or Markdown, by the ending of the name."""

from __future__ import annotations

import os
from collections.abc import Sequence
from datetime import UTC, date, datetime, time
from functools import partial
from pathlib import Path
from typing import Final

from counterspin._version import __version__
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.output import mark, marked, reserve, write_whole
from counterspin.reports.blocks import Block, Paragraph

#: Endings of the files that are written.
FORMATS: Final = (".html", ".pdf", ".md")


def check_format(path: Path) -> str:
    """Return the format that a file's name asks for; CampaignError if there is no such format."""
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise CampaignError("report", [f"{path}: name the file .html, .pdf or .md"])
    return suffix


@frozen
class Publication:
    """Blocks with what they are."""

    kind: str  #: What every file of them says that it is, such as "a comparison".
    #: What it is called, and what it is known by.
    title: str
    identifier: str
    blocks: Sequence[Block]  #: The answer first.
    version: str = __version__  #: Of the program that computed what they show.

    def text(self, suffix: str, issued: datetime) -> str:
        """Return it as ``.html`` or ``.md``, made at a time with its zone."""
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
        return f"{markdown(self.blocks)}\n<!-- {mark(self.kind)} -->\n\n{markdown([end])}"

    def pdf(self, issued: datetime) -> bytes:
        """Return it as a PDF, made at a time with its zone."""
        from counterspin.reports.pdf import pdf

        return pdf(
            self.blocks,
            title=self.title,
            identifier=self.identifier,
            date=issued,
            kind=self.kind,
        )

    def write(self, path: Path, issued: datetime, *, overwrite: bool = False) -> None:
        """Write it, whole or not at all.

        overwrite: Whether an earlier one of this kind may be replaced; nothing else is.
        """
        suffix, kind = check_format(path), partial(marked, self.kind)
        reserve(path, kind, overwrite=overwrite)
        data = self.pdf(issued) if suffix == ".pdf" else self.text(suffix, issued).encode()
        write_whole(path, lambda part: part.write_bytes(data), kind, overwrite=overwrite)


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
