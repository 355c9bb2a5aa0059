"""Printed report of a plan: runs to make, expected uncertainties, active limits."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

from counterspin.calibration.pages.accelerometer import confounding_text
from counterspin.calibration.pages.uncertainty import assumption_sentence, default_prior_sentence
from counterspin.inference.joint.summary import BudgetLine
from counterspin.inference.joint.unknowns import unit_of
from counterspin.physics.terms import SHARED_TERMS, TERMS, describe_term, find_symbol
from counterspin.planning.faults import Requirement
from counterspin.planning.result import (
    GoalResult,
    PlannedAccelerometer,
    PlanResult,
    PredictedCoefficient,
)
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import NOT_DETERMINED, field_unit, format_number, format_share

_LINES: Final = 6  #: of a budget
#: A bound that would allow a reduction by more than these per cent is not informative.
_EMPTY_BOUND: Final = 90.0

#: Deviations above which a fit that estimates a fault nearly always finds it (5 % each way).
_DETECTION_DEVIATIONS: Final = 4.0

#: Descriptions of changes to limits that are not sizes.
_CHANGES: Final = {"senses": "both senses of rotation", "fewest_rates": "reduced by one"}


def plan_blocks(result: PlanResult) -> list[Block]:
    """Return a plan or a forecast as blocks, the answer first."""
    blocks: list[Block] = [Heading(result.title, 1), *_summary_blocks(result)]
    blocks += [Paragraph(f"Warning: {text}", "warning") for text in result.warnings]
    blocks += _run_blocks(result) if result.runs else []
    blocks += _reading_blocks(result) if result.readings else []
    for name, accelerometer in result.accelerometers.items():
        blocks += _accelerometer_blocks(result, name, accelerometer)
    blocks += _limit_blocks(result)
    blocks += _comparison_blocks(result)
    blocks += _requirement_blocks(result)
    return blocks


def _summary_blocks(result: PlanResult) -> Iterator[Block]:
    goal = result.goal
    sought = goal.sizes if goal else {_main_coefficient(result): 1.0}
    parts, dominated = [], []
    for name in sought:
        owner, _, symbol = name.partition(".")
        predicted = (
            result.accelerometers[owner].coefficients[symbol]
            if owner in result.accelerometers
            else result.platform[name]
        )
        parts.append(f"u({_spoken_name(name)}) = {_format_u(predicted)}")
        if owner in result.accelerometers:
            dominated.append(default_prior_sentence(result.accelerometers[owner], symbol))
    amounts = [
        f"{count} {word}{'s' * (count > 1)}"
        for count, word in ((len(result.runs), "run"), (len(result.readings), "reading"))
        if count
    ]
    amounts += [_format_time(result.total_time)] if result.total_time > 0.0 else []
    yield Paragraph(f"{'; '.join(parts)}: {', '.join(amounts)}.", "answer")
    for sentence in (*dominated, assumption_sentence(result)):
        if sentence:
            yield Paragraph(sentence)
    if goal is not None:
        yield Paragraph(_optimality(goal, result.total_time > 0.0))
    gravity = format_number(result.gravity, 9)
    yield Paragraph(
        "All values are standard uncertainties (k = 1) expected from a joint calibration, "
        f"expressed in units of the local gravity, g = {gravity} m/s^2.",
        "quiet",
    )


def _optimality(goal: GoalResult, timed: bool) -> str:
    if goal.efficiency is None:
        return (
            "Another plan may be better by an unknown amount, because no theorem gives a bound for "
            "noisy time stamps."
        )
    gain = 100.0 * (1.0 - goal.efficiency)
    if gain > _EMPTY_BOUND:
        return (
            f"Another plan may be better, but by no more than {format_number(gain, 2)} %, which is "
            "the bound for all plans."
        )
    if gain < 0.05:
        return "No plan within these limits is more than 0.05 % better."
    by = f"more than {format_number(gain, 2)} %"
    if goal.kind == "minimise":
        quantity = (
            "uncertainty"
            if goal.criterion == "sum"
            else ("mean uncertainty (geometric mean from the covariance determinant)")
        )
        return f"No plan within these limits can reduce the {quantity} by {by}."
    if timed:
        return f"No plan within these limits can be {by} shorter."
    return f"No plan within these limits needs {by} fewer readings."


def _run_blocks(result: PlanResult) -> Iterator[Block]:
    is_scheduled = all(run.start is not None for run in result.runs)
    several = len({run.attitude for run in result.runs}) > 1
    yield Heading("Runs in time order" if is_scheduled else "Runs")
    columns = [
        Column("Run"),
        Column("Rate, rad/s", "right"),
        Column("g", "right"),
        Column("Revolutions", "right"),
        Column("Record, s", "right"),
    ]
    columns += [Column("Start time, s", "right")] * is_scheduled
    columns += [Column("Attitude", wraps=True)] * several
    rows = []
    for run in result.runs:
        row = [
            run.name,
            format_number(run.rate, 6),
            format_number(run.specific_force, 4),
            format_number(run.revolutions, 5),
            format_number(run.duration, 6),
        ]
        row += [format_number(run.start, 6)] if run.start is not None and is_scheduled else []
        row += [run.attitude] * several
        rows.append(tuple(row))
    yield Table(tuple(columns), tuple(rows))
    if not several:
        yield Paragraph(f"Attitude: {result.runs[0].attitude}.")


def _reading_blocks(result: PlanResult) -> Iterator[Block]:
    """Show the readings: one of several at a place with the number of them."""
    yield Heading("Readings")
    places: dict[tuple[str, ...], int] = {}
    several = len(result.accelerometers) > 1
    for reading in result.readings:
        row: tuple[str, ...] = (
            reading.motion,
            reading.mounting or "-",
            format_number(reading.rate, 6) if reading.rate else "-",
            format_number(reading.specific_force, 4) if reading.rate else "-",
            reading.axes,
            format_number(1e6 * reading.u, 3),
        )
        row = (reading.accelerometer, *row) if several else row
        places[row] = places.get(row, 0) + 1
    columns = [
        Column("Motion"),
        Column("Mounting"),
        Column("Rate, rad/s", "right"),
        Column("g", "right"),
        Column("Input, pendulous axis", wraps=True),
        Column("u, ug", "right"),
        Column("Number", "right"),
    ]
    yield Table(
        ((Column("Accelerometer"),) if several else ()) + tuple(columns),
        tuple((*row, str(count)) for row, count in places.items()),
    )
    words = {
        "mirrored": "in mirrored order, so that a linear drift cancels",
        "random": "in random order, so that a drift acts as noise",
        "listed": "in the order of the stations",
    }
    if result.order:
        yield Paragraph(f"The planned campaign lists the readings {words[result.order]}.")


def _accelerometer_blocks(
    result: PlanResult, name: str, accelerometer: PlannedAccelerometer
) -> Iterator[Block]:
    yield Heading(f"Expected uncertainties for {name}")
    rows, quiet = [], set()
    displayed = dict(accelerometer.coefficients) | result.platform
    for index, (symbol, predicted) in enumerate(displayed.items()):
        rows.append(
            (symbol, _format_u(predicted), _format_prior(predicted), _dominant_source(predicted))
        )
        if not predicted.estimated:
            quiet.add(index)
    yield Table(
        (
            Column("Coefficient"),
            Column("u"),
            Column("u (prior)"),
            Column("Sources", wraps=True),
        ),
        tuple(rows),
        frozenset(quiet),
    )
    for item in accelerometer.confounded:
        yield Paragraph(
            f"{confounding_text(item)} with this plan. The plan determines only "
            f"{item.determined}. {_separation_advice(result, item.terms)}"
        )
    targets = result.goal.sizes if result.goal else {_main_coefficient(result): 1.0}
    for symbol, lines in accelerometer.budget.items():
        if f"{name}.{symbol}" in targets:
            yield from _budget_blocks(result, name, symbol, lines)
    yield from _fault_blocks(result, name, accelerometer)


def _separation_advice(result: PlanResult, terms: Sequence[str]) -> str:
    """Return advice to separate terms: the other sense, other rates, another attitude."""
    rates = [run.rate for run in result.runs]
    if not rates:
        return "To separate these terms, add other stations, or state a value for one of the terms."
    platform = [SHARED_TERMS[symbol] for symbol in terms if symbol in SHARED_TERMS]
    rows = [TERMS[symbol] for symbol in terms if symbol in TERMS]
    if (
        rows
        and min(rates) * max(rates) > 0.0
        and any(
            row.symbol.startswith(("platform.drift.", "platform.g_sensitivity."))
            for row in platform
        )
    ):
        # Drift and g-sensitivity change their sign with the sense, the accelerometer's do not.
        return "To separate these terms, add runs in the opposite sense of rotation."
    one_rate = max(map(abs, rates)) < 1.001 * min(map(abs, rates))
    if one_rate and len({len(row.effect.factors) for row in rows}) > 1:
        return "To separate these terms, add runs at other rates."
    if not platform and len({run.attitude for run in result.runs}) == 1:
        return (
            "To separate these terms, add a second attitude, or state a value for one of the terms."
        )
    return "To separate these terms, state a value for one of the terms."


def _budget_blocks(
    result: PlanResult, name: str, symbol: str, lines: list[BudgetLine]
) -> Iterator[Block]:
    unit, factor = field_unit(result.accelerometers[name].coefficients[symbol].unit)
    yield Heading(f"Expected uncertainty budget of {symbol} of {name}")
    by_source: dict[str, list[BudgetLine]] = {}
    runs = {run.name for run in result.runs}
    for line in lines:
        owner, _, term = line.source.partition(".")
        by_source.setdefault(f"{term}, all runs" if owner in runs else line.source, []).append(line)
    rows = []
    for source, together in by_source.items():
        share = sum(line.share for line in together)
        contribution = math.sqrt(sum(line.contribution**2 for line in together))
        u_values = {line.u for line in together}
        size = u_values.pop() if len(u_values) == 1 else None
        its_unit, its_factor = field_unit(together[0].unit)
        known_u = "" if size is None else f"{format_number(size * its_factor, 3)} {its_unit}"
        description = describe_term(source.removesuffix(", all runs"))
        rows.append(
            (share, (source, description, known_u, format_number(contribution * factor, 2)))
        )
    rows.sort(key=lambda row: -row[0])
    yield Table(
        (
            Column("Source", wraps=True),
            Column("Meaning", wraps=True),
            Column("Std. uncertainty", "right", wraps=True),
            Column(f"Contribution, {unit}", "right", wraps=True),
            Column("Share of u^2", "right", wraps=True),
        ),
        tuple((*row, format_share(share)) for share, row in rows[:_LINES]),
    )


def _fault_blocks(
    result: PlanResult, name: str, accelerometer: PlannedAccelerometer
) -> Iterator[Block]:
    """List faults that would shift K_II undetected, and state the share of K_II from a harmonic."""
    if accelerometer.faults is None:
        return
    yield Heading(f"Effects on {name} that the plan cannot detect")
    undetected_faults = [effect for effect in accelerometer.faults if not effect.noticed]
    detected_faults = [effect for effect in accelerometer.faults if effect.noticed]
    if undetected_faults:
        yield Paragraph(
            "The plan fixes each of these effects at the nominal value. Each of them, at its "
            "default size, would by itself shift K_II by more than the standard uncertainty, "
            "and the residuals would still be consistent with noise."
        )
        yield Table(
            (
                Column("Effect", wraps=True),
                Column("Typical size", "right"),
                Column("Shift of K_II", "right"),
                Column("If estimated"),
            ),
            tuple(
                (
                    f"{effect.words} ({effect.symbol})",
                    _in_field_unit(effect.size, effect.unit),
                    f"{effect.ratio:.3g} u" if effect.ratio < 1e3 else f"{effect.ratio:.0f} u",
                    "determined" if effect.deviation > _DETECTION_DEVIATIONS else "not determined",
                )
                for effect in undetected_faults
            ),
        )
        yield Paragraph(
            "Remove these terms from model.assume, state priors for them in [model.priors], and "
            "run the plan again."
        )
    else:
        yield Paragraph(
            "If any effect that the plan fixes at a nominal value shifts K_II by more than the "
            "standard uncertainty, the residuals will reveal the effect."
            if result.assumed
            else "The plan does not fix any effect at a nominal value. Each term without a "
            "prior contributes its default standard uncertainty."
        )
    if detected_faults:
        symbols = ", ".join(effect.symbol for effect in detected_faults)
        yield Paragraph(f"The residuals would reveal {symbols}.")
    share = accelerometer.harmonic_share
    if share is None:
        return
    percent = "Less than 0.1" if abs(share) < 1e-3 else format_number(100.0 * share, 2)
    yield Paragraph(
        f"{percent} % of the information on K_II comes from the second harmonic of the K_II "
        "term. Encoder eccentricity and imbalance can imitate this harmonic. The remaining "
        "information comes from the mean of a_I^2.",
    )


def _limit_blocks(result: PlanResult) -> Iterator[Block]:
    if result.goal is None:
        return
    yield Heading("Active limits")
    quantity = "Uncertainty" if result.goal.kind == "minimise" else "Time"
    if not result.limits:
        yield Paragraph(
            "Relaxing any limit by 10 % does not help, because the priors limit the "
            f"{quantity.lower()}."
        )
        return
    rows = []
    for line in result.limits:
        change = _CHANGES.get(line.key, "relaxed by 10 %")
        gain = f"{format_number(100.0 * line.gain, 2)} %" if line.binds else "nothing"
        rows.append((line.words, change, gain))
    yield Table(
        (
            Column("Limit", wraps=True),
            Column("Change"),
            Column(f"Reduction of {quantity}", "right"),
        ),
        tuple(rows),
    )


def _comparison_blocks(result: PlanResult) -> Iterator[Block]:
    if not result.others:
        return
    yield Heading("Other plans")
    rows = []
    for plan in result.others:
        for name, u in plan.u.items():
            unit, factor = field_unit(_unit_of_name(name))
            rows.append(
                (
                    plan.words,
                    f"u({_spoken_name(name)}) = {format_number(u * factor, 3)} {unit}",
                    format_number(plan.ratio[name], 3),
                )
            )
    yield Table(
        (
            Column("Plan", wraps=True),
            Column("Std. uncertainty"),
            Column("Ratio", "right"),
        ),
        tuple(rows),
    )
    time_note = " Unless stated otherwise, all plans take the same time." if result.runs else ""
    explanation = (
        "The ratio is the uncertainty with this plan divided by the uncertainty with the other "
        f"plan.{time_note}"
    )
    yield Paragraph(explanation, "quiet")


def _requirement_blocks(result: PlanResult) -> Iterator[Block]:
    if not result.requirements:
        return
    yield Heading("Requirements for the centrifuge")
    rows = tuple((line.words, _format_size(line)) for line in result.requirements)
    yield Table((Column("Property", wraps=True), Column("Within", "right")), rows)
    yield Paragraph(
        "Each of these errors would by itself increase the uncertainty by 5 %, "
        f"{result.requirements_for}.",
        "quiet",
    )


def _format_size(line: Requirement) -> str:
    if line.size is None:
        return "no limit"
    unit, factor = line.unit, 1.0
    if line.unit == "1":
        unit, factor = "ppm", 1e6
    return f"{format_number(line.size * factor, 2)} {unit}"


# Words


def _main_coefficient(result: PlanResult) -> str:
    """Return the main coefficient of a forecast without a goal: K_II, or else the first."""
    name, accelerometer = next(iter(result.accelerometers.items()))
    symbols = list(accelerometer.coefficients)
    return f"{name}.{'K_II' if 'K_II' in symbols else symbols[0]}"


def _unit_of_name(name: str) -> str:
    return unit_of(_symbol_of_name(name))


def _symbol_of_name(name: str) -> str:
    return find_symbol(name)


def _spoken_name(name: str) -> str:
    symbol = _symbol_of_name(name)
    return name if symbol == name else f"{symbol} of {name.removesuffix(f'.{symbol}')}"


def _in_field_unit(size: float, unit: str) -> str:
    field, factor = field_unit(unit)
    return f"{format_number(size * factor, 2)} {field}"


def _format_u(predicted: PredictedCoefficient) -> str:
    if predicted.u is None:
        return NOT_DETERMINED
    unit, factor = field_unit(predicted.unit)
    return f"{format_number(predicted.u * factor, 3)} {unit}"


def _format_prior(predicted: PredictedCoefficient) -> str:
    if predicted.prior is None:
        return "-"
    unit, factor = field_unit(predicted.unit)
    return f"{format_number(predicted.prior * factor, 3)} {unit}"


def _dominant_source(predicted: PredictedCoefficient) -> str:
    u_parts = {
        "noise": predicted.u_noise,
        "stated priors": predicted.u_stated,
        "default priors": predicted.u_unstated,
    }
    squares = {key: part**2 for key, part in u_parts.items() if part}
    sum_of_squares = sum(squares.values())
    if predicted.u is None or sum_of_squares == 0.0:
        return "-"
    return ", ".join(
        f"{key} {format_share(square / sum_of_squares)}"
        for key, square in sorted(squares.items(), key=lambda pair: -pair[1])
        if square > 1e-3 * sum_of_squares
    )


def _format_time(seconds: float) -> str:
    if seconds < 3600.0:
        return f"{format_number(seconds, 4)} s"
    return f"{format_number(seconds / 3600.0, 3)} h"
