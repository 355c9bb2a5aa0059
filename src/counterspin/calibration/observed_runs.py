"""Observed records, joined with the rotation on which they were taken."""

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
from counterspin.campaign.documents import with_source
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
from counterspin.records.signals import WORDS as REMOVED
from counterspin.records.signals import FirstHarmonic, detrending_order
from counterspin.records.temperature_profile import read_temperature_profile
from counterspin.units import ZERO_CELSIUS

#: Horizontal part of an input axis from which its signal is held to the motion's wave.
_MIN_HORIZONTAL: Final = 0.05

#: How many of 1, t and t^2 a line is.
_STRAIGHT_LINE: Final = 2

#: A stated temperature may be off the recorded ones by so much, K: chamber and instrument differ.
_MAX_DEVIATION: Final = 5.0

#: Record and the part of it -> its course.
_Profiles = dict[tuple[Path, tuple[float, float]], tuple[float, ...]]

#: rad, over which a change with the latitude is taken.
_LATITUDE_STEP: Final = 1e-5


@frozen
class Signal:
    """One accelerometer's output in one run, less what a perfect system would have recorded."""

    accelerometer: Accelerometer  #: Whose it is.
    #: S - S_ref in m, m/s or m/s^2, shape (n,), at the record's times; NaN where it is missing.
    #: What a computer took off with its own velocity is put back.
    error: Array
    #: Change of what is put back with the latitude, m/rad and so on, shape (n,); None of a computer
    #: that is given the platform's velocity.
    latitude_derivative: Array | None = None


@frozen
class ObservedRun:
    """One run as the estimators see it."""

    run: Run  #: Its description.
    #: The cleaned record: times from the first sample, block means where it was dense.
    record: Record
    #: The spindle identified from the recorded angle; None where the nominal rate is taken.
    rotation: SpindleFit | None
    trajectory: Trajectory  #: The motion along which reference and columns are taken.
    signals: Mapping[str, Signal]  #: By accelerometer.


def observe(campaign: Campaign) -> Iterator[ObservedRun]:
    """Read the campaign's runs one after the other."""
    _check_files_exist(campaign)
    first_runs: dict[bytes, Run] = {}
    timeline = RunTimeline(campaign)
    moments_by_run: dict[str, dict[str, Array]] = {}
    for run in campaign.runs:
        record = read_run(campaign, run)
        moments_by_run[run.name] = dict(record.polynomials)
        samples = _samples_digest(record)
        earlier = first_runs.setdefault(samples, run)
        if earlier is not run:
            raise duplicate_record_error(campaign, earlier, run)
        # When a run was made may depend on how long those before it lasted.
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
    common_count = detrending_order(list(moments_by_run.values()))
    counts = {run: detrending_order([moments]) for run, moments in moments_by_run.items()}
    count = max(common_count, *counts.values())
    return count, [run for run, moments in counts.items() if count in (common_count, moments)]


def _reject_detrended(campaign: Campaign, name: str, moments_by_run: Mapping[str, Array]) -> None:
    """Refuse a signal from which more was removed than start offset and velocity take up."""
    observable = campaign.accelerometers[name].observable
    count, runs = detect_detrending(moments_by_run)
    if count <= observation.ORDERS[observable]:
        return
    column = campaign.accelerometers[name].channel.name
    powers = ", ".join(("1", "t", "t^2")[:count])
    end_condition = ", or zero at both ends in every run" if count == _STRAIGHT_LINE else ""
    raise RecordError(
        f"{', '.join(runs)}: a {REMOVED[count]} was removed from column '{column}' ({name}) "
        f"before the file was written: the rows are orthogonal to {powers}{end_condition} to "
        "the last digit, which does not occur in an unprocessed record. This also removed the "
        f"effect of K_F and K_II on {observable.replace('_', ' ')}. Switch this processing "
        "(detrend, remove offset, zero mean) off in the recorder or in the export, and record "
        "or export again.",
        code="detrended-record",
    )


def _check_files_exist(campaign: Campaign) -> None:
    """Name all files that are not there at once, before hours go into those that are."""
    on_disk = (
        file
        for run in campaign.runs
        for file in run.files
        if isinstance(campaign.record_at(file), Path)
    )
    missing = [f"{file}: " for file in dict.fromkeys(on_disk) if not file.exists()]
    rest = None if campaign.rest is None else campaign.record_at(campaign.rest)
    if isinstance(rest, Path) and not rest.exists():
        missing.append(f"{rest} (noise.from): ")
    if missing:
        raise RecordError(
            "\n".join(f"{file}file not found" for file in missing), code="file-not-found"
        )


