"""A simulated record of poses: a triad that rests, is turned by hand, and rests again."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.conditions import reference_point
from counterspin.campaign.description import Campaign
from counterspin.campaign.reading import PoseRecord
from counterspin.campaign.runs import sample_count
from counterspin.physics.conditions import AT_REFERENCE
from counterspin.triads.poses import TriadPoses, predict_indications

#: How long a hand takes from one pose to the next, s.
_MOTION: Final = 1.5

#: How it trembles meanwhile: size of each axis, g, and frequencies, Hz.
_TREMOR: Final = 0.1
_TREMOR_FREQUENCIES: Final = (2.0, 6.0)

#: Rows whose products of all terms are in memory at once.
_ROWS: Final = 50_000

#: Beside so small a sine of the angle between them two directions are opposite, or one.
_MIN_ANGLE: Final = 1e-6


def pose_seconds(record: PoseRecord) -> float:
    """Return the duration of each pose of a simulated sensor, s.

    It is twice the requested duration plus the second that the search for rests needs.
    """
    return 2.0 * record.rest + 1.0


def record_seconds(record: PoseRecord, poses: int) -> float:
    """Return the duration of a simulated record with a number of poses, s."""
    return poses * (pose_seconds(record) + _MOTION) - _MOTION


def simulate_forces(
    record: PoseRecord, poses: int, rate: float, generator: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Return times, s, the specific force in the triad's frame, g, and the directions at rest.

    The directions are drawn all over the sphere. From one to the next the triad is turned along the
    great circle, slowly at both ends, by a hand that trembles.

    rate: Samples a second, Hz.

    Returns: shapes (n,), (n, 3) and (poses, 3).
    """
    directions = generator.standard_normal((poses, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    time = np.arange(sample_count(record_seconds(record, poses), rate)) / rate
    interval = pose_seconds(record) + _MOTION
    pose_index = np.minimum((time / interval).astype(int), poses - 1)
    progress = np.clip((time - pose_index * interval - pose_seconds(record)) / _MOTION, 0.0, 1.0)
    fraction = 0.5 * (1.0 - np.cos(np.pi * progress))
    first, last = directions[pose_index], directions[np.minimum(pose_index + 1, poses - 1)]
    perpendicular = _perpendicular_directions(first, last)
    angle = fraction * np.arctan2(
        np.sum(perpendicular * last, axis=1), np.sum(first * last, axis=1)
    )
    force = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * perpendicular
    frequencies = generator.uniform(*_TREMOR_FREQUENCIES, 3)
    phase = generator.uniform(0.0, 2.0 * math.pi, 3)
    tremor = _TREMOR * np.sin(2.0 * np.pi * frequencies * time[:, None] + phase)
    force += np.where((progress > 0.0) & (progress < 1.0), 1.0, 0.0)[:, None] * tremor
    return time, force, directions


def _perpendicular_directions(first: Array, last: Array) -> Array:
    """Return unit vectors at right angles to the first ones, towards the last ones, (n, 3)."""
    projected = last - np.sum(first * last, axis=1)[:, None] * first
    size = np.linalg.norm(projected, axis=1)
    fallback = np.cross(first, np.eye(3)[np.argmin(np.abs(first), axis=1)])
    fallback /= np.linalg.norm(fallback, axis=1)[:, None]
    is_parallel = size < _MIN_ANGLE
    perpendicular: Array = np.where(
        is_parallel[:, None], fallback, projected / np.where(is_parallel, 1.0, size)[:, None]
    )
    return perpendicular


def indicated_forces(
    campaign: Campaign, record: PoseRecord, time: Array, force: Array
) -> dict[str, Array]:
    """Return the noiseless indication of each accelerometer of the triad, m/s^2, shape (n,).

    time, force: As in `simulate_forces`.
    """
    assert campaign.triad is not None
    assert campaign.simulation is not None
    names, truth = campaign.triad.accelerometers, campaign.simulation.truth.coefficients
    coefficients = [truth.get(name, {}) for name in names]
    axes = np.array([campaign.accelerometers[name].mounting.matrix for name in names])
    origin = reference_point(campaign)
    temperature_offsets = np.array(record.temperature or (origin.temperature,)) - origin.temperature
    knots = np.linspace(time[0], time[-1], len(temperature_offsets))
    start_time = 0.0 if record.time is None else record.time - origin.time
    values = []
    for first in range(0, len(time), _ROWS):
        chunk = time[first : first + _ROWS]
        n = len(chunk)
        rows = TriadPoses(
            accelerometers=names,
            names=("",) * n,
            axes=axes,
            gravity=campaign.site.gravity,
            value=np.zeros((n, 3)),
            u=None,
            conditions={
                **AT_REFERENCE.at(chunk, 0.0),
                "temperature": np.interp(chunk, knots, temperature_offsets),
                "time": start_time + chunk,
            },
            repeats=np.ones(n),
            scatter=np.zeros(n),
            in_si=np.zeros((n, 3)),
        )
        values.append(predict_indications(rows, coefficients, force[first : first + n]))
    forces = campaign.site.gravity * np.concatenate(values)
    return dict(zip(names, forces.T, strict=True))
