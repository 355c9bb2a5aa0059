"""Report of a history: verdict, table and control chart of each instrument."""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import datetime, timedelta
from typing import Final

from counterspin.histories.result import (
    History,
    InstrumentHistory,
    Point,
    Repeatability,
    RepeatabilityComponent,
    Scatter,
)
from counterspin.inference.distributions import expanded_uncertainty
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Plot, PlotSeries, Table
from counterspin.reports.numbers import (
    find_display_unit,
    format_estimate,
    format_number,
    format_p,
    format_probability,
    round_to_uncertainty,
)

#: Description in the file of a control chart.
FILE_DESCRIPTION: Final = "a control chart"

_DAYS_PER_YEAR: Final = 365.25  #: days

#: |z| above which a result requires action (ISO 13528:2015, 9.4.2).
_ACTION_Z: Final = 3.0


def history_blocks(history: History) -> Iterator[Block]:
    """Yield each instrument's verdict, table and control chart, then the unused files."""
    yield Heading(f"History of {_quantity_name(history)}", 1)
    for instrument in history.instruments:
        yield Heading(f"Serial number {_instrument_name(instrument)}")
        is_consistent = instrument.verdict in {"single", "constant"}
        yield Paragraph(
            verdict_sentences(history, instrument), "answer" if is_consistent else "warning"
        )
        yield _result_table(history, instrument)
        for line in conclusion_sentences(history, instrument):
            yield Paragraph(line)
        if instrument.repeatability is not None:
            yield from _repeatability_blocks(history, instrument.repeatability)
        if len(instrument.points) > 1:
            yield control_plot(history, instrument)
    yield Paragraph(
        "The number after ± is the standard uncertainty (k = 1). z is the difference from the "
        "weighted mean, divided by the standard uncertainty of the difference. E_n is the "
        "change since the previous result, divided by the expanded uncertainty (95 %) of this "
        "change. Two results are consistent if |E_n| <= 1 (ISO 13528).",
        "quiet",
    )
    if history.converted:
        gravity = format_number(history.gravity, 9)
        yield Paragraph(
            "Results from other sites are converted to the g-units of the latest result, g = "
            f"{gravity} m/s^2.",
            "quiet",
        )
    yield from _unused_result_blocks(history)


def verdict_sentences(history: History, instrument: InstrumentHistory) -> str:
    """Return the verdict on the agreement of an instrument's results, in one or two sentences."""
    name, unit, factor = _quantity_name(history), *find_display_unit(history.unit)
    points, mean = instrument.points, instrument.mean * factor
    mean_text = format_estimate(mean, instrument.u_mean * factor, unit)
    if instrument.verdict == "single":
        return (
            f"{name} = {mean_text}. There is only one result; a comparison requires at least two."
        )
    trend = instrument.drift
    drift_text = None
    if trend is not None:
        drift_text = format_estimate(trend.value * factor, trend.u * factor, unit) + " a year"
    scatter_text = _scatter_sentence(instrument.scatter)
    if instrument.verdict == "constant":
        drift_sentence = f" No significant drift: {drift_text}." if drift_text else ""
        return (
            f"{name} is constant: {len(points)} results are consistent with {mean_text} "
            f"({scatter_text}).{drift_sentence}"
        )
    if instrument.verdict == "drifts" and trend is not None:
        return (
            f"{name} drifts by {drift_text}: {len(points)} results are consistent with a straight "
            f"line ({_scatter_sentence(trend.scatter)}) but not with a constant ({scatter_text})."
        )
    if instrument.verdict == "differ":
        first_point, last_point = points
        change_text = format_estimate(
            (last_point.value - first_point.value) * factor,
            (last_point.u**2 + first_point.u**2) ** 0.5 * factor,
            unit,
        )
        return (
            f"{name} changed by {change_text} between {first_point.date} and {last_point.date} "
            f"({scatter_text}). With two results, a drift cannot be distinguished from a jump or "
            "from an understated uncertainty."
        )
    worst_point = max(points, key=lambda point: abs(point.z or 0.0))
    return (
        f"The results for {name} scatter more than the uncertainties explain ({scatter_text}), and "
        "a steady drift does not explain the scatter. Either the value jumped, or the "
        f"uncertainties are understated. The result in {worst_point.file} deviates most (z = "
        f"{format_number(worst_point.z or 0.0, 2)})."
    )


