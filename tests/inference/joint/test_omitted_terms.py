"""What a term left out is said to do is what it does to a fit that knows nothing of it."""

import math

import numpy as np
import pytest
from joint_campaign import three_rates, unknowns

from counterspin.inference.joint import omitted_terms
from counterspin.inference.joint.estimation import NoiseRequest, estimate
from counterspin.inference.joint.omitted_terms import sensitivities
from counterspin.inference.joint.unknowns import Considered, Unknowns
from counterspin.physics.terms import DEGREE_PER_HOUR, term

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
    left_out = Considered(owner, symbol, (0.0, 0.0), math.inf)
    said = sensitivities(plain, [left_out])[:, 0] * size
    really = moved.solution.estimate - plain.solution.estimate
    for index, unknown in enumerate(plain.model.unknowns):
        if unknown.symbol in ("K_F", "K_II"):
            assert really[index] == pytest.approx(said[index], rel=0.03), unknown.symbol


@pytest.mark.parametrize("walk", [0.0, 1e-4])
def test_long_records_may_be_thinned(walk, monkeypatch):
    """At typical sizes by less than 1 % of u, or 0.1 % of what a term does, from all rows."""
    model = Unknowns(tuple(unknowns(["K_F", "K_I", "K_II", "K_III"])))
    series = three_rates(PLAIN, per_revolution=64, revolutions=80)
    fit = estimate(series, model, {"Qx": NoiseRequest(0.01, walk)}, reject=False).fit
    symbols = {"Qx": ("K_OO", "K_4", "K_OQ", "delta_O")} | {
        "": ("platform.drift.north", "platform.g_sensitivity.yz", "platform.compliance.zx")
    }
    left_out = [
        Considered(owner, symbol, (0.0, 0.0), math.inf)
        for owner, own in symbols.items()
        for symbol in own
    ]
    sizes = np.array([term(one.symbol).typical for one in left_out])
    inputs = {"centrifuge.radius": 1e-5, "records.timing_offset": 1e-5}
    thinned = sensitivities(fit, left_out, inputs) * [*sizes, *inputs.values()]
    monkeypatch.setattr(omitted_terms, "_SENSITIVITY_ROWS", 10**9)
    whole = sensitivities(fit, left_out, inputs) * [*sizes, *inputs.values()]
    allowed = 0.01 * fit.solution.u[:, None] + 1e-3 * np.abs(whole)
    assert (np.abs(thinned - whole) < allowed).all()
