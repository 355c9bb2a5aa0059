"""Normal, chi-square and Student's distribution of scalars, in plain Python.

A typical calibration calls these functions about fifty times. Importing SciPy would take as long as
the entire calibration.

They agree with SciPy and mpmath to ten digits or more, also in far tails.
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Final

#: Coverage probability of expanded uncertainties, also for guard bands.
COVERAGE: Final = 0.95

#: Relative change at which a series or a continued fraction ends.
_SERIES_TOLERANCE: Final = 4e-16

#: Above this argument, Stirling's series is more accurate than a difference of `math.lgamma`.
_MIN_STIRLING_ARGUMENT: Final = 100.0

#: Degrees of freedom above which Student's distribution is nearly normal.
_NORMAL_DOF: Final = 1e6

#: Degrees of freedom above which Student's factor equals the normal factor to nine digits.
_INFINITE_DOF: Final = 1e9

_STANDARD_NORMAL: Final = NormalDist()

#: Smallest degrees of freedom: with fewer, the 95 % factor exceeds 1e12 and can overflow.
MIN_DOF: Final = 0.1

#: Smallest degrees of freedom for an interval; GUM G.4.1 truncates smaller ones to 0.
MIN_INTERVAL_DOF: Final = 1.0


def normal_cdf(x: float) -> float:
    """Return the probability that a standard normal variable is below x."""
    return 0.5 * math.erfc(-x / math.sqrt(2.0))


def normal_quantile(p: float) -> float:
    """Return the x whose `normal_cdf` is p, 0 < p < 1."""
    return _STANDARD_NORMAL.inv_cdf(p)


def chi_square_tail(dof: float, chi2: float) -> float:
    """Return the probability that a sum of squares exceeds chi2: Q(dof/2, chi2/2).

    Q is the regularised incomplete gamma function (NIST DLMF 8.2.4), by its series (8.7.1) below
    the mean and its continued fraction (8.9.2) above.
    """
    a, x = 0.5 * dof, 0.5 * chi2
    if x <= 0.0 or math.isinf(x):
        return 1.0 if x <= 0.0 else 0.0
    # x^a exp(-x) / gamma(a + 1), whose factors would overflow.
    relative_excess = (x - a) / a
    if relative_excess <= -1.0:  # to all digits; a is large then
        return 1.0
    if a >= _MIN_STIRLING_ARGUMENT:
        density = math.exp(-a * (relative_excess - math.log1p(relative_excess))) / (
            math.sqrt(2.0 * math.pi * a) * math.exp(_stirling_series(a))
        )
    else:
        density = math.exp(a * math.log(x) - x - math.lgamma(a + 1.0))
    if x < a + 1.0:
        series_sum = term = 1.0
        n = a
        while term > series_sum * _SERIES_TOLERANCE:
            n += 1.0
            term *= x / n
            series_sum += term
        return max(1.0 - density * series_sum, 0.0)
    return density * a * _gamma_continued_fraction(a, x)


def student_cdf(dof: float, t: float) -> float:
    """Return the probability that a Student's t variable is below t."""
    if math.isinf(dof) or math.isinf(t):
        return normal_cdf(t)
    return _student_tail(dof, -t) if t < 0.0 else 1.0 - _student_tail(dof, t)


def student_quantile(dof: float, p: float) -> float:
    """Return the t whose `student_cdf` is p, 0 < p < 1.

    Newton's method for the logarithm of the tail as a function of log t. The function is concave
    and decreasing, so the method converges from any start.
    """
    if math.isinf(dof):
        return normal_quantile(p)
    target_tail, dof = min(p, 1.0 - p), max(dof, MIN_DOF)
    if target_tail == 0.5:
        return 0.0
    t = -normal_quantile(target_tail)
    for _ in range(100):
        tail = _student_tail(dof, t)
        step = math.log(tail / target_tail) * tail / (t * _student_density(dof, t))
        t *= math.exp(min(step, 50.0))
        if abs(step) < 1e-14:
            break
    return -t if p < 0.5 else t


def log_binomial(n: float, k: float) -> float:
    """Return the logarithm of the binomial coefficient."""
    return math.lgamma(n + 1.0) - math.lgamma(k + 1.0) - math.lgamma(n - k + 1.0)


