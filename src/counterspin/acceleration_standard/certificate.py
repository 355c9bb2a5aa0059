"""Certificate of a centrifuge: a DCC of the applied acceleration at each level."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from counterspin.acceleration_standard.page import budget_table, format_level, validation_sentence
from counterspin.acceleration_standard.result import AppliedAcceleration, AppliedLevel, Origin
from counterspin.certificates import certificate_text
from counterspin.certificates.build import render_extension, serialize_document
from counterspin.certificates.certificate_text import coverage_factor
from counterspin.certificates.completeness import (
    MIN_EVIDENCE_SHARE,
    MissingEntry,
    missing_administrative_data,
    missing_evidence_entry,
    missing_lines,
)
from counterspin.certificates.evidence import (
    evidence_lines,
    require_evidence,
    terms_without_evidence,
)
from counterspin.certificates.issue_steps import (
    issue_notes,
    ledger_path,
    make_issue,
    read_laboratory_logo,
    render_images,
    render_pages,
    sign_pages_if_requested,
    signer_notes,
)
from counterspin.certificates.issuing import Certificate
from counterspin.certificates.lab import APPLIED_ACCELERATION, Lab, read_machine_lab
from counterspin.certificates.ledger import sha256_hex
from counterspin.certificates.pdf_pages import (
    administrative_rows,
    equipment_blocks,
    item_rows,
    page_title,
    section_blocks,
    two_column_table,
)
from counterspin.certificates.schema import Element, check_schema, format_decimal
from counterspin.certificates.signature import sign_document
from counterspin.certificates.signers import Signer
from counterspin.certificates.statements import Issue, Statement
from counterspin.errors import CampaignError
from counterspin.inference.distributions import COVERAGE
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import (
    format_estimate,
    format_number,
    format_share,
    format_uncertainty,
)
from counterspin.reports.typography import typeset, typeset_block

_METHOD_TEXT: Final = (
    "The acceleration is calculated from radius, rotation rate, alignment and gravity: a = R "
    "(1 + s c) w^2 cos(beta) cos(lambda) + g sin(lambda) + 2 w Omega R sin(L), with c = R w^2 "
    "and lambda = lambda_0 + d w^2 (IEEE Std 836, Annex B). The stated value is the mean over "
    "one revolution along an input axis that points inward."
)

#: Statement of a certificate: name, sentences, standards.
_Section = tuple[str, list[str], tuple[str, ...]]


def certify_applied(
    result: AppliedAcceleration,
    lab: Mapping[str, Any] | Path | str,
    *,
    schema: Path | None = None,
    signer: Signer | Callable[[], Signer] | None = None,
) -> Certificate:
    """Make the certificate of a centrifuge; `Certificate.write` writes it.

    Parameters
    ----------
    result
        Budget of the applied acceleration.
    lab
        Contents of ``LAB.toml`` as nested mappings with the same keys, or the file. Its [item]
        is the centrifuge.
    schema
        Folder or file of the DCC schema, against which the certificate is validated.
    signer
        As in `counterspin.certificate`.

    Raises
    ------
    CampaignError
        If the laboratory data have missing keys or mistakes, if [evidence] lacks an assumed
        term, or if a draft is to be signed.
    CounterspinError
        If key or schema is not valid.
    """
    laboratory = read_machine_lab(lab, result.gravity)
    source = "the laboratory data" if isinstance(lab, Mapping) else str(lab)
    folder = Path() if isinstance(lab, Mapping) else Path(lab).parent
    assumed_symbols = _source_symbols(result, "assumed")
    require_evidence(assumed_symbols, laboratory.evidence, source)
    entries = [*missing_administrative_data(laboratory), *_missing_evidence(laboratory, result)]
    if entries and signer is not None:
        raise CampaignError(source, missing_lines(entries), code="certificate-incomplete")
    issue = replace(
        make_issue(laboratory, result.content, None, (), is_draft=bool(entries)),
        is_signed=signer is not None,
        logo=read_laboratory_logo(laboratory, folder, source),
    )
    if callable(signer):
        signer = signer()
    stated_levels = [(level, _stated_u(laboratory, level)) for level in result.levels]
    blocks = list(_page_blocks(laboratory, result, issue, stated_levels))
    root = _build_document(laboratory, result, issue, stated_levels, render_pages(blocks, issue))
    xml = serialize_document(root if signer is None else sign_document(root, signer))
    if schema is not None:
        check_schema(xml, schema, f"certificate {issue.identifier}")
    return Certificate(
        identifier=issue.identifier,
        accelerometers=[],
        notes=[*issue_notes(laboratory, issue, entries), *signer_notes(signer, issue)],
        xml=xml,
        pages=lambda: sign_pages_if_requested(render_pages(blocks, issue, xml=xml), signer),
        page_images=lambda: render_images(blocks, issue),
        ledger=ledger_path(laboratory, lab),
        entry={"identifier": issue.identifier, "sha256": sha256_hex(xml)},
        signed_by=laboratory.persons[0].name,
        reason="issued",
        draft=issue.is_draft,
    )


def _source_symbols(result: AppliedAcceleration, origin: Origin) -> list[str]:
    return [source.symbol for source in result.applied_sources if source.origin == origin]


def _stated_u(lab: Lab, level: AppliedLevel) -> float:
    """Return u of a level, m/s^2, such that U = k u is not below the capability."""
    capability = lab.capability(APPLIED_ACCELERATION, 1.0) or 0.0
    return max(_evaluated_u(level), capability * abs(level.acceleration) / coverage_factor(None))


def _evaluated_u(level: AppliedLevel) -> float:
    """Return u of a level, m/s^2; without validation, U covers the Monte Carlo interval."""
    check, value = level.monte_carlo, level.acceleration
    if check.validated:
        return level.u
    return max(level.u, max(value - check.low, check.high - value) / coverage_factor(None))


def _missing_evidence(lab: Lab, result: AppliedAcceleration) -> Iterator[MissingEntry]:
    """Yield default uncertainties with a large share of a variance and without evidence."""
    for symbol, (share, level) in _default_shares(result).items():
        if terms_without_evidence([symbol], lab.evidence):
            yield missing_evidence_entry(
                symbol, share, f"the acceleration at {format_level(level)}"
            )


def _default_shares(result: AppliedAcceleration) -> dict[str, tuple[float, AppliedLevel]]:
    """Return the largest share of each default uncertainty that requires evidence, by symbol."""
    largest_shares: dict[str, tuple[float, AppliedLevel]] = {}
    for level in result.levels:
        for line in level.budget:
            source = result.source(line.source)
            previous_entry = largest_shares.get(source.symbol, (MIN_EVIDENCE_SHARE, level))
            if source.origin == "default" and line.share >= previous_entry[0]:
                largest_shares[source.symbol] = line.share, level
    return largest_shares


def _certificate_statements(
    lab: Lab, result: AppliedAcceleration, stated_levels: Sequence[tuple[AppliedLevel, float]]
) -> list[_Section]:
    """Return the statements of XML and pages, in the order of reading."""
    settings, quality_standards = lab.certificate, ("ISO/IEC 17025:2017",)
    capability_lines = [
        f"At {format_level(level)}, the evaluated uncertainty is U = "
        f"{format_uncertainty(coverage_factor(None) * _evaluated_u(level))} m/s^2. The "
        "certificate states the calibration and measurement capability instead, because this "
        "is the smallest uncertainty that the laboratory may state."
        for level, u in stated_levels
        if u > _evaluated_u(level)
    ]
    assumed_symbols = _source_symbols(result, "assumed")
    default_symbols = list(_default_shares(result))
    return [
        (certificate_text.UNCERTAINTY_HEADING, _uncertainty_lines(result), ("JCGM 100:2008",)),
        (certificate_text.CAPABILITY_HEADING, capability_lines, ("ILAC-P14:09/2020",)),
        (
            certificate_text.FIXED_TERMS_HEADING,
            [*evidence_lines(assumed_symbols, lab.evidence)],
            (),
        ),
        (
            certificate_text.DEFAULT_EVIDENCE_HEADING,
            [*evidence_lines(default_symbols, lab.evidence)],
            (),
        ),
        (
            certificate_text.CUSTOMER_DATA_HEADING,
            [*certificate_text.customer_lines(settings)],
            quality_standards,
        ),
        (certificate_text.SCOPE_HEADING, [certificate_text.scope_statement()], quality_standards),
        (certificate_text.REMARKS_HEADING, [*settings.remarks], ()),
    ]


def _uncertainty_lines(result: AppliedAcceleration) -> list[str]:
    k = coverage_factor(None)
    default_symbols = _source_symbols(result, "default")
    lines = [
        "The number after ± is the expanded uncertainty U. U is the combined standard "
        "uncertainty according to the GUM (JCGM 100), multiplied by the coverage factor k = "
        f"{format_decimal(k)} of the normal distribution for a coverage probability of "
        f"{format_share(COVERAGE)}.",
        validation_sentence(result),
    ]
    if not all(level.monte_carlo.validated for level in result.levels):
        lines.append(
            "If the Monte Carlo method does not validate the GUM interval, U covers "
            "the Monte Carlo interval."
        )
    if default_symbols:
        lines.append(
            "For these sources without a stated uncertainty, the budgets contain the default "
            f"standard uncertainty: {', '.join(default_symbols)}."
        )
    return lines


def _build_document(
    lab: Lab,
    result: AppliedAcceleration,
    issue: Issue,
    stated_levels: Sequence[tuple[AppliedLevel, float]],
    pages: bytes,
) -> Element:
    """Return the root element of the certificate."""
    settings = lab.certificate
    traceability = Statement(
        certificate_text.TRACEABILITY_HEADING,
        [settings.traceability],
        language=settings.language,
        traceable=True,
    )
    draft_statement = Statement(
        "Draft", [certificate_text.DRAFT_STATEMENT] if issue.is_draft else [], valid=False
    )
    laboratory_texts = {
        certificate_text.FIXED_TERMS_HEADING,
        certificate_text.DEFAULT_EVIDENCE_HEADING,
        certificate_text.REMARKS_HEADING,
    }
    sections = [
        Statement(name, lines, standards, settings.language if name in laboratory_texts else "en")
        for name, lines, standards in _certificate_statements(lab, result, stated_levels)
    ]
    asset_folder = files("counterspin.acceleration_standard") / "assets"
    return render_extension(
        (asset_folder / "certificate.xml.jinja").read_text(encoding="utf-8"),
        lab=lab,
        settings=settings,
        issue=issue,
        result=result,
        names=[],
        statements=[
            statement for statement in (draft_statement, traceability, *sections) if statement.lines
        ],
        file=result.content,
        stated=stated_levels,
        method=[_METHOD_TEXT, *certificate_text.deviation_lines(settings)],
        uncertainty=_uncertainty_lines(result),
        level_words=format_level,
        pages=pages,
    )


def _page_blocks(
    lab: Lab,
    result: AppliedAcceleration,
    issue: Issue,
    stated_levels: Sequence[tuple[AppliedLevel, float]],
) -> Iterator[Block]:
    """Yield the pages of the certificate."""
    yield Heading(page_title(issue), 1)
    if issue.is_draft:
        yield Paragraph(certificate_text.DRAFT_STATEMENT, "warning")
    yield Paragraph(
        f"{issue.identifier}. The Digital Calibration Certificate (DCC, XML) with this "
        "identifier contains the same values in machine-readable form.",
        "quiet",
    )
    yield two_column_table(administrative_rows(lab, issue))
    yield Heading("Calibrated item")
    yield two_column_table(item_rows(lab))
    yield Heading("Method")
    for line in (_METHOD_TEXT, *certificate_text.deviation_lines(lab.certificate)):
        yield Paragraph(typeset(line))
    yield from equipment_blocks(lab.equipment)
    yield Heading("Results")
    yield typeset_block(_results_table(stated_levels))
    for level in result.levels:
        yield Heading(f"Uncertainty budget at {format_level(level)}", 3)
        yield typeset_block(budget_table(result, level))
    yield Heading("Statements")
    yield from section_blocks(certificate_text.TRACEABILITY_HEADING, lab.certificate.traceability)
    for name, lines, _ in _certificate_statements(lab, result, stated_levels):
        yield from section_blocks(name, *map(typeset, lines))


def _results_table(stated_levels: Sequence[tuple[AppliedLevel, float]]) -> Table:
    k = coverage_factor(None)
    rows = tuple(
        (
            format_level(level),
            format_number(level.rate, 9),
            format_estimate(level.acceleration, k * u, "m/s^2"),
            format_uncertainty(k * u / abs(level.acceleration)),
            format_decimal(k),
        )
        for level, u in stated_levels
    )
    return Table(
        (
            Column("Level"),
            Column("Rate, rad/s", "right"),
            Column("Applied acceleration ± U", "right"),
            Column("U, relative", "right"),
            Column("k", "right"),
        ),
        rows,
    )
