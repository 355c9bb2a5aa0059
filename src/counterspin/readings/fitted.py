"""Goodness of fit of a group of readings or poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import field, replace
from typing import Final, Self

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.combined_distribution import tail_beside
from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.least_squares import Solution
from counterspin.physics.station import READINGS
from counterspin.readings.linear import LinearReadings, Measured

#: Least degrees of freedom from which residuals are judged, and repeats tell the noise alone: five,
#: effective ones rounded, as twelve positions on a well-known head have. Of twenty columns that are
#: tried, one is then told from chance every other time if it is 15 of its standard deviations; with
#: four left it must be 26, with three 89, with two 5100 (Student's t).
FEWEST_FREEDOM: Final = 4.5

#: Readings without any noise, but for one that is off, leave this chi-square of the others.
_LEAST_REST: Final = 1e-6

#: In so many of good campaigns a position, or a reading, is called off.
_OF_SINGLE: Final = 0.5 * SIGNIFICANCE


@frozen
class Position:
    """Readings of one position, or one reading, beside the others."""

    #: Of the readings; their mean residual, g.
    places: tuple[int, ...]
    residual: float
    #: The mean residual over its own standard deviation, with leverages and considered terms
    #: counted; NaN where the fit follows these readings wholly.
    standardised: float
    #: The same with an estimated noise as the others tell it (externally studentised), and the
    #: probability of as much by chance, to either side.
    beside_others: float
    p: float


@frozen
class Outlying:
    """A reading, or the readings of one position together, that the noise does not explain."""

    places: tuple[int, ...]  #: Among the readings.
    name: str  #: Of the reading, or of each of them.
    residual: float  #: g.
    z: float  #: Residual over its standard deviation, by the noise of the others.


@frozen
class FittedReadings:
    """A group of readings or poses, and how it fits a solution that has followed it."""

    readings: Measured  #: What was read.
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

    def place_in(self, fit: JointFit) -> int | None:
        """Return which of a fit's observations they are; None if it is without them."""
        for place, one in enumerate(fit.observations):
            if isinstance(one, LinearReadings) and one.group is self.readings:
                return place
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
        return self.stated or self.noise <= self.readings.least_noise

    @property
    def tested_freedom(self) -> float:
        """The degrees of freedom by which residuals are tested.

        A noise that was estimated without some terms has more than the fit with these terms leaves.
        """
        return min(self.noise_dof, self.residual_dof)

    def evaluate(self, fit: JointFit) -> Self:
        """Evaluate the same readings under another fit that includes them."""
        group, solution, model = self.readings, fit.solution, fit.model
        place = self.place_in(fit)
        assert place is not None
        part = fit.observations[place]
        assert isinstance(part, LinearReadings)
        told = None
        if not self.has_external_noise:
            # Noise is estimated with what is considered among the unknowns.
            told = _NoiseWithout(part.relaxed(len(model.unknowns)), fit.relaxed, group)

        def position(places: Sequence[int]) -> Position:
            return position_of(part, places, solution, model, told)

        return replace(
            self,
            linear=part,
            residual_dof=part.freedom(solution),
            residuals=part.left(solution, model),
            chi2=part.squares(solution, model),
            single=tuple(position((place,)) for place in range(group.size)),
            positions=tuple(position(places) for places in group.read_again),
        )

    @property
    def label(self) -> str:
        """The name of these readings."""
        return READINGS[self.readings.motion]

    def outlying(self) -> list[Outlying]:
        """Return the outliers among readings and positions.

        Each reading, and the readings of each position that was read more than once together, are
        compared with the noise of the others (externally studentised), at the level of the other
        tests shared out among them. Noise that is hardly known judges nothing.
        """
        if self.noise_dof < FEWEST_FREEDOM:
            return []
        every = [*self.positions, *self.single]
        z = [each.beside_others for each in every]
        p = [each.p for each in every]
        far_off: list[Outlying] = []
        said: dict[int, float] = {}
        for i in np.flatnonzero(np.array(p) < _OF_SINGLE / len(every)):
            places, size = every[i].places, abs(z[i])
            # A reading is named beside its position only where it alone is the worse.
            if any(size <= said.get(place, 0.0) for place in places):
                continue
            said |= dict.fromkeys(places, size)
            names = ", ".join(dict.fromkeys(self.readings.names[place] for place in places))
            far_off.append(Outlying(tuple(places), names, every[i].residual, z[i]))
        return far_off

    @property
    def misfit_of_positions(self) -> float | None:
        """Probability of residuals beside the repeats' scatter as large as these; None without.

        The F test of lack of fit against pure error: Draper and Smith, Applied Regression
        Analysis, 3rd ed., section 2.1.
        """
        own = self.residuals / self.sigma
        # Each repeat at one setting has the noise alone, each reading the head's part as well,
        # which is known: of what the residuals should be, only the noise's share is to be found.
        again = float(np.sum(self.readings.repeats - 1.0))
        scatter = float(np.sum(self.readings.scatter)) / self.noise**2
        share = float(np.mean(self.linear.noise_share))
        apart = within = 0.0
        for position in self.positions:
            places = list(position.places)
            apart += len(places) - 1.0
            within += float(np.sum((own[places] - own[places].mean()) ** 2))
        left = self.residual_dof - apart
        if self.has_external_noise or again + apart < 1.0 or left < 0.5 or scatter + within <= 0.0:
            return None
        from scipy.special import fdtrc

        weight = again / share**2 + apart
        expected = ((1.0 - share) + share * scatter / again) * again / share**2 if again else 0.0
        expected = (expected + within) / weight
        return float(fdtrc(left, weight, max(self.chi2 - within, 0.0) / left / expected))


