"""Readings, and poses at unknown attitudes, as data of the joint fit.

The derivatives are taken at what readings and priors together say, and taken again there until it
settles. The readings become blocks of square-root information, which are solved together with the
blocks of records.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import field, replace
from typing import Final, Self, TypeVar

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import ConvergenceError, NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.blocks import Block
from counterspin.inference.distributions import tail_beside
from counterspin.inference.identifiability import assess
from counterspin.inference.joint.fit import JointFit, solve_blocks, solve_relaxed
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.least_squares import Solution
from counterspin.inference.linear_readings import LinearReadings, Readings
from counterspin.inference.noise.model import Noise
from counterspin.inference.poses import TriadPoses

U = TypeVar("U", bound=Unknown)

#: Rounds in which derivatives and noise must settle; two or three are usual.
_ROUNDS: Final = 50

#: The same for the noise alone, which may approach zero slowly.
_NOISE_ROUNDS: Final = 200

#: Estimated noise is no smaller than this part of what the head's angle adds (rms), or the few
#: positions where the head adds nothing would be taken for exact. Enough repeats tell it.
_LEAST_BESIDE_HEAD: Final = 0.3

#: Readings without any noise, but for one that is off, leave this chi-square of the others.
_LEAST_REST: Final = 1e-6

#: Least degrees of freedom from which residuals are judged, and repeats tell the noise alone: five,
#: effective ones rounded, for twelve positions of which nothing is stated have just these. Of
#: twenty columns that are tried, one is then told from chance every other time if it is 15 of its
#: standard deviations; with four left it must be 26, with three 89, with two 5100 (Student's t).
FEWEST_FREEDOM: Final = 4.5

#: Part of a standard uncertainty that is as good as none.
_HELD: Final = 1e-6

#: How many times its largest credible size an unknown may have where derivatives are taken.
_FARTHEST: Final = 10.0

#: Settled: nothing moves by more than this part of its uncertainty, no noise by this part.
_LARGEST_MOVE: Final = 1e-5
_TOLERANCE: Final = 1e-6


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
class FittedReadings:
    """A group of readings or poses, and how it fits a solution that has followed it."""

    readings: Readings | TriadPoses  #: What was read.
    linear: LinearReadings  #: The same linearised at the estimate, each with its uncertainty.
    noise: float  #: Of one repeat where it was estimated, g; elsewhere it means nothing.
    dof: float  #: Degrees of freedom of an estimated noise; infinite where it was stated.
    freedom: float = math.nan  #: Readings less what the fit follows of them.
    #: Reading less model at the estimate, g, shape (n,).
    residuals: Array = field(default_factory=lambda: np.empty(0))
    squares: float = math.nan  #: Chi-square of the residuals, by noise and considered terms.
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
    def sigma(self) -> Array:
        """Standard uncertainty of each reading, the head's part included, g, shape (n,)."""
        return self.linear.sigma

    @property
    def weighed(self) -> bool:
        """Whether residuals are held against a noise that they did not tell: stated, or the least.

        Those that are no more than rounding say nothing of each other's size.
        """
        return self.readings.u is not None or self.noise <= self.readings.least_noise

    def under(self, fit: JointFit) -> Self:
        """Return how the same readings fit what a fit, which has them, says."""
        group, solution, model = self.readings, fit.solution, fit.model
        place = self.place_in(fit)
        assert place is not None
        part = fit.observations[place]
        assert isinstance(part, LinearReadings)
        told = None
        if not self.weighed:
            # Noise is estimated with what is considered among the unknowns.
            told = _NoiseWithout(part.relaxed(len(model.unknowns)), fit.relaxed, group)

        def position(places: Sequence[int]) -> Position:
            return _position(part, places, solution, model, told)

        return replace(
            self,
            linear=part,
            freedom=part.freedom(solution),
            residuals=part.left(solution, model),
            squares=part.squares(solution, model),
            single=tuple(position((place,)) for place in range(group.size)),
            positions=tuple(position(places) for places in group.read_again),
        )


@frozen
class ReadingsFit:
    """A solved problem with readings."""

    fit: JointFit  #: Of records, if there are any, and readings.
    groups: tuple[FittedReadings, ...]  #: The readings as they fit, in the order of the `Readings`.

    @property
    def solution(self) -> Solution:
        """Estimates less nominal."""
        return self.fit.solution


def solve_readings(
    readings: Sequence[Readings | TriadPoses], model: Unknowns, records: JointFit | None = None
) -> ReadingsFit:
    """Estimate a model from readings, together with what records say.

    model: What is estimated and considered. Of the inputs radius, gravity and latitude count here.
    """
    try:
        return _solved(readings, model, records)
    except NotIdentifiableError:
        bare = _without_unasked(readings, model)
        set_by_hand = any(group.u is None and any(group.position) for group in readings)
        if not set_by_hand and bare == model:
            raise
    # Where hardly a position is read twice, its error hides the noise, and in few poses terms that
    # nobody asks for do. The residuals show both together, and the noise is taken to be as large as
    # that.
    unset = [replace(g, position=()) if isinstance(g, Readings) else g for g in readings]
    together = _solved(unset, bare, records)
    return _solved(readings, model, records, together)