def read_run(campaign: Campaign, run: Run) -> Record:
    """Return the record of one run; RecordError if it cannot be used, with file and line."""
    harmonics = {
        name: harmonic
        for name, accelerometer in campaign.accelerometers.items()
        if (harmonic := _expected_harmonic(campaign, run, accelerometer)) is not None
    }
    motion = NominalMotion(run.rate, harmonics, waves=-run.table_ratio or 1.0)
    columns = record_columns(campaign, run)
    return read_record(campaign.record_at(run.record), columns, motion)


def duplicate_record_error(
    campaign: Campaign, earlier: Run | Reading, run: Run | Reading
) -> RecordError:
    """Return the error that a run's record has the same samples as that of an earlier one."""
    first, second = (item.record and campaign.record_at(item.record) for item in (earlier, run))
    return RecordError(
        f"{second} contains the same samples as {first} (runs {earlier.name} and {run.name}). "
        "Each record may be used only once. Remove one of the runs, or give it a different "
        "record.",
        code="duplicate-record",
    )


def _samples_digest(record: Record) -> bytes:
    """Return a digest that two records share only if all their samples are equal."""
    digest = hashlib.sha256()
    for values in (record.time, record.angle, *record.signals.values()):
        if values is not None:
            digest.update(np.ascontiguousarray(values).data)
    return digest.digest()


def _expected_harmonic(
    campaign: Campaign, run: Run, accelerometer: Accelerometer
) -> FirstHarmonic | None:
    """Return the wave that the motion makes along an input axis; None where it is nearly upright.

    The position is R (cos th, sin th); each time derivative multiplies it with the rate and turns
    it forward by a right angle. On a table of another ratio the force turns by -ratio times th; of
    ratio 0 it stands still.
    """
    if run.table_ratio == 0.0:
        return None
    east, north, _ = accelerometer.mounting.turned(run.attitude).input_axis
    if math.hypot(east, north) < _MIN_HORIZONTAL:
        return None
    derivatives = 2 - observation.ORDERS[accelerometer.observable]
    amplitude = campaign.radius.value * complex(east, north) * (-1j * run.rate) ** derivatives
    return FirstHarmonic(amplitude, OBSERVABLES[accelerometer.observable])


def record_columns(campaign: Campaign, run: Run) -> RecordColumns:
    """Return the columns of a run's record, how its file is written, and the part to be used."""
    recording = campaign.recording_of(run)
    return RecordColumns(
        recording.time,
        recording.angle,
        {name: accelerometer.channel for name, accelerometer in campaign.accelerometers.items()},
        recording.dialect,
        run.part,
        tuple(run.continued_in),
        run.pulses,
    )


def fit_rotation(
    campaign: Campaign, time: Array, angle: Array, rate: float, count: Array, spread: Array
) -> SpindleFit:
    """Return the rotation identified from a recorded angle.

    time, angle: Of the block means, s and rad, shape (n,).
    rate: The stated one, rad/s.
    count, spread: Of each block, the samples and the standard deviation of their times, s.
    """
    # The angle of a row was sampled `timing_offset` after its output.
    delay = campaign.timing_offset.value if campaign.timing_offset else 0.0
    return fit_spindle(time + delay, angle, rate, weights=count, spread=spread)


def observe_run(
    campaign: Campaign, run: Run, record: Record, conditions: RunConditions = AT_REFERENCE
) -> ObservedRun:
    """Identify the rotation of one run and take the reference displacement away.

    record: The run's record.
    """
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
        signals = _with_platform_velocity(campaign, run, record.time, signals)
    return ObservedRun(run, record, rotation, trajectory, signals)


