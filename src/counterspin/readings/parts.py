"""Groups of readings and poses of an accelerometer."""

from __future__ import annotations

from typing import cast

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.readings.fitted import FittedReadings


def parts_of(view: AccelerometerView) -> tuple[FittedReadings, ...]:
    """Return the groups of readings and poses of an accelerometer, poses last."""
    return cast("tuple[FittedReadings, ...]", view.groups)


def readings_of(view: AccelerometerView) -> tuple[FittedReadings, ...]:
    """Return the groups of readings at known attitudes."""
    return tuple(part for part in parts_of(view) if not part.readings.triad)


def poses_of(view: AccelerometerView) -> tuple[FittedReadings, ...]:
    """Return the groups of poses."""
    return tuple(part for part in parts_of(view) if part.readings.triad)
