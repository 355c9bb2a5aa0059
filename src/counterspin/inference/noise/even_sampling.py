"""The cosine transform of an evenly sampled record at rest, whose rows are nearly independent.

The transform of type II is that of a record continued by its mirror image. White noise is exactly
independent in it from row to row, and so is a random walk whose mean is unknown: its steps' inverse
covariance has just these vectors (Strang, SIAM Review 41 (1999) 135). Flicker lies between the two:
its slowest `SLOW_ROWS` rows have their covariance, the others are less than 0.5 % correlated in
all. What is white in a velocity or a displacement is differences of white noise here, independent
but for the first and last `order` rows: those are given up, each an unknown of its own.

The fast rows have variances that change little from one to the next, so that the triangle of a
group says all that the group does: a hundred thousand rows cost what three thousand cost.
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

#: Rows beyond which neighbours within this part of their number are one group.
_UNGROUPED_ROWS: Final = 400
_GROUP_FRACTION: Final = 0.02


@frozen(eq=False)
class EvenlySampledData:
    """Means of the specific force between the samples of a record at rest."""

    step: float  #: s.
    kind: Sampling
    design: Array  #: (n, k) columns of unknowns; not their common constant.
    observations: Array  #: (n,) m/s^2: differences of that order, over step^order.
    places: NDArray[np.intp]  #: (k,) of the columns among the unknowns of all records.

    @classmethod
    def of(
        cls, values: Array, step: float, kind: Sampling, slow: Array, first: int
    ) -> EvenlySampledData:
        """Return a record of an observable without gaps.

        values: (n,) as recorded, SI.
        slow: (n - order, k) columns of what all records share, of the specific force.
        first: Number that this record's own unknowns begin with.
        """
        order = kind.order
        force = np.diff(values, n=order) / step**order
        ends = np.zeros((force.size, 2 * order))
        for place in range(order):
            ends[place, place] = ends[-1 - place, order + place] = 1.0
        places = [*range(slow.shape[1]), *range(first, first + 2 * order)]
        return cls(step, kind, np.column_stack([slow, ends]), force, np.array(places, np.intp))

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
        stack, variances = [rows[: edges[0]]], [row_variances[:, : edges[0]]]
        for begin, end in pairwise(edges):
            group_triangle = triangular_factor(rows[begin:end])
            stack.append(group_triangle)
            variances.append(
                np.repeat(
                    row_variances[:, begin:end].mean(axis=1)[:, None], len(group_triangle), axis=1
                )
            )
        counts = np.append(np.ones(edges[0]), np.diff(edges).astype(float))
        first = np.cumsum([0, edges[0], *map(len, stack[1:])])[1:-1]
        places = np.append(np.arange(edges[0]), first).astype(np.intp)
        return TransformedRecord(
            self.step,
            self.kind,
            n,
            np.concatenate(stack),
            np.concatenate(variances, axis=1),
            counts,
            places,
            _slow_covariances(n, self.kind),
        )


@frozen(eq=False)
class TransformedRecord:
    """Rows of the cosine transform, with rows of high frequency in groups."""

    step: float  #: s.
    kind: Sampling
    samples: int  #: Of the specific force.
    stack: Array  #: [design | observations], (m, k + 1).
    row_variances: Array  #: Variance of each row per unit of each of `COMPONENTS`, (4, m).
    counts: Array  #: How many rows of the transform each group has, (g,).
    places: NDArray[np.intp]  #: Of each group's first row in `stack`, (g,).
    #: Covariance of the slowest rows for each bias component; None: they are independent.
    slow_covariances: tuple[Array | None, ...]
    walk_duration: float = 0.0
    added_variance: float = 0.0

    @property
    def order(self) -> int:
        """Number of integrations of acceleration to the observable with white noise."""
        return self.kind.order

    @property
    def rows(self) -> int:
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

    def with_columns(self, kept: NDArray[np.bool_]) -> TransformedRecord:
        """Return the transform with some of the design columns."""
        return replace(self, stack=np.asfortranarray(self.stack[:, np.append(kept, True)]))

    def without_added_variance(self) -> TransformedRecord:
        """Return the record itself, because it has no known additional variance."""
        return self

    def whitened(self, ratios: Variances) -> tuple[Array, float]:
        """Return whitened rows, and the log-determinant of their covariance."""
        variance = np.asarray(ratios) @ self.row_variances
        rows = self.stack / np.sqrt(variance)[:, None]
        log_det = float(self.counts @ np.log(variance[self.places]))
        coloured = [
            ratio * part
            for ratio, part in zip(ratios[2:], self.slow_covariances, strict=True)
            if part is not None and ratio > 0.0
        ]
        if coloured:
            slow = slice(0, min(SLOW_ROWS, self.rows))
            covariance = np.sum(coloured, axis=0)
            covariance.flat[:: len(covariance) + 1] = variance[slow]
            factor = np.linalg.cholesky(covariance)
            rows[slow] = np.linalg.solve(factor, self.stack[slow])
            log_det += 2.0 * float(np.log(np.diagonal(factor)).sum())
            log_det -= float(np.log(variance[slow]).sum())
        return rows, log_det


def _row_variances(k: Array, n: int, step: float, kind: Sampling) -> Array:
    """Return the variance of each row of the transform per unit of each of `COMPONENTS`.

    k: Number of each row, from 1, shape (m,).
    n: Samples of the specific force.
    Returns: (4, m).
    """
    row_variances = sampled_densities(math.pi * k / n, step, kind)
    for variances, covariance in zip(row_variances[2:], _slow_covariances(n, kind), strict=True):
        if covariance is not None:
            variances[: len(covariance)] = np.diagonal(covariance)
    return row_variances


def _slow_covariances(n: int, kind: Sampling) -> tuple[Array | None, ...]:
    """Return the covariance of the slowest rows for each bias component of unit size."""
    order, components = kind.averaging_order, BIAS_COMPONENTS.values()
    return tuple(component.transform_covariance(n, order) for component in components)
