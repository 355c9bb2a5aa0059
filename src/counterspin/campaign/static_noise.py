"""Noise of the accelerometers, estimated from a record at rest."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from counterspin.campaign.description import Campaign
from counterspin.campaign.field_types import ESTIMATE
from counterspin.campaign.settings import NOISE_UNITS, NoiseSettings, StatedNoise
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.inference.noise.components import BIAS_COMPONENTS, component_keys
from counterspin.inference.noise.static_noise import (
    StaticNoise,
    StaticSignal,
    analyse_static_record,
)
from counterspin.input import FileIdentity
from counterspin.physics import observation
from counterspin.records.formats import read_scaled
from counterspin.records.memory import MemoryTable


@frozen
class ResolvedNoise:
    """The stated noise of one accelerometer."""

    sizes: StatedNoise | None  #: Standard deviations; None: not stated.
    #: Covariance of the variances of `COMPONENTS`, as in `Noise`; empty without a record at rest.
    covariance: tuple[tuple[float, ...], ...] = ()


@frozen
class _NoiseRequest:
    """A record at rest with the settings of its reading, as a cache key."""

    identity: FileIdentity | str  #: Identity of the file, or checksum of a record in memory.
    cache_key: tuple[object, ...]
    campaign: Campaign = field(compare=False)


def resolve_noise(
    campaign: Campaign, undetected: float | str = ESTIMATE
) -> dict[str, ResolvedNoise]:
    """Return accelerometer -> stated noise, completed from a record at rest.

    Bias wander that the record does not show is zero.

    undetected: White noise if the record does not show it. A calibration estimates it from the
        campaign's records; without records, as in a forecast, it is zero.
    """
    if campaign.rest is None:
        return dict.fromkeys(campaign.accelerometers, ResolvedNoise(campaign.noise))
    noise_by_name = _static_record_noise(campaign)
    return {
        name: _resolve_accelerometer(campaign, name, noise_by_name.get(name), undetected)
        for name in campaign.accelerometers
    }


def simulated_noise(campaign: Campaign) -> dict[str, float]:
    """Return key of [noise] -> standard deviation of the simulated noise."""
    assert campaign.simulation is not None
    true_noise = campaign.simulation.truth.noise
    if isinstance(true_noise, NoiseSettings) and true_noise.rest is not None:
        return complete_noise_sizes(campaign, true_noise)
    return _noise_sizes(true_noise)


def complete_noise_sizes(campaign: Campaign, noise: NoiseSettings) -> dict[str, float]:
    """Return key of [noise] -> standard deviation, completed from the record at rest.

    If the accelerometers differ, the largest value counts: a simulation and a plan have one noise.
    """
    noise_by_name = resolve_noise(replace(campaign, noise=noise), 0.0)
    sizes = _noise_sizes(noise)
    for name, accelerometer in campaign.accelerometers.items():
        for key in set(component_keys(accelerometer.observable).values()) - noise.model_fields_set:
            sizes[key] = max(sizes[key], getattr(noise_by_name[name].sizes, key))
    return sizes


def _noise_sizes(noise: StatedNoise) -> dict[str, float]:
    return {key: getattr(noise, key) for key in NOISE_UNITS}


def _resolve_accelerometer(
    campaign: Campaign, name: str, static_noise: StaticNoise | None, undetected: float | str
) -> ResolvedNoise:
    noise, observable = campaign.noise, campaign.accelerometers[name].observable
    assert noise is not None
    if static_noise is None:
        return ResolvedNoise(noise)
    covariance = static_noise.covariance.copy()
    sizes: dict[str, float | str] = {}
    for index, (component, key) in enumerate(component_keys(observable).items()):
        # The first component of a specific force, velocity quantisation, averages out.
        if key == "specific_force" or key in noise.model_fields_set:
            covariance[index], covariance[:, index] = 0.0, 0.0
            continue
        variance = static_noise.components[component].variance
        if key == "displacement" and isinstance(noise.quantisation, float):
            # The stated quantisation is a part of the white noise.
            variance = max(variance - noise.quantisation**2 / 12.0, 0.0)
        sizes[key] = math.sqrt(variance)
        if variance == 0.0 and component not in BIAS_COMPONENTS:
            sizes[key] = undetected
    remaining_covariance = tuple(map(tuple, covariance.tolist())) if np.any(covariance) else ()
    return ResolvedNoise(noise.model_copy(update=sizes), remaining_covariance)


def _static_record_noise(campaign: Campaign) -> Mapping[str, StaticNoise]:
    """Return accelerometer -> noise of the record at rest."""
    file, label = campaign.rest, f"{campaign.path}: noise.from"
    assert file is not None
    cache_key = (
        file,
        campaign.gravity,
        campaign.time,
        campaign.dialect,
        tuple(
            (accelerometer.name, accelerometer.channel, accelerometer.observable)
            for accelerometer in campaign.accelerometers.values()
        ),
    )
    try:
        # The cached request should not keep all records of the campaign in memory.
        record = campaign.record_at(file)
        frames = {file: record} if isinstance(record, MemoryTable) else {}
        bare_campaign = replace(campaign, frames=frames, runs=(), readings=())
        identity = (
            record.checksum if isinstance(record, MemoryTable) else FileIdentity.from_file(record)
        )
        return _analyse_record(_NoiseRequest(identity, cache_key, bare_campaign))
    except OSError as error:
        raise RecordError(f"{label}: {file}: file not found", code="file-not-found") from error
    except RecordError as error:
        raise RecordError(f"{label}: {error}", code=error.code) from error


@lru_cache(maxsize=4)
def _analyse_record(request: _NoiseRequest) -> Mapping[str, StaticNoise]:
    file = request.campaign.rest
    assert file is not None
    record = request.campaign.record_at(file)
    signals = static_signals(request.campaign, record)
    return {signal.name: analyse_static_record(record, signal).analysis.noise for signal in signals}


def static_signals(campaign: Campaign, record: Path | MemoryTable) -> list[StaticSignal]:
    """Return the columns of a campaign's accelerometers in a record at rest."""
    recorded_accelerometers = [
        accelerometer
        for accelerometer in campaign.accelerometers.values()
        if accelerometer.channel.name
    ]
    specs = [campaign.time, *(accelerometer.channel for accelerometer in recorded_accelerometers)]
    time, *signals = read_scaled(record, specs, campaign.dialect)
    return [
        StaticSignal(
            accelerometer.name,
            accelerometer.channel.name,
            observation.ORDERS[accelerometer.observable],
            accelerometer.channel.in_g,
            time,
            values,
        )
        for accelerometer, values in zip(recorded_accelerometers, signals, strict=True)
    ]
