"""A history as a page: a sentence, a table and a control chart for each instrument.

- `render_history`: as something that rich prints; `history_blocks`: the same as blocks
- `control_plot`: one instrument's control chart as a block
- `history_figure`: the control charts of all, drawn by matplotlib
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Any, Final

from counterspin.histories.result import History, InstrumentHistory, Point, Scatter
from counterspin.inference.conformity import expanded_uncertainty
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Plot, PlotSeries, Table
from counterspin.reports.figure import COLOURS, SETTINGS, as_words
from counterspin.reports.numbers import (
    field_unit,
    format_estimate,
    format_number,
    round_to_uncertainty,
)
from counterspin.reports.text import Report
from counterspin.reports.typography import typeset

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_YEAR: Final = timedelta(days=365.25)


def render_history(history: History) -> Report:
    """Return the history for the terminal: verdicts, tables and unused files, without pictures."""
    return Report(list(history_blocks(history)))


def history_blocks(history: History) -> Iterator[Block]:
    """Yield each instrument's verdict, table and control chart, then the unused files."""
    yield Heading(f"History of {history.term}", 1)
    for instrument in history.instruments:
        yield Heading(_name(instrument))
        good = instrument.verdict in {"single", "constant"}
        yield Paragraph(verdict_in_words(history, instrument), "answer" if good else "warning")
        yield _table(history, instrument)
        if len(instrument.points) > 1:
            yield control_plot(history, instrument)
    yield Paragraph(
        "± is one standard uncertainty (k = 1). z: difference from the weighted mean over its "
        "standard uncertainty. E_n: change since the result before, over the expanded uncertainty "
        "(95 %) of the change; up to 1 in size the two agree (ISO 13528). Results are taken as "
        "independent.",
        "quiet",
    )
    if history.converted:
        gravity = format_number(history.gravity, 9)
        yield Paragraph(
            f"Results of other sites are converted to g-units of g = {gravity} m/s^2, that of the "
            "latest result.",
            "quiet",
        )
    yield from _not_among_them(history)


def verdict_in_words(history: History, instrument: InstrumentHistory) -> str:
    """Return whether an instrument's results agree, in one or two sentences."""
    name, unit, factor = history.term, *field_unit(history.unit)
    points, mean = instrument.points, instrument.mean * factor
    average = format_estimate(mean, instrument.u_mean * factor, unit)
    if instrument.verdict == "single":
        return f"{name} = {average}: one result, with nothing to compare it with."
    line = instrument.drift
    slope = None
    if line is not None:
        slope = format_estimate(line.value * factor, line.u * factor, unit) + " a year"
    scatter = _scatter_in_words(instrument.scatter)
    if instrument.verdict == "constant":
        drift = f" No drift is seen: {slope}." if slope else ""
        return f"{name} is constant: {len(points)} results agree with {average} ({scatter}).{drift}"
    if instrument.verdict == "drifts" and line is not None:
        return (
            f"{name} drifts by {slope}; {len(points)} results agree with a straight line "
            f"({_scatter_in_words(line.scatter)}), better than with a constant ({scatter})."
        )
    if instrument.verdict == "differ":
        first, last = points
        change = format_estimate(
            (last.value - first.value) * factor, (last.u**2 + first.u**2) ** 0.5 * factor, unit
        )
        return (
            f"{name} changed by {change} between {first.date} and {last.date} ({scatter}). Two "
            "results cannot tell a drift from a jump, or from an uncertainty that is too small."
        )
    farthest = max(points, key=lambda point: abs(point.z or 0.0))
    return (
        f"{name} scatters more than the uncertainties explain ({scatter}), and not by a steady "
        f"drift: it jumped, or uncertainties are too small. Farthest from the others is "
        f"{farthest.file} (z = {format_number(farthest.z or 0.0, 2)})."
    )


