"""Linear sensitivities against a reciprocal radius with known distribution."""

import math

import numpy as np
import pytest
from scipy import stats

import counterspin as cs
from counterspin.calibration.linearity import Response
from counterspin.calibration.monte_carlo import draw_errors
from counterspin.calibration.pages.budget import interval_blocks
from counterspin.calibration.result_parts import Coefficient
from counterspin.inference.distributions import numerical_tolerance

CAMPAIGN = """schema = 1
site = {{ gravity = "9.8 m/s^2", latitude = "45 deg" }}
centrifuge = {{ radius = {radius} }}
[accelerometers.A]
input_axis = "west"
pendulous_axis = "up"
[model]
terms = ["K_F", "K_I"]
assume = "all"
"""
RATES = (3.0, 6.0, 9.0, 12.0)
U_RADIUS = 0.03


def calibrate(folder, u_radius, prior="", rates=RATES):
    """Calibrate a perfect accelerometer at a radius of 1 m."""
    runs = "".join(
        f'[[runs]]\nname = "r{rate}"\nmotion = "arm"\nrate = "{rate} rad/s"\n'
        f'axes = {{ input = "inward", pendulous = "up" }}\n'
        f'reading = "{rate**2 / 9.8:.9f} ± 1e-6 g"\n'
        for rate in rates
    )
    text = CAMPAIGN.format(radius=f'"1 ± {u_radius} m"') + prior + runs
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return cs.calibrate(folder, monte_carlo=200_000)


def test_large_radius_uncertainty_has_second_order_response(tmp_path):
    """K_I = 1/(1 + x) for a radius of 1 + x m, with x normal.

    At -2 u the exact value differs from the linear one by (2 u)^2/(1 - 2 u).
    """
    result = calibrate(tmp_path, U_RADIUS)
    k_i = result.accelerometers["A"].monte_carlo["K_I"]
    difference = (2 * U_RADIUS) ** 2 / (1 - 2 * U_RADIUS)
    assert k_i.linear_difference == pytest.approx(difference, rel=1e-3)
    assert k_i.second_order == ["centrifuge.radius"]
    exact = 1.0 / (1.0 + U_RADIUS * stats.norm.ppf(np.linspace(0.0, 1.0, 200_002)[1:-1]))
    # The linear response has 0.0300 and the interval from 0.941 to 1.059.
    assert k_i.u == pytest.approx(exact.std(), rel=0.005)
    # The shortest interval is less than 1 % shorter, so the symmetric interval is stated.
    assert [k_i.low, k_i.high] == pytest.approx(np.quantile(exact, [0.025, 0.975]), abs=5e-4)
    assert k_i.gum_validated is False
    text = "".join(map(str, interval_blocks("A", result)))
    assert "Monte Carlo trials use second-order sensitivities for K_I (centrifuge.radius)" in text


def test_small_radius_uncertainty_is_linear(tmp_path):
    """At 2 u the second order is (2e-5)^2 = 4e-10; the tolerance for u = 1e-5 is 5e-7."""
    result = calibrate(tmp_path, 1e-5)
    k_i = result.accelerometers["A"].monte_carlo["K_I"]
    assert k_i.linear_difference == pytest.approx(4e-10, rel=0.05)
    assert k_i.tolerance == 5e-7
    assert k_i.second_order == []
    text = "".join(map(str, interval_blocks("A", result)))
    assert "use linear sensitivities" in text


def test_joint_response_of_sources_is_included(tmp_path):
    """The product of two sources is not in the response of a single source.

    At two rates, K_I = 1/(1 + x) - k (a_1 + a_2) (1 + x) for a radius of 1 + x m and K_II = k.
    """
    u_k, rates = 2e-3, (3.0, 12.0)
    prior = f'[model.priors]\nK_II = "0 ± {u_k} g/g^2"\n'
    result = calibrate(tmp_path, U_RADIUS, prior, rates)
    level = sum(rate**2 for rate in rates) / 9.8
    limit = 2 * U_RADIUS
    differences = []
    generator = np.random.default_rng(102)
    # K_II is first, because it has all of the variance of K_F.
    for k, x in generator.uniform(-2.0, 2.0, (4, 2)) * [u_k, U_RADIUS]:
        # The parabola of the radius is exact at 0 and at both limits.
        odd = 0.5 * (1 / (1 + limit) - 1 / (1 - limit)) * x / limit
        even = (0.5 * (1 / (1 + limit) + 1 / (1 - limit)) - 1.0) * (x / limit) ** 2
        exact = 1 / (1 + x) - k * level * (1 + x)
        differences.append(abs(exact - (1.0 + odd + even - k * level)))
    k_i = result.accelerometers["A"].monte_carlo["K_I"]
    assert k_i.joint_difference == pytest.approx(max(differences), rel=1e-2)
    assert k_i.joint_difference > k_i.tolerance
    text = "".join(map(str, interval_blocks("A", result)))
    assert "by more than the numerical tolerance for K_F, K_I" in text


def test_response_parabola_passes_through_points():
    response = Response(lower_difference=0.3, upper_difference=-0.1)
    np.testing.assert_allclose(response.parabola(np.array([-2.0, 0.0, 2.0])), [0.3, 0.0, -0.1])


def test_purely_second_order_source_is_drawn():
    """The square of a standard normal has mean 1 and standard deviation sqrt(2)."""
    coefficient = Coefficient(value=0.0, u=1.0, dof=None, unit="g", estimated=True)
    errors = draw_errors(
        [], coefficient, {}, 200_000, np.random.default_rng(1), {"x": Response(4.0, 4.0)}
    )
    assert errors.mean() == pytest.approx(1.0, abs=5 * math.sqrt(2.0 / 200_000))
    assert errors.std() == pytest.approx(math.sqrt(2.0), rel=0.02)
    assert numerical_tolerance(1.0) < Response(4.0, 4.0).size
