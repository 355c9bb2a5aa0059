"""Recorded campaigns: forecasts with data from their records, and the gain of further runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.calibration.joint import estimate_campaign
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.model import make_unknowns
from counterspin.calibration.observed_runs import ObservedRun, add_recorded_conditions, observe_runs
from counterspin.campaign.description import Campaign
from counterspin.campaign.documents import require_source
from counterspin.campaign.quantity import read_attitude_matrix
from counterspin.campaign.reading import Reading
from counterspin.campaign.runs import Run
from counterspin.campaign.settings import NoiseSettings, StatedNoise
from counterspin.campaign.static_noise import resolve_noise
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.noise.components import component_keys
from counterspin.inference.noise.model import Noise
from counterspin.planning.forecast import forecast
from counterspin.readings.fit import solve_readings
from counterspin.threads import single_blas_thread
from counterspin.triads.groups import group_poses
from counterspin.triads.record_poses import campaign_poses, pooled_noise


def add_pose_noise(campaign: Campaign) -> Campaign:
    """Return a campaign whose poses all have a value and a standard uncertainty.

    Poses of records come from the records. Poses without a stated noise get the noise of the fit.
    """
    if campaign.triad is None:
        return campaign
    fitted_poses = campaign_poses(campaign)
    poses = [fitted_pose.pose for fitted_pose in fitted_poses]
    has_blank_values = any(math.isnan(reading.value) for pose in poses for reading in pose)
    if has_blank_values or all(reading.u is not None for pose in poses for reading in pose):
        return campaign
    *_, group = group_poses(campaign, poses, pooled_noise(fitted_poses, campaign.gravity.value))
    noise = solve_readings([group], make_unknowns(campaign)).groups[0].noise
    noisy_poses = tuple(_set_noise(pose, noise) for pose in poses)
    return replace(campaign, triad=replace(campaign.triad, poses=noisy_poses, records=()))


def _set_noise(pose: Sequence[Reading], noise: float) -> tuple[Reading, ...]:
    """Return a pose with the noise of one repeat if it does not state its noise."""
    if all(reading.u is not None for reading in pose):
        return tuple(pose)
    repeats = min(reading.repeats for reading in pose)
    return tuple(replace(reading, u=noise / math.sqrt(repeats)) for reading in pose)


def needs_records(campaign: Campaign, sampling_rate: float | None) -> bool:
    """Check that a forecast needs data beyond the description and that the records exist.

    sampling_rate: Hz; None if unknown.
    """
    if not campaign.runs or campaign.simulation is not None:
        return False
    has_described_runs = sampling_rate is not None and all(
        run.duration is not None for run in campaign.runs
    )
    has_records = all(run.record in campaign.frames or run.record.exists() for run in campaign.runs)
    return has_records and not (has_described_runs and _unstated_noise_keys(campaign) == set())


def apply_records(campaign: Campaign) -> tuple[Campaign, dict[str, float]]:
    """Return a campaign with durations and noise from its records, and sampling rates by run."""
    campaign = add_recorded_conditions(campaign)
    observed_runs, noise = observe_with_noise(campaign)
    return apply_observations(campaign, observed_runs, noise), sampling_rates(observed_runs)


def observe_with_noise(campaign: Campaign) -> tuple[list[ObservedRun], dict[str, Noise]]:
    """Return the records of a campaign, and the noise by accelerometer if it is not stated."""
    observed_runs = list(observe_runs(campaign))
    if not _unstated_noise_keys(campaign):
        return observed_runs, {}
    estimate, _ = estimate_campaign(JointProblem(campaign, observed_runs))
    return observed_runs, fitted_noise(estimate.fit)


def fitted_noise(fit: JointFit) -> dict[str, Noise]:
    """Return the estimated noise, including random walks below the detection limit."""
    undetected_levels = {name: level for name, (level, _) in fit.undetected_walks.items()}
    return {
        name: replace(
            noise, random_walk=math.hypot(noise.random_walk, undetected_levels.get(name, 0.0))
        )
        for name, noise in fit.noise.items()
    }


def sampling_rates(observed_runs: Sequence[ObservedRun]) -> dict[str, float]:
    """Return the sampling rates by run, Hz."""
    return {run.run.name: 1.0 / run.record.report.step for run in observed_runs}


def apply_observations(
    campaign: Campaign, observed_runs: Sequence[ObservedRun], noise: Mapping[str, Noise]
) -> Campaign:
    """Return a campaign with durations and noise from its records where it does not state them.

    noise: Estimated noise by accelerometer; the largest is used, because a description has one.
    """
    durations = {run.run.name: float(run.record.time[-1]) for run in observed_runs}
    runs = tuple(
        run.model_copy(update={"duration": durations.get(run.name, run.duration)})
        for run in campaign.runs
    )
    max_sizes: dict[str, float] = {}
    for name, noise_sizes in noise.items():
        for component, key in component_keys(campaign.accelerometers[name].observable).items():
            max_sizes[key] = max(getattr(noise_sizes, component), max_sizes.get(key, 0.0))
    angle_rms = [run.rotation.rms for run in observed_runs if run.rotation is not None]
    stated_noise = campaign.noise or NoiseSettings()
    sizes = {key: max_sizes.get(key, 0.0) for key in _unstated_noise_keys(campaign)}
    if not stated_noise.angle and angle_rms:
        sizes["angle"] = max(angle_rms)
    return replace(campaign, runs=runs, noise=stated_noise.model_copy(update=sizes))


def _unstated_noise_keys(campaign: Campaign) -> set[str]:
    """Return the keys of the noise components that the campaign does not state."""
    stated_sizes = [stated_noise.sizes for stated_noise in resolve_noise(campaign).values()]
    return {
        key
        for key in StatedNoise.model_fields
        if any(sizes is None or isinstance(getattr(sizes, key), str) for sizes in stated_sizes)
    }


#: Attitudes that are easy to set on a double turntable.
_SUGGESTED_ATTITUDES: Final = (
    "90 deg about east",
    "90 deg about north",
    "180 deg about east",
    "180 deg about north",
)

#: Further runs must reduce u below this fraction of u with fewer runs.
_MAX_U_RATIO: Final = 0.8


@frozen
class SuggestedRuns:
    """Suggested runs, and the standard uncertainty with and without them."""

    attitude: str  #: Attitude of all suggested runs.
    runs: list[dict[str, Any]]  #: Entries of ``[[runs]]``.
    seconds: float  #: Total duration of their records, s.
    u: float  #: Forecast standard uncertainty of the coefficient with the runs.
    u_without_runs: float  #: Forecast standard uncertainty without the runs.


@single_blas_thread()
def suggest_runs(
    campaign: Campaign, observed_runs: Sequence[ObservedRun], noise: Mapping[str, Noise], name: str
) -> SuggestedRuns | None:
    """Return the shortest runs in another attitude that reduce u of a coefficient; None if none do.

    campaign: Campaign with records of all runs.
    noise: Estimated noise by accelerometer.
    name: Name of the coefficient, such as ``Qx.K_II``.
    """
    if not campaign.runs:
        return None
    rate_by_run = sampling_rates(observed_runs)

    def forecast_u(runs: Sequence[dict[str, Any]]) -> float:
        existing_runs = list(require_source(campaign).document["runs"])
        new_campaign = campaign.change({"runs": [*existing_runs, *runs]}) if runs else campaign
        highest_rate = max(rate_by_run.values())
        new_rates = {run.name: rate_by_run.get(run.name, highest_rate) for run in new_campaign.runs}
        return forecast(
            apply_observations(new_campaign, observed_runs, noise), sampling_rate=new_rates
        ).u[name]

    u_without_runs = forecast_u(())
    best: SuggestedRuns | None = None
    for attitude, runs in _candidate_runs(apply_observations(campaign, observed_runs, noise)):
        seconds = sum(float(run["duration"].split()[0]) for run in runs)
        try:
            u = forecast_u(runs)
        except NotIdentifiableError:
            continue
        candidate = SuggestedRuns(attitude, runs, seconds, u, u_without_runs)
        is_longer = best is not None and seconds > best.seconds
        if u < _MAX_U_RATIO * u_without_runs and (
            best is None or u < (_MAX_U_RATIO if is_longer else 1.0) * best.u
        ):
            best = candidate
    return best


def _candidate_runs(campaign: Campaign) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yield repeated runs in other attitudes: first of the fastest run, then of all rates."""
    attitudes = [
        attitude
        for attitude in _SUGGESTED_ATTITUDES
        if not any(
            np.allclose(run.attitude, read_attitude_matrix(attitude)) for run in campaign.runs
        )
    ]
    runs = sorted(campaign.runs, key=lambda run: -abs(run.rate))
    runs_by_rate = list({run.rate: run for run in reversed(runs)}.values())[::-1]
    for selection in ([runs[0]], runs_by_rate)[: 1 + (len(runs_by_rate) > 1)]:
        for attitude in attitudes:
            yield attitude, [_describe_repeated_run(campaign, run, attitude) for run in selection]


def _describe_repeated_run(campaign: Campaign, run: Run, attitude: str) -> dict[str, Any]:
    """Return the description of a run that repeats another run in an attitude."""
    names = {other_run.name for other_run in campaign.runs}
    name = next(
        name
        for index in range(1, len(names) + 2)
        if (name := f"{run.name} turned{'' if index == 1 else f' {index}'}") not in names
    )
    return {
        "name": name,
        "rate": f"{run.rate:.9g} rad/s",
        "attitude": attitude,
        "duration": f"{run.duration:.6g} s",
        "record": f"{name.replace(' ', '-')}{Path(run.record).suffix}",
    }
