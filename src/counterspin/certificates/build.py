"""A result and a laboratory's data become a Digital Calibration Certificate (DCC 3.3.0).

- `certificate`: the document as bytes of XML
- `check_certifiable`: whether a result can be certified at all
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from lxml import etree

from counterspin.calibration.result import Result
from counterspin.certificates import wording
from counterspin.certificates.administrative import Issue, administrative_data
from counterspin.certificates.elements import ENGLISH, Element, attached, dcc
from counterspin.certificates.lab import Lab
from counterspin.certificates.measurement import measurement_results
from counterspin.certificates.statements import Verdicts, statements
from counterspin.errors import RecordError

SCHEMA_VERSION: Final = "3.3.0"


def check_certifiable(result: Result, names: Sequence[str]) -> None:
    """Raise RecordError if a result is not one to put one's name to."""
    if result.model == "as-printed":
        raise RecordError(
            "this result was computed by the paper's equations as printed, whose K_II is half of "
            "the true one; calibrate again with --model exact"
        )
    found = (result.accelerometers[name].coefficients.values() for name in names)
    if not any(wording.is_determined(c) for coefficients in found for c in coefficients):
        raise RecordError(
            "the records determine no coefficient of "
            f"{', '.join(names)}: there is nothing to certify"
        )


def certificate(
    result: Result, lab: Lab, issue: Issue, verdicts: Verdicts, report: bytes | None
) -> Element:
    """Return the certificate's root element.

    Parameters
    ----------
    result
        What was found; `check_certifiable` has let it pass.
    lab
        What the laboratory says.
    issue
        Identifier and date.
    verdicts
        Conformity of the certified coefficients.
    report
        The report as PDF, for people; None: there is none.
    """
    root = dcc(
        "digitalCalibrationCertificate",
        administrative_data(lab, result, issue, statements(lab, result, verdicts)),
        measurement_results(lab, result),
        _comment(lab, result),
        None
        if report is None
        else attached(
            "document",
            issue.file_name(".pdf"),
            "application/pdf",
            report,
            "The same for people to read.",
        ),
        schemaVersion=SCHEMA_VERSION,
    )
    etree.indent(root, " ")
    return root


def to_bytes(root: Element) -> bytes:
    """Return the document as it is written to a file."""
    written: bytes = etree.tostring(root, encoding="UTF-8", xml_declaration=True)
    return written + b"\n"


def _comment(lab: Lab, result: Result) -> Element | None:
    """Return every warning of the calibration, which the certificate must not hide."""
    lines = list(result.warnings)
    for name in lab.certified(result):
        lines += [
            warning if warning.startswith(name) else f"{name}: {warning}"
            for warning in result.accelerometers[name].warnings
        ]
    if not lines:
        return None
    return dcc("comment", *(dcc("content", f"Warning: {line}", lang=ENGLISH) for line in lines))
