"""The outcome of `counterspin apply`, as a person reads it."""

from __future__ import annotations

import math

from counterspin.correction.apply_file import CorrectedFile, Level
from counterspin.reports.blocks import Block, Heading, Paragraph
from counterspin.reports.numbers import format_number
from counterspin.reports.text import Report


def render_application(done: CorrectedFile) -> Report:
    """Return the corrected values, the size of the correction, and its uncertainty."""
    blocks: list[Block] = [Heading(f"Wrote {done.path}")]
    for one in (done, *done.more):
        blocks += _column_blocks(one)
    correction = done.correction
    if math.isfinite(correction.dof):
        blocks.append(
            Paragraph(
                f"It has at least {format_number(correction.dof, 3)} effective degrees of freedom."
            )
        )
    blocks += [Paragraph(note) for note in correction.notes]
    blocks += [Paragraph(f"Warning: {text}", "warning") for text in correction.warnings]
    return Report(blocks)


def _column_blocks(done: CorrectedFile) -> list[Block]:
    unit = done.correction.unit

    def at(level: Level) -> str:
        return f"{format_number(level.u, 2)} {unit} at {format_number(level.indicated, 6)} {unit}"

    read = f" It was read with {done.found}." if done.found else ""
    missing = f"; {done.missing} of them lack a number and remain empty" if done.missing else ""
    return [
        Paragraph(
            f"{done.rows} rows of {done.column}, from {format_number(done.low, 6)} to "
            f"{format_number(done.high, 6)} {unit}{missing}.{read}"
        ),
        Paragraph(
            f"Largest correction {format_number(done.most.correction, 6)} {unit}, at "
            f"{format_number(done.most.indicated, 6)} {unit}."
        ),
        Paragraph(
            f"Standard uncertainty of the correction (k = 1): {at(done.at_one_g)} (the row nearest "
            f"to 1 g), {at(done.at_largest)} (the largest). The noise of the indication is "
            "not included."
        ),
    ]
