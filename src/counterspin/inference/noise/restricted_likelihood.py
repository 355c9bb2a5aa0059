"""The restricted likelihood of a noise model: what records say of it, whatever the unknowns are.

Differencing removes start offset and velocity, whitening for trial ratios of the variances and one
QR leave a triangle that serves every scale of the noise (Patterson and Thompson, Biometrika 58
(1971) 545; Harville, JASA 72 (1977) 320).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from counterspin.arrays import Array, in_parts, triangle_of
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.noise.model import Differences, solve_banded_factor
from counterspin.inference.noise.wander import LowRank, Variances

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


@dataclass
class RestrictedLikelihood:
    """The restricted likelihood of noise of variances exp(log scale) x unit, and of priors.

    Whitened rows are reduced to a triangle that is kept for each unit. Where records have a known
    variance beside it, the unit is the noise itself, and the scale 1.
    """

    differences: list[Differences]
    stacks: list[Array]  # differenced [design | observations] of each record
    places: list[NDArray[np.intp]]  # of each stack's columns but the last among all unknowns
    prior: Array  # [rows | values]
    orders: list[int]
    before: list[float]
    added: list[float | Array]
    triangles: dict[Variances, tuple[Array, float]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        records: Sequence[RecordData],
        prior_rows: ArrayLike | None,
        prior_values: ArrayLike | None,
    ) -> RestrictedLikelihood:
        """Difference the records; arguments as of `search.find_noise`."""
        if not records:
            raise ValueError("noise cannot be estimated from no records")
        if len({record.order for record in records}) > 1:
            raise ValueError("records of different observables do not share noise components")
        differences = [Differences.of(r.times, r.order, r.count, r.spacing) for r in records]
        rows = [
            np.column_stack([np.asarray(r.design, float), np.asarray(r.observations, float)])
            for r in records
        ]
        stacks = [d.apply(stack) for d, stack in zip(differences, rows, strict=True)]
        places = [
            np.arange(stack.shape[1] - 1) if r.places is None else np.asarray(r.places, np.intp)
            for r, stack in zip(records, rows, strict=True)
        ]
        p = 1 + max((int(place.max()) for place in places if place.size), default=-1)
        known = np.zeros((0, p)) if prior_rows is None else np.asarray(prior_rows, float)
        values = np.zeros(len(known)) if prior_values is None else np.asarray(prior_values, float)
        likelihood = cls(
            differences,
            stacks,
            places,
            np.column_stack([known, values]),
            [record.order for record in records],
            [record.before for record in records],
            [record.added for record in records],
        )
        # What differencing leaves of a start error in the design is rounding, not an unknown.
        before, after = np.zeros(known.shape[1]), np.zeros(known.shape[1])
        for total, part in ((before, rows), (after, stacks)):
            for place, stack in zip(places, part, strict=True):
                total[place] += np.square(stack[:, :-1]).sum(axis=0)
        seen = (after > 1e-28 * before) | (known != 0).any(axis=0)
        likelihood._keep(np.flatnonzero(seen))
        likelihood._keep(likelihood._independent())
        unknowns = likelihood.prior.shape[1] - 1
        if likelihood.rows + len(known) <= unknowns:
            raise NotIdentifiableError(
                f"{likelihood.rows} differenced rows are too few to estimate noise beside "
                f"{unknowns} unknowns; state the noise, or give longer records"
            )
        return likelihood

    def _keep(self, unknowns: NDArray[np.intp]) -> None:
        renamed = np.full(self.prior.shape[1] - 1, -1)
        renamed[unknowns] = np.arange(unknowns.size)
        for index, (place, stack) in enumerate(zip(self.places, self.stacks, strict=True)):
            kept = renamed[place] >= 0
            self.places[index] = renamed[place[kept]]
            self.stacks[index] = np.asfortranarray(stack[:, np.append(kept, True)])
        self.prior = self.prior[:, np.append(unknowns, self.prior.shape[1] - 1)]
        self.triangles.clear()

    def _independent(self) -> NDArray[np.intp]:
        """Unknowns that span what can be told; the likelihood depends on their span only."""
        from scipy.linalg import qr

        joined = np.vstack([self._triangle(WHITE)[0], self.prior])[:, :-1]
        scaled = joined / np.linalg.norm(joined, axis=0)
        factor, order = qr(scaled, mode="r", pivoting=True)
        return np.sort(order[: factor.shape[0]][np.abs(np.diagonal(factor)) > 1e-11])

    @property
    def rows(self) -> int:
        """How many differenced rows there are."""
        return sum(d.rows for d in self.differences)

    @property
    def evaluations(self) -> int:
        """For how many units the rows were whitened."""
        return len(self.triangles)

    @property
    def least_walk(self) -> float:
        """Log of the ratio of N^2 to the white variance that the longest record cannot show."""
        order = self.orders[0]
        steps = np.concatenate([np.diff(d.blocks.time) for d in self.differences])
        counts = np.concatenate([d.blocks.count for d in self.differences])
        unit = 1 / (np.median(counts) * np.median(steps) ** (2 * order - 1))
        longest = max(d.rows for d in self.differences)
        return math.log(0.1 * unit * longest ** (-2.0 * order))

    @property
    def walk_range(self) -> float:
        """Over how much of the logarithm above that walk and white noise show beside each other."""
        return 2.0 * self.orders[0] * math.log(max(d.rows for d in self.differences))

    def without_added(self) -> RestrictedLikelihood:
        """Return the likelihood with all of the samples' white variance to be estimated."""
        if not any(map(np.any, self.added)):
            return self
        return replace(self, added=[0.0] * len(self.added), triangles={})

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

    def best_scale(self, unit: Variances) -> float:
        """Log scale at which `slope` is zero."""
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
                    f"the unknowns follow all of {self.rows} rows, so that no noise shows beside "
                    "them; state the noise, or give longer records"
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

    def _whitened(self, index: int, unit: Variances) -> tuple[Array, float]:
        """Return a record's whitened rows at unit scale, and the log-determinant of their noise."""
        differences, stack = self.differences[index], self.stacks[index]
        bands, log_det = differences.factor(unit[0] + self.added[index], unit[1])
        rows = solve_banded_factor(bands, stack)
        if not any(unit[2:]):
            return rows, log_det
        beside = float(unit[0] + np.mean(self.added[index]))
        shown, *_ = differences.wander(self.orders[index], (beside, *unit[1:]), self.before[index])
        wander = LowRank.of(solve_banded_factor(bands, shown))
        return wander.apply(rows), log_det + wander.log_det

    def _triangle(self, unit: Variances) -> tuple[Array, float]:
        """Triangle of the whitened rows at unit scale, and the log-determinant of their noise."""
        if unit not in self.triangles:
            width = self.prior.shape[1]
            log_det, parts = 0.0, [np.zeros((width, width))]
            for index, place in enumerate(self.places):
                rows, part = self._whitened(index, unit)
                log_det += part
                own = triangle_of(in_parts(rows))
                whole = np.zeros((own.shape[0], width))
                whole[:, np.append(place, width - 1)] = own
                parts.append(whole)
            self.triangles[unit] = triangle_of(np.vstack(parts)), log_det
        return self.triangles[unit]
