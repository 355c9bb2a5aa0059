"""Correction of accelerometers for their calibrated errors, and how uncertain it leaves them.

The products with a_P and a_O need the specific force along the other two axes. It is known, or
it is what other accelerometers on the same platform sense; their errors are then corrected too,
in turn, until the forces converge.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

import numpy as np

from counterspin.arrays import Array, semidefinite_root
from counterspin.frozen import frozen
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.effects import Product, Slope
from counterspin.physics.inversion import NotInvertibleError, invert
from counterspin.physics.terms import OWN_TERMS, TERMS

_EPSILON: Final = float(np.finfo(np.float64).eps)

#: Rounds of correcting each accelerometer with the others; a misalignment of 1e-2 needs eight.
_MAX_ROUNDS: Final = 100

#: Projections below this are rounding of the mountings (directions are unit vectors).
_PROJECTION_ROUNDING: Final = 1e-9


@frozen(eq=False)
class CalibratedAccelerometer:
    """A calibrated accelerometer."""

    name: str  #: For messages.
    mounting: Mounting  #: Its axes on the platform.
    #: Symbol of a product, or of a slope with temperature -> value in g-units; terms not named have
    #: their nominal value, known exactly.
    coefficients: Mapping[str, float]
    covariance: Array  #: Of these coefficients in their order, shape (t, t).

    def using(self, axis: str) -> tuple[str, ...]:
        """Return the symbols that need the specific force along P or O for value or variance."""
        return tuple(
            symbol
            for place, (symbol, value) in enumerate(self.coefficients.items())
            if axis in product_of(symbol).factors and (value or self.covariance[place, place])
        )

    @property
    def slopes(self) -> dict[str, Slope]:
        """What changes its coefficients with the conditions, by symbol."""
        own = {s: OWN_TERMS[s].effect for s in self.coefficients}
        return {s: effect for s, effect in own.items() if isinstance(effect, Slope)}

    def at(self, warmth: Array | float) -> dict[str, Array | float]:
        """Return the coefficients of products at a temperature, as of `Warmth`."""
        slopes = self.slopes
        values: dict[str, Array | float] = {
            s: value for s, value in self.coefficients.items() if s not in slopes
        }
        for symbol, slope in slopes.items():
            own = values.get(slope.coefficient, TERMS[slope.coefficient].nominal)
            values[slope.coefficient] = own + self.coefficients[symbol] * _lever(slope, warmth)
        return values


def product_of(symbol: str) -> Product:
    """Return the product of a term, or of that whose coefficient a slope changes."""
    effect = OWN_TERMS[symbol].effect
    return TERMS[effect.coefficient].effect if isinstance(effect, Slope) else effect


def _lever(slope: Slope, warmth: Array | float) -> Array:
    """Return what a slope is multiplied with; with time and heating it is at the beginning."""
    zero = np.zeros_like(warmth)
    return slope.levers(zero, np.asarray(warmth, dtype=np.float64), zero, zero)


@frozen(eq=False)
class KnownForce:
    """A direction along which the specific force is known without an accelerometer."""

    direction: Array  #: Unit vector in the frame of the mountings, shape (3,).
    force: Array | float  #: Specific force along it in g, shape (n,) or one for all samples.
    u: float = 0.0  #: Its standard uncertainty in g, common to all samples.


@frozen(eq=False)
class Warmth:
    """How much warmer it was than where the coefficients are those that are named, K."""

    value: Array | float = 0.0  #: Shape (n,), or one for all samples.
    u: float = 0.0  #: Its standard uncertainty, common to all samples.

    @property
    def nodes(self) -> list[tuple[float, Array | float]]:
        """Weights and temperatures that give means of polynomials over what it may have been.

        Three, exact for powers of a normal temperature up to the fifth.
        """
        if self.u == 0.0:
            return [(1.0, self.value)]
        step = math.sqrt(3.0) * self.u
        return [
            (1.0 / 6.0, self.value - step),
            (2.0 / 3.0, self.value),
            (1.0 / 6.0, self.value + step),
        ]


@frozen(eq=False)
class CorrectedForces:
    """What the accelerometers' indications stand for."""

    force: Array  #: Specific force along each input axis in g, shape (n, m).
    #: Its standard uncertainty from coefficients and known forces, shape (n, m); the noise of the
    #: indications is no part of it.
    u: Array


_AS_CALIBRATED: Final = Warmth()


def missing_axes(
    instruments: Sequence[CalibratedAccelerometer], known: Sequence[KnownForce]
) -> list[tuple[CalibratedAccelerometer, str, tuple[str, ...]]]:
    """Return (instrument, ``P`` or ``O``, symbols that need it) where the force is not known."""
    _, determined = _projections(instruments, known)
    return [
        (instrument, axis, instrument.using(axis))
        for k, instrument in enumerate(instruments)
        for a, axis in enumerate("PO")
        if instrument.using(axis) and not determined[k, a]
    ]


