"""The first stage's parabola against closed forms, brute force and its own claims."""

import math

import numpy as np
import pytest
from scipy.special import stdtrit

from counterspin.errors import NotIdentifiableError
from counterspin.inference.two_stage.first_stage import Strobes, first_stage

SIGMA = 0.01


def strobes(time, error=None, noise_factor=None):
    return Strobes(
        time,
        np.zeros(time.size) if error is None else error,
        np.ones(time.size) if noise_factor is None else noise_factor,
        lost=0,
    )


@pytest.mark.parametrize(("period", "printed"), [(4, 8.38735e-8), (2, 3.35494e-7), (1, 1.34198e-6)])
def test_u_of_b2_matches_paper_plan(period, printed):
    n = 100
    parabola = first_stage(strobes((0.25 + np.arange(n)) * period), SIGMA)
    # The quadratic orthogonal polynomial on n even points has the norm n(n^2-1)(n^2-4)/180.
    closed = SIGMA / period**2 * math.sqrt(180 / (n * (n**2 - 1) * (n**2 - 4)))
    assert parabola.u_b2 == pytest.approx(closed, rel=1e-10)
    assert parabola.u_b2 == pytest.approx(printed, rel=1e-5)


def test_parabola_is_recovered_far_from_time_zero():
    time = 300.0 + 0.7 * np.arange(50)
    truth = np.array([0.3, -2e-3, 5e-4])
    parabola = first_stage(strobes(time, np.polynomial.polynomial.polyval(time, truth)), SIGMA)
    # Rounding of 50 m, made larger by the condition of so far an extrapolation, (315/17)^2.
    np.testing.assert_allclose(parabola.coefficients, truth, rtol=1e-10)
    assert np.abs(parabola.residuals).max() < 350 * 50 * 2.3e-16 * 10
    np.testing.assert_allclose(
        parabola.gain @ np.vander(time, 3, increasing=True), np.eye(3), atol=1e-7
    )
    assert parabola.b2 == parabola.coefficients[2]


def test_weights_follow_noise_factors():
    rng = np.random.default_rng(2)
    time = np.sort(rng.uniform(0.0, 10.0, 12))
    factor = rng.uniform(0.7, 1.0, 12)
    error = rng.standard_normal(12)
    parabola = first_stage(strobes(time, error, factor), SIGMA)
    x = np.vander(time, 3, increasing=True)
    information = x.T @ np.diag(1 / (SIGMA * factor) ** 2) @ x
    expected = np.linalg.solve(information, x.T @ (error / (SIGMA * factor) ** 2))
    np.testing.assert_allclose(parabola.coefficients, expected, rtol=1e-9)
    np.testing.assert_allclose(parabola.covariance, np.linalg.inv(information), rtol=1e-9)
    assert parabola.chi2 == pytest.approx(
        np.sum((parabola.residuals / (SIGMA * factor)) ** 2), rel=1e-12
    )
    assert parabola.dof == 9


def test_sigma_is_given_or_from_residuals():
    time = np.arange(5.0)
    # The one residual pattern of five points beside two more: the cubic orthogonal polynomial.
    cubic = np.array([-1.0, 2.0, 0.0, -2.0, 1.0])
    error = 1.0 + 0.5 * time + 0.2 * time**2 + 0.03 * cubic
    given = first_stage(strobes(time, error), SIGMA)
    assert (given.sigma, given.sigma_from_residuals) == (SIGMA, False)
    assert given.chi2 == pytest.approx(10 * 0.03**2 / SIGMA**2, rel=1e-9)
    own = first_stage(strobes(time, error))
    assert own.sigma_from_residuals
    assert own.sigma == pytest.approx(0.03 * math.sqrt(10 / 2), rel=1e-9)
    assert own.u_b2 / given.u_b2 == pytest.approx(own.sigma / SIGMA, rel=1e-12)
    np.testing.assert_array_equal(own.coefficients, given.coefficients)


def test_three_strobes_raise():
    assert first_stage(strobes(np.arange(4.0)), SIGMA).dof == 1
    with pytest.raises(NotIdentifiableError, match="3 strobes cannot determine a parabola"):
        first_stage(strobes(np.arange(3.0)), SIGMA)


def walk_covariance(time, random_walk):
    """Integrate N^2 (t1 - u)(t2 - u) over u from 0 to the earlier time by Gauss nodes."""
    x, w = np.polynomial.legendre.leggauss(4)
    early = np.minimum.outer(time, time)
    u = early[..., None] * (1 + x) / 2
    product = (time[:, None, None] - u) * (time[None, :, None] - u)
    return random_walk**2 * np.sum(product * w, axis=-1) * early / 2


def test_random_walk_is_whitened():
    rng = np.random.default_rng(5)
    time, walk = 3.0 + 2.0 * np.arange(40), 2e-4
    factor = rng.uniform(0.7, 1.0, 40)
    error = rng.standard_normal(40)
    plain = first_stage(strobes(time, error, factor), SIGMA)
    parabola = first_stage(strobes(time, error, factor), SIGMA, walk)
    covariance = np.diag((SIGMA * factor) ** 2) + walk_covariance(time, walk)
    np.testing.assert_allclose(
        parabola.covariance, parabola.gain @ covariance @ parabola.gain.T, rtol=1e-9, atol=0
    )
    x = np.vander(time, 3, increasing=True)
    np.testing.assert_allclose(parabola.gain @ x, np.eye(3), atol=1e-9)
    # b2 is the estimate of least variance.
    inverse = np.linalg.inv(covariance)
    least = np.linalg.inv(x.T @ inverse @ x)
    assert parabola.u_b2 == pytest.approx(math.sqrt(least[2, 2]), rel=1e-9)
    assert parabola.b2 == pytest.approx((least @ x.T @ inverse @ error)[2], rel=1e-7)
    assert parabola.u_b2 > 2 * plain.u_b2  # so that it is the walk that was tested
    assert parabola.chi2 == pytest.approx(
        error @ (inverse - inverse @ x @ least @ x.T @ inverse) @ error, rel=1e-7
    )


def test_u_with_random_walk_matches_scatter():
    rng = np.random.default_rng(3)
    walk, step, each, count, trials = 2e-4, 0.05, 40, 20, 4000
    time = each * step * np.arange(1, count + 1)
    parabola = first_stage(strobes(time), 0.0, walk)
    # White acceleration, one value a step, integrated twice by plain sums.
    acceleration = walk / math.sqrt(step) * rng.standard_normal((trials, each * count))
    velocity = np.cumsum(acceleration, axis=1) * step
    position = np.cumsum(velocity - 0.5 * step * acceleration, axis=1) * step
    b2 = position[:, each - 1 :: each] @ parabola.gain[2]
    # A standard deviation from n draws scatters by 1/sqrt(2 n) = 1.1 %.
    assert np.std(b2) / parabola.u_b2 == pytest.approx(1.0, abs=4 / math.sqrt(2 * trials))


@pytest.mark.parametrize("given", [True, False])
def test_interval_of_b2_has_95_percent_coverage(given):
    rng = np.random.default_rng(4)
    time, trials = np.arange(8.0), 4000
    truth = 1e-3
    factor = np.linspace(0.7, 1.0, 8)
    covered = 0
    for _ in range(trials):
        error = truth * time**2 + SIGMA * factor * rng.standard_normal(8)
        parabola = first_stage(strobes(time, error, factor), SIGMA if given else None)
        k = 1.959964 if given else stdtrit(parabola.dof, 0.975)  # 2.57 with 5 degrees of freedom
        covered += abs(parabola.b2 - truth) < k * parabola.u_b2
    assert covered / trials == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / trials))
