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
_TAIL: Final = 0.025

#: Satterthwaite's formula holds from so many degrees of freedom on, and below so small a share.
_MANY_DOF: Final = 50.0
_LEAST_SHARE: Final = 1e-6

#: Steps of the integral over the estimated variance.
_NODES: Final = 80

#: Difference of tails, and of logarithms of what they are tails of, that no digit shows.
_LEAST_EXCESS: Final = 1e-13


def mixture_tail(share: float, dof: float, q: float) -> float:
    """Return the probability that a sum of something estimated and something known exceeds q.

    The sum, sqrt(1 - share) z + sqrt(share) t, z being normal and t Student's, is over its standard
    uncertainty. Satterthwaite's formula for its degrees of freedom, dof / share^2, gives as much
    where `dof` are many; few of them leave tails that it does not see.

    share: Part that what is estimated has in the variance, from 0 to 1.
    q: Not below 0.
    """
    if dof > _MANY_DOF or not _LEAST_SHARE < share < 1.0:
        return student_cdf(dof / share**2 if share > 0.0 else math.inf, -q)
    return math.fsum(
        weight * normal_cdf(-q / math.sqrt(1.0 - share + share * variance))
        for weight, variance in _mixture(dof)
    )


@lru_cache(maxsize=16)
def _mixture(dof: float) -> list[tuple[float, float]]:
    """Return weights, of sum 1, and values of the true variance over the estimated one."""
    # It is dof / chi-square: over u, the logarithm of chi-square / dof, whose density is
    # exp(-dof/2 (e^u - 1 - u)) but for a factor.
    reach = 40.0 / dof
    low, high = -reach - 1.0, math.log1p(reach + math.sqrt(2.0 * reach))
    nodes = [low + (high - low) * k / _NODES for k in range(_NODES + 1)]
    weights = [math.exp(-0.5 * dof * (math.expm1(u) - u)) for u in nodes]
    total = sum(weights)
    return [(weight / total, math.exp(-u)) for weight, u in zip(weights, nodes, strict=True)]


def mixture_dof(share: float, dof: float) -> float:
    """Return the degrees of freedom whose Student's interval of 95 % is that of `mixture_tail`."""
    satterthwaite = dof / share**2 if share > 0.0 else math.inf
    if dof > _MANY_DOF or not _LEAST_SHARE < share < 1.0:
        return satterthwaite
    dof = max(dof, MIN_DOF)
    # Between the normal quantile and Student's own, both over the logarithm.
    low, high = -normal_quantile(_TAIL), -student_quantile(dof, _TAIL)
    q = math.exp(
        _find_root(
            lambda log_q: mixture_tail(share, dof, math.exp(log_q)) - _TAIL,
            math.log(low),
            math.log(high),
        )
    )
    matched_dof = math.exp(
        _find_root(
            lambda log_dof: student_cdf(math.exp(log_dof), -q) - _TAIL,
            math.log(dof),
            30.0,
        )
    )
    return min(matched_dof, satterthwaite)


def estimated_part_dof(share: float, dof: float) -> float:
    """Return the degrees of freedom of the estimated part of a sum; the inverse of `mixture_dof`.

    share: Part that what is estimated has in the variance, from 0 to 1.
    dof: Of the sum.
    """
    satterthwaite = dof * share**2
    if satterthwaite > _MANY_DOF or not _LEAST_SHARE < share < 1.0:
        return satterthwaite
    q = -student_quantile(dof, _TAIL)
    return math.exp(
        _find_root(
            lambda log_dof: mixture_tail(share, math.exp(log_dof), q) - _TAIL,
            math.log(MIN_DOF),
            math.log(_MANY_DOF),
        )
    )


def _find_root(excess: Callable[[float], float], low: float, high: float) -> float:
    """Return where a falling function is zero, or the end that is nearest to it.

    False position; an end that stays has its value halved (the Illinois algorithm).
    """
    excess_low, excess_high = excess(low), excess(high)
    if excess_low <= 0.0:
        return low
    if excess_high >= 0.0:
        return high
    middle = previous = 0.0
    for _ in range(60):
        middle = (low * excess_high - high * excess_low) / (excess_high - excess_low)
        value = excess(middle)
        if abs(value) < _LEAST_EXCESS or high - low < _LEAST_EXCESS:
            break
        if value > 0.0:
            low, excess_low = middle, value
            excess_high *= 0.5 if previous > 0.0 else 1.0
        else:
            high, excess_high = middle, value
            excess_low *= 0.5 if previous < 0.0 else 1.0
        previous = value
    return middle
