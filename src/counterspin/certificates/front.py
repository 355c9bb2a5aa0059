"""The pages of a certificate: subject, method, results and statements.

Opinions, such as whether a result is good, are left to the report (ISO/IEC 17025 7.8.7).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Final

from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient, TriadResult
from counterspin.calibration.si_estimates import SiEstimate
from counterspin.certificates import wording
from counterspin.certificates.amendment import amendment_lines
from counterspin.certificates.conversion import (
    capability_lines,
    certified_triad,
    in_si,
    matrix_dof,
    output_lines,
    output_table,
    shown_in_si,
    triad_lines,
    with_capability,
)
from counterspin.certificates.conversion import (
    title as triad_title,
)
from counterspin.certificates.evidence import evidence_lines
from counterspin.certificates.lab import Contact, Lab, LabAccelerometer
from counterspin.certificates.schema import factor
from counterspin.certificates.statements import Issue, Verdicts
from counterspin.certificates.wording import coverage_factor
from counterspin.characters import Lines
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import format_count, format_estimate, format_number
from counterspin.reports.typography import typeset, typeset_block

TITLE: Final = "Calibration certificate"

#: Where somebody signs on paper.
_LINE: Final = Lines("", "_____________________________________")
_ELECTRONIC: Final = "electronic, of the XML and of these pages"


def title(issue: Issue) -> str:
    """Return the heading of every page."""
    return f"DRAFT, not a {TITLE.lower()}" if issue.draft else TITLE


def front_blocks(lab: Lab, result: Result, issue: Issue, verdicts: Verdicts) -> Iterator[Block]:
    """Yield the certificate's pages.

    lab: The laboratory's data.
    """
    settings, names = lab.certificate, lab.certified(result)
    stated = with_capability(result, lab)
    yield Heading(title(issue), 1)
    if issue.draft:
        yield Paragraph(wording.DRAFT, "warning")
    yield Paragraph(
        f"{issue.identifier}. The Digital Calibration Certificate (DCC, XML) of this identifier "
        "holds the same numbers for machines.",
        "quiet",
    )
    for line in amendment_lines(issue.amended):
        yield Paragraph(typeset(line))
    yield _two_columns(_administration(lab, issue))
    yield Heading("Calibrated item")
    yield _two_columns(_item(lab, result))
    yield Heading("Method and conditions")
    yield typeset_block(_two_columns(_circumstances(lab, result)))
    for line in (wording.BASED_ON, *wording.deviation_lines(settings)):
        yield Paragraph(typeset(line))
    yield Heading("Results")
    seal = wording.seal_lines(result, issue.accepted_unsealed)
    for line in (*wording.misfit_lines(result, names), *seal):
        yield Paragraph(typeset(line), "warning")
    yield from _results(lab, result, stated)
    yield Heading("Statements")
    yield from _part(wording.UNCERTAINTY, typeset(wording.uncertainty_statement()))
    yield from _part(wording.UNITS, typeset(wording.unit_statement(result.inputs.gravity)))
    yield from _part(wording.TRACEABILITY, settings.traceability)
    yield from _conformity(stated, verdicts)
    yield from _part(wording.REMARKS, *settings.remarks)
    yield from _part(wording.SCOPE, wording.scope_statement())


def _part(name: str, *lines: str) -> Iterator[Block]:
    """Yield a named section of some statements; nothing without any."""
    if lines:
        yield Heading(name, 3)
    yield from map(Paragraph, lines)


def _conformity(stated: Result, verdicts: Verdicts) -> Iterator[Block]:
    said = list[Paragraph]()
    for name, by_symbol in verdicts.items():
        for symbol, judged in by_symbol.items():
            coefficient = stated.accelerometers[name].coefficients.get(symbol)
            word = wording.verdict(symbol, name, judged, coefficient)
            text = typeset(f"{word} {wording.decision_rule(judged)}")
            # A sign and its number stay on one line.
            text = text.replace("< ", "<\u00a0").replace("> ", ">\u00a0").replace("<= ", "≤\u00a0")
            said.append(Paragraph(text, "plain" if judged.verdict == "pass" else "warning"))
    if said:
        yield Heading(wording.CONFORMITY, 3)
    yield from said


def _results(lab: Lab, result: Result, stated: Result) -> Iterator[Block]:
    """Yield the numbers, of `stated`, and the statements about them."""
    settings, names = lab.certificate, lab.certified(result)
    for name in names:
        accelerometer = stated.accelerometers[name]
        yield typeset_block(results_table(name, accelerometer.coefficients, in_si(stated, name)))
        for line in wording.output_lines(accelerometer).values():
            yield Paragraph(typeset(line))
        for line in wording.not_determined(name, accelerometer):
            yield Paragraph(typeset(line), "warning")
    if (triad := certified_triad(stated, names)) is not None:
        yield from map(typeset_block, _triad(stated, triad))
    yield Paragraph(
        "The XML holds the covariances of these coefficients"
        + (", also between accelerometers." if len(names) > 1 and stated.correlation else "."),
        "quiet",
    )
    yield from _part(wording.CAPABILITY, *map(typeset, capability_lines(result, stated, lab)))
    rests = list[Paragraph]()
    for name in names:
        for line in wording.rest_lines(name, result):
            rests.append(Paragraph(typeset(f"{name}: {line}")))
        for line in result.accelerometers[name].warnings:
            warning = f"Warning: {wording.without_plus_minus(line)}"
            rests.append(Paragraph(typeset(warning), "warning"))
    if rests:
        yield Heading(wording.RESTS_ON, 3)
    yield from rests
    known = (line for name in names for line in wording.known_beforehand(name, result, settings))
    yield from _part(wording.KNOWN, *map(typeset, known))
    yield from _part(wording.ASSUMED, *evidence_lines(result.assumed, lab.evidence))
    yield from _part(wording.SUPPLIED, *wording.customer_lines(settings))


def _triad(stated: Result, triad: TriadResult) -> Iterator[Block]:
    """Yield a triad's parameters with U, and its corrected output."""
    yield Heading(triad_title(triad), 3)
    for line in triad_lines(triad):
        yield Paragraph(typeset(line))
    yield results_table("Parameter", *shown_in_si(stated, triad))
    for line in output_lines(stated, triad):
        yield Paragraph(typeset(line))
    if triad.matrix is not None and triad.u_matrix is not None:
        k = coverage_factor(matrix_dof(triad))
        expanded = [[k * u for u in row] for row in triad.u_matrix]
        yield output_table(triad.accelerometers, triad.matrix, expanded, k)


