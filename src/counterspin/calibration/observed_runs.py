"""Observed runs: records with the identified rotation and the reference output."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.accelerometers import Accelerometer
from counterspin.campaign.columns import Recording
from counterspin.campaign.conditions import RunTimeline
from counterspin.campaign.description import Campaign
from counterspin.campaign.documents import set_source
from counterspin.campaign.reading import PoseRecord, Reading
from counterspin.campaign.runs import Run
from counterspin.campaign.settings import OBSERVABLES
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.physics import observation
from counterspin.physics.conditions import AT_REFERENCE, RunConditions
from counterspin.physics.motion import Trajectory
from counterspin.physics.own_velocity import AxisError, computer_correction
from counterspin.physics.spindle import Spindle, SpindleFit, fit_spindle
from counterspin.records.formats import open_columns
from counterspin.records.reading import read_record
from counterspin.records.record import NominalMotion, Record, RecordColumns
from counterspin.records.signals import TREND_LABELS as REMOVED
from counterspin.records.signals import FirstHarmonic, detrending_order
from counterspin.records.temperature_profile import read_temperature_profile
from counterspin.units import ZERO_CELSIUS

#: Smallest horizontal component of an input axis for comparing its signal with the rotation.
_MIN_HORIZONTAL_COMPONENT: Final = 0.05

#: Number of powers of t in a straight line: 1 and t.
_STRAIGHT_LINE_ORDER: Final = 2

#: Largest difference between stated and recorded temperature, K: chamber and instrument differ.
_MAX_TEMPERATURE_DIFFERENCE: Final = 5.0

#: (record, time range) -> temperatures.
_TemperatureProfiles = dict[tuple[Path, tuple[float, float]], tuple[float, ...]]

#: Step of the finite difference with respect to the latitude, rad.
_LATITUDE_STEP: Final = 1e-5


@frozen
class Signal:
    """Output of one accelerometer in one run minus the output of a perfect system."""

    accelerometer: Accelerometer
    #: S - S_ref in m, m/s or m/s^2, shape (n,), at the times of the record; NaN: missing sample.
    #: Corrections that a computer derived from its own velocity are removed.
    error: Array
    #: Derivative of the removed corrections with respect to the latitude, m/rad, m/s/rad or
    #: m/s^2/rad, shape (n,); None if the computer uses the velocity of the platform.
    latitude_derivative: Array | None = None


@frozen
class ObservedRun:
    """One run with its record, rotation, trajectory and signals."""

    run: Run  #: Its description.
    record: Record  #: The cleaned record, in block means; time 0 is the first sample.
    #: Rotation identified from the recorded angle; None: the nominal rate applies.
    rotation: SpindleFit | None
    trajectory: Trajectory  #: Motion for the reference output and the design columns.
    signals: Mapping[str, Signal]  #: By accelerometer.


def observe_runs(campaign: Campaign) -> Iterator[ObservedRun]:
    """Read the runs of a campaign one by one."""
    _check_files_exist(campaign)
    runs_by_digest: dict[bytes, Run] = {}
    timeline = RunTimeline(campaign)
    moments_by_run: dict[str, dict[str, Array]] = {}
    for run in campaign.runs:
        record = read_run(campaign, run)
        moments_by_run[run.name] = dict(record.polynomials)
        digest = _samples_digest(record)
        first_run = runs_by_digest.setdefault(digest, run)
        if first_run is not run:
            raise duplicate_record_error(campaign, first_run, run)
        # The start time of a run may depend on the durations of the earlier runs.
        yield observe_run(campaign, run, record, timeline.add(run, float(record.time[-1])))
    for name in campaign.accelerometers:
        _reject_detrended(
            campaign, name, {run: moments[name] for run, moments in moments_by_run.items()}
        )


def detect_detrending(moments_by_run: Mapping[str, Array]) -> tuple[int, list[str]]:
    """Return the number of terms of 1, t, t^2 that a recorder removed from a signal, and the runs.

    moments_by_run: Run -> parts of the signal's column, as in `Record.polynomials`.
    """
    if not moments_by_run:
        return 0, []
    common_order = detrending_order(list(moments_by_run.values()))
    orders = {run: detrending_order([moments]) for run, moments in moments_by_run.items()}
    order = max(common_order, *orders.values())
    return order, [run for run, run_order in orders.items() if order in (common_order, run_order)]


def _reject_detrended(campaign: Campaign, name: str, moments_by_run: Mapping[str, Array]) -> None:
    """Raise RecordError if more was removed from a signal than the start values absorb."""
    observable = campaign.accelerometers[name].observable
    order, runs = detect_detrending(moments_by_run)
    if order <= observation.ORDERS[observable]:
        return
    column = campaign.accelerometers[name].channel.name
    power_names = ", ".join(("1", "t", "t^2")[:order])
    end_condition = ", or zero at both ends in every run" if order == _STRAIGHT_LINE_ORDER else ""
    raise RecordError(
        f"{', '.join(runs)}: a {REMOVED[order]} was removed from column '{column}' ({name}) "
        f"before the file was written: the rows are orthogonal to {power_names}{end_condition} to "
        "the last digit, which does not occur in an unprocessed record. This also removed the "
        f"effect of K_F and K_II on {observable.replace('_', ' ')}. Switch this processing "
        "(detrend, remove offset, zero mean) off in the recorder or in the export, and record "
        "or export again.",
        code="detrended-record",
    )


def _check_files_exist(campaign: Campaign) -> None:
    """Raise RecordError with all missing files, before any file is read."""
    record_files = (
        file
        for run in campaign.runs
        for file in run.files
        if isinstance(campaign.record_at(file), Path)
    )
    missing_files = [f"{file}: " for file in dict.fromkeys(record_files) if not file.exists()]
    static_record = None if campaign.rest is None else campaign.record_at(campaign.rest)
    if isinstance(static_record, Path) and not static_record.exists():
        missing_files.append(f"{static_record} (noise.from): ")
    if missing_files:
        raise RecordError(
            "\n".join(f"{file}file not found" for file in missing_files), code="file-not-found"
        )


def read_run(campaign: Campaign, run: Run) -> Record:
    """Return the record of one run; RecordError names file and line of an invalid record."""
    harmonics = {
        name: harmonic
        for name, accelerometer in campaign.accelerometers.items()
        if (harmonic := _expected_harmonic(campaign, run, accelerometer)) is not None
    }
    motion = NominalMotion(run.rate, harmonics, waves=-run.table_ratio or 1.0)
    columns = record_columns(campaign, run)
    return read_record(campaign.record_at(run.record), columns, motion)


def duplicate_record_error(
    campaign: Campaign, first_run: Run | Reading, run: Run | Reading
) -> RecordError:
    """Return the error that two runs have records with the same samples."""
    sources = [entry.record and campaign.record_at(entry.record) for entry in (first_run, run)]
    return RecordError(
        f"{sources[1]} contains the same samples as {sources[0]} "
        f"(runs {first_run.name} and {run.name}). "
        "Each record may be used only once. Remove one of the runs, or give it a different "
        "record.",
        code="duplicate-record",
    )


def _samples_digest(record: Record) -> bytes:
    """Return a digest that two records share only if all their samples are equal.

    The times do not count, because an export may give them another zero.
    """
    digest = hashlib.sha256()
    for values in (record.angle, *record.signals.values()):
        if values is not None:
            digest.update(np.ascontiguousarray(values).data)
    return digest.digest()


def _expected_harmonic(
    campaign: Campaign, run: Run, accelerometer: Accelerometer
) -> FirstHarmonic | None:
    """Return the harmonic of the rotation along an input axis; None for a nearly vertical axis.

    The position is R (cos th, sin th); each time derivative multiplies it by the rate and advances
    it by a right angle. On a table with another ratio, the force rotates by -ratio times th.
    """
    if run.table_ratio == 0.0:
        return None
    east, north, _ = accelerometer.mounting.turned(run.attitude).input_axis
    if math.hypot(east, north) < _MIN_HORIZONTAL_COMPONENT:
        return None
    derivative_order = 2 - observation.ORDERS[accelerometer.observable]
    amplitude = campaign.radius.value * complex(east, north) * (-1j * run.rate) ** derivative_order
    return FirstHarmonic(amplitude, OBSERVABLES[accelerometer.observable])


def record_columns(campaign: Campaign, run: Run) -> RecordColumns:
    """Return columns, file dialect and time range of the record of a run."""
    recording = campaign.recording_of(run)
    return RecordColumns(
        recording.time,
        recording.angle,
        {name: accelerometer.channel for name, accelerometer in campaign.accelerometers.items()},
        recording.dialect,
        run.time_range,
        tuple(run.continued_in),
        run.pulses,
    )


def fit_rotation(
    campaign: Campaign, time: Array, angle: Array, rate: float, count: Array, time_sd: Array
) -> SpindleFit:
    """Return the rotation identified from a recorded angle.

    time, angle: Block means, s and rad, shape (n,).
    rate: Stated rate, rad/s.
    count, time_sd: Number of samples of each block, and standard deviation of their times, s.
    """
    # The angle of a row was sampled `timing_offset` after the output.
    delay = campaign.timing_offset.value if campaign.timing_offset else 0.0
    return fit_spindle(time + delay, angle, rate, weights=count, spread=time_sd)


def observe_run(
    campaign: Campaign, run: Run, record: Record, conditions: RunConditions = AT_REFERENCE
) -> ObservedRun:
    """Identify the rotation of one run and subtract the reference output."""
    rotation = None
    if record.angle is not None:
        rotation = fit_rotation(
            campaign, record.time, record.angle, run.rate, record.count, record.time_sd
        )
    spindle = rotation.spindle if rotation else Spindle(run.rate)
    trajectory = Trajectory(spindle, campaign.radius.value, campaign.site, conditions=conditions)
    trajectory = replace(trajectory, table_ratio=run.table_ratio)
    signals = {}
    for name, accelerometer in campaign.accelerometers.items():
        reference = observation.block_average(
            lambda t, a=accelerometer: observation.reference(  # type: ignore[misc]
                trajectory, a.mounting, t, a.observable, run.attitude
            ),
            record.time,
            record.time_sd,
        )
        signals[name] = Signal(accelerometer, record.signals[name] - reference)
    if campaign.own_velocity:
        signals = _apply_platform_velocity(campaign, run, record.time, signals)
    return ObservedRun(run, record, rotation, trajectory, signals)


def _apply_platform_velocity(
    campaign: Campaign, run: Run, time: Array, signals: Mapping[str, Signal]
) -> dict[str, Signal]:
    """Return the signals that a computer with the velocity of the platform would have recorded."""
    axis_errors = []
    for signal in signals.values():
        accelerometer = signal.accelerometer
        axis = accelerometer.mounting.turned(run.attitude).input_axis
        # The reference contains the residual gravity, which also affects the velocity.
        residual_gravity = observation.residual_gravity(
            campaign.site, axis, time, accelerometer.observable
        )
        axis_errors.append(
            AxisError(axis, accelerometer.observable, time, signal.error + residual_gravity)
        )
    site = campaign.site
    shifted_site = replace(site, latitude=site.latitude + _LATITUDE_STEP)
    corrections = computer_correction(site, axis_errors)
    shifted_corrections = computer_correction(shifted_site, axis_errors)
    return {
        name: Signal(
            signal.accelerometer,
            signal.error + correction,
            (shifted_correction - correction) / _LATITUDE_STEP,
        )
        for (name, signal), correction, shifted_correction in zip(
            signals.items(), corrections, shifted_corrections, strict=True
        )
    }


# Recorded temperatures, which replace stated ones


def add_recorded_conditions(campaign: Campaign) -> Campaign:
    """Return the campaign with temperatures from its records, and readings without angle marked.

    RecordError: a column is invalid, or contradicts a stated temperature.
    """
    profiles: _TemperatureProfiles = {}
    runs = tuple(
        run.model_copy(update={"temperature": recorded_temperatures(campaign, run, profiles)})
        for run in campaign.runs
    )
    readings = tuple(
        replace(
            reading,
            temperature=recorded_temperatures(campaign, reading, profiles),
            uses_recorder_clock=reading.uses_recorder_clock and _has_angle(campaign, reading),
        )
        if reading.record is not None
        else reading
        for reading in campaign.readings
    )
    triad = campaign.triad
    if triad is not None:
        records = tuple(
            replace(record, temperature=recorded_temperatures(campaign, record, profiles))
            for record in triad.records
        )
        triad = replace(triad, records=records)
    if not profiles and readings == campaign.readings:
        return campaign
    source = campaign.source
    campaign = replace(campaign, runs=runs, readings=readings, triad=triad)
    return campaign if source is None else set_source(campaign, source)


def _has_angle(campaign: Campaign, reading: Reading) -> bool:
    """Return whether the record of a reading has an angle column; True if the file is missing."""
    assert reading.record is not None
    assert campaign.angle is not None
    source = campaign.record_at(reading.record)
    if isinstance(source, Path) and not source.exists():
        return True
    with open_columns(source, campaign.dialect) as file:
        return file.has_column(campaign.angle.name)


def recorded_temperatures(
    campaign: Campaign, entry: Run | Reading | PoseRecord, profiles: _TemperatureProfiles
) -> tuple[float, ...] | None:
    """Return the temperatures of a run, reading or record of poses, K, from its record if possible.

    profiles: Cache of temperature profiles; the function adds the profile of this entry.
    """
    columns = temperature_columns(campaign, entry)
    if columns is None or entry.record is None:
        return entry.temperature
    source, key = campaign.record_at(entry.record), (entry.record, columns.time_range)
    if isinstance(source, Path) and not source.exists():
        return entry.temperature  # reading the signals raises the error
    if key not in profiles:
        profiles[key] = read_temperature_profile(source, columns)
    profile = profiles[key]
    max_difference = max(
        (max(min(profile) - value, value - max(profile)) for value in entry.temperature or ()),
        default=0.0,
    )
    if max_difference > _MAX_TEMPERATURE_DIFFERENCE:
        low, high = (f"{value - ZERO_CELSIUS:.4g}" for value in (min(profile), max(profile)))
        (column,) = columns.signals.values()
        raise RecordError(
            f"{source}: column '{column.name}' contains temperatures from {low} to {high} degC; "
            f'the temperature stated for "{entry.name}" differs from these values by '
            f"{max_difference:.3g} K. Correct the unit of the column or the stated temperature, or "
            "remove that temperature.",
            code="temperature-mismatch",
        )
    return profile


def temperature_columns(
    campaign: Campaign, entry: Run | Reading | PoseRecord
) -> RecordColumns | None:
    """Return the time and temperature columns of a record; None if it has no temperature."""
    stated_dialect = entry.dialect if isinstance(entry, PoseRecord) else None
    dialect = stated_dialect or campaign.dialect
    recording = Recording(campaign.time, None, dialect, campaign.temperature)
    columns = RecordColumns(campaign.time, None, {})
    if isinstance(entry, Run):
        recording = campaign.recording_of(entry)
        columns = replace(
            columns, time_range=entry.time_range, continuation_files=tuple(entry.continued_in)
        )
    if recording.temperature is None:
        return None
    signals = {"temperature": recording.temperature}
    return replace(columns, time=recording.time, signals=signals, dialect=recording.dialect)
