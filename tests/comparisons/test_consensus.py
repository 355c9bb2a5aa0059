"""Reference values against closed forms and published values of other programs."""

import numpy as np
import pytest
from scipy.stats import binom

from counterspin.comparisons.consensus import (
    degrees_of_equivalence,
    largest_consistent_subsets,
    weighted_mean,
)


def find_subsets(values, covariance):
    return largest_consistent_subsets(np.array(values, float), np.array(covariance, float), 0.05)


def test_outlier_among_four_laboratories_is_excluded():
    values, u = np.array([15.0, 15.1, 15.2, 16.2]), 0.1
    covariance = u**2 * np.eye(4)
    (reference,) = find_subsets(values, covariance)
    assert reference.members == (0, 1, 2)
    assert reference.value == pytest.approx(15.10)
    assert round(reference.u, 2) == 0.06  # u/sqrt(3)
    d, u_d = degrees_of_equivalence(values, covariance, reference.weights)
    assert d == pytest.approx([-0.1, 0.0, 0.1, 1.1], abs=1e-12)
    u_inside, u_outside = u * (2 / 3) ** 0.5, u * (4 / 3) ** 0.5
    assert u_d == pytest.approx([u_inside, u_inside, u_inside, u_outside])


def test_procedure_a_matches_bipm_program():
    """43877 ± 53 of these five, in the example of Cox's procedure A of the BIPM_RI_PyModules."""
    u = np.array([97.0, 100.0, 104.5, 160.0, 280.0])
    (reference,) = find_subsets([43772, 43910, 43947, 43910, 43900], np.diag(u**2))
    assert (round(reference.value), round(reference.u)) == (43877, 53)
    assert len(reference.members) == 5


@pytest.mark.parametrize(
    ("values", "variance", "members"),
    [
        ([20, 20.6, 20.5, 19.3], 1, [(0, 1, 2, 3)]),
        ([20, 23.6, 20.5, 19.3], 1, [(0, 2, 3)]),
        ([10, 11, 20, 21], 5, [(0, 1), (2, 3)]),
    ],
)
def test_correlated_values_match_met4fof_redundancy(values, variance, members):
    """The test cases of that program (Kok and Harris), solved by hand.

    A common variance of 1 leaves the weights equal and adds to u^2 alone.
    """
    subsets = find_subsets(values, variance * np.eye(4) + 1.0)
    best = [candidate for candidate in subsets if candidate.chi2 < subsets[0].chi2 + 1e-9]
    assert [candidate.members for candidate in best] == members
    for subset in best:
        chosen = np.array(values, float)[list(subset.members)]
        assert subset.value == pytest.approx(chosen.mean())
        assert subset.u**2 == pytest.approx(1 + variance / chosen.size)
        assert subset.chi2 == pytest.approx(chosen.var() * chosen.size / variance)


def test_common_error_cancels_in_degrees_of_equivalence():
    values, covariance = np.array([1.0, 2.0, 3.0, 20.0]), np.eye(4) + 100.0
    reference = find_subsets(values, covariance)[0]
    _, u_d = degrees_of_equivalence(values, covariance, reference.weights)
    assert u_d**2 == pytest.approx([2 / 3, 2 / 3, 2 / 3, 4 / 3])


def test_inconsistent_values_have_no_reference():
    assert find_subsets([0, 10, 20], np.eye(3)) == []


def test_consistent_laboratories_are_rejected_at_5_percent():
    trials, rng = 1000, np.random.default_rng(5)
    root = rng.normal(size=(5, 7))
    covariance = root @ root.T
    draws = rng.multivariate_normal(np.full(5, 3.0), covariance, trials)
    rejected = sum(weighted_mean(draw, covariance).p < 0.05 for draw in draws)
    assert binom.ppf(1e-4, trials, 0.05) <= rejected <= binom.ppf(1 - 1e-4, trials, 0.05)
