"""Printed report of `counterspin apply`."""

from __future__ import annotations

import math

from counterspin.correction.apply_file import CorrectedFile, CorrectedRow
from counterspin.reports.blocks import Block, Heading, Paragraph
from counterspin.reports.numbers import format_number
from counterspin.reports.text import Report


def correction_report(file: CorrectedFile) -> Report:
    """Return the corrected values, the size of the correction, and its uncertainty."""
    blocks: list[Block] = [Heading(f"Wrote {file.path}")]
    for column_file in (file, *file.more):
        blocks += _column_blocks(column_file)
    correction = file.correction
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


def _column_blocks(file: CorrectedFile) -> list[Block]:
    unit = file.correction.unit

    def describe_row(row: CorrectedRow) -> str:
        return f"{format_number(row.u, 2)} {unit} at {format_number(row.indicated, 6)} {unit}"

    format_text = f" File format: {file.found}." if file.found else ""
    verbs = "lacks a number and remains" if file.missing == 1 else "lack a number and remain"
    missing_text = f"; {file.missing} of these rows {verbs} empty" if file.missing else ""
    return [
        Paragraph(
            f"{file.rows} rows of {file.column}, from "
            f"{format_number(file.low, 6)} to {format_number(file.high, 6)} "
            f"{unit}{missing_text}.{format_text}"
        ),
        Paragraph(
            f"The largest correction is {format_number(file.most.correction, 6)} {unit}, "
            f"at {format_number(file.most.indicated, 6)} {unit}."
        ),
        Paragraph(
            f"The standard uncertainty of the correction (k = 1) is {describe_row(file.at_one_g)} "
            f"(row nearest to 1 g) and {describe_row(file.at_largest)} (largest value). It does "
            "not include the noise of the indication."
        ),
    ]
