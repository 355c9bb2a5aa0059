"""From indicated to true specific force: the inverse of Eq. 7, and its uncertainty.

On either side of a_I = 0 the indicated specific force is a polynomial in a_I. It rises there from
zero up to its first turning point; within that range there is exactly one specific force along
the input axis that an indication can stand for, and a bracketed Newton iteration finds it.

The products with a_P and a_O need the specific force along the other two axes. It is known, or
it is what other accelerometers on the same platform sense; their errors are then corrected too,
in turn, until nothing moves any more.

- `invert`: one accelerometer, a_P and a_O given
- `Instrument`, `Known`: calibrated accelerometers, and directions in which the force is known
- `missing_axes`: the axes along which the force is needed and not known
- `correct`: several accelerometers together, with standard uncertainties
- `NotInvertibleError`: an indication that the model does not reach
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from counterspin.errors import ConvergenceError
from counterspin.physics.accelerometer import TERMS, Array, Mounting

_EPS: Final = float(np.finfo(np.float64).eps)

#: A bracket halves at least every other step, so that this is never reached by a sound model.
_STEPS: Final = 200

#: Rounds of correcting each accelerometer with the others; a misalignment of 1e-2 needs eight.
_ROUNDS: Final = 100

#: Projections below this are rounding of the mountings (directions are unit vectors).
_PARALLEL: Final = 1e-9


class NotInvertibleError(ConvergenceError):
    """A sample has no specific force that the model could indicate in that way.

    Attributes
    ----------
    row
        The sample, counted from 0.
    reason
        Why, as a sentence without its subject.
    """

    def __init__(self, row: int, reason: str) -> None:
        self.row, self.reason = row, reason
        super().__init__(f"sample {row} (counted from 0) {reason}")


def invert(
    coefficients: Mapping[str, float],
    indicated: Array,
    a_p: Array | float = 0.0,
    a_o: Array | float = 0.0,
) -> Array:
    """Return the specific force along the input axis, the inverse of Eq. 7.

    Parameters
    ----------
    coefficients
        Coefficients by symbol, in g-units; those not named have their nominal value.
    indicated
        Indicated specific force in g, shape (n,). Where it, a_p or a_o is not finite, so is the
        result.
    a_p, a_o
        Specific force along the pendulous and the output axis in g, shape (n,) or one for all.

    Returns
    -------
    Array
        a_I in g, shape (n,), to rounding.

    Raises
    ------
    NotInvertibleError
        If an indication lies outside of what the model reaches before it turns round, or the
        model does not rise at a_I = 0.
    """
    y, p, o = np.broadcast_arrays(np.asarray(indicated, dtype=np.float64), a_p, a_o)
    present = np.isfinite(y) & np.isfinite(p) & np.isfinite(o)
    force = np.full(y.shape, np.nan)
    rows = np.flatnonzero(present)
    if rows.size:
        force[rows] = _rising(coefficients, y[rows], p[rows], o[rows], rows)
    return force


def _rising(
    coefficients: Mapping[str, float], y: Array, p: Array, o: Array, rows: np.ndarray
) -> Array:
    """Return the root of the indication less y on the branch that holds a_I = 0."""
    at_zero = _polynomial(coefficients, np.ones_like(y), p, o)[0]
    side = np.where(y >= at_zero, 1.0, -1.0)
    # In x = |a_I|, and with this sign, what is sought is the root of a polynomial that begins
    # below zero and rises.
    poly = _polynomial(coefficients, side, p, o)
    poly[0] -= y
    poly *= side
    flat = np.flatnonzero(~(poly[1] > 0.0))
    if flat.size:
        worst = int(flat[0])
        raise NotInvertibleError(
            int(rows[worst]),
            "cannot be corrected: the indication does not rise with the specific force at zero "
            f"(slope {poly[1, worst]:.3g}); check the coefficients and their units.",
        )
    turn = _turning_point(poly)
    high = np.minimum(turn, 2.0 * -poly[0] / poly[1])
    while True:
        short = (_value(poly, high) < 0.0) & (high < turn)
        if not short.any():
            break
        high = np.where(short, np.minimum(2.0 * high, turn), high)
    beyond = np.flatnonzero(_value(poly, high) < -_rounding(poly, high, y))
    if beyond.size:
        worst = int(beyond[0])
        level = float(side[worst] * turn[worst])
        reach = float(y[worst] + side[worst] * _value(poly, turn)[worst])
        raise NotInvertibleError(
            int(rows[worst]),
            f"cannot be corrected: it indicates {y[worst]:.6g} g, and this model turns round at "
            f"{level:.6g} g, where it indicates {reach:.6g} g.",
        )
    return side * _root(poly, high, y, rows)


def _polynomial(coefficients: Mapping[str, float], side: Array, p: Array, o: Array) -> Array:
    """Return the indication's coefficients in powers of |a_I|, lowest first, shape (4, n)."""
    unit = np.stack([side, p, o])
    poly = np.zeros((1 + max(row.power for row in TERMS.values()), side.size))
    for row in TERMS.values():
        value = coefficients.get(row.symbol, row.nominal)
        if value != 0.0:
            # Each product is homogeneous in a_I on its side: its value at +-1 times |a_I|^power.
            poly[row.power] += value * row.evaluate(unit)
    return poly


