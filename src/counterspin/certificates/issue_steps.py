"""Steps of issue that are common to certificates of results and of centrifuges."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, date, datetime, time, timedelta
from pathlib import Path
from typing import Any

from counterspin.certificates.amendment import AmendedCertificate, check_new_identifier
from counterspin.certificates.completeness import MissingEntry, missing_lines
from counterspin.certificates.lab import Lab
from counterspin.certificates.ledger import sha256_hex
from counterspin.certificates.logo import read_logo
from counterspin.certificates.pdf_pages import page_title
from counterspin.certificates.signature import sign_pages
from counterspin.certificates.signers import Signer
from counterspin.certificates.statements import Issue
from counterspin.errors import CampaignError, error_code
from counterspin.reports.blocks import Block
from counterspin.reports.publication import parse_issue_date


def read_laboratory_logo(lab: Lab, folder: Path, source: str) -> bytes | None:
    """Read the logo; CampaignError if it cannot be used."""
    name = lab.laboratory.logo
    try:
        return None if name is None else read_logo(folder, name)
    except ValueError as error:
        raise CampaignError(
            source, [f"laboratory.logo: {error}"], code=error_code(error, "wrong-file-type")
        ) from error


def sign_pages_if_requested(pdf: bytes, signer: Signer | None) -> bytes:
    """Sign the pages if there is a signer."""
    return pdf if signer is None else sign_pages(pdf, signer, parse_issue_date())


def ledger_path(lab: Lab, lab_source: Mapping[str, Any] | Path | str) -> Path | None:
    """Return the path of the ledger in the folder of the laboratory file; None without one."""
    if lab.certificate.ledger is None:
        return None
    folder = Path() if isinstance(lab_source, Mapping) else Path(lab_source).parent
    return folder / lab.certificate.ledger


def issue_notes(lab: Lab, issue: Issue, missing_entries: Sequence[MissingEntry]) -> Iterator[str]:
    """Yield notes on dates, characters and missing data for the laboratory."""
    from counterspin.reports.pdf import find_missing_glyphs

    if (issue_day := issue.date.date()) < lab.certificate.end:
        yield (
            f"The date of issue, {issue_day}, is earlier than certificate.end, "
            f"{lab.certificate.end}."
        )
    # In other time zones, the day may be one later.
    if (issued := lab.certificate.issued) and issued > parse_issue_date().date() + timedelta(1):
        yield f"certificate.issued, {issued}, is in the future."
    for equipment in lab.equipment:
        due = equipment.due or date.max
        key = "begin" if due < lab.certificate.begin else "end"
        limit: date = getattr(lab.certificate, key)
        if due < limit:
            yield (
                f"The calibration of {equipment.name} was due on {due}, earlier than "
                f"certificate.{key}, {limit}."
            )
    if missing_glyphs := find_missing_glyphs(lab.model_dump_json(warnings="none")):
        yield (
            f"The fonts of this computer have no glyphs for {missing_glyphs}, so the pages show "
            "squares instead. The XML is not affected. Install a font with these glyphs."
        )
    if missing_entries:
        yield (
            "This document is a draft, so it cannot be signed or entered in a ledger. These "
            "entries are missing:"
        )
        yield from missing_lines(missing_entries)


def signer_notes(signer: Signer | None, issue: Issue) -> Iterator[str]:
    """Yield a note if the signer certificate is not valid on the day of issue."""
    if signer is None:
        return
    valid_until = signer.certificates[0].not_valid_after_utc.date()
    valid_from = signer.certificates[0].not_valid_before_utc.date()
    if not valid_from <= issue.date.date() <= valid_until:
        yield (
            f"The date of issue, {issue.date.date()}, is outside the validity period of the "
            f"signer's certificate ({valid_from} to {valid_until}). After {valid_until}, verifiers "
            "will not accept the signature."
        )


def _derive_identifier(lab: Lab, content: bytes, acceptance_reasons: Sequence[str]) -> str:
    """Derive an identifier from the result file and the laboratory data."""
    lab_json = lab.model_dump_json(by_alias=True, exclude_unset=True, warnings="none")
    hashed_texts = (sha256_hex(content), lab_json, *(acceptance_reasons or [""]))
    return f"CS-{sha256_hex(chr(0).join(hashed_texts).encode('utf-8', 'surrogatepass'))[:12]}"


def make_issue(
    lab: Lab,
    content: bytes,
    amended_certificate: AmendedCertificate | None,
    acceptance_reasons: Sequence[str],
    *,
    is_draft: bool,
) -> Issue:
    """Return identifier, date and state of a certificate.

    content: Bytes of the result file.
    acceptance_reasons: Reasons for exceptions.
    """
    default_identifier = (
        _derive_identifier(lab, content, acceptance_reasons)
        if amended_certificate is None
        else amended_certificate.next_identifier()
    )
    identifier = lab.certificate.identifier or default_identifier
    if amended_certificate is not None:
        check_new_identifier(identifier, amended_certificate)
    return Issue(
        identifier=f"DRAFT-{identifier}" if is_draft else identifier,
        # Without a time of day, XML and PDF issued one after the other are identical.
        date=datetime.combine(lab.certificate.issued or parse_issue_date().date(), time(), UTC),
        is_draft=is_draft,
        amended_certificate=amended_certificate,
    )


def render_pages(blocks: Sequence[Block], issue: Issue, *, xml: bytes | None = None) -> bytes:
    """Render the pages as PDF, with the XML attached if given."""
    from counterspin.reports.pdf import Attachment, render_pdf

    attachments = []
    if xml is not None:
        attachments.append(
            Attachment(
                name=issue.file_name(".xml"),
                data=xml,
                media_type="application/xml",
                description="Digital Calibration Certificate (DCC)",
                relationship="data",
            )
        )
    pdf_bytes: bytes = render_pdf(list(blocks), attachments=attachments, **_page_settings(issue))
    return pdf_bytes


def render_images(blocks: Sequence[Block], issue: Issue) -> list[str]:
    """Render the pages as SVG images."""
    from counterspin.reports.pdf import render_page_images

    return render_page_images(list(blocks), **_page_settings(issue))


def _page_settings(issue: Issue) -> dict[str, Any]:
    """Return title, identifier, date and marks of the pages."""
    from counterspin.reports.pdf import PageMarks

    return {
        "title": page_title(issue),
        "identifier": issue.identifier,
        "date": issue.date,
        "marks": PageMarks("DRAFT" if issue.is_draft else "", issue.logo),
    }
