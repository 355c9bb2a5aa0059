"""Restricted likelihood of a noise model, which does not depend on the unknowns.

Differences remove start offset and velocity. Whitening with trial ratios of the variances and a QR
decomposition give a triangle that is valid for every scale of the noise (Patterson and Thompson,
Biometrika 58 (1971) 545; Harville, JASA 72 (1977) 320).

For bias noise, its cosines (`counterspin.inference.noise.bias_instability`) and the columns of the
record are reduced to a triangle, once for each ratio of the white noise. Trial variances of the
bias noise then only require the few hundred rows of the triangle, not the record.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from counterspin.arrays import Array, median, qr_blocks, triangular_factor
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.noise.bias_instability import (
    Variances,
    basis_length,
    basis_size,
    coefficient_covariance,
    integrated_cosines,
)
from counterspin.inference.noise.components import COMPONENTS
from counterspin.inference.noise.model import SPECIFIC_FORCE, Differences, solve_banded_factor

if TYPE_CHECKING:
    from counterspin.inference.noise.even_sampling import EvenlySampledData, TransformedRecord

#: Variances of white noise alone.
WHITE: Final = (1.0, *(0.0 for _ in COMPONENTS[1:]))

#: Degrees of freedom per row below which only rounding errors remain.
_MIN_DOF: Final = 1e-9


@frozen
class RecordData:
    """A record of an observable, as input of the noise estimation."""

    times: ArrayLike  #: s, increasing, shape (n,).
    order: int  #: 2 displacement, 1 velocity, 0 specific force.
    #: Columns of the unknowns of the record, shape (n, k), without start offset and velocity, which
    #: differences remove.
    design: ArrayLike
    observations: ArrayLike  #: Shape (n,).
    #: Samples per row and the time between them, as in `make_whitener`.
    count: ArrayLike | None = None
    spacing: ArrayLike | None = None
    #: Indices of the columns among the p unknowns of all records, shape (k,); None: all of them.
    column_indices: ArrayLike | None = None
    walk_duration: float = 0.0  #: Duration of the bias walk before the record, s.
    #: Known additional variance of the samples, shape (n,) or a number.
    added_variance: float | Array = 0.0
    variance_ratio: float = 1.0  #: White-noise variance over that of the accelerometer.

    def reduce(self) -> DifferencedRecord:
        """Return the differenced record."""
        differences = Differences.from_times(
            self.times, self.order, self.count, self.spacing, self.variance_ratio
        )
        rows = [np.asarray(self.design, float), np.asarray(self.observations, float)]
        stack = differences.apply(np.column_stack(rows))
        return DifferencedRecord(
            differences, stack, self.order, self.walk_duration, self.added_variance
        )


@dataclass
class DifferencedRecord:
    """The differences of a record, with cached triangular factors."""

    differences: Differences
    stack: Array  #: Differenced [design | observations], (m, k + 1).
    order: int
    walk_duration: float
    added_variance: float | Array
    triangles: dict[Any, tuple[Array, float]] = field(default_factory=dict)

    @property
    def n_rows(self) -> int:
        """Number of rows of the differences."""
        return self.differences.n_rows

    @property
    def length(self) -> float:
        """Duration of the record, s."""
        return float(self.differences.blocks.time[-1])

    @property
    def spacing(self) -> float:
        """Median time between samples, s."""
        return median(self.differences.spacing)

    @property
    def row_steps(self) -> tuple[Array, Array]:
        """Times between rows, s, and the number of samples of each row."""
        blocks = self.differences.blocks
        return np.diff(blocks.time), blocks.count

    def with_columns(self, mask: NDArray[np.bool_]) -> DifferencedRecord:
        """Return the record with some of the design columns."""
        stack = np.asfortranarray(self.stack[:, np.append(mask, True)])
        return replace(self, stack=stack, triangles={})

    def without_added_variance(self) -> DifferencedRecord:
        """Return the record without the known additional variance."""
        if not np.any(self.added_variance):
            return self
        return replace(self, added_variance=0.0, triangles={})

    def whitened(self, ratios: Variances) -> tuple[Array, float]:
        """Return rows whitened with these variances, or fewer rows with the same information.

        Returns: Rows; log-determinant of the covariance of the differences.
        """
        if not any(ratios[2:]):
            bands, log_det = self.differences.factor(ratios[0] + self.added_variance, ratios[1])
            return solve_banded_factor(bands, self.stack), log_det
        white_variance = (
            float(ratios[0] + np.mean(self.added_variance)) * self.differences.variance_ratio
        )
        length = basis_length(self.length)
        n_cosines = basis_size((white_variance, *ratios[1:]), self.spacing, length, self.order)
        scale = self._scale(ratios)
        triangle, log_det = self._triangular_factor(ratios[0] / scale, ratios[1] / scale, n_cosines)
        covariance = coefficient_covariance(ratios, n_cosines, length, self.walk_duration) / scale
        cosines = triangle[:n_cosines, :n_cosines]
        rows = triangle[:, n_cosines:] / math.sqrt(scale)
        inner_covariance = cosines @ covariance @ cosines.T
        inner_covariance.flat[:: len(inner_covariance) + 1] += 1.0
        factor = np.linalg.cholesky(inner_covariance)
        from scipy.linalg import solve_triangular

        rows[:n_cosines] = solve_triangular(
            factor, rows[:n_cosines], lower=True, check_finite=False
        )
        log_det += self.n_rows * math.log(scale) + 2.0 * float(np.log(np.diagonal(factor)).sum())
        return rows, log_det

    @property
    def _is_heteroscedastic(self) -> bool:
        """True if the two white variances of a sample do not scale together."""
        return bool(np.any(self.added_variance)) or self.differences.variance_ratio != 1.0

    def _scale(self, ratios: Variances) -> float:
        """Return the scale by which the white variances are normalised."""
        if self._is_heteroscedastic:
            return 1.0
        spacing = self.differences.spacing
        if self.order == SPECIFIC_FORCE and np.ptp(spacing) == 0.0:
            return float(ratios[0] + ratios[1] / spacing[0])
        return ratios[0] or ratios[1]

    def _triangular_factor(self, white: float, walk: float, n_cosines: int) -> tuple[Array, float]:
        """Return the triangle of whitened [cosines | stack], and the log-determinant."""
        is_even = self.order == SPECIFIC_FORCE and np.ptp(self.differences.spacing) == 0.0
        if is_even and not self._is_heteroscedastic:
            white, walk = 1.0, 0.0  # both are white noise of a sample
        key = (white, walk, n_cosines)
        if key not in self.triangles:
            blocks, length = self.differences.blocks, basis_length(self.length)
            cosines = self.differences.apply(
                integrated_cosines(
                    blocks.time,
                    blocks.count,
                    self.differences.spacing,
                    self.order,
                    n_cosines,
                    length,
                )
            )
            bands, log_det = self.differences.factor(white + self.added_variance, walk)
            rows = solve_banded_factor(bands, np.column_stack([cosines, self.stack]))
            self.triangles[key] = triangular_factor(qr_blocks(rows)), log_det
        return self.triangles[key]


@dataclass
class RestrictedLikelihood:
    """Restricted likelihood of noise with the variances exp(log scale) x ratios, and priors.

    Whitened rows are reduced to a triangle, which is cached for each set of ratios. If records have
    a known additional variance, the ratios are the variances themselves, and the scale is 1.
    """

    records: list[DifferencedRecord | TransformedRecord]
    column_indices: list[NDArray[np.intp]]  # indices of each record's columns among all unknowns
    prior: Array  # [rows | values]
    triangles: dict[Variances, tuple[Array, float]] = field(default_factory=dict)
    scales: dict[Variances, float] = field(default_factory=dict)  # best log scale of the ratios

    @classmethod
    def from_records(
        cls,
        records: Sequence[RecordData | EvenlySampledData],
        prior_rows: ArrayLike | None,
        prior_values: ArrayLike | None,
    ) -> RestrictedLikelihood:
        """Return the likelihood of differenced records; see `search.estimate_noise`."""
        if not records:
            raise ValueError("noise cannot be estimated without records")
        design_matrices = [np.asarray(r.design, float) for r in records]
        reduced_records = [r.reduce() for r in records]
        if len({record.order for record in reduced_records}) > 1:
            raise ValueError("records of different observables have different noise components")
        column_indices = [
            np.arange(design.shape[1])
            if r.column_indices is None
            else np.asarray(r.column_indices, np.intp)
            for r, design in zip(records, design_matrices, strict=True)
        ]
        p = 1 + max((int(indices.max()) for indices in column_indices if indices.size), default=-1)
        prior_factor = np.zeros((0, p)) if prior_rows is None else np.asarray(prior_rows, float)
        values = (
            np.zeros(len(prior_factor)) if prior_values is None else np.asarray(prior_values, float)
        )
        likelihood = cls(reduced_records, column_indices, np.column_stack([prior_factor, values]))
        # Differences reduce a start error in the design to rounding errors.
        norms_before, norms_after = np.zeros(prior_factor.shape[1]), np.zeros(prior_factor.shape[1])
        for squared_norms, designs in (
            (norms_before, design_matrices),
            (norms_after, [record.stack[:, :-1] for record in reduced_records]),
        ):
            for indices, design in zip(column_indices, designs, strict=True):
                squared_norms[indices] += np.square(design).sum(axis=0)
        is_visible = (norms_after > 1e-28 * norms_before) | (prior_factor != 0).any(axis=0)
        likelihood._select_unknowns(np.flatnonzero(is_visible))
        likelihood._select_unknowns(likelihood._independent_unknowns())
        n_unknowns = likelihood.prior.shape[1] - 1
        if likelihood.n_rows + len(prior_factor) <= n_unknowns:
            raise NotIdentifiableError(
                f"{likelihood.n_rows} differenced rows are too few to estimate the noise together "
                f"with {n_unknowns} unknowns; state the noise, or use longer records"
            )
        return likelihood

    def _select_unknowns(self, unknowns: NDArray[np.intp]) -> None:
        new_indices = np.full(self.prior.shape[1] - 1, -1)
        new_indices[unknowns] = np.arange(unknowns.size)
        for index, columns in enumerate(self.column_indices):
            is_kept = new_indices[columns] >= 0
            self.column_indices[index] = new_indices[columns[is_kept]]
            self.records[index] = self.records[index].with_columns(is_kept)
        self.prior = self.prior[:, np.append(unknowns, self.prior.shape[1] - 1)]
        self.triangles.clear()
        self.scales.clear()

    def _independent_unknowns(self) -> NDArray[np.intp]:
        """Return unknowns whose columns span the column space, on which the likelihood depends."""
        from scipy.linalg import qr

        rows = np.vstack([self._triangular_factor(WHITE)[0], self.prior])[:, :-1]
        scaled_rows = rows / np.linalg.norm(rows, axis=0)
        factor, order = qr(scaled_rows, mode="r", pivoting=True)
        return np.sort(order[: factor.shape[0]][np.abs(np.diagonal(factor)) > 1e-11])

    @property
    def n_rows(self) -> int:
        """Number of differenced rows."""
        return sum(record.n_rows for record in self.records)

    @property
    def evaluations(self) -> int:
        """Number of sets of ratios for which the rows were whitened."""
        return len(self.triangles)

    @property
    def order(self) -> int:
        """Number of times that the observable integrates acceleration."""
        return self.records[0].order

    @property
    def length(self) -> float:
        """Duration of the longest record, s."""
        return max(record.length for record in self.records)

    @property
    def added_variances(self) -> list[float | Array]:
        """Known white variance of each record, in addition to the estimated variance."""
        return [record.added_variance for record in self.records]

    @property
    def log_walk_floor(self) -> float:
        """Log ratio of N^2 to the white variance below which the walk is undetectable."""
        steps, counts = map(
            np.concatenate, zip(*(record.row_steps for record in self.records), strict=True)
        )
        unit_ratio = 1 / (median(counts) * median(steps) ** (2 * self.order - 1))
        return math.log(0.1 * unit_ratio * self._max_rows ** (-2.0 * self.order))

    @property
    def walk_range(self) -> float:
        """Range of the log ratio in which the records distinguish random walk and white noise."""
        return 2.0 * self.order * math.log(self._max_rows)

    @property
    def _max_rows(self) -> int:
        return max(record.n_rows for record in self.records)

    def without_added_variance(self) -> RestrictedLikelihood:
        """Return the likelihood without the known additional variances."""
        if not any(map(np.any, self.added_variances)):
            return self
        records = [record.without_added_variance() for record in self.records]
        return replace(self, records=records, triangles={}, scales={})

    def value(self, log_scale: float, ratios: Variances) -> float:
        """Return the restricted log-likelihood, except for a constant of the records."""
        triangle, _ = self._joint_triangle(log_scale, ratios)
        log_det = self._triangular_factor(ratios)[1] + self.n_rows * log_scale
        log_information = 2 * float(np.log(np.abs(np.diagonal(triangle)[:-1])).sum())
        return -(log_det + log_information + float(triangle[-1, -1]) ** 2) / 2

    def slope(self, log_scale: float, ratios: Variances) -> float:
        """Return the derivative of `value` with respect to the log scale."""
        dof, rss = self._dof_and_rss(log_scale, ratios)
        return (rss - dof) / 2

    def dof(self, log_scale: float, ratios: Variances) -> float:
        """Return the number of rows minus the effective number of unknowns."""
        return self._dof_and_rss(log_scale, ratios)[0]

    def estimate(self, log_scale: float, ratios: Variances) -> tuple[Array, Array]:
        """Return the estimates of the selected unknowns for a noise, and their covariance."""
        triangle, _ = self._joint_triangle(log_scale, ratios)
        inverse = np.linalg.inv(triangle[:-1, :-1])
        return inverse @ triangle[:-1, -1], inverse @ inverse.T

    def best_scale(self, ratios: Variances) -> float:
        """Return the log scale at which `slope` is zero."""
        if ratios not in self.scales:
            self.scales[ratios] = self._best_scale(ratios)
        return self.scales[ratios]

    def _best_scale(self, ratios: Variances) -> float:
        values = self._triangular_factor(ratios)[0][:, -1]
        dof = self.n_rows - self.prior.shape[1] + 1
        # If the unknowns can follow all rows, residuals are due to priors: start from above.
        rss = float(values[-1]) ** 2 if dof > 0 else float(values @ values)
        if rss == 0:
            raise NotIdentifiableError(
                "all residuals are zero, so the noise cannot be estimated; state the noise"
            )
        log_scale = math.log(rss / (dof if dof > 0 else self.n_rows))
        for _ in range(100 if len(self.prior) else 0):
            effective_dof, scaled_rss = self._dof_and_rss(log_scale, ratios)
            if effective_dof <= _MIN_DOF * self.n_rows or scaled_rss <= 0.0:
                raise NotIdentifiableError(
                    f"the unknowns fit all {self.n_rows} rows exactly, so the noise cannot be "
                    "estimated; state the noise, or use longer records"
                )
            change = math.log(scaled_rss / effective_dof)
            log_scale += change
            if abs(change) < 1e-12:
                break
        return log_scale

    def _dof_and_rss(self, log_scale: float, ratios: Variances) -> tuple[float, float]:
        joint_triangle, data_triangle = self._joint_triangle(log_scale, ratios)
        if len(self.prior) == 0:
            return self.n_rows - data_triangle.shape[1] + 1.0, float(data_triangle[-1, -1]) ** 2
        inverse = np.linalg.inv(joint_triangle[:-1, :-1])
        leverage = data_triangle[:, :-1] @ inverse
        residual = data_triangle[:, -1] - leverage @ joint_triangle[:-1, -1]
        return self.n_rows - float(np.sum(leverage**2)), float(residual @ residual)

    def _joint_triangle(self, log_scale: float, ratios: Variances) -> tuple[Array, Array]:
        """Return the triangle of [unknowns | observations] with and without the priors."""
        data_triangle = self._triangular_factor(ratios)[0] * math.exp(-log_scale / 2)
        return (
            triangular_factor(np.vstack([data_triangle, self.prior]))
            if len(self.prior)
            else data_triangle
        ), data_triangle

    def _triangular_factor(self, ratios: Variances) -> tuple[Array, float]:
        """Return the triangle of the whitened rows at unit scale, and the log-determinant."""
        if ratios not in self.triangles:
            n_columns = self.prior.shape[1]
            log_det, triangles = 0.0, [np.zeros((n_columns, n_columns))]
            for record, indices in zip(self.records, self.column_indices, strict=True):
                rows, record_log_det = record.whitened(ratios)
                log_det += record_log_det
                # The triangle of all records is computed at the end.
                triangle = qr_blocks(rows)
                triangle = triangular_factor(triangle) if len(self.records) > 1 else triangle
                stacked_rows = np.zeros((triangle.shape[0], n_columns))
                stacked_rows[:, np.append(indices, n_columns - 1)] = triangle
                triangles.append(stacked_rows)
            self.triangles[ratios] = triangular_factor(np.vstack(triangles)), log_det
        return self.triangles[ratios]