def _turning_point(poly: Array) -> Array:
    """Return where a cubic's slope, positive at zero, first vanishes beyond; infinite if never."""
    a, b, c = poly[1], 2.0 * poly[2], 3.0 * poly[3]
    square = b * b - 4.0 * a * c
    # This form of the root keeps its digits as c goes to zero.
    divisor = -b + np.sqrt(np.maximum(square, 0.0))
    turns = (square >= 0.0) & (divisor > 0.0)
    turn = np.full(a.shape, np.inf)
    turn[turns] = 2.0 * a[turns] / divisor[turns]
    return turn


def _value(poly: Array, x: Array) -> Array:
    total: Array = poly[-1]
    for row in poly[-2::-1]:
        total = total * x + row
    return total


def _slope(poly: Array, x: Array) -> Array:
    return _value(poly[1:] * np.arange(1.0, poly.shape[0])[:, None], x)


def _rounding(poly: Array, x: Array, y: Array) -> Array:
    """Return what rounding may make of the polynomial's value, which cancels against y."""
    return 2.0 * _EPS * (_value(np.abs(poly), x) + np.abs(y))


def _root(poly: Array, high: Array, y: Array, rows: np.ndarray) -> Array:
    low = np.zeros_like(high)
    x = np.minimum(-poly[0] / poly[1], high)
    for _ in range(_STEPS):
        value, slope = _value(poly, x), _slope(poly, x)
        low, high = np.where(value < 0.0, x, low), np.where(value < 0.0, high, x)
        step = np.divide(-value, slope, out=np.full_like(x, np.inf), where=slope > 0.0)
        new = x + step
        new = np.where((new >= low) & (new <= high), new, 0.5 * (low + high))
        settled = (np.abs(value) <= _rounding(poly, x, y)) | (np.abs(new - x) <= 2.0 * _EPS * x)
        x = new
        if settled.all():
            return x
    worst = int(rows[int(np.flatnonzero(~settled)[0])])
    raise NotInvertibleError(worst, f"has not settled after {_STEPS} steps.")


@dataclass(frozen=True, eq=False)
class Instrument:
    """A calibrated accelerometer.

    Attributes
    ----------
    name
        For messages.
    mounting
        Its axes on the platform.
    coefficients
        Symbol -> value in g-units; terms not named have their nominal value, known exactly.
    covariance
        Of these coefficients in their order, shape (t, t).
    """

    name: str
    mounting: Mounting
    coefficients: Mapping[str, float]
    covariance: Array

    def using(self, axis: str) -> tuple[str, ...]:
        """Return the symbols that need the specific force along P or O for value or variance."""
        return tuple(
            symbol
            for place, (symbol, value) in enumerate(self.coefficients.items())
            if axis in TERMS[symbol].factors and (value or self.covariance[place, place])
        )


