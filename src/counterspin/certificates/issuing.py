"""From a result to a certificate's file, and from the file back to its numbers.

- `issue_certificate`: read, check, build, sign, validate, write
- `Outcome`: what was written
- `check_certificate`: validate, verify the signature, read the numbers
- `certificate_blocks`: the numbers of a certificate as a page
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, time
from pathlib import Path
from typing import Final

from counterspin.calibration.conformity import with_conformity
from counterspin.calibration.pages.full_report import document, identifier_of
from counterspin.calibration.pages.publishing import issue_date
from counterspin.calibration.result import Result
from counterspin.certificates.administrative import Issue
from counterspin.certificates.build import certificate, check_certifiable, to_bytes
from counterspin.certificates.conversion import with_exact_g
from counterspin.certificates.front import TITLE, front_blocks, results_table
from counterspin.certificates.lab import Lab, example_keys, read_lab
from counterspin.certificates.reading import Certified, read_certificate
from counterspin.certificates.schema import check_schema
from counterspin.certificates.signature import read_signer, sign, verify
from counterspin.certificates.statements import Verdicts
from counterspin.errors import CampaignError, CounterspinError, RecordError
from counterspin.input import read_file
from counterspin.output import write_whole
from counterspin.reports.blocks import Block, Heading, Paragraph
from counterspin.reports.numbers import format_number

#: Endings of the files that are written.
FORMATS: Final = (".xml", ".pdf")


@dataclass(frozen=True)
class Outcome:
    """What was written.

    Attributes
    ----------
    identifier
        Of the certificate.
    accelerometers
        The names of those certified.
    notes
        What the laboratory should check, in sentences.
    """

    identifier: str
    accelerometers: list[str]
    notes: list[str]


def issue_certificate(
    result_file: Path,
    lab_file: Path,
    output: Path,
    *,
    schema: Path | None = None,
    key: Path | None = None,
    cert: Path | None = None,
) -> Outcome:
    """Write the certificate of a result.

    Parameters
    ----------
    result_file
        The result's JSON.
    lab_file
        ``LAB.toml``.
    output
        ``.xml``: the certificate; ``.pdf``: pages to read (PDF/A-3), with the same XML, byte
        for byte, attached.
    schema
        Folder or file of DCC's schema, against which the certificate is validated.
    key, cert
        Private key and its X.509 certificate, PEM: the certificate is signed.

    Raises
    ------
    CampaignError
        If LAB.toml has missing keys or mistakes, or the file's name ends otherwise.
    RecordError
        If the result cannot be read or must not be certified.
    CounterspinError
        If key or schema cannot be used, or the file cannot be written.
    """
    if output.suffix.lower() not in FORMATS:
        raise CampaignError("certificate", [f"{output}: name the file .xml or .pdf"])
    if output.is_file():
        raise CounterspinError(
            f"{output} exists; a certificate replaces no file, least of all an issued one: name "
            "another"
        )
    if (key is None) != (cert is None):
        raise CampaignError("certificate", ["`key` and `cert` are given together"])
    result = Result.read(result_file)
    lab, specifications = read_lab(lab_file, result)
    names = lab.certified(result)
    try:
        check_certifiable(result, names)
    except RecordError as error:
        raise RecordError(f"{result_file}: {error}") from error
    signer = read_signer(key, cert) if key is not None and cert is not None else None
    issue = _issue(lab, result, signed=signer is not None)
    judged = result if specifications is None else with_conformity(result, specifications)
    verdicts = {name: judged.accelerometers[name].conformity for name in names}
    report = _report(lab, judged, issue, verdicts)
    root = certificate(result, lab, issue, verdicts, report)
    data = to_bytes(root if signer is None else sign(root, signer))
    if schema is not None:
        check_schema(data, schema, str(output))
    if output.suffix.lower() == ".pdf":
        data = _report(lab, judged, issue, verdicts, attach=data)
    write_whole(output, lambda part: part.write_bytes(data))
    return Outcome(
        identifier=issue.identifier,
        accelerometers=names,
        notes=list(_notes(lab, result, issue)),
    )


def _notes(lab: Lab, result: Result, issue: Issue) -> Iterator[str]:
    names = lab.certified(result)
    if left_out := [name for name in result.accelerometers if name not in names]:
        yield f"Not certified, as certificate.accelerometers has it: {', '.join(left_out)}."
    if (day := issue.date.date()) < lab.certificate.end:
        yield f"The day of issue, {day}, lies before certificate.end, {lab.certificate.end}."
    if keys := example_keys(lab):
        yield f"Still the example's: {', '.join(keys)}."


def _issue(lab: Lab, result: Result, *, signed: bool) -> Issue:
    day = lab.certificate.issued
    return Issue(
        identifier=lab.certificate.identifier or identifier_of(result),
        date=issue_date() if day is None else datetime.combine(day, time(), UTC),
        signed=signed,
    )


def _report(
    lab: Lab, result: Result, issue: Issue, verdicts: Verdicts, *, attach: bytes | None = None
) -> bytes:
    from counterspin.reports.pdf import Attachment, pdf

    blocks = [*front_blocks(lab, result, issue, verdicts), *_as_chapter(document(result))]
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
    data: bytes = pdf(
        blocks,
        title=TITLE,
        identifier=issue.identifier,
        date=issue.date,
        attachments=attachments,
    )
    return data


def _as_chapter(blocks: list[Block]) -> Iterator[Block]:
    # The certificate has the title; the report's own becomes a chapter's.
    for block in blocks:
        yield Heading(block.text) if isinstance(block, Heading) and block.level == 1 else block


# Back


def check_certificate(
    path: Path, *, schema: Path | None = None, cert: Path | None = None
) -> Certified:
    """Read a certificate's numbers; with a schema validated, with a signer's certificate verified.

    Raises
    ------
    RecordError
        If the file cannot be read, does not conform to the schema, is not signed by the holder
        of `cert` or was changed since.
    CounterspinError
        If schema or cert cannot be used.
    """
    try:
        data = read_file(path)
    except OSError as error:
        raise RecordError(f"{path}: cannot be read ({error.strerror})") from error
    if schema is not None:
        check_schema(data, schema, str(path))
    if cert is not None:
        # Only what the signature covers is read.
        data = verify(data, cert, str(path))
    return read_certificate(data, str(path))


def certificate_blocks(certified: Certified) -> Iterator[Block]:
    """Yield the numbers of a certificate."""
    yield Heading(f"{TITLE} {certified.identifier}", 1)
    for name, accelerometer in certified.accelerometers.items():
        coefficients = accelerometer.coefficients
        yield results_table(name, coefficients, with_exact_g(coefficients, certified.gravity))
    yield Paragraph(
        f"g = {format_number(certified.gravity, 9)} m/s^2, taken as exact for what is shown in "
        "g-units.",
        "quiet",
    )
