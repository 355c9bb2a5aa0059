"""Printed report of the paper's figures, ours, and the demonstration."""

from __future__ import annotations

from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.pages.accelerometer import to_field_units
from counterspin.calibration.result_parts import AccelerometerResult
from counterspin.inference.two_stage.first_stage import Parabola
from counterspin.inference.two_stage.second_stage import StrobedRun
from counterspin.physics.terms import term
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Plot, PlotSeries, Table
from counterspin.reports.numbers import field_unit, format_estimate, format_number
from counterspin.reports.text import Report
from counterspin.reproduction.demo import Demonstration
from counterspin.reproduction.plan import PaperSection, Reproduction, Row

_COLUMNS = (
    Column("Quantity", wraps=True, narrowest=30),
    Column("Paper", align="right"),
    Column("counterspin", align="right"),
    Column("Unit", wraps=True),
    Column("Reason for the difference", wraps=True),
)


def reproduction_blocks(reproduction: Reproduction) -> list[Block]:
    """Return the comparison with the paper: quantity, paper, counterspin, unit, why."""
    blocks: list[Block] = []
    for section in reproduction.sections:
        blocks += [Heading(section.title), _table(section)]
    blocks.append(
        Paragraph(
            'The column "Paper" gives the printed value, or the value of the printed equation. '
            'The column "counterspin" gives the computed value. The derivations are in '
            "docs/paper.md.",
            "quiet",
        )
    )
    return blocks


def _table(section: PaperSection) -> Table:
    return Table(_COLUMNS, tuple(_cells(row) for row in section.rows))


def _cells(row: Row) -> tuple[str, ...]:
    return (row.quantity, row.printed_text, row.ours_text, row.unit, row.why)


#: Description in the file of the figure.
FILE_DESCRIPTION: Final = "a figure of the demonstration"


def demonstration_report(shown: Demonstration) -> Report:
    """Return the demonstration's table and its explanation."""
    campaign = shown.campaign
    methods = (shown.joint, shown.two_stage.result, shown.as_printed.result)
    table = Table(
        columns=(
            Column("Term"),
            Column("Truth"),
            Column("Joint", wraps=True),
            Column("Two-stage", wraps=True),
            Column("As printed", wraps=True),
            Column("Unit"),
        ),
        rows=tuple(
            (
                symbol,
                format_number(truth * field_unit(term(symbol).unit)[1], 12),
                *(_cell(method, symbol, symbol in campaign.model.considered) for method in methods),
                field_unit(term(symbol).unit)[0],
            )
            for symbol, truth in shown.truth.items()
        ),
        quiet=frozenset(
            row
            for row, symbol in enumerate(shown.truth)
            if not any(_is_estimated(method, symbol) for method in methods)
        ),
    )
    runs = len(campaign.runs)
    blocks: list[Block] = [
        Heading(f"{campaign.title}: {runs} runs of 100 revolutions were simulated and calibrated."),
        table,
        Paragraph(
            "The number after ± is the standard uncertainty (k = 1). g is the local gravity.",
            "quiet",
        ),
        Paragraph(
            "The joint method, the default of `calibrate`, fits all samples of all runs "
            "together with weights."
        ),
        Paragraph(
            "The two-stage method is the method of the paper, with one sample per revolution "
            "and exact equations."
        ),
        Paragraph(
            "The as-printed method uses the equations as printed in the paper. Their K_II term "
            "is twice the exact term, so these equations yield half the true K_II."
        ),
    ]
    return Report(blocks)


def _is_estimated(method: AccelerometerResult, symbol: str) -> bool:
    return symbol in method.coefficients and method.coefficients[symbol].estimated


def _cell(method: AccelerometerResult, symbol: str, considered: bool) -> str:
    if symbol not in method.coefficients:
        return "held" if considered else "-"
    coefficient = method.coefficients[symbol]
    if not coefficient.estimated:
        return "prior value" if coefficient.value is not None else "not determined"
    value, u, _ = to_field_units(coefficient)
    return format_estimate(value, u)


def demonstration_plots(shown: Demonstration) -> list[Plot]:
    """Return the plots of the two-stage method: K_II's parabola of each run, and the residuals.

    The parabola of K_F, which is the same at every rate and much larger, is subtracted from the
    displacement error, and so are the initial offset and velocity.
    """
    (name,) = shown.campaign.accelerometers
    bias = shown.two_stage.result.coefficients["K_F"].value
    assert bias is not None
    half = 0.5 * bias * shown.campaign.gravity.value
    upper: list[PlotSeries] = []
    lower: list[Plot] = []
    runs = shown.two_stage.second.runs
    end = 1.01 * max(float(run.parabola.strobes.time[-1]) for run in runs)
    reach = 1.15e3 * max(_largest(run.parabola) for run in runs)
    for index, run in enumerate(runs):
        time, error = run.parabola.strobes.time, run.parabola.strobes.error
        b0, b1, b2 = run.parabola.coefficients
        fine = np.linspace(0.0, time[-1], 100)
        upper.append(PlotSeries("", _tuple(fine), _tuple((b2 - half) * fine**2), colour=index))
        # All strobes would hide the curve; the plot of residuals shows them.
        some = slice(None, None, max(1, time.size // 25))
        deviation = (error - b0 - b1 * time - half * time**2)[some]
        words = f"{run.name}, {run.trajectory.spindle.rate:.4f} rad/s"
        upper.append(
            PlotSeries(
                words, _tuple(time[some]), _tuple(deviation), None, None, "points", colour=index
            )
        )
        lower.append(_residuals(run, index, (0.0, end), reach))
    return [
        Plot(
            title=f"{shown.campaign.title}: {name}, displacement error minus the parabola of K_F",
            x_label="time, s",
            y_label="displacement error, m",
            series=tuple(upper),
            levels=(0.0,),
            x_range=(0.0, end),
            height=1.3,
        ),
        *lower,
    ]


def _residuals(run: StrobedRun, index: int, x_range: tuple[float, float], reach: float) -> Plot:
    parabola = run.parabola
    time = _tuple(parabola.strobes.time)
    band = 2e3 * _sigma(parabola)
    ends = (time[0], time[-1])
    return Plot(
        title=f"{run.name}: strobes minus fitted parabola; band: ± 2 standard deviations",
        x_label="time, s",
        y_label="mm",
        series=(
            PlotSeries("", ends, (0.0, 0.0), (-band, -band), (band, band), "band", colour=index),
            PlotSeries(
                "", time, _tuple(1e3 * parabola.residuals), None, None, "points", colour=index
            ),
        ),
        levels=(0.0,),
        x_range=x_range,
        y_range=(-reach, reach),
        height=0.55,
    )


def _sigma(parabola: Parabola) -> float:
    """Return the standard deviation of a strobe, m."""
    # Strobes between two samples are means of both, so their noise is slightly smaller.
    return parabola.sigma * float(np.mean(parabola.strobes.noise_factor))


def _largest(parabola: Parabola) -> float:
    """Return the half-height of a plot that contains residuals and band, m."""
    return max(2.0 * _sigma(parabola), float(np.max(np.abs(parabola.residuals))))


def _tuple(values: Array) -> tuple[float, ...]:
    return tuple(values.tolist())
