"""`counterspin check`: check a record while the run can still be repeated."""

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
from counterspin.monitoring.mean_run import MeanRun, check_mean, collect_mean_runs
from counterspin.monitoring.observer import Observer, RecordedRun, recorded_runs
from counterspin.monitoring.result import CheckedRun, CurrentEstimate, RunState
from counterspin.monitoring.run_state import (
    CurrentFit,
    current_estimates,
    fit_runs,
    list_displayed_names,
    make_poses_state,
    make_run_state,
    pose_remarks,
    run_remarks,
    undetermined_estimates,
)
from counterspin.planning.forecast import forecast
from counterspin.planning.recorded import add_pose_noise, apply_observations, fitted_noise
from counterspin.records.formats import find_opener
from counterspin.records.memory import MemoryTable, make_memory_table
from counterspin.threads import single_blas_thread


def check(record: object, campaign: Campaign | Path | str, *, run: str | None = None) -> CheckedRun:
    """Check the record of a run: clock, angle, rate, residuals and expected uncertainty.

    Parameters
    ----------
    record
        Record file, or a data frame as in `make_campaign`.
    campaign
        Campaign, its folder or its description; other records may be missing.
    run
        Name of the run; None: the run with this record file, or with the name of the file.

    Returns
    -------
    CheckedRun

    Raises
    ------
    CampaignError
        If the description is wrong, or the run cannot be identified.
    RecordError
        If the file is not found.
    """
    full_campaign = campaign if isinstance(campaign, Campaign) else read_campaign(campaign)
    with single_blas_thread():
        return _check_record(record, full_campaign, run)


def _check_record(record: object, campaign: Campaign, run_name: str | None) -> CheckedRun:
    file = Path(record).absolute() if isinstance(record, Path | str) else None
    if file is not None:
        if not file.exists():
            raise RecordError(f"{record}: file not found", code="file-not-found")
        find_opener(file)  # checked first: it does not depend on the run
    selected_run = _select_run(campaign, file, run_name)
    if file is None:
        table: MemoryTable = make_memory_table(f"{selected_run.name} in memory", record)
        campaign = replace(campaign, frames={**campaign.frames, selected_run.record: table})
    if isinstance(selected_run, MeanRun):
        return check_mean(campaign, selected_run, file or selected_run.record)
    checked_run = selected_run if file is None else _replace_file(selected_run, file)
    campaign = _map_records(campaign, lambda run: checked_run if run is selected_run else run)
    single_check = _check_single(campaign, checked_run)
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
    other_names, current_values = _fit_with_other_records(campaign, checked_run, single_check.fit)
    expected_values, missing_reason = _forecast_estimates(campaign, checked_run, single_check)
    return CheckedRun(
        run=single_check.state,
        remarks=single_check.remarks,
        # Too few poses in this record may suffice together with those of other records.
        good=single_check.is_good
        or (single_check.fit is None and any(c.u is not None for c in current_values)),
        others=other_names,
        reached=current_values,
        expected=expected_values,
        why_not=missing_reason,
    )


def _replace_file(run: RecordedRun, file: Path) -> RecordedRun:
    """Return a run, or a record of poses, with its record replaced by a file."""
    if isinstance(run, Run):
        return run.model_copy(update={"file": file})
    return replace(run, record=file)


def _map_records(
    campaign: Campaign, function: Callable[[RecordedRun], RecordedRun | None]
) -> Campaign:
    """Return a campaign with a function applied to its runs and pose records; None removes one."""
    runs = tuple(run for run in map(function, campaign.runs) if isinstance(run, Run))
    triad = campaign.triad
    if triad is not None:
        records = tuple(
            record for record in map(function, triad.records) if isinstance(record, PoseRecord)
        )
        triad = replace(triad, records=records)
    return replace(campaign, runs=runs, triad=triad)


def _select_run(
    campaign: Campaign, file: Path | None, run_name: str | None
) -> RecordedRun | MeanRun:
    """Return the run with a name or a record file."""
    candidates = (*recorded_runs(campaign), *collect_mean_runs(campaign))
    runs_by_name = {run.name: run for run in candidates}
    if run_name is not None:
        if run_name not in runs_by_name:
            raise CampaignError(
                "`run`",
                [f'no run is named "{run_name}"{suggest_name(run_name, list(runs_by_name))}'],
                code="unknown-run",
            )
        return runs_by_name[run_name]
    if file is not None:
        for run in candidates:
            if run.record == file or (run.record.exists() and run.record.samefile(file)):
                return run
        if file.stem in runs_by_name:
            return runs_by_name[file.stem]
        for run in candidates:
            if run.record.name == file.name:
                return run
    if len(candidates) == 1:
        return candidates[0]
    names_text = ", ".join(runs_by_name)
    problem = f"name a run: {names_text}" if names_text else "no run of the campaign has a record"
    raise UsageError("`run`", [problem])


