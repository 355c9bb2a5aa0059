"""Poses of a campaign's triad: those that were read, and those found in records."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from counterspin.campaign.conditions import origin_of
from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import PoseRecord, Reading
from counterspin.frozen import frozen
from counterspin.records.record import ColumnSpec, RecordColumns, RecordReport
from counterspin.triads.rests import Poses, read_poses


@frozen(eq=False)
class RecordOfPoses:
    """A record with poses in it, and what was found."""

    name: str  #: Of the run.
    poses: Poses  #: Where the triad lay still; forces in m/s^2.
    report: RecordReport  #: What the reading found.


@frozen(eq=False)
class FoundPose:
    """A pose: the readings of all three, and where it was found."""

    pose: tuple[Reading, ...]  #: In the order of the triad's accelerometers.
    record: RecordOfPoses | None = None  #: The record that it was found in; None: it was read.
    place: int = 0  #: Among the poses of the record.

    @property
    def noise_within(self) -> float:
        """Standard deviation of the means of a record if its rows are independent, m/s^2."""
        if self.record is None:
            return 0.0
        found = self.record.poses
        return float(np.sqrt(np.mean(found.scatter[self.place] ** 2) / found.count[self.place]))


def campaign_poses(campaign: Campaign) -> list[FoundPose]:
    """Return every pose of a campaign's triad."""
    if campaign.triad is None:
        return []
    read = [FoundPose(pose) for pose in campaign.triad.poses]
    return [
        *read,
        *(one for record in campaign.triad.records for one in found_in(campaign, record)),
    ]


def noise_within(poses: Sequence[FoundPose], gravity: float) -> float:
    """Return the noise estimated within the poses found in records, g."""
    within = [one.noise_within for one in poses if one.record is not None]
    return math.sqrt(sum(size**2 for size in within) / len(within)) / gravity if within else 0.0


def columns_of_poses(campaign: Campaign) -> RecordColumns:
    """Return the columns of records with poses, and how their files are written."""
    return RecordColumns(campaign.time, None, _channels(campaign), campaign.dialect)


def _channels(campaign: Campaign) -> dict[str, ColumnSpec]:
    """Return the columns of specific force of a triad's accelerometers."""
    names = campaign.triad.accelerometers if campaign.triad else ()
    forces = {name: campaign.accelerometers[name].force for name in names}
    return {name: force for name, force in forces.items() if force is not None}


def found_in(campaign: Campaign, record: PoseRecord) -> Iterator[FoundPose]:
    """Yield the poses of a record, each with its means as readings."""
    g, source = campaign.gravity.value, campaign.record_at(record.record)
    # Within a record times are known, from its first row, whether or not it says when it began.
    begun = origin_of(campaign).time if record.time is None else record.time
    in_si = {name: not channel.in_g for name, channel in _channels(campaign).items()}
    found, read = read_poses(source, columns_of_poses(campaign), record.rest, record.threshold)
    whole = RecordOfPoses(record.name, found, read.report)
    warm, middles = record.temperature, 0.5 * (found.start + found.end)
    knots = np.linspace(found.time[0], found.time[-1], len(warm or ()))
    every = zip(found.start, middles, found.mean / g, strict=True)
    for place, (start, middle, mean) in enumerate(every):
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
                temperature=warm and (float(np.interp(middle, knots, warm)),),
                time=begun + float(start - found.time[0]),
                in_si=si,
            )
            for (name, si), value in zip(in_si.items(), mean, strict=True)
        )
        yield FoundPose(pose, whole, place)
