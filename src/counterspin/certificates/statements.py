"""The statements of a certificate: its claims in words, marked up for machines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Conformity
from counterspin.certificates import wording
from counterspin.certificates.administrative import Issue, item_id
from counterspin.certificates.amendment import amendment_lines
from counterspin.certificates.elements import ENGLISH, Element, dcc, rich, text
from counterspin.certificates.evidence import evidence_lines
from counterspin.certificates.lab import Lab

Verdicts = Mapping[str, Mapping[str, Conformity]]


def quantity_id(lab: Lab, result: Result, name: str, symbol: str) -> str:
    """Return the id of a coefficient."""
    return f"{item_id(lab, result, name)}.{symbol}"


def statements(
    lab: Lab, result: Result, issue: Issue, verdicts: Verdicts, raised: Sequence[str]
) -> list[Element]:
    """Return every statement, in the order in which they are read.

    lab: The laboratory's data.
    """
    gravity = result.inputs.gravity
    settings = lab.certificate
    names = lab.certified(result)
    texts = [
        *_said("Draft", *([wording.DRAFT] if issue.draft else ())),
        *_said("Amendment", *amendment_lines(issue.amended), norm="ISO/IEC 17025:2017"),
        *_said("Misfit of the result", *wording.despite_lines(result, names)),
        *_said("File of the result", *wording.seal_lines(result)),
        _traceability(lab),
        dcc(
            "statement",
            text("name", wording.UNCERTAINTY),
            dcc("norm", "JCGM 100:2008"),
            dcc("norm", "JCGM 102:2011"),
            rich("declaration", wording.uncertainty_statement()),
            refType="basic_methodMeasurementUncertainty",
        ),
        dcc(
            "statement",
            text("name", wording.UNITS),
            rich("declaration", wording.unit_statement(gravity)),
            dcc("nonSIDefinition", f"1 g = {gravity!r} m/s^2, the local gravity of the site"),
            dcc("nonSIUnit", "g"),
        ),
        *_said(wording.CAPABILITY, *raised, norm="ILAC-P14:09/2020"),
        *_said(
            wording.KNOWN,
            *(line for name in names for line in wording.known_beforehand(name, result, settings)),
        ),
        *_said(
            wording.ASSUMED,
            *evidence_lines(result.assumed, lab.evidence),
            language=settings.language,
        ),
        *_said(
            wording.SUPPLIED,
            *wording.customer_lines(settings),
            language=settings.language,
            norm="ISO/IEC 17025:2017",
        ),
        *_missing(lab, result),
        *_assumptions(lab, result),
        *_conformity(lab, result, verdicts),
        dcc(
            "statement",
            text("name", wording.SCOPE),
            dcc("norm", "ISO/IEC 17025:2017"),
            rich("declaration", wording.scope_statement()),
        ),
    ]
    if lab.certificate.remarks:
        texts.append(
            dcc(
                "statement",
                text("name", wording.REMARKS),
                rich("declaration", *lab.certificate.remarks, language=lab.certificate.language),
            )
        )
    return texts


def _said(
    name: str, *lines: str, norm: str | None = None, language: str = ENGLISH
) -> Iterator[Element]:
    """Yield a statement of some lines; nothing without any."""
    if lines:
        yield dcc(
            "statement",
            text("name", name),
            None if norm is None else dcc("norm", norm),
            rich("declaration", *lines, language=language),
        )


def _traceability(lab: Lab) -> Element:
    settings = lab.certificate
    return dcc(
        "statement",
        text("name", wording.TRACEABILITY),
        dcc("traceable", "true"),
        rich("declaration", settings.traceability, language=settings.language),
    )


def _missing(lab: Lab, result: Result) -> Iterator[Element]:
    for name in lab.certified(result):
        if lines := wording.not_determined(name, result.accelerometers[name]):
            yield dcc(
                "statement",
                text("name", f"Not determined, accelerometer {name}"),
                rich("declaration", *lines),
                refId=item_id(lab, result, name),
            )


def _assumptions(lab: Lab, result: Result) -> Iterator[Element]:
    for name in lab.certified(result):
        if lines := wording.rest_lines(name, result):
            yield dcc(
                "statement",
                text("name", f"{wording.RESTS_ON}, accelerometer {name}"),
                rich("declaration", *lines),
                refId=item_id(lab, result, name),
            )


def _conformity(lab: Lab, result: Result, verdicts: Verdicts) -> Iterator[Element]:
    for name, by_symbol in verdicts.items():
        for symbol, judged in by_symbol.items():
            coefficient = result.accelerometers[name].coefficients.get(symbol)
            certified = coefficient is not None and wording.is_determined(coefficient)
            word = wording.conformity_word(judged, coefficient)
            yield dcc(
                "statement",
                text("name", f"{wording.CONFORMITY}, {symbol} of {name}"),
                dcc("norm", "JCGM 106:2012"),
                rich(
                    "declaration",
                    wording.verdict(symbol, name, judged, coefficient),
                    wording.decision_rule(judged),
                ),
                None if word is None else dcc("conformity", word),
                refId=quantity_id(lab, result, name, symbol)
                if certified
                else item_id(lab, result, name),
            )
