"""Readings in a campaign: runs with one value each, at rest, on an arm or on a double turntable.

They stand in ``[[runs]]`` with a ``reading``, or in a table that ``[readings]`` names
(`counterspin.campaign.readings_table`): every row of the table becomes such a run, so that both are
checked alike.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from counterspin.arrays import Array
from counterspin.campaign.attitude import TURN_WORDS, attitude_rows, read_direction
from counterspin.campaign.checking import Path as KeyPath
from counterspin.campaign.checking import Problems, did_you_mean
from counterspin.campaign.columns import BLANK
from counterspin.campaign.kinds import (
    PositiveRatio,
    Seconds,
    SettingsSection,
    Temperatures,
    Text,
    described,
    positive,
    read_exactly,
    record_file,
    with_units,
)
from counterspin.campaign.quantity import Quantity, last_digit, parse
from counterspin.campaign.settings import Output
from counterspin.frozen import frozen
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.station import FRAMES, MotionKind

#: Most readings of a campaign, and most records, one for each run and accelerometer, of which a
#: forecast or a study is made.
MOST_READINGS: Final = 10_000
MOST_RECORDS: Final = 60

#: Written for an attitude that nobody knows.
UNKNOWN: Final = "unknown"

#: A reading, or repeats of one at the same setting.
Written = Text | Annotated[list[Text], Field(min_length=1)]
#: That of the one accelerometer there is, or of several by name.
OfEach = Annotated[Written | dict[str, Written], BeforeValidator(with_units)]


class ReadingAxes(SettingsSection):
    """``axes`` of a reading: where input and pendulous axis point in the frame of its motion."""

    input: Text | list[float] = described(
        "in which the input axis points in the frame of the motion", "inward", kind="direction"
    )
    pendulous: Text | list[float] = described(
        "in which the pendulous axis points", "up", kind="direction"
    )


class PosesSettings(SettingsSection):
    """``poses`` of a record at rest: how they are found in it."""

    rest: Seconds = described("shortest rest that is a pose", "1.5 s", 1.5, absent="1.5 s")
    threshold: Annotated[float, read_exactly("m/s^2"), AfterValidator(positive)] | None = described(
        "scatter below which the sensor rests", "0.05 m/s^2", None, absent="found in the record"
    )
    u: Annotated[float, read_exactly("m/s^2"), AfterValidator(positive)] | None = described(
        "standard uncertainty of each axis in a pose, what its rest does not show included; "
        "needed for nine poses or fewer",
        "0.01 m/s^2",
        None,
        absent="by how the poses fit",
    )


class ReadingRunSettings(SettingsSection):
    """[[runs]]: one value at one station, or a record whose mean it is."""

    name: Text = described("of the run", "tumble 30")
    skip: bool = described("`true` leaves the run out, and the result says so", True, False)
    motion: MotionKind = described("how the instrument moves", "static", "counter-rotating")
    reading: Annotated[Written | dict[str, Written] | None, BeforeValidator(with_units)] = (
        described(
            "value with its unit; `±` where its standard uncertainty is known; a list of "
            "them: repeats at one setting, whose mean counts and whose scatter tells the "
            "noise",
            "1.082532 ± 2e-6 mA",
            None,
            absent="`record`",
        )
    )
    record: Annotated[Text, AfterValidator(record_file)] | None = described(
        "in place of `reading`, at rest or on an arm: a file whose mean over whole "
        "revolutions is the reading, its noise the uncertainty",
        "rest.csv",
        None,
        absent="`reading`",
    )
    rate: Annotated[float, read_exactly("rad/s")] = described(
        "of the spindle, signed; none at rest", "9.9 rad/s", 0.0, absent="0 rad/s"
    )
    attitude: Any = described(
        "as of other [runs](campaign.md#runs), with `±` for the head; at rest there "
        "must be this or `axes`; `unknown` for a pose of a triad",
        "30 ± 0.001 deg about north",
        None,
        absent="level",
    )
    head: Annotated[float, read_exactly("rad")] | None = described(
        "what the dividing head shows, where that is not the angle of the attitude: the instrument "
        "is mounted on it otherwise",
        "120 deg",
        None,
        absent="the angle of the attitude",
    )
    axes: ReadingAxes | None = described(
        "`input` and `pendulous` in the frame of the motion, in place of an attitude",
        {"input": "inward", "pendulous": "up"},
        None,
        absent="`attitude`",
    )
    poses: PosesSettings | None = described(
        "of a `record` whose attitude is `unknown`: how [poses](triads.md) are found in it",
        {"rest": "1.5 s"},
        None,
        absent="rests of 1.5 s",
    )
    mounting: str = described("name of the position on the fixture", "in", "")
    temperature: Temperatures | None = described(
        "in this run; of a `record` several count as taken at even times from its start to its end",
        "23.4 degC",
        None,
        kind="text, list of text",
    )
    time: Annotated[float, read_exactly("s")] | None = described(
        "when it was read, by any clock", "12 min", None
    )
    duration: Seconds | None = described(
        "length of a `record` that is [simulated](#simulating-readings)",
        "400 s",
        None,
        absent="those of `[simulation]`",
    )
    revolutions: PositiveRatio | None = described(
        "length of a `record` that is [simulated](#simulating-readings)",
        100,
        None,
        absent="those of `[simulation]`",
    )


@frozen
class Reading:
    """One reading of one accelerometer."""

    #: Of the run, whose it is, how the instrument moves, and the fixture's position (or empty).
    name: str
    accelerometer: str
    motion: MotionKind
    mounting: str
    axes: Mounting  #: In the frame of the motion.
    rate: float  #: rad/s.
    #: Indication in g by the nominal sensitivity, and its standard uncertainty; None: not stated.
    #: Of a record, 0 and None until it is read; NaN where `BLANK` stands.
    value: float
    u: float | None
    #: Axis about which the dividing head turned, zero without one, shape (3,).
    head: tuple[float, float, float]
    u_head: float  #: Random standard uncertainty of the head's angle, rad.
    #: K, of a record several evenly spread over it, and s; None where they were not recorded.
    temperature: tuple[float, ...] | None
    time: float | None
    record: Path | None = None  #: The file whose mean is the reading; None: the value is given.
    duration: float | None = None  #: Length of the record that is simulated, s; None: not stated.
    repeats: int = 1  #: How many repeats at one setting the value is the mean of.
    scatter: float = 0.0  #: Sum of squares of the repeats about their mean, g^2.
    resolution: float = 0.0  #: One of the last digit that was written, g; 0 of a record.
    #: Whether it was written in m/s^2, so that its value in g depends on the gravity assumed.
    in_si: bool = False
    #: Name of the position at rest, the same for all that are set alike; empty where errors of
    #: setting it are no matter.
    position: str = ""
    head_angle: float = 0.0  #: What the dividing head shows, rad; 0 without one.


def is_reading(raw: object) -> bool:
    """Return whether an entry of ``[[runs]]`` is a reading that counts, and not a record."""
    if isinstance(raw, Mapping) and raw.get("skip") is True:
        return False
    moved = isinstance(raw, Mapping) and raw.get("motion", "counter-rotating") != "counter-rotating"
    return moved or (isinstance(raw, Mapping) and "reading" in raw)


def resolve_readings(
    runs: Sequence[tuple[Any, KeyPath]],
    *,
    mountings: Mapping[str, Mounting | None],
    outputs: Mapping[str, Output | None],
    folder: Path,
    problems: Problems,
    gravity: float,
    turns: float | None,
) -> tuple[Reading, ...]:
    """Return the readings of runs, with where each stands; parameters as of `resolve_reading`.

    turns: Revolutions of a record that is simulated on a machine; None where nothing is simulated,
        so that every reading has its value.
    """
    readings: list[Reading] = []
    blank: list[KeyPath] = []
    for raw, path in runs:
        own = resolve_reading(
            raw, path, mountings, outputs, folder=folder, problems=problems, gravity=gravity
        )
        if any(math.isnan(reading.value) for reading in own):
            blank.append((*path, "reading"))
        readings += [_with_length(reading, turns) for reading in own]
    if blank and turns is None:
        others = f", nor have {len(blank) - 1} others" if len(blank) > 1 else ""
        problems.add(
            blank[0],
            f"has no value yet{others}; enter the reading, or [truth] to simulate it",
        )
    return tuple(readings)


def _with_length(reading: Reading, turns: float | None) -> Reading:
    """Return a reading with the length of its record, where it is simulated on a machine."""
    if reading.duration is not None or not reading.rate or turns is None:
        return reading
    return replace(reading, duration=turns * 2.0 * math.pi / abs(reading.rate))


def resolve_reading(
    raw: Any,
    path: KeyPath,
    mountings: Mapping[str, Mounting | None],
    outputs: Mapping[str, Output | None],
    *,
    folder: Path,
    problems: Problems,
    gravity: float,
) -> list[Reading]:
    """Return the readings of one run, one for each accelerometer that was read.

    mountings: Accelerometer -> its axes in the level attitude; None where they are a mistake.
    outputs: Accelerometer -> what its readings are in, None: g; not where that is a mistake.
    gravity: Of the site, m/s^2.
    """
    settings = problems.check(ReadingRunSettings, raw, path)
    if settings is None:
        return []
    before = len(problems.lines)
    _check_station(settings, path, problems)
    attitude = problems.attempt((*path, "attitude"), _attitude, settings.attitude or "level")
    duration = _duration(settings, path, problems)
    if (settings.reading is None) == (settings.record is None):
        problems.add(path, "give one of reading and record")
        return []
    if settings.record is None and len(settings.temperature or ()) > 1:
        problems.add(
            (*path, "temperature"), "a reading has one temperature; several belong to a record"
        )
    if settings.poses is not None:
        problems.add((*path, "poses"), 'are searched for only with attitude = "unknown"')
    values = settings.reading
    if settings.record is not None:
        values = dict.fromkeys(mountings, "")
    if isinstance(values, str | list):
        if len(mountings) > 1:
            problems.add(
                (*path, "reading"),
                "there are several accelerometers; write reading = { NAME = ... }",
            )
            return []
        values = dict.fromkeys(mountings, values)
    readings = []
    for name, text in (values or {}).items():
        where = (
            (*path, "reading", name) if isinstance(settings.reading, dict) else (*path, "reading")
        )
        if name not in mountings:
            said = did_you_mean(name, mountings)
            if mountings:
                problems.add(where, f'there is no accelerometer "{name}"{said}')
            continue
        read: _Value | None = _Value(0.0, None)
        if settings.record is None and name in outputs:
            texts = [text] if isinstance(text, str) else text
            read = problems.attempt(where, _value, texts, outputs[name], gravity)
        axes = problems.attempt(path, _axes, settings, mountings[name], attitude)
        if read is None or axes is None or attitude is None:
            continue
        rows, head, u_head, angle = attitude
        readings.append(
            Reading(
                name=settings.name,
                accelerometer=name,
                motion=settings.motion,
                mounting=settings.mounting,
                axes=axes,
                rate=settings.rate,
                value=read.mean,
                u=read.u,
                head=head,
                u_head=u_head,
                head_angle=angle if settings.head is None else settings.head,
                temperature=settings.temperature,
                time=settings.time,
                record=folder / settings.record if settings.record else None,
                duration=duration,
                repeats=read.repeats,
                scatter=read.scatter,
                resolution=read.resolution,
                in_si=read.in_si,
                position=_position(settings, rows),
            )
        )
    return readings if len(problems.lines) == before else []


def positioned(readings: Sequence[Reading], setting: Quantity | None) -> tuple[Reading, ...]:
    """Return readings with their positions at rest numbered, where an error of setting is stated.

    setting: That error.
    """
    keys = dict.fromkeys(r.position for r in readings if setting and r.motion == "static")
    numbers = {key: str(number) for number, key in enumerate(keys, start=1)}
    return tuple(replace(r, position=numbers.get(r.position, "")) for r in readings)


def _position(settings: ReadingRunSettings, attitude: Array) -> str:
    """Return what two readings have in common that are taken at one position of the fixture."""
    if settings.motion != "static":
        return ""
    if settings.axes is not None:
        return f"{settings.mounting}: {settings.axes.input}, {settings.axes.pendulous}"
    # Adding zero makes -0 the same as 0.
    return f"{settings.mounting}: {(np.round(attitude, 9) + 0.0).tolist()}"


def _check_station(settings: ReadingRunSettings, path: KeyPath, problems: Problems) -> None:
    """Note what is missing of where a reading is taken, or too much."""
    if "." in settings.mounting:
        # Terms of the machine have it between dots: centrifuge.radius.MOUNTING.
        problems.add((*path, "mounting"), f'"{settings.mounting}" has a dot; leave it out')
    if settings.motion == "static" and settings.rate != 0.0:
        problems.add((*path, "rate"), "a static run does not turn; leave the rate out")
    if settings.motion != "static" and settings.rate == 0.0:
        problems.add((*path, "rate"), f"is missing: a run with motion {settings.motion} turns")
    if settings.motion == "static" and settings.attitude is None and settings.axes is None:
        problems.add((*path, "attitude"), "is missing: a reading at rest needs its position")
    turned = isinstance(settings.attitude, str) and TURN_WORDS.fullmatch(settings.attitude.strip())
    if settings.head is not None and (settings.motion != "static" or not turned):
        problems.add(
            (*path, "head"), 'turns about an axis: write attitude = "30 deg about north", or alike'
        )


def _duration(settings: ReadingRunSettings, path: KeyPath, problems: Problems) -> float | None:
    """Return the length of a record, s, where it is stated."""
    if settings.revolutions is None:
        return settings.duration
    if settings.duration is not None:
        problems.add((*path, "duration"), "revolutions is given too; keep one")
    elif settings.rate == 0.0:
        problems.add((*path, "revolutions"), "a run that does not turn has a duration")
    return 2.0 * math.pi * settings.revolutions / abs(settings.rate or 1.0)


@frozen
class _Value:
    """Mean of repeats in g by the nominal sensitivity, its u where all state theirs."""

    mean: float
    u: float | None
    repeats: int = 1
    scatter: float = 0.0
    in_si: bool = False
    resolution: float = 0.0


def _value(texts: Sequence[str], output: Output | None, gravity: float) -> _Value:
    """Return what repeats of one reading say."""
    unit, size, zero = "g", 1.0, 0.0
    if output is not None:
        unit, size, zero = output.unit, output.sensitivity, output.zero
    conversion = gravity if output is None else None
    written = [
        f"0 {text.removeprefix(BLANK) or unit}" if text.startswith(BLANK) else text
        for text in texts
    ]
    quantities = [parse(text, unit, gravity=conversion) for text in written]
    values = (np.array([quantity.value for quantity in quantities]) - zero) / size
    u = np.array([quantity.u for quantity in quantities]) / abs(size)
    mean = float(values.mean()) if written == list(texts) else math.nan
    in_si = False
    if conversion is not None:
        unlike = parse(written[0], unit, gravity=2.0 * conversion)
        in_si = unlike != quantities[0]
    if (u > 0.0).all():
        return _Value(mean, float(np.linalg.norm(u)) / len(texts), len(texts), in_si=in_si)
    scatter = float(np.sum((values - mean) ** 2))
    last = 0.0
    if not math.isnan(mean):
        last = min(parse(last_digit(text), unit, gravity=conversion).value for text in written)
    return _Value(mean, None, len(texts), scatter, in_si, last / abs(size))


#: Rows of an attitude; axis of the head that made it, and its angle's uncertainty and value.
_Attitude = tuple[Array, tuple[float, float, float], float, float]


def _attitude(value: Any) -> _Attitude:
    """Return an attitude, with a head of no axis where none made it."""
    match = TURN_WORDS.fullmatch(value.strip()) if isinstance(value, str) else None
    if match is None:
        return attitude_rows(value), (0.0, 0.0, 0.0), 0.0, 0.0
    turn = parse(match[1], "rad")
    return (
        attitude_rows(f"{turn.value!r} rad about {match[2]}"),
        read_direction(match[2]),
        turn.u,
        turn.value,
    )


def _axes(
    settings: ReadingRunSettings, mounting: Mounting | None, attitude: _Attitude | None
) -> Mounting | None:
    """Return the accelerometer's axes in the frame of the motion; None where they are a mistake."""
    if settings.axes is None:
        if settings.motion == "arm":
            raise ValueError(
                'on an arm there is no attitude; write axes = { input = "inward", '
                'pendulous = "up" }'
            )
        return None if mounting is None or attitude is None else mounting.turned(attitude[0])
    if settings.attitude is not None:
        raise ValueError("has axes and an attitude; keep one")
    names = FRAMES[settings.motion]
    return Mounting.from_axes(
        *(_direction(value, names) for value in (settings.axes.input, settings.axes.pendulous))
    )


def _direction(value: str | list[float], names: Mapping[str, Any]) -> list[float]:
    if isinstance(value, str):
        if value not in names:
            raise ValueError(f'unknown direction "{value}" here' + did_you_mean(value, names))
        return list(names[value])
    return value
