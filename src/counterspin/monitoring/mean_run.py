"""A record on an arm or at rest, whose mean is a reading: rotation, mean, contribution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from counterspin.calibration.observed_runs import add_recorded_conditions
from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import Reading
from counterspin.errors import CounterspinError
from counterspin.frozen import frozen
from counterspin.monitoring.observer import Observer, record_name
from counterspin.monitoring.result import CheckedRun, CurrentEstimate, MeanState, RunState
from counterspin.monitoring.run_state import (
    current_estimates,
    displayed_names,
    fit_runs,
    report_fields,
    rotation_fields,
    run_remarks,
    undetermined_estimates,
)
from counterspin.readings.mean_records import AveragedRecord, average_record


@frozen(eq=False)
class MeanRun:
    """A run whose record has a mean for each accelerometer, which is its reading."""

    readings: tuple[Reading, ...]  #: At least one.

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.readings[0].name

    @property
    def record(self) -> Path:
        """Path of the record."""
        record = self.readings[0].record
        assert record is not None
        return record


def mean_runs(campaign: Campaign) -> list[MeanRun]:
    """Return the runs whose means are readings."""
    by_name: dict[str, list[Reading]] = {}
    for reading in campaign.readings:
        if reading.record is not None:
            by_name.setdefault(reading.name, []).append(reading)
    return [MeanRun(tuple(readings)) for readings in by_name.values()]


def check_mean(campaign: Campaign, run: MeanRun, file: Path) -> CheckedRun:
    """Check the record of a run whose mean is a reading.

    file: The record, which may differ from that of the description.
    """
    campaign = _map_readings(
        campaign,
        lambda reading: replace(reading, record=file) if reading.name == run.name else reading,
    )
    try:
        averaged = [
            average_record(campaign, reading)
            for reading in campaign.readings
            if reading.record == file
        ]
    except CounterspinError as error:
        return CheckedRun(
            run=_unread_state(campaign, run, file, str(error)),
            remarks=[str(error)],
            good=False,
            others=[],
            reached=[],
            expected=[],
            why_not="the record cannot be used in its present form",
        )
    state = _read_state(campaign, averaged)
    notes = list(dict.fromkeys(note for record in averaged for note in record.mean.report.notes()))
    remarks, good = run_remarks(state, notes, ())
    others, estimates = _fit_with_others(campaign, run.name)
    return CheckedRun(
        run=state, remarks=remarks, good=good, others=others, reached=estimates, expected=[]
    )


def _map_readings(campaign: Campaign, function: Callable[[Reading], Reading | None]) -> Campaign:
    """Return a campaign with a function applied to its readings; None removes one."""
    return replace(
        campaign,
        readings=tuple(
            reading for reading in map(function, campaign.readings) if reading is not None
        ),
    )


def _unread_state(campaign: Campaign, run: MeanRun, file: Path, reason: str) -> RunState:
    """Return the state of a record that cannot be used."""
    return RunState(
        run=run.name,
        record=record_name(file, campaign.folder),
        state="failed",
        why=reason,
        rows=0,
        stated_seconds=run.readings[0].duration,
        nominal_rate=run.readings[0].rate,
    )


def _read_state(campaign: Campaign, averaged: Sequence[AveragedRecord]) -> RunState:
    """Return the contents of a record: one mean for each accelerometer, and the rotation."""
    first = averaged[0]
    reading, measured = first.reading, first.reading.measured_rate
    assert reading.record is not None
    facts = report_fields(first.mean.report, first.record.time) | rotation_fields(first.rotation)
    facts["outliers"] = max(sum(record.mean.report.outliers.values()) for record in averaged)
    if measured is not None:
        facts |= {"rate": measured.value, "u_rate": measured.u}
    return RunState(
        run=reading.name,
        record=record_name(reading.record, campaign.folder),
        state="read",
        stated_seconds=reading.duration,
        nominal_rate=reading.rate,
        **facts,
        means={
            record.reading.accelerometer: MeanState(
                value=record.reading.value,
                u=record.reading.u or 0.0,
                revolutions=record.mean.revolutions,
            )
            for record in averaged
        },
    )


def _fit_with_others(campaign: Campaign, name: str) -> tuple[list[str], list[CurrentEstimate]]:
    """Return the other existing records, and the coefficients from all of them together."""

    def has_record(record: Path) -> bool:
        return record in campaign.frames or record.exists()

    runs = tuple(run for run in campaign.runs if has_record(run.record))
    usable_campaign = _map_readings(
        replace(campaign, runs=runs),
        lambda reading: reading if reading.record is None or has_record(reading.record) else None,
    )
    observer = Observer(usable_campaign)
    observer.poll()
    usable_campaign, observed = observer.usable_runs()
    others = [observed_run.run.name for observed_run in observed]
    others += [run.name for run in mean_runs(usable_campaign) if run.name != name]
    names = displayed_names(campaign)
    try:
        usable_campaign = add_recorded_conditions(usable_campaign)
        return others, current_estimates(fit_runs(usable_campaign, observed), names)
    except CounterspinError:
        return others, undetermined_estimates(campaign, names)