@dataclass(frozen=True, eq=False)
class Known:
    """A direction along which the specific force is known without an accelerometer.

    Attributes
    ----------
    direction
        Unit vector in the frame of the mountings, shape (3,).
    force
        Specific force along it in g, shape (n,) or one for all samples.
    u
        Its standard uncertainty in g, common to all samples.
    """

    direction: Array
    force: Array | float
    u: float = 0.0


@dataclass(frozen=True, eq=False)
class Corrected:
    """What the accelerometers' indications stand for.

    Attributes
    ----------
    force
        Specific force along each input axis in g, shape (n, m).
    u
        Its standard uncertainty from coefficients and known forces, shape (n, m); the noise of
        the indications is no part of it.
    """

    force: Array
    u: Array


def missing_axes(
    instruments: Sequence[Instrument], known: Sequence[Known]
) -> list[tuple[Instrument, str, tuple[str, ...]]]:
    """Return (instrument, ``P`` or ``O``, symbols that need it) where the force is not known.

    Raises
    ------
    ValueError
        As `correct`.
    """
    _, determined = _projections(instruments, known)
    return [
        (one, axis, one.using(axis))
        for k, one in enumerate(instruments)
        for a, axis in enumerate("PO")
        if one.using(axis) and not determined[k, a]
    ]


def correct(
    instruments: Sequence[Instrument], indicated: Array, known: Sequence[Known] = ()
) -> Corrected:
    """Correct the indications of accelerometers that stand on one platform.

    Each accelerometer's a_P and a_O are the projections of the vector that the corrected forces
    along all input axes, and the known ones, determine. The uncertainty is first order: with M
    the Jacobian of all indications with respect to all a_I, the errors of the coefficients K_k of
    accelerometer k move a_I by -M^-1 J_k dK_k, J_k being the products. For one accelerometer this
    is u(a_I) = sqrt(J C J^T) / |d a_ind/d a_I|. Coefficients of different accelerometers are taken
    as uncorrelated.

    Parameters
    ----------
    instruments
        The accelerometers, m of them, each with an input axis of its own.
    indicated
        Indicated specific force in g, shape (n, m); not finite: nor is the sample's result.
    known
        Further directions in which the force is known.

    Returns
    -------
    Corrected

    Raises
    ------
    NotInvertibleError
        If a sample lies outside of what the model reaches.
    ConvergenceError
        If the accelerometers' mutual corrections do not settle.
    ValueError
        If the force along an axis is needed and not known, or the force along a direction is
        given more than once.
    """
    missing = missing_axes(instruments, known)
    if missing:
        one, axis, symbols = missing[0]
        raise ValueError(f"{one.name}: {', '.join(symbols)} need a_{axis}, which is not known")
    weights, _ = _projections(instruments, known)
    n, m = indicated.shape
    given = np.empty((n, len(known)))
    for place, item in enumerate(known):
        given[:, place] = item.force
    force = _settled(instruments, indicated, given, weights)
    a_ipo = _along_axes(force, given, weights)

    jacobian = np.empty((n, m, m))
    from_known = np.zeros((n, m, len(known)))
    variance = np.empty((n, m))
    for k, one in enumerate(instruments):
        p, o = (_total_slope(one, a_ipo[k], axis)[:, None] for axis in "PO")
        jacobian[:, k] = p * weights[k, 0, :m] + o * weights[k, 1, :m]
        jacobian[:, k, k] += _total_slope(one, a_ipo[k], "I")
        from_known[:, k] = p * weights[k, 0, m:] + o * weights[k, 1, m:]
        variance[:, k] = _variance(one, a_ipo[k])
    inverse = np.full_like(jacobian, np.nan)
    present = np.isfinite(jacobian).all(axis=(1, 2))
    inverse[present] = np.linalg.inv(jacobian[present])
    total = np.einsum("nik,nk->ni", inverse**2, variance)
    spread = inverse @ from_known * [item.u for item in known]
    total += np.sum(spread**2, axis=2)
    return Corrected(force, np.sqrt(total))


