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
from counterspin.reports.numbers import (
    NOT_DETERMINED,
    find_display_unit,
    format_number,
    format_share,
)

#: Maximum number of lines of a budget.
_MAX_BUDGET_LINES: Final = 6
#: Reduction in per cent above which a bound is not informative.
_UNINFORMATIVE_BOUND: Final = 90.0

#: z-score above which a fit that estimates a fault nearly always detects it (5 % each way).
_DETECTION_Z_SCORE: Final = 4.0

#: Descriptions of changes to limits that are not quantities.
_CHANGE_TEXTS: Final = {"senses": "both senses of rotation", "fewest_rates": "reduced by one"}


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
    goal_sizes = goal.sizes if goal else {_main_coefficient(result): 1.0}
    u_texts, sentences = [], []
    for name in goal_sizes:
        owner, _, symbol = name.partition(".")
        coefficient = (
            result.accelerometers[owner].coefficients[symbol]
            if owner in result.accelerometers
            else result.platform[name]
        )
        u_texts.append(f"u({_display_name(name)}) = {_format_u(coefficient)}")
        if owner in result.accelerometers:
            label = _display_name(name) if len(goal_sizes) > 1 else ""
            sentences.append(default_prior_sentence(result.accelerometers[owner], symbol, label))
    total_texts = [
        f"{count} {noun}{'s' * (count > 1)}"
        for count, noun in ((len(result.runs), "run"), (len(result.readings), "reading"))
        if count
    ]
    total_texts += [_format_time(result.total_time)] if result.total_time > 0.0 else []
    yield Paragraph(f"{'; '.join(u_texts)}: {', '.join(total_texts)}.", "answer")
    for sentence in (*sentences, assumption_sentence(result)):
        if sentence:
            yield Paragraph(sentence)
    if goal is not None:
        yield Paragraph(_optimality_sentence(goal, result.total_time > 0.0))
    gravity_text = format_number(result.gravity, 9)
    yield Paragraph(
        "All values are standard uncertainties (k = 1) expected from a joint calibration, "
        f"expressed in units of the local gravity, g = {gravity_text} m/s^2.",
        "quiet",
    )


def _optimality_sentence(goal: GoalResult, is_timed: bool) -> str:
    if goal.efficiency is None:
        return (
            "Another plan may be better. The possible improvement is unknown, because no bound "
            "is known for plans with time-stamp jitter."
        )
    max_gain = 100.0 * (1.0 - goal.efficiency)
    if max_gain > _UNINFORMATIVE_BOUND:
        return (
            f"Another plan may be better, but by no more than {format_number(max_gain, 2)} %, "
            "which is the bound for all plans."
        )
    if max_gain < 0.05:
        return "No plan within these limits is more than 0.05 % better."
    gain_text = f"more than {format_number(max_gain, 2)} %"
    if goal.kind == "minimise":
        quantity = (
            "uncertainty"
            if goal.criterion == "sum"
            else "mean uncertainty (geometric mean from the covariance determinant)"
        )
        return f"No plan within these limits can reduce the {quantity} by {gain_text}."
    if is_timed:
        return f"No plan within these limits can be {gain_text} shorter."
    return f"No plan within these limits needs {gain_text} fewer readings."


def _run_blocks(result: PlanResult) -> Iterator[Block]:
    is_scheduled = all(run.start is not None for run in result.runs)
    has_several_attitudes = len({run.attitude for run in result.runs}) > 1
    yield Heading("Runs in time order" if is_scheduled else "Runs")
    columns = [
        Column("Run"),
        Column("Rate, rad/s", "right"),
        Column("g", "right"),
        Column("Revolutions", "right"),
        Column("Record, s", "right"),
    ]
    columns += [Column("Start time, s", "right")] * is_scheduled
    columns += [Column("Attitude", wraps=True)] * has_several_attitudes
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
        row += [run.attitude] * has_several_attitudes
        rows.append(tuple(row))
    yield Table(tuple(columns), tuple(rows))
    if not has_several_attitudes:
        yield Paragraph(f"Attitude: {result.runs[0].attitude}.")


def _reading_blocks(result: PlanResult) -> Iterator[Block]:
    """Show the distinct readings with the number of each."""
    yield Heading("Readings")
    counts_by_row: dict[tuple[str, ...], int] = {}
    has_several_accelerometers = len(result.accelerometers) > 1
    for reading in result.readings:
        row: tuple[str, ...] = (
            reading.motion,
            reading.mounting or "-",
            format_number(reading.rate, 6) if reading.rate else "-",
            format_number(reading.specific_force, 4) if reading.rate else "-",
            reading.axes,
            format_number(1e6 * reading.u, 3),
        )
        row = (reading.accelerometer, *row) if has_several_accelerometers else row
        counts_by_row[row] = counts_by_row.get(row, 0) + 1
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
        ((Column("Accelerometer"),) if has_several_accelerometers else ()) + tuple(columns),
        tuple((*row, str(count)) for row, count in counts_by_row.items()),
    )
    order_texts = {
        "mirrored": "in mirrored order, so that a linear drift cancels",
        "random": "in random order, so that a drift acts as noise",
        "listed": "in the order of the stations",
    }
    if result.order:
        yield Paragraph(f"The planned campaign lists the readings {order_texts[result.order]}.")


