"""Restricted likelihood of white noise and a walk with dense covariances, for make_fits.py.

Nothing here uses counterspin. With V = w I + N^2 W of all rows, design matrix X and residuals y:

    2 log L = -log|V| - log|X' V^-1 X| - (y - X b)' V^-1 (y - X b)

(Patterson and Thompson, Biometrika 58 (1971) 545). Priors are additional rows.
"""

import math

import numpy as np
from dense_fit import differentiate_model, walk_covariance

GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


class Likelihood:
    """Restricted likelihood of the records of one accelerometer, with common noise levels."""

    def __init__(self, groups, times, integrations, unknowns):
        values = {u.name: u.mean for u in unknowns}
        n_free = sum(rows.free_columns.shape[1] for rows in groups)
        n_rows, p = sum(t.size for t in times), len(unknowns)
        with_prior = [j for j, u in enumerate(unknowns) if np.isfinite(u.sd)]
        n_all_rows = n_rows + len(with_prior)
        self.design, self.residuals = np.zeros((n_all_rows, p + n_free)), np.zeros(n_all_rows)
        self.white_covariance, self.walk_covariance = np.zeros((2, n_all_rows, n_all_rows))
        self.prior_variances = np.zeros(n_all_rows)
        row, column = 0, p
        for rows, t in zip(groups, times, strict=True):
            record_rows = slice(row, row + t.size)
            self.design[record_rows, :p] = differentiate_model(rows, unknowns, values)
            self.design[record_rows, column : column + rows.free_columns.shape[1]] = (
                rows.free_columns
            )
            self.residuals[record_rows] = rows.values - rows.model(values)
            self.white_covariance[record_rows, record_rows] = np.eye(t.size)
            self.walk_covariance[record_rows, record_rows] = walk_covariance(t, 1.0, integrations)
            row, column = row + t.size, column + rows.free_columns.shape[1]
        for k, j in enumerate(with_prior):
            self.design[n_rows + k, j] = 1.0
            self.prior_variances[n_rows + k] = unknowns[j].sd ** 2
        self.design /= np.linalg.norm(self.design, axis=0)

    def log_likelihood(self, white, density=0.0):
        """Return the log-likelihood up to a constant at two variances."""
        root = np.linalg.cholesky(
            np.diag(self.prior_variances)
            + white * self.white_covariance
            + density * self.walk_covariance
        )
        rows = np.linalg.solve(root, np.column_stack([self.design, self.residuals]))
        triangle = np.linalg.qr(rows, mode="r")
        half = np.log(np.abs(np.diag(root))).sum() + np.log(np.abs(np.diag(triangle)[:-1])).sum()
        return -half - 0.5 * triangle[-1, -1] ** 2

    def fit_white(self, density, start):
        """Return the most likely white variance for a given walk."""
        return math.exp(
            maximise(
                lambda x: self.log_likelihood(math.exp(x), density), math.log(start), 3.0, 1e-4
            )
        )

    def fit(self, white, density):
        """Return the most likely variances about a start."""

        def profile(x):
            return self.log_likelihood(self.fit_white(math.exp(x), white), math.exp(x))

        density = math.exp(maximise(profile, math.log(density), 4.0, 1e-4))
        return np.array([self.fit_white(density, white), density])

    def log_covariance(self, levels, step=1e-2):
        """Return the covariance of the logarithms of the levels: inverse observed information."""
        m = levels.size

        def curvature(i, j):
            corners = (
                a
                * b
                * self.log_likelihood(
                    *(levels * np.exp(step * (a * np.eye(m)[i] + b * np.eye(m)[j])))
                )
                for a in (1, -1)
                for b in (1, -1)
            )
            return sum(corners) / (4.0 * step**2)

        return np.linalg.inv([[-curvature(i, j) for j in range(m)] for i in range(m)])


def maximise(function, start, half_width, tolerance):
    """Return the maximum of a unimodal function by golden-section search about a start."""
    low, high = start - half_width, start + half_width
    first, second = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    first_value, second_value = function(first), function(second)
    while high - low > tolerance:
        if first_value > second_value:
            high, second, second_value = second, first, first_value
            first = high - GOLDEN * (high - low)
            first_value = function(first)
        else:
            low, first, first_value = first, second, second_value
            second = low + GOLDEN * (high - low)
            second_value = function(second)
    return 0.5 * (low + high)


def find_crossing(function, value, low, high):
    """Return the argument at which an increasing function has a value, by bisection."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if function(middle) < value else (low, middle)
    return 0.5 * (low + high)


def normal_cdf(x):
    """Return the standard normal distribution function."""
    return 0.5 * math.erfc(-x / math.sqrt(2.0))


def student_cdf(dof, x):
    """Return Student's distribution function for x >= 0, by Simpson's rule."""
    t = np.linspace(0.0, x, 4001)
    density = np.exp(-(dof + 1.0) / 2.0 * np.log1p(t**2 / dof))
    size = math.lgamma((dof + 1.0) / 2.0) - math.lgamma(dof / 2.0)
    weights = np.ones(t.size)
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    area = float(weights @ density) * (t[1] - t[0]) / 3.0
    return 0.5 + math.exp(size) / math.sqrt(dof * math.pi) * area


def student_quantile(dof, level):
    return find_crossing(lambda x: student_cdf(dof, x), level, 0.0, 200.0)


def _find_dof(function, value):
    """Return the degrees of freedom at which a decreasing function has a value."""
    return math.exp(-find_crossing(lambda x: function(math.exp(-x)), value, -12.0, 0.0))


def estimate_hidden_walk(likelihood, white, variance, slope):
    """Return N^2 and degrees of freedom with an undetected walk (docs/methods.md, Noise).

    The distribution of N^2 is its likelihood times (N^2)^(-2/3) dN^2. Given N^2, a coefficient is
    normal with variance + slope N^2. The level and degrees of freedom of the most affected
    coefficient match its quantiles at one u and 95 %. The other coefficients have the same level,
    and degrees of freedom that match their 95 % quantiles.
    """
    log_levels, values = math.log(white) + np.arange(-32.0, 10.0, 0.2), []
    for x in log_levels:
        values.append(
            likelihood.log_likelihood(likelihood.fit_white(math.exp(x), white), math.exp(x))
        )
        if values[-1] < max(values) - 14.0:
            break
    levels = np.exp(log_levels[: len(values)])
    weights = np.exp(np.array(values) - max(values)) * levels ** (1.0 / 3.0)
    weights /= weights.sum()

    def quantile(k, level):
        sds = np.sqrt(variance[k] + slope[k] * levels)

        def mixture_cdf(x):
            return sum(w * normal_cdf(x / s) for w, s in zip(weights, sds, strict=True))

        return find_crossing(mixture_cdf, level, 0.0, 50.0 * sds[-1])

    one_u_level, most_affected = normal_cdf(1.0), int(np.argmax(slope / variance))
    u_quantile, interval_quantile = (
        quantile(most_affected, one_u_level),
        quantile(most_affected, 0.975),
    )
    dof = _find_dof(
        lambda d: student_quantile(d, 0.975) / student_quantile(d, one_u_level),
        interval_quantile / u_quantile,
    )
    u = u_quantile / student_quantile(dof, one_u_level)
    level = (u**2 - variance[most_affected]) / slope[most_affected]
    spread = np.sqrt(variance + level * slope)
    dofs = [
        _find_dof(lambda d: student_quantile(d, 0.975), quantile(k, 0.975) / spread[k])
        for k in range(variance.size)
    ]
    return level, np.array(dofs)
