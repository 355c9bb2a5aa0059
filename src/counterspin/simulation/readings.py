"""Simulated readings: the indications at each station, and files that contain these values."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.description import Campaign
from counterspin.campaign.documents import load_document
from counterspin.campaign.quantity import NUMBER, PLUS_MINUS, parse_quantity
from counterspin.campaign.reading import Reading
from counterspin.campaign.runs import is_pose, is_reading, sample_count
from counterspin.campaign.terms import POSITION_SYMBOL
from counterspin.campaign.validation import Problems
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.input import read_file
from counterspin.physics.motion import encoder_error
from counterspin.physics.spindle import Spindle
from counterspin.physics.station import Stations, mean_products
from counterspin.physics.terms import TERMS, coefficient_of, condition_of
from counterspin.readings.cells import BLANK, is_empty
from counterspin.readings.groups import group_readings, numbered_groups
from counterspin.readings.known_attitudes import Readings
from counterspin.readings.section import ReadingsSettings
from counterspin.readings.table import ReadingsTable, load_table
from counterspin.simulation.simulable import apply_inputs_to_readings, apply_true_inputs
from counterspin.toml_text import format_document, parse_toml
from counterspin.triads.groups import make_group
from counterspin.triads.poses import predict_indications
from counterspin.units import unit_factor

#: Number of digits of simulated readings beyond their standard uncertainty.
_EXTRA_DIGITS: Final = 3

_NUMBER_PATTERN = re.compile(rf"\s*({NUMBER}|{re.escape(BLANK)})\s*(.*)", re.DOTALL)


def compute_indications(
    group: Readings,
    coefficients: Mapping[str, float],
    machine_terms: Mapping[str, float],
    head_error: Array,
) -> Array:
    """Return the noiseless indication at each reading of a group, in g, without linearisation.

    coefficients: True values of the accelerometer in g-units, including slopes; others are nominal.
    machine_terms: True values of the terms of the machine, which move the stations.
    head_error: Angle error of the dividing head at each reading, rad, shape (n,).
    """
    stations = group.rotate_head(group.stations_with(machine_terms), head_error)
    products = mean_products(stations, group.site)
    indications: Array = np.sum(products * _effective_coefficients(group, coefficients), axis=1)
    return indications


def _effective_coefficients(group: Readings, coefficients: Mapping[str, float]) -> Array:
    """Return the coefficients under the conditions of each reading, shape (n, terms)."""
    reference_values = [coefficients.get(symbol, row.nominal) for symbol, row in TERMS.items()]
    effective_coefficients = np.tile(reference_values, (group.size, 1))
    for symbol, value in coefficients.items():
        if condition_of(symbol):
            index = list(TERMS).index(coefficient_of(symbol))
            effective_coefficients[:, index] += value * group.design_factor(symbol)
    return effective_coefficients


def head_errors(readings: Sequence[Reading], generator: np.random.Generator) -> Array:
    """Return angle errors of the dividing head, rad, shape (n,).

    The accelerometers of a run have the same error.
    """
    return draw_by_run(readings, generator) * [reading.u_head for reading in readings]


def rate_errors(campaign: Campaign) -> Array:
    """Return relative errors of rates and amplitudes, shape (n,).

    The accelerometers of a run have the same error.
    """
    readings = campaign.readings
    u = [
        (reading.u_rate or 0.0) / abs(reading.rate) if reading.rate else reading.u_amplitude
        for reading in readings
    ]
    return draw_by_run(readings, reading_generator(campaign, 1, 1)) * u


def draw_by_run(readings: Sequence[Reading], generator: np.random.Generator) -> Array:
    """Return standard normal numbers, shape (n,), equal for all accelerometers of a run."""
    draws: dict[tuple[str, int], float] = {}
    numbers = np.zeros(len(readings))
    counts: Counter[tuple[str, str]] = Counter()
    for index, reading in enumerate(readings):
        # Several readings of a table may have the same name; each is a separate position.
        key = (reading.accelerometer, reading.name)
        position = (reading.name, counts[key])
        counts[key] += 1
        if position not in draws:
            draws[position] = float(generator.standard_normal())
        numbers[index] = draws[position]
    return numbers


def positioning_uncertainties(campaign: Campaign) -> dict[str, float]:
    """Return symbol -> standard uncertainty of the positioning error, rad."""
    priors = campaign.model.priors.items()
    return {symbol: prior.u for symbol, prior in priors if symbol.startswith(f"{POSITION_SYMBOL}.")}


def true_machine(campaign: Campaign) -> dict[str, float]:
    """Return the true machine terms, including random positioning errors."""
    assert campaign.simulation is not None
    generator = reading_generator(campaign, 0, 1)
    uncertainties = positioning_uncertainties(campaign)
    errors = {symbol: u * float(generator.standard_normal()) for symbol, u in uncertainties.items()}
    return errors | dict(campaign.simulation.truth.machine)


def true_readings(campaign: Campaign) -> tuple[tuple[Reading, ...], Array]:
    """Return the readings of a campaign with noiseless values, and the errors of the dividing head.

    Returns: the readings in the order of the campaign, with unchanged readings of records; the
        errors, rad, shape (n,).
    """
    assert campaign.simulation is not None
    truth, readings = campaign.simulation.truth, campaign.readings
    angle_errors = head_errors(readings, reading_generator(campaign, 0))
    values, machine_terms = np.zeros(len(readings)), true_machine(campaign)
    rates, relative_errors = true_rates(campaign), rate_errors(campaign)
    for group, indices in numbered_groups(campaign, campaign.readings):
        coefficients = truth.coefficients.get(group.accelerometer, {})
        true_group = apply_rates(apply_inputs_to_readings(campaign, group), rates[indices])
        true_group = true_group.with_rate_errors(relative_errors[indices])
        values[indices] = compute_indications(
            true_group, coefficients, machine_terms, angle_errors[indices]
        )
    return tuple(
        reading if reading.record else replace(reading, value=value)
        for reading, value in zip(readings, values.tolist(), strict=True)
    ), angle_errors


def true_rates(campaign: Campaign) -> Array:
    """Return the root mean square of the true rate in each reading, rad/s, shape (n,).

    The mean is over the revolutions of the reading. The sign is the sense; 0 at rest.
    """
    assert campaign.simulation is not None
    truth_by_reading = campaign.simulation.truth.reading_runs
    return np.array(
        [
            _mean_rate(
                truth_by_reading[reading.name, reading.rate].spindle, reading.duration or 0.0
            )
            if reading.rate
            else 0.0
            for reading in campaign.readings
        ]
    )


def _mean_rate(spindle: Spindle, duration: float) -> float:
    """Return the root mean square of a rate, with its sign, rad/s.

    The phase of the ripple has no effect on whole revolutions at constant rate.
    """
    relative_drift = spindle.drift * duration
    mean_square = spindle.rate**2 * (1.0 + relative_drift + relative_drift**2 / 3.0)
    ripple_mean_square = sum(0.5 * harmonic.amplitude**2 for harmonic in spindle.ripples)
    return math.copysign(math.sqrt(mean_square + ripple_mean_square), spindle.rate)


def apply_rates(group: Readings, rates: Array) -> Readings:
    """Return the readings at true rates that differ from the stated rates.

    rates: True rates, rad/s, shape (n,).
    """
    stated_rates = np.array(group.stated_rates)
    relative_errors = (
        np.divide(rates, stated_rates, out=np.ones_like(rates), where=stated_rates != 0.0) - 1.0
    )
    return group.with_rate_errors(relative_errors)


def true_poses(campaign: Campaign) -> tuple[tuple[Reading, ...], ...]:
    """Return the poses at unknown attitudes with noiseless values.

    The directions are uniformly distributed over the sphere and depend on the seed.
    """
    assert campaign.simulation is not None
    if campaign.triad is None or not campaign.triad.poses:
        return ()
    poses, truth = campaign.triad.poses, campaign.simulation.truth.coefficients
    group = make_group(campaign, poses)
    directions = true_directions(campaign)
    values = predict_indications(
        group, [truth.get(name, {}) for name in group.accelerometers], directions
    )
    return tuple(
        tuple(
            replace(reading, value=value) for reading, value in zip(pose, pose_values, strict=True)
        )
        for pose, pose_values in zip(poses, values.tolist(), strict=True)
    )


def true_directions(campaign: Campaign) -> Array:
    """Return the directions of the specific force in the poses, unit vectors, shape (n, 3)."""
    n_poses = len(campaign.triad.poses) if campaign.triad else 0
    directions = reading_generator(campaign, 0, 2).standard_normal((n_poses, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1)[:, None], np.float64)


def reading_generator(campaign: Campaign, *stream: int) -> np.random.Generator:
    """Return a random generator that is independent of the runs of the double turntable.

    stream: 0: dividing head; (0, 1): positions; (0, 2): unknown attitudes; (0, 3 + i): record i of
        poses; 1: noise of the readings; (1, 1): rates; 2 + i: record i.
    """
    assert campaign.simulation is not None
    return np.random.default_rng(
        np.random.SeedSequence(campaign.simulation.seed, spawn_key=(0, *stream))
    )


def simulate_mean_record(
    campaign: Campaign, reading: Reading, head_error: float
) -> tuple[Array, Array, Array]:
    """Return time (s), recorded angle (rad) and indicated force (m/s^2), each shape (n,).

    The angle is the noiseless angle of the encoder.

    head_error: Angle error of the dividing head, rad.
    """
    assert campaign.simulation is not None
    truth, sampling_rate = campaign.simulation.truth, campaign.simulation.sampling_rate
    if reading.duration is None:
        raise ValueError(f'the run "{reading.name}" has no duration')
    times = np.arange(sample_count(reading.duration, sampling_rate)) / sampling_rate
    (group,) = (
        apply_inputs_to_readings(campaign, reading_group)
        for reading_group in group_readings(campaign, [reading])
    )
    stations = group.stations_with(true_machine(campaign))
    stations = group.rotate_head(stations, np.array([head_error]))
    (effective_coefficients,) = _effective_coefficients(
        group, truth.coefficients.get(reading.accelerometer, {})
    )
    if not reading.rate:
        zeros = np.zeros_like(times)
        return (
            times,
            zeros,
            _instantaneous_force(
                group, effective_coefficients, stations, stations.forces(group.site, zeros)
            ),
        )
    run_truth = truth.reading_runs[reading.name, reading.rate]
    spindle = run_truth.spindle
    stations = replace(stations, rate=np.array([_mean_rate(spindle, reading.duration)]))
    forces = stations.forces(
        group.site,
        spindle.angle(times),
        spindle.angular_rate(times),
        spindle.angular_acceleration(times),
    )
    timing_offset = apply_true_inputs(campaign).timing_offset
    angle = spindle.angle(times + (timing_offset.value if timing_offset else 0.0))
    angle = angle + encoder_error(run_truth.shared, angle)
    return times, angle, _instantaneous_force(group, effective_coefficients, stations, forces)


def _instantaneous_force(
    group: Readings, effective_coefficients: Array, stations: Stations, forces: Array
) -> Array:
    """Return the indicated specific force, m/s^2, shape (n,).

    stations: Station of the reading.
    forces: Specific force in the frame of the station, m/s^2, shape (1, n, 3).
    """
    indicated: Array = group.site.gravity * (
        effective_coefficients @ stations.products(group.site, forces)[:, 0]
    )
    return indicated


# Files: the description and the table of readings


@frozen
class NoiselessReadings:
    """Noiseless readings."""

    readings: tuple[Reading, ...]  #: Readings at known attitudes, in the order of the campaign.
    poses: tuple[tuple[Reading, ...], ...]  #: Poses at unknown attitudes.


def fill_description(
    campaign: Campaign, noiseless_readings: NoiselessReadings, generator: np.random.Generator
) -> str | None:
    """Return the description of a campaign with simulated values of the readings of its runs.

    Comments are kept if each value is a string on one line.

    Returns: None if no run has a reading.
    """
    text = _description_text(campaign)
    document = parse_toml(text)
    runs = [run for run in document.get("runs", []) if is_reading(run)]
    if not any("reading" in run for run in runs):
        return None
    readings, poses = iter(noiseless_readings.readings), iter(noiseless_readings.poses)
    search_start, edited_text = 0, text
    for run in runs:
        if "reading" not in run:
            # A record has a reading of each accelerometer; a record of poses has none.
            for _ in () if is_pose(run) else campaign.accelerometers:
                next(readings)
            continue
        old_texts = _repeat_texts(run["reading"])
        new_texts = []
        run_readings = _pose_readings(next(poses), run["reading"]) if is_pose(run) else readings
        for cells in old_texts:
            reading = next(run_readings)
            new_texts.append([_simulate_text(cell, campaign, reading, generator) for cell in cells])
        run["reading"] = _restore_structure(run["reading"], new_texts)
        for old_text, new_text in zip(chain(*old_texts), chain(*new_texts), strict=True):
            position = edited_text.find(f'"{old_text}"', search_start)
            if position >= 0:
                end = position + len(old_text) + 2
                edited_text = f'{edited_text[:position]}"{new_text}"{edited_text[end:]}'
                search_start = position + len(new_text)
    return edited_text if _parses_to(edited_text, document) else format_document(document)


def _pose_readings(pose: Sequence[Reading], names: Iterable[str]) -> Iterator[Reading]:
    """Return the readings of a pose in the order of accelerometer names."""
    readings_by_name = {reading.accelerometer: reading for reading in pose}
    return iter([readings_by_name[name] for name in names])


def _description_text(campaign: Campaign) -> str:
    """Return the text of the description of a campaign."""
    if campaign.source is not None and campaign.source.in_memory:
        return campaign.source.text
    return read_file(campaign.path).decode("utf-8-sig")


def _repeat_texts(reading: Any) -> list[list[str]]:
    """Return the texts of the repeats for each accelerometer of a reading."""
    cells = list(reading.values()) if isinstance(reading, dict) else [reading]
    return [[cell] if isinstance(cell, str) else cell for cell in cells]


def _restore_structure(reading: Any, new_texts: list[list[str]]) -> Any:
    """Return new texts with the structure of `reading`."""
    cells = list(reading.values()) if isinstance(reading, dict) else [reading]
    formatted_cells: list[Any] = [
        repeat_texts[0] if isinstance(cell, str) else repeat_texts
        for cell, repeat_texts in zip(cells, new_texts, strict=True)
    ]
    if isinstance(reading, dict):
        return dict(zip(reading, formatted_cells, strict=True))
    return formatted_cells[0]


def _parses_to(text: str, document: Mapping[str, Any]) -> bool:
    try:
        return parse_toml(text) == document
    except ValueError:
        return False


def _simulate_text(
    old_text: str, campaign: Campaign, reading: Reading, generator: np.random.Generator
) -> str:
    """Return the text of a reading with its simulated value, keeping the unit and the ±."""
    output, output_at_zero = campaign.accelerometers[reading.accelerometer].output, 0.0
    match = _NUMBER_PATTERN.fullmatch(old_text)
    assert match is not None
    unit_text = match[2] or (output.unit if output else "g")
    unit = re.sub(rf"^{PLUS_MINUS}{NUMBER}\s*", "", unit_text)
    if output is None:
        output_per_g = unit_factor("g", unit, gravity=apply_true_inputs(campaign).gravity.value)
    else:
        unit_scale = unit_factor(output.unit, unit)
        output_per_g, output_at_zero = unit_scale * output.sensitivity, unit_scale * output.zero
    stated_u = parse_quantity(f"0 {unit_text}", unit).u
    scale_and_zero = (output_per_g, output_at_zero)
    value = _noisy_reading(campaign, reading, scale_and_zero, stated_u, generator)
    return f"{value!r} {unit_text}"


def _noisy_reading(
    campaign: Campaign,
    reading: Reading,
    scale_and_zero: tuple[float, float],
    stated_u: float,
    generator: np.random.Generator,
) -> float:
    """Return a reading with noise, rounded to a few digits beyond its uncertainty.

    scale_and_zero: Output per g, and output at 0 g, in the unit of the reading.
    stated_u: Stated standard uncertainty, in the unit of the reading.
    """
    output_per_g, output_at_zero = scale_and_zero
    assert campaign.simulation is not None
    true_noise = campaign.simulation.truth.reading_noise.get(reading.accelerometer)
    u = stated_u if true_noise is None else true_noise * abs(output_per_g)
    value = output_at_zero + reading.value * output_per_g + u * float(generator.standard_normal())
    return round(value, _EXTRA_DIGITS - math.floor(math.log10(u))) if u > 0.0 else value


def fill_table(
    campaign: Campaign, noiseless_readings: NoiselessReadings, generator: np.random.Generator
) -> tuple[Path, Any] | None:
    """Return the file of [readings], and its table as a polars frame with simulated values.

    Returns: None without this section.
    """
    import polars as pl

    document = campaign.source.document if campaign.source else load_document(campaign.path)
    if "readings" not in document:
        return None
    settings = ReadingsSettings.model_validate(document["readings"])
    path = campaign.folder / settings.file
    required_dialect = settings.model_copy(update={"decimal": None, "sheet": None}).dialect
    stated_keys = [key for key, value in vars(required_dialect).items() if value is not None]
    if stated_keys:
        raise CampaignError(
            str(campaign.path),
            [
                f"readings.{key}: a simulated table cannot have this key; omit it"
                for key in stated_keys
            ],
            code="conflicting-keys",
        )
    frame = load_table(path, settings.dialect)[0].frame
    outputs = {
        name: accelerometer.output for name, accelerometer in campaign.accelerometers.items()
    }
    table = ReadingsTable(settings, outputs, Problems(document), document)
    rows = [
        (index, row)
        for index, row in enumerate(frame.iter_rows(named=True))
        if table.is_reading_row(row)
    ]
    values = {
        column: [None if is_empty(cell) else cell for cell in frame[column].to_list()]
        for view in table.mounting_views({})
        for columns in view.value_columns("reading").values()
        for column in columns
    }
    is_posed_row = [is_pose(table.make_run(row, index, ())) for index, row in rows]
    # The readings of the table are last.
    first_reading = len(noiseless_readings.readings) - sum(
        len(view.value_columns("reading"))
        for (_, row), is_posed in zip(rows, is_posed_row, strict=True)
        for view in ([] if is_posed else table.mounting_views(row))
    )
    readings = iter(noiseless_readings.readings[first_reading:])
    poses = iter(noiseless_readings.poses[-sum(is_posed_row) or None :])
    for (index, row), is_posed in zip(rows, is_posed_row, strict=True):
        row_readings = (
            _pose_readings(next(poses), table.value_columns("reading")) if is_posed else readings
        )
        row_columns = [
            (view, name, columns)
            for view in table.mounting_views(row)
            for name, columns in view.value_columns("reading").items()
        ]
        for view, name, columns in row_columns:
            reading = next(row_readings)
            output = outputs[name]
            u = view.u(row, name, ()) or 0.0
            for column in [column for column in columns if not is_empty(row[column])] or columns:
                scale = (output.sensitivity, output.zero) if output else (1.0, 0.0)
                values[column][index] = _noisy_reading(campaign, reading, scale, u, generator)
    return path, frame.with_columns([pl.Series(column, cells) for column, cells in values.items()])
