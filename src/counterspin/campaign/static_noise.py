"""Noise that a campaign leaves to a record of its accelerometers at rest."""

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
from counterspin.inference.noise.components import BIAS_COMPONENTS, size_keys
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

    sizes: StatedNoise | None  #: None: nothing.
    #: Of the variances of `COMPONENTS`, as in `Noise`; empty where no record at rest says them.
    covariance: tuple[tuple[float, ...], ...] = ()


@frozen
class _NoiseRequest:
    """A record at rest and how it is read."""

    identity: FileIdentity | str  #: Of a record in memory, its checksum.
    read: tuple[object, ...]
    campaign: Campaign = field(compare=False)


def resolve_noise(
    campaign: Campaign, undetected: float | str = ESTIMATE
) -> dict[str, ResolvedNoise]:
    """Return the stated noise, by accelerometer.

    Values from a record at rest complete the stated ones; a wander that the record does not show is
    zero.

    undetected: White noise that the record does not show. A calibration leaves it to the campaign's
        records; without records, as in a forecast, it is zero.
    """
    if campaign.rest is None:
        return dict.fromkeys(campaign.accelerometers, ResolvedNoise(campaign.noise))
    noise_by_name = _static_record_noise(campaign)
    return {
        name: _resolve_accelerometer(campaign, name, noise_by_name.get(name), undetected)
        for name in campaign.accelerometers
    }


def simulated_noise(campaign: Campaign) -> dict[str, float]:
    """Return the sizes of the simulated noise of a campaign, by key of [noise]."""
    assert campaign.simulation is not None
    true = campaign.simulation.truth.noise
    if isinstance(true, NoiseSettings) and true.rest is not None:
        return with_static_sizes(campaign, true)
    return _sizes(true)


def with_static_sizes(campaign: Campaign, noise: NoiseSettings) -> dict[str, float]:
    """Return the sizes of a campaign's noise, by key, with the sizes from its record at rest.

    If the accelerometers have sizes of their own, take the largest: a simulation and a plan have
    one noise.
    """
    resolved = resolve_noise(replace(campaign, noise=noise), 0.0)
    sizes = _sizes(noise)
    for name, accelerometer in campaign.accelerometers.items():
        for key in set(size_keys(accelerometer.observable).values()) - noise.model_fields_set:
            sizes[key] = max(sizes[key], getattr(resolved[name].sizes, key))
    return sizes


def _sizes(noise: StatedNoise) -> dict[str, float]:
    return {key: getattr(noise, key) for key in NOISE_UNITS}


def _resolve_accelerometer(
    campaign: Campaign, name: str, static_noise_of: StaticNoise | None, undetected: float | str
) -> ResolvedNoise:
    noise, observable = campaign.noise, campaign.accelerometers[name].observable
    assert noise is not None
    if static_noise_of is None:
        return ResolvedNoise(noise)
    covariance = static_noise_of.covariance.copy()
    sizes: dict[str, float | str] = {}
    for index, (component, key) in enumerate(size_keys(observable).items()):
        # Of a specific force the first component is quantisation of the velocity: it averages away.
        if key == "specific_force" or key in noise.model_fields_set:
            covariance[index], covariance[:, index] = 0.0, 0.0
            continue
        variance = static_noise_of.components[component].variance
        if key == "displacement" and isinstance(noise.quantisation, float):
            # What is stated of the steps is a part of what is white.
            variance = max(variance - noise.quantisation**2 / 12.0, 0.0)
        sizes[key] = math.sqrt(variance)
        if variance == 0.0 and component not in BIAS_COMPONENTS:
            sizes[key] = undetected
    remaining_covariance = tuple(map(tuple, covariance.tolist())) if np.any(covariance) else ()
    return ResolvedNoise(noise.model_copy(update=sizes), remaining_covariance)


def _static_record_noise(campaign: Campaign) -> Mapping[str, StaticNoise]:
    """Return the noise of the record at rest, by accelerometer."""
    file, key = campaign.rest, f"{campaign.path}: noise.from"
    assert file is not None
    read = (
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
        # What was found stays in memory: the record, and the campaign's others, need not.
        record = campaign.record_at(file)
        frames = {file: record} if isinstance(record, MemoryTable) else {}
        without_runs = replace(campaign, frames=frames, runs=(), readings=())
        identity = (
            record.checksum if isinstance(record, MemoryTable) else FileIdentity.from_file(record)
        )
        return _analyze_record(_NoiseRequest(identity, read, without_runs))
    except OSError as error:
        raise RecordError(f"{key}: {file}: file not found", code="file-not-found") from error
    except RecordError as error:
        raise RecordError(f"{key}: {error}", code=error.code) from error


@lru_cache(maxsize=4)
def _analyze_record(request: _NoiseRequest) -> Mapping[str, StaticNoise]:
    file = request.campaign.rest
    assert file is not None
    record = request.campaign.record_at(file)
    signals = static_signals(request.campaign, record)
    return {signal.name: analyse_static_record(record, signal).analysis.noise for signal in signals}


def static_signals(campaign: Campaign, record: Path | MemoryTable) -> list[StaticSignal]:
    """Return the columns of a campaign's accelerometers in a record at rest."""
    used = [
        accelerometer
        for accelerometer in campaign.accelerometers.values()
        if accelerometer.channel.name
    ]
    specs = [campaign.time, *(accelerometer.channel for accelerometer in used)]
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
        for accelerometer, values in zip(used, signals, strict=True)
    ]
