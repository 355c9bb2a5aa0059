"""`counterspin watch`: the state of a campaign while its records grow."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from counterspin.calibration.observed_runs import ObservedRun
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.campaign.reading import PoseRecord
from counterspin.campaign.runs import Run
from counterspin.errors import CampaignError, CounterspinError, UsageError
from counterspin.frozen import frozen
from counterspin.monitoring.observer import Observer, recordings
from counterspin.monitoring.result import CurrentEstimate, RunState, WatchState
from counterspin.monitoring.run_state import (
    CurrentFit,
    current_estimates,
    displayed_names,
    fit_runs,
    goal_states,
    poses_state,
    resolve_goals,
    run_state,
    undetermined_estimates,
)
from counterspin.threads import single_blas_thread

#: Fraction of the stated duration from which a run is complete.
_COMPLETE_FRACTION: Final = 1.0 - 1e-3


@frozen
class Pace:
    """The interval between looks at the files, and the share of the processor."""

    interval: float = 1.0  #: Seconds between two looks.
    #: Part of one core that fits may take: the longer one takes, the later the next one.
    share: float = 0.02

    def __post_init__(self) -> None:
        if not (0.0 < self.interval < 1e6 and 0.0 < self.share <= 1.0):
            raise UsageError(
                "watch",
                [
                    (
                        "the interval must be greater than 0 s, and the share of a core must "
                        "be between 0 and 1"
                    )
                ],
            )


_DEFAULT_PACE: Final = Pace()


def watch(
    where: Campaign | Path | str,
    *,
    goals: Sequence[str] | Mapping[str, float | str] | Path = (),
    pace: Pace = _DEFAULT_PACE,
    once: bool = False,
) -> Iterator[WatchState]:
    """Follow the records of a campaign while they grow.

    The watch stores nothing except in memory: a restarted watch has the same states from then on.
    Of text tables only new rows are read; other files are read completely when they change.

    Parameters
    ----------
    where
        The campaign's folder, its description, or a campaign already read.
    goals
        Such as ``K_II 1e-8 g/g^2``, or name -> u, or the file of a plan, whose ``target`` counts.
    pace
        Interval between looks, and share of the processor.
    once
        True: stop after one state; False: the iterator ends only when every run is as long as
        the description states.

    Yields
    ------
    WatchState
        The first one at once, then whenever there is something new.

    Raises
    ------
    CampaignError
        If the description is wrong, has no runs with records, or a goal names no term of it.
    """
    campaign = where if isinstance(where, Campaign) else read_campaign(where)
    if not recordings(campaign):
        raise CampaignError(
            "watch",
            ["the campaign has no run whose record can be monitored"],
            code="method-not-applicable",
        )
    targets = resolve_goals(campaign, goals)
    return _iter_states(campaign, targets, pace, once=once)


@dataclass
class _Schedule:
    """The times of the next look and the next fit."""

    pace: Pace
    fit_due: float = 0.0

    def after_fit(self, cost: float) -> None:
        self.fit_due = time.monotonic() + max(self.pace.interval, cost / self.pace.share)

    def wait(self) -> None:
        time.sleep(self.pace.interval)


def _iter_states(
    campaign: Campaign, goals: Mapping[str, float], pace: Pace, *, once: bool
) -> Iterator[WatchState]:
    observer, clock = Observer(campaign, grow=True), _Schedule(pace)
    events: list[str] = []
    due = True
    while True:
        changed, new_events = observer.poll()
        events += new_events
        due |= changed
        if due and time.monotonic() >= clock.fit_due:
            begin = time.process_time()
            state = _watch_state(campaign, observer, goals, tuple(events))
            clock.after_fit(time.process_time() - begin)
            events, due = [], False
            yield state
            if once or state.complete:
                return
        clock.wait()


def _watch_state(
    campaign: Campaign, observer: Observer, goals: Mapping[str, float], events: Sequence[str]
) -> WatchState:
    with single_blas_thread():
        usable_campaign, observed = observer.usable_runs()
        fit, trouble = None, None
        estimates: list[CurrentEstimate] = []
        if observed or usable_campaign.readings or usable_campaign.posed:
            try:
                fit = fit_runs(usable_campaign, observed)
                estimates = current_estimates(fit, displayed_names(campaign, goals))
            except CounterspinError as error:
                trouble = str(error)
        runs = _run_states(campaign, observer, observed, fit)
    if not estimates:
        estimates = undetermined_estimates(campaign, displayed_names(campaign, goals))
    return WatchState(
        title=campaign.title,
        runs=runs,
        coefficients=estimates,
        goals=goal_states(goals, estimates),
        events=list(events),
        trouble=trouble,
        complete=all(map(_is_complete, runs)),
    )


def _run_states(
    campaign: Campaign, observer: Observer, observed: Sequence[ObservedRun], fit: CurrentFit | None
) -> list[RunState]:
    by_name = {observed_run.run.name: observed_run for observed_run in observed}
    states = []
    for run in recordings(campaign):
        trouble = observer.of(run.name)[1]
        if isinstance(run, PoseRecord) and (poses := observer.poses_of(run.name)):
            state = poses_state(campaign, run, poses, fit)
        elif isinstance(run, Run) and run.name in by_name:
            state = run_state(campaign, by_name[run.name], fit.views if fit else ())
        else:
            states.append(observer.unread_state(run.name))
            continue
        states.append(state.model_copy(update={"why": trouble}))
    return states


def _is_complete(state: RunState) -> bool:
    stated = state.stated_seconds
    return (
        state.state == "read"
        and stated is not None
        and state.seconds >= _COMPLETE_FRACTION * stated
    )
