"""Readings of a campaign: runs with one value each, at rest, on an arm or on a double turntable.

They are entries of ``[[runs]]`` with a ``reading``, or rows of the table that ``[readings]`` names
(`counterspin.readings.table`). Each row becomes such a run, so that both are validated alike.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.campaign.documents import KeyPath
from counterspin.campaign.field_types import Contradiction
from counterspin.campaign.quantity import Quantity, last_digit_step, parse_quantity
from counterspin.campaign.reading import Reading
from counterspin.campaign.runs import Run
from counterspin.campaign.settings import Output
from counterspin.campaign.validation import Problems, suggest_name
from counterspin.errors import Problem
from counterspin.frozen import copy_with, frozen
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.conditions import stated_conditions
from counterspin.physics.station import FRAMES
from counterspin.readings.cells import BLANK
from counterspin.readings.similar_rows import attitude_keys, convert_rows, row_pattern

#: Largest number of readings of a campaign, and largest number of records (one for each run and
#: accelerometer) of a forecast or a study.
MAX_READINGS: Final = 10_000
MAX_RECORDS: Final = 60

#: Largest reading, g; meters show larger numbers if they are overloaded.
_MAX_READING: Final = 1e6


def find_contradictions(run: Run) -> Iterator[Contradiction]:
    """Yield missing, superfluous and contradictory keys of a run that is a reading."""
    is_pose, is_rotating = run.stated_attitude.is_unknown, run.rate != 0.0
    is_static, is_vibration = run.motion == "static", run.motion == "vibration"
    has_attitude, has_no_axes = "stated_attitude" in run.model_fields_set, run.axes is None
    has_single_temperature = len(run.temperature or ()) < 2
    not_applicable = "does not apply to an unknown attitude"
    arm_message = (
        'a run on an arm has no attitude; write axes = { input = "inward", pendulous = "up" }'
    )
    # Condition of the error, message, key and related keys.
    rows: Iterable[tuple[object, str, str]] = (
        (
            (run.reading is None) == (run.file is None),
            "give either reading or record",
            " reading record",
        ),
        (
            is_pose and not is_static,
            'an attitude can be unknown only at rest; write "static"',
            "motion attitude",
        ),
        (is_pose and not has_no_axes, not_applicable, "axes attitude"),
        (is_pose and run.mounting, not_applicable, "mounting attitude"),
        # Symbols of machine terms contain the mounting between dots: centrifuge.radius.MOUNTING.
        (
            "." in run.mounting,
            Problem(f'"{run.mounting}" contains a dot; remove it', "invalid-name"),
            "mounting",
        ),
        (is_static and is_rotating, "a static run has no rotation; omit the rate", "rate motion"),
        (
            is_vibration and is_rotating,
            "a run on a shaker has no rotation; omit the rate",
            "rate motion",
        ),
        (
            is_vibration and run.amplitude is None,
            Problem("is missing: a vibration requires a peak acceleration", "missing-key"),
            "amplitude motion",
        ),
        (
            not is_vibration and run.amplitude is not None,
            'applies only to a vibration; write motion = "vibration"',
            "amplitude motion",
        ),
        (
            not is_vibration and run.bias_acceleration,
            'applies only to a vibration; write motion = "vibration"',
            "bias_acceleration motion",
        ),
        (
            is_vibration and run.file is not None,
            "is not averaged over vibration cycles; give the mean output as reading",
            "record motion",
        ),
        (
            (is_static or is_vibration) and run.truth,
            "a static run does not rotate, but truth describes the spindle; omit this key",
            "truth motion",
        ),
        (
            "tilt" in (run.truth or {}),
            "contains the tilt of a platform, which does not affect readings; remove the tilt",
            "truth motion reading",
        ),
        (
            not is_static and not is_vibration and not is_rotating,
            Problem(f'is missing: a run with motion "{run.motion}" requires a rate', "missing-key"),
            "rate motion",
        ),
        (
            (is_static or is_vibration) and has_no_axes and not has_attitude,
            Problem("is missing: a reading at rest requires a position", "missing-key"),
            "attitude axes motion",
        ),
        (has_no_axes and not is_pose and run.motion == "arm", arm_message, " axes motion"),
        (
            not has_no_axes and has_attitude and not is_pose,
            "has axes and an attitude; keep only one of them",
            " axes attitude",
        ),
        (
            run.head is not None and not (is_static and any(run.stated_attitude.head_axis)),
            (
                'requires an attitude that is a rotation about an axis, such as attitude = "30 deg '
                'about north"'
            ),
            "head attitude motion",
        ),
        (
            run.revolutions is not None and run.duration is None and not is_rotating,
            Problem("a run at rest requires a duration", "missing-key"),
            "revolutions duration rate",
        ),
        (
            run.file is None and not has_single_temperature,
            "a reading has only one temperature; a list of temperatures applies to a record",
            "temperature record",
        ),
        (
            run.poses and not is_pose,
            'are detected only with attitude = "unknown"',
            "poses attitude",
        ),
        (
            run.poses and is_pose and run.file is None,
            "are detected in a record, but this run has a reading",
            "poses record",
        ),
    )
    for is_wrong, message, keys in rows:
        if is_wrong:
            key, *related_keys = keys.split(" ")
            yield ((key,) if key else ()), message, *related_keys


def collect_readings(
    resolved_entries: Iterable[tuple[KeyPath, Sequence[Reading]]],
    problems: Problems,
    turns: float | None,
) -> tuple[Reading, ...]:
    """Return the readings that `resolve_readings` yields; report those without a value."""
    blank_paths: list[KeyPath] = []
    readings: list[Reading] = []
    for path, run_readings in resolved_entries:
        readings += run_readings
        for reading in run_readings:
            if abs(reading.value) > _MAX_READING:
                message = (
                    f"is {reading.value:.2g} g for {reading.accelerometer}, which is impossible; "
                    "check the sensitivity, and whether the meter was overloaded (9.9E+37)"
                )
                problems.add((*path, "reading"), message, "value-out-of-range")
        if any(math.isnan(reading.value) for reading in run_readings):
            blank_paths.append((*path, "reading"))
    if blank_paths and turns is None:
        n_others = len(blank_paths) - 1
        others_text = ""
        if n_others:
            others = "does another reading" if n_others == 1 else f"do {n_others} others"
            others_text = f", nor {others}"
        message = f"has no value yet{others_text}; enter the reading, or add [truth] to simulate it"
        problems.add(blank_paths[0], message, "missing-value")
    return tuple(readings)


def resolve_readings(
    runs: Sequence[tuple[Any, KeyPath]],
    *,
    mountings: Mapping[str, Mounting | None],
    outputs: Mapping[str, Output | None],
    folder: Path,
    problems: Problems,
    gravity: float,
    turns: float | None,
) -> Iterator[tuple[KeyPath, Sequence[Reading]]]:
    """Yield the path of each run and its readings, one for each accelerometer that was read.

    An invalid run has no readings.

    runs: Runs with their paths in the description.
    mountings: Accelerometer -> its axes in the level attitude; None if they are invalid.
    outputs: Accelerometer -> unit of its readings, None: g; no entry if the unit is invalid.
    gravity: Gravity of the site, m/s^2.
    turns: Revolutions of a simulated record; None without a simulation.
    """
    patterns = [row_pattern(raw) for raw, _ in runs]
    indices_by_pattern: dict[Hashable, list[int]] = {}
    for index, pattern in enumerate(patterns):
        indices_by_pattern.setdefault(pattern, []).append(index)
    indices_by_pattern.pop(None, None)
    converted_readings: dict[int, Sequence[Reading]] = {}
    for index, (raw, path) in enumerate(runs):
        readings = converted_readings.pop(index, None)
        if readings is None:
            readings = _resolve_run(raw, path, mountings, outputs, folder, problems, gravity)
            similar_indices = indices_by_pattern.pop(patterns[index], []) if readings else []
            similar_indices = [i for i in similar_indices if i > index]
            if similar_indices:
                rows = [runs[i][0] for i in similar_indices]
                row_readings = convert_rows(rows, readings, mountings, outputs, gravity)
                pairs = zip(similar_indices, row_readings, strict=True)
                converted_readings |= {i: row for i, row in pairs if row is not None}
        yield path, [_set_duration(reading, turns) for reading in readings]


def _resolve_run(
    raw: Any,
    path: KeyPath,
    mountings: Mapping[str, Mounting | None],
    outputs: Mapping[str, Output | None],
    folder: Path,
    problems: Problems,
    gravity: float,
) -> Sequence[Reading]:
    """Return the readings of a run; none if the run is invalid."""
    n_errors = len(problems.lines)
    units = {name: output.unit if output else "g" for name, output in outputs.items()}
    run, invalid_keys = problems.validate_partial(
        Run, raw, path, folder=folder, units=units, gravity=gravity
    )
    if run is None or invalid_keys & {"reading", "record", "motion"}:
        return ()
    readings: list[Reading] = []
    for name, texts, value_path in _accelerometer_readings(run, path, mountings, problems):
        value: _ParsedValue | None = _ParsedValue(0.0, None)
        if texts and name in outputs:
            value = problems.collect(value_path, _parse_value, texts, outputs[name], gravity)
        axes = problems.collect(path, _resolve_axes, run, mountings[name])
        if value is not None and axes is not None:
            readings.append(_make_reading(run, name, value, axes))
    return readings if len(problems.lines) == n_errors else ()


def _set_duration(reading: Reading, turns: float | None) -> Reading:
    """Return a reading with the duration of its record, if it is simulated on a machine."""
    if reading.duration is not None or not reading.rate or turns is None:
        return reading
    return replace(reading, duration=turns * 2.0 * math.pi / abs(reading.rate))


def _accelerometer_readings(
    run: Run, path: KeyPath, names: Collection[str], problems: Problems
) -> Iterator[tuple[str, Sequence[str | Quantity], KeyPath]]:
    """Yield each accelerometer that was read, its values (none for a record), and their path."""
    reading_path, values = (*path, "reading"), run.reading
    if run.file is not None:
        values = {name: [] for name in names}
    elif not isinstance(values, dict):
        if len(names) > 1:
            problems.add(
                reading_path,
                "the campaign has several accelerometers; write reading = { NAME = ... }",
                "missing-value",
            )
            return
        values = dict.fromkeys(names, values or [])
    for name, texts in values.items():
        value_path = (*reading_path, name) if isinstance(run.reading, dict) else reading_path
        if name in names:
            yield name, texts if isinstance(texts, list) else [texts], value_path
        elif names:
            message = f'no accelerometer is named "{name}"' + suggest_name(name, names)
            problems.add(value_path, message, "unknown-accelerometer")


def _make_reading(run: Run, name: str, parsed_value: _ParsedValue, axes: Mounting) -> Reading:
    """Return the reading of one accelerometer."""
    return Reading(
        name=run.name,
        accelerometer=name,
        motion=run.motion,
        mounting=run.mounting or (_mounting_name(axes) if run.motion == "arm" else ""),
        axes=axes,
        rate=run.rate,
        u_rate=run.u_rate,
        value=parsed_value.mean,
        u=parsed_value.u,
        head=run.stated_attitude.head_axis,
        u_head=run.stated_attitude.u,
        head_angle=run.stated_attitude.angle if run.head is None else run.head,
        **stated_conditions(run),
        record=run.file,
        duration=run.length,
        repeats=parsed_value.repeats,
        scatter=parsed_value.scatter,
        resolution=parsed_value.resolution,
        in_si=parsed_value.in_si,
        position=_position_key(run),
        amplitude=run.amplitude.value if run.amplitude else 0.0,
        u_amplitude=run.amplitude.u / run.amplitude.value if run.amplitude else 0.0,
        bias_acceleration=run.bias_acceleration,
    )


def _mounting_name(axes: Mounting) -> str:
    """Return the name of a mounting on the arm that the description does not name."""
    directions = FRAMES["arm"]
    projections = np.array(list(directions.values())) @ axes.matrix[:2].T
    return "-".join(list(directions)[index] for index in np.argmax(projections, axis=0))


def number_positions(
    readings: Sequence[Reading], positioning_error: Quantity | None
) -> tuple[Reading, ...]:
    """Return readings with numbered positions at rest if a positioning error is stated."""
    keys = dict.fromkeys(
        reading.position for reading in readings if positioning_error and reading.motion == "static"
    )
    numbers = {key: str(index) for index, key in enumerate(keys, start=1)}
    return tuple(
        copy_with(reading, {"position": numbers.get(reading.position, "")}) for reading in readings
    )


def mark_recorded_angles(readings: Sequence[Reading]) -> tuple[Reading, ...]:
    """Mark readings whose record on the arm contains the angle."""
    return tuple(
        replace(reading, uses_recorder_clock=True) if reading.record and reading.rate else reading
        for reading in readings
    )


def _position_key(run: Run) -> str:
    """Return the key that readings at the same position of the fixture share."""
    if run.motion != "static":
        return ""
    if run.axes is not None:
        return f"{run.mounting}: {run.axes.input}, {run.axes.pendulous}"
    return attitude_keys(run.mounting, run.attitude[None])[0]


@frozen
class _ParsedValue:
    """Mean of repeats in g by the nominal sensitivity, with its u if all repeats state theirs."""

    mean: float
    u: float | None
    repeats: int = 1
    scatter: float = 0.0
    in_si: bool = False
    resolution: float = 0.0


def _parse_value(
    repeats: Sequence[str | Quantity], output: Output | None, gravity: float
) -> _ParsedValue:
    """Return the value of one reading from its repeats."""
    unit, sensitivity, zero = "g", 1.0, 0.0
    if output is not None:
        unit, sensitivity, zero = output.unit, output.sensitivity, output.zero
    gravity_in_unit = gravity if output is None else None
    texts = [
        f"0 {text.removeprefix(BLANK) or unit}"
        if isinstance(text, str) and text.startswith(BLANK)
        else text
        for text in repeats
    ]
    quantities = [parse_quantity(text, unit, gravity=gravity_in_unit) for text in texts]
    values = (np.array([quantity.value for quantity in quantities]) - zero) / sensitivity
    u = np.array([quantity.u for quantity in quantities]) / abs(sensitivity)
    mean = float(values.mean()) if texts == list(repeats) else math.nan
    in_si = False
    if gravity_in_unit is not None:
        rescaled_quantity = parse_quantity(texts[0], unit, gravity=2.0 * gravity_in_unit)
        in_si = rescaled_quantity != quantities[0]
    if (u > 0.0).all():
        return _ParsedValue(mean, float(np.linalg.norm(u)) / len(u), len(u), in_si=in_si)
    scatter = float(np.sum((values - mean) ** 2))
    last_digit_size = 0.0
    if not math.isnan(mean):
        last_digit_size = min(
            parse_quantity(last_digit_step(text), unit, gravity=gravity_in_unit).value
            for text in texts
        )
    return _ParsedValue(mean, None, len(u), scatter, in_si, last_digit_size / abs(sensitivity))


def _resolve_axes(run: Run, mounting: Mounting | None) -> Mounting | None:
    """Return the accelerometer's axes in the frame of the motion; None if they are invalid."""
    if run.axes is None:
        return None if mounting is None else mounting.turned(run.attitude)
    directions = FRAMES[run.motion]
    return Mounting.from_axes(
        *(_resolve_direction(value, directions) for value in (run.axes.input, run.axes.pendulous))
    )


def _resolve_direction(value: str | list[float], directions: Mapping[str, Any]) -> list[float]:
    if isinstance(value, str):
        if value not in directions:
            raise ValueError(
                f'unknown direction "{value}" for this motion' + suggest_name(value, directions)
            )
        return list(directions[value])
    return value
