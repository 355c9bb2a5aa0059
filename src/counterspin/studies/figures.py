"""The figures of a study: histogram of z, coverage, bias against what varied.

matplotlib is imported only when a figure is drawn.

- `z_figure`, `coverage_figure`, `bias_figure`
- `write_figures`: all of them, to a folder
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from counterspin.reports.figure import save
from counterspin.reports.numbers import field_unit
from counterspin.studies.result import CoefficientResult, StudyResult
from counterspin.studies.tally import LEVELS, Z_BINS, Z_EDGE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = ("#0072B2", "#D55E00", "#009E73")


def _all(result: StudyResult) -> list[tuple[str, CoefficientResult]]:
    return [
        (f"{analysis}: {name}", coefficient)
        for analysis, found in result.analyses.items()
        for name, coefficient in found.coefficients.items()
    ]


def z_figure(result: StudyResult) -> Figure:
    """Draw how error over claimed u is distributed, beside the normal distribution."""
    from matplotlib.figure import Figure

    chosen = _all(result)
    figure = Figure(figsize=(7.0, 1.8 * len(chosen)), layout="constrained")
    panels = figure.subplots(len(chosen), 1, sharex=True, squeeze=False)[:, 0]
    edges = np.linspace(-Z_EDGE, Z_EDGE, Z_BINS + 1)
    fine = np.linspace(-Z_EDGE, Z_EDGE, 241)
    for axes, (name, one) in zip(panels, chosen, strict=True):
        counts = np.array(one.histogram)
        density = counts[1:-1] / (counts.sum() * (edges[1] - edges[0]))
        axes.stairs(density, edges, fill=True, color=_COLOURS[0], alpha=0.5)
        axes.plot(fine, np.exp(-0.5 * fine**2) / np.sqrt(2.0 * np.pi), color="0.3", linewidth=0.9)
        beyond = 100.0 * (counts[0] + counts[-1]) / counts.sum()
        axes.set_title(f"{name} ({beyond:.3g} % beyond ± {Z_EDGE:g})", loc="left", fontsize=8)
        axes.set_ylabel("density")
    panels[-1].set_xlabel("error / claimed standard uncertainty")
    return figure


def coverage_figure(result: StudyResult) -> Figure:
    """Draw how often the intervals held the truth, with binomial intervals."""
    from matplotlib.figure import Figure

    chosen = _all(result)
    figure = Figure(figsize=(7.0, 1.2 + 0.5 * len(chosen)), layout="constrained")
    axes = figure.subplots()
    place = np.arange(len(chosen))
    for index, level in enumerate(LEVELS):
        share = np.array([one.covered[index] for _, one in chosen])
        low, high = np.array([one.intervals[index] for _, one in chosen]).T
        error = np.maximum(np.array([share - low, high - share]), 0.0)
        at = place + 0.25 * (index - 1)
        label = f"{100 * level:.0f} %"
        colour = _COLOURS[index]
        axes.barh(at, 100 * share, 0.22, xerr=100 * error, color=colour, alpha=0.7, label=label)
        axes.axvline(100 * level, color=colour, linewidth=0.8, linestyle="--")
    axes.set_yticks(place, [name for name, _ in chosen])
    axes.invert_yaxis()
    axes.set_xlabel("trials whose interval held the truth / %")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.15), ncols=3, frameon=False)
    return figure


def bias_figure(result: StudyResult, driver: str) -> Figure:
    """Draw the bias of each coefficient against one of the quantities that varied."""
    from matplotlib.figure import Figure

    chosen = _all(result)
    figure = Figure(figsize=(7.0, 1.8 * len(chosen)), layout="constrained")
    panels = figure.subplots(len(chosen), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, one) in zip(panels, chosen, strict=True):
        against = one.against[driver]
        columns = (against.value, against.trials, against.bias, against.se_bias)
        value, trials, bias, spread = (np.array(column, dtype=float) for column in columns)
        seen = trials > 1
        unit, factor = field_unit(one.unit)
        axes.axhline(0.0, color="0.4", linewidth=0.8)
        axes.errorbar(
            value[seen],
            factor * bias[seen],
            2.0 * factor * spread[seen],
            fmt="o",
            markersize=4,
            color=_COLOURS[0],
        )
        axes.set_title(name, loc="left", fontsize=8)
        axes.set_ylabel(f"bias / {unit}" if unit else "bias")
    panels[-1].set_xlabel(driver)
    return figure


def write_figures(result: StudyResult, folder: Path) -> None:
    """Write all figures of a study to a folder, as SVG."""
    save(z_figure(result), folder / "z.svg")
    save(coverage_figure(result), folder / "coverage.svg")
    for driver in dict.fromkeys(driver for _, one in _all(result) for driver in one.against):
        save(bias_figure(result, driver), folder / f"bias-{driver}.svg")
