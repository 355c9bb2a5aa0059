"""Text on the uncertainty: main source, possible reduction, prior information."""

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

#: Share of u^2 above which default priors dominate.
_DOMINANT_SHARE: Final = 0.5

#: Assumed ratio of a stated uncertainty to the default one.
IMPROVEMENT_FACTOR: Final = 0.1

#: Smallest share of any u^2 of a source in the table.
_MIN_SHARE: Final = 1e-3

#: Share below which lines of a budget are combined, and the largest number of separate small lines.
_MIN_LINE_SHARE: Final = 1e-4
_MAX_SMALL_LINES: Final = 3

#: Largest number of assumed terms in a list.
_MAX_LISTED_NAMES: Final = 8


class HasUncertainty(Protocol):
    """Uncertainty of a coefficient, estimated or forecast."""

    @property
    def u(self) -> float | None:
        """Standard uncertainty."""

    @property
    def unit(self) -> str:
        """Unit of `u`."""


class HasCoefficients(Protocol):
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


def split_budget(lines: Sequence[BudgetLine]) -> tuple[Sequence[BudgetLine], Sequence[BudgetLine]]:
    """Return the main lines and the small lines of a budget."""
    count = next((k for k, line in enumerate(lines) if line.share < _MIN_LINE_SHARE), len(lines))
    return (lines, ()) if len(lines) - count <= _MAX_SMALL_LINES else (lines[:count], lines[count:])


def default_prior_sentence(
    accelerometer: HasCoefficients, symbol: str = "K_II", label: str = ""
) -> str:
    """Return a sentence on the default prior that dominates the u of a coefficient, or "".

    label: Name of the coefficient in the sentence, if the symbol alone is ambiguous.
    """
    coefficient = accelerometer.coefficients.get(symbol)
    lines = accelerometer.budget.get(symbol, [])
    default_lines = [line for line in lines if line.kind == "unstated"]
    if coefficient is None or not coefficient.u or not default_lines:
        return ""
    if sum(line.share for line in default_lines) < _DOMINANT_SHARE:
        return ""
    largest_line = max(default_lines, key=lambda line: line.share)
    text = (
        f"{_contribution_sentence(largest_line, label or symbol)} No uncertainty was stated for "
        f"this term, so the default of {_format_source_u(largest_line, 1.0)} was used."
    )
    what_if = accelerometer.what_if
    if what_if is None or largest_line.source not in what_if.known:
        return text
    improved_u = IMPROVEMENT_FACTOR * what_if.known[largest_line.source]
    unit, factor = find_display_unit(coefficient.unit)
    u_text = format_uncertainty(what_if.u(symbol, {largest_line.source: improved_u}) * factor)
    subject = f"u({label})" if label else "u"
    return (
        f"{text} If {largest_line.source} were known to "
        f"{_format_source_u(largest_line, IMPROVEMENT_FACTOR)}, {subject} would fall to "
        f"{u_text} {unit}."
    )


def describe_kind(kind: str) -> str:
    """Return the name of a kind of source of uncertainty."""
    return {"unstated": "default", "held": "considered"}.get(kind, kind)


def source_label(source: str) -> str:
    """Return description and symbol of a term or source of uncertainty, for a table."""
    description = describe_term(source)
    return f"{description}, {source}" if description else source


def main_source_sentence(accelerometer: HasCoefficients, symbol: str = "K_II") -> str:
    """Return a sentence on the main source of the u of a coefficient; empty if not known."""
    lines = accelerometer.budget.get(symbol, [])
    if not lines:
        return ""
    largest_line = max(lines, key=lambda line: line.share)
    return _contribution_sentence(largest_line, symbol)


def _contribution_sentence(line: BudgetLine, symbol: str) -> str:
    """Return a sentence on the share of a source in the variance of a coefficient."""
    description = describe_term(line.source)
    source_text = (
        f"{line.source} ({description})"
        if description
        else line.source[:1].upper() + line.source[1:]
    )
    return f"{source_text} contributes {format_share(line.share)} of the variance of {symbol}."


def _format_source_u(line: BudgetLine, u_factor: float) -> str:
    unit, factor = find_display_unit(line.unit)
    return f"{format_number((line.u or 0.0) * factor * u_factor, 2)} {unit}".strip()


def assumption_sentence(result: HasAssumptions) -> str:
    """Return a sentence on the terms assumed to be perfect; empty if there are none."""
    names = result.assumed
    if not names:
        return ""
    shown_names = ", ".join(names[:_MAX_LISTED_NAMES])
    n_remaining = len(names) - _MAX_LISTED_NAMES
    name_list = f"{shown_names} and {n_remaining} more" if n_remaining > 0 else shown_names
    return (
        "u does not include the uncertainty of these terms, which are fixed at their nominal "
        f"values: {name_list}."
    )


def prior_blocks(result: Result) -> Iterator[Block]:
    """Yield the prior information that contributes to any budget of a result."""
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
    correlations_by_pair: dict[frozenset[str], float] = {}
    for name, accelerometer in result.accelerometers.items():
        all_correlations = accelerometer.prior_correlations
        for term, correlations in all_correlations.items():
            for other_term, r in correlations.items():
                full_name = f"{name}.{other_term}" if other_term in all_correlations else other_term
                correlations_by_pair[frozenset({f"{name}.{term}", full_name})] = r
    texts = [f"{' and '.join(sorted(pair))} {r:g}" for pair, r in correlations_by_pair.items()]
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
    posterior_text = "held (considered)"
    if row.found is not None and row.u_found is not None:
        posterior_text = format_estimate(row.found * factor, row.u_found * factor, unit)
    return (
        row.name,
        describe_term(row.name),
        describe_kind(row.kind),
        format_estimate(row.value * factor, row.u * factor, unit),
        posterior_text,
        format_share(share),
    )
