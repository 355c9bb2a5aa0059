"""Readings: closed forms, and Monte-Carlo with machines drawn from their priors."""

import math
import os

import numpy as np
import pytest
from reading_campaigns import (
    TRUTH,
    arm,
    considered,
    model,
    readings,
    simulated,
    tumble,
    unknown,
)
from scipy import stats

from counterspin.errors import NotIdentifiableError
from counterspin.inference.identifiability import assess
from counterspin.inference.readings import solve_readings
from counterspin.physics.accelerometer import TERMS

TRIALS = 4000 if os.environ.get("COUNTERSPIN_FULL") else 300
SIGMA = 2e-6


def test_readings_without_noise_give_back_the_truth():
    rng = np.random.default_rng(1)
    tests = [tumble(), arm()]
    groups = [readings(test, simulated(test, rng, 0.0), SIGMA) for test in tests]
    fit = solve_readings(groups, model())
    nominal = np.array([TERMS[s].nominal for s in TRUTH])
    np.testing.assert_allclose(
        fit.solution.estimate + nominal, list(TRUTH.values()), rtol=1e-9, atol=1e-15
    )


def test_u_of_a_tumble_is_the_textbook_s():
    terms = ("K_F", "K_I", "delta_O", "K_II", "K_IP")
    fit = solve_readings([readings(tumble(), np.zeros(12), SIGMA)], model(terms))
    expected = [0.5, 0.408248, 0.408248, 0.816497, 0.816497]
    np.testing.assert_allclose(fit.solution.u / SIGMA, expected, rtol=0, atol=6e-7)


def test_what_one_g_cannot_tell_is_named():
    """a_I^2 + a_P^2 + a_O^2 = 1 at rest, in whatever attitude."""
    terms = ("K_F", "K_I", "K_II", "K_PP", "K_OO")
    asked = model(terms)
    fit = solve_readings([readings(tumble(24), np.zeros(24), SIGMA)], asked)
    assessment = assess(fit.solution, [u.symbol for u in asked.unknowns])
    assert not any(assessment.determined[s] for s in ("K_F", "K_II", "K_PP", "K_OO"))
    assert assessment.determined["K_I"]


def test_an_unseen_mistake_in_one_position_stands_out():
    rng = np.random.default_rng(3)
    values = simulated(tumble(), rng, SIGMA)
    values[5] += 160e-6
    fit = solve_readings([readings(tumble(), values, SIGMA)], model(("K_F", "K_I", "delta_O")))
    assert np.argmax(np.abs(fit.standardised[0])) == 5
    assert abs(fit.standardised[0][5]) > 50.0


def test_fewer_readings_than_unknowns_cannot_tell_their_noise():
    values = simulated(tumble(3), np.random.default_rng(2), SIGMA)
    with pytest.raises(NotIdentifiableError, match="without a stated uncertainty"):
        solve_readings([readings(tumble(3), values, None)], model(("K_F", "K_I", "delta_O")))


# What varies: the readings' noise, the head, and the machine, which is drawn from its priors.

U_STRETCH, U_DROOP, U_RADIUS, U_HEAD, U_ZERO = 5e-9, 2e-8, 2e-6, 5e-6, 2e-5
STRETCH = considered("centrifuge.stretch", U_STRETCH)
DROOP = considered("centrifuge.droop", U_DROOP)


def radius(side):
    return unknown(f"centrifuge.radius.{side}", (0.0, U_RADIUS), "")


CASES = {
    "tumble": ([tumble()], model(("K_F", "K_I", "delta_O")), {"u_head": U_HEAD}),
    "arm": ([arm()], model(others=(radius("inward"), radius("outward"))), {}),
    "arm, machine considered": ([arm()], model(considered=(STRETCH, DROOP)), {}),
    "arm, stretch estimated": (
        [arm()],
        model(others=(unknown("centrifuge.stretch", (0.0, U_STRETCH), ""),)),
        {},
    ),
    "mixed": (
        [tumble(), arm()],
        model(
            (*TRUTH, "delta_O"),
            others=(unknown("head.zero", (0.0, U_ZERO), ""), radius("inward"), radius("outward")),
            considered=(STRETCH, DROOP),
        ),
        {"u_head": U_HEAD},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("stated", [True, False], ids=["noise stated", "noise estimated"])
@pytest.mark.parametrize("case", CASES)
def test_unbiased_and_covers(case, stated):
    tests, asked, more = CASES[case]
    rng = np.random.default_rng(sum(map(ord, case)))
    truth = {u.symbol: TRUTH.get(u.symbol, 0.0) for u in asked.unknowns if u.owner}
    z, inside = [], 0
    everything = [*asked.unknowns, *asked.considered]
    for _ in range(TRIALS):
        machine = {u.symbol: rng.normal(0.0, u.prior[1]) for u in everything if not u.owner}
        groups = [
            readings(
                test,
                simulated(test, rng, SIGMA, machine, truth=truth, **more),
                SIGMA if stated else None,
                **more,
            )
            for test in tests
        ]
        fit = solve_readings(groups, asked)
        wanted = np.array([truth.get(u.symbol, machine.get(u.symbol)) for u in asked.unknowns])
        nominal = np.array([u.nominal for u in asked.unknowns])
        error = fit.solution.estimate + nominal - wanted
        z.append(error / fit.solution.u)
        inside += np.abs(z[-1]) < 1.96
    z = np.array(z)
    # Four standard errors of a mean, and of a share of 95 %, of so many trials.
    assert np.abs(z.mean(axis=0)).max() < 4.0 * 1.1 / math.sqrt(TRIALS)
    slack = 4.0 * math.sqrt(0.05 * 0.95 / TRIALS)
    share = inside / TRIALS
    if stated:
        assert np.abs(share - 0.95).max() < slack
    else:
        # Without Student's t the intervals of an estimated noise are short by what t says.
        dof = min(left for left in fit.dof if math.isfinite(left))
        short = 2.0 * stats.t.cdf(1.96, dof) - 1.0
        assert share.min() > short - slack
        assert share.max() < 0.95 + slack
