"""What the model leaves out, and what that would do at its typical size.

- `left_out_sentence`: what decides, by name, the largest with its size
- `left_out_blocks`: all of it as a table
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from counterspin.calibration.left_out import decisive
from counterspin.calibration.result_parts import AccelerometerResult
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import field_unit, format_number

#: Effects below this part of a coefficient's u are not worth a number.
_NEGLIGIBLE_PART: Final = 0.01


def left_out_sentence(accelerometer: AccelerometerResult) -> str:
    """Return what would move a coefficient by more than its u; empty if nothing would.

    Each term is named once, with the first coefficient that it moves; of each coefficient the
    largest effect is stated.
    """
    listed, named = [], set()
    for name, (first, *others) in decisive(accelerometer).items():
        moved, to_moved = field_unit(accelerometer.coefficients[name].unit)
        unit, factor = field_unit(first.unit)
        shift = format_number(first.shift * to_moved, 2)
        size = format_number(first.size * factor, 2)
        part = f"{name} by {shift} {moved} ({first.symbol}, {size} {unit})"
        named.add(first.symbol)
        new = [effect.symbol for effect in others if effect.symbol not in named]
        named.update(new)
        listed.append(f"{part}, and less by {', '.join(new)}" if new else part)
    if not listed:
        return ""
    return f"Not in the model, and so not in u; typical sizes would move {'; '.join(listed)}."


def left_out_blocks(accelerometer: AccelerometerResult) -> Iterator[Block]:
    """Yield a table of what would move any coefficient by more than its u, if there is anything."""
    effects = decisive(accelerometer)
    if not effects:
        return
    by_term: dict[str, dict[str, float]] = {}
    sizes = {}
    for own in effects.values():
        for effect in own:
            sizes[effect.symbol] = (effect.size, effect.unit)
            by_term.setdefault(effect.symbol, {})
    for symbol, moves in by_term.items():
        omitted = accelerometer.left_out[symbol]
        for name in effects:
            own_moves = omitted.moves or {"K_II": omitted.sensitivity or 0.0}
            moves[name] = abs(own_moves.get(name, 0.0)) * sizes[symbol][0]
    columns = [Column("Left out"), Column("Typical size", "right")]
    for name in effects:
        moved, _ = field_unit(accelerometer.coefficients[name].unit)
        columns.append(Column(f"{name}, {moved}", "right"))
    rows = []
    for symbol, moves in by_term.items():
        unit, factor = field_unit(sizes[symbol][1])
        cells = [symbol, f"{format_number(sizes[symbol][0] * factor, 2)} {unit}"]
        for name, shift in moves.items():
            c = accelerometer.coefficients[name]
            worth = shift > _NEGLIGIBLE_PART * (c.u or 0.0)
            cells.append(format_number(shift * field_unit(c.unit)[1], 2) if worth else "")
        rows.append(tuple(cells))
    yield Heading("What the model leaves out", 3)
    yield Paragraph(
        "By how much each would move the coefficients at its typical size. It is not in u, but in "
        "the second uncertainty, u typical.",
        "quiet",
    )
    yield Table(tuple(columns), tuple(rows))
