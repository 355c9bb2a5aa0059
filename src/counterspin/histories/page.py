"""Printed report of a history: a sentence, a table and a control chart for each instrument."""

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
    RepeatComponent,
    Scatter,
)
from counterspin.inference.distributions import expanded_uncertainty
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Plot, PlotSeries, Table
from counterspin.reports.numbers import (
    field_unit,
    format_estimate,
    format_number,
    format_probability,
    round_to_uncertainty,
)

#: Description in the file of a control chart.
FILE_DESCRIPTION: Final = "a control chart"

_YEAR: Final = 365.25  #: days

#: |z| above which a result requires action (ISO 13528:2015, 9.4.2).
_ACTION_Z: Final = 3.0


def history_blocks(history: History) -> Iterator[Block]:
    """Yield each instrument's verdict, table and control chart, then the unused files."""
    yield Heading(f"History of {_title(history)}", 1)
    for instrument in history.instruments:
        yield Heading(f"Serial number {_instrument_name(instrument)}")
        good = instrument.verdict in {"single", "constant"}
        yield Paragraph(verdict_sentences(history, instrument), "answer" if good else "warning")
        yield _table(history, instrument)
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
    yield from _unused_blocks(history)


def verdict_sentences(history: History, instrument: InstrumentHistory) -> str:
    """Return the verdict on the agreement of an instrument's results, in one or two sentences."""
    name, unit, factor = _title(history), *field_unit(history.unit)
    points, mean = instrument.points, instrument.mean * factor
    average = format_estimate(mean, instrument.u_mean * factor, unit)
    if instrument.verdict == "single":
        return f"{name} = {average}. There is only one result; a comparison requires at least two."
    line = instrument.drift
    slope = None
    if line is not None:
        slope = format_estimate(line.value * factor, line.u * factor, unit) + " a year"
    scatter = _scatter_sentence(instrument.scatter)
    if instrument.verdict == "constant":
        drift = f" No significant drift: {slope}." if slope else ""
        return (
            f"{name} is constant: {len(points)} results are consistent with {average} "
            f"({scatter}).{drift}"
        )
    if instrument.verdict == "drifts" and line is not None:
        return (
            f"{name} drifts by {slope}: {len(points)} results are consistent with a straight "
            f"line ({_scatter_sentence(line.scatter)}) but not with a constant ({scatter})."
        )
    if instrument.verdict == "differ":
        first, last = points
        change = format_estimate(
            (last.value - first.value) * factor, (last.u**2 + first.u**2) ** 0.5 * factor, unit
        )
        return (
            f"{name} changed by {change} between {first.date} and {last.date} ({scatter}). "
            "With two results, a drift cannot be distinguished from a jump or from an "
            "understated uncertainty."
        )
    farthest = max(points, key=lambda point: abs(point.z or 0.0))
    return (
        f"The results for {name} scatter more than the uncertainties explain ({scatter}), and "
        "a steady drift does not explain the scatter. Either the value jumped, or the "
        f"uncertainties are understated. The result in {farthest.file} deviates most (z = "
        f"{format_number(farthest.z or 0.0, 2)})."
    )


def conclusion_sentences(history: History, instrument: InstrumentHistory) -> Iterator[str]:
    """Yield sentences on control limits, shared inputs, due date, and pairs of laboratories."""
    unit, factor = field_unit(history.unit)

    def shown(low: float, high: float) -> str:
        return f"{low * factor:.6g} to {high * factor:.6g} {unit}"

    if (chart := instrument.control) is not None:
        out = [
            *(f"{file} is outside the action limits" for file in chart.beyond),
            *(f"{file} has jumped since the previous result" for file in chart.leaps),
        ]
        yield (
            f"Individuals chart: centre {chart.centre * factor:.6g} {unit}, action limits "
            f"{shown(chart.action_low, chart.action_high)}, warning limits "
            f"{shown(chart.warning_low, chart.warning_high)}. The limits are calculated from "
            "the mean moving range. "
            + (f"The process is out of control: {'; '.join(out)}." if out else "In control.")
        )
    if instrument.correlation is not None:
        yield (
            "The results have these sources of uncertainty in common: "
            f"{', '.join(instrument.shared)} (correlation up to {instrument.correlation:.2f}). "
            "The evaluation includes these correlations."
        )
    if (due := instrument.due) is not None:
        reliability = format_probability(due.reliability)
        if due.date is not None:
            yield (
                f"The next calibration is due on {due.date}. Until this date, the straight "
                f"line through the results stays within the specification with {reliability} "
                "(control chart method of ILAC-G24:2022)."
            )
        elif instrument.specification is not None:
            yield f"No due date can be stated with {reliability}: {due.reason}."
    for pair in instrument.laboratories:
        agree = "agree" if pair.agrees else "differ significantly"
        difference = format_number(pair.difference * factor, 2)
        yield (
            f"{pair.second} minus {pair.first} = {difference} {unit}, E_n = {pair.e_n:.2f}; "
            f"the results {agree}."
        )


