"""Small simulated campaigns for the joint fit: series without noise, and noise drawn on them."""

import math
from dataclasses import replace

import numpy as np

from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.joint.unknowns import Considered, Unknown
from counterspin.inference.noise.simulation import draw_accelerometer_noise
from counterspin.physics import simulation
from counterspin.physics.accelerometer import QX, QY
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.observation import LEVEL, ORDERS, reference
from counterspin.physics.spindle import Spindle
from counterspin.physics.terms import DEGREE_PER_HOUR, term

SITE = Site(9.8066, math.radians(45.75))
RATES = (math.pi / 2, math.pi, 2 * math.pi)
ARCSEC = math.radians(1.0) / 3600.0
DEG_H = DEGREE_PER_HOUR
MOUNTINGS = {"Qx": QX, "Qy": QY}
NOTHING = (0.0, math.inf)


def simulate_series(
    run,
    rate,
    coefficients,
    platform=None,
    *,
    accelerometer="Qx",
    mounting=None,
    attitude=LEVEL,
    observable="displacement",
    revolutions=12,
    per_revolution=32,
    spindle=None,
    radius=2.5,
    site=SITE,
):
    """Simulate a series with start offset and velocity by the nonlinear model."""
    duration = revolutions * 2 * math.pi / abs(rate)
    times = np.linspace(0.0, duration, revolutions * per_revolution + 1)
    trajectory = Trajectory(spindle or Spindle(rate), radius, site)
    axes = mounting or MOUNTINGS[accelerometer]
    recorded = simulation.simulate_record(
        trajectory, axes, coefficients, platform or {}, times, observable, attitude=attitude
    )
    start = (0.02 - 3e-3 * times, np.full(times.size, -3e-3), np.zeros(times.size))
    error = recorded - reference(trajectory, axes, times, observable, attitude)
    return ResidualSeries(
        accelerometer=accelerometer,
        run=run,
        trajectory=trajectory,
        mounting=axes,
        observable=observable,
        attitude=attitude,
        time=times,
        time_sd=np.zeros(times.size),
        count=np.ones(times.size),
        spacing=float(times[1]),
        error=error + start[2 - ORDERS[observable]],
    )


def three_rates(coefficients, platform=None, **more):
    """Return runs at the three rates of the paper."""
    return [
        simulate_series(f"run{i}", rate, coefficients, platform, **more)
        for i, rate in enumerate(RATES, start=1)
    ]


def unknowns(symbols, priors=None, owner="Qx"):
    """Return the unknowns of an accelerometer with the limits of the table."""
    known = priors or {}
    return tuple(
        Unknown(owner, symbol, known.get(symbol, NOTHING), term(symbol).limit) for symbol in symbols
    )


def make_considered_inputs(sizes):
    """Return considered inputs with the limits of the table; sizes are standard uncertainties."""
    return tuple(
        Considered("", s, (0.0, u), term(s).limit, is_of_interest=False) for s, u in sizes.items()
    )


def add_noise(series, noise, rng):
    """Return the series with simulated noise added."""
    drawn = noise.white * rng.standard_normal(series.time.size)
    if noise.random_walk:
        drawn = drawn + draw_accelerometer_noise(rng, series.time, noise.random_walk, series.order)
    return replace(series, error=series.error + drawn)


def redraw_noise(prepared, noise, rng):
    """Return design blocks with simulated noise added and unchanged columns."""
    return tuple(replace(one, series=add_noise(one.series, noise, rng)) for one in prepared)
