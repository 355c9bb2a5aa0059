"""Simulated record of poses: a triad rests, is turned by hand, and rests again."""

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

#: Duration of the motion from one pose to the next, s.
_MOTION_DURATION: Final = 1.5

#: Tremor of the hand during the motion: amplitude of each axis, g, and frequency range, Hz.
_TREMOR_AMPLITUDE: Final = 0.1
_TREMOR_FREQUENCIES: Final = (2.0, 6.0)

#: Number of rows in a chunk, which limits the memory for the products of all terms.
_CHUNK_ROWS: Final = 50_000

#: Sine of an angle below which two directions count as parallel or opposite.
_MIN_SINE: Final = 1e-6


def pose_duration(record: PoseRecord) -> float:
    """Return the duration of each pose of a simulated sensor, s.

    It is twice the requested duration plus the second that the search for rests needs.
    """
    return 2.0 * record.min_rest + 1.0


def record_duration(record: PoseRecord, n_poses: int) -> float:
    """Return the duration of a simulated record with a number of poses, s."""
    return n_poses * (pose_duration(record) + _MOTION_DURATION) - _MOTION_DURATION


def simulate_forces(
    record: PoseRecord, n_poses: int, sampling_rate: float, generator: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Return times, s, the specific force in the frame of the triad, g, and the directions at rest.

    The directions are uniformly distributed over the sphere. Between them, the triad moves along a
    great circle with smooth ends and the tremor of a hand.

    sampling_rate: Hz.

    Returns: shapes (n,), (n, 3) and (n_poses, 3).
    """
    directions = generator.standard_normal((n_poses, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    times = np.arange(sample_count(record_duration(record, n_poses), sampling_rate)) / sampling_rate
    interval = pose_duration(record) + _MOTION_DURATION
    pose_index = np.minimum((times / interval).astype(int), n_poses - 1)
    motion_progress = np.clip(
        (times - pose_index * interval - pose_duration(record)) / _MOTION_DURATION, 0.0, 1.0
    )
    turn_fraction = 0.5 * (1.0 - np.cos(np.pi * motion_progress))
    starts, ends = directions[pose_index], directions[np.minimum(pose_index + 1, n_poses - 1)]
    perpendiculars = _perpendicular_directions(starts, ends)
    angle = turn_fraction * np.arctan2(
        np.sum(perpendiculars * ends, axis=1), np.sum(starts * ends, axis=1)
    )
    force = np.cos(angle)[:, None] * starts + np.sin(angle)[:, None] * perpendiculars
    frequencies = generator.uniform(*_TREMOR_FREQUENCIES, 3)
    phase = generator.uniform(0.0, 2.0 * math.pi, 3)
    tremor = _TREMOR_AMPLITUDE * np.sin(2.0 * np.pi * frequencies * times[:, None] + phase)
    force += np.where((motion_progress > 0.0) & (motion_progress < 1.0), 1.0, 0.0)[:, None] * tremor
    return times, force, directions


def _perpendicular_directions(starts: Array, ends: Array) -> Array:
    """Return unit vectors perpendicular to the start directions, towards the end directions."""
    projection = ends - np.sum(starts * ends, axis=1)[:, None] * starts
    norm = np.linalg.norm(projection, axis=1)
    fallbacks = np.cross(starts, np.eye(3)[np.argmin(np.abs(starts), axis=1)])
    fallbacks /= np.linalg.norm(fallbacks, axis=1)[:, None]
    is_parallel = norm < _MIN_SINE
    directions: Array = np.where(
        is_parallel[:, None], fallbacks, projection / np.where(is_parallel, 1.0, norm)[:, None]
    )
    return directions


def indicated_forces(
    campaign: Campaign, record: PoseRecord, times: Array, force: Array
) -> dict[str, Array]:
    """Return the noiseless indication of each accelerometer of the triad, m/s^2, shape (n,).

    times, force: As in `simulate_forces`.
    """
    assert campaign.triad is not None
    assert campaign.simulation is not None
    names, truth = campaign.triad.accelerometers, campaign.simulation.truth.coefficients
    coefficients = [truth.get(name, {}) for name in names]
    axes = np.array([campaign.accelerometers[name].mounting.matrix for name in names])
    reference = reference_point(campaign)
    temperature_offsets = (
        np.array(record.temperature or (reference.temperature,)) - reference.temperature
    )
    knots = np.linspace(times[0], times[-1], len(temperature_offsets))
    start_time = 0.0 if record.time is None else record.time - reference.time
    chunks = []
    for start in range(0, len(times), _CHUNK_ROWS):
        chunk_times = times[start : start + _CHUNK_ROWS]
        chunk_size = len(chunk_times)
        poses = TriadPoses(
            accelerometers=names,
            names=("",) * chunk_size,
            axes=axes,
            gravity=campaign.site.gravity,
            value=np.zeros((chunk_size, 3)),
            u=None,
            conditions={
                **AT_REFERENCE.at(chunk_times, 0.0),
                "temperature": np.interp(chunk_times, knots, temperature_offsets),
                "time": start_time + chunk_times,
            },
            repeats=np.ones(chunk_size),
            scatter=np.zeros(chunk_size),
            in_si=np.zeros((chunk_size, 3)),
        )
        chunks.append(predict_indications(poses, coefficients, force[start : start + chunk_size]))
    forces = campaign.site.gravity * np.concatenate(chunks)
    return dict(zip(names, forces.T, strict=True))
