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
from counterspin.campaign.conditions import conditions_of
from counterspin.campaign.description import Campaign
from counterspin.campaign.documents import keep
from counterspin.campaign.reading import PoseRecord, Reading
from counterspin.campaign.runs import Run
from counterspin.campaign.settings import OBSERVABLES
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.physics import observation
from counterspin.physics.effects import AT_REFERENCE, RunConditions
from counterspin.physics.motion import Trajectory
from counterspin.physics.own_velocity import AxisError, taken
from counterspin.physics.spindle import Spindle, SpindleFit, fit_spindle
from counterspin.records.reading import read_record
from counterspin.records.record import Record, RecordColumns, StatedMotion
from counterspin.records.signals import WORDS as REMOVED
from counterspin.records.signals import Swing, removed
from counterspin.records.temperature_course import read_course
from counterspin.units import ZERO_CELSIUS

#: Horizontal part of an input axis from which its signal is held to the motion's wave.
_HORIZONTAL_PART: Final = 0.05

#: How many of 1, t and t^2 a line is.
_LINE: Final = 2

#: A stated temperature may be off the recorded ones by so much, K: chamber and instrument differ.
_APART: Final = 5.0

#: Record and the part of it -> its course.
_Known = dict[tuple[Path, tuple[float, float]], tuple[float, ...]]

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
    by_latitude: Array | None = None


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
    _refuse_missing(campaign)
    first_with: dict[bytes, Run] = {}
    lengths: dict[str, float] = {}
    parts: dict[str, dict[str, Array]] = {}
    for run in campaign.runs:
        record = read_run(campaign, run)
        parts[run.name] = dict(record.polynomials)
        samples = _samples_digest(record)
        earlier = first_with.setdefault(samples, run)
        if earlier is not run:
            raise recorded_twice(campaign, earlier, run)
        # When a run was made may depend on how long those before it lasted.
        lengths[run.name] = float(record.time[-1])
        yield observe_run(campaign, run, record, conditions_of(campaign, lengths)[run.name])
    for name in campaign.accelerometers:
        _refuse_removed(campaign, name, {run: own[name] for run, own in parts.items()})


def removed_of(parts: Mapping[str, Array]) -> tuple[int, list[str]]:
    """Return how many of 1, t and t^2 a recorder removed from a signal, and in which runs.

    parts: Run -> parts of the signal's column, as of `Record.polynomials`.
    """
    if not parts:
        return 0, []
    together = removed(list(parts.values()))
    alone = {run: removed([own]) for run, own in parts.items()}
    count = max(together, *alone.values())
    return count, [run for run, own in alone.items() if count in (together, own)]


def _refuse_removed(campaign: Campaign, name: str, parts: Mapping[str, Array]) -> None:
    """Refuse a signal from which more was removed than start offset and velocity take up."""
    observable = campaign.accelerometers[name].observable
    count, runs = removed_of(parts)
    if count <= observation.ORDERS[observable]:
        return
    column = campaign.accelerometers[name].channel.name
    powers = ", ".join(("1", "t", "t^2")[:count])
    ends = ", or zero at both ends in every run" if count == _LINE else ""
    raise RecordError(
        f"{', '.join(runs)}: a {REMOVED[count]} was removed from column '{column}' ({name}) before "
        f"it was written: to the last digit its rows are orthogonal to {powers}{ends}, as no "
        "original record is. This also removed the effect of K_F and K_II on "
        f"{observable.replace('_', ' ')}. Switch this off in the recorder or in the export "
        "(detrend, remove offset, zero mean), and record or export again."
    )


def _refuse_missing(campaign: Campaign) -> None:
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
        raise RecordError("\n".join(f"{file}file not found." for file in missing))


def read_run(campaign: Campaign, run: Run) -> Record:
    """Return the record of one run; RecordError if it cannot be used, with file and line."""
    swings = {
        name: swing
        for name, accelerometer in campaign.accelerometers.items()
        if (swing := _swing(campaign, run, accelerometer)) is not None
    }
    columns, motion = record_columns(campaign, run), StatedMotion(run.rate, swings)
    return read_record(campaign.record_at(run.record), columns, motion)


def recorded_twice(campaign: Campaign, earlier: Run | Reading, run: Run | Reading) -> RecordError:
    """Return the error that a run's record has the same samples as that of an earlier one."""
    first, second = (one.record and campaign.record_at(one.record) for one in (earlier, run))
    return RecordError(
        f"{second}: holds the same samples as {first} (runs {earlier.name} and {run.name}). A "
        "record is used once only: remove one of the runs, or give it its own record."
    )


def _samples_digest(record: Record) -> bytes:
    """Return a digest that two records share only if all their samples are equal."""
    digest = hashlib.sha256()
    for values in (record.time, record.angle, *record.signals.values()):
        if values is not None:
            digest.update(np.ascontiguousarray(values).data)
    return digest.digest()


