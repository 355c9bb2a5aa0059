"""The first pages of a certificate for people: administrative data and statements, then results.

- `front_blocks`: what stands before the report (ISO/IEC 17025 7.8.2.1)
- `results_table`: the coefficients with their expanded uncertainties
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from counterspin.calibration.notebook.si_estimate import SiEstimate
from counterspin.calibration.pages.accelerometer import rests_on
from counterspin.calibration.pages.motions import lines_of_tests, readings_of
from counterspin.calibration.pages.verdict import misfit_blocks
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient
from counterspin.certificates import wording
from counterspin.certificates.administrative import Issue
from counterspin.certificates.conversion import in_si
from counterspin.certificates.coverage import coverage_factor
from counterspin.certificates.elements import factor
from counterspin.certificates.lab import Contact, Lab, LabAccelerometer
from counterspin.certificates.statements import Verdicts
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import format_count, format_estimate
from counterspin.reports.typography import typeset, typeset_block

TITLE = "Calibration certificate"


def front_blocks(lab: Lab, result: Result, issue: Issue, verdicts: Verdicts) -> Iterator[Block]:
    """Yield the certificate's own pages; the report of the result follows them."""
    yield Heading(TITLE, 1)
    yield Paragraph(
        f"{issue.identifier}. The Digital Calibration Certificate (DCC, XML) of this identifier "
        "holds the same numbers for machines.",
        "quiet",
    )
    yield _two_columns(_administration(lab, issue))
    yield Heading("Calibrated item")
    yield _two_columns(_item(lab, result))
    yield Heading("Results")
    yield from misfit_blocks(result)
    if readings_of(result):
        for line in lines_of_tests(result):
            yield Paragraph(typeset(line))
    for name in lab.certified(result):
        coefficients = result.accelerometers[name].coefficients
        yield typeset_block(results_table(name, coefficients, in_si(result, name)))
        for line in wording.output_lines(result.accelerometers[name]):
            yield Paragraph(typeset(line))
        for line in wording.not_determined(name, result.accelerometers[name]):
            yield Paragraph(typeset(line), "warning")
        for line in rests_on(result.accelerometers[name]):
            yield Paragraph(typeset(f"{name}: {line}"))
    yield Heading("Statements")
    yield Paragraph(typeset(wording.uncertainty_statement()))
    yield Paragraph(typeset(wording.unit_statement(result.inputs.gravity)))
    yield Paragraph(lab.certificate.traceability)
    for name, by_symbol in verdicts.items():
        for symbol, judged in by_symbol.items():
            said = f"{wording.verdict(symbol, name, judged)} {wording.decision_rule(judged)}"
            yield Paragraph(said, "plain" if judged.verdict == "pass" else "warning")
    for remark in lab.certificate.remarks:
        yield Paragraph(remark)
    yield Paragraph(wording.scope_statement())


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
        yield "Temperature", f"{format_estimate(temperature.value, temperature.u or None)} °C"
    yield "Issued", issue.date.date().isoformat()
    for place, person in enumerate(lab.persons):
        signs = ", signs" if place == 0 else ""
        yield "Responsible", f"{person.name}, {person.role}{signs}"


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

    Parameters
    ----------
    name
        The accelerometer.
    coefficients
        In g-units; one that is missing here stands in SI alone.
    estimates
        In SI.
    """
    rows = []
    for symbol, estimate in estimates.items():
        in_g, k_in_g = "-", "-"
        if (c := coefficients.get(symbol)) is not None and c.u is not None:
            k = coverage_factor(c.dof)
            in_g, k_in_g = format_estimate(c.value, k * c.u, c.unit), factor(k)
        k = coverage_factor(estimate.dof)
        rows.append(
            (
                symbol,
                in_g,
                k_in_g,
                format_estimate(estimate.value, k * estimate.u, estimate.unit.words),
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