def correct(
    instruments: Sequence[CalibratedAccelerometer],
    indicated: Array,
    known: Sequence[KnownForce] = (),
    between: Mapping[tuple[int, int], Array] = MappingProxyType({}),
    warmth: Warmth = _AS_CALIBRATED,
) -> CorrectedForces:
    """Correct the indications of accelerometers that stand on one platform.

    Each accelerometer's a_P and a_O are the projections of the vector that the corrected forces
    along all input axes, and the known ones, determine. The uncertainty is first order: with M
    the Jacobian of all indications with respect to all a_I, the errors of the coefficients K_k of
    accelerometer k move a_I by -M^-1 J_k dK_k, J_k being the products. For one accelerometer this
    is u(a_I) = sqrt(J C J^T) / |d a_ind/d a_I|.

    instruments: The accelerometers, m of them, each with an input axis of its own.
    indicated: Indicated specific force in g, shape (n, m); not finite: nor is the sample's result.
    between: Places of two accelerometers, the lower first -> covariance of their coefficients, of
        the first along the rows; where there is none they are uncorrelated.
    warmth: For slopes with temperature. Its u moves the force by the slopes, and what these are
        uncertain by counts at every temperature that it may have been.
    """
    missing = missing_axes(instruments, known)
    if missing:
        instrument, axis, symbols = missing[0]
        raise ValueError(
            f"{instrument.name}: {', '.join(symbols)} need a_{axis}, which is not known"
        )
    weights, _ = _projections(instruments, known)
    n, m = indicated.shape
    given = np.empty((n, len(known)))
    for place, item in enumerate(known):
        given[:, place] = item.force
    force = _settled(instruments, indicated, given, weights, warmth.value)
    a_ipo = _along_axes(force, given, weights)

    jacobian = np.empty((n, m, m))
    from_known = np.zeros((n, m, len(known) + 1))
    variance = np.zeros((n, m, m))
    for k, instrument in enumerate(instruments):
        at = instrument.at(warmth.value)
        p, o = (_total_slope(at, a_ipo[k], axis)[:, None] for axis in "PO")
        jacobian[:, k] = p * weights[k, 0, :m] + o * weights[k, 1, :m]
        jacobian[:, k, k] += _total_slope(at, a_ipo[k], "I")
        from_known[:, k, :-1] = p * weights[k, 0, m:] + o * weights[k, 1, m:]
        from_known[:, k, -1] = _by_warmth(instrument, a_ipo[k], warmth.value)
        variance[:, k, k] = _variance(instrument, a_ipo[k], warmth)
    for (k, other), covariance in between.items():
        for weight, value in warmth.nodes:
            one, two = (_products(instruments[at], a_ipo[at], value) for at in (k, other))
            variance[:, k, other] += weight * np.sum((one @ covariance) * two, axis=1)
        variance[:, other, k] = variance[:, k, other]
    inverse = np.full_like(jacobian, np.nan)
    present = np.isfinite(jacobian).all(axis=(1, 2))
    inverse[present] = np.linalg.inv(jacobian[present])
    total = np.sum((inverse @ variance) * inverse, axis=2)
    spread = inverse @ from_known * [*(item.u for item in known), warmth.u]
    total += np.sum(spread**2, axis=2)
    # Rounding alone may leave less than nothing where errors of two accelerometers cancel.
    return CorrectedForces(force, np.sqrt(np.maximum(total, 0.0)))


def indication(instrument: CalibratedAccelerometer, a_ipo: Array) -> tuple[Array, Array]:
    """Return what an accelerometer indicates (Eq. 7), and its u from the coefficients; both in g.

    It is as warm as where its coefficients are those that are named.

    a_ipo: Specific force along its axes I, P, O in g, shape (3, n).
    """
    total = np.zeros(a_ipo.shape[1])
    for row in TERMS.values():
        value = instrument.coefficients.get(row.symbol, row.nominal)
        if value != 0.0:
            total += value * row.effect.evaluate(a_ipo)
    return total, np.sqrt(_variance(instrument, a_ipo, _AS_CALIBRATED))


