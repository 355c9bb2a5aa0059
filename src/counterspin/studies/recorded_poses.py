"""Records of poses in a study: each pose is read, with the noise of its mean, as often as drawn."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from counterspin.campaign.description import Campaign
from counterspin.campaign.noise_at_rest import true_noise
from counterspin.campaign.runs import is_pose
from counterspin.campaign.triad import PoseRecord
from counterspin.simulation.pose_record import record_seconds


def with_poses_read(document: Mapping[str, Any], campaign: Campaign) -> dict[str, Any]:
    """Return a description in which the poses of records are readings, whose values are drawn.

    campaign: As it describes it, with [simulation].
    """
    records = {one.name: one for one in campaign.triad.records} if campaign.triad else {}
    runs: list[Any] = []
    for run in document.get("runs", ()):
        record = records.get(run.get("name")) if is_pose(run) else None
        runs += [run] if record is None else _poses(record, campaign)
    return {**document, "runs": runs}


def _poses(record: PoseRecord, campaign: Campaign) -> Iterator[dict[str, Any]]:
    """Yield the poses of a record as runs."""
    assert campaign.simulation is not None
    assert campaign.triad is not None
    count = campaign.simulation.poses
    every = record_seconds(record, 2) - record_seconds(record, 1)
    reading = {}
    for name in campaign.triad.accelerometers:
        output = campaign.accelerometers[name].output
        unit, size = ("g", 1.0) if output is None else (output.unit, output.sensitivity)
        u = "" if record.u is None else f" ± {record.u / campaign.gravity.value * abs(size)!r}"
        reading[name] = f"?{u} {unit}"
    middles = (np.arange(count) + 0.5) / count
    for place, middle in enumerate(middles.tolist()):
        pose = {
            "name": f"{record.name} {place + 1}",
            "motion": "static",
            "attitude": "unknown",
            "reading": reading,
            "time": f"{(record.time or 0.0) + place * every!r} s",
        }
        if record.temperature is not None:
            knots = np.linspace(0.0, 1.0, len(record.temperature))
            pose["temperature"] = f"{float(np.interp(middle, knots, record.temperature))!r} K"
        yield pose


def with_noise_of_poses(campaign: Campaign, records: tuple[PoseRecord, ...]) -> Campaign:
    """Return a campaign whose poses have the true noise of means in such records."""
    assert campaign.simulation is not None
    assert campaign.triad is not None
    truth = campaign.simulation.truth
    # A record's rest is twice what is asked for, beside what the search for it takes.
    size = noise_of_mean(campaign, 2.0 * min(record.rest for record in records))
    noise = dict.fromkeys(campaign.triad.accelerometers, size) | dict(truth.reading_noise)
    known = replace(truth, reading_noise=noise)
    return replace(campaign, simulation=campaign.simulation.completed(truth=known))


def noise_of_mean(campaign: Campaign, seconds: float) -> float:
    """Return the true standard deviation of the mean of so much of a record, g."""
    assert campaign.simulation is not None
    noise, rate = true_noise(campaign), campaign.simulation.sampling_rate
    white = float(noise.specific_force) / math.sqrt(max(seconds * rate, 1.0))
    walk = float(noise.acceleration) / math.sqrt(max(seconds, 1.0 / rate))
    return math.hypot(white, walk) / campaign.gravity.value
