"""Noise that was found: degrees of freedom and hidden walks, against resolving it again."""

import math

import numpy as np
import pytest

from counterspin.inference.joint.budget import budget
from counterspin.inference.noise.components import NOISE_COMPONENTS
from counterspin.inference.noise.model import Noise
from counterspin.inference.noise.search import NoiseEstimate, effective_dof
from counterspin.inference.noise.undetected_walk import UndetectedWalk, marginal_walk
from counterspin.inference.two_stage.first_stage import Strobes
from counterspin.inference.two_stage.model import TwoStageRequest
from counterspin.inference.two_stage.second_stage import (
    StrobedRun,
    apply_noise_uncertainty,
    second_stage,
)
from counterspin.physics.accelerometer import QX
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.spindle import Spindle

SITE = Site(9.8, 0.8)
RATES = (1.5, 3.0, 6.0)
PRIORS = {"K_III": (0.0, 1e-6)}


def estimated_noise(white, walk, *, estimated=("white", "random_walk"), unseen=None):
    covariance = np.diag([1e-11, 0.0, 0.0, 0.0])
    if walk:
        covariance[:2, :2] = [[1e-11, -2e-13], [-2e-13, 4e-14]]
    return NoiseEstimate(
        noise=Noise(white, walk),
        covariance=covariance,
        estimated=estimated,
        dropped=() if walk else ("random_walk",),
        log_likelihoods={},
        degrees_of_freedom=100.0,
        evaluations=1,
        undetected_walk=unseen,
    )


def solve_second_stage(noise):
    """Return runs and their second stage with this noise."""
    request = TwoStageRequest(priors=PRIORS, random_walk=None).with_noise(noise)
    runs = []
    for rate in RATES:
        motion = Trajectory(Spindle(rate), 2.5, SITE)
        time = (math.pi / 2 + 2 * math.pi * np.arange(1, 21)) / rate
        strobes = Strobes(time, np.zeros(20), np.linspace(0.8, 1.0, 20), lost=0)
        runs.append(StrobedRun(str(rate), motion, request.first_stage(strobes, motion)))
    return runs, second_stage(runs, QX, request)


def test_degrees_of_freedom_match_refit_with_other_noise():
    components = estimated_noise(0.01, 1e-3)
    _, second = solve_second_stage(components.noise)
    wider = apply_noise_uncertainty(second, components.noise, components)

    def variance(white=1.0, walk=1.0):
        level = Noise(0.01 * math.sqrt(white), 1e-3 * math.sqrt(walk))
        return np.diag(solve_second_stage(level)[1].fit.solution.covariance_noise)

    # The gains move with the noise, which at the optimum costs nothing of first order.
    by_white, by_walk = (
        (variance(**{name: 1.01}) - variance(**{name: 0.99})) / (0.02 * size)
        for name, size in (("white", 1e-4), ("walk", 1e-6))
    )
    slopes = np.column_stack([by_white, by_walk])
    expected = effective_dof(variance(), slopes, components.covariance[:2, :2])
    np.testing.assert_allclose(wider.dof, expected, rtol=1e-3)
    assert np.isfinite(wider.dof).all()
    assert wider.fit.solution.covariance_undetected is None


def test_undetected_walk_is_propagated_with_same_weights():
    unseen = UndetectedWalk(np.array([1e-8, 1e-7, 1e-6]), np.array([0.5, 0.3, 0.2]))
    components = estimated_noise(0.01, 0.0, estimated=("white",), unseen=unseen)
    runs, second = solve_second_stage(components.noise)
    wider = apply_noise_uncertainty(second, components.noise, components)
    # The same gains on strobes with the walk's covariance, an integral over the white noise.
    slope = np.zeros((2, 2))
    for place, run in enumerate(runs):
        time = run.parabola.strobes.time
        nodes, weights = np.polynomial.legendre.leggauss(200)
        moments = np.maximum(time[:, None] - time[-1] * (1 + nodes) / 2, 0.0)
        walk = (moments * weights * time[-1] / 2) @ moments.T
        curvature = run.parabola.gain[2]
        slope += (
            curvature @ walk @ curvature * np.outer(second.gain[:, place], second.gain[:, place])
        )
    level, _ = marginal_walk(unseen, np.diag(second.fit.solution.covariance), np.diag(slope))
    np.testing.assert_allclose(wider.fit.solution.covariance_undetected, level * slope, rtol=1e-3)
    before = np.diag(second.fit.solution.covariance)
    after = np.diag(wider.fit.solution.covariance)
    np.testing.assert_allclose(after, before + level * np.diag(slope), rtol=1e-3)
    assert (after > 1.2 * before).any()
    # The budget says so in a line of its own.
    unit = NOISE_COMPONENTS["random_walk"].unit
    (line,) = [line for line in budget(wider.fit, 0) if line.unit == unit]
    assert line.contribution == pytest.approx(math.sqrt(level * slope[0, 0]), rel=1e-3)
    assert np.isfinite(wider.dof).all()


def test_exactly_known_unknown_is_fixed():
    unseen = UndetectedWalk(np.array([1e-7]), np.array([1.0]))
    components = estimated_noise(0.01, 0.0, estimated=("white",), unseen=unseen)
    request = TwoStageRequest(priors={"K_II": (2e-5, 0.0)}, random_walk=None)
    request = request.with_noise(components.noise)
    runs, _ = solve_second_stage(components.noise)
    second = second_stage(runs, QX, request)
    wider = apply_noise_uncertainty(second, components.noise, components)
    assert wider.estimate("K_II") == (2e-5, 0.0)
    assert wider.estimate("K_F")[1] > 0.0


def test_stated_noise_is_not_replaced():
    request = TwoStageRequest(sigma=0.02, random_walk=0.0)
    assert request.with_noise(estimated_noise(0.01, 1e-3).noise) is request
    two_stage_request = TwoStageRequest(random_walk=None, from_residuals=True)
    assert two_stage_request.with_noise(estimated_noise(0.01, 1e-3).noise).sigma is None
    assert two_stage_request.with_noise(
        estimated_noise(0.01, 1e-3).noise
    ).random_walk == pytest.approx(1e-3)
