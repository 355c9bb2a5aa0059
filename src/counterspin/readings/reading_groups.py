"""Groups of readings and poses of an accelerometer."""

from __future__ import annotations

from typing import cast

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.readings.fitted import FittedReadings


def groups_of_view(view: AccelerometerView) -> tuple[FittedReadings, ...]:
    """Return the groups of readings and poses of an accelerometer, poses last."""
    return cast("tuple[FittedReadings, ...]", view.groups)


def reading_groups(view: AccelerometerView) -> tuple[FittedReadings, ...]:
    """Return the groups of readings at known attitudes."""
    return tuple(group for group in groups_of_view(view) if not group.readings.triad)


def pose_groups(view: AccelerometerView) -> tuple[FittedReadings, ...]:
    """Return the groups of poses."""
    return tuple(group for group in groups_of_view(view) if group.readings.triad)
