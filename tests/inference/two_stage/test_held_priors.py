"""Priors of the two-stage method, each against a fit without it."""

import math

import numpy as np
import pytest

from counterspin.inference.two_stage.first_stage import first_stage
from counterspin.inference.two_stage.held_priors import held_priors
from counterspin.inference.two_stage.request import TwoStageRequest
from counterspin.inference.two_stage.second_stage import StrobedRun, second_stage
from counterspin.inference.two_stage.strobes import Strobes
from counterspin.physics import observation, simulation
from counterspin.physics.accelerometer import QX
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.spindle import Spindle

RATES = (math.pi / 2, math.pi, 1.5 * math.pi, 2 * math.pi)
SITE = Site(9.8, 0.8)
TRUTH = {"K_F": 0.004, "K_I": 1.001, "K_II": 2e-5}
SIGMA, PSI = 0.01, "platform.tilt.north"
PRIORS = {"K_F": (0.00402, 2e-6), "K_I": (1.001, 0.0), PSI: (0.0, 2e-6)}


def runs():
    rng = np.random.default_rng(3)
    found = []
    for rate in RATES:
        motion = Trajectory(Spindle(rate), 2.5, SITE)
        time = motion.spindle.time_at(2 * math.pi * np.arange(1, 101))
        error = simulation.recorded(motion, QX, TRUTH, {}, time)
        error = error - observation.reference(motion, QX, time) + rng.normal(0.0, SIGMA, 100)
        strobes = Strobes(time, error, np.ones(100), lost=0)
        found.append(StrobedRun(f"{rate:.2f}", motion, first_stage(strobes, SIGMA)))
    return found


RUNS = runs()


def resolved(priors):
    return second_stage(RUNS, QX, TwoStageRequest(priors=priors), ignored=())


@pytest.fixture(scope="module")
def held():
    return {(each.run, each.symbol): each for each in held_priors(resolved(PRIORS))}


def test_an_estimated_term_is_held_to_the_fit_without_its_prior(held):
    """Generalised least squares, what is considered being part of each run's covariance."""
    known = held["", "K_F"]
    assert (known.stated, known.spread) == PRIORS["K_F"]
    second = resolved(PRIORS)
    moved = second.fixed * second.solution.considered_sd
    weight = np.linalg.inv(np.diag(second.sigma**2) + moved @ moved.T)
    b2 = np.array([run.parabola.b2 for run in RUNS]) - second.fixed @ second.assumed
    covariance = np.linalg.inv(second.design.T @ weight @ second.design)
    place = second.symbols.index("K_F")
    value = (covariance @ second.design.T @ weight @ b2)[place]
    assert known.excess == pytest.approx(0.00402 - value, rel=1e-6)
    assert known.u == pytest.approx(math.hypot(2e-6, covariance[place, place] ** 0.5), rel=1e-6)
    assert known.excess / known.u > 5.0


def test_without_anything_considered_it_is_the_textbook_s():
    plain = {"K_F": PRIORS["K_F"], "K_I": PRIORS["K_I"]}
    (known,) = held_priors(resolved(plain))
    value, u = resolved({**plain, "K_F": (0.00402, math.inf)}).estimate("K_F")
    assert known.excess == pytest.approx(0.00402 - value, rel=1e-6)
    assert known.u == pytest.approx(math.hypot(u, 2e-6), rel=1e-6)


def test_a_tilt_of_every_run_is_held_run_by_run_and_together(held):
    assert {run for run, symbol in held if symbol == PSI} == {"", *(run.name for run in RUNS)}
    # All tilts alike are a bias: g psi is K_F, and tells the same of the same mistake.
    together, bias = held["", PSI], held["", "K_F"]
    assert together.excess / together.u == pytest.approx(-bias.excess / bias.u, rel=1e-6)


def test_what_nothing_else_tells_is_not_tested():
    # As many runs as unknowns, K_F's prior among what is needed.
    second = second_stage(RUNS[:1], QX, TwoStageRequest(priors={"K_F": (0.004, 2e-6)}), ignored=())
    assert held_priors(second) == []


def test_an_exact_value_is_no_prior():
    priors = {**PRIORS, "K_F": (0.004, 0.0)}
    assert ("", "K_F") not in {(h.run, h.symbol) for h in held_priors(resolved(priors))}
