"""The figures of a plan: u against total time, against the highest rate, and where it comes from.

- `time_figure`, `rate_figure`, `source_figure`
- `save_figures`: all three as SVG
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from counterspin.output import make_folder
from counterspin.planning.result import Curve, Curves, PlanResult
from counterspin.reports.figure import COLOURS, MARKERS, SETTINGS, save
from counterspin.reports.numbers import field_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: File -> what it shows.
FIGURES: Final = ("plan-time.svg", "plan-rate.svg", "plan-sources.svg")


def time_figure(result: PlanResult) -> Figure:
    """Draw the least u against the total time (the Pareto front), and where this plan stands."""
    curves = _curves(result)
    return _draw(
        {"best plan": curves.time},
        curves,
        "total time / s",
        here=(result.total_time, _here(result, curves)),
        ends=False,
    )


def rate_figure(result: PlanResult) -> Figure:
    """Draw the least u against the highest rate allowed, and where this plan stands."""
    curves = _curves(result)
    fastest = max(abs(run.rate) for run in result.runs)
    return _draw(
        {"best plan": curves.rate},
        curves,
        "highest rate / (rad/s)",
        here=(fastest, _here(result, curves)),
        ends=False,
    )


def source_figure(result: PlanResult) -> Figure:
    """Draw what each source contributes to u, all rates of this plan scaled together."""
    curves = _curves(result)
    return _draw(curves.sources, curves, "rate of the fastest run / (rad/s)", here=None, ends=True)


def save_figures(result: PlanResult, folder: Path) -> tuple[Path, ...]:
    """Write the figures into a folder, which is made if it is not there.

    Raises
    ------
    CounterspinError
        If they cannot be written.
    """
    make_folder(folder)
    paths = tuple(folder / name for name in FIGURES)
    for path, draw in zip(paths, (time_figure, rate_figure, source_figure), strict=True):
        save(draw(result), path)
    return paths


def _curves(result: PlanResult) -> Curves:
    if result.curves is None:
        raise ValueError("the result was made without curves")
    return result.curves


def _here(result: PlanResult, curves: Curves) -> float | None:
    owner, _, symbol = curves.coefficient.partition(".")
    if owner in result.accelerometers:
        return result.accelerometers[owner].coefficients[symbol].u
    return result.platform[curves.coefficient].u


def _draw(
    lines: Mapping[str, Curve],
    curves: Curves,
    abscissa: str,
    *,
    here: tuple[float, float | None] | None,
    ends: bool,
) -> Figure:
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    unit, factor = field_unit(curves.unit)
    with mpl.rc_context(SETTINGS):
        figure = Figure(figsize=(6.4, 4.0), layout="constrained")
        axes = figure.subplots()
        for index, (words, curve) in enumerate(lines.items()):
            axes.plot(
                curve.x,
                factor * np.asarray(curve.u),
                color=COLOURS[index % len(COLOURS)],
                marker=MARKERS[index % len(MARKERS)],
                markersize=4.0,
                markerfacecolor="white",
                linewidth=1.2,
                label=words,
            )
        if here is not None and here[1] is not None:
            axes.plot(
                *(here[0], factor * here[1]),
                "*",
                color="black",
                markersize=10,
                label="this plan",
                linestyle="none",
            )
        axes.set_xscale("log")
        axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):
            low, high = axis.get_view_interval()
            # A range of less than a decade needs ticks between the powers of ten.
            between = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0) if high < 10.0 * low else (2.0, 5.0)
            axis.set_major_locator(LogLocator(subs=(1.0, *between)))
            axis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.set_minor_formatter(NullFormatter())
        axes.set_xlabel(abscissa)
        owner, _, symbol = curves.coefficient.partition(".")
        what = f"contribution to u({symbol})" if ends else f"u({symbol})"
        axes.set_ylabel(f"{what} of {owner} / ({unit})")
        axes.legend()
    return figure
