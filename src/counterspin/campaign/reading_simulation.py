"""Simulated readings: what a known instrument on a known machine indicates at each station."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.conditions import groups_of
from counterspin.campaign.description import Campaign
from counterspin.campaign.machine import POSITION
from counterspin.campaign.readings import Reading
from counterspin.campaign.resolved import sample_count
from counterspin.inference.linear_readings import Readings
from counterspin.physics.station import Station, mean_products
from counterspin.physics.terms import CONDITION_TERMS, TERMS


def indications(
    group: Readings,
    coefficients: Mapping[str, float],
    machine: Mapping[str, float],
    head_error: Array,
) -> Array:
    """Return what is indicated at each reading of a group, without noise, in g.

    Nothing is linearised: the stations are moved by what the machine does.

    coefficients: True values of the accelerometer in g-units, slopes included; those not named are
        nominal.
    head_error: Error of the dividing head's angle at each reading, rad, shape (n,).
    """
    stations = group.turned(group.stations_with(machine), head_error)
    products = mean_products(stations, group.site)
    found: Array = np.sum(products * _effective(group, coefficients), axis=1)
    return found


def _effective(group: Readings, coefficients: Mapping[str, float]) -> Array:
    """Return the coefficients at each reading, under its conditions, shape (n, terms)."""
    nominal = [coefficients.get(symbol, row.nominal) for symbol, row in TERMS.items()]
    effective = np.tile(nominal, (group.size, 1))
    for symbol in CONDITION_TERMS.keys() & coefficients.keys():
        place = list(TERMS).index(CONDITION_TERMS[symbol].effect.coefficient)
        effective[:, place] += coefficients[symbol] * group.lever(symbol)
    return effective


def head_errors(readings: Sequence[Reading], generator: np.random.Generator) -> Array:
    """Return errors of the dividing head's angle, rad: one for all accelerometers of a run."""
    drawn: dict[tuple[str, int], float] = {}
    errors = np.zeros(len(readings))
    seen: Counter[tuple[str, str]] = Counter()
    for index, reading in enumerate(readings):
        # A table may name several readings alike; each is a position of its own.
        own = (reading.accelerometer, reading.name)
        position = (reading.name, seen[own])
        seen[own] += 1
        if position not in drawn:
            drawn[position] = float(generator.standard_normal())
        errors[index] = drawn[position] * reading.u_head
    return errors


def setting_spread(campaign: Campaign) -> dict[str, float]:
    """Return how far off positions may be set, rad, by symbol: one for all that is read there."""
    priors = campaign.machine.priors.items()
    return {symbol: prior.u for symbol, prior in priors if symbol.startswith(f"{POSITION}.")}


def true_machine(campaign: Campaign) -> dict[str, float]:
    """Return what is true of the machine, drawn errors of setting positions among it."""
    assert campaign.simulation is not None
    generator, spread = stream(campaign, 0, 1), setting_spread(campaign)
    errors = {symbol: u * float(generator.standard_normal()) for symbol, u in spread.items()}
    return errors | dict(campaign.simulation.truth.machine)


def numbered_groups(campaign: Campaign) -> list[tuple[Readings, list[int]]]:
    """Return the groups of a campaign's readings, and the places of each in the campaign."""
    numbered = [replace(r, name=str(place)) for place, r in enumerate(campaign.readings)]
    return [(group, [int(name) for name in group.names]) for group in groups_of(campaign, numbered)]


def true_readings(campaign: Campaign) -> tuple[tuple[Reading, ...], Array]:
    """Return a campaign's readings with what would be read without noise, and the head's errors.

    Returns: the readings in the campaign's order, those of records as they were; rad, shape (n,).
    """
    assert campaign.simulation is not None
    truth, readings = campaign.simulation.truth, campaign.readings
    errors = head_errors(readings, stream(campaign, 0))
    values, machine = np.zeros(len(readings)), true_machine(campaign)
    for group, places in numbered_groups(campaign):
        coefficients = truth.coefficients.get(group.accelerometer, {})
        values[places] = indications(group, coefficients, machine, errors[places])
    return tuple(
        reading if reading.record else replace(reading, value=value)
        for reading, value in zip(readings, values.tolist(), strict=True)
    ), errors


def stream(campaign: Campaign, *which: int) -> np.random.Generator:
    """Return random numbers that no run of the double turntable has.

    So a run that is added changes no reading, and the other way round.

    which: 0 of the head, 0 and 1 of positions, 1 of the readings' noise, from 2 on of records.
    """
    assert campaign.simulation is not None
    return np.random.default_rng(
        np.random.SeedSequence(campaign.simulation.seed, spawn_key=(0, *which))
    )


def simulate_mean_record(
    campaign: Campaign, reading: Reading, head_error: float
) -> tuple[Array, Array, Array]:
    """Return time (s), angle (rad) and indicated specific force (m/s^2), each shape (n,).

    head_error: Error of the dividing head's angle, rad.
    """
    assert campaign.simulation is not None
    truth, rate = campaign.simulation.truth, campaign.simulation.sampling_rate
    if reading.duration is None:
        raise ValueError(f'the run "{reading.name}" states no duration')
    time = np.arange(sample_count(reading.duration, rate)) / rate
    angle = reading.rate * time
    (group,) = groups_of(campaign, [reading])
    stations = group.stations_with(true_machine(campaign))
    (station,) = group.turned(stations, np.array([head_error]))
    (effective,) = _effective(group, truth.coefficients.get(reading.accelerometer, {}))
    return time, angle, _instantaneous(station, group, effective, angle)


def _instantaneous(station: Station, group: Readings, effective: Array, angle: Array) -> Array:
    """Return the indicated specific force at each angle, m/s^2."""
    gravity = group.site.gravity
    a_ipo = station.axes_under_load() @ station.force(group.site, angle).T / gravity
    products = np.stack([row.effect.evaluate(a_ipo) for row in TERMS.values()])
    found: Array = gravity * (effective @ products)
    return found
