"""Kinds of test beside each other, as blocks of a report."""

from __future__ import annotations

import math
from collections.abc import Iterator

from counterspin.calibration.findings import level_of_kinds
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient, KindOfTest
from counterspin.reports.blocks import Block, Column, Paragraph, Table
from counterspin.reports.numbers import NOT_DETERMINED, field_unit, format_compact, format_number


def kind_blocks(accelerometer: AccelerometerResult) -> Iterator[Block]:
    """Yield each coefficient by all tests and by each kind alone, and whether the kinds agree."""
    kinds = accelerometer.kinds
    if not kinds:
        return
    symbols = [
        symbol
        for symbol, c in accelerometer.coefficients.items()
        if c.estimated or any(_has(kind, symbol) for kind in kinds)
    ]
    yield Table(
        columns=(
            Column("Coefficient"),
            Column("Unit"),
            Column("All tests", "right"),
            *(Column(f"{kind.kind} alone ({kind.count})", "right", wraps=True) for kind in kinds),
        ),
        rows=tuple(
            (
                symbol,
                field_unit(accelerometer.coefficients[symbol].unit)[0],
                _cell(accelerometer.coefficients[symbol]),
                *(_cell(kind.coefficients.get(symbol)) for kind in kinds),
            )
            for symbol in symbols
            if symbol in accelerometer.coefficients
        ),
    )
    level = level_of_kinds(kinds)
    words = "; ".join(_words(kind, level) for kind in kinds)
    yield Paragraph("Each test method against the others: " + words + ".")


def _has(kind: KindOfTest, symbol: str) -> bool:
    return symbol in kind.coefficients and kind.coefficients[symbol].estimated


def _cell(coefficient: Coefficient | None) -> str:
    if coefficient is None or not coefficient.estimated or coefficient.value is None:
        return NOT_DETERMINED
    _, factor = field_unit(coefficient.unit)
    return format_compact(coefficient.value * factor, (coefficient.u or 0.0) * factor)


def _words(kind: KindOfTest, level: float) -> str:
    if kind.p is None:
        return f"{kind.kind}: not predicted by the others"
    verdict = "agrees" if kind.p >= level else "does not agree"
    text = (
        f"{kind.kind}: {verdict} (chi-square/dof {format_number(kind.chi2 / kind.dof, 3)}, "
        f"p = {format_number(kind.p, 2)}"
    )
    moved = {symbol: abs(shift.z) for symbol, shift in kind.without.items()}
    if moved and math.isfinite(size := max(moved.values())):
        symbol = max(moved, key=lambda name: moved[name])
        text += f"; without it {symbol} moves most, by {format_number(size, 2)} of the shift's u"
    return text + ")"
