"""The one uncertainty in words: what dominates it, what would reduce it, what it rests on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, Protocol

from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Knowledge
from counterspin.inference.joint.summary import BudgetLine, WhatIf
from counterspin.physics.terms import description_of
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import (
    field_unit,
    format_estimate,
    format_number,
    format_share,
    format_uncertainty,
)

#: Unstated sources that make up more than this part of u^2 decide it.
_MOST: Final = 0.5

#: How much better than its typical size something is taken to be known once it is stated.
KNOWN_BETTER: Final = 0.1

#: Sources below this part of any u^2 are not in the table.
_LEAST_SHARE: Final = 1e-3

#: Lines of a budget below this share are said together, where they are more than a few.
_LEAST_LINE: Final = 1e-4
_FEW_LINES: Final = 3

#: So many names of what is assumed are listed.
_MOST_NAMES: Final = 8


class HasUncertainty(Protocol):
    """A coefficient's uncertainty, found or forecast."""

    @property
    def u(self) -> float | None:
        """Standard uncertainty."""

    @property
    def unit(self) -> str:
        """Of `u`."""


class HasAnswer(Protocol):
    """Uncertainties of an accelerometer, estimated or forecast."""

    @property
    def coefficients(self) -> Mapping[str, HasUncertainty]:
        """By symbol."""

    @property
    def budget(self) -> Mapping[str, Sequence[BudgetLine]]:
        """By symbol."""

    @property
    def what_if(self) -> WhatIf | None:
        """Data for an update of the uncertainties."""


class HasAssumptions(Protocol):
    """A result, or a plan."""

    @property
    def assumed(self) -> Sequence[str]:
        """Terms assumed to be perfect."""


def decisive_lines(
    lines: Sequence[BudgetLine],
) -> tuple[Sequence[BudgetLine], Sequence[BudgetLine]]:
    """Return the lines of a budget that make up u, and those that together add next to nothing."""
    count = next((k for k, line in enumerate(lines) if line.share < _LEAST_LINE), len(lines))
    return (lines, ()) if len(lines) - count <= _FEW_LINES else (lines[:count], lines[count:])


def dominance(accelerometer: HasAnswer, symbol: str = "K_II") -> str:
    """Return the unstated sources that decide the u of a coefficient; empty if none do."""
    coefficient = accelerometer.coefficients.get(symbol)
    lines = accelerometer.budget.get(symbol, [])
    unstated = [line for line in lines if line.kind == "unstated"]
    if coefficient is None or not coefficient.u or not unstated:
        return ""
    if sum(line.share for line in unstated) < _MOST:
        return ""
    largest = max(unstated, key=lambda line: line.share)
    said = (
        f"{format_share(largest.share)} of u^2 of {symbol} comes from {in_words(largest.source)}, "
        f"which is not stated (typical {_size(largest, 1.0)})"
    )
    update = accelerometer.what_if
    if update is None or largest.source not in update.known:
        return f"{said}."
    known = KNOWN_BETTER * update.known[largest.source]
    unit, factor = field_unit(coefficient.unit)
    left = format_uncertainty(update.u(symbol, {largest.source: known}) * factor)
    return (
        f"{said}; stating or measuring it to {_size(largest, KNOWN_BETTER)} would leave "
        f"u = {left} {unit}."
    )


def label_of(source: str) -> str:
    """Return a term or source of uncertainty as a table names it: words and symbol."""
    words = description_of(source)
    return f"{words}, {source}" if words else source


def in_words(source: str) -> str:
    """Return a term or source of uncertainty as a sentence names it."""
    return f"the {label_of(source)}" if description_of(source) else source


def largest_part(accelerometer: HasAnswer, symbol: str = "K_II") -> str:
    """Return a sentence on the main source of the u of a coefficient; empty if not known."""
    lines = accelerometer.budget.get(symbol, [])
    if not lines:
        return ""
    largest = max(lines, key=lambda line: line.share)
    words = in_words(largest.source)
    return f"{format_share(largest.share)} of u^2 of {symbol} comes from {words}."


def _size(line: BudgetLine, part: float) -> str:
    unit, factor = field_unit(line.unit)
    return f"{format_number((line.u or 0.0) * factor * part, 2)} {unit}".strip()


def assumption(result: HasAssumptions) -> str:
    """Return a sentence on the terms assumed to be perfect; empty if there are none."""
    names = result.assumed
    if not names:
        return ""
    shown = ", ".join(names[:_MOST_NAMES])
    more = len(names) - _MOST_NAMES
    listed = f"{shown} and {more} more" if more > 0 else shown
    return f"Assumed perfect, so not included in u: {listed}."


def knowledge_blocks(result: Result) -> Iterator[Block]:
    """Yield what a result rests on beside its data, as far as it counts in any budget."""
    shares = _shares(result)
    rows = [row for row in result.rests_on if shares.get(row.name, 0.0) >= _LEAST_SHARE]
    if not rows and not result.assumed:
        return
    yield Heading("Prior information")
    if rows:
        rows.sort(key=lambda row: -shares[row.name])
        yield Paragraph(
            "Priors in the fit: as stated in the description, or by default 0 with the default "
            "standard uncertainty. The share is the largest share of u^2 among all coefficients.",
            "quiet",
        )
        yield Table(
            (
                Column("Term or input", wraps=True),
                Column("Meaning", wraps=True),
                Column("Known"),
                Column("Before", "right"),
                Column("With the data", "right"),
                Column("Largest share of u^2", "right"),
            ),
            tuple(_row(row, shares[row.name]) for row in rows),
        )
    if sentence := assumption(result):
        yield Paragraph(sentence)


def _shares(result: Result) -> dict[str, float]:
    """Return by name of a source the largest share that it has in the u^2 of any coefficient."""
    shares: dict[str, float] = {}
    for name, accelerometer in result.accelerometers.items():
        for line in (line for lines in accelerometer.budget.values() for line in lines):
            for source in (line.source, f"{name}.{line.source}"):
                shares[source] = max(shares.get(source, 0.0), line.share)
    return shares


def _row(row: Knowledge, share: float) -> tuple[str, ...]:
    unit, factor = field_unit(row.unit)
    after = "held"
    if row.found is not None and row.u_found is not None:
        after = format_estimate(row.found * factor, row.u_found * factor, unit)
    return (
        row.name,
        description_of(row.name),
        row.kind,
        format_estimate(row.value * factor, row.u * factor, unit),
        after,
        format_share(share),
    )
