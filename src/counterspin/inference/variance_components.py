"""Variance of repeated measurements beyond their own uncertainties, by what was repeated.

Each measurement has a known uncertainty, and its groups: which day it is of, which mounting, which
turn-on. Whatever is common to a group is drawn anew for each, with the variance of its component;
measurements then have the covariance C + sum of v_c Z_c Z_c^T. The variances are those of the
restricted likelihood, which allows for the mean (or line) being estimated from the same data:

    -2 l = log|V| + log|X^T V^-1 X| + y^T P y,   P = V^-1 - V^-1 X (X^T V^-1 X)^-1 X^T V^-1.

In balanced classes they are those of the analysis of variance, where these are not negative.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from functools import lru_cache
from itertools import product
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen

#: Variances are looked for between these parts of the measurements' own.
_SMALLEST: Final = 1e-10
_LARGEST: Final = 1e6

#: Coverage of intervals.
_COVERAGE: Final = 0.95

#: A variance below this part of the measurements' own is none if that is as likely.
_SMALL: Final = 1e-2


@frozen
class Component:
    """Variance of measurements between groups."""

    groups: int  #: How many there are.
    #: What they tell beyond coarser groups; the variance of s groups alone has s - 1.
    freedom: int
    value: float  #: Standard deviation, in the unit of the measurements; 0: nothing is seen.
    #: Its 95 % interval by the profile of the restricted likelihood; `low` is 0 where there may be
    #: nothing.
    low: float
    high: float


@frozen
class VarianceComponents:
    """Components by name, and what is estimated beside them."""

    components: Mapping[str, Component]
    #: Name of groups that cannot be told from those of a component -> that component.
    same_as: Mapping[str, str]
    value: float  #: Of the first column of the design, such as the mean, weighed with all of them.
    u: float  #: Its standard uncertainty, with all of them.


def variance_components(
    values: Array, covariance: Array, groups: Mapping[str, Sequence[Hashable]], design: Array
) -> VarianceComponents:
    """Find the variance of each component.

    values, covariance: Measurements, shape (n,), and what is known of their errors, shape (n, n).
    groups: Component -> the group of each measurement. Coarser ones count first: what finer groups
        show that coarser ones show too is these.
    design: Columns of what is estimated beside, such as the mean, shape (n, p).
    """
    distinct, same_as = _distinct_groups(groups, design)
    search = _RestrictedDeviance(
        values, covariance, [item for item, _ in distinct.values()], design
    )
    estimate, min_deviance = search.best()
    components = {}
    for index, (name, (of_group, freedom)) in enumerate(distinct.items()):
        low, high = search.interval(index, estimate, min_deviance, freedom)
        components[name] = Component(
            groups=of_group.shape[1],
            freedom=freedom,
            value=math.sqrt(estimate[index]),
            low=math.sqrt(low),
            high=math.sqrt(high),
        )
    inverse, weighted_design = search.weights(estimate)
    mean = np.linalg.solve(weighted_design, design.T @ inverse @ values)
    return VarianceComponents(
        components, same_as, float(mean[0]), math.sqrt(float(np.linalg.inv(weighted_design)[0, 0]))
    )


def _distinct_groups(
    groups: Mapping[str, Sequence[Hashable]], design: Array
) -> tuple[dict[str, tuple[Array, int]], dict[str, str]]:
    """Return the indicators of groups, shape (n, g), with what they tell beyond coarser ones."""
    distinct: dict[str, tuple[Array, int]] = {}
    same_as: dict[str, str] = {}
    independent_columns, rank = design, int(np.linalg.matrix_rank(design))
    for name, labels in sorted(groups.items(), key=lambda item: len(set(item[1]))):
        indices = {label: index for index, label in enumerate(dict.fromkeys(labels))}
        indicator = np.eye(len(indices))[[indices[label] for label in labels]]
        combined_design = np.hstack([independent_columns, indicator])
        dof = int(np.linalg.matrix_rank(combined_design)) - rank
        if dof > 0:
            distinct[name] = indicator, dof
            independent_columns, rank = combined_design, rank + dof
        elif len(indices) > 1 and distinct:
            same_as[name] = list(distinct)[-1]
    return distinct, same_as


class _RestrictedDeviance:
    """The restricted likelihood of variances, in units of the measurements' own."""

    def __init__(
        self, values: Array, covariance: Array, indicators: Sequence[Array], design: Array
    ) -> None:
        self.values, self.design, self.covariance = values, design, covariance
        self.parts = [indicator @ indicator.T for indicator in indicators]
        residuals = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
        mean_variance = float(np.mean(np.diag(covariance)))
        self.scale = max(mean_variance, float(residuals @ residuals) / values.size)

    def weights(self, variances: Array) -> tuple[Array, Array]:
        """Return V^-1, shape (n, n), and X^T V^-1 X."""
        covariance = self.covariance + sum(
            (v * component for v, component in zip(variances, self.parts, strict=True)), 0.0
        )
        inverse = np.linalg.inv(covariance)
        return inverse, self.design.T @ inverse @ self.design

    def deviance(self, variances: Array) -> tuple[float, Array]:
        """Return -2 l and its derivatives by the variances."""
        try:
            inverse, weighted = self.weights(variances)
            (sign, log_det), (_, log_det_of_mean) = (
                np.linalg.slogdet(matrix) for matrix in (inverse, weighted)
            )
            weighted_design = inverse @ self.design
            projection = inverse - weighted_design @ np.linalg.solve(weighted, weighted_design.T)
        except np.linalg.LinAlgError:
            return math.inf, np.zeros(len(self.parts))
        if not (sign > 0.0 and np.isfinite(projection).all()):
            return math.inf, np.zeros(len(self.parts))
        residual = projection @ self.values
        deviance = -log_det + log_det_of_mean + float(self.values @ residual)
        slopes = [
            np.sum(projection * component) - residual @ component @ residual
            for component in self.parts
        ]
        return float(deviance), np.array(slopes)

    def minimise(self, start: Array, fixed_variances: Mapping[int, float]) -> tuple[Array, float]:
        """Return the variances of the least -2 l from a start, some of them fixed, and that."""
        from scipy.optimize import minimize

        free = [index for index in range(len(self.parts)) if index not in fixed_variances]
        variances = np.array(start, dtype=float)
        for index, value in fixed_variances.items():
            variances[index] = value
        if not free:
            return variances, self.deviance(variances)[0]

        def deviance_of_logs(x: Array) -> tuple[float, Array]:
            variances[free] = np.exp(x) * self.scale
            deviance, slopes = self.deviance(variances)
            return (deviance if math.isfinite(deviance) else 1e300), slopes[free] * variances[free]

        ends = (math.log(_SMALLEST), math.log(_LARGEST))
        initial = np.clip(np.log(np.maximum(variances[free], 1e-300) / self.scale), *ends)
        result = minimize(
            deviance_of_logs, initial, jac=True, method="L-BFGS-B", bounds=[ends] * len(free)
        )
        variances[free] = np.exp(result.x) * self.scale
        return variances, self.deviance(variances)[0]

    def best(self) -> tuple[Array, float]:
        """Return the variances of the least -2 l, and that; what is not needed is zero."""
        starts = product((1.0, 1e-3), repeat=len(self.parts))
        trials = [self.minimise(np.array(start) * self.scale, {}) for start in starts]
        variances, min_deviance = min(trials, key=lambda trial: trial[1])
        zero_components: dict[int, float] = {}
        for index in np.flatnonzero(variances < _SMALL * self.scale):
            reduced, deviance = self.minimise(variances, {**zero_components, int(index): 0.0})
            if deviance <= min_deviance + 1e-6:
                zero_components[int(index)] = 0.0
                variances, min_deviance = reduced, deviance
        return variances, min_deviance

    def interval(
        self, index: int, estimate: Array, min_deviance: float, dof: int
    ) -> tuple[float, float]:
        """Return the ends of a variance's interval."""
        from scipy.optimize import brentq

        limit = min_deviance + _profile_limit(dof)

        def excess(logarithm: float) -> float:
            value = math.exp(logarithm) * self.scale
            return self.minimise(estimate, {index: value})[1] - limit

        ends = math.log(_SMALLEST), math.log(_LARGEST)
        middle = math.log(max(estimate[index] / self.scale, _SMALLEST))
        low = high = 0.0
        if excess(ends[0]) > 0.0 and middle > ends[0]:
            low = math.exp(brentq(excess, ends[0], middle, xtol=1e-4)) * self.scale
        step = 1.0
        while middle + step < ends[1] and excess(middle + step) < 0.0:
            step *= 2.0
        end = min(middle + step, ends[1])
        if excess(end) < 0.0:
            high = math.inf
        else:
            high = math.exp(brentq(excess, middle, end, xtol=1e-4)) * self.scale
        return low, high


@lru_cache(maxsize=64)
def _profile_limit(dof: int) -> float:
    """Return how far -2 l may rise within a 95 % interval of a variance.

    For a variance that s^2 with some degrees of freedom shows, -2 l rises by n (w - 1 - log w) at
    s^2/w. What that must be for 95 % is chi-square's 3.84 for many, and 4.76 for one.
    """
    from scipy.optimize import brentq
    from scipy.special import lambertw
    from scipy.stats import chi2

    def coverage_error(rise: float) -> float:
        at = -math.exp(-1.0 - rise / dof)
        low, high = (-float(lambertw(at, branch).real) for branch in (0, -1))
        coverage = chi2.cdf(dof * high, dof) - chi2.cdf(dof * low, dof)
        return float(coverage) - _COVERAGE

    return float(brentq(coverage_error, 3.0, 12.0))
