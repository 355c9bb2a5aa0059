"""`counterspin check`: one record, checked while there is still time to make it again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from counterspin.calibration.observed import ObservedRun
from counterspin.campaign.checking import did_you_mean
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.campaign.reading import PoseRecord
from counterspin.campaign.runs import Run
from counterspin.errors import CampaignError, CounterspinError, RecordError
from counterspin.frozen import frozen
from counterspin.monitoring.mean_run import MeanRun, check_mean, mean_runs
from counterspin.monitoring.observer import Observer, Recorded, recordings
from counterspin.monitoring.result import CheckedRun, ReachedCoefficient, RunState
from counterspin.monitoring.run_state import (
    FitSoFar,
    joint_fit_of,
    nothing_reached,
    poses_state,
    reached_coefficients,
    remarks_of,
    remarks_of_poses,
    run_state,
    shown_names,
)
from counterspin.planning.forecast import forecast
from counterspin.planning.recorded import as_recorded, noise_of_fit, with_pose_noise
from counterspin.records.formats import opener_of
from counterspin.records.frames import memory_table
from counterspin.records.memory import MemoryTable
from counterspin.threads import one_blas_thread


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
        If file not found.
    """
    full_campaign = campaign if isinstance(campaign, Campaign) else read_campaign(campaign)
    with one_blas_thread():
        return _checked(record, full_campaign, run)


def _checked(record: object, campaign: Campaign, name: str | None) -> CheckedRun:
    file = Path(record).absolute() if isinstance(record, Path | str) else None
    if file is not None:
        if not file.exists():
            raise RecordError(f"{file}: file not found.")
        opener_of(file)  # asked before it matters which run it is
    meant = _select_run(campaign, file, name)
    if file is None:
        table: MemoryTable = memory_table(f"{meant.name} in memory", record)
        campaign = replace(campaign, frames={**campaign.frames, meant.record: table})
    if isinstance(meant, MeanRun):
        return check_mean(campaign, meant, file or meant.record)
    tested = meant if file is None else _use_file(meant, file)
    campaign = _with_recorded(campaign, lambda run: tested if run is meant else run)
    own_check = _check_alone(campaign, tested)
    if own_check.fit is None and own_check.state.poses is None:
        return CheckedRun(
            run=own_check.state,
            remarks=own_check.remarks,
            good=False,
            others=[],
            reached=[],
            expected=[],
            why_not="the record cannot be used as it is",
        )
    others, reached = _check_with_others(campaign, tested, own_check.fit)
    expected, why_not = _expected(campaign, tested, own_check)
    return CheckedRun(
        run=own_check.state,
        remarks=own_check.remarks,
        # Poses that are too few by themselves may be enough with others.
        good=own_check.good or (own_check.fit is None and any(c.u is not None for c in reached)),
        others=others,
        reached=reached,
        expected=expected,
        why_not=why_not,
    )


def _use_file(run: Recorded, file: Path) -> Recorded:
    """Return a run, or a record of poses, whose record is another file."""
    if isinstance(run, Run):
        return run.model_copy(update={"file": file})
    return replace(run, record=file)


def _with_recorded(campaign: Campaign, use: Callable[[Recorded], Recorded | None]) -> Campaign:
    """Return a campaign with its runs and records of poses as a function has them, None: not."""
    runs = tuple(run for run in map(use, campaign.runs) if isinstance(run, Run))
    triad = campaign.triad
    if triad is not None:
        records = tuple(
            record for record in map(use, triad.records) if isinstance(record, PoseRecord)
        )
        triad = replace(triad, records=records)
    return replace(campaign, runs=runs, triad=triad)


