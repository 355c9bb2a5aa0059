"""Runs with records: how each is read, which part of it, and which are left out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from counterspin.campaign.checking import Path as KeyPath
from counterspin.campaign.checking import Problems
from counterspin.campaign.columns import Recording, RecordsSettings
from counterspin.campaign.kinds import exact
from counterspin.campaign.memory.documents import patched
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.readings import is_reading
from counterspin.campaign.resolved import Run, RunTruth
from counterspin.campaign.settings import RunSettings
from counterspin.campaign.truth import TruthReader
from counterspin.frozen import frozen
from counterspin.records.dialect import Dialect

#: Keys of [records] that a run has of its own.
_OWN: Final = ("time", "angle", "temperature", "recorder", "clock", *Dialect.__dataclass_fields__)


@frozen
class RunDefaults:
    """What the sections beside ``[[runs]]`` say of each run."""

    folder: Path  #: Of the record files.
    records: Mapping[str, Any]  #: The section [records], as it stands.
    truth: TruthReader | None  #: What [truth] says; None where nothing is simulated.
    revolutions: float  #: Of a run that is simulated.


def taken_runs(runs: Sequence[Any]) -> list[tuple[int, Any]]:
    """Return the runs that are not left out, with their places in the description."""
    return [(place, run) for place, run in enumerate(runs) if not _is_skipped(run)]


def skipped_runs(runs: Sequence[Any]) -> tuple[str, ...]:
    """Return the names of the runs that are left out."""
    return tuple(str(run.get("name", "?")) for run in runs if _is_skipped(run))


def _is_skipped(run: Any) -> bool:
    return isinstance(run, Mapping) and run.get("skip") is True


def resolve_runs(
    runs: Sequence[tuple[int, Any]], defaults: RunDefaults, problems: Problems
) -> list[Run]:
    """Return the runs that have records, and note every mistake in them."""
    resolved = []
    names: dict[str, int] = {}
    records: dict[str, int] = {}
    for index, raw in runs:
        path = ("runs", index)
        if isinstance(raw, dict):
            _once(raw.get("name"), names, (*path, "name"), problems)
            for key, file in _files(raw):
                if isinstance(file, str) and not _is_elsewhere(raw, file, runs, defaults.records):
                    _once(file, records, (*path, key), problems)
        if is_reading(raw):
            continue
        settings = problems.check(RunSettings, raw, path)
        if settings is None:
            continue
        _check_files(settings, path, problems)
        duration = _duration(settings, defaults, path, problems)
        resolved.append(
            Run(
                name=settings.name,
                rate=settings.rate,
                record=defaults.folder / settings.record,
                attitude=settings.attitude,
                duration=duration,
                truth=_truth(settings, defaults, path, problems),
                temperature=settings.temperature,
                time=settings.time,
                recording=_own_recording(settings, defaults, path, problems),
                part=_part(settings, path, problems),
                continued_in=tuple(defaults.folder / name for name in settings.continued_in),
                pulses=defaults.folder / settings.pulses if settings.pulses else None,
            )
        )
    _check_clocks(resolved, problems)
    return resolved


def _files(raw: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return the files that a run names, with their keys."""
    more = raw.get("continued_in")
    names = [("continued_in", name) for name in (more if isinstance(more, list) else [])]
    return [("record", raw.get("record")), *names, ("pulses", raw.get("pulses"))]


def _check_files(settings: RunSettings, path: KeyPath, problems: Problems) -> None:
    ending = Path(settings.record).suffix.lower()
    for place, name in enumerate(settings.continued_in):
        if Path(name).suffix.lower() != ending:
            words = f"must end in {ending}, as the record does"
            problems.add((*path, "continued_in", place), words)


def _is_elsewhere(
    raw: Mapping[str, Any], file: Any, runs: Sequence[tuple[int, Any]], common: Mapping[str, Any]
) -> bool:
    """Return whether a run uses another part of a file than every other run that names it.

    common: The section [records].
    """
    sharing = [
        other
        for _, other in runs
        if other is not raw and isinstance(other, dict) and other.get("record") == file
    ]
    here = _table_in_file(raw, common)
    same = [one for one in sharing if not _are_two_tables(here, _table_in_file(one, common))]
    if not same:
        return bool(sharing)
    if "start" not in raw and "stop" not in raw:
        return False
    begin, end = _stated_part(raw)
    return all(end <= start or stop <= begin for start, stop in map(_stated_part, same))