def conclusion_sentences(history: History, instrument: InstrumentHistory) -> Iterator[str]:
    """Yield sentences on control limits, shared inputs, due date, and pairs of laboratories."""
    unit, factor = find_display_unit(history.unit)

    if (chart := instrument.control) is not None:
        # The chart's standard deviation, which rounds its limits; identical results have none.
        sigma = (chart.action_high - chart.warning_high) or instrument.u_mean
        rounded = round_to_uncertainty(chart.centre * factor, sigma * factor)

        def format_level(level: float) -> str:
            if rounded is None:
                return format_number(level * factor, 17)
            return rounded.format(level * factor) + rounded.power

        alarms = [
            *(f"{file} is outside the action limits" for file in chart.beyond),
            *(f"{file} has jumped since the previous result" for file in chart.leaps),
        ]
        yield (
            f"Individuals chart: centre {format_level(chart.centre)} {unit}, action limits "
            f"{format_level(chart.action_low)} to {format_level(chart.action_high)} {unit}, "
            f"warning limits {format_level(chart.warning_low)} to "
            f"{format_level(chart.warning_high)} {unit}. The limits are calculated from the mean "
            "moving range. "
            + (
                f"The process is out of control: {'; '.join(alarms)}."
                if alarms
                else "The process is in control."
            )
        )
    if instrument.correlation is not None:
        yield (
            "The results have these sources of uncertainty in common: "
            f"{', '.join(instrument.shared)} (correlation up to {instrument.correlation:.2f}). "
            "The evaluation includes these correlations."
        )
    if (due := instrument.due) is not None:
        probability_text = format_probability(due.reliability)
        if due.date is not None:
            yield (
                f"The next calibration is due on {due.date}. Until this date, the straight "
                f"line through the results stays within the specification with {probability_text} "
                "(control chart method of ILAC-G24:2022)."
            )
        elif instrument.specification is not None:
            yield f"No due date can be stated with {probability_text}: {due.reason}."
    for pair in instrument.laboratories:
        agreement_text = "agree" if pair.agrees else "differ significantly"
        difference_text = _format_difference(pair.difference * factor, pair.e_n)
        yield (
            f"{pair.second} minus {pair.first} = {difference_text} {unit}, E_n = {pair.e_n:.2f}; "
            f"the results {agreement_text}."
        )


def _format_difference(difference: float, e_n: float) -> str:
    """Format a difference, rounded to the first digit of its expanded uncertainty."""
    if not difference or not e_n:
        return "0"
    u_digit = math.floor(math.log10(abs(difference / e_n)))
    return format_number(difference, max(1, math.floor(math.log10(abs(difference))) - u_digit + 1))


#: Component -> the repeated condition, singular and plural.
_CONDITION_NAMES: Final = {
    "day": ("day", "days"),
    "mounting": ("mounting", "mountings"),
    "turn_on": ("turn-on", "turn-ons"),
}

#: Degrees of freedom below which a standard deviation is poorly known.
_MIN_RELIABLE_DOF: Final = 5