def _student_tail(dof: float, t: float) -> float:
    """Return the probability above t >= 0: half of I_x(dof/2, 1/2), x = dof/(dof + t^2)."""
    if dof > _NORMAL_DOF and t**4 < 1e-3 * dof:
        # Near the normal distribution, the fraction would lose digits (Abramowitz and Stegun
        # 26.7.8).
        t_squared = t * t
        correction = t * (t_squared + 1.0) / (4.0 * dof) + t * (
            ((3.0 * t_squared - 7.0) * t_squared - 5.0) * t_squared - 3.0
        ) / (96.0 * dof * dof)
        return normal_cdf(-t) + correction * math.exp(-0.5 * t_squared) / math.sqrt(2.0 * math.pi)
    a = 0.5 * dof
    ratio = t * t / dof
    x, y = 1.0 / (1.0 + ratio), ratio / (1.0 + ratio)
    # x^a y^(1/2) / B(a, 1/2)
    density = _gamma_ratio(a) / math.sqrt(math.pi) * math.exp(-a * math.log1p(ratio)) * math.sqrt(y)
    if x < (a + 1.0) / (a + 2.5):
        return 0.5 * density / a * _beta_continued_fraction(a, 0.5, x)
    return 0.5 - density * _beta_continued_fraction(0.5, a, y)


def _student_density(dof: float, t: float) -> float:
    a = 0.5 * dof
    kernel = math.exp(-(a + 0.5) * math.log1p(t * t / dof))
    return _gamma_ratio(a) / math.sqrt(dof * math.pi) * kernel


def _gamma_ratio(a: float) -> float:
    """Return gamma(a + 1/2) / gamma(a)."""
    if a < _MIN_STIRLING_ARGUMENT:
        return math.exp(math.lgamma(a + 0.5) - math.lgamma(a))
    b = a + 0.5
    log_ratio = a * math.log1p(0.5 / a) - 0.5
    return math.sqrt(a) * math.exp(log_ratio + _stirling_series(b) - _stirling_series(a))


def _stirling_series(a: float) -> float:
    """Return ln gamma(a) minus (a - 1/2) ln a - a + ln(2 pi)/2 (NIST DLMF 5.11.1)."""
    inverse_square = 1.0 / (a * a)
    return (
        1.0 / 12.0
        - inverse_square * (1.0 / 360.0 - inverse_square * (1.0 / 1260.0 - inverse_square / 1680.0))
    ) / a


def _gamma_continued_fraction(a: float, x: float) -> float:
    """Return gamma(a, x) exp(x) / x^a by Lentz's method."""
    b = x + 1.0 - a
    c, d = math.inf, 1.0 / b
    value, relative_change, n = d, math.inf, 0.0
    while relative_change > _SERIES_TOLERANCE:
        n += 1.0
        numerator = -n * (n - a)
        b += 2.0
        d = 1.0 / (numerator * d + b)
        c = b + numerator / c
        value *= c * d
        relative_change = abs(c * d - 1.0)
    return value


def _beta_continued_fraction(a: float, b: float, x: float) -> float:
    """Return a B_x(a, b) / (x^a (1 - x)^b) by Lentz's method (NIST DLMF 8.17.22)."""
    c, d = 1.0, 1.0 / (1.0 - (a + b) * x / (a + 1.0))
    value, relative_change, m = d, math.inf, 0.0
    while relative_change > _SERIES_TOLERANCE:
        m += 1.0
        for numerator in (
            m * (b - m) * x / ((a + 2.0 * m - 1.0) * (a + 2.0 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2.0 * m) * (a + 2.0 * m + 1.0)),
        ):
            d = 1.0 / (1.0 + numerator * d)
            c = 1.0 + numerator / c
            value *= c * d
        relative_change = abs(c * d - 1.0)
    return value


def finite_dof(dof: float) -> float | None:
    """Return degrees of freedom for a result; None if they are practically infinite.

    Satterthwaite's formula gives numbers such as 9e16 if almost no part of u was estimated.
    """
    return dof if dof < _INFINITE_DOF else None


def expanded_uncertainty(u: float, dof: float | None, coverage: float = COVERAGE) -> float:
    """Return half the width of the coverage interval: Student's factor times u (GUM G.3)."""
    p = 0.5 * (1.0 + coverage)
    return student_quantile(math.inf if dof is None else dof, p) * u


def numerical_tolerance(u: float) -> float:
    """Return half a unit of the last of two significant digits of u (JCGM 101, 7.9.2)."""
    return 0.5 * 10.0 ** (math.floor(math.log10(u)) - 1) if u else 0.0
