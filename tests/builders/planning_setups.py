"""Set-ups for tests of planning, and the uncertainty of the joint fit for any design."""

import math
from dataclasses import replace

import numpy as np

from counterspin.inference.joint.design_blocks import build_design_blocks
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.joint.unknowns import Considered, Unknown, Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.physics.accelerometer import QX, QY
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.spindle import Spindle
from counterspin.physics.terms import DEGREE_PER_HOUR, INPUTS, TERMS, term
from counterspin.planning.weights import PlannedInstrument, Setup
from counterspin.records.reduction import block_size

ARCSECOND = math.pi / 648000
SITE = Site(9.8, math.radians(45.75))
LEVEL = {"level": np.eye(3)}
#: Input axis of Qx up, and east again with the pendulous axis north.
ATTITUDES = LEVEL | {
    "about north": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "about east": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
WHITE = Noise(0.01)
#: What makes the example plan that of the paper: what is not stated is perfect, one rate will do.
PERFECT = [(f"# {key}", key) for key in ('assume = "all"', "fewest_rates = 1")]
PLATFORM = (
    "platform.tilt.north",
    "platform.drift.north",
    "platform.g_sensitivity.zx",
)
PRIORS = {
    "K_F": 0.5e-6,
    "platform.tilt.north": 0.5 * ARCSECOND,
    "platform.drift.north": 0.005 * DEGREE_PER_HOUR,
    "platform.g_sensitivity.zx": 0.02 * DEGREE_PER_HOUR,
    "centrifuge.radius": 1e-4,
    "site.gravity": 1e-5,
    "records.timing_offset": 1e-3,
}


def make_unknown(symbol, owner, kind=Unknown, priors=PRIORS):
    row = term(symbol)
    return kind(owner, symbol, (row.nominal, priors.get(symbol, math.inf)), row.limit)


def make_setup(
    symbols=("K_F", "K_I", "K_II", "K_III"),
    *,
    platform=PLATFORM,
    considered=(),
    attitudes=LEVEL,
    noise=WHITE,
    observable="displacement",
    mountings=None,
    priors=PRIORS,
    sampling_rate=50.0,
    timing_noise=0.0,
    expected=1e-3,
):
    """Return a set-up; `priors` are standard uncertainties, `expected` is a part of the limits."""
    mountings = mountings or {"Qx": QX}

    def owners(symbol):
        if symbol in TERMS:
            return list(mountings)
        return list(attitudes) if term(symbol).per_run else [""]

    model = Unknowns(
        tuple(make_unknown(s, o, priors=priors) for s in (*symbols, *platform) for o in owners(s)),
        tuple(make_unknown(s, o, Considered, priors) for s in considered for o in owners(s)),
    )
    return Setup(
        instruments=tuple(
            PlannedInstrument(name, mounting, observable, noise, timing_noise)
            for name, mounting in mountings.items()
        ),
        attitudes=dict(attitudes),
        radius=2.5,
        site=SITE,
        sampling_rate=sampling_rate,
        model=model,
        expected=np.array([expected * u.limit for u in model.unknowns]),
        scale_factors=dict.fromkeys(mountings, 1.0),
    )


def average_blocks(n_samples, step, rate):
    """Return mean times, spreads and counts of the blocks of a record; the last may be shorter."""
    block_starts = np.arange(0, n_samples, block_size(step, rate))
    count = np.diff(np.append(block_starts, n_samples))
    # Of n times in even steps: mean and standard deviation.
    return (block_starts + 0.5 * (count - 1)) * step, step * np.sqrt((count**2 - 1) / 12.0), count


def remove_input_effects(block, model, estimate):
    """Return a record whose error contains the terms but not the inputs."""
    term_indices = [
        k for k, i in enumerate(block.unknowns) if model.unknowns[i].symbol not in INPUTS
    ]
    values = estimate[[block.unknowns[k] for k in term_indices]]
    return replace(block.series, error=block.design[:, term_indices] @ values)


def fit_u(setup, design):
    """Return u of the shared unknowns from every sample of every run, by `solve_joint`."""
    series, attitudes = [], {}
    for index, run_type in enumerate(design.types):
        run = f"run {index}"
        attitudes[run] = run_type.attitude
        n_samples = (
            math.floor(float(design.duration[index]) * setup.sampling_rate * (1 + 1e-12)) + 1
        )
        spindle = Spindle(run_type.sense * float(design.rate[index]))
        time, time_sd, count = average_blocks(n_samples, 1.0 / setup.sampling_rate, spindle.rate)
        for instrument in setup.instruments:
            series.append(
                ResidualSeries(
                    instrument.name,
                    run,
                    Trajectory(spindle, setup.radius, setup.site),
                    instrument.mounting,
                    instrument.observable,
                    setup.attitudes[run_type.attitude],
                    time,
                    time_sd,
                    count,
                    1.0 / setup.sampling_rate,
                    np.zeros_like(time),
                )
            )

    def repeat_for_runs(terms):
        """Return the terms that belong to a run, for every run of their attitude."""
        run_terms = []
        for unknown in terms:
            if unknown.owner in setup.attitudes:
                run_terms += [
                    replace(unknown, owner=run)
                    for run, at in attitudes.items()
                    if at == unknown.owner
                ]
            else:
                run_terms.append(unknown)
        return tuple(run_terms)

    model = Unknowns(repeat_for_runs(setup.model.unknowns), repeat_for_runs(setup.model.considered))
    expected = {u.name: v for u, v in zip(setup.model.unknowns, setup.expected, strict=True)}
    estimate = np.array(
        [
            expected.get(u.name, expected.get(f"{attitudes.get(u.owner)}.{u.symbol}"))
            for u in model.unknowns
        ]
    )
    blocks = build_design_blocks(series, model, setup.scale_factors, estimate)
    timing = {instrument.name: instrument.timing_noise for instrument in setup.instruments}
    blocks = [
        replace(
            block,
            series=remove_input_effects(block, model, estimate).with_timestamp_noise(
                timing[block.accelerometer]
            ),
        )
        for block in blocks
    ]
    fit = solve_joint(
        blocks, model, {instrument.name: instrument.noise for instrument in setup.instruments}
    )
    shared = [i for i, u in enumerate(model.unknowns) if u.owner not in attitudes]
    return fit.solution.u[shared]


TWO_MOUNTINGS = {"Qx": QX, "Qy": QY}
