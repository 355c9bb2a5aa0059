"""Whether coefficients meet their specifications, as blocks of a report."""

from __future__ import annotations

from collections.abc import Iterator

from counterspin.calibration.pages.accelerometer import in_field_units
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient
from counterspin.inference.conformity import Conformity
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import (
    field_unit,
    format_estimate,
    format_number,
    format_probability,
    format_uncertainty,
)

_COLUMNS = (
    Column("Accelerometer"),
    Column("Term"),
    Column("Estimate"),
    Column("Tolerance"),
    Column("Unit"),
    Column("Verdict"),
    Column("Conforms with", "right", wraps=True),
    Column("Risk", "right"),
)


def conformity_blocks(result: Result) -> Iterator[Block]:
    """Yield the verdicts and their decision rules; nothing without a specification."""
    stated = [
        (name, symbol, verdict, accelerometer.coefficients.get(symbol))
        for name, accelerometer in result.accelerometers.items()
        for symbol, verdict in accelerometer.conformity.items()
    ]
    if not stated:
        return
    yield Heading("Conformity")
    yield Table(
        _COLUMNS,
        tuple(
            (
                name,
                symbol,
                _estimate(coefficient),
                _tolerance(verdict),
                field_unit(verdict.unit)[0],
                verdict.verdict,
                "-" if verdict.probability is None else format_probability(verdict.probability),
                "-" if verdict.risk is None else format_probability(verdict.risk),
            )
            for name, symbol, verdict, coefficient in stated
        ),
        quiet=frozenset(
            i for i, (_, _, verdict, _) in enumerate(stated) if verdict.probability is None
        ),
    )
    for name, symbol, verdict, _ in stated:
        if verdict.verdict == "fail":
            yield Paragraph(f"{symbol} of {name} does not meet its specification.", "warning")
        elif verdict.reason is not None:
            yield Paragraph(f"{symbol} of {name} is undecided: {verdict.reason}.", "warning")
    for words in dict.fromkeys(rule_in_words(verdict) for _, _, verdict, _ in stated):
        yield Paragraph(words, "quiet")
    bands = [
        f"{symbol} of {name} {_band(verdict)}"
        for name, symbol, verdict, _ in stated
        if verdict.guard_band
    ]
    if bands:
        yield Paragraph(f"Guard bands w: {'; '.join(bands)}.", "quiet")


def rule_in_words(verdict: Conformity) -> str:
    """Return the decision rule of a verdict, as a certificate must state it."""
    risk = "The risk is the probability that the verdict is wrong (JCGM 106:2012)."
    if verdict.rule == "simple":
        return f"Decision rule: simple acceptance, by the estimate alone. {risk}"
    if verdict.rule == "guarded":
        return (
            "Decision rule: guard bands. Pass if the estimate is inside the tolerance limits "
            "by at least w, fail if it is outside by more than w, otherwise undecided. "
            f"{risk}"
        )
    assert verdict.needed is not None
    needed = format_number(100.0 * verdict.needed, 6)
    return (
        f"Decision rule: pass if the coefficient conforms with a probability of at least "
        f"{needed} %, fail if it fails to conform with at least that probability, otherwise "
        f"undecided. {risk}"
    )


def _estimate(coefficient: Coefficient | None) -> str:
    if coefficient is None or not coefficient.estimated:
        return "-"
    value, u, _ = in_field_units(coefficient)
    return format_estimate(value, u)


def _tolerance(verdict: Conformity) -> str:
    """Return the tolerance limits in the unit in which the estimate is shown."""
    _, factor = field_unit(verdict.unit)
    low, high = (
        None if limit is None else format_number(limit * factor, 9)
        for limit in (verdict.low, verdict.high)
    )
    if low is None:
        return f"at most {high}"
    return f"at least {low}" if high is None else f"{low} to {high}"


def _band(verdict: Conformity) -> str:
    assert verdict.guard_band is not None
    unit, factor = field_unit(verdict.unit)
    return f"{format_uncertainty(verdict.guard_band * factor)} {unit}"
