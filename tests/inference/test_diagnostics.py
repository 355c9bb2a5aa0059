import itertools
import math

import numpy as np
import pytest
from scipy.special import ndtr

from counterspin.inference.diagnostics import (
    agreement_limit,
    diagnose,
    fisher_g_p,
    normal_equivalent,
    periodogram,
    periodogram_peak,
    runs_test,
)
from counterspin.inference.distributions import chi_square_tail


def white_noise(seed, n=2000):
    return np.random.default_rng(seed).normal(size=n)


def test_independent_residuals_have_no_finding():
    result = diagnose({"run1": white_noise(1), "run2": white_noise(2)}, 3990, noise_given=True)
    assert result.findings == ()
    assert "independent noise" in result.verdict
    assert result.chi2 == pytest.approx(sum(run.chi2 for run in result.runs.values()))
    assert result.runs["run1"].dof == 1995
    assert result.lack_of_fit_p == chi_square_tail(3990, result.chi2)


def test_wrong_stated_noise_is_lack_of_fit():
    small = diagnose({"a": 1.2 * white_noise(1)}, 1995, noise_given=True)
    assert small.lack_of_fit_p < 1e-6
    assert "1.21 times as large" in small.verdict
    large = diagnose({"a": 0.8 * white_noise(1)}, 1995, noise_given=True)
    assert "too large" in large.verdict


def test_runs_may_have_different_degrees_of_freedom():
    own = {"run1": 1999.5, "run2": 1990.0}
    result = diagnose({"run1": white_noise(1), "run2": white_noise(2)}, own, noise_given=True)
    assert {name: run.dof for name, run in result.runs.items()} == own
    assert result.dof == 3989.5
    assert result.runs["run2"].chi2_p == chi_square_tail(1990.0, result.runs["run2"].chi2)
    with pytest.raises(ValueError, match="nothing can be tested"):
        diagnose({"run1": white_noise(1)}, {"run1": 0.0}, noise_given=True)


def test_bad_run_is_named():
    result = diagnose({"good": white_noise(1), "bad": 1.3 * white_noise(2)}, 3990, noise_given=True)
    assert any(finding.startswith("bad:") for finding in result.findings)
    assert not any(finding.startswith("good:") for finding in result.findings)


def test_unmodelled_slow_effect_is_found():
    slow = white_noise(3) + 0.7 * np.linspace(-1, 1, 2000) ** 3 * 2
    result = diagnose({"a": slow / slow.std()}, 1995, noise_given=False)
    assert result.lack_of_fit_p < 1e-3
    assert result.runs["a"].sign_z < -3
    assert "seldom" in result.verdict


def test_unmodelled_periodic_effect_is_found():
    times = np.arange(2000) * 0.02
    rows = white_noise(4) + 0.3 * np.cos(2 * np.pi * 3.0 * times)
    result = diagnose({"a": rows}, 1995, noise_given=False, times={"a": times})
    assert result.runs["a"].peak_frequency == pytest.approx(3.0, abs=0.013)
    assert result.lack_of_fit_p < 1e-6
    assert "peak at 3 Hz" in result.verdict


def test_dominant_wave_is_first_finding():
    """The tone of run b precedes the drift of run a, and spectral peaks precede sign tests."""
    slow = white_noise(1) + np.linspace(-1.0, 1.0, 2000)
    tone = white_noise(2) + np.sin(0.3 * np.arange(2000.0))
    findings = diagnose({"a": slow, "b": tone}, 3990, noise_given=False).findings
    assert findings[0].startswith("b: a spectral peak")
    assert findings[0].endswith("a periodic effect, such as a vibration.")
    assert any(finding.startswith("a: ") for finding in findings[1:])


def test_sign_test_moments_match_permutations():
    """Mean and variance of the number of runs over every arrangement of 4 plus and 5 minus."""
    counts, z = [], []
    for places in itertools.combinations(range(9), 4):
        signs = -np.ones(9)
        signs[list(places)] = 1
        count, distance, _ = runs_test(signs)
        assert count == 1 + np.count_nonzero(np.diff(signs))
        counts.append(count)
        z.append(distance)
    assert np.mean(z) == pytest.approx(0, abs=1e-12)
    assert np.var(z) == pytest.approx(1, rel=1e-12)


