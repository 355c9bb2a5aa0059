"""Global risks against JCGM 106's integral by SciPy, stated figures and simulated items."""

import math

import numpy as np
import pytest
from scipy import integrate, stats

from counterspin.inference.conformity import DecisionRule, Specification, decide
from counterspin.inference.global_risk import Process, global_risk, guard_band_for_risk

TOLERANCE = (-5e-5, 5e-5)
PROCESS = Process(0.0, 2.5e-5)
U = 5e-6


def risks_by_scipy(process, u, tolerance, acceptance):
    """Return both risks as probabilities of rectangles of the bivariate normal distribution."""
    covariance = [[process.sigma**2, process.sigma**2], [process.sigma**2, process.sigma**2 + u**2]]
    # In standard deviations, for the tolerance of the integration.
    scale = np.array([process.sigma, math.hypot(process.sigma, u)])
    correlation = np.array(covariance) / np.outer(scale, scale)
    rv = stats.multivariate_normal(cov=correlation, abseps=1e-12, releps=1e-12, maxpts=10**6)

    def rectangle(truth, estimate):
        ends = np.array([truth, estimate]) - process.mean
        return rv.cdf(ends[:, 1] / scale, lower_limit=ends[:, 0] / scale)

    both = rectangle(tolerance, acceptance)
    everything = (-np.inf, np.inf)
    return rectangle(everything, acceptance) - both, rectangle(tolerance, everything) - both


# The guard band U of 95 % is 1.96 u; with exactly 2 u the risk is 0.0161 %.
@pytest.mark.parametrize(
    ("guard", "stated"),
    [(0.0, 0.68e-2), (1.959964 * U, 0.018e-2), (2.0 * U, 0.0161e-2)],
)
def test_consumer_risk_matches_published_values(guard, stated):
    acceptance = (TOLERANCE[0] + guard, TOLERANCE[1] - guard)
    risk = global_risk(PROCESS, U, None, TOLERANCE, acceptance)
    assert risk.consumer == pytest.approx(stated, rel=0.01)
    assert (risk.consumer, risk.producer) == pytest.approx(
        risks_by_scipy(PROCESS, U, TOLERANCE, acceptance), abs=1e-9
    )


@pytest.mark.parametrize("u", [2e-7, 3e-5])
def test_risks_of_off_centre_process_match_scipy(u):
    process, acceptance = Process(3e-5, 1e-5), (-4e-5, 4.2e-5)
    risk = global_risk(process, u, None, TOLERANCE, acceptance)
    assert (risk.consumer, risk.producer) == pytest.approx(
        risks_by_scipy(process, u, TOLERANCE, acceptance), abs=1e-9
    )


def test_risks_match_simulated_items():
    count, rng, dof = 200_000, np.random.default_rng(12), 5.0
    truth = rng.normal(PROCESS.mean, PROCESS.sigma, count)
    estimate = truth + U * rng.standard_t(dof, count)
    conforms, accepted = np.abs(truth) <= TOLERANCE[1], np.abs(estimate) <= TOLERANCE[1]
    risk = global_risk(PROCESS, U, dof, TOLERANCE, TOLERANCE)
    for expected, events in (
        (risk.consumer, accepted & ~conforms),
        (risk.producer, ~accepted & conforms),
    ):
        sampling = math.sqrt(expected * (1.0 - expected) / count)
        assert np.mean(events) == pytest.approx(expected, abs=4.0 * sampling)


def test_exact_measurement_and_empty_acceptance_have_limiting_risks():
    exact = global_risk(PROCESS, 0.0, None, TOLERANCE, (-4e-5, 6e-5))
    tails = stats.norm.cdf([-2.4, -2.0, -1.6])
    assert exact.consumer == pytest.approx(tails[1] - tails[0], rel=1e-9)
    assert exact.producer == pytest.approx(tails[2] - tails[1], rel=1e-9)
    none = global_risk(PROCESS, U, None, TOLERANCE, (1.0, -1.0))
    assert none.consumer == 0.0
    assert none.producer == pytest.approx(1.0 - 2.0 * tails[1], rel=1e-9)


@pytest.mark.parametrize("limits", [TOLERANCE, (None, 5e-5)])
def test_guard_band_has_permitted_risk(limits):
    band = guard_band_for_risk(PROCESS, U, None, limits, 1e-3)
    low, high = limits
    accepted = (None if low is None else low + band, high - band)
    assert global_risk(PROCESS, U, None, limits, accepted).consumer == pytest.approx(1e-3, rel=1e-6)
    assert guard_band_for_risk(PROCESS, U, None, limits, 0.5) == 0.0


@pytest.mark.parametrize("rule", ["simple", "guarded", "probability"])
def test_decision_has_risk_of_rule(rule):
    """P(accept and nonconforming), integrated over what an estimate decides."""
    specification = Specification("", *TOLERANCE, "g", PROCESS)
    decision_rule = DecisionRule(rule)

    def accepted(value):
        return decide(value, U, None, specification, decision_rule).verdict == "pass"

    edge = {"simple": 5e-5, "guarded": 5e-5 - 1.959964 * U, "probability": 5e-5 - 1.644854 * U}
    assert accepted(edge[rule] - 1e-11)
    assert not accepted(edge[rule] + 1e-11)
    global_risk = decide(0.0, U, None, specification, decision_rule).global_risk

    def integrand(z):
        noise = stats.norm(PROCESS.sigma * z, U)
        return stats.norm.pdf(z) * (noise.cdf(edge[rule]) - noise.cdf(-edge[rule]))

    expected = 2.0 * integrate.quad(integrand, 2.0, 6.0, epsabs=1e-13)[0]
    assert global_risk.consumer == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("sigma", [0.0, -1.0, math.inf])
def test_process_without_spread_raises(sigma):
    with pytest.raises(ValueError, match="is not a valid process distribution"):
        Process(0.0, sigma)
