"""Correlated priors: their correlation matrix, independent rows, and independent sources."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from counterspin.arrays import Array


class HasPrior(Protocol):
    """An unknown with a prior, such as `counterspin.inference.joint.unknowns.Unknown`."""

    @property
    def name(self) -> str:
        """Full name."""

    @property
    def prior(self) -> tuple[float, float]:
        """Value and standard uncertainty."""

    @property
    def correlations(self) -> Mapping[str, float]:
        """Names of other unknowns -> stated correlation of the priors."""


def correlation_matrix(
    names: Sequence[str], correlations: Mapping[str, Mapping[str, float]]
) -> Array:
    """Return the correlation matrix of named quantities, shape (n, n).

    correlations: Name -> correlation with other quantities; other names are ignored.
    """
    indices = {name: index for index, name in enumerate(names)}
    matrix = np.eye(len(names))
    for name, index in indices.items():
        for other_name, r in correlations.get(name, {}).items():
            if other_name in indices:
                matrix[index, indices[other_name]] = r
    return matrix


def prior_correlation(unknowns: Sequence[HasPrior]) -> Array | None:
    """Return the correlation matrix of priors, shape (p, p); None if all are independent."""
    correlations = {
        unknown.name: unknown.correlations for unknown in unknowns if unknown.correlations
    }
    if not correlations:
        return None
    return correlation_matrix([unknown.name for unknown in unknowns], correlations)


def prior_root(unknowns: Sequence[HasPrior]) -> Array | None:
    """Return the Cholesky factor of `prior_correlation`; None if all priors are independent."""
    correlation = prior_correlation(unknowns)
    return None if correlation is None else np.asarray(np.linalg.cholesky(correlation))


def whiten_priors(columns: Array, sd: Array, correlation: Array | None) -> Array:
    """Return whitened deviations from the prior means, in which the priors have unit covariance.

    A row depends on its own unknown and on the preceding unknowns.

    columns: Shape (p, ...).
    sd: Standard uncertainties of the priors, above 0, shape (p,).
    correlation: Correlation of the priors, shape (p, p); None: independent.
    """
    rows: Array = columns / sd.reshape(-1, *[1] * (columns.ndim - 1))
    return rows if correlation is None else np.linalg.solve(np.linalg.cholesky(correlation), rows)


def conditional_priors(unknowns: Sequence[HasPrior], owner: str) -> dict[str, tuple[str, float]]:
    """Return correlated unknown -> its source in a budget, and the u of the source.

    A correlated prior is conditional on the preceding priors. These sources are independent, so
    that the squares of their contributions add up.

    owner: Accelerometer whose name is omitted from the names of its terms.
    """
    root = prior_root(unknowns)
    if root is None:
        return {}
    names = [unknown.name.removeprefix(f"{owner}.") for unknown in unknowns]
    sources = {}
    for index, unknown in enumerate(unknowns):
        preceding_names = ", ".join(names[k] for k in np.flatnonzero(root[index, :index]).tolist())
        source = f"{names[index]} given {preceding_names}" if preceding_names else names[index]
        if unknown.correlations:
            sources[unknown.name] = source, float(root[index, index]) * unknown.prior[1]
    return sources
