"""Variance components of repeated measurements beyond their own uncertainties.

Each measurement has a known uncertainty and belongs to groups, such as a day, a mounting or a
turn-on. Each group has a common random effect with the variance of its component, so that the
measurements have the covariance C + sum of v_c Z_c Z_c^T. The variances maximise the restricted
likelihood, which accounts for the mean (or line) that is estimated from the same data:

    -2 l = log|V| + log|X^T V^-1 X| + y^T P y,   P = V^-1 - V^-1 X (X^T V^-1 X)^-1 X^T V^-1.

For balanced groups, they equal those of the analysis of variance, if these are not negative.
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

#: Limits of the variances, relative to those of the measurements.
_MIN_VARIANCE_RATIO: Final = 1e-10
_MAX_VARIANCE_RATIO: Final = 1e6

#: Coverage of intervals.
_COVERAGE: Final = 0.95

#: A variance below this fraction of the measurements' is set to 0 if the likelihood permits it.
_NEGLIGIBLE_VARIANCE_RATIO: Final = 1e-2


@frozen
class Component:
    """Variance of measurements between groups."""

    groups: int  #: Number of groups.
    #: Degrees of freedom in addition to coarser groups; s groups alone have s - 1.
    dof: int
    value: float  #: Standard deviation, in the unit of the measurements; 0: none detected.
    #: 95 % interval by the profile of the restricted likelihood; `low` is 0 if the component may be
    #: absent.
    low: float
    high: float


@frozen
class VarianceComponents:
    """Components by name, and the estimate of the mean."""

    components: Mapping[str, Component]
    #: Name of groups that cannot be separated from those of a component -> this component.
    same_as: Mapping[str, str]
    #: Coefficient of the first column of the design, such as the mean, and its standard
    #: uncertainty, with all components.
    value: float
    u: float


def variance_components(
    values: Array, covariance: Array, groups: Mapping[str, Sequence[Hashable]], design: Array
) -> VarianceComponents:
    """Estimate the variance of each component.

    values, covariance: Measurements, shape (n,), and covariance of their errors, shape (n, n).
    groups: Component -> the group of each measurement. An effect of both coarser and finer groups
        is attributed to the coarser groups.
    design: Columns of the mean, shape (n, p).
    """
    distinct_groups, same_as = _distinct_groups(groups, design)
    likelihood = _RestrictedDeviance(
        values, covariance, [item for item, _ in distinct_groups.values()], design
    )
    estimate, min_deviance = likelihood.minimise_all()
    components = {}
    for index, (name, (indicator, dof)) in enumerate(distinct_groups.items()):
        low, high = likelihood.interval(index, estimate, min_deviance, dof)
        components[name] = Component(
            groups=indicator.shape[1],
            dof=dof,
            value=math.sqrt(estimate[index]),
            low=math.sqrt(low),
            high=math.sqrt(high),
        )
    inverse_covariance, information = likelihood.precision(estimate)
    parameters = np.linalg.solve(information, design.T @ inverse_covariance @ values)
    return VarianceComponents(
        components,
        same_as,
        float(parameters[0]),
        math.sqrt(float(np.linalg.inv(information)[0, 0])),
    )


def _distinct_groups(
    groups: Mapping[str, Sequence[Hashable]], design: Array
) -> tuple[dict[str, tuple[Array, int]], dict[str, str]]:
    """Return the indicators of groups, shape (n, g), with their additional degrees of freedom."""
    distinct_groups: dict[str, tuple[Array, int]] = {}
    same_as: dict[str, str] = {}
    independent_columns, rank = design, int(np.linalg.matrix_rank(design))
    for name, labels in sorted(groups.items(), key=lambda item: len(set(item[1]))):
        indices = {label: index for index, label in enumerate(dict.fromkeys(labels))}
        indicator = np.eye(len(indices))[[indices[label] for label in labels]]
        combined_design = np.hstack([independent_columns, indicator])
        dof = int(np.linalg.matrix_rank(combined_design)) - rank
        if dof > 0:
            distinct_groups[name] = indicator, dof
            independent_columns, rank = combined_design, rank + dof
        elif len(indices) > 1 and distinct_groups:
            same_as[name] = list(distinct_groups)[-1]
    return distinct_groups, same_as


class _RestrictedDeviance:
    """Restricted likelihood of the variances."""

    def __init__(
        self, values: Array, covariance: Array, indicators: Sequence[Array], design: Array
    ) -> None:
        self.values, self.design, self.covariance = values, design, covariance
        self.group_covariances = [indicator @ indicator.T for indicator in indicators]
        residuals = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
        mean_variance = float(np.mean(np.diag(covariance)))
        self.scale = max(mean_variance, float(residuals @ residuals) / values.size)

    def precision(self, variances: Array) -> tuple[Array, Array]:
        """Return V^-1, shape (n, n), and X^T V^-1 X."""
        covariance = self.covariance + sum(
            (v * component for v, component in zip(variances, self.group_covariances, strict=True)),
            0.0,
        )
        inverse_covariance = np.linalg.inv(covariance)
        return inverse_covariance, self.design.T @ inverse_covariance @ self.design

    def deviance(self, variances: Array) -> tuple[float, Array]:
        """Return -2 l and its derivatives by the variances."""
        try:
            inverse_covariance, information = self.precision(variances)
            (sign, log_det), (_, log_det_information) = (
                np.linalg.slogdet(matrix) for matrix in (inverse_covariance, information)
            )
            weighted_design = inverse_covariance @ self.design
            projection = inverse_covariance - weighted_design @ np.linalg.solve(
                information, weighted_design.T
            )
        except np.linalg.LinAlgError:
            return math.inf, np.zeros(len(self.group_covariances))
        if not (sign > 0.0 and np.isfinite(projection).all()):
            return math.inf, np.zeros(len(self.group_covariances))
        residual = projection @ self.values
        deviance = -log_det + log_det_information + float(self.values @ residual)
        gradient = [
            np.sum(projection * component) - residual @ component @ residual
            for component in self.group_covariances
        ]
        return float(deviance), np.array(gradient)

    def minimise(self, start: Array, fixed_variances: Mapping[int, float]) -> tuple[Array, float]:
        """Return the variances that minimise -2 l from a start, some of them fixed, and -2 l."""
        from scipy.optimize import minimize

        free = [i for i in range(len(self.group_covariances)) if i not in fixed_variances]
        variances = np.array(start, dtype=float)
        for index, value in fixed_variances.items():
            variances[index] = value
        if not free:
            return variances, self.deviance(variances)[0]

        def deviance_of_logs(x: Array) -> tuple[float, Array]:
            variances[free] = np.exp(x) * self.scale
            deviance, gradient = self.deviance(variances)
            log_gradient = gradient[free] * variances[free]
            return (deviance if math.isfinite(deviance) else 1e300), log_gradient

        log_bounds = (math.log(_MIN_VARIANCE_RATIO), math.log(_MAX_VARIANCE_RATIO))
        initial = np.clip(np.log(np.maximum(variances[free], 1e-300) / self.scale), *log_bounds)
        result = minimize(
            deviance_of_logs, initial, jac=True, method="L-BFGS-B", bounds=[log_bounds] * len(free)
        )
        variances[free] = np.exp(result.x) * self.scale
        return variances, self.deviance(variances)[0]

    def minimise_all(self) -> tuple[Array, float]:
        """Return the variances that minimise -2 l, unnecessary variances being 0, and -2 l."""
        starts = product((1.0, 1e-3), repeat=len(self.group_covariances))
        minima = [self.minimise(np.array(start) * self.scale, {}) for start in starts]
        variances, min_deviance = min(minima, key=lambda minimum: minimum[1])
        zero_components: dict[int, float] = {}
        for index in np.flatnonzero(variances < _NEGLIGIBLE_VARIANCE_RATIO * self.scale):
            components = {**zero_components, int(index): 0.0}
            reduced_variances, deviance = self.minimise(variances, components)
            if deviance <= min_deviance + 1e-6:
                zero_components = components
                variances, min_deviance = reduced_variances, deviance
        return variances, min_deviance

    def interval(
        self, index: int, estimate: Array, min_deviance: float, dof: int
    ) -> tuple[float, float]:
        """Return the limits of the interval of a variance."""
        from scipy.optimize import brentq

        deviance_limit = min_deviance + _profile_limit(dof)

        def excess_deviance(log_ratio: float) -> float:
            value = math.exp(log_ratio) * self.scale
            return self.minimise(estimate, {index: value})[1] - deviance_limit

        log_bounds = math.log(_MIN_VARIANCE_RATIO), math.log(_MAX_VARIANCE_RATIO)
        log_estimate = math.log(max(estimate[index] / self.scale, _MIN_VARIANCE_RATIO))
        low = high = 0.0
        if excess_deviance(log_bounds[0]) > 0.0 and log_estimate > log_bounds[0]:
            log_low = brentq(excess_deviance, log_bounds[0], log_estimate, xtol=1e-4)
            low = math.exp(log_low) * self.scale
        step = 1.0
        while log_estimate + step < log_bounds[1] and excess_deviance(log_estimate + step) < 0.0:
            step *= 2.0
        log_high = min(log_estimate + step, log_bounds[1])
        if excess_deviance(log_high) < 0.0:
            high = math.inf
        else:
            high = math.exp(brentq(excess_deviance, log_estimate, log_high, xtol=1e-4)) * self.scale
        return low, high


@lru_cache(maxsize=64)
def _profile_limit(dof: int) -> float:
    """Return the increase of -2 l at the limits of the 95 % interval of a variance.

    For an estimate s^2 with n degrees of freedom, -2 l increases by n (w - 1 - log w) at s^2/w. The
    increase for 95 % is 4.76 for one degree of freedom, and tends to 3.84, as for chi-square.
    """
    from scipy.optimize import brentq
    from scipy.special import lambertw
    from scipy.stats import chi2

    def coverage_error(deviance_rise: float) -> float:
        argument = -math.exp(-1.0 - deviance_rise / dof)
        low, high = (-float(lambertw(argument, branch).real) for branch in (0, -1))
        coverage = chi2.cdf(dof * high, dof) - chi2.cdf(dof * low, dof)
        return float(coverage) - _COVERAGE

    return float(brentq(coverage_error, 3.0, 12.0))
