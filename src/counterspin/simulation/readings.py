"""Simulated readings: what is indicated at each station, and the files with these values in."""

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
from counterspin.campaign.terms import POSITION
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

#: Simulated readings are written with so many digits beyond their standard uncertainty.
_EXTRA_DIGITS: Final = 3

_NUMBER_PATTERN = re.compile(rf"\s*({NUMBER}|{re.escape(BLANK)})\s*(.*)", re.DOTALL)


def indications(
    group: Readings,
    coefficients: Mapping[str, float],
    machine: Mapping[str, float],
    head_error: Array,
) -> Array:
    """Return the noiseless indication at each reading of a group, in g.

    Nothing is linearised: the stations are moved by what the machine does.

    coefficients: True values of the accelerometer in g-units, slopes included; those not named are
        nominal.
    head_error: Error of the dividing head's angle at each reading, rad, shape (n,).
    """
    stations = group.rotate_head(group.stations_with(machine), head_error)
    products = mean_products(stations, group.site)
    indicated: Array = np.sum(products * _effective_coefficients(group, coefficients), axis=1)
    return indicated


def _effective_coefficients(group: Readings, coefficients: Mapping[str, float]) -> Array:
    """Return the coefficients at each reading, under its conditions, shape (n, terms)."""
    nominal = [coefficients.get(symbol, row.nominal) for symbol, row in TERMS.items()]
    effective = np.tile(nominal, (group.size, 1))
    for symbol, value in coefficients.items():
        if condition_of(symbol):
            place = list(TERMS).index(coefficient_of(symbol))
            effective[:, place] += value * group.design_factor(symbol)
    return effective


def head_errors(readings: Sequence[Reading], generator: np.random.Generator) -> Array:
    """Return errors of the dividing head's angle, rad: one for all accelerometers of a run."""
    return draw_by_run(readings, generator) * [reading.u_head for reading in readings]


def setting_errors(campaign: Campaign) -> Array:
    """Return relative errors of rates and amplitudes: one for all accelerometers of a run."""
    readings = campaign.readings
    u = [(r.u_rate or 0.0) / abs(r.rate) if r.rate else r.u_amplitude for r in readings]
    return draw_by_run(readings, reading_generator(campaign, 1, 1)) * u


def draw_by_run(readings: Sequence[Reading], generator: np.random.Generator) -> Array:
    """Return standard normal numbers: one for all accelerometers of a run, shape (n,)."""
    drawn: dict[tuple[str, int], float] = {}
    numbers = np.zeros(len(readings))
    first_indices: Counter[tuple[str, str]] = Counter()
    for index, reading in enumerate(readings):
        # A table may name several readings alike; each is a position of its own.
        key = (reading.accelerometer, reading.name)
        position = (reading.name, first_indices[key])
        first_indices[key] += 1
        if position not in drawn:
            drawn[position] = float(generator.standard_normal())
        numbers[index] = drawn[position]
    return numbers


def setting_spread(campaign: Campaign) -> dict[str, float]:
    """Return the standard uncertainty of setting each position, rad, by symbol."""
    priors = campaign.model.priors.items()
    return {symbol: prior.u for symbol, prior in priors if symbol.startswith(f"{POSITION}.")}


def true_machine(campaign: Campaign) -> dict[str, float]:
    """Return the true machine terms, including drawn errors of setting positions."""
    assert campaign.simulation is not None
    generator, spread = reading_generator(campaign, 0, 1), setting_spread(campaign)
    errors = {symbol: u * float(generator.standard_normal()) for symbol, u in spread.items()}
    return errors | dict(campaign.simulation.truth.machine)


def true_readings(campaign: Campaign) -> tuple[tuple[Reading, ...], Array]:
    """Return a campaign's readings with what would be read without noise, and the head's errors.

    Returns: the readings in the campaign's order, those of records as they were; rad, shape (n,).
    """
    assert campaign.simulation is not None
    truth, readings = campaign.simulation.truth, campaign.readings
    errors = head_errors(readings, reading_generator(campaign, 0))
    values, machine = np.zeros(len(readings)), true_machine(campaign)
    rates, errors_of_settings = true_rates(campaign), setting_errors(campaign)
    for group, indices in numbered_groups(campaign, campaign.readings):
        coefficients = truth.coefficients.get(group.accelerometer, {})
        stated_reading = apply_rates(apply_inputs_to_readings(campaign, group), rates[indices])
        stated_reading = stated_reading.with_setting_errors(errors_of_settings[indices])
        values[indices] = indications(stated_reading, coefficients, machine, errors[indices])
    return tuple(
        reading if reading.record else replace(reading, value=value)
        for reading, value in zip(readings, values.tolist(), strict=True)
    ), errors


