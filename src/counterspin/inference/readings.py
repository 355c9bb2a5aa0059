"""Readings: single values at rest, on an arm or on a turntable, as data of the joint fit.

A reading is linear in the coefficients and nearly so in what the machine does; the derivatives are
taken at what readings and priors together say, and taken again there until it settles. The readings
become blocks of square-root information, which are solved together with the blocks of records.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import ConvergenceError, NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.blocks import Block, reduce_block
from counterspin.inference.joint.fit import solve_blocks, solve_relaxed
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.least_squares import Solution
from counterspin.physics.motion import Site
from counterspin.physics.station import Station, mean_products, moved
from counterspin.physics.terms import CONDITION_TERMS, TERMS, is_term, mounting_of, term

#: Rounds in which derivatives and noise must settle; two or three are usual.
_ROUNDS: Final = 50

#: The same for the noise alone, which may approach zero slowly.
_NOISE_ROUNDS: Final = 200

#: Estimated noise is no smaller than this part of what the head's angle adds (rms), or the few
#: positions where the head adds nothing would be taken for exact. Enough repeats tell it.
_LEAST_BESIDE_HEAD: Final = 0.3

#: Readings without any noise, but for one that is off, leave this chi-square of the others.
_LEAST_REST: Final = 1e-6

#: Least degrees of freedom from which residuals are judged, and repeats tell the noise alone.
FEWEST_FREEDOM: Final = 5.0

#: Settled: nothing moves by more than this part of its uncertainty, no noise by this part.
_LARGEST_MOVE: Final = 1e-5
_TOLERANCE: Final = 1e-6

#: Step of a machine term's derivative, of its largest credible size: large, for little rounding.
_STEP: Final = 1e-2

#: Uncertain inputs that readings feel, and the step of each derivative: m, m/s^2, rad.
_INPUT_STEPS: Final = {"centrifuge.radius": 1e-4, "site.gravity": 1e-3, "site.latitude": 1e-3}

#: Step of the derivative by the dividing head's angle, rad.
_HEAD_STEP: Final = 1e-5

_SYMBOLS: Final = tuple(TERMS)


@frozen
class Readings:
    """Readings of one accelerometer in one motion, n of them, with noise of one kind."""

    #: Its name, and the motion of every station.
    accelerometer: str
    motion: str
    names: tuple[str, ...]  #: Of the readings.
    site: Site  #: Where they were taken.
    stations: tuple[Station, ...]  #: Axes and machine of each.
    mountings: tuple[str, ...]  #: Name of each reading's mounting; empty where it has none.
    #: Axis about which the dividing head turned, in the station's frame, shape (n, 3); zero without
    #: one.
    head: Array
    #: Random standard uncertainty of the head's angle at each position, rad, shape (n,).
    u_head: Array
    #: Indication in g by the nominal sensitivity, and its standard uncertainty, shape (n,); None:
    #: one for all, estimated from the residuals.
    value: Array
    u: Array | None
    #: K from the reference temperature, s from the first reading, shape (n,).
    temperature: Array
    time: Array
    #: How many repeats at one setting each value is the mean of, and the sum of their squares about
    #: it, g^2, shape (n,). Where `u` is None.
    repeats: Array
    scatter: Array
    #: 1 where a value was written in m/s^2 and became g by the gravity assumed, else 0.
    in_si: Array | float = 0.0

    def products(self, machine: Mapping[str, float]) -> Array:
        """Return every term's mean product at each reading, shape (n, number of `TERMS`).

        machine: The machine's terms that move stations, less nominal, by symbol.
        """
        return mean_products(self.stations_with(machine), self.site)

    def stations_with(self, machine: Mapping[str, float]) -> list[Station]:
        """Return where the readings were taken, with the machine's terms as given."""
        stations = list(self.stations)
        for symbol, size in machine.items():
            if size != 0.0:
                stations = self.moved(stations, symbol, size)
        return stations

    def moved(self, stations: Sequence[Station], symbol: str, size: float) -> list[Station]:
        """Return the readings' stations, moved already, with one more of the machine's terms."""
        return [
            moved(station, symbol, size, head) if acting else station
            for station, acting, head in zip(stations, self.acting(symbol), self.head, strict=True)
        ]

    def turned(self, stations: Sequence[Station], by: Array) -> list[Station]:
        """Return stations with the head's angle off by so much at each, rad, shape (n,)."""
        every = zip(stations, by.tolist(), self.head, strict=True)
        return [moved(station, "head.zero", angle, head) for station, angle, head in every]

    @property
    def read_again(self) -> tuple[tuple[int, ...], ...]:
        """Places of the readings of each position that was read more than once."""
        same: dict[tuple[object, ...], list[int]] = {}
        for place, (station, mounting) in enumerate(
            zip(self.stations, self.mountings, strict=True)
        ):
            # Where an axis points is known to rounding only.
            axes = tuple(np.round(station.mounting.matrix, 9).ravel().tolist())
            same.setdefault((axes, station.rate, mounting), []).append(place)
        return tuple(tuple(places) for places in same.values() if len(places) > 1)

    @property
    def size(self) -> int:
        """The number of readings."""
        return len(self.stations)

    def acting(self, symbol: str) -> Array:
        """Return 1 for each reading on which a term of the machine acts, else 0, shape (n,)."""
        if not is_term(symbol) or self.motion not in term(symbol).motions:
            return np.zeros(self.size)
        mounting = mounting_of(symbol)
        if not mounting:
            return np.ones(self.size)
        return np.array([float(own == mounting) for own in self.mountings])

    def lever(self, symbol: str) -> Array:
        """Return what a slope of a coefficient is multiplied with: K, s or g^2, shape (n,)."""
        condition = CONDITION_TERMS[symbol].effect.condition
        if condition == "force":
            g = self.site.gravity
            forces = [station.radius * station.rate**2 / g for station in self.stations]
            return np.asarray(np.square(forces))
        return self.temperature if condition == "temperature" else self.time


