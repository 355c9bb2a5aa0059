"""The Cramer-Rao bound of a study: the least uncertainty that its records and readings allow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from counterspin.inference.blocks import Block
from counterspin.inference.identifiability import assess
from counterspin.inference.joint.fit import solve_blocks
from counterspin.inference.joint.prepared import prepare_columns
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.linear_readings import Measured, blocks_at
from counterspin.inference.noise.model import Noise
from counterspin.physics.terms import TERMS
from counterspin.studies.draws import StudyTruth
from counterspin.studies.joint_engine import scale_factors
from counterspin.studies.noise import NOISE_LEVELS
from counterspin.studies.world import World


def bounds(
    truth: StudyTruth, model: Unknowns, world: World | None, readings: Sequence[Measured] = ()
) -> dict[str, float]:
    """Return the least standard uncertainty from all samples and readings, by unknown.

    The bound is that of the true noise, of the unknowns of the analysis with what is known of them
    beforehand (the posterior bound of van Trees), everything else being known. An unknown that the
    data do not determine has none.

    world: Of the records; None: there are none.
    readings: With their true noise.
    """
    model = Unknowns(model.unknowns)
    blocks = [] if world is None else _blocks_of_records(world, truth, model)
    if readings:
        at = np.array([truth.mean(u.owner, u.symbol) - u.nominal for u in model.unknowns])
        blocks += blocks_at(readings, model, at)
    if not blocks:
        return {}
    solution = solve_blocks(blocks, model)
    determined = assess(solution, [u.name for u in model.unknowns]).determined
    variance = np.diag(solution.covariance_noise + solution.covariance_prior)
    return {
        u.name: float(np.sqrt(v))
        for u, v in zip(model.unknowns, variance, strict=True)
        if determined[u.name]
    }


def _blocks_of_records(world: World, truth: StudyTruth, model: Unknowns) -> list[Block]:
    """Return the blocks of the records with their true noise; none without noise."""
    draws = truth.draw(np.random.default_rng(0), 256)
    levels = {NOISE_LEVELS[symbol][1]: float(level.mean()) for symbol, level in draws.noise.items()}
    world = replace(world, noise=replace(world.noise, white=float(draws.white.mean()), **levels))
    level = world.noise
    noise = Noise(
        level.white, level.random_walk, level.quantisation, level.flicker, level.bias_walk
    )
    if noise.sample_variance == 0.0 and noise.random_walk == 0.0:
        return []
    names = {u.owner for u in model.unknowns if u.symbol in TERMS} or set(world.mountings)
    series = [
        world.series(run, name, truth.spindles[run])
        for run in range(len(world.runs))
        for name in world.mountings
        if name in names
    ]
    prepared = prepare_columns(series, model, scale_factors(series, model, truth))
    noises = dict.fromkeys(names, noise)
    return [part.block_in(model, noises) for part in prepared]
