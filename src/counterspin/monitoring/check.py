"""`counterspin check`: one record, judged while there is still time to make it again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from counterspin.calibration.observed import ObservedRun
from counterspin.campaign.checking import did_you_mean
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.campaign.resolved import Run
from counterspin.errors import CampaignError, CounterspinError, RecordError
from counterspin.monitoring.judging import remarks_of, run_state
from counterspin.monitoring.observing import Observer, record_name
from counterspin.monitoring.reaching import Fitted, fitted, reached, shown_names
from counterspin.monitoring.result import CheckedRun, ReachedCoefficient, RunState
from counterspin.planning.forecast import forecast
from counterspin.planning.recorded.from_records import as_recorded, noise_of_fit
from counterspin.records.formats import opener_of
from counterspin.records.memory import MemoryTable, memory_table
from counterspin.workers import one_blas_thread


def check(
    record: object,
    campaign: Campaign | Path | str,
    *,
    run: str | None = None,
) -> CheckedRun:
    """Judge the record of one run: clock, angle, rate, residuals, resulting uncertainty.

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
        If there is no such file.
    """
    whole = campaign if isinstance(campaign, Campaign) else read_campaign(campaign)
    with one_blas_thread():
        return _checked(record, whole, run)


def _checked(record: object, campaign: Campaign, name: str | None) -> CheckedRun:
    file = Path(record).absolute() if isinstance(record, Path | str) else None
    if file is not None:
        if not file.exists():
            raise RecordError(f"{file}: there is no such file.")
        opener_of(file)  # asked before it matters which run it is
    run = _meant(campaign, file, name)
    if file is not None:
        own = replace(run, record=file)
        runs = tuple(own if other is run else other for other in campaign.runs)
        campaign = replace(campaign, runs=runs)
    else:
        own = run
        table: MemoryTable = memory_table(f"{run.name} in memory", record)
        campaign = replace(campaign, frames={**campaign.frames, run.record: table})
    state, remarks, good, alone = _by_itself(campaign, own)
    if alone is None:
        return CheckedRun(
            run=state,
            remarks=remarks,
            good=False,
            others=[],
            reached=[],
            expected=[],
            why_not="the record cannot be used as it stands",
        )
    others, found = _with_the_others(campaign, own, alone)
    expected, why_not = _expected(campaign, own, alone)
    return CheckedRun(
        run=state,
        remarks=remarks,
        good=good,
        others=others,
        reached=found,
        expected=expected,
        why_not=why_not,
    )


def _meant(campaign: Campaign, file: Path | None, name: str | None) -> Run:
    """Return the run whose record is meant."""
    by_name = {run.name: run for run in campaign.runs}
    for posed in campaign.triad.records if campaign.triad else ():
        its_file = name is None and file is not None and file.name == posed.record.name
        if name == posed.name or its_file:
            text = f'"{posed.name}" is a record of poses, which is judged by calibrating it'
            raise CampaignError("check", [text])
    if name is not None:
        if name not in by_name:
            raise CampaignError(
                "`run`", [f'no run is called "{name}"{did_you_mean(name, list(by_name))}']
            )
        return by_name[name]
    if file is not None:
        for run in campaign.runs:
            if run.record == file or (run.record.exists() and run.record.samefile(file)):
                return run
        if file.stem in by_name:
            return by_name[file.stem]
        for run in campaign.runs:
            if run.record.name == file.name:
                return run
    if len(campaign.runs) == 1:
        return campaign.runs[0]
    raise CampaignError(
        "`run`", [f"say which run this is, one of: {', '.join(by_name) or 'none has a record'}"]
    )


def _by_itself(
    campaign: Campaign, run: Run
) -> tuple[RunState, list[str], bool, tuple[ObservedRun, Fitted] | None]:
    """Return what a run shows by itself, what is odd, whether it is good, and its fit."""
    part = replace(campaign, runs=(run,), readings=())
    observer = Observer(part)
    observer.look()
    part, observed = observer.present()
    if not observed:
        waits, trouble, rows = observer.of(run.name)
        why = trouble or f"too short: {waits}"
        state = RunState(
            run=run.name,
            record=record_name(run.record, campaign.folder),
            state="failed",
            why=why,
            rows=rows,
            stated_seconds=run.duration,
            nominal_rate=run.rate,
        )
        return state, [why], False, None
    try:
        fit = fitted(part, observed)
    except CounterspinError as error:
        state = run_state(part, observed[0], ())
        return state, [str(error)], False, None
    state = run_state(part, observed[0], fit.views)
    remarks, good = remarks_of(state, observed[0].record.report.notes(), fit.views)
    return state, remarks, good, (observed[0], fit)


def _with_the_others(
    campaign: Campaign, run: Run, alone: tuple[ObservedRun, Fitted]
) -> tuple[list[str], list[ReachedCoefficient]]:
    """Return which other records are there, and what they say with this one."""
    there = [
        r for r in campaign.runs if r is run or r.record in campaign.frames or r.record.exists()
    ]
    observer = Observer(replace(campaign, runs=tuple(there)))
    observer.look()
    part, observed = observer.present()
    fit = alone[1]
    if len(observed) > 1 or campaign.readings:
        try:
            fit = fitted(part, observed)
        except CounterspinError:
            return [], reached(fit, shown_names(campaign))
    others = [one.run.name for one in observed if one.run is not run]
    return others, reached(fit, shown_names(campaign))


def _expected(
    campaign: Campaign, run: Run, alone: tuple[ObservedRun, Fitted]
) -> tuple[list[ReachedCoefficient], str | None]:
    """Return what the whole campaign will know, its other runs being made as described."""
    observed, fit = alone
    seconds = float(observed.record.time[-1])
    runs = [replace(r, duration=seconds if r is run else r.duration) for r in campaign.runs]
    unknown = [r.name for r in runs if r.duration is None]
    if unknown:
        return [], f"the description does not say how long {', '.join(unknown)} will last"
    whole = as_recorded(
        replace(campaign, runs=tuple(runs)), [observed], noise_of_fit(fit.estimate.fit)
    )
    try:
        predicted = forecast(whole, sampling_rate=1.0 / observed.record.report.step)
    except CounterspinError as error:
        return [], str(error)
    names = shown_names(campaign)
    lines = reached(Fitted(whole, predicted.estimate), names)
    return [line.model_copy(update={"value": None}) for line in lines], None
