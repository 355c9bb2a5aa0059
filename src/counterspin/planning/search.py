"""The search for a plan: its problem, its designs as campaigns, whether its goal can be had."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.description import Campaign
from counterspin.campaign.quantity import read_attitude
from counterspin.errors import CounterspinError, NotIdentifiableError
from counterspin.inference import least_squares
from counterspin.inference.identifiability import Assessment, assess
from counterspin.inference.joint.budget import budget
from counterspin.inference.least_squares import Block
from counterspin.inference.priors import prior_correlation
from counterspin.physics.terms import find_symbol, term
from counterspin.planning.candidate_set import Optimum, relax
from counterspin.planning.design import (
    Design,
    Limits,
    RunType,
    allow_both_senses,
    measurement_order,
)
from counterspin.planning.forecast import Forecast, forecast, make_setup
from counterspin.planning.optimisation import least_time, optimise
from counterspin.planning.plan_file import Plan, campaign_document, resolve_plan_campaign
from counterspin.planning.run_information import Predictor, RunInformation
from counterspin.reports.numbers import format_distinct

#: Durations are written in multiples of this, s; those at the fewest revolutions exactly.
_DURATION_STEP: Final = 0.1


class Search:
    """A plan's problem."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.limits = plan.limits
        low, high = plan.limits.rate
        # A limit is relaxed by a tenth to find what it costs.
        longest = min(plan.limits.longest_run * 1.11, plan.limits.total_time)
        turns = longest * 1.11 * high * 1.11 / (2.0 * math.pi)
        information = RunInformation(
            make_setup(plan.template, plan.sampling_rate),
            (low * 0.89, high * 1.11),
            (max(1.0, 0.89 * plan.limits.revolutions), turns),
            (1, -1),
        )
        self.predictor = Predictor(information)
        self.criterion = plan.goal.criterion_of(self.predictor.names)

    @cached_property
    def relaxing(self) -> Predictor | None:
        """A predictor whose considered terms are estimated; None if it would be the same.

        It omits changes from run to run, which can only reduce the information.
        """
        information = self.predictor.information
        if not information.dated and not information.setup.considered_sizes.size:
            return None
        setup = make_setup(self.plan.template, self.plan.sampling_rate, with_considered=False)
        return Predictor(information.of_model(setup))

    @property
    def bounded(self) -> bool:
        """True if the relaxation bounds every plan: information must not depend on sample phases.

        With noise of the time stamps, samples at an extremum of the output are most informative,
        and their number depends on many digits of the rate.
        """
        return not any(
            instrument.scatters for instrument in self.predictor.information.setup.instruments
        )

    def best(
        self, limits: Limits | None = None, start: Design | None = None
    ) -> Optimum[Design] | None:
        """Return the best plan, within other limits if these are given; None: target missed."""
        limits = limits or self.limits
        if self.plan.goal.kind == "target":
            return least_time(self.predictor, limits, self.criterion, relaxing=self.relaxing)
        return self.smallest(limits, start)

    def smallest(
        self, limits: Limits | None = None, start: Design | None = None
    ) -> Optimum[Design]:
        """Return the plan with the smallest uncertainty, whatever the goal."""
        return optimise(
            self.predictor,
            limits or self.limits,
            self.criterion,
            relaxing=self.relaxing,
            start=start,
        )

    # From designs to campaigns

    def in_order(self, design: Design) -> Design:
        """Return the runs in the order in which to make them."""
        return design.select(measurement_order(design.types))

    def rounded(self, design: Design, limits: Limits | None = None) -> Design:
        """Return the design with durations and rates as they are written, still in the limits.

        Durations are rounded down. What that has left over of the total time is the longest run's.

        limits: None: those of the plan.
        """
        limits = limits or self.limits
        rounded = self._round_down(design)
        if self.plan.goal.kind == "minimise":
            longest = int(np.argmax(rounded.duration))
            spare = limits.total_time - limits.time(rounded)
            room = min(spare, limits.longest_run - float(rounded.duration[longest]))
            steps = math.floor(room / _DURATION_STEP + 1e-6)
            if steps > 0:
                rounded = _lengthen(rounded, longest, steps * _DURATION_STEP)
        return rounded

    def meeting(self, design: Design, targets: Mapping[str, float]) -> Design | None:
        """Return the rounded design, lengthened until no u is above its target.

        Returns: none if the total time does not suffice.
        """
        rounded = self._round_down(design)
        indices = [self.predictor.names.index(name) for name in targets]
        target_u = np.array(list(targets.values()))
        while np.any(self.predictor.u(rounded)[indices] > target_u):
            # One step more for the run that it helps most.
            candidates = [
                longer
                for index in range(len(rounded.types))
                if (longer := _lengthen(rounded, index, _DURATION_STEP)).duration[index]
                <= self.limits.longest_run * (1.0 + 1e-12)
            ]
            if not candidates or self.limits.time(candidates[0]) > self.limits.total_time + 1e-9:
                return None
            covariance = self.predictor.covariance(
                rounded.types,
                np.array([candidate.rate for candidate in candidates]),
                np.array([candidate.revolutions for candidate in candidates]),
                whole_samples=True,
            )
            u = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))[:, indices]
            rounded = candidates[int(np.argmin((u / target_u).max(axis=1)))]
        return rounded

    def _round_down(self, design: Design) -> Design:
        rate = np.array([self._rounded_rate(float(w)) for w in design.rate])
        fewest = self.limits.revolutions * 2.0 * math.pi / rate
        steps = np.floor(design.duration / _DURATION_STEP + 1e-6)
        shortest = np.maximum(design.duration, fewest)
        written = steps * _DURATION_STEP
        allowed = np.minimum(np.where(written < fewest, shortest, written), self.limits.longest_run)
        duration = np.round(allowed, 9)
        return Design(design.types, rate, duration * rate / (2.0 * math.pi))

    def _rounded_rate(self, rate: float) -> float:
        """Return a rate with five digits; a setting, or a limit that it touches, as it is."""
        low, high = self.limits.rate
        if self.limits.settings:
            return rate
        if rate > high * (1.0 - 1e-6):
            return high
        if rate < low * (1.0 + 1e-6):
            return low
        return min(max(float(f"{rate:.5g}"), low), high)

    def document(self, design: Design, title: str = "Planned campaign") -> dict[str, Any]:
        """Return the document of a campaign with these runs."""
        runs = []
        digits = len(str(len(design.types)))
        for index, run_type in enumerate(design.types):
            name = f"run{index + 1:0{digits}d}"
            rate = run_type.sense * float(design.rate[index])
            run = {
                "name": name,
                "rate": f"{rate!r} rad/s",
                "duration": f"{round(float(design.duration[index]), 9)!r} s",
                "record": f"{name}.csv",
            }
            written = self.plan.attitudes[run_type.attitude]
            runs.append(run if written == "level" else {**run, "attitude": written})
        return campaign_document(self.plan, runs, title)

    def campaign(self, design: Design) -> Campaign:
        """Return the campaign with these runs."""
        return resolve_plan_campaign(self.document(design), self.plan.path)

    # Other plans in the same time

    def three_rates(self, design: Design, time: float) -> Design | None:
        """Return the paper's plan: a quarter, half and all of the highest rate, equal turns."""
        high = self.limits.rate[1]
        return self._equal_runs(design, time, np.array([0.25, 0.5, 1.0]) * high, by_turns=True)

    def even_rates(self, design: Design, time: float) -> Design | None:
        """Return the same number of runs, of equal length, at equally spaced rates."""
        attitudes = len(dict.fromkeys(run_type.attitude for run_type in design.types))
        count = max(2, len(design.types) // attitudes)
        rates = np.linspace(*self.limits.rate, count)
        return self._equal_runs(design, time, rates, by_turns=False)

    def _equal_runs(
        self, design: Design, time: float, rates: Any, *, by_turns: bool
    ) -> Design | None:
        """Return runs at given rates, in each attitude of the plan, that take a given time."""
        attitudes = list(dict.fromkeys(run_type.attitude for run_type in design.types))
        rate = np.tile(rates, len(attitudes))
        available = time - (len(attitudes) - 1) * self.limits.attitude_change
        available -= float(np.sum(self.limits.overhead(rate)))
        share = 1.0 / rate if by_turns else np.ones_like(rate)
        duration = available * share / share.sum()
        if available <= 0.0 or np.any(duration * rate < 2.0 * math.pi):
            return None
        types = tuple(RunType(attitude, 1) for attitude in attitudes for _ in rates)
        return Design(types, rate, duration * rate / (2.0 * math.pi))


def _lengthen(design: Design, index: int, by: float) -> Design:
    """Return the design with one run longer, s."""
    duration: Array = design.duration
    duration[index] = round(float(duration[index]) + by, 9)
    return replace(design, revolutions=duration * design.rate / (2.0 * math.pi))


#: Attitudes that are tried where those allowed do not suffice.
_ATTITUDES_TRIED: Final = ("90 deg about east", "90 deg about north", "90 deg about up")

#: How many sources of uncertainty the error for a missed target names.
_SOURCES_NAMED: Final = 3

#: Factor of the total time that stands for unlimited time.
_UNLIMITED_TIME: Final = 1e4


def require_determined(search: Search) -> None:
    """Refuse a goal that no campaign within the limits determines, however it is spent."""
    assessment = _assess(search, search.predictor, search.limits.types)
    missing, text = not_determined(
        assessment,
        search.plan.goal.sizes,
        "any campaign within these limits",
        f"in the allowed attitudes ({', '.join(search.plan.attitudes)}) ",
    )
    if not missing:
        return
    helps = _find_helpful_attitude(search, missing)
    text += (
        f'. Also allow the attitude "{helps}" (limits.attitudes)'
        if helps
        else ". State priors for the other terms in [model.priors], or remove them from model.terms"
    )
    raise NotIdentifiableError(text + ".")


def not_determined(
    assessment: Assessment, goal: Iterable[str], by: str, where: str = ""
) -> tuple[list[str], str]:
    """Return the undetermined unknowns of a goal, and the beginning of a sentence about them.

    by, where: Words: the data that do not determine the goal; their campaign or plan.
    """
    missing_names = [name for name in goal if not assessment.determined[name]]
    if not missing_names:
        return [], ""
    also = f" (nor {', '.join(missing_names[1:])})" if missing_names[1:] else ""
    text = f"{missing_names[0]} is not determined by {by}{also}"
    confounded = [item for item in assessment.confounded if missing_names[0] in item.terms]
    return missing_names, text + (
        (f": {where}only {confounded[0].determined} is determined") if confounded else ""
    )


def words_of_missed_target(
    prediction: Forecast, goal: Mapping[str, float], none: str, best: str
) -> str:
    """Return the beginning of a sentence on the target missed most, its excess and the reason.

    none, best: Words: the plans that do not reach the target; the best of them, with this forecast.
    """
    u = prediction.u
    name = max(goal, key=lambda key: u[key] / goal[key])
    unit = term(find_symbol(name)).unit
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
        f"{none} reaches u({name}) = {format_distinct(goal[name], u[name])} {unit}. {best} "
        f"reaches {format_distinct(u[name], goal[name])} {unit}; the variance comes from "
        f"{sources}"
    )