#: Component -> the repeated condition, singular and plural.
_CONDITIONS: Final = {
    "day": ("day", "days"),
    "mounting": ("mounting", "mountings"),
    "turn_on": ("turn-on", "turn-ons"),
}

#: Degrees of freedom below which a standard deviation is poorly known.
_MIN_RELIABLE_DOF: Final = 5


def _repeatability_blocks(history: History, repeats: Repeatability) -> Iterator[Block]:
    """Yield the table of the variation of results in excess of their u."""
    unit, factor = field_unit(history.unit)

    def shown(value: float) -> str:
        return format_number(value * factor, 2)

    def row(name: str, component: RepeatComponent) -> tuple[str, ...]:
        what = " or ".join(_CONDITIONS[alias][0] for alias in (name, *component.same_as))
        upper = "any" if component.high is None else shown(component.high)
        interval = f"{shown(component.low) if component.low else 0} to {upper}"
        counted = f"{component.groups} {_CONDITIONS[name][1]}"
        return f"another {what}", shown(component.value), interval, counted, str(component.freedom)

    rows = [row(name, component) for name, component in repeats.components.items()]
    if len(rows) > 1:
        rows.append(("all results", shown(repeats.total), "", "", ""))
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
    about = "a line" if repeats.about == "line" else "the mean"
    few = [
        _CONDITIONS[n][1]
        for n, component in repeats.components.items()
        if component.freedom < _MIN_RELIABLE_DOF
    ]
    why = [
        f"{_CONDITIONS[name][0]}: {words}"
        for name, words in repeats.not_told.items()
        if name != "day"
    ]
    yield Paragraph(
        f"These standard deviations about {about} are in addition to the uncertainties of the "
        "results (restricted likelihood)."
        + (
            (
                f" With few {' and '.join(few)}, the estimates are unreliable. Use the "
                "intervals instead."
            )
            if few
            else ""
        )
        + (f" These components cannot be separated: {'; '.join(why)}." if why else ""),
        "quiet",
    )


def _limit_series(
    instrument: InstrumentHistory, ends: tuple[float, float], factor: float
) -> Iterator[PlotSeries]:
    """Yield control and specification limits; each type has one legend entry."""
    lines: list[tuple[str, tuple[float | None, ...], int]] = []
    if (chart := instrument.control) is not None:
        lines += [
            ("centre (mean of the results)", (chart.centre,), 4),
            ("warning limits", (chart.warning_low, chart.warning_high), 5),
            ("action limits (moving range)", (chart.action_low, chart.action_high), 1),
        ]
    if (limits := instrument.specification) is not None:
        lines.append(("specification", (limits.low, limits.high), 6))
    for words, levels, colour in lines:
        label = words
        for level in levels:
            if level is not None:
                y = (level * factor,) * 2
                yield PlotSeries(label, ends, y, colour=colour, stands_out=words == "specification")
                label = ""


