"""Readings and poses of a campaign, and its triad, as the description states them.

Extensions read them: `counterspin.readings` and `counterspin.triads`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Any, Final

from counterspin.campaign.documents import KeyPath
from counterspin.frozen import frozen
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.conditions import StatedConditions
from counterspin.physics.terms import MotionKind
from counterspin.records.dialect import Dialect

#: How many poses a record is taken to have before it is read.
MANY: Final = 1000


@frozen
class MeasuredRate:
    """The rate of a run that its recorded angle shows."""

    value: float  #: Root mean square over the rows used, with the sign of the sense, rad/s.
    u: float  #: Standard uncertainty, without the part of the recorder's clock, rad/s.


@frozen
class Reading(StatedConditions):
    """One reading of one accelerometer."""

    #: Of the run, whose it is, how the instrument moves, and the fixture's position (or empty).
    name: str
    accelerometer: str
    motion: MotionKind
    mounting: str
    axes: Mounting  #: In the frame of the motion.
    rate: float  #: Stated rate, rad/s.
    #: Random standard uncertainty of the stated rate, rad/s; None: not stated.
    u_rate: float | None = field(kw_only=True, default=None)
    #: Indication in g by the nominal sensitivity, and its standard uncertainty; None: not stated.
    #: Of a record, 0 and None until it is read; NaN where `BLANK` stands.
    value: float
    u: float | None
    #: Axis about which the dividing head turned, zero without one, shape (3,).
    head: tuple[float, float, float]
    u_head: float  #: Random standard uncertainty of the head's angle, rad.
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
    #: Whether its record has an angle, so that the recorder's clock measures the rate.
    by_clock: bool = False
    measured: MeasuredRate | None = None  #: The rate in its record; None: the stated one counts.
    #: Of a vibration: peak value, m/s^2, its random relative standard uncertainty, and the mean
    #: along the input axis beside gravity, m/s^2.
    amplitude: float = 0.0
    u_amplitude: float = 0.0
    bias_acceleration: float = 0.0


@frozen
class PoseRecord(StatedConditions):
    """A record of all three with many poses in it."""

    name: str  #: Of the run.
    record: Path  #: Absolute path.
    rest: float  #: Shortest rest that is a pose, s.
    threshold: float | None  #: Below which the sensor rests, m/s^2; None: found.
    u: float | None = None  #: Of each axis in a pose, m/s^2; None: not stated.
    dialect: Dialect | None = None  #: How its file is written; None: as the other records.


@frozen
class Triad:
    """Three accelerometers of one sensor, and its poses."""

    accelerometers: tuple[str, ...]  #: Their names.
    #: Each pose that was read: a reading of each accelerometer, its axes in the triad's frame.
    poses: tuple[tuple[Reading, ...], ...] = ()
    records: tuple[PoseRecord, ...] = ()  #: Records with poses.
    #: Accelerometer and symbol of the misalignments that are nothing by the choice of the frame,
    #: where nothing but poses says how the triad stands.
    of_frame: tuple[tuple[str, str], ...] = ()

    @property
    def count(self) -> int:
        """The number of poses; `MANY` if they are in records."""
        return len(self.poses) if not self.records else MANY

    @property
    def posed(self) -> bool:
        """True if there are poses of unknown attitude."""
        return bool(self.poses or self.records)


@frozen
class DescribedReadings:
    """Readings, poses and triad that a description states."""

    readings: tuple[Reading, ...] = ()  #: At known attitudes.
    triad: Triad | None = None
    whole: bool = True  #: Whether no reading has a mistake.
    #: Name of a run -> its table of true values, with the place.
    truths: Mapping[str, tuple[Mapping[str, Any], KeyPath]] = field(default_factory=dict)
    files: tuple[Path, ...] = ()  #: Of readings and of records that are readings.
    checksums: Mapping[Path, str] = field(default_factory=dict)  #: Of the files that were read.