def _repeatability_blocks(history: History, repeatability: Repeatability) -> Iterator[Block]:
    """Yield the table of the variation of results in excess of their u."""
    unit, factor = find_display_unit(history.unit)

    def format_number_in_unit(value: float) -> str:
        return format_number(value * factor, 2)

    def component_row(name: str, component: RepeatabilityComponent) -> tuple[str, ...]:
        condition = " or ".join(_CONDITION_NAMES[alias][0] for alias in (name, *component.same_as))
        upper_text = "any" if component.high is None else format_number_in_unit(component.high)
        interval = f"{format_number_in_unit(component.low) if component.low else 0} to {upper_text}"
        groups_text = f"{component.groups} {_CONDITION_NAMES[name][1]}"
        return (
            f"another {condition}",
            format_number_in_unit(component.value),
            interval,
            groups_text,
            str(component.freedom),
        )

    rows = [component_row(name, component) for name, component in repeatability.components.items()]
    if len(rows) > 1:
        rows.append(("all results", format_number_in_unit(repeatability.total), "", "", ""))
    yield Table(
        columns=(
            Column("Changed condition"),
            Column(f"Standard deviation, {unit}", "right"),
            Column("95 % interval", "right"),
            Column("From", "right"),
            Column("Degrees of freedom", "right"),
        ),
        rows=tuple(rows),
    )
    reference_text = "a line" if repeatability.about == "line" else "the mean"
    unreliable_conditions = [
        _CONDITION_NAMES[name][1]
        for name, component in repeatability.components.items()
        if component.freedom < _MIN_RELIABLE_DOF
    ]
    undetermined_reasons = [
        f"{_CONDITION_NAMES[name][0]}: {reason}"
        for name, reason in repeatability.not_told.items()
        if name != "day"
    ]
    yield Paragraph(
        f"These standard deviations about {reference_text} add to the uncertainties of the "
        "results. The estimates are restricted maximum likelihood estimates."
        + (
            (
                f" With few {' and '.join(unreliable_conditions)}, the estimates are unreliable. "
                "Use the intervals instead."
            )
            if unreliable_conditions
            else ""
        )
        + (
            f" These components cannot be separated: {'; '.join(undetermined_reasons)}."
            if undetermined_reasons
            else ""
        ),
        "quiet",
    )


def _limit_series(
    instrument: InstrumentHistory, date_range: tuple[float, float], factor: float
) -> Iterator[PlotSeries]:
    """Yield control and specification limits; each type has one legend entry."""
    limit_lines: list[tuple[str, tuple[float | None, ...], int]] = []
    if (chart := instrument.control) is not None:
        limit_lines += [
            ("centre (mean of the results)", (chart.centre,), 4),
            ("warning limits", (chart.warning_low, chart.warning_high), 5),
            ("action limits (moving range)", (chart.action_low, chart.action_high), 1),
        ]
    if (limits := instrument.specification) is not None:
        limit_lines.append(("specification", (limits.low, limits.high), 6))
    for legend, levels, colour in limit_lines:
        label = legend
        for level in levels:
            if level is not None:
                y = (level * factor,) * 2
                yield PlotSeries(
                    label, date_range, y, colour=colour, is_highlighted=legend == "specification"
                )
                label = ""


def control_plot(history: History, instrument: InstrumentHistory) -> Plot:
    """Return the results with their 95 % intervals over time, mean, control limits and drift."""
    unit, factor = find_display_unit(history.unit)
    x = tuple(_days_since_epoch(point.date) for point in instrument.points)
    y = tuple(point.value * factor for point in instrument.points)
    half_widths = tuple(
        expanded_uncertainty(point.u, point.dof) * factor for point in instrument.points
    )
    date_range = (min(x), max(x))
    mean, u = instrument.mean * factor, expanded_uncertainty(instrument.u_mean, None) * factor
    series = [
        PlotSeries(
            "weighted mean; band: 95 %",
            date_range,
            (mean, mean),
            low=(mean - u, mean - u),
            high=(mean + u, mean + u),
        )
    ]
    series += _limit_series(instrument, date_range, factor)
    if len(x) > 1 and instrument.control is None:
        # The standard uncertainty of a result minus the mean, which includes the result.
        z_limits = [
            _ACTION_Z * math.sqrt(max(point.u**2 - instrument.u_mean**2, 0.0)) * factor
            for point in instrument.points
        ]
        legend = f"control limits, z = ± {_ACTION_Z:g}"
        for label, sign in ((legend, 1.0), ("", -1.0)):
            limit_values = tuple(mean + sign * z_limit for z_limit in z_limits)
            series.append(PlotSeries(label, x, limit_values, colour=1))
    if (trend := instrument.drift) is not None and len(x) > 2:
        series.append(
            PlotSeries(
                "drift",
                date_range,
                tuple(
                    factor
                    * (
                        trend.level
                        + trend.value * (date - _days_since_epoch(trend.date)) / _DAYS_PER_YEAR
                    )
                    for date in date_range
                ),
                is_highlighted=instrument.verdict == "drifts",
                colour=3,
            )
        )
    series.append(
        PlotSeries(
            "results; error bars: 95 %",
            x,
            y,
            low=tuple(value - half_width for value, half_width in zip(y, half_widths, strict=True)),
            high=tuple(
                value + half_width for value, half_width in zip(y, half_widths, strict=True)
            ),
            kind="points",
            colour=2,
        )
    )
    return Plot(
        title=f"{_quantity_name(history)} of {_instrument_name(instrument)}",
        x_label="date",
        y_label=f"{_quantity_name(history)}, {unit}",
        series=tuple(series),
        is_date_axis=True,
    )


