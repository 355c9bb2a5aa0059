"""Goodness of fit of a group of readings or poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import field, replace
from typing import Final, Self

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.inference.distributions import normal_quantile
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.least_squares import Solution
from counterspin.inference.mixture_distribution import mixture_tail
from counterspin.physics.station import READING_LABELS
from counterspin.readings.linear import LinearReadings, ReadingGroup

#: Smallest degrees of freedom for tests of residuals, and for noise from repeats alone: five
#: rounded effective ones, as for twelve positions on a well-known head. With twenty candidate
#: patterns, a pattern of 15 of its standard deviations is then detected in half of the cases; with
#: four degrees of freedom it must have 26, with three 89, with two 5100 (Student's t).
MIN_DOF: Final = 4.5

#: Smallest chi-square of the other readings if a single one deviates from noiseless readings.
_MIN_REMAINDER: Final = 1e-6

#: Variance of a combined residual relative to its readings below which the fit absorbs it.
_MIN_RELATIVE_VARIANCE: Final = 1e-9

#: Largest number of readings with gross errors that may explain the deviations of others.
_MAX_GROSS_ERRORS: Final = 3

#: Smallest gross error relative to the largest one, whose effect is known to first order.
_MIN_RELATIVE_ERROR: Final = 0.1

#: Fraction of good campaigns in which a position or a reading is reported as an outlier.
_POSITION_SIGNIFICANCE: Final = 0.5 * SIGNIFICANCE


@frozen
class Position:
    """Residual of a position with its readings, or of a single reading."""

    indices: tuple[int, ...]  #: Indices of the readings.
    residual: float  #: Mean residual, g.
    #: Mean residual over its standard deviation, with leverages and considered terms; NaN if the
    #: fit absorbs these readings completely.
    standardized: float
    studentized: float  #: Externally studentised residual: with the noise of the other readings.
    noise_fraction: float  #: Fraction of the noise in the variance of the residual.
    noise_dof: float  #: Degrees of freedom of this noise.

    @property
    def p(self) -> float:
        """Two-sided probability of a residual this large by chance; NaN if undetermined."""
        if math.isnan(self.studentized):
            return math.nan
        return 2.0 * mixture_tail(self.noise_fraction, self.noise_dof, abs(self.studentized))


@frozen
class OutlyingReadings:
    """An outlying reading, or the readings of an outlying position."""

    indices: tuple[int, ...]  #: Indices of the readings.
    name: str  #: Name of the reading, or names of the readings.
    residual: float  #: Mean residual, g.
    z: float  #: Externally studentised residual.


@frozen
class FittedReadings:
    """A group of readings or poses in a fit, with its residuals."""

    readings: ReadingGroup  #: Readings or poses.
    linear: LinearReadings  #: The readings linearised at the estimate.
    noise: float  #: Estimated noise of a repeat, g; meaningless if the noise was stated.
    noise_dof: float  #: Degrees of freedom of the estimated noise; infinite if it was stated.
    residual_dof: float = math.nan  #: Number of readings minus their leverages.
    #: Residuals at the estimate, g, shape (n,).
    residuals: Array = field(default_factory=lambda: np.empty(0))
    chi2: float = math.nan  #: Chi-square of the residuals, with noise and considered terms.
    single_readings: tuple[Position, ...] = ()  #: Each reading by itself.
    positions: tuple[Position, ...] = ()  #: Each position with several readings.
    #: Readings without which no other one is an outlier; empty if there are none or many.
    gross_errors: tuple[Position, ...] = ()

    def index_in(self, fit: JointFit) -> int | None:
        """Return the index among the observations of a fit; None if the fit lacks the group."""
        for index, observation in enumerate(fit.observations):
            if isinstance(observation, LinearReadings) and observation.group is self.readings:
                return index
        return None

    @property
    def motion(self) -> str:
        """Motion of every reading; ``poses`` of poses."""
        return self.readings.motion

    @property
    def accelerometers(self) -> tuple[str, ...]:
        """Names of the accelerometers that were read."""
        return self.readings.accelerometers

    @property
    def sigma(self) -> Array:
        """Standard uncertainty of each reading, the head's part included, g, shape (n,)."""
        return self.linear.sigma

    @property
    def stated(self) -> bool:
        """True if the uncertainty of the readings was stated."""
        return self.readings.u is not None

    @property
    def has_external_noise(self) -> bool:
        """True if the noise was not estimated from the residuals, but stated or only rounding."""
        return self.stated or self.noise <= self.readings.noise_floor

    @property
    def tested_dof(self) -> float:
        """Degrees of freedom for tests of the residuals.

        Noise that was estimated without some terms has more degrees of freedom than the residuals.
        """
        return min(self.noise_dof, self.residual_dof)

    def evaluate(self, fit: JointFit) -> Self:
        """Return the group evaluated with another fit that includes it."""
        group, solution, model = self.readings, fit.solution, fit.model
        index = self.index_in(fit)
        assert index is not None
        linear = fit.observations[index]
        assert isinstance(linear, LinearReadings)
        noise = None
        if not self.has_external_noise:
            # The noise was estimated with considered terms as unknowns.
            group_with_considered = linear.with_considered_estimated(len(model.unknowns))
            noise = (group_with_considered, fit.solution_with_considered, group.repeat_dof)
        single_readings = [(index,) for index in range(group.size)]
        positions = evaluate_positions(
            linear, [*single_readings, *group.replicates], solution, model, noise
        )
        limit = -normal_quantile(0.5 * significance(positions)) if noise is None else math.inf
        n_outliers = sum(abs(position.standardized) > limit for position in positions)
        return replace(
            self,
            gross_errors=_gross_errors(linear, fit, positions) if n_outliers > 1 else (),
            linear=linear,
            residual_dof=linear.residual_dof(solution),
            residuals=linear.residuals(solution, model),
            chi2=linear.chi2(solution, model),
            single_readings=tuple(positions[: group.size]),
            positions=tuple(positions[group.size :]),
        )

    @property
    def label(self) -> str:
        """Name of these readings in messages."""
        return READING_LABELS[self.readings.motion]

    def outliers(self) -> list[OutlyingReadings]:
        """Return the outliers among readings and positions.

        Each reading, and each position with several readings, is compared with the noise of the
        other readings (externally studentised). All these tests share the significance level.
        Without sufficient degrees of freedom of the noise, there are no outliers. If a few gross
        errors explain all outliers, only they are returned.
        """
        if self.noise_dof < MIN_DOF:
            return []
        positions = [*self.positions, *self.single_readings]
        level = significance(positions)
        if self.gross_errors:
            positions = list(self.gross_errors)
        z = [position.studentized for position in positions]
        outliers: list[OutlyingReadings] = []
        z_by_index: dict[int, float] = {}
        # The tails of the test distributions are not below those of the normal distribution.
        for i in np.flatnonzero(np.abs(z) > -normal_quantile(0.5 * level)).tolist():
            if positions[i].p >= level:
                continue
            indices, magnitude = positions[i].indices, abs(z[i])
            # A reading in an outlying position is reported only if it deviates more by itself.
            if any(magnitude <= z_by_index.get(index, 0.0) for index in indices):
                continue
            z_by_index |= dict.fromkeys(indices, magnitude)
            names = ", ".join(dict.fromkeys(self.readings.names[index] for index in indices))
            outliers.append(OutlyingReadings(tuple(indices), names, positions[i].residual, z[i]))
        return outliers

    @property
    def position_misfit_p(self) -> float | None:
        """p-value of the F test of lack of fit against pure error; None without repeats.

        Draper and Smith, Applied Regression Analysis, 3rd ed., section 2.1.
        """
        normalized_residuals = self.residuals / self.sigma
        # Repeats at one setting contain only the noise; readings also contain the known variance of
        # the head. Only the noise share is unknown.
        repeat_dof = float(np.sum(self.readings.repeats - 1.0))
        scatter = float(np.sum(self.readings.scatter)) / self.noise**2
        noise_share = float(np.mean(self.linear.noise_share))
        position_dof = position_squares = 0.0
        for position in self.positions:
            indices = list(position.indices)
            position_dof += len(indices) - 1.0
            members = normalized_residuals[indices]
            position_squares += float(np.sum((members - members.mean()) ** 2))
        remaining_dof = self.residual_dof - position_dof
        if (
            self.has_external_noise
            or repeat_dof + position_dof < 1.0
            or remaining_dof < 0.5
            or scatter + position_squares <= 0.0
        ):
            return None
        from scipy.special import fdtrc

        pure_error_dof = repeat_dof / noise_share**2 + position_dof
        expected_mean_square = (
            ((1.0 - noise_share) + noise_share * scatter / repeat_dof) * repeat_dof / noise_share**2
            if repeat_dof
            else 0.0
        )
        expected_mean_square = (expected_mean_square + position_squares) / pure_error_dof
        return float(
            fdtrc(
                remaining_dof,
                pure_error_dof,
                max(self.chi2 - position_squares, 0.0) / remaining_dof / expected_mean_square,
            )
        )


