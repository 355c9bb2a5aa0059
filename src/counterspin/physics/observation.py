"""What a record shows of each error: observation columns, metres per unit coefficient (Eq. 10-14).

Given the trajectory, the error of the recorded output is linear in the coefficients,
e(t) = start offset + start velocity x t + sum_j (K_j - nominal) x column_j(t). The columns are
double time integrals for displacement, single for velocity, and none for specific force.

- `columns`: one column for each term of the table, along any trajectory
- `reference`: what a perfect system would have recorded
- `gravity_left`: the part of it that the navigation computer leaves of gravity
- `over_blocks`: columns or reference for block means
- `parabola`: the t^2 coefficients at constant rate, in closed form
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache, partial
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.physics import quadrature
from counterspin.physics.accelerometer import Mounting, Term
from counterspin.physics.conditions import AT_REFERENCE, ConditionTerm
from counterspin.physics.motion import Motion, Site, Trajectory
from counterspin.physics.path_errors import path_change
from counterspin.physics.quadrature import Panels
from counterspin.physics.shared_terms import AnyTerm, MotionTerm, PlatformTerm, SharedTerm, term

#: How often each observable integrates the specific force.
ORDERS: Final = {"displacement": 2, "velocity": 1, "specific_force": 0}

LEVEL: Final[Array] = np.eye(3)  #: attitude with x, y, z pointing east, north, up
LEVEL.flags.writeable = False  # a default that calls share


def reference(
    trajectory: Trajectory,
    mounting: Mounting,
    times: Array,
    observable: str = "displacement",
    attitude: Array = LEVEL,
) -> Array:
    """Return what perfect accelerometers record along an accelerometer's input axis (Eq. 11).

    Gravity that the navigation computer leaves is in it, as S'' = f - f_h has it.

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
    axis = mounting.turned(attitude).input_axis
    result: Array = motion(times) @ axis
    if trajectory.site.gravity_left:
        result = result + gravity_left(trajectory.site, axis, times, observable)
    return result


