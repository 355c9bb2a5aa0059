"""Simulated records of a three-axis sensor that rests in many poses."""

from __future__ import annotations

import numpy as np

import triads
from counterspin.arrays import Array
from counterspin.frozen import frozen

STEP = 0.01
NOISE = 0.02


@frozen(eq=False)
class PosedRecord:
    """Contain a record of k rests and its true forces."""

    time: Array
    values: Array  #: m/s^2, shape (n, 3).
    start: Array
    end: Array
    force: Array  #: Of each rest, m/s^2, shape (k, 3).


def simulate_poses(
    rest_duration: float, motion: float, count: int = 12, noise: float = NOISE, seed: int = 1
) -> PosedRecord:
    """Return static intervals of `rest_duration` s with `motion` s of motion between them."""
    rng = np.random.default_rng(seed)
    force = rng.normal(size=(count, 3))
    force *= 9.81 / np.linalg.norm(force, axis=1)[:, None]
    n_rest, n_motion = round(rest_duration / STEP), round(motion / STEP)
    segments = []
    for index in range(count):
        segments.append(np.tile(force[index], (n_rest, 1)))
        if index + 1 < count:
            fraction = (1.0 - np.cos(np.pi * np.arange(1, n_motion + 1) / (n_motion + 1.0))) / 2.0
            path = force[index] + fraction[:, None] * (force[index + 1] - force[index])
            # A hand trembles at some hertz, and is not straight.
            angle = 2.0 * np.pi * 4.0 * STEP * np.arange(n_motion)[:, None] + rng.uniform(0, 6, 3)
            segments.append(path + 2.0 * np.sin(angle))
    values = np.concatenate(segments)
    start = np.arange(count) * (n_rest + n_motion) * STEP
    return PosedRecord(
        time=np.arange(len(values)) * STEP,
        values=values + noise * rng.normal(size=values.shape),
        start=start,
        end=start + (n_rest - 1) * STEP,
        force=force,
    )


def write_campaign(folder, records, more=""):
    """Write a campaign of records of poses, name -> `Posed`, with the truth of `triads`; in g."""
    folder.mkdir(parents=True, exist_ok=True)
    text = triads.format_description('records = { time = { sampling_rate = "100 Hz" } }\n')
    for index, name in enumerate(triads.NAMES, 1):
        column = f'specific_force = {{ column = "column {index}", unit = "g" }}\n'
        text = text.replace(
            triads.format_accelerometer(name), triads.format_accelerometer(name, column)
        )
    for name, record in records.items():
        text += f'[[runs]]\nname = "{name}"\nmotion = "static"\nattitude = "unknown"\n'
        text += f'record = "{name}.log"\n'
        if record is not None:
            (folder / f"{name}.log").write_text(make_log(record), "utf-8")
    (folder / "campaign.toml").write_text(text + more, "utf-8")
    return folder


def make_log(record):
    """Return the lines of a logger, by `triads.compute_indications` of its forces in g."""
    rows = triads.compute_indications(record.values / 9.81)
    return "".join(f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in rows.tolist())