def _administration(lab: Lab, issue: Issue) -> Iterator[tuple[str, str]]:
    settings = lab.certificate
    yield "Laboratory", _address(lab.laboratory)
    if lab.laboratory.code is not None:
        yield "Accreditation", lab.laboratory.code
    yield "Customer", _address(lab.customer)
    if settings.received is not None:
        yield "Item received", settings.received.isoformat()
    days = dict.fromkeys((settings.begin.isoformat(), settings.end.isoformat()))
    yield "Calibrated", f"{' to '.join(days)}, place: {settings.place}"
    if lab.conditions.temperature is not None:
        temperature = lab.conditions.temperature
        yield "Ambient temperature", _with_expanded(temperature.value, temperature.u, "°C")
    yield "Issued", issue.date.date().isoformat()
    for place, person in enumerate(lab.persons):
        signs = ", signs" if place == 0 else ""
        yield "Responsible", f"{person.name}, {person.role}{signs}"
    yield "Signature", _ELECTRONIC if issue.signed else _LINE


def _circumstances(lab: Lab, result: Result) -> Iterator[tuple[str, str]]:
    """Yield method and circumstances, from which a reader judges whether the result applies."""
    inputs = result.inputs
    if lab.certificate.procedure is not None:
        yield "Procedure", lab.certificate.procedure
    yield "Method", wording.method_name(result)
    yield "Test", Lines(*wording.test_lines(result))
    if result.runs:
        rates = (f"{name}: {run.rate:.7g} rad/s" for name, run in result.runs.items())
        yield "Rates", ", ".join(rates)
    if inputs.radius:
        yield "Radius", _with_expanded(inputs.radius, inputs.u_radius, "m")
    yield "Local gravity", _with_expanded(inputs.gravity, inputs.u_gravity, "m/s^2")
    latitude, u = math.degrees(inputs.latitude), math.degrees(inputs.u_latitude)
    yield "Latitude", _with_expanded(latitude, u, "deg")


def _with_expanded(value: float, u: float, unit: str) -> str:
    if not u:
        return f"{format_number(value, 9)} {unit}"
    k = coverage_factor(None)
    return f"{format_estimate(value, k * u, unit)} (U, k = {factor(k)})"


def _address(contact: Contact) -> str:
    street = " ".join(part for part in (contact.street, contact.number) if part)
    city = " ".join(part for part in (contact.post_code, contact.city) if part)
    parts = (contact.name, street, city, contact.country, contact.email, contact.phone)
    return ", ".join(part for part in parts if part)


def _item(lab: Lab, result: Result) -> Iterator[tuple[str, str]]:
    item = lab.item
    yield "Item", item.name
    yield "Manufacturer, model", f"{item.manufacturer}, {item.model}"
    yield "Serial number", item.serial_number
    if item.state is not None:
        yield "State", f"calibrated {item.state}"
    if item.inventory_number is not None:
        yield "Inventory number", item.inventory_number
    for name in lab.certified(result):
        part = lab.accelerometers.get(name, LabAccelerometer())
        known = (part.manufacturer, part.model, lab.serial_number(name, result))
        if any(known):
            yield f"Accelerometer {name}", ", ".join(text for text in known if text)


def _two_columns(rows: Iterator[tuple[str, str]]) -> Table:
    return Table((Column("", wraps=True), Column("", wraps=True)), tuple(rows))


def results_table(
    name: str, coefficients: Mapping[str, Coefficient], estimates: Mapping[str, SiEstimate]
) -> Table:
    """Return the determined coefficients with U, in g-units and in SI.

    coefficients: In g-units; a missing one is in SI only.
    """
    rows = []
    for symbol, estimate in estimates.items():
        in_g, k_in_g = "-", "-"
        if (c := coefficients.get(symbol)) is not None and c.u is not None:
            k = coverage_factor(c.dof)
            in_g, k_in_g = wording.shown_in_g(c, k), factor(k)
        k = coverage_factor(estimate.dof)
        unit = "" if estimate.unit.words == "1" else estimate.unit.words
        rows.append(
            (
                symbol,
                in_g,
                k_in_g,
                format_estimate(estimate.value, k * estimate.u, unit),
                factor(k),
                "infinite" if estimate.dof is None else format_count(estimate.dof),
            )
        )
    return Table(
        (
            Column(name),
            Column("Value ± U, g-units"),
            Column("k", "right"),
            Column("Value ± U, SI"),
            Column("k", "right"),
            Column("Degrees of freedom", "right", wraps=True),
        ),
        tuple(rows),
    )
