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
from counterspin.physics.station import READINGS
from counterspin.readings.linear import LinearReadings, ReadingGroup

#: Least degrees of freedom from which residuals are judged, and repeats tell the noise alone: five,
#: effective ones rounded, as twelve positions on a well-known head have. Of twenty columns that are
#: tried, one is then told from chance every other time if it is 15 of its standard deviations; with
#: four left it must be 26, with three 89, with two 5100 (Student's t).
MIN_DOF: Final = 4.5

#: Readings without any noise, but for one that is off, leave this chi-square of the others.
_MIN_REMAINDER: Final = 1e-6

#: Below this part of its readings' variance the fit follows a combination of them wholly.
_LEAST_VARIANCE: Final = 1e-9

#: In so many of good campaigns a position, or a reading, is called off.
_SINGLE_LEVEL: Final = 0.5 * SIGNIFICANCE


@frozen
class Position:
    """Readings of one position, or one reading, beside the others."""

    #: Of the readings; their mean residual, g.
    indices: tuple[int, ...]
    residual: float
    #: The mean residual over its own standard deviation, with leverages and considered terms
    #: counted; NaN where the fit follows these readings wholly.
    standardized: float
    #: The same with an estimated noise as the others tell it (externally studentised), the part of
    #: its variance from that noise, and the noise's degrees of freedom.
    studentized: float
    noise_fraction: float
    noise_dof: float

    @property
    def p(self) -> float:
        """Probability of as large a deviation by chance, to either side; NaN if undetermined."""
        if math.isnan(self.studentized):
            return math.nan
        return 2.0 * mixture_tail(self.noise_fraction, self.noise_dof, abs(self.studentized))


@frozen
class OutlyingReadings:
    """A reading, or the readings of one position together, that the noise does not explain."""

    indices: tuple[int, ...]  #: Among the readings.
    name: str  #: Of the reading, or of each of them.
    residual: float  #: g.
    z: float  #: Residual over its standard deviation, by the noise of the others.


