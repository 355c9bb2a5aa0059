"""Readings and poses linearised at an estimate: rows of square-root information, as for records."""

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
from counterspin.physics.station import READINGS

#: No readout resolves more of its range: one of 8.5 digits has ten times as much.
MIN_RELATIVE_NOISE: Final = 1e-9 / math.sqrt(12.0)


class ReadingGroup(Protocol):
    """A group of n readings, or of poses of a triad, with noise of one kind."""

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
        """Stated standard uncertainties, g; None: one for all, from the residuals."""

    @property
    def time(self) -> Array:
        """Times from the beginning of the campaign, s, shape (n,)."""

    @property
    def repeats(self) -> Array:
        """Number of repeats at one setting of each, shape (n,)."""

    @property
    def scatter(self) -> Array:
        """Sum of squares of the repeats about their mean, g^2, shape (n,)."""

    @property
    def position(self) -> tuple[str, ...]:
        """Names of the positions whose setting error is an unknown."""

    @property
    def noise_floor(self) -> float:
        """The least credible noise of one repeat, g."""

    @property
    def replicates(self) -> tuple[tuple[int, ...], ...]:
        """Places of the readings of each position that was read more than once."""

    @property
    def repeat_dof(self) -> float:
        """Degrees of freedom of repeats at one setting among themselves."""

    def linearize(
        self, model: Unknowns, estimate: Array, variance: Array | None = None
    ) -> LinearReadings:
        """Return the rows at an estimate; parameters as in `linearise`."""

    def start(self, unknowns: Sequence[Unknown], point: Array) -> Array:
        """Return the point at which to begin, shape (p,)."""

    def without_setting_errors(self) -> ReadingGroup:
        """Return the group without errors of setting its positions."""

    def with_noise(self, noise: float) -> ReadingGroup:
        """Return the group with a stated noise of one repeat, g."""

    def with_rotated_mounting(
        self, name: str, turn: Callable[[Mounting], Mounting]
    ) -> ReadingGroup:
        """Return the group with an accelerometer mounted otherwise."""

    def default_candidates(self, model: Unknowns) -> Sequence[Unknown]:
        """Return the requested parameters that the directions of poses may leave undetermined."""

    def undetermined(
        self, fit: JointFit, model: Unknowns, candidates: Sequence[Unknown]
    ) -> Sequence[Unknown]:
        """Return the candidates that the directions of poses do not determine.

        fit: Of the model with the default priors of all candidates.
        model: Without these priors.
        """

    def curvature(self, model: Unknowns, estimate: Array, moves: Array) -> Array:
        """Return the second-order change of each row as the unknowns move, shape (n, m).

        moves: Of the unknowns from the estimate, shape (p, m).
        """

    def lack_of_noise(self, freedom: float, free: int, solution: Solution, model: Unknowns) -> str:
        """Return the error that the residuals do not determine their noise; empty: they do.

        freedom: Degrees of freedom of the residuals and of repeats.
        free: Number of unknowns that the group alone determines.
        """

    def divergence(self, rounds: int) -> str:
        """Return the error that the fit did not converge in so many rounds; empty: no cause."""


def noise_source(group: ReadingGroup) -> str:
    """Return the name of a group in a budget: accelerometer, motion and kind of noise."""
    estimated = "" if group.u is not None else " (estimated)"
    return f"{group.accelerometer}: {READINGS[group.motion]}{estimated}"


