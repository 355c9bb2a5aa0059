"""Conversion of ``PLAN.toml`` with [[stations]] to a `ReadingPlan` of candidate readings.

Every candidate is a run with a reading in a template campaign, with the checks of a campaign.
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

#: Maximum number of candidate readings: the search computes the gains of all pairs of exchanges.
_MAX_CANDIDATES: Final = 3600


@frozen
class CandidateReading:
    """A reading that a plan may contain any number of times."""

    run: Mapping[str, Any]  #: Entry of [[runs]] with blank values.
    time: float  #: Time for the reading, s.
    #: For a pose: accelerometer -> 1 if its input axis points up, -1 if it points down.
    up: Mapping[str, float] | None = None

    @property
    def name(self) -> str:
        """Name of the reading."""
        return str(self.run["name"])


@frozen(eq=False)
class ReadingPlan:
    """A plan of readings, checked and resolved."""

    path: Path  #: Absolute path of the file.
    document: Mapping[str, Any]  #: Document of the planned campaign, without runs.
    existing_runs: tuple[Any, ...]  #: Existing entries of [[runs]].
    sampling_rate: float | None  #: Sampling rate of existing records, Hz; None without records.
    template: Campaign  #: Campaign with the existing observations and each candidate once.
    candidates: tuple[CandidateReading, ...]  #: Candidate readings.
    existing_poses: tuple[tuple[Reading, ...], ...]  #: Existing poses with their u.
    max_readings: float  #: Maximum number of new readings; infinite without a limit.
    total_time: float  #: Maximum time of new readings, s; infinite without a limit.
    order: str  #: ``mirrored``, ``random`` or ``listed``.
    goal: GoalResult  #: Goal of the plan.

    def campaign_document(
        self, readings: Sequence[CandidateReading], *, value: str = BLANK
    ) -> dict[str, Any]:
        """Return the document of the campaign with readings in this order."""
        has_times = any(reading.time > 0.0 for reading in readings)
        start_time, runs = 0.0, []
        for name, reading in zip(_number_names(readings), readings, strict=True):
            run = _fill_value(reading.run, value) | {"name": name}
            if has_times:
                # The time in the middle of the reading, from the start of the first.
                run["time"] = f"{round(start_time + 0.5 * reading.time, 6)!r} s"
                start_time += reading.time
            runs.append(run)
        return {**self.document, "runs": [*self.existing_runs, *runs]}

    def existing_campaign(self) -> Campaign:
        """Return the campaign with only its existing observations, with the same model."""
        names = {reading.name for reading in self.candidates}
        existing_readings = tuple(
            reading for reading in self.template.readings if reading.name not in names
        )
        triad = self.template.triad and replace(self.template.triad, poses=self.existing_poses)
        return replace(self.template, readings=existing_readings, triad=triad)

    def campaign(self, readings: Sequence[CandidateReading]) -> Campaign:
        """Return the campaign with readings in this order and zero values."""
        campaign = resolve_plan_campaign(self.campaign_document(readings, value="0"), self.path)
        if campaign.triad is None:
            return campaign
        poses = _simulate_poses(campaign, dict(zip(_number_names(readings), readings, strict=True)))
        triad = replace(campaign.triad, poses=(*self.existing_poses, *poses), records=())
        return replace(campaign, triad=triad)


def _number_names(readings: Sequence[CandidateReading]) -> list[str]:
    digits = len(str(len(readings)))
    return [f"{index:0{digits}d} {reading.name}" for index, reading in enumerate(readings, start=1)]


def _simulate_poses(
    campaign: Campaign, planned_readings: Mapping[str, CandidateReading]
) -> tuple[tuple[Reading, ...], ...]:
    """Return the planned poses of a campaign with their expected values.

    planned_readings: Readings by name of their run.
    """
    assert campaign.triad is not None
    poses = [pose for pose in campaign.triad.poses if pose[0].name in planned_readings]
    if not poses:
        return ()
    upward_axes = [planned_readings[pose[0].name].up or {} for pose in poses]
    pose_priors = [campaign.accelerometers[reading.accelerometer].priors for reading in poses[0]]
    coefficients = [
        {symbol: prior.value for symbol, prior in priors.items()} for priors in pose_priors
    ]
    values = set_pose_values(make_group(campaign, poses), upward_axes, coefficients).value.tolist()
    return tuple(
        tuple(replace(reading, value=value) for reading, value in zip(pose, row, strict=True))
        for pose, row in zip(poses, values, strict=True)
    )


def set_pose_values(
    poses: TriadPoses,
    upward_axes: Sequence[Mapping[str, float]],
    coefficients: Sequence[Mapping[str, float]],
) -> TriadPoses:
    """Return poses with their expected indications.

    upward_axes: For each pose, accelerometer -> weight of its input axis in the upward direction.
    coefficients: Coefficients of each accelerometer; others are nominal.
    """
    axis_weights = np.array(
        [[directions.get(name, 0.0) for name in poses.accelerometers] for directions in upward_axes]
    )
    vertical = axis_weights @ poses.axes[:, 0]
    unit_vertical = vertical / np.linalg.norm(vertical, axis=1)[:, None]
    return replace(poses, value=predict_indications(poses, coefficients, unit_vertical))


def upward_directions(names: Sequence[str]) -> list[dict[str, float]]:
    """Return 26 directions: accelerometer -> 1 if its input axis points up, -1 if it points down.

    Directions along one axis come first, then between two axes, then between three.
    """
    combinations = filter(any, product((1.0, -1.0, 0.0), repeat=len(names)))
    directions = [dict(zip(names, combination, strict=True)) for combination in combinations]
    return sorted(directions, key=lambda direction: sum(map(abs, direction.values())))


def describe_upward_direction(up: Mapping[str, float]) -> str:
    """Return the description of an upward direction, such as "+X -Y up"."""
    axis_labels = (f"{'-' if sign < 0.0 else '+'}{name}" for name, sign in up.items() if sign)
    return f"{' '.join(axis_labels)} up"


def _fill_value(run: Mapping[str, Any], value: str) -> dict[str, Any]:
    reading = run["reading"]
    if isinstance(reading, str):
        return {**run, "reading": reading.replace(BLANK, value)}
    return {**run, "reading": {name: text.replace(BLANK, value) for name, text in reading.items()}}


def read_any_plan(
    where: Mapping[str, Any] | Path | str, file: Path | None = None
) -> Plan | ReadingPlan:
    """Read and check a plan of records or of readings; file: as in `plan_file.read_plan`."""
    has_stations = "stations" in load_plan(where)
    return read_reading_plan(where, file) if has_stations else read_plan(where, file)


def read_reading_plan(
    where: Mapping[str, Any] | Path | str, file: Path | None = None
) -> ReadingPlan:
    """Read and check a plan of readings; file: as in `plan_file.read_plan`."""
    file, raw = file or plan_name(where), load_plan(where)
    problems = Problems(raw)
    problems.check(ReadingPlanDocument, raw, ())
    limits = problems.check(ReadingLimitsSettings, table_of(raw, "limits"), ("limits",))
    goal_settings = problems.check(GoalSettings, table_of(raw, "goal"), ("goal",))
    plan_keys = ("limits", "goal", "stations", "runs")
    document = {key: value for key, value in raw.items() if key not in plan_keys}
    existing_runs = list_of(raw, "runs")
    tables = table_of(raw, "accelerometers")
    names = list(tables)
    units = {
        name: table_of(table, "output").get("unit", "g")
        for name, table in tables.items()
        if isinstance(table, Mapping)
    }
    triad = problems.check(TriadSettings, raw["triad"], ("triad",)) if "triad" in raw else None
    candidates: list[CandidateReading] = []
    for index, entry in enumerate(list_of(raw, "stations")):
        entry_path = ("stations", index)
        settings = problems.check(StationsSettings, entry, entry_path, units=units)
        if settings is not None:
            station_accelerometers = triad.accelerometers if triad and settings.attitude else names
            candidates += _candidate_readings(
                settings, entry, station_accelerometers, raw, entry_path, problems
            )
    used_names = {str(run.get("name")) for run in existing_runs if isinstance(run, dict)}
    for reading in candidates:
        if reading.name in used_names:
            text = f'two entries have the name "{reading.name}"; give each entry a different name'
            problems.add(("stations",), text, "duplicate-entry")
        used_names.add(reading.name)
    if len(candidates) > _MAX_CANDIDATES:
        message = (
            f"allow {len(candidates)} different readings, which exceeds the limit of "
            f"{_MAX_CANDIDATES}"
        )
        problems.add(("stations",), message, "too-many-rows")
    runs = [_fill_value(reading.run, "0") for reading in candidates]
    campaign = None
    if runs and not problems.lines:
        full_document = {**document, "runs": [*existing_runs, *runs]}
        run_problems = Problems(full_document)
        campaign = resolve_campaign(full_document, file, run_problems)
        # Report an error that all readings share only once.
        lines = (_relabel_run_problem(line, len(existing_runs)) for line in run_problems.lines)
        problems.lines += dict.fromkeys(line.partition(' (run "')[0] for line in lines)
    existing_poses: tuple[tuple[Reading, ...], ...] = ()
    if campaign is not None and campaign.triad is not None:
        campaign, existing_poses = _add_poses(campaign, candidates)
        # The number of poses determines the parameters of interest; one set of candidates suffices.
        model = {"terms": list(campaign.model.terms), **table_of(raw, "model")}
        document = {**document, "model": model}
    goal = resolve_goal(goal_settings, campaign, problems) if goal_settings and campaign else None
    if limits is not None and limits.readings is None and limits.total_time is None:
        problems.add(("limits",), "give readings or total_time", "missing-key")
    if (
        limits is not None
        and limits.total_time is not None
        and not all(reading.time for reading in candidates)
    ):
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
    if problems.lines or campaign is None or goal is None or limits is None:
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
        existing_poses,
        float(limits.readings or math.inf),
        limits.total_time or math.inf,
        limits.order,
        goal,
    )


def _add_poses(
    campaign: Campaign, candidates: Sequence[CandidateReading]
) -> tuple[Campaign, tuple[tuple[Reading, ...], ...]]:
    """Return a template campaign with the values of candidate poses, and the existing poses."""
    assert campaign.triad is not None
    readings = {reading.name: reading for reading in candidates}
    planned_poses = _simulate_poses(campaign, readings)
    existing_poses = tuple(pose for pose in campaign.triad.poses if pose[0].name not in readings)
    existing_campaign = add_pose_noise(
        replace(campaign, triad=replace(campaign.triad, poses=existing_poses))
    )
    assert existing_campaign.triad is not None
    triad = replace(existing_campaign.triad, poses=(*existing_campaign.triad.poses, *planned_poses))
    return replace(campaign, triad=triad), existing_campaign.triad.poses


def _relabel_run_problem(line: str, n_runs: int) -> str:
    """Return the message of a problem with a candidate's run as a problem of the stations."""
    match = re.match(r"runs\[(\d+)\]", line)
    if match is None or int(match[1]) < n_runs:
        return line
    return f"stations{line[match.end() :]}"


