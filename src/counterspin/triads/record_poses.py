"""Poses of the triad of a campaign: stated as readings, or detected in records."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from counterspin.campaign.conditions import reference_point
from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import PoseRecord, Reading
from counterspin.frozen import frozen
from counterspin.physics.conditions import stated_conditions
from counterspin.records.record import ColumnSpec, RecordColumns, RecordReport
from counterspin.triads.static_intervals import StaticIntervals, read_poses


@frozen(eq=False)
class RecordWithPoses:
    """A record with poses, and its rest intervals."""

    name: str  #: Name of the run.
    poses: StaticIntervals  #: Rest intervals, with forces in m/s^2.
    report: RecordReport  #: Report on reading the file.


@frozen(eq=False)
class LocatedPose:
    """A pose: the readings of all three accelerometers, and its position in a record."""

    pose: tuple[Reading, ...]  #: In the order of the triad's accelerometers.
    record: RecordWithPoses | None = None  #: Record with the pose; None: stated as readings.
    index: int = 0  #: Index among the poses of the record.

    @property
    def scatter_noise(self) -> float:
        """Standard deviation of the mean values if the rows are independent, m/s^2."""
        if self.record is None:
            return 0.0
        poses = self.record.poses
        return float(np.sqrt(np.mean(poses.scatter[self.index] ** 2) / poses.count[self.index]))


def campaign_poses(campaign: Campaign) -> list[LocatedPose]:
    """Return all poses of the triad of a campaign."""
    if campaign.triad is None:
        return []
    stated_poses = [LocatedPose(pose) for pose in campaign.triad.poses]
    return [
        *stated_poses,
        *(pose for record in campaign.triad.records for pose in extract_poses(campaign, record)),
    ]


def pooled_noise(poses: Sequence[LocatedPose], gravity: float) -> float:
    """Return the noise estimated within the poses of records, g; 0 without records."""
    noises = [pose.scatter_noise for pose in poses if pose.record is not None]
    return math.sqrt(sum(n**2 for n in noises) / len(noises)) / gravity if noises else 0.0


def pose_columns(campaign: Campaign, record: PoseRecord) -> RecordColumns:
    """Return the columns of a record with poses, and how its file is written."""
    dialect = record.dialect or campaign.dialect
    return RecordColumns(campaign.time, None, _force_columns(campaign), dialect)


def _force_columns(campaign: Campaign) -> dict[str, ColumnSpec]:
    """Return the specific-force columns of the accelerometers of the triad."""
    names = campaign.triad.accelerometers if campaign.triad else ()
    forces = {name: campaign.accelerometers[name].force for name in names}
    return {name: force for name, force in forces.items() if force is not None}


def extract_poses(campaign: Campaign, record: PoseRecord) -> Iterator[LocatedPose]:
    """Yield the poses of a record, each with its means as readings."""
    g, source = campaign.gravity.value, campaign.record_at(record.record)
    # Times within a record are known from its first row even if its start time is not.
    start_time = reference_point(campaign).time if record.time is None else record.time
    in_si = {name: not channel.in_g for name, channel in _force_columns(campaign).items()}
    columns = pose_columns(campaign, record)
    intervals, table = read_poses(source, columns, record.min_rest, record.threshold)
    source_record = RecordWithPoses(record.name, intervals, table.report)
    temperatures, mid_times = record.temperature, 0.5 * (intervals.start + intervals.end)
    knot_times = np.linspace(intervals.time[0], intervals.time[-1], len(temperatures or ()))
    rows = zip(intervals.start, mid_times, intervals.mean / g, strict=True)
    for index, (start, mid_time, mean) in enumerate(rows):
        conditions = stated_conditions(record)
        conditions["time"] = start_time + float(start - intervals.time[0])
        if temperatures:
            conditions["temperature"] = (float(np.interp(mid_time, knot_times, temperatures)),)
        pose = tuple(
            Reading(
                name=f"{record.name} {start:.6g} s",
                accelerometer=name,
                motion="static",
                mounting="",
                axes=campaign.accelerometers[name].mounting,
                rate=0.0,
                value=float(value),
                u=None if record.u is None else record.u / g,
                head=(0.0, 0.0, 0.0),
                u_head=0.0,
                **conditions,
                in_si=is_si,
            )
            for (name, is_si), value in zip(in_si.items(), mean, strict=True)
        )
        yield LocatedPose(pose, source_record, index)
