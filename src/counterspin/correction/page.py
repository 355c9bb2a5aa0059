"""Printed report of `counterspin apply`."""

from __future__ import annotations

import math

from counterspin.correction.apply_file import CorrectedFile, CorrectedRow
from counterspin.reports.blocks import Block, Heading, Paragraph
from counterspin.reports.numbers import format_number
from counterspin.reports.text import Report


def correction_report(corrected: CorrectedFile) -> Report:
    """Return the corrected values, the size of the correction, and its uncertainty."""
    blocks: list[Block] = [Heading(f"Wrote {corrected.path}")]
    for column_file in (corrected, *corrected.more):
        blocks += _column_blocks(column_file)
    correction = corrected.correction
    if math.isfinite(correction.dof):
        blocks.append(
            Paragraph(
                f"The correction has at least {format_number(correction.dof, 3)} effective "
                "degrees of freedom."
            )
        )
    blocks += [Paragraph(note) for note in correction.notes]
    blocks += [Paragraph(f"Warning: {text}", "warning") for text in correction.warnings]
    return Report(blocks)


def _column_blocks(corrected: CorrectedFile) -> list[Block]:
    unit = corrected.correction.unit

    def at(level: CorrectedRow) -> str:
        return f"{format_number(level.u, 2)} {unit} at {format_number(level.indicated, 6)} {unit}"

    read = f" File format: {corrected.found}." if corrected.found else ""
    missing = (
        f"; {corrected.missing} of these rows lack a number and remain empty"
        if corrected.missing
        else ""
    )
    return [
        Paragraph(
            f"{corrected.rows} rows of {corrected.column}, from "
            f"{format_number(corrected.low, 6)} to {format_number(corrected.high, 6)} "
            f"{unit}{missing}.{read}"
        ),
        Paragraph(
            f"The largest correction is {format_number(corrected.most.correction, 6)} {unit}, "
            f"at {format_number(corrected.most.indicated, 6)} {unit}."
        ),
        Paragraph(
            f"The standard uncertainty of the correction (k = 1) is {at(corrected.at_one_g)} "
            f"(row nearest to 1 g) and {at(corrected.at_largest)} (largest value). It does not "
            "include the noise of the indication."
        ),
    ]
