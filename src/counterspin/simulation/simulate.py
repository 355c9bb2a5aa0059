"""`counterspin simulate`: records and readings of a campaign with known coefficients."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import overload

import numpy as np
import polars as pl

from counterspin.arrays import Array
from counterspin.campaign.conditions import run_conditions
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.campaign.documents import (
    DESCRIPTION_NAME,
    is_inside_folder,
    load_document,
    require_source,
)
from counterspin.campaign.memory import WRITERS, copy_record
from counterspin.campaign.reading import Reading
from counterspin.campaign.runs import Run, sample_count
from counterspin.campaign.simulated_truth import SimulatedTruth
from counterspin.campaign.static_noise import simulated_noise
from counterspin.errors import CampaignError, ExistingFileError, UsageError
from counterspin.inference.noise.model import SPECIFIC_FORCE, Noise
from counterspin.inference.noise.simulation import add_noise, add_white_noise
from counterspin.output import make_folder, write_atomically, write_text
from counterspin.physics import observation, simulation
from counterspin.physics.motion import Trajectory, encoder_error, perturb_trajectory
from counterspin.physics.own_velocity import AxisError, own_velocity_errors
from counterspin.records.memory import MemoryTable, make_memory_table
from counterspin.records.record import ColumnSpec
from counterspin.simulation.pose_record import indicated_forces, simulate_forces
from counterspin.simulation.readings import (
    NoiselessReadings,
    fill_description,
    fill_table,
    reading_generator,
    simulate_mean_record,
    true_poses,
    true_readings,
)
from counterspin.simulation.simulable import (
    apply_true_inputs,
    check_size,
    clock_ratio,
    gravity_ratio,
    reading_problems,
    refuse_unsupported,
    simulation_problems,
)
from counterspin.toml_text import parse_toml
from counterspin.units import TEMPERATURE_SCALES


@overload
def simulate(
    where: Path | str | Campaign,
    folder: Path | str,
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Path, ...]: ...
@overload
def simulate(where: Path | str | Campaign) -> Campaign: ...
def simulate(
    where: Path | str | Campaign,
    folder: Path | str | None = None,
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Path, ...] | Campaign:
    """Simulate the records of every run and the readings, in memory or as files.

    Each run has a separate random stream, so that adding or changing a run does not change the
    other runs.

    Parameters
    ----------
    where
        The campaign's folder, its ``campaign.toml``, or a `Campaign`; with [truth].
    folder
        Folder for the records and the description; created if missing. None: write nothing.
    overwrite
        True: replace the files of an earlier simulation, but no other files.
    progress
        Function called after each file with (written files, total files).

    Returns
    -------
    tuple of Path, or Campaign
        The record files, in the order of the runs, and the table of readings, if there is one.
        Without a folder: the campaign with its records in memory, and its truth.

    Raises
    ------
    CampaignError
        If the description is invalid, [truth] is missing or not credible, a run is too long, or
        the format of a record is not supported. A table of readings requires a folder.
    CounterspinError
        If a file exists already or cannot be written.
    """
    campaign = where if isinstance(where, Campaign) else read_campaign(where)
    _check_simulable(campaign)
    refuse_unsupported(campaign)
    if folder is None:
        return _simulate_in_memory(campaign)
    folder = Path(folder)
    targets = _record_targets(campaign, folder)
    readings, head_errors = true_readings(campaign)
    noiseless_readings = NoiselessReadings(readings, true_poses(campaign))
    generator = reading_generator(campaign, 1)
    has_readings = bool(readings or noiseless_readings.poses)
    text = fill_description(campaign, noiseless_readings, generator) if has_readings else None
    table = fill_table(campaign, noiseless_readings, generator) if has_readings else None
    if table is not None:
        targets = (*targets, *_targets_in_folder(campaign, folder, {"readings.file": table[0]}))
    if text is None and campaign.source is not None and campaign.source.in_memory:
        text = campaign.source.text
    description_path = folder / DESCRIPTION_NAME
    source_file = campaign.source.file if campaign.source else campaign.path
    is_source = (
        description_path.exists()
        and source_file is not None
        and description_path.samefile(source_file)
    )
    if description_path.exists() and not is_source and not _is_simulated(description_path):
        raise ExistingFileError(
            f"{description_path} does not belong to a simulated campaign, so its files were not "
            "overwritten. Choose another output folder"
        )
    replaced_descriptions = [description_path] if text is not None or not is_source else []
    static_records = _static_record_copy(campaign, folder)
    _check_targets(
        (*targets, *static_records, *replaced_descriptions), description_path, overwrite=overwrite
    )
    for target_folder in (folder, *(target.parent for target in (*targets, *static_records))):
        make_folder(target_folder)

    # Generators keep only one record in memory at a time.
    frames = chain(
        _simulate_run_records(campaign),
        _simulate_mean_records(campaign, head_errors),
        _simulate_pose_records(campaign),
        [table[1]] if table else [],
    )
    # Write the description first: it identifies the records of an interrupted simulation.
    if text is not None:
        write_text(description_path, text, overwrite=overwrite)
    elif not is_source:
        write_atomically(
            description_path, partial(shutil.copyfile, campaign.path), overwrite=overwrite
        )
    for target, static_record in static_records.items():
        copy_record(static_record, target, overwrite=overwrite)
    for n_written, (frame, target) in enumerate(zip(frames, targets, strict=True), start=1):
        write_frame = partial(WRITERS[target.suffix.lower()], frame)
        write_atomically(target, write_frame, overwrite=overwrite)
        if progress is not None:
            progress(n_written, len(targets))
    return targets


def _check_targets(paths: Sequence[Path], description_path: Path, *, overwrite: bool) -> None:
    """Raise CounterspinError for existing files that must not be replaced."""
    existing_files = [path for path in paths if path.exists()]
    if existing_files and not description_path.exists():
        raise ExistingFileError(
            f"{existing_files[0]} already exists, and its folder has no {DESCRIPTION_NAME} that "
            "describes a simulation, so the file was not overwritten. Choose another output folder"
        )
    if existing_files and not overwrite:
        raise ExistingFileError(
            f"{existing_files[0]} already exists; choose another output folder, or use "
            "`overwrite=True`"
        )


def _check_simulable(campaign: Campaign) -> None:
    """Raise CampaignError for a campaign that cannot be simulated."""
    if campaign.simulation is None:
        raise CampaignError(
            str(campaign.path),
            ["truth: missing; `simulate` requires [truth.NAME] tables with the true coefficients"],
            code="missing-key",
        )
    check_size(campaign, campaign.simulation.sampling_rate, "simulation")
    if problems := [*simulation_problems(campaign), *reading_problems(campaign)]:
        raise CampaignError(str(campaign.path), problems, code="not-simulable")


def _simulate_in_memory(campaign: Campaign) -> Campaign:
    """Return a campaign with simulated records and readings."""
    source = require_source(campaign)
    if "readings" in source.document:
        raise UsageError(
            str(campaign.path),
            ["readings: the simulation of a readings table requires an output folder"],
        )
    readings, head_errors = true_readings(campaign)
    noiseless_readings = NoiselessReadings(readings, true_poses(campaign))
    generator = reading_generator(campaign, 1)
    has_readings = bool(readings or noiseless_readings.poses)
    text = fill_description(campaign, noiseless_readings, generator) if has_readings else None
    if text is not None:
        source = replace(source, document=parse_toml(text))
    files: dict[Path, None] = dict.fromkeys(run.record for run in campaign.runs)
    files |= dict.fromkeys(
        reading.record for reading in campaign.readings if reading.record is not None
    )
    pose_records = campaign.triad.records if campaign.triad else ()
    files |= dict.fromkeys(record.record for record in pose_records)
    frames = [
        *_simulate_run_records(campaign),
        *_simulate_mean_records(campaign, head_errors),
        *_simulate_pose_records(campaign),
    ]
    names = {run.record: run.name for run in campaign.runs}
    names |= {
        reading.record: reading.name for reading in campaign.readings if reading.record is not None
    }
    names |= {record.record: record.name for record in pose_records}
    tables = {
        file: make_memory_table(f"{names[file]} in memory", frame)
        for file, frame in zip(files, frames, strict=True)
    }
    # A record at rest is not simulated; keep the existing frame.
    return Campaign.of(source, campaign.folder, {**campaign.frames, **tables})


def _simulate_run_records(campaign: Campaign) -> Iterator[pl.DataFrame]:
    """Yield the records of the runs of a double turntable."""
    assert campaign.simulation is not None
    streams = np.random.SeedSequence(campaign.simulation.seed).spawn(len(campaign.runs))
    for run, stream in zip(campaign.runs, streams, strict=True):
        yield pl.DataFrame(simulate_run(campaign, run, np.random.default_rng(stream)))


def _simulate_mean_records(campaign: Campaign, head_errors: Array) -> Iterator[pl.DataFrame]:
    """Yield the records whose means are readings, with a column for each accelerometer."""
    assert campaign.simulation is not None
    noise = simulated_noise(campaign)
    readings_with_errors = [
        (reading, float(head_errors[i])) for i, reading in enumerate(campaign.readings)
    ]
    readings_by_file: dict[Path, list[tuple[Reading, float]]] = {}
    for reading, angle_error in readings_with_errors:
        if reading.record is not None:
            readings_by_file.setdefault(reading.record, []).append((reading, angle_error))
    for index, file_readings in enumerate(readings_by_file.values()):
        generator = reading_generator(campaign, 2 + index)
        columns: dict[str, Array] = {}
        for reading, angle_error in file_readings:
            accelerometer = campaign.accelerometers[reading.accelerometer]
            times, angle, signal = simulate_mean_record(campaign, reading, angle_error)
            if not columns:
                clock_scale = clock_ratio(campaign, campaign.recording)
                timestamps = add_white_noise(generator, times * clock_scale, noise["timing"])
                columns[campaign.time.name] = timestamps / campaign.time.factor
                if campaign.angle is not None:
                    angle = add_white_noise(generator, angle, noise["angle"])
                    columns[campaign.angle.name] = campaign.angle.to_file_units(angle)
                columns |= _temperature_column(campaign.temperature, reading.temperature, times)
            observable = accelerometer.observable
            model = Noise.from_sizes(noise, observable).without_bias_instability
            signal = add_noise(generator, times, signal, model, observation.ORDERS[observable])
            channel = accelerometer.channel
            columns[channel.name] = channel.to_file_units(signal * gravity_ratio(campaign, channel))
        yield pl.DataFrame(columns)


def _simulate_pose_records(campaign: Campaign) -> Iterator[pl.DataFrame]:
    """Yield the records of poses."""
    assert campaign.simulation is not None
    noise, sampling_rate = simulated_noise(campaign), campaign.simulation.sampling_rate
    for index, record in enumerate(campaign.triad.records if campaign.triad else ()):
        generator = reading_generator(campaign, 0, 3 + index)
        times, force, _ = simulate_forces(
            record, campaign.simulation.poses, sampling_rate, generator
        )
        columns: dict[str, Array] = {}
        if campaign.time.kind != "rows":
            timestamps = add_white_noise(generator, times, noise["timing"])
            columns[campaign.time.name] = timestamps / campaign.time.factor
        columns |= _temperature_column(campaign.temperature, record.temperature, times)
        indications = indicated_forces(apply_true_inputs(campaign), record, times, force)
        model = Noise.from_sizes(noise, "specific_force").without_bias_instability
        for name, indication in indications.items():
            channel = campaign.accelerometers[name].force
            assert channel is not None
            signal = add_noise(generator, times, indication, model, SPECIFIC_FORCE)
            columns[channel.name] = channel.to_file_units(signal * gravity_ratio(campaign, channel))
        yield pl.DataFrame(columns)


def _temperature_column(
    column: ColumnSpec | None, temperatures: Sequence[float] | None, times: Array
) -> dict[str, Array]:
    """Return the temperature column for temperatures at equal intervals, K; empty without them."""
    if column is None or not temperatures:
        return {}
    file_column = replace(column, offset=TEMPERATURE_SCALES[column.unit or "degC"])
    knots = np.linspace(times[0], times[-1], len(temperatures))
    return {column.name: file_column.to_file_units(np.interp(times, knots, temperatures))}


def _is_simulated(description_path: Path) -> bool:
    try:
        return "truth" in load_document(description_path)
    except CampaignError:
        return False


def _record_targets(campaign: Campaign, folder: Path) -> tuple[Path, ...]:
    """Return the target path of each record, with its path relative to the campaign's folder."""
    records = {f"runs[{index}].record": run.record for index, run in enumerate(campaign.runs)}
    reading_records = dict.fromkeys(
        reading.record for reading in campaign.readings if reading.record is not None
    )
    names = {reading.record: reading.name for reading in campaign.readings}
    records |= {f'record of the run "{names[path]}"': path for path in reading_records}
    for record in campaign.triad.records if campaign.triad else ():
        records[f'record of the run "{record.name}"'] = record.record
    return _targets_in_folder(campaign, folder, records)


