"""Many campaigns in one table: K_II of every accelerometer, or why there is none.

- `render_batch`: as something that rich prints
"""

from __future__ import annotations

from collections.abc import Sequence

from counterspin.calibration.batch import Calibrated
from counterspin.calibration.pages.accelerometer import in_field_units
from counterspin.reports.blocks import Block, Column, Paragraph, Table
from counterspin.reports.numbers import format_estimate
from counterspin.reports.text import Report

_COLUMNS = (
    Column("Campaign"),
    Column("Accelerometer"),
    Column("K_II", align="right"),
    Column("Unit"),
    Column("Warnings", align="right"),
)


def render_batch(outcomes: Sequence[Calibrated]) -> Report:
    """Return the summary of a batch, failures below it."""
    rows = tuple(row for one in outcomes for row in _rows(one))
    blocks: list[Block] = [Table(_COLUMNS, rows)] if rows else []
    blocks += [
        Paragraph(f"{one.directory}: {one.error}", "warning") for one in outcomes if one.error
    ]
    failed = sum(one.result is None for one in outcomes)
    blocks.append(
        Paragraph(f"{len(outcomes) - failed} campaigns calibrated, {failed} failed.", "quiet")
    )
    return Report(blocks)


def _rows(one: Calibrated) -> list[tuple[str, ...]]:
    if one.result is None:
        return []
    rows: list[tuple[str, ...]] = []
    for name, found in one.result.accelerometers.items():
        coefficient = found.coefficients.get("K_II")
        value, u, unit = (None, None, "") if coefficient is None else in_field_units(coefficient)
        warnings = str(len(found.warnings) + len(one.result.warnings))
        rows.append((str(one.directory), name, format_estimate(value, u), unit, warnings))
    return rows
