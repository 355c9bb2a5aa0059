"""From a campaign to the joint fit's problem: unknowns (of `model`), series and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from counterspin.calibration.model import model_of
from counterspin.calibration.observed import ObservedRun
from counterspin.campaign.accelerometers import Accelerometer
from counterspin.campaign.description import Campaign
from counterspin.campaign.noise_at_rest import said_noise
from counterspin.campaign.settings import StatedNoise
from counterspin.frozen import frozen
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import WANTED, Noise
from counterspin.physics import observation


@frozen(eq=False)
class JointProblem:
    """A campaign and what was recorded of it, as the joint fit takes both."""

    campaign: Campaign  #: The description.
    observed: Sequence[ObservedRun] = ()  #: Its runs.

    @cached_property
    def model(self) -> Unknowns:
        """What is unknown."""
        return model_of(self.campaign)

    @cached_property
    def series(self) -> tuple[Series, ...]:
        """What was recorded."""
        return series_of(self.campaign, self.observed)

    @cached_property
    def noise(self) -> dict[str, Noise]:
        """The noise of each accelerometer, as far as it is stated."""
        return noise_of(self.campaign)

    def series_of(self, name: str) -> list[Series]:
        """Return what was recorded of one accelerometer."""
        return [one for one in self.series if one.accelerometer == name]


def series_of(campaign: Campaign, observed: Sequence[ObservedRun]) -> tuple[Series, ...]:
    """Return one series for each run and accelerometer, missing samples left out."""
    timing = campaign.noise.timing if campaign.noise else 0.0
    series = []
    for run in observed:
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
            )
            series.append(one.with_timing(timing) if isinstance(timing, float) else one)
    return tuple(series)


def noise_of(campaign: Campaign) -> dict[str, Noise]:
    """Return each accelerometer's noise, as far as it is stated.

    Without [noise], or where it says nothing of an accelerometer's record, all is wanted. In
    a record of specific force the accelerometer's white noise cannot be told from that of the
    record: only one of the two is estimated.
    """
    said = said_noise(campaign)
    return {
        name: replace(_noise_of(said[name].sizes, one), covariance=said[name].covariance)
        for name, one in campaign.accelerometers.items()
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
