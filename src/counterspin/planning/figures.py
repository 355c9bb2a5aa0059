"""The figures of a plan: uncertainty against total time and highest rate, and its sources."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.inference.joint.budget import budget
from counterspin.output import make_folder
from counterspin.physics.terms import symbol_of, term
from counterspin.planning.design import Design
from counterspin.planning.forecast import forecast
from counterspin.planning.plan_file import Plan
from counterspin.planning.result import Curve, Curves, PlanResult
from counterspin.planning.search import Search
from counterspin.reports.blocks import Plot, PlotSeries
from counterspin.reports.charts import reserve_figures, save
from counterspin.reports.numbers import field_unit

#: The files, in the order of `plan_plots`.
FIGURES: Final = ("plan-time.svg", "plan-rate.svg", "plan-sources.svg")

#: What each of them says that it is.
FIGURE: Final = "a figure of a plan"

#: Largest over least value up to which a figure is flat, and is drawn from zero.
_FLAT: Final = 1.1

#: Points of each curve.
_POINTS: Final = 9
#: Ends of the curves, as factors of the total time and of the highest rate.
_TIME_FACTORS: Final = (0.25, 4.0)
_RATE_FACTORS: Final = (0.4, 1.4)
_SOURCES_SHOWN: Final = 6


def plan_plots(result: PlanResult) -> tuple[Plot, Plot, Plot]:
    """Return the least u against the total time and against the highest rate, and its sources."""
    curves = result.curves
    if curves is None:
        raise ValueError("the result was computed without curves")
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


def curves_of(
    plan: Plan, design: Design, progress: Callable[[int, int], None] | None = None
) -> Curves:
    """Return the curves for the first coefficient of a plan's goal.

    progress: Called before each point with the number of those that are computed, and of all.
    """
    done = itertools.count()

    def factors(low: float, high: float) -> Iterator[float]:
        for factor in np.geomspace(low, high, _POINTS):
            if progress is not None:
                progress(next(done), 3 * _POINTS)
            yield float(factor)

    name = next(iter(plan.goal.sizes))
    search = Search(plan, reach=(_TIME_FACTORS[1], _RATE_FACTORS[1]))
    place = search.predictor.names.index(name)
    times, by_time = [], []
    start = design
    for factor in factors(*_TIME_FACTORS):
        total = plan.limits.total_time * factor
        free = plan.limits.longest_run >= plan.limits.total_time
        limits = replace(
            plan.limits,
            total_time=total,
            longest_run=total if free else min(plan.limits.longest_run, total),
        )
        if limits.possible:
            best = search.smallest(limits, start)
            times.append(total)
            by_time.append(float(search.predictor.u(best.design)[place]))
    rates, by_rate = [], []
    for factor in factors(*_RATE_FACTORS):
        high = plan.limits.rate[1] * factor
        if plan.limits.settings or high < plan.limits.rate[0]:
            continue
        limits = replace(plan.limits, rate=(plan.limits.rate[0], high))
        if limits.possible:
            best = search.smallest(limits)
            rates.append(high)
            by_rate.append(float(search.predictor.u(best.design)[place]))
    return Curves(
        coefficient=name,
        unit=term(symbol_of(name)).unit,
        time=Curve(x=times, u=by_time),
        rate=Curve(x=rates, u=by_rate),
        sources=_sources(search, design, name, factors(_RATE_FACTORS[0], 1.0)),
    )


def _sources(
    search: Search, design: Design, name: str, factors: Iterable[float]
) -> dict[str, Curve]:
    """Return each source's contribution against the rate, all runs' rates scaled together."""
    high = float(design.rate.max())
    contributions: dict[str, list[float]] = {}
    rates: list[float] = []
    for factor in factors:
        scaled = replace(design, rate=design.rate * factor, revolutions=design.revolutions * factor)
        predicted = forecast(search.campaign(scaled))
        index = [unknown.name for unknown in predicted.fit.model.unknowns].index(name)
        runs = {run.name for run in predicted.campaign.runs}
        squares: dict[str, float] = {}
        for line in budget(predicted.fit, index):
            owner, _, symbol = line.source.partition(".")
            words = "noise" if line.kind == "noise" else symbol if owner in runs else line.source
            squares[words] = squares.get(words, 0.0) + line.contribution**2
        for words in {*contributions, *squares}:
            values = contributions.setdefault(words, [0.0] * len(rates))
            values.append(math.sqrt(squares.get(words, 0.0)))
        rates.append(high * factor)
    largest = sorted(contributions, key=lambda words: -max(contributions[words]))[:_SOURCES_SHOWN]
    return {words: Curve(x=rates, u=contributions[words]) for words in largest}