def _static_record_copy(campaign: Campaign, folder: Path) -> dict[Path, Path | MemoryTable]:
    """Return the record at rest by its target path; empty if it is not copied."""
    stated_path, resolved_path = campaign.noise and campaign.noise.rest, campaign.rest
    if not stated_path or resolved_path is None or Path(stated_path).is_absolute():
        return {}
    if ".." in Path(stated_path).parts:
        text = "is outside the campaign folder; choose a file in the folder of the description"
        raise CampaignError(
            str(campaign.path), [f"noise.from: {stated_path} {text}"], code="path-outside-folder"
        )
    target, record = folder / stated_path, campaign.record_at(resolved_path)
    is_same_file = isinstance(record, Path) and target.exists() and target.samefile(record)
    return {} if is_same_file else {target: record}


def _targets_in_folder(
    campaign: Campaign, folder: Path, files: Mapping[str, Path]
) -> tuple[Path, ...]:
    """Return the target paths of files, with their paths relative to the campaign's folder."""
    targets, problems = [], []
    for key, file in files.items():
        if file.suffix.lower() not in WRITERS:
            problems.append(
                f"{key}: {file.name} cannot be simulated; the file name must end in "
                f"{' or '.join(WRITERS)}"
            )
        elif not is_inside_folder(file, campaign.folder):
            problems.append(
                f"{key}: {file} is outside the campaign folder, where a simulation must not "
                "write; choose a file in the folder of the description"
            )
        else:
            targets.append(folder / file.relative_to(campaign.folder))
    if problems:
        raise CampaignError(str(campaign.path), problems, code="not-simulable")
    return tuple(targets)


