"""Cosine transform of a regularly sampled record at rest, with nearly independent rows.

In the cosine transform of type II, the rows of white noise are exactly independent. So are those of
a random walk with unknown mean, because the inverse covariance of its steps has these eigenvectors
(Strang, SIAM Review 41 (1999) 135). For flicker, the slowest `SLOW_ROWS` rows have their
covariance; the other rows are correlated by less than 0.5 % in total. White noise of a velocity or
displacement becomes differences of white noise, independent except for the first and last `order`
rows, each of which has an unknown of its own.

Neighbouring fast rows have nearly equal variances, so that the triangle of a group contains all
its information: a hundred thousand rows cost as much as three thousand.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from counterspin.arrays import Array, triangular_factor
from counterspin.frozen import frozen
from counterspin.inference.noise.bias_instability import Variances
from counterspin.inference.noise.components import (
    BIAS_COMPONENTS,
    SLOW_ROWS,
    Sampling,
    sampled_densities,
)

#: Number of rows without groups, and width of a group relative to its first row.
_UNGROUPED_ROWS: Final = 400
_GROUP_FRACTION: Final = 0.02


@frozen(eq=False)
class EvenlySampledData:
    """Mean specific force between the samples of a record at rest."""

    step: float  #: Time between samples, s.
    kind: Sampling
    design: Array  #: Columns of the unknowns without the constant, shape (n, k).
    observations: Array  #: Differences over step^order, m/s^2, shape (n,).
    #: Indices of the columns among the unknowns of all records, shape (k,).
    column_indices: NDArray[np.intp]

    @classmethod
    def from_samples(
        cls, values: Array, step: float, sampling: Sampling, shared_columns: Array, first_index: int
    ) -> EvenlySampledData:
        """Return the data of a record without gaps.

        values: Recorded values, SI, shape (n,).
        shared_columns: Columns of the common unknowns of all records, shape (n - order, k).
        first_index: Index of the first unknown of this record alone.
        """
        order = sampling.order
        force = np.diff(values, n=order) / step**order
        end_columns = np.zeros((force.size, 2 * order))
        for row in range(order):
            end_columns[row, row] = end_columns[-1 - row, order + row] = 1.0
        indices = [*range(shared_columns.shape[1]), *range(first_index, first_index + 2 * order)]
        return cls(
            step,
            sampling,
            np.column_stack([shared_columns, end_columns]),
            force,
            np.array(indices, np.intp),
        )

    def reduce(self) -> TransformedRecord:
        """Return the cosine transform of the record."""
        from scipy.fft import dct

        n = self.observations.size
        rows = np.column_stack([self.design, self.observations])
        rows = dct(rows, type=2, norm="ortho", axis=0)[1:]
        row_variances = _row_variances(np.arange(1.0, n), n, self.step, self.kind)
        edges = [min(n - 1, _UNGROUPED_ROWS)]
        while edges[-1] < n - 1:
            edges.append(min(n - 1, math.ceil(edges[-1] * (1.0 + _GROUP_FRACTION))))
        row_groups, variances = [rows[: edges[0]]], [row_variances[:, : edges[0]]]
        for begin, end in pairwise(edges):
            group_triangle = triangular_factor(rows[begin:end])
            row_groups.append(group_triangle)
            variances.append(
                np.repeat(
                    row_variances[:, begin:end].mean(axis=1)[:, None], len(group_triangle), axis=1
                )
            )
        counts = np.append(np.ones(edges[0]), np.diff(edges).astype(float))
        group_starts = np.cumsum([0, edges[0], *map(len, row_groups[1:])])[1:-1]
        first_rows = np.append(np.arange(edges[0]), group_starts).astype(np.intp)
        return TransformedRecord(
            self.step,
            self.kind,
            n,
            np.concatenate(row_groups),
            np.concatenate(variances, axis=1),
            counts,
            first_rows,
            _slow_covariances(n, self.kind),
        )


@frozen(eq=False)
class TransformedRecord:
    """Rows of the cosine transform, with rows of high frequency in groups."""

    step: float  #: Time between samples, s.
    kind: Sampling
    samples: int  #: Number of samples of the specific force.
    stack: Array  #: [design | observations], (m, k + 1).
    row_variances: Array  #: Variance of each row per unit of each of `COMPONENTS`, (4, m).
    counts: Array  #: Number of rows of the transform in each group, (g,).
    first_rows: NDArray[np.intp]  #: Index of the first row of each group in `stack`, (g,).
    #: Covariance of the slowest rows for each bias component; None: independent.
    slow_covariances: tuple[Array | None, ...]
    walk_duration: float = 0.0
    added_variance: float = 0.0

    @property
    def order(self) -> int:
        """Number of integrations of acceleration to the observable with white noise."""
        return self.kind.order

    @property
    def n_rows(self) -> int:
        """Number of rows of the transform, without the mean."""
        return self.samples - 1

    @property
    def length(self) -> float:
        """Duration of the record, s."""
        return self.samples * self.step

    @property
    def spacing(self) -> float:
        """Time between samples, s."""
        return self.step

    @property
    def row_steps(self) -> tuple[Array, Array]:
        """Time between samples, s, and the number of samples per row, which is 1."""
        return np.array([self.step]), np.ones(1)

    def with_columns(self, mask: NDArray[np.bool_]) -> TransformedRecord:
        """Return the transform with some of the design columns."""
        return replace(self, stack=np.asfortranarray(self.stack[:, np.append(mask, True)]))

    def without_added_variance(self) -> TransformedRecord:
        """Return the record itself, because it has no known additional variance."""
        return self

    def whitened(self, ratios: Variances) -> tuple[Array, float]:
        """Return whitened rows, and the log-determinant of their covariance."""
        variance = np.asarray(ratios) @ self.row_variances
        rows = self.stack / np.sqrt(variance)[:, None]
        log_det = float(self.counts @ np.log(variance[self.first_rows]))
        covariances = [
            ratio * slow_covariance
            for ratio, slow_covariance in zip(ratios[2:], self.slow_covariances, strict=True)
            if slow_covariance is not None and ratio > 0.0
        ]
        if covariances:
            slow_rows = slice(0, min(SLOW_ROWS, self.n_rows))
            covariance = np.sum(covariances, axis=0)
            covariance.flat[:: len(covariance) + 1] = variance[slow_rows]
            factor = np.linalg.cholesky(covariance)
            rows[slow_rows] = np.linalg.solve(factor, self.stack[slow_rows])
            log_det += 2.0 * float(np.log(np.diagonal(factor)).sum())
            log_det -= float(np.log(variance[slow_rows]).sum())
        return rows, log_det


def _row_variances(k: Array, n: int, step: float, sampling: Sampling) -> Array:
    """Return the variance of each row of the transform per unit of each of `COMPONENTS`.

    k: Index of each row, from 1, shape (m,).
    n: Number of samples of the specific force.
    Returns: (4, m).
    """
    row_variances = sampled_densities(math.pi * k / n, step, sampling)
    for variances, covariance in zip(
        row_variances[2:], _slow_covariances(n, sampling), strict=True
    ):
        if covariance is not None:
            variances[: len(covariance)] = np.diagonal(covariance)
    return row_variances


def _slow_covariances(n: int, sampling: Sampling) -> tuple[Array | None, ...]:
    """Return the covariance of the slowest rows for each bias component of unit size."""
    order, components = sampling.averaging_order, BIAS_COMPONENTS.values()
    return tuple(component.transform_covariance(n, order) for component in components)
