"""Pages of a certificate's PDF: subject, method, results and statements.

Opinions, such as whether a result is good, are left to the report (ISO/IEC 17025 7.8.7).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from counterspin.calibration.pages.budget import budget_table
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient, TriadResult
from counterspin.calibration.si_estimates import SiEstimate
from counterspin.certificates import certificate_text
from counterspin.certificates.amendment import amendment_lines
from counterspin.certificates.certificate_text import coverage_factor
from counterspin.certificates.completeness import default_evidence
from counterspin.certificates.conversion import (
    apply_cmc_floor,
    certified_triad,
    cmc_lines,
    coefficients_in_si,
    displayed_parameters,
    matrix_dof,
    output_lines,
    output_table,
    triad_lines,
    triad_title,
)
from counterspin.certificates.evidence import evidence_lines
from counterspin.certificates.lab import Contact, Equipment, Lab, LabAccelerometer
from counterspin.certificates.schema import format_decimal
from counterspin.certificates.statements import Issue, Verdicts
from counterspin.characters import MultilineText
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import format_count, format_estimate, format_number
from counterspin.reports.typography import typeset, typeset_block

TITLE: Final = "Calibration certificate"

#: Line for a signature on paper.
_SIGNATURE_LINE: Final = MultilineText("", "_____________________________________")
_ELECTRONIC: Final = "electronic signature of the XML and of these pages"


def page_title(issue: Issue) -> str:
    """Return the heading of every page."""
    return f"DRAFT, not a {TITLE.lower()}" if issue.draft else TITLE


def page_blocks(lab: Lab, result: Result, issue: Issue, verdicts: Verdicts) -> Iterator[Block]:
    """Yield the certificate's pages.

    lab: The laboratory's data.
    """
    settings, names = lab.certificate, lab.certified(result)
    stated = apply_cmc_floor(result, lab)
    yield Heading(page_title(issue), 1)
    if issue.draft:
        yield Paragraph(certificate_text.DRAFT, "warning")
    yield Paragraph(
        f"{issue.identifier}. The Digital Calibration Certificate (DCC, XML) with this "
        "identifier contains the same values in machine-readable form.",
        "quiet",
    )
    for line in amendment_lines(issue.amended):
        yield Paragraph(typeset(line))
    yield two_columns_table(administrative_rows(lab, issue))
    yield Heading("Calibrated item")
    yield two_columns_table([*item_rows(lab), *_accelerometer_rows(lab, result)])
    yield Heading("Method and conditions")
    yield typeset_block(two_columns_table(_method_rows(lab, result)))
    for line in (certificate_text.BASED_ON, *certificate_text.deviation_lines(settings)):
        yield Paragraph(typeset(line))
    yield from equipment_blocks(lab.equipment)
    yield Heading("Results")
    seal = certificate_text.seal_lines(result, issue.accepted_unsealed)
    for line in (*certificate_text.misfit_lines(result, names), *seal):
        yield Paragraph(typeset(line), "warning")
    yield from _result_blocks(lab, result, stated)
    yield Heading("Statements")
    yield from section_blocks(
        certificate_text.UNCERTAINTY, typeset(certificate_text.uncertainty_statement())
    )
    yield from section_blocks(
        certificate_text.UNITS, typeset(certificate_text.unit_statement(result.inputs.gravity))
    )
    yield from section_blocks(certificate_text.TRACEABILITY, settings.traceability)
    yield from _conformity_blocks(stated, verdicts)
    yield from section_blocks(certificate_text.REMARKS, *settings.remarks)
    yield from section_blocks(certificate_text.SCOPE, certificate_text.scope_statement())


def equipment_blocks(equipment: Sequence[Equipment]) -> Iterator[Block]:
    """Yield a table of the equipment with its traceability; nothing without equipment."""
    if not equipment:
        return
    yield Heading(certificate_text.EQUIPMENT)
    rows = (
        (
            e.name,
            ", ".join(part for part in (e.manufacturer, e.model) if part),
            e.serial_number or "",
            e.quantity or "",
            e.certificate or "",
            e.calibrated_by or "",
            "" if e.due is None else e.due.isoformat(),
        )
        for e in equipment
    )
    titles = (
        "Equipment",
        "Manufacturer, model",
        "Serial number",
        "Quantity",
        "Certificate",
        "Calibrated by",
        "Next calibration due",
    )
    columns = tuple(Column(title, wraps=True) for title in titles)
    yield Table(columns, tuple(rows)).without_empty_columns()


def _budget_blocks(name: str, result: Result, symbols: Iterable[str]) -> Iterator[Block]:
    """Yield the budget of each certified coefficient; small sources share a row."""
    budgets = result.accelerometers[name].budget
    for symbol in symbols:
        if lines := budgets.get(symbol):
            main_lines = [line for line in lines if line.share >= certificate_text.MIN_SHARE]
            small_lines = [line for line in lines if line.share < certificate_text.MIN_SHARE]
            yield Heading(f"Uncertainty budget of {symbol}, {name}", 3)
            yield budget_table(name, symbol, result, main_lines, small_lines)


def section_blocks(name: str, *lines: str) -> Iterator[Block]:
    """Yield a section of statements with its heading; nothing if it is empty."""
    if lines:
        yield Heading(name, 3)
    yield from map(Paragraph, lines)


def _conformity_blocks(stated: Result, verdicts: Verdicts) -> Iterator[Block]:
    paragraphs = list[Paragraph]()
    for name, by_symbol in verdicts.items():
        for symbol, judged in by_symbol.items():
            coefficient = stated.accelerometers[name].coefficients.get(symbol)
            word = certificate_text.verdict_sentence(symbol, name, judged, coefficient)
            text = typeset(f"{word} {certificate_text.decision_rule(judged)}")
            # Keep a sign and its number on one line.
            text = text.replace("< ", "<\u00a0").replace("> ", ">\u00a0").replace("<= ", "≤\u00a0")
            paragraphs.append(Paragraph(text, "plain" if judged.verdict == "pass" else "warning"))
    if paragraphs:
        yield Heading(certificate_text.CONFORMITY, 3)
    yield from paragraphs


def _result_blocks(lab: Lab, result: Result, stated: Result) -> Iterator[Block]:
    """Yield the numbers, of `stated`, and the statements about them."""
    settings, names = lab.certificate, lab.certified(result)
    for name in names:
        accelerometer = stated.accelerometers[name]
        estimates = coefficients_in_si(stated, name)
        yield typeset_block(results_table(name, accelerometer.coefficients, estimates))
        yield from map(typeset_block, _budget_blocks(name, result, estimates))
        for line in certificate_text.output_lines(accelerometer).values():
            yield Paragraph(typeset(line))
        for line in certificate_text.undetermined_lines(name, accelerometer):
            yield Paragraph(typeset(line), "warning")
    if (triad := certified_triad(stated, names)) is not None:
        yield from map(typeset_block, _triad_blocks(stated, triad))
    yield Paragraph(
        "The XML contains the covariances of these coefficients"
        + (
            ", including covariances between accelerometers."
            if len(names) > 1 and stated.correlation
            else "."
        ),
        "quiet",
    )
    yield from section_blocks(
        certificate_text.CAPABILITY, *map(typeset, cmc_lines(result, stated, lab))
    )
    owners = dict[str, list[str]]()
    for name in names:
        for line in certificate_text.assumption_lines(name, result):
            owners.setdefault(line, []).append(name)
    paragraphs = [
        Paragraph(typeset(f"{', '.join(owned_statements)}: {line}"))
        for line, owned_statements in owners.items()
    ]
    for name in names:
        for line in result.accelerometers[name].warnings:
            warning = f"Warning: {certificate_text.replace_plus_minus(line)}"
            paragraphs.append(Paragraph(typeset(warning), "warning"))
    if paragraphs:
        yield Heading(certificate_text.BASIS, 3)
    yield from paragraphs
    prior_statements = (
        line for name in names for line in certificate_text.prior_lines(name, result, settings)
    )
    yield from section_blocks(certificate_text.PRIOR_KNOWLEDGE, *map(typeset, prior_statements))
    yield from section_blocks(
        certificate_text.ASSUMED, *evidence_lines(result.assumed, lab.evidence)
    )
    yield from section_blocks(certificate_text.DEFAULTS, *default_evidence(lab, result))
    yield from section_blocks(certificate_text.SUPPLIED, *certificate_text.customer_lines(settings))


def _triad_blocks(stated: Result, triad: TriadResult) -> Iterator[Block]:
    """Yield a triad's parameters with U, and its corrected output."""
    yield Heading(triad_title(triad), 3)
    for line in triad_lines(triad):
        yield Paragraph(typeset(line))
    yield results_table("Parameter", *displayed_parameters(stated, triad))
    for line in output_lines(stated, triad):
        yield Paragraph(typeset(line))
    if triad.matrix is not None and triad.u_matrix is not None:
        k = coverage_factor(matrix_dof(triad))
        expanded = [[k * u for u in row] for row in triad.u_matrix]
        yield output_table(triad.accelerometers, triad.matrix, expanded, k)


