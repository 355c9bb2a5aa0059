"""Values printed in the paper, and exact values for its stated plan.

Xie, Liu, Qiao, Pan and Ren, "Second-order coefficient calibration method of accelerometer in
platform inertial navigation system tested on double turntable centrifuge", section 2.3, Tables 1
and 2, Eq. 26-34. Only the columns come from the package; the small least-squares problems are
solved here, so that the package's two-stage method has something to be compared with.
"""

import numpy as np
import pytest

from counterspin.physics import as_printed
from counterspin.physics.accelerometer import QX
from counterspin.physics.closed_forms import parabola
from counterspin.validation.cases import case

RADIUS, GRAVITY, SCALE_FACTOR = 2.5, 9.8, 1.001
RATES = np.pi * np.array([0.5, 1.0, 2.0])
SIGMA_DISPLACEMENT = 0.01
PRINTED_SIGMA_B2 = np.array(case("the paper's sigma(K_II)").given["sigma_b2"])  # after Eq. 31
PRINTED_SIGMA_K_II = 3.0362e-7  # after Eq. 34


def unweighted_sigma(columns, sigma):
    """Eq. 33, 34: the first unknown's standard uncertainty by the rows of the pseudo-inverse."""
    return np.sqrt(np.sum((np.linalg.pinv(columns)[0] * sigma) ** 2))


def weighted_sigma(columns, sigma):
    inverse = np.linalg.inv(np.linalg.qr(columns / sigma[:, None], mode="r"))
    return np.linalg.norm(inverse[0])


def compute_printed_columns(gravity=GRAVITY):
    return as_printed.second_stage_columns(RATES, RADIUS, gravity, SCALE_FACTOR)


def compute_exact_column(symbol):
    return np.array([parabola(symbol, QX, rate, RADIUS, GRAVITY) for rate in RATES])


@pytest.fixture(scope="module")
def stated_plan_sigma():
    """100 strobes at w0 t = pi/2 + 2 k pi, 0.01 m each, through Eq. 17 and 31 with known sigma."""
    sigma = []
    for rate in RATES:
        time = (np.pi / 2 + 2 * np.pi * np.arange(1, 101)) / rate
        polynomial = np.vander(time / time[-1], 3, increasing=True)
        row = np.linalg.pinv(polynomial)[2] / time[-1] ** 2
        sigma.append(SIGMA_DISPLACEMENT * np.linalg.norm(row))
    return np.array(sigma)


def test_printed_sigma_k_ii_follows_from_printed_sigma_b2():
    sigma = unweighted_sigma(compute_printed_columns(), PRINTED_SIGMA_B2)
    assert sigma == pytest.approx(3.0355e-7, abs=0.5e-11)
    assert sigma == pytest.approx(PRINTED_SIGMA_K_II, rel=3e-4)


def test_standard_gravity_deviates_from_printed_sigma_k_ii():
    sigma = unweighted_sigma(compute_printed_columns(gravity=9.80665), PRINTED_SIGMA_B2)
    assert sigma == pytest.approx(3.0375e-7, abs=0.5e-11)


def test_factor_one_quarter_doubles_sigma_k_ii():
    columns = compute_printed_columns()
    columns[:, 0] = compute_exact_column("K_II")
    assert unweighted_sigma(columns, PRINTED_SIGMA_B2) == pytest.approx(6.0709e-7, abs=0.5e-11)


def test_sigma_b2_of_stated_plan(stated_plan_sigma):
    np.testing.assert_allclose(stated_plan_sigma, [8.38735e-8, 3.35494e-7, 1.34198e-6], rtol=5e-6)


def test_sigma_b2_grows_with_square_of_rate(stated_plan_sigma):
    """An equal number of strobes in half the time; the printed values hardly depend on rate."""
    np.testing.assert_allclose(stated_plan_sigma[1:] / stated_plan_sigma[:-1], 4.0, rtol=1e-10)


def test_sigma_b2_is_independent_of_first_strobe(stated_plan_sigma):
    """Whether k runs from 0 or from 1 (the paper has both) shifts time, not the curvature."""
    time = (np.pi / 2 + 2 * np.pi * np.arange(100)) / RATES[0]
    row = np.linalg.pinv(np.vander(time / time[-1], 3, increasing=True))[2] / time[-1] ** 2
    assert np.linalg.norm(row) * SIGMA_DISPLACEMENT == pytest.approx(
        stated_plan_sigma[0], rel=1e-10
    )


@pytest.mark.parametrize(
    ("symbols", "drift", "expected"),
    [
        (("K_II", "K_F"), False, 5.312e-9),
        (("K_II",), False, 5.230e-9),
        (("K_II", "K_F"), True, 8.270e-9),
    ],
)
def test_exact_model_sigma_of_stated_plan(stated_plan_sigma, symbols, drift, expected):
    columns = [compute_exact_column(symbol) for symbol in symbols]
    if drift:  # relative to the nominal angle, a strobe has -1/2 K_I R C w0 t^2
        columns.append(-SCALE_FACTOR * RADIUS * RATES / 2)
    sigma = weighted_sigma(np.column_stack(columns), stated_plan_sigma)
    assert sigma == pytest.approx(expected, abs=0.5e-12)


def test_printed_columns_sigma_of_stated_plan(stated_plan_sigma):
    """The printed columns give smaller values for a K_II that is half the true value."""
    unweighted = unweighted_sigma(compute_printed_columns(), stated_plan_sigma)
    weighted = weighted_sigma(compute_printed_columns(), stated_plan_sigma)
    assert unweighted == pytest.approx(3.223e-9, abs=0.5e-12)
    assert weighted == pytest.approx(2.814e-9, abs=0.5e-12)
