"""The t^2 coefficient that each error adds to a strobed run, for many rotations at once.

The first stage is linear: b2 = sum_k g_k e(t_k) over the strobes, with sum g_k = sum g_k t_k = 0.
A double integral e(t) = int (t - s) f(s) ds therefore adds

    b2 = int W(s) f(s) ds,    W(s) = sum over t_k > s of g_k (t_k - s),

one integral with a kernel that is linear between strobes and zero outside them. Two panels of
twelve Gauss-Legendre nodes between neighbouring strobes give it to rounding.

What each error adds to a run's b2 is a smooth function of the drift and of the first harmonic's
cosine and sine parts. A `Surrogate`, a polynomial of the fourth degree through points computed so,
stands for it inside a box, whose corners and inside are checked when it is made. Quantities that
do not vary take no part; where none varies the polynomial is a constant.
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
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.effects import (
    AttitudeError,
    Effect,
    Slope,
    SpecificForceProduct,
    TrajectoryError,
)
from counterspin.physics.motion import Site
from counterspin.physics.spindle import TURN, Spindle
from counterspin.physics.terms import term

_PANELS: Final = 2
_NODES: Final = 12

#: Node times times trials that are worked on at once: a cache's worth.
_VALUES_AT_ONCE: Final = 30_000


def _between() -> tuple[Array, Array]:
    """Return nodes in [0, 1] and weights that sum to 1."""
    x, w = np.polynomial.legendre.leggauss(_NODES)
    starts = np.arange(_PANELS)[:, None] / _PANELS
    nodes = (starts + (1.0 + x) / (2.0 * _PANELS)).ravel()
    return nodes, np.tile(w / (2.0 * _PANELS), _PANELS)


_X, _W = _between()


@frozen
class StrobedMotion:
    """The strobed motion of one run."""

    #: Rate, start angle and the harmonics beyond the first; drift and first harmonic vary.
    spindle: Spindle
    angles: Array  #: Spindle angles of the strobes, rad, shape (m,).
    mounting: Mounting  #: The axes in the run's attitude.
    attitude: Array  #: The platform's attitude, shape (3, 3).
    site: Site  #: Where the centrifuge stands.
    radius: float  #: m.

    @classmethod
    def of(
        cls,
        spindle: Spindle,
        duration: float,
        phase: float,
        mounting: Mounting,
        attitude: Array,
        site: Site,
        radius: float,
    ) -> StrobedMotion:
        """Return a run with the strobes that a record of this duration passes."""
        first = spindle.start_angle
        last = first + spindle.rate * duration
        low, high = min(first, last), max(first, last)
        margin = 1e-9 * TURN
        turns = np.arange(
            math.ceil((low - phase - margin) / TURN), math.floor((high - phase + margin) / TURN) + 1
        )
        angles: Array = np.asarray(phase + TURN * turns, dtype=np.float64)
        angles = angles if spindle.rate > 0 else angles[::-1]
        return cls(spindle, angles, mounting.turned(attitude), attitude, site, radius)


#: Highest power of the input-axis force that the nodes resolve.
_HIGHEST_POWER: Final = 4


def obstacle(symbol: str) -> str | None:
    """Return the obstacle to a term in this quadrature, in words after its symbol, or None."""
    match term(symbol).effect:
        case SpecificForceProduct(has_kink=kink, power=power) if kink or power > _HIGHEST_POWER:
            return "has a kink" if kink else "has harmonics above the fourth"
        case SpecificForceProduct(of_rotation=True) | AttitudeError(kind="table"):
            return "does not act on a platform that keeps its attitude"
        case TrajectoryError():
            return "changes the path"
        case Slope():
            return "changes from run to run"
        case AttitudeError(kind="g2_sensitivity"):
            # Its turn before the first strobe is an integral without a closed form.
            return "has no closed form"
    return None


def effects(
    motion: StrobedMotion,
    symbols: Sequence[str],
    drift: Array,
    ripple_cos: Array,
    ripple_sin: Array,
) -> tuple[Array, Array]:
    """Return b2 per unit coefficient, and the divisor of a strobe's noise in b2.

    symbols: Terms, q of them, none with an `obstacle`. The platform's are seen with a scale factor
        of 1.
    drift, ripple_cos, ripple_sin: Of each of n rotations, shape (n,): 1/s, ratios.
    Returns: b2 per unit in m/s^2, shape (q, n), and sigma/u(b2) in s^2, shape (n,).
    """
    n = drift.size
    curvatures = np.empty((len(symbols), n))
    size = np.empty(n)
    step = max(1, _VALUES_AT_ONCE // (motion.angles.size * _X.size))
    for start in range(0, n, step):
        part = slice(start, start + step)
        rotation = _Rotation(motion.spindle, drift[part], ripple_cos[part], ripple_sin[part])
        curvatures[:, part], size[part] = _effects(motion, symbols, rotation)
    return curvatures, size


class _Rotation:
    """The angle of many rotations at once; times of shape (..., n), the rotations last."""

    def __init__(self, spindle: Spindle, drift: Array, cos: Array, sin: Array) -> None:
        self.rate, self.start = spindle.rate, spindle.start_angle
        self.drift, self.cos, self.sin = drift, cos, sin
        self.others = [
            (ripple.harmonic, ripple.amplitude / spindle.rate, ripple.phase)
            for ripple in spindle.ripples
            if ripple.harmonic != 1
        ]

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """Return angle (rad), rate and angular acceleration (rad/s, rad/s^2) at times in s."""
        w0 = self.rate
        uniform = w0 * t
        c, s = np.cos(uniform), np.sin(uniform)
        wave = self.cos * c - self.sin * s
        slope = self.cos * s + self.sin * c
        angle = self.start + uniform * (1.0 + 0.5 * self.drift * t) - wave + self.cos
        rate = 1.0 + self.drift * t + slope
        alpha = wave + self.drift / w0
        for n, ratio, phase in self.others:
            inside = n * uniform + phase
            angle -= ratio / n * (np.cos(inside) - math.cos(phase))
            rate += ratio * np.sin(inside)
            alpha += n * ratio * np.cos(inside)
        return angle, w0 * rate, w0 * w0 * alpha

    def time_at(self, angles: Array) -> Array:
        """Return the times at which the angles (m,) are passed, s, shape (m, n)."""
        target = angles[:, None]
        if np.any(np.hypot(self.cos, self.sin) >= 1.0):
            raise ConvergenceError("the ripple stops the spindle; its ratio must be below 1")
        t = (target - self.start) / self.rate * np.ones_like(self.drift)
        for _ in range(50):
            angle, rate, _ = self.at(t)
            step = (angle - target) / rate
            t = t - step
            if np.all(np.abs(step) <= 1e-9 * (1.0 + np.abs(t))):  # squared by the next step
                angle, rate, _ = self.at(t)
                return np.asarray(t - (angle - target) / rate)
        raise ConvergenceError("the strobes are not reached: the ripple is too large for this rate")


def _effects(
    motion: StrobedMotion, symbols: Sequence[str], rotation: _Rotation
) -> tuple[Array, Array]:
    strobes = rotation.time_at(motion.angles)
    n = rotation.drift.size
    gain, size = curvature_gain(strobes)
    gap = np.diff(strobes, axis=0)
    times = strobes[:-1, None] + gap[:, None] * _X[:, None]
    # Sums over the later strobes, taken from a strobe's own time so that nothing cancels.
    later = np.cumsum(gain[::-1], axis=0)[::-1][1:]
    moment = np.cumsum((gap * later)[::-1], axis=0)[::-1]
    kernel = moment[:, None] - later[:, None] * (gap[:, None] * _X[:, None])
    weight = (kernel * gap[:, None] * _W[:, None]).reshape(-1, n)
    field = _Force(motion, rotation, times.reshape(-1, n))
    curvatures = np.empty((len(symbols), n))
    for index, symbol in enumerate(symbols):
        curvatures[index] = _effect(motion, term(symbol).effect, field, weight, gain)
    return curvatures, size


def curvature_gain(strobes: Array) -> tuple[Array, Array]:
    """Return d(b2)/d(strobes) of an unweighted parabola (m, n), and 1/its norm (n,)."""
    t = strobes - strobes.mean(axis=0)
    square = t * t
    mean = square.mean(axis=0)
    tilt = np.sum(square * t, axis=0) / (mean * t.shape[0])
    shape = square - tilt * t - mean
    norm = np.sum(shape * shape, axis=0)
    return shape / norm, np.sqrt(norm)


class _Force:
    """The specific force at the nodes, east, north and up, and its derived quantities."""

    def __init__(self, motion: StrobedMotion, rotation: _Rotation, times: Array) -> None:
        self.times, self.site, self.radius = times, motion.site, motion.radius
        radius = motion.radius
        angle, rate, alpha = rotation.at(times)
        self.cos, self.sin = np.cos(angle), np.sin(angle)
        along = radius * rate
        self._velocity = (-along * self.sin, along * self.cos)
        inward, forward = along * rate, radius * alpha
        turn = 2.0 * motion.site.earth_rotation
        east, north = self._velocity
        self.force = (
            -inward * self.cos - forward * self.sin - turn[2] * north,
            -inward * self.sin + forward * self.cos + turn[2] * east,
            motion.site.gravity - turn[1] * east,
        )
        self._turn = turn
        start = rotation.at(np.zeros((1, rotation.drift.size)))
        self._start = (
            -radius * start[1][0] * np.sin(start[0][0]),
            radius * start[1][0] * np.cos(start[0][0]),
        )
        self._first = (np.cos(start[0][0]), np.sin(start[0][0]))

    def along(self, axis: Array) -> Array:
        """Return the component along an axis, m/s^2."""
        east, north, up = self.force
        return np.asarray(axis[0] * east + axis[1] * north + axis[2] * up)

    def velocity_along(self, axis: Array) -> Array:
        """Return the integral of the specific force along an axis since t = 0, m/s."""
        east = self.radius * (self.cos - self._first[0])
        north = self.radius * (self.sin - self._first[1])
        gained = (
            self._velocity[0] - self._start[0] - self._turn[2] * north,
            self._velocity[1] - self._start[1] + self._turn[2] * east,
            self.site.gravity * self.times - self._turn[1] * east,
        )
        return np.asarray(axis[0] * gained[0] + axis[1] * gained[1] + axis[2] * gained[2])

    def coriolis_along(self, axis: Array) -> Array:
        """Return the Coriolis part alone, m/s^2."""
        east, north = self._velocity
        turn = self._turn
        return np.asarray(
            -axis[0] * turn[2] * north + axis[1] * turn[2] * east - axis[2] * turn[1] * east
        )


def _effect(
    motion: StrobedMotion,
    effect: Effect,
    field: _Force,
    weight: Array,
    gain: Array,
) -> Array:
    g = motion.site.gravity
    axes = motion.mounting
    if isinstance(effect, SpecificForceProduct):
        if not effect.factors:
            return np.full(gain.shape[1], 0.5 * g)
        if effect.is_linear:
            axis = effect.weight * axes.matrix["IPO".index(effect.factors[0])]
            return _linear(motion, axis, field, weight, gain)
        a_ipo = np.stack([field.along(axis) for axis in axes.matrix]) / g
        return _weighted(weight, g * effect.evaluate(a_ipo))
    assert isinstance(effect, AttitudeError)
    if effect.kind == "tilt":
        axis = np.cross(np.eye(3)[effect.axis], axes.input_axis)
        return _linear(motion, axis, field, weight, gain)
    arm = np.cross(motion.attitude[effect.axis], axes.input_axis)
    turned = field.along(arm)
    if effect.force_axis is None:
        return _weighted(weight, field.times * turned)
    axis = motion.attitude[effect.force_axis]
    lean = field.along(axis) if effect.kind == "compliance" else field.velocity_along(axis)
    return _weighted(weight, lean * turned / g)


def _linear(motion: StrobedMotion, axis: Array, field: _Force, weight: Array, gain: Array) -> Array:
    """Return b2 of the force along an axis: the position at the strobes, without an integration."""
    position = axis[0] * np.cos(motion.angles) + axis[1] * np.sin(motion.angles)
    moved = field.radius * (position @ gain)
    upward = 0.5 * motion.site.gravity * axis[2]
    return np.asarray(moved + upward + _weighted(weight, field.coriolis_along(axis)))


def _weighted(weight: Array, values: Array) -> Array:
    return np.asarray(np.einsum("sn,sn->n", weight, values))


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
    """The range of a surrogate: centre and half width of drift and ripple parts, (3,)."""

    centre: Array
    half: Array

    @property
    def varies(self) -> npt.NDArray[np.intp]:
        """Indices of the quantities, of three, that vary."""
        return np.flatnonzero(self.half > 0.0)


def box_of(motion: StrobedMotion, bounds: Array) -> Box:
    """Return the box of the draws of a study, cut to the largest box of a surrogate.

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
        coefficients = _fit_monomials(basis, exact / size) * size
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
        fitted = self.coefficients @ _monomials(scaled, self.powers)
        return fitted[:-1], fitted[-1]


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
    """Return for each monomial except the first its place, an earlier one's, and the factor."""
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
    b2, size = effects(motion, symbols, *values)
    return np.vstack([b2, size])


def _fit_monomials(basis: Array, values: Array) -> Array:
    return np.asarray(np.linalg.lstsq(basis.T, values.T, rcond=None)[0].T)
