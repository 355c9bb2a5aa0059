"""`counterspin check`: one record, checked while there is still time to make it again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from counterspin.calibration.observed_runs import ObservedRun
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.campaign.reading import PoseRecord
from counterspin.campaign.runs import Run
from counterspin.campaign.validation import suggest_name
from counterspin.errors import CampaignError, CounterspinError, RecordError, UsageError
from counterspin.frozen import frozen
from counterspin.monitoring.mean_run import MeanRun, check_mean, mean_runs
from counterspin.monitoring.observer import Observer, Recorded, recordings
from counterspin.monitoring.result import CheckedRun, CurrentEstimate, RunState
from counterspin.monitoring.run_state import (
    CurrentFit,
    current_estimates,
    displayed_names,
    fit_runs,
    pose_remarks,
    poses_state,
    run_remarks,
    run_state,
    undetermined_estimates,
)
from counterspin.planning.forecast import forecast
from counterspin.planning.recorded import add_pose_noise, apply_observations, fitted_noise
from counterspin.records.formats import find_opener
from counterspin.records.memory import MemoryTable, memory_table
from counterspin.threads import single_blas_thread


def check(
    record: object,
    campaign: Campaign | Path | str,
    *,
    run: str | None = None,
) -> CheckedRun:
    """Check the record of one run: clock, angle, rate, residuals, resulting uncertainty.

    Parameters
    ----------
    record
        The file, or a frame as `make_campaign` takes it.
    campaign
        The campaign, its folder or its description; not all its records need be there.
    run
        Which of its runs this is; None: the one whose record the file is, or that has its name.

    Returns
    -------
    CheckedRun

    Raises
    ------
    CampaignError
        If the description is wrong, or it is not clear which run this is.
    RecordError
        If the file is not found.
    """
    full_campaign = campaign if isinstance(campaign, Campaign) else read_campaign(campaign)
    with single_blas_thread():
        return _check_record(record, full_campaign, run)


def _check_record(record: object, campaign: Campaign, name: str | None) -> CheckedRun:
    file = Path(record).absolute() if isinstance(record, Path | str) else None
    if file is not None:
        if not file.exists():
            raise RecordError(f"{record}: file not found", code="file-not-found")
        find_opener(file)  # checked first: it does not depend on the run
    selected_run = _select_run(campaign, file, name)
    if file is None:
        table: MemoryTable = memory_table(f"{selected_run.name} in memory", record)
        campaign = replace(campaign, frames={**campaign.frames, selected_run.record: table})
    if isinstance(selected_run, MeanRun):
        return check_mean(campaign, selected_run, file or selected_run.record)
    campaign_with_file = selected_run if file is None else _replace_file(selected_run, file)
    campaign = _map_records(
        campaign, lambda run: campaign_with_file if run is selected_run else run
    )
    single_check = _check_single(campaign, campaign_with_file)
    if single_check.fit is None and single_check.state.poses is None:
        return CheckedRun(
            run=single_check.state,
            remarks=single_check.remarks,
            good=False,
            others=[],
            reached=[],
            expected=[],
            why_not="the record cannot be used in its present form",
        )
    others, reached = _check_with_others(campaign, campaign_with_file, single_check.fit)
    expected, reason = _expected_estimates(campaign, campaign_with_file, single_check)
    return CheckedRun(
        run=single_check.state,
        remarks=single_check.remarks,
        # Poses that are too few alone may suffice with those of other records.
        good=single_check.good
        or (single_check.fit is None and any(c.u is not None for c in reached)),
        others=others,
        reached=reached,
        expected=expected,
        why_not=reason,
    )


def _replace_file(run: Recorded, file: Path) -> Recorded:
    """Return a run, or a record of poses, with its record replaced by a file."""
    if isinstance(run, Run):
        return run.model_copy(update={"file": file})
    return replace(run, record=file)


def _map_records(campaign: Campaign, function: Callable[[Recorded], Recorded | None]) -> Campaign:
    """Return a campaign with a function applied to its runs and pose records; None removes one."""
    runs = tuple(run for run in map(function, campaign.runs) if isinstance(run, Run))
    triad = campaign.triad
    if triad is not None:
        records = tuple(
            record for record in map(function, triad.records) if isinstance(record, PoseRecord)
        )
        triad = replace(triad, records=records)
    return replace(campaign, runs=runs, triad=triad)


def _select_run(campaign: Campaign, file: Path | None, name: str | None) -> Recorded | MeanRun:
    """Return the run of a record."""
    recorded = (*recordings(campaign), *mean_runs(campaign))
    by_name = {run.name: run for run in recorded}
    if name is not None:
        if name not in by_name:
            raise CampaignError(
                "`run`",
                [f'no run is named "{name}"{suggest_name(name, list(by_name))}'],
                code="unknown-run",
            )
        return by_name[name]
    if file is not None:
        for run in recorded:
            if run.record == file or (run.record.exists() and run.record.samefile(file)):
                return run
        if file.stem in by_name:
            return by_name[file.stem]
        for run in recorded:
            if run.record.name == file.name:
                return run
    if len(recorded) == 1:
        return recorded[0]
    raise UsageError("`run`", [f"name a run: {', '.join(by_name) or 'no run has a record'}"])


@frozen
class _SingleCheck:
    """Check of a single record."""

    state: RunState
    remarks: list[str]
    good: bool
    fit: CurrentFit | None  # None if the record cannot be used
    observed: ObservedRun | None = None  # None for poses


def _check_single(campaign: Campaign, run: Recorded) -> _SingleCheck:
    """Return the check of a single record."""
    single_campaign = _map_records(
        replace(campaign, readings=()), lambda candidate: run if candidate is run else None
    )
    if single_campaign.triad is not None:
        single_campaign = replace(single_campaign, triad=replace(single_campaign.triad, poses=()))
    observer = Observer(single_campaign)
    observer.poll()
    part, observed = observer.usable_runs()
    poses = observer.poses_of(run.name)
    if not observed and not poses:
        state = observer.unread_state(run.name)
        reason = state.why if state.state == "failed" else f"the record is too short: {state.why}"
        state = state.model_copy(update={"state": "failed", "why": reason})
        return _SingleCheck(state, [reason or ""], good=False, fit=None)
    fit, refusal = None, ""
    try:
        fit = fit_runs(part, observed)
    except CounterspinError as error:
        refusal = str(error)
    if isinstance(run, PoseRecord):
        state = poses_state(part, run, poses, fit)
        remarks, good = pose_remarks(poses, fit)
        observed_run = None
    else:
        (observed_run,) = observed
        state = run_state(part, observed_run, fit.views if fit else ())
        remarks, good = (
            run_remarks(state, observed_run.record.report.notes(), fit.views)
            if fit
            else ([], False)
        )
    if fit is None:
        remarks, good = [refusal, *remarks], False
    return _SingleCheck(state, remarks, good, fit, observed_run)


def _check_with_others(
    campaign: Campaign, run: Recorded, fit: CurrentFit | None
) -> tuple[list[str], list[CurrentEstimate]]:
    """Return the other existing records, and the coefficients from all records together.

    fit: Fit of this record alone; None if it does not determine enough.
    """

    def existing_record(recorded: Recorded) -> Recorded | None:
        in_memory = recorded.record in campaign.frames
        return recorded if recorded is run or in_memory or recorded.record.exists() else None

    observer = Observer(_map_records(campaign, existing_record))
    observer.poll()
    usable_campaign, observed = observer.usable_runs()
    others = [item.run.name for item in observed]
    others += [
        item.name for item in (usable_campaign.triad.records if usable_campaign.triad else ())
    ]
    others.remove(run.name)
    if others or usable_campaign.readings or usable_campaign.posed:
        try:
            fit = fit_runs(usable_campaign, observed)
        except CounterspinError:
            others = []
    names = displayed_names(campaign)
    return others, current_estimates(fit, names) if fit else undetermined_estimates(campaign, names)


def _expected_estimates(
    campaign: Campaign, run: Recorded, single_check: _SingleCheck
) -> tuple[list[CurrentEstimate], str | None]:
    """Return the expected coefficients of the whole campaign with its other runs as described."""
    if not campaign.runs:
        return [], None
    completed, rate = campaign, None
    if single_check.observed is not None and single_check.fit is not None:
        seconds = float(single_check.observed.record.time[-1])
        rate = 1.0 / single_check.observed.record.report.step
        runs = (
            r.model_copy(update={"duration": seconds}) if r is run else r for r in campaign.runs
        )
        noise = fitted_noise(single_check.fit.estimate.fit)
        completed = apply_observations(
            replace(campaign, runs=tuple(runs)), [single_check.observed], noise
        )
    unknown = [r.name for r in completed.runs if r.duration is None]
    if unknown:
        return [], f"the description does not state the duration of {', '.join(unknown)}"
    try:
        completed = add_pose_noise(completed)
        predicted = forecast(completed, sampling_rate=rate)
    except CounterspinError as error:
        return [], str(error)
    names = displayed_names(campaign)
    lines = current_estimates(CurrentFit(completed, predicted.estimate), names)
    return [line.model_copy(update={"value": None}) for line in lines], None