def _select_run(campaign: Campaign, file: Path | None, name: str | None) -> Recorded | MeanRun:
    """Return the run whose record is meant."""
    recorded = (*recordings(campaign), *mean_runs(campaign))
    by_name = {run.name: run for run in recorded}
    if name is not None:
        if name not in by_name:
            raise CampaignError(
                "`run`", [f'there is no run "{name}"{did_you_mean(name, list(by_name))}']
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
    raise CampaignError(
        "`run`", [f"name the run, one of: {', '.join(by_name) or 'none has a record'}"]
    )


@frozen
class _RecordCheck:
    """A record by itself."""

    state: RunState
    remarks: list[str]
    good: bool
    fit: FitSoFar | None  # None where it cannot be used
    observed: ObservedRun | None = None  # None of poses


def _check_alone(campaign: Campaign, run: Recorded) -> _RecordCheck:
    """Return the check of a single record."""
    alone = _with_recorded(
        replace(campaign, readings=()), lambda candidate: run if candidate is run else None
    )
    if alone.triad is not None:
        alone = replace(alone, triad=replace(alone.triad, poses=()))
    observer = Observer(alone)
    observer.look()
    part, observed = observer.present()
    poses = observer.poses_of(run.name)
    if not observed and not poses:
        state = observer.not_read(run.name)
        why = state.why if state.state == "failed" else f"too short: {state.why}"
        state = state.model_copy(update={"state": "failed", "why": why})
        return _RecordCheck(state, [why or ""], good=False, fit=None)
    fit, refused = None, ""
    try:
        fit = joint_fit_of(part, observed)
    except CounterspinError as error:
        refused = str(error)
    if isinstance(run, PoseRecord):
        state = poses_state(part, run, poses, fit)
        remarks, good = remarks_of_poses(poses, fit)
        observed_run = None
    else:
        (observed_run,) = observed
        state = run_state(part, observed_run, fit.views if fit else ())
        remarks, good = (
            remarks_of(state, observed_run.record.report.notes(), fit.views) if fit else ([], False)
        )
    if fit is None:
        remarks, good = [refused, *remarks], False
    return _RecordCheck(state, remarks, good, fit, observed_run)


def _check_with_others(
    campaign: Campaign, run: Recorded, fit: FitSoFar | None
) -> tuple[list[str], list[ReachedCoefficient]]:
    """Return the other existing records, and the coefficients from all records together.

    fit: Fit of this record alone; None if it does not determine enough.
    """

    def existing(recorded: Recorded) -> Recorded | None:
        in_memory = recorded.record in campaign.frames
        return recorded if recorded is run or in_memory or recorded.record.exists() else None

    observer = Observer(_with_recorded(campaign, existing))
    observer.look()
    part, observed = observer.present()
    others = [item.run.name for item in observed]
    others += [item.name for item in (part.triad.records if part.triad else ())]
    others.remove(run.name)
    if others or part.readings or part.posed:
        try:
            fit = joint_fit_of(part, observed)
        except CounterspinError:
            others = []
    names = shown_names(campaign)
    return others, reached_coefficients(fit, names) if fit else nothing_reached(campaign, names)


def _expected(
    campaign: Campaign, run: Recorded, own_check: _RecordCheck
) -> tuple[list[ReachedCoefficient], str | None]:
    """Return the expected coefficients of the whole campaign with its other runs as described."""
    if not campaign.runs:
        return [], None
    completed, rate = campaign, None
    if own_check.observed is not None and own_check.fit is not None:
        seconds = float(own_check.observed.record.time[-1])
        rate = 1.0 / own_check.observed.record.report.step
        runs = (
            r.model_copy(update={"duration": seconds}) if r is run else r for r in campaign.runs
        )
        noise = noise_of_fit(own_check.fit.estimate.fit)
        completed = as_recorded(replace(campaign, runs=tuple(runs)), [own_check.observed], noise)
    unknown = [r.name for r in completed.runs if r.duration is None]
    if unknown:
        return [], f"the description does not state how long {', '.join(unknown)} will last"
    try:
        completed = with_pose_noise(completed)
        predicted = forecast(completed, sampling_rate=rate)
    except CounterspinError as error:
        return [], str(error)
    names = shown_names(campaign)
    lines = reached_coefficients(FitSoFar(completed, predicted.estimate), names)
    return [line.model_copy(update={"value": None}) for line in lines], None
