"""Issue a result's certificate, write its file, and check an existing one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import field, replace
from datetime import date
from pathlib import Path
from typing import Any, Final, Literal

from counterspin.calibration.conformity import judge_conformity
from counterspin.calibration.findings import judge_result
from counterspin.calibration.pages.triad import shown_parameter
from counterspin.calibration.result import Result
from counterspin.certificates.amendment import (
    Amendment,
    read_amended,
    record_changes,
    verify_amended,
)
from counterspin.certificates.build import build_document as dcc_document
from counterspin.certificates.build import check_certifiable, to_bytes
from counterspin.certificates.certificate_reader import (
    CertificateNumbers,
    is_pdf,
    read_certificate,
    read_document,
    verify_pages,
)
from counterspin.certificates.completeness import missing_data, missing_lines
from counterspin.certificates.conversion import apply_cmc_floor, output_table, to_si_with_exact_g
from counterspin.certificates.evidence import require_evidence
from counterspin.certificates.issue_steps import (
    issue_notes,
    ledger_path,
    make_issue,
    read_laboratory_logo,
    render_images,
    render_pages,
    signed_pages,
    signer_notes,
)
from counterspin.certificates.lab import Lab, read_lab, with_required_keys
from counterspin.certificates.ledger import IssueDetails, checksum_of, record_certificate
from counterspin.certificates.pdf_pages import TITLE, page_blocks, results_table
from counterspin.certificates.schema import check_schema
from counterspin.certificates.signature import (
    PdfSignatureStatus,
    is_signed,
    sign,
    verify,
)
from counterspin.certificates.signers import KeyMaterial, Signer, certificates_in
from counterspin.certificates.statements import Issue
from counterspin.errors import (
    CampaignError,
    ExistingFileError,
    RecordError,
    UsageError,
)
from counterspin.frozen import frozen
from counterspin.input import read_file
from counterspin.output import check_writable, write_atomically
from counterspin.reports.blocks import Block, Heading, Paragraph
from counterspin.reports.numbers import format_number
from counterspin.reports.publication import issue_date

#: Suffixes of certificate files.
FORMATS: Final = (".xml", ".pdf")


@frozen(eq=False)
class Certificate:
    """A certificate.

    Attributes
    ----------
    identifier
        By which it is known.
    accelerometers
        The names of those certified.
    notes
        What the laboratory should check, in sentences.
    xml
        The certificate (DCC), signed if a key was given.
    pages
        Makes the PDF.
    page_images
        Makes an SVG image of each page.
    ledger
        Where the laboratory enters it once it is written; None: nowhere.
    entry
        What is entered there: the certificate's identifier and checksum, what it amends.
    signed_by, reason
        Who answers for it, and why it was issued.
    result
        The file of the result; None if it came from none.
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
        """Return pages to read (PDF/A-3), with the XML attached byte for byte."""
        return self.pages()

    def write(self, path: Path | str, *, ledger: Path | None = None) -> Path:
        """Write the certificate, as XML or PDF by the ending of the name; return the path.

        Parameters
        ----------
        path
            The file.
        ledger
            The ledger of the entry, instead of the laboratory's. A draft is not entered.

        Raises
        ------
        CampaignError
            If the name has another ending.
        CounterspinError
            If the file exists already or cannot be written; or if the ledger cannot be written,
            was altered, or has this identifier with other content. Then nothing is written.
        """
        path = Path(path)
        check_output_path(path)
        data = self.pdf() if path.suffix.lower() == ".pdf" else self.xml
        self._write(path, data, ledger, self.entry)
        return path

    def write_both(self, path: Path | str, *, ledger: Path | None = None) -> list[Path]:
        """Write XML and PDF with the same signature; return their paths.

        The finished PDF is staged under a hidden name before the XML is published. Therefore the
        same call completes an interrupted one, on any day and with another signature.

        Parameters
        ----------
        path
            One of the two files; the other differs in the ending of its name.
        ledger
        The ledger of the entry, as for `write`.

        Raises
        ------
        CampaignError
            If the name ends otherwise.
        CounterspinError
            As for `write`; or if the XML exists and is not that of an interrupted call.
        """
        path = Path(path)
        check_output_paths(path)
        xml, pdf = _xml_and_pdf(path)
        if not xml.is_file():
            data = self.pdf()
            staged_pdf = self._staged_pdf_path(pdf, self.xml)
            write_atomically(staged_pdf, lambda part: part.write_bytes(data), overwrite=True)
            self.write(xml, ledger=ledger)
        published_xml = read_document(xml)
        staged_pdf = self._staged_pdf_path(pdf, published_xml)
        if not (staged_pdf.is_file() and read_document(staged_pdf) == published_xml):
            raise ExistingFileError(
                f"{xml} already exists, and no interrupted command left a PDF that belongs to it. "
                "A certificate never overwrites a file; choose another name"
            )
        data = read_file(staged_pdf)
        self._write(pdf, data, ledger, {**self.entry, "sha256": checksum_of(published_xml)})
        for part in staged_pdf.parent.glob(self._staged_pdf_path(pdf, None).name):
            part.unlink(missing_ok=True)
        return [path, paired_path(path)]

    def _staged_pdf_path(self, pdf: Path, xml: bytes | None) -> Path:
        """Return the staging path of a PDF; a pattern for any XML if `xml` is None."""
        identifier_hash = checksum_of(self.identifier.encode("utf-8", "surrogatepass"))[:16]
        return (
            pdf.resolve().parent / f".{identifier_hash}-{checksum_of(xml)[:16] if xml else '*'}.pdf"
        )

    def _write(
        self, path: Path, data: bytes, ledger: Path | None, entry: Mapping[str, str]
    ) -> None:
        """Write bytes to a file, after their entry in the ledger if there is one."""
        ledger_path = None if self.draft else ledger or self.ledger
        if ledger_path is None:
            write_atomically(path, lambda part: part.write_bytes(data))
            return
        details = IssueDetails(self.signed_by, self.reason, issue_date(), self.result)
        earlier_entry = record_certificate(ledger_path, path, data, entry, details)
        if earlier_entry is not None:
            self.notes.append(
                f"An earlier command entered certificate {self.identifier} on "
                f"{earlier_entry.when}, but was then interrupted. That entry ({path}) refers to "
                f"{earlier_entry.when}."
            )


