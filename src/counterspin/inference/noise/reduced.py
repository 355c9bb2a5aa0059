"""A record of one observable, reduced to what the likelihood of its noise needs.

Wherever a bias wanders, its cosines (`counterspin.inference.noise.wander`) and the record's own
columns are reduced to one triangle, once for each ratio of the noise beside the wander. Trial sizes
of the wander then cost what the triangle's few hundred rows cost, however long the record is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from counterspin.arrays import Array, in_parts, median, triangle_of
from counterspin.frozen import frozen
from counterspin.inference.noise.model import (
    SPECIFIC_FORCE,
    Differences,
    solve_banded_factor,
)
from counterspin.inference.noise.wander import (
    Variances,
    coefficient_covariance,
    functions_needed,
    integrated_cosines,
    spanned,
)


@frozen
class RecordData:
    """One record of one observable, as noise estimation needs it."""

    times: ArrayLike  #: (n,) s, increasing.
    order: int  #: 2 displacement, 1 velocity, 0 specific force.
    #: (n, k) columns of the unknowns that the record sees. Start offset and velocity may be left
    #: out: differencing removes them.
    design: ArrayLike
    observations: ArrayLike  #: (n,).
    #: Samples per row and the time between them, as in `make_whitener`.
    count: ArrayLike | None = None
    spacing: ArrayLike | None = None
    #: (k,) which of the p unknowns of all records the columns belong to; absent: all of them.
    places: ArrayLike | None = None
    before: float = 0.0  #: For how long a bias had walked when the record began, s.
    #: (n,) or a number: a variance of each row's samples that is known, beside what is estimated.
    added: float | Array = 0.0
    relative: float = 1.0  #: Its white variance over that of records that are alike.

    def reduced(self) -> DifferencedRecord:
        """Return its differences."""
        differences = Differences.of(
            self.times, self.order, self.count, self.spacing, self.relative
        )
        rows = [np.asarray(self.design, float), np.asarray(self.observations, float)]
        stack = differences.apply(np.column_stack(rows))
        return DifferencedRecord(differences, stack, self.order, self.before, self.added)


@dataclass
class DifferencedRecord:
    """A record's differences, and triangles of them that serve many sizes of the noise."""

    differences: Differences
    stack: Array  #: Differenced [design | observations], (m, k + 1).
    order: int
    before: float
    added: float | Array
    triangles: dict[Any, tuple[Array, float]] = field(default_factory=dict)

    @property
    def rows(self) -> int:
        """How many there are."""
        return self.differences.rows

    @property
    def length(self) -> float:
        """Of the record, s."""
        return float(self.differences.blocks.time[-1])

    @property
    def spacing(self) -> float:
        """Usual time between samples, s."""
        return median(self.differences.spacing)

    @property
    def row_steps(self) -> tuple[Array, Array]:
        """Times from row to row, s, and how many samples the rows are means of."""
        blocks = self.differences.blocks
        return np.diff(blocks.time), blocks.count

    def with_columns(self, kept: NDArray[np.bool_]) -> DifferencedRecord:
        """Return it with some of the columns of its design."""
        stack = np.asfortranarray(self.stack[:, np.append(kept, True)])
        return replace(self, stack=stack, triangles={})

    def without_added(self) -> DifferencedRecord:
        """Return it with all of the samples' white variance to be estimated."""
        return replace(self, added=0.0, triangles={}) if np.any(self.added) else self

    def whitened(self, unit: Variances) -> tuple[Array, float]:
        """Return rows whitened at these variances, or as many as say the same of the unknowns.

        Returns: Rows; log-determinant of the covariance of the differences.
        """
        if not any(unit[2:]):
            bands, log_det = self.differences.factor(unit[0] + self.added, unit[1])
            return solve_banded_factor(bands, self.stack), log_det
        beside = float(unit[0] + np.mean(self.added)) * self.differences.relative
        length = spanned(self.length)
        count = functions_needed((beside, *unit[1:]), self.spacing, length, self.order)
        scale = self._scale(unit)
        triangle, log_det = self._triangle(unit[0] / scale, unit[1] / scale, count)
        covariance = coefficient_covariance(unit, count, length, self.before) / scale
        shown = triangle[:count, :count]
        rows = triangle[:, count:] / math.sqrt(scale)
        inside = shown @ covariance @ shown.T
        inside.flat[:: len(inside) + 1] += 1.0
        factor = np.linalg.cholesky(inside)
        from scipy.linalg import solve_triangular

        rows[:count] = solve_triangular(factor, rows[:count], lower=True, check_finite=False)
        log_det += self.rows * math.log(scale) + 2.0 * float(np.log(np.diagonal(factor)).sum())
        return rows, log_det

    @property
    def _uneven(self) -> bool:
        """Whether its white noise is in no proportion to what else is white in a sample."""
        return bool(np.any(self.added)) or self.differences.relative != 1.0

    def _scale(self, unit: Variances) -> float:
        """Return a size of the noise beside a wander, by which it becomes one of few."""
        if self._uneven:
            return 1.0
        spacing = self.differences.spacing
        if self.order == SPECIFIC_FORCE and np.ptp(spacing) == 0.0:
            return float(unit[0] + unit[1] / spacing[0])
        return unit[0] or unit[1]

    def _triangle(self, white: float, walk: float, count: int) -> tuple[Array, float]:
        """Triangle of [cosines | stack], whitened without the wander, and the log-determinant."""
        even = self.order == SPECIFIC_FORCE and np.ptp(self.differences.spacing) == 0.0
        if even and not self._uneven:
            white, walk = 1.0, 0.0  # what is white in a sample cannot be told from it
        key = (white, walk, count)
        if key not in self.triangles:
            blocks, length = self.differences.blocks, spanned(self.length)
            shown = self.differences.apply(
                integrated_cosines(
                    blocks.time, blocks.count, self.differences.spacing, self.order, count, length
                )
            )
            bands, log_det = self.differences.factor(white + self.added, walk)
            rows = solve_banded_factor(bands, np.column_stack([shown, self.stack]))
            self.triangles[key] = triangle_of(in_parts(rows)), log_det
        return self.triangles[key]