def _place(
    estimate: Array,
    found: Solution,
    known: Array,
    limits: Array,
    farthest: Array,
    turned: Sequence[int],
) -> Array:
    """Return where to take derivatives: what is not determined may be anything, and is no place.

    Nor is what is far beyond credible; the estimate may be, and is then found to be.

    Of a triad that is often a combination, such as a turn about the vertical: to leave out unknown
    by unknown would leave out the angles between its axes too. What is left of theirs is what the
    estimates are beside what is known, give or take the limits.

    farthest: From what is known.
    turned: Places of a triad's unknowns.
    """
    u = found.u[: known.size]
    place: Array = known + np.clip(np.where(u < limits, estimate - known, 0.0), -farthest, farthest)
    own = [at for at in turned if np.isfinite(u[at])]
    if (u < limits)[own].all():
        return place
    size = limits[own]
    spread = np.eye(len(own)) + found.covariance[np.ix_(own, own)] / np.outer(size, size)
    place[own] = known[own] + size * np.linalg.solve(spread, (estimate - known)[own] / size)
    return place


def _without_unasked(readings: Sequence[Readings | TriadPoses], model: Unknowns) -> Unknowns:
    """Return a model in which what is not asked for, and poses without u show, is as assumed."""
    posed = {
        name
        for group in readings
        if isinstance(group, TriadPoses) and group.u is None
        for name in group.accelerometers
    }

    def held(other: U) -> U:
        if other.owner not in posed or other.asked or math.isinf(other.prior[1]):
            return other
        return replace(other, prior=(other.prior[0], _HELD * other.prior[1]))

    return Unknowns(tuple(map(held, model.unknowns)), tuple(map(held, model.considered)))


def _solved(
    readings: Sequence[Readings | TriadPoses],
    model: Unknowns,
    records: JointFit | None,
    together: ReadingsFit | None = None,
) -> ReadingsFit:
    """Return the solved problem; of `together`, where it is given, the noise is taken."""
    beside = () if records is None else records.blocks[: len(records.prepared)]
    everything = [*model.unknowns, *model.considered]
    known = np.array([unknown.prior_mean for unknown in everything])
    point = known
    for group in readings:
        point = group.start(everything, point) if isinstance(group, TriadPoses) else point
    limits = np.array([unknown.limit for unknown in everything])
    # One reading with the wrong sign drives what is known beforehand so far that nothing is linear.
    stated = np.array([math.isfinite(unknown.prior[1]) for unknown in everything])
    farthest = np.where(stated, _FARTHEST * limits, np.inf)
    noise = (
        [_first_noise(group) for group in readings]
        if together is None
        else [g.noise for g in together.groups]
    )
    # What is considered is in the residuals too. Noise and the point of the derivatives are found
    # beside it, as if it were estimated with its prior: else it would be taken for noise, and what
    # looks like it would leave its prior so far that derivatives there are not the machine's.
    relaxed, variance = bool(model.considered), None
    alone = not beside and len(readings) == 1
    free = sum(math.isinf(unknown.prior[1]) for unknown in everything) if alone else 0
    posed = {name for g in readings if isinstance(g, TriadPoses) for name in g.accelerometers}
    turned = [place for place, u in enumerate(model.unknowns) if u.owner in posed]
    for _ in range(_ROUNDS):
        parts = [group.linearised(model, point, variance) for group in readings]
        # The columns hold while only the noise is another.
        for _ in range(_NOISE_ROUNDS):
            weighted = [part.with_noise(size) for part, size in zip(parts, noise, strict=True)]
            blocks = [part.weighed() for part in weighted]
            solution = solve_blocks([*beside, *blocks], model)
            before, followed, found = noise, weighted, solution
            if relaxed:
                followed = [part.relaxed(len(model.unknowns)) for part in weighted]
                found = solve_relaxed([*beside, *blocks], model)
            if together is not None:
                break
            noise = [
                _noise_again(group, part, found, Unknowns(model.unknowns), own, free)
                for group, part, own in zip(readings, followed, before, strict=True)
            ]
            changes = (abs(new / old - 1.0) for new, old in zip(noise, before, strict=True))
            if max(changes) < _TOLERANCE:
                break
        estimate, u = found.estimate[: known.size], found.u[: known.size]
        place = _place(estimate, found, known, limits, farthest, turned)
        variance = u**2
        moves, point = np.abs(place - point) / np.where(u > 0, u, 1.0), place
        if moves.max(initial=0.0) < _LARGEST_MOVE:
            break
    else:
        for group in readings:
            if isinstance(group, TriadPoses):
                raise ConvergenceError(_do_not_settle(group))
        name = _furthest_off(readings, beside, model)
        raise ConvergenceError(
            f"the fit of the readings did not converge in {_ROUNDS} rounds; check "
            f'"{name}", which is furthest off the others: its sign, digits and unit, and whether '
            "it was exchanged with another. Else give the machine's terms priors, or state the "
            "standard uncertainties of the readings"
        )
    dof = [
        part.freedom_of_noise(found) + group.freedom_of_repeats if group.u is None else math.inf
        for group, part in zip(readings, followed, strict=True)
    ]
    if together is not None:
        dof = [group.dof for group in together.groups]
    told = {
        part.source: Noise(size)
        for group, part, size in zip(readings, weighted, noise, strict=True)
        if group.u is None
    }
    fit = JointFit(model, solution, tuple(weighted), tuple(blocks), told)
    if records is not None:
        fit = replace(
            records,
            solution=replace(solution, covariance_unseen=records.solution.covariance_unseen),
            observations=(*records.prepared, *weighted),
            blocks=(*beside, *blocks),
            noise={**records.noise, **told},
        )
    groups = (
        FittedReadings(group, part, size, freedom).under(fit)
        for group, part, size, freedom in zip(readings, weighted, noise, dof, strict=True)
    )
    return ReadingsFit(fit, tuple(groups))


