"""Card of one accelerometer: value, interval, shares of the variance, quality checks."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Sequence
from typing import Final

from counterspin.calibration.findings import methods_agree, supporting_evidence
from counterspin.calibration.pages.accelerometer import to_field_units
from counterspin.calibration.pages.uncertainty import default_prior_sentence, main_source_sentence
from counterspin.calibration.pages.verdict import finding_text
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient, State
from counterspin.inference.distributions import MIN_INTERVAL_DOF, expanded_uncertainty
from counterspin.inference.joint.summary import BudgetLine
from counterspin.physics.terms import describe_term
from counterspin.reports.blocks import Card, Check, Paragraph, Share
from counterspin.reports.numbers import (
    find_display_unit,
    format_estimate,
    format_interval,
    format_number,
    format_share,
    format_uncertainty,
)
from counterspin.reports.typography import SYMBOL

#: State of a result -> text.
STATE_NAMES: Final[dict[State, str]] = {
    "good": "Good",
    "reservations": "With reservations",
    "not-determined": "Not determined",
    "contradicted": "Contradicted",
}

#: Text in place of an interval.
NO_INTERVAL: Final = "no 95 % interval: less than one degree of freedom remains"

#: Positive and negative directions of the east-north-up axes.
_DIRECTIONS: Final = (("east", "west"), ("north", "south"), ("up", "down"))

#: Largest number of named shares of u^2 in a bar, and the smallest named share.
_MAX_SHARES: Final = 4
_MIN_SHARE: Final = 0.005


def accelerometer_card(
    name: str, accelerometer: AccelerometerResult, paragraphs: Sequence[Paragraph]
) -> Card | None:
    """Return the card of a judged accelerometer: of K_II, or of the first requested coefficient.

    None without a coefficient.

    paragraphs: The same content as text.
    """
    coefficients = accelerometer.coefficients
    if not coefficients or accelerometer.state is None:
        return None
    symbol = main_symbol(coefficients)
    coefficient = coefficients[symbol]
    value, u, unit = to_field_units(coefficient)
    is_determined = coefficient.estimated and value is not None and u is not None
    return Card(
        title=name,
        detail=_describe_orientation(accelerometer),
        state=accelerometer.state,
        state_text=STATE_NAMES[accelerometer.state],
        symbol=symbol,
        value=format_estimate(value, u) if is_determined else "",
        unit=unit,
        remarks=tuple(_interval_remarks(coefficient, accelerometer.state)) if is_determined else (),
        shares=tuple(_variance_shares(accelerometer.budget.get(symbol, ())))
        if is_determined
        else (),
        note=_card_note(accelerometer, symbol),
        checks=tuple(_quality_checks(accelerometer)),
        paragraphs=tuple(paragraphs),
    )


def main_symbol(coefficients: Collection[str]) -> str:
    """Return K_II if it was requested, otherwise the first requested coefficient."""
    return "K_II" if "K_II" in coefficients else next(iter(coefficients))


def _describe_orientation(accelerometer: AccelerometerResult) -> str:
    """Return the stated serial number and directions of the input and pendulous axes."""
    texts = [f"serial number {accelerometer.serial_number}"] if accelerometer.serial_number else []
    for axis, vector in zip(("input", "pendulous"), accelerometer.axes or (), strict=False):
        if direction := _describe_direction(vector):
            texts.append(f"{axis} axis {direction}")
    return ", ".join(texts)


def _describe_direction(vector: tuple[float, float, float]) -> str:
    """Return the name of a direction along an axis; empty for other directions."""
    index = max(range(3), key=lambda k: abs(vector[k]))
    if abs(vector[index]) < 1.0 - 1e-9:
        return ""
    return _DIRECTIONS[index][vector[index] < 0.0]


def _interval_remarks(coefficient: Coefficient, state: State) -> Iterator[str]:
    """Yield interval and expanded uncertainty; a contradicted value has neither."""
    value, u, unit = to_field_units(coefficient)
    if state == "contradicted" or value is None or not u:
        return
    if unit != coefficient.unit:
        yield f"= {format_estimate(coefficient.value, coefficient.u, coefficient.unit)}"
    if coefficient.dof is not None and coefficient.dof < MIN_INTERVAL_DOF:
        yield NO_INTERVAL
        return
    expanded_u = expanded_uncertainty(u, coefficient.dof)
    yield f"95 % interval: {format_interval(value, u, expanded_u, unit)}"
    yield f"U = {format_uncertainty(expanded_u)} {unit}, k = {format_number(expanded_u / u, 3)}"


def _variance_shares(budget: Sequence[BudgetLine]) -> Iterator[Share]:
    lines = sorted(budget, key=lambda line: -line.share)
    shown_lines = [line for line in lines[:_MAX_SHARES] if line.share >= _MIN_SHARE]
    for line in shown_lines:
        label = f"{_short_name(line.source)} {format_share(line.share)}"
        yield Share(label, line.share, line.kind == "unstated")
    remaining_share = max(1.0 - math.fsum(line.share for line in shown_lines), 0.0)
    if shown_lines and remaining_share > 0.0:
        yield Share(f"others {format_share(remaining_share)}", remaining_share)


def _short_name(source: str) -> str:
    """Return the symbol of a source if it is printable, else its description."""
    return source if re.fullmatch(SYMBOL, source) else describe_term(source) or source


def _card_note(accelerometer: AccelerometerResult, symbol: str) -> str:
    if accelerometer.findings:
        n_remaining = len(accelerometer.findings) - 1
        text = finding_text(accelerometer.findings[0])
        return f"{text} (More findings below: {n_remaining}.)" if n_remaining else text
    return default_prior_sentence(accelerometer, symbol) or main_source_sentence(
        accelerometer, symbol
    )


def _quality_checks(accelerometer: AccelerometerResult) -> Iterator[Check]:
    """Yield the checks of the fit, of the runs and of the two-stage method."""
    evidence = dict(supporting_evidence(accelerometer))
    p = accelerometer.residual.lack_of_fit_p
    yield _make_check(
        "Fit",
        evidence.get("fit"),
        None
        if p is None
        else f"the residuals are not consistent with noise (p = {format_number(p, 2)})",
    )
    tested_lines = [line for line in accelerometer.jackknife if line.z is not None]
    largest_shift = max(tested_lines, key=lambda line: abs(line.z or 0.0), default=None)
    shift_clause = None
    if largest_shift is not None:
        shift_text = format_number(abs(largest_shift.z or 0.0), 2)
        shift_clause = (
            f"the largest shift, {shift_text} times its standard uncertainty, results from "
            f"omitting {largest_shift.run}"
        )
    clause = evidence.get("leave-one-run-out")
    yield _make_check("Runs", f"{clause}; {shift_clause}" if clause else None, shift_clause)
    yield _make_check("Method", *_compare_methods(accelerometer))


def _make_check(title: str, passed_text: str | None, failed_text: str | None) -> Check:
    if passed_text is not None:
        return Check(title, "passed", passed_text)
    return (
        Check(title, "open", "not checked")
        if failed_text is None
        else Check(title, "failed", failed_text)
    )


def _compare_methods(accelerometer: AccelerometerResult) -> tuple[str | None, str | None]:
    """Return the comparison with the two-stage method as a passed and as a failed check."""
    comparison, coefficient = accelerometer.two_stage, accelerometer.coefficients.get("K_II")
    if comparison is None or coefficient is None:
        return None, None
    unit, factor = find_display_unit(coefficient.unit)
    value_text = format_estimate(comparison.value * factor, comparison.u * factor, unit)
    difference_text = f"z = {format_number(abs(comparison.z), 2)}"
    if methods_agree(comparison):
        return (
            f"the two-stage result agrees with the joint result: {value_text}, {difference_text}",
            None,
        )
    return (
        None,
        f"the two-stage result does not agree with the joint result: {value_text}, "
        f"{difference_text}",
    )