def _assess(search: Search, predictor: Predictor, run_types: tuple[RunType, ...]) -> Assessment:
    """Assess a campaign with much of everything: all run types, four rates, all the time each."""
    limits = search.limits
    rates = np.array(limits.settings or np.geomspace(*limits.rate, 4))
    longest = np.minimum(limits.longest_run, limits.total_time - limits.overhead(rates))
    turns = np.maximum(limits.revolutions, longest * rates / (2.0 * math.pi))
    types = tuple(run_type for run_type in run_types for _ in rates)
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
        prior_correlation=prior_correlation(shared),
        considered_sd=predictor.common,
        limits=[unknown.limit for unknown in shared],
    )
    return assess(solution, [unknown.name for unknown in shared if unknown.is_of_interest])


def _find_helpful_attitude(search: Search, missing_names: list[str]) -> str | None:
    """Return an attitude with which the missing coefficients would be determined."""
    plan, limits = search.plan, search.limits
    run = plan.template.runs[0]
    for attitude in _ATTITUDES_TRIED:
        if attitude in plan.attitudes:
            continue
        new_run = run.model_copy(update={"name": attitude, "stand": read_attitude(attitude)})
        campaign = replace(plan.template, runs=(*plan.template.runs, new_run))
        turns = limits.longest_run * limits.rate[1] / (2.0 * math.pi)
        predictor = Predictor(
            RunInformation(
                make_setup(campaign, plan.sampling_rate),
                limits.rate,
                (limits.revolutions, max(turns, limits.revolutions)),
                (1, -1),
            )
        )
        senses = {run_type.sense for run_type in limits.types}
        run_types = (*limits.types, *(RunType(attitude, sense) for sense in sorted(senses)))
        assessment = _assess(search, predictor, run_types)
        if all(assessment.determined[name] for name in missing_names):
            return attitude
    return None


