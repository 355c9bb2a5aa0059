"""`counterspin watch`: monitoring of a campaign during recording."""

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
from counterspin.monitoring.observer import Observer, recorded_runs
from counterspin.monitoring.result import CurrentEstimate, RunState, WatchState
from counterspin.monitoring.run_state import (
    CurrentFit,
    current_estimates,
    fit_runs,
    goal_states,
    list_displayed_names,
    make_poses_state,
    make_run_state,
    resolve_goals,
    undetermined_estimates,
)
from counterspin.threads import single_blas_thread

#: Fraction of the stated duration from which a run is complete.
_COMPLETE_FRACTION: Final = 1.0 - 1e-3


@frozen
class Pace:
    """Polling interval, and share of the processor used by fits."""

    interval: float = 1.0  #: Polling interval, s.
    #: Fraction of one processor core that fits may use; long fits are repeated less often.
    share: float = 0.02

    def __post_init__(self) -> None:
        if not 0.0 < self.interval < 1e6:
            raise UsageError("watch", ["`interval`: must be greater than 0 s and less than 1e6 s"])
        if not 0.0 < self.share <= 1.0:
            raise UsageError("watch", ["`share`: must be greater than 0 and at most 1"])


_DEFAULT_PACE: Final = Pace()


def watch(
    where: Campaign | Path | str,
    *,
    goals: Sequence[str] | Mapping[str, float | str] | Path = (),
    pace: Pace = _DEFAULT_PACE,
    once: bool = False,
) -> Iterator[WatchState]:
    """Monitor the records of a campaign during recording.

    All data are kept in memory only; after a restart, the states continue unchanged. Only new rows
    of text tables are read; other files are read completely when they change.

    Parameters
    ----------
    where
        Campaign, its folder or its description.
    goals
        Goals such as ``K_II 1e-8 g/g^2``, a mapping name -> u, or a plan file with a ``target``.
    pace
        Polling interval, and share of the processor.
    once
        True: stop after one state; False: stop when every run has its stated duration.

    Yields
    ------
    WatchState
        The first state immediately, then a state after each change.

    Raises
    ------
    CampaignError
        If the description is wrong or has no runs with records, or a goal names an unknown term.
    """
    campaign = where if isinstance(where, Campaign) else read_campaign(where)
    if not recorded_runs(campaign):
        raise CampaignError(
            "watch",
            ["the campaign has no run whose record can be monitored"],
            code="method-not-applicable",
        )
    targets = resolve_goals(campaign, goals)
    return _iterate_states(campaign, targets, pace, once=once)


@dataclass
class _Schedule:
    """Times of the next poll and the next fit."""

    pace: Pace
    next_fit_time: float = 0.0

    def schedule_fit(self, seconds: float) -> None:
        self.next_fit_time = time.monotonic() + max(self.pace.interval, seconds / self.pace.share)

    def wait(self) -> None:
        time.sleep(self.pace.interval)


def _iterate_states(
    campaign: Campaign, goals: Mapping[str, float], pace: Pace, *, once: bool
) -> Iterator[WatchState]:
    observer, schedule = Observer(campaign, is_growing=True), _Schedule(pace)
    events: list[str] = []
    is_fit_due = True
    while True:
        has_changed, new_events = observer.poll()
        events += new_events
        is_fit_due |= has_changed
        if is_fit_due and time.monotonic() >= schedule.next_fit_time:
            fit_start_time = time.process_time()
            state = _make_watch_state(campaign, observer, goals, tuple(events))
            schedule.schedule_fit(time.process_time() - fit_start_time)
            events, is_fit_due = [], False
            yield state
            if once or state.complete:
                return
        schedule.wait()


def _make_watch_state(
    campaign: Campaign, observer: Observer, goals: Mapping[str, float], events: Sequence[str]
) -> WatchState:
    with single_blas_thread():
        usable_campaign, observed_runs = observer.read_usable_runs()
        fit, fit_error = None, None
        estimates: list[CurrentEstimate] = []
        if observed_runs or usable_campaign.readings or usable_campaign.posed:
            try:
                fit = fit_runs(usable_campaign, observed_runs)
                estimates = current_estimates(fit, list_displayed_names(campaign, goals))
            except CounterspinError as error:
                fit_error = str(error)
        runs = _make_run_states(campaign, observer, observed_runs, fit)
    if not estimates:
        estimates = undetermined_estimates(campaign, list_displayed_names(campaign, goals))
    return WatchState(
        title=campaign.title,
        runs=runs,
        coefficients=estimates,
        goals=goal_states(goals, estimates),
        events=list(events),
        trouble=fit_error,
        complete=all(map(_is_complete, runs)),
    )


def _make_run_states(
    campaign: Campaign,
    observer: Observer,
    observed_runs: Sequence[ObservedRun],
    fit: CurrentFit | None,
) -> list[RunState]:
    observed_by_name = {observed_run.run.name: observed_run for observed_run in observed_runs}
    states = []
    for run in recorded_runs(campaign):
        error = observer.read_status(run.name)[1]
        if isinstance(run, PoseRecord) and (poses := observer.find_poses(run.name)):
            state = make_poses_state(campaign, run, poses, fit)
        elif isinstance(run, Run) and run.name in observed_by_name:
            state = make_run_state(campaign, observed_by_name[run.name], fit.views if fit else ())
        else:
            states.append(observer.unread_state(run.name))
            continue
        states.append(state.model_copy(update={"why": error}))
    return states


def _is_complete(state: RunState) -> bool:
    stated_duration = state.stated_seconds
    return (
        state.state == "read"
        and stated_duration is not None
        and state.seconds >= _COMPLETE_FRACTION * stated_duration
    )
