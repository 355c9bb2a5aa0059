"""The joint fit's problem: a campaign's unknowns (of `model`), series and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Final

import numpy as np

from counterspin.calibration.model import model_of
from counterspin.calibration.observed import ObservedRun
from counterspin.campaign.accelerometers import Accelerometer
from counterspin.campaign.description import Campaign
from counterspin.campaign.settings import StatedNoise
from counterspin.frozen import frozen
from counterspin.inference.joint.series import TIMING, Series, StampErrors
from counterspin.inference.joint.time_stamps import find_stamp_errors
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import WANTED, Noise
from counterspin.loading import load_name
from counterspin.physics import observation

#: The function that reads the noise of a campaign from a record at rest.
NOISE_AT_REST: Final = "counterspin.campaign.noise_at_rest:said_noise"


@frozen(eq=False)
class JointProblem:
    """A campaign and what was recorded of it, as the joint fit takes both."""

    campaign: Campaign  #: The description.
    observed: Sequence[ObservedRun] = ()  #: Its runs.
    #: By how much the timing offset in `observed` differs from the stated one, s.
    delay: float = 0.0

    @cached_property
    def model(self) -> Unknowns:
        """The unknowns of the fit."""
        model = model_of(self.campaign)
        if self.delay == 0.0:
            return model
        unknowns = (
            replace(unknown, prior=(-self.delay, unknown.prior[1]))
            if unknown.symbol == TIMING
            else unknown
            for unknown in model.unknowns
        )
        return replace(model, unknowns=tuple(unknowns))

    @cached_property
    def series(self) -> tuple[Series, ...]:
        """The recorded series."""
        return series_of(self.campaign, self.observed)

    @cached_property
    def noise(self) -> dict[str, Noise]:
        """The noise of each accelerometer, as far as it is stated."""
        return noise_of(self.campaign)

    def series_of(self, name: str) -> list[Series]:
        """Return the series of an accelerometer."""
        return [one for one in self.series if one.accelerometer == name]


def series_of(campaign: Campaign, observed: Sequence[ObservedRun]) -> tuple[Series, ...]:
    """Return one series for each run and accelerometer, missing samples left out."""
    timing, encoder_noise = stated_times(campaign)
    series = []
    for run in observed:
        stamps = _stamp_errors(run, timing, encoder_noise)
        for name, signal in run.signals.items():
            keep = np.isfinite(signal.error)
            accelerometer = signal.accelerometer
            one = Series(
                accelerometer=name,
                run=run.run.name,
                trajectory=run.trajectory,
                mounting=accelerometer.mounting,
                observable=accelerometer.observable,
                attitude=run.run.attitude,
                time=run.record.time[keep],
                spread=run.record.time_sd[keep],
                count=run.record.count[keep].astype(float),
                spacing=run.record.report.step,
                error=signal.error[keep],
                in_g=accelerometer.channel.in_g,
                angle_error=run.rotation.error if run.rotation else None,
                recorder=campaign.recording_of(run.run).recorder,
                by_latitude=None if signal.by_latitude is None else signal.by_latitude[keep],
                stamps=stamps and stamps.of_rows(keep),
            )
            one = one.with_timing(timing)
            series.append(one.corrected(stamps.prior[0]) if stamps else one)
    return tuple(series)


def stated_times(campaign: Campaign) -> tuple[float, float]:
    """Return the stated noise of time stamps, s, and of the encoder, rad; 0: not stated."""
    noise = campaign.noise
    sizes = (noise.timing, noise.angle) if noise else (0.0, 0.0)
    timing, angle = (size if isinstance(size, float) else 0.0 for size in sizes)
    return timing, angle


def _stamp_errors(run: ObservedRun, timing: float, encoder_noise: float) -> StampErrors | None:
    """Return the errors of the time stamps of a run that its recorded angle shows."""
    rotation, record = run.rotation, run.record
    if rotation is None:
        return None
    widening = None
    if record.angle_sd is not None:
        of_angle = record.angle_sd / abs(rotation.spindle.rate)
        widening = np.nan_to_num(of_angle**2 - record.time_sd**2)
    stated = timing, encoder_noise
    return find_stamp_errors(rotation, record.time, record.count, stated, widening)


def noise_of(campaign: Campaign) -> dict[str, Noise]:
    """Return each accelerometer's noise, as far as it is stated.

    Without [noise], or where it says nothing of an accelerometer's record, all is wanted. In
    a record of specific force the accelerometer's white noise cannot be told from that of the
    record: only one of the two is estimated.
    """
    if campaign.rest is None:
        return {
            name: _noise_of(campaign.noise, accelerometer)
            for name, accelerometer in campaign.accelerometers.items()
        }
    stated = load_name(NOISE_AT_REST)(campaign)
    return {
        name: replace(
            _noise_of(stated[name].sizes, accelerometer), covariance=stated[name].covariance
        )
        for name, accelerometer in campaign.accelerometers.items()
    }


def _noise_of(noise: StatedNoise | None, accelerometer: Accelerometer) -> Noise:
    integrated = observation.ORDERS[accelerometer.observable] > 0
    everything = Noise(WANTED, WANTED if integrated else 0.0)
    if noise is None:
        return everything
    white = _given(getattr(noise, accelerometer.observable))
    walk = _given(noise.acceleration)
    if not integrated and walk is WANTED:
        white, walk = WANTED, 0.0
    displacement = accelerometer.observable == "displacement"
    step = _given(noise.quantisation) if displacement else 0.0
    wander = (_given(noise.flicker), _given(noise.bias_walk))
    stated = Noise(white, walk, 0.0 if step is WANTED else step, *wander)
    # A record without any noise cannot be weighted: then the residuals have to say.
    if not any((white, walk, stated.quantisation)):
        return replace(everything, flicker=stated.flicker, bias_walk=stated.bias_walk)
    if noise.wanders and white == 0.0 and stated.wanted:
        return replace(stated, white=WANTED)  # beside what wanders there is white noise
    return stated


def _given(size: float | str) -> float:
    return size if isinstance(size, float) else WANTED
