"""Active limits of a plan: the gain from relaxing each, and u against time and rate."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from counterspin.inference.joint.budget import budget
from counterspin.output import make_folder
from counterspin.physics.terms import symbol_of, term
from counterspin.planning.design import Criterion, Design, Limits, both_senses, fitted_into
from counterspin.planning.forecast import forecast
from counterspin.planning.optimisation import polish, shortest_plan
from counterspin.planning.plan_file import Plan
from counterspin.planning.result import Curve, Curves, LimitResult, PlanResult
from counterspin.planning.run_information import Predictor
from counterspin.planning.search import Search
from counterspin.reports.blocks import Plot, PlotSeries
from counterspin.reports.charts import reserve_figures, save
from counterspin.reports.numbers import field_unit

#: Part of a limit by which it is relaxed, and the smallest relative gain of u that is reported.
RELAXATION: Final = 0.1
GAIN: Final = 5e-4

#: Relative distance from a limit at which a plan touches it.
_TOUCHING_DISTANCE: Final = 2e-3


class _Limit(NamedTuple):
    """A limit that a plan touches, or that takes of its time."""

    key: str
    words: str
    touched: bool
    changes: dict[str, Any]  #: The fields of `Limits` that change if a limit is relaxed.


def limits_of(search: Search, design: Design) -> list[LimitResult]:
    """Return the binding limits and the gain from a tenth more of each, the largest gain first."""
    lines = []
    for limit in _limits(search, design):
        if limit.touched:
            gain = _gain(search, limit.key, replace(search.limits, **limit.changes), design)
            if gain > GAIN or limit.key == "senses":
                binds = gain > GAIN
                lines.append(LimitResult(key=limit.key, words=limit.words, binds=binds, gain=gain))
    return sorted(lines, key=lambda line: -line.gain)


def _limits(search: Search, design: Design) -> Iterator[_Limit]:
    limits, more, less = search.limits, 1.0 + RELAXATION, 1.0 - RELAXATION
    low, high = limits.rate
    below, above = 1.0 - _TOUCHING_DISTANCE, 1.0 + _TOUCHING_DISTANCE
    time, longest = limits.total_time, limits.longest_run
    spent = search.plan.goal.kind == "minimise" and limits.time(design) > time * below
    yield _Limit(
        "total_time", f"total time {time:.6g} s", spent, {"total_time": limits.total_time * more}
    )
    settings = (*limits.settings, high * more) if limits.settings else ()
    yield _Limit(
        "rate",
        f"highest rate {high:.6g} rad/s",
        bool((design.rate > high * below).any()),
        {"rate": (low, high * more), "settings": settings},
    )
    yield _Limit(
        "lowest_rate",
        f"lowest rate {low:.6g} rad/s",
        not limits.settings and bool((design.rate < low * above).any()),
        {"rate": (low * less, high)},
    )
    rates, runs = limits.fewest_rates, limits.runs
    yield _Limit("fewest_rates", f"{rates} rates at least", rates > 1, {"fewest_rates": rates - 1})
    more_runs = {"runs": math.ceil(runs * more)}
    yield _Limit("runs", f"{runs} runs at most", len(design.types) >= runs, more_runs)
    words = {
        "settling": f"settling {limits.settling:.4g} s a run",
        "spin_up": "time of spin-up and spin-down",
        "attitude_change": f"changing the attitude, {limits.attitude_change:.4g} s",
    }
    several = len({run_type.attitude for run_type in design.types}) > 1
    for key, text in words.items():
        size = getattr(limits, key)
        touched = size > 0.0 and (several or key != "attitude_change")
        yield _Limit(key, text, touched, {key: size * less})
    yield _Limit(
        "revolutions",
        f"{limits.revolutions:g} revolutions at least",
        bool((design.revolutions < limits.revolutions * above).any()),
        {"revolutions": limits.revolutions * less},
    )
    yield _Limit(
        "longest_run",
        f"longest run {longest:.6g} s",
        longest < time and bool((design.duration > longest * below).any()),
        {"longest_run": longest * more},
    )
    yield _Limit("sampling_rate", f"sampling rate {search.plan.sampling_rate:.6g} Hz", True, {})
    one_sense = all(run_type.sense == 1 for run_type in limits.types)
    yield _Limit("senses", "one sense of the spin", one_sense, {"types": both_senses(limits).types})


def _gain(search: Search, key: str, limits: Limits, design: Design) -> float:
    """Return the relative decrease of u (or of time) within relaxed limits."""
    predictor = search.predictor
    if search.plan.goal.kind == "target":
        before = math.log(search.limits.time(design))
    else:
        before = predictor.value(search.criterion, design)
    if key == "sampling_rate":
        faster = search.plan.sampling_rate * (1.0 + RELAXATION)
        predictor = Predictor(predictor.information.sampled_at(faster))
    starts = _starts(search, key, limits, design)
    after = min(before, *(_improve(search, predictor, limits, start) for start in starts))
    return 1.0 - math.exp(after - before)


def _starts(search: Search, key: str, limits: Limits, design: Design) -> list[Design]:
    """Return starting designs that use a relaxed limit where better lengths alone do not."""
    if key == "senses":
        turned = tuple(
            run_type._replace(sense=-run_type.sense) if index % 2 else run_type
            for index, run_type in enumerate(design.types)
        )
        return [design, replace(design, types=turned)]
    if key == "runs":
        more = limits.runs - len(design.types)
        # More of each type's shortest run: those are the ones there are many of.
        longest_first = np.argsort(-design.duration, kind="stable")
        run_types = {design.types[index]: index for index in longest_first}
        others = [
            Design(
                (run_type,) * more,
                np.repeat(design.rate[index], more),
                np.repeat(design.revolutions[index], more),
            )
            for run_type, index in run_types.items()
        ]
        return [design, *(design.joined(addition) for addition in others)]
    if key == "fewest_rates" and len(design.types) > 1:
        slower = search.limits.runs_apart(design.rate)[1:]
        return [design, *(design.without(index) for index in slower)]
    if key == "rate" and limits.settings:
        rate = np.where(design.rate == max(limits.settings[:-1]), limits.rate[1], design.rate)
        return [design, Design(design.types, rate, design.duration * rate / (2.0 * math.pi))]
    return [design]


def _improve(search: Search, predictor: Predictor, limits: Limits, design: Design) -> float:
    if search.plan.goal.kind == "target":
        singles = [
            Criterion((place,), (scale,))
            for place, scale in zip(search.criterion.places, search.criterion.scales, strict=True)
        ]
        shorter = shortest_plan(predictor, limits, singles, design)
        met = all(predictor.value(single, shorter) < 1e-5 for single in singles)
        return math.log(limits.time(shorter)) if met else math.inf
    start = fitted_into(design, limits) or design
    return polish(predictor, limits, search.criterion, start)[0]


# Figures

#: The files, in the order of `plan_plots`.
FIGURES: Final = ("plan-time.svg", "plan-rate.svg", "plan-sources.svg")

#: Title of each figure.
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
            point = PlotSeries("this plan", (at,), (factor * u,), kind="points", stands_out=True)
            series.append(point)
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

    overwrite: True: replace earlier figures; no other file is replaced.
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
            by_time.append(float(search.predictor.u(best.choice)[place]))
    rates, by_rate = [], []
    for factor in factors(*_RATE_FACTORS):
        high = plan.limits.rate[1] * factor
        if plan.limits.settings or high < plan.limits.rate[0]:
            continue
        limits = replace(plan.limits, rate=(plan.limits.rate[0], high))
        if limits.possible:
            best = search.smallest(limits)
            rates.append(high)
            by_rate.append(float(search.predictor.u(best.choice)[place]))
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
