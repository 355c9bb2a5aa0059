"""Statements of a certificate, with their machine-readable attributes."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from counterspin.calibration.result import Result
from counterspin.certificates import certificate_text
from counterspin.certificates.amendment import AmendedCertificate, amendment_lines
from counterspin.certificates.completeness import default_evidence
from counterspin.certificates.conversion import (
    certified_triad,
    cmc_lines,
    triad_lines,
    triad_title,
)
from counterspin.certificates.evidence import evidence_lines
from counterspin.certificates.lab import Lab
from counterspin.certificates.schema import ENGLISH
from counterspin.frozen import frozen
from counterspin.inference.verdicts import Conformity

Verdicts = Mapping[str, Mapping[str, Conformity]]

_GUM: Final = ("JCGM 100:2008", "JCGM 102:2011")
_QUALITY: Final = ("ISO/IEC 17025:2017",)


@frozen
class Issue:
    """Identifier and date of a certificate."""

    identifier: str  #: Unique identifier.
    date: datetime.datetime  #: Date of issue, UTC.
    signed: bool = False  #: Whether an electronic signature follows.
    #: Whether data are missing, so that nothing is certified.
    draft: bool = False
    amended: AmendedCertificate | None = None  #: The certificate that this one replaces.
    #: Reason for certifying a result whose file has no seal; None if it has one.
    accepted_unsealed: str | None = None
    logo: bytes | None = None  #: The laboratory's, PNG or SVG.

    def file_name(self, ending: str) -> str:
        """Return a file name made of the identifier; a slash in it would name a folder."""
        return re.sub(r"[^\w.-]+", "_", self.identifier) + ending


@frozen
class Statement:
    """A statement, with its machine-readable attributes (``dcc:statement``)."""

    name: str
    lines: Sequence[str]  #: Paragraphs; a statement without any is omitted.
    norms: Sequence[str] = ()  #: Standards that it follows.
    language: str = ENGLISH
    ref: str | None = None  #: Id of the element that it concerns.
    kind: str | None = None  #: ``refType`` of the DCC.
    traceable: bool = False
    non_si: str | None = None  #: Definition of the unit g.
    conformity: str | None = None  #: DCC keyword, such as ``pass`` or ``fail``.
    valid: bool = True  #: False: what the statement concerns is not valid.


def item_id(lab: Lab, result: Result, name: str) -> str:
    """Return the id of an accelerometer's item."""
    return f"item-{lab.certified(result).index(name) + 1}"


def statements(
    lab: Lab, result: Result, stated: Result, issue: Issue, verdicts: Verdicts
) -> list[Statement]:
    """Return the statements in the order of reading.

    stated: The result with the uncertainties that the laboratory may claim.
    """
    candidates = [
        *_certificate_statements(lab, stated, issue),
        *_value_statements(lab, result, stated),
        *_conformity_statements(lab, stated, verdicts),
        Statement(certificate_text.SCOPE, [certificate_text.scope_statement()], _QUALITY),
        Statement(
            certificate_text.REMARKS, lab.certificate.remarks, language=lab.certificate.language
        ),
    ]
    return [statement for statement in candidates if statement.lines]


def _certificate_statements(lab: Lab, stated: Result, issue: Issue) -> Iterator[Statement]:
    settings = lab.certificate
    yield Statement("Draft", [certificate_text.DRAFT] if issue.draft else [], valid=False)
    yield Statement("Amendment", amendment_lines(issue.amended), _QUALITY)
    misfit = certificate_text.misfit_lines(stated, lab.certified(stated))
    yield Statement("Accepted misfit", misfit)
    yield Statement("Result file", certificate_text.seal_lines(stated, issue.accepted_unsealed))
    yield Statement(
        certificate_text.TRACEABILITY,
        [settings.traceability],
        language=settings.language,
        traceable=True,
    )


def _value_statements(lab: Lab, result: Result, stated: Result) -> Iterator[Statement]:
    settings, names, g = lab.certificate, lab.certified(result), stated.inputs.gravity
    kind = "basic_methodMeasurementUncertainty"
    yield Statement(
        certificate_text.UNCERTAINTY, [certificate_text.uncertainty_statement()], _GUM, kind=kind
    )
    one_g = f"1 g = {g!r} m/s^2, the local gravity at the site"
    yield Statement(certificate_text.UNITS, [certificate_text.unit_statement(g)], non_si=one_g)
    cmc_sentences = cmc_lines(result, stated, lab)
    yield Statement(certificate_text.CAPABILITY, cmc_sentences, ("ILAC-P14:09/2020",))
    prior_sentences = [
        line for n in names for line in certificate_text.prior_lines(n, stated, settings)
    ]
    yield Statement(certificate_text.PRIOR_KNOWLEDGE, prior_sentences)
    evidence = [*evidence_lines(stated.assumed, lab.evidence)]
    yield Statement(certificate_text.ASSUMED, evidence, language=settings.language)
    bounds = default_evidence(lab, stated)
    yield Statement(certificate_text.DEFAULTS, bounds, language=settings.language)
    supplied = certificate_text.customer_lines(settings)
    yield Statement(certificate_text.SUPPLIED, supplied, _QUALITY, settings.language)
    for name in names:
        lines = certificate_text.undetermined_lines(name, stated.accelerometers[name])
        yield Statement(
            f"Undetermined coefficients of accelerometer {name}",
            lines,
            ref=item_id(lab, stated, name),
        )
    if (triad := certified_triad(stated, names)) is not None:
        yield Statement(triad_title(triad), triad_lines(triad))
    for name in names:
        lines = certificate_text.assumption_lines(name, stated)
        subject = f"{certificate_text.BASIS}, accelerometer {name}"
        yield Statement(subject, lines, ref=item_id(lab, stated, name))


def _conformity_statements(lab: Lab, stated: Result, verdicts: Verdicts) -> Iterator[Statement]:
    for name, by_symbol in verdicts.items():
        for symbol, judged in by_symbol.items():
            c = stated.accelerometers[name].coefficients.get(symbol)
            item = item_id(lab, stated, name)
            yield Statement(
                f"{certificate_text.CONFORMITY}, {symbol} of {name}",
                [
                    certificate_text.verdict_sentence(symbol, name, judged, c),
                    certificate_text.decision_rule(judged),
                ],
                ("JCGM 106:2012",),
                ref=f"{item}.{symbol}"
                if c is not None and certificate_text.is_determined(c)
                else item,
                conformity=certificate_text.dcc_verdict(judged, c),
            )
