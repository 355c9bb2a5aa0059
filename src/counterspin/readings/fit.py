"""Readings, and poses at unknown attitudes, as data of the joint fit.

The derivatives are taken at what readings and priors together say, and taken again there until it
settles. The readings become blocks of square-root information, which are solved together with the
blocks of records.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Final, TypeVar

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import ConvergenceError, NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.joint.fit import JointFit, solve_blocks
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.least_squares import Solution
from counterspin.inference.noise.model import Noise
from counterspin.physics.terms import HEAD_WAVES
from counterspin.readings.fitted import FEWEST_FREEDOM, FittedReadings, position_of
from counterspin.readings.linear import LinearReadings, Measured

U = TypeVar("U", bound=Unknown)

#: Rounds in which derivatives and noise must settle; two or three are usual.
_ROUNDS: Final = 100

#: The same for the noise alone, which may approach zero slowly.
_NOISE_ROUNDS: Final = 200

#: Estimated noise is no smaller than this part of what the head's angle adds (rms), or the few
#: positions where the head adds nothing would be taken for exact. Enough repeats tell it.
_LEAST_BESIDE_HEAD: Final = 0.3

#: Part of a standard uncertainty that is as good as none.
_HELD: Final = 1e-6

#: Rounds in which an unknown goes all the way to where it is found.
_WHOLE_STEPS: Final = 15

#: How many times its largest credible size an unknown may have where derivatives are taken.
_FARTHEST: Final = 10.0

#: Settled: nothing moves by more than this part of its uncertainty, no noise by this part.
_LARGEST_MOVE: Final = 1e-5
_TOLERANCE: Final = 1e-6


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
    readings: Sequence[Measured], model: Unknowns, records: JointFit | None = None
) -> ReadingsFit:
    """Estimate a model from readings, together with what records say.

    A requested parameter of a triad that the directions of its poses do not determine gets its
    default prior; the model of the fit says which.

    model: What is estimated and considered. Of the inputs radius, gravity and latitude count here.
    """
    first = None
    for group in readings:
        if candidates := group.default_candidates(model):
            first = _solved_or_held(readings, model.with_default_priors(candidates), records)
            lacking = group.undetermined(first.fit, model, candidates)
            model = model.with_default_priors(lacking)
            break
    found = _solved_or_held(readings, model, records, first)
    return replace(found, groups=tuple(group.evaluate(found.fit) for group in found.groups))


def _solved_or_held(
    readings: Sequence[Measured],
    model: Unknowns,
    records: JointFit | None,
    start: ReadingsFit | None = None,
) -> ReadingsFit:
    """Return the solved problem, with what hides the noise held where few readings tell both.

    start: A fit to begin with; None: the prior means, or the ellipsoid of the poses.
    """
    try:
        return _solved(readings, model, records, start)
    except NotIdentifiableError as error:
        set_by_hand = any(group.u is None and any(group.position) for group in readings)
        models = [m for m in _with_less(readings, model) if set_by_hand or m != model]
        not_determined = error
    # Errors of positions that are hardly read twice hide the noise, and so do nuisance terms in few
    # readings or poses. The residuals show both together, which is an upper limit of the noise.
    unset = [group.with_positions_set() for group in readings]
    for bare in models:
        try:
            together = _solved(unset, bare, records, start)
        except NotIdentifiableError as error:
            not_determined = error
        else:
            return _solved(readings, model, records, start, together)
    raise not_determined


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


def _with_less(readings: Sequence[Measured], model: Unknowns) -> Iterator[Unknowns]:
    """Yield models that hold ever more terms that hide the noise of readings or poses without u.

    Of poses all nuisance terms are held. Of readings the waves of the dividing head that have
    default priors are held first, and then the accelerometer's terms that have default priors too.
    """
    without_u = [group for group in readings if group.u is None]
    posed = {name for group in without_u for name in group.triad}
    read = {group.accelerometer for group in without_u if not group.triad}
    for owners in (set(), read) if read else (set(),):

        def held(other: U, owners: Collection[str] = owners) -> U:
            hides = other.owner in posed
            if other.unstated and read:
                hides |= other.owner in owners or other.symbol.startswith(HEAD_WAVES)
            if not hides or other.asked or math.isinf(other.prior[1]):
                return other
            return replace(other, prior=(other.prior[0], _HELD * other.prior[1]))

        yield Unknowns(tuple(map(held, model.unknowns)), tuple(map(held, model.considered)))


def _solved(
    readings: Sequence[Measured],
    model: Unknowns,
    records: JointFit | None,
    start: ReadingsFit | None = None,
    together: ReadingsFit | None = None,
) -> ReadingsFit:
    """Return the solved problem, its groups not yet judged under the fit.

    start: As of `_solved_or_held`.
    together: A fit whose noise is taken; None: the noise is estimated.
    """
    everything = [*model.unknowns, *model.considered]
    known = np.array([unknown.prior_mean for unknown in everything])
    point = known if start is None else start.fit.relaxed.estimate[: known.size]
    for group in readings if start is None else ():
        point = group.start(everything, point)
    limits = np.array([unknown.limit for unknown in everything])
    # One reading with the wrong sign drives what is known beforehand so far that nothing is linear.
    stated = np.array([math.isfinite(unknown.prior[1]) for unknown in everything])
    farthest = np.where(stated, _FARTHEST * limits, np.inf)
    noise = [_first_noise(group) for group in readings]
    if (known_noise := together or start) is not None:
        noise = [group.noise for group in known_noise.groups]
    # What is considered is in the residuals too. Noise and the point of the derivatives are found
    # beside it, as if it were estimated with its prior: else it would be taken for noise, and what
    # looks like it would leave its prior so far that derivatives there are not the machine's.
    variance = None
    alone = records is None and len(readings) == 1
    free = sum(math.isinf(unknown.prior[1]) for unknown in everything) if alone else 0
    posed = {name for group in readings for name in group.triad}
    turned = [place for place, u in enumerate(model.unknowns) if u.owner in posed]
    for count in range(_ROUNDS):
        parts = [group.linearised(model, point, variance) for group in readings]
        # The columns hold while only the noise is another.
        for _ in range(_NOISE_ROUNDS):
            weighted = [part.with_noise(size) for part, size in zip(parts, noise, strict=True)]
            fit, before = _beside(records, weighted, model), noise
            followed = [part.relaxed(len(model.unknowns)) for part in weighted]
            if together is not None:
                break
            noise = [
                _noise_again(group, part, fit.relaxed, Unknowns(model.unknowns), own, free)
                for group, part, own in zip(readings, followed, before, strict=True)
            ]
            changes = (abs(new / old - 1.0) for new, old in zip(noise, before, strict=True))
            if max(changes) < _TOLERANCE:
                break
        found = fit.relaxed
        estimate, u = found.estimate[: known.size], found.u[: known.size]
        place = _place(estimate, found, known, limits, farthest, turned)
        variance = u**2
        moves = np.abs(place - point) / np.where(u > 0, u, 1.0)
        # Positions that were set by hand may turn to and fro: then half of the way is taken.
        point = place if count < _WHOLE_STEPS else 0.5 * (point + place)
        if moves.max(initial=0.0) < _LARGEST_MOVE:
            break
    else:
        for group in readings:
            if why := group.divergence(_ROUNDS):
                raise ConvergenceError(why)
        name = _furthest_off(readings, records, model)
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
        dof = [group.noise_dof for group in together.groups]
    told = {
        part.source: Noise(size)
        for group, part, size in zip(readings, parts, noise, strict=True)
        if group.u is None
    }
    fit = replace(fit, noise=told)
    if records is not None:
        hidden = replace(fit.solution, covariance_unseen=records.solution.covariance_unseen)
        noises = {**records.noise, **told}
        fit = replace(fit, solution=hidden, noise=noises, unseen=records.unseen)
    groups = (
        FittedReadings(group, part, size, freedom)
        for group, part, size, freedom in zip(readings, parts, noise, dof, strict=True)
    )
    return ReadingsFit(fit, tuple(groups))


def _beside(
    records: JointFit | None, weighted: Sequence[LinearReadings], model: Unknowns
) -> JointFit:
    """Return the fit of readings, with the noise that they have, beside the records of another."""
    own, others = tuple(part.weighed() for part in weighted), tuple(weighted)
    if records is None:
        return JointFit(model, solve_blocks(own, model), others, own, {})
    blocks = (*records.blocks[: len(records.prepared)], *own)
    return JointFit(model, solve_blocks(blocks, model), (*records.prepared, *others), blocks, {})


def _furthest_off(readings: Sequence[Measured], records: JointFit | None, model: Unknowns) -> str:
    """Return the name of the reading that is furthest off a fit with all that is known as it is."""
    known = np.array([other.prior_mean for other in (*model.unknowns, *model.considered)])
    parts = [group.linearised(model, known, None).with_noise(1.0) for group in readings]
    solution = _beside(records, parts, model).solution
    worst, furthest = "", 0.0
    for group, part in zip(readings, parts, strict=True):
        for place, name in enumerate(group.names):
            off = abs(position_of(part, (place,), solution, model, None).standardised)
            if off > furthest:
                worst, furthest = name, off
    return worst


def _first_noise(group: Measured) -> float:
    """Return a noise to begin with: a millionth of the largest indication."""
    return 1e-6 * float(np.max(np.abs(group.value), initial=1e-3))


def _noise_again(
    group: Measured,
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
    if why := group.lack_of_noise(float(left_over.sum()) + again, free, solution, model):
        raise NotIdentifiableError(why)
    # Where the head's part is known, the score of the rest: each reading by the share that it has.
    share = part.noise_share
    left = part.left(solution, model) / part.sigma
    squares = float(share @ left**2) + float(group.scatter.sum()) / own**2
    size = own * math.sqrt(squares / (float(share @ left_over) + again))
    if again < FEWEST_FREEDOM:
        size = max(size, _LEAST_BESIDE_HEAD * float(np.sqrt(np.mean(part.head**2))))
    # Beside unstated terms a fit may follow every digit of readings without any noise.
    return max(size, group.least_noise)