def true_rates(campaign: Campaign) -> Array:
    """Return the root mean square of the true rate in each reading, rad/s, shape (n,).

    It is that over the revolutions of the reading, with the sign of the sense; 0 at rest.
    """
    assert campaign.simulation is not None
    read = campaign.simulation.truth.reading_runs
    return np.array(
        [
            _mean_rate(read[r.name, r.rate].spindle, r.duration or 0.0) if r.rate else 0.0
            for r in campaign.readings
        ]
    )


def _mean_rate(spindle: Spindle, duration: float) -> float:
    """Return the root mean square of a rate, with its sign, rad/s.

    The phase of the ripple has no effect on whole revolutions at constant rate.
    """
    drift = spindle.drift * duration
    slow = spindle.rate**2 * (1.0 + drift + drift**2 / 3.0)
    ripple = sum(0.5 * harmonic.amplitude**2 for harmonic in spindle.ripples)
    return math.copysign(math.sqrt(slow + ripple), spindle.rate)


def apply_rates(group: Readings, rates: Array) -> Readings:
    """Return readings that were taken at these rates than the stated ones, rad/s, shape (n,)."""
    stated = np.array(group.stated_rates)
    errors = np.divide(rates, stated, out=np.ones_like(rates), where=stated != 0.0) - 1.0
    return group.with_setting_errors(errors)


def true_poses(campaign: Campaign) -> tuple[tuple[Reading, ...], ...]:
    """Return the poses at unknown attitudes with what would be read without noise.

    Their directions are drawn from the seed, all over the sphere.
    """
    assert campaign.simulation is not None
    if campaign.triad is None or not campaign.triad.poses:
        return ()
    poses, truth = campaign.triad.poses, campaign.simulation.truth.coefficients
    group = make_group(campaign, poses)
    along = true_directions(campaign)
    values = predict_indications(
        group, [truth.get(name, {}) for name in group.accelerometers], along
    )
    return tuple(
        tuple(
            replace(reading, value=value) for reading, value in zip(pose, pose_values, strict=True)
        )
        for pose, pose_values in zip(poses, values.tolist(), strict=True)
    )


def true_directions(campaign: Campaign) -> Array:
    """Return the directions of the specific force in the poses, unit vectors, shape (n, 3)."""
    count = len(campaign.triad.poses) if campaign.triad else 0
    along = reading_generator(campaign, 0, 2).standard_normal((count, 3))
    return np.asarray(along / np.linalg.norm(along, axis=1)[:, None], np.float64)


def reading_generator(campaign: Campaign, *which: int) -> np.random.Generator:
    """Return random numbers that no run of the double turntable has.

    So a run that is added changes no reading, and the other way round.

    which: 0 of the head, 0 and 1 of positions, 0 and 2 of unknown attitudes, 0 and from 3 on of
        records of poses, 1 of the readings' noise, 1 and 1 of rates, from 2 on of records.
    """
    assert campaign.simulation is not None
    return np.random.default_rng(
        np.random.SeedSequence(campaign.simulation.seed, spawn_key=(0, *which))
    )


def simulate_mean_record(
    campaign: Campaign, reading: Reading, head_error: float
) -> tuple[Array, Array, Array]:
    """Return time (s), recorded angle (rad) and indicated force (m/s^2), each shape (n,).

    The angle is that of the encoder without noise.

    head_error: Error of the dividing head's angle, rad.
    """
    assert campaign.simulation is not None
    truth, rate = campaign.simulation.truth, campaign.simulation.sampling_rate
    if reading.duration is None:
        raise ValueError(f'the run "{reading.name}" has no duration')
    time = np.arange(sample_count(reading.duration, rate)) / rate
    (group,) = (
        apply_inputs_to_readings(campaign, reading_group)
        for reading_group in group_readings(campaign, [reading])
    )
    stations = group.stations_with(true_machine(campaign))
    stations = group.rotate_head(stations, np.array([head_error]))
    (effective,) = _effective_coefficients(group, truth.coefficients.get(reading.accelerometer, {}))
    if not reading.rate:
        still = np.zeros_like(time)
        return (
            time,
            still,
            _instantaneous_force(group, effective, stations, stations.forces(group.site, still)),
        )
    of_run = truth.reading_runs[reading.name, reading.rate]
    spindle = of_run.spindle
    stations = replace(stations, rate=np.array([_mean_rate(spindle, reading.duration)]))
    forces = stations.forces(
        group.site,
        spindle.angle(time),
        spindle.angular_rate(time),
        spindle.angular_acceleration(time),
    )
    late = apply_true_inputs(campaign).timing_offset
    angle = spindle.angle(time + (late.value if late else 0.0))
    angle = angle + encoder_error(of_run.shared, angle)
    return time, angle, _instantaneous_force(group, effective, stations, forces)


