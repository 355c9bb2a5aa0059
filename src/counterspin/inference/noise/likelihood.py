"""The restricted likelihood of a noise model: what records say of it, whatever the unknowns are.

Differencing removes start offset and velocity, whitening for trial ratios of the variances and one
QR leave a triangle that serves every scale of the noise (Patterson and Thompson, Biometrika 58
(1971) 545; Harville, JASA 72 (1977) 320).

Wherever a bias wanders, its cosines (`counterspin.inference.noise.wander`) and the record's own
columns are reduced to one triangle, once for each ratio of the noise beside the wander. Trial sizes
of the wander then cost what the triangle's few hundred rows cost, however long the record is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from counterspin.arrays import Array, in_parts, median, triangle_of
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.noise.even import EvenData, EvenRecord
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

#: White noise alone.
WHITE: Final = (1.0, 0.0, 0.0, 0.0)

#: Rows less what the unknowns follow of them, below which rounding is all that is left.
_LEAST_FREEDOM: Final = 1e-9


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
        """True if its white noise is not proportional to the other white noise of a sample."""
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


@dataclass
class RestrictedLikelihood:
    """The restricted likelihood of noise of variances exp(log scale) x unit, and of priors.

    Whitened rows are reduced to a triangle that is kept for each unit. Where records have a known
    variance beside it, the unit is the noise itself, and the scale 1.
    """

    records: list[DifferencedRecord | EvenRecord]
    places: list[NDArray[np.intp]]  # of each record's columns among all unknowns
    prior: Array  # [rows | values]
    triangles: dict[Variances, tuple[Array, float]] = field(default_factory=dict)
    scales: dict[Variances, float] = field(default_factory=dict)  # the best of each unit

    @classmethod
    def of(
        cls,
        records: Sequence[RecordData | EvenData],
        prior_rows: ArrayLike | None,
        prior_values: ArrayLike | None,
    ) -> RestrictedLikelihood:
        """Difference the records; arguments as of `search.find_noise`."""
        if not records:
            raise ValueError("noise cannot be estimated from no records")
        rows = [np.asarray(r.design, float) for r in records]
        reduced = [r.reduced() for r in records]
        if len({record.order for record in reduced}) > 1:
            raise ValueError("records of different observables do not share noise components")
        places = [
            np.arange(design.shape[1]) if r.places is None else np.asarray(r.places, np.intp)
            for r, design in zip(records, rows, strict=True)
        ]
        p = 1 + max((int(place.max()) for place in places if place.size), default=-1)
        known = np.zeros((0, p)) if prior_rows is None else np.asarray(prior_rows, float)
        values = np.zeros(len(known)) if prior_values is None else np.asarray(prior_values, float)
        likelihood = cls(reduced, places, np.column_stack([known, values]))
        # What differencing leaves of a start error in the design is rounding, not an unknown.
        before, after = np.zeros(known.shape[1]), np.zeros(known.shape[1])
        for total, part in ((before, rows), (after, [one.stack[:, :-1] for one in reduced])):
            for place, design in zip(places, part, strict=True):
                total[place] += np.square(design).sum(axis=0)
        seen = (after > 1e-28 * before) | (known != 0).any(axis=0)
        likelihood._keep(np.flatnonzero(seen))
        likelihood._keep(likelihood._independent())
        unknowns = likelihood.prior.shape[1] - 1
        if likelihood.rows + len(known) <= unknowns:
            raise NotIdentifiableError(
                f"{likelihood.rows} differenced rows are too few to estimate noise "
                f"together with {unknowns} unknowns; state the noise, or give longer records"
            )
        return likelihood

    def _keep(self, unknowns: NDArray[np.intp]) -> None:
        renamed = np.full(self.prior.shape[1] - 1, -1)
        renamed[unknowns] = np.arange(unknowns.size)
        for index, place in enumerate(self.places):
            kept = renamed[place] >= 0
            self.places[index] = renamed[place[kept]]
            self.records[index] = self.records[index].with_columns(kept)
        self.prior = self.prior[:, np.append(unknowns, self.prior.shape[1] - 1)]
        self.triangles.clear()
        self.scales.clear()

    def _independent(self) -> NDArray[np.intp]:
        """Unknowns that span what can be told; the likelihood depends on their span only."""
        from scipy.linalg import qr

        joined = np.vstack([self._triangle(WHITE)[0], self.prior])[:, :-1]
        scaled = joined / np.linalg.norm(joined, axis=0)
        factor, order = qr(scaled, mode="r", pivoting=True)
        return np.sort(order[: factor.shape[0]][np.abs(np.diagonal(factor)) > 1e-11])

    @property
    def rows(self) -> int:
        """Number of differenced rows."""
        return sum(record.rows for record in self.records)

    @property
    def evaluations(self) -> int:
        """For how many units the rows were whitened."""
        return len(self.triangles)

    @property
    def order(self) -> int:
        """Number of times that the observable integrates acceleration."""
        return self.records[0].order

    @property
    def length(self) -> float:
        """Of the longest record, s."""
        return max(record.length for record in self.records)

    @property
    def added(self) -> list[float | Array]:
        """Known white variance of each record, in addition to the estimated variance."""
        return [record.added for record in self.records]

    @property
    def least_walk(self) -> float:
        """Log of the ratio of N^2 to the white variance that the longest record cannot show."""
        steps, counts = map(
            np.concatenate, zip(*(record.row_steps for record in self.records), strict=True)
        )
        unit = 1 / (median(counts) * median(steps) ** (2 * self.order - 1))
        return math.log(0.1 * unit * self._longest ** (-2.0 * self.order))

    @property
    def walk_range(self) -> float:
        """Over how much of the logarithm above that walk and white noise show beside each other."""
        return 2.0 * self.order * math.log(self._longest)

    @property
    def _longest(self) -> int:
        return max(record.rows for record in self.records)

    def without_added(self) -> RestrictedLikelihood:
        """Return the likelihood with all of the samples' white variance to be estimated."""
        if not any(map(np.any, self.added)):
            return self
        records = [record.without_added() for record in self.records]
        return replace(self, records=records, triangles={}, scales={})

    def value(self, log_scale: float, unit: Variances) -> float:
        """Restricted log-likelihood, but for a constant of the records."""
        joined, _ = self._joined(log_scale, unit)
        log_det = self._triangle(unit)[1] + self.rows * log_scale
        log_information = 2 * float(np.log(np.abs(np.diagonal(joined)[:-1])).sum())
        return -(log_det + log_information + float(joined[-1, -1]) ** 2) / 2

    def slope(self, log_scale: float, unit: Variances) -> float:
        """Differentiate `value` by the log scale."""
        freedom, rss = self._freedom_and_rss(log_scale, unit)
        return (rss - freedom) / 2

    def freedom(self, log_scale: float, unit: Variances) -> float:
        """Rows less the unknowns that the rows themselves determine."""
        return self._freedom_and_rss(log_scale, unit)[0]

    def estimate(self, log_scale: float, unit: Variances) -> tuple[Array, Array]:
        """Return the unknowns at a noise, those kept in their order, and their covariance."""
        joined, _ = self._joined(log_scale, unit)
        inverse = np.linalg.inv(joined[:-1, :-1])
        return inverse @ joined[:-1, -1], inverse @ inverse.T

    def best_scale(self, unit: Variances) -> float:
        """Log scale at which `slope` is zero."""
        if unit not in self.scales:
            self.scales[unit] = self._best_scale(unit)
        return self.scales[unit]

    def _best_scale(self, unit: Variances) -> float:
        values = self._triangle(unit)[0][:, -1]
        left = self.rows - self.prior.shape[1] + 1
        # Where unknowns can follow all rows, only their priors leave anything: from above.
        rss = float(values[-1]) ** 2 if left > 0 else float(values @ values)
        if rss == 0:
            raise NotIdentifiableError(
                "the residuals are all zero, so no noise can be estimated; state the noise"
            )
        log_scale = math.log(rss / (left if left > 0 else self.rows))
        for _ in range(100 if len(self.prior) else 0):
            freedom, scaled = self._freedom_and_rss(log_scale, unit)
            if freedom <= _LEAST_FREEDOM * self.rows or scaled <= 0.0:
                raise NotIdentifiableError(
                    f"the unknowns fit all of {self.rows} rows exactly, so that no noise "
                    "can be estimated; state the noise, or give longer records"
                )
            change = math.log(scaled / freedom)
            log_scale += change
            if abs(change) < 1e-12:
                break
        return log_scale

    def _freedom_and_rss(self, log_scale: float, unit: Variances) -> tuple[float, float]:
        joined, data = self._joined(log_scale, unit)
        if len(self.prior) == 0:
            return self.rows - data.shape[1] + 1.0, float(data[-1, -1]) ** 2
        inverse = np.linalg.inv(joined[:-1, :-1])
        leverage = data[:, :-1] @ inverse
        residual = data[:, -1] - leverage @ joined[:-1, -1]
        return self.rows - float(np.sum(leverage**2)), float(residual @ residual)

    def _joined(self, log_scale: float, unit: Variances) -> tuple[Array, Array]:
        """Triangle of [unknowns | observations] with and without the priors' rows."""
        data = self._triangle(unit)[0] * math.exp(-log_scale / 2)
        return (triangle_of(np.vstack([data, self.prior])) if len(self.prior) else data), data

    def _triangle(self, unit: Variances) -> tuple[Array, float]:
        """Triangle of the whitened rows at unit scale, and the log-determinant of their noise."""
        if unit not in self.triangles:
            width = self.prior.shape[1]
            log_det, parts = 0.0, [np.zeros((width, width))]
            for record, place in zip(self.records, self.places, strict=True):
                rows, part = record.whitened(unit)
                log_det += part
                # The triangle of all, of one record or of many, is taken at the end.
                own = in_parts(rows)
                own = triangle_of(own) if len(self.records) > 1 else own
                whole = np.zeros((own.shape[0], width))
                whole[:, np.append(place, width - 1)] = own
                parts.append(whole)
            self.triangles[unit] = triangle_of(np.vstack(parts)), log_det
        return self.triangles[unit]