def position_of(
    part: LinearReadings,
    places: Sequence[int],
    solution: Solution,
    model: Unknowns,
    noise: _NoiseWithout | None,
) -> Position:
    """Return the weighted mean of some residuals, and it over its own standard deviation."""
    weights = np.zeros(part.target.size)
    weights[list(places)] = 1.0 / part.sigma[list(places)] ** 2
    weights /= weights.sum()
    own = weights * part.sigma
    column = part.left_of(own, solution)
    left = max(float(own @ column), 0.0)
    shifted = weights @ part.moved_by(solution) * model.considered_sizes
    variance = left + float(shifted @ shifted)
    residual = float(weights @ part.left(solution, model))
    if variance <= 1e-9 * float(own @ own):
        return Position(tuple(places), residual, math.nan, math.nan, math.nan)
    z, share, dof = residual / math.sqrt(variance), 0.0, math.inf
    beside_others = z
    if noise is not None:
        # The head, priors and what is considered have their parts of the variance too.
        by_noise = min(float(part.noise_share @ column**2) / variance, 1.0)
        scale, dof = noise.beside(own)
        shrunk = 1.0 - by_noise + by_noise * scale
        beside_others, share = z / math.sqrt(shrunk), by_noise * scale / shrunk
    p = 2.0 * tail_beside(share, dof, abs(beside_others))
    return Position(tuple(places), residual, z, beside_others, p)


class _NoiseWithout:
    """An estimated noise without some of the readings, all else being equal."""

    def __init__(self, part: LinearReadings, solution: Solution, group: Measured) -> None:
        self._part, self._solution = part, solution
        self._share = part.noise_share
        self._residual = part.left_at(solution.estimate) / part.sigma
        again = group.freedom_of_repeats
        self._dof = part.freedom_of_noise(solution) + again
        # The noise is such that the squares of residuals and repeats are what is expected.
        self._squares = float(self._share @ (1.0 - part.leverages(solution))) + again

    def beside(self, own: Array) -> tuple[float, float]:
        """Return the variance without a combination of the readings, over it, and its dof."""
        share, column = self._share, self._part.left_of(own, self._solution)
        left = float(own @ column)
        if left <= 1e-9 * float(own @ own):
            return 1.0, self._dof
        removed = column * float(own @ self._residual) / left
        squares = self._squares - float(share @ (removed * (2.0 * self._residual - removed)))
        weighed = share * column
        crossed = float(weighed @ self._part.left_of(weighed, self._solution)) / left
        gone = float(weighed @ column) / left
        scale = max(squares, _LEAST_REST) / max(self._squares - gone, _LEAST_REST)
        return scale, max(self._dof - 2.0 * crossed + gone**2, 1.0)
