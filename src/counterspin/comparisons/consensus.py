"""Reference value of several measurements of one quantity, and degrees of equivalence.

After M. G. Cox, Metrologia 39 (2002) 589, procedure A, and 44 (2007) 187. The weighted mean of
correlated measurements is that of generalised least squares.
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

    values, covariance: Shapes (n,) and (n, n); the covariance is positive definite.
    members: Indices of the subset; None: all.
    """
    chosen = list(range(values.size) if members is None else members)
    inverse = np.linalg.inv(covariance[np.ix_(chosen, chosen)])
    weights = np.zeros(values.size)
    weights[chosen] = inverse.sum(axis=0) / inverse.sum()
    mean = float(weights @ values)
    residuals = values[chosen] - mean
    chi2, dof = float(residuals @ inverse @ residuals), len(chosen) - 1
    p = chi_square_tail(dof, chi2) if dof else None
    return Consensus(tuple(chosen), weights, mean, float(inverse.sum() ** -0.5), chi2, p)


def largest_consistent_subsets(
    values: Array, covariance: Array, significance: float
) -> list[Consensus]:
    """Return the largest consistent subsets of at least two, in the order of their chi-square.

    A subset is consistent if its `p` is at least the significance.

    Returns: An empty list if no two measurements are consistent.
    """
    for size in range(values.size, 1, -1):
        means = [
            weighted_mean(values, covariance, members)
            for members in combinations(range(values.size), size)
        ]
        consistent = [mean for mean in means if mean.p is not None and mean.p >= significance]
        if consistent:
            return sorted(consistent, key=lambda mean: mean.chi2)
    return []


def degrees_of_equivalence(values: Array, covariance: Array, weights: Array) -> tuple[Array, Array]:
    """Return the measurements minus a reference value, and their standard uncertainties.

    For members of the reference, u^2 is u_i^2 - u_ref^2. For other, independent measurements it
    is u_i^2 + u_ref^2.

    weights: Weights of the measurements in the reference value, shape (n,).
    """
    rows = np.eye(values.size) - weights
    return rows @ values, np.sqrt(np.maximum(np.diag(rows @ covariance @ rows.T), 0.0))