def simulate_run(campaign: Campaign, run: Run, generator: np.random.Generator) -> dict[str, Array]:
    """Return the columns of the record of a run, in the units of its channels.

    Returns: column name -> values, shape (n,): time, angle (if recorded), temperature (if
        recorded), and one column for each accelerometer.
    """
    if campaign.simulation is None or run.duration is None:
        raise ValueError("this campaign has no data for a simulation")
    run_truth = campaign.simulation.truth.runs[run.name]
    sampling_rate = campaign.simulation.sampling_rate
    true_campaign, recording = apply_true_inputs(campaign), campaign.recording_of(run)
    trajectory = Trajectory(
        run_truth.spindle,
        true_campaign.radius.value,
        true_campaign.site,
        conditions=run_conditions(campaign)[run.name],
        table_ratio=run.table_ratio,
    )
    times = np.arange(sample_count(run.duration, sampling_rate)) / sampling_rate
    noise = simulated_noise(campaign)
    clock_scale = clock_ratio(campaign, recording)
    timestamps = add_white_noise(generator, times * clock_scale, noise["timing"])
    columns = {recording.time.name: timestamps / recording.time.factor}
    if recording.angle is not None:
        angle_delay = true_campaign.timing_offset.value if true_campaign.timing_offset else 0.0
        angle = run_truth.spindle.angle(times + angle_delay)
        angle = angle + encoder_error(run_truth.shared, angle)
        angle = add_white_noise(generator, angle, noise["angle"])
        columns[recording.angle.name] = recording.angle.to_file_units(angle)
    columns |= _temperature_column(recording.temperature, run.temperature, times)
    signals = _simulate_outputs(true_campaign, run, trajectory, times)
    for name, accelerometer in campaign.accelerometers.items():
        observable = accelerometer.observable
        signal = add_noise(
            generator,
            times,
            signals[name],
            Noise.from_sizes(noise, observable),
            observation.ORDERS[observable],
            trajectory.conditions.start,
        )
        channel = accelerometer.channel
        columns[channel.name] = channel.to_file_units(signal * gravity_ratio(campaign, channel))
    return columns


