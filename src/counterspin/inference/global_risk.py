"""Global risks of a decision rule for items of a known process (JCGM 106:2012, clause 9).

The quantity varies between items with a normal distribution, and the measurement error with a
normal distribution or Student's t. The consumer's risk is the probability that an item is accepted
and does not conform. The producer's risk is the probability that it conforms and is not accepted.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Final

import numpy as np

from counterspin.frozen import frozen
from counterspin.inference.distributions import student_cdf
from counterspin.inference.verdicts import GlobalRisk

#: Half-range of the integration over process and error, in standard deviations.
_RANGE_FACTOR: Final = 12.0

#: Nodes in each interval of the quadrature.
_NODES_PER_INTERVAL: Final = 16

_BISECTIONS: Final = 60


@frozen
class Process:
    """The distribution of a quantity between items of a process: normal."""

    mean: float
    sigma: float  #: Standard deviation, positive.

    def __post_init__(self) -> None:
        """Raise ValueError if the standard deviation is not positive."""
        if not (math.isfinite(self.mean) and 0.0 < self.sigma < math.inf):
            raise ValueError(f"{self.mean} ± {self.sigma} is not a valid process distribution")


def global_risk(
    process: Process,
    u: float,
    dof: float | None,
    tolerance_limits: tuple[float | None, float | None],
    acceptance: tuple[float | None, float | None],
) -> GlobalRisk:
    """Return the risks of accepting items whose estimate lies between acceptance limits.

    u, dof: Standard uncertainty of an estimate, u >= 0, and its degrees of freedom; None: infinite.
    tolerance_limits, acceptance: Lower and upper limit; None where there is none.
    """
    low, high = _infinite_if_missing(tolerance_limits)
    lower_acceptance, upper_acceptance = _infinite_if_missing(acceptance)
    if lower_acceptance > upper_acceptance:
        # No estimate passes.
        lower_acceptance = upper_acceptance = math.inf
    half_range = _RANGE_FACTOR * process.sigma
    begin, end = process.mean - half_range, process.mean + half_range
    offsets = np.array([0.0, *(s * 2.0**k for k in range(-1, 5) for s in (-1.0, 1.0))])
    breakpoint_groups = [
        process.mean + offsets * process.sigma,
        *(
            limit + offsets * u
            for limit in (lower_acceptance, upper_acceptance)
            if math.isfinite(limit)
        ),
        np.array([begin, end, np.clip(low, begin, end), np.clip(high, begin, end)]),
    ]
    breakpoints = np.unique(np.clip(np.concatenate(breakpoint_groups), begin, end))
    x, weights = np.polynomial.legendre.leggauss(_NODES_PER_INTERVAL)
    consumer_risk = producer_risk = 0.0
    for left, right in pairwise(breakpoints.tolist()):
        midpoint, half_width = 0.5 * (left + right), 0.5 * (right - left)
        is_conforming = low <= midpoint <= high
        for node, weight in zip(midpoint + half_width * x, half_width * weights, strict=True):
            value = float(node)
            z = (value - process.mean) / process.sigma
            density = float(weight) * math.exp(-0.5 * z * z)
            if is_conforming:
                producer_risk += density * _acceptance_probability(
                    value, u, dof, lower_acceptance, upper_acceptance, is_accepted=False
                )
            else:
                consumer_risk += density * _acceptance_probability(
                    value, u, dof, lower_acceptance, upper_acceptance, is_accepted=True
                )
    normalisation = process.sigma * math.sqrt(2.0 * math.pi)
    return GlobalRisk(
        mean=process.mean,
        sigma=process.sigma,
        consumer=consumer_risk / normalisation,
        producer=producer_risk / normalisation,
    )


def guard_band_for_risk(
    process: Process,
    u: float,
    dof: float | None,
    tolerance_limits: tuple[float | None, float | None],
    max_consumer_risk: float,
) -> float:
    """Return the smallest guard band for a permitted consumer's risk; 0 if none is needed.

    The first four parameters are those of `global_risk`.

    max_consumer_risk: Largest permitted consumer's risk, above 0 and below 1.
    """
    if not 0.0 < max_consumer_risk < 1.0:
        raise ValueError(f"a risk must be between 0 and 1; got {max_consumer_risk}")

    def consumer_risk(guard_band: float) -> float:
        low, high = tolerance_limits
        acceptance = (
            None if low is None else low + guard_band,
            None if high is None else high - guard_band,
        )
        return global_risk(process, u, dof, tolerance_limits, acceptance).consumer

    lower_bound, upper_bound = 0.0, _RANGE_FACTOR * (u + process.sigma)
    if consumer_risk(lower_bound) <= max_consumer_risk:
        return 0.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (lower_bound + upper_bound)
        lower_bound, upper_bound = (
            (middle, upper_bound)
            if consumer_risk(middle) > max_consumer_risk
            else (lower_bound, middle)
        )
    return upper_bound


def _infinite_if_missing(limits: tuple[float | None, float | None]) -> tuple[float, float]:
    low, high = limits
    return -math.inf if low is None else low, math.inf if high is None else high


def _acceptance_probability(
    value: float, u: float, dof: float | None, low: float, high: float, *, is_accepted: bool
) -> float:
    """Return the probability that an estimate is accepted, or that it is rejected."""
    if u == 0.0:
        return float((low <= value <= high) == is_accepted)
    z_low, z_high = (low - value) / u, (high - value) / u
    if not is_accepted:
        return _cdf(z_low, dof) + _cdf(-z_high, dof)
    # If both limits are above the value, the difference of the small tails keeps its digits.
    if z_low > 0.0:
        return _cdf(-z_low, dof) - _cdf(-z_high, dof)
    return _cdf(z_high, dof) - _cdf(z_low, dof)


def _cdf(x: float, dof: float | None) -> float:
    if math.isinf(x):
        return 1.0 if x > 0.0 else 0.0
    return student_cdf(math.inf if dof is None else dof, x)
