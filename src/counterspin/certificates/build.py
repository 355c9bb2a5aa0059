"""The Digital Calibration Certificate (DCC 3.3.0) of a result and a laboratory's data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from lxml import etree

from counterspin.calibration.findings import judge_result, refusal
from counterspin.calibration.result import Result
from counterspin.certificates import wording
from counterspin.certificates.administrative import Issue, administrative_data
from counterspin.certificates.capability import capability_lines, with_capability
from counterspin.certificates.elements import DCC, Element, attached, dcc, rich
from counterspin.certificates.lab import Lab
from counterspin.certificates.measurement import measurement_results
from counterspin.certificates.statements import Verdicts, statements
from counterspin.errors import RecordError

SCHEMA_VERSION: Final = "3.3.0"


def check_certifiable(result: Result, names: Sequence[str]) -> None:
    """Raise RecordError if a result must not be certified; it is judged already, or is here."""
    if result.model == "as-printed":
        raise RecordError(
            "this result was computed by the paper's equations as printed, whose K_II is half of "
            "the true one; calibrate again with the exact model"
        )
    if (refused := refusal(judge_result(result), names)) is not None:
        raise RecordError(refused)
    by_accelerometer = (result.accelerometers[name].coefficients.values() for name in names)
    if not any(wording.is_determined(c) for coefficients in by_accelerometer for c in coefficients):
        raise RecordError(
            "the records determine no coefficient of "
            f"{', '.join(names)}: there is nothing to certify"
        )


def certificate(
    result: Result,
    lab: Lab,
    issue: Issue,
    verdicts: Verdicts,
    pages: bytes | None,
    original: Result | None = None,
) -> Element:
    """Return the certificate's root element.

    Parameters
    ----------
    result
        A result that `check_certifiable` accepts.
    lab
        The laboratory's data.
    issue
        Identifier and date.
    verdicts
        Conformity of the certified coefficients.
    pages
        The same as PDF, or None.
    original
        The result as its file has it, if that is another.
    """
    stated = with_capability(result, lab)
    raised = capability_lines(result, stated, lab)
    root = dcc(
        "digitalCalibrationCertificate",
        administrative_data(lab, result, issue, statements(lab, stated, issue, verdicts, raised)),
        measurement_results(lab, stated, original or result),
        _comment(lab, result),
        None
        if pages is None
        else attached(
            "document",
            issue.file_name(".pdf"),
            "application/pdf",
            pages,
            "The same for people to read.",
        ),
        schemaVersion=SCHEMA_VERSION,
    )
    _drop_unlinked(root)
    _drop_single_languages(root)
    etree.indent(root, " ")
    return root


def to_bytes(root: Element) -> bytes:
    """Return the document as bytes for a file."""
    written: bytes = etree.tostring(root, encoding="UTF-8", xml_declaration=True)
    return written + b"\n"


def _comment(lab: Lab, result: Result) -> Element | None:
    """Return all warnings of the calibration, which the certificate must state."""
    lines = list(result.warnings)
    if result.accepted_misfit is not None:
        lines.append(f"The misfit was accepted: {result.accepted_misfit}")
    for name in lab.certified(result):
        lines += [
            warning if warning.startswith(name) else f"{name}: {warning}"
            for warning in result.accelerometers[name].warnings
        ]
    if not lines:
        return None
    return rich("comment", *(f"Warning: {wording.plainly(line)}" for line in lines))


def _drop_unlinked(root: Element) -> None:
    """Take away each id that nothing refers to, as PTB's rules have it."""
    named = {name for element in root.iter() for name in element.get("refId", "").split()}
    for element in root.iter():
        if element.get("id") not in {None, *named}:
            del element.attrib["id"]


def _drop_single_languages(root: Element) -> None:
    """Where there are two languages, let text that exists in one of them alone state none.

    PTB's rules ask for text in every language that is used, or for text without one.
    """
    used = len(list(root.iter(f"{{{DCC}}}usedLangCodeISO639_1")))
    for content in root.iter(f"{{{DCC}}}content"):
        if used > 1:
            content.attrib.pop("lang", None)
