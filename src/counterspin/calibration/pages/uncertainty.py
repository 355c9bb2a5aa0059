"""The one uncertainty in words: what dominates it, what would reduce it, what it rests on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, Protocol

from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Knowledge
from counterspin.inference.joint.summary import BudgetLine, WhatIf
from counterspin.physics.terms import describe_term
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import (
    find_display_unit,
    format_estimate,
    format_number,
    format_share,
    format_uncertainty,
)

#: Unstated sources that make up more than this part of u^2 decide it.
_DOMINANT_SHARE: Final = 0.5

#: How much better than its typical size something is taken to be known once it is stated.
IMPROVEMENT_FACTOR: Final = 0.1

#: Sources below this part of any u^2 are not in the table.
_MIN_SHARE: Final = 1e-3

#: Lines of a budget below this share are said together, where they are more than a few.
_MIN_LINE_SHARE: Final = 1e-4
_MAX_SMALL_LINES: Final = 3

#: So many names of what is assumed are listed.
_MAX_NAMES: Final = 8


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


def split_small_lines(
    lines: Sequence[BudgetLine],
) -> tuple[Sequence[BudgetLine], Sequence[BudgetLine]]:
    """Split a budget into the lines that make up u and the small lines."""
    count = next((k for k, line in enumerate(lines) if line.share < _MIN_LINE_SHARE), len(lines))
    return (lines, ()) if len(lines) - count <= _MAX_SMALL_LINES else (lines[:count], lines[count:])


def default_prior_sentence(accelerometer: HasAnswer, symbol: str = "K_II", label: str = "") -> str:
    """Return a sentence on the default prior that dominates the u of a coefficient, or "".

    label: Name of the coefficient in the sentence, if the symbol alone is ambiguous.
    """
    coefficient = accelerometer.coefficients.get(symbol)
    lines = accelerometer.budget.get(symbol, [])
    unstated = [line for line in lines if line.kind == "unstated"]
    if coefficient is None or not coefficient.u or not unstated:
        return ""
    if sum(line.share for line in unstated) < _DOMINANT_SHARE:
        return ""
    largest = max(unstated, key=lambda line: line.share)
    text = (
        f"{_contribution_sentence(largest, label or symbol)} No uncertainty was stated for this "
        f"term, so the default of {_format_source_u(largest, 1.0)} was used."
    )
    update = accelerometer.what_if
    if update is None or largest.source not in update.known:
        return text
    improved_u = IMPROVEMENT_FACTOR * update.known[largest.source]
    unit, factor = find_display_unit(coefficient.unit)
    remaining_u = format_uncertainty(update.u(symbol, {largest.source: improved_u}) * factor)
    subject = f"u({label})" if label else "u"
    return (
        f"{text} If {largest.source} were known to "
        f"{_format_source_u(largest, IMPROVEMENT_FACTOR)}, {subject} would fall to {remaining_u} "
        f"{unit}."
    )


def kind_words(kind: str) -> str:
    """Return the kind of a source of uncertainty in words."""
    return {"unstated": "default", "held": "considered"}.get(kind, kind)


def source_label(source: str) -> str:
    """Return description and symbol of a term or source of uncertainty, for a table."""
    words = describe_term(source)
    return f"{words}, {source}" if words else source


def main_source_sentence(accelerometer: HasAnswer, symbol: str = "K_II") -> str:
    """Return a sentence on the main source of the u of a coefficient; empty if not known."""
    lines = accelerometer.budget.get(symbol, [])
    if not lines:
        return ""
    largest = max(lines, key=lambda line: line.share)
    return _contribution_sentence(largest, symbol)


def _contribution_sentence(line: BudgetLine, symbol: str) -> str:
    """Return a sentence on the share of a source in the variance of a coefficient."""
    words = describe_term(line.source)
    source = f"{line.source} ({words})" if words else line.source[:1].upper() + line.source[1:]
    return f"{source} contributes {format_share(line.share)} of the variance of {symbol}."


def _format_source_u(line: BudgetLine, factor_of_u: float) -> str:
    unit, factor = find_display_unit(line.unit)
    return f"{format_number((line.u or 0.0) * factor * factor_of_u, 2)} {unit}".strip()


def assumption_sentence(result: HasAssumptions) -> str:
    """Return a sentence on the terms assumed to be perfect; empty if there are none."""
    names = result.assumed
    if not names:
        return ""
    first_names = ", ".join(names[:_MAX_NAMES])
    remaining_count = len(names) - _MAX_NAMES
    name_list = f"{first_names} and {remaining_count} more" if remaining_count > 0 else first_names
    return (
        "u does not include the uncertainty of these terms, which are fixed at their nominal "
        f"values: {name_list}."
    )


def prior_blocks(result: Result) -> Iterator[Block]:
    """Yield the prior information of a result, as far as it counts in any budget."""
    shares = _largest_shares(result)
    rows = [row for row in result.rests_on if shares.get(row.name, 0.0) >= _MIN_SHARE]
    if not rows and not result.assumed:
        return
    yield Heading("Prior information")
    if rows:
        rows.sort(key=lambda row: -shares[row.name])
        yield Paragraph(
            "The fit uses priors as stated in the description. For terms without a stated "
            "prior, the prior is the nominal value with the default standard uncertainty. The last "
            "column gives the largest share of u^2 among all coefficients.",
            "quiet",
        )
        yield Table(
            (
                Column("Term or input", wraps=True),
                Column("Meaning", wraps=True),
                Column("Source of the prior"),
                Column("Prior", "right"),
                Column("Posterior", "right"),
                Column("Largest share of u^2", "right"),
            ),
            tuple(_prior_row(row, shares[row.name]) for row in rows),
        )
    if sentence := _correlation_sentence(result):
        yield Paragraph(sentence)
    if sentence := assumption_sentence(result):
        yield Paragraph(sentence)


def _correlation_sentence(result: Result) -> str:
    """Return a sentence on the stated correlations between priors; empty without any."""
    pairs: dict[frozenset[str], float] = {}
    for name, accelerometer in result.accelerometers.items():
        all_correlations = accelerometer.prior_correlations
        for term, correlations in all_correlations.items():
            for partner, r in correlations.items():
                full_name = f"{name}.{partner}" if partner in all_correlations else partner
                pairs[frozenset({f"{name}.{term}", full_name})] = r
    texts = [f"{' and '.join(sorted(pair))} {r:g}" for pair, r in pairs.items()]
    return f"Stated correlations between priors: {', '.join(texts)}." if texts else ""


def _largest_shares(result: Result) -> dict[str, float]:
    """Return the largest share of each source in the u^2 of any coefficient."""
    shares: dict[str, float] = {}
    for name, accelerometer in result.accelerometers.items():
        for line in (line for lines in accelerometer.budget.values() for line in lines):
            for source in (line.source, f"{name}.{line.source}"):
                shares[source] = max(shares.get(source, 0.0), line.share)
    return shares


def _prior_row(row: Knowledge, share: float) -> tuple[str, ...]:
    unit, factor = find_display_unit(row.unit)
    posterior = "held (considered)"
    if row.found is not None and row.u_found is not None:
        posterior = format_estimate(row.found * factor, row.u_found * factor, unit)
    return (
        row.name,
        describe_term(row.name),
        kind_words(row.kind),
        format_estimate(row.value * factor, row.u * factor, unit),
        posterior,
        format_share(share),
    )
