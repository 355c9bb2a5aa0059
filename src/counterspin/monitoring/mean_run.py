"""Check of a record whose mean is a reading: on an arm, or at rest."""

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
    fit_runs,
    list_displayed_names,
    report_fields,
    rotation_fields,
    run_remarks,
    undetermined_estimates,
)
from counterspin.readings.mean_records import AveragedRecord, average_record


@frozen(eq=False)
class MeanRun:
    """A run whose record provides one mean reading for each accelerometer."""

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


def collect_mean_runs(campaign: Campaign) -> list[MeanRun]:
    """Return the runs whose means are readings."""
    readings_by_name: dict[str, list[Reading]] = {}
    for reading in campaign.readings:
        if reading.record is not None:
            readings_by_name.setdefault(reading.name, []).append(reading)
    return [MeanRun(tuple(readings)) for readings in readings_by_name.values()]


def check_mean(campaign: Campaign, run: MeanRun, file: Path) -> CheckedRun:
    """Check the record of a run whose mean is a reading.

    file: The record, which may differ from that of the description.
    """
    campaign = _map_readings(
        campaign,
        lambda reading: replace(reading, record=file) if reading.name == run.name else reading,
    )
    try:
        averaged_records = [
            average_record(campaign, reading)
            for reading in campaign.readings
            if reading.record == file
        ]
    except CounterspinError as error:
        return CheckedRun(
            run=_make_failed_state(campaign, run, file, str(error)),
            remarks=[str(error)],
            good=False,
            others=[],
            reached=[],
            expected=[],
            why_not="the record cannot be used in its present form",
        )
    state = _make_read_state(campaign, averaged_records)
    notes = list(
        dict.fromkeys(note for record in averaged_records for note in record.mean.report.notes())
    )
    remarks, is_good = run_remarks(state, notes, ())
    other_names, estimates = _fit_with_others(campaign, run.name)
    return CheckedRun(
        run=state, remarks=remarks, good=is_good, others=other_names, reached=estimates, expected=[]
    )


def _map_readings(campaign: Campaign, function: Callable[[Reading], Reading | None]) -> Campaign:
    """Return a campaign with a function applied to its readings; None removes one."""
    return replace(
        campaign,
        readings=tuple(
            reading for reading in map(function, campaign.readings) if reading is not None
        ),
    )


def _make_failed_state(campaign: Campaign, run: MeanRun, file: Path, reason: str) -> RunState:
    """Return the state of an unusable record."""
    return RunState(
        run=run.name,
        record=record_name(file, campaign.folder),
        state="failed",
        why=reason,
        rows=0,
        stated_seconds=run.readings[0].duration,
        nominal_rate=run.readings[0].rate,
    )


def _make_read_state(campaign: Campaign, records: Sequence[AveragedRecord]) -> RunState:
    """Return the state of a record: means of the accelerometers, and rotation."""
    first_record = records[0]
    reading, measured_rate = first_record.reading, first_record.reading.measured_rate
    assert reading.record is not None
    fields = report_fields(first_record.mean.report, first_record.record.time) | rotation_fields(
        first_record.rotation
    )
    fields["outliers"] = max(sum(record.mean.report.outliers.values()) for record in records)
    if measured_rate is not None:
        fields |= {"rate": measured_rate.value, "u_rate": measured_rate.u}
    return RunState(
        run=reading.name,
        record=record_name(reading.record, campaign.folder),
        state="read",
        stated_seconds=reading.duration,
        nominal_rate=reading.rate,
        **fields,
        means={
            record.reading.accelerometer: MeanState(
                value=record.reading.value,
                u=record.reading.u or 0.0,
                revolutions=record.mean.revolutions,
            )
            for record in records
        },
    )


def _fit_with_others(campaign: Campaign, run_name: str) -> tuple[list[str], list[CurrentEstimate]]:
    """Return the names of other existing records, and the coefficients from all records."""

    def has_record(record: Path) -> bool:
        return record in campaign.frames or record.exists()

    runs = tuple(run for run in campaign.runs if has_record(run.record))
    usable_campaign = _map_readings(
        replace(campaign, runs=runs),
        lambda reading: reading if reading.record is None or has_record(reading.record) else None,
    )
    observer = Observer(usable_campaign)
    observer.poll()
    usable_campaign, observed_runs = observer.read_usable_runs()
    other_names = [observed_run.run.name for observed_run in observed_runs]
    other_names += [run.name for run in collect_mean_runs(usable_campaign) if run.name != run_name]
    names = list_displayed_names(campaign)
    try:
        usable_campaign = add_recorded_conditions(usable_campaign)
        return other_names, current_estimates(fit_runs(usable_campaign, observed_runs), names)
    except CounterspinError:
        return other_names, undetermined_estimates(campaign, names)