def _accelerometer_blocks(
    result: PlanResult, name: str, accelerometer: PlannedAccelerometer
) -> Iterator[Block]:
    yield Heading(f"Expected uncertainties for {name}")
    rows, quiet_rows = [], set()
    coefficients = dict(accelerometer.coefficients) | result.platform
    for index, (symbol, coefficient) in enumerate(coefficients.items()):
        texts = (_format_u(coefficient), _format_prior(coefficient), _format_sources(coefficient))
        rows.append((symbol, *texts))
        if not coefficient.estimated:
            quiet_rows.add(index)
    yield Table(
        (Column("Coefficient"), Column("u"), Column("u (prior)"), Column("Sources", wraps=True)),
        tuple(rows),
        frozenset(quiet_rows),
    )
    for confounded_terms in accelerometer.confounded:
        yield Paragraph(
            f"{confounding_text(confounded_terms)} with this plan. The plan determines only "
            f"{confounded_terms.determined}. {_separation_advice(result, confounded_terms.terms)}"
        )
    targets = result.goal.sizes if result.goal else {_main_coefficient(result): 1.0}
    for symbol, budget_lines in accelerometer.budget.items():
        if f"{name}.{symbol}" in targets:
            yield from _budget_blocks(result, name, symbol, budget_lines)
    yield from _fault_blocks(result, name, accelerometer)


def _separation_advice(result: PlanResult, terms: Sequence[str]) -> str:
    """Return advice to separate terms: the other sense, other rates, another attitude."""
    rates = [run.rate for run in result.runs]
    if not rates:
        return "To separate these terms, add other stations, or state a value for one of the terms."
    platform_terms = [SHARED_TERMS[symbol] for symbol in terms if symbol in SHARED_TERMS]
    accelerometer_terms = [TERMS[symbol] for symbol in terms if symbol in TERMS]
    if (
        accelerometer_terms
        and min(rates) * max(rates) > 0.0
        and any(
            row.symbol.startswith(("platform.drift.", "platform.g_sensitivity."))
            for row in platform_terms
        )
    ):
        # Drift and g-sensitivity change their sign with the sense, the accelerometer's do not.
        return "To separate these terms, add runs in the opposite sense of rotation."
    has_one_rate = max(map(abs, rates)) < 1.001 * min(map(abs, rates))
    if has_one_rate and len({len(row.effect.factors) for row in accelerometer_terms}) > 1:
        return "To separate these terms, add runs at other rates."
    if not platform_terms and len({run.attitude for run in result.runs}) == 1:
        return (
            "To separate these terms, add a second attitude, or state a value for one of the terms."
        )
    return "To separate these terms, state a value for one of the terms."


def _budget_blocks(
    result: PlanResult, name: str, symbol: str, budget_lines: list[BudgetLine]
) -> Iterator[Block]:
    unit, factor = find_display_unit(result.accelerometers[name].coefficients[symbol].unit)
    yield Heading(f"Expected uncertainty budget of {symbol} of {name}")
    lines_by_source: dict[str, list[BudgetLine]] = {}
    runs = {run.name for run in result.runs}
    for line in budget_lines:
        owner, _, term = line.source.partition(".")
        source = f"{term}, all runs" if owner in runs else line.source
        lines_by_source.setdefault(source, []).append(line)
    rows = []
    for source, source_lines in lines_by_source.items():
        share = sum(line.share for line in source_lines)
        contribution = math.sqrt(sum(line.contribution**2 for line in source_lines))
        u_values = {line.u for line in source_lines}
        u = u_values.pop() if len(u_values) == 1 else None
        source_unit, source_factor = find_display_unit(source_lines[0].unit)
        u_text = "" if u is None else f"{format_number(u * source_factor, 3)} {source_unit}"
        description = describe_term(source.removesuffix(", all runs"))
        rows.append((share, (source, description, u_text, format_number(contribution * factor, 2))))
    rows.sort(key=lambda row: -row[0])
    yield Table(
        (
            Column("Source", wraps=True),
            Column("Meaning", wraps=True),
            Column("Std. uncertainty", "right", wraps=True),
            Column(f"Contribution, {unit}", "right", wraps=True),
            Column("Share of u^2", "right", wraps=True),
        ),
        tuple((*row, format_share(share)) for share, row in rows[:_MAX_BUDGET_LINES]),
    )


