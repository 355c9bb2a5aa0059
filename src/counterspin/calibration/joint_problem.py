"""From a campaign to the joint fit's problem: series and noise; its unknowns are in `model`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from counterspin.calibration.observed import ObservedRun
from counterspin.campaign.description import Campaign
from counterspin.inference.joint.estimation import NoiseRequest
from counterspin.inference.joint.series import Series
from counterspin.physics import observation


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
                by_latitude=None if signal.by_latitude is None else signal.by_latitude[keep],
            )
            series.append(one.with_timing(timing) if isinstance(timing, float) else one)
    return tuple(series)


def noise_of(campaign: Campaign) -> dict[str, NoiseRequest]:
    """Return what is known of each accelerometer's noise; None stands for "to be estimated".

    Without [noise], or where it says nothing of an accelerometer's record, all is estimated. In
    a record of specific force the accelerometer's white noise cannot be told from that of the
    record: only one of the two is estimated.
    """
    requests = {}
    for name, accelerometer in campaign.accelerometers.items():
        integrated = observation.ORDERS[accelerometer.observable] > 0
        everything = NoiseRequest(None, None if integrated else 0.0)
        noise = campaign.noise
        if noise is None:
            requests[name] = everything
            continue
        white = _given(getattr(noise, accelerometer.observable))
        walk = _given(noise.acceleration)
        if not integrated and walk is None:
            white, walk = None, 0.0
        displacement = accelerometer.observable == "displacement"
        step = noise.quantisation if displacement else 0.0
        quantisation = step if isinstance(step, float) else 0.0
        # A record without any noise cannot be weighted: then the residuals have to say.
        silent = white == 0.0 and walk == 0.0 and quantisation == 0.0
        if silent:
            white, walk, quantisation = everything.white, everything.random_walk, 0.0
        wander = (_given(noise.flicker), _given(noise.bias_walk))
        if noise.wanders and white == 0.0 and None in (walk, *wander):
            white = None  # beside what wanders there is white noise
        requests[name] = NoiseRequest(white, walk, quantisation, *wander)
    return requests


def _given(size: float | str) -> float | None:
    return size if isinstance(size, float) else None
