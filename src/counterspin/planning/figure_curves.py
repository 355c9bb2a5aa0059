"""The curves of a plan's figures: uncertainty against time and rate, and its sources."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.inference.joint.budget import budget
from counterspin.physics.terms import symbol_of, term
from counterspin.planning.design import Design
from counterspin.planning.forecast import forecast
from counterspin.planning.plan_file import Plan
from counterspin.planning.result import Curve, Curves
from counterspin.planning.search import Search

#: Points of each curve.
_POINTS: Final = 9
#: Ends of the curves, as factors of the total time and of the highest rate.
_TIME_FACTORS: Final = (0.25, 4.0)
_RATE_FACTORS: Final = (0.4, 1.4)
_SOURCES_SHOWN: Final = 6


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
