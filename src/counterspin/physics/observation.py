"""What a record shows of each error: observation columns, metres per unit coefficient (Eq. 10-14).

Given the trajectory, the error of the recorded output is linear in the coefficients,
e(t) = start offset + start velocity x t + sum_j (K_j - nominal) x column_j(t). The columns are
double time integrals for displacement, single for velocity, and none for specific force.

- `columns`: one column for each term of the table, along any trajectory
- `reference`: what a perfect system would have recorded
- `over_blocks`: either of them for block means
- `parabola`: the t^2 coefficients at constant rate, in closed form
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from counterspin.physics import quadrature
from counterspin.physics.accelerometer import (
    Array,
    Mounting,
    PlatformTerm,
    Term,
    term,
)
from counterspin.physics.motion import Trajectory

#: How often each observable integrates the specific force.
ORDERS: Final = {"displacement": 2, "velocity": 1, "specific_force": 0}

LEVEL: Final[Array] = np.eye(3)  #: attitude with x, y, z pointing east, north, up


def reference(
    trajectory: Trajectory,
    mounting: Mounting,
    times: Array,
    observable: str = "displacement",
    attitude: Array = LEVEL,
) -> Array:
    """Return what a perfect system records along an accelerometer's input axis (Eq. 11).

    Parameters
    ----------
    trajectory, mounting, attitude
        As for `columns`.
    times
        s, shape (n,).
    observable
        ``displacement`` (m), ``velocity`` (m/s) or ``specific_force`` (m/s^2).

    Returns
    -------
    Array
        Shape (n,).
    """
    motion = {
        "displacement": trajectory.position,
        "velocity": trajectory.velocity,
        "specific_force": trajectory.specific_force,
    }[observable]
    return motion(times) @ mounting.turned(attitude).input_axis


def columns(
    trajectory: Trajectory,
    mounting: Mounting,
    symbols: Sequence[str],
    times: Array,
    observable: str = "displacement",
    *,
    attitude: Array = LEVEL,
    scale_factor: float = 1.0,
) -> Array:
    """Return the observation columns of terms along a trajectory.

    Parameters
    ----------
    trajectory
        The motion from t = 0, the time at which the tilts are defined and where offset and
        start velocity are zero.
    mounting
        The accelerometer's axes in the level attitude.
    symbols
        Terms of the table, m of them.
    times
        s, not negative, shape (n,).
    observable
        ``displacement``, ``velocity`` or ``specific_force``.
    attitude
        Rows: where the platform's x, y, z axes point in east-north-up, shape (3, 3).
    scale_factor
        K_I, with which the accelerometer sees the platform's errors, g/g.

    Returns
    -------
    Array
        Shape (n, m), in m, m/s or m/s^2 per unit coefficient. For K_I the coefficient is
        K_I - 1.

    Raises
    ------
    ValueError
        If a symbol is not in the table.
    """
    order = ORDERS[observable]
    rows = [term(symbol) for symbol in symbols]
    axes = mounting.turned(attitude)
    panels = _Panels(trajectory, times)
    result = np.empty((times.size, len(rows)))
    by_quadrature: list[tuple[int, Callable[[Array, Array], Array]]] = []
    kinked = False
    for index, row in enumerate(rows):
        linear = _linear_in_force(row, axes)
        if linear is not None:
            factor = scale_factor if isinstance(row, PlatformTerm) else 1.0
            result[:, index] = factor * (panels.integral_of_force(order) @ linear)
        elif row.symbol == "K_F":
            result[:, index] = trajectory.site.gravity * times**order / max(1, order)
        else:
            kinked = kinked or (isinstance(row, Term) and "|I|" in row.factors)
            by_quadrature.append((index, _integrand(row, trajectory, axes, attitude, scale_factor)))
    if by_quadrature:
        functions = [function for _, function in by_quadrature]
        kink = (lambda t: trajectory.specific_force(t) @ axes.input_axis) if kinked else None

        def integrands(t: Array) -> Array:
            force = trajectory.specific_force(t)
            return np.stack([function(t, force) for function in functions])

        values = panels.integrate(integrands, order, kink)
        result[:, [index for index, _ in by_quadrature]] = values
    return result


def over_blocks(function: Callable[[Array], Array], times: Array, spread: Array) -> Array:
    """Return a function of time averaged over blocks of samples.

    Two points at the mean time plus and minus its standard deviation inside the block have the
    block's mean exactly up to the third power of time, which over 1/64 revolution leaves less
    than 1e-7 of the first harmonic.

    Parameters
    ----------
    function
        Maps times (m,) in s to values (m, ...).
    times, spread
        Mean time of each block and standard deviation of its samples' times, s, shape (n,).

    Returns
    -------
    Array
        Shape (n, ...).
    """
    if not np.any(spread):
        return function(times)
    both = function(np.concatenate([times - spread, times + spread]))
    mean: Array = 0.5 * (both[: times.size] + both[times.size :])
    return mean


class _Panels:
    """The integrals along one trajectory at one set of times, each computed once."""

    def __init__(self, trajectory: Trajectory, times: Array) -> None:
        self.trajectory = trajectory
        self.times = times
        self._force: dict[int, Array] = {}

    def integrate(
        self,
        integrand: Callable[[Array], Array],
        order: int,
        kink: Callable[[Array], Array] | None = None,
    ) -> Array:
        if order == 0:
            return integrand(self.times).T
        spindle = self.trajectory.spindle
        duration = max(float(self.times.max(initial=0.0)), np.finfo(float).tiny)
        edges = quadrature.panel_edges(spindle, duration)
        if kink is not None:
            breaks = quadrature.sign_changes(kink, edges)
            edges = quadrature.panel_edges(spindle, duration, breaks)
        return quadrature.integrate(integrand, edges, self.times, order)

    def integral_of_force(self, order: int) -> Array:
        """Integral of the specific force, shape (n, 3), by the exact identity of kinematics.

        The double integral of the acceleration is the position less its start value and slope:
        as a quadrature it would be a small difference of large numbers. Only the Coriolis part
        of the double integral, 2 Omega x (integral of the position), needs a quadrature.
        """
        if order not in self._force:
            self._force[order] = self._integral_of_force(order)
        return self._force[order]

    def _integral_of_force(self, order: int) -> Array:
        motion, t = self.trajectory, self.times
        if order == 0:
            return motion.specific_force(t)
        if order == 1:
            return motion.velocity_of_specific_force(t)
        zero = np.zeros(1)
        start = motion.position(zero)
        swept = self.integrate(lambda s: motion.position(s).T, 1) - start * t[:, None]
        up = np.array([0.0, 0.0, motion.site.gravity])
        return (
            motion.position(t)
            - start
            - motion.velocity(zero) * t[:, None]
            + 2.0 * np.cross(motion.site.earth_rotation, swept)
            + 0.5 * up * t[:, None] ** 2
        )


def _linear_in_force(row: Term | PlatformTerm, axes: Mounting) -> Array | None:
    """Return the vector whose product with the specific force is the term, if there is one."""
    if isinstance(row, Term):
        if len(row.factors) != 1:
            return None
        along: Array = row.sign * axes.matrix["IPO".index(row.factors[0])]
        return along
    if row.kind != "tilt":
        return None
    # (-psi x f) . I = f . (psi x I)
    return np.cross(np.eye(3)[row.axis], axes.input_axis)


def _integrand(
    row: Term | PlatformTerm,
    trajectory: Trajectory,
    axes: Mounting,
    attitude: Array,
    scale_factor: float,
) -> Callable[[Array, Array], Array]:
    """Return what the term integrates, m/s^2 per unit, of time (n,) and specific force (n, 3)."""
    g = trajectory.site.gravity
    if isinstance(row, Term):
        return lambda _, force: g * row.evaluate(axes.matrix @ force.T / g)
    # The gyros turn with the platform: their axes are rows of the attitude.
    arm = scale_factor * np.cross(attitude[row.axis], axes.input_axis)
    if row.force_axis is None:
        return lambda t, force: t * (force @ arm)
    force_axis = attitude[row.force_axis] / g
    return lambda t, force: (trajectory.velocity_of_specific_force(t) @ force_axis) * (force @ arm)


def parabola(symbol: str, mounting: Mounting, rate: float, radius: float, gravity: float) -> float:
    """Return the t^2 coefficient of a term's displacement at constant rate, in closed form.

    Without Earth rate, from start angle 0, in the level attitude, for a horizontal input axis
    with the pendulous axis vertical. This is the corrected content of Eq. 19: K_II enters with
    1/4, not 1/2.

    Parameters
    ----------
    symbol
        A term of the table; those without a parabola give 0 (drift grows with t^3).
    rate, radius, gravity
        rad/s (signed), m, m/s^2.

    Returns
    -------
    float
        m/s^2 per unit coefficient.

    Raises
    ------
    ValueError
        If the symbol is unknown or the mounting is not of this kind.
    """
    matrix = mounting.matrix
    if abs(matrix[0, 2]) > 1e-9 or abs(abs(matrix[1, 2]) - 1.0) > 1e-9:
        raise ValueError("closed forms need a horizontal input axis and a vertical pendulous axis")
    row = term(symbol)
    force = radius * rate**2 / gravity
    if isinstance(row, Term):
        vertical = float(matrix[1, 2]) ** row.factors.count("P")  # a_P is -1 with P down
        horizontal = force ** sum(factor != "P" for factor in row.factors)
        return 0.5 * gravity * row.sign * vertical * horizontal * _mean_of_harmonics(row.factors)
    seen = np.cross(np.eye(3)[row.axis], matrix[0])
    if row.kind == "tilt":
        return 0.5 * gravity * float(seen[2])
    if row.kind == "g_sensitivity" and row.force_axis in (0, 1):
        # psi follows the velocity gained since the start. About the vertical it turns the
        # centripetal force, and the product has a mean where the two directions cross;
        # about a horizontal axis the start velocity stays behind as a tilt against gravity.
        along = float(np.cross(np.eye(3)[row.force_axis], seen)[2])
        start_velocity = radius * rate if row.force_axis == 1 else 0.0
        return 0.25 * radius * rate * force * along - 0.5 * float(seen[2]) * start_velocity
    return 0.0


def _mean_of_harmonics(factors: Sequence[str]) -> float:
    """Return the mean over a revolution of cos^i sin^o, as many as there are I and O."""
    i, o = sum(factor in ("I", "|I|") for factor in factors), factors.count("O")
    if i % 2 or o % 2 or "|I|" in factors:
        return 0.0
    # The beta integral, (i-1)!! (o-1)!! / (i+o)!! in terms of gamma functions.
    gammas = math.gamma((i + 1) / 2) * math.gamma((o + 1) / 2)
    return gammas / (math.pi * math.gamma((i + o) / 2 + 1))
