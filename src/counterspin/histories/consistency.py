"""Agreement, drift and repeatability of an instrument's results; control limits; due date.

The stated standard uncertainties are not scaled. Measurements are independent unless a
covariance is given.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.histories.files import DatedResult
from counterspin.histories.result import (
    ControlLimits,
    Repeatability,
    RepeatabilityComponent,
    Scatter,
)
from counterspin.inference.distributions import chi_square_tail, expanded_uncertainty, normal_cdf
from counterspin.inference.least_squares import Fit, fit
from counterspin.inference.variance_components import variance_components


@frozen
class Mean:
    """A weighted mean of measurements."""

    #: Mean and its standard uncertainty, in the unit of the measurements.
    value: float
    u: float
    scatter: Scatter  #: Scatter of the measurements about the mean.
    differences: Array  #: Measurements minus mean, shape (n,).
    #: `differences` divided by their standard uncertainties, (u_i^2 - u^2)^(1/2) because the mean
    #: includes the measurement; shape (n,), NaN for a single measurement.
    z: Array


@frozen
class Drift:
    """A straight line through measurements over time."""

    #: Change per unit of time, and its standard uncertainty.
    slope: float
    u: float
    #: Two-sided p-value of the slope under no drift (normal distribution).
    p: float
    #: Weighted mean time, at which slope and value are uncorrelated, and value of the line then.
    time: float
    value: float
    u_value: float  #: Standard uncertainty of `value`.
    scatter: Scatter  #: Scatter of the measurements about the line.

    def evaluate(self, time: npt.ArrayLike) -> tuple[Array, Array]:
        """Return the line and its standard uncertainty at times, each with the shape of `time`."""
        elapsed = np.asarray(time, dtype=np.float64) - self.time
        return self.value + self.slope * elapsed, np.hypot(self.u_value, self.u * elapsed)


def weighted_mean(values: npt.ArrayLike, u: npt.ArrayLike, covariance: Array | None = None) -> Mean:
    """Return the mean with weights 1/u^2 and the scatter of the measurements about it.

    values, u: Measurements and their standard uncertainties, shape (n,), n >= 1, u > 0.
    covariance: Covariance of correlated measurements, shape (n, n), for generalised least squares.
    """
    measurements, uncertainties = np.asarray(values, np.float64), np.asarray(u, np.float64)
    if covariance is not None:
        return _correlated_mean(measurements, covariance)
    mean_fit = fit(np.ones((measurements.size, 1)), measurements, uncertainties)
    return Mean(
        value=float(mean_fit.estimate[0]),
        u=float(mean_fit.u[0]),
        scatter=_evaluate_scatter(mean_fit),
        differences=mean_fit.residuals,
        z=_leave_one_out_scores(measurements, uncertainties),
    )


def fit_drift(
    time: npt.ArrayLike, values: npt.ArrayLike, u: npt.ArrayLike, covariance: Array | None = None
) -> Drift | None:
    """Fit a straight line by weighted least squares.

    time: Times of the measurements, shape (n,), in any unit and order.
    Returns: None if all times are equal.
    """
    times, uncertainties = np.asarray(time, np.float64), np.asarray(u, np.float64)
    if np.ptp(times) == 0.0:
        return None
    # At the weighted mean time, value and slope are uncorrelated.
    measurements = np.asarray(values, np.float64)
    if covariance is None:
        mean_time = float(np.average(times, weights=uncertainties**-2.0))
        line_fit = fit(
            np.stack([np.ones(times.size), times - mean_time], axis=1), measurements, uncertainties
        )
    else:
        whitened_columns = _whiten(
            np.stack([np.ones(times.size), times, measurements], axis=1), covariance
        )
        whitened_ones, whitened_times, whitened_values = whitened_columns.T
        mean_time = float(whitened_ones @ whitened_times / (whitened_ones @ whitened_ones))
        line_fit = fit(
            np.stack([whitened_ones, whitened_times - mean_time * whitened_ones], axis=1),
            whitened_values,
            1.0,
        )
    (value, slope), (u_value, u_slope) = line_fit.estimate, line_fit.u
    return Drift(
        slope=float(slope),
        u=float(u_slope),
        p=2.0 * normal_cdf(-abs(slope) / u_slope),
        time=mean_time,
        value=float(value),
        u_value=float(u_value),
        scatter=_evaluate_scatter(line_fit),
    )


def en_score(
    first: tuple[float, float, float | None],
    second: tuple[float, float, float | None],
    covariance: float = 0.0,
) -> float:
    """Return the E_n score of a second measurement relative to the first (ISO 13528:2015, 9.7).

    first, second: Value, standard uncertainty and degrees of freedom (None: infinite). The
        coverage probability is 95 %.
    """
    first_expanded_u = expanded_uncertainty(*first[1:])
    second_expanded_u = expanded_uncertainty(*second[1:])
    covariance_term = (
        2.0 * covariance * (first_expanded_u / first[1]) * (second_expanded_u / second[1])
    )
    return (second[0] - first[0]) / math.sqrt(
        first_expanded_u**2 + second_expanded_u**2 - covariance_term
    )


def _correlated_mean(values: Array, covariance: Array) -> Mean:
    whitened = _whiten(np.stack([np.ones(values.size), values], axis=1), covariance)
    mean_fit = fit(whitened[:, :1], whitened[:, 1], 1.0)
    mean, u = float(mean_fit.estimate[0]), float(mean_fit.u[0])
    differences = values - mean
    z = np.full(values.size, np.nan)
    # Also for generalised least squares, the covariance of a measurement with the mean is u^2.
    variances = np.diag(covariance) - u**2
    is_significant = variances > 1e-12 * np.diag(covariance)
    if values.size > 1:
        z[is_significant] = differences[is_significant] / np.sqrt(variances[is_significant])
    return Mean(mean, u, _evaluate_scatter(mean_fit), differences, z)


def _whiten(columns: Array, covariance: Array) -> Array:
    """Return the whitened columns."""
    from scipy.linalg import cholesky, solve_triangular

    whitened: Array = solve_triangular(cholesky(covariance, lower=True), columns, lower=True)
    return whitened


def _leave_one_out_scores(values: Array, u: Array) -> Array:
    # Equals the difference over the root of u_i^2 - u^2, without cancellation when one
    # measurement has nearly all the weight.
    weights = u**-2.0
    z = np.full(values.size, np.nan)
    for i in range(values.size if values.size > 1 else 0):
        other_values, other_weights = np.delete(values, i), np.delete(weights, i)
        z[i] = (values[i] - np.average(other_values, weights=other_weights)) / math.hypot(
            u[i], other_weights.sum() ** -0.5
        )
    return z


def _evaluate_scatter(fit_result: Fit) -> Scatter:
    chi2, dof = fit_result.chi2, fit_result.dof
    if dof < 1:
        return Scatter(chi2=chi2, dof=dof, p=None, birge=None)
    return Scatter(chi2=chi2, dof=dof, p=chi_square_tail(dof, chi2), birge=math.sqrt(chi2 / dof))


#: Mean and standard deviation of the range of two normal values of unit variance.
_D2: Final = 2.0 / math.sqrt(math.pi)
_D3: Final = math.sqrt(2.0 - 4.0 / math.pi)

#: Action and warning limits, in standard deviations.
ACTION_SIGMAS: Final = 3.0
WARNING_SIGMAS: Final = 2.0

#: Smallest number of results for control limits.
MIN_RESULTS: Final = 3


def individuals_chart(values: npt.ArrayLike, files: Sequence[str]) -> ControlLimits | None:
    """Return the individuals chart of results (NIST/SEMATECH e-Handbook, 6.3.2.2).

    values: Results in order of time, shape (n,).
    files: Names of the n result files.
    Returns: None for fewer than `MIN_RESULTS` results.
    """
    measurements = np.asarray(values, dtype=np.float64)
    if measurements.size < MIN_RESULTS:
        return None
    moving_ranges = np.abs(np.diff(measurements))
    mean_range = float(moving_ranges.mean())
    centre, sigma = float(measurements.mean()), mean_range / _D2
    range_limit = mean_range + ACTION_SIGMAS * _D3 * sigma
    is_outside_limits = np.abs(measurements - centre) > ACTION_SIGMAS * sigma
    return ControlLimits(
        centre=centre,
        warning_low=centre - WARNING_SIGMAS * sigma,
        warning_high=centre + WARNING_SIGMAS * sigma,
        action_low=centre - ACTION_SIGMAS * sigma,
        action_high=centre + ACTION_SIGMAS * sigma,
        mean_range=mean_range,
        range_limit=range_limit,
        beyond=[
            file for file, is_outside in zip(files, is_outside_limits, strict=True) if is_outside
        ],
        leaps=[
            file
            for file, moving_range in zip(files[1:], moving_ranges, strict=True)
            if moving_range > range_limit
        ],
    )


#: Longest calibration interval, years.
MAX_YEARS: Final = 10.0

YEAR: Final = timedelta(days=365.25)


def probability_within(drift: Drift, time: float, low: float | None, high: float | None) -> float:
    """Return the probability that the quantity lies within limits at a time.

    The uncertainty of the line is multiplied by its Birge ratio if the ratio exceeds 1.

    low, high: Specification limits; None: no limit.
    """
    value, u = (float(estimate) for estimate in drift.evaluate(time))
    u *= max(1.0, drift.scatter.birge or 1.0)
    p_below_high = 1.0 if high is None else normal_cdf((high - value) / u)
    return p_below_high - (0.0 if low is None else normal_cdf((low - value) / u))


def next_due_date(
    drift: Drift,
    first_date: datetime,
    last_date: datetime,
    limits: tuple[float | None, float | None],
    reliability: float,
) -> datetime | None:
    """Return the last day on which the quantity is in specification with the given reliability.

    Method 2 of ILAC-G24:2022 (OIML D 10:2022), 6.3, "Control chart (calendar-time)": drift
    and its uncertainty are estimated from past results and extrapolated.

    Returns: `last_date` if the probability is already too small; None if it is large enough for
        `MAX_YEARS` years.
    """
    last_time = (last_date - first_date) / YEAR
    if probability_within(drift, last_time, *limits) < reliability:
        return last_date
    # The probability may increase first, if the line approaches the centre: find the first failure.
    n_steps = int(MAX_YEARS * 52)
    time_within_limits = last_time
    for step in range(1, n_steps + 1):
        time_beyond_limits = last_time + MAX_YEARS * step / n_steps
        if probability_within(drift, time_beyond_limits, *limits) < reliability:
            break
        time_within_limits = time_beyond_limits
    else:
        return None
    while time_beyond_limits - time_within_limits > 1e-4:
        middle_time = 0.5 * (time_within_limits + time_beyond_limits)
        if probability_within(drift, middle_time, *limits) < reliability:
            time_beyond_limits = middle_time
        else:
            time_within_limits = middle_time
    return first_date + time_within_limits * YEAR


#: Smallest excess of results over other parameters that determines a variance.
_MIN_EXTRA_RESULTS: Final = 2


def evaluate_repeatability(
    records: Sequence[DatedResult], covariance: Array | None, *, has_drift: bool
) -> Repeatability | None:
    """Return the variation of results in excess of their u; None for too few results.

    covariance: Covariance of the results, shape (n, n); None: independent results.
    has_drift: True: variation about a straight line over time; False: about the mean.
    """
    first_date = records[0].date
    years = np.array([(record.date - first_date) / YEAR for record in records])
    columns = [np.ones(len(records)), *([years - years.mean()] if has_drift else [])]
    if len(records) < len(columns) + _MIN_EXTRA_RESULTS:
        return None
    groups, undetermined_reasons = _group_by_condition(records)
    if not groups:
        return None
    known_covariance = (
        np.diag([record.u**2 for record in records]) if covariance is None else covariance
    )
    values = np.array([record.value for record in records])
    estimate = variance_components(values, known_covariance, groups, np.stack(columns, axis=1))
    components = {
        name: RepeatabilityComponent(
            value=component.value,
            low=component.low,
            high=component.high if math.isfinite(component.high) else None,
            groups=component.groups,
            freedom=component.dof,
            same_as=[alias for alias, main_name in estimate.same_as.items() if main_name == name],
        )
        for name, component in estimate.components.items()
    }
    return Repeatability(
        components=components,
        total=math.sqrt(sum(component.value**2 for component in components.values())),
        about="line" if has_drift else "mean",
        value=estimate.value,
        u=estimate.u,
        not_told=undetermined_reasons,
    )


def _group_by_condition(
    records: Sequence[DatedResult],
) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Return condition -> group of each result, and condition -> reason for missing groups."""
    labels_by_condition: dict[str, list[str | None]] = {
        "day": [record.date.date().isoformat() for record in records],
        "mounting": [record.mounting for record in records],
        "turn_on": [record.turn_on for record in records],
    }
    groups: dict[str, list[str]] = {}
    undetermined_reasons: dict[str, str] = {}
    for name, labels in labels_by_condition.items():
        stated_labels = [label for label in labels if label is not None]
        if len(stated_labels) < len(labels):
            n_missing = len(labels) - len(stated_labels)
            undetermined_reasons[name] = (
                f"this value is missing in {n_missing} of {len(labels)} results"
            )
        elif len(set(stated_labels)) < 2:
            undetermined_reasons[name] = "all results have the same label"
        else:
            groups[name] = stated_labels
    return groups, undetermined_reasons