def _projections(
    instruments: Sequence[Instrument], known: Sequence[Known]
) -> tuple[Array, np.ndarray]:
    """Return the weights that lead from forces along the known directions to a_P and a_O.

    Shape (m, 2, m + len(known)); and whether they determine a_P and a_O, shape (m, 2).
    """
    rows = [one.mounting.input_axis for one in instruments]
    directions = np.stack([*rows, *(item.direction for item in known)])
    if np.linalg.matrix_rank(directions, tol=_PARALLEL) < directions.shape[0]:
        raise ValueError(
            "the specific force along some direction is given more than once: by "
            f"{len(rows)} accelerometers ({', '.join(one.name for one in instruments)}) and "
            f"{len(known)} known forces, whose directions are not independent"
        )
    wanted = np.stack([one.mounting.matrix[1:] for one in instruments])
    weights = wanted @ np.linalg.pinv(directions)
    determined = np.linalg.norm(weights @ directions - wanted, axis=2) < _PARALLEL
    weights[~determined] = 0.0
    return np.where(np.abs(weights) < _PARALLEL, 0.0, weights), determined


def _along_axes(force: Array, given: Array, weights: Array) -> Array:
    """Return the forces along I, P, O of each accelerometer, shape (m, 3, n)."""
    all_known = np.concatenate([force, given], axis=1).T
    return np.concatenate([force.T[:, None], weights @ all_known], axis=1)


def _settled(
    instruments: Sequence[Instrument], indicated: Array, given: Array, weights: Array
) -> Array:
    """Correct each accelerometer with the others' corrected forces until none moves."""
    force = np.array(indicated, dtype=np.float64)
    # A sample that one accelerometer misses is missing altogether.
    force[~np.isfinite(np.concatenate([force, given], axis=1)).all(axis=1)] = np.nan
    m = len(instruments)
    coupled = bool(np.any(weights[:, :, :m]))
    scale = 32.0 * _EPS * (1.0 + np.max(np.abs(force), axis=1, keepdims=True))
    for _ in range(_ROUNDS if coupled else 1):
        a_ipo = _along_axes(force, given, weights)
        columns = [
            invert(one.coefficients, np.where(np.isnan(force[:, k]), np.nan, indicated[:, k]), p, o)
            for k, (one, (_, p, o)) in enumerate(zip(instruments, a_ipo, strict=True))
        ]
        new = np.stack(columns, axis=1)
        moving = np.abs(new - force) > scale
        force = new
        if not coupled or not moving.any():
            return force
    worst = int(np.flatnonzero(moving.any(axis=1))[0])
    raise NotInvertibleError(
        worst,
        "cannot be corrected: the accelerometers' mutual corrections have not settled after "
        f"{_ROUNDS} rounds; check the coefficients and their units.",
    )


def _total_slope(one: Instrument, a_ipo: Array, axis: str) -> Array:
    total = np.zeros(a_ipo.shape[1])
    for row in TERMS.values():
        value = one.coefficients.get(row.symbol, row.nominal)
        if value != 0.0:
            total += value * row.slope(a_ipo, axis)
    return total


def _variance(one: Instrument, a_ipo: Array) -> Array:
    products = np.stack([TERMS[symbol].evaluate(a_ipo) for symbol in one.coefficients], axis=1)
    found: Array = np.einsum("ni,ij,nj->n", products, one.covariance, products)
    return np.maximum(found, 0.0)
