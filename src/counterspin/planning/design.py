"""Designs of a campaign: runs, what they may be, what they cost, and how good they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from counterspin.arrays import Array, triangle_of
from counterspin.campaign.conditions import UNKNOWN_WARMING
from counterspin.frozen import frozen
from counterspin.inference.least_squares import REGULARISATION
from counterspin.planning.run_information import RunInformation

#: Rates count as different if one is this many times the other; settings always do.
_DIFFERENT_RATE_RATIO: Final = 1.25

#: Relative distance by which rounding may bring different rates nearer.
_ROUNDING: Final = 1e-4

#: Part by which a plan may be beyond a limit that it touches.
_TOUCHING: Final = 1e-6

#: Relative step of the derivatives of a run's information, by central differences.
_RELATIVE_STEP: Final = 1e-5


class RunType(NamedTuple):
    """What a run is besides its rate and length: attitude and sense of the spin (+1, -1)."""

    attitude: str
    sense: int


@frozen(eq=False)
class Design:
    """Runs of a campaign."""

    types: tuple[RunType, ...]  #: Of each run.
    rate: Array  #: Size of each rate, rad/s, shape (n,).
    revolutions: Array  #: Shape (n,).

    @property
    def duration(self) -> Array:
        """Length of each record, s, shape (n,)."""
        return np.asarray(2.0 * math.pi * self.revolutions / self.rate)

    def without(self, index: int) -> Design:
        """Return the design with one run left out."""
        types = self.types[:index] + self.types[index + 1 :]
        return Design(types, np.delete(self.rate, index), np.delete(self.revolutions, index))

    def taken(self, places: Sequence[int]) -> Design:
        """Return the design with the runs at some places, in their order."""
        types, chosen = tuple(self.types[i] for i in places), list(places)
        return Design(types, self.rate[chosen], self.revolutions[chosen])

    def with_type(self, index: int, new: RunType) -> Design:
        """Return the design with one run in another attitude or sense."""
        types = (*self.types[:index], new, *self.types[index + 1 :])
        return Design(types, self.rate, self.revolutions)

    def joined(self, other: Design) -> Design:
        """Return the runs of both."""
        return Design(
            self.types + other.types,
            np.concatenate([self.rate, other.rate]),
            np.concatenate([self.revolutions, other.revolutions]),
        )


@frozen
class Limits:
    """What a campaign may be."""

    types: tuple[RunType, ...]  #: Attitudes and senses available.
    rate: tuple[float, float]  #: Smallest and largest size of the rate, rad/s.
    settings: tuple[float, ...]  #: The sizes of rate available, rad/s; empty: all between.
    total_time: float  #: Of the campaign, s: records, spin-up and settling, changes of attitude.
    settling: float  #: Of each run, s.
    spin_up: float  #: Time that each run's start and end take for each rad/s, s/(rad/s).
    attitude_change: float  #: Time to change the attitude, s.
    revolutions: float  #: Fewest of a run.
    longest_run: float  #: Longest record, s.
    runs: int  #: Largest number.
    fewest_rates: int = 1  #: How many different rates the runs must have at least.

    def overhead(self, rate: Array) -> Array:
        """Return the time that runs take beside their records, s."""
        return self.settling + self.spin_up * rate

    def time(self, design: Design) -> float:
        """Return what a campaign takes, s."""
        attitudes = len({run_type.attitude for run_type in design.types})
        return (
            float(np.sum(design.duration + self.overhead(design.rate)))
            + max(0, attitudes - 1) * self.attitude_change
        )

    def nearest(self, rate: Array) -> Array:
        """Return the available rates that are nearest to some, shape (n,), rad/s."""
        if not self.settings:
            return np.clip(rate, *self.rate)
        settings = np.array(self.settings)
        ratio: Array = np.abs(np.log(rate[:, None] / settings))
        nearest: Array = settings[np.argmin(ratio, axis=1)]
        return nearest

    def hold(self, design: Design) -> bool:
        """Return whether a campaign is within all of them, to rounding."""
        return bool(
            set(design.types) <= set(self.types)
            and len(design.types) <= self.runs
            and np.allclose(self.nearest(design.rate), design.rate, rtol=_TOUCHING, atol=0.0)
            and np.all(design.revolutions > self.revolutions * (1.0 - _TOUCHING))
            and np.all(design.duration < self.longest_run * (1.0 + _TOUCHING))
            and self.time(design) < self.total_time * (1.0 + _TOUCHING)
            and len(self.runs_apart(design.rate)) >= self.fewest_rates
        )

    @property
    def shortest(self) -> float:
        """The least time in which runs can be made, one at each rate that there must be, s."""
        rates = np.array(self.settings or self.rate)
        times = np.sort(self.revolutions * 2.0 * math.pi / rates + self.overhead(rates))
        if self.fewest_rates > 1:
            rates = np.array(self.different_rates(self.rate[1]))
            times = self.revolutions * 2.0 * math.pi / rates + self.overhead(rates)
        return float(np.sum(times[: self.fewest_rates]))

    @property
    def possible(self) -> bool:
        """Whether there is any campaign within them."""
        return (
            self.runs >= self.fewest_rates
            and len(self.different_rates(self.rate[1])) >= self.fewest_rates
            and self.total_time >= self.shortest
        )

    @property
    def apart(self) -> float:
        """How many times the next lower one each of the different rates must be."""
        return 1.0 if self.settings else _DIFFERENT_RATE_RATIO

    def different_rates(self, fastest: float) -> list[float]:
        """Return as many different rates as there must be, from the fastest down, rad/s.

        Fewer if the lowest rate comes before.
        """
        if self.settings:
            below = [w for w in self.settings if w <= fastest * (1.0 + 1e-9)]
            others = [w for w in self.settings if w not in below]
            return [*reversed(below), *others][: self.fewest_rates]
        rates = [fastest / self.apart**step for step in range(self.fewest_rates)]
        return [w for w in rates if w >= self.rate[0] * (1.0 - 1e-9)]

    def runs_apart(self, rate: Array) -> list[int]:
        """Return runs at different rates, from the fastest down: as many as there must be at most.

        rate: Of the runs, shape (n,).
        """
        chosen: list[int] = []
        for index in np.argsort(-rate, kind="stable"):
            limit = math.inf if not chosen else float(rate[chosen[-1]]) / self.apart
            # Settings differ by what they differ; other rates by the ratio, but for rounding.
            limit *= 1.0 - 1e-9 if self.settings else 1.0 + _ROUNDING
            if len(chosen) < self.fewest_rates and rate[index] <= limit:
                chosen.append(int(index))
        return chosen


@frozen
class Criterion:
    """What is to be small."""

    places: tuple[int, ...]  #: The unknowns of interest, among the shared ones.
    scales: tuple[float, ...]  #: The size of u that counts as 1, for each.
    #: ``sum``: the root mean square of u/scale (c-optimality for one unknown, else A);
    #: ``determinant``: the volume of the ellipsoid of uncertainty (D).
    combination: Literal["sum", "determinant"] = "sum"

    def value(self, covariance: Array) -> Array:
        """Return the logarithm of u/scale (mean in the criterion's sense), shape (...,)."""
        inside = self._inside(covariance)
        count = len(self.places)
        if self.combination == "sum":
            trace = np.trace(inside, axis1=-2, axis2=-1)
            return np.asarray(0.5 * np.log(trace / count))
        return np.asarray(0.5 / count * np.linalg.slogdet(inside)[1])

    def directions(self, covariance: Array) -> Array:
        """Return vectors c with d(value) = sum of c' d(covariance) c, shape (p, k)."""
        inside = self._inside(covariance)
        count = len(self.places)
        if self.combination == "sum":
            root = np.eye(count) / math.sqrt(2.0 * float(np.trace(inside)))
        else:
            root = np.linalg.cholesky(np.linalg.inv(inside)) / math.sqrt(2.0 * count)
        full = np.zeros((covariance.shape[-1], count))
        full[list(self.places)] = root / np.array(self.scales)[:, None]
        return full

    def _inside(self, covariance: Array) -> Array:
        index = list(self.places)
        scale = np.array(self.scales)
        part = covariance[..., index, :][..., :, index]
        return np.asarray(part / np.outer(scale, scale))


def order_of(types: Sequence[RunType]) -> list[int]:
    """Return the places of runs in the order in which to make them.

    Attitude after attitude, and inside it the senses in turn, so that what changes slowly
    with time is not taken for what changes with the sense.
    """
    order: list[int] = []
    for attitude in dict.fromkeys(run_type.attitude for run_type in types):
        by_sense = [
            [i for i, run_type in enumerate(types) if run_type == (attitude, sense)]
            for sense in (1, -1)
        ]
        longer, shorter = sorted(by_sense, key=len, reverse=True)
        for i, index in enumerate(longer):
            order.append(index)
            order += shorter[i : i + 1]
    return order


def _conditions(types: Sequence[RunType], duration: Array) -> tuple[Array, Array]:
    """Return when runs begin and how warm they are then, as `conditions_of` takes it, (..., n).

    duration: s, shape (..., n).
    """
    order = order_of(types)
    start, warmth = np.empty_like(duration), np.zeros(len(order))
    start[..., order] = np.cumsum(duration[..., order], axis=-1) - duration[..., order]
    if len(order) > 1:
        warmth[order] = UNKNOWN_WARMING * np.linspace(-0.5, 0.5, len(order))
    return start, warmth


class Predictor:
    """Uncertainties that designs would have, by the same solve as a calibration's."""

    def __init__(self, information: RunInformation) -> None:
        self.information = information
        setup = information.setup
        shared = [setup.model.unknowns[i] for i in setup.shared]
        self.names = tuple(unknown.name for unknown in shared)
        sd = np.array([u.prior[1] for u in shared])
        limits = np.array([u.limit for u in shared])
        #: An unknown of which nothing is known is held as loosely as in the solution.
        self.prior = np.diag(1.0 / np.where(np.isfinite(sd), sd, REGULARISATION * limits))
        sizes = setup.considered_sizes
        self.common = sizes[list(setup.considered)]
        self.own = {name: sizes[list(setup.own(name)[1])] for name in setup.attitudes}

    @property
    def p(self) -> int:
        """How many unknowns all runs share."""
        return len(self.names)

    def covariance(
        self,
        types: Sequence[RunType],
        rate: Array,
        revolutions: Array,
        *,
        whole_samples: bool = False,
    ) -> Array:
        """Return the covariance of the shared unknowns for each of many designs.

        rate, revolutions: Shape (..., n).
        Returns: shape (..., p, p).
        """
        blocks = self.information.blocks(
            types,
            rate,
            revolutions,
            whole_samples=whole_samples,
            conditions=_conditions(types, 2.0 * math.pi * revolutions / rate),
        )
        return self._covariance(types, blocks)[0]

    def u(self, design: Design) -> Array:
        """Return the standard uncertainties of the shared unknowns, shape (p,).

        For the samples that records of these lengths have, while `covariance` is smooth in the
        lengths.
        """
        runs = (design.types, design.rate, design.revolutions)
        covariance = self.covariance(*runs, whole_samples=True)
        return np.asarray(np.sqrt(np.diag(covariance)))

    def value(self, criterion: Criterion, design: Design) -> float:
        """Return a criterion of a design, see `Criterion.value`."""
        covariance = self.covariance(design.types, design.rate, design.revolutions)
        return float(criterion.value(covariance))

    def _covariance(self, types: Sequence[RunType], blocks: Array) -> tuple[Array, Array, Array]:
        """Return covariance, its part without considered terms, and their spread (..., p, k)."""
        p = self.p
        lead = blocks.shape[:-3]
        rows = blocks[..., :p].reshape(*lead, -1, p)
        prior = np.broadcast_to(self.prior, (*lead, p, p))
        triangle = triangle_of(np.concatenate([rows, prior], axis=-2))
        root = np.linalg.inv(triangle)
        inner = np.asarray(root @ np.swapaxes(root, -1, -2), dtype=np.float64)
        if blocks.shape[-1] == p:
            return inner, inner, np.zeros((*lead, p, 0))
        moments = np.swapaxes(blocks[..., :p], -1, -2) @ self._sized(types, blocks)
        q = self.common.size
        common = moments[..., :q].sum(axis=-3)
        own = np.moveaxis(moments[..., q:], -3, -2)
        own = own.reshape(*lead, p, own.shape[-2] * own.shape[-1])
        columns = np.concatenate([common, own], axis=-1)
        spread: Array = -inner @ columns
        whole: Array = inner + spread @ np.swapaxes(spread, -1, -2)
        return whole, inner, spread

    def _sized(self, types: Sequence[RunType], blocks: Array) -> Array:
        """Return the considered columns of blocks, each times its standard uncertainty."""
        q = self.common.size
        columns = blocks[..., self.p :].copy()
        columns[..., :q] *= self.common
        for index, run_type in enumerate(types):
            own = self.own[run_type.attitude]
            columns[..., index, :, q : q + own.size] *= own
        return columns

    def sensitivities(self, design: Design, criterion: Criterion) -> tuple[float, Array, Array]:
        """Return a criterion and its derivatives by log rate and log revolutions of each run.

        The information of one run enters the covariance as P dM P, so that once P is known the
        derivatives need no other solution, only blocks a step aside.
        """
        up, down = 1.0 + _RELATIVE_STEP, 1.0 - _RELATIVE_STEP
        rate = np.array([[1.0], [up], [down], [1.0], [1.0]]) * design.rate
        turns = np.array([[1.0], [1.0], [1.0], [up], [down]]) * design.revolutions
        # When a run begins depends on those before it: so little that no derivative has it.
        when = _conditions(design.types, design.duration)
        blocks = self.information.blocks(design.types, rate, turns, conditions=when)
        covariance, inner, spread = self._covariance(design.types, blocks[0])
        value = float(criterion.value(covariance))
        c = criterion.directions(covariance)
        share = self._share(design.types, blocks, inner, spread, c)
        return (
            value,
            (share[1] - share[2]) / (2.0 * _RELATIVE_STEP),
            (share[3] - share[4]) / (2.0 * _RELATIVE_STEP),
        )

    def _share(
        self, types: Sequence[RunType], blocks: Array, inner: Array, spread: Array, c: Array
    ) -> Array:
        """Return for each run a quantity whose difference quotient is the criterion's derivative.

        With v = P c, s = spread' c and B the considered moments, d(c' S c) is
        -v' dM v - 2 s' (dB' v) - 2 s' B' dP c; shape (..., runs).
        """
        p = self.p
        v = inner @ c
        seen = blocks[..., :p] @ v
        share = -np.sum(seen**2, axis=(-2, -1))
        if spread.shape[-1] == 0:
            return np.asarray(share)
        s = spread.T @ c
        # d(spread' c) = -(dB)' v + B' P dM P c, and B' P is -spread'.
        towards = spread @ s
        share -= 2.0 * np.sum(seen * (blocks[..., :p] @ towards), axis=(-2, -1))
        columns = self._sized(types, blocks)
        q, n = self.common.size, len(types)
        width = columns.shape[-1] - q
        weights = np.zeros((n, q + width, c.shape[1]))
        weights[:, :q] = s[:q]
        weights[:, q:] = s[q:].reshape(n, width, c.shape[1])
        share -= 2.0 * np.sum(seen * (columns @ weights), axis=(-2, -1))
        return np.asarray(share)
