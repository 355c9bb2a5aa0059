"""The reports' pictures of a result, on Matplotlib's axes.

- `residual_pictures`, `spectrum_pictures`, `budget_pictures`: of the result's own numbers
- `displacement_pictures`: of whole residuals, with what the fit makes of them
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from counterspin.calibration.notebook.residuals import RunResiduals
from counterspin.calibration.pages.pictures import (
    budget_bars,
    residual_spectra,
    residuals_over_time,
)
from counterspin.reports.blocks import Picture, Plot, PlotSeries

if TYPE_CHECKING:
    from counterspin.calibration.result import Result


def residual_pictures(result: Result, name: str) -> list[Picture]:
    """Return the residuals of an accelerometer over time, a picture a run."""
    return [*residuals_over_time(name, result.accelerometers[name], result.runs)]


def spectrum_pictures(result: Result, name: str) -> list[Picture]:
    """Return the spectra of an accelerometer's whitened residuals."""
    return [*residual_spectra(name, result.accelerometers[name], result.runs)]


def budget_pictures(result: Result, name: str, symbol: str) -> list[Picture]:
    """Return the contributions to the uncertainty of a coefficient."""
    bars = budget_bars(name, result.accelerometers[name], symbol)
    return [] if bars is None else [bars]


def displacement_pictures(residuals: Sequence[RunResiduals]) -> list[Picture]:
    """Return what was recorded less the reference, and the fit through it, a picture a run."""
    words = {"m": "displacement", "m/s": "velocity", "m/s^2": "specific force"}
    return [
        Plot(
            title=f"Error of the {words[left.unit]}: {left.accelerometer} in {left.run}",
            x_label="time, s",
            y_label=f"recorded less reference, {left.unit}",
            series=(
                PlotSeries(
                    "recorded", tuple(left.time), tuple(left.error), kind="points", colour=0
                ),
                PlotSeries("fitted", tuple(left.time), tuple(left.fitted), colour=1),
            ),
        )
        for left in residuals
    ]
