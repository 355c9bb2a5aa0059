"""Poses of a triad at unknown attitudes: of each, what three accelerometers say of |f|.

At rest the specific force is g, in a direction that the pose's own two angles give. Turning the
triad a little moves its three indications in a plane, so that one combination of them, along the
force, is left once the angles are eliminated: one row a pose, whatever the noise of each
accelerometer. The angles themselves are those that fit the three indications best.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.identifiability import assess
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.least_squares import Solution
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.effects import SIGN_WIDTH
from counterspin.physics.terms import CONDITION_TERMS, LINEAR, TERMS
from counterspin.readings.linear import FINEST, LinearReadings
from counterspin.triads.rank import candidates_of, undetermined_parameters

_SYMBOLS: Final = tuple(TERMS)

#: Rounds in which a pose's two angles settle; each leaves a residual's part of the last error.
_ROUNDS: Final = 40

#: Settled: no direction moves by more, rad.
_SETTLED: Final = 1e-14

#: Sensitivities that a start without a guess may find, of the nominal one.
_CREDIBLE: Final = (0.2, 5.0)

#: A quadric whose columns are worse conditioned says nothing of poses.
_WORST_CONDITION: Final = 1e4


@frozen
class TriadPoses:
    """Poses of three accelerometers at rest, n of them, with noise of one kind."""

    accelerometers: tuple[str, ...]  #: Their names, the first two of which span the frame.
    names: tuple[str, ...]  #: Of the poses.
    #: Each accelerometer's axes I, P, O in the triad's frame, rows, shape (3, 3, 3).
    axes: Array
    gravity: float  #: Of the site, m/s^2.
    #: Indications in g by the nominal sensitivities, and their standard uncertainties, shape
    #: (n, 3); None: one for all, estimated from the residuals.
    value: Array
    u: Array | None
    #: K from the reference temperature, s from the campaign's beginning, shape (n,).
    temperature: Array
    time: Array
    #: How many repeats each indication is the mean of, and the sum of all squares about their
    #: means, g^2, shape (n,). Where `u` is None.
    repeats: Array
    scatter: Array
    #: 1 where a value was written in m/s^2 and became g by the gravity assumed, else 0, (n, 3).
    in_si: Array
    within: float = 0.0  #: What is known of the noise from within the poses, g.
    resolution: float = 0.0  #: One of the last digit that was written, g.
    direction: Array | float = 0.0  #: In which the temperature went, as of `RunConditions`.
    motion: str = "poses"

    @property
    def accelerometer(self) -> str:
        """All of them in one word."""
        return ", ".join(self.accelerometers)

    @property
    def size(self) -> int:
        """The number of poses."""
        return len(self.names)

    @property
    def least_noise(self) -> float:
        """The least noise that they can be said to have, g; see `Readings.least_noise`."""
        largest = float(np.max(np.abs(self.value), initial=1e-3))
        return max(self.within, self.resolution / math.sqrt(12.0), FINEST * largest)

    @property
    def read_again(self) -> tuple[tuple[int, ...], ...]:
        """Nobody knows whether two poses are one."""
        return ()

    @property
    def position(self) -> tuple[str, ...]:
        """Nobody has set them."""
        return ()

    @property
    def freedom_of_repeats(self) -> float:
        """Degrees of freedom that repeats in one pose have among themselves, of all three."""
        return 3.0 * float(np.sum(self.repeats - 1.0))

    def linearised(
        self,
        model: Unknowns,
        estimate: Array,
        variance: Array | None = None,  # noqa: ARG002 -- nothing of a pose is of second order
    ) -> LinearReadings:
        """Return one row a pose at an estimate, the pose's angles eliminated."""
        point = self.at(model, estimate)
        columns = self._columns(point)
        perfect = point.indicated - columns @ point.values
        for index, unknown in enumerate(point.everything):
            if unknown.symbol == "site.gravity":
                columns[:, :, index] += self.in_si * point.indicated / self.gravity
        along = point.along
        rows = np.einsum("nk,nkp->np", along, columns)
        stated = None if self.u is None else np.sqrt(np.sum((along * self.u) ** 2, axis=1))
        nothing = np.zeros(self.size)
        target = np.sum(along * (self.value - perfect), axis=1)
        return LinearReadings.whole(self, model, rows, target, stated, self.repeats, nothing)

    def _columns(self, point: PosesAt) -> Array:
        """Return the derivatives of the indications by everything, shape (n, 3, p)."""
        columns = np.zeros((self.size, 3, len(point.everything)))
        for index, place, term, lever in levers(self, point.everything):
            columns[:, place, index] = point.products[:, place, term] * lever
        return columns

    def curvature(self, model: Unknowns, estimate: Array, moves: Array) -> Array:
        """Return the second-order change of each row as the unknowns move, shape (n, m).

        A move turns the force that the indications give. Its length, which is known, then changes
        by half the square of the turn.

        moves: Of the unknowns from the estimate, shape (p, m).
        """
        point = self.at(model, estimate)
        _, slopes = _products(self.axes, point.direction, point.effective)
        columns = self._columns(point)[:, :, : len(moves)]
        change = np.linalg.solve(slopes, columns @ moves)
        along = np.einsum("nj,njm->nm", point.direction, change)
        turned = change - point.direction[:, :, None] * along[:, None, :]
        squares: Array = np.sum(turned**2, axis=1)
        return 0.5 * point.growth[:, None] * squares

    def at(self, model: Unknowns, estimate: Array) -> PosesAt:
        """Return the poses under the coefficients of an estimate, their angles found.

        estimate: The unknowns less nominal; considered terms that it lacks are as assumed.
        """
        everything = (*model.unknowns, *model.considered)
        assumed = [other.prior_mean for other in everything[len(estimate) :]]
        values = np.append(estimate, assumed)
        effective = np.tile([row.nominal for row in TERMS.values()], (self.size, 3, 1))
        for index, place, term, lever in levers(self, everything):
            effective[:, place, term] += values[index] * lever
        return PosesAt.settled(self, everything, values, effective)

    def start(self, unknowns: Sequence[Unknown], point: Array) -> Array:
        """Return a place to begin at without a guess: of biases, sensitivities and angles."""
        bias, rows = _ellipsoid(self.value, self.axes)
        found = {"K_F": bias}
        for symbol, (axis, sign) in LINEAR.items():
            found[symbol] = sign * np.sum(rows * self.axes[:, axis], axis=1)
        begun = point.copy()
        for index, unknown in enumerate(unknowns):
            if unknown.owner in self.accelerometers and unknown.symbol in found:
                place = self.accelerometers.index(unknown.owner)
                begun[index] = found[unknown.symbol][place] - unknown.nominal
        return begun

    @property
    def triad(self) -> tuple[str, ...]:
        """Names of the accelerometers."""
        return self.accelerometers

    def with_positions_set(self) -> TriadPoses:
        """Return the poses: no position was set."""
        return self

    def with_noise(self, noise: float) -> TriadPoses:
        """Return the poses with a stated noise of one repeat, g."""
        own = noise / np.sqrt(self.repeats)
        return replace(self, u=np.repeat(own[:, None], 3, axis=1))

    def turned_about(self, name: str, turn: Callable[[Mounting], Mounting]) -> TriadPoses:
        """Return the poses with an accelerometer mounted otherwise."""
        if name not in self.accelerometers:
            return self
        axes, place = self.axes.copy(), self.accelerometers.index(name)
        axes[place] = turn(Mounting(tuple(map(tuple, axes[place])))).matrix
        return replace(self, axes=axes)

    def default_candidates(self, model: Unknowns) -> Sequence[Unknown]:
        """Return the requested parameters that the directions may leave undetermined."""
        return candidates_of(model, self.accelerometers)

    def undetermined(
        self, fit: JointFit, model: Unknowns, candidates: Sequence[Unknown]
    ) -> Sequence[Unknown]:
        """Return the candidates that the directions do not determine, as of `Measured`."""
        return undetermined_parameters(fit, model, candidates)

    def lack_of_noise(self, freedom: float, free: int, solution: Solution, model: Unknowns) -> str:
        """Return the error that the residuals do not determine their noise; as of `Measured`."""
        if freedom >= 0.5 and self.size + self.freedom_of_repeats > free:
            return ""
        return _too_few(self, solution, model)

    def divergence(self, rounds: int) -> str:
        """Return the error that the fit did not converge in so many rounds."""
        return _unsettled(self, rounds)


