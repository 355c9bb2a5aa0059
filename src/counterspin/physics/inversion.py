"""The inverse of Eq. 7: the specific force that an indication stands for.

On either side of a_I = 0 the indicated specific force is a polynomial in a_I. It rises there from
zero up to its first turning point; within that range there is exactly one specific force along
the input axis that an indication can stand for, and a bracketed Newton iteration finds it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import ConvergenceError
from counterspin.physics.terms import TERMS

_EPSILON: Final = float(np.finfo(np.float64).eps)

#: A bracket halves at least every other step, so a sound model never needs so many.
_MAX_STEPS: Final = 200


#: Specific force, g, beyond which no instrument works: a turning point there is none.
_MAX_FORCE: Final = 1e9


class NotInvertibleError(ConvergenceError):
    """With this model no specific force gives a sample's indication."""

    def __init__(self, row: int, reason: str) -> None:
        self.row, self.reason = row, reason
        super().__init__(f"sample {row} (counted from 0) {reason}")


def invert(
    coefficients: Mapping[str, Array | float],
    indicated: Array,
    a_p: Array | float = 0.0,
    a_o: Array | float = 0.0,
) -> Array:
    """Return the specific force along the input axis, the inverse of Eq. 7.

    coefficients: Coefficients by symbol, in g-units, of shape (n,) or one for all; those not named
        have their nominal value.
    indicated: Indicated specific force in g, shape (n,). Where it, a_p or a_o is not finite, so is
        the result.
    a_p, a_o: Specific force along the pendulous and the output axis in g, shape (n,) or one for
        all.
    Returns: a_I in g, shape (n,), to rounding.
    """
    y, p, o = np.broadcast_arrays(np.asarray(indicated, dtype=np.float64), a_p, a_o)
    present = np.isfinite(y) & np.isfinite(p) & np.isfinite(o)
    force = np.full(y.shape, np.nan)
    rows = np.flatnonzero(present)
    if rows.size:
        own = {s: value[rows] if np.ndim(value) else value for s, value in coefficients.items()}  # type: ignore[index]
        force[rows] = _rising(own, y[rows], p[rows], o[rows], rows)
    return force


def _rising(
    coefficients: Mapping[str, Array | float], y: Array, p: Array, o: Array, rows: np.ndarray
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
        there = _value(poly[:, worst : worst + 1], turn[worst : worst + 1])
        reach = float(y[worst] + side[worst] * there[0])
        raise NotInvertibleError(
            int(rows[worst]),
            f"cannot be corrected: it indicates {y[worst]:.6g} g, and this model has its turning "
            f"point at {level:.6g} g, where it indicates {reach:.6g} g.",
        )
    return side * _root(poly, high, y, rows)


def _polynomial(
    coefficients: Mapping[str, Array | float], side: Array, p: Array, o: Array
) -> Array:
    """Return the indication's coefficients in powers of |a_I|, lowest first, shape (m, n)."""
    unit = np.stack([side, p, o])
    given = {row.effect: coefficients.get(row.symbol, row.nominal) for row in TERMS.values()}
    used = {row: value for row, value in given.items() if np.any(value)}
    poly = np.zeros((1 + max([3, *(row.power for row in used)]), side.size))
    for row, value in used.items():
        # Each product is homogeneous in a_I on its side: its value at +-1 times |a_I|^power.
        poly[row.power] += value * row.evaluate(unit)
    return poly


def _turning_point(poly: Array) -> Array:
    """Return where the slope, positive at zero, first vanishes beyond; infinite if never."""
    slope = poly[1:] * np.arange(1.0, poly.shape[0])[:, None]
    if poly.shape[0] == 4:
        return _first_zero_of_parabola(slope)
    # Between the zeros of its own slope the slope is monotone: the first of these stretches at
    # whose end it is not positive holds the zero.
    low, high = np.zeros_like(slope[0]), np.full_like(slope[0], np.inf)
    for end in (*_turns_of_cubic(slope), np.full_like(slope[0], _MAX_FORCE)):
        reached = np.isinf(high) & (end <= _MAX_FORCE)
        below = reached & (_value(slope, np.where(reached, end, 0.0)) <= 0.0)
        high = np.where(below, end, high)
        low = np.where(reached & ~below, end, low)
    inside = np.isfinite(high)
    turn = np.where(inside, 0.5 * (low + np.where(inside, high, 0.0)), np.inf)
    for _ in range(_MAX_STEPS if inside.any() else 0):
        at = np.where(inside, turn, 0.0)
        positive = _value(slope, at) > 0.0
        low, high = np.where(positive, at, low), np.where(positive, high, at)
        new = np.where(inside, 0.5 * (low + high), np.inf)
        if np.all((new == turn) | ~inside):
            break
        turn = new
    return turn


def _first_zero_of_parabola(poly: Array) -> Array:
    """Return the first zero beyond zero of a + b x + c x^2, a > 0; infinite if there is none."""
    a, b, c = poly
    square = b * b - 4.0 * a * c
    # This form of the root keeps its digits as c goes to zero.
    divisor = -b + np.sqrt(np.maximum(square, 0.0))
    crosses = (square >= 0.0) & (divisor > 0.0)
    zero = np.full(a.shape, np.inf)
    zero[crosses] = 2.0 * a[crosses] / divisor[crosses]
    return zero


def _turns_of_cubic(poly: Array) -> tuple[Array, Array]:
    """Return where a cubic's slope vanishes beyond zero, the nearer first; infinite if nowhere."""
    a, b, c = poly[1], 2.0 * poly[2], 3.0 * poly[3]
    root = np.sqrt(np.maximum(b * b - 4.0 * a * c, 0.0))
    half = -0.5 * (b + np.where(b < 0.0, -root, root))
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        zeros = np.stack([half / c, a / half])
    zeros[:, b * b < 4.0 * a * c] = np.inf
    zeros = np.where(np.isfinite(zeros) & (zeros > 0.0), zeros, np.inf)
    return zeros.min(axis=0), zeros.max(axis=0)


def _value(poly: Array, x: Array) -> Array:
    total: Array = poly[-1]
    for row in poly[-2::-1]:
        total = total * x + row
    return total


def _slope(poly: Array, x: Array) -> Array:
    return _value(poly[1:] * np.arange(1.0, poly.shape[0])[:, None], x)


def _rounding(poly: Array, x: Array, y: Array) -> Array:
    """Return what rounding may make of the polynomial's value, which cancels against y."""
    return 2.0 * _EPSILON * (_value(np.abs(poly), x) + np.abs(y))


def _root(poly: Array, high: Array, y: Array, rows: np.ndarray) -> Array:
    low = np.zeros_like(high)
    x = np.minimum(-poly[0] / poly[1], high)
    for _ in range(_MAX_STEPS):
        value, slope = _value(poly, x), _slope(poly, x)
        low, high = np.where(value < 0.0, x, low), np.where(value < 0.0, high, x)
        step = np.divide(-value, slope, out=np.full_like(x, np.inf), where=slope > 0.0)
        new = x + step
        new = np.where((new >= low) & (new <= high), new, 0.5 * (low + high))
        settled = (np.abs(value) <= _rounding(poly, x, y)) | (np.abs(new - x) <= 2.0 * _EPSILON * x)
        x = new
        if settled.all():
            return x
    worst = int(rows[int(np.flatnonzero(~settled)[0])])
    raise NotInvertibleError(worst, f"has not converged after {_MAX_STEPS} steps.")
