"""Readings in a description: entries of ``[[runs]]``, and the table of ``[readings]``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, cast

from counterspin.campaign.documents import KeyPath, merge_patch, table_of
from counterspin.campaign.reading import DescribedReadings, Reading, Triad
from counterspin.campaign.resolution import DescriptionReader
from counterspin.campaign.runs import is_pose, is_reading
from counterspin.campaign.settings import FixtureSettings
from counterspin.campaign.validation import Problems
from counterspin.loading import is_installed, load_name
from counterspin.readings.entries import (
    collect_readings,
    mark_recorded_angles,
    number_positions,
    resolve_readings,
)
from counterspin.readings.table import read_table
from counterspin.records.dialect import Dialect

#: Reader of [triad] and of poses; signature of `counterspin.triads.section.resolve_triad`.
TRIAD: Final = "counterspin.triads.section:resolve_triad"

#: Entries of readings with their paths in the description.
_Entries = Sequence[tuple[Any, KeyPath]]


def read_readings(
    reader: DescriptionReader, turns: float | None, *, has_records: bool
) -> DescribedReadings:
    """Return the readings, poses and triad of a description, and collect all their errors.

    turns: Revolutions of a simulated record; None without a simulation.
    has_records: Whether there are runs of a double turntable.
    """
    problems, accelerometers = reader.problems, reader.accelerometers
    mountings = {name: accelerometers.mountings.get(name) for name in accelerometers.tables}
    folder, n_errors = reader.file.parent, len(problems.lines)
    checksums: dict[Path, str] = {}
    entries = _reading_entries(reader, checksums)
    resolve = partial(
        resolve_readings,
        mountings=mountings,
        outputs=accelerometers.outputs,
        folder=folder,
        problems=problems,
        gravity=reader.gravity,
        turns=turns,
    )
    fixture = reader.sections.get("fixture") or FixtureSettings()
    attitude_entries = [entry for entry in entries if not is_pose(entry[0])]
    readings = collect_readings(resolve(attitude_entries), problems, turns)
    readings = number_positions(readings, fixture.position)
    records = reader.sections.get("records")
    if records and records.recording.angle is not None:
        readings = mark_recorded_angles(readings)
    is_valid = len(problems.lines) == n_errors
    section = table_of(reader.raw, "records")
    pose_entries = [
        (_merge_records_section(raw, path, section, problems), path)
        for raw, path in entries
        if is_pose(raw)
    ]
    default_priors = None if readings or has_records else accelerometers.own_priors
    pose_readings = (
        {reading.accelerometer: reading for reading in collect_readings([run], problems, turns)}
        for run in resolve([entry for entry in pose_entries if "record" not in entry[0]])
    )
    triad = _resolve_triad(reader, pose_entries, mountings, pose_readings, default_priors)
    truths = {
        str(raw["name"]): (raw["truth"], (*path, "truth"))
        for raw, path in entries
        if isinstance(raw, Mapping) and "name" in raw and isinstance(raw.get("truth"), Mapping)
    }
    return DescribedReadings(readings, triad, is_valid, truths, _reading_files(reader), checksums)


def _reading_entries(
    reader: DescriptionReader, checksums: dict[Path, str]
) -> list[tuple[Any, KeyPath]]:
    """Return the runs that are readings, including rows of the table, with their paths."""
    runs: list[tuple[Any, KeyPath]] = [
        (raw, ("runs", index)) for index, raw in reader.sections["indexed_runs"] if is_reading(raw)
    ]
    if "readings" in reader.raw:
        raw, folder, accelerometers = reader.raw, reader.file.parent, reader.accelerometers
        outputs = {name: accelerometers.outputs.get(name) for name in accelerometers.raw}
        runs += read_table(raw, folder, outputs, reader.problems, checksums)
    return runs


def _merge_records_section(
    raw: Mapping[str, Any], path: KeyPath, section: Mapping[str, Any], problems: Problems
) -> Mapping[str, Any]:
    """Return the entry of a record of poses, with defaults of `records` from the section."""
    own_settings = raw.get("records")
    if not isinstance(own_settings, Mapping):
        return raw
    known_keys = Dialect.__dataclass_fields__
    for key in own_settings:
        if key not in known_keys:
            message = f"cannot be set for a record of poses; known keys: {', '.join(known_keys)}"
            problems.add((*path, "records", key), message)
    return {**raw, "records": merge_patch(section, own_settings)}


def _resolve_triad(
    reader: DescriptionReader,
    pose_entries: _Entries,
    mountings: Mapping[str, Any],
    pose_readings: Iterator[Mapping[str, Reading]],
    default_priors: Mapping[str, Any] | None,
) -> Triad | None:
    """Return the triad with its poses; None without a triad."""
    section, folder, problems = reader.raw.get("triad"), reader.file.parent, reader.problems
    if section is None and not pose_entries:
        return None
    if not is_installed(TRIAD):
        problems.add(("triad",), "this installation does not support triads", "missing-package")
        return None
    resolve = load_name(TRIAD)
    triad = resolve(
        section,
        mountings,
        pose_entries,
        folder,
        pose_readings,
        own_priors=default_priors,
        problems=problems,
    )
    return cast("Triad | None", triad)


def _reading_files(reader: DescriptionReader) -> tuple[Path, ...]:
    """Return the files of readings."""
    runs = (run for _, run in reader.sections["indexed_runs"] if is_reading(run))
    names = [run["record"] for run in runs if "record" in run]
    if "readings" in reader.raw:
        names.append(table_of(reader.raw, "readings").get("file"))
    return tuple(sorted({reader.file.parent / name for name in names if isinstance(name, str)}))
