"""Uncertainty of the coefficients due to an undetected random walk.

Near the detection limit, the criterion drops an existing random walk. This hardly changes the
estimates, but their intervals: K_F and K_II depend on the slowest changes of a record, where the
walk is largest, and an undetected walk can triple their standard deviation. No criterion can
distinguish such records from records without a walk. Therefore the weights are those without a
walk, and the uncertainty of these weights is averaged over the posterior of the walk.

The posterior density of N^2 is the restricted likelihood times (N^2)^(-2/3), which is N^(-1/3) for
N. With this power, intervals cover 95 % or more for any walk: 95 % at the detection limit, and more
near zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.distributions import normal_cdf, student_quantile

#: Power of N^2 in the prior density of log N^2.
PRIOR_EXPONENT: Final = 1.0 / 3.0

#: Step of log N^2.
_LOG_STEP: Final = 1.0

#: Change of the log-likelihood at which a walk becomes visible, and at which it is excluded.
_DETECTION_CHANGE: Final = 0.05
_EXCLUSION_CHANGE: Final = 8.0

_MAX_STEPS: Final = 60

#: Levels at which the mixture and Student's distribution agree: one u, and 95 %.
_ONE_SD_LEVEL: Final = normal_cdf(1.0)
_INTERVAL_LEVEL: Final = 0.975


@frozen
class UndetectedWalk:
    """Posterior of an undetected random walk."""

    levels: Array  #: N^2, (m/s^2)^2/Hz, increasing, shape (g,).
    weights: Array  #: Probability of each level, shape (g,).

    @property
    def step(self) -> float:
        """Step of N^2 for derivatives at N = 0."""
        return 1e-2 * float(self.levels[1])


def walk_posterior(
    profile: Callable[[float], tuple[float, float]], start: float, log_likelihood_without: float
) -> UndetectedWalk:
    """Return the posterior of a random walk from the profile likelihood of the records.

    profile: Log of a ratio of walk to white noise -> (log-likelihood at the best level of the white
        noise, log N^2).
    """
    for _ in range(_MAX_STEPS):
        if abs(profile(start)[0] - log_likelihood_without) < _DETECTION_CHANGE:
            break
        start -= 2.0 * _LOG_STEP
    log_likelihoods, log_levels = [], []
    for step in range(_MAX_STEPS):
        log_likelihood, log_level = profile(start + step * _LOG_STEP)
        log_likelihoods.append(log_likelihood)
        log_levels.append(log_level)
        if log_likelihood < max(log_likelihood_without, *log_likelihoods) - _EXCLUSION_CHANGE:
            break
    log_density = np.array(log_likelihoods) + PRIOR_EXPONENT * np.array(log_levels)
    weights = _LOG_STEP * np.exp(log_density - log_density.max())
    # Below the first level, the likelihood is constant, and the power is integrated.
    tail_weight = weights[0] / _LOG_STEP / PRIOR_EXPONENT
    weights[0] *= 0.5
    lowest_level = math.exp(log_levels[0]) * PRIOR_EXPONENT / (1.0 + PRIOR_EXPONENT)
    probabilities = np.append(tail_weight, weights)
    return UndetectedWalk(
        np.append(lowest_level, np.exp(log_levels)), probabilities / probabilities.sum()
    )


def marginal_walk(
    walk: UndetectedWalk, variances: Array, sensitivities: Array, inverse_dof: Array | float = 0.0
) -> tuple[float, Array]:
    """Return a level of the walk that is equivalent to its posterior, with degrees of freedom.

    The distribution of a coefficient is a mixture of normal distributions with the variances
    variance + sensitivity x level. Student's distribution is fitted to that of the most sensitive
    coefficient. The other coefficients have the same level, and degrees of freedom with a correct
    95 % interval.

    variances: u^2 of each coefficient without the walk, shape (p,).
    sensitivities: Increase of u^2 per unit of N^2, shape (p,).
    inverse_dof: Inverse degrees of freedom without the walk.
    Returns: N^2; inverse degrees of freedom of u^2 with the walk (Welch-Satterthwaite), shape (p,).
    """
    mixture_sds = np.sqrt(variances[:, None] + sensitivities[:, None] * walk.levels)
    most_affected = int(np.argmax(sensitivities / variances))
    sd_quantiles, interval_quantiles = (
        _quantile(mixture_sds, walk.weights, level) for level in (_ONE_SD_LEVEL, _INTERVAL_LEVEL)
    )
    dof = _dof_from_ratio(float(interval_quantiles[most_affected] / sd_quantiles[most_affected]))
    u = float(sd_quantiles[most_affected]) / student_quantile(dof, _ONE_SD_LEVEL)
    level = max(u**2 - variances[most_affected], 0.0) / sensitivities[most_affected]
    total_variances = variances + sensitivities * level
    quantile_ratios = interval_quantiles / np.sqrt(total_variances)
    walk_inverse_dof = np.array(
        [1.0 / _dof_from_quantile(float(ratio)) for ratio in quantile_ratios]
    )
    return level, (variances / total_variances) ** 2 * inverse_dof + walk_inverse_dof


def _quantile(sds: Array, weights: Array, level: float) -> Array:
    """Return a quantile of each mixture of normal distributions, by bisection, shape (p,)."""
    from scipy.special import ndtr

    low, high = np.zeros(len(sds)), 10.0 * sds.max(axis=1)
    for _ in range(60):
        midpoint = 0.5 * (low + high)
        is_below = ndtr(midpoint[:, None] / sds) @ weights < level
        low, high = np.where(is_below, midpoint, low), np.where(is_below, high, midpoint)
    return np.asarray(high)


def _dof_from_ratio(ratio: float) -> float:
    """Return the degrees of freedom at which Student's two quantiles have this ratio."""
    from scipy.special import stdtrit

    return _solve_for_dof(
        lambda dof: float(stdtrit(dof, _INTERVAL_LEVEL) / stdtrit(dof, _ONE_SD_LEVEL)), ratio
    )


def _dof_from_quantile(quantile: float) -> float:
    """Return the degrees of freedom of a given 97.5 % quantile."""
    from scipy.special import stdtrit

    return _solve_for_dof(lambda dof: float(stdtrit(dof, _INTERVAL_LEVEL)), quantile)


def _solve_for_dof(function: Callable[[float], float], value: float) -> float:
    """Return the degrees of freedom, at least 1, at which a decreasing function has a value."""
    low, high = 0.0, math.log(1e6)
    if function(math.exp(high)) >= value:
        return math.inf  # no longer tails than a normal distribution has
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if function(math.exp(middle)) > value else (low, middle)
    return math.exp(high)
