"""Readings in a description: entries of ``[[runs]]``, and the table of ``[readings]``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, cast

from counterspin.campaign.documents import KeyPath, table_of
from counterspin.campaign.reading import DescribedReadings, Reading, Triad
from counterspin.campaign.resolution import DescriptionReader
from counterspin.campaign.runs import is_pose, is_reading
from counterspin.campaign.settings import FixtureSettings
from counterspin.loading import is_installed, load_name
from counterspin.readings.entries import positioned, resolve_readings, with_recorded_angles
from counterspin.readings.table import read_table

#: Reader of [triad] and of poses; signature of `counterspin.triads.section.resolve_triad`.
TRIAD: Final = "counterspin.triads.section:resolve_triad"

#: Entries of readings, each with its place in the description.
_Entries = Sequence[tuple[Any, KeyPath]]


def read_readings(
    reader: DescriptionReader, turns: float | None, *, has_records: bool
) -> DescribedReadings:
    """Return the readings, poses and triad of a description, and note every mistake in them.

    turns: Revolutions of a simulated record; None without a simulation.
    has_records: Whether there are runs of a double turntable.
    """
    problems, accelerometers = reader.problems, reader.accelerometers
    mountings = {name: accelerometers.mountings.get(name) for name in accelerometers.tables}
    folder, before = reader.file.parent, len(problems.lines)
    checksums: dict[Path, str] = {}
    numbered = _numbered(reader, checksums)
    read = partial(
        resolve_readings,
        mountings=mountings,
        outputs=accelerometers.outputs,
        folder=folder,
        problems=problems,
        gravity=reader.gravity,
        turns=turns,
    )
    fixture = reader.parts.get("fixture") or FixtureSettings()
    known = [entry for entry in numbered if not is_pose(entry[0])]
    readings = positioned(read(known), fixture.position)
    records = reader.parts.get("records")
    if records and records.recording.angle is not None:
        readings = with_recorded_angles(readings)
    whole = len(problems.lines) == before
    posed = [entry for entry in numbered if is_pose(entry[0])]
    given = None if readings or has_records else accelerometers.own_priors
    triad = _triad(reader, posed, mountings, read, given)
    truths = {
        str(raw["name"]): (raw["truth"], (*path, "truth"))
        for raw, path in numbered
        if isinstance(raw, Mapping) and "name" in raw and isinstance(raw.get("truth"), Mapping)
    }
    return DescribedReadings(readings, triad, whole, truths, _files(reader), checksums)


def _numbered(reader: DescriptionReader, checksums: dict[Path, str]) -> list[tuple[Any, KeyPath]]:
    """Return the runs that are readings, including rows of the table, with their places."""
    runs: list[tuple[Any, KeyPath]] = [
        (raw, ("runs", index)) for index, raw in reader.parts["listed"] if is_reading(raw)
    ]
    if "readings" in reader.raw:
        outputs = reader.accelerometers.outputs
        every = {name: outputs.get(name) for name in reader.accelerometers.raw}
        runs += read_table(reader.raw, reader.file.parent, every, reader.problems, checksums)
    return runs


def _triad(
    reader: DescriptionReader,
    posed: _Entries,
    mountings: Mapping[str, Any],
    read: Callable[[_Entries], tuple[Reading, ...]],
    given: Mapping[str, Any] | None,
) -> Triad | None:
    """Return the triad with its poses; None without them."""
    section = reader.raw.get("triad")
    if section is None and not posed:
        return None
    if not is_installed(TRIAD):
        reader.problems.add(("triad",), "this installation has no triads")
        return None
    folder, problems = reader.file.parent, reader.problems
    resolve = load_name(TRIAD)
    triad = resolve(section, mountings, posed, folder, read, given=given, problems=problems)
    return cast("Triad | None", triad)


def _files(reader: DescriptionReader) -> tuple[Path, ...]:
    """Return the files of readings."""
    listed = (run for _, run in reader.parts["listed"] if is_reading(run))
    named = [run["record"] for run in listed if "record" in run]
    if "readings" in reader.raw:
        named.append(table_of(reader.raw, "readings").get("file"))
    return tuple(sorted({reader.file.parent / name for name in named if isinstance(name, str)}))
