"""Whether a plan's goal can be had at all, and if not, what stands in the way."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.attitude import attitude_rows
from counterspin.errors import CounterspinError, NotIdentifiableError
from counterspin.inference import least_squares
from counterspin.inference.blocks import Block
from counterspin.inference.identifiability import Assessment, assess
from counterspin.inference.joint.budget import budget
from counterspin.physics.terms import symbol_of, term
from counterspin.planning.design import Predictor, RunType
from counterspin.planning.forecast import Forecast, forecast, setup_of
from counterspin.planning.limiting import both_senses
from counterspin.planning.relaxation import relax
from counterspin.planning.runs.run_information import RunInformation
from counterspin.planning.search import Search
from counterspin.reports.numbers import format_apart

#: Attitudes that are tried where those allowed do not suffice.
_ATTITUDES_TRIED: Final = ("90 deg about east", "90 deg about north", "90 deg about up")

#: How many sources of uncertainty the error for a missed target names.
_SOURCES_NAMED: Final = 3

#: Factor of the total time that stands for unlimited time.
_UNLIMITED_TIME: Final = 1e4


def require_determined(search: Search) -> None:
    """Refuse a goal that no campaign within the limits determines, however it is spent."""
    assessment = _assessed(search, search.predictor, search.limits.types)
    missing, text = not_determined(
        assessment,
        search.plan.goal.sizes,
        "any campaign within these limits",
        f"in the attitudes allowed ({', '.join(search.plan.attitudes)}) ",
    )
    if not missing:
        return
    helps = _helpful(search, missing)
    text += (
        f'. Allow the attitude "{helps}" too (limits.attitudes)'
        if helps
        else ". State what is known of the other terms in [model.priors], or remove "
        "them from model.terms"
    )
    raise NotIdentifiableError(text + ".")


def not_determined(
    assessment: Assessment, goal: Iterable[str], by: str, where: str = ""
) -> tuple[list[str], str]:
    """Return what of a goal is not determined, and a sentence without its end that says so.

    by, where: Words: what does not determine it; in what.
    """
    missing = [name for name in goal if not assessment.determined[name]]
    if not missing:
        return [], ""
    also = f" (nor are {', '.join(missing[1:])})" if missing[1:] else ""
    text = f"{missing[0]} is not determined by {by}{also}"
    confounded = [item for item in assessment.confounded if missing[0] in item.terms]
    return missing, text + (f": {where}only {confounded[0].determined} is" if confounded else "")


def missed(prediction: Forecast, goal: Mapping[str, float], none: str, best: str) -> str:
    """Return a sentence without its end: which target is missed most, by how much, and why.

    none, best: Words: what does not reach it; the best of these, whose forecast this is.
    """
    u = prediction.u
    name = max(goal, key=lambda key: u[key] / goal[key])
    unit = term(symbol_of(name)).unit
    index = [unknown.name for unknown in prediction.fit.model.unknowns].index(name)
    shares: dict[str, float] = {}
    for line in budget(prediction.fit, index):
        # The tilts of all runs are one source in words.
        owner, _, symbol = line.source.partition(".")
        of_run = owner in {run.name for run in prediction.campaign.runs}
        words = f"{symbol} of the runs" if of_run else line.source
        shares[words] = shares.get(words, 0.0) + line.share
    named = sorted(shares.items(), key=lambda pair: -pair[1])[:_SOURCES_NAMED]
    sources = ", ".join(f"{words} {100.0 * share:.0f} %" for words, share in named)
    return (
        f"{none} reaches u({name}) = {format_apart(goal[name], u[name])} {unit}. {best} has "
        f"{format_apart(u[name], goal[name])} {unit}, of whose square: {sources}"
    )


def _assessed(search: Search, predictor: Predictor, run_types: tuple[RunType, ...]) -> Assessment:
    """Assess a campaign with much of everything: all run types, four rates, all the time each."""
    limits = search.limits
    rates = np.array(limits.settings or np.geomspace(*limits.rate, 4))
    longest = np.minimum(limits.longest_run, limits.total_time - limits.overhead(rates))
    turns = np.maximum(limits.revolutions, longest * rates / (2.0 * math.pi))
    types = tuple(one for one in run_types for _ in rates)
    tell = predictor.information.blocks
    blocks = tell(types, np.tile(rates, len(run_types)), np.tile(turns, len(run_types)))
    return assess_blocks(predictor, blocks)


def assess_blocks(predictor: Predictor, blocks: Array) -> Assessment:
    """Assess blocks of a predictor as those of a calibration are, by the names of its unknowns."""
    setup = predictor.information.setup
    shared = [setup.model.unknowns[i] for i in setup.shared]
    p = predictor.p
    solution = least_squares.solve(
        [
            Block(
                block[:, :p],
                np.zeros(len(block)),
                block[:, p : p + predictor.common.size],
                rss=0.0,
                rows=len(block),
                nuisance=0,
            )
            for block in blocks
        ],
        prior_sd=[unknown.prior[1] for unknown in shared],
        considered_sd=predictor.common,
        limits=[unknown.limit for unknown in shared],
    )
    return assess(solution, [unknown.name for unknown in shared if unknown.asked])


def _helpful(search: Search, missing: list[str]) -> str | None:
    """Return an attitude with which the missing coefficients would be determined."""
    plan, limits = search.plan, search.limits
    run = plan.stand_in.runs[0]
    for words in _ATTITUDES_TRIED:
        if words in plan.attitudes:
            continue
        added = run.model_copy(update={"name": words, "attitude": attitude_rows(words)})
        campaign = replace(plan.stand_in, runs=(*plan.stand_in.runs, added))
        turns = limits.longest_run * limits.rate[1] / (2.0 * math.pi)
        predictor = Predictor(
            RunInformation(
                setup_of(campaign, plan.sampling_rate),
                limits.rate,
                (limits.revolutions, max(turns, limits.revolutions)),
                (1, -1),
            )
        )
        senses = {one.sense for one in limits.types}
        run_types = (*limits.types, *(RunType(words, sense) for sense in sorted(senses)))
        assessment = _assessed(search, predictor, run_types)
        if all(assessment.determined[name] for name in missing):
            return words
    return None


def unreachable(search: Search) -> CounterspinError:
    """Return the error for a target that no plan within the limits reaches."""
    best = search.smallest()
    goal: Mapping[str, float] = search.plan.goal.sizes
    text = missed(
        forecast(search.campaign(best.design)),
        goal,
        f"no plan {'within the limits' if search.bounded else 'that was found'}",
        f"The best, in {search.limits.time(best.design):.4g} s,",
    )
    if len(goal) > 1:
        return CounterspinError(text + ".")
    ((name, size),) = goal.items()
    unit = term(symbol_of(name)).unit
    if search.bounded:
        unlimited = replace(
            search.limits,
            total_time=search.limits.total_time * _UNLIMITED_TIME,
            attitude_change=0.0,
        )
        relaxed = relax(search.relaxing or search.predictor, unlimited, search.criterion)
        floor = math.exp(relaxed.value) * size
        if floor > size:
            text += f". With any amount of time it would be {format_apart(floor, size)} {unit}"
    if all(one.sense == 1 for one in search.limits.types):
        both = search.smallest(both_senses(search.limits), best.design)
        there = search.predictor.u(both.design)[search.predictor.names.index(name)]
        text += f", with both senses of the spin {format_apart(there, size)} {unit}"
    return CounterspinError(text + ".")