def _candidate_readings(
    settings: StationsSettings,
    entry: Mapping[str, Any],
    names: Sequence[str],
    raw: Mapping[str, Any],
    path: KeyPath,
    problems: Problems,
) -> list[CandidateReading]:
    """Return the candidate readings of an entry of [[stations]]."""
    u_values = settings.u if isinstance(settings.u, dict) else dict.fromkeys(names, settings.u)
    values = {name: f"{BLANK} ± {u}" for name, u in u_values.items()}
    shared_keys: dict[str, Any] = {"motion": settings.motion}
    shared_keys |= {key: entry[key] for key in ("attitude", "axes", "mounting") if key in entry}
    reading: Any = next(iter(values.values())) if len(values) == 1 else values
    n_problems = len(problems.lines)
    is_static = settings.motion == "static"
    if is_static and (settings.rates or settings.specific_forces):
        problems.add(path, "a station at rest has no rates; give positions or attitudes")
    if not is_static and bool(settings.rates) == bool(settings.specific_forces):
        problems.add(path, "give either rates or specific_forces")
    if settings.positions is not None and settings.attitudes is not None:
        problems.add(path, "give either positions or attitudes")
    if settings.attitude is None and settings.up is not None:
        problems.add((*path, "up"), 'this key applies only to poses; write attitude = "unknown"')
    if settings.attitude is not None:
        if not is_static or settings.positions is not None or settings.attitudes is not None:
            problems.add(
                (*path, "attitude"),
                "these keys do not apply to poses at rest, which have no rate and no position",
            )
        if len(problems.lines) == n_problems:
            if "triad" in raw:
                return _candidate_poses(
                    settings, {**shared_keys, "reading": reading}, names, path, problems
                )
            problems.add((*path, "attitude"), 'is "unknown", which requires [triad]', "missing-key")
        return []
    if len(problems.lines) > n_problems:
        return []
    entries = _station_attitudes(settings) if is_static else _station_rates(settings, raw)
    return [
        CandidateReading(
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


def _candidate_poses(
    settings: StationsSettings,
    shared_keys: Mapping[str, Any],
    names: Sequence[str],
    path: KeyPath,
    problems: Problems,
) -> list[CandidateReading]:
    """Return the candidate poses of an entry of [[stations]]; `names` are those of the triad."""
    directions = upward_directions(names)
    if settings.up is not None:
        parsed_directions = [
            problems.collect((*path, "up", index), _parse_upward_direction, text, names)
            for index, text in enumerate(settings.up)
        ]
        directions = [direction for direction in parsed_directions if direction is not None]
    candidates = []
    for direction in directions:
        run = {
            "name": " ".join(filter(None, (settings.name, describe_upward_direction(direction)))),
            **shared_keys,
        }
        candidates.append(CandidateReading(run, settings.time, direction))
    return candidates


def _parse_upward_direction(text: str, names: Sequence[str]) -> dict[str, float]:
    """Return accelerometer -> 1 or -1 from a text such as "X - Y"."""
    direction, sign = {}, 1.0
    for token in re.findall(r"[+-]|[^\s+-]\S*", text):
        if token in "+-":
            sign = -1.0 if token == "-" else 1.0
        elif token in direction:
            raise InputError(f'"{token}" is listed twice', "duplicate-entry")
        elif token not in names:
            suggestion = suggest_name(token, names)
            raise InputError(
                f'"{token}" is not an accelerometer of the triad{suggestion}',
                "unknown-accelerometer",
            )
        else:
            direction[token], sign = sign, 1.0
    if not direction:
        raise InputError("does not name an accelerometer", "unknown-accelerometer")
    return direction


def _station_attitudes(settings: StationsSettings) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name and the attitude key of every position at rest."""
    u_text = f" ± {settings.u_angle!r} rad" if settings.u_angle else ""
    if settings.positions is not None:
        for position in range(settings.positions):
            angle = 360.0 * position / settings.positions
            angle_text = f"{math.radians(angle)!r}{u_text}" if u_text else f"{angle!r} deg"
            yield f"{angle:.6g} deg", {"attitude": f"{angle_text} about {settings.about}"}
    elif settings.attitudes is not None:
        for attitude in settings.attitudes:
            name = attitude if isinstance(attitude, str) else str(attitude)
            yield name, {"attitude": attitude}
    else:
        yield "at rest" if not settings.name else "", {}


def _station_rates(
    settings: StationsSettings, raw: Mapping[str, Any]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name and the rate key of every reading of a rotating station."""
    signs = (1.0, -1.0) if settings.senses == "both" else (1.0,)
    named_rates = [(f"{rate:.6g} rad/s", rate) for rate in settings.rates or ()]
    named_rates += [(f"{force:.6g} g", math.nan) for force in settings.specific_forces or ()]
    for index, (rate_text, rate) in enumerate(named_rates):
        magnitude = rate
        if settings.specific_forces:
            magnitude = _rate_for_force(settings.specific_forces[index], raw)
        for sign in signs:
            name = rate_text
            if sign < 0.0:
                name = f"-{rate_text}" if settings.rates else f"{rate_text} reversed"
            yield name, {"rate": f"{sign * magnitude!r} rad/s"}


def _rate_for_force(force: float, raw: Mapping[str, Any]) -> float:
    """Return the rate, rad/s, at a centripetal force in g; 1 for an invalid centrifuge.

    The check of the campaign reports the errors of the centrifuge.
    """
    from counterspin.campaign.quantity import parse_quantity

    try:
        gravity = parse_quantity(raw["site"]["gravity"], "m/s^2").value
        radius = parse_quantity(raw["centrifuge"]["radius"], "m").value
        return math.sqrt(force * gravity / radius)
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return 1.0