@frozen
class ReadingsFit:
    """A solved problem with readings; lists are in the order of the `Readings`."""

    solution: Solution  #: Estimates less nominal.
    blocks: tuple[Block, ...]  #: The readings' square-root information.
    #: Standard uncertainty of each reading, the head's part included, g, shape (n,).
    sigma: tuple[Array, ...]
    #: Of one repeat where it was estimated, g; elsewhere it means nothing.
    noise: tuple[float, ...]
    #: Degrees of freedom of an estimated noise; infinite where it was stated.
    dof: tuple[float, ...]
    freedom: tuple[float, ...]  #: Readings less what the fit follows of them.
    residuals: tuple[Array, ...]  #: Reading less model at the estimate, g, shape (n,).
    squares: tuple[float, ...]  #: Chi-square of the residuals, by noise and considered terms.
    #: Each reading by itself, and for each position that was read more than once its readings.
    single: tuple[tuple[Position, ...], ...]
    positions: tuple[tuple[Position, ...], ...]
    linear: tuple[_Part, ...]  #: The readings linearised at the estimate, for `judge`.


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
    #: degrees of freedom of that; infinite where noise is stated.
    beside_others: float
    dof: float


def solve_readings(
    readings: Sequence[Readings], model: Unknowns, beside: Sequence[Block] = ()
) -> ReadingsFit:
    """Estimate a model from readings, together with what records say.

    model: What is estimated and considered. Of the inputs radius, gravity and latitude count here.
    """
    everything = [*model.unknowns, *model.considered]
    point = known = np.array([unknown.prior_mean for unknown in everything])
    limits = np.array([unknown.limit for unknown in everything])
    noise = [_first_noise(group) for group in readings]
    # What is considered is in the residuals too. Noise and the point of the derivatives are found
    # beside it, as if it were estimated with its prior: else it would be taken for noise, and what
    # looks like it would leave its prior so far that derivatives there are not the machine's.
    relaxed = bool(model.considered)
    for _ in range(_ROUNDS):
        parts = [_Part.of(group, model, point) for group in readings]
        # The columns hold while only the noise is another.
        for _ in range(_NOISE_ROUNDS):
            weighted = [part.with_noise(size) for part, size in zip(parts, noise, strict=True)]
            blocks = [part.block() for part in weighted]
            solution = solve_blocks([*beside, *blocks], model)
            before, followed, found = noise, weighted, solution
            if relaxed:
                followed = [part.relaxed() for part in weighted]
                found = solve_relaxed([*beside, *blocks], model)
            noise = [
                _noise_again(group, part, found, Unknowns(model.unknowns), own)
                for group, part, own in zip(readings, followed, before, strict=True)
            ]
            changes = (abs(new / old - 1.0) for new, old in zip(noise, before, strict=True))
            if max(changes) < _TOLERANCE:
                break
        estimate, u = found.estimate[: known.size], found.u[: known.size]
        # What is not determined, and may be anything, is no place to take derivatives at.
        place = np.where(u < limits, estimate, known)
        moves, point = np.abs(place - point) / np.where(u > 0, u, 1.0), place
        if moves.max(initial=0.0) < _LARGEST_MOVE:
            break
    else:
        raise ConvergenceError(
            f"the fit of the readings did not settle in {_ROUNDS} rounds; give the terms of the "
            "machine priors, or state the standard uncertainties of the readings"
        )
    judged = [
        judge(group, part, solution, model, (other, found))
        for group, part, other in zip(readings, weighted, followed, strict=True)
    ]
    freedom = tuple(each.freedom for each in judged)
    return ReadingsFit(
        solution,
        tuple(blocks),
        tuple(part.sigma for part in weighted),
        tuple(noise),
        tuple(
            part.freedom_of_noise(found) + _freedom_of_repeats(group)
            if group.u is None
            else math.inf
            for group, part in zip(readings, followed, strict=True)
        ),
        freedom,
        tuple(each.residuals for each in judged),
        tuple(each.squares for each in judged),
        tuple(each.single for each in judged),
        tuple(each.positions for each in judged),
        tuple(weighted),
    )


