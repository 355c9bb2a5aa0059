"""A campaign that is recorded, as a forecast needs it: with what its records say."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from counterspin.calibration.joint import estimate_campaign
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.observed import ObservedRun, observe, with_recorded_temperatures
from counterspin.campaign.description import Campaign
from counterspin.campaign.noise_at_rest import said_noise
from counterspin.campaign.settings import NoiseSettings, StatedNoise
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.noise.model import Noise


def lacks(campaign: Campaign, sampling_rate: float | None) -> bool:
    """Return whether a forecast needs more than the description says, and the records are there.

    sampling_rate: Hz, where it is known.
    """
    if not campaign.runs or campaign.simulation is not None:
        return False
    known = sampling_rate is not None and all(run.duration is not None for run in campaign.runs)
    there = all(run.record in campaign.frames or run.record.exists() for run in campaign.runs)
    return there and not (known and _to_be_found(campaign) == set())


def from_records(campaign: Campaign) -> tuple[Campaign, dict[str, float]]:
    """Return a campaign with the lengths and the noise of its records, and run -> rate, Hz."""
    campaign = with_recorded_temperatures(campaign)
    observed, noise = observed_with_noise(campaign)
    return as_recorded(campaign, observed, noise), rates_of(observed)


def observed_with_noise(campaign: Campaign) -> tuple[list[ObservedRun], dict[str, Noise]]:
    """Return a campaign's records, and the noise of each accelerometer that it leaves to them."""
    observed = list(observe(campaign))
    if not _to_be_found(campaign):
        return observed, {}
    estimated, _ = estimate_campaign(JointProblem(campaign, observed))
    return observed, noise_of_fit(estimated.fit)


def noise_of_fit(fit: JointFit) -> dict[str, Noise]:
    """Return the noise that was found, with the random walk that may be there and not show."""
    hidden = {name: level for name, (level, _) in fit.unseen.items()}
    return {
        name: replace(noise, random_walk=math.hypot(noise.random_walk, hidden.get(name, 0.0)))
        for name, noise in fit.noise.items()
    }


def rates_of(observed: Sequence[ObservedRun]) -> dict[str, float]:
    """Return run -> samples a second, Hz."""
    return {one.run.name: 1.0 / one.record.report.step for one in observed}


def as_recorded(
    campaign: Campaign, observed: Sequence[ObservedRun], noise: Mapping[str, Noise]
) -> Campaign:
    """Return a campaign with the lengths of runs, and the noise, that it leaves to its records.

    noise: By accelerometer, as it was found; the largest counts, since a description has one.
    """
    seconds = {one.run.name: float(one.record.time[-1]) for one in observed}
    runs = tuple(
        r.model_copy(update={"duration": seconds.get(r.name, r.duration)}) for r in campaign.runs
    )
    found: dict[str, float] = {}
    for name, one in noise.items():
        sizes = {
            campaign.accelerometers[name].observable: one.white,
            "acceleration": one.random_walk,
            "flicker": one.flicker,
            "bias_walk": one.bias_walk,
        }
        for key, size in sizes.items():
            found[key] = max(size, found.get(key, 0.0))
    angles = [one.rotation.rms for one in observed if one.rotation is not None]
    stated = campaign.noise or NoiseSettings()
    sizes = {key: found.get(key, 0.0) for key in _to_be_found(campaign)}
    if not stated.angle and angles:
        sizes["angle"] = max(angles)
    return replace(campaign, runs=runs, noise=stated.model_copy(update=sizes))


def _to_be_found(campaign: Campaign) -> set[str]:
    """Return the components of noise that are left to the records."""
    said = [one.sizes for one in said_noise(campaign).values()]
    return {
        key
        for key in StatedNoise.model_fields
        if any(sizes is None or isinstance(getattr(sizes, key), str) for sizes in said)
    }
