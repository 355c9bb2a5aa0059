"""What a record is: the columns of its file, the motion it was taken on, and the samples read.

- `ColumnSpec`, `RecordColumns`: columns of a file and their units
- `StatedMotion`: what the campaign says of the run
- `Record`: point samples or block means, in SI units
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field

import numpy as np

from counterspin.frozen import frozen
from counterspin.input import FileIdentity
from counterspin.records.amplitude import Swing
from counterspin.records.report import RecordReport


@frozen
class ColumnSpec:
    """A column of a record file: its name and the factor that turns its unit into SI."""

    name: str
    factor: float = 1.0


@frozen
class RecordColumns:
    """Which columns of a file hold what.

    Attributes
    ----------
    time, angle
        Time and spindle angle (wrapped or not), or no angle.
    signals
        By accelerometer.
    """

    time: ColumnSpec
    angle: ColumnSpec | None
    signals: Mapping[str, ColumnSpec]

    @property
    def names(self) -> list[str]:
        """The columns to be read, each once."""
        specs = [self.time, *([self.angle] if self.angle else []), *self.signals.values()]
        return list(dict.fromkeys(spec.name for spec in specs))


@frozen
class StatedMotion:
    """The stated motion of a run, against which its record is checked.

    Attributes
    ----------
    rate
        rad/s; negative turns from north to east.
    swings
        Accelerometer -> the wave that the motion puts into its signal; those without are not
        checked against it.
    """

    rate: float
    swings: Mapping[str, Swing] = field(default_factory=dict)


@frozen
class Record:
    """One run: point samples or block means, in SI units. Arrays (n,).

    Attributes
    ----------
    time
        s since the first sample; of a block, the mean time of its samples.
    angle
        rad, unwrapped; None when the file has no angle column.
    signals
        Accelerometer -> displacement, velocity or specific force (m, m/s, m/s^2); NaN where that
        accelerometer has no good sample.
    count
        Samples in each block; 1 is a point sample.
    time_sd
        s, standard deviation of the times inside each block; 0 for a point.
    start_time
        s, the first sample's time in the file's own clock.
    report
        What was found.
    identity
        Which file it was read from; None of a record in memory.
    """

    time: np.ndarray
    angle: np.ndarray | None
    signals: dict[str, np.ndarray]
    count: np.ndarray
    time_sd: np.ndarray
    start_time: float
    report: RecordReport
    identity: FileIdentity | None