@frozen
class FittedReadings:
    """A group of readings or poses, and how it fits a solution that has followed it."""

    readings: ReadingGroup  #: What was read.
    linear: LinearReadings  #: The same linearised at the estimate, each with its uncertainty.
    noise: float  #: Of one repeat where it was estimated, g; elsewhere it means nothing.
    noise_dof: float  #: Degrees of freedom of an estimated noise; infinite where it was stated.
    residual_dof: float = math.nan  #: Readings less what the fit follows of them.
    #: Reading less model at the estimate, g, shape (n,).
    residuals: Array = field(default_factory=lambda: np.empty(0))
    chi2: float = math.nan  #: Chi-square of the residuals, by noise and considered terms.
    #: Each reading by itself, and for each position that was read more than once its readings.
    single: tuple[Position, ...] = ()
    positions: tuple[Position, ...] = ()

    def index_in(self, fit: JointFit) -> int | None:
        """Return which of a fit's observations they are; None if it is without them."""
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
        """Whether the uncertainty of the readings was stated."""
        return self.readings.u is not None

    @property
    def has_external_noise(self) -> bool:
        """Whether residuals are held against a noise that they did not tell: stated, or the least.

        Those that are no more than rounding say nothing of each other's size.
        """
        return self.stated or self.noise <= self.readings.noise_floor

    @property
    def tested_dof(self) -> float:
        """The degrees of freedom by which residuals are tested.

        A noise that was estimated without some terms has more than the fit with these terms leaves.
        """
        return min(self.noise_dof, self.residual_dof)

    def evaluate(self, fit: JointFit) -> Self:
        """Evaluate the same readings under another fit that includes them."""
        group, solution, model = self.readings, fit.solution, fit.model
        index = self.index_in(fit)
        assert index is not None
        linear = fit.observations[index]
        assert isinstance(linear, LinearReadings)
        noise = None
        if not self.has_external_noise:
            # Noise is estimated with what is considered among the unknowns.
            considered_estimated = linear.with_considered_estimated(len(model.unknowns))
            noise = (considered_estimated, fit.solution_with_considered, group.repeat_dof)
        readings = [(index,) for index in range(group.size)]
        positions = evaluate_positions(
            linear, [*readings, *group.replicates], solution, model, noise
        )
        return replace(
            self,
            linear=linear,
            residual_dof=linear.residual_dof(solution),
            residuals=linear.residuals(solution, model),
            chi2=linear.chi2(solution, model),
            single=tuple(positions[: group.size]),
            positions=tuple(positions[group.size :]),
        )

    @property
    def label(self) -> str:
        """The name of these readings."""
        return READINGS[self.readings.motion]

    def outliers(self) -> list[OutlyingReadings]:
        """Return the outliers among readings and positions.

        Each reading, and the readings of each position that was read more than once together, are
        compared with the noise of the others (externally studentised), at the level of the other
        tests shared out among them. Noise that is hardly known judges nothing.
        """
        if self.noise_dof < MIN_DOF:
            return []
        tested_sets = [*self.positions, *self.single]
        z, level = [item.studentized for item in tested_sets], _SINGLE_LEVEL / len(tested_sets)
        outliers: list[OutlyingReadings] = []
        z_by_index: dict[int, float] = {}
        # The tails of the distributions of the tests are not below those of the normal one.
        for i in np.flatnonzero(np.abs(z) > -normal_quantile(0.5 * level)).tolist():
            if tested_sets[i].p >= level:
                continue
            indices, size = tested_sets[i].indices, abs(z[i])
            # A reading is named beside its position only where it alone is the worse.
            if any(size <= z_by_index.get(index, 0.0) for index in indices):
                continue
            z_by_index |= dict.fromkeys(indices, size)
            names = ", ".join(dict.fromkeys(self.readings.names[index] for index in indices))
            outliers.append(OutlyingReadings(tuple(indices), names, tested_sets[i].residual, z[i]))
        return outliers

    @property
    def position_misfit_p(self) -> float | None:
        """Probability of residuals beside the repeats' scatter as large as these; None without.

        The F test of lack of fit against pure error: Draper and Smith, Applied Regression
        Analysis, 3rd ed., section 2.1.
        """
        normalized = self.residuals / self.sigma
        # Each repeat at one setting has the noise alone, each reading the head's part as well,
        # which is known: of what the residuals should be, only the noise's share is to be found.
        repeat_dof = float(np.sum(self.readings.repeats - 1.0))
        scatter = float(np.sum(self.readings.scatter)) / self.noise**2
        share = float(np.mean(self.linear.noise_share))
        position_dof = position_squares = 0.0
        for position in self.positions:
            indices = list(position.indices)
            position_dof += len(indices) - 1.0
            position_squares += float(
                np.sum((normalized[indices] - normalized[indices].mean()) ** 2)
            )
        remaining_dof = self.residual_dof - position_dof
        if (
            self.has_external_noise
            or repeat_dof + position_dof < 1.0
            or remaining_dof < 0.5
            or scatter + position_squares <= 0.0
        ):
            return None
        from scipy.special import fdtrc

        weight = repeat_dof / share**2 + position_dof
        expected = (
            ((1.0 - share) + share * scatter / repeat_dof) * repeat_dof / share**2
            if repeat_dof
            else 0.0
        )
        expected = (expected + position_squares) / weight
        return float(
            fdtrc(
                remaining_dof,
                weight,
                max(self.chi2 - position_squares, 0.0) / remaining_dof / expected,
            )
        )


class _ReadingSets:
    """Sets of readings, k of them, whose members stand one after the other in `readings`."""

    def __init__(self, sets: Sequence[Sequence[int]]) -> None:
        self.lengths = [len(indices) for indices in sets]
        self.readings = np.concatenate(sets)
        self._starts = np.cumsum([0, *self.lengths])[:-1]

    def sum(self, values: Array) -> Array:
        """Return the sums of the members' values over each set, shape (k, ...)."""
        return np.asarray(np.add.reduceat(values, self._starts, axis=0))


