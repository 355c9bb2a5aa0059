"""Variance components: against published values, the analysis of variance, and known truth."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from counterspin.inference.variance_components import _profile_limit, variance_components


def mean_of(n):
    return np.ones((n, 1))


def in_groups(count, size):
    return np.repeat(range(count), size).tolist()


def test_dyestuff_components_match_lme4():
    """Davies and Goldsmith 1972, table 6.1; lme4 (Bates 2010, section 1.3) by REML."""
    batches = """1545 1440 1440 1520 1580  1540 1555 1490 1560 1495  1595 1550 1605 1510 1560
                 1445 1440 1595 1465 1545  1595 1630 1515 1635 1625  1520 1455 1450 1480 1445"""
    values = np.array(batches.split(), dtype=float)
    groups = {"batch": in_groups(6, 5), "sample": list(range(30))}
    components = variance_components(values, np.zeros((30, 30)), groups, mean_of(30))
    batch, sample = components.components["batch"], components.components["sample"]
    assert batch.value**2 == pytest.approx(1764.05, rel=1e-5)
    assert sample.value**2 == pytest.approx(2451.25, rel=1e-5)
    assert (components.value, components.u) == pytest.approx((1527.5, 19.383), rel=1e-4)
    assert (batch.groups, batch.dof, sample.dof) == (6, 5, 24)


#: Strength of paste: ten batches of three casks, tested twice. Davies and Goldsmith 1972.
PASTE = """62.8 62.6 60.1 62.3 62.7 63.1  60.0 61.4 57.5 56.9 61.1 58.9  58.7 57.5 63.9 63.1 65.4
63.7  57.1 56.4 56.9 58.6 64.7 64.5  55.1 55.1 54.7 54.2 58.8 57.5  63.4 64.9 59.3 58.1 60.5 60.0
62.5 62.6 61.0 58.7 56.9 57.7  59.2 59.4 65.2 66.0 64.8 64.1  54.8 54.8 64.0 64.0 57.7 56.8
58.3 59.3 59.2 59.2 58.9 56.6"""


def test_nested_components_match_anova():
    """Compare with lme4 (Bates 2010, section 2.2) by REML: 1.657, 8.434, 0.678."""
    values = np.array(PASTE.split(), dtype=float)
    groups = {"cask": in_groups(30, 2), "batch": in_groups(10, 6), "test": list(range(60))}
    components = variance_components(values, np.zeros((60, 60)), groups, mean_of(60)).components
    cube = values.reshape(10, 3, 2)
    of_cask, of_batch = cube.mean(axis=2), cube.mean(axis=(1, 2))
    squares = (
        6.0 * of_batch.var(ddof=1),
        2.0 * float(np.sum((of_cask - of_batch[:, None]) ** 2)) / 20.0,
        float(np.sum((cube - of_cask[:, :, None]) ** 2)) / 30.0,
    )
    expected = {
        "batch": (squares[0] - squares[1]) / 6.0,
        "cask": (squares[1] - squares[2]) / 2.0,
        "test": squares[2],
    }
    for name, variance in expected.items():
        assert components[name].value ** 2 == pytest.approx(variance, rel=1e-4)
    published = {"batch": 1.657, "cask": 8.434, "test": 0.678}
    assert {n: round(c.value**2, 3) for n, c in components.items()} == pytest.approx(
        published, abs=5e-4
    )
    # The batches may not differ at all (lme4's profile begins at 0 as well); the casks do.
    assert components["batch"].low == 0.0
    assert 2.0 < components["cask"].low < 2.5
    assert [c.dof for c in components.values()] == [9, 20, 30]


def test_bcg_trials_match_metafor():
    """Thirteen trials of BCG: metafor (Viechtbauer 2010, J. Stat. Softw. 36(3), section 3)."""
    rows = """4 119 11 128  6 300 29 274  3 228 11 209  62 13536 248 12619  33 5036 47 5761
        180 1361 372 1079  8 2537 10 619  505 87886 499 87892  29 7470 45 7232  17 1699 65 1600
        186 50448 141 27197  5 2493 3 2338  27 16886 29 17825"""
    a, b, c, d = np.array(rows.split(), dtype=float).reshape(13, 4).T
    risk = np.log(a / (a + b)) - np.log(c / (c + d))
    variance = 1 / a - 1 / (a + b) + 1 / c - 1 / (c + d)
    trials = {"trial": list(range(13))}
    components = variance_components(risk, np.diag(variance), trials, mean_of(13))
    assert components.components["trial"].value ** 2 == pytest.approx(0.3132, abs=5e-5)
    assert (components.value, components.u) == pytest.approx((-0.7145, 0.1798), abs=5e-5)


def test_negative_variance_estimate_is_zero():
    """Balanced classes whose means scatter less than their members: the estimate is negative."""
    values = np.array([1.0, -1.0, 0.9, -0.9, 1.1, -1.1])
    groups = {"day": in_groups(3, 2), "turn": list(range(6))}
    components = variance_components(values, np.zeros((6, 6)), groups, mean_of(6)).components
    assert components["day"].value == components["day"].low == 0.0
    # With it gone the other is the variance about the mean.
    assert components["turn"].value == pytest.approx(values.std(ddof=1), rel=1e-5)
    assert 0.0 < components["day"].high < 3.0


def test_inseparable_factors_are_merged():
    rng = np.random.default_rng(2)
    groups = {
        "day": in_groups(3, 4),
        "mounting": [f"m{k}" for k in in_groups(3, 4)],
        "turn": in_groups(6, 2),
        "site": ["here"] * 12,
    }
    components = variance_components(
        rng.standard_normal(12), 0.01 * np.eye(12), groups, np.ones((12, 1))
    )
    assert list(components.components) == ["day", "turn"]
    assert components.same_as == {"mounting": "day"}
    assert [c.dof for c in components.components.values()] == [2, 3]


def test_common_error_does_not_change_variances():
    """Fully correlated errors, however large, change neither variances nor their intervals."""
    values, own = np.array([1.0, 2.5, 0.7, 3.1]), 0.04 * np.eye(4)
    groups = {"day": list(range(4))}
    alone = variance_components(values, own, groups, mean_of(4))
    shared = variance_components(values, own + 100.0, groups, mean_of(4))
    first, second = alone.components["day"], shared.components["day"]
    assert (first.value, first.low, first.high) == pytest.approx(
        (second.value, second.low, second.high), rel=1e-3
    )
    assert shared.u == pytest.approx(math.hypot(alone.u, 10.0), rel=1e-6)


@pytest.mark.parametrize("freedom", [1, 2, 4, 30])
def test_interval_of_single_variance_matches_chi_square(freedom):
    """n + 1 values without known errors: s^2 by chi-square with n degrees of freedom."""
    n = freedom + 1
    values = np.random.default_rng(n).standard_normal(n)
    component = variance_components(
        values, np.zeros((n, n)), {"all": list(range(n))}, mean_of(n)
    ).components["all"]
    s = values.std(ddof=1)
    assert component.value == pytest.approx(s, rel=1e-4)
    shown = freedom * (s / component.high) ** 2, freedom * (s / component.low) ** 2
    covered = chi2.cdf(shown[1], freedom) - chi2.cdf(shown[0], freedom)
    assert covered == pytest.approx(0.95, abs=1e-3)
    # At both ends the likelihood is the same: -2 l rises by n (w - 1 - log w).
    rises = [freedom * (w - 1.0 - math.log(w)) for w in (shown[0] / freedom, shown[1] / freedom)]
    assert rises == pytest.approx([_profile_limit(freedom)] * 2, rel=1e-2)


@pytest.mark.slow
def test_intervals_of_few_days_and_turn_ons_have_coverage():
    """In histories of 4 days with 3 turn-ons, coverage is at least 95 % minus 3 sigma."""
    rng = np.random.default_rng(11)
    day, turn, u = 2.0, 1.0, np.tile([0.3, 0.6, 1.2], 4)
    groups = {"day": in_groups(4, 3), "turn": list(range(12))}
    trials, inside, variances = 50, np.zeros(2), np.zeros(2)
    for _ in range(trials):
        values = (
            np.repeat(day * rng.standard_normal(4), 3)
            + turn * rng.standard_normal(12)
            + u * rng.standard_normal(12)
        )
        components = variance_components(values, np.diag(u**2), groups, mean_of(12)).components
        for place, (name, truth) in enumerate((("day", day), ("turn", turn))):
            inside[place] += components[name].low <= truth <= components[name].high
            variances[place] += components[name].value ** 2 / trials
    spread = 3.0 * math.sqrt(0.95 * 0.05 / trials)
    assert np.all(inside / trials > 0.95 - spread), inside / trials
    assert inside.sum() < 2 * trials, inside
    # Of mean squares with 3 and 8 degrees of freedom; that none is below zero adds little.
    known = float(np.mean(u**2))
    for found_mean, truth, freedom, size in (
        (variances[0], day**2, 3, day**2 + (turn**2 + known) / 3),
        (variances[1], turn**2, 8, turn**2 + known),
    ):
        assert found_mean == pytest.approx(truth, abs=3.0 * size * math.sqrt(2 / freedom / trials))
