"""Weighted mean, drift and E_n score against closed forms and repeated trials."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from counterspin.errors import NotIdentifiableError
from counterspin.histories.consistency import en_score, fit_drift, weighted_mean

numbers = st.integers(-1000, 1000).map(lambda n: n / 8)
spreads = st.integers(1, 400).map(lambda n: n / 16)
series = st.lists(st.tuples(numbers, spreads), min_size=2, max_size=8)


# The mean


def test_weighted_mean_of_two_measurements():
    # Weights 1 and 1/4: mean 1/5 of the way, chi2 = 5^2/(1 + 4).
    mean = weighted_mean([10.0, 15.0], [1.0, 2.0])
    assert mean.value == pytest.approx(11.0)
    assert mean.u == pytest.approx(math.sqrt(0.8))
    assert mean.scatter.chi2 == pytest.approx(5.0)
    assert mean.scatter.dof == 1
    assert mean.scatter.birge == pytest.approx(math.sqrt(5.0))
    # With one degree of freedom chi-square is a squared normal variable.
    assert mean.scatter.p == pytest.approx(math.erfc(math.sqrt(5.0 / 2.0)))
    assert mean.differences == pytest.approx([-1.0, 4.0])
    assert mean.z == pytest.approx([-math.sqrt(5.0), math.sqrt(5.0)])


def test_p_value_with_two_degrees_of_freedom_is_exponential():
    mean = weighted_mean([1.0, 2.0, 6.0], [1.0, 1.0, 1.0])
    assert mean.scatter.chi2 == pytest.approx(14.0)
    assert mean.scatter.p == pytest.approx(math.exp(-7.0))


def test_one_measurement_has_no_consistency_test():
    mean = weighted_mean([3.0], [0.5])
    assert (mean.value, mean.u) == (pytest.approx(3.0), pytest.approx(0.5))
    assert mean.scatter.p is None
    assert mean.scatter.birge is None
    assert np.isnan(mean.z).all()


@given(series)
def test_z_is_difference_over_uncertainty(measured):
    values, u = np.array(measured).T
    mean = weighted_mean(values, u)
    # Var(x_i - mean) = u_i^2 - u^2; the tolerance allows for cancellation.
    spread = u**2 - mean.u**2
    clear = spread > 1e-6 * u**2
    assert mean.z[clear] == pytest.approx(
        (mean.differences / np.sqrt(np.where(clear, spread, 1.0)))[clear], rel=1e-8, abs=1e-8
    )


def test_z_of_dominant_measurement():
    assert weighted_mean([0.0, 3.0], [1e-12, 1.0]).z == pytest.approx([-3.0, 3.0])


@pytest.mark.parametrize("u", [[1.0, 0.0], [1.0, -1.0], [1.0, math.nan], [1.0]])
def test_rejects_invalid_uncertainty(u):
    with pytest.raises((ValueError, NotIdentifiableError)):
        weighted_mean([1.0, 2.0], u)


# The drift


def test_drift_through_two_points():
    drift = fit_drift([2000.0, 2004.0], [1.0, 3.0], [0.3, 0.4])
    assert drift.slope == pytest.approx(0.5)
    assert drift.u == pytest.approx(0.5 / 4.0)  # sqrt(0.3^2 + 0.4^2) over four years
    assert drift.p == pytest.approx(math.erfc(4.0 / math.sqrt(2.0)))
    assert drift.scatter.p is None
    value, u = drift.evaluate([2000.0, 2004.0])
    assert value == pytest.approx([1.0, 3.0])
    assert u == pytest.approx([0.3, 0.4])


@given(series, st.integers(-50, 50))
def test_exact_line_is_recovered(measured, slope):
    u = np.array([spread for _, spread in measured])
    time = np.arange(u.size) * 0.5 + 2020.0
    drift = fit_drift(time, 7.0 + slope * (time - 2020.0), u)
    assert drift.slope == pytest.approx(slope, abs=1e-7)
    assert drift.scatter.chi2 == pytest.approx(0.0, abs=1e-8)


def test_drift_agrees_with_textbook_formula():
    time, y = np.array([0.0, 1.0, 2.5, 4.0]), np.array([1.0, 1.3, 0.9, 1.8])
    u = np.array([0.1, 0.2, 0.15, 0.3])
    weights = u**-2
    sw, sx, sy = weights.sum(), (weights * time).sum(), (weights * y).sum()
    delta = sw * (weights * time**2).sum() - sx**2
    drift = fit_drift(time, y, u)
    assert drift.slope == pytest.approx((sw * (weights * time * y).sum() - sx * sy) / delta)
    assert drift.u == pytest.approx(math.sqrt(sw / delta))
    assert (drift.time, drift.value) == (pytest.approx(sx / sw), pytest.approx(sy / sw))


def test_single_date_has_no_drift():
    assert fit_drift([5.0, 5.0, 5.0], [1.0, 2.0, 3.0], [1.0, 1.0, 1.0]) is None
    assert fit_drift([5.0], [1.0], [1.0]) is None


def test_drift_is_unbiased_with_correct_coverage():
    rng = np.random.default_rng(17043)
    trials, true = 2000, 0.3
    time = np.array([0.0, 0.4, 1.1, 1.9, 2.5, 3.6])
    u = np.array([0.5, 0.2, 0.4, 0.3, 0.6, 0.25])
    drifts = [fit_drift(time, 5.0 + true * time + rng.normal(0.0, u), u) for _ in range(trials)]
    slopes, stated_u = np.array([drift.slope for drift in drifts]), drifts[0].u
    # 4.5 standard deviations of each statistic: 1 in 150,000.
    assert abs(slopes.mean() - true) < 4.5 * stated_u / math.sqrt(trials)
    assert abs(slopes.std() / stated_u - 1.0) < 4.5 / math.sqrt(2.0 * trials)
    coverage = np.mean(np.abs(slopes - true) < 1.959963984540054 * stated_u)
    assert abs(coverage - 0.95) < 4.5 * math.sqrt(0.95 * 0.05 / trials)
    p_values = np.array([drift.scatter.p for drift in drifts])
    assert abs(np.mean(p_values < 0.1) - 0.1) < 4.5 * math.sqrt(0.1 * 0.9 / trials)
    level = np.array([drift.evaluate(2.0)[0] for drift in drifts])
    assert abs(level.std() / drifts[0].evaluate(2.0)[1] - 1.0) < 4.5 / math.sqrt(2.0 * trials)


def test_false_alarm_rate_of_drift_matches_level():
    rng = np.random.default_rng(13528)
    trials, u = 2000, np.full(4, 0.2)
    p_values = np.array([fit_drift(np.arange(4.0), rng.normal(0.0, u), u).p for _ in range(trials)])
    for level in (0.01, 0.2, 0.7):
        assert abs(np.mean(p_values < level) - level) < 4.5 * math.sqrt(
            level * (1 - level) / trials
        )


# E_n


def test_en_score_closed_form():
    # U = 1.96 u where the degrees of freedom are infinite; with 1 and 2, Student's closed forms.
    assert en_score((1.0, 3.0, None), (11.0, 4.0, None)) == pytest.approx(10.0 / (5 * 1.959963985))
    first_quantile = math.tan(0.475 * math.pi)
    second_quantile = 0.95 * math.sqrt(2.0 / (1.0 - 0.95**2))
    assert en_score((5.0, 1.0, 1.0), (2.0, 1.0, 2.0)) == pytest.approx(
        -3.0 / math.hypot(first_quantile, second_quantile)
    )


@given(numbers, spreads, numbers, spreads)
def test_en_score_with_infinite_dof_is_z_over_1_96(a, u_a, b, u_b):
    z = (b - a) / math.hypot(u_a, u_b)
    assert en_score((a, u_a, None), (b, u_b, None)) == pytest.approx(z / 1.959963984540054)
