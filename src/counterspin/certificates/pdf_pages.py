"""Pages of the PDF of a certificate: subject, method, results and statements.

Opinions, such as on the quality of a result, are left to the report (ISO/IEC 17025 7.8.7).
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
from counterspin.certificates.completeness import default_evidence_lines
from counterspin.certificates.conversion import (
    apply_cmc_floor,
    certified_triad,
    cmc_lines,
    coefficients_in_si,
    displayed_parameters,
    matrix_dof,
    matrix_table,
    triad_lines,
    triad_output_lines,
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

CERTIFICATE_TITLE: Final = "Calibration certificate"

#: Line for a signature on paper.
_SIGNATURE_LINE: Final = MultilineText("", "_____________________________________")
_ELECTRONIC_SIGNATURE: Final = "electronic signature of the XML and of these pages"


def page_title(issue: Issue) -> str:
    """Return the heading of every page."""
    return f"DRAFT, not a {CERTIFICATE_TITLE.lower()}" if issue.is_draft else CERTIFICATE_TITLE


def page_blocks(lab: Lab, result: Result, issue: Issue, verdicts: Verdicts) -> Iterator[Block]:
    """Yield the pages of a certificate.

    lab: Laboratory data.
    """
    settings, names = lab.certificate, lab.certified_names(result)
    certified_result = apply_cmc_floor(result, lab)
    yield Heading(page_title(issue), 1)
    if issue.is_draft:
        yield Paragraph(certificate_text.DRAFT_STATEMENT, "warning")
    yield Paragraph(
        f"{issue.identifier}. The Digital Calibration Certificate (DCC, XML) with this "
        "identifier contains the same values in machine-readable form.",
        "quiet",
    )
    for line in amendment_lines(issue.amended_certificate):
        yield Paragraph(typeset(line))
    yield two_column_table(administrative_rows(lab, issue))
    yield Heading("Calibrated item")
    yield two_column_table([*item_rows(lab), *_accelerometer_rows(lab, result)])
    yield Heading("Method and conditions")
    yield typeset_block(two_column_table(_method_rows(lab, result)))
    for line in (certificate_text.STANDARD_STATEMENT, *certificate_text.deviation_lines(settings)):
        yield Paragraph(typeset(line))
    yield from equipment_blocks(lab.equipment)
    yield Heading("Results")
    seal_lines = certificate_text.seal_lines(result, issue.acceptance_reason)
    for line in (*certificate_text.misfit_lines(result, names), *seal_lines):
        yield Paragraph(typeset(line), "warning")
    yield from _result_blocks(lab, result, certified_result)
    yield Heading("Statements")
    yield from section_blocks(
        certificate_text.UNCERTAINTY_HEADING, typeset(certificate_text.uncertainty_statement())
    )
    yield from section_blocks(
        certificate_text.UNITS_HEADING,
        typeset(certificate_text.unit_statement(result.inputs.gravity)),
    )
    yield from section_blocks(certificate_text.TRACEABILITY_HEADING, settings.traceability)
    yield from _conformity_blocks(certified_result, verdicts)
    yield from section_blocks(certificate_text.REMARKS_HEADING, *settings.remarks)
    yield from section_blocks(certificate_text.SCOPE_HEADING, certificate_text.scope_statement())


def equipment_blocks(equipment: Sequence[Equipment]) -> Iterator[Block]:
    """Yield a table of the equipment with its traceability, if any."""
    if not equipment:
        return
    yield Heading(certificate_text.EQUIPMENT_HEADING)
    rows = (
        (
            item.name,
            ", ".join(text for text in (item.manufacturer, item.model) if text),
            item.serial_number or "",
            item.quantity or "",
            item.certificate or "",
            item.calibrated_by or "",
            "" if item.due is None else item.due.isoformat(),
        )
        for item in equipment
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
            main_lines = [line for line in lines if line.share >= certificate_text.MIN_NAMED_SHARE]
            small_lines = [line for line in lines if line.share < certificate_text.MIN_NAMED_SHARE]
            yield Heading(f"Uncertainty budget of {symbol}, {name}", 3)
            yield budget_table(name, symbol, result, main_lines, small_lines)


def section_blocks(heading: str, *lines: str) -> Iterator[Block]:
    """Yield a section of statements with its heading, unless it is empty."""
    if lines:
        yield Heading(heading, 3)
    yield from map(Paragraph, lines)


def _conformity_blocks(certified_result: Result, verdicts: Verdicts) -> Iterator[Block]:
    paragraphs = list[Paragraph]()
    for name, conformity_by_symbol in verdicts.items():
        for symbol, conformity in conformity_by_symbol.items():
            coefficient = certified_result.accelerometers[name].coefficients.get(symbol)
            sentence = certificate_text.verdict_sentence(symbol, name, conformity, coefficient)
            text = typeset(f"{sentence} {certificate_text.decision_rule_sentence(conformity)}")
            # Keep a sign and its number on one line.
            text = text.replace("< ", "<\u00a0").replace("> ", ">\u00a0").replace("<= ", "≤\u00a0")
            paragraphs.append(
                Paragraph(text, "plain" if conformity.verdict == "pass" else "warning")
            )
    if paragraphs:
        yield Heading(certificate_text.CONFORMITY_HEADING, 3)
    yield from paragraphs


def _result_blocks(lab: Lab, result: Result, certified_result: Result) -> Iterator[Block]:
    """Yield the numbers of `certified_result` and the statements on them."""
    settings, names = lab.certificate, lab.certified_names(result)
    for name in names:
        accelerometer = certified_result.accelerometers[name]
        estimates = coefficients_in_si(certified_result, name)
        yield typeset_block(results_table(name, accelerometer.coefficients, estimates))
        yield from map(typeset_block, _budget_blocks(name, result, estimates))
        for line in certificate_text.output_lines(accelerometer).values():
            yield Paragraph(typeset(line))
        for line in certificate_text.undetermined_lines(name, accelerometer):
            yield Paragraph(typeset(line), "warning")
    if (triad := certified_triad(certified_result, names)) is not None:
        yield from map(typeset_block, _triad_blocks(certified_result, triad))
    yield Paragraph(
        "The XML contains the covariances of these coefficients"
        + (
            ", including covariances between accelerometers."
            if len(names) > 1 and certified_result.correlation
            else "."
        ),
        "quiet",
    )
    yield from section_blocks(
        certificate_text.CAPABILITY_HEADING, *map(typeset, cmc_lines(result, certified_result, lab))
    )
    names_by_line = dict[str, list[str]]()
    for name in names:
        for line in certificate_text.assumption_lines(name, result):
            names_by_line.setdefault(line, []).append(name)
    paragraphs = [
        Paragraph(typeset(f"{', '.join(owner_names)}: {line}"))
        for line, owner_names in names_by_line.items()
    ]
    for name in names:
        for line in result.accelerometers[name].warnings:
            warning = f"Warning: {certificate_text.replace_plus_minus(line)}"
            paragraphs.append(Paragraph(typeset(warning), "warning"))
    if paragraphs:
        yield Heading(certificate_text.BASIS_HEADING, 3)
    yield from paragraphs
    statements = (
        line for name in names for line in certificate_text.prior_lines(name, result, settings)
    )
    yield from section_blocks(certificate_text.PRIOR_INFORMATION_HEADING, *map(typeset, statements))
    yield from section_blocks(
        certificate_text.FIXED_TERMS_HEADING, *evidence_lines(result.assumed, lab.evidence)
    )
    yield from section_blocks(
        certificate_text.DEFAULT_EVIDENCE_HEADING, *default_evidence_lines(lab, result)
    )
    yield from section_blocks(
        certificate_text.CUSTOMER_DATA_HEADING, *certificate_text.customer_lines(settings)
    )


def _triad_blocks(certified_result: Result, triad: TriadResult) -> Iterator[Block]:
    """Yield the parameters of a triad with U, and its corrected output."""
    yield Heading(triad_title(triad), 3)
    for line in triad_lines(triad):
        yield Paragraph(typeset(line))
    yield results_table("Parameter", *displayed_parameters(certified_result, triad))
    for line in triad_output_lines(certified_result, triad):
        yield Paragraph(typeset(line))
    if triad.matrix is not None and triad.u_matrix is not None:
        k = coverage_factor(matrix_dof(triad))
        expanded_matrix = [[k * u for u in row] for row in triad.u_matrix]
        yield matrix_table(triad.accelerometers, triad.matrix, expanded_matrix, k)


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
        yield "Ambient temperature", _format_with_expanded_u(temperature.value, temperature.u, "°C")
    yield "Issued", issue.date.date().isoformat()
    for index, person in enumerate(lab.persons):
        suffix = ", signs" if index == 0 else ""
        yield "Responsible", f"{person.name}, {person.role}{suffix}"
    yield "Signature", _ELECTRONIC_SIGNATURE if issue.is_signed else _SIGNATURE_LINE


def _method_rows(lab: Lab, result: Result) -> Iterator[tuple[str, str]]:
    """Yield method and conditions of the calibration."""
    inputs = result.inputs
    if lab.certificate.procedure is not None:
        yield "Procedure", lab.certificate.procedure
    yield "Method", certificate_text.method_name(result)
    yield "Test", MultilineText(*certificate_text.test_lines(result))
    if result.runs:
        rate_texts = (f"{name}: {run.rate:.7g} rad/s" for name, run in result.runs.items())
        yield "Rates", ", ".join(rate_texts)
    if inputs.radius:
        yield "Radius", _format_with_expanded_u(inputs.radius, inputs.u_radius, "m")
    yield "Local gravity", _format_with_expanded_u(inputs.gravity, inputs.u_gravity, "m/s^2")
    latitude, u = math.degrees(inputs.latitude), math.degrees(inputs.u_latitude)
    yield "Latitude", _format_with_expanded_u(latitude, u, "deg")


def _format_with_expanded_u(value: float, u: float, unit: str) -> str:
    if not u:
        return f"{format_number(value, 9)} {unit}"
    k = coverage_factor(None)
    return f"{format_estimate(value, k * u, unit)} (U, k = {format_decimal(k)})"


def _format_address(contact: Contact) -> str:
    street = " ".join(text for text in (contact.street, contact.number) if text)
    city = " ".join(text for text in (contact.post_code, contact.city) if text)
    address_parts = (contact.name, street, city, contact.country, contact.email, contact.phone)
    return ", ".join(text for text in address_parts if text)


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
    for name in lab.certified_names(result):
        lab_accelerometer = lab.accelerometers.get(name, LabAccelerometer())
        identification = (
            lab_accelerometer.manufacturer,
            lab_accelerometer.model,
            lab.serial_number(name, result),
        )
        if any(identification):
            yield f"Accelerometer {name}", ", ".join(text for text in identification if text)


def two_column_table(rows: Iterable[tuple[str, str]]) -> Table:
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
        g_text, k_text = "-", "-"
        if (coefficient := coefficients.get(symbol)) is not None and coefficient.u is not None:
            k = coverage_factor(coefficient.dof)
            g_text, k_text = certificate_text.format_in_g_units(coefficient, k), format_decimal(k)
        k = coverage_factor(estimate.dof)
        unit = "" if estimate.unit.plain_text == "1" else estimate.unit.plain_text
        rows.append(
            (
                symbol,
                g_text,
                k_text,
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
