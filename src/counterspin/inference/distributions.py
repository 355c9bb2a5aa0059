"""Normal, chi-square and Student's distribution for single numbers, in plain Python.

A usual calibration asks these some fifty times; loading SciPy for that would take it as long as
everything that it computes.

Compared with SciPy and mpmath they have ten correct digits or more, in far tails too.
"""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Final

#: Coverage probability of an expanded uncertainty, also of one that is the unit of a guard band.
COVERAGE: Final = 0.95

#: Relative change at which a series or a continued fraction ends.
_SERIES_TOLERANCE: Final = 4e-16

#: From here on Stirling's series has more correct digits than a difference of `math.lgamma`.
_STIRLING_FROM: Final = 100.0

#: More degrees of freedom make Student's distribution all but the normal one.
_NORMAL_DOF: Final = 1e6

#: From so many degrees of freedom on, Student's factor is the normal one to nine digits.
_INFINITE_DOF: Final = 1e9

_NORMAL: Final = NormalDist()

#: Of fewer degrees of freedom 95 % lie within more than 1e12 standard uncertainties, and beyond
#: what a number can be: nothing is known.
MIN_DOF: Final = 0.1


def normal_cdf(x: float) -> float:
    """Return the probability of a standard normal number below x."""
    return 0.5 * math.erfc(-x / math.sqrt(2.0))


def normal_quantile(p: float) -> float:
    """Return the x whose `normal_cdf` is p, 0 < p < 1."""
    return _NORMAL.inv_cdf(p)


def chi_square_tail(dof: float, chi2: float) -> float:
    """Return the probability of a sum of squares above chi2: Q(dof/2, chi2/2).

    Q is the regularised incomplete gamma function (NIST DLMF 8.2.4), by its series (8.7.1) below
    the mean and its continued fraction (8.9.2) above.
    """
    a, x = 0.5 * dof, 0.5 * chi2
    if x <= 0.0 or math.isinf(x):
        return 1.0 if x <= 0.0 else 0.0
    # x^a exp(-x) / gamma(a + 1), whose factors would overflow.
    deviation = (x - a) / a
    if deviation <= -1.0:  # to all digits; a is large then
        return 1.0
    if a >= _STIRLING_FROM:
        density = math.exp(-a * (deviation - math.log1p(deviation))) / (
            math.sqrt(2.0 * math.pi * a) * math.exp(_stirling(a))
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
    """Return the probability of Student's number of `dof` degrees of freedom below t."""
    if math.isinf(dof) or math.isinf(t):
        return normal_cdf(t)
    return _student_tail(dof, -t) if t < 0.0 else 1.0 - _student_tail(dof, t)


def student_quantile(dof: float, p: float) -> float:
    """Return the t whose `student_cdf` is p, 0 < p < 1.

    Newton's method on the logarithm of the tail against that of t: a concave falling function, so
    that it settles from any start.
    """
    if math.isinf(dof):
        return normal_quantile(p)
    tail, dof = min(p, 1.0 - p), max(dof, MIN_DOF)
    if tail == 0.5:
        return 0.0
    t = -normal_quantile(tail)
    for _ in range(100):
        density = _student_tail(dof, t)
        step = math.log(density / tail) * density / (t * _student_density(dof, t))
        t *= math.exp(min(step, 50.0))
        if abs(step) < 1e-14:
            break
    return -t if p < 0.5 else t


def log_binomial(n: float, k: float) -> float:
    """Return the logarithm of n over k."""
    return math.lgamma(n + 1.0) - math.lgamma(k + 1.0) - math.lgamma(n - k + 1.0)


def _student_tail(dof: float, t: float) -> float:
    """Return the probability above t >= 0: half of I_x(dof/2, 1/2), x = dof/(dof + t^2)."""
    if dof > _NORMAL_DOF and t**4 < 1e-3 * dof:
        # So near the normal distribution the fraction would lose digits (Abramowitz and Stegun
        # 26.7.8).
        square = t * t
        correction = t * (square + 1.0) / (4.0 * dof) + t * (
            ((3.0 * square - 7.0) * square - 5.0) * square - 3.0
        ) / (96.0 * dof * dof)
        return normal_cdf(-t) + correction * math.exp(-0.5 * square) / math.sqrt(2.0 * math.pi)
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
    return (
        _gamma_ratio(a) / math.sqrt(dof * math.pi) * math.exp(-(a + 0.5) * math.log1p(t * t / dof))
    )


def _gamma_ratio(a: float) -> float:
    """Return gamma(a + 1/2) / gamma(a)."""
    if a < _STIRLING_FROM:
        return math.exp(math.lgamma(a + 0.5) - math.lgamma(a))
    b = a + 0.5
    log_ratio = a * math.log1p(0.5 / a) - 0.5
    return math.sqrt(a) * math.exp(log_ratio + _stirling(b) - _stirling(a))


def _stirling(a: float) -> float:
    """Return ln gamma(a) less (a - 1/2) ln a - a + ln(2 pi)/2 (NIST DLMF 5.11.1)."""
    square = 1.0 / (a * a)
    return (1.0 / 12.0 - square * (1.0 / 360.0 - square * (1.0 / 1260.0 - square / 1680.0))) / a


def _gamma_continued_fraction(a: float, x: float) -> float:
    """Return gamma(a, x) exp(x) / x^a by Lentz's method."""
    b = x + 1.0 - a
    c, d = math.inf, 1.0 / b
    value, change, n = d, math.inf, 0.0
    while change > _SERIES_TOLERANCE:
        n += 1.0
        step = -n * (n - a)
        b += 2.0
        d = 1.0 / (step * d + b)
        c = b + step / c
        value *= c * d
        change = abs(c * d - 1.0)
    return value


def _beta_continued_fraction(a: float, b: float, x: float) -> float:
    """Return a B_x(a, b) / (x^a (1 - x)^b) by Lentz's method (NIST DLMF 8.17.22)."""
    c, d = 1.0, 1.0 / (1.0 - (a + b) * x / (a + 1.0))
    value, change, m = d, math.inf, 0.0
    while change > _SERIES_TOLERANCE:
        m += 1.0
        for step in (
            m * (b - m) * x / ((a + 2.0 * m - 1.0) * (a + 2.0 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2.0 * m) * (a + 2.0 * m + 1.0)),
        ):
            d = 1.0 / (1.0 + step * d)
            c = 1.0 + step / c
            value *= c * d
        change = abs(c * d - 1.0)
    return value


def finite_dof(dof: float) -> float | None:
    """Return degrees of freedom as a result states them: None where they are as good as infinite.

    Satterthwaite's formula gives numbers such as 9e16 where next to nothing of u was estimated.
    """
    return dof if dof < _INFINITE_DOF else None


def expanded_uncertainty(u: float, dof: float | None, coverage: float = COVERAGE) -> float:
    """Return half the width of the coverage interval: Student's factor times u (GUM G.3)."""
    tail = 0.5 * (1.0 + coverage)
    return student_quantile(math.inf if dof is None else dof, tail) * u


def numerical_tolerance(u: float) -> float:
    """Return half a unit of the last of two significant digits of u (JCGM 101, 7.9.2)."""
    return 0.5 * 10.0 ** (math.floor(math.log10(u)) - 1) if u else 0.0