def gravity_left(site: Site, input_axis: Array, times: Array, observable: str) -> Array:
    """Return what the navigation computer leaves of gravity in a record, shape (n,).

    Parameters
    ----------
    site
        With the gravity that the computer removes.
    input_axis
        In the run's attitude, east-north-up, shape (3,).
    times, observable
        As for `columns`.
    """
    order = ORDERS[observable]
    if order == 0:  # from a force nothing is taken away
        return np.zeros(times.size)
    return site.gravity_left * float(input_axis[2]) * times**order / order


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

    Examples
    --------
    What a bias of 1 g does is g t^2/2, whatever the spindle does:

    >>> import math
    >>> import numpy as np
    >>> import counterspin as cs
    >>> site = cs.Site(gravity=9.8, latitude=math.radians(45.0))
    >>> trajectory = cs.Trajectory(cs.Spindle(math.pi), radius=2.5, site=site)
    >>> cs.columns(trajectory, cs.QX, ["K_F"], np.array([1.0, 10.0])).round(6).ravel().tolist()
    [4.9, 490.0]
    """
    order = ORDERS[observable]
    rows = [term(symbol) for symbol in symbols]
    shown = _Shown(trajectory, mounting.turned(attitude), attitude, times, order)
    linear = {i: vector for i, row in enumerate(rows) if (vector := shown.along(row)) is not None}
    bias = [i for i, row in enumerate(rows) if row.symbol == "K_F"]
    kinked = [i for i, row in enumerate(rows) if isinstance(row, Term) and _has_kink(row)]
    path = [i for i, row in enumerate(rows) if isinstance(row, MotionTerm)]
    slopes = {i: row for i, row in enumerate(rows) if isinstance(row, ConditionTerm)}
    smooth = [i for i in range(len(rows)) if i not in (*linear, *bias, *kinked, *path, *slopes)]
    result = np.empty((len(rows), times.size))
    result[bias] = trajectory.site.gravity * times**order / max(1, order)
    if kinked:
        with_kink = [row for row in rows if isinstance(row, Term) and _has_kink(row)]
        result[kinked] = shown.kinked(with_kink)
    if smooth or linear:
        integrated = [row for i in smooth if not isinstance(row := rows[i], ConditionTerm)]
        result[smooth], force = shown.smooth(integrated, bool(linear))
        for i, vector in linear.items():
            result[i] = vector @ force
    for i in path:
        row = rows[i]
        assert isinstance(row, MotionTerm)
        result[i] = path_change(row, shown.motion, order) @ shown.input_axis
    sloping = list(dict.fromkeys(row.coefficient for row in slopes.values()))
    if sloping:
        own = columns(trajectory, mounting, sloping, times, observable, attitude=attitude)
    for i, row in slopes.items():
        lever = row.lever(trajectory.conditions, trajectory.centripetal)
        result[i] = lever * own[:, sloping.index(row.coefficient)]
        if row.condition == "time":  # it goes on changing within the run
            result[i] += trajectory.site.gravity * times ** (order + 1) / math.factorial(order + 1)
    # The accelerometer sees what is shared through its scale factor.
    shared = [i for i, row in enumerate(rows) if isinstance(row, PlatformTerm | MotionTerm)]
    result[shared] *= scale_factor
    return result.T


def _has_kink(row: Term) -> bool:
    return "|I|" in row.factors


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


@lru_cache(maxsize=8)
def _along(trajectory: Trajectory, duration: float) -> tuple[Panels, Motion]:
    """Return the panels of a trajectory and the motion at their nodes.

    Kept for a while: accelerometers of one run share them, and so do a fit and its checks.
    """
    edges = quadrature.panel_edges(trajectory.spindle, duration, coarse=trajectory.coarse)
    panels = Panels(edges)
    return panels, trajectory.at(panels.nodes)


class _Shown:
    """The integrals along one trajectory at one set of times."""

    def __init__(
        self, trajectory: Trajectory, axes: Mounting, attitude: Array, times: Array, order: int
    ) -> None:
        self._trajectory = trajectory
        self._axes = axes
        self._attitude = attitude
        self._times = times
        self._order = order
        self._duration = max(float(times.max(initial=0.0)), np.finfo(float).tiny)

    @cached_property
    def motion(self) -> Motion:
        """The motion at the times."""
        return self._trajectory.at(self._times)

    @property
    def input_axis(self) -> Array:
        """The input axis in the run's attitude, east-north-up, shape (3,)."""
        return self._axes.input_axis

    def along(self, row: AnyTerm) -> Array | None:
        """Return the vector whose product with the specific force is the term, if there is one."""
        if isinstance(row, Term):
            if len(row.factors) != 1:
                return None
            axis: Array = row.sign * self._axes.matrix["IPO".index(row.factors[0])]
            return axis
        if not isinstance(row, PlatformTerm) or row.kind != "tilt":
            return None
        # (-psi x f) . I = f . (psi x I)
        return np.cross(np.eye(3)[row.axis], self._axes.input_axis)

    def smooth(self, rows: Sequence[Term | SharedTerm], with_force: bool) -> tuple[Array, Array]:
        """Return the integrals of terms, (k, n), and where wanted of the force, (3, n)."""
        if self._order == 0:
            return self._integrands(rows, self.motion), self.motion.specific_force.T
        panels, motion = _along(self._trajectory, self._duration)
        integrals = self._integrals(rows, panels, motion, with_force and self._order == 2)
        if self._order == 1:
            return integrals, self.motion.velocity_of_specific_force.T
        if not with_force:
            return integrals, np.empty((0, self._times.size))
        return integrals[2:], self._double_integral_of_force(integrals[:2])

    def kinked(self, rows: Sequence[Term | SharedTerm]) -> Array:
        """Return the integrals of terms that have a kink where a_I changes sign, (k, n)."""
        motion, along = self._trajectory, self._axes.input_axis
        if self._order == 0:
            return self._integrands(rows, self.motion)
        of_panels = partial(
            quadrature.panel_edges, motion.spindle, self._duration, coarse=motion.coarse
        )
        breaks = quadrature.sign_changes(lambda t: motion.specific_force(t) @ along, of_panels())
        panels = Panels(of_panels(breaks))
        return self._integrals(rows, panels, motion.at(panels.nodes))

    def _integrals(
        self,
        rows: Sequence[Term | SharedTerm],
        panels: Panels,
        motion: Motion,
        with_path: bool = False,
    ) -> Array:
        """Return the integrals of terms, before them if wanted those of the path, east and north.

        All functions are integrated together: where the times lie in the panels is found once.
        """
        terms = self._integrands(rows, motion)
        if self._order == 1:
            return panels.integrals(self._times, once=terms)
        path = motion.position.T[:2] if with_path else None
        return panels.integrals(self._times, once=path, twice=terms)

    def _integrands(self, rows: Sequence[Term | SharedTerm], motion: Motion) -> Array:
        """Return what the terms integrate, m/s^2 per unit coefficient and K_I, shape (k, m)."""
        sensed = _Sensed(motion, self._axes, self._attitude)
        values = np.empty((len(rows), motion.t.size))
        for index, row in enumerate(rows):
            values[index] = sensed.integrand(row)
        return values

    def _double_integral_of_force(self, path: Array) -> Array:
        """Double integral of the specific force, (3, n), by the exact identity of kinematics.

        The double integral of the acceleration is the position less its start value and slope:
        as a quadrature it would be a small difference of large numbers. Only the Coriolis part,
        2 Omega x (integral of the position), needs a quadrature; `path` is that of its part to
        east and north, (2, n).
        """
        t, site = self._times, self._trajectory.site
        start = self._trajectory.at(np.zeros(1))
        doubled = self.motion.position.T - start.position.T - start.velocity.T * t
        east, north = 2.0 * (path - start.position.T[:2] * t)
        _, to_north, to_up = site.earth_rotation
        doubled[0] -= to_up * north
        doubled[1] += to_up * east
        doubled[2] += 0.5 * site.gravity * t**2 - to_north * east
        return doubled


