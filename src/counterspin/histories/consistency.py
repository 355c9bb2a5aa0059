"""Whether repeated measurements of one quantity agree, and whether it drifts.

The measurements have the standard uncertainties that they state, which are not scaled, and are
independent unless their covariance is given.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.conformity import expanded_uncertainty
from counterspin.inference.distributions import chi_square_tail, normal_cdf
from counterspin.inference.plain_fit import Fit, fit


@frozen
class Agreement:
    """How measurements scatter about a fit, in their own uncertainties."""

    chi2: float  #: Sum of squared differences, each over its standard uncertainty.
    dof: int  #: Measurements less fitted quantities.
    #: Probability of a larger `chi2` if the uncertainties are right; None without a degree of
    #: freedom.
    p: float | None
    #: Birge ratio, the root of chi2/dof: near 1 where the uncertainties are right; None likewise.
    birge: float | None


@frozen
class Mean:
    """A weighted mean."""

    #: The mean and its standard uncertainty, in the unit of the measurements.
    value: float
    u: float
    agreement: Agreement  #: Of the measurements with it.
    difference: Array  #: Measurements less mean, shape (n,).
    #: `difference` over its own standard uncertainty, which is the root of u_i^2 - u^2, for the
    #: measurement is part of the mean; shape (n,), NaN for one measurement alone.
    z: Array


@frozen
class Drift:
    """A straight line over time."""

    #: Change per unit of time, and its standard uncertainty from those of the measurements.
    slope: float
    u: float
    #: Probability of a slope as large if there is no drift (normal distribution, both sides).
    p: float
    #: The weighted mean time, at which slope and value are uncorrelated, and the line's value
    #: there.
    time: float
    value: float
    u_value: float  #: Standard uncertainty of `value`.
    agreement: Agreement  #: Of the measurements with the line.

    def at(self, time: npt.ArrayLike) -> tuple[Array, Array]:
        """Return the line and its standard uncertainty at times, each of the times' shape."""
        since = np.asarray(time, dtype=np.float64) - self.time
        return self.value + self.slope * since, np.hypot(self.u_value, self.u * since)


def weighted_mean(values: npt.ArrayLike, u: npt.ArrayLike, covariance: Array | None = None) -> Mean:
    """Return the mean with weights 1/u^2 and whether the measurements agree with it.

    values, u: Measurements and their standard uncertainties, shape (n,), n >= 1, u > 0.
    covariance: Of the measurements, shape (n, n), where they are not independent: the mean is then
        that of generalised least squares.
    """
    measured, sigma = np.asarray(values, np.float64), np.asarray(u, np.float64)
    if covariance is not None:
        return _correlated_mean(measured, covariance)
    constant = fit(np.ones((measured.size, 1)), measured, sigma)
    return Mean(
        value=float(constant.estimate[0]),
        u=float(constant.u[0]),
        agreement=_agreement(constant),
        difference=constant.residuals,
        z=_against_the_others(measured, sigma),
    )


def drift(
    time: npt.ArrayLike,
    values: npt.ArrayLike,
    u: npt.ArrayLike,
    covariance: Array | None = None,
) -> Drift | None:
    """Fit a straight line by weighted least squares.

    time: Of the measurements, shape (n,), in any unit and order.
    Returns: none where all measurements are of one time.
    """
    when, sigma = np.asarray(time, np.float64), np.asarray(u, np.float64)
    if np.ptp(when) == 0.0:
        return None
    # About the weighted mean time value and slope are uncorrelated.
    measured = np.asarray(values, np.float64)
    if covariance is None:
        middle = float(np.average(when, weights=sigma**-2.0))
        line = fit(np.stack([np.ones(when.size), when - middle], axis=1), measured, sigma)
    else:
        whitened = _whitened(np.stack([np.ones(when.size), when, measured], axis=1), covariance)
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
        agreement=_agreement(line),
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
    one, other = (expanded_uncertainty(u, dof) for _, u, dof in (first, second))
    common = 2.0 * covariance * (one / first[1]) * (other / second[1])
    return (second[0] - first[0]) / math.sqrt(one**2 + other**2 - common)


def _correlated_mean(values: Array, covariance: Array) -> Mean:
    whitened = _whitened(np.stack([np.ones(values.size), values], axis=1), covariance)
    constant = fit(whitened[:, :1], whitened[:, 1], 1.0)
    mean, u = float(constant.estimate[0]), float(constant.u[0])
    difference = values - mean
    z = np.full(values.size, np.nan)
    # Of generalised least squares too, the covariance of a measurement with the mean is u^2.
    left = np.diag(covariance) - u**2
    apart = left > 1e-12 * np.diag(covariance)
    if values.size > 1:
        z[apart] = difference[apart] / np.sqrt(left[apart])
    return Mean(mean, u, _agreement(constant), difference, z)


def _whitened(columns: Array, covariance: Array) -> Array:
    """Return columns in units in which the measurements are independent, of variance one."""
    from scipy.linalg import cholesky, solve_triangular

    whitened: Array = solve_triangular(cholesky(covariance, lower=True), columns, lower=True)
    return whitened


def _against_the_others(values: Array, u: Array) -> Array:
    # The same number as difference over the root of u_i^2 - u^2, without its cancellation where
    # one measurement has nearly all the weight.
    weight = u**-2.0
    z = np.full(values.size, np.nan)
    for i in range(values.size if values.size > 1 else 0):
        others, left = np.delete(values, i), np.delete(weight, i)
        z[i] = (values[i] - np.average(others, weights=left)) / math.hypot(u[i], left.sum() ** -0.5)
    return z


def _agreement(fitted: Fit) -> Agreement:
    if fitted.dof < 1:
        return Agreement(fitted.chi2, fitted.dof, None, None)
    return Agreement(
        chi2=fitted.chi2,
        dof=fitted.dof,
        p=chi_square_tail(fitted.dof, fitted.chi2),
        birge=math.sqrt(fitted.chi2 / fitted.dof),
    )
