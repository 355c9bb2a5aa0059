"""Designs of a campaign: runs, their limits, their cost, and the criterion to minimise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, Literal, NamedTuple

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen

#: Minimum ratio of distinct rates; rate settings only need to differ.
_DISTINCT_RATE_RATIO: Final = 1.25

#: Relative tolerance of that ratio, for rounded rates.
_RATE_TOLERANCE: Final = 1e-4

#: Relative tolerance of all limits.
_LIMIT_TOLERANCE: Final = 1e-6


class RunType(NamedTuple):
    """Attitude and sense of the spin (+1, -1) of a run."""

    attitude: str
    sense: int


@frozen(eq=False)
class Design:
    """Runs of a campaign."""

    types: tuple[RunType, ...]  #: Type of each run.
    rate: Array  #: Magnitude of each rate, rad/s, shape (n,).
    revolutions: Array  #: Revolutions of each run, shape (n,).

    @property
    def duration(self) -> Array:
        """Duration of each record, s, shape (n,)."""
        return np.asarray(2.0 * math.pi * self.revolutions / self.rate)

    def without(self, index: int) -> Design:
        """Return the design without one run."""
        types = self.types[:index] + self.types[index + 1 :]
        return Design(types, np.delete(self.rate, index), np.delete(self.revolutions, index))

    def select(self, indices: Sequence[int]) -> Design:
        """Return the design with the runs at `indices`, in that order."""
        types, index = tuple(self.types[i] for i in indices), list(indices)
        return Design(types, self.rate[index], self.revolutions[index])

    def with_type(self, index: int, run_type: RunType) -> Design:
        """Return the design with one run in another attitude or sense."""
        types = (*self.types[:index], run_type, *self.types[index + 1 :])
        return Design(types, self.rate, self.revolutions)

    def concatenate(self, other: Design) -> Design:
        """Return the runs of both designs."""
        return Design(
            self.types + other.types,
            np.concatenate([self.rate, other.rate]),
            np.concatenate([self.revolutions, other.revolutions]),
        )


@frozen
class Limits:
    """Limits of a campaign: attitudes, senses, rates, times and number of runs."""

    types: tuple[RunType, ...]  #: Available attitudes and senses.
    rate_range: tuple[float, float]  #: Lowest and highest rate (magnitudes), rad/s.
    rate_settings: tuple[float, ...]  #: Available rates, rad/s; empty: any rate in the range.
    total_time: float  #: Time of the campaign, s: records, spin-up, settling, attitude changes.
    settling: float  #: Settling time of each run, s.
    spin_up: float  #: Time of spin-up and spin-down per unit of rate, s/(rad/s).
    attitude_change: float  #: Time to change the attitude, s.
    min_revolutions: float  #: Minimum number of revolutions of a run.
    max_duration: float  #: Maximum duration of a record, s.
    max_runs: int  #: Maximum number of runs.
    min_rates: int = 1  #: Minimum number of distinct rates.

    def overhead(self, rate: Array) -> Array:
        """Return the time of spin-up, settling and spin-down at each rate, s."""
        return self.settling + self.spin_up * rate

    def campaign_time(self, design: Design) -> float:
        """Return the total time of a campaign, s."""
        n_attitudes = len({run_type.attitude for run_type in design.types})
        return (
            float(np.sum(design.duration + self.overhead(design.rate)))
            + max(0, n_attitudes - 1) * self.attitude_change
        )

    def nearest_rates(self, rates: Array) -> Array:
        """Return the available rates nearest to `rates`, rad/s, shape (n,)."""
        if not self.rate_settings:
            return np.clip(rates, *self.rate_range)
        rate_settings = np.array(self.rate_settings)
        log_ratios: Array = np.abs(np.log(rates[:, None] / rate_settings))
        nearest_settings: Array = rate_settings[np.argmin(log_ratios, axis=1)]
        return nearest_settings

    def contains(self, design: Design) -> bool:
        """Check that a campaign is within all limits, except for rounding."""
        return bool(
            set(design.types) <= set(self.types)
            and len(design.types) <= self.max_runs
            and np.allclose(
                self.nearest_rates(design.rate), design.rate, rtol=_LIMIT_TOLERANCE, atol=0.0
            )
            and np.all(design.revolutions > self.min_revolutions * (1.0 - _LIMIT_TOLERANCE))
            and np.all(design.duration < self.max_duration * (1.0 + _LIMIT_TOLERANCE))
            and self.campaign_time(design) < self.total_time * (1.0 + _LIMIT_TOLERANCE)
            and len(self.distinct_rate_runs(design.rate)) >= self.min_rates
        )

    @property
    def min_time(self) -> float:
        """Minimum time for one run at each required rate, s."""
        rates = np.array(self.rate_settings or self.rate_range)
        times = np.sort(self.min_revolutions * 2.0 * math.pi / rates + self.overhead(rates))
        if self.min_rates > 1:
            rates = np.array(self.distinct_rates(self.rate_range[1]))
            times = self.min_revolutions * 2.0 * math.pi / rates + self.overhead(rates)
        return float(np.sum(times[: self.min_rates]))

    @property
    def is_feasible(self) -> bool:
        """True if any campaign is within the limits."""
        return (
            self.max_runs >= self.min_rates
            and len(self.distinct_rates(self.rate_range[1])) >= self.min_rates
            and self.total_time >= self.min_time
        )

    @property
    def min_rate_ratio(self) -> float:
        """Minimum ratio of each distinct rate to the next lower one."""
        return 1.0 if self.rate_settings else _DISTINCT_RATE_RATIO

    def distinct_rates(self, highest_rate: float) -> list[float]:
        """Return the required number of distinct rates in descending order, rad/s.

        Return fewer rates if the next rate would be below the lowest rate.
        """
        if self.rate_settings:
            lower_settings = [
                rate for rate in self.rate_settings if rate <= highest_rate * (1.0 + 1e-9)
            ]
            higher_settings = [rate for rate in self.rate_settings if rate not in lower_settings]
            return [*reversed(lower_settings), *higher_settings][: self.min_rates]
        rates = [highest_rate / self.min_rate_ratio**step for step in range(self.min_rates)]
        return [rate for rate in rates if rate >= self.rate_range[0] * (1.0 - 1e-9)]

    def distinct_rate_runs(self, rate: Array) -> list[int]:
        """Return indices of runs at distinct rates, fastest first, at most the required number.

        rate: Rates of the runs, rad/s, shape (n,).
        """
        indices: list[int] = []
        for index in np.argsort(-rate, kind="stable"):
            max_rate = math.inf if not indices else float(rate[indices[-1]]) / self.min_rate_ratio
            # Settings may have any ratio; other rates need the least ratio, except for rounding.
            max_rate *= 1.0 - 1e-9 if self.rate_settings else 1.0 + _RATE_TOLERANCE
            if len(indices) < self.min_rates and rate[index] <= max_rate:
                indices.append(int(index))
        return indices


@frozen
class Criterion:
    """The criterion that a plan minimises."""

    indices: tuple[int, ...]  #: Indices of the parameters of interest among the shared unknowns.
    scales: tuple[float, ...]  #: u that counts as 1, for each parameter.
    #: ``sum``: the root mean square of u/scale (c-optimality for one unknown, else A);
    #: ``determinant``: the volume of the ellipsoid of uncertainty (D).
    combination: Literal["sum", "determinant"] = "sum"

    def value(self, covariance: Array) -> Array:
        """Return the logarithm of u/scale (mean in the criterion's sense), shape (...,)."""
        scaled_covariance = self._scaled_covariance(covariance)
        count = len(self.indices)
        if self.combination == "sum":
            trace = np.trace(scaled_covariance, axis1=-2, axis2=-1)
            return np.asarray(0.5 * np.log(trace / count))
        return np.asarray(0.5 / count * np.linalg.slogdet(scaled_covariance)[1])

    def directions(self, covariance: Array) -> Array:
        """Return vectors c with d(value) = sum of c' d(covariance) c, shape (p, k)."""
        scaled_covariance = self._scaled_covariance(covariance)
        count = len(self.indices)
        if self.combination == "sum":
            scaled_directions = np.eye(count) / math.sqrt(2.0 * float(np.trace(scaled_covariance)))
        else:
            scaled_directions = np.linalg.cholesky(np.linalg.inv(scaled_covariance)) / math.sqrt(
                2.0 * count
            )
        directions = np.zeros((covariance.shape[-1], count))
        directions[list(self.indices)] = scaled_directions / np.array(self.scales)[:, None]
        return directions

    def _scaled_covariance(self, covariance: Array) -> Array:
        index = list(self.indices)
        scale = np.array(self.scales)
        block = covariance[..., index, :][..., :, index]
        return np.asarray(block / np.outer(scale, scale))


def measurement_order(types: Sequence[RunType]) -> list[int]:
    """Return the indices of runs in the order in which to make them.

    Complete one attitude before the next, and alternate the senses in each attitude, so that
    drift is not confounded with the sense of rotation.
    """
    order: list[int] = []
    for attitude in dict.fromkeys(run_type.attitude for run_type in types):
        runs_by_sense = [
            [i for i, run_type in enumerate(types) if run_type == (attitude, sense)]
            for sense in (1, -1)
        ]
        majority, minority = sorted(runs_by_sense, key=len, reverse=True)
        for i, index in enumerate(majority):
            order.append(index)
            order += minority[i : i + 1]
    return order


def fit_to_limits(design: Design, limits: Limits) -> Design | None:
    """Return the design if it is within the limits, else a similar design that is, or None.

    Keep the longest runs, each at the nearest available rate, and scale the durations to the total
    time. Return None if no such design exists, or a type of run is not available.
    """
    if limits.contains(design):
        return design
    if not set(design.types) <= set(limits.types):
        return None
    indices = np.sort(np.argsort(-design.duration, kind="stable")[: limits.max_runs])
    rate = limits.nearest_rates(design.rate[indices])
    types = tuple(design.types[index] for index in indices)
    duration = design.duration[indices]
    scaled_design = scale_to_time(Design(types, rate, duration * rate / (2.0 * math.pi)), limits)
    return scaled_design if scaled_design is not None and limits.contains(scaled_design) else None


def scale_to_time(design: Design, limits: Limits) -> Design | None:
    """Return the design with its durations scaled to the total time; None if it cannot fit."""
    separated_design = _separate_rates(design, limits)
    if separated_design is None:
        return None
    design = separated_design
    overhead_time = float(np.sum(limits.overhead(design.rate)))
    change_time = limits.campaign_time(design) - float(np.sum(design.duration)) - overhead_time
    record_time = limits.total_time - overhead_time - change_time
    min_durations = limits.min_revolutions * 2.0 * math.pi / design.rate
    spare_time = record_time - float(min_durations.sum())
    if spare_time < -1e-9 * limits.total_time:
        return None
    excess_durations = np.clip(design.duration, min_durations, limits.max_duration) - min_durations
    excess_sum = float(excess_durations.sum())
    scale = max(0.0, spare_time) / excess_sum if excess_sum > 0.0 else 0.0
    duration = np.minimum(
        min_durations + scale * excess_durations, np.maximum(limits.max_duration, min_durations)
    )
    return replace(design, revolutions=duration * design.rate / (2.0 * math.pi))


def _separate_rates(design: Design, limits: Limits) -> Design | None:
    """Return the design, its slowest runs at further distinct rates if it has too few.

    Return None if the limits do not allow enough rates.
    """
    if len(limits.distinct_rate_runs(design.rate)) >= limits.min_rates:
        return design
    highest_rate = max(
        float(design.rate.max()),
        min(
            limits.rate_range[1],
            limits.rate_range[0] * limits.min_rate_ratio ** (limits.min_rates - 1),
        ),
    )
    rates = limits.distinct_rates(highest_rate)
    if len(rates) < limits.min_rates or limits.min_rates > limits.max_runs:
        return None
    while len(design.types) < limits.min_rates:
        design = design.concatenate(design.select([0]))
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
