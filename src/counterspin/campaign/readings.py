"""Readings in a campaign: runs with one value each, at rest, on an arm or on a double turntable.

They stand in ``[[runs]]`` with a ``reading``, or in a table that ``[readings]`` names: every row of
the table becomes such a run, so that both are checked alike.

- `ReadingRunSettings`, `ReadingsSettings`: what may stand there
- `Reading`, `Output`: what comes of it
- `is_reading`: which of the runs are readings
- `read_table`: the rows of a table as runs; `resolve_reading`: a run as readings
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field

from counterspin.arrays import Array
from counterspin.campaign.attitude import attitude_rows, read_direction
from counterspin.campaign.checking import Path as KeyPath
from counterspin.campaign.checking import Problems, did_you_mean
from counterspin.campaign.quantity import parse
from counterspin.campaign.settings import SettingsSection, Text, read_exactly
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.station import FRAMES, MotionKind

#: Kelvin at 0 degC; only differences of temperature count.
_ZERO_CELSIUS: Final = 273.15

_TEMPERATURE = re.compile(r"\s*([+-]?\d+\.?\d*(?:[eE][+-]?\d+)?)\s*(degC|°C|K)\s*")
_TURN = re.compile(r"(.+?)\s+about\s+(\w+)")

#: Columns that a table of readings may have, beside those of the readings themselves.
_COLUMNS: Final = ("name", "motion", "rate", "attitude", "temperature", "time", "mounting")


class ReadingAxes(SettingsSection):
    """``axes`` of a reading: where input and pendulous axis point in the frame of its motion."""

    input: Text | list[float]
    pendulous: Text | list[float]


class ReadingRunSettings(SettingsSection):
    """[[runs]] with a reading: one value at one station."""

    name: Text
    motion: Literal["counter-rotating", "arm", "static"] = "counter-rotating"
    reading: Text | dict[str, Text] | None = None
    record: Text | None = None
    rate: Annotated[float, read_exactly("rad/s")] = 0.0
    attitude: Any = "level"
    axes: ReadingAxes | None = None
    mounting: str = ""
    temperature: Text | None = None
    time: Annotated[float, read_exactly("s")] | None = None


class ReadingsSettings(SettingsSection):
    """[readings]: a table in place of many [[runs]]."""

    file: Text
    columns: dict[str, str | dict[str, str]] = Field(min_length=1)
    motion: Literal["counter-rotating", "arm", "static"] = "static"
    about: Text = "north"
    attitude_unit: Text = "deg"
    rate_unit: Text = "rad/s"
    axes: ReadingAxes | None = None
    mounting: str = ""


@dataclass(frozen=True)
class Output:
    """What an accelerometer's readings are in.

    Attributes
    ----------
    unit
        Such as ``mA``.
    sensitivity
        Nominal, in that unit per g.
    """

    unit: str
    sensitivity: float


@dataclass(frozen=True)
class Reading:
    """One reading of one accelerometer.

    Attributes
    ----------
    name, accelerometer, motion, mounting
        Of the run, whose it is, how the instrument moves, and the fixture's position (or empty).
    axes
        In the frame of the motion.
    rate
        rad/s.
    value, u
        Indication in g by the nominal sensitivity, and its standard uncertainty; None: not stated.
        Of a record, 0 and None until it is read.
    record
        The file whose mean is the reading; None: the value is given.
    head
        Axis about which the dividing head turned, zero without one, shape (3,).
    u_head
        Random standard uncertainty of the head's angle, rad.
    temperature, time
        K and s; None where they were not recorded.
    """

    name: str
    accelerometer: str
    motion: MotionKind
    mounting: str
    axes: Mounting
    rate: float
    value: float
    u: float | None
    head: tuple[float, float, float]
    u_head: float
    temperature: float | None
    time: float | None
    record: Path | None = None


def is_reading(raw: object) -> bool:
    """Return whether an entry of ``[[runs]]`` is a reading and not a record."""
    moved = isinstance(raw, Mapping) and raw.get("motion", "counter-rotating") != "counter-rotating"
    return moved or (isinstance(raw, Mapping) and "reading" in raw)


def resolve_reading(
    raw: Any,
    path: KeyPath,
    mountings: Mapping[str, Mounting],
    outputs: Mapping[str, Output | None],
    *,
    folder: Path,
    problems: Problems,
    gravity: float,
) -> list[Reading]:
    """Return the readings of one run, one for each accelerometer that was read.

    Parameters
    ----------
    raw, path
        The run as it stands, and where.
    mountings, outputs
        Accelerometer -> its axes in the level attitude, and what its readings are in (None: g).
    folder
        Of the campaign.
    problems
        Where mistakes are noted; then nothing is returned.
    gravity
        Of the site, m/s^2.
    """
    settings = problems.check(ReadingRunSettings, raw, path)
    if settings is None:
        return []
    before = len(problems.lines)
    if settings.motion == "static" and settings.rate != 0.0:
        problems.add((*path, "rate"), "a static run does not turn; leave the rate out")
    if settings.motion != "static" and settings.rate == 0.0:
        problems.add((*path, "rate"), f"is missing: a run with motion {settings.motion} turns")
    attitude = problems.attempt((*path, "attitude"), _attitude, settings.attitude)
    temperature = problems.attempt((*path, "temperature"), read_temperature, settings.temperature)
    if (settings.reading is None) == (settings.record is None):
        problems.add(path, "give one of reading and record")
        return []
    values = settings.reading
    if settings.record is not None:
        values = dict.fromkeys(mountings, "")
    if isinstance(values, str):
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
            problems.add(
                where, f'no accelerometer is called "{name}"' + did_you_mean(name, mountings)
            )
            continue
        read: tuple[float, float | None] | None = (0.0, None)
        if settings.record is None:
            read = problems.attempt(where, _value, text, outputs.get(name), gravity)
        axes = problems.attempt(path, _axes, settings, mountings[name], attitude)
        if read is None or axes is None or attitude is None:
            continue
        _, head, u_head = attitude
        readings.append(
            Reading(
                name=settings.name,
                accelerometer=name,
                motion=settings.motion,
                mounting=settings.mounting,
                axes=axes,
                rate=settings.rate,
                value=read[0],
                u=read[1],
                head=head,
                u_head=u_head,
                temperature=temperature,
                time=settings.time,
                record=folder / settings.record if settings.record else None,
            )
        )
    return readings if len(problems.lines) == before else []


def read_temperature(text: str | None) -> float | None:
    """Return a temperature in K; ValueError if it is none."""
    if text is None:
        return None
    match = _TEMPERATURE.fullmatch(text)
    if match is None:
        raise ValueError(f'{text!r} is not a temperature; write "23.4 degC" or "296.5 K"')
    return float(match[1]) + (0.0 if match[2] == "K" else _ZERO_CELSIUS)


def _value(text: str, output: Output | None, gravity: float) -> tuple[float, float | None]:
    """Return a reading in g by the nominal sensitivity, and its uncertainty where it is stated."""
    if output is None:
        quantity, size = parse(text, "g", gravity=gravity), 1.0
    else:
        quantity, size = parse(text, output.unit), output.sensitivity
    u = quantity.u / abs(size)
    return quantity.value / size, u if u > 0.0 else None


def _attitude(value: Any) -> tuple[Array, tuple[float, float, float], float]:
    """Return an attitude, the axis of the head that made it, and the angle's uncertainty."""
    match = _TURN.fullmatch(value.strip()) if isinstance(value, str) else None
    if match is None:
        return attitude_rows(value), (0.0, 0.0, 0.0), 0.0
    turn = parse(match[1], "rad")
    return (
        attitude_rows(f"{turn.value!r} rad about {match[2]}"),
        read_direction(match[2]),
        turn.u,
    )


