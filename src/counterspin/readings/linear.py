"""Readings and poses linearised at an estimate, as observations of the joint fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final, Protocol

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import Observation, Unknown, Unknowns
from counterspin.inference.least_squares import Block, Solution, reduce_block
from counterspin.inference.noise.model import Noise
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.station import READING_LABELS

#: Smallest relative noise of a readout; a readout with 8.5 digits has ten times as much.
MIN_RELATIVE_NOISE: Final = 1e-9 / math.sqrt(12.0)


class ReadingGroup(Protocol):
    """A group of n readings, or of poses of a triad, with one kind of noise."""

    @property
    def accelerometer(self) -> str:
        """Name of the accelerometer; all names of a triad, joined."""

    @property
    def accelerometers(self) -> tuple[str, ...]:
        """Names of the accelerometers that were read."""

    @property
    def triad(self) -> tuple[str, ...]:
        """Names of the accelerometers of a triad whose attitudes are unknown; empty: no triad."""

    @property
    def motion(self) -> str:
        """Motion of every station; ``poses`` of poses."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the readings."""

    @property
    def size(self) -> int:
        """Number of readings."""

    @property
    def value(self) -> Array:
        """Indications, g, shape (n,) or (n, 3)."""

    @property
    def u(self) -> Array | None:
        """Stated standard uncertainties, g; None: estimated, common to all readings."""

    @property
    def time(self) -> Array:
        """Times from the beginning of the campaign, s, shape (n,)."""

    @property
    def repeats(self) -> Array:
        """Number of repeats at one setting, shape (n,)."""

    @property
    def scatter(self) -> Array:
        """Sum of squares of the repeats about their mean, g^2, shape (n,)."""

    @property
    def position(self) -> tuple[str, ...]:
        """Names of the positions whose positioning error is an unknown."""

    @property
    def noise_floor(self) -> float:
        """Smallest credible noise of a repeat, g."""

    @property
    def replicates(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the readings of each position with several readings."""

    @property
    def repeat_dof(self) -> float:
        """Degrees of freedom of repeats at one setting."""

    def linearize(
        self, model: Unknowns, estimate: Array, variance: Array | None = None
    ) -> LinearReadings:
        """Return the group linearised at an estimate; see `known_attitudes.linearize`."""

    def start(self, unknowns: Sequence[Unknown], point: Array) -> Array:
        """Return the start of the iteration, shape (p,)."""

    def without_positioning_errors(self) -> ReadingGroup:
        """Return the group without positioning errors."""

    def with_noise(self, noise: float) -> ReadingGroup:
        """Return the group with a stated noise of one repeat, g."""

    def with_rotated_mounting(
        self, name: str, rotate: Callable[[Mounting], Mounting]
    ) -> ReadingGroup:
        """Return the group with a rotated accelerometer."""

    def default_candidates(self, model: Unknowns) -> Sequence[Unknown]:
        """Return the requested parameters that the directions of poses may leave undetermined."""

    def find_undetermined(
        self, fit: JointFit, model: Unknowns, candidates: Sequence[Unknown]
    ) -> Sequence[Unknown]:
        """Return the candidates that the directions of poses do not determine.

        fit: Fit of the model with the default priors of all candidates.
        model: Model without these priors.
        """

    def curvature(self, model: Unknowns, estimate: Array, steps: Array) -> Array:
        """Return the second-order change of each row for steps of the unknowns, shape (n, m).

        steps: Steps of the unknowns from the estimate, shape (p, m).
        """

    def insufficient_noise_message(
        self, dof: float, n_free: int, solution: Solution, model: Unknowns
    ) -> str:
        """Return an error message if the residuals do not determine the noise, else ''.

        dof: Degrees of freedom of the residuals and of repeats.
        n_free: Number of unknowns that the group alone determines.
        """

    def divergence_message(self, n_iterations: int) -> str:
        """Return an error message on a fit that did not converge; empty: unknown cause."""


def noise_source(group: ReadingGroup) -> str:
    """Return the name of the noise of a group: accelerometer, motion and kind of noise."""
    suffix = "" if group.u is not None else " (estimated)"
    return f"{group.accelerometer}: {READING_LABELS[group.motion]}{suffix}"


@frozen
class LinearReadings(Observation):
    """Readings linearised at an estimate: target = design @ unknowns + fixed @ considered."""

    group: ReadingGroup
    target: Array  # (n,), g, readings minus the indications of a perfect system
    stated_sd: Array | None  # (n,), g, stated noise without the contributions in `other_sd`
    repeats: Array  # (n,), number of repeats
    other_sd: Array  # (n,), g, contribution of head, rates and squares of positioning errors
    sigma: Array  # (n,), g, total standard uncertainty
    rate_sd: Array | float = 0.0  # (n,), g, contribution of the rates in `other_sd`
    u_rate: Array | float = 0.0  # (n,), as in `Readings`
    default_rate: Array | float = 0.0  # (n,), as in `Readings`

    @property
    def source(self) -> str:
        """Name of the noise of the readings."""
        return noise_source(self.group)

    run = source

    @property
    def motion(self) -> str:
        """Motion of every station; ``poses`` of poses."""
        return self.group.motion

    @classmethod
    def from_columns(
        cls,
        group: ReadingGroup,
        model: Unknowns,
        columns: Array,
        target: Array,
        stated_sd: Array | None,
        repeats: Array,
        other_sd: Array,
    ) -> LinearReadings:
        """Make linear readings from the columns of unknowns and considered terms, (n, p + q)."""
        p, q = len(model.unknowns), len(model.considered)
        sigma = other_sd if stated_sd is None else np.hypot(stated_sd, other_sd)
        blocks = tuple(range(p)), columns[:, :p], tuple(range(q)), columns[:, p:]
        return cls(*blocks, group, target, stated_sd, repeats, other_sd, sigma)

    def with_noise(self, noise: float) -> LinearReadings:
        """Return the readings with a noise of one repeat, unless they state their noise."""
        noise_sd = noise / np.sqrt(self.repeats) if self.stated_sd is None else self.stated_sd
        return replace(self, sigma=np.hypot(noise_sd, self.other_sd))

    def block(self, noise: Mapping[str, Noise]) -> Block:
        """Return the square-root information with the noise of the source, unless it is stated."""
        model = noise.get(self.source)
        return (self if model is None else self.with_noise(model.white)).whitened_block()

    def whitened_block(self) -> Block:
        """Return the square-root information with the current noise."""
        weight = 1.0 / self.sigma[:, None]
        return reduce_block(
            self.design * weight, self.target / self.sigma, None, self.considered_design * weight
        )

    def gains(self, solution: Solution, weights: Array) -> Array:
        """Return the change of a combination of the unknowns per g in a reading, shape (n,)."""
        sensitivity = weights @ solution.weighted_covariance[:, list(self.unknowns)]
        gains: Array = (self.design @ sensitivity) / self.sigma**2
        return gains

    def rate_variances(self, solution: Solution, weights: Array) -> tuple[float, float]:
        """Return the variances of a combination due to random rate errors: stated, and default."""
        variances = (self.gains(solution, weights) * self.rate_sd) ** 2
        default_variance = float(np.sum(variances * self.default_rate))
        return float(np.sum(variances)) - default_variance, default_variance

    @property
    def rate_uncertainties(self) -> tuple[Array, Array]:
        """Relative standard uncertainties of the rates: stated, and default; else 0, shape (n,)."""
        is_default = np.broadcast_to(self.default_rate, self.target.shape)
        return self.u_rate * (is_default == 0.0), self.u_rate * is_default

    def residuals(self, solution: Solution, model: Unknowns) -> Array:
        """Return the residuals with considered terms at their assumed values, shape (n,)."""
        means = np.array([term.prior_mean for term in model.considered])
        residuals: Array = (
            self.residuals_at(solution.estimate)
            - self.considered_design @ means[list(self.considered)]
        )
        return residuals

    def residuals_at(self, estimate: Array) -> Array:
        """Return the residuals at an estimate with considered terms at zero, shape (n,)."""
        residuals: Array = self.target - self.design @ estimate[list(self.unknowns)]
        return residuals

    def chi2(self, solution: Solution, model: Unknowns) -> float:
        """Return chi-square of the residuals, with considered terms in their covariance.

        An error of a considered term within its u is no misfit: chi-square is the smallest sum of
        the squares of residuals and of considered terms over their u (Searle, Matrix Algebra Useful
        for Statistics, 1982, section 10.7).
        """
        residuals = self.residuals(solution, model) / self.sigma
        considered_columns = (
            self.considered_sensitivity(solution) / self.sigma[:, None] * model.considered_sds
        )
        coefficients = np.linalg.lstsq(
            np.vstack([considered_columns, np.eye(considered_columns.shape[1])]),
            np.append(residuals, np.zeros(considered_columns.shape[1])),
            rcond=None,
        )[0]
        remainder = residuals - considered_columns @ coefficients
        return float(remainder @ remainder + coefficients @ coefficients)

    def considered_sensitivity(self, solution: Solution) -> Array:
        """Return d(residuals)/d(considered terms), shape (n, q), except for the sign."""
        columns: Array = self.design @ solution.sensitivity_considered[list(self.unknowns)]
        columns[:, list(self.considered)] += self.considered_design
        return columns

    def covariance(self, solution: Solution) -> Array:
        """Return the weighted covariance of the unknowns of the readings."""
        covariance: Array = solution.weighted_covariance[np.ix_(self.unknowns, self.unknowns)]
        return covariance

    def leverages(self, solution: Solution) -> Array:
        """Return the leverage of each reading, from 0 to 1, shape (n,)."""
        rows = self.design / self.sigma[:, None]
        leverages: Array = np.sum((rows @ self.covariance(solution)) * rows, axis=1)
        clipped_leverages: Array = np.clip(leverages, 0.0, 1.0)
        return clipped_leverages

    def residual_dof(self, solution: Solution) -> float:
        """Return the number of readings minus their leverages."""
        return float(np.sum(1.0 - self.leverages(solution)))

    def noise_moments(self, solution: Solution) -> tuple[float, float]:
        """Return scale and degrees of freedom of the sum of squares due to noise alone.

        For noise e with unit variance, the residuals are R e with R = 1 - rows C rows'. Their sum
        of squares is distributed as scale times chi-square (Satterthwaite, Biometrics Bulletin 2
        (1946) 110), with the scale tr R^4 / tr R^2 and (tr R^2)^2 / tr R^4 degrees of freedom.
        Errors of the machine only increase it.
        """
        rows = self.design / self.sigma[:, None]
        hat_matrix = self.covariance(solution) @ (rows.T @ rows)
        squared_hat = hat_matrix @ hat_matrix
        # tr H^k of H = rows C rows' is that of the smaller matrix C rows' rows.
        trace_1, trace_2 = float(np.trace(hat_matrix)), float(np.trace(squared_hat))
        trace_3, trace_4 = (
            float(np.sum(squared_hat * hat_matrix.T)),
            float(np.sum(squared_hat * squared_hat.T)),
        )
        second_moment = len(rows) - 2.0 * trace_1 + trace_2
        fourth_moment = len(rows) - 4.0 * trace_1 + 6.0 * trace_2 - 4.0 * trace_3 + trace_4
        if not (second_moment > 1e-9 and fourth_moment > 1e-9):
            return 1.0, 0.0
        return fourth_moment / second_moment, second_moment**2 / fourth_moment

    def noise_dof(self, solution: Solution) -> float:
        """Return the degrees of freedom of the noise estimated from the residuals.

        They are twice the Fisher information of the log variance in the restricted likelihood
        (Searle, Casella and McCulloch, Variance Components, 1992, section 6.6). Without priors and
        without a head, this is the number of readings minus the number of unknowns.
        """
        rows, noise_share = self.design / self.sigma[:, None], self.noise_share
        weighted_hat = self.covariance(solution) @ (rows.T @ (noise_share[:, None] * rows))
        linear_part = float(noise_share**2 @ (1.0 - 2.0 * self.leverages(solution)))
        return linear_part + float(np.sum(weighted_hat * weighted_hat.T))

    @property
    def noise_share(self) -> Array:
        """Fraction of the noise in the variance of each reading, shape (n,)."""
        share: Array = 1.0 - (self.other_sd / self.sigma) ** 2
        return share


def blocks_at(readings: Sequence[ReadingGroup], model: Unknowns, estimate: Array) -> list[Block]:
    """Return the square-root information of readings with stated noise.

    estimate: Point of linearisation: unknowns minus nominal values, shape (p,).
    """
    return [group.linearize(model, estimate).whitened_block() for group in readings]


def rows_at(
    readings: Sequence[ReadingGroup], model: Unknowns, estimate: Array
) -> list[tuple[Array, Array]]:
    """Return the rows of `blocks_at`, reading by reading, with unit variance."""
    linear_groups = [group.linearize(model, estimate) for group in readings]
    return [
        (
            linear_group.design / linear_group.sigma[:, None],
            linear_group.considered_design / linear_group.sigma[:, None],
        )
        for linear_group in linear_groups
    ]
