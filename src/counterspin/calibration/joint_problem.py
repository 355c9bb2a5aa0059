"""The joint fit's problem: a campaign's unknowns (of `model`), series and noise."""

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
from counterspin.inference.joint.time_stamps import find_stamp_errors
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.components import BIAS_COMPONENTS
from counterspin.inference.noise.model import ESTIMATE, Noise
from counterspin.loading import load_name
from counterspin.physics import observation

#: The function that reads the noise of a campaign from a record at rest.
STATIC_NOISE: Final = "counterspin.campaign.static_noise:resolve_noise"


@frozen(eq=False)
class JointProblem:
    """A campaign and what was recorded of it, as the joint fit takes both."""

    campaign: Campaign  #: The description.
    observed: Sequence[ObservedRun] = ()  #: Its runs.
    #: (owner, input) -> deviation of its value in `observed` from the stated one, SI.
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
        return make_series(self.campaign, self.observed)

    @cached_property
    def noise(self) -> dict[str, Noise]:
        """The noise of each accelerometer, as far as it is stated."""
        return make_noise(self.campaign)

    def accelerometer_series(self, name: str) -> list[ResidualSeries]:
        """Return the series of an accelerometer."""
        return [
            record_series for record_series in self.series if record_series.accelerometer == name
        ]


def make_series(campaign: Campaign, observed: Sequence[ObservedRun]) -> tuple[ResidualSeries, ...]:
    """Return one series for each run and accelerometer, missing samples left out."""
    timing, encoder_noise = stated_timing_noise(campaign)
    series = []
    for run in observed:
        timestamp_errors = _timestamp_errors(run, timing, encoder_noise)
        for name, signal in run.signals.items():
            valid = np.isfinite(signal.error)
            accelerometer = signal.accelerometer
            record_series = ResidualSeries(
                accelerometer=name,
                run=run.run.name,
                trajectory=run.trajectory,
                mounting=accelerometer.mounting,
                observable=accelerometer.observable,
                attitude=run.run.attitude,
                time=run.record.time[valid],
                time_sd=run.record.time_sd[valid],
                count=run.record.count[valid].astype(float),
                spacing=run.record.report.step,
                error=signal.error[valid],
                in_g=accelerometer.channel.in_g,
                angle_error=run.rotation.error if run.rotation else None,
                recorder=campaign.recording_of(run.run).recorder,
                latitude_sensitivity=None
                if signal.latitude_derivative is None
                else signal.latitude_derivative[valid],
                timestamp_errors=timestamp_errors and timestamp_errors.select(valid),
            )
            record_series = record_series.with_timestamp_noise(timing)
            series.append(
                record_series.correct_times(timestamp_errors.prior[0])
                if timestamp_errors
                else record_series
            )
    return tuple(series)


def stated_timing_noise(campaign: Campaign) -> tuple[float, float]:
    """Return the stated noise of time stamps, s, and of the encoder, rad; 0: not stated."""
    noise = campaign.noise
    sizes = (noise.timing, noise.angle) if noise else (0.0, 0.0)
    timing, angle = (size if isinstance(size, float) else 0.0 for size in sizes)
    return timing, angle


def _timestamp_errors(
    run: ObservedRun, timing: float, encoder_noise: float
) -> TimestampErrors | None:
    """Return the errors of the time stamps of a run that its recorded angle shows."""
    rotation, record = run.rotation, run.record
    if rotation is None:
        return None
    widening = None
    if record.angle_sd is not None:
        time_sd_of_angle = record.angle_sd / abs(rotation.spindle.rate)
        widening = np.nan_to_num(time_sd_of_angle**2 - record.time_sd**2)
    stated = timing, encoder_noise
    return find_stamp_errors(rotation, record.time, record.count, stated, widening)


def make_noise(campaign: Campaign) -> dict[str, Noise]:
    """Return each accelerometer's noise, as far as it is stated.

    Without [noise], or where it says nothing of an accelerometer's record, all is wanted. In
    a record of specific force the accelerometer's white noise cannot be told from that of the
    record: only one of the two is estimated.
    """
    if campaign.rest is None:
        return {
            name: _noise_model(campaign.noise, accelerometer)
            for name, accelerometer in campaign.accelerometers.items()
        }
    stated = load_name(STATIC_NOISE)(campaign)
    return {
        name: replace(
            _noise_model(stated[name].sizes, accelerometer), covariance=stated[name].covariance
        )
        for name, accelerometer in campaign.accelerometers.items()
    }


def _noise_model(noise: StatedNoise | None, accelerometer: Accelerometer) -> Noise:
    integrated = observation.ORDERS[accelerometer.observable] > 0
    unknown_noise = Noise(ESTIMATE, ESTIMATE if integrated else 0.0)
    if noise is None:
        return unknown_noise
    sizes = {key: _size_or_wanted(size) for key, size in noise if key in NOISE_UNITS}
    if sizes["quantisation"] is ESTIMATE:
        sizes["quantisation"] = 0.0
    stated = Noise.from_sizes(sizes, accelerometer.observable)
    if not integrated and stated.random_walk is ESTIMATE:
        stated = replace(stated, white=ESTIMATE, random_walk=0.0)
    # A record without any noise cannot be weighted: the noise is then estimated, except a walk that
    # is stated as zero.
    if not any((stated.white, stated.random_walk, stated.quantisation)):
        estimated = Noise(ESTIMATE) if "acceleration" in noise.model_fields_set else unknown_noise
        return estimated.with_sizes({name: getattr(stated, name) for name in BIAS_COMPONENTS})
    if noise.wanders and stated.white == 0.0 and stated.to_estimate:
        return replace(stated, white=ESTIMATE)  # beside what wanders there is white noise
    return stated


def _size_or_wanted(size: float | str) -> float:
    return size if isinstance(size, float) else ESTIMATE
