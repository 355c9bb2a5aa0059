"""Many campaigns in one table: K_II of every accelerometer, or why there is none."""

from __future__ import annotations

from collections.abc import Iterator

from counterspin.calibration.batch import BatchResult
from counterspin.calibration.pages.accelerometer import in_field_units
from counterspin.calibration.result import Result
from counterspin.reports.blocks import Block, Column, Paragraph, Table
from counterspin.reports.numbers import format_estimate

_COLUMNS = (
    Column("Campaign"),
    Column("Accelerometer"),
    Column("K_II", align="right"),
    Column("Unit"),
    Column("State"),
)


def batch_blocks(batch: BatchResult) -> list[Block]:
    """Return the summary of a batch, failures below it."""
    rows = tuple(
        row
        for folder, outcome in batch.campaigns.items()
        if isinstance(outcome, Result)
        for row in _rows(folder, outcome)
    )
    blocks: list[Block] = [Table(_COLUMNS, rows)] if rows else []
    blocks += [Paragraph(f"{folder}: {error}", "warning") for folder, error in batch.failed.items()]
    blocks += [
        Paragraph(f"{folder}: the records contradict the result; it must not be used.", "warning")
        for folder in batch.contradicted
    ]
    failed = len(batch.failed)
    calibrated = len(batch.campaigns) - failed
    blocks.append(Paragraph(f"{calibrated} campaigns calibrated, {failed} failed.", "quiet"))
    return blocks


def _rows(folder: str, result: Result) -> Iterator[tuple[str, ...]]:
    for name, accelerometer in result.accelerometers.items():
        coefficient = accelerometer.coefficients.get("K_II")
        value, u, unit = (None, None, "") if coefficient is None else in_field_units(coefficient)
        yield folder, name, format_estimate(value, u), unit, accelerometer.state or ""
