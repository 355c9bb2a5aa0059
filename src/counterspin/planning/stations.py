"""Conversion of ``PLAN.toml`` with [[stations]] to a `ReadingPlan` of possible readings.

Every station becomes a run with a reading of a template campaign, so that both are checked alike.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.campaign.description import Campaign, resolve_campaign
from counterspin.campaign.documents import KeyPath, campaign_error, list_of, table_of
from counterspin.campaign.reading import Reading
from counterspin.campaign.validation import Problems, suggest_name
from counterspin.errors import InputError
from counterspin.frozen import frozen
from counterspin.planning.plan_file import (
    Plan,
    load_plan,
    plan_name,
    read_plan,
    resolve_goal,
    resolve_plan_campaign,
)
from counterspin.planning.plan_sections import (
    GoalSettings,
    ReadingLimitsSettings,
    ReadingPlanDocument,
    StationsSettings,
)
from counterspin.planning.recorded import add_pose_noise
from counterspin.planning.result import GoalResult
from counterspin.readings.cells import BLANK
from counterspin.triads.groups import make_group
from counterspin.triads.poses import TriadPoses, predict_indications
from counterspin.triads.section import TriadSettings

#: Most possible readings: the gain of an exchange is computed for all pairs.
_MAX_CANDIDATES: Final = 3600


@frozen
class PossibleReading:
    """A reading that may be taken, any number of times."""

    run: Mapping[str, Any]  #: As [[runs]] has it, its values blank.
    time: float  #: That it takes, s.
    #: Of a pose: accelerometer -> 1 where its input axis points up, -1 where it points down.
    up: Mapping[str, float] | None = None

    @property
    def name(self) -> str:
        """Name of the reading."""
        return str(self.run["name"])


@frozen(eq=False)
class ReadingPlan:
    """A plan of readings, checked and resolved."""

    path: Path  #: Of the file, absolute.
    document: Mapping[str, Any]  #: The campaign to be, without runs.
    taken: tuple[Any, ...]  #: Runs that it has already, records and readings, as [[runs]] has them.
    sampling_rate: float | None  #: Of the records among them, Hz; None where there is none.
    template: Campaign  #: The campaign with existing observations and each possible reading once.
    candidates: tuple[PossibleReading, ...]  #: The possible readings.
    poses: tuple[tuple[Reading, ...], ...]  #: Those that it has already, with their u.
    #: Most of them, and s; infinite without a limit.
    readings: float
    total_time: float
    order: str  #: ``mirrored``, ``random`` or ``listed``.
    goal: GoalResult  #: What it is for.

    def campaign_document(
        self, readings: Sequence[PossibleReading], *, value: str = BLANK
    ) -> dict[str, Any]:
        """Return the document of the campaign with readings in this order."""
        has_times = any(reading.time > 0.0 for reading in readings)
        now, runs = 0.0, []
        for name, reading in zip(_number_names(readings), readings, strict=True):
            run = _with_value(reading.run, value) | {"name": name}
            if has_times:
                # The time in the middle of the reading, from the start of the first.
                run["time"] = f"{round(now + 0.5 * reading.time, 6)!r} s"
                now += reading.time
            runs.append(run)
        return {**self.document, "runs": [*self.taken, *runs]}

    def campaign_as_it_is(self) -> Campaign:
        """Return the campaign with its existing observations only, of the same model."""
        names = {reading.name for reading in self.candidates}
        existing = tuple(r for r in self.template.readings if r.name not in names)
        triad = self.template.triad and replace(self.template.triad, poses=self.poses)
        return replace(self.template, readings=existing, triad=triad)

    def campaign(self, readings: Sequence[PossibleReading]) -> Campaign:
        """Return the campaign with readings in this order, their values zero."""
        campaign = resolve_plan_campaign(self.campaign_document(readings, value="0"), self.path)
        if campaign.triad is None:
            return campaign
        poses = _simulate_poses(campaign, dict(zip(_number_names(readings), readings, strict=True)))
        triad = replace(campaign.triad, poses=(*self.poses, *poses), records=())
        return replace(campaign, triad=triad)


def _number_names(readings: Sequence[PossibleReading]) -> list[str]:
    digits = len(str(len(readings)))
    return [f"{index:0{digits}d} {reading.name}" for index, reading in enumerate(readings, start=1)]


def _simulate_poses(
    campaign: Campaign, planned_readings: Mapping[str, PossibleReading]
) -> tuple[tuple[Reading, ...], ...]:
    """Return the poses that are planned, by the names of their runs, as they will be read."""
    assert campaign.triad is not None
    poses = [pose for pose in campaign.triad.poses if pose[0].name in planned_readings]
    if not poses:
        return ()
    ups = [planned_readings[pose[0].name].up or {} for pose in poses]
    priors_of = [campaign.accelerometers[reading.accelerometer].priors for reading in poses[0]]
    coefficients = [
        {symbol: prior.value for symbol, prior in priors.items()} for priors in priors_of
    ]
    values = pointing_up(make_group(campaign, poses), ups, coefficients).value.tolist()
    return tuple(
        tuple(replace(reading, value=value) for reading, value in zip(pose, row, strict=True))
        for pose, row in zip(poses, values, strict=True)
    )


def pointing_up(
    poses: TriadPoses,
    ups: Sequence[Mapping[str, float]],
    coefficients: Sequence[Mapping[str, float]],
) -> TriadPoses:
    """Return poses with the values that they have where they point as `every_up` says.

    coefficients: Of each accelerometer; those not named are nominal.
    """
    up = np.array(
        [[directions.get(name, 0.0) for name in poses.accelerometers] for directions in ups]
    )
    direction = up @ poses.axes[:, 0]
    unit = direction / np.linalg.norm(direction, axis=1)[:, None]
    return replace(poses, value=predict_indications(poses, coefficients, unit))


def every_up(names: Sequence[str]) -> list[dict[str, float]]:
    """Return 26 directions: accelerometer -> 1 where its input axis points up, -1 where down.

    First one axis, then two, then all three.
    """
    signs = [
        combination
        for combination in product((1.0, -1.0, 0.0), repeat=len(names))
        if any(combination)
    ]
    ups = [dict(zip(names, combination, strict=True)) for combination in signs]
    return sorted(ups, key=lambda up: sum(map(abs, up.values())))


def words_of_up(up: Mapping[str, float]) -> str:
    """Return such a direction in words, such as "+X -Y up"."""
    axes = (f"{'-' if sign < 0.0 else '+'}{name}" for name, sign in up.items() if sign)
    return f"{' '.join(axes)} up"


def _with_value(run: Mapping[str, Any], value: str) -> dict[str, Any]:
    reading = run["reading"]
    if isinstance(reading, str):
        return {**run, "reading": reading.replace(BLANK, value)}
    return {**run, "reading": {name: text.replace(BLANK, value) for name, text in reading.items()}}


def read_any_plan(
    path: Mapping[str, Any] | Path | str, file: Path | None = None
) -> Plan | ReadingPlan:
    """Read and check a plan of records or of readings; file: as in `plan_file.read_plan`."""
    readings = "stations" in load_plan(path)
    return read_reading_plan(path, file) if readings else read_plan(path, file)


def read_reading_plan(
    path: Mapping[str, Any] | Path | str, file: Path | None = None
) -> ReadingPlan:
    """Read and check a plan of readings; file: as in `plan_file.read_plan`."""
    file, raw = file or plan_name(path), load_plan(path)
    problems = Problems(raw)
    problems.check(ReadingPlanDocument, raw, ())
    limits = problems.check(ReadingLimitsSettings, table_of(raw, "limits"), ("limits",))
    goal = problems.check(GoalSettings, table_of(raw, "goal"), ("goal",))
    plan_keys = ("limits", "goal", "stations", "runs")
    document = {k: v for k, v in raw.items() if k not in plan_keys}
    existing_runs = list_of(raw, "runs")
    tables = table_of(raw, "accelerometers")
    names = list(tables)
    units = {
        name: table_of(table, "output").get("unit", "g")
        for name, table in tables.items()
        if isinstance(table, Mapping)
    }
    triad = problems.check(TriadSettings, raw["triad"], ("triad",)) if "triad" in raw else None
    candidates: list[PossibleReading] = []
    for index, entry in enumerate(list_of(raw, "stations")):
        path_of_entry = ("stations", index)
        settings = problems.check(StationsSettings, entry, path_of_entry, units=units)
        if settings is not None:
            read = triad.accelerometers if triad and settings.attitude else names
            candidates += _candidate_readings(settings, entry, read, raw, path_of_entry, problems)
    used_names = {str(run.get("name")) for run in existing_runs if isinstance(run, dict)}
    for reading in candidates:
        if reading.name in used_names:
            text = f'two entries have the name "{reading.name}"; give each entry a different name'
            problems.add(("stations",), text, "duplicate-entry")
        used_names.add(reading.name)
    if len(candidates) > _MAX_CANDIDATES:
        words = (
            f"allow {len(candidates)} different readings, which exceeds the limit of "
            f"{_MAX_CANDIDATES}"
        )
        problems.add(("stations",), words, "too-many-rows")
    runs = [_with_value(reading.run, "0") for reading in candidates]
    campaign = None
    if runs and not problems.lines:
        full_document = {**document, "runs": [*existing_runs, *runs]}
        run_problems = Problems(full_document)
        campaign = resolve_campaign(full_document, file, run_problems)
        # One message for an error that all readings share.
        lines = (_at_stations(line, len(existing_runs)) for line in run_problems.lines)
        problems.lines += dict.fromkeys(line.partition(' (run "')[0] for line in lines)
    poses: tuple[tuple[Reading, ...], ...] = ()
    if campaign is not None and campaign.triad is not None:
        campaign, poses = _add_poses(campaign, candidates)
        # The number of poses decides the parameters of interest; here the minimum is enough.
        model = {"terms": list(campaign.model.terms), **table_of(raw, "model")}
        document = {**document, "model": model}
    goal_result = resolve_goal(goal, campaign, problems) if goal and campaign else None
    if limits is not None and limits.readings is None and limits.total_time is None:
        problems.add(("limits",), "give readings or total_time", "missing-key")
    if limits is not None and limits.total_time is not None and not all(r.time for r in candidates):
        problems.add(
            ("limits", "total_time"),
            "requires the time of a reading at every station",
            "missing-key",
        )
    if limits is not None and campaign is not None and campaign.runs and not limits.sampling_rate:
        problems.add(
            ("limits", "sampling_rate"),
            "this entry is missing; the records in [[runs]] require a sampling rate",
            "missing-key",
        )
    if problems.lines or campaign is None or goal_result is None or limits is None:
        raise campaign_error(
            file, problems.lines or ["stations: missing; give at least one [[stations]]"]
        )
    return ReadingPlan(
        file.absolute(),
        document,
        tuple(existing_runs),
        limits.sampling_rate,
        campaign,
        tuple(candidates),
        poses,
        float(limits.readings or math.inf),
        limits.total_time or math.inf,
        limits.order,
        goal_result,
    )


def _add_poses(
    campaign: Campaign, candidates: Sequence[PossibleReading]
) -> tuple[Campaign, tuple[tuple[Reading, ...], ...]]:
    """Return a template campaign with the values of possible poses; and those taken already."""
    assert campaign.triad is not None
    planned_readings = {reading.name: reading for reading in candidates}
    planned_poses = _simulate_poses(campaign, planned_readings)
    existing = tuple(pose for pose in campaign.triad.poses if pose[0].name not in planned_readings)
    complete = add_pose_noise(replace(campaign, triad=replace(campaign.triad, poses=existing)))
    assert complete.triad is not None
    triad = replace(complete.triad, poses=(*complete.triad.poses, *planned_poses))
    return replace(campaign, triad=triad), complete.triad.poses


def _at_stations(line: str, run_count: int) -> str:
    """Return a mistake of a run that stands for a station as one of the stations."""
    match = re.match(r"runs\[(\d+)\]", line)
    if match is None or int(match[1]) < run_count:
        return line
    return f"stations{line[match.end() :]}"


def _candidate_readings(
    settings: StationsSettings,
    entry: Mapping[str, Any],
    names: Sequence[str],
    raw: Mapping[str, Any],
    path: KeyPath,
    problems: Problems,
) -> list[PossibleReading]:
    """Return the readings that an entry of [[stations]] stands for."""
    u_values = settings.u if isinstance(settings.u, dict) else dict.fromkeys(names, settings.u)
    values = {name: f"{BLANK} ± {u}" for name, u in u_values.items()}
    shared_keys: dict[str, Any] = {"motion": settings.motion}
    shared_keys |= {key: entry[key] for key in ("attitude", "axes", "mounting") if key in entry}
    reading: Any = next(iter(values.values())) if len(values) == 1 else values
    before = len(problems.lines)
    static = settings.motion == "static"
    if static and (settings.rates or settings.specific_forces):
        problems.add(path, "a station at rest has no rates; give positions or attitudes")
    if not static and bool(settings.rates) == bool(settings.specific_forces):
        problems.add(path, "give either rates or specific_forces")
    if settings.positions is not None and settings.attitudes is not None:
        problems.add(path, "give either positions or attitudes")
    if settings.attitude is None and settings.up is not None:
        problems.add((*path, "up"), 'this key applies only to poses; write attitude = "unknown"')
    if settings.attitude is not None:
        if not static or settings.positions is not None or settings.attitudes is not None:
            problems.add(
                (*path, "attitude"),
                "these keys do not apply to poses at rest, which have no rate and no position",
            )
        if len(problems.lines) == before:
            if "triad" in raw:
                return _poses(settings, {**shared_keys, "reading": reading}, names, path, problems)
            problems.add((*path, "attitude"), 'is "unknown", which requires [triad]', "missing-key")
        return []
    if len(problems.lines) > before:
        return []
    entries = _attitudes(settings) if static else _rates(settings, raw)
    return [
        PossibleReading(
            {
                "name": " ".join(filter(None, (settings.name, name))),
                **shared_keys,
                **entry_keys,
                "reading": reading,
            },
            settings.time,
        )
        for name, entry_keys in entries
    ]


def _poses(
    settings: StationsSettings,
    shared_keys: Mapping[str, Any],
    names: Sequence[str],
    path: KeyPath,
    problems: Problems,
) -> list[PossibleReading]:
    """Return the poses that an entry of [[stations]] stands for; `names` are those of its triad."""
    ups = every_up(names)
    if settings.up is not None:
        read = [
            problems.collect((*path, "up", index), _up, words, names)
            for index, words in enumerate(settings.up)
        ]
        ups = [up for up in read if up is not None]
    candidates = []
    for up in ups:
        run = {"name": " ".join(filter(None, (settings.name, words_of_up(up)))), **shared_keys}
        candidates.append(PossibleReading(run, settings.time, up))
    return candidates


def _up(text: str, names: Sequence[str]) -> dict[str, float]:
    """Return accelerometer -> 1 or -1 of words such as "X - Y"."""
    up, sign = {}, 1.0
    for token in re.findall(r"[+-]|[^\s+-]\S*", text):
        if token in "+-":
            sign = -1.0 if token == "-" else 1.0
        elif token in up:
            raise InputError(f'"{token}" is listed twice', "duplicate-entry")
        elif token not in names:
            suggestion = suggest_name(token, names)
            raise InputError(
                f'"{token}" is not an accelerometer of the triad{suggestion}',
                "unknown-accelerometer",
            )
        else:
            up[token], sign = sign, 1.0
    if not up:
        raise InputError("does not name an accelerometer", "unknown-accelerometer")
    return up


def _attitudes(settings: StationsSettings) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield name and attitude of every position at rest."""
    head = f" ± {settings.u_angle!r} rad" if settings.u_angle else ""
    if settings.positions is not None:
        for position in range(settings.positions):
            angle = 360.0 * position / settings.positions
            turn = f"{math.radians(angle)!r}{head}" if head else f"{angle!r} deg"
            yield f"{angle:.6g} deg", {"attitude": f"{turn} about {settings.about}"}
    elif settings.attitudes is not None:
        for attitude in settings.attitudes:
            words = attitude if isinstance(attitude, str) else str(attitude)
            yield words, {"attitude": attitude}
    else:
        yield "at rest" if not settings.name else "", {}


def _rates(
    settings: StationsSettings, raw: Mapping[str, Any]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield name and rate of every reading that turns."""
    signs = (1.0, -1.0) if settings.senses == "both" else (1.0,)
    named_rates: list[tuple[str, float]] = [(f"{w:.6g} rad/s", w) for w in settings.rates or ()]
    named_rates += [(f"{force:.6g} g", math.nan) for force in settings.specific_forces or ()]
    for index, (words, rate) in enumerate(named_rates):
        size = rate
        if settings.specific_forces:
            size = _rate_for(settings.specific_forces[index], raw)
        for sign in signs:
            name = words if sign > 0.0 else f"-{words}" if settings.rates else f"{words} reversed"
            yield name, {"rate": f"{sign * size!r} rad/s"}


def _rate_for(force: float, raw: Mapping[str, Any]) -> float:
    """Return the rate at which the centripetal force has a size, g; 1 for an invalid machine.

    The check of the campaign reports the errors of the machine.
    """
    from counterspin.campaign.quantity import parse_quantity

    try:
        gravity = parse_quantity(raw["site"]["gravity"], "m/s^2").value
        radius = parse_quantity(raw["centrifuge"]["radius"], "m").value
        return math.sqrt(force * gravity / radius)
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return 1.0