def administrative_rows(lab: Lab, issue: Issue) -> Iterator[tuple[str, str]]:
    """Yield laboratory, customer, dates, persons and signature."""
    settings = lab.certificate
    yield "Laboratory", _format_address(lab.laboratory)
    if lab.laboratory.code is not None:
        yield "Accreditation", lab.laboratory.code
    yield "Customer", _format_address(lab.customer)
    if settings.received is not None:
        yield "Item received", settings.received.isoformat()
    days = dict.fromkeys((settings.begin.isoformat(), settings.end.isoformat()))
    yield "Calibrated", f"{' to '.join(days)}, place: {settings.place}"
    if lab.conditions.temperature is not None:
        temperature = lab.conditions.temperature
        yield "Ambient temperature", _format_expanded(temperature.value, temperature.u, "°C")
    yield "Issued", issue.date.date().isoformat()
    for place, person in enumerate(lab.persons):
        signs = ", signs" if place == 0 else ""
        yield "Responsible", f"{person.name}, {person.role}{signs}"
    yield "Signature", _ELECTRONIC if issue.signed else _SIGNATURE_LINE


def _method_rows(lab: Lab, result: Result) -> Iterator[tuple[str, str]]:
    """Yield the method and the conditions, which show whether the result applies."""
    inputs = result.inputs
    if lab.certificate.procedure is not None:
        yield "Procedure", lab.certificate.procedure
    yield "Method", certificate_text.method_name(result)
    yield "Test", MultilineText(*certificate_text.test_lines(result))
    if result.runs:
        rates = (f"{name}: {run.rate:.7g} rad/s" for name, run in result.runs.items())
        yield "Rates", ", ".join(rates)
    if inputs.radius:
        yield "Radius", _format_expanded(inputs.radius, inputs.u_radius, "m")
    yield "Local gravity", _format_expanded(inputs.gravity, inputs.u_gravity, "m/s^2")
    latitude, u = math.degrees(inputs.latitude), math.degrees(inputs.u_latitude)
    yield "Latitude", _format_expanded(latitude, u, "deg")


