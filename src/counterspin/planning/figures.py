"""The figures of a plan: uncertainty against total time and highest rate, and its sources."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from counterspin.output import make_folder
from counterspin.planning.result import Curve, PlanResult
from counterspin.reports.blocks import Plot, PlotSeries
from counterspin.reports.charts import reserve_figures, save
from counterspin.reports.numbers import field_unit

#: The files, in the order of `plan_plots`.
FIGURES: Final = ("plan-time.svg", "plan-rate.svg", "plan-sources.svg")

#: What each of them says that it is.
FIGURE: Final = "a figure of a plan"

#: Largest over least value up to which a figure is flat, and is drawn from zero.
_FLAT: Final = 1.1


def plan_plots(result: PlanResult) -> tuple[Plot, Plot, Plot]:
    """Return the least u against the total time and against the highest rate, and its sources."""
    curves = result.curves
    if curves is None:
        raise ValueError("the result was made without curves")
    unit, factor = field_unit(curves.unit)
    owner, _, symbol = curves.coefficient.partition(".")
    if owner in result.accelerometers:
        u = result.accelerometers[owner].coefficients[symbol].u
    else:
        u = result.platform[curves.coefficient].u
    fastest = max(abs(run.rate) for run in result.runs)

    def plot(title: str, x_label: str, lines: Mapping[str, Curve], at: float | None) -> Plot:
        series = []
        for index, (words, curve) in enumerate(lines.items()):
            x, y = tuple(curve.x), tuple(factor * value for value in curve.u)
            series.append(PlotSeries("", x, y, colour=index))
            series.append(PlotSeries(words, x, y, kind="points", colour=index))
        if at is not None and u is not None:
            here = PlotSeries("this plan", (at,), (factor * u,), kind="points", stands_out=True)
            series.append(here)
        y_label = f"u({symbol})" if at is not None else "contribution"
        values = [factor * value for curve in lines.values() for value in curve.u]
        values += [factor * u] if at is not None and u is not None else []
        # On a logarithmic axis a flat line would have ticks that differ in the last digit.
        flat = max(values) < _FLAT * min(values)
        return Plot(
            title,
            x_label,
            f"{y_label}, {unit}",
            tuple(series),
            log_x=True,
            log_y=not flat,
            y_range=(0.0, 1.2 * max(values)) if flat else None,
            height=1.4,
        )

    return (
        plot(
            f"Least u({symbol}) of {owner} in a total time",
            "total time, s",
            {"best plan": curves.time},
            result.total_time,
        ),
        plot(
            f"Least u({symbol}) of {owner} up to a rate",
            "highest rate, rad/s",
            {"best plan": curves.rate},
            fastest,
        ),
        plot(
            f"Where u({symbol}) of {owner} comes from, all rates of this plan scaled together",
            "rate of the fastest run, rad/s",
            curves.sources,
            None,
        ),
    )


def save_figures(
    result: PlanResult, folder: Path | str, *, overwrite: bool = False
) -> tuple[Path, ...]:
    """Write the figures into a folder, which is made if it is not there.

    overwrite: Whether earlier figures may be replaced; no other file is.
    """
    paths = tuple(Path(folder) / name for name in FIGURES)
    reserve_figures(paths, FIGURE, overwrite=overwrite)
    make_folder(Path(folder))
    for path, plot in zip(paths, plan_plots(result), strict=True):
        save([plot], path, FIGURE, overwrite=overwrite)
    return paths
