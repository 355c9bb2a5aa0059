"""Uncertainty of the coefficients due to a walk that the records do not show.

Near the limit of what records can show, the criterion drops a random walk that is there. Estimates
are none the worse for it, but their intervals are: K_F and K_II rest on the slowest changes of a
record, where the walk is greatest, and a walk that nobody sees can triple their standard deviation.
No rule could tell such records from records without a walk. So the weights are those without it,
and the uncertainty is that of these weights averaged over the walks that the records allow.

The density of N^2, given the records, is the restricted likelihood times (N^2)^(-2/3), which is
N^(-1/3) for N. With this power intervals cover 95 % or more at any size of the walk: just that at
the detection limit, and more near zero, where nothing is wrong and the records cannot know it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.distributions import normal_cdf, student_quantile

#: The density of log N^2 before the records are looked at goes with this power of N^2.
PRIOR_EXPONENT: Final = 1.0 / 3.0

#: Steps of log N^2, in which likelihoods change smoothly.
_LOG_STEP: Final = 1.0

#: Change of the log-likelihood by which a walk shows, and by which it is out of the question.
_VISIBLE_CHANGE: Final = 0.05
_EXCLUDING_CHANGE: Final = 8.0

_MAX_STEPS: Final = 60

#: Levels at which the mixture and Student's distribution are made to agree: one u, and 95 %.
_ONE_SD_LEVEL: Final = normal_cdf(1.0)
_HALF_INTERVAL: Final = 0.975


@frozen
class UndetectedWalk:
    """The posterior of a random walk that the records do not show."""

    levels: Array  #: N^2, (m/s^2)^2/Hz, increasing, shape (g,).
    weights: Array  #: Probability of each, shape (g,).

    @property
    def step(self) -> float:
        """Step of N^2 for derivatives at N = 0."""
        return 1e-2 * float(self.levels[1])


def walk_posterior(
    profile: Callable[[float], tuple[float, float]], first: float, without: float
) -> UndetectedWalk:
    """Return the posterior of a random walk from the profile likelihood of the records.

    profile: Log of a ratio of walk to white noise -> (log-likelihood at the best level of the white
        noise, log N^2).
    """
    for _ in range(_MAX_STEPS):
        if abs(profile(first)[0] - without) < _VISIBLE_CHANGE:
            break
        first -= 2.0 * _LOG_STEP
    values, levels = [], []
    for step in range(_MAX_STEPS):
        value, log_level = profile(first + step * _LOG_STEP)
        values.append(value)
        levels.append(log_level)
        if value < max(without, *values) - _EXCLUDING_CHANGE:
            break
    log_density = np.array(values) + PRIOR_EXPONENT * np.array(levels)
    weights = _LOG_STEP * np.exp(log_density - log_density.max())
    # Below the first level the likelihood is constant: the power is integrated, and so is N^2.
    tail = weights[0] / _LOG_STEP / PRIOR_EXPONENT
    weights[0] *= 0.5
    smallest = math.exp(levels[0]) * PRIOR_EXPONENT / (1.0 + PRIOR_EXPONENT)
    probabilities = np.append(tail, weights)
    return UndetectedWalk(np.append(smallest, np.exp(levels)), probabilities / probabilities.sum())


def marginal_walk(
    unseen: UndetectedWalk, variance: Array, slope: Array, inverse: Array | float = 0.0
) -> tuple[float, Array]:
    """Return a level of the walk that is equivalent to its posterior, with degrees of freedom.

    The coefficient that feels the walk most has Student's distribution fitted to its own: a
    normal one for each level, of variance + slope x level, weighted. For the others, which get
    the same level, the degrees of freedom are those at which the 95 % interval is right.

    variance: u^2 of each coefficient without the walk, shape (p,).
    slope: What N^2 adds to it, per unit, shape (p,).
    inverse: Of the degrees of freedom without the walk.
    Returns: N^2; inverse degrees of freedom of u^2 with it (Welch and Satterthwaite), shape (p,).
    """
    mixture_sds = np.sqrt(variance[:, None] + slope[:, None] * unseen.levels)
    most_affected = int(np.argmax(slope / variance))
    narrow, wide = (
        _quantile(mixture_sds, unseen.weights, level) for level in (_ONE_SD_LEVEL, _HALF_INTERVAL)
    )
    dof = _dof_from_ratio(float(wide[most_affected] / narrow[most_affected]))
    u = float(narrow[most_affected]) / student_quantile(dof, _ONE_SD_LEVEL)
    level = max(u**2 - variance[most_affected], 0.0) / slope[most_affected]
    total = variance + slope * level
    quantile_ratios = wide / np.sqrt(total)
    inverse_of_walk = np.array([1.0 / _dof_from_quantile(float(size)) for size in quantile_ratios])
    return level, (variance / total) ** 2 * inverse + inverse_of_walk


def _quantile(spread: Array, weights: Array, level: float) -> Array:
    """Return a quantile of each mixture of normal distributions, by bisection, shape (p,)."""
    from scipy.special import ndtr

    low, high = np.zeros(len(spread)), 10.0 * spread.max(axis=1)
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = ndtr(middle[:, None] / spread) @ weights < level
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.asarray(high)


def _dof_from_ratio(ratio: float) -> float:
    """Return the degrees of freedom at which Student's two quantiles have this ratio."""
    from scipy.special import stdtrit

    return _root(
        lambda dof: float(stdtrit(dof, _HALF_INTERVAL) / stdtrit(dof, _ONE_SD_LEVEL)), ratio
    )


def _dof_from_quantile(quantile: float) -> float:
    """Return the degrees of freedom of a given 97.5 % quantile."""
    from scipy.special import stdtrit

    return _root(lambda dof: float(stdtrit(dof, _HALF_INTERVAL)), quantile)


def _root(function: Callable[[float], float], value: float) -> float:
    """Return the degrees of freedom, at least 1, at which a decreasing function has a value."""
    low, high = 0.0, math.log(1e6)
    if function(math.exp(high)) >= value:
        return math.inf  # no longer tails than a normal distribution has
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if function(math.exp(middle)) > value else (low, middle)
    return math.exp(high)