def check_output_path(output: Path) -> None:
    """Refuse a name with another ending, and the name of an existing file."""
    if output.suffix.lower() not in FORMATS:
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
    if output.suffix.lower() not in FORMATS:
        check_output_path(output)
    xml, pdf = _xml_and_pdf(output)
    if not xml.is_file():
        check_output_path(xml)
    check_output_path(pdf)


def _xml_and_pdf(output: Path) -> tuple[Path, Path]:
    """Return the paths of a certificate's XML and PDF, one of which is given."""
    places = output, paired_path(output)
    return places if output.suffix.lower() == ".xml" else places[::-1]


def paired_path(output: Path) -> Path:
    """Return the name of the PDF next to a certificate's XML, or of the XML next to its PDF."""
    return output.with_suffix(next(f for f in FORMATS if f != output.suffix.lower()))


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
        The result, or its JSON file.
    lab
        What ``LAB.toml`` says, as nested mappings with the same keys; or the file.
    schema
        Folder or file of DCC's schema, against which the certificate is validated.
    signer
        Who signs XML and pages, as `read_signer` and `command_signer` of
        `counterspin.certificates.signers` return it; or what returns that, which is called once
        all else has been checked.
    accept_misfit
        The reason for which a result that its records contradict is certified all the same; it
        stands in the certificate.
    accept_unsealed
        The reason for which a result is certified although its file has no seal; it stands in the
        certificate.
    amends
        An issued certificate that this one replaces, and why; it says both, and what changed.

    Raises
    ------
    CampaignError
        If the laboratory's data have missing keys or mistakes, or if a draft is to be signed: one
        with a value of the template, or without data that a certificate needs.
    RecordError
        If the result cannot be read or must not be certified.
    CounterspinError
        If key or schema cannot be used.
    """
    for name, reason in (("accept_misfit", accept_misfit), ("accept_unsealed", accept_unsealed)):
        if reason is not None and not reason.strip():
            raise UsageError("certificate", [f"`{name}`: state the reason in words"])
    original = result if isinstance(result, Result) else Result.read(result)
    data, specifications = read_lab(lab, original)
    names = data.certified(original)
    judged = judge_result(original)
    if accept_misfit is not None:
        if judged.state != "contradicted":
            raise UsageError(
                "certificate",
                ["`accept_misfit`: the records do not contradict this result; omit this argument"],
            )
        judged = judged.model_copy(update={"accepted_misfit": accept_misfit})
    try:
        check_certifiable(judged, names)
    except RecordError as error:
        if isinstance(result, Result):
            raise
        raise RecordError(f"{result}: {error}", code=error.code) from error
    if (problem := _unsealed_error(original, accept_unsealed)) is not None:
        source = "the result" if isinstance(result, Result) else str(result)
        raise RecordError(f"{source}: {problem}", code="result-altered")
    source = "the laboratory data" if isinstance(lab, Mapping) else str(lab)
    folder = Path() if isinstance(lab, Mapping) else Path(lab).parent
    require_evidence(original.assumed, data.evidence, source)
    amended, old = (None, b"") if amends is None else read_amended(amends)
    accepted = tuple(reason for reason in (accept_misfit, accept_unsealed) if reason is not None)
    missing = missing_data(data, original)
    issue = make_issue(data, original.content, amended, accepted, draft=bool(missing))
    issue = replace(
        issue,
        accepted_unsealed=accept_unsealed,
        signed=signer is not None,
        logo=read_laboratory_logo(data, folder, source),
    )
    if issue.draft and signer is not None:
        raise CampaignError(source, missing_lines(missing), code="certificate-incomplete")
    if callable(signer):
        signer = signer()
    certified = apply_cmc_floor(judged, data)
    if specifications is not None:
        certified = judge_conformity(certified, specifications)
    verdicts = {name: certified.accelerometers[name].conformity for name in names}
    if amended is not None:
        new = to_bytes(dcc_document(judged, data, issue, verdicts, None, original))
        issue = replace(issue, amended=record_changes(amended, old, new))
    blocks = list(page_blocks(data, judged, issue, verdicts))
    pages = render_pages(blocks, issue)
    root = dcc_document(judged, data, issue, verdicts, pages, original)
    xml = to_bytes(root if signer is None else sign(root, signer))
    if schema is not None:
        check_schema(xml, schema, f"certificate {issue.identifier}")
    return Certificate(
        identifier=issue.identifier,
        accelerometers=names,
        notes=[
            *_omission_notes(data, judged),
            *issue_notes(data, issue, missing),
            *signer_notes(signer, issue),
        ],
        xml=xml,
        ledger=ledger_path(data, lab),
        entry={"identifier": issue.identifier, "sha256": checksum_of(xml)}
        | (
            {}
            if amended is None
            else {"amends": amended.identifier, "amends_sha256": amended.checksum}
        ),
        signed_by=data.persons[0].name,
        reason=_reason(issue, judged),
        result=None if isinstance(result, Result) else Path(result),
        draft=issue.draft,
        pages=lambda: signed_pages(render_pages(blocks, issue, attach=xml), signer),
        page_images=lambda: render_images(blocks, issue),
    )


def draft_pages(result: Result, lab: Mapping[str, Any], folder: Path) -> list[str]:
    """Return the pages of a result's certificate as SVG images, marked as a draft.

    folder: That of the laboratory's file, for the logo.

    Raises
    ------
    CampaignError
        If the laboratory's data have mistakes. Required keys that are missing have the values of
        the template.
    RecordError
        If the result must not be certified.
    """
    data, specifications = read_lab(with_required_keys(lab), result)
    names, judged = data.certified(result), judge_result(result)
    check_certifiable(judged, names)
    issue = make_issue(data, result.content, None, (), draft=True)
    issue = replace(issue, logo=read_laboratory_logo(data, folder, "the laboratory data"))
    certified = apply_cmc_floor(judged, data)
    if specifications is not None:
        certified = judge_conformity(certified, specifications)
    verdicts = {name: certified.accelerometers[name].conformity for name in names}
    return render_images(list(page_blocks(data, judged, issue, verdicts)), issue)


def _reason(issue: Issue, result: Result) -> str:
    """Return the reason of issue, with the reasons of all exceptions."""
    reason = "issued" if issue.amended is None else issue.amended.reason
    if result.accepted_misfit is not None:
        reason += f"; the misfit was accepted for this reason: {result.accepted_misfit}"
    if issue.accepted_unsealed is not None:
        reason += f"; the missing seal was accepted for this reason: {issue.accepted_unsealed}"
    return reason


def _unsealed_error(result: Result, accept_unsealed: str | None) -> str | None:
    """Return the error of a result whose file must not be certified; None if it may be."""
    if not result.sealed and accept_unsealed is None:
        return (
            "the file has no seal, so later changes to it cannot be excluded; give the original "
            "file, calibrate again, or state in `accept_unsealed` why the result is certified "
            "nevertheless"
        )
    if result.sealed and accept_unsealed is not None:
        return "the file has a valid seal; omit `accept_unsealed`"
    return None


def _omission_notes(lab: Lab, result: Result) -> Iterator[str]:
    names = lab.certified(result)
    if excluded := [name for name in result.accelerometers if name not in names]:
        yield (
            "These accelerometers are not certified (see certificate.accelerometers): "
            f"{', '.join(excluded)}."
        )


# Reading and checking


@frozen
class CertificateCheck:
    """The numbers of a certificate's file, and the validity of its signature."""

    certified: CertificateNumbers  #: The numbers.
    #: State of the XML's signature; ``unchecked``: no certificate of the signer was given.
    signature: Literal["none", "unchecked", "valid"]
    #: State of the PDF's signature, if that of its XML is valid; None: unchecked, or not a PDF.
    pages: PdfSignatureStatus | None = None
    #: Day after the issue on which the signer's certificate expired; None: valid or not given.
    expired: date | None = None