def unreachable(search: Search) -> CounterspinError:
    """Return the error for a target that no plan within the limits reaches."""
    optimum = search.smallest()
    goal: Mapping[str, float] = search.plan.goal.sizes
    text = words_of_missed_target(
        forecast(search.campaign(optimum.design)),
        goal,
        f"no plan {'within the limits' if search.bounded else 'found by the search'}",
        f"The best plan, which takes {search.limits.time(optimum.design):.4g} s,",
    )
    if len(goal) > 1:
        return CounterspinError(text + ".", code="goal-not-reached")
    ((name, target),) = goal.items()
    unit = term(find_symbol(name)).unit
    if search.bounded:
        unlimited = replace(
            search.limits,
            total_time=search.limits.total_time * _UNLIMITED_TIME,
            attitude_change=0.0,
        )
        _, relaxed = relax(search.relaxing or search.predictor, unlimited, search.criterion)
        floor = math.exp(relaxed.value) * target
        if floor > target:
            text += f". With unlimited time, u would be {format_distinct(floor, target)} {unit}"
    if all(run_type.sense == 1 for run_type in search.limits.types):
        both_senses = search.smallest(allow_both_senses(search.limits), optimum.design)
        u = search.predictor.u(both_senses.design)[search.predictor.names.index(name)]
        text += f", and with both senses of rotation {format_distinct(u, target)} {unit}"
    return CounterspinError(text + ".", code="goal-not-reached")