def _table_in_file(raw: Mapping[str, Any], common: Mapping[str, Any]) -> list[Any]:
    """Return the sheet and the group that are read of a run's record; None: the only one."""
    own = raw.get("records")
    stated = {**common, **own} if isinstance(own, Mapping) else common
    return [stated.get("sheet"), stated.get("group")]


def _are_two_tables(one: Sequence[Any], other: Sequence[Any]) -> bool:
    return any(a is not None and b is not None and a != b for a, b in zip(one, other, strict=True))


def _stated_part(raw: Mapping[str, Any]) -> tuple[float, float]:
    """Return the part of its record that a run states; all of it if it states none that is one."""
    try:
        start = exact(raw["start"], "s") if "start" in raw else -math.inf
        stop = exact(raw["stop"], "s") if "stop" in raw else math.inf
    except ValueError:
        return -math.inf, math.inf
    return start, stop


def _once(value: Any, seen: dict[str, int], path: KeyPath, problems: Problems) -> None:
    index = path[1]
    assert isinstance(index, int)
    if isinstance(value, str) and seen.setdefault(value, index) != index:
        problems.add(path, f'"{value}" is already used by runs[{seen[value]}]')


def _duration(
    settings: RunSettings, defaults: RunDefaults, path: KeyPath, problems: Problems
) -> float | None:
    duration: float | None = settings.duration
    if duration is not None and settings.revolutions is not None:
        problems.add((*path, "duration"), "revolutions is given too; keep one")
    simulated = defaults.revolutions if defaults.truth is not None else None
    turns = settings.revolutions or simulated
    if duration is None and turns is not None:
        duration = turns * 2.0 * math.pi / abs(settings.rate)
    return duration


def _truth(
    settings: RunSettings, defaults: RunDefaults, path: KeyPath, problems: Problems
) -> RunTruth | None:
    if defaults.truth is not None:
        return defaults.truth.of_run(settings.rate, settings.truth or {}, (*path, "truth"))
    if settings.truth is not None:
        problems.add((*path, "truth"), "needs [simulation] or [truth]")
    return None


def _own_recording(
    settings: RunSettings, defaults: RunDefaults, path: KeyPath, problems: Problems
) -> Recording | None:
    """Return how a run's record is read, where that differs from the others."""
    if settings.records is None:
        return None
    path = (*path, "records")
    for key in settings.records:
        if key not in _OWN:
            problems.add((*path, key), f"cannot be set for one run; known: {', '.join(_OWN)}")
    if "angle" in settings.records and "angle" not in defaults.records:
        problems.add((*path, "angle"), "state an angle in [records], for all runs")
    own = problems.check(RecordsSettings, patched(defaults.records, settings.records), path)
    if own is None:
        return None
    recording = own.recording
    if recording.recorder == (defaults.records.get("recorder") or ""):
        if "clock" in settings.records:
            problems.add(
                (*path, "clock"), 'name the recorder to which it belongs, as in recorder = "B"'
            )
        return replace(recording, recorder="")
    return recording


def _check_clocks(runs: Sequence[Run], problems: Problems) -> None:
    """Note recorders of which two runs state two clocks."""
    clocks: dict[str, tuple[str, Quantity | None]] = {}
    for run in runs:
        if run.recording is not None and run.recording.recorder:
            own = run.name, run.recording.clock
            first, clock = clocks.setdefault(run.recording.recorder, own)
            if clock != run.recording.clock:
                problems.add(
                    ("runs",),
                    f'"{first}" and "{run.name}" state two clocks of the recorder '
                    f'"{run.recording.recorder}"; state one',
                )


def _part(settings: RunSettings, path: KeyPath, problems: Problems) -> tuple[float, float]:
    """Return from where to where a record is used."""
    start = -math.inf if settings.start is None else settings.start
    stop = math.inf if settings.stop is None else settings.stop
    if not start < stop:
        problems.add((*path, "stop"), "must come after start")
    return start, stop