def _with_platform_velocity(
    campaign: Campaign, run: Run, time: Array, signals: Mapping[str, Signal]
) -> dict[str, Signal]:
    """Return the signals that a computer which is given the platform's velocity would have made."""
    errors = []
    for signal in signals.values():
        accelerometer = signal.accelerometer
        axis = accelerometer.mounting.turned(run.attitude).input_axis
        # The reference has what is left of gravity in it; the velocity is off by that too.
        residual_gravity = observation.residual_gravity(
            campaign.site, axis, time, accelerometer.observable
        )
        errors.append(
            AxisError(axis, accelerometer.observable, time, signal.error + residual_gravity)
        )
    site = campaign.site
    north = replace(site, latitude=site.latitude + _LATITUDE_STEP)
    corrections, shifted_corrections = (
        computer_correction(site, errors),
        computer_correction(north, errors),
    )
    return {
        name: Signal(
            signal.accelerometer, signal.error + correction, (shifted - correction) / _LATITUDE_STEP
        )
        for (name, signal), correction, shifted in zip(
            signals.items(), corrections, shifted_corrections, strict=True
        )
    }


# The temperatures that are in records, in the place of those that a description states


def with_recorded_conditions(campaign: Campaign) -> Campaign:
    """Return a campaign with temperatures from its records, and which of them have no angle.

    RecordError where a column cannot be used, or contradicts what a run states.
    """
    profiles: _Profiles = {}
    runs = tuple(
        run.model_copy(update={"temperature": recorded_temperatures(campaign, run, profiles)})
        for run in campaign.runs
    )
    readings = tuple(
        replace(
            item,
            temperature=recorded_temperatures(campaign, item, profiles),
            by_clock=item.by_clock and _has_angle(campaign, item),
        )
        if item.record is not None
        else item
        for item in campaign.readings
    )
    triad = campaign.triad
    if triad is not None:
        records = tuple(
            replace(item, temperature=recorded_temperatures(campaign, item, profiles))
            for item in triad.records
        )
        triad = replace(triad, records=records)
    if not profiles and readings == campaign.readings:
        return campaign
    changed = replace(campaign, runs=runs, readings=readings, triad=triad)
    return changed if campaign.source is None else with_source(changed, campaign.source)


def _has_angle(campaign: Campaign, reading: Reading) -> bool:
    """Return whether the record of a reading has the column of the angle, as far as it exists."""
    assert reading.record is not None
    assert campaign.angle is not None
    source = campaign.record_at(reading.record)
    if isinstance(source, Path) and not source.exists():
        return True
    with open_columns(source, campaign.dialect) as file:
        return file.has_column(campaign.angle.name)


def recorded_temperatures(
    campaign: Campaign, item: Run | Reading | PoseRecord, profiles: _Profiles
) -> tuple[float, ...] | None:
    """Return the temperatures of a run, reading or record of poses, K: what its own record says.

    profiles: Profiles read before, to which that of the item is added.
    """
    columns = temperature_columns(campaign, item)
    if columns is None or item.record is None:
        return item.temperature
    source, key = campaign.record_at(item.record), (item.record, columns.time_range)
    if isinstance(source, Path) and not source.exists():
        return item.temperature  # whoever reads the rest of it says so
    if key not in profiles:
        profiles[key] = read_temperature_profile(source, columns)
    profile = profiles[key]
    deviation = max(
        (max(min(profile) - stated, stated - max(profile)) for stated in item.temperature or ()),
        default=0.0,
    )
    if deviation > _MAX_DEVIATION:
        low, high = (f"{value - ZERO_CELSIUS:.4g}" for value in (min(profile), max(profile)))
        (column,) = columns.signals.values()
        raise RecordError(
            f"{source}: column '{column.name}' contains temperatures from {low} to {high} degC; "
            f'the temperature stated for "{item.name}" differs from these values by '
            f"{deviation:.3g} K. Correct the unit of the column or the stated temperature, or "
            "remove that temperature.",
            code="temperature-mismatch",
        )
    return profile


def temperature_columns(
    campaign: Campaign, item: Run | Reading | PoseRecord
) -> RecordColumns | None:
    """Return the columns of time and temperature of a record; None where it has no temperature."""
    own_dialect = item.dialect if isinstance(item, PoseRecord) else None
    dialect = own_dialect or campaign.dialect
    recording = Recording(campaign.time, None, dialect, campaign.temperature)
    columns = RecordColumns(campaign.time, None, {})
    if isinstance(item, Run):
        recording = campaign.recording_of(item)
        columns = replace(
            columns, time_range=item.part, continuation_files=tuple(item.continued_in)
        )
    if recording.temperature is None:
        return None
    signals = {"temperature": recording.temperature}
    return replace(columns, time=recording.time, signals=signals, dialect=recording.dialect)
