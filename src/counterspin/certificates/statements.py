"""Statements of a certificate with machine-readable attributes."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from counterspin.calibration.result import Result
from counterspin.certificates import certificate_text
from counterspin.certificates.amendment import AmendedCertificate, amendment_lines
from counterspin.certificates.completeness import default_evidence_lines
from counterspin.certificates.conversion import certified_triad, cmc_lines, triad_lines, triad_title
from counterspin.certificates.evidence import evidence_lines
from counterspin.certificates.lab import Lab
from counterspin.certificates.schema import ENGLISH
from counterspin.frozen import frozen
from counterspin.inference.verdicts import Conformity

Verdicts = Mapping[str, Mapping[str, Conformity]]

_GUM_DOCUMENTS: Final = ("JCGM 100:2008", "JCGM 102:2011")
_QUALITY_STANDARDS: Final = ("ISO/IEC 17025:2017",)


@frozen
class Issue:
    """Identifier, date and state of a certificate."""

    identifier: str  #: Unique identifier.
    date: datetime.datetime  #: Date of issue, UTC.
    is_signed: bool = False  #: Whether an electronic signature follows.
    is_draft: bool = False  #: Whether required data are missing.
    amended_certificate: AmendedCertificate | None = None  #: Certificate that is replaced.
    #: Reason for certifying a result file without a seal; None for a sealed file.
    acceptance_reason: str | None = None
    logo: bytes | None = None  #: Logo of the laboratory, PNG or SVG.

    def file_name(self, suffix: str) -> str:
        """Return a file name made from the identifier, without characters such as slashes."""
        return re.sub(r"[^\w.-]+", "_", self.identifier) + suffix


@frozen
class Statement:
    """A statement with machine-readable attributes (``dcc:statement``)."""

    name: str
    lines: Sequence[str]  #: Paragraphs; a statement without paragraphs is omitted.
    standards: Sequence[str] = ()  #: Standards that apply.
    language: str = ENGLISH
    subject_id: str | None = None  #: Id of the element that is the subject.
    ref_type: str | None = None  #: ``refType`` of the DCC.
    traceable: bool = False
    non_si_definition: str | None = None  #: Definition of the unit g.
    conformity: str | None = None  #: DCC keyword, such as ``pass`` or ``fail``.
    valid: bool = True  #: False: the subject of the statement is not valid.


def accelerometer_item_id(lab: Lab, result: Result, name: str) -> str:
    """Return the id of the item of an accelerometer."""
    return f"item-{lab.certified_names(result).index(name) + 1}"


def certificate_statements(
    lab: Lab, result: Result, certified_result: Result, issue: Issue, verdicts: Verdicts
) -> list[Statement]:
    """Return the statements in reading order.

    certified_result: Result after `conversion.apply_cmc_floor`.
    """
    all_statements = [
        *_document_statements(lab, certified_result, issue),
        *_value_statements(lab, result, certified_result),
        *_conformity_statements(lab, certified_result, verdicts),
        Statement(
            certificate_text.SCOPE_HEADING, [certificate_text.scope_statement()], _QUALITY_STANDARDS
        ),
        Statement(
            certificate_text.REMARKS_HEADING,
            lab.certificate.remarks,
            language=lab.certificate.language,
        ),
    ]
    return [statement for statement in all_statements if statement.lines]


def _document_statements(lab: Lab, result: Result, issue: Issue) -> Iterator[Statement]:
    settings = lab.certificate
    yield Statement(
        "Draft", [certificate_text.DRAFT_STATEMENT] if issue.is_draft else [], valid=False
    )
    yield Statement("Amendment", amendment_lines(issue.amended_certificate), _QUALITY_STANDARDS)
    misfit_lines = certificate_text.misfit_lines(result, lab.certified_names(result))
    yield Statement("Accepted misfit", misfit_lines)
    yield Statement("Result file", certificate_text.seal_lines(result, issue.acceptance_reason))
    yield Statement(
        certificate_text.TRACEABILITY_HEADING,
        [settings.traceability],
        language=settings.language,
        traceable=True,
    )


def _value_statements(lab: Lab, result: Result, certified_result: Result) -> Iterator[Statement]:
    settings = lab.certificate
    names = lab.certified_names(result)
    gravity = certified_result.inputs.gravity
    uncertainty_type = "basic_methodMeasurementUncertainty"
    yield Statement(
        certificate_text.UNCERTAINTY_HEADING,
        [certificate_text.uncertainty_statement()],
        _GUM_DOCUMENTS,
        ref_type=uncertainty_type,
    )
    g_definition = f"1 g = {gravity!r} m/s^2, the local gravity at the site"
    yield Statement(
        certificate_text.UNITS_HEADING,
        [certificate_text.unit_statement(gravity)],
        non_si_definition=g_definition,
    )
    cmc_sentences = cmc_lines(result, certified_result, lab)
    yield Statement(certificate_text.CAPABILITY_HEADING, cmc_sentences, ("ILAC-P14:09/2020",))
    prior_sentences = [
        line
        for name in names
        for line in certificate_text.prior_lines(name, certified_result, settings)
    ]
    yield Statement(certificate_text.PRIOR_INFORMATION_HEADING, prior_sentences)
    evidence = [*evidence_lines(certified_result.assumed, lab.evidence)]
    yield Statement(certificate_text.FIXED_TERMS_HEADING, evidence, language=settings.language)
    default_evidence = default_evidence_lines(lab, certified_result)
    yield Statement(
        certificate_text.DEFAULT_EVIDENCE_HEADING, default_evidence, language=settings.language
    )
    customer_lines = certificate_text.customer_lines(settings)
    yield Statement(
        certificate_text.CUSTOMER_DATA_HEADING,
        customer_lines,
        _QUALITY_STANDARDS,
        settings.language,
    )
    for name in names:
        lines = certificate_text.undetermined_lines(name, certified_result.accelerometers[name])
        yield Statement(
            f"Undetermined coefficients of accelerometer {name}",
            lines,
            subject_id=accelerometer_item_id(lab, certified_result, name),
        )
    if (triad := certified_triad(certified_result, names)) is not None:
        yield Statement(triad_title(triad), triad_lines(triad))
    for name in names:
        lines = certificate_text.assumption_lines(name, certified_result)
        heading = f"{certificate_text.BASIS_HEADING}, accelerometer {name}"
        yield Statement(
            heading, lines, subject_id=accelerometer_item_id(lab, certified_result, name)
        )


def _conformity_statements(lab: Lab, result: Result, verdicts: Verdicts) -> Iterator[Statement]:
    for name, conformity_by_symbol in verdicts.items():
        for symbol, conformity in conformity_by_symbol.items():
            coefficient = result.accelerometers[name].coefficients.get(symbol)
            item_id = accelerometer_item_id(lab, result, name)
            yield Statement(
                f"{certificate_text.CONFORMITY_HEADING}, {symbol} of {name}",
                [
                    certificate_text.verdict_sentence(symbol, name, conformity, coefficient),
                    certificate_text.decision_rule_sentence(conformity),
                ],
                ("JCGM 106:2012",),
                subject_id=f"{item_id}.{symbol}"
                if coefficient is not None and certificate_text.is_determined(coefficient)
                else item_id,
                conformity=certificate_text.dcc_verdict(conformity, coefficient),
            )
