"""Uncertainty budget of a coefficient, with the columns of GUM table H.1."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from counterspin.calibration.pages.uncertainty import split_budget
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult
from counterspin.inference.joint.summary import BudgetLine
from counterspin.physics.terms import describe_term
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import (
    find_display_unit,
    format_interval,
    format_number,
    format_share,
    format_uncertainty,
    round_to_uncertainty,
)

#: Kind of a source -> type of its evaluation (GUM 3.3.4). Noise is of type A if it is estimated
#: from the records, else of type B.
_EVALUATION_TYPES: Final = {"stated": "B", "unstated": "B, default", "held": "B, considered"}


#: Ratio to the tolerance below which a difference is not given as a number.
_NEGLIGIBLE_RATIO: Final = 0.01


def budget_blocks(name: str, result: Result) -> Iterator[Block]:
    """Yield a table for each coefficient of an accelerometer that has a budget, K_II first."""
    budgets = result.accelerometers[name].budget
    for symbol in sorted(budgets, key=lambda symbol: symbol != "K_II"):
        yield Heading(f"Uncertainty budget of {symbol}, {name}", 3)
        yield budget_table(name, symbol, result, *split_budget(budgets[symbol]))


def interval_blocks(name: str, result: Result) -> Iterator[Block]:
    """Yield the GUM and Monte Carlo coverage intervals of an accelerometer, if available."""
    outcomes = {True: "validated", False: "not validated", None: "too few trials"}
    rows, n_trials = [], 0
    accelerometer = result.accelerometers[name]
    for symbol, monte_carlo in accelerometer.monte_carlo.items():
        coefficient = accelerometer.coefficients[symbol]
        if coefficient.value is None or coefficient.u is None:
            continue
        unit, factor = find_display_unit(coefficient.unit)
        u, n_trials = coefficient.u * factor, monte_carlo.trials
        intervals = (coefficient.interval(), (monte_carlo.low, monte_carlo.high))
        gum_text, shortest_text = (
            format_interval(0.5 * (low + high) * factor, u, 0.5 * (high - low) * factor)
            for low, high in intervals
        )
        rows.append((symbol, gum_text, shortest_text, unit, outcomes[monte_carlo.gum_validated]))
    if rows:
        yield Heading(f"95 % coverage intervals of {name}, {n_trials} trials (JCGM 101)", 3)
        yield Table(
            columns=(
                Column("Coefficient"),
                Column("GUM", "right"),
                Column("Monte Carlo, shortest", "right"),
                Column("Unit"),
                Column("GUM interval"),
            ),
            rows=tuple(rows),
        )
        if sentence := _linearity_sentence(accelerometer):
            yield Paragraph(sentence, "quiet")


def _linearity_sentence(accelerometer: AccelerometerResult) -> str:
    """Return a sentence on the test of the linear sensitivities; empty without a test."""
    ratios = {
        symbol: (interval.linear_difference or 0.0) / interval.tolerance
        for symbol, interval in accelerometer.monte_carlo.items()
        if interval.linear_difference is not None
    }
    if not ratios:
        return ""
    worst_symbol = max(ratios, key=lambda symbol: ratios[symbol])
    ratio_text = format_number(ratios[worst_symbol], 2)
    amount_text = f"at most {ratio_text} times the numerical tolerance ({worst_symbol})"
    if ratios[worst_symbol] < _NEGLIGIBLE_RATIO:
        amount_text = f"less than {_NEGLIGIBLE_RATIO:g} times the numerical tolerance"
    text = (
        f"Full fits with each source shifted by ±2 u differ from the linear prediction by "
        f"{amount_text}."
    )
    second_order_texts = [
        f"{symbol} ({', '.join(interval.second_order)})"
        for symbol, interval in accelerometer.monte_carlo.items()
        if interval.second_order
    ]
    sensitivities = "linear sensitivities"
    if second_order_texts:
        sensitivities = f"second-order sensitivities for {', '.join(second_order_texts)}"
    text += f" Monte Carlo trials use {sensitivities}."
    failed_symbols = [
        symbol
        for symbol, interval in accelerometer.monte_carlo.items()
        if (interval.joint_difference or 0.0) > interval.tolerance
    ]
    if failed_symbols:
        text += (
            " With all sources shifted together, full fits still differ from the prediction by "
            f"more than the numerical tolerance for {', '.join(failed_symbols)}. The intervals "
            "for these coefficients are therefore approximate. State smaller uncertainties."
        )
    return text


def budget_table(
    name: str,
    symbol: str,
    result: Result,
    shown_lines: Sequence[BudgetLine],
    small_lines: Sequence[BudgetLine],
) -> Table:
    """Return the budget of a coefficient as a table without empty columns.

    name: Name of the accelerometer.
    shown_lines, small_lines: Lines with separate rows, and lines in a common row.
    """
    accelerometer = result.accelerometers[name]
    coefficient = accelerometer.coefficients.get(symbol)
    unit, factor = find_display_unit(coefficient.unit if coefficient else "")
    values = prior_values(name, result)
    rows: list[tuple[str, ...]] = [
        (
            line.source,
            describe_term(line.source),
            evaluation_type(line, accelerometer),
            *_prior_cells(line, values.get(line.source)),
            _sensitivity_cell(line, factor),
            format_uncertainty(line.contribution * factor),
            format_share(line.share),
        )
        for line in shown_lines
    ]
    if small_lines:
        remaining_u = math.hypot(*(line.contribution for line in small_lines))
        share_text = format_share(sum(line.share for line in small_lines))
        rows.append(
            (
                f"{len(small_lines)} more",
                *[""] * 5,
                format_uncertainty(remaining_u * factor),
                share_text,
            )
        )
    combined_u = math.hypot(*(line.contribution for line in (*shown_lines, *small_lines)))
    rows.append(("combined", *[""] * 5, format_uncertainty(combined_u * factor), ""))
    return Table(
        columns=(
            Column("Source", wraps=True),
            Column("Meaning", wraps=True),
            Column("Type"),
            Column("Value", "right"),
            Column("Std. uncertainty", "right", wraps=True),
            Column(f"Sensitivity, {unit} per unit", "right", wraps=True),
            Column(f"Contribution, {unit}", "right", wraps=True),
            Column("Share of u^2", "right", wraps=True),
        ),
        rows=tuple(rows),
    ).without_empty_columns()


def prior_values(name: str, result: Result) -> Mapping[str, float]:
    """Return the prior values of terms and inputs, by source as in a budget of `name`.

    A result does not contain the priors of estimated coefficients.
    """
    priors = {row.name.removeprefix(f"{name}."): row.value for row in result.rests_on}
    coefficients = result.accelerometers[name].coefficients.items()
    fixed_values = {
        symbol: coefficient.value
        for symbol, coefficient in coefficients
        if not coefficient.estimated and coefficient.value is not None
    }
    return fixed_values | priors


def evaluation_type(line: BudgetLine, accelerometer: AccelerometerResult) -> str:
    """Return the type of evaluation of a source (GUM 3.3.4), A or B."""
    if line.kind != "noise":
        return _EVALUATION_TYPES[line.kind]
    return "A" if any(line.estimated for line in accelerometer.noise.values()) else "B"


def _prior_cells(line: BudgetLine, value: float | None) -> tuple[str, str]:
    """Return the cells of a source's value and standard uncertainty, with their unit."""
    if line.u is None:
        return "", ""
    unit, factor = find_display_unit(line.unit)
    u_text = f"{format_number(line.u * factor, 2)} {unit}"
    if not value:
        return "" if value is None else f"0 {unit}", u_text
    rounded_estimate = round_to_uncertainty(value * factor, line.u * factor)
    if rounded_estimate is None or rounded_estimate.exponent:
        return f"{format_number(value * factor, 9)} {unit}", u_text
    return f"{rounded_estimate.value} {unit}", u_text


def _sensitivity_cell(line: BudgetLine, factor: float) -> str:
    if line.sensitivity is None:
        return ""
    return format_number(line.sensitivity * factor / find_display_unit(line.unit)[1])
