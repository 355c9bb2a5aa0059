"""Reports of the reproduction of the paper and of the demonstration."""

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
from counterspin.reports.numbers import find_display_unit, format_estimate, format_number
from counterspin.reports.text import Report
from counterspin.reproduction.demo import Demonstration
from counterspin.reproduction.plan import PaperSection, Reproduction, Row

_COMPARISON_COLUMNS = (
    Column("Quantity", wraps=True, min_width=30),
    Column("Paper", align="right"),
    Column("counterspin", align="right"),
    Column("Unit", wraps=True),
    Column("Reason for the difference", wraps=True),
)


def reproduction_blocks(reproduction: Reproduction) -> list[Block]:
    """Return the tables of the comparison with the paper, a table for each section."""
    blocks: list[Block] = []
    for section in reproduction.sections:
        blocks += [Heading(section.title), _section_table(section)]
    blocks.append(
        Paragraph(
            'The column "Paper" gives the printed value, or the value that the printed equation '
            'gives. The column "counterspin" gives the computed value. The derivations are in '
            "docs/paper.md.",
            "quiet",
        )
    )
    return blocks


def _section_table(section: PaperSection) -> Table:
    return Table(_COMPARISON_COLUMNS, tuple(_row_cells(row) for row in section.rows))


def _row_cells(row: Row) -> tuple[str, ...]:
    return (row.quantity, row.printed_text, row.ours_text, row.unit, row.why)


#: Description in the file of the figure.
FILE_DESCRIPTION: Final = "a figure of the demonstration"


def demonstration_report(demonstration: Demonstration) -> Report:
    """Return the table of the coefficients by each method, with an explanation."""
    campaign = demonstration.campaign
    results = (demonstration.joint, demonstration.two_stage.result, demonstration.as_printed.result)
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
                format_number(true_value * find_display_unit(term(symbol).unit)[1], 12),
                *(
                    _coefficient_text(result, symbol, symbol in campaign.model.considered)
                    for result in results
                ),
                find_display_unit(term(symbol).unit)[0],
            )
            for symbol, true_value in demonstration.truth.items()
        ),
        quiet_rows=frozenset(
            row
            for row, symbol in enumerate(demonstration.truth)
            if not any(_is_estimated(result, symbol) for result in results)
        ),
    )
    n_runs = len(campaign.runs)
    blocks: list[Block] = [
        Heading(
            f"{campaign.title}: {n_runs} runs of 100 revolutions were simulated and calibrated."
        ),
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


def _is_estimated(result: AccelerometerResult, symbol: str) -> bool:
    return symbol in result.coefficients and result.coefficients[symbol].estimated


def _coefficient_text(result: AccelerometerResult, symbol: str, is_considered: bool) -> str:
    if symbol not in result.coefficients:
        return "held" if is_considered else "-"
    coefficient = result.coefficients[symbol]
    if not coefficient.estimated:
        return "prior value" if coefficient.value is not None else "not determined"
    value, u, _ = to_field_units(coefficient)
    return format_estimate(value, u)


def demonstration_plots(demonstration: Demonstration) -> list[Plot]:
    """Return the plots of the two-stage method: K_II's parabola of each run, and the residuals.

    The parabola of K_F, which is the same at every rate and much larger, is subtracted from the
    displacement error, and so are the initial offset and velocity.
    """
    (name,) = demonstration.campaign.accelerometers
    bias = demonstration.two_stage.result.coefficients["K_F"].value
    assert bias is not None
    bias_curvature = 0.5 * bias * demonstration.campaign.gravity.value
    displacement_series: list[PlotSeries] = []
    residual_plots: list[Plot] = []
    runs = demonstration.two_stage.second_stage.runs
    time_limit = 1.01 * max(float(run.parabola.strobes.time[-1]) for run in runs)
    residual_limit = 1.15e3 * max(_residual_limit(run.parabola) for run in runs)
    for run_index, run in enumerate(runs):
        time, error = run.parabola.strobes.time, run.parabola.strobes.error
        b0, b1, b2 = run.parabola.coefficients
        fine_time = np.linspace(0.0, time[-1], 100)
        displacement_series.append(
            PlotSeries(
                "",
                _to_tuple(fine_time),
                _to_tuple((b2 - bias_curvature) * fine_time**2),
                colour=run_index,
            )
        )
        # All strobes would hide the curve; the plot of residuals shows them.
        plotted_slice = slice(None, None, max(1, time.size // 25))
        displacement = (error - b0 - b1 * time - bias_curvature * time**2)[plotted_slice]
        label = f"{run.name}, {run.trajectory.spindle.rate:.4f} rad/s"
        displacement_series.append(
            PlotSeries(
                label,
                _to_tuple(time[plotted_slice]),
                _to_tuple(displacement),
                None,
                None,
                "points",
                colour=run_index,
            )
        )
        residual_plots.append(_residual_plot(run, run_index, (0.0, time_limit), residual_limit))
    return [
        Plot(
            title=f"{demonstration.campaign.title}: {name}, "
            "displacement error minus the parabola of K_F",
            x_label="time, s",
            y_label="displacement error, m",
            series=tuple(displacement_series),
            levels=(0.0,),
            x_range=(0.0, time_limit),
            height=1.3,
        ),
        *residual_plots,
    ]


def _residual_plot(
    run: StrobedRun, run_index: int, x_range: tuple[float, float], residual_limit: float
) -> Plot:
    parabola = run.parabola
    time = _to_tuple(parabola.strobes.time)
    band_half_width = 2e3 * _strobe_sigma(parabola)
    time_range = (time[0], time[-1])
    return Plot(
        title=f"{run.name}: strobes minus fitted parabola; band: ± 2 standard deviations",
        x_label="time, s",
        y_label="mm",
        series=(
            PlotSeries(
                "",
                time_range,
                (0.0, 0.0),
                (-band_half_width, -band_half_width),
                (band_half_width, band_half_width),
                "band",
                colour=run_index,
            ),
            PlotSeries(
                "",
                time,
                _to_tuple(1e3 * parabola.residuals),
                None,
                None,
                "points",
                colour=run_index,
            ),
        ),
        levels=(0.0,),
        x_range=x_range,
        y_range=(-residual_limit, residual_limit),
        height=0.55,
    )


def _strobe_sigma(parabola: Parabola) -> float:
    """Return the standard deviation of a strobe, m."""
    # Strobes between two samples are means of both, so their noise is slightly smaller.
    return parabola.sigma * float(np.mean(parabola.strobes.noise_factor))


def _residual_limit(parabola: Parabola) -> float:
    """Return the half-height of a plot that contains residuals and band, m."""
    return max(2.0 * _strobe_sigma(parabola), float(np.max(np.abs(parabola.residuals))))


def _to_tuple(values: Array) -> tuple[float, ...]:
    return tuple(values.tolist())
