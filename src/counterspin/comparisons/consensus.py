"""Reference value of several measurements of one quantity, and degrees of equivalence.

Method of M. G. Cox, Metrologia 39 (2002) 589, procedure A, and 44 (2007) 187, with generalised
least squares for correlated measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.distributions import chi_square_tail


@frozen(eq=False)
class Consensus:
    """Weighted mean of a subset of n measurements."""

    members: tuple[int, ...]  #: Indices of the measurements in the subset, ascending.
    weights: Array  #: Weights of all measurements, shape (n,); 0 outside the subset.
    value: float
    u: float
    chi2: float  #: Chi-square of the members about the mean.
    p: float | None  #: Probability of a larger chi-square by chance; None for a single member.


def weighted_mean(
    values: Array, covariance: Array, members: Sequence[int] | None = None
) -> Consensus:
    """Return the weighted mean of a subset.

    values: Measurements, shape (n,).
    covariance: Positive definite covariance, shape (n, n).
    members: Indices of the subset; None: all.
    """
    indices = list(range(values.size) if members is None else members)
    precision = np.linalg.inv(covariance[np.ix_(indices, indices)])
    weights = np.zeros(values.size)
    weights[indices] = precision.sum(axis=0) / precision.sum()
    mean = float(weights @ values)
    residuals = values[indices] - mean
    chi2, dof = float(residuals @ precision @ residuals), len(indices) - 1
    p = chi_square_tail(dof, chi2) if dof else None
    return Consensus(tuple(indices), weights, mean, float(precision.sum() ** -0.5), chi2, p)


def largest_consistent_subsets(
    values: Array, covariance: Array, significance: float
) -> list[Consensus]:
    """Return the largest consistent subsets of at least two measurements, sorted by chi-square.

    A subset is consistent if its `p` is at least the significance.

    Returns: An empty list if no two measurements are consistent.
    """
    for n_members in range(values.size, 1, -1):
        means = [
            weighted_mean(values, covariance, members)
            for members in combinations(range(values.size), n_members)
        ]
        consistent_means = [mean for mean in means if mean.p is not None and mean.p >= significance]
        if consistent_means:
            return sorted(consistent_means, key=lambda mean: mean.chi2)
    return []


def degrees_of_equivalence(values: Array, covariance: Array, weights: Array) -> tuple[Array, Array]:
    """Return the measurements minus a reference value, and their standard uncertainties.

    For members of the reference, u^2 is u_i^2 - u_ref^2. For other, independent measurements it
    is u_i^2 + u_ref^2.

    weights: Weights of the measurements in the reference value, shape (n,).
    """
    projection = np.eye(values.size) - weights
    variances = np.diag(projection @ covariance @ projection.T)
    return projection @ values, np.sqrt(np.maximum(variances, 0.0))
