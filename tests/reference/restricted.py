"""Restricted likelihood of white noise and a walk with dense covariances, for make_fits.py.

Nothing here uses counterspin. With V = w I + N^2 W of all rows, X their columns and y what is left:

    2 log L = -log|V| - log|X' V^-1 X| - (y - X b)' V^-1 (y - X b)

(Patterson and Thompson, Biometrika 58 (1971) 545). What is known beforehand are further rows.
"""

import math

import numpy as np
from dense_fit import derivatives, walk

GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


class Likelihood:
    """Of records of one accelerometer, whose noise has the same levels in all of them."""

    def __init__(self, groups, times, integrations, unknowns):
        at = {u.name: u.mean for u in unknowns}
        free = sum(rows.free.shape[1] for rows in groups)
        size, p = sum(t.size for t in times), len(unknowns)
        known = [j for j, u in enumerate(unknowns) if np.isfinite(u.sd)]
        every = size + len(known)
        self.design, self.left = np.zeros((every, p + free)), np.zeros(every)
        self.white, self.walk = np.zeros((2, every, every))
        self.fixed = np.zeros(every)
        row, column = 0, p
        for rows, t in zip(groups, times, strict=True):
            here = slice(row, row + t.size)
            self.design[here, :p] = derivatives(rows, unknowns, at)
            self.design[here, column : column + rows.free.shape[1]] = rows.free
            self.left[here] = rows.values - rows.model(at)
            self.white[here, here] = np.eye(t.size)
            self.walk[here, here] = walk(t, 1.0, integrations)
            row, column = row + t.size, column + rows.free.shape[1]
        for k, j in enumerate(known):
            self.design[size + k, j] = 1.0
            self.fixed[size + k] = unknowns[j].sd ** 2
        self.design /= np.linalg.norm(self.design, axis=0)

    def value(self, white, density=0.0):
        """Return the log-likelihood up to a constant at two variances."""
        root = np.linalg.cholesky(np.diag(self.fixed) + white * self.white + density * self.walk)
        rows = np.linalg.solve(root, np.column_stack([self.design, self.left]))
        triangle = np.linalg.qr(rows, mode="r")
        half = np.log(np.abs(np.diag(root))).sum() + np.log(np.abs(np.diag(triangle)[:-1])).sum()
        return -half - 0.5 * triangle[-1, -1] ** 2

    def best_white(self, density, start):
        """Return the most likely white variance for a given walk."""
        return math.exp(
            largest(lambda x: self.value(math.exp(x), density), math.log(start), 3.0, 1e-4)
        )

    def best(self, white, density):
        """Return the most likely variances about a start."""

        def beside(x):
            return self.value(self.best_white(math.exp(x), white), math.exp(x))

        density = math.exp(largest(beside, math.log(density), 4.0, 1e-4))
        return np.array([self.best_white(density, white), density])

    def spread(self, levels, step=1e-2):
        """Covariance of the logarithms of the levels: the inverse of the observed information."""
        m = levels.size

        def curvature(i, j):
            corners = (
                a * b * self.value(*(levels * np.exp(step * (a * np.eye(m)[i] + b * np.eye(m)[j]))))
                for a in (1, -1)
                for b in (1, -1)
            )
            return sum(corners) / (4.0 * step**2)

        return np.linalg.inv([[-curvature(i, j) for j in range(m)] for i in range(m)])


def largest(function, start, reach, close):
    """Return the maximum of a unimodal function by golden-section search about a start."""
    low, high = start - reach, start + reach
    first, second = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    one, two = function(first), function(second)
    while high - low > close:
        if one > two:
            high, second, two = second, first, one
            first = high - GOLDEN * (high - low)
            one = function(first)
        else:
            low, first, one = first, second, two
            second = low + GOLDEN * (high - low)
            two = function(second)
    return 0.5 * (low + high)


def crossing(function, value, low, high):
    """Return the argument at which an increasing function has a value, by bisection."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if function(middle) < value else (low, middle)
    return 0.5 * (low + high)


def normal(x):
    """The normal distribution."""
    return 0.5 * math.erfc(-x / math.sqrt(2.0))


def student(dof, x):
    """Student's distribution for x >= 0, by Simpson's rule on its density."""
    t = np.linspace(0.0, x, 4001)
    density = np.exp(-(dof + 1.0) / 2.0 * np.log1p(t**2 / dof))
    size = math.lgamma((dof + 1.0) / 2.0) - math.lgamma(dof / 2.0)
    weights = np.ones(t.size)
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    area = float(weights @ density) * (t[1] - t[0]) / 3.0
    return 0.5 + math.exp(size) / math.sqrt(dof * math.pi) * area


def student_quantile(dof, level):
    return crossing(lambda x: student(dof, x), level, 0.0, 200.0)


def _dof_where(falling, value):
    """Return where a function that falls with the degrees of freedom has a value."""
    return math.exp(-crossing(lambda x: falling(math.exp(-x)), value, -12.0, 0.0))


def hidden(likelihood, white, variance, slope):
    """Return N^2 and degrees of freedom with an undetected walk (docs/methods.md, Noise).

    N^2 is spread as its likelihood times (N^2)^(-2/3) dN^2; for each N^2 a coefficient is normal
    with variance + slope N^2. Of the coefficient that feels it most the quantiles of one u and of
    95 % are those of Student's distribution with its u; the others have its level, and the degrees
    of freedom that make their 95 % right.
    """
    logs, values = math.log(white) + np.arange(-32.0, 10.0, 0.2), []
    for x in logs:
        values.append(likelihood.value(likelihood.best_white(math.exp(x), white), math.exp(x)))
        if values[-1] < max(values) - 14.0:
            break
    levels = np.exp(logs[: len(values)])
    weights = np.exp(np.array(values) - max(values)) * levels ** (1.0 / 3.0)
    weights /= weights.sum()

    def quantile(k, level):
        spread = np.sqrt(variance[k] + slope[k] * levels)

        def below(x):
            return sum(w * normal(x / s) for w, s in zip(weights, spread, strict=True))

        return crossing(below, level, 0.0, 50.0 * spread[-1])

    one_u, most = normal(1.0), int(np.argmax(slope / variance))
    narrow, wide = quantile(most, one_u), quantile(most, 0.975)
    dof = _dof_where(
        lambda d: student_quantile(d, 0.975) / student_quantile(d, one_u), wide / narrow
    )
    u = narrow / student_quantile(dof, one_u)
    level = (u**2 - variance[most]) / slope[most]
    spread = np.sqrt(variance + level * slope)
    dofs = [
        _dof_where(lambda d: student_quantile(d, 0.975), quantile(k, 0.975) / spread[k])
        for k in range(variance.size)
    ]
    return level, np.array(dofs)
