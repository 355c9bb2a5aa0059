"""The Cramer-Rao bound of a study: the least uncertainty that its records allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from counterspin.inference.identifiability import assess
from counterspin.inference.joint.fit import JointFit, solve_joint
from counterspin.inference.joint.prepared import prepare_columns
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.physics.terms import TERMS
from counterspin.studies.draws import StudyTruth
from counterspin.studies.joint_engine import scale_factors
from counterspin.studies.noise import NOISE_LEVELS
from counterspin.studies.world import World


def cramer_rao(world: World, truth: StudyTruth, model: Unknowns) -> dict[str, float]:
    """Return the least standard uncertainty from all samples of the records, by unknown.

    The bound is that of the records' true noise, of the unknowns of the analysis with what is
    known of them beforehand (the posterior bound of van Trees), everything else being known. An
    unknown that the records do not determine has none.
    """
    fit = fit_of_truth(world, truth, Unknowns(model.unknowns))
    if fit is None:
        return {}
    determined = assess(fit.solution, [u.name for u in model.unknowns]).determined
    variance = np.diag(fit.solution.covariance_noise + fit.solution.covariance_prior)
    return {
        u.name: float(np.sqrt(v))
        for u, v in zip(model.unknowns, variance, strict=True)
        if determined[u.name]
    }


def fit_of_truth(world: World, truth: StudyTruth, model: Unknowns) -> JointFit | None:
    """Return the joint fit of the records with their true noise; None without noise."""
    draws = truth.draw(np.random.default_rng(0), 256)
    levels = {NOISE_LEVELS[symbol][1]: float(level.mean()) for symbol, level in draws.noise.items()}
    world = replace(world, noise=replace(world.noise, white=float(draws.white.mean()), **levels))
    level = world.noise
    noise = Noise(
        level.white, level.random_walk, level.quantisation, level.flicker, level.bias_walk
    )
    if noise.sample_variance == 0.0 and noise.random_walk == 0.0:
        return None
    names = {u.owner for u in model.unknowns if u.symbol in TERMS} or set(world.mountings)
    series = [
        world.series(run, name, truth.spindles[run])
        for run in range(len(world.runs))
        for name in world.mountings
        if name in names
    ]
    prepared = prepare_columns(series, model, scale_factors(series, model, truth))
    return solve_joint(prepared, model, dict.fromkeys(names, noise))