@frozen
class Judged:
    """How readings fit a solution; as the attributes of `ReadingsFit`, of one group."""

    freedom: float
    residuals: Array
    squares: float
    single: tuple[Position, ...]
    positions: tuple[Position, ...]


def judge(
    group: Readings,
    part: _Part,
    solution: Solution,
    model: Unknowns,
    relaxed: tuple[_Part, Solution] | None = None,
) -> Judged:
    """Return how readings fit a solution that has followed them, perhaps with others beside.

    relaxed: The same with what is considered among the unknowns, by which noise is estimated.
    """
    noise = None if group.u is not None else _NoiseWithout(*(relaxed or (part, solution)), group)

    def position(places: Sequence[int]) -> Position:
        return part.position(places, solution, model, noise)

    return Judged(
        part.freedom(solution),
        part.left(solution, model),
        part.squares(solution, model),
        tuple(position((place,)) for place in range(group.size)),
        tuple(position(places) for places in group.read_again),
    )


def blocks_at(readings: Sequence[Readings], model: Unknowns, estimate: Array) -> list[Block]:
    """Return the square-root information of readings whose noise is stated.

    estimate: Where the derivatives are taken: the unknowns less nominal, shape (p,).
    """
    return [_Part.of(group, model, estimate).with_noise(math.nan).block() for group in readings]


def rows_at(
    readings: Sequence[Readings], model: Unknowns, estimate: Array
) -> list[tuple[Array, Array]]:
    """Return the rows of `blocks_at`, reading by reading, with unit variance."""
    parts = [_Part.of(group, model, estimate).with_noise(math.nan) for group in readings]
    return [(part.design / part.sigma[:, None], part.fixed / part.sigma[:, None]) for part in parts]


