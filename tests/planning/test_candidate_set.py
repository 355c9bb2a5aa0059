"""What gains most within two limits, against a linear program."""

import math

import numpy as np
import pytest
from scipy.optimize import linprog

from counterspin.planning.candidate_set import _Relaxation
from counterspin.planning.design import Criterion


@pytest.mark.parametrize("total", [3.0, 40.0, 150.0, 1e4])
@pytest.mark.parametrize("spread", [0.1, 2.0])
@pytest.mark.parametrize("seed", range(5))
def test_largest_gain_matches_linear_program(seed, spread, total):
    """From a time that few may take of to one that does not count.

    Where gains are much alike, two observations share the limits; else one gains most by far.
    """
    rng, count, number = np.random.default_rng(seed), 60, 14.0
    cost, gains = rng.uniform(1.0, 20.0, count), rng.lognormal(0.0, spread, count)
    gains *= np.sqrt(cost)
    gains[cost < 2.0] *= 0.01
    criterion = Criterion((0,), (1.0,))
    Relaxation = _Relaxation(np.eye(1), criterion, np.ones((count, 1, 1)), cost, total, number)
    weight, price = Relaxation.linear_optimum(gains)
    limits = {"A_ub": [cost, np.ones(count)], "b_ub": [total, number]}
    expected = linprog(-gains, **limits, method="highs")
    assert gains @ weight == pytest.approx(-expected.fun, rel=1e-9)
    np.testing.assert_allclose(weight, expected.x, rtol=1e-6, atol=1e-9)
    assert price == pytest.approx(-expected.ineqlin.marginals[1], rel=1e-6, abs=1e-9)
    assert cost @ weight <= total * (1.0 + 1e-12)
    assert math.fsum(weight) <= number * (1.0 + 1e-12)