@frozen
class PosesAt:
    """Poses under given coefficients, each turned so that its three indications fit best."""

    everything: tuple[Unknown, ...]  #: What is estimated, then what is considered.
    values: Array  #: Of these, less nominal.
    effective: Array  #: The coefficients at each pose, shape (n, 3, number of `TERMS`).
    direction: Array  #: Of the specific force in the triad's frame, unit vectors, shape (n, 3).
    products: Array  #: Of every term, shape (n, 3, number of `TERMS`).
    indicated: Array  #: By the coefficients, g, shape (n, 3).
    #: The combination of the three indications that no turn changes, unit vectors, (n, 3).
    along: Array
    growth: Array  #: What it grows by as the specific force grows, shape (n,).

    @classmethod
    def settled(
        cls,
        poses: TriadPoses,
        everything: tuple[Unknown, ...],
        values: Array,
        effective: Array,
    ) -> Self:
        """Return the poses with the directions that fit their indications best."""
        weight = np.ones((poses.size, 3)) if poses.u is None else 1.0 / poses.u
        direction = _first_directions(poses, effective)
        for _ in range(_ROUNDS):
            products, slopes = _products(poses.axes, direction, effective)
            left = weight * (poses.value - np.sum(products * effective, axis=2))
            aside = _aside(direction)
            turning = weight[:, :, None] * (slopes @ aside)
            gram = np.swapaxes(turning, 1, 2) @ turning
            step = np.linalg.solve(gram, np.swapaxes(turning, 1, 2) @ left[:, :, None])
            moved = direction + (aside @ step)[:, :, 0]
            direction = moved / np.linalg.norm(moved, axis=1)[:, None]
            if np.max(np.abs(step), initial=0.0) < _SETTLED:
                break
        products, slopes = _products(poses.axes, direction, effective)
        turning = slopes @ _aside(direction)
        along = np.cross(turning[:, :, 0], turning[:, :, 1])
        along /= np.linalg.norm(along, axis=1)[:, None]
        growth = np.einsum("nk,nkj,nj->n", along, slopes, direction)
        sign = np.where(growth < 0.0, -1.0, 1.0)
        return cls(
            everything,
            values,
            effective,
            direction,
            products,
            np.sum(products * effective, axis=2),
            along * sign[:, None],
            growth * sign,
        )