@frozen
class _Part:
    """Readings linearised at an estimate: target = design @ unknowns + fixed @ considered."""

    design: Array  # (n, p)
    fixed: Array  # (n, q)
    target: Array  # (n,), g, less what a perfect system indicates
    stated: Array | None  # (n,), g, without the head's part
    repeats: Array  # (n,)
    head: Array  # (n,), the head's random part, g
    sigma: Array  # (n,), g, both together

    @classmethod
    def of(cls, group: Readings, model: Unknowns, estimate: Array) -> _Part:
        """Return the columns at an estimate; considered terms that it lacks are as assumed."""
        everything = [*model.unknowns, *model.considered]
        at = np.append(estimate, [term.prior_mean for term in everything[len(estimate) :]])
        own = {
            index: unknown.symbol
            for index, unknown in enumerate(everything)
            if unknown.owner in ("", group.accelerometer)
        }
        machine = {
            symbol: float(at[index])
            for index, symbol in own.items()
            if not everything[index].owner and group.acting(symbol).any()
        }
        stations = group.stations_with(machine)
        products = mean_products(stations, group.site)
        effective = np.tile([row.nominal for row in TERMS.values()], (group.size, 1))
        columns = np.zeros((group.size, len(everything)))
        for index, symbol in own.items():
            if symbol in TERMS:
                place, lever = _SYMBOLS.index(symbol), np.ones(group.size)
            elif everything[index].owner:
                changing = CONDITION_TERMS[symbol].effect.coefficient
                place, lever = _SYMBOLS.index(changing), group.lever(symbol)
            else:
                continue
            columns[:, index] = products[:, place] * lever
            effective[:, place] += at[index] * lever

        def slope(more: Array, less: Array, step: float) -> Array:
            found: Array = np.sum((more - less) * effective, axis=1) / (2.0 * step)
            return found

        def slope_of(symbol: str, step: float) -> Array:
            both = [*group.moved(stations, symbol, step), *group.moved(stations, symbol, -step)]
            more, less = np.split(mean_products(both, group.site), 2)
            return slope(more, less, step)

        for index, symbol in own.items():
            if symbol in machine:
                columns[:, index] = slope_of(symbol, _STEP * everything[index].limit)
        perfect = np.sum(products * effective, axis=1) - columns @ at
        # Derivatives by inputs are taken at what is stated of them, and not at the estimate.
        for index, symbol in own.items():
            if symbol in _INPUT_STEPS:
                step = _INPUT_STEPS[symbol]
                ahead, behind = (_with_input(group, symbol, s, machine) for s in (step, -step))
                columns[:, index] = slope(ahead.products(machine), behind.products(machine), step)
            if symbol == "site.gravity":
                turned = group.in_si * np.sum(products * effective, axis=1)
                columns[:, index] += turned / group.site.gravity
        head = np.zeros(group.size)
        if group.u_head.any():
            turn = np.full(group.size, _HEAD_STEP)
            both = (group.turned(stations, by) for by in (turn, -turn))
            more, less = (mean_products(each, group.site) for each in both)
            head = np.abs(slope(more, less, _HEAD_STEP)) * group.u_head
        return cls(
            columns[:, : len(model.unknowns)],
            columns[:, len(model.unknowns) :],
            group.value - perfect,
            group.u,
            group.repeats,
            head,
            head,
        )

    def with_noise(self, noise: float) -> _Part:
        """Return the same with a noise, of one repeat, for readings that state none."""
        own = noise / np.sqrt(self.repeats) if self.stated is None else self.stated
        return replace(self, sigma=np.hypot(own, self.head))

    def relaxed(self) -> _Part:
        """Return the same with what is considered among the unknowns, after the others."""
        every = np.hstack([self.design, self.fixed])
        return replace(self, design=every, fixed=self.fixed[:, :0])

    def block(self) -> Block:
        weight = 1.0 / self.sigma[:, None]
        return reduce_block(
            self.design * weight, self.target / self.sigma, None, self.fixed * weight
        )

    def left(self, solution: Solution, model: Unknowns) -> Array:
        """Return the residuals, the considered terms at their assumed values."""
        means = np.array([term.prior_mean for term in model.considered])
        left: Array = self.left_at(solution.estimate) - self.fixed @ means
        return left

    def left_at(self, estimate: Array) -> Array:
        left: Array = self.target - self.design @ estimate
        return left

    def squares(self, solution: Solution, model: Unknowns) -> float:
        """Return chi-square of the residuals, whose covariance the considered terms are part of.

        A considered term that is not what was assumed is no misfit as long as its u allows it: the
        least sum of squares of what is left and of the considered terms over their u (Searle,
        Matrix Algebra Useful for Statistics, 1982, section 10.7, has the identity).
        """
        left = self.left(solution, model) / self.sigma
        moved = self.fixed + self.design @ solution.sensitivity_considered
        moved = moved / self.sigma[:, None] * _spread(model)
        found = np.linalg.lstsq(
            np.vstack([moved, np.eye(moved.shape[1])]),
            np.append(left, np.zeros(moved.shape[1])),
            rcond=None,
        )[0]
        rest = left - moved @ found
        return float(rest @ rest + found @ found)

    def leverages(self, solution: Solution) -> Array:
        """Return how far the fit follows each reading: 0 not at all, 1 wholly."""
        rows = self.design / self.sigma[:, None]
        followed: Array = np.sum((rows @ solution.least_covariance) * rows, axis=1)
        clipped: Array = np.clip(followed, 0.0, 1.0)
        return clipped

    def freedom(self, solution: Solution) -> float:
        """Return the readings less what the fit follows of them."""
        return float(np.sum(1.0 - self.leverages(solution)))

    def freedom_of_noise(self, solution: Solution) -> float:
        """Return the degrees of freedom of an estimated noise that the residuals give it.

        Twice Fisher's information of the logarithm of its variance in the restricted likelihood
        (Searle, Casella and McCulloch, Variance Components, 1992, section 6.6): the readings less
        the unknowns where nothing is known beforehand and the head adds nothing.
        """
        rows, share = self.design / self.sigma[:, None], self.noise_share
        weighed = solution.least_covariance @ (rows.T @ (share[:, None] * rows))
        once = float(share**2 @ (1.0 - 2.0 * self.leverages(solution)))
        return once + float(np.sum(weighed * weighed.T))

    @property
    def noise_share(self) -> Array:
        """The part that noise has in the variance of each reading, the head having the rest."""
        share: Array = 1.0 - (self.head / self.sigma) ** 2
        return share

    def left_of(self, column: Array, solution: Solution) -> Array:
        """Return what the fit leaves of a column over the standard uncertainties, shape (n,)."""
        rows = self.design / self.sigma[:, None]
        left: Array = column - rows @ (solution.least_covariance @ (rows.T @ column))
        return left

    def position(
        self,
        places: Sequence[int],
        solution: Solution,
        model: Unknowns,
        noise: _NoiseWithout | None,
    ) -> Position:
        """Return the weighted mean of some residuals, and it over its own standard deviation."""
        weights = np.zeros(self.target.size)
        weights[list(places)] = 1.0 / self.sigma[list(places)] ** 2
        weights /= weights.sum()
        own = weights * self.sigma
        column = self.left_of(own, solution)
        left = max(float(own @ column), 0.0)
        moved = weights @ self.fixed + weights @ self.design @ solution.sensitivity_considered
        shifted = moved * _spread(model)
        variance = left + float(shifted @ shifted)
        residual = float(weights @ self.left(solution, model))
        if variance <= 1e-9 * float(own @ own):
            return Position(tuple(places), residual, math.nan, math.nan, math.inf)
        z = residual / math.sqrt(variance)
        if noise is None:
            return Position(tuple(places), residual, z, z, math.inf)
        # The head, priors and what is considered have their parts of the variance too.
        part = min(float(self.noise_share @ column**2) / variance, 1.0)
        scale, dof = noise.beside(own)
        shrunk = 1.0 - part + part * scale
        dof *= (shrunk / (part * scale)) ** 2 if part * scale > 0.0 else math.inf
        return Position(tuple(places), residual, z, z / math.sqrt(shrunk), dof)


