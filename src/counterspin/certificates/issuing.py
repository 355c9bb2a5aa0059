"""Issue the certificate of a result, write its files, and check certificate files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import field, replace
from datetime import date, datetime
from pathlib import Path
from typing import Any, Final, Literal

from counterspin.calibration.conformity import judge_conformity
from counterspin.calibration.findings import judge_result
from counterspin.calibration.pages.triad import describe_parameter
from counterspin.calibration.result import Result
from counterspin.certificates.amendment import (
    Amendment,
    read_amended_certificate,
    record_changes,
    verify_amendment,
)
from counterspin.certificates.build import build_document as dcc_document
from counterspin.certificates.build import check_certifiable, serialize_document
from counterspin.certificates.certificate_reader import (
    CertificateNumbers,
    is_pdf,
    read_certificate,
    read_document,
    verify_pages,
)
from counterspin.certificates.completeness import missing_data, missing_lines
from counterspin.certificates.conversion import apply_cmc_floor, matrix_table, to_si_with_exact_g
from counterspin.certificates.evidence import require_evidence
from counterspin.certificates.issue_steps import (
    issue_notes,
    ledger_path,
    make_issue,
    read_laboratory_logo,
    render_images,
    render_pages,
    sign_pages_if_requested,
    signer_notes,
)
from counterspin.certificates.lab import Lab, add_required_keys, read_lab
from counterspin.certificates.ledger import IssueDetails, record_certificate, sha256_hex
from counterspin.certificates.pdf_pages import CERTIFICATE_TITLE, page_blocks, results_table
from counterspin.certificates.schema import check_schema
from counterspin.certificates.signature import PdfSignatureStatus, is_signed, sign_document, verify
from counterspin.certificates.signers import KeyMaterial, Signer, read_certificates
from counterspin.certificates.statements import Issue
from counterspin.errors import CampaignError, ExistingFileError, RecordError, UsageError
from counterspin.frozen import frozen
from counterspin.input import read_file
from counterspin.output import check_writable, write_atomically
from counterspin.reports.blocks import Block, Heading, Paragraph
from counterspin.reports.numbers import format_number
from counterspin.reports.publication import parse_issue_date

#: Suffixes of certificate files.
FILE_SUFFIXES: Final = (".xml", ".pdf")


@frozen(eq=False)
class Certificate:
    """A certificate.

    Attributes
    ----------
    identifier
        Unique identifier.
    accelerometers
        Names of the certified accelerometers.
    notes
        Sentences on items that the laboratory should check.
    xml
        The certificate (DCC), signed if a key was given.
    pages
        Function that returns the PDF.
    page_images
        Function that returns an SVG image of each page.
    ledger
        Ledger in which the certificate is entered when it is written; None: no ledger.
    entry
        Data of the entry: identifier and checksum of the certificate and of an amended certificate.
    signed_by, reason
        Responsible person, and reason of issue.
    result
        Path of the result file; None for a result in memory.
    draft
        Whether the certificate is a draft: template values, or missing required data.
    """

    identifier: str
    accelerometers: list[str]
    notes: list[str]
    xml: bytes = field(repr=False)
    pages: Callable[[], bytes] = field(repr=False)
    page_images: Callable[[], list[str]] = field(repr=False)
    ledger: Path | None = None
    entry: Mapping[str, str] = field(default_factory=dict, repr=False)
    signed_by: str = ""
    reason: str = ""
    result: Path | None = None
    draft: bool = False

    def pdf(self) -> bytes:
        """Return the pages as PDF/A-3, with the XML attached."""
        return self.pages()

    def write(self, path: Path | str, *, ledger: Path | None = None) -> Path:
        """Write the certificate as XML or PDF, according to the file suffix; return the path.

        Parameters
        ----------
        path
            Path of the file.
        ledger
            Ledger of the entry; None: the laboratory's ledger. A draft is not entered.

        Raises
        ------
        CampaignError
            If the file has another suffix.
        CounterspinError
            If the file already exists or cannot be written, or if the ledger cannot be written,
            was altered, or contains this identifier with different content. In these cases,
            nothing is written.
        """
        path = Path(path)
        check_output_path(path)
        content = self.pdf() if path.suffix.lower() == ".pdf" else self.xml
        self._write(path, content, ledger, self.entry)
        return path

    def write_both(self, path: Path | str, *, ledger: Path | None = None) -> list[Path]:
        """Write XML and PDF with the same signature; return their paths.

        The finished PDF is staged under a hidden name before the XML is published. Therefore, the
        same call completes an interrupted call, even on another day or with another signature.

        Parameters
        ----------
        path
            Path of one of the two files; the other has the other suffix.
        ledger
            Ledger of the entry, as for `write`.

        Raises
        ------
        CampaignError
            If the file has another suffix.
        CounterspinError
            As for `write`, or if the XML exists and does not belong to an interrupted call.
        """
        path = Path(path)
        check_output_paths(path)
        xml, pdf = _xml_and_pdf_paths(path)
        if not xml.is_file():
            pdf_content = self.pdf()
            staged_pdf_path = self._staged_pdf_path(pdf, self.xml)
            write_atomically(
                staged_pdf_path,
                lambda partial_path: partial_path.write_bytes(pdf_content),
                overwrite=True,
            )
            self.write(xml, ledger=ledger)
        published_xml = read_document(xml)
        staged_pdf_path = self._staged_pdf_path(pdf, published_xml)
        if not (staged_pdf_path.is_file() and read_document(staged_pdf_path) == published_xml):
            raise ExistingFileError(
                f"{xml} already exists, and no interrupted command left a PDF for this XML file. "
                "counterspin never overwrites a file when it issues a certificate; choose "
                "another name"
            )
        pdf_content = read_file(staged_pdf_path)
        self._write(pdf, pdf_content, ledger, {**self.entry, "sha256": sha256_hex(published_xml)})
        for partial_path in staged_pdf_path.parent.glob(self._staged_pdf_path(pdf, None).name):
            partial_path.unlink(missing_ok=True)
        return [path, paired_path(path)]

    def _staged_pdf_path(self, pdf: Path, xml: bytes | None) -> Path:
        """Return the staging path of a PDF; a pattern for any XML if `xml` is None."""
        id_hash = sha256_hex(self.identifier.encode("utf-8", "surrogatepass"))[:16]
        return pdf.resolve().parent / f".{id_hash}-{sha256_hex(xml)[:16] if xml else '*'}.pdf"

    def _write(
        self, path: Path, content: bytes, ledger: Path | None, entry: Mapping[str, str]
    ) -> None:
        """Write bytes to a file, after the entry in the ledger, if any."""
        ledger_path = None if self.draft else ledger or self.ledger
        if ledger_path is None:
            write_atomically(path, lambda partial_path: partial_path.write_bytes(content))
            return
        details = IssueDetails(self.signed_by, self.reason, parse_issue_date(), self.result)
        earlier_entry = record_certificate(ledger_path, path, content, entry, details)
        if earlier_entry is not None:
            self.notes.append(
                f"An earlier command entered certificate {self.identifier} on "
                f"{earlier_entry.when}, but was then interrupted. {path} is the certificate of "
                f"that entry (number {earlier_entry.number})."
            )


def check_output_path(output: Path) -> None:
    """Raise an error if the file has another suffix or already exists."""
    if output.suffix.lower() not in FILE_SUFFIXES:
        raise CampaignError(
            "certificate",
            [f"{output}: the file name must end in .xml or .pdf"],
            code="wrong-file-ending",
        )
    if output.is_file():
        raise ExistingFileError(
            f"{output} already exists. It may be an issued certificate, so it is never "
            "replaced; choose another name"
        )
    check_writable(output)


def check_output_paths(output: Path) -> None:
    """Check the paths of XML and PDF as `check_output_path` does; an existing XML is accepted."""
    if output.suffix.lower() not in FILE_SUFFIXES:
        check_output_path(output)
    xml, pdf = _xml_and_pdf_paths(output)
    if not xml.is_file():
        check_output_path(xml)
    check_output_path(pdf)


def _xml_and_pdf_paths(output: Path) -> tuple[Path, Path]:
    """Return the paths of the XML and of the PDF, given one of them."""
    paths = output, paired_path(output)
    return paths if output.suffix.lower() == ".xml" else paths[::-1]


def paired_path(output: Path) -> Path:
    """Return the path of the PDF for a path of an XML, and vice versa."""
    return output.with_suffix(".pdf" if output.suffix.lower() == ".xml" else ".xml")


def certificate(
    result: Result | Path | str,
    lab: Mapping[str, Any] | Path | str,
    *,
    schema: Path | None = None,
    signer: Signer | Callable[[], Signer] | None = None,
    accept_misfit: str | None = None,
    accept_unsealed: str | None = None,
    amends: Amendment | None = None,
) -> Certificate:
    """Make the certificate of a result; `Certificate.write` writes it.

    Parameters
    ----------
    result
        Result or result file.
    lab
        ``LAB.toml``, or a mapping with the same keys.
    schema
        Folder or file of the DCC schema; validates the certificate.
    signer
        Signer of XML and pages, from `read_signer` or `command_signer` of
        `counterspin.certificates.signers`; or a function that returns a signer and is called after
        all other checks.
    accept_misfit
        Reason for certifying a result that is contradicted by its records; stated in the
        certificate.
    accept_unsealed
        Reason for certifying a result file without a seal; stated in the certificate.
    amends
        Issued certificate that this certificate replaces, and the reason. The certificate states
        both and the changes.

    Returns
    -------
    Certificate

    Raises
    ------
    CampaignError
        If the laboratory data have missing keys or mistakes, or if a draft is to be signed. A draft
        contains values of the template or lacks required data.
    RecordError
        If the result cannot be read or must not be certified.
    CounterspinError
        If the key or the schema cannot be used.
    """
    for name, reason in (("accept_misfit", accept_misfit), ("accept_unsealed", accept_unsealed)):
        if reason is not None and not reason.strip():
            raise UsageError("certificate", [f"`{name}`: state the reason in words"])
    original_result = result if isinstance(result, Result) else Result.read(result)
    lab_data, specifications = read_lab(lab, original_result)
    names = lab_data.certified_names(original_result)
    judged_result = judge_result(original_result)
    if accept_misfit is not None:
        if judged_result.state != "contradicted":
            raise UsageError(
                "certificate",
                ["`accept_misfit`: the records do not contradict this result; omit this argument"],
            )
        judged_result = judged_result.model_copy(update={"accepted_misfit": accept_misfit})
    try:
        check_certifiable(judged_result, names)
    except RecordError as error:
        if isinstance(result, Result):
            raise
        raise RecordError(f"{result}: {error}", code=error.code) from error
    if (seal_problem := _seal_problem(original_result, accept_unsealed)) is not None:
        source = "the result" if isinstance(result, Result) else str(result)
        raise RecordError(f"{source}: {seal_problem}", code="result-altered")
    source = "the laboratory data" if isinstance(lab, Mapping) else str(lab)
    folder = Path() if isinstance(lab, Mapping) else Path(lab).parent
    require_evidence(original_result.assumed, lab_data.evidence, source)
    amended_certificate, old_xml = (
        (None, b"") if amends is None else read_amended_certificate(amends)
    )
    acceptance_reasons = tuple(
        reason for reason in (accept_misfit, accept_unsealed) if reason is not None
    )
    missing_entries = missing_data(lab_data, original_result)
    issue = make_issue(
        lab_data,
        original_result.content,
        amended_certificate,
        acceptance_reasons,
        is_draft=bool(missing_entries),
    )
    issue = replace(
        issue,
        acceptance_reason=accept_unsealed,
        is_signed=signer is not None,
        logo=read_laboratory_logo(lab_data, folder, source),
    )
    if issue.is_draft and signer is not None:
        raise CampaignError(source, missing_lines(missing_entries), code="certificate-incomplete")
    if callable(signer):
        signer = signer()
    certified_result = apply_cmc_floor(judged_result, lab_data)
    if specifications is not None:
        certified_result = judge_conformity(certified_result, specifications)
    verdicts = {name: certified_result.accelerometers[name].conformity for name in names}
    if amended_certificate is not None:
        new_xml = serialize_document(
            dcc_document(judged_result, lab_data, issue, verdicts, None, original_result)
        )
        issue = replace(
            issue, amended_certificate=record_changes(amended_certificate, old_xml, new_xml)
        )
    blocks = list(page_blocks(lab_data, judged_result, issue, verdicts))
    pages = render_pages(blocks, issue)
    root = dcc_document(judged_result, lab_data, issue, verdicts, pages, original_result)
    xml = serialize_document(root if signer is None else sign_document(root, signer))
    if schema is not None:
        check_schema(xml, schema, f"certificate {issue.identifier}")
    return Certificate(
        identifier=issue.identifier,
        accelerometers=names,
        notes=[
            *_omission_notes(lab_data, judged_result),
            *_campaign_date_notes(lab_data, judged_result),
            *issue_notes(lab_data, issue, missing_entries),
            *signer_notes(signer, issue),
        ],
        xml=xml,
        ledger=ledger_path(lab_data, lab),
        entry={"identifier": issue.identifier, "sha256": sha256_hex(xml)}
        | (
            {}
            if amended_certificate is None
            else {
                "amends": amended_certificate.identifier,
                "amends_sha256": amended_certificate.checksum,
            }
        ),
        signed_by=lab_data.persons[0].name,
        reason=_issue_reason(issue, judged_result),
        result=None if isinstance(result, Result) else Path(result),
        draft=issue.is_draft,
        pages=lambda: sign_pages_if_requested(render_pages(blocks, issue, xml=xml), signer),
        page_images=lambda: render_images(blocks, issue),
    )


def draft_pages(result: Result, lab: Mapping[str, Any], folder: Path) -> list[str]:
    """Return the pages of a draft certificate as SVG images.

    folder: Folder of the laboratory file, for the logo.

    Raises
    ------
    CampaignError
        If the laboratory data have mistakes. Missing required keys take the values of the
        template.
    RecordError
        If the result must not be certified.
    """
    lab_data, specifications = read_lab(add_required_keys(lab), result)
    names, judged_result = lab_data.certified_names(result), judge_result(result)
    check_certifiable(judged_result, names)
    issue = make_issue(lab_data, result.content, None, (), is_draft=True)
    issue = replace(issue, logo=read_laboratory_logo(lab_data, folder, "the laboratory data"))
    certified_result = apply_cmc_floor(judged_result, lab_data)
    if specifications is not None:
        certified_result = judge_conformity(certified_result, specifications)
    verdicts = {name: certified_result.accelerometers[name].conformity for name in names}
    return render_images(list(page_blocks(lab_data, judged_result, issue, verdicts)), issue)


def _issue_reason(issue: Issue, result: Result) -> str:
    """Return the reason of issue and the reasons for exceptions."""
    reason = "issued" if issue.amended_certificate is None else issue.amended_certificate.reason
    if result.accepted_misfit is not None:
        reason += f"; the misfit was accepted for this reason: {result.accepted_misfit}"
    if issue.acceptance_reason is not None:
        reason += f"; the missing seal was accepted for this reason: {issue.acceptance_reason}"
    return reason


def _seal_problem(result: Result, accept_unsealed: str | None) -> str | None:
    """Return the problem with the seal of a result; None if the result can be certified."""
    if not result.sealed and accept_unsealed is None:
        return (
            "the file has no seal, so later changes to it cannot be excluded; give the original "
            "file, calibrate again, or state in `accept_unsealed` why you certify the result "
            "anyway"
        )
    if result.sealed and accept_unsealed is not None:
        return "the file has a valid seal; omit `accept_unsealed`"
    return None


def _omission_notes(lab: Lab, result: Result) -> Iterator[str]:
    names = lab.certified_names(result)
    if excluded_names := [name for name in result.accelerometers if name not in names]:
        yield (
            "These accelerometers are not certified (see certificate.accelerometers): "
            f"{', '.join(excluded_names)}."
        )


def _campaign_date_notes(lab: Lab, result: Result) -> Iterator[str]:
    """Yield a note if the date of the campaign is not within the calibration."""
    try:
        campaign_date = datetime.fromisoformat(result.details.get("date", "").strip()).date()
    except ValueError:
        return  # missing, or another text
    begin, end = lab.certificate.begin, lab.certificate.end
    if not begin <= campaign_date <= end:
        yield (
            f"The date of the campaign, {campaign_date}, is not between certificate.begin, "
            f"{begin}, and certificate.end, {end}."
        )


# Reading and checking


@frozen
class CertificateCheck:
    """The numbers of a certificate file, and the validity of its signatures."""

    numbers: CertificateNumbers  #: Numbers of the certificate.
    #: State of the signature of the XML; ``unchecked``: no signer certificate was given.
    signature: Literal["none", "unchecked", "valid"]
    #: State of the signature of the PDF, if the XML signature is valid; None: unchecked or no PDF.
    page_signature: PdfSignatureStatus | None = None
    #: Day after the issue on which the signer certificate expired; None: valid or not given.
    expiry_date: date | None = None


def check_certificate(
    path: Path,
    *,
    schema: Path | None = None,
    signer_certificate: Path | KeyMaterial | None = None,
    amended_path: Path | None = None,
) -> CertificateCheck:
    """Read the numbers of a certificate; check schema, signatures and amendment if requested.

    schema, signer_certificate: As in `certificate`; the signer's certificate, PEM.
    """
    document = read_document(path)
    if schema is not None:
        check_schema(document, schema, str(path))
    if amended_path is not None:
        verify_amendment(document, amended_path, str(path))
    if signer_certificate is None:
        has_signature = is_signed(document, str(path))
        return CertificateCheck(
            read_certificate(document, str(path)), "unchecked" if has_signature else "none"
        )
    # Read only the signed part.
    signature_check = verify(document, signer_certificate, str(path))
    numbers = read_certificate(signature_check.content, str(path))
    return CertificateCheck(
        numbers,
        "valid",
        _verify_page_signature(path, signer_certificate),
        signature_check.expiry_date,
    )


def _verify_page_signature(
    path: Path, signer_certificate: Path | KeyMaterial
) -> PdfSignatureStatus | None:
    """Return the state of the signature of a PDF; RecordError if it is not valid."""
    if not is_pdf(path):
        return None
    from cryptography.hazmat.primitives.serialization import Encoding

    expected_certificate = read_certificates(KeyMaterial.read(signer_certificate))[0].public_bytes(
        Encoding.DER
    )
    status = verify_pages(path, expected_certificate)
    if status == "changed":
        raise RecordError(
            f"{path}: the signature is not valid: the pages were changed after the holder of "
            f"{signer_certificate} signed them; the attached XML was not changed",
            code="invalid-signature",
        )
    if status == "invalid":
        raise RecordError(
            f"{path}: the holder of {signer_certificate} signed the attached XML, but not "
            "the pages",
            code="invalid-signature",
        )
    return status


def certificate_blocks(numbers: CertificateNumbers) -> Iterator[Block]:
    """Yield tables with the numbers of a certificate."""
    yield Heading(f"{CERTIFICATE_TITLE} {numbers.identifier}", 1)
    for name, accelerometer in numbers.accelerometers.items():
        coefficients = accelerometer.coefficients
        yield results_table(name, coefficients, to_si_with_exact_g(coefficients, numbers.gravity))
    if (triad := numbers.triad) is not None:
        parameters = triad.parameters.coefficients
        displayed_parameters = dict(
            describe_parameter(name, parameter) for name, parameter in parameters.items()
        )
        yield results_table(
            "Parameter",
            displayed_parameters,
            to_si_with_exact_g(displayed_parameters, numbers.gravity),
        )
        if (
            triad.matrix is not None
            and triad.expanded_matrix is not None
            and triad.coverage_factor is not None
        ):
            matrix, expanded_matrix = triad.matrix.tolist(), triad.expanded_matrix.tolist()
            yield matrix_table(triad.accelerometers, matrix, expanded_matrix, triad.coverage_factor)
            yield Paragraph(
                "The matrix and the offsets are calculated from these parameters.", "quiet"
            )
    yield Paragraph(
        f"g = {format_number(numbers.gravity, 9)} m/s^2, taken as exact for the values in g-units.",
        "quiet",
    )
