"""The smooth prediction of runs against the joint fit of every sample."""

import math

import numpy as np
import pytest
from planning_setups import ATTITUDES, PLATFORM, PRIORS, TWO, make_setup, u_by_joint_fit

from counterspin.inference.noise.model import NoiseModel
from counterspin.planning.angle_functions import functions, integration, prefix_factors
from counterspin.planning.design import Design, Predictor, RunType
from counterspin.planning.run_information import RunInformation

RATES, TURNS = (1.0, 7.0), (5.0, 120.0)

CASES = {
    "one accelerometer": {},
    "terms that only Earth rate tells apart": {"symbols": ("K_I", "K_II", "K_IP", "K_OO", "K_F")},
    "a kink": {"symbols": ("K_F", "K_I", "K_II", "K_OQ")},
    "attitudes": {
        "symbols": ("K_F", "K_I", "K_II", "K_PP", "K_OO", "delta_P"),
        "attitudes": ATTITUDES,
    },
    "random walk": {"noise": NoiseModel(0.01, 3e-5)},
    "velocity": {"noise": NoiseModel(1e-3, 3e-5), "observable": "velocity"},
    "specific force": {"noise": NoiseModel(1e-3, 1e-5), "observable": "specific_force"},
    "two accelerometers": {
        "mountings": TWO,
        "platform": (*PLATFORM, "platform.tilt.east", "platform.g_sensitivity.zy"),
        "priors": PRIORS | {"platform.tilt.east": 1e-6},
    },
    "jitter": {"jitter": 1e-3},
    "considered terms and inputs": {
        "platform": ("platform.drift.north",),
        "considered": ("platform.tilt.north", "platform.g_sensitivity.zx"),
        "inputs": {"centrifuge.radius": 1e-4, "site.gravity": 1e-5, "records.timing_offset": 1e-3},
    },
}


def design_of(setup, rng, *, whole):
    """Return six runs at random, of whole revolutions or not."""
    names = list(setup.attitudes)
    types = tuple(RunType(names[i % len(names)], int(rng.choice([-1, 1]))) for i in range(6))
    turns = rng.uniform(6.0, 60.0, 6)
    return Design(types, rng.uniform(1.2, 6.5, 6), np.round(turns) if whole else turns)


@pytest.mark.parametrize("whole", [True, False], ids=["whole revolutions", "any length"])
@pytest.mark.parametrize("case", CASES)
def test_prediction_is_the_joint_fit_s(case, whole):
    setup = make_setup(**CASES[case])
    predictor = Predictor(RunInformation(setup, RATES, TURNS, (1, -1)))
    design = design_of(setup, np.random.default_rng(5), whole=whole)
    # A record of n samples is taken as the n - 1 steps between them: half of one in the 300 of
    # the shortest run, twice where it fixes a u by itself. A fraction of a revolution counts for
    # a fraction of 1/(2 pi 6).
    assert predictor.u(design) == pytest.approx(
        u_by_joint_fit(setup, design), rel=4e-3 if whole else 0.04
    )


def test_integration_of_the_functions_is_exact():
    angle = np.linspace(0.0, 20.0, 200)
    for order in (1, 2):
        integral = functions(angle, 3) @ integration(3, order)
        step = angle[1] - angle[0]
        derivative = integral
        for _ in range(order):
            derivative = np.gradient(derivative, step, axis=0, edge_order=2)
        inside = slice(3, -3)
        used = [0, 1, *range(4, 16)]  # th^2 and th^3 are results, not integrands
        error = derivative[inside, used] - functions(angle, 3)[inside][:, used]
        # Second-order differences of sin 3 th times th: step^2/6 x 27 x 20.
        assert np.abs(error).max() < 2.0 * 27.0 * 20.0 * step**2


def test_prefix_factor_is_that_of_the_rows_so_far():
    rows = np.random.default_rng(1).standard_normal((40, 5))
    ends = np.array([10, 25, 40])
    for end, factor in zip(ends, prefix_factors(rows, ends, 2), strict=True):
        head, tail = rows[:end, :2], rows[:end, 2:]
        left = tail - head @ np.linalg.lstsq(head, tail, rcond=None)[0]
        assert factor.T @ factor == pytest.approx(left.T @ left, rel=1e-10, abs=1e-10)


def test_no_run_says_more_than_a_longer_one():
    setup = make_setup()
    information = RunInformation(setup, RATES, TURNS, (1,))
    turns = np.linspace(5.0, 100.0, 60)
    blocks = information.blocks("level", 1, np.full(turns.size, 4.0), turns)
    gram = np.swapaxes(blocks, -1, -2) @ blocks
    scale = np.sqrt(np.diagonal(gram[-1]))
    gain = np.diff(gram / np.outer(scale, scale), axis=0)
    assert np.linalg.eigvalsh(gain).min() > -1e-4  # the spline's own error
    assert math.isclose(float(np.trace(gram[-1] / np.outer(scale, scale))), len(scale))