def test_sign_test_p_value_matches_permutations():
    signs = [
        np.isin(np.arange(16), places) * 2.0 - 1 for places in itertools.combinations(range(16), 8)
    ]
    tests = [runs_test(rows) for rows in signs]
    z = np.array([distance for _, distance, _ in tests])
    for _, distance, p in tests[:50]:
        assert p == pytest.approx((np.abs(z) >= abs(distance) - 1e-9).mean(), abs=0.01)


def test_uninformative_signs_have_p_value_one():
    assert runs_test(np.ones(5)) == (1, 0.0, 1.0)
    assert runs_test(np.zeros(5)) == (0, 0.0, 1.0)
    assert runs_test([1.0, -1.0]) == (2, 0.0, 1.0)
    assert runs_test([1.0, 0.0, 2.0, -1.0, -2.0])[0] == 2


def test_peak_test_matches_tabulated_values():
    """Fisher's 5 % points of g (1929; also Shimshoni 1971): m = 5, 10, 20, 50."""
    for lines, point in ((5, 0.68377), (10, 0.44495), (20, 0.27040), (50, 0.13135)):
        assert fisher_g_p(point, lines) == pytest.approx(0.05, rel=2e-4)


@pytest.mark.parametrize("lines", [2, 3, 60, 17_500])
def test_peak_test_is_uniform_under_independence(lines):
    rng = np.random.default_rng(lines)
    power = rng.exponential(size=(400, lines))
    p = np.sort([fisher_g_p(s, lines) for s in power.max(axis=1) / power.sum(axis=1)])
    # Kolmogorov's 0.1 % point.
    assert np.abs(p - (np.arange(400) + 0.5) / 400).max() < 1.95 / math.sqrt(400)


def test_peak_of_pure_tone_and_of_zeros():
    tone = np.cos(2 * np.pi * 0.125 * np.arange(64))
    frequency, share, p = periodogram_peak(periodogram(tone), 64)
    assert frequency == 0.125
    assert share == pytest.approx(1)
    assert p < 1e-100
    assert periodogram_peak(periodogram(np.zeros(8)), 8) == (0.0, 0.0, 1.0)
    assert periodogram_peak(periodogram([1.0, -2.0, 0.5]), 3)[2] == 1.0
    assert fisher_g_p(1.0, 7) == 0.0


def test_false_alarm_rate_matches_stated_level():
    rng = np.random.default_rng(5)
    alarms = sum(
        bool(diagnose(dict(enumerate(rng.normal(size=(3, 200)))), 600, noise_given=False).findings)
        for _ in range(3000)
    )
    assert alarms / 3000 < 0.01 + 3 * math.sqrt(0.01 / 3000)


def test_too_few_residuals_raise():
    with pytest.raises(ValueError, match="at least three"):
        diagnose({}, 5, noise_given=True)
    with pytest.raises(ValueError, match="at least three"):
        diagnose({"a": [1.0, 2.0]}, 5, noise_given=True)
    with pytest.raises(ValueError, match="nothing can be tested"):
        diagnose({"a": white_noise(1)}, 0, noise_given=True)


@pytest.mark.parametrize("differences", [1, 6, 160])
def test_difference_limit_has_familywise_probability_of_998_per_mille(differences):
    limit = agreement_limit(differences)
    assert (1.0 - 2.0 * ndtr(-limit)) ** differences == pytest.approx(0.998, abs=1e-9)


@pytest.mark.parametrize(("z", "dof", "size"), [(-2.0, None, 2.0), (4.302653, 2.0, 1.959964)])
def test_normal_equivalent_has_tail_of_student_t(z, dof, size):
    assert normal_equivalent(z, dof) == pytest.approx(size, rel=1e-6)