def indications_along(
    poses: TriadPoses, coefficients: Sequence[Mapping[str, float]], direction: Array
) -> Array:
    """Return the indications of a triad in poses of given directions, g, shape (n, 3).

    coefficients: Of each accelerometer, slopes included; those not named are nominal.
    direction: Of the specific force in the triad's frame: unit vectors at rest, in motion the force
        itself in g; shape (n, 3).
    """
    effective = np.tile([row.nominal for row in TERMS.values()], (poses.size, 3, 1))
    for place, own in enumerate(coefficients):
        for symbol, value in own.items():
            if symbol in TERMS:
                effective[:, place, _SYMBOLS.index(symbol)] += value - TERMS[symbol].nominal
            elif (lever := lever_of(poses, symbol)) is not None:
                effective[:, place, _changing(symbol)] += value * lever
    products, _ = _products(poses.axes, direction, effective)
    return np.asarray(np.sum(products * effective, axis=2), np.float64)


def lever_of(poses: TriadPoses, symbol: str) -> Array | None:
    """Return by what a slope is multiplied, shape (n,); None if it is nothing at rest."""
    slope = CONDITION_TERMS[symbol].effect
    if slope.condition == "force":
        return None
    ways = np.broadcast_to(poses.direction, poses.size)
    return slope.design_factors(poses.time, poses.temperature, ways, np.zeros(poses.size))


def _changing(symbol: str) -> int:
    """Return the place of the term that a slope changes."""
    return _SYMBOLS.index(CONDITION_TERMS[symbol].effect.coefficient)


def levers(
    poses: TriadPoses, everything: Sequence[Unknown]
) -> Iterator[tuple[int, int, int, Array]]:
    """Yield for each coefficient, or slope of one: its index, whose, of which term, times what."""
    for index, unknown in enumerate(everything):
        if unknown.owner not in poses.accelerometers:
            continue
        place, symbol = poses.accelerometers.index(unknown.owner), unknown.symbol
        if symbol in TERMS:
            yield index, place, _SYMBOLS.index(symbol), np.ones(poses.size)
        elif symbol in CONDITION_TERMS:
            lever = lever_of(poses, symbol)
            if lever is not None:
                yield index, place, _changing(symbol), lever


def _products(axes: Array, direction: Array, effective: Array) -> tuple[Array, Array]:
    """Return every term's product, and the slopes of the indications by the direction, at poses.

    Returns: shapes (n, 3, number of `TERMS`) and (n, 3, 3).
    """
    a_ipo = np.einsum("kij,nj->ink", axes, direction)
    rows = [row.effect for row in TERMS.values()]
    products = np.stack([effect.evaluate(a_ipo, sign_width=SIGN_WIDTH) for effect in rows], axis=-1)
    by_axis = np.zeros((*a_ipo.shape[1:], 3))
    for place, effect in enumerate(rows):
        if not effective[:, :, place].any():
            continue
        for axis, name in enumerate("IPO"):
            by_axis[:, :, axis] += effective[:, :, place] * effect.slope(a_ipo, name)
    return products, np.einsum("nki,kij->nkj", by_axis, axes)


def _aside(direction: Array) -> Array:
    """Return two unit vectors at right angles to each direction and other, shape (n, 3, 2)."""
    least = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    first = np.cross(direction, least)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(direction, first)], axis=2)