def control_plot(history: History, instrument: InstrumentHistory) -> Plot:
    """Return the results with their 95 % intervals over time, their mean and the drift."""
    unit, factor = field_unit(history.unit)
    x = tuple(_years(point.date) for point in instrument.points)
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
            kind="band",
        )
    ]
    if (line := instrument.drift) is not None and len(x) > 2:
        series.append(
            PlotSeries(
                "drift",
                ends,
                tuple(
                    factor * (line.level + line.value * (end - _years(line.date))) for end in ends
                ),
                stands_out=instrument.verdict == "drifts",
            )
        )
    series.append(
        PlotSeries(
            "results; bars: 95 %",
            x,
            y,
            low=tuple(a - b for a, b in zip(y, half, strict=True)),
            high=tuple(a + b for a, b in zip(y, half, strict=True)),
            kind="points",
        )
    )
    return Plot(
        title=f"{history.term} of {_name(instrument)}",
        x_label="year",
        y_label=f"{history.term}, {unit}",
        series=tuple(series),
    )


def history_figure(history: History) -> Figure:
    """Draw the control chart of every instrument, one below the other.

    Returns
    -------
    matplotlib.figure.Figure
        Not bound to any window; `counterspin.reports.figure.save` writes it.
    """
    import matplotlib as mpl
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.figure import Figure

    count = len(history.instruments)
    with mpl.rc_context(SETTINGS):
        figure = Figure(figsize=(7.0, 0.6 + 2.8 * count), layout="constrained")
        for axes, instrument in zip(
            figure.subplots(count, 1, squeeze=False)[:, 0], history.instruments, strict=True
        ):
            plot = control_plot(history, instrument)
            axes.set_title(as_words(plot.title), loc="left", fontweight="bold")
            axes.set_ylabel(typeset(plot.y_label))
            # Digits that all values share belong to each of them, not above the axis.
            axes.ticklabel_format(axis="y", useOffset=False)
            for series in plot.series:
                _draw(axes, series)
            locator = AutoDateLocator()  # type: ignore[no-untyped-call]
            axes.xaxis.set_major_locator(locator)
            form = ConciseDateFormatter(locator)  # type: ignore[no-untyped-call]
            axes.xaxis.set_major_formatter(form)
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, fontsize="small")
            axes.margins(x=0.05)
        return figure


def _draw(axes: Any, series: PlotSeries) -> None:
    x = [_date(year) for year in series.x]
    if series.kind == "points":
        assert series.low is not None
        half = [y - low for y, low in zip(series.y, series.low, strict=True)]  # type: ignore[operator]
        axes.errorbar(
            x,
            series.y,
            half,
            fmt="o",
            color=COLOURS[0],
            markersize=4.5,
            markerfacecolor="white",
            capsize=3.0,
            linewidth=1.0,
            label=series.label,
        )
        return
    if series.kind == "band":
        axes.fill_between(x, series.low, series.high, color="0.5", alpha=0.2, linewidth=0)
        axes.plot(x, series.y, color="0.4", linewidth=1.0, label=series.label)
        return
    axes.plot(
        x,
        series.y,
        color=COLOURS[1],
        linewidth=1.2,
        linestyle="-" if series.stands_out else "--",
        label=series.label,
    )


def _name(instrument: InstrumentHistory) -> str:
    if instrument.stated_by == "campaign":
        return f"{instrument.serial_number} (serial number of the campaign)"
    return instrument.serial_number


def _scatter_in_words(scatter: Scatter) -> str:
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
            Column(f"{history.term}, {unit}", "right"),
            Column("Less mean", "right"),
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


def _not_among_them(history: History) -> Iterator[Block]:
    for note in history.notes:
        yield Paragraph(f"Warning: {note}", "warning")
    for unused in history.damaged:
        yield Paragraph(f"Not read: {unused.file}: {unused.reason}.", "warning")
    if history.left_out:
        yield Paragraph(f"Left out ({len(history.left_out)}):")
    for unused in history.left_out:
        whose = f", {unused.accelerometer}" if unused.accelerometer else ""
        yield Paragraph(f"{unused.file}{whose}: {unused.reason}.", "quiet")
    if count := len(history.passed_over):
        yield Paragraph(f"JSON files that are not results, ignored: {count}.", "quiet")


def _years(date: str) -> float:
    """Return a date as a year with decimals, years being equally long."""
    return 2000.0 + (datetime.fromisoformat(date) - datetime(2000, 1, 1)) / _YEAR


def _date(year: float) -> datetime:
    return datetime(2000, 1, 1) + (year - 2000.0) * _YEAR
