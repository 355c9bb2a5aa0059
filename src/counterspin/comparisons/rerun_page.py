"""A result and the same calibration made again, as a person reads it."""

from __future__ import annotations

from counterspin.comparisons.result import RepeatedCalibration, RepeatedCoefficient
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import (
    NOT_DETERMINED,
    field_unit,
    format_estimate,
    format_number,
)


def repeat_blocks(repeated: RepeatedCalibration) -> list[Block]:
    """Return whether the result still holds, and what changed."""
    blocks: list[Block] = [
        Heading("A result calibrated again", 1),
        Paragraph(in_words(repeated), "answer" if repeated.same else "warning"),
    ]
    if repeated.moved:
        found = "; ".join(f"{name}: {where}" for name, where in repeated.moved.items())
        blocks.append(Paragraph(f"Found by their checksums under other names: {found}.", "quiet"))
    differing = [c for c in repeated.coefficients if c.relative is None or c.relative > 0.0]
    if not repeated.same and differing:
        blocks.append(_table(differing))
    if repeated.changes:
        blocks.append(Heading("What changed"))
        blocks.append(
            Table(
                (Column(""), Column("Then", wraps=True), Column("Now", wraps=True)),
                tuple((change.subject, *change.values) for change in repeated.changes),
            )
        )
    return blocks


def in_words(repeated: RepeatedCalibration) -> str:
    """Return whether the result still holds, in a sentence."""
    limit = format_number(repeated.limit)
    if repeated.same:
        size = repeated.largest or 0.0
        most = f"largest relative difference {size:.1e}" if size else "no number differs"
        return f"{repeated.result}: the same within {limit} ({most})."
    whose = "; ".join(change.subject for change in repeated.changes)
    cause = f" Changed: {whose}." if whose else " Inputs, version and environment are the same."
    if repeated.largest is None:
        how = "its coefficients, or those that it determines, differ"
    elif repeated.largest <= repeated.limit:
        how = f"it was {repeated.state_before}, and is {repeated.state_now}"
    elif repeated.largest_in_u is None:
        how = f"the largest relative difference is {repeated.largest:.1e}"
    else:
        how = (
            f"the largest difference is {format_number(repeated.largest_in_u)} u "
            f"(relative: {repeated.largest:.1e})"
        )
    return f"{repeated.result}: not the same within {limit}: {how}.{cause}"


def _table(differing: list[RepeatedCoefficient]) -> Table:
    rows = list[tuple[str, ...]]()
    for c in differing:
        unit, factor = field_unit(c.unit)
        in_u = "" if c.in_u is None else f"{c.in_u:.2g}"
        rows.append(
            (
                f"{c.name}, {unit}",
                _number(c.before, c.u_before, factor),
                _number(c.now, c.u_now, factor),
                in_u,
            )
        )
    return Table(
        (
            Column("Coefficient"),
            Column("Then", "right"),
            Column("Now", "right"),
            Column("Difference in u", "right"),
        ),
        tuple(rows),
    )


def _number(value: float | None, u: float | None, factor: float) -> str:
    if value is None:
        return NOT_DETERMINED
    return format_estimate(value * factor, u * factor) if u else format_number(value * factor, 12)
