"""Agreement, drift and repeatability of an instrument's results; control limits; due date.

The measurements have the standard uncertainties that they state, which are not scaled, and are
independent unless their covariance is given.
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
from counterspin.histories.result import ControlLimits, Repeatability, RepeatComponent, Scatter
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
    difference: Array  #: Measurements minus mean, shape (n,).
    #: `difference` over its standard uncertainty, the root of u_i^2 - u^2 because the measurement
    #: is part of the mean; shape (n,), NaN for a single measurement.
    z: Array


@frozen
class Drift:
    """A straight line through measurements over time."""

    #: Change per unit of time, and its standard uncertainty.
    slope: float
    u: float
    #: Two-sided p-value of the slope under no drift (normal distribution).
    p: float
    #: Weighted mean time, at which slope and value are uncorrelated, and the line's value at it.
    time: float
    value: float
    u_value: float  #: Standard uncertainty of `value`.
    scatter: Scatter  #: Scatter of the measurements about the line.

    def evaluate(self, time: npt.ArrayLike) -> tuple[Array, Array]:
        """Return the line and its standard uncertainty at times, each with the shape of `time`."""
        since = np.asarray(time, dtype=np.float64) - self.time
        return self.value + self.slope * since, np.hypot(self.u_value, self.u * since)


def weighted_mean(values: npt.ArrayLike, u: npt.ArrayLike, covariance: Array | None = None) -> Mean:
    """Return the mean with weights 1/u^2 and the scatter of the measurements about it.

    values, u: Measurements and their standard uncertainties, shape (n,), n >= 1, u > 0.
    covariance: Covariance of dependent measurements, shape (n, n); the mean is then that of
        generalised least squares.
    """
    measured, sigma = np.asarray(values, np.float64), np.asarray(u, np.float64)
    if covariance is not None:
        return _correlated_mean(measured, covariance)
    constant = fit(np.ones((measured.size, 1)), measured, sigma)
    return Mean(
        value=float(constant.estimate[0]),
        u=float(constant.u[0]),
        scatter=_scatter(constant),
        difference=constant.residuals,
        z=_leave_one_out_scores(measured, sigma),
    )


def fit_drift(
    time: npt.ArrayLike,
    values: npt.ArrayLike,
    u: npt.ArrayLike,
    covariance: Array | None = None,
) -> Drift | None:
    """Fit a straight line by weighted least squares.

    time: Times of the measurements, shape (n,), in any unit and order.
    Returns: None if all times are equal.
    """
    when, sigma = np.asarray(time, np.float64), np.asarray(u, np.float64)
    if np.ptp(when) == 0.0:
        return None
    # At the weighted mean time, value and slope are uncorrelated.
    measured = np.asarray(values, np.float64)
    if covariance is None:
        middle = float(np.average(when, weights=sigma**-2.0))
        line = fit(np.stack([np.ones(when.size), when - middle], axis=1), measured, sigma)
    else:
        whitened = _whiten(np.stack([np.ones(when.size), when, measured], axis=1), covariance)
        ones, times, observed = whitened.T
        middle = float(ones @ times / (ones @ ones))
        line = fit(np.stack([ones, times - middle * ones], axis=1), observed, 1.0)
    (value, slope), (u_value, u_slope) = line.estimate, line.u
    return Drift(
        slope=float(slope),
        u=float(u_slope),
        p=2.0 * normal_cdf(-abs(slope) / u_slope),
        time=middle,
        value=float(value),
        u_value=float(u_value),
        scatter=_scatter(line),
    )


def en_score(
    first: tuple[float, float, float | None],
    second: tuple[float, float, float | None],
    covariance: float = 0.0,
) -> float:
    """Return the E_n score of a second measurement against a first (ISO 13528:2015, 9.7).

    first, second: Value, standard uncertainty and degrees of freedom (None is infinite) of each;
        the expanded uncertainties are those of 95 % coverage.
    """
    first_expanded, second_expanded = (
        expanded_uncertainty(u, dof) for _, u, dof in (first, second)
    )
    common = 2.0 * covariance * (first_expanded / first[1]) * (second_expanded / second[1])
    return (second[0] - first[0]) / math.sqrt(first_expanded**2 + second_expanded**2 - common)


def _correlated_mean(values: Array, covariance: Array) -> Mean:
    whitened = _whiten(np.stack([np.ones(values.size), values], axis=1), covariance)
    constant = fit(whitened[:, :1], whitened[:, 1], 1.0)
    mean, u = float(constant.estimate[0]), float(constant.u[0])
    difference = values - mean
    z = np.full(values.size, np.nan)
    # For generalised least squares too, the covariance of a measurement with the mean is u^2.
    variance = np.diag(covariance) - u**2
    distinct = variance > 1e-12 * np.diag(covariance)
    if values.size > 1:
        z[distinct] = difference[distinct] / np.sqrt(variance[distinct])
    return Mean(mean, u, _scatter(constant), difference, z)


def _whiten(columns: Array, covariance: Array) -> Array:
    """Return the whitened columns."""
    from scipy.linalg import cholesky, solve_triangular

    whitened: Array = solve_triangular(cholesky(covariance, lower=True), columns, lower=True)
    return whitened


def _leave_one_out_scores(values: Array, u: Array) -> Array:
    # Equals the difference over the root of u_i^2 - u^2, without cancellation when one
    # measurement has nearly all the weight.
    weight = u**-2.0
    z = np.full(values.size, np.nan)
    for i in range(values.size if values.size > 1 else 0):
        others, other_weights = np.delete(values, i), np.delete(weight, i)
        z[i] = (values[i] - np.average(others, weights=other_weights)) / math.hypot(
            u[i], other_weights.sum() ** -0.5
        )
    return z


def _scatter(fitted: Fit) -> Scatter:
    chi2, dof = fitted.chi2, fitted.dof
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
    """Return the chart of results in order of time (NIST/SEMATECH e-Handbook, 6.3.2.2).

    values: Shape (n,).
    files: Names of the results' files, n of them.
    Returns: None for fewer than `MIN_RESULTS` results.
    """
    measured = np.asarray(values, dtype=np.float64)
    if measured.size < MIN_RESULTS:
        return None
    ranges = np.abs(np.diff(measured))
    mean_range = float(ranges.mean())
    centre, sigma = float(measured.mean()), mean_range / _D2
    limit = mean_range + ACTION_SIGMAS * _D3 * sigma
    beyond = np.abs(measured - centre) > ACTION_SIGMAS * sigma
    return ControlLimits(
        centre=centre,
        warning_low=centre - WARNING_SIGMAS * sigma,
        warning_high=centre + WARNING_SIGMAS * sigma,
        action_low=centre - ACTION_SIGMAS * sigma,
        action_high=centre + ACTION_SIGMAS * sigma,
        mean_range=mean_range,
        range_limit=limit,
        beyond=[file for file, far in zip(files, beyond, strict=True) if far],
        leaps=[file for file, size in zip(files[1:], ranges, strict=True) if size > limit],
    )


#: Longest calibration interval, years.
MAX_YEARS: Final = 10.0

YEAR: Final = timedelta(days=365.25)


def probability_within(line: Drift, time: float, low: float | None, high: float | None) -> float:
    """Return the probability that the quantity lies within limits at a time.

    The line's uncertainty is multiplied by its Birge ratio if that is above 1.

    low, high: The limits; None: no limit.
    """
    value, u = (float(part) for part in line.evaluate(time))
    u *= max(1.0, line.scatter.birge or 1.0)
    below = 1.0 if high is None else normal_cdf((high - value) / u)
    return below - (0.0 if low is None else normal_cdf((low - value) / u))


def next_due_date(
    line: Drift,
    start: datetime,
    last: datetime,
    limits: tuple[float | None, float | None],
    reliability: float,
) -> datetime | None:
    """Return the last day on which the quantity is in specification with the given reliability.

    After method 2 of ILAC-G24:2022 (OIML D 10:2022), 6.3, "Control chart (calendar-time)": drift
    and its uncertainty are estimated from past results and extrapolated.

    Returns: `last` if the probability is already too small; None if it is large enough for
        `MAX_YEARS` years.
    """
    begin = (last - start) / YEAR
    if probability_within(line, begin, *limits) < reliability:
        return last
    # The probability may first grow, if the line approaches the centre: use the first failure.
    steps = int(MAX_YEARS * 52)
    inside = begin
    for step in range(1, steps + 1):
        outside = begin + MAX_YEARS * step / steps
        if probability_within(line, outside, *limits) < reliability:
            break
        inside = outside
    else:
        return None
    while outside - inside > 1e-4:
        middle = 0.5 * (inside + outside)
        if probability_within(line, middle, *limits) < reliability:
            outside = middle
        else:
            inside = middle
    return start + inside * YEAR


#: Smallest number of results, beyond the other parameters, that determine a variance.
_MIN_DOF: Final = 2


def repeatability(
    records: Sequence[DatedResult], covariance: Array | None, *, drifts: bool
) -> Repeatability | None:
    """Return the variation of results in excess of their u; None for too few.

    covariance: Covariance of the results, shape (n, n); None: they are independent.
    drifts: True: deviations from a line over time; False: from the mean.
    """
    start = records[0].date
    years = np.array([(record.date - start) / YEAR for record in records])
    columns = [np.ones(len(records)), *([years - years.mean()] if drifts else [])]
    if len(records) < len(columns) + _MIN_DOF:
        return None
    groups, not_told = _repeat_groups(records)
    if not groups:
        return None
    known = np.diag([record.u**2 for record in records]) if covariance is None else covariance
    values = np.array([record.value for record in records])
    fitted = variance_components(values, known, groups, np.stack(columns, axis=1))
    components = {
        name: RepeatComponent(
            value=component.value,
            low=component.low,
            high=component.high if math.isfinite(component.high) else None,
            groups=component.groups,
            freedom=component.freedom,
            same_as=[same_name for same_name, place in fitted.same_as.items() if place == name],
        )
        for name, component in fitted.components.items()
    }
    return Repeatability(
        components=components,
        total=math.sqrt(sum(component.value**2 for component in components.values())),
        about="line" if drifts else "mean",
        value=fitted.value,
        u=fitted.u,
        not_told=not_told,
    )


def _repeat_groups(records: Sequence[DatedResult]) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Return the groups of each result by repeated condition, and reasons for missing groups."""
    labels: dict[str, list[str | None]] = {
        "day": [record.date.date().isoformat() for record in records],
        "mounting": [record.mounting for record in records],
        "turn_on": [record.turn_on for record in records],
    }
    groups: dict[str, list[str]] = {}
    not_told: dict[str, str] = {}
    for name, values in labels.items():
        named = [label for label in values if label is not None]
        if len(named) < len(values):
            lacking = len(values) - len(named)
            not_told[name] = f"{lacking} of {len(values)} results do not contain this value"
        elif len(set(named)) < 2:
            not_told[name] = "all results have the same label"
        else:
            groups[name] = named
    return groups, not_told


