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
from counterspin.calibration.observed_runs import ObservedRun, add_recorded_conditions, observe
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
from counterspin.inference.noise.components import size_keys
from counterspin.inference.noise.model import Noise
from counterspin.planning.forecast import forecast
from counterspin.readings.fit import solve_readings
from counterspin.threads import single_blas_thread
from counterspin.triads.groups import group_poses
from counterspin.triads.record_poses import campaign_poses, pooled_noise


def add_pose_noise(campaign: Campaign) -> Campaign:
    """Return a campaign each of whose poses has a value and a standard uncertainty.

    Those of records are found in them; the noise of those that state none is that of their fit.
    """
    if campaign.triad is None:
        return campaign
    fitted_poses = campaign_poses(campaign)
    poses = [fitted.pose for fitted in fitted_poses]
    blank = any(math.isnan(reading.value) for pose in poses for reading in pose)
    if blank or all(reading.u is not None for pose in poses for reading in pose):
        return campaign
    *_, group = group_poses(campaign, poses, pooled_noise(fitted_poses, campaign.gravity.value))
    noise = solve_readings([group], make_unknowns(campaign)).groups[0].noise
    noisy = tuple(_set_noise(pose, noise) for pose in poses)
    return replace(campaign, triad=replace(campaign.triad, poses=noisy, records=()))


def _set_noise(pose: Sequence[Reading], noise: float) -> tuple[Reading, ...]:
    """Return a pose with a noise, of one repeat, where it states none."""
    if all(reading.u is not None for reading in pose):
        return tuple(pose)
    repeats = min(reading.repeats for reading in pose)
    return tuple(replace(reading, u=noise / math.sqrt(repeats)) for reading in pose)


def needs_records(campaign: Campaign, sampling_rate: float | None) -> bool:
    """Check that a forecast needs data beyond the description and that the records exist.

    sampling_rate: Hz, where it is known.
    """
    if not campaign.runs or campaign.simulation is not None:
        return False
    is_described = sampling_rate is not None and all(
        run.duration is not None for run in campaign.runs
    )
    is_recorded = all(run.record in campaign.frames or run.record.exists() for run in campaign.runs)
    return is_recorded and not (is_described and _unstated_noise(campaign) == set())


def apply_records(campaign: Campaign) -> tuple[Campaign, dict[str, float]]:
    """Return a campaign with the lengths and the noise of its records, and run -> rate, Hz."""
    campaign = add_recorded_conditions(campaign)
    observed_runs, noise = observe_with_noise(campaign)
    return apply_observations(campaign, observed_runs, noise), sampling_rates(observed_runs)


def observe_with_noise(campaign: Campaign) -> tuple[list[ObservedRun], dict[str, Noise]]:
    """Return a campaign's records, and the noise of each accelerometer that it leaves to them."""
    observed_runs = list(observe(campaign))
    if not _unstated_noise(campaign):
        return observed_runs, {}
    estimated, _ = estimate_campaign(JointProblem(campaign, observed_runs))
    return observed_runs, fitted_noise(estimated.fit)


def fitted_noise(fit: JointFit) -> dict[str, Noise]:
    """Return the noise that was found, with the random walk that may be there and not show."""
    undetected_levels = {name: level for name, (level, _) in fit.undetected_walks.items()}
    return {
        name: replace(
            noise, random_walk=math.hypot(noise.random_walk, undetected_levels.get(name, 0.0))
        )
        for name, noise in fit.noise.items()
    }


def sampling_rates(observed_runs: Sequence[ObservedRun]) -> dict[str, float]:
    """Return run -> samples a second, Hz."""
    return {run.run.name: 1.0 / run.record.report.step for run in observed_runs}


def apply_observations(
    campaign: Campaign, observed_runs: Sequence[ObservedRun], noise: Mapping[str, Noise]
) -> Campaign:
    """Return a campaign with the lengths of runs, and the noise, that it leaves to its records.

    noise: By accelerometer, as it was found; the largest counts, since a description has one.
    """
    seconds = {run.run.name: float(run.record.time[-1]) for run in observed_runs}
    runs = tuple(
        r.model_copy(update={"duration": seconds.get(r.name, r.duration)}) for r in campaign.runs
    )
    largest: dict[str, float] = {}
    for name, noise_sizes in noise.items():
        for component, key in size_keys(campaign.accelerometers[name].observable).items():
            largest[key] = max(getattr(noise_sizes, component), largest.get(key, 0.0))
    angles = [run.rotation.rms for run in observed_runs if run.rotation is not None]
    stated = campaign.noise or NoiseSettings()
    sizes = {key: largest.get(key, 0.0) for key in _unstated_noise(campaign)}
    if not stated.angle and angles:
        sizes["angle"] = max(angles)
    return replace(campaign, runs=runs, noise=stated.model_copy(update=sizes))


