"""The smooth prediction of runs against the joint fit of every sample."""

import math
from dataclasses import replace

import numpy as np
import pytest
from planning_setups import ATTITUDES, PLATFORM, PRIORS, TWO_MOUNTINGS, fit_u, make_setup

from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.planning.design import Design, RunType
from counterspin.planning.information_table import (
    basis_functions,
    integration_matrix,
    prefix_factors,
)
from counterspin.planning.run_information import Predictor, RunInformation

INPUTS = ("centrifuge.radius", "site.gravity", "records.timing_offset")
RATES, TURNS = (1.0, 7.0), (5.0, 33.0)

CASES = {
    "one accelerometer": {},
    "terms that only Earth rate tells apart": {"symbols": ("K_I", "K_II", "K_IP", "K_OO", "K_F")},
    "a kink": {"symbols": ("K_F", "K_I", "K_II", "K_OQ")},
    "attitudes": {
        "symbols": ("K_F", "K_I", "K_II", "K_PP", "K_OO", "delta_P"),
        "attitudes": ATTITUDES,
    },
    "random walk": {"noise": Noise(0.01, 3e-5)},
    "velocity": {"noise": Noise(1e-3, 3e-5), "observable": "velocity"},
    "specific force": {"noise": Noise(1e-3, 1e-5), "observable": "specific_force"},
    "two accelerometers": {
        "mountings": TWO_MOUNTINGS,
        "platform": (*PLATFORM, "platform.tilt.east", "platform.g_sensitivity.zy"),
        "priors": PRIORS | {"platform.tilt.east": 1e-6},
    },
    "time stamps": {"timing_noise": 1e-3},
    "time stamps alone": {"timing_noise": 5e-3, "noise": Noise(1e-3)},
    "time stamps and walk": {"timing_noise": 1e-3, "noise": Noise(1e-3, 3e-5)},
    "time stamps of velocity": {
        "timing_noise": 5e-3,
        "noise": Noise(1e-3),
        "observable": "velocity",
    },
    "time stamps of force": {
        "timing_noise": 5e-3,
        "noise": Noise(1e-2),
        "observable": "specific_force",
    },
    "time stamps of a large bias": {"timing_noise": 1e-3, "expected": 0.05},
    "inputs as unknowns": {"platform": (*PLATFORM, *INPUTS)},
    "considered terms and inputs": {
        "platform": ("platform.drift.north",),
        "considered": ("platform.tilt.north", "platform.g_sensitivity.zx", *INPUTS),
    },
}


HELD = {
    "platform": ("platform.drift.north",),
    "considered": ("platform.tilt.north", "records.clock", *INPUTS),
    "priors": PRIORS | {"records.clock": 2e-5},
}
CASES["a clock that is held"] = HELD

BOTH = (RunType("level", 1), RunType("level", -1))


def random_design(setup, rng):
    """Return six runs at random."""
    names = list(setup.attitudes)
    types = tuple(RunType(names[i % len(names)], int(rng.choice([-1, 1]))) for i in range(6))
    return Design(types, rng.uniform(1.2, 6.5, 6), rng.uniform(6.0, 32.0, 6))


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_prediction_matches_joint_fit(case):
    """Every u within 0.02 %: the lengths are of any part of a revolution and of a sample.

    With noise of the time stamps within 3 %: the best samples are those at an extremum, and the
    search takes what they tell on average.
    """
    rel = 0.03 if "timing_noise" in CASES[case] else 2e-4
    setup = make_setup(**CASES[case])
    predictor = Predictor(RunInformation(setup, RATES, TURNS, (1, -1)))
    design = random_design(setup, np.random.default_rng(5))
    assert predictor.u(design) == pytest.approx(fit_u(setup, design), rel=rel)


def test_prediction_with_few_samples_per_revolution():
    setup = make_setup(sampling_rate=5.0)
    predictor = Predictor(RunInformation(setup, RATES, TURNS, (1, -1)))
    # From 26 samples to a revolution down to 5, where the third harmonics are barely told apart.
    design = Design(BOTH * 2, np.array([1.2, 3.0, 5.0, 6.5]), np.array([7.3, 15.0, 24.7, 32.2]))
    assert predictor.u(design) == pytest.approx(fit_u(setup, design), rel=2e-4)


def test_columns_of_considered_term_serve_estimating_model():
    setup = make_setup(**HELD)
    others = (estimate_considered_term(one) for one in setup.model.considered)
    model = Unknowns((*setup.model.unknowns, *others))
    values = np.append(setup.expected, np.zeros(len(setup.model.considered)))
    estimated = replace(setup, model=model, expected=values)
    taken_over = RunInformation(setup, RATES, TURNS, (1, -1)).with_setup(estimated)
    anew = RunInformation(estimated, RATES, TURNS, (1, -1))
    design = random_design(setup, np.random.default_rng(3))
    u = Predictor(taken_over).u(design)
    assert u == pytest.approx(Predictor(anew).u(design), rel=1e-9)
    assert u == pytest.approx(fit_u(estimated, design), rel=2e-4)


def estimate_considered_term(held):
    """Return a term that is held as one that is estimated and not asked for."""
    return Unknown(held.owner, held.symbol, held.prior, held.limit, False, held.has_default_prior)


def test_integration_of_functions_is_exact():
    angle = np.linspace(0.0, 20.0, 200)
    for order in (1, 2):
        integral = basis_functions(angle, 3) @ integration_matrix(3, order)
        step = angle[1] - angle[0]
        derivative = integral
        for _ in range(order):
            derivative = np.gradient(derivative, step, axis=0, edge_order=2)
        inside = slice(3, -3)
        used = [0, 1, *range(4, 16)]  # th^2 and th^3 are results, not integrands
        error = derivative[inside, used] - basis_functions(angle, 3)[inside][:, used]
        # Second-order differences of sin 3 th times th: step^2/6 x 27 x 20.
        assert np.abs(error).max() < 2.0 * 27.0 * 20.0 * step**2


def test_prefix_factor_matches_previous_rows():
    rows = np.random.default_rng(1).standard_normal((40, 5))
    ends = np.array([10, 25, 40])
    for end, factor in zip(ends, prefix_factors(rows, ends, 2), strict=True):
        head, tail = rows[:end, :2], rows[:end, 2:]
        left = tail - head @ np.linalg.lstsq(head, tail, rcond=None)[0]
        assert factor.T @ factor == pytest.approx(left.T @ left, rel=1e-10, abs=1e-10)


def test_information_increases_with_run_length():
    setup = make_setup()
    information = RunInformation(setup, RATES, (5.0, 120.0), (1,))
    turns = np.linspace(5.0, 100.0, 60)
    blocks = information.blocks(BOTH[:1], np.full((turns.size, 1), 4.0), turns[:, None])[:, 0]
    gram = np.swapaxes(blocks, -1, -2) @ blocks
    scale = np.sqrt(np.diagonal(gram[-1]))
    gain = np.diff(gram / np.outer(scale, scale), axis=0)
    assert np.linalg.eigvalsh(gain).min() > -1e-4  # the spline's own error
    assert math.isclose(float(np.trace(gram[-1] / np.outer(scale, scale))), len(scale))