def _projections(
    instruments: Sequence[CalibratedAccelerometer], known: Sequence[KnownForce]
) -> tuple[Array, np.ndarray]:
    """Return the weights that lead from forces along the known directions to a_P and a_O.

    Shape (m, 2, m + len(known)); and whether they determine a_P and a_O, shape (m, 2).
    """
    rows = [instrument.mounting.input_axis for instrument in instruments]
    directions = np.stack([*rows, *(item.direction for item in known)])
    if np.linalg.matrix_rank(directions, tol=_PROJECTION_ROUNDING) < directions.shape[0]:
        raise ValueError(
            "the specific force along some direction is given more than once: by "
            f"{len(rows)} accelerometers ({', '.join(i.name for i in instruments)}) and "
            f"{len(known)} known forces, whose directions are not independent"
        )
    wanted = np.stack([instrument.mounting.matrix[1:] for instrument in instruments])
    weights = wanted @ np.linalg.pinv(directions)
    determined = np.linalg.norm(weights @ directions - wanted, axis=2) < _PROJECTION_ROUNDING
    weights[~determined] = 0.0
    return np.where(np.abs(weights) < _PROJECTION_ROUNDING, 0.0, weights), determined


def _along_axes(force: Array, given: Array, weights: Array) -> Array:
    """Return the forces along I, P, O of each instrument, shape (m, 3, n)."""
    all_known = np.concatenate([force, given], axis=1).T
    return np.concatenate([force.T[:, None], weights @ all_known], axis=1)


def _settled(
    instruments: Sequence[CalibratedAccelerometer],
    indicated: Array,
    given: Array,
    weights: Array,
    warmth: Array | float,
) -> Array:
    """Correct each accelerometer with the others' corrected forces until none moves."""
    force = np.array(indicated, dtype=np.float64)
    # A sample that one accelerometer misses is missing altogether.
    there = np.isfinite(np.concatenate([force, given], axis=1)).all(axis=1)
    force[~(there & np.isfinite(warmth))] = np.nan
    m = len(instruments)
    coupled = bool(np.any(weights[:, :, :m]))
    scale = 32.0 * _EPSILON * (1.0 + np.max(np.abs(force), axis=1, keepdims=True))
    coefficients = [instrument.at(warmth) for instrument in instruments]
    for _ in range(_MAX_ROUNDS if coupled else 1):
        a_ipo = _along_axes(force, given, weights)
        new = np.empty_like(force)
        for k, (instrument, (_, p, o)) in enumerate(zip(instruments, a_ipo, strict=True)):
            wanted = np.where(np.isnan(force[:, k]), np.nan, indicated[:, k])
            try:
                new[:, k] = invert(coefficients[k], wanted, p, o)
            except NotInvertibleError as error:
                raise NotInvertibleError(
                    error.row, f"of {instrument.name} {error.reason}"
                ) from error
        moving = np.abs(new - force) > scale
        force = new
        if not coupled or not moving.any():
            return force
    worst = int(np.flatnonzero(moving.any(axis=1))[0])
    raise NotInvertibleError(
        worst,
        "cannot be corrected: the accelerometers' mutual corrections have not converged after "
        f"{_MAX_ROUNDS} rounds; check the coefficients and their units.",
    )


def _total_slope(coefficients: Mapping[str, Array | float], a_ipo: Array, axis: str) -> Array:
    total = np.zeros(a_ipo.shape[1])
    for row in TERMS.values():
        value = coefficients.get(row.symbol, row.nominal)
        if np.any(value):
            total += value * row.effect.slope(a_ipo, axis)
    return total


def _by_warmth(instrument: CalibratedAccelerometer, a_ipo: Array, warmth: Array | float) -> Array:
    """Return by what an error of the temperature moves the indication, g/K, shape (n,)."""
    total = np.zeros(a_ipo.shape[1])
    for symbol, slope in instrument.slopes.items():
        if slope.condition == "temperature":
            steep = slope.power * np.asarray(warmth) ** (slope.power - 1)
            value = instrument.coefficients[symbol]
            total += value * steep * product_of(symbol).evaluate(a_ipo)
    return total


def _products(instrument: CalibratedAccelerometer, a_ipo: Array, warmth: Array | float) -> Array:
    """Return by what an error of each coefficient moves the indication, shape (n, t)."""
    slopes = instrument.slopes
    columns = [product_of(symbol).evaluate(a_ipo) for symbol in instrument.coefficients]
    for place, symbol in enumerate(instrument.coefficients):
        if symbol in slopes:
            columns[place] = columns[place] * _lever(slopes[symbol], warmth)
    return np.stack(columns, axis=1)


def _variance(instrument: CalibratedAccelerometer, a_ipo: Array, warmth: Warmth) -> Array:
    root = semidefinite_root(instrument.covariance)
    total = np.zeros(a_ipo.shape[1])
    for weight, value in warmth.nodes:
        # A sum of squares: no error of the covariance makes it less than nothing.
        total += weight * np.sum((_products(instrument, a_ipo, value) @ root) ** 2, axis=1)
    return total