class _Sensed:
    """What accelerometer and gyros sense during a motion; each part is worked out once."""

    def __init__(self, motion: Motion, axes: Mounting, attitude: Array) -> None:
        self._motion = motion
        self._axes = axes
        # The gyros turn with the platform: their axes are rows of the attitude.
        self._attitude = attitude
        self._gravity = motion.trajectory.site.gravity

    def integrand(self, row: Term | SharedTerm) -> Array:
        """Return what a term integrates, m/s^2 per unit coefficient and K_I, shape (m,)."""
        if isinstance(row, Term):
            return self._gravity * row.evaluate(self._a_ipo)
        assert isinstance(row, PlatformTerm)  # errors of the path are no integrals
        integrand: Array = self._turn(row) * self._turned[row.axis]
        return integrand

    def _turn(self, row: PlatformTerm) -> Array:
        """Return the attitude error per unit of a term that is no tilt, rad, (m,)."""
        if row.kind == "drift":
            return self._motion.t
        if row.kind == "g2_sensitivity":
            return self._motion.square_of_specific_force / self._gravity**2
        assert row.force_axis is not None
        along = self._gained if row.kind == "g_sensitivity" else self._along_platform
        turn: Array = along[row.force_axis]
        return turn

    @cached_property
    def _a_ipo(self) -> Array:
        """Specific force along I, P, O in g, shape (3, m)."""
        return self._axes.matrix @ self._motion.specific_force.T / self._gravity

    @cached_property
    def _turned(self) -> Array:
        """What a turn about each of the platform's axes makes of the force, m/s^2, (3, m)."""
        arms = np.cross(self._attitude, self._axes.input_axis)
        return arms @ self._motion.specific_force.T

    @cached_property
    def _gained(self) -> Array:
        """Integral of the specific force along the platform's axes in g s, (3, m)."""
        return self._attitude @ self._motion.velocity_of_specific_force.T / self._gravity

    @cached_property
    def _along_platform(self) -> Array:
        """Specific force along the platform's axes in g, (3, m)."""
        return self._attitude @ self._motion.specific_force.T / self._gravity


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
    if isinstance(row, ConditionTerm):
        return 0.5 * gravity * row.lever(AT_REFERENCE, force)
    if isinstance(row, Term):
        vertical = float(matrix[1, 2]) ** row.factors.count("P")  # a_P is -1 with P down
        horizontal = force ** sum(factor != "P" for factor in row.factors)
        return 0.5 * gravity * row.sign * vertical * horizontal * _mean_of_harmonics(row.factors)
    if isinstance(row, PlatformTerm):
        return _parabola_of_platform(row, matrix, rate, radius, gravity)
    return 0.0  # the path comes back to where it was after each revolution


def _parabola_of_platform(
    row: PlatformTerm, matrix: Array, rate: float, radius: float, gravity: float
) -> float:
    force = radius * rate**2 / gravity
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
    if row.kind == "compliance" and row.force_axis is not None:
        # Gravity leans the platform for good; a level force comes round with what it turns.
        level = row.force_axis < 2
        return 0.5 * gravity * float(seen[row.force_axis]) * (0.5 * force**2 if level else 1.0)
    return 0.0


def _mean_of_harmonics(factors: Sequence[str]) -> float:
    """Return the mean over a revolution of cos^i sin^o, as many as there are I and O."""
    i, o = sum(factor in ("I", "|I|") for factor in factors), factors.count("O")
    if i % 2 or o % 2 or "|I|" in factors:
        return 0.0
    # The beta integral, (i-1)!! (o-1)!! / (i+o)!! in terms of gamma functions.
    gammas = math.gamma((i + 1) / 2) * math.gamma((o + 1) / 2)
    return gammas / (math.pi * math.gamma((i + o) / 2 + 1))