def _simulate_outputs(
    campaign: Campaign, run: Run, trajectory: Trajectory, times: Array
) -> dict[str, Array]:
    """Return the noiseless output of the navigation computer for each accelerometer."""
    assert campaign.simulation is not None
    truth = campaign.simulation.truth
    platform_values = truth.runs[run.name].shared
    signals = {}
    for name, accelerometer in campaign.accelerometers.items():
        signal = simulation.simulate_record(
            trajectory,
            accelerometer.mounting,
            truth.coefficients.get(name, {}),
            platform_values,
            times,
            accelerometer.observable,
            attitude=run.attitude,
        )
        signals[name] = signal + _start_error(truth, name, times, accelerometer.observable)
    if not campaign.own_velocity:
        return signals
    # The residual gravity also affects the velocity of the navigation computer.
    site = replace(campaign.site, removed_gravity=None)
    perturbed_trajectory = perturb_trajectory(replace(trajectory, site=site), platform_values)
    errors = []
    for name, accelerometer in campaign.accelerometers.items():
        observable = accelerometer.observable
        axis = accelerometer.mounting.turned(run.attitude).input_axis
        reference_signal = observation.reference(
            perturbed_trajectory, accelerometer.mounting, times, observable, run.attitude
        )
        errors.append(AxisError(axis, observable, times, signals[name] - reference_signal))
    corrected_errors = own_velocity_errors(site, errors)
    return {
        name: signal + corrected_error - error.error
        for (name, signal), corrected_error, error in zip(
            signals.items(), corrected_errors, errors, strict=True
        )
    }


def _start_error(truth: SimulatedTruth, name: str, times: Array, observable: str) -> Array | float:
    """Return the contribution of the start errors to the output; zero for a specific force."""
    offset, velocity = truth.start_offset.get(name, 0.0), truth.start_velocity.get(name, 0.0)
    if observable == "displacement":
        return offset + velocity * times
    return velocity if observable == "velocity" else 0.0
