"""Whether a plan's goal can be had at all, what limits the plan, and what it would gain without."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.attitude import read_attitude
from counterspin.errors import CounterspinError, NotIdentifiableError
from counterspin.inference import least_squares
from counterspin.inference.blocks import Block
from counterspin.inference.identifiability import Assessment, assess
from counterspin.inference.joint.budget import budget
from counterspin.physics.terms import symbol_of, term
from counterspin.planning.design import Criterion, Design, Limits, Predictor, RunType
from counterspin.planning.forecast import Forecast, forecast, setup_of
from counterspin.planning.polishing import fitted_into, polish, shortest_plan
from counterspin.planning.possibilities import relax
from counterspin.planning.result import LimitResult
from counterspin.planning.run_information import RunInformation
from counterspin.planning.search import Search
from counterspin.reports.numbers import format_apart

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
    changes: dict[str, Any]  #: The fields of `Limits` that are others if it gives way.


def limits_of(search: Search, design: Design) -> list[LimitResult]:
    """Return which limits bind and what a tenth more would gain, the largest gain first."""
    lines = []
    for limit in _limits(search, design):
        if limit.touched:
            gain = _gain(search, limit.key, replace(search.limits, **limit.changes), design)
            if gain > GAIN or limit.key == "senses":
                binds = gain > GAIN
                lines.append(LimitResult(key=limit.key, words=limit.words, binds=binds, gain=gain))
    return sorted(lines, key=lambda line: -line.gain)


def both_senses(limits: Limits) -> Limits:
    """Return the limits with both senses of the spin allowed in every attitude."""
    attitudes = dict.fromkeys(run_type.attitude for run_type in limits.types)
    types = tuple(RunType(attitude, sense) for attitude in attitudes for sense in (1, -1))
    return replace(limits, types=types)


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
    one = all(run_type.sense == 1 for run_type in limits.types)
    yield _Limit("senses", "one sense of the spin", one, {"types": both_senses(limits).types})


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
    after = min(before, *(_improved(search, predictor, limits, start) for start in starts))
    return 1.0 - math.exp(after - before)


def _starts(search: Search, key: str, limits: Limits, design: Design) -> list[Design]:
    """Return designs that make use of a relaxed limit, where better lengths alone do not."""
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
        return [design, *(design.joined(other) for other in others)]
    if key == "fewest_rates" and len(design.types) > 1:
        slower = search.limits.runs_apart(design.rate)[1:]
        return [design, *(design.without(index) for index in slower)]
    if key == "rate" and limits.settings:
        rate = np.where(design.rate == max(limits.settings[:-1]), limits.rate[1], design.rate)
        return [design, Design(design.types, rate, design.duration * rate / (2.0 * math.pi))]
    return [design]


def _improved(search: Search, predictor: Predictor, limits: Limits, design: Design) -> float:
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


def words_of_missed_target(
    prediction: Forecast, goal: Mapping[str, float], none: str, best: str
) -> str:
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
        added = run.model_copy(update={"name": words, "stand": read_attitude(words)})
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
    text = words_of_missed_target(
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
