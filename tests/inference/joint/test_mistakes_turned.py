"""A fit with an accelerometer turned is the fit that its mounting, stated so, would have given."""

import math
from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import add_noise, make_unknowns, simulate_three_rates

from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.fit import estimate_considered
from counterspin.inference.joint.mistakes import (
    CROSS_AXIS_SYMBOLS,
    rotate_accelerometer,
    rotate_mounting,
)
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.physics.accelerometer import QX, Mounting

PRIORS = {
    "K_F": (0.005, 2e-6),
    "K_I": (1.002, 5e-6),
    "K_OO": (2e-6, 1e-8),
    "K_IO": (3e-6, 1e-8),
    "K_PP": (0.0, 1e-6),
    "delta_O": (1e-5, 1e-6),
}
MODEL = Unknowns(make_unknowns(["K_F", "K_I", "K_II", "K_OO", "K_IO", "K_PP", "delta_O"], PRIORS))
#: Where the pendulous axis, stated as down, points after so many quarters.
POINTS = {1: "north", 2: "up", 3: "south"}


def test_cross_axis_terms():
    assert set(CROSS_AXIS_SYMBOLS) == {"K_IP", "K_IO", "K_PO", "K_PP", "K_OO", "delta_O", "delta_P"}


@pytest.mark.parametrize("quarters", POINTS)
def test_quarter_turn_rotates_pendulous_to_output_axis(quarters):
    other = rotate_mounting(QX, quarters)
    np.testing.assert_allclose(
        other.matrix, Mounting.from_axes("east", POINTS[quarters]).matrix, atol=1e-15
    )
    assert np.linalg.det(other.matrix) == pytest.approx(1.0)


@pytest.mark.parametrize("observable", ["displacement", "specific_force"])
@pytest.mark.parametrize("quarters", POINTS)
def test_rotated_fit_matches_fit_of_other_mounting(observable, quarters):
    rng, white = np.random.default_rng(3), 0.01 if observable == "displacement" else 1e-4
    truth = {"K_F": 0.005, "K_I": 1.002, "K_II": 2.7e-5, "K_OO": 2e-6, "K_IO": 3e-6}
    series = [
        add_noise(record, Noise(white), rng)
        for record in simulate_three_rates(truth, observable=observable)
    ]
    request = {"Qx": Noise(white, 0.0)}
    solution = rotate_accelerometer(
        estimate_considered(estimate(series, MODEL, request, rejects_outliers=False).fit),
        "Qx",
        quarters,
    ).solution
    other = Mounting.from_axes("east", POINTS[quarters])
    stated = [replace(record, mounting=other) for record in series]
    wanted = estimate_considered(
        estimate(stated, MODEL, request, rejects_outliers=False).fit
    ).solution
    # The rest of the columns knows of the other terms in second order only.
    np.testing.assert_allclose(
        solution.estimate, wanted.estimate, atol=1e-6 * float(np.max(wanted.u)), rtol=1e-6
    )
    assert solution.chi2 == pytest.approx(wanted.chi2, rel=1e-6)
    assert math.isfinite(solution.chi2)


def test_other_accelerometer_is_unchanged():
    series = simulate_three_rates({"K_F": 0.005, "K_I": 1.002, "K_OO": 2e-6})
    fit = estimate_considered(
        estimate(series, MODEL, {"Qx": Noise(0.01, 0.0)}, rejects_outliers=False).fit
    )
    np.testing.assert_array_equal(
        rotate_accelerometer(fit, "Qy", 1).solution.estimate, fit.solution.estimate
    )