def _axes(
    settings: ReadingRunSettings, mounting: Mounting, attitude: tuple[Array, Any, float] | None
) -> Mounting:
    """Return the accelerometer's axes in the frame of the motion."""
    if settings.axes is None:
        if settings.motion == "arm":
            raise ValueError(
                'on an arm the axes follow from no attitude; write axes = { input = "inward", '
                'pendulous = "up" }'
            )
        return mounting if attitude is None else mounting.turned(attitude[0])
    if settings.attitude != "level":
        raise ValueError("has axes and an attitude; keep one")
    names = FRAMES[settings.motion]
    return Mounting.from_axes(
        *(_direction(value, names) for value in (settings.axes.input, settings.axes.pendulous))
    )


def _direction(value: str | list[float], names: Mapping[str, Any]) -> list[float]:
    if isinstance(value, str):
        if value not in names:
            raise ValueError(f'no direction is called "{value}" here' + did_you_mean(value, names))
        return list(names[value])
    return value


def read_table(
    raw: Any, folder: Path, accelerometers: Mapping[str, Output | None], problems: Problems
) -> Iterator[tuple[dict[str, Any], KeyPath]]:
    """Yield the rows of the table that ``[readings]`` names, as runs, with where each stands.

    Parameters
    ----------
    raw
        The section.
    folder
        Of the campaign.
    accelerometers
        Names, and what their readings are in.
    problems
        Where mistakes are noted.
    """
    settings = problems.check(ReadingsSettings, raw, ("readings",))
    if settings is None:
        return
    frame = problems.attempt(("readings", "file"), _load, folder / settings.file)
    if frame is None:
        return
    columns = {k: v for k, v in settings.columns.items() if isinstance(v, str)}
    values = {
        k: _by_accelerometer(settings.columns.get(k), accelerometers) for k in ("reading", "u")
    }
    if not values["reading"]:
        problems.add(
            ("readings", "columns"), "reading is missing: the column that holds the values"
        )
        return
    wanted = {**columns, **values["reading"], **values["u"]}
    for key in columns:
        if key not in (*_COLUMNS, "reading", "u"):
            problems.add(("readings", "columns", key), "unknown key" + did_you_mean(key, _COLUMNS))
    for column in dict.fromkeys(wanted.values()):
        if column not in frame.columns:
            problems.add(
                ("readings", "columns"),
                f'{settings.file} has no column "{column}"' + did_you_mean(column, frame.columns),
            )
    if any(line.startswith("readings") for line in problems.lines):
        return
    for index, row in enumerate(frame.iter_rows(named=True)):
        path: KeyPath = ("readings", f"{settings.file} row {index + 1}")
        yield _as_run(row, index, settings, columns, values, accelerometers), path