def significance(positions: Sequence[Position]) -> float:
    """Return the p-value below which one of several positions is an outlier."""
    return _POSITION_SIGNIFICANCE / len(positions)


def _gross_errors(
    linear_group: LinearReadings, fit: JointFit, positions: Sequence[Position]
) -> tuple[Position, ...]:
    """Return the readings without which no other reading is an outlier; empty if there are many.

    A gross error shifts the fit, so that correct readings deviate as well. The reading with the
    largest standardised residual is deleted repeatedly (Hadi and Simonoff, J. Am. Stat. Assoc. 88
    (1993) 1264).
    """
    solution = fit.solution_with_considered
    linear_group = linear_group.with_considered_estimated(len(fit.model.unknowns))
    rows = linear_group.design / linear_group.sigma[:, None]
    residual = linear_group.residuals_at(solution.estimate) / linear_group.sigma
    covariance = linear_group.covariance(solution)
    variance = 1.0 - linear_group.leverages(solution)
    limit = significance(positions)
    deleted_positions: list[Position] = []
    for _ in range(_MAX_GROSS_ERRORS + 1):
        z = residual / np.sqrt(np.where(variance > _MIN_RELATIVE_VARIANCE, variance, np.inf))
        index = int(np.argmax(np.abs(z)))
        error = replace(positions[index], standardized=float(z[index]), studentized=float(z[index]))
        largest_z = (deleted_positions or [error])[0].studentized
        if error.p >= limit or abs(z[index]) < _MIN_RELATIVE_ERROR * abs(largest_z):
            return tuple(deleted_positions)
        deleted_positions.append(error)
        # The fit without a reading is a fit with a parameter for its error.
        step = covariance @ rows[index]
        column = -rows @ step
        column[index] += 1.0
        residual = residual - column * (residual[index] / variance[index])
        covariance = covariance + np.outer(step, step) / variance[index]
        variance = variance - column**2 / variance[index]
    return ()


