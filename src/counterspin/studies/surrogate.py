"""Strobed effects as a polynomial of the spindle's small errors, checked inside a box.

What each error adds to a run's b2 (`counterspin.studies.strobed_effects`) is a smooth function of
the drift and of the first harmonic's cosine and sine parts. A polynomial of the fourth degree
through points computed by quadrature stands for it inside a box, whose corners and inside are
checked when it is made. Quantities that do not vary take no part; where none varies the polynomial
is a constant.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.errors import ConvergenceError
from counterspin.frozen import frozen
from counterspin.physics.terms import term
from counterspin.studies.strobed_effects import StrobedMotion, effects

DEGREE: Final = 4

#: The box: angle that drift adds in a run (rad), ripple ratio.
_DRIFT_ANGLE: Final = 0.076
_RIPPLE_RATIO: Final = 6e-4

#: The largest error that the polynomial may have, in parts of the largest value in the box.
_TOLERANCE: Final = 1e-9

#: Smallest effect held to the tolerance, in parts of the largest, both at credible sizes.
_SMALLEST_EFFECT: Final = 1e-4

#: Points of the fit for each coefficient of the polynomial, and points of the check.
_POINTS_PER_COEFFICIENT: Final = 3
_CHECK_POINTS: Final = 60


@frozen
class Box:
    """Where a surrogate holds: centre and half width of drift and ripple parts, (3,)."""

    centre: Array
    half: Array

    @property
    def varies(self) -> npt.NDArray[np.intp]:
        """Which of the three quantities vary."""
        return np.flatnonzero(self.half > 0.0)


def box_of(motion: StrobedMotion, bounds: Array) -> Box:
    """Return the box that holds what a study draws, or as much of it as a surrogate may hold.

    bounds: Least and greatest drift and ripple's cosine and sine parts, shape (3, 2).
    """
    turned = float(np.max(np.abs(motion.angles - motion.spindle.start_angle)))
    duration = turned / abs(motion.spindle.rate)
    allowed = np.array([2.0 * _DRIFT_ANGLE / (turned * duration), _RIPPLE_RATIO, _RIPPLE_RATIO])
    low, high = bounds.T
    centre = 0.5 * (low + high)
    low, high = np.clip(low, -allowed, allowed), np.clip(high, -allowed, allowed)
    varying = high > low
    centre = np.where(varying, 0.5 * (low + high), centre)
    half = np.where(varying, 0.5 * (high - low) * (1.0 + 1e-9), 0.0)
    return Box(centre, half)


@frozen
class Surrogate:
    """The effects of a run's terms as polynomials."""

    box: Box  #: Where they hold.
    #: Of the varying quantities, one row for each monomial.
    powers: tuple[tuple[int, ...], ...]
    #: Of the effects, with sigma/u(b2) as last row, shape (q + 1, monomials).
    coefficients: Array
    error: float  #: The largest error found in the check, in parts of each one's largest value.

    @classmethod
    def fit(cls, motion: StrobedMotion, symbols: Sequence[str], box: Box) -> Surrogate:
        """Make the polynomials of a run and check them."""
        places = box.varies
        powers = sorted(_powers(places.size), key=sum)
        generator = np.random.default_rng(4)
        points = _POINTS_PER_COEFFICIENT * len(powers) if places.size else 1
        # Points that crowd towards the faces, as Chebyshev's do, keep the error even.
        scaled = np.cos(math.pi * generator.random((places.size, points)))
        checked = generator.uniform(-1.0, 1.0, (places.size, _CHECK_POINTS if places.size else 1))
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=places.size))).T
        if places.size:
            checked = np.hstack([checked, corners])
        exact, check = (_exact(motion, symbols, box, points) for points in (scaled, checked))
        size = np.maximum(np.abs(exact).max(axis=1), 1e-30)[:, None]
        basis, basis_check = _monomials(scaled, powers), _monomials(checked, powers)
        coefficients = _fitted(basis, exact / size) * size
        # A term that acts very little is compared with the effect of others at credible sizes.
        limits = np.array([term(symbol).limit for symbol in symbols])[:, None]
        floor = _SMALLEST_EFFECT * np.max(size[:-1] * limits) / limits
        scale = np.vstack([np.maximum(size[:-1], floor), size[-1:]])
        error = float(np.max(np.abs(coefficients @ basis_check - check) / scale))
        if error > _TOLERANCE:
            raise ConvergenceError(
                f'the polynomial surrogate errs by {error:.1e} in its box; use `engine="exact"`'
            )
        return cls(box, tuple(powers), coefficients, error)

    def holds(self, small: Sequence[Array]) -> npt.NDArray[np.bool_]:
        """Return for which rotations (drift, cos, sin; each (n,)) the surrogate holds."""
        inside = np.ones(np.broadcast_shapes(*(part.shape for part in small)), dtype=bool)
        for value, centre, half in zip(small, self.box.centre, self.box.half, strict=True):
            slack = half if half > 0.0 else 1e-12 * abs(centre)
            inside &= np.abs(value - centre) <= slack
        return inside

    def __call__(self, small: Sequence[Array]) -> tuple[Array, Array]:
        """Return the effects, shape (q, n), and sigma/u(b2), (n,); n is 1 where nothing varies."""
        scaled = [(small[i] - self.box.centre[i]) / self.box.half[i] for i in self.box.varies]
        found = self.coefficients @ _monomials(scaled, self.powers)
        return found[:-1], found[-1]


def _powers(count: int) -> list[tuple[int, ...]]:
    ranges = itertools.product(range(DEGREE + 1), repeat=count)
    return [powers for powers in ranges if sum(powers) <= DEGREE]


def _monomials(scaled: Sequence[Array] | Array, powers: Sequence[tuple[int, ...]]) -> Array:
    """Return all monomials, shape (monomials, n), each by one product of an earlier one."""
    n = scaled[0].size if len(scaled) else 1
    basis = np.empty((len(powers), n))
    basis[0] = 1.0
    for index, lower, factor in _products(tuple(powers)):
        np.multiply(basis[lower], scaled[factor], out=basis[index])
    return basis


@lru_cache(maxsize=16)
def _products(powers: tuple[tuple[int, ...], ...]) -> tuple[tuple[int, int, int], ...]:
    """Return for each monomial beside the first its place, an earlier one's, and the factor."""
    place = {power: index for index, power in enumerate(powers)}
    products = []
    for power in sorted(powers, key=sum)[1:]:
        lead = next(i for i, p in enumerate(power) if p)
        lower = tuple(p - (i == lead) for i, p in enumerate(power))
        products.append((place[power], place[lower], lead))
    return tuple(products)


def _exact(motion: StrobedMotion, symbols: Sequence[str], box: Box, scaled: Array) -> Array:
    values = np.repeat(box.centre[:, None], scaled.shape[1], axis=1)
    values[box.varies] += box.half[box.varies, None] * scaled
    found, size = effects(motion, symbols, *values)
    return np.vstack([found, size])


def _fitted(basis: Array, values: Array) -> Array:
    return np.asarray(np.linalg.lstsq(basis.T, values.T, rcond=None)[0].T)
