"""Section [triad]: three accelerometers in one frame, and their poses at unknown attitudes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import Field

from counterspin.campaign.columns import RecordsSettings
from counterspin.campaign.documents import KeyPath
from counterspin.campaign.field_types import SettingsSection, Text, key_field
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.reading import PoseRecord, Reading, Triad
from counterspin.campaign.runs import PosesSettings, Run
from counterspin.campaign.validation import Problems, suggest_name
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.conditions import stated_conditions

#: Smallest volume spanned by the three input axes; below it, one direction is not sensed.
_MIN_VOLUME: Final = 0.1

#: Default input and pendulous axes: X, Y and Z of one body frame.
DEFAULT_AXES: Final = (("east", "north"), ("north", "up"), ("up", "east"))

#: Keys of an accelerometer's axes.
_AXES_KEYS: Final = {"input_axis", "pendulous_axis", "output_axis"}

#: Tolerance of the cosine between parallel or perpendicular unit vectors.
_ALIGNMENT_TOLERANCE: Final = 1e-6


class TriadSettings(SettingsSection):
    """Section [triad]: three accelerometers of one sensor."""

    accelerometers: Annotated[list[Text], Field(min_length=3, max_length=3)] = key_field(
        "names of the three accelerometers. The first axis of the frame is the input axis of the "
        "first accelerometer. The input axis of the second accelerometer lies in the plane of the "
        "first two axes. If you enter no axes, the nominal input axes are at right angles",
        ["X", "Y", "Z"],
    )


def apply_default_axes(tables: Mapping[str, Any], triad: Any) -> Mapping[str, Any]:
    """Return the tables of accelerometers, with default axes for a triad without stated axes.

    triad: The raw section; its errors are reported elsewhere.
    """
    entries = triad.get("accelerometers") if isinstance(triad, Mapping) else None
    names = [n for n in entries if isinstance(n, str)] if isinstance(entries, list) else []
    own_tables = [tables.get(name) for name in names]
    if len(names) != len(DEFAULT_AXES) or any(
        not isinstance(table, Mapping) or _AXES_KEYS & table.keys() for table in own_tables
    ):
        return tables
    axes = [
        {"input_axis": input_axis, "pendulous_axis": pendulous_axis}
        for input_axis, pendulous_axis in DEFAULT_AXES
    ]
    return {**tables, **{n: {**a, **tables[n]} for n, a in zip(names, axes, strict=True)}}


def resolve_triad(
    raw: Any,
    mountings: Mapping[str, Mounting | None],
    runs: Sequence[tuple[Any, KeyPath]],
    folder: Path,
    pose_readings: Iterator[Mapping[str, Reading]],
    *,
    own_priors: Mapping[str, Mapping[str, Quantity]] | None,
    problems: Problems,
) -> Triad | None:
    """Return the triad with its poses and records; None without a valid section.

    raw: The raw section, None if missing.
    mountings: Axes in the frame of the triad by accelerometer; None if they are invalid.
    runs: Runs at unknown attitudes, with the path of each.
    folder: Folder of the records.
    pose_readings: Readings of the runs without a record, by accelerometer, resolved on demand.
    own_priors: Priors from the table of each accelerometer, by accelerometer and symbol; None if
        the attitude of the triad is determined.
    """
    if raw is None:
        for _, path in runs:
            problems.add(
                (*path, "attitude"),
                'is "unknown", which requires three accelerometers; write [triad] '
                'accelerometers = ["X", "Y", "Z"]',
                "missing-key",
            )
        return None
    settings = problems.check(TriadSettings, raw, ("triad",))
    names = () if settings is None else tuple(settings.accelerometers)
    axes = _resolve_axes(names, mountings, problems)
    frame_misalignments = (
        () if own_priors is None or not axes else _frame_misalignments(names, axes, problems)
    )
    for name, symbol in frame_misalignments:
        if symbol in (own_priors or {}).get(name, {}):
            problems.add(
                ("accelerometers", name, symbol),
                "is zero by definition of the frame of the triad if all attitudes are unknown; "
                "omit it",
            )
    poses: list[tuple[Reading, ...]] = []
    records: list[PoseRecord] = []
    for run, path in runs:
        if "record" in run:
            records += _resolve_record(run, path, folder, problems)
        else:
            poses += _resolve_pose(path, names if axes else (), pose_readings, problems)
    return Triad(names, tuple(poses), tuple(records), frame_misalignments) if axes else None


def _resolve_axes(
    names: Sequence[str], mountings: Mapping[str, Mounting | None], problems: Problems
) -> list[Mounting]:
    """Return the axes of the three accelerometers; empty if they do not form a triad."""
    n_errors = len(problems.lines)
    for index, name in enumerate(names if mountings else ()):
        if name not in mountings:
            suggestion = suggest_name(name, mountings)
            problems.add(
                ("triad", "accelerometers", index),
                f'no accelerometer is named "{name}"{suggestion}',
                "unknown-accelerometer",
            )
        elif name in names[:index]:
            problems.add(
                ("triad", "accelerometers", index), f'"{name}" is listed twice', "duplicate-entry"
            )
    axes = [mounting for mounting in map(mountings.get, names) if mounting is not None]
    if len(problems.lines) > n_errors or len(axes) < len(names):
        return []
    if names and abs(np.linalg.det([mounting.input_axis for mounting in axes])) < _MIN_VOLUME:
        problems.add(
            ("triad", "accelerometers"),
            "the input axes of the three accelerometers lie (nearly) in one plane",
            "invalid-axes",
        )
        return []
    return axes


def _frame_misalignments(
    names: Sequence[str], axes: Sequence[Mounting], problems: Problems
) -> tuple[tuple[str, str], ...]:
    """Return the misalignments that define the frame and are therefore zero.

    These are both of the first accelerometer, and one of the second: that perpendicular to the
    plane of their input axes.
    """
    first_axes, second_axes = axes[0].matrix, axes[1].matrix
    normal = np.cross(first_axes[0], second_axes[0])
    normal /= np.linalg.norm(normal)
    is_normal = np.abs(np.abs(second_axes[1:] @ normal) - 1.0) < _ALIGNMENT_TOLERANCE
    if not is_normal.any():
        problems.add(
            ("accelerometers", names[1], "pendulous_axis"),
            f"must lie in the plane of the input axes of {names[0]} and {names[1]}, or at right "
            "angles to this plane, so that one misalignment is perpendicular to the plane",
            "invalid-axes",
        )
        return ()
    return (
        (names[0], "delta_O"),
        (names[0], "delta_P"),
        (names[1], "delta_O" if is_normal[0] else "delta_P"),
    )


def _resolve_record(
    raw: Mapping[str, Any], path: KeyPath, folder: Path, problems: Problems
) -> Iterator[PoseRecord]:
    """Yield the record with poses of a run if it is valid."""
    run = problems.check(Run, raw, path, folder=folder)
    if run is None:
        return
    poses, dialect = run.poses or PosesSettings(), None
    if run.records is not None:
        settings = problems.check(RecordsSettings, run.records, (*path, "records"))
        dialect = settings.dialect if settings else None
    yield PoseRecord(
        *(run.name, run.record, poses.rest, poses.threshold, poses.u, dialect),
        **stated_conditions(run),
    )


def _resolve_pose(
    path: KeyPath,
    names: Sequence[str],
    pose_readings: Iterator[Mapping[str, Reading]],
    problems: Problems,
) -> Iterator[tuple[Reading, ...]]:
    """Yield the next pose with values if it is valid.

    names: Accelerometers of the triad; empty if they are invalid.
    """
    n_errors = len(problems.lines)
    readings = next(pose_readings)
    if names and readings and set(readings) != set(names):
        message = (
            f"at an unknown attitude, {', '.join(names)} must have readings, and no other "
            "accelerometers"
        )
        problems.add((*path, "reading"), message, "missing-value")
    has_stated_u = [reading.u is not None for reading in readings.values()]
    if any(has_stated_u) and not all(has_stated_u):
        message = "state the uncertainty for all three readings of a pose, or for none"
        problems.add((*path, "reading"), message, "wrong-uncertainty")
    if readings.keys() >= set(names) > set() and len(problems.lines) == n_errors:
        yield tuple(readings[name] for name in names)