def _swing(campaign: Campaign, run: Run, accelerometer: Accelerometer) -> Swing | None:
    """Return the wave that the motion makes along an input axis; None where it is nearly upright.

    The position is R (cos th, sin th); each time derivative multiplies it with the rate and turns
    it forward by a right angle.
    """
    east, north, _ = accelerometer.mounting.turned(run.attitude).input_axis
    if math.hypot(east, north) < _HORIZONTAL_PART:
        return None
    derivatives = 2 - observation.ORDERS[accelerometer.observable]
    wave = campaign.radius.value * complex(east, north) * (-1j * run.rate) ** derivatives
    return Swing(wave, OBSERVABLES[accelerometer.observable])


def record_columns(campaign: Campaign, run: Run) -> RecordColumns:
    """Return the columns of a run's record, how its file is written, and the part to be used."""
    recording = campaign.recording_of(run)
    return RecordColumns(
        recording.time,
        recording.angle,
        {name: a.channel for name, a in campaign.accelerometers.items()},
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
    late = campaign.timing_offset.value if campaign.timing_offset else 0.0
    return fit_spindle(time + late, angle, rate, weights=count, spread=spread)


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
        signals = _of_platform_velocity(campaign, run, record.time, signals)
    return ObservedRun(run, record, rotation, trajectory, signals)


def _of_platform_velocity(
    campaign: Campaign, run: Run, time: Array, signals: Mapping[str, Signal]
) -> dict[str, Signal]:
    """Return the signals that a computer which is given the platform's velocity would have made."""
    errors = []
    for signal in signals.values():
        accelerometer = signal.accelerometer
        axis = accelerometer.mounting.turned(run.attitude).input_axis
        # The reference has what is left of gravity in it; the velocity is off by that too.
        left = observation.residual_gravity(campaign.site, axis, time, accelerometer.observable)
        errors.append(AxisError(axis, accelerometer.observable, time, signal.error + left))
    site = campaign.site
    north = replace(site, latitude=site.latitude + _LATITUDE_STEP)
    back, there = taken(site, errors), taken(north, errors)
    return {
        name: Signal(signal.accelerometer, signal.error + part, (moved - part) / _LATITUDE_STEP)
        for (name, signal), part, moved in zip(signals.items(), back, there, strict=True)
    }


# The temperatures that are in records, in the place of those that a description states


def with_recorded_temperatures(campaign: Campaign) -> Campaign:
    """Return a campaign whose runs have the temperatures that are in their records.

    RecordError where a column cannot be used, or contradicts what a run states.
    """
    known: _Known = {}
    runs = tuple(
        run.model_copy(update={"temperature": temperatures_of(campaign, run, known)})
        for run in campaign.runs
    )
    readings = tuple(
        replace(one, temperature=temperatures_of(campaign, one, known)) for one in campaign.readings
    )
    triad = campaign.triad
    if triad is not None:
        records = tuple(
            replace(one, temperature=temperatures_of(campaign, one, known)) for one in triad.records
        )
        triad = replace(triad, records=records)
    if not known:
        return campaign
    changed = replace(campaign, runs=runs, readings=readings, triad=triad)
    return changed if campaign.source is None else keep(changed, campaign.source)


def temperatures_of(
    campaign: Campaign, one: Run | Reading | PoseRecord, known: _Known
) -> tuple[float, ...] | None:
    """Return the temperatures of a run, reading or record of poses, K: what its own record says.

    known: Courses that were read, to which its own is added.
    """
    columns = columns_of_temperature(campaign, one)
    if columns is None or one.record is None:
        return one.temperature
    source, key = campaign.record_at(one.record), (one.record, columns.part)
    if isinstance(source, Path) and not source.exists():
        return one.temperature  # whoever reads the rest of it says so
    if key not in known:
        known[key] = read_course(source, columns)
    course = known[key]
    apart = max(
        (max(min(course) - stated, stated - max(course)) for stated in one.temperature or ()),
        default=0.0,
    )
    if apart > _APART:
        low, high = (f"{value - ZERO_CELSIUS:.4g}" for value in (min(course), max(course)))
        (column,) = columns.signals.values()
        raise RecordError(
            f"{source}: column '{column.name}' has temperatures from {low} to {high} degC; the run "
            f'"{one.name}" states one that is {apart:.3g} K off. Correct the unit of the column or '
            "the temperature of the run, or leave that out."
        )
    return course


def columns_of_temperature(
    campaign: Campaign, one: Run | Reading | PoseRecord
) -> RecordColumns | None:
    """Return the columns of time and temperature of a record; None where it has no temperature."""
    recording = Recording(campaign.time, None, campaign.dialect, campaign.temperature)
    columns = RecordColumns(campaign.time, None, {})
    if isinstance(one, Run):
        recording = campaign.recording_of(one)
        columns = replace(columns, part=one.part, more=tuple(one.continued_in))
    if recording.temperature is None:
        return None
    signals = {"temperature": recording.temperature}
    return replace(columns, time=recording.time, signals=signals, dialect=recording.dialect)
