"""Records whose means are readings: at rest, and on an arm, with the recorded angle.

The mean of R w^2 is R times the mean of w^2, so the reading belongs to the root mean square of the
rate, including drift and ripple. The variance of w^2, which acts through K_II, is neglected: a
ripple of 1e-3 adds 2e-6 of the squared force.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.observed_runs import duplicate_record_error, fit_rotation
from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import MeasuredRate, Reading
from counterspin.errors import ConvergenceError, NotIdentifiableError, RecordError
from counterspin.frozen import frozen
from counterspin.physics.spindle import SpindleFit
from counterspin.readings.means import (
    RecordMean,
    RowRotation,
    mean_of_record,
    read_rows,
    stated_rotation,
)
from counterspin.records.column_file import Chunk
from counterspin.records.record import Record, RecordColumns
from counterspin.records.reduction import BlockAverager, BlockMeans, block_size


@frozen(eq=False)
class AveragedRecord:
    """A record whose mean is a reading."""

    reading: Reading  #: Reading with the mean as its value, and the measured rate.
    mean: RecordMean  #: Mean of the record.
    record: Record  #: All rows of the record.
    rotation: SpindleFit | None = None  #: Fit of the recorded angle; None: at rest, or no angle.


@frozen(eq=False)
class MeanRecords:
    """Means and rates of the averaged records."""

    #: (accelerometer, reading) -> mean.
    means: Mapping[tuple[str, str], RecordMean] = field(default_factory=dict)
    #: Run on the arm -> rate from the recorded angle, and stated rate, rad/s.
    rates: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    without_angle: tuple[str, ...] = ()  #: Runs on the arm without a recorded angle.


def average_records(campaign: Campaign) -> tuple[list[Reading], MeanRecords]:
    """Return the readings of a campaign with values from their records, and the means."""
    readings: list[Reading] = []
    means: dict[tuple[str, str], RecordMean] = {}
    rates: dict[str, tuple[float, float]] = {}
    without_angle: list[str] = []
    first_readings: dict[bytes, Reading] = {}
    for reading in campaign.readings:
        if reading.record is None:
            readings.append(reading)
            continue
        averaged_record = average_record(campaign, reading)
        digest = averaged_record.mean.digest
        first_reading = first_readings.setdefault(digest, reading) if digest else reading
        if first_reading.name != reading.name:
            raise duplicate_record_error(campaign, first_reading, reading)
        readings.append(averaged_record.reading)
        means[reading.accelerometer, reading.name] = averaged_record.mean
        if averaged_record.reading.measured_rate is not None:
            rates[reading.name] = averaged_record.reading.measured_rate.value, reading.rate
        elif reading.rate:
            without_angle.append(reading.name)
    return readings, MeanRecords(means, rates, tuple(dict.fromkeys(without_angle)))


def average_record(campaign: Campaign, reading: Reading) -> AveragedRecord:
    """Return the mean of the record of a reading, and the rotation from the recorded angle."""
    assert reading.record is not None
    channel = campaign.accelerometers[reading.accelerometer].force
    assert channel is not None
    record_source = campaign.record_at(reading.record)
    columns = RecordColumns(
        campaign.time,
        campaign.angle if reading.uses_recorder_clock else None,
        {reading.accelerometer: channel},
        campaign.dialect,
        needs_angle=False,
    )
    record = read_rows(record_source, columns, reading.rate)
    rotation, row_rotation = None, stated_rotation(record.time, reading.rate)
    if record.angle is not None:
        rotation = _fit_record_rotation(campaign, reading, record)
        row_rotation = _row_rotation(campaign, reading, rotation, record.time)
    mean, rows = mean_of_record(record, channel.name, row_rotation)
    measured_rate = None
    if rotation is not None:
        measured_rate = MeasuredRate(*rotation.rate_at(record.time[rows]))
    # The conversion from g or by a sensitivity to m/s^2 used the assumed gravity; it is reversed.
    g, in_si = campaign.gravity.value, not channel.in_g
    reading = replace(
        reading,
        value=mean.value / g,
        u=mean.u / g,
        in_si=in_si,
        uses_recorder_clock=rotation is not None,
        measured_rate=measured_rate,
    )
    return AveragedRecord(reading, mean, record, rotation)


def _fit_record_rotation(campaign: Campaign, reading: Reading, record: Record) -> SpindleFit:
    """Return the rotation identified from block means of the recorded angle."""
    blocks = _angle_blocks(record, reading.rate)
    assert blocks.angle is not None
    try:
        return fit_rotation(
            campaign, blocks.time, blocks.angle, reading.rate, blocks.count, blocks.time_sd
        )
    except (NotIdentifiableError, ConvergenceError) as error:
        raise RecordError(f"{record.report.path}: {error}", code=error.code) from None


def _angle_blocks(record: Record, rate: float) -> BlockMeans:
    """Return the block means of times and angles, as for records of the double turntable."""
    step = record.report.step
    averager = BlockAverager(block_size(step, rate), step, rate, reject_outliers=False)
    max_relative_deviation = float(np.abs(np.diff(record.time) / step - 1.0).max(initial=0.0))
    return averager.average(Chunk(record.time, record.angle, []), max_relative_deviation).blocks


def _row_rotation(
    campaign: Campaign, reading: Reading, rotation: SpindleFit, time: Array
) -> RowRotation:
    """Return the rotation of an arm at times, s, with the nominal output."""
    spindle = rotation.spindle
    outward = float(reading.axes.input_axis[0])
    centripetal = -outward * campaign.radius.value * spindle.angular_rate(time) ** 2
    # A ripple below the noise of the angle may exceed the noise of the output.
    max_harmonic = max(rotation.error.harmonics, default=0)
    return RowRotation(spindle.angle(time), centripetal, max_harmonic)
