"""`counterspin check`: one record, checked while there is still time to make it again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from counterspin.calibration.observed import ObservedRun
from counterspin.campaign.checking import did_you_mean
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.campaign.runs import Run
from counterspin.campaign.triad import PoseRecord
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
from counterspin.records.memory import MemoryTable, memory_table
from counterspin.workers import one_blas_thread


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
    whole = campaign if isinstance(campaign, Campaign) else read_campaign(campaign)
    with one_blas_thread():
        return _checked(record, whole, run)


def _checked(record: object, campaign: Campaign, name: str | None) -> CheckedRun:
    file = Path(record).absolute() if isinstance(record, Path | str) else None
    if file is not None:
        if not file.exists():
            raise RecordError(f"{file}: file not found.")
        opener_of(file)  # asked before it matters which run it is
    meant = _meant(campaign, file, name)
    if file is None:
        table: MemoryTable = memory_table(f"{meant.name} in memory", record)
        campaign = replace(campaign, frames={**campaign.frames, meant.record: table})
    if isinstance(meant, MeanRun):
        return check_mean(campaign, meant, file or meant.record)
    own = meant if file is None else _of_file(meant, file)
    campaign = _with_recorded(campaign, lambda run: own if run is meant else run)
    own_check = _by_itself(campaign, own)
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
    others, found = _with_the_others(campaign, own, own_check.fit)
    expected, why_not = _expected(campaign, own, own_check)
    return CheckedRun(
        run=own_check.state,
        remarks=own_check.remarks,
        # Poses that are too few by themselves may be enough with others.
        good=own_check.good or (own_check.fit is None and any(c.u is not None for c in found)),
        others=others,
        reached=found,
        expected=expected,
        why_not=why_not,
    )


def _of_file(run: Recorded, file: Path) -> Recorded:
    """Return a run, or a record of poses, whose record is another file."""
    if isinstance(run, Run):
        return run.model_copy(update={"file": file})
    return replace(run, record=file)


def _with_recorded(campaign: Campaign, use: Callable[[Recorded], Recorded | None]) -> Campaign:
    """Return a campaign with its runs and records of poses as a function has them, None: not."""
    runs = tuple(run for run in map(use, campaign.runs) if isinstance(run, Run))
    triad = campaign.triad
    if triad is not None:
        records = tuple(one for one in map(use, triad.records) if isinstance(one, PoseRecord))
        triad = replace(triad, records=records)
    return replace(campaign, runs=runs, triad=triad)


def _meant(campaign: Campaign, file: Path | None, name: str | None) -> Recorded | MeanRun:
    """Return the run whose record is meant."""
    every = (*recordings(campaign), *mean_runs(campaign))
    by_name = {run.name: run for run in every}
    if name is not None:
        if name not in by_name:
            raise CampaignError(
                "`run`", [f'there is no run "{name}"{did_you_mean(name, list(by_name))}']
            )
        return by_name[name]
    if file is not None:
        for run in every:
            if run.record == file or (run.record.exists() and run.record.samefile(file)):
                return run
        if file.stem in by_name:
            return by_name[file.stem]
        for run in every:
            if run.record.name == file.name:
                return run
    if len(every) == 1:
        return every[0]
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


def _by_itself(campaign: Campaign, run: Recorded) -> _RecordCheck:
    """Return what a record shows by itself."""
    alone = _with_recorded(
        replace(campaign, readings=()), lambda other: run if other is run else None
    )
    if alone.triad is not None:
        alone = replace(alone, triad=replace(alone.triad, poses=()))
    observer = Observer(alone)
    observer.look()
    part, observed = observer.present()
    found = observer.poses_of(run.name)
    if not observed and not found:
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
        state = poses_state(part, run, found, fit)
        remarks, good = remarks_of_poses(found, fit)
        own = None
    else:
        (own,) = observed
        state = run_state(part, own, fit.views if fit else ())
        remarks, good = (
            remarks_of(state, own.record.report.notes(), fit.views) if fit else ([], False)
        )
    if fit is None:
        remarks, good = [refused, *remarks], False
    return _RecordCheck(state, remarks, good, fit, own)


def _with_the_others(
    campaign: Campaign, run: Recorded, fit: FitSoFar | None
) -> tuple[list[str], list[ReachedCoefficient]]:
    """Return which other records are there, and what they say with this one.

    fit: Of this one alone; None if it does not determine enough.
    """

    def there(other: Recorded) -> Recorded | None:
        in_memory = other.record in campaign.frames
        return other if other is run or in_memory or other.record.exists() else None

    observer = Observer(_with_recorded(campaign, there))
    observer.look()
    part, observed = observer.present()
    others = [one.run.name for one in observed]
    others += [one.name for one in (part.triad.records if part.triad else ())]
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
    """Return what the whole campaign will know, its other runs being made as described."""
    if not campaign.runs:
        return [], None
    whole, rate = campaign, None
    if own_check.observed is not None and own_check.fit is not None:
        seconds = float(own_check.observed.record.time[-1])
        rate = 1.0 / own_check.observed.record.report.step
        runs = (
            r.model_copy(update={"duration": seconds}) if r is run else r for r in campaign.runs
        )
        noise = noise_of_fit(own_check.fit.estimate.fit)
        whole = as_recorded(replace(campaign, runs=tuple(runs)), [own_check.observed], noise)
    unknown = [r.name for r in whole.runs if r.duration is None]
    if unknown:
        return [], f"the description does not state how long {', '.join(unknown)} will last"
    try:
        whole = with_pose_noise(whole)
        predicted = forecast(whole, sampling_rate=rate)
    except CounterspinError as error:
        return [], str(error)
    names = shown_names(campaign)
    lines = reached_coefficients(FitSoFar(whole, predicted.estimate), names)
    return [line.model_copy(update={"value": None}) for line in lines], None