@frozen
class _SingleCheck:
    """Check of a single record."""

    state: RunState
    remarks: list[str]
    is_good: bool
    fit: CurrentFit | None  # None if the record cannot be used
    observed_run: ObservedRun | None = None  # None for poses


def _check_single(campaign: Campaign, run: RecordedRun) -> _SingleCheck:
    """Return the check of a single record."""
    single_campaign = _map_records(
        replace(campaign, readings=()), lambda candidate: run if candidate is run else None
    )
    if single_campaign.triad is not None:
        single_campaign = replace(single_campaign, triad=replace(single_campaign.triad, poses=()))
    observer = Observer(single_campaign)
    observer.poll()
    usable_campaign, observed_runs = observer.read_usable_runs()
    poses = observer.find_poses(run.name)
    if not observed_runs and not poses:
        state = observer.unread_state(run.name)
        reason = state.why if state.state == "failed" else f"the record is too short: {state.why}"
        state = state.model_copy(update={"state": "failed", "why": reason})
        return _SingleCheck(state, [reason or ""], is_good=False, fit=None)
    fit, fit_error = None, ""
    try:
        fit = fit_runs(usable_campaign, observed_runs)
    except CounterspinError as error:
        fit_error = str(error)
    if isinstance(run, PoseRecord):
        state = make_poses_state(usable_campaign, run, poses, fit)
        remarks, is_good = pose_remarks(poses, fit)
        observed_run = None
    else:
        (observed_run,) = observed_runs
        state = make_run_state(usable_campaign, observed_run, fit.views if fit else ())
        remarks, is_good = (
            run_remarks(state, observed_run.record.report.notes(), fit.views)
            if fit
            else ([], False)
        )
    if fit is None:
        remarks, is_good = [fit_error, *remarks], False
    return _SingleCheck(state, remarks, is_good, fit, observed_run)


def _fit_with_other_records(
    campaign: Campaign, run: RecordedRun, fit: CurrentFit | None
) -> tuple[list[str], list[CurrentEstimate]]:
    """Return the names of other existing records, and the coefficients from all records.

    fit: Fit of this record alone; None if the record cannot be fitted alone.
    """

    def keep_existing_record(candidate: RecordedRun) -> RecordedRun | None:
        is_in_memory = candidate.record in campaign.frames
        return candidate if candidate is run or is_in_memory or candidate.record.exists() else None

    observer = Observer(_map_records(campaign, keep_existing_record))
    observer.poll()
    recorded_campaign, observed_runs = observer.read_usable_runs()
    other_names = [observed_run.run.name for observed_run in observed_runs]
    triad = recorded_campaign.triad
    other_names += [record.name for record in (triad.records if triad else ())]
    other_names.remove(run.name)
    if other_names or recorded_campaign.readings or recorded_campaign.posed:
        try:
            fit = fit_runs(recorded_campaign, observed_runs)
        except CounterspinError:
            other_names = []
    names = list_displayed_names(campaign)
    estimates = current_estimates(fit, names) if fit else undetermined_estimates(campaign, names)
    return other_names, estimates


def _forecast_estimates(
    campaign: Campaign, run: RecordedRun, single_check: _SingleCheck
) -> tuple[list[CurrentEstimate], str | None]:
    """Return the expected uncertainties of the complete campaign, or the reason for none."""
    if not campaign.runs:
        return [], None
    forecast_campaign, sampling_rate = campaign, None
    if single_check.observed_run is not None and single_check.fit is not None:
        duration = float(single_check.observed_run.record.time[-1])
        sampling_rate = 1.0 / single_check.observed_run.record.report.step
        runs = (
            listed_run.model_copy(update={"duration": duration})
            if listed_run is run
            else listed_run
            for listed_run in campaign.runs
        )
        noise = fitted_noise(single_check.fit.estimate.fit)
        forecast_campaign = apply_observations(
            replace(campaign, runs=tuple(runs)), [single_check.observed_run], noise
        )
    runs_without_duration = [
        listed_run.name for listed_run in forecast_campaign.runs if listed_run.duration is None
    ]
    if runs_without_duration:
        names_text = ", ".join(runs_without_duration)
        return [], f"the description does not state the duration of {names_text}"
    try:
        forecast_campaign = add_pose_noise(forecast_campaign)
        prediction = forecast(forecast_campaign, sampling_rate=sampling_rate)
    except CounterspinError as error:
        return [], str(error)
    names = list_displayed_names(campaign)
    estimates = current_estimates(CurrentFit(forecast_campaign, prediction.estimate), names)
    return [estimate.model_copy(update={"value": None}) for estimate in estimates], None
