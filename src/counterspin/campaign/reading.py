"""Readings and poses of a campaign, and its triad, as the description states them.

The extensions `counterspin.readings` and `counterspin.triads` read them.
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

#: Assumed number of poses in a record that has not been read.
ASSUMED_POSE_COUNT: Final = 1000


@frozen
class MeasuredRate:
    """The rate of a run, measured from its recorded angle."""

    value: float  #: Root mean square over the used rows, with the sign of the rotation, rad/s.
    u: float  #: Standard uncertainty, without that of the recorder's clock, rad/s.


@frozen
class Reading(StatedConditions):
    """One reading of one accelerometer."""

    #: Names of run and accelerometer, motion of the instrument, position on the fixture (or empty).
    name: str
    accelerometer: str
    motion: MotionKind
    mounting: str
    axes: Mounting  #: Axes in the frame of the motion.
    rate: float  #: Stated rate, rad/s.
    #: Random standard uncertainty of the stated rate, rad/s; None: not stated.
    u_rate: float | None = field(kw_only=True, default=None)
    #: Indication in g by the nominal sensitivity, and its standard uncertainty; None: not stated.
    #: For a record, 0 and None until it is read; NaN for a `BLANK` cell.
    value: float
    u: float | None
    #: Axis of the dividing head's turn, shape (3,); zero without a turn.
    head: tuple[float, float, float]
    u_head: float  #: Random standard uncertainty of the head's angle, rad.
    record: Path | None = None  #: Record whose mean is the reading; None: the value is stated.
    duration: float | None = None  #: Length of a simulated record, s; None: not stated.
    repeats: int = 1  #: Number of repeats at one setting, of which the value is the mean.
    scatter: float = 0.0  #: Sum of squares of the repeats about their mean, g^2.
    resolution: float = 0.0  #: Step of the last digit, g; 0 for a record.
    #: Whether the value was stated in m/s^2, so that its value in g depends on gravity.
    in_si: bool = False
    #: Name of the position at rest, common to all readings with the same setting; empty if its
    #: positioning error does not matter.
    position: str = ""
    head_angle: float = 0.0  #: Indication of the dividing head, rad; 0 without one.
    #: Whether the record has an angle, so that the recorder's clock measures the rate.
    uses_recorder_clock: bool = False
    measured_rate: MeasuredRate | None = None  #: Rate in the record; None: the stated one.
    #: For a vibration: amplitude, m/s^2, its random relative standard uncertainty, and the mean
    #: specific force along the input axis in addition to gravity, m/s^2.
    amplitude: float = 0.0
    u_amplitude: float = 0.0
    bias_acceleration: float = 0.0


@frozen
class PoseRecord(StatedConditions):
    """A record of a triad with many poses."""

    name: str  #: Name of the run.
    record: Path  #: Absolute path.
    min_rest: float  #: Shortest rest interval that is used as a pose, s.
    threshold: float | None  #: Scatter below which the sensor rests, m/s^2; None: detected.
    u: float | None = None  #: Standard uncertainty of an axis in a pose, m/s^2; None: not stated.
    dialect: Dialect | None = None  #: Format of the file; None: that of the other records.


@frozen
class Triad:
    """Three accelerometers of one sensor, and its poses."""

    accelerometers: tuple[str, ...]  #: Names of the accelerometers.
    #: Pose -> reading of each accelerometer, with axes in the triad's frame.
    poses: tuple[tuple[Reading, ...], ...] = ()
    records: tuple[PoseRecord, ...] = ()  #: Records with poses.
    #: Accelerometer and symbol of the misalignments that are nothing by the choice of the frame,
    #: where nothing but poses says how the triad stands.
    frame_misalignments: tuple[tuple[str, str], ...] = ()

    @property
    def count(self) -> int:
        """The number of poses; `ASSUMED_POSE_COUNT` if they are in records."""
        return len(self.poses) if not self.records else ASSUMED_POSE_COUNT

    @property
    def has_poses(self) -> bool:
        """True if there are poses of unknown attitude."""
        return bool(self.poses or self.records)


@frozen
class DescribedReadings:
    """Readings, poses and triad that a description states."""

    readings: tuple[Reading, ...] = ()  #: Readings at known attitudes.
    triad: Triad | None = None
    is_complete: bool = True  #: Whether all readings are valid.
    #: Name of a run -> table of true values, with its key path.
    truths: Mapping[str, tuple[Mapping[str, Any], KeyPath]] = field(default_factory=dict)
    files: tuple[Path, ...] = ()  #: Files of readings, and records that are readings.
    checksums: Mapping[Path, str] = field(default_factory=dict)  #: File -> SHA-256.