def check_certificate(
    path: Path,
    *,
    schema: Path | None = None,
    cert: Path | KeyMaterial | None = None,
    amends: Path | None = None,
) -> CertificateCheck:
    """Read a certificate's numbers; validate with a schema, verify with a signer's certificate.

    schema, cert: As in `certificate`; the signer's certificate, PEM.
    """
    data = read_document(path)
    if schema is not None:
        check_schema(data, schema, str(path))
    if amends is not None:
        verify_amended(data, amends, str(path))
    if cert is None:
        signed = is_signed(data, str(path))
        return CertificateCheck(
            read_certificate(data, str(path)), "unchecked" if signed else "none"
        )
    # Read only the signed part.
    verified = verify(data, cert, str(path))
    certified = read_certificate(verified.content, str(path))
    return CertificateCheck(certified, "valid", _check_pages(path, cert), verified.expired)


def _check_pages(path: Path, cert: Path | KeyMaterial) -> PdfSignatureStatus | None:
    """Return the state of a PDF's signature; RecordError if it is not valid."""
    if not is_pdf(path):
        return None
    from cryptography.hazmat.primitives.serialization import Encoding

    expected = certificates_in(KeyMaterial.read(cert))[0].public_bytes(Encoding.DER)
    status = verify_pages(path, expected)
    if status == "changed":
        raise RecordError(
            f"{path}: the signature is not valid: the pages were changed after the holder of "
            f"{cert} signed them; the attached XML was not changed",
            code="invalid-signature",
        )
    if status == "invalid":
        raise RecordError(
            f"{path}: the pages were not signed by the holder of {cert}; the attached XML was",
            code="invalid-signature",
        )
    return status


def certificate_blocks(certified: CertificateNumbers) -> Iterator[Block]:
    """Yield the numbers of a certificate."""
    yield Heading(f"{TITLE} {certified.identifier}", 1)
    for name, accelerometer in certified.accelerometers.items():
        coefficients = accelerometer.coefficients
        yield results_table(name, coefficients, to_si_with_exact_g(coefficients, certified.gravity))
    if (triad := certified.triad) is not None:
        parameters = triad.parameters.coefficients
        shown = dict(shown_parameter(name, c) for name, c in parameters.items())
        yield results_table("Parameter", shown, to_si_with_exact_g(shown, certified.gravity))
        if triad.matrix is not None and triad.expanded is not None and triad.factor is not None:
            matrix, expanded = triad.matrix.tolist(), triad.expanded.tolist()
            yield output_table(triad.accelerometers, matrix, expanded, triad.factor)
            yield Paragraph(
                "The matrix and the offsets are calculated from these parameters.", "quiet"
            )
    yield Paragraph(
        f"g = {format_number(certified.gravity, 9)} m/s^2, taken as exact for the values in "
        "g-units.",
        "quiet",
    )