def control_plot(history: History, instrument: InstrumentHistory) -> Plot:
    """Return the results with their 95 % intervals over time, mean, control limits and drift."""
    unit, factor = field_unit(history.unit)
    x = tuple(_days_since_epoch(point.date) for point in instrument.points)
    y = tuple(point.value * factor for point in instrument.points)
    half = tuple(expanded_uncertainty(point.u, point.dof) * factor for point in instrument.points)
    ends = (min(x), max(x))
    mean, u = instrument.mean * factor, expanded_uncertainty(instrument.u_mean, None) * factor
    series = [
        PlotSeries(
            "weighted mean; band: 95 %",
            ends,
            (mean, mean),
            low=(mean - u, mean - u),
            high=(mean + u, mean + u),
        )
    ]
    series += _limit_series(instrument, ends, factor)
    if len(x) > 1 and instrument.control is None:
        # The standard uncertainty of a result minus the mean, which includes the result.
        away = [
            _ACTION_Z * math.sqrt(max(point.u**2 - instrument.u_mean**2, 0.0)) * factor
            for point in instrument.points
        ]
        words = f"control limits, z = ± {_ACTION_Z:g}"
        for label, sign in ((words, 1.0), ("", -1.0)):
            limit = tuple(mean + sign * distance for distance in away)
            series.append(PlotSeries(label, x, limit, colour=1))
    if (line := instrument.drift) is not None and len(x) > 2:
        series.append(
            PlotSeries(
                "drift",
                ends,
                tuple(
                    factor
                    * (line.level + line.value * (end - _days_since_epoch(line.date)) / _YEAR)
                    for end in ends
                ),
                stands_out=instrument.verdict == "drifts",
                colour=3,
            )
        )
    series.append(
        PlotSeries(
            "results; error bars: 95 %",
            x,
            y,
            low=tuple(a - b for a, b in zip(y, half, strict=True)),
            high=tuple(a + b for a, b in zip(y, half, strict=True)),
            kind="points",
            colour=2,
        )
    )
    return Plot(
        title=f"{_title(history)} of {_instrument_name(instrument)}",
        x_label="date",
        y_label=f"{_title(history)}, {unit}",
        series=tuple(series),
        dates=True,
    )


def history_plots(history: History) -> list[Plot]:
    """Return the control chart of every instrument."""
    return [control_plot(history, instrument) for instrument in history.instruments]


def _title(history: History) -> str:
    return "angle minus 90 deg" if history.term == "angle" else history.term


def _instrument_name(instrument: InstrumentHistory) -> str:
    if instrument.stated_by == "campaign":
        return f"{instrument.serial_number} (of the campaign)"
    return instrument.serial_number


def _scatter_sentence(scatter: Scatter) -> str:
    if scatter.p is None or scatter.birge is None:
        return "no degree of freedom"
    p, birge = format_number(scatter.p, 2), format_number(scatter.birge, 2)
    return f"chi-square p = {p}, Birge ratio {birge}"


def _table(history: History, instrument: InstrumentHistory) -> Table:
    unit, factor = field_unit(history.unit)
    return Table(
        columns=(
            Column("Date"),
            Column("File", wraps=True),
            Column("Method", wraps=True),
            Column(f"{_title(history)}, {unit}", "right"),
            Column("Deviation", "right"),
            Column("z", "right"),
            Column("E_n", "right"),
        ),
        rows=tuple(_row(point, factor) for point in instrument.points),
    )


def _row(point: Point, factor: float) -> tuple[str, ...]:
    value, u = point.value * factor, point.u * factor
    rounded = round_to_uncertainty(value, u)
    less = "-"
    if point.difference is not None:
        less = format_number(point.difference * factor, 2)
        if rounded is not None and not rounded.exponent:
            less = rounded.write(point.difference * factor)
    return (
        point.date,
        point.file,
        point.method,
        format_estimate(value, u),
        less,
        "-" if point.z is None else f"{point.z:.2f}",
        "-" if point.e_n is None else f"{point.e_n:.2f}",
    )


def _unused_blocks(history: History) -> Iterator[Block]:
    for note in history.notes:
        yield Paragraph(f"Warning: {note}", "warning")
    for unused in history.damaged:
        yield Paragraph(f"{unused.file} was not used: {unused.reason}.", "warning")
    if history.left_out:
        yield Paragraph(f"Omitted ({len(history.left_out)}):")
    for unused in history.left_out:
        whose = f", {unused.accelerometer}" if unused.accelerometer else ""
        yield Paragraph(f"{unused.file}{whose}: {unused.reason.removesuffix('.')}.", "quiet")
    if count := len(history.passed_over):
        files = (
            "JSON file is not a result and is"
            if count == 1
            else "JSON files are not results and are"
        )
        yield Paragraph(f"{count} {files} ignored.", "quiet")


def _days_since_epoch(date: str) -> float:
    """Return a date as days since 1970-01-01."""
    return (datetime.fromisoformat(date) - datetime(1970, 1, 1)) / timedelta(days=1)
