"""Designs of a campaign: runs, their limits, their cost, and the criterion to minimise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, Literal, NamedTuple

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen

#: Rates count as different if one is this many times the other; settings always do.
_DIFFERENT_RATE_RATIO: Final = 1.25

#: Relative distance by which rounding may bring different rates nearer.
_ROUNDING: Final = 1e-4

#: Part by which a plan may be beyond a limit that it touches.
_TOUCHING: Final = 1e-6


class RunType(NamedTuple):
    """Attitude and sense of the spin (+1, -1) of a run."""

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

    def select(self, indices: Sequence[int]) -> Design:
        """Return the design with the runs at some places, in their order."""
        types, selected = tuple(self.types[i] for i in indices), list(indices)
        return Design(types, self.rate[selected], self.revolutions[selected])

    def with_type(self, index: int, new: RunType) -> Design:
        """Return the design with one run in another attitude or sense."""
        types = (*self.types[:index], new, *self.types[index + 1 :])
        return Design(types, self.rate, self.revolutions)

    def concatenate(self, addition: Design) -> Design:
        """Return the runs of both designs."""
        return Design(
            self.types + addition.types,
            np.concatenate([self.rate, addition.rate]),
            np.concatenate([self.revolutions, addition.revolutions]),
        )


@frozen
class Limits:
    """Limits of a campaign: available attitudes, senses, rates, times and numbers of runs."""

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
        """Return the time that runs take in addition to their records, s."""
        return self.settling + self.spin_up * rate

    def time(self, design: Design) -> float:
        """Return the total time of a campaign, s."""
        attitudes = len({run_type.attitude for run_type in design.types})
        return (
            float(np.sum(design.duration + self.overhead(design.rate)))
            + max(0, attitudes - 1) * self.attitude_change
        )

    def nearest(self, rate: Array) -> Array:
        """Return the available rates nearest to the given rates, shape (n,), rad/s."""
        if not self.settings:
            return np.clip(rate, *self.rate)
        settings = np.array(self.settings)
        ratio: Array = np.abs(np.log(rate[:, None] / settings))
        nearest: Array = settings[np.argmin(ratio, axis=1)]
        return nearest

    def contains(self, design: Design) -> bool:
        """Check that a campaign is within all limits, to rounding."""
        return bool(
            set(design.types) <= set(self.types)
            and len(design.types) <= self.runs
            and np.allclose(self.nearest(design.rate), design.rate, rtol=_TOUCHING, atol=0.0)
            and np.all(design.revolutions > self.revolutions * (1.0 - _TOUCHING))
            and np.all(design.duration < self.longest_run * (1.0 + _TOUCHING))
            and self.time(design) < self.total_time * (1.0 + _TOUCHING)
            and len(self.distinct_rate_runs(design.rate)) >= self.fewest_rates
        )

    @property
    def shortest_time(self) -> float:
        """The least time for one run at each required rate, s."""
        rates = np.array(self.settings or self.rate)
        times = np.sort(self.revolutions * 2.0 * math.pi / rates + self.overhead(rates))
        if self.fewest_rates > 1:
            rates = np.array(self.different_rates(self.rate[1]))
            times = self.revolutions * 2.0 * math.pi / rates + self.overhead(rates)
        return float(np.sum(times[: self.fewest_rates]))

    @property
    def is_feasible(self) -> bool:
        """True if any campaign is within the limits."""
        return (
            self.runs >= self.fewest_rates
            and len(self.different_rates(self.rate[1])) >= self.fewest_rates
            and self.total_time >= self.shortest_time
        )

    @property
    def min_rate_ratio(self) -> float:
        """Least ratio of each of the different rates to the next lower one."""
        return 1.0 if self.settings else _DIFFERENT_RATE_RATIO

    def different_rates(self, fastest: float) -> list[float]:
        """Return as many different rates as are required, from the fastest down, rad/s.

        Return fewer rates if the lowest rate is reached first.
        """
        if self.settings:
            below = [w for w in self.settings if w <= fastest * (1.0 + 1e-9)]
            others = [w for w in self.settings if w not in below]
            return [*reversed(below), *others][: self.fewest_rates]
        rates = [fastest / self.min_rate_ratio**step for step in range(self.fewest_rates)]
        return [w for w in rates if w >= self.rate[0] * (1.0 - 1e-9)]

    def distinct_rate_runs(self, rate: Array) -> list[int]:
        """Return indices of runs at different rates, fastest first, at most the required number.

        rate: Of the runs, shape (n,).
        """
        indices: list[int] = []
        for index in np.argsort(-rate, kind="stable"):
            limit = math.inf if not indices else float(rate[indices[-1]]) / self.min_rate_ratio
            # Settings may have any ratio; other rates need the least ratio, except for rounding.
            limit *= 1.0 - 1e-9 if self.settings else 1.0 + _ROUNDING
            if len(indices) < self.fewest_rates and rate[index] <= limit:
                indices.append(int(index))
        return indices


@frozen
class Criterion:
    """The criterion that a plan minimises."""

    indices: tuple[int, ...]  #: The unknowns of interest, among the shared ones.
    scales: tuple[float, ...]  #: The size of u that counts as 1, for each.
    #: ``sum``: the root mean square of u/scale (c-optimality for one unknown, else A);
    #: ``determinant``: the volume of the ellipsoid of uncertainty (D).
    combination: Literal["sum", "determinant"] = "sum"

    def value(self, covariance: Array) -> Array:
        """Return the logarithm of u/scale (mean in the criterion's sense), shape (...,)."""
        block = self._scaled_block(covariance)
        count = len(self.indices)
        if self.combination == "sum":
            trace = np.trace(block, axis1=-2, axis2=-1)
            return np.asarray(0.5 * np.log(trace / count))
        return np.asarray(0.5 / count * np.linalg.slogdet(block)[1])

    def directions(self, covariance: Array) -> Array:
        """Return vectors c with d(value) = sum of c' d(covariance) c, shape (p, k)."""
        block = self._scaled_block(covariance)
        count = len(self.indices)
        if self.combination == "sum":
            root = np.eye(count) / math.sqrt(2.0 * float(np.trace(block)))
        else:
            root = np.linalg.cholesky(np.linalg.inv(block)) / math.sqrt(2.0 * count)
        directions = np.zeros((covariance.shape[-1], count))
        directions[list(self.indices)] = root / np.array(self.scales)[:, None]
        return directions

    def _scaled_block(self, covariance: Array) -> Array:
        index = list(self.indices)
        scale = np.array(self.scales)
        block = covariance[..., index, :][..., :, index]
        return np.asarray(block / np.outer(scale, scale))


def measurement_order(types: Sequence[RunType]) -> list[int]:
    """Return the places of runs in the order in which to make them.

    Attitude after attitude, and inside it the senses in turn, so that slow changes
    with time are not confused with changes with the sense.
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


def fit_to_limits(design: Design, limits: Limits) -> Design | None:
    """Return the design if it is within the limits, else a similar design that is, or None.

    Its longest runs are kept, each at the nearest rate that there is, with the lengths scaled into
    the time. None: no such design exists, or it has types of run that are not available.
    """
    if limits.contains(design):
        return design
    if not set(design.types) <= set(limits.types):
        return None
    indices = np.sort(np.argsort(-design.duration, kind="stable")[: limits.runs])
    rate = limits.nearest(design.rate[indices])
    types = tuple(design.types[index] for index in indices)
    duration = design.duration[indices]
    fitted = scale_to_time(Design(types, rate, duration * rate / (2.0 * math.pi)), limits)
    return fitted if fitted is not None and limits.contains(fitted) else None


def scale_to_time(design: Design, limits: Limits) -> Design | None:
    """Return the design with its lengths scaled into the available time; None if none fits."""
    separated = _separate_rates(design, limits)
    if separated is None:
        return None
    design = separated
    fixed = float(np.sum(limits.overhead(design.rate)))
    change_time = limits.time(design) - float(np.sum(design.duration)) - fixed
    record_time = limits.total_time - fixed - change_time
    shortest = limits.revolutions * 2.0 * math.pi / design.rate
    spare_time = record_time - float(shortest.sum())
    if spare_time < -1e-9 * limits.total_time:
        return None
    excess = np.clip(design.duration, shortest, limits.longest_run) - shortest
    excess_sum = float(excess.sum())
    scale = max(0.0, spare_time) / excess_sum if excess_sum > 0.0 else 0.0
    duration = np.minimum(shortest + scale * excess, np.maximum(limits.longest_run, shortest))
    return replace(design, revolutions=duration * design.rate / (2.0 * math.pi))


def _separate_rates(design: Design, limits: Limits) -> Design | None:
    """Return the design with its slowest runs moved to separate rates, if it has too few rates.

    None if the limits do not allow it.
    """
    if len(limits.distinct_rate_runs(design.rate)) >= limits.fewest_rates:
        return design
    fastest = max(
        float(design.rate.max()),
        min(limits.rate[1], limits.rate[0] * limits.min_rate_ratio ** (limits.fewest_rates - 1)),
    )
    rates = limits.different_rates(fastest)
    if len(rates) < limits.fewest_rates or limits.fewest_rates > limits.runs:
        return None
    while len(design.types) < limits.fewest_rates:
        design = design.concatenate(
            Design(design.types[:1], design.rate[:1], design.revolutions[:1])
        )
    rate = design.rate.copy()
    order = np.argsort(-rate, kind="stable")
    rate[order[0]] = rates[0]
    rate[order[len(order) - len(rates) + 1 :]] = rates[1:]
    return Design(design.types, rate, design.duration * rate / (2.0 * math.pi))


def allow_both_senses(limits: Limits) -> Limits:
    """Return the limits with both senses of the spin allowed in every attitude."""
    attitudes = dict.fromkeys(run_type.attitude for run_type in limits.types)
    types = tuple(RunType(attitude, sense) for attitude in attitudes for sense in (1, -1))
    return replace(limits, types=types)