def _first_directions(poses: TriadPoses, effective: Array) -> Array:
    """Return the directions that bias, sensitivity and misalignments alone give."""
    bias, rows = effective[:, :, _SYMBOLS.index("K_F")], np.zeros((poses.size, 3, 3))
    for symbol, (axis, sign) in LINEAR.items():
        along = sign * effective[:, :, _SYMBOLS.index(symbol)]
        rows += along[:, :, None] * poses.axes[:, axis]
    found = np.asarray(np.linalg.solve(rows, (poses.value - bias)[:, :, None])[:, :, 0], np.float64)
    return np.asarray(found / np.linalg.norm(found, axis=1)[:, None], np.float64)


def _ellipsoid(value: Array, axes: Array) -> tuple[Array, Array]:
    """Return biases and the vectors along which the three feel, as poses show them without a guess.

    First one sensitivity for all by the norm of the indications, then a sphere, then an ellipsoid,
    each where the poses determine it.

    Returns: g, shape (3,); in the triad's frame, g/g, shape (3, 3).
    """
    nominal = axes[:, 0]
    plain: Array = np.asarray(np.linalg.solve(nominal, value.T).T, np.float64)
    size = float(np.sqrt(np.mean(np.sum(plain**2, axis=1))))
    bias, gram = np.zeros(3), size**2 * np.eye(3)
    sphere = _least_squares(2.0 * plain, np.sum(plain**2, axis=1), constant=True)
    if sphere is not None:
        square = sphere[3] + float(sphere[:3] @ sphere[:3])
        if _are_credible(np.array([square])) and np.linalg.norm(sphere[:3]) < _CREDIBLE[1]:
            bias, gram = sphere[:3], square * np.eye(3)
    x, y, z = (plain - bias).T
    columns = np.column_stack(
        [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z]
    )
    quadric = _least_squares(columns, np.ones(len(plain)))
    if quadric is not None:
        xx, yy, zz, xy, xz, yz = quadric[:6]
        form = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if np.linalg.eigvalsh(form)[0] > 0.0:
            centre = -np.linalg.solve(form, quadric[6:])
            spread = (1.0 + centre @ form @ centre) * np.linalg.inv(form)
            if _are_credible(np.linalg.eigvalsh(spread)):
                bias, gram = bias + centre, np.asarray(spread, np.float64)
    gram = nominal @ gram @ nominal.T
    frame = np.stack([nominal[0], np.zeros(3), np.cross(nominal[0], nominal[1])])
    frame[2] /= np.linalg.norm(frame[2])
    frame[1] = np.cross(frame[2], frame[0])
    lower = np.linalg.cholesky(np.asarray(gram, np.float64))
    lower[:, 2] *= 1.0 if nominal[2] @ frame[2] > 0.0 else -1.0
    return nominal @ bias, lower @ frame


def _are_credible(squares: npt.NDArray[np.float64]) -> bool:
    low, high = _CREDIBLE
    return bool(np.all((squares > low**2) & (squares < high**2)))


def _least_squares(columns: Array, target: Array, *, constant: bool = False) -> Array | None:
    """Return the solution; None where the rows do not determine it."""
    ones = np.ones((target.size, int(constant)))
    every: Array = np.hstack([columns, ones])
    sizes = np.linalg.norm(every, axis=0)
    if every.shape[0] < every.shape[1] or not sizes.all():
        return None
    if np.linalg.cond(every / sizes) > _WORST_CONDITION:
        return None
    return np.asarray(np.linalg.lstsq(every, target, rcond=None)[0], np.float64)


def _too_few(poses: TriadPoses, solution: Solution, model: Unknowns) -> str:
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
        if angles and poses.size > len(asked) - len(angles)
        else ""
    )
    return (
        f"{poses.accelerometer}: {poses.size} pose{'s' * (poses.size > 1)} at unknown attitudes "
        f"without a stated uncertainty do not determine their noise in addition to "
        f"{len(free)} unknowns without a prior.{besides} Take more poses, spread over all "
        f"directions, or state the uncertainty.{fewer}"
    )


def _unsettled(poses: TriadPoses, rounds: int) -> str:
    """Return why poses may leave a fit without an end: they lie too near each other."""
    unit = poses.value / np.linalg.norm(poses.value, axis=1)[:, None]
    middle = unit.mean(axis=0)
    widest = math.degrees(math.acos(np.clip(np.min(unit @ middle) / np.linalg.norm(middle), -1, 1)))
    return (
        f"{poses.accelerometer}: the fit of {poses.size} poses did not converge in {rounds} "
        f"rounds. They lie within {widest:.0f} deg of one direction; take poses all over the "
        f"sphere, or "
        "give the coefficients priors."
    )
