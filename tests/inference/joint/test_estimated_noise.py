"""A wandering bias estimated, and what it does to the joint fit: coverage by seeded Monte-Carlo."""

import os
from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import add_noise, make_unknowns, simulate_three_rates
from scipy.stats import chi2
from scipy.stats import t as student

from counterspin.inference.joint.design_blocks import build_design_blocks
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import ESTIMATE, Noise
from counterspin.inference.noise.simulation import draw_bias_noise
from counterspin.physics.conditions import RunConditions

FULL = bool(os.environ.get("COUNTERSPIN_FULL"))
COEFFICIENTS = {"K_F": 5e-3, "K_I": 1.002, "K_II": 2e-5, "K_III": 3e-6}
TRUTH = np.array([5e-3, 2e-3, 2e-5, 3e-6])
MODEL = Unknowns(make_unknowns(list(COEFFICIENTS)))
UG = 9.8066e-6


def make_series(observable, **size):
    """Return series without noise; the second and third start later."""
    series = simulate_three_rates(COEFFICIENTS, observable=observable, **size)
    return [
        replace(
            record,
            trajectory=replace(record.trajectory, conditions=RunConditions(start=300.0 * place)),
        )
        for place, record in enumerate(series)
    ]


def add_wander(series, noise, rng):
    """Return the series with all noise components."""
    start = series.trajectory.conditions.start
    drawn = draw_bias_noise(rng, series.time, noise, series.order, start)
    plain = Noise(noise.white, noise.random_walk)
    return add_noise(replace(series, error=series.error + drawn), plain, rng)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("observable", "noise"),
    [
        ("displacement", Noise(5e-3, 1e-5, 0.0, 2 * UG, 0.0)),
        ("displacement", Noise(5e-3, 0.0, 0.0, 0.0, 0.5 * UG)),
        ("velocity", Noise(1e-3, 1e-5, 0.0, 2 * UG, 0.1 * UG)),
        ("specific_force", Noise(1e-3, 0.0, 0.0, 20 * UG, 1 * UG)),
    ],
    ids=["flicker", "walk of the bias", "both in velocity", "both in force"],
)
def test_given_wander_has_coverage(observable, noise):
    """z of the trials has the rms 1; without the wander it is several times that."""
    rng, trials = np.random.default_rng(8), 20 if FULL else 12
    prepared = build_design_blocks(make_series(observable), MODEL, {"Qx": 1.002})
    plain = Noise(noise.white, noise.random_walk)
    z, blind = [], []
    for _ in range(trials):
        drawn = [replace(one, series=add_wander(one.series, noise, rng)) for one in prepared]
        for known, scores in ((noise, z), (plain, blind)):
            solution = solve_joint(drawn, MODEL, {"Qx": known}).solution
            scores.append((solution.estimate - TRUTH) / solution.u)
    low, high = np.sqrt(chi2.ppf([1e-4, 1 - 1e-4], trials) / trials)
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert (rms > low).all()
    assert (rms < high).all()
    assert np.sqrt(np.mean(np.square(blind), axis=0))[0] > 3.0


def test_estimated_wander_has_coverage():
    """Fewer than 7 of 10 intervals of 95 % contain the truth with probability 0.001."""
    rng = np.random.default_rng(21)
    noise = Noise(5e-3, 0.0, 0.0, 5 * UG, 0.0)
    series = make_series("displacement", revolutions=6, per_revolution=16)
    request = {"Qx": Noise(ESTIMATE, 0.0, 0.0, ESTIMATE, 0.0)}
    held = np.zeros(4)
    for _ in range(10):
        drawn = [add_wander(record, noise, rng) for record in series]
        estimation = estimate(drawn, MODEL, request, rejects_outliers=False)
        solution, dof = estimation.fit.solution, np.minimum(estimation.dof, 1e6)
        held += np.abs(solution.estimate - TRUTH) < student.ppf(0.975, dof) * solution.u
    assert held[0] >= 7
    assert held[2] >= 7