def _by_accelerometer(
    column: str | dict[str, str] | None, accelerometers: Mapping[str, Any]
) -> dict[str, str]:
    if isinstance(column, dict):
        return column
    return {} if column is None else dict.fromkeys(list(accelerometers)[:1], column)


def _load(path: Path) -> Any:
    """Return a table as a polars frame; ValueError if it cannot be read."""
    import polars as pl

    suffix = path.suffix.lower()
    try:
        content = io.BytesIO(path.read_bytes())
        if suffix == ".csv":
            return pl.read_csv(content, infer_schema_length=None)
        if suffix == ".parquet":
            return pl.read_parquet(content)
        if suffix == ".xlsx":
            return pl.read_excel(content)
    except OSError as error:
        raise ValueError(f"{path.name} cannot be read ({error.strerror})") from error
    except ModuleNotFoundError as error:
        raise ValueError(
            f"{path.name}: Excel files need the package fastexcel; install it, or save the table "
            "as CSV"
        ) from error
    except Exception as error:
        raise ValueError(f"{path.name} is damaged or no table ({str(error)[:150]})") from error
    raise ValueError(f"{path.name}: a table of readings is .csv, .parquet or .xlsx")


def _as_run(
    row: Mapping[str, Any],
    index: int,
    settings: ReadingsSettings,
    columns: Mapping[str, str],
    values: Mapping[str, Mapping[str, str]],
    accelerometers: Mapping[str, Output | None],
) -> dict[str, Any]:
    """Return a row as a run would be written."""

    def cell(key: str) -> Any:
        return row[columns[key]] if key in columns else None

    run: dict[str, Any] = {"name": str(cell("name") or f"reading {index + 1}")}
    run["motion"] = str(cell("motion") or settings.motion)
    if (rate := cell("rate")) and float(rate) != 0.0:
        run["rate"] = f"{float(rate)!r} {settings.rate_unit}"
    attitude = cell("attitude")
    if isinstance(attitude, str):
        run["attitude"] = attitude
    elif attitude is not None:
        run["attitude"] = f"{float(attitude)!r} {settings.attitude_unit} about {settings.about}"
    if settings.axes is not None and run["motion"] != "static":
        run["axes"] = settings.axes.model_dump()
    run["mounting"] = str(cell("mounting") or settings.mounting)
    if (temperature := cell("temperature")) is not None:
        run["temperature"] = (
            temperature if isinstance(temperature, str) else f"{float(temperature)!r} degC"
        )
    if (time := cell("time")) is not None:
        run["time"] = time if isinstance(time, str) else f"{float(time)!r} s"
    run["reading"] = {
        name: _written(row[column], row.get(values["u"].get(name, "")), accelerometers.get(name))
        for name, column in values["reading"].items()
    }
    return run


def _written(value: Any, u: Any, output: Output | None) -> str:
    unit = output.unit if output else "g"
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "empty"
    if isinstance(value, str):
        return value
    spread = f" ± {float(u)!r}" if u is not None and np.isfinite(float(u)) else ""
    return f"{float(value)!r}{spread} {unit}"
