"""From a campaign to the joint fit's problem: series and noise; its unknowns are in `model`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from functools import lru_cache

import numpy as np

from counterspin.calibration.observed import ObservedRun, rest_signals
from counterspin.campaign.description import Campaign
from counterspin.campaign.kinds import ESTIMATE
from counterspin.campaign.resolved import Accelerometer
from counterspin.campaign.settings import StatedNoise
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.inference.joint.series import Series
from counterspin.inference.noise.model import COMPONENTS, WANTED, Noise
from counterspin.inference.noise.rest import RestNoise
from counterspin.inference.noise.stretches import at_rest
from counterspin.input import FileIdentity
from counterspin.physics import observation


@frozen
class SaidNoise:
    """What is stated of one accelerometer's noise."""

    sizes: StatedNoise | None  #: None: nothing.
    #: Of the variances of `COMPONENTS`, as of `Noise`; empty where no record at rest says them.
    covariance: tuple[tuple[float, ...], ...] = ()


@frozen
class _Asked:
    """A record at rest and how it is read."""

    identity: FileIdentity
    read: tuple[object, ...]
    campaign: Campaign = field(compare=False)


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


def said_noise(campaign: Campaign) -> dict[str, SaidNoise]:
    """Return what is stated of the noise, by accelerometer.

    Of a record at rest counts what is not stated beside it. What it does not show of white noise is
    left to the campaign's records; a wander that it does not show is none.
    """
    if campaign.rest is None:
        return dict.fromkeys(campaign.accelerometers, SaidNoise(campaign.noise))
    found = _found(campaign)
    return {name: _said(campaign, name, found.get(name)) for name in campaign.accelerometers}


def _said(campaign: Campaign, name: str, found: RestNoise | None) -> SaidNoise:
    noise, observable = campaign.noise, campaign.accelerometers[name].observable
    assert noise is not None
    if found is None:
        return SaidNoise(noise)
    # Of a specific force the first component is quantisation of the velocity: it averages away.
    own = None if observable == "specific_force" else observable
    covariance = found.covariance.copy()
    sizes: dict[str, float | str] = {}
    for place, key in enumerate((own, "acceleration", "flicker", "bias_walk")):
        if key is None or key in noise.model_fields_set:
            covariance[place], covariance[:, place] = 0.0, 0.0
            continue
        variance = found.components[COMPONENTS[place]].variance
        if key == "displacement" and isinstance(noise.quantisation, float):
            # What is stated of the steps is a part of what is white.
            variance = max(variance - noise.quantisation**2 / 12.0, 0.0)
        sizes[key] = math.sqrt(variance)
        if variance == 0.0 and key in (own, "acceleration"):
            sizes[key] = ESTIMATE
    said = tuple(map(tuple, covariance.tolist())) if np.any(covariance) else ()
    return SaidNoise(noise.model_copy(update=sizes), said)


def _found(campaign: Campaign) -> Mapping[str, RestNoise]:
    """Return the noise of the record at rest, by accelerometer."""
    file, key = campaign.rest, f"{campaign.path}: noise.from"
    assert file is not None
    read = (
        file,
        campaign.gravity,
        campaign.time,
        campaign.dialect,
        tuple((a.name, a.channel, a.observable) for a in campaign.accelerometers.values()),
    )
    try:
        # What was found stays in memory: the record, and the campaign's others, need not.
        asked = replace(campaign, frames={}, runs=(), readings=())
        return _analysed(_Asked(FileIdentity.of(file), read, asked))
    except OSError as error:
        raise RecordError(f"{key}: {file}: there is no such file.") from error
    except RecordError as error:
        raise RecordError(f"{key}: {error}") from error


@lru_cache(maxsize=4)
def _analysed(asked: _Asked) -> Mapping[str, RestNoise]:
    file = asked.campaign.rest
    assert file is not None
    signals = rest_signals(asked.campaign, file)
    return {signal.name: at_rest(file, signal).analysis.noise for signal in signals}
