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
NO_PRIOR = (0.0, math.inf)


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
    signal = simulation.simulate_record(
        trajectory, axes, coefficients, platform or {}, times, observable, attitude=attitude
    )
    start_errors = (0.02 - 3e-3 * times, np.full(times.size, -3e-3), np.zeros(times.size))
    error = signal - reference(trajectory, axes, times, observable, attitude)
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
        error=error + start_errors[2 - ORDERS[observable]],
    )


def simulate_three_rates(coefficients, platform=None, **options):
    """Return runs at the three rates of the paper."""
    return [
        simulate_series(f"run{i}", rate, coefficients, platform, **options)
        for i, rate in enumerate(RATES, start=1)
    ]


def make_unknowns(symbols, priors=None, owner="Qx"):
    """Return the unknowns of an accelerometer with the limits of the table."""
    priors_by_symbol = priors or {}
    return tuple(
        Unknown(owner, symbol, priors_by_symbol.get(symbol, NO_PRIOR), term(symbol).limit)
        for symbol in symbols
    )


def make_considered_inputs(sizes):
    """Return considered inputs with the limits of the table; sizes are standard uncertainties."""
    return tuple(
        Considered("", symbol, (0.0, u), term(symbol).limit, is_of_interest=False)
        for symbol, u in sizes.items()
    )


def add_noise(series, noise, rng):
    """Return the series with simulated noise added."""
    samples = noise.white * rng.standard_normal(series.time.size)
    if noise.random_walk:
        samples = samples + draw_accelerometer_noise(
            rng, series.time, noise.random_walk, series.order
        )
    return replace(series, error=series.error + samples)


def redraw_noise(blocks, noise, rng):
    """Return design blocks with simulated noise added and unchanged columns."""
    return tuple(replace(block, series=add_noise(block.series, noise, rng)) for block in blocks)