class _CombinedResiduals:
    """Residuals of a fit in combinations of its n readings, one for each of k sets.

    With r = s - H s of a combination s in standard uncertainties, and H the hat matrix of the
    readings: sums over r need the q unknowns only, and not the n x n hat matrix.
    """

    def __init__(
        self, part: LinearReadings, solution: Solution, sets: _ReadingSets, s: Array
    ) -> None:
        """Project combinations; s: weights of the members of all sets."""
        self._rows = part.design / part.sigma[:, None]
        self._sets, self._s = sets, s
        self._covariance = part.covariance(solution)
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
        """The products r . s, the variances of the combined residuals, shape (k,)."""
        projected: Array = np.sum(self._row_sums * self._projection, axis=1)
        return np.asarray(np.maximum(self._sets.sum(self._s**2) - projected, 0.0))

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
        projected: Array = np.sum((rows @ self._covariance) * rows, axis=1)
        return self.squares(weights**2) - projected


def evaluate_positions(
    part: LinearReadings,
    sets: Sequence[Sequence[int]],
    solution: Solution,
    model: Unknowns,
    noise: tuple[LinearReadings, Solution, float] | None,
) -> list[Position]:
    """Return the weighted mean residual of each set of readings over its standard deviation.

    sets: Places of the readings of each set, k of them.
    noise: Readings and solution by which their noise was estimated, and the repeats' degrees of
        freedom; None: it was not.
    """
    members = _ReadingSets(sets)
    sigma = part.sigma[members.readings]
    weights = sigma**-2.0
    weights /= np.repeat(members.sum(weights), members.lengths)
    combined = weights * sigma
    r = _CombinedResiduals(part, solution, members, combined)
    sensitivity = part.considered_sensitivity(solution)[members.readings] * model.considered_sds
    shifts = members.sum(weights[:, None] * sensitivity)
    variance = r.variance + np.sum(shifts**2, axis=1)
    residual = members.sum(weights * part.residuals(solution, model)[members.readings])
    is_undetermined = variance <= _LEAST_VARIANCE * members.sum(combined**2)
    variance[is_undetermined] = 1.0
    z = residual / np.sqrt(variance)
    studentized, share, dof = z, np.zeros(len(sets)), np.full(len(sets), math.inf)
    if noise is not None:
        # The head, priors and what is considered have their parts of the variance too.
        fraction = np.minimum(r.squares(part.noise_share) / variance, 1.0)
        scale, dof = _deleted_noise(*noise, members, combined)
        ratio = 1.0 - fraction + fraction * scale
        studentized, share = z / np.sqrt(ratio), fraction * scale / ratio
    z[is_undetermined] = studentized[is_undetermined] = math.nan
    columns = (column.tolist() for column in (residual, z, studentized, share, dof))
    return [Position(tuple(s), *row) for s, *row in zip(sets, *columns, strict=True)]


def _deleted_noise(
    part: LinearReadings,
    solution: Solution,
    repeat_dof: float,
    sets: _ReadingSets,
    combined: Array,
) -> tuple[Array, Array]:
    """Return the noise variance estimated without each set, over that with it, and its dof.

    All else being equal. Arguments as in `evaluate_positions`; combined: the weights of the
    readings in standard uncertainties.
    """
    r = _CombinedResiduals(part, solution, sets, combined)
    share, variance = part.noise_share, r.variance
    residual = part.residuals_at(solution.estimate) / part.sigma
    total_dof = part.noise_dof(solution) + repeat_dof
    # The noise is such that the squares of residuals and repeats are what is expected.
    total_squares = float(share @ (1.0 - part.leverages(solution))) + repeat_dof
    is_undetermined = variance <= _LEAST_VARIANCE * sets.sum(combined**2)
    variance[is_undetermined] = 1.0
    removed = sets.sum(combined * residual[sets.readings]) / variance
    removed_squares = r.squares(share)
    removed_dof = removed_squares / variance
    squares = total_squares - removed * (2.0 * r.dot(share * residual) - removed * removed_squares)
    scale = np.maximum(squares, _MIN_REMAINDER) / np.maximum(
        total_squares - removed_dof, _MIN_REMAINDER
    )
    dof = total_dof - 2.0 * r.weighted_variance(share) / variance + removed_dof**2
    return (
        np.where(is_undetermined, 1.0, scale),
        np.where(is_undetermined, total_dof, np.maximum(dof, 1.0)),
    )
