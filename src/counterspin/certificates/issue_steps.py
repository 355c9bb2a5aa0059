"""Steps of issuing that the certificates of results and of centrifuges share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime, time
from pathlib import Path
from typing import Any

from counterspin.certificates.amendment import AmendedCertificate, check_new_identifier
from counterspin.certificates.completeness import MissingEntry, missing_lines
from counterspin.certificates.lab import Lab
from counterspin.certificates.ledger import checksum_of
from counterspin.certificates.logo import read_logo
from counterspin.certificates.pdf_pages import page_title
from counterspin.certificates.signature import sign_pages
from counterspin.certificates.signers import Signer
from counterspin.certificates.statements import Issue
from counterspin.errors import CampaignError, error_code
from counterspin.reports.blocks import Block
from counterspin.reports.publication import issue_date


def read_laboratory_logo(lab: Lab, folder: Path, source: str) -> bytes | None:
    """Return the content of the logo; CampaignError if it cannot be used."""
    name = lab.laboratory.logo
    try:
        return None if name is None else read_logo(folder, name)
    except ValueError as error:
        raise CampaignError(
            source, [f"laboratory.logo: {error}"], code=error_code(error, "wrong-file-type")
        ) from error


def signed_pages(pages: bytes, signer: Signer | None) -> bytes:
    """Return the pages with a signature if there is a signer."""
    return pages if signer is None else sign_pages(pages, signer, issue_date())


def ledger_path(data: Lab, lab: Mapping[str, Any] | Path | str) -> Path | None:
    """Return the path of the ledger beside the laboratory's file; None without one."""
    if data.certificate.ledger is None:
        return None
    folder = Path() if isinstance(lab, Mapping) else Path(lab).parent
    return folder / data.certificate.ledger


def issue_notes(lab: Lab, issue: Issue, missing: Sequence[MissingEntry]) -> Iterator[str]:
    """Yield notes on dates and missing data, which the laboratory should check."""
    if (day := issue.date.date()) < lab.certificate.end:
        yield f"The day of issue, {day}, is earlier than certificate.end, {lab.certificate.end}."
    for equipment in lab.equipment:
        if equipment.due is not None and equipment.due < lab.certificate.begin:
            yield (
                f"The calibration of {equipment.name} was due on {equipment.due}, earlier than "
                f"certificate.begin, {lab.certificate.begin}."
            )
    if missing:
        yield (
            "This document is a draft, so it cannot be signed or entered in a ledger. These "
            "entries are missing:"
        )
        yield from missing_lines(missing)


def signer_notes(signer: Signer | None, issue: Issue) -> Iterator[str]:
    """Yield a note if the signer's certificate is not valid on the day of issue."""
    if signer is None:
        return
    end = signer.certificates[0].not_valid_after_utc.date()
    begin = signer.certificates[0].not_valid_before_utc.date()
    if not begin <= issue.date.date() <= end:
        yield (
            f"The day of issue, {issue.date.date()}, is outside the validity period of the "
            f"signer's certificate ({begin} to {end}). After {end}, verifiers will not accept "
            "the signature."
        )


def _identifier(lab: Lab, content: bytes, accepted: Sequence[str]) -> str:
    """Return an identifier derived from the bytes of the result and the laboratory's data."""
    stated = lab.model_dump_json(by_alias=True, exclude_unset=True, warnings="none")
    rests_on = (checksum_of(content), stated, *(accepted or [""]))
    return f"CS-{checksum_of(chr(0).join(rests_on).encode('utf-8', 'surrogatepass'))[:12]}"


def make_issue(
    lab: Lab,
    content: bytes,
    amended: AmendedCertificate | None,
    accepted: Sequence[str],
    *,
    draft: bool,
) -> Issue:
    """Return identifier, date and state of a certificate.

    content: Bytes of the result's file.
    accepted: Reasons of exceptions.
    """
    unnamed = _identifier(lab, content, accepted) if amended is None else amended.next_identifier()
    identifier = lab.certificate.identifier or unnamed
    if amended is not None:
        check_new_identifier(identifier, amended)
    return Issue(
        identifier=f"DRAFT-{identifier}" if draft else identifier,
        # The date has no time of day, so that XML and PDF made one after the other are identical.
        date=datetime.combine(lab.certificate.issued or issue_date().date(), time(), UTC),
        draft=draft,
        amended=amended,
    )


def render_pages(blocks: Sequence[Block], issue: Issue, *, attach: bytes | None = None) -> bytes:
    """Return the pages as PDF, with the XML attached if it is given."""
    from counterspin.reports.pdf import Attachment, pdf

    attachments = []
    if attach is not None:
        attachments.append(
            Attachment(
                name=issue.file_name(".xml"),
                data=attach,
                media_type="application/xml",
                description="Digital Calibration Certificate (DCC)",
                relationship="data",
            )
        )
    data: bytes = pdf(list(blocks), attachments=attachments, **_page_settings(issue))
    return data


def render_images(blocks: Sequence[Block], issue: Issue) -> list[str]:
    """Return the pages as SVG images."""
    from counterspin.reports.pdf import page_images

    return page_images(list(blocks), **_page_settings(issue))


def _page_settings(issue: Issue) -> dict[str, Any]:
    """Return title, identifier, date and marks of the pages."""
    from counterspin.reports.pdf import PageMarks

    return {
        "title": page_title(issue),
        "identifier": issue.identifier,
        "date": issue.date,
        "marks": PageMarks("DRAFT" if issue.draft else "", issue.logo),
    }