def _instantaneous_force(
    group: Readings, effective: Array, stations: Stations, forces: Array
) -> Array:
    """Return the indicated specific force, m/s^2, shape (n,).

    stations: The station of the reading.
    forces: In its frame, m/s^2, shape (1, n, 3).
    """
    found: Array = group.site.gravity * (effective @ stations.products(group.site, forces)[:, 0])
    return found


# Files: the description and the table of readings


@frozen
class NoiselessReadings:
    """Noiseless readings."""

    readings: tuple[Reading, ...]  #: At known attitudes, in the campaign's order.
    poses: tuple[tuple[Reading, ...], ...]  #: At unknown ones.


def fill_description(
    campaign: Campaign, exact: NoiselessReadings, generator: np.random.Generator
) -> str | None:
    """Return a campaign's description with values in place of those of its runs.

    Comments stay where they are, as long as the text is of the usual form.

    Returns: none if no run has a reading, so that nothing is to be changed.
    """
    text = _description_text(campaign)
    document = parse_toml(text)
    runs = [run for run in document.get("runs", []) if is_reading(run)]
    if not any("reading" in run for run in runs):
        return None
    readings, poses = iter(exact.readings), iter(exact.poses)
    index, edited = 0, text
    for run in runs:
        if "reading" not in run:
            # A record, of all accelerometers; that of poses is none of a reading.
            for _ in () if is_pose(run) else campaign.accelerometers:
                next(readings)
            continue
        old = _repeat_texts(run["reading"])
        new = []
        filled = _pose_readings(next(poses), run["reading"]) if is_pose(run) else readings
        for texts in old:
            reading = next(filled)
            new.append([_replace_value(text, campaign, reading, generator) for text in texts])
        run["reading"] = _format_like(run["reading"], new)
        for before, after in zip(chain(*old), chain(*new), strict=True):
            where = edited.find(f'"{before}"', index)
            if where >= 0:
                edited = f'{edited[:where]}"{after}"{edited[where + len(before) + 2 :]}'
                index = where + len(after)
    return edited if _parses_to(edited, document) else format_document(document)


def _pose_readings(pose: Sequence[Reading], names: Iterable[str]) -> Iterator[Reading]:
    """Return the readings of a pose in the order in which accelerometers are named."""
    by_name = {reading.accelerometer: reading for reading in pose}
    return iter([by_name[name] for name in names])


def _description_text(campaign: Campaign) -> str:
    """Return a campaign's description as it is written."""
    if campaign.source is not None and campaign.source.in_memory:
        return campaign.source.text
    return read_file(campaign.path).decode("utf-8-sig")


def _repeat_texts(reading: Any) -> list[list[str]]:
    """Return the repeats of each accelerometer's reading as they are written."""
    cells = list(reading.values()) if isinstance(reading, dict) else [reading]
    return [[cell] if isinstance(cell, str) else cell for cell in cells]


def _format_like(reading: Any, new: list[list[str]]) -> Any:
    """Return new texts in the form of the old ones."""
    cells = list(reading.values()) if isinstance(reading, dict) else [reading]
    written: list[Any] = [
        texts[0] if isinstance(cell, str) else texts for cell, texts in zip(cells, new, strict=True)
    ]
    return dict(zip(reading, written, strict=True)) if isinstance(reading, dict) else written[0]


def _parses_to(text: str, document: Mapping[str, Any]) -> bool:
    try:
        return parse_toml(text) == document
    except ValueError:
        return False


