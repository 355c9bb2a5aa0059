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

#: Range of the process and of the error that counts, in standard deviations.
_RANGE: Final = 12.0

#: Nodes in each interval of the quadrature.
_NODES: Final = 16

_BISECTIONS: Final = 60


@frozen
class Process:
    """The distribution of a quantity between items of a process: normal."""

    mean: float
    sigma: float  #: Standard deviation, positive.

    def __post_init__(self) -> None:
        """Refuse a standard deviation that is not positive."""
        if not (math.isfinite(self.mean) and 0.0 < self.sigma < math.inf):
            raise ValueError(f"{self.mean} ± {self.sigma} is not a valid process distribution")


def global_risk(
    process: Process,
    u: float,
    dof: float | None,
    tolerance: tuple[float | None, float | None],
    acceptance: tuple[float | None, float | None],
) -> GlobalRisk:
    """Return the risks of accepting items whose estimate lies between acceptance limits.

    u, dof: Standard uncertainty of an estimate, u >= 0, and its degrees of freedom; None: infinite.
    tolerance, acceptance: Lower and upper limit; None where there is none.
    """
    low, high = _ends(tolerance)
    lower_limit, upper_limit = _ends(acceptance)
    if lower_limit > upper_limit:
        # No estimate passes.
        lower_limit = upper_limit = math.inf
    spread = _RANGE * process.sigma
    begin, end = process.mean - spread, process.mean + spread
    steps = np.array([0.0, *(s * 2.0**k for k in range(-1, 5) for s in (-1.0, 1.0))])
    edges = [
        process.mean + steps * process.sigma,
        *(limit + steps * u for limit in (lower_limit, upper_limit) if math.isfinite(limit)),
        np.array([begin, end, np.clip(low, begin, end), np.clip(high, begin, end)]),
    ]
    nodes = np.unique(np.clip(np.concatenate(edges), begin, end))
    x, weights = np.polynomial.legendre.leggauss(_NODES)
    consumer = producer = 0.0
    for left, right in pairwise(nodes.tolist()):
        middle, half = 0.5 * (left + right), 0.5 * (right - left)
        conforms = low <= middle <= high
        for node, weight in zip(middle + half * x, half * weights, strict=True):
            value = float(node)
            z = (value - process.mean) / process.sigma
            density = float(weight) * math.exp(-0.5 * z * z)
            if conforms:
                producer += density * _probability(
                    value, u, dof, lower_limit, upper_limit, inside=False
                )
            else:
                consumer += density * _probability(
                    value, u, dof, lower_limit, upper_limit, inside=True
                )
    norm = process.sigma * math.sqrt(2.0 * math.pi)
    return GlobalRisk(
        mean=process.mean, sigma=process.sigma, consumer=consumer / norm, producer=producer / norm
    )


def guard_band_for_risk(
    process: Process,
    u: float,
    dof: float | None,
    tolerance: tuple[float | None, float | None],
    consumer: float,
) -> float:
    """Return the smallest guard band with at most a consumer's risk; 0 if none is needed.

    Parameters as in `global_risk`; consumer: The largest permitted risk, positive.
    """
    if not 0.0 < consumer < 1.0:
        raise ValueError(f"a risk must be between 0 and 1; got {consumer}")

    def risk(width: float) -> float:
        low, high = tolerance
        acceptance = (
            None if low is None else low + width,
            None if high is None else high - width,
        )
        return global_risk(process, u, dof, tolerance, acceptance).consumer

    lower_bound, upper_bound = 0.0, _RANGE * (u + process.sigma)
    if risk(lower_bound) <= consumer:
        return 0.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (lower_bound + upper_bound)
        lower_bound, upper_bound = (
            (middle, upper_bound) if risk(middle) > consumer else (lower_bound, middle)
        )
    return upper_bound


def _ends(limits: tuple[float | None, float | None]) -> tuple[float, float]:
    low, high = limits
    return -math.inf if low is None else low, math.inf if high is None else high


def _probability(
    value: float, u: float, dof: float | None, low: float, high: float, *, inside: bool
) -> float:
    """Return the probability of an estimate inside, or outside, the acceptance limits."""
    if u == 0.0:
        return float((low <= value <= high) == inside)
    below, above = (low - value) / u, (high - value) / u
    if not inside:
        return _cdf(below, dof) + _cdf(-above, dof)
    # On one side of both limits, the difference of the small tails keeps its digits.
    if below > 0.0:
        return _cdf(-below, dof) - _cdf(-above, dof)
    return _cdf(above, dof) - _cdf(below, dof)


def _cdf(x: float, dof: float | None) -> float:
    if math.isinf(x):
        return 1.0 if x > 0.0 else 0.0
    return student_cdf(math.inf if dof is None else dof, x)
