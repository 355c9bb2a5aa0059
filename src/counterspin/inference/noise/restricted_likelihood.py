"""The restricted likelihood of a noise model: what records say of it, whatever the unknowns are.

Differencing removes start offset and velocity, whitening for a trial ratio of walk to white noise
and one QR leave a triangle that serves every noise level (Patterson and Thompson, Biometrika 58
(1971) 545; Harville, JASA 72 (1977) 320).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from counterspin.arrays import Array, triangle_of
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.noise.model import Differences, solve_banded_factor
from counterspin.inference.noise.wander import Levels, LowRank

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
    #: (n,) or a number: white variance of each row's samples over that which is estimated.
    shares: float | Array = 1.0


class Ratios(NamedTuple):
    """Variances over that of the white noise: N^2, B^2 and K^2 of a wandering bias."""

    walk: float
    flicker: float
    bias_walk: float


@dataclass
class RestrictedLikelihood:
    """The restricted likelihood of (log scale, ratio) of records and priors.

    The noise of all rows is exp(log scale) (white + ratio x walk), or the walk alone where the
    ratio is infinite. Where the bias wanders, `Ratios` stand in place of the ratio. Whitened rows
    are reduced to a triangle that is kept for each ratio.
    """

    differences: list[Differences]
    stacks: list[Array]  # differenced [design | observations] of each record
    places: list[NDArray[np.intp]]  # of each stack's columns but the last among all unknowns
    prior: Array  # [rows | values]
    orders: list[int]
    before: list[float]
    shares: list[float | Array]
    triangles: dict[float | Ratios, tuple[Array, float]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        records: Sequence[RecordData],
        prior_rows: ArrayLike | None,
        prior_values: ArrayLike | None,
    ) -> RestrictedLikelihood:
        """Difference the records; arguments and errors as in `variance_components.estimate`."""
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
            [record.shares for record in records],
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

        joined = np.vstack([self._triangle(0.0)[0], self.prior])[:, :-1]
        scaled = joined / np.linalg.norm(joined, axis=0)
        factor, order = qr(scaled, mode="r", pivoting=True)
        return np.sort(order[: factor.shape[0]][np.abs(np.diagonal(factor)) > 1e-11])

    @property
    def rows(self) -> int:
        """How many differenced rows there are."""
        return sum(d.rows for d in self.differences)

    @property
    def evaluations(self) -> int:
        """For how many ratios the rows were whitened."""
        return len(self.triangles)

    @property
    def log_ratios(self) -> Array:
        """Ratios from a walk that the longest record cannot show to one that hides white noise."""
        order = self.differences[0].order
        steps = np.concatenate([np.diff(d.blocks.time) for d in self.differences])
        counts = np.concatenate([d.blocks.count for d in self.differences])
        unit = 1 / (np.median(counts) * np.median(steps) ** (2 * order - 1))
        longest = max(d.rows for d in self.differences)
        low, high = math.log(0.1 * unit * longest ** (-2.0 * order)), math.log(1e4 * unit)
        return np.linspace(low, high, 3 + math.ceil((high - low) / math.log(1e4)))

    def value(self, log_scale: float, ratio: float | Ratios) -> float:
        """Restricted log-likelihood, but for a constant of the records."""
        joined, _ = self._joined(log_scale, ratio)
        log_det = self._triangle(ratio)[1] + self.rows * log_scale
        log_information = 2 * float(np.log(np.abs(np.diagonal(joined)[:-1])).sum())
        return -(log_det + log_information + float(joined[-1, -1]) ** 2) / 2

    def slope(self, log_scale: float, ratio: float | Ratios) -> float:
        """Differentiate `value` by the log scale."""
        freedom, rss = self._freedom_and_rss(log_scale, ratio)
        return (rss - freedom) / 2

    def freedom(self, log_scale: float, ratio: float | Ratios) -> float:
        """Rows less the unknowns that the rows themselves determine."""
        return self._freedom_and_rss(log_scale, ratio)[0]

    def best_scale(self, ratio: float | Ratios) -> float:
        """Log scale at which `slope` is zero."""
        values = self._triangle(ratio)[0][:, -1]
        left = self.rows - self.prior.shape[1] + 1
        # Where unknowns can follow all rows, only their priors leave anything: from above.
        rss = float(values[-1]) ** 2 if left > 0 else float(values @ values)
        if rss == 0:
            raise NotIdentifiableError(
                "the residuals are all zero, so no noise can be estimated; state the noise"
            )
        log_scale = math.log(rss / (left if left > 0 else self.rows))
        for _ in range(100 if len(self.prior) else 0):
            freedom, scaled = self._freedom_and_rss(log_scale, ratio)
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

    def _freedom_and_rss(self, log_scale: float, ratio: float | Ratios) -> tuple[float, float]:
        joined, data = self._joined(log_scale, ratio)
        if len(self.prior) == 0:
            return self.rows - data.shape[1] + 1.0, float(data[-1, -1]) ** 2
        inverse = np.linalg.inv(joined[:-1, :-1])
        leverage = data[:, :-1] @ inverse
        residual = data[:, -1] - leverage @ joined[:-1, -1]
        return self.rows - float(np.sum(leverage**2)), float(residual @ residual)

    def _joined(self, log_scale: float, ratio: float | Ratios) -> tuple[Array, Array]:
        """Triangle of [unknowns | observations] with and without the priors' rows."""
        data = self._triangle(ratio)[0] * math.exp(-log_scale / 2)
        return (triangle_of(np.vstack([data, self.prior])) if len(self.prior) else data), data

    def _whitened(self, index: int, ratio: float | Ratios) -> tuple[Array, float]:
        """Return a record's whitened rows at unit scale, and the log-determinant of their noise."""
        differences, stack = self.differences[index], self.stacks[index]
        share = self.shares[index]
        if not isinstance(ratio, Ratios):
            scales = (0.0, 1.0) if math.isinf(ratio) else (share, ratio)
            bands, log_det = differences.factor(*scales)
            return solve_banded_factor(bands, stack), log_det
        bands, log_det = differences.factor(share, ratio.walk)
        shown = differences.wander(self.orders[index], Levels(1.0, *ratio), self.before[index])
        wander = LowRank.of(solve_banded_factor(bands, shown))
        return wander.apply(solve_banded_factor(bands, stack)), log_det + wander.log_det

    def _triangle(self, ratio: float | Ratios) -> tuple[Array, float]:
        """Triangle of the whitened rows at unit scale, and the log-determinant of their noise."""
        if ratio not in self.triangles:
            width = self.prior.shape[1]
            log_det, parts = 0.0, [np.zeros((width, width))]
            for index, place in enumerate(self.places):
                rows, part = self._whitened(index, ratio)
                log_det += part
                own = triangle_of(rows)
                whole = np.zeros((own.shape[0], width))
                whole[:, np.append(place, width - 1)] = own
                parts.append(whole)
            self.triangles[ratio] = triangle_of(np.vstack(parts)), log_det
        return self.triangles[ratio]
