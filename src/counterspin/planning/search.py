"""Search for a plan: its setup, its designs as campaigns, and the feasibility of its goal."""

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
from counterspin.planning.candidate_set import Optimum, relax_design
from counterspin.planning.design import (
    Design,
    Limits,
    RunType,
    allow_both_senses,
    measurement_order,
)
from counterspin.planning.forecast import Forecast, forecast, make_setup
from counterspin.planning.optimisation import minimise_time, optimise
from counterspin.planning.plan_file import Plan, campaign_document, resolve_plan_campaign
from counterspin.planning.run_information import Predictor, RunInformation
from counterspin.reports.numbers import format_distinct

#: Step of rounded durations, s; the minimum durations are exact.
_DURATION_STEP: Final = 0.1


class Search:
    """Search for the optimal runs of a plan."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.limits = plan.limits
        low, high = plan.limits.rate_range
        # Relaxed limits exceed the limits by a tenth.
        max_duration = min(plan.limits.max_duration * 1.11, plan.limits.total_time)
        max_revolutions = max_duration * 1.11 * high * 1.11 / (2.0 * math.pi)
        information = RunInformation(
            make_setup(plan.template, plan.sampling_rate),
            (low * 0.89, high * 1.11),
            (max(1.0, 0.89 * plan.limits.min_revolutions), max_revolutions),
            (1, -1),
        )
        self.predictor = Predictor(information)
        self.criterion = plan.goal.make_criterion(self.predictor.names)

    @cached_property
    def relaxed_predictor(self) -> Predictor | None:
        """A predictor that estimates the considered terms; None if there are none.

        It neglects changes from run to run, which can only reduce the information.
        """
        information = self.predictor.information
        if not information.is_time_dependent and not information.setup.considered_sds.size:
            return None
        setup = make_setup(self.plan.template, self.plan.sampling_rate, keep_considered=False)
        return Predictor(information.with_setup(setup))

    @property
    def has_bound(self) -> bool:
        """True if the relaxation bounds every plan.

        It does not with noise of the time stamps: samples at an extremum of the output are then
        most informative, and their number depends on many digits of the rate.
        """
        return not any(
            instrument.has_timing_noise
            for instrument in self.predictor.information.setup.instruments
        )

    def find_optimum(
        self, limits: Limits | None = None, start: Design | None = None
    ) -> Optimum[Design] | None:
        """Return the best plan, within `limits` if given; None if it misses the target."""
        limits = limits or self.limits
        if self.plan.goal.kind == "target":
            return minimise_time(
                self.predictor, limits, self.criterion, relaxed_predictor=self.relaxed_predictor
            )
        return self.minimise_u(limits, start)

    def minimise_u(
        self, limits: Limits | None = None, start: Design | None = None
    ) -> Optimum[Design]:
        """Return the plan with the smallest uncertainty, whatever the goal."""
        return optimise(
            self.predictor,
            limits or self.limits,
            self.criterion,
            relaxed_predictor=self.relaxed_predictor,
            start=start,
        )

    # From designs to campaigns

    def order_runs(self, design: Design) -> Design:
        """Return the runs in the order in which to make them."""
        return design.select(measurement_order(design.types))

    def round_design(self, design: Design, limits: Limits | None = None) -> Design:
        """Return the design with rounded durations and rates, within the limits.

        Durations are rounded down. The longest run gets the remaining time.

        limits: None: those of the plan.
        """
        limits = limits or self.limits
        rounded_design = self._round_down(design)
        if self.plan.goal.kind == "minimise":
            longest_index = int(np.argmax(rounded_design.duration))
            spare_time = limits.total_time - limits.campaign_time(rounded_design)
            max_extension = min(
                spare_time, limits.max_duration - float(rounded_design.duration[longest_index])
            )
            n_steps = math.floor(max_extension / _DURATION_STEP + 1e-6)
            if n_steps > 0:
                rounded_design = _lengthen(rounded_design, longest_index, n_steps * _DURATION_STEP)
        return rounded_design

    def lengthen_to_targets(self, design: Design, targets: Mapping[str, float]) -> Design | None:
        """Return the rounded design, lengthened until no u is above its target.

        Returns: None if the total time is too short.
        """
        rounded_design = self._round_down(design)
        indices = [self.predictor.names.index(name) for name in targets]
        target_u = np.array(list(targets.values()))
        while np.any(self.predictor.u(rounded_design)[indices] > target_u):
            # Lengthen the run that reduces u most by one step.
            candidates = [
                longer_design
                for index in range(len(rounded_design.types))
                if (longer_design := _lengthen(rounded_design, index, _DURATION_STEP)).duration[
                    index
                ]
                <= self.limits.max_duration * (1.0 + 1e-12)
            ]
            if (
                not candidates
                or self.limits.campaign_time(candidates[0]) > self.limits.total_time + 1e-9
            ):
                return None
            covariance = self.predictor.covariance(
                rounded_design.types,
                np.array([candidate.rate for candidate in candidates]),
                np.array([candidate.revolutions for candidate in candidates]),
                whole_samples=True,
            )
            u = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))[:, indices]
            rounded_design = candidates[int(np.argmin((u / target_u).max(axis=1)))]
        return rounded_design

    def _round_down(self, design: Design) -> Design:
        rate = np.array([self._round_rate(float(run_rate)) for run_rate in design.rate])
        min_durations = self.limits.min_revolutions * 2.0 * math.pi / rate
        steps = np.floor(design.duration / _DURATION_STEP + 1e-6)
        unrounded_durations = np.maximum(design.duration, min_durations)
        rounded_durations = steps * _DURATION_STEP
        feasible_durations = np.minimum(
            np.where(rounded_durations < min_durations, unrounded_durations, rounded_durations),
            self.limits.max_duration,
        )
        duration = np.round(feasible_durations, 9)
        return Design(design.types, rate, duration * rate / (2.0 * math.pi))

    def _round_rate(self, rate: float) -> float:
        """Return a rate with five digits; do not round a setting or a limit."""
        low, high = self.limits.rate_range
        if self.limits.rate_settings:
            return rate
        if rate > high * (1.0 - 1e-6):
            return high
        if rate < low * (1.0 + 1e-6):
            return low
        return min(max(float(f"{rate:.5g}"), low), high)

    def document(self, design: Design, title: str = "Planned campaign") -> dict[str, Any]:
        """Return the document of the campaign with the runs of a design."""
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
            attitude = self.plan.attitudes[run_type.attitude]
            runs.append(run if attitude == "level" else {**run, "attitude": attitude})
        return campaign_document(self.plan, runs, title)

    def campaign(self, design: Design) -> Campaign:
        """Return the campaign with the runs of a design."""
        return resolve_plan_campaign(self.document(design), self.plan.path)

    # Other plans in the same time

    def three_rate_design(self, design: Design, time: float) -> Design | None:
        """Return the paper's plan: 1/4, 1/2 and 1 times the highest rate, equal revolutions."""
        high = self.limits.rate_range[1]
        return self._make_equal_runs(
            design, time, np.array([0.25, 0.5, 1.0]) * high, equal_revolutions=True
        )

    def even_rate_design(self, design: Design, time: float) -> Design | None:
        """Return the same number of runs with equal durations at equally spaced rates."""
        n_attitudes = len(dict.fromkeys(run_type.attitude for run_type in design.types))
        count = max(2, len(design.types) // n_attitudes)
        rates = np.linspace(*self.limits.rate_range, count)
        return self._make_equal_runs(design, time, rates, equal_revolutions=False)

    def _make_equal_runs(
        self, design: Design, time: float, rates: Any, *, equal_revolutions: bool
    ) -> Design | None:
        """Return runs at given rates, in each attitude of the plan, that take a given time."""
        attitudes = list(dict.fromkeys(run_type.attitude for run_type in design.types))
        rate = np.tile(rates, len(attitudes))
        available_time = time - (len(attitudes) - 1) * self.limits.attitude_change
        available_time -= float(np.sum(self.limits.overhead(rate)))
        time_shares = 1.0 / rate if equal_revolutions else np.ones_like(rate)
        duration = available_time * time_shares / time_shares.sum()
        if available_time <= 0.0 or np.any(duration * rate < 2.0 * math.pi):
            return None
        types = tuple(RunType(attitude, 1) for attitude in attitudes for _ in rates)
        return Design(types, rate, duration * rate / (2.0 * math.pi))


def _lengthen(design: Design, index: int, seconds: float) -> Design:
    """Return the design with one run longer by `seconds`."""
    duration: Array = design.duration
    duration[index] = round(float(duration[index]) + seconds, 9)
    return replace(design, revolutions=duration * design.rate / (2.0 * math.pi))


#: Attitudes to try if the allowed attitudes are not sufficient.
_TRIAL_ATTITUDES: Final = ("90 deg about east", "90 deg about north", "90 deg about up")

#: Maximum number of sources of uncertainty in the error for a missed target.
_MAX_SOURCES: Final = 3

#: Factor of the total time that stands for unlimited time.
_UNLIMITED_TIME_FACTOR: Final = 1e4


def require_determined(search: Search) -> None:
    """Refuse a goal that no campaign within the limits determines."""
    assessment = _assess_run_types(search, search.predictor, search.limits.types)
    missing_names, text = describe_undetermined(
        assessment,
        search.plan.goal.sizes,
        "any campaign within these limits",
        f"in the allowed attitudes ({', '.join(search.plan.attitudes)}) ",
    )
    if not missing_names:
        return
    helpful_attitude = _find_helpful_attitude(search, missing_names)
    text += (
        f'. Also allow the attitude "{helpful_attitude}" (limits.attitudes)'
        if helpful_attitude
        else ". State priors for the other terms in [model.priors], or remove them from model.terms"
    )
    raise NotIdentifiableError(text + ".")


def describe_undetermined(
    assessment: Assessment, goal: Iterable[str], data_text: str, campaign_text: str = ""
) -> tuple[list[str], str]:
    """Return the undetermined unknowns of a goal, and the beginning of a sentence about them.

    data_text: Description of the data that do not determine the goal.
    campaign_text: Description of the campaign or plan.
    """
    missing_names = [name for name in goal if not assessment.determined[name]]
    if not missing_names:
        return [], ""
    others_text = f" (nor {', '.join(missing_names[1:])})" if missing_names[1:] else ""
    text = f"{missing_names[0]} is not determined by {data_text}{others_text}"
    confounded = [group for group in assessment.confounded if missing_names[0] in group.terms]
    return missing_names, text + (
        (f": {campaign_text}only {confounded[0].determined} is determined") if confounded else ""
    )


def describe_missed_target(
    prediction: Forecast, goal: Mapping[str, float], plans_text: str, best_text: str
) -> str:
    """Return the beginning of a sentence on the most exceeded target, its excess and the reason.

    plans_text: Description of the plans that do not reach the target.
    best_text: Description of the best of them, to which `prediction` applies.
    """
    u = prediction.u
    name = max(goal, key=lambda key: u[key] / goal[key])
    unit = term(find_symbol(name)).unit
    index = [unknown.name for unknown in prediction.fit.model.unknowns].index(name)
    share_by_source: dict[str, float] = {}
    for line in budget(prediction.fit, index):
        # Combine the terms of all runs, such as their tilts.
        owner, _, symbol = line.source.partition(".")
        is_run_term = owner in {run.name for run in prediction.campaign.runs}
        source = f"{symbol} of the runs" if is_run_term else line.source
        share_by_source[source] = share_by_source.get(source, 0.0) + line.share
    largest_shares = sorted(share_by_source.items(), key=lambda pair: -pair[1])[:_MAX_SOURCES]
    sources_text = ", ".join(f"{source} {100.0 * share:.0f} %" for source, share in largest_shares)
    return (
        f"{plans_text} reaches u({name}) = {format_distinct(goal[name], u[name])} {unit}. "
        f"{best_text} reaches {format_distinct(u[name], goal[name])} {unit}; the variance comes "
        f"from {sources_text}"
    )


def _assess_run_types(
    search: Search, predictor: Predictor, run_types: tuple[RunType, ...]
) -> Assessment:
    """Assess a campaign with all run types at four rates, each with the maximum duration."""
    limits = search.limits
    rates = np.array(limits.rate_settings or np.geomspace(*limits.rate_range, 4))
    durations = np.minimum(limits.max_duration, limits.total_time - limits.overhead(rates))
    revolutions = np.maximum(limits.min_revolutions, durations * rates / (2.0 * math.pi))
    types = tuple(run_type for run_type in run_types for _ in rates)
    rate, revolutions = (np.tile(values, len(run_types)) for values in (rates, revolutions))
    return assess_blocks(predictor, predictor.information.blocks(types, rate, revolutions))


def assess_blocks(predictor: Predictor, blocks: Array) -> Assessment:
    """Assess the blocks of a predictor in the same way as the blocks of a calibration."""
    setup = predictor.information.setup
    shared_unknowns = [setup.model.unknowns[i] for i in setup.shared_indices]
    p = predictor.p
    solution = least_squares.solve(
        [
            Block(
                block[:, :p],
                np.zeros(len(block)),
                block[:, p : p + predictor.common_sds.size],
                rss=0.0,
                rows=len(block),
                n_nuisance=0,
            )
            for block in blocks
        ],
        prior_sd=[unknown.prior[1] for unknown in shared_unknowns],
        prior_correlation=prior_correlation(shared_unknowns),
        considered_sd=predictor.common_sds,
        limits=[unknown.limit for unknown in shared_unknowns],
    )
    return assess(solution, [unknown.name for unknown in shared_unknowns if unknown.is_of_interest])


def _find_helpful_attitude(search: Search, missing_names: list[str]) -> str | None:
    """Return an attitude that would determine the missing coefficients; None if none does."""
    plan, limits = search.plan, search.limits
    run = plan.template.runs[0]
    for attitude in _TRIAL_ATTITUDES:
        if attitude in plan.attitudes:
            continue
        update = {"name": attitude, "stated_attitude": read_attitude(attitude)}
        new_run = run.model_copy(update=update)
        campaign = replace(plan.template, runs=(*plan.template.runs, new_run))
        max_revolutions = limits.max_duration * limits.rate_range[1] / (2.0 * math.pi)
        predictor = Predictor(
            RunInformation(
                make_setup(campaign, plan.sampling_rate),
                limits.rate_range,
                (limits.min_revolutions, max(max_revolutions, limits.min_revolutions)),
                (1, -1),
            )
        )
        senses = {run_type.sense for run_type in limits.types}
        run_types = (*limits.types, *(RunType(attitude, sense) for sense in sorted(senses)))
        assessment = _assess_run_types(search, predictor, run_types)
        if all(assessment.determined[name] for name in missing_names):
            return attitude
    return None


def unreachable_target_error(search: Search) -> CounterspinError:
    """Return the error for a target that no plan within the limits reaches."""
    optimum = search.minimise_u()
    goal: Mapping[str, float] = search.plan.goal.sizes
    text = describe_missed_target(
        forecast(search.campaign(optimum.design)),
        goal,
        f"no plan {'within the limits' if search.has_bound else 'found by the search'}",
        f"The best plan, which takes {search.limits.campaign_time(optimum.design):.4g} s,",
    )
    if len(goal) > 1:
        return CounterspinError(text + ".", code="goal-not-reached")
    ((name, target),) = goal.items()
    unit = term(find_symbol(name)).unit
    if search.has_bound:
        relaxed_limits = replace(
            search.limits,
            total_time=search.limits.total_time * _UNLIMITED_TIME_FACTOR,
            attitude_change=0.0,
        )
        _, relaxed_optimum = relax_design(
            search.relaxed_predictor or search.predictor, relaxed_limits, search.criterion
        )
        min_u = math.exp(relaxed_optimum.value) * target
        if min_u > target:
            text += f". With unlimited time, u would be {format_distinct(min_u, target)} {unit}"
    if all(run_type.sense == 1 for run_type in search.limits.types):
        both_senses_optimum = search.minimise_u(allow_both_senses(search.limits), optimum.design)
        u = search.predictor.u(both_senses_optimum.design)[search.predictor.names.index(name)]
        text += f", and with both senses of rotation {format_distinct(u, target)} {unit}"
    return CounterspinError(text + ".", code="goal-not-reached")
