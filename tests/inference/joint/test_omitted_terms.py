"""What a term left out is said to do is what it does to a fit that knows nothing of it."""

import math

import pytest
from joint_campaign import three_rates, unknowns

from counterspin.inference.joint.estimation import NoiseRequest, estimate
from counterspin.inference.joint.omitted_terms import sensitivities
from counterspin.inference.joint.unknowns import Considered, Unknowns
from counterspin.physics.shared_terms import DEGREE_PER_HOUR

PLAIN = {"K_F": 0.004, "K_I": 1.001, "K_II": 2e-5}
NOISE = {"Qx": NoiseRequest(0.01, 0.0)}


def fitted(coefficients, platform=None):
    model = Unknowns(tuple(unknowns(["K_F", "K_I", "K_II"])))
    return estimate(three_rates(coefficients, platform), model, NOISE, reject=False).fit


@pytest.mark.parametrize(
    ("owner", "symbol", "size"),
    [
        ("Qx", "K_OO", 1e-6),
        ("Qx", "K_PP", 1e-6),
        ("", "platform.g_sensitivity.zx", 0.1 * DEGREE_PER_HOUR),
        ("", "platform.drift.north", 0.01 * DEGREE_PER_HOUR),
    ],
)
def test_a_term_left_out_moves_the_estimates_as_said(owner, symbol, size):
    plain = fitted(PLAIN)
    there = {symbol: size}
    moved = fitted(PLAIN | there) if owner else fitted(PLAIN, there)
    term = Considered(owner, symbol, (0.0, 0.0), math.inf)
    said = sensitivities(plain, [term])[:, 0] * size
    really = moved.solution.estimate - plain.solution.estimate
    for index, unknown in enumerate(plain.model.unknowns):
        if unknown.symbol in ("K_F", "K_II"):
            assert really[index] == pytest.approx(said[index], rel=0.03), unknown.symbol