def _unstated_noise(campaign: Campaign) -> set[str]:
    """Return the components of noise that are left to the records."""
    stated = [stated_noise.sizes for stated_noise in resolve_noise(campaign).values()]
    return {
        key
        for key in StatedNoise.model_fields
        if any(sizes is None or isinstance(getattr(sizes, key), str) for sizes in stated)
    }


#: Attitudes that a double turntable is easily set to.
_SUGGESTED_ATTITUDES: Final = (
    "90 deg about east",
    "90 deg about north",
    "180 deg about east",
    "180 deg about north",
)

#: Runs are worth their time if they reduce u below this part of the u with fewer runs.
_MAX_REMAINING_FRACTION: Final = 0.8


@frozen
class SuggestedRuns:
    """Runs to be added, and the uncertainty with them."""

    attitude: str  #: Of all of them.
    runs: list[dict[str, Any]]  #: As in ``[[runs]]``.
    seconds: float  #: That their records take.
    u: float  #: Standard uncertainty of the coefficient then.
    u_without: float  #: And without them, by the same forecast.


@single_blas_thread()
def suggest_runs(
    campaign: Campaign, observed_runs: Sequence[ObservedRun], noise: Mapping[str, Noise], name: str
) -> SuggestedRuns | None:
    """Return the cheapest runs in another attitude that help a coefficient; None if none does.

    campaign: As it was read, all of its runs with records.
    noise: By accelerometer, as it was found.
    name: Of the coefficient, such as ``Qx.K_II``.
    """
    if not campaign.runs:
        return None
    rates = sampling_rates(observed_runs)

    def u_of(runs: Sequence[dict[str, Any]]) -> float:
        existing = list(require_source(campaign).document["runs"])
        new_campaign = campaign.change({"runs": [*existing, *runs]}) if runs else campaign
        highest = max(rates.values())
        run_rates = {run.name: rates.get(run.name, highest) for run in new_campaign.runs}
        return forecast(
            apply_observations(new_campaign, observed_runs, noise), sampling_rate=run_rates
        ).u[name]

    u_without = u_of(())
    best_suggestion: SuggestedRuns | None = None
    for attitude, runs in _candidate_runs(apply_observations(campaign, observed_runs, noise)):
        seconds = sum(float(run["duration"].split()[0]) for run in runs)
        try:
            u = u_of(runs)
        except NotIdentifiableError:
            continue
        candidate = SuggestedRuns(attitude, runs, seconds, u, u_without)
        is_longer = best_suggestion is not None and seconds > best_suggestion.seconds
        if u < _MAX_REMAINING_FRACTION * u_without and (
            best_suggestion is None
            or u < (_MAX_REMAINING_FRACTION if is_longer else 1.0) * best_suggestion.u
        ):
            best_suggestion = candidate
    return best_suggestion


def _candidate_runs(campaign: Campaign) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yield runs like those that there are, in other attitudes: the fastest, then all rates."""
    attitudes = [
        attitude
        for attitude in _SUGGESTED_ATTITUDES
        if not any(
            np.allclose(run.attitude, read_attitude_matrix(attitude)) for run in campaign.runs
        )
    ]
    runs = sorted(campaign.runs, key=lambda run: -abs(run.rate))
    by_rate = list({run.rate: run for run in reversed(runs)}.values())[::-1]
    for selection in ([runs[0]], by_rate)[: 1 + (len(by_rate) > 1)]:
        for attitude in attitudes:
            yield attitude, [_repeat_run(campaign, run, attitude) for run in selection]


def _repeat_run(campaign: Campaign, run: Run, attitude: str) -> dict[str, Any]:
    """Return a run as it is described that repeats another one in an attitude."""
    names = {existing.name for existing in campaign.runs}
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
