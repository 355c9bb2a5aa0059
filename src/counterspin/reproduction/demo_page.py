"""The demonstration as a person sees it: truth beside every method, and the figure.

- `render_demonstration`: the table, as something that rich prints
- `demonstration_figure`: displacement error with its parabolas, residuals below
- `strobe_panels`: runs of the two-stage method as the figure draws them
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from counterspin.calibration.pages.accelerometer import in_field_units
from counterspin.calibration.result_parts import AccelerometerResult
from counterspin.inference.two_stage.second_stage import StrobedRun
from counterspin.physics.accelerometer import term
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.figure import StrobePanel, displacement_figure
from counterspin.reports.numbers import field_unit, format_estimate, format_number
from counterspin.reports.text import Report
from counterspin.reproduction.demo import Demonstration

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def render_demonstration(shown: Demonstration) -> Report:
    """Return the demonstration's table and what it means."""
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
        Heading(f"{campaign.title}: {runs} runs of 100 revolutions, simulated and calibrated"),
        table,
        Paragraph("± is one standard uncertainty (k = 1); g is the site's gravity.", "quiet"),
        Paragraph(
            "Joint: every sample of every run in one weighted fit, the default of `calibrate`."
        ),
        Paragraph("Two-stage: the paper's method, one sample a revolution, with exact equations."),
        Paragraph(
            "As printed: the paper's own equations. Their K_II term is twice the exact one, so "
            "that half of the true K_II comes back."
        ),
    ]
    return Report(blocks)


def _is_estimated(method: AccelerometerResult, symbol: str) -> bool:
    return symbol in method.coefficients and method.coefficients[symbol].estimated


def _cell(method: AccelerometerResult, symbol: str, considered: bool) -> str:
    if symbol not in method.coefficients:
        return "considered" if considered else "-"
    found = method.coefficients[symbol]
    if not found.estimated:
        return "known beforehand" if found.value is not None else "not determined"
    value, u, _ = in_field_units(found)
    return format_estimate(value, u)


def strobe_panels(runs: Iterable[StrobedRun]) -> list[StrobePanel]:
    """Return what the figure draws of each run's first stage."""
    panels = []
    for run in runs:
        parabola = run.parabola
        strobes = parabola.strobes
        panels.append(
            StrobePanel(
                run_name=run.name,
                rate=run.trajectory.spindle.rate,
                time=strobes.time,
                error=strobes.error,
                fitted=strobes.error - parabola.residuals,
                residual=parabola.residuals,
                # Strobes between two samples are means of both, and so a little quieter.
                sigma=parabola.sigma * float(np.mean(strobes.noise_factor)),
            )
        )
    return panels


def demonstration_figure(shown: Demonstration) -> Figure:
    """Return the figure of the exact two-stage method."""
    (name,) = shown.campaign.accelerometers
    return displacement_figure(
        strobe_panels(shown.two_stage.runs), title=f"{shown.campaign.title}: {name}"
    )
