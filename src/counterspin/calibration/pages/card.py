"""The answer on one accelerometer at a glance: value, interval, parts of u, quality checks."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import Final

from counterspin.calibration.findings import methods_agree, supporting_evidence
from counterspin.calibration.pages.accelerometer import in_field_units
from counterspin.calibration.pages.uncertainty import dominance, largest_part
from counterspin.calibration.pages.verdict import finding_text
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient, State
from counterspin.inference.distributions import expanded_uncertainty
from counterspin.inference.joint.summary import BudgetLine
from counterspin.physics.terms import description_of
from counterspin.reports.blocks import Card, Check, Paragraph, Share
from counterspin.reports.numbers import (
    field_unit,
    format_estimate,
    format_interval,
    format_number,
    format_share,
    format_uncertainty,
)
from counterspin.reports.typography import SYMBOL

#: States of a result in words.
STATE_WORDS: Final[dict[State, str]] = {
    "good": "Good",
    "reservations": "With reservations",
    "not-determined": "Not determined",
    "contradicted": "Contradicted",
}

#: East-north-up, and the opposite directions.
_DIRECTIONS: Final = (("east", "west"), ("north", "south"), ("up", "down"))

#: Parts of u^2 that a bar shows by name; smaller ones are shown together.
_SHOWN_PARTS: Final = 4
_SMALLEST_PART: Final = 0.005


def accelerometer_card(
    name: str, accelerometer: AccelerometerResult, paragraphs: Sequence[Paragraph]
) -> Card | None:
    """Return the card of a judged accelerometer: of K_II, or of the first requested coefficient.

    None without a coefficient.

    paragraphs: The same in text.
    """
    coefficients = accelerometer.coefficients
    if not coefficients or accelerometer.state is None:
        return None
    symbol = "K_II" if "K_II" in coefficients else next(iter(coefficients))
    coefficient = coefficients[symbol]
    value, u, unit = in_field_units(coefficient)
    determined = coefficient.estimated and value is not None and u is not None
    return Card(
        title=name,
        detail=_orientation(accelerometer),
        state=accelerometer.state,
        state_words=STATE_WORDS[accelerometer.state],
        symbol=symbol,
        value=format_estimate(value, u) if determined else "",
        unit=unit,
        remarks=tuple(_remarks(coefficient, accelerometer.state)) if determined else (),
        shares=tuple(_shares(accelerometer.budget.get(symbol, ()))) if determined else (),
        note=_note(accelerometer, symbol),
        checks=tuple(_checks(accelerometer)),
        paragraphs=tuple(paragraphs),
    )


def _orientation(accelerometer: AccelerometerResult) -> str:
    """Return serial number and directions of the input and pendulous axes, as far as stated."""
    parts = [f"serial number {accelerometer.serial_number}"] if accelerometer.serial_number else []
    for axis, vector in zip(("input", "pendulous"), accelerometer.axes or (), strict=False):
        if direction := _direction(vector):
            parts.append(f"{axis} axis {direction}")
    return ", ".join(parts)


def _direction(vector: tuple[float, float, float]) -> str:
    """Return the name of a main direction; empty for any other."""
    largest = max(range(3), key=lambda k: abs(vector[k]))
    if abs(vector[largest]) < 1.0 - 1e-9:
        return ""
    return _DIRECTIONS[largest][vector[largest] < 0.0]


def _remarks(coefficient: Coefficient, state: State) -> Iterator[str]:
    """Yield interval and expanded uncertainty; a contradicted value has neither."""
    value, u, unit = in_field_units(coefficient)
    if state == "contradicted" or value is None or not u:
        return
    if unit != coefficient.unit:
        yield f"= {format_estimate(coefficient.value, coefficient.u, coefficient.unit)}"
    half = expanded_uncertainty(u, coefficient.dof)
    yield f"95 % interval: {format_interval(value, u, half, unit)}"
    yield f"U = {format_uncertainty(half)} {unit}, k = {format_number(half / u, 3)}"


def _shares(budget: Sequence[BudgetLine]) -> Iterator[Share]:
    lines = sorted(budget, key=lambda line: -line.share)
    shown = [line for line in lines[:_SHOWN_PARTS] if line.share >= _SMALLEST_PART]
    for line in shown:
        label = f"{_short_name(line.source)} {format_share(line.share)}"
        yield Share(label, line.share, line.kind == "unstated")
    rest = max(1.0 - math.fsum(line.share for line in shown), 0.0)
    if shown and rest > 0.0:
        yield Share(f"others {format_share(rest)}", rest)


def _short_name(source: str) -> str:
    """Return the printed symbol of a source, or else its meaning."""
    return source if re.fullmatch(SYMBOL, source) else description_of(source) or source


def _note(accelerometer: AccelerometerResult, symbol: str) -> str:
    if accelerometer.findings:
        more = len(accelerometer.findings) - 1
        text = finding_text(accelerometer.findings[0])
        return f"{text} ({more} more below.)" if more else text
    return dominance(accelerometer, symbol) or largest_part(accelerometer, symbol)


def _checks(accelerometer: AccelerometerResult) -> Iterator[Check]:
    """Yield whether the residuals fit, no run drives the result and another method agrees."""
    passed = dict(supporting_evidence(accelerometer))
    p = accelerometer.residual.lack_of_fit_p
    yield _check(
        "Fit",
        passed.get("fit"),
        None if p is None else f"the residuals do not look like noise (p = {format_number(p, 2)})",
    )
    moved = [line for line in accelerometer.jackknife if line.z is not None]
    largest = max(moved, key=lambda line: abs(line.z or 0.0), default=None)
    shift = None
    if largest is not None:
        size = format_number(abs(largest.z or 0.0), 2)
        shift = f"largest shift, without {largest.run}: {size} times its standard uncertainty"
    clause = passed.get("each run left out")
    yield _check("Runs", f"{clause}; {shift}" if clause else None, shift)
    yield _check("Method", *_of_methods(accelerometer))


def _check(title: str, passed: str | None, failed: str | None) -> Check:
    if passed is not None:
        return Check(title, "passed", passed)
    return Check(title, "open", "not checked") if failed is None else Check(title, "failed", failed)


def _of_methods(accelerometer: AccelerometerResult) -> tuple[str | None, str | None]:
    """Return the comparison with the two-stage method as a passed and as a failed check."""
    compared, coefficient = accelerometer.two_stage, accelerometer.coefficients.get("K_II")
    if compared is None or coefficient is None:
        return None, None
    unit, factor = field_unit(coefficient.unit)
    value = format_estimate(compared.value * factor, compared.u * factor, unit)
    difference = f"difference {format_number(abs(compared.z), 2)} times its standard uncertainty"
    if methods_agree(compared):
        return f"two-stage method agrees: {value}, {difference}", None
    return None, f"two-stage method disagrees: {value}, {difference}"