class _NoiseWithout:
    """An estimated noise without some of the readings, all else being equal."""

    def __init__(self, part: _Part, solution: Solution, group: Readings) -> None:
        self._part, self._solution = part, solution
        self._share = part.noise_share
        self._residual = part.left_at(solution.estimate) / part.sigma
        again = _freedom_of_repeats(group)
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


def _spread(model: Unknowns) -> Array:
    """Return the standard uncertainties of all that is considered."""
    return np.array(model.considered_sizes, dtype=np.float64)


def _with_input(group: Readings, name: str, by: float, machine: Mapping[str, float]) -> Readings:
    """Return readings with an input changed; a mounting whose radius is a term keeps its own."""
    if name == "site.gravity":
        return replace(group, site=replace(group.site, gravity=group.site.gravity + by))
    if name == "site.latitude":
        return replace(group, site=replace(group.site, latitude=group.site.latitude + by))
    return replace(
        group,
        stations=tuple(
            station
            if f"centrifuge.radius.{mounting}" in machine
            else replace(station, radius=station.radius + by)
            for station, mounting in zip(group.stations, group.mountings, strict=True)
        ),
    )


def _first_noise(group: Readings) -> float:
    """Return a noise to begin with: a millionth of the largest indication."""
    return 1e-6 * float(np.max(np.abs(group.value), initial=1e-3))


def _freedom_of_repeats(group: Readings) -> float:
    """Return the degrees of freedom that repeats at one setting have among themselves."""
    return float(np.sum(group.repeats - 1.0))


def _noise_again(
    group: Readings, part: _Part, solution: Solution, model: Unknowns, own: float
) -> float:
    """Return the noise that the residuals show; its fixed point is the REML estimate."""
    if group.u is not None:
        return 1.0
    left_over = 1.0 - part.leverages(solution)
    again = _freedom_of_repeats(group)
    if left_over.sum() + again < 0.5:
        raise NotIdentifiableError(
            f"{group.accelerometer}: {group.size} readings ({group.motion}) without a stated "
            "uncertainty cannot tell their noise beside the unknowns; state it, or take more "
            "readings than there are unknowns"
        )
    # Where the head's part is known, the score of the rest: each reading by the share that it has.
    share = part.noise_share
    left = part.left(solution, model) / part.sigma
    squares = float(share @ left**2) + float(group.scatter.sum()) / own**2
    size = own * math.sqrt(squares / (float(share @ left_over) + again))
    if again < FEWEST_FREEDOM:
        size = max(size, _LEAST_BESIDE_HEAD * float(np.sqrt(np.mean(part.head**2))))
    # Readings without any noise, such as simulated ones, must not end in a division by zero.
    return max(size, 1e-15)