def history_plots(history: History) -> list[Plot]:
    """Return the control chart of every instrument."""
    return [control_plot(history, instrument) for instrument in history.instruments]


def _quantity_name(history: History) -> str:
    return "angle minus 90 deg" if history.term == "angle" else history.term


def _instrument_name(instrument: InstrumentHistory) -> str:
    if instrument.stated_by == "campaign":
        return f"{instrument.serial_number} (of the campaign)"
    return instrument.serial_number


def _scatter_sentence(scatter: Scatter) -> str:
    if scatter.p is None or scatter.birge is None:
        return "no degree of freedom"
    return f"chi-square {format_p(scatter.p)}, Birge ratio {format_number(scatter.birge, 2)}"


def _result_table(history: History, instrument: InstrumentHistory) -> Table:
    unit, factor = find_display_unit(history.unit)
    return Table(
        columns=(
            Column("Date"),
            Column("File", wraps=True),
            Column("Method", wraps=True),
            Column(f"{_quantity_name(history)}, {unit}", "right"),
            Column("Deviation", "right"),
            Column("z", "right"),
            Column("E_n", "right"),
        ),
        rows=tuple(_result_row(point, factor) for point in instrument.points),
    )


def _result_row(point: Point, factor: float) -> tuple[str, ...]:
    value, u = point.value * factor, point.u * factor
    rounded_value = round_to_uncertainty(value, u)
    difference_text = "-"
    if point.difference is not None:
        difference_text = format_number(point.difference * factor, 2)
        if rounded_value is not None and not rounded_value.exponent:
            difference_text = rounded_value.format(point.difference * factor)
    return (
        point.date,
        point.file,
        point.method,
        format_estimate(value, u),
        difference_text,
        "-" if point.z is None else f"{point.z:.2f}",
        "-" if point.e_n is None else f"{point.e_n:.2f}",
    )


def _unused_result_blocks(history: History) -> Iterator[Block]:
    for note in history.notes:
        yield Paragraph(f"Warning: {note}", "warning")
    for unused_result in history.damaged:
        yield Paragraph(f"{unused_result.file} was not used: {unused_result.reason}.", "warning")
    if history.left_out:
        yield Paragraph(f"Omitted ({len(history.left_out)}):")
    for unused_result in history.left_out:
        name_text = f", {unused_result.accelerometer}" if unused_result.accelerometer else ""
        yield Paragraph(
            f"{unused_result.file}{name_text}: {unused_result.reason.removesuffix('.')}.", "quiet"
        )
    if n_ignored := len(history.passed_over):
        subject = (
            "JSON file is not a result and is"
            if n_ignored == 1
            else "JSON files are not results and are"
        )
        yield Paragraph(f"{n_ignored} {subject} ignored.", "quiet")


def _days_since_epoch(date: str) -> float:
    """Return a date as days since 1970-01-01."""
    return (datetime.fromisoformat(date) - datetime(1970, 1, 1)) / timedelta(days=1)