def _furthest_off(
    readings: Sequence[Readings | TriadPoses], beside: Sequence[Block], model: Unknowns
) -> str:
    """Return the name of the reading that is furthest off a fit with all that is known as it is."""
    known = np.array([other.prior_mean for other in (*model.unknowns, *model.considered)])
    parts = [group.linearised(model, known, None).with_noise(1.0) for group in readings]
    solution = solve_blocks([*beside, *(part.weighed() for part in parts)], model)
    worst, furthest = "", 0.0
    for group, part in zip(readings, parts, strict=True):
        for place, name in enumerate(group.names):
            off = abs(_position(part, (place,), solution, model, None).standardised)
            if off > furthest:
                worst, furthest = name, off
    return worst


def _position(
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

    def __init__(
        self, part: LinearReadings, solution: Solution, group: Readings | TriadPoses
    ) -> None:
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


def _first_noise(group: Readings | TriadPoses) -> float:
    """Return a noise to begin with: a millionth of the largest indication."""
    return 1e-6 * float(np.max(np.abs(group.value), initial=1e-3))


def _too_few_poses(group: TriadPoses, solution: Solution, model: Unknowns) -> str:
    """Return that poses tell no noise, and what they do not determine besides."""
    free = [u.name for u in model.unknowns if math.isinf(u.prior[1])]
    asked = [unknown.name for unknown in model.unknowns if unknown.asked]
    determined = assess(solution, asked).determined
    lacking = [name for name in asked if not determined[name]]
    besides = f" They do not determine {', '.join(lacking)} at all." if lacking else ""
    angles = [u for u in model.unknowns if u.asked and u.symbol.startswith("delta")]
    fewer = (
        " They can determine biases and scale factors, if these alone are asked for: terms = "
        '["K_F", "K_I"] in [model].'
        if angles and group.size > len(asked) - len(angles)
        else ""
    )
    return (
        f"{group.accelerometer}: {group.size} pose{'s' * (group.size > 1)} at unknown attitudes "
        f"without a stated uncertainty do not determine their noise in addition to "
        f"{len(free)} unknowns without a prior.{besides} Take more poses, spread over all "
        f"directions, or state the uncertainty.{fewer}"
    )


def _do_not_settle(group: TriadPoses) -> str:
    """Return why poses may leave a fit without an end: they lie too near each other."""
    unit = group.value / np.linalg.norm(group.value, axis=1)[:, None]
    middle = unit.mean(axis=0)
    widest = math.degrees(math.acos(np.clip(np.min(unit @ middle) / np.linalg.norm(middle), -1, 1)))
    return (
        f"{group.accelerometer}: the fit of {group.size} poses did not converge in {_ROUNDS} "
        f"rounds. They lie within {widest:.0f} deg of one direction; take poses all over the "
        f"sphere, or "
        "give the coefficients priors."
    )


def _noise_again(
    group: Readings | TriadPoses,
    part: LinearReadings,
    solution: Solution,
    model: Unknowns,
    own: float,
    free: int,
) -> float:
    """Return the noise that the residuals show; its fixed point is the REML estimate.

    free: Unknowns that nothing but the group can tell.
    """
    if group.u is not None:
        return 1.0
    left_over = 1.0 - part.leverages(solution)
    again = group.freedom_of_repeats
    few = left_over.sum() + again < 0.5
    if isinstance(group, TriadPoses) and (few or group.size + again <= free):
        raise NotIdentifiableError(_too_few_poses(group, solution, model))
    if few:
        raise NotIdentifiableError(
            f"{group.accelerometer}: {group.size} readings ({group.motion}) without a stated "
            f"uncertainty do not determine their noise in addition to the unknowns; state it, or "
            "take more readings than there are unknowns"
        )
    # Where the head's part is known, the score of the rest: each reading by the share that it has.
    share = part.noise_share
    left = part.left(solution, model) / part.sigma
    squares = float(share @ left**2) + float(group.scatter.sum()) / own**2
    size = own * math.sqrt(squares / (float(share @ left_over) + again))
    if again < FEWEST_FREEDOM:
        size = max(size, _LEAST_BESIDE_HEAD * float(np.sqrt(np.mean(part.head**2))))
    # Beside unstated terms a fit may follow every digit of readings without any noise.
    return max(size, group.least_noise)