def _replace_value(
    old: str, campaign: Campaign, reading: Reading, generator: np.random.Generator
) -> str:
    """Return the text of a reading with another value, in the unit and with the ± that it has."""
    output, zero = campaign.accelerometers[reading.accelerometer].output, 0.0
    match = _NUMBER_PATTERN.fullmatch(old)
    assert match is not None
    rest = match[2] or (output.unit if output else "g")
    unit = re.sub(rf"^{PLUS_MINUS}{NUMBER}\s*", "", rest)
    if output is None:
        per_g = unit_factor("g", unit, gravity=apply_true_inputs(campaign).gravity.value)
    else:
        size = unit_factor(output.unit, unit)
        per_g, zero = size * output.sensitivity, size * output.zero
    stated = parse_quantity(f"0 {rest}", unit).u
    return f"{_noisy_reading(campaign, reading, (per_g, zero), stated, generator)!r} {rest}"


def _noisy_reading(
    campaign: Campaign,
    reading: Reading,
    scale: tuple[float, float],
    stated: float,
    generator: np.random.Generator,
) -> float:
    """Return a reading with noise, with some digits more than its noise leaves it.

    scale: How much of the unit a g is, and what is read where there is none.
    """
    per_g, zero = scale
    assert campaign.simulation is not None
    uncertainty = campaign.simulation.truth.reading_noise.get(reading.accelerometer)
    u = stated if uncertainty is None else uncertainty * abs(per_g)
    value = zero + reading.value * per_g + u * float(generator.standard_normal())
    return round(value, _EXTRA_DIGITS - math.floor(math.log10(u))) if u > 0.0 else value


def fill_table(
    campaign: Campaign, exact: NoiselessReadings, generator: np.random.Generator
) -> tuple[Path, Any] | None:
    """Return the file that [readings] names, and the table, a polars frame, with values in it.

    Returns: none if there is no such section.
    """
    import polars as pl

    raw = campaign.source.document if campaign.source else load_document(campaign.path)
    if "readings" not in raw:
        return None
    settings = ReadingsSettings.model_validate(raw["readings"])
    path = campaign.folder / settings.file
    is_plain = settings.model_copy(update={"decimal": None, "sheet": None}).dialect
    stated_names = [key for key, value in vars(is_plain).items() if value is not None]
    if stated_names:
        raise CampaignError(
            str(campaign.path),
            [
                f"readings.{key}: a simulated table cannot have this key; omit it"
                for key in stated_names
            ],
            code="conflicting-keys",
        )
    frame = load_table(path, settings.dialect)[0].frame
    outputs = {name: a.output for name, a in campaign.accelerometers.items()}
    table = ReadingsTable(settings, outputs, Problems(raw), raw)
    rows = [
        (index, row)
        for index, row in enumerate(frame.iter_rows(named=True))
        if table.is_reading_row(row)
    ]
    values = {
        column: [None if is_empty(cell) else cell for cell in frame[column].to_list()]
        for view in table.mounting_views({})
        for accelerometer_rows in view.value_columns("reading").values()
        for column in accelerometer_rows
    }
    unknown = [is_pose(table.make_run(row, index, ())) for index, row in rows]
    # The rows of the table come last.
    start = len(exact.readings) - sum(
        len(view.value_columns("reading"))
        for (_, row), is_posed in zip(rows, unknown, strict=True)
        for view in ([] if is_posed else table.mounting_views(row))
    )
    readings, poses = iter(exact.readings[start:]), iter(exact.poses[-sum(unknown) or None :])
    for (index, row), is_posed in zip(rows, unknown, strict=True):
        used_rows = (
            _pose_readings(next(poses), table.value_columns("reading")) if is_posed else readings
        )
        views = table.mounting_views(row)
        for view, name, accelerometer_rows in [
            (v, n, c) for v in views for n, c in v.value_columns("reading").items()
        ]:
            reading = next(used_rows)
            output = outputs[name]
            stated = view.u(row, name, ()) or 0.0
            for column in [
                c for c in accelerometer_rows if not is_empty(row[c])
            ] or accelerometer_rows:
                scale = (output.sensitivity, output.zero) if output else (1.0, 0.0)
                values[column][index] = _noisy_reading(campaign, reading, scale, stated, generator)
    return path, frame.with_columns([pl.Series(c, cells) for c, cells in values.items()])
