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
    #: The same with an estimated noise as the others tell it (externally studentised), and the
    #: probability of as much by chance, to either side.
    studentized: float
    p: float


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
        deleted_noise = None
        if not self.has_external_noise:
            # Noise is estimated with what is considered among the unknowns.
            deleted_noise = _DeletedNoise(
                linear.with_considered_estimated(len(model.unknowns)),
                fit.solution_with_considered,
                group,
            )

        def position(indices: Sequence[int]) -> Position:
            return make_position(linear, indices, solution, model, deleted_noise)

        return replace(
            self,
            linear=linear,
            residual_dof=linear.residual_dof(solution),
            residuals=linear.residuals(solution, model),
            chi2=linear.chi2(solution, model),
            single=tuple(position((index,)) for index in range(group.size)),
            positions=tuple(position(indices) for indices in group.replicates),
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
        tested = [*self.positions, *self.single]
        z = [item.studentized for item in tested]
        p = [item.p for item in tested]
        outliers: list[OutlyingReadings] = []
        reported: dict[int, float] = {}
        for i in np.flatnonzero(np.array(p) < _SINGLE_LEVEL / len(tested)):
            indices, size = tested[i].indices, abs(z[i])
            # A reading is named beside its position only where it alone is the worse.
            if any(size <= reported.get(index, 0.0) for index in indices):
                continue
            reported |= dict.fromkeys(indices, size)
            names = ", ".join(dict.fromkeys(self.readings.names[index] for index in indices))
            outliers.append(OutlyingReadings(tuple(indices), names, tested[i].residual, z[i]))
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


def make_position(
    part: LinearReadings,
    indices: Sequence[int],
    solution: Solution,
    model: Unknowns,
    noise: _DeletedNoise | None,
) -> Position:
    """Return the weighted mean of some residuals, and it over its own standard deviation."""
    weights = np.zeros(part.target.size)
    weights[list(indices)] = 1.0 / part.sigma[list(indices)] ** 2
    weights /= weights.sum()
    scaled_weights = weights * part.sigma
    column = part.project_out(scaled_weights, solution)
    residual_variance = max(float(scaled_weights @ column), 0.0)
    considered_shift = weights @ part.considered_sensitivity(solution) * model.considered_sds
    variance = residual_variance + float(considered_shift @ considered_shift)
    residual = float(weights @ part.residuals(solution, model))
    if variance <= 1e-9 * float(scaled_weights @ scaled_weights):
        return Position(tuple(indices), residual, math.nan, math.nan, math.nan)
    z, share, dof = residual / math.sqrt(variance), 0.0, math.inf
    studentized = z
    if noise is not None:
        # The head, priors and what is considered have their parts of the variance too.
        noise_fraction = min(float(part.noise_share @ column**2) / variance, 1.0)
        scale, dof = noise.evaluate(scaled_weights)
        variance_ratio = 1.0 - noise_fraction + noise_fraction * scale
        studentized, share = z / math.sqrt(variance_ratio), noise_fraction * scale / variance_ratio
    p = 2.0 * mixture_tail(share, dof, abs(studentized))
    return Position(tuple(indices), residual, z, studentized, p)


class _DeletedNoise:
    """An estimated noise without some of the readings, all else being equal."""

    def __init__(self, part: LinearReadings, solution: Solution, group: ReadingGroup) -> None:
        self._part, self._solution = part, solution
        self._share = part.noise_share
        self._residual = part.residuals_at(solution.estimate) / part.sigma
        repeat_dof = group.repeat_dof
        self._dof = part.noise_dof(solution) + repeat_dof
        # The noise is such that the squares of residuals and repeats are what is expected.
        self._squares = float(self._share @ (1.0 - part.leverages(solution))) + repeat_dof

    def evaluate(self, combination: Array) -> tuple[float, float]:
        """Return the variance without a combination of the readings, over it, and its dof."""
        share, column = self._share, self._part.project_out(combination, self._solution)
        remainder = float(combination @ column)
        if remainder <= 1e-9 * float(combination @ combination):
            return 1.0, self._dof
        removed = column * float(combination @ self._residual) / remainder
        squares = self._squares - float(share @ (removed * (2.0 * self._residual - removed)))
        weighted = share * column
        cross_term = float(weighted @ self._part.project_out(weighted, self._solution)) / remainder
        removed_dof = float(weighted @ column) / remainder
        scale = max(squares, _MIN_REMAINDER) / max(self._squares - removed_dof, _MIN_REMAINDER)
        return scale, max(self._dof - 2.0 * cross_term + removed_dof**2, 1.0)