def _format_expanded(value: float, u: float, unit: str) -> str:
    if not u:
        return f"{format_number(value, 9)} {unit}"
    k = coverage_factor(None)
    return f"{format_estimate(value, k * u, unit)} (U, k = {format_decimal(k)})"


def _format_address(contact: Contact) -> str:
    street = " ".join(part for part in (contact.street, contact.number) if part)
    city = " ".join(part for part in (contact.post_code, contact.city) if part)
    parts = (contact.name, street, city, contact.country, contact.email, contact.phone)
    return ", ".join(part for part in parts if part)


def item_rows(lab: Lab) -> Iterator[tuple[str, str]]:
    """Yield name and identification of the item."""
    item = lab.item
    yield "Item", item.name
    yield "Manufacturer, model", f"{item.manufacturer}, {item.model}"
    yield "Serial number", item.serial_number
    if item.state is not None:
        yield "State", f"calibrated {item.state}"
    if item.inventory_number is not None:
        yield "Inventory number", item.inventory_number


def _accelerometer_rows(lab: Lab, result: Result) -> Iterator[tuple[str, str]]:
    for name in lab.certified(result):
        part = lab.accelerometers.get(name, LabAccelerometer())
        known = (part.manufacturer, part.model, lab.serial_number(name, result))
        if any(known):
            yield f"Accelerometer {name}", ", ".join(text for text in known if text)


def two_columns_table(rows: Iterable[tuple[str, str]]) -> Table:
    """Return a table of names and values without titles."""
    return Table((Column("", wraps=True), Column("", wraps=True)), tuple(rows))


def results_table(
    name: str, coefficients: Mapping[str, Coefficient], estimates: Mapping[str, SiEstimate]
) -> Table:
    """Return the determined coefficients with U, in g-units and in SI.

    coefficients: In g-units; a coefficient missing here is shown in SI only.
    """
    rows = []
    for symbol, estimate in estimates.items():
        in_g, k_in_g = "-", "-"
        if (c := coefficients.get(symbol)) is not None and c.u is not None:
            k = coverage_factor(c.dof)
            in_g, k_in_g = certificate_text.format_in_g_units(c, k), format_decimal(k)
        k = coverage_factor(estimate.dof)
        unit = "" if estimate.unit.plain_text == "1" else estimate.unit.plain_text
        rows.append(
            (
                symbol,
                in_g,
                k_in_g,
                format_estimate(estimate.value, k * estimate.u, unit),
                format_decimal(k),
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
