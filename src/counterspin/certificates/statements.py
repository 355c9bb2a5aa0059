"""The statements of a certificate: its claims in words, and the marks of each for machines."""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from counterspin.calibration.result import Result
from counterspin.certificates import wording
from counterspin.certificates.amendment import AmendedCertificate, amendment_lines
from counterspin.certificates.conversion import (
    capability_lines,
    certified_triad,
    title,
    triad_lines,
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

    identifier: str  #: Unique.
    date: datetime.datetime  #: Of issue, UTC.
    signed: bool = False  #: Whether an electronic signature follows.
    #: Whether the laboratory's data are not its own yet, so that nothing is certified.
    draft: bool = False
    amended: AmendedCertificate | None = None  #: The certificate that this one replaces.
    #: Why a result is certified although its file has no seal; None if it has one.
    accepted_unsealed: str | None = None

    def file_name(self, ending: str) -> str:
        """Return a file name made of the identifier; a slash in it would name a folder."""
        return re.sub(r"[^\w.-]+", "_", self.identifier) + ending


@frozen
class Statement:
    """A claim in words, with its marks for machines (``dcc:statement``)."""

    name: str
    lines: Sequence[str]  #: Its paragraphs; there is no statement without any.
    norms: Sequence[str] = ()  #: The standards that it follows.
    language: str = ENGLISH
    ref: str | None = None  #: Id of the element that it is about.
    kind: str | None = None  #: ``refType`` of the DCC.
    traceable: bool = False
    non_si: str | None = None  #: Definition of the unit g.
    conformity: str | None = None  #: ``pass``, ``fail`` and so on, as the DCC has them.


def item_id(lab: Lab, result: Result, name: str) -> str:
    """Return the id of an accelerometer's item."""
    return f"item-{lab.certified(result).index(name) + 1}"


def statements(
    lab: Lab, result: Result, stated: Result, issue: Issue, verdicts: Verdicts
) -> list[Statement]:
    """Return every statement, in the order in which they are read.

    stated: The result with the uncertainties that the laboratory may claim.
    """
    every = [
        *_of_the_certificate(lab, stated, issue),
        *_of_the_values(lab, result, stated),
        *_of_conformity(lab, stated, verdicts),
        Statement(wording.SCOPE, [wording.scope_statement()], _QUALITY),
        Statement(wording.REMARKS, lab.certificate.remarks, language=lab.certificate.language),
    ]
    return [statement for statement in every if statement.lines]


def _of_the_certificate(lab: Lab, stated: Result, issue: Issue) -> Iterator[Statement]:
    settings = lab.certificate
    yield Statement("Draft", [wording.DRAFT] if issue.draft else [])
    yield Statement("Amendment", amendment_lines(issue.amended), _QUALITY)
    misfit = wording.misfit_lines(stated, lab.certified(stated))
    yield Statement("Misfit of the result", misfit)
    yield Statement("File of the result", wording.seal_lines(stated, issue.accepted_unsealed))
    yield Statement(
        wording.TRACEABILITY, [settings.traceability], language=settings.language, traceable=True
    )


def _of_the_values(lab: Lab, result: Result, stated: Result) -> Iterator[Statement]:
    settings, names, g = lab.certificate, lab.certified(result), stated.inputs.gravity
    kind = "basic_methodMeasurementUncertainty"
    yield Statement(wording.UNCERTAINTY, [wording.uncertainty_statement()], _GUM, kind=kind)
    one_g = f"1 g = {g!r} m/s^2, the local gravity of the site"
    yield Statement(wording.UNITS, [wording.unit_statement(g)], non_si=one_g)
    raised = capability_lines(result, stated, lab)
    yield Statement(wording.CAPABILITY, raised, ("ILAC-P14:09/2020",))
    known = [line for n in names for line in wording.known_beforehand(n, stated, settings)]
    yield Statement(wording.KNOWN, known)
    evidence = [*evidence_lines(stated.assumed, lab.evidence)]
    yield Statement(wording.ASSUMED, evidence, language=settings.language)
    supplied = wording.customer_lines(settings)
    yield Statement(wording.SUPPLIED, supplied, _QUALITY, settings.language)
    for name in names:
        lines = wording.not_determined(name, stated.accelerometers[name])
        yield Statement(
            f"Not determined, accelerometer {name}", lines, ref=item_id(lab, stated, name)
        )
    if (triad := certified_triad(stated, names)) is not None:
        yield Statement(title(triad), triad_lines(triad))
    for name in names:
        lines = wording.rest_lines(name, stated)
        about = f"{wording.RESTS_ON}, accelerometer {name}"
        yield Statement(about, lines, ref=item_id(lab, stated, name))


def _of_conformity(lab: Lab, stated: Result, verdicts: Verdicts) -> Iterator[Statement]:
    for name, by_symbol in verdicts.items():
        for symbol, judged in by_symbol.items():
            c = stated.accelerometers[name].coefficients.get(symbol)
            item = item_id(lab, stated, name)
            yield Statement(
                f"{wording.CONFORMITY}, {symbol} of {name}",
                [wording.verdict(symbol, name, judged, c), wording.decision_rule(judged)],
                ("JCGM 106:2012",),
                ref=f"{item}.{symbol}" if c is not None and wording.is_determined(c) else item,
                conformity=wording.conformity_word(judged, c),
            )
