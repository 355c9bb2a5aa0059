"""Distributions of single numbers, against SciPy and mpmath."""

import math

import mpmath
import numpy as np
import pytest
from scipy import special, stats

from counterspin.inference.distributions import (
    chi_square_tail,
    finite_dof,
    log_binomial,
    normal_cdf,
    normal_quantile,
    numerical_tolerance,
    student_cdf,
    student_quantile,
)
from counterspin.inference.mixture_distribution import mixture_dof, mixture_tail

SMALL = np.logspace(-12, -0.31, 30).tolist()


@pytest.mark.parametrize("x", np.linspace(-35, 8, 40).tolist())
def test_normal_distribution_matches_scipy(x):
    assert normal_cdf(x) == pytest.approx(special.ndtr(x), rel=1e-12)
    p = min(max(special.ndtr(x), 1e-300), 1 - 1e-15)
    assert normal_quantile(p) == pytest.approx(special.ndtri(p), rel=1e-12)


@pytest.mark.parametrize("dof", [0.3, 1, 2.5, 10, 99, 199, 201, 1000, 6664.009, 34000, 1e6])
def test_chi_square_tail_matches_scipy(dof):
    """From far below the mean to nine standard deviations above it."""
    for z in np.linspace(-6, 9, 31):
        chi2 = max(dof + z * math.sqrt(2 * dof), dof * math.exp(z))
        expected = special.chdtrc(dof, chi2)
        assert chi_square_tail(dof, chi2) == pytest.approx(expected, rel=1e-11, abs=1e-280)


def test_chi_square_tail_at_zero_and_infinity():
    assert chi_square_tail(5.0, 0.0) == 1.0
    assert chi_square_tail(5.0, math.inf) == 0.0
    assert chi_square_tail(1e8, 1e-9) == 1.0  # less than a rounding of dof
    assert math.isnan(chi_square_tail(5.0, math.nan))
    # SciPy has seven digits here; with so many degrees of freedom it is the normal distribution
    # with Wilson and Hilferty's cube root, which is as good as 1/dof.
    cube = ((1 + 4e-4) ** (1 / 3) - (1 - 2 / 9e8)) / math.sqrt(2 / 9e8)
    assert chi_square_tail(1e8, 1e8 * (1 + 4e-4)) == pytest.approx(normal_cdf(-cube), rel=1e-5)


@pytest.mark.parametrize("dof", [0.5, 1, 2, 5, 50, 199, 201, 2470.86, 1e4, 1e6, 2e6, 1e9])
def test_student_cdf_matches_forty_digits(dof):
    with mpmath.workdps(40):
        for t in (1e-6, 0.3, 1.0, 1.6, 1.8, 2.04, 2.7, 5.0, 9.0):
            a, x = mpmath.mpf(dof) / 2, dof / (dof + mpmath.mpf(t) ** 2)
            tail = float(mpmath.betainc(a, mpmath.mpf(1) / 2, 0, x, regularized=True) / 2)
            assert student_cdf(dof, -t) == pytest.approx(tail, rel=1e-10)
            assert student_cdf(dof, t) == pytest.approx(1 - tail, rel=1e-14)


@pytest.mark.parametrize("dof", [0.5, 1, 2, 5, 50, 199, 201, 2470.86, 1e4])
def test_student_quantile_matches_scipy(dof):
    for p in SMALL:
        assert student_quantile(dof, p) == pytest.approx(special.stdtrit(dof, p), rel=1e-11)
    assert student_quantile(dof, 0.75) == -student_quantile(dof, 0.25)
    assert student_quantile(dof, 0.5) == 0.0


def test_infinite_degrees_of_freedom_are_normal():
    for p in SMALL:
        assert student_quantile(math.inf, p) == normal_quantile(p)
        assert student_quantile(1e12, p) == pytest.approx(normal_quantile(p), rel=1e-9, abs=1e-9)
    assert student_cdf(math.inf, -1.5) == normal_cdf(-1.5)
    assert (student_cdf(3.0, -math.inf), student_cdf(3.0, math.inf)) == (0.0, 1.0)


def test_log_binomial_matches_exact_value():
    assert math.exp(log_binomial(10, 3)) == pytest.approx(math.comb(10, 3), rel=1e-13)
    assert log_binomial(5000, 200) == pytest.approx(math.log(math.comb(5000, 200)), rel=1e-13)


@pytest.mark.parametrize("dof", [1e-300, 1e-3, 0.05])
def test_degrees_of_freedom_are_at_least_one_tenth(dof):
    """The quantile would be beyond what a number can be: 1e320 of 0.005."""
    assert student_quantile(dof, 0.025) == student_quantile(0.1, 0.025) < -1e12
    assert 0.0 < mixture_dof(0.06, dof) == min(mixture_dof(0.06, 0.1), dof / 0.06**2)


@pytest.mark.parametrize("dof", [1.0, 2.0, 5.0, 20.0])
@pytest.mark.parametrize("share", [1e-3, 0.03, 0.3, 0.9])
def test_mixture_interval_matches_quadrature(share, dof):
    """The tail beyond it, by quadrature over Student's density, is 2.5 %."""
    half = stats.t.isf(0.025, mixture_dof(share, dof))
    x = np.tan(np.linspace(-0.5, 0.5, 20001)[1:-1] * np.pi)
    known = stats.norm.sf((half - math.sqrt(share) * x) / math.sqrt(1.0 - share))
    tail = np.trapezoid(known * stats.t.pdf(x, dof), x)
    # Satterthwaite's formula is taken where it has fewer degrees of freedom.
    assert tail == pytest.approx(0.025, rel=2e-3) or tail < 0.025
    assert dof * 0.999 < mixture_dof(share, dof) <= dof / share**2


@pytest.mark.parametrize("dof", [2.0, 5.0, 20.0, 100.0])
@pytest.mark.parametrize("share", [0.1, 0.6, 1.0])
@pytest.mark.parametrize("q", [0.0, 2.0, 5.0, 8.0])
def test_mixture_tail_matches_quadrature(share, dof, q):
    """By quadrature over Student's density; Satterthwaite has an eighth at 5, 5 and 0.6."""
    if share == 1.0:
        tail = stats.t.sf(q, dof)
    else:
        x = np.tan(np.linspace(-0.5, 0.5, 200001)[1:-1] * np.pi)
        known = stats.norm.sf((q - math.sqrt(share) * x) / math.sqrt(1.0 - share))
        tail = np.trapezoid(known * stats.t.pdf(x, dof), x)
    if dof > 50.0:
        assert mixture_tail(share, dof, q) == pytest.approx(stats.t.sf(q, dof / share**2), rel=1e-9)
    else:
        assert mixture_tail(share, dof, q) == pytest.approx(tail, rel=1e-3)


def test_mixture_dof_of_single_source():
    assert mixture_dof(1.0, 3.0) == 3.0
    assert math.isinf(mixture_dof(0.0, 3.0))
    assert mixture_dof(0.5, 100.0) == 400.0


@pytest.mark.parametrize(
    ("dof", "stated"), [(3.0, 3.0), (2e8, 2e8), (9.12e16, None), (math.inf, None)]
)
def test_huge_degrees_of_freedom_are_infinite(dof, stated):
    assert finite_dof(dof) == stated


def test_numerical_tolerance_matches_jcgm_101():
    """JCGM 101, 7.9.2, example 1: u = 0.00035 g is 35e-5 g, so that the tolerance is 5e-6 g."""
    assert numerical_tolerance(0.00035) == pytest.approx(5e-6)