class _ReadingSets:
    """k sets of readings, concatenated in `readings`."""

    def __init__(self, sets: Sequence[Sequence[int]]) -> None:
        self.lengths = [len(indices) for indices in sets]
        self.readings = np.concatenate(sets)
        self._starts = np.cumsum([0, *self.lengths])[:-1]

    def sum(self, values: Array) -> Array:
        """Return the sums of the members' values over each set, shape (k, ...)."""
        return np.asarray(np.add.reduceat(values, self._starts, axis=0))


class _CombinedResiduals:
    """Combined residuals of k sets of the n readings of a fit.

    For a combination s in standard uncertainties, r = s - H s with the hat matrix H. Sums over r
    are computed with the q unknowns, without the n x n matrix.
    """

    def __init__(
        self, linear_group: LinearReadings, solution: Solution, sets: _ReadingSets, weights: Array
    ) -> None:
        """Project combinations; weights: weights of the members of all sets."""
        self._rows = linear_group.design / linear_group.sigma[:, None]
        self._sets, self._s = sets, weights
        self._covariance = linear_group.covariance(solution)
        self._row_sums = self._weighted_rows(np.ones(len(self._rows)))
        self._projection = self._row_sums @ self._covariance

    def _weighted_rows(self, weights: Array) -> Array:
        """Return rows' (weights s), shape (k, q); weights: shape (n,)."""
        readings = self._sets.readings
        return self._sets.sum((weights[readings] * self._s)[:, None] * self._rows[readings])

    def dot(self, vector: Array) -> Array:
        """Return r . vector, shape (k,); vector: shape (n,)."""
        sums = self._sets.sum(self._s * vector[self._sets.readings])
        return np.asarray(sums - self._projection @ (self._rows.T @ vector))

    @property
    def variance(self) -> Array:
        """Products r . s, the variances of the combined residuals, shape (k,)."""
        projected_variances: Array = np.sum(self._row_sums * self._projection, axis=1)
        return np.asarray(np.maximum(self._sets.sum(self._s**2) - projected_variances, 0.0))

    def squares(self, weights: Array) -> Array:
        """Return the sums of weights r^2, shape (k,); weights: shape (n,)."""
        sums = self._sets.sum(weights[self._sets.readings] * self._s**2)
        rows = self._weighted_rows(weights) + self._residual_rows(weights)
        return np.asarray(np.maximum(sums - np.sum(rows * self._projection, axis=1), 0.0))

    def _residual_rows(self, weights: Array) -> Array:
        """Return rows' (weights r), shape (k, q)."""
        gram = self._rows.T @ (weights[:, None] * self._rows)
        return np.asarray(self._weighted_rows(weights) - self._projection @ gram)

    def weighted_variance(self, weights: Array) -> Array:
        """Return w . (w - H w) of w = weights r, shape (k,)."""
        rows = self._residual_rows(weights)
        projected_variances: Array = np.sum((rows @ self._covariance) * rows, axis=1)
        return self.squares(weights**2) - projected_variances


