"""Readings of a tumble and of an arm centrifuge, with a machine drawn from its priors."""

import math

import numpy as np
from stations import Station, combine_stations

from counterspin.inference.joint.unknowns import Considered, Unknown, Unknowns
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.conditions import AT_REFERENCE, RunConditions
from counterspin.physics.motion import Site
from counterspin.physics.simulation import run_coefficients
from counterspin.physics.station import FRAMES, mean_products
from counterspin.physics.terms import TERMS, term
from counterspin.readings.known_attitudes import Readings

SITE = Site(9.80665, 0.8)
TRUTH = {"K_F": 2e-3, "K_I": 1.0005, "K_II": 15e-6, "K_III": 2e-6}
ARM_FRAME = FRAMES["arm"]


def make_unknown(symbol, prior=(0.0, math.inf), owner="A", kind=Unknown):
    row = term(symbol)
    return kind(owner, symbol, prior, row.limit)


def make_considered(symbol, u, owner=""):
    return make_unknown(symbol, (0.0, u), owner, Considered)


def make_tumble(count=12):
    """Return stations of an equal-angle tumble about north from input axis up, and the axis."""
    stations = []
    for angle in np.arange(count) * 2.0 * np.pi / count:
        cos, sin = math.cos(angle), math.sin(angle)
        stations.append(Station("static", Mounting.from_axes([sin, 0.0, cos], [-cos, 0.0, sin])))
    return stations, [""] * count, np.tile([0.0, 1.0, 0.0], (count, 1))


def make_arm_test(forces=(1.0, 2.0, 5.0, 10.0, 15.0, 20.0), radius=1.0):
    """Return stations on an arm in both senses and two mountings."""
    stations, mountings = [], []
    for side in ("inward", "outward"):
        mounting = Mounting.from_axes(ARM_FRAME[side], ARM_FRAME["forward"])
        for force in forces:
            for sense in (1.0, -1.0):
                rate = sense * math.sqrt(force * SITE.gravity / radius)
                stations.append(Station("arm", mounting, rate=rate, radius=radius))
                mountings.append(side)
    return stations, mountings, np.zeros((len(stations), 3))


def make_readings(test, value, u, u_head=0.0, temperature=None):
    """Return a group of readings; the noise is estimated if u is None."""
    stations, mountings, head = test
    n = len(stations)
    return Readings(
        accelerometer="A",
        motion=stations[0].motion,
        names=tuple(f"position {i}" for i in range(n)),
        site=SITE,
        stations=combine_stations(stations),
        mountings=tuple(mountings),
        head=np.asarray(head, dtype=float),
        u_head=np.full(n, u_head),
        value=np.asarray(value, dtype=float),
        u=None if u is None else np.full(n, u),
        conditions={
            **AT_REFERENCE.at(np.zeros(n), 0.0),
            "temperature": np.zeros(n) if temperature is None else temperature,
            "time": np.arange(n) * 60.0,
        },
        repeats=np.ones(n),
        scatter=np.zeros(n),
    )


def simulate_readings(test, rng, sigma, machine=(), u_head=0.0, truth=TRUTH, temperature=None):
    """Simulate readings with the exact model and the true machine.

    Slopes of coefficients, with temperature or time, are among the truth.
    """
    n = len(test[0])
    group = make_readings(test, np.zeros(n), 1.0, temperature=temperature)
    angle_errors = rng.normal(0.0, u_head, n) if u_head else np.zeros(n)
    true_stations = group.rotate_head(group.stations_with(dict(machine)), angle_errors)
    coefficients = []
    for index in range(n):
        conditions = RunConditions(
            float(group.time[index]), float(group.conditions["temperature"][index])
        )
        values_at_run = run_coefficients(truth, conditions, 0.0)
        coefficients.append(
            [values_at_run.get(symbol, row.nominal) for symbol, row in TERMS.items()]
        )
    values = np.sum(mean_products(true_stations, SITE) * coefficients, axis=1)
    return values + rng.normal(0.0, sigma, n)


def make_model(terms=tuple(TRUTH), others=(), considered=()):
    """Return the estimated and considered unknowns."""
    return Unknowns((*map(make_unknown, terms), *others), tuple(considered))
