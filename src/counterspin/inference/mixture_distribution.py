"""Distribution of a sum of an estimated and a known part, in plain Python."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Final

from counterspin.inference.distributions import (
    MIN_DOF,
    normal_cdf,
    normal_quantile,
    student_cdf,
    student_quantile,
)

#: `mixture_dof` matches the tail beyond an interval of 95 %.
_TAIL_PROBABILITY: Final = 0.025

#: Satterthwaite's formula holds above these degrees of freedom, and below this share.
_LARGE_DOF: Final = 50.0
_MIN_SHARE: Final = 1e-6

#: Number of steps of the integral over the estimated variance.
_N_NODES: Final = 80

#: Tolerance of root finding: of the function, and of its argument.
_ROOT_TOLERANCE: Final = 1e-13


def mixture_tail(share: float, dof: float, q: float) -> float:
    """Return the probability that the sum of an estimated and a known part exceeds q.

    The standardised sum is sqrt(1 - share) z + sqrt(share) t, with z normal and t Student's.
    Satterthwaite's formula for its degrees of freedom, dof / share^2, is accurate for large `dof`;
    for small `dof` it underestimates the tails.

    share: Share of the estimated part in the variance, from 0 to 1.
    dof: Degrees of freedom of the estimated part.
    q: Quantile, in standard uncertainties of the sum, not negative.
    """
    if dof > _LARGE_DOF or not _MIN_SHARE < share < 1.0:
        return student_cdf(dof / share**2 if share > 0.0 else math.inf, -q)
    return math.fsum(
        weight * normal_cdf(-q / math.sqrt(1.0 - share + share * variance))
        for weight, variance in _variance_nodes(dof)
    )


@lru_cache(maxsize=16)
def _variance_nodes(dof: float) -> list[tuple[float, float]]:
    """Return weights, with sum 1, and values of the ratio of true to estimated variance."""
    # The ratio is dof / chi-square. The density of u = log(chi-square / dof) is proportional to
    # exp(-dof/2 (e^u - 1 - u)).
    half_range = 40.0 / dof
    low, high = -half_range - 1.0, math.log1p(half_range + math.sqrt(2.0 * half_range))
    nodes = [low + (high - low) * k / _N_NODES for k in range(_N_NODES + 1)]
    weights = [math.exp(-0.5 * dof * (math.expm1(u) - u)) for u in nodes]
    total = sum(weights)
    return [(weight / total, math.exp(-u)) for weight, u in zip(weights, nodes, strict=True)]


def mixture_dof(share: float, dof: float) -> float:
    """Return the degrees of freedom of Student's t with the 95 % interval of the mixture."""
    satterthwaite_dof = dof / share**2 if share > 0.0 else math.inf
    if dof > _LARGE_DOF or not _MIN_SHARE < share < 1.0:
        return satterthwaite_dof
    dof = max(dof, MIN_DOF)
    # Search between the logarithms of the normal and of Student's quantile.
    low, high = -normal_quantile(_TAIL_PROBABILITY), -student_quantile(dof, _TAIL_PROBABILITY)
    q = math.exp(
        _find_root(
            lambda log_q: mixture_tail(share, dof, math.exp(log_q)) - _TAIL_PROBABILITY,
            math.log(low),
            math.log(high),
        )
    )
    matched_dof = math.exp(
        _find_root(
            lambda log_dof: student_cdf(math.exp(log_dof), -q) - _TAIL_PROBABILITY,
            math.log(dof),
            30.0,
        )
    )
    return min(matched_dof, satterthwaite_dof)


def estimated_part_dof(share: float, dof: float) -> float:
    """Return the degrees of freedom of the estimated part of a sum; the inverse of `mixture_dof`.

    share: Share of the estimated part in the variance, from 0 to 1.
    dof: Degrees of freedom of the sum.
    """
    satterthwaite = dof * share**2
    if satterthwaite > _LARGE_DOF or not _MIN_SHARE < share < 1.0:
        return satterthwaite
    q = -student_quantile(dof, _TAIL_PROBABILITY)
    return math.exp(
        _find_root(
            lambda log_dof: mixture_tail(share, math.exp(log_dof), q) - _TAIL_PROBABILITY,
            math.log(MIN_DOF),
            math.log(_LARGE_DOF),
        )
    )


def _find_root(function: Callable[[float], float], low: float, high: float) -> float:
    """Return the root of a decreasing function, or the nearest end of the interval.

    False position with the Illinois modification.
    """
    value_low, value_high = function(low), function(high)
    if value_low <= 0.0:
        return low
    if value_high >= 0.0:
        return high
    midpoint = previous_value = 0.0
    for _ in range(60):
        midpoint = (low * value_high - high * value_low) / (value_high - value_low)
        value = function(midpoint)
        if abs(value) < _ROOT_TOLERANCE or high - low < _ROOT_TOLERANCE:
            break
        if value > 0.0:
            low, value_low = midpoint, value
            value_high *= 0.5 if previous_value > 0.0 else 1.0
        else:
            high, value_high = midpoint, value
            value_low *= 0.5 if previous_value < 0.0 else 1.0
        previous_value = value
    return midpoint