def _fault_blocks(
    result: PlanResult, name: str, accelerometer: PlannedAccelerometer
) -> Iterator[Block]:
    """List faults that would shift K_II undetected, and state the share of K_II from a harmonic."""
    if accelerometer.faults is None:
        return
    yield Heading(f"Effects on {name} that the plan cannot detect")
    undetected_faults = [fault for fault in accelerometer.faults if not fault.noticed]
    detected_faults = [fault for fault in accelerometer.faults if fault.noticed]
    if undetected_faults:
        yield Paragraph(
            "The plan fixes these effects at their nominal values. Any one of them, at the "
            "default size, would shift K_II by more than the standard uncertainty, "
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
                    f"{fault.words} ({fault.symbol})",
                    _format_quantity(fault.size, fault.unit),
                    f"{fault.ratio:.3g} u" if fault.ratio < 1e3 else f"{fault.ratio:.0f} u",
                    "determined" if fault.deviation > _DETECTION_Z_SCORE else "not determined",
                )
                for fault in undetected_faults
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
        symbols_text = ", ".join(fault.symbol for fault in detected_faults)
        yield Paragraph(f"The residuals would reveal {symbols_text}.")
    harmonic_share = accelerometer.harmonic_share
    if harmonic_share is None:
        return
    percent = (
        "Less than 0.1" if abs(harmonic_share) < 1e-3 else format_number(100.0 * harmonic_share, 2)
    )
    yield Paragraph(
        f"{percent} % of the information on K_II comes from the second harmonic of the K_II "
        "term. Encoder eccentricity and imbalance can imitate this harmonic. The remaining "
        "information comes from the mean of a_I^2."
    )


def _limit_blocks(result: PlanResult) -> Iterator[Block]:
    if result.goal is None:
        return
    yield Heading("Active limits")
    quantity = "uncertainty" if result.goal.kind == "minimise" else "time"
    if not result.limits:
        yield Paragraph(
            f"Relaxing any limit by 10 % does not help, because the priors limit the {quantity}."
        )
        return
    rows = []
    for limit in result.limits:
        change_text = _CHANGE_TEXTS.get(limit.key, "relaxed by 10 %")
        gain_text = f"{format_number(100.0 * limit.gain, 2)} %" if limit.binds else "none"
        rows.append((limit.words, change_text, gain_text))
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
            unit, factor = find_display_unit(_coefficient_unit(name))
            rows.append(
                (
                    plan.words,
                    f"u({_display_name(name)}) = {format_number(u * factor, 3)} {unit}",
                    format_number(plan.ratio[name], 3),
                )
            )
    yield Table(
        (Column("Plan", wraps=True), Column("Std. uncertainty"), Column("Ratio", "right")),
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
    rows = tuple(
        (requirement.words, _format_size(requirement)) for requirement in result.requirements
    )
    yield Table((Column("Property", wraps=True), Column("Allowed error", "right")), rows)
    yield Paragraph(
        "Any one of these errors would increase the uncertainty by 5 %, "
        f"{result.requirements_for}.",
        "quiet",
    )


def _format_size(requirement: Requirement) -> str:
    if requirement.size is None:
        return "no limit"
    unit, factor = requirement.unit, 1.0
    if requirement.unit == "1":
        unit, factor = "ppm", 1e6
    return f"{format_number(requirement.size * factor, 2)} {unit}"


# Formatted values


def _main_coefficient(result: PlanResult) -> str:
    """Return the main coefficient of a forecast without a goal: K_II, or else the first."""
    name, accelerometer = next(iter(result.accelerometers.items()))
    symbols = list(accelerometer.coefficients)
    return f"{name}.{'K_II' if 'K_II' in symbols else symbols[0]}"


def _coefficient_unit(name: str) -> str:
    return unit_of(find_symbol(name))


def _display_name(name: str) -> str:
    symbol = find_symbol(name)
    return name if symbol == name else f"{symbol} of {name.removesuffix(f'.{symbol}')}"


def _format_quantity(size: float, unit: str) -> str:
    display_unit, factor = find_display_unit(unit)
    return f"{format_number(size * factor, 2)} {display_unit}"


def _format_u(coefficient: PredictedCoefficient) -> str:
    if coefficient.u is None:
        return NOT_DETERMINED
    unit, factor = find_display_unit(coefficient.unit)
    return f"{format_number(coefficient.u * factor, 3)} {unit}"


def _format_prior(coefficient: PredictedCoefficient) -> str:
    if coefficient.prior is None:
        return "-"
    unit, factor = find_display_unit(coefficient.unit)
    return f"{format_number(coefficient.prior * factor, 3)} {unit}"


def _format_sources(coefficient: PredictedCoefficient) -> str:
    u_by_source = {
        "noise": coefficient.u_noise,
        "stated priors": coefficient.u_stated,
        "default priors": coefficient.u_unstated,
    }
    variances = {source: u**2 for source, u in u_by_source.items() if u}
    total_variance = sum(variances.values())
    if coefficient.u is None or total_variance == 0.0:
        return "-"
    return ", ".join(
        f"{source} {format_share(variance / total_variance)}"
        for source, variance in sorted(variances.items(), key=lambda pair: -pair[1])
        if variance > 1e-3 * total_variance
    )


def _format_time(seconds: float) -> str:
    if seconds < 3600.0:
        return f"{format_number(seconds, 4)} s"
    return f"{format_number(seconds / 3600.0, 3)} h"