#: Correlation below which shared inputs are negligible.
_NEGLIGIBLE_CORRELATION: Final = 0.01

#: Smallest ratio of the unshared u to the total u.
_MIN_UNSHARED_RATIO: Final = 1e-3


@frozen
class SharedInputs:
    """Shared inputs of results."""

    names: tuple[str, ...]  #: Names of the inputs, such as ``centrifuge.radius``.
    largest_correlation: float  #: Largest correlation of two results.
    covariance: Array  #: Covariance of the results, shape (n, n).


def find_shared_inputs(
    u: Sequence[float], source_shifts: Sequence[Mapping[tuple[str, str], float]]
) -> SharedInputs | None:
    """Return the shared inputs of results; None if they are negligible."""
    counts: dict[tuple[str, str], int] = {}
    for shift_by_source in source_shifts:
        for key in shift_by_source:
            counts[key] = counts.get(key, 0) + 1
    keys = [key for key, count in counts.items() if count > 1]
    shifts = np.array(
        [[shift_by_source.get(key, 0.0) for key in keys] for shift_by_source in source_shifts]
    )
    total_u = np.asarray(u, dtype=np.float64)
    unshared_variances = total_u**2 - (shifts**2).sum(axis=1)
    covariance = shifts @ shifts.T
    covariance[np.diag_indices(total_u.size)] += np.maximum(
        unshared_variances, (_MIN_UNSHARED_RATIO * total_u) ** 2
    )
    standard_deviations = np.sqrt(np.diag(covariance))
    correlation = np.abs(
        covariance / np.outer(standard_deviations, standard_deviations) - np.eye(total_u.size)
    )
    if not keys or (largest_correlation := float(correlation.max())) < _NEGLIGIBLE_CORRELATION:
        return None
    relative_shifts = np.abs(shifts / total_u[:, None]).max(axis=0)
    names = dict.fromkeys(
        key[0]
        for key, relative_shift in zip(keys, relative_shifts, strict=True)
        if relative_shift**2 >= 0.1 * _NEGLIGIBLE_CORRELATION
    )
    return SharedInputs(tuple(names), largest_correlation, covariance)
