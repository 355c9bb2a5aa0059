"""A wandering bias estimated, and what it does to the joint fit: coverage by seeded Monte-Carlo."""

import math
from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import noisy, three_rates, unknowns
from scipy.stats import chi2
from scipy.stats import t as student

from counterspin.inference.joint.estimation import NoiseRequest, estimate
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.prepared import prepare_columns
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import NoiseModel, make_whitener
from counterspin.inference.noise.restricted_likelihood import (
    Ratios,
    RecordData,
    RestrictedLikelihood,
)
from counterspin.inference.noise.wander_components import estimate_wandering
from counterspin.physics.effects import RunConditions
from counterspin.physics.simulation import bias_wander

COEFFICIENTS = {"K_F": 5e-3, "K_I": 1.002, "K_II": 2e-5, "K_III": 3e-6}
TRUTH = np.array([5e-3, 2e-3, 2e-5, 3e-6])
MODEL = Unknowns(unknowns(list(COEFFICIENTS)))
UG = 9.8066e-6


def campaign(observable, **size):
    """Series without noise; the second and third begin later."""
    series = three_rates(COEFFICIENTS, observable=observable, **size)
    return [
        replace(
            one, trajectory=replace(one.trajectory, conditions=RunConditions(start=300.0 * place))
        )
        for place, one in enumerate(series)
    ]


def wandering(series, noise, rng):
    """The series with all of its noise."""
    start = series.trajectory.conditions.start
    drawn = bias_wander(rng, series.time, noise.flicker, noise.bias_walk, series.order, start)
    plain = NoiseModel(noise.white, noise.random_walk)
    return noisy(replace(series, error=series.error + drawn), plain, rng)


# The likelihood


@pytest.mark.parametrize("order", [1, 2])
def test_likelihood_is_that_of_the_whitened_rows(order):
    """Patterson and Thompson's, with the whitener whose rows are tested for themselves."""
    rng = np.random.default_rng(5)
    times = np.linspace(0.0, 200.0, 101)
    design = np.column_stack([times**order, np.cos(0.3 * times)])
    values = rng.standard_normal(times.size)
    records = [RecordData(times, order, design, values, before=50.0)]
    likelihood = RestrictedLikelihood.of(records, None, None)
    white = 0.7
    found = likelihood.value(math.log(white), Ratios(1e-4, 1e-5, 1e-6))
    noise = NoiseModel(*(math.sqrt(white * part) for part in (1.0, 1e-4)), 0.0)
    noise = replace(noise, flicker=math.sqrt(white * 1e-5), bias_walk=math.sqrt(white * 1e-6))
    whitener = make_whitener(times, order, noise, before=50.0)
    x, y = whitener.apply(design), whitener.apply(values)
    _, log_information = np.linalg.slogdet(x.T @ x)
    left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    expected = -(whitener.log_det + log_information + left @ left) / 2
    assert found == pytest.approx(expected, rel=1e-9)


# What is found


def test_sizes_are_found():
    """Two records of specific force: each size within three of its standard errors."""
    rng = np.random.default_rng(11)
    noise = NoiseModel(1e-4, 0.0, 0.0, flicker=4e-5, bias_walk=0.0)
    times = np.arange(400) * 0.5
    records = [
        RecordData(
            times,
            0,
            np.ones((times.size, 1)),
            noise.white * rng.standard_normal(times.size)
            + bias_wander(rng, times, noise.flicker, 0.0, 0),
            places=[0],
        )
        for _ in range(2)
    ]
    found = estimate_wandering(records, NoiseRequest(None, 0.0, 0.0, None, 0.0))
    assert found.estimated == ("white", "flicker")
    for place, name in ((0, "white"), (2, "flicker")):
        square = getattr(noise, name) ** 2
        error = math.sqrt(found.covariance[place, place])
        assert error < square
        assert abs(getattr(found, name) ** 2 - square) < 3 * error


def test_a_wander_that_is_not_there_is_dropped_or_small():
    rng = np.random.default_rng(4)
    times = np.arange(400) * 0.5
    white = 1e-3 * rng.standard_normal(times.size)
    records = [RecordData(times, 1, np.empty((times.size, 0)), white)]
    found = estimate_wandering(records, NoiseRequest(None, 0.0, 0.0, None, None))
    assert found.white == pytest.approx(1e-3, rel=0.1)
    assert "bias_walk" in found.dropped
    # Over the whole record it would add less than the white noise of one sample.
    assert found.flicker * times[-1] < 2e-3


# Coverage


@pytest.mark.parametrize(
    ("observable", "noise"),
    [
        ("displacement", NoiseModel(5e-3, 1e-5, 0.0, 2 * UG, 0.0)),
        ("displacement", NoiseModel(5e-3, 0.0, 0.0, 0.0, 0.5 * UG)),
        ("velocity", NoiseModel(1e-3, 1e-5, 0.0, 2 * UG, 0.1 * UG)),
        ("specific_force", NoiseModel(1e-3, 0.0, 0.0, 20 * UG, 1 * UG)),
    ],
    ids=["flicker", "walk of the bias", "both in velocity", "both in force"],
)
def test_given_wander_is_covered(observable, noise):
    """z of the trials has the rms 1; without the wander it is several times that."""
    rng, trials = np.random.default_rng(8), 20
    prepared = prepare_columns(campaign(observable), MODEL, {"Qx": 1.002})
    plain = NoiseModel(noise.white, noise.random_walk)
    z, blind = [], []
    for _ in range(trials):
        drawn = [replace(one, series=wandering(one.series, noise, rng)) for one in prepared]
        for known, scores in ((noise, z), (plain, blind)):
            solution = solve_joint(drawn, MODEL, {"Qx": known}).solution
            scores.append((solution.estimate - TRUTH) / solution.u)
    low, high = np.sqrt(chi2.ppf([1e-4, 1 - 1e-4], trials) / trials)
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert (rms > low).all()
    assert (rms < high).all()
    assert np.sqrt(np.mean(np.square(blind), axis=0))[0] > 3.0


def test_estimated_wander_is_covered():
    """95 % intervals of K_F and K_II hold the truth: fewer than 7 of 10 happen once in 1000."""
    rng = np.random.default_rng(21)
    noise = NoiseModel(5e-3, 0.0, 0.0, 5 * UG, 0.0)
    series = campaign("displacement", revolutions=6, per_revolution=16)
    request = {"Qx": NoiseRequest(None, 0.0, 0.0, None, 0.0)}
    held = np.zeros(4)
    for _ in range(10):
        drawn = [wandering(one, noise, rng) for one in series]
        found = estimate(drawn, MODEL, request, reject=False)
        solution, dof = found.fit.solution, np.minimum(found.dof, 1e6)
        held += np.abs(solution.estimate - TRUTH) < student.ppf(0.975, dof) * solution.u
    assert held[0] >= 7
    assert held[2] >= 7