#: Correlation below which shared inputs are negligible in print.
_NEGLIGIBLE_CORRELATION: Final = 0.01

#: Smallest unshared part of u.
_MIN_UNSHARED_PART: Final = 1e-3


@frozen
class SharedInputs:
    """Shared inputs of results."""

    names: tuple[str, ...]  #: Names of the inputs, such as ``centrifuge.radius``.
    largest: float  #: Largest correlation of two results.
    covariance: Array  #: Covariance of the results, shape (n, n).


def find_shared_inputs(
    u: Sequence[float], shared: Sequence[Mapping[tuple[str, str], float]]
) -> SharedInputs | None:
    """Return the shared inputs of results; None if they are negligible."""
    count: dict[tuple[str, str], int] = {}
    for sources in shared:
        for key in sources:
            count[key] = count.get(key, 0) + 1
    keys = [key for key, n in count.items() if n > 1]
    moved = np.array([[sources.get(key, 0.0) for key in keys] for sources in shared])
    total = np.asarray(u, dtype=np.float64)
    unshared = total**2 - (moved**2).sum(axis=1)
    covariance = moved @ moved.T
    covariance[np.diag_indices(total.size)] += np.maximum(
        unshared, (_MIN_UNSHARED_PART * total) ** 2
    )
    size = np.sqrt(np.diag(covariance))
    correlation = np.abs(covariance / np.outer(size, size) - np.eye(total.size))
    if not keys or (largest := float(correlation.max())) < _NEGLIGIBLE_CORRELATION:
        return None
    weight = np.abs(moved / total[:, None]).max(axis=0)
    names = dict.fromkeys(
        key[0] for key, w in zip(keys, weight, strict=True) if w**2 >= 0.1 * _NEGLIGIBLE_CORRELATION
    )
    return SharedInputs(tuple(names), largest, covariance)