def evaluate_positions(
    linear_group: LinearReadings,
    sets: Sequence[Sequence[int]],
    solution: Solution,
    model: Unknowns,
    noise: tuple[LinearReadings, Solution, float] | None,
) -> list[Position]:
    """Return the standardised weighted mean residual of each set of readings.

    sets: Indices of the readings of each of k sets.
    noise: Readings and solution of the noise estimate, and degrees of freedom of the repeats; None:
        the noise was not estimated.
    """
    reading_sets = _ReadingSets(sets)
    sigma = linear_group.sigma[reading_sets.readings]
    weights = sigma**-2.0
    weights /= np.repeat(reading_sets.sum(weights), reading_sets.lengths)
    standardised_weights = weights * sigma
    combined_residuals = _CombinedResiduals(
        linear_group, solution, reading_sets, standardised_weights
    )
    sensitivity = (
        linear_group.considered_sensitivity(solution)[reading_sets.readings] * model.considered_sds
    )
    shifts = reading_sets.sum(weights[:, None] * sensitivity)
    variance = combined_residuals.variance + np.sum(shifts**2, axis=1)
    residual = reading_sets.sum(
        weights * linear_group.residuals(solution, model)[reading_sets.readings]
    )
    is_undetermined = variance <= _MIN_RELATIVE_VARIANCE * reading_sets.sum(standardised_weights**2)
    variance[is_undetermined] = 1.0
    z = residual / np.sqrt(variance)
    studentized, noise_fraction, dof = z, np.zeros(len(sets)), np.full(len(sets), math.inf)
    if noise is not None:
        # The head, priors and considered terms also contribute to the variance.
        fraction = np.minimum(combined_residuals.squares(linear_group.noise_share) / variance, 1.0)
        scale, dof = _deleted_noise(*noise, reading_sets, standardised_weights)
        ratio = 1.0 - fraction + fraction * scale
        studentized, noise_fraction = z / np.sqrt(ratio), fraction * scale / ratio
    z[is_undetermined] = studentized[is_undetermined] = math.nan
    columns = (column.tolist() for column in (residual, z, studentized, noise_fraction, dof))
    return [Position(tuple(s), *row) for s, *row in zip(sets, *columns, strict=True)]


def _deleted_noise(
    linear_group: LinearReadings,
    solution: Solution,
    repeat_dof: float,
    sets: _ReadingSets,
    standardised_weights: Array,
) -> tuple[Array, Array]:
    """Return the noise variance estimated without each set over that with it, and its dof.

    standardised_weights: Weights of the readings in standard uncertainties; for other parameters,
        see `evaluate_positions`.
    """
    combined_residuals = _CombinedResiduals(linear_group, solution, sets, standardised_weights)
    noise_share, variance = linear_group.noise_share, combined_residuals.variance
    residual = linear_group.residuals_at(solution.estimate) / linear_group.sigma
    total_dof = linear_group.noise_dof(solution) + repeat_dof
    # With the estimated noise, the squares of residuals and repeats equal their expectation.
    total_squares = float(noise_share @ (1.0 - linear_group.leverages(solution))) + repeat_dof
    is_undetermined = variance <= _MIN_RELATIVE_VARIANCE * sets.sum(standardised_weights**2)
    variance[is_undetermined] = 1.0
    deleted_residuals = sets.sum(standardised_weights * residual[sets.readings]) / variance
    deleted_squares = combined_residuals.squares(noise_share)
    deleted_dof = deleted_squares / variance
    remaining_squares = total_squares - deleted_residuals * (
        2.0 * combined_residuals.dot(noise_share * residual) - deleted_residuals * deleted_squares
    )
    scale = np.maximum(remaining_squares, _MIN_REMAINDER) / np.maximum(
        total_squares - deleted_dof, _MIN_REMAINDER
    )
    dof = (
        total_dof
        - 2.0 * combined_residuals.weighted_variance(noise_share) / variance
        + deleted_dof**2
    )
    return (
        np.where(is_undetermined, 1.0, scale),
        np.where(is_undetermined, total_dof, np.maximum(dof, 1.0)),
    )
