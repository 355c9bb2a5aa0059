"""The problem of the joint fit: unknowns (`model`), series and noise of a campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import Final

import numpy as np

from counterspin.calibration.model import make_unknowns
from counterspin.calibration.observed_runs import ObservedRun
from counterspin.campaign.accelerometers import Accelerometer
from counterspin.campaign.description import Campaign
from counterspin.campaign.settings import NOISE_UNITS, StatedNoise
from counterspin.frozen import frozen
from counterspin.inference.joint.series import ResidualSeries, TimestampErrors
from counterspin.inference.joint.time_stamps import find_timestamp_errors
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.components import BIAS_COMPONENTS
from counterspin.inference.noise.model import ESTIMATE, Noise
from counterspin.loading import load_name
from counterspin.physics import observation

#: The function that reads the noise of a campaign from a record at rest.
STATIC_NOISE_FUNCTION: Final = "counterspin.campaign.static_noise:resolve_noise"


@frozen(eq=False)
class JointProblem:
    """A campaign and its observed runs, for the joint fit."""

    campaign: Campaign  #: The description.
    observed_runs: Sequence[ObservedRun] = ()
    #: (owner, input) -> value used in `observed_runs` minus the stated value, SI.
    shifts: Mapping[tuple[str, str], float] = field(default_factory=dict)

    @cached_property
    def model(self) -> Unknowns:
        """The unknowns of the fit."""
        model = make_unknowns(self.campaign)
        if not self.shifts:
            return model
        unknowns = (
            replace(unknown, prior=(-self.shifts[key], unknown.prior[1]))
            if (key := (unknown.owner, unknown.symbol)) in self.shifts
            else unknown
            for unknown in model.unknowns
        )
        return replace(model, unknowns=tuple(unknowns))

    @cached_property
    def series(self) -> tuple[ResidualSeries, ...]:
        """The recorded series."""
        return make_series(self.campaign, self.observed_runs)

    @cached_property
    def noise(self) -> dict[str, Noise]:
        """The noise model of each accelerometer, with its stated components."""
        return make_noise(self.campaign)

    def accelerometer_series(self, name: str) -> list[ResidualSeries]:
        """Return the series of an accelerometer."""
        return [series for series in self.series if series.accelerometer == name]


def make_series(campaign: Campaign, runs: Sequence[ObservedRun]) -> tuple[ResidualSeries, ...]:
    """Return one series for each run and accelerometer, without missing samples."""
    timing_noise, encoder_noise = stated_timing_noise(campaign)
    series = []
    for run in runs:
        timestamp_errors = _timestamp_errors(run, timing_noise, encoder_noise)
        for name, signal in run.signals.items():
            is_finite = np.isfinite(signal.error)
            accelerometer = signal.accelerometer
            record_series = ResidualSeries(
                accelerometer=name,
                run=run.run.name,
                trajectory=run.trajectory,
                mounting=accelerometer.mounting,
                observable=accelerometer.observable,
                attitude=run.run.attitude,
                time=run.record.time[is_finite],
                time_sd=run.record.time_sd[is_finite],
                count=run.record.count[is_finite].astype(float),
                spacing=run.record.report.step,
                error=signal.error[is_finite],
                in_g=accelerometer.channel.in_g,
                angle_error=run.rotation.error if run.rotation else None,
                recorder=campaign.recording_of(run.run).recorder,
                latitude_sensitivity=None
                if signal.latitude_derivative is None
                else signal.latitude_derivative[is_finite],
                timestamp_errors=timestamp_errors and timestamp_errors.select(is_finite),
            )
            record_series = record_series.with_timestamp_noise(timing_noise)
            series.append(
                record_series.correct_times(timestamp_errors.prior[0])
                if timestamp_errors
                else record_series
            )
    return tuple(series)


def stated_timing_noise(campaign: Campaign) -> tuple[float, float]:
    """Return the stated noise of time stamps, s, and of the encoder, rad; 0: not stated."""
    noise = campaign.noise
    values = (noise.timing, noise.angle) if noise else (0.0, 0.0)
    timing_noise, encoder_noise = (value if isinstance(value, float) else 0.0 for value in values)
    return timing_noise, encoder_noise


def _timestamp_errors(
    run: ObservedRun, timing_noise: float, encoder_noise: float
) -> TimestampErrors | None:
    """Return the time-stamp errors of a run, as estimated from its recorded angle."""
    rotation, record = run.rotation, run.record
    if rotation is None:
        return None
    excess_variance = None
    if record.angle_sd is not None:
        angle_time_sd = record.angle_sd / abs(rotation.spindle.rate)
        excess_variance = np.nan_to_num(angle_time_sd**2 - record.time_sd**2)
    stated_noise = timing_noise, encoder_noise
    return find_timestamp_errors(rotation, record.time, record.count, stated_noise, excess_variance)


def make_noise(campaign: Campaign) -> dict[str, Noise]:
    """Return the noise model of each accelerometer: stated components, and those to estimate.

    In a record of specific force, the white noise of accelerometer and recorder is inseparable,
    so only one of the two is estimated.
    """
    if campaign.rest is None:
        return {
            name: _noise_model(campaign.noise, accelerometer)
            for name, accelerometer in campaign.accelerometers.items()
        }
    static_noise = load_name(STATIC_NOISE_FUNCTION)(campaign)
    return {
        name: replace(
            _noise_model(static_noise[name].sizes, accelerometer),
            covariance=static_noise[name].covariance,
        )
        for name, accelerometer in campaign.accelerometers.items()
    }


def _noise_model(noise: StatedNoise | None, accelerometer: Accelerometer) -> Noise:
    is_integrated = observation.ORDERS[accelerometer.observable] > 0
    unknown_noise = Noise(ESTIMATE, ESTIMATE if is_integrated else 0.0)
    if noise is None:
        return unknown_noise
    noise_sizes = {key: _size_or_estimate(size) for key, size in noise if key in NOISE_UNITS}
    if noise_sizes["quantisation"] is ESTIMATE:
        noise_sizes["quantisation"] = 0.0
    model = Noise.from_sizes(noise_sizes, accelerometer.observable)
    if not is_integrated and model.random_walk is ESTIMATE:
        model = replace(model, white=ESTIMATE, random_walk=0.0)
    # Rows without noise have no weights, so noise is estimated, except a random walk stated as 0.
    if not any((model.white, model.random_walk, model.quantisation)):
        default = Noise(ESTIMATE) if "acceleration" in noise.model_fields_set else unknown_noise
        return default.with_sizes({name: getattr(model, name) for name in BIAS_COMPONENTS})
    if noise.wanders and model.white == 0.0 and model.to_estimate:
        return replace(model, white=ESTIMATE)  # a bias drift comes with white noise
    return model


def _size_or_estimate(size: float | str) -> float:
    return size if isinstance(size, float) else ESTIMATE