@frozen
class LinearReadings(Observation):
    """Readings linearised at an estimate: target = design @ unknowns + fixed @ considered."""

    group: ReadingGroup
    target: Array  # (n,), g, less what a perfect system indicates
    stated: Array | None  # (n,), g, without the head's part
    repeats: Array  # (n,)
    head: Array  # (n,), what head, rates and squares of setting errors add, g
    sigma: Array  # (n,), g, both together
    rate: Array | float = 0.0  # (n,), the part of the rates in `head`, g
    u_rate: Array | float = 0.0  # (n,), as in `Readings`
    default_rate: Array | float = 0.0

    @property
    def source(self) -> str:
        """The name of the readings."""
        return noise_source(self.group)

    run = source

    @property
    def motion(self) -> str:
        """That of every station; ``poses`` of those."""
        return self.group.motion

    @classmethod
    def from_columns(
        cls,
        group: ReadingGroup,
        model: Unknowns,
        columns: Array,
        target: Array,
        stated: Array | None,
        repeats: Array,
        head: Array,
    ) -> LinearReadings:
        """Return rows with columns of all that is estimated and considered, (n, p + q)."""
        p, q = len(model.unknowns), len(model.considered)
        sigma = head if stated is None else np.hypot(stated, head)
        split = tuple(range(p)), columns[:, :p], tuple(range(q)), columns[:, p:]
        return cls(*split, group, target, stated, repeats, head, sigma)

    def with_noise(self, noise: float) -> LinearReadings:
        """Return the same with a noise, of one repeat, for readings that state none."""
        noise_sd = noise / np.sqrt(self.repeats) if self.stated is None else self.stated
        return replace(self, sigma=np.hypot(noise_sd, self.head))

    def block(self, noise: Mapping[str, Noise]) -> Block:
        """Return their square-root information; a noise counts where none is stated."""
        noise_model = noise.get(self.source)
        return (
            self if noise_model is None else self.with_noise(noise_model.white)
        ).whitened_block()

    def whitened_block(self) -> Block:
        """Return their square-root information by the noise that they have."""
        weight = 1.0 / self.sigma[:, None]
        return reduce_block(
            self.design * weight, self.target / self.sigma, None, self.fixed * weight
        )

    def gains(self, solution: Solution, weights: Array) -> Array:
        """Return the change of a combination of the unknowns per 1 g in a reading, shape (n,)."""
        sensitivity = weights @ solution.weighted_covariance[:, list(self.unknowns)]
        gains: Array = (self.design @ sensitivity) / self.sigma**2
        return gains

    def rate_variances(self, solution: Solution, weights: Array) -> tuple[float, float]:
        """Return the variances of a combination by random errors of rates: stated, and default."""
        squares = (self.gains(solution, weights) * self.rate) ** 2
        default = float(np.sum(squares * self.default_rate))
        return float(np.sum(squares)) - default, default

    @property
    def rate_uncertainties(self) -> tuple[Array, Array]:
        """Relative standard uncertainties of its rates: stated, and default; else 0, shape (n,)."""
        default = np.broadcast_to(self.default_rate, self.target.shape)
        return self.u_rate * (default == 0.0), self.u_rate * default

    def residuals(self, solution: Solution, model: Unknowns) -> Array:
        """Return the residuals, the considered terms at their assumed values."""
        means = np.array([term.prior_mean for term in model.considered])
        residuals: Array = (
            self.residuals_at(solution.estimate) - self.fixed @ means[list(self.considered)]
        )
        return residuals

    def residuals_at(self, estimate: Array) -> Array:
        """Return the residuals beside held terms of nothing, at an estimate."""
        residuals: Array = self.target - self.design @ estimate[list(self.unknowns)]
        return residuals

    def chi2(self, solution: Solution, model: Unknowns) -> float:
        """Return chi-square of the residuals, whose covariance the considered terms are part of.

        A considered term that is not what was assumed is no misfit as long as its u allows it: the
        least sum of squares of what is left and of the considered terms over their u (Searle,
        Matrix Algebra Useful for Statistics, 1982, section 10.7, has the identity).
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
        """Return the residual columns of the considered terms, shape (n, q)."""
        columns: Array = self.design @ solution.sensitivity_considered[list(self.unknowns)]
        columns[:, list(self.considered)] += self.fixed
        return columns

    def covariance(self, solution: Solution) -> Array:
        """Return the covariance that the weights minimise, of the own unknowns."""
        covariance: Array = solution.weighted_covariance[np.ix_(self.unknowns, self.unknowns)]
        return covariance

    def leverages(self, solution: Solution) -> Array:
        """Return the leverage of each reading, from 0 to 1."""
        rows = self.design / self.sigma[:, None]
        raw: Array = np.sum((rows @ self.covariance(solution)) * rows, axis=1)
        clipped: Array = np.clip(raw, 0.0, 1.0)
        return clipped

    def residual_dof(self, solution: Solution) -> float:
        """Return the readings less what the fit follows of them."""
        return float(np.sum(1.0 - self.leverages(solution)))

    def noise_moments(self, solution: Solution) -> tuple[float, float]:
        """Return scale and degrees of freedom of the squares that noise alone leaves.

        The residuals are R e, of noise e with unit variance and R = 1 - rows C rows'. Their sum of
        squares is distributed as scale times chi-square (Satterthwaite, Biometrics Bulletin 2
        (1946) 110): tr R^4 / tr R^2 and (tr R^2)^2 / tr R^4. Errors of the machine only add to it.
        """
        rows = self.design / self.sigma[:, None]
        hat = self.covariance(solution) @ (rows.T @ rows)
        square = hat @ hat
        # tr H^k of H = rows C rows' is that of the smaller matrix C rows' rows.
        first, second = float(np.trace(hat)), float(np.trace(square))
        third, fourth = float(np.sum(square * hat.T)), float(np.sum(square * square.T))
        second_moment = len(rows) - 2.0 * first + second
        fourth_moment = len(rows) - 4.0 * first + 6.0 * second - 4.0 * third + fourth
        if not (second_moment > 1e-9 and fourth_moment > 1e-9):
            return 1.0, 0.0
        return fourth_moment / second_moment, second_moment**2 / fourth_moment

    def noise_dof(self, solution: Solution) -> float:
        """Return the degrees of freedom of an estimated noise that the residuals give it.

        Twice Fisher's information of the logarithm of its variance in the restricted likelihood
        (Searle, Casella and McCulloch, Variance Components, 1992, section 6.6): the readings less
        the unknowns where nothing is known beforehand and the head adds nothing.
        """
        rows, share = self.design / self.sigma[:, None], self.noise_share
        weighted = self.covariance(solution) @ (rows.T @ (share[:, None] * rows))
        linear_part = float(share**2 @ (1.0 - 2.0 * self.leverages(solution)))
        return linear_part + float(np.sum(weighted * weighted.T))

    @property
    def noise_share(self) -> Array:
        """The part that noise has in the variance of each reading, the head having the rest."""
        share: Array = 1.0 - (self.head / self.sigma) ** 2
        return share


def blocks_at(readings: Sequence[ReadingGroup], model: Unknowns, estimate: Array) -> list[Block]:
    """Return the square-root information of readings whose noise is stated.

    estimate: Where the derivatives are taken: the unknowns less nominal, shape (p,).
    """
    return [group.linearize(model, estimate).whitened_block() for group in readings]


def rows_at(
    readings: Sequence[ReadingGroup], model: Unknowns, estimate: Array
) -> list[tuple[Array, Array]]:
    """Return the rows of `blocks_at`, reading by reading, with unit variance."""
    parts = [group.linearize(model, estimate) for group in readings]
    return [(part.design / part.sigma[:, None], part.fixed / part.sigma[:, None]) for part in parts]
