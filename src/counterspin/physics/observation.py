"""Design columns of the error terms, metres per unit coefficient (Eq. 10-14).

Given the trajectory, the error of the recorded output is linear in the coefficients,
e(t) = start offset + start velocity x t + sum_j (K_j - nominal) x column_j(t). The columns are
double time integrals for displacement, single for velocity, and none for specific force.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.physics import quadrature
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.effects import (
    AttitudeError,
    Effect,
    Slope,
    SpecificForceProduct,
    TrajectoryError,
)
from counterspin.physics.motion import Motion, Site, Trajectory, motion_at, trajectory_sensitivity
from counterspin.physics.quadrature import Panels
from counterspin.physics.spindle import Spindle
from counterspin.physics.terms import TERMS, term

#: Largest number of nodes for which integrals are cached: about a hundred revolutions.
_MAX_NODES: Final = 16384

#: Effects that are integrated along a trajectory.
IntegratedEffect = SpecificForceProduct | AttitudeError | Slope

#: Observable -> number of integrations of the specific force.
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
    """Return the record of perfect accelerometers along an input axis (Eq. 11).

    It includes the residual gravity of the navigation computer, as in S'' = f - f_h.

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
    if mounting.response is not None:
        static = replace(mounting, response=None)

        def sensed_record(spindle: Spindle) -> Array:
            path = replace(trajectory, spindle=spindle)
            return columns(path, static, ["K_I"], times, observable, attitude=attitude)[:, 0]

        def static_record(spindle: Spindle) -> Array:
            path = replace(trajectory, spindle=spindle)
            return reference(path, static, times, observable, attitude)

        return mounting.response.filter_record(trajectory.spindle, static_record, sensed_record)
    axis = mounting.turned(attitude).input_axis
    quantity = {"displacement": "position"}.get(observable, observable)
    result: Array = getattr(motion_at(trajectory, times), quantity) @ axis
    if trajectory.site.gravity_left:
        result = result + residual_gravity(trajectory.site, axis, times, observable)
    return result


def residual_gravity(site: Site, input_axis: Array, times: Array, observable: str) -> Array:
    """Return the contribution of residual gravity to a record, shape (n,).

    input_axis: Input axis in the attitude of the run, east-north-up, shape (3,).
    """
    order = ORDERS[observable]
    if order == 0:  # gravity is not removed from a force
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
        The motion from t = 0, at which the tilts are defined and offset and start velocity are 0.
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
        K_I in the columns of platform errors, g/g.

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
    The effect of a bias of 1 g is g t^2/2 for any rotation:

    >>> import math
    >>> import numpy as np
    >>> import counterspin as cs
    >>> site = cs.Site(gravity=9.8, latitude=math.radians(45.0))
    >>> trajectory = cs.Trajectory(cs.Spindle(math.pi), radius=2.5, site=site)
    >>> cs.columns(trajectory, cs.QX, ["K_F"], np.array([1.0, 10.0])).round(6).ravel().tolist()
    [4.9, 490.0]
    """
    if mounting.response is not None:
        static = replace(mounting, response=None)
        options: dict[str, Any] = {"attitude": attitude, "scale_factor": scale_factor}

        def static_columns(spindle: Spindle) -> Array:
            path = replace(trajectory, spindle=spindle)
            return columns(path, static, symbols, times, observable, **options)

        shifts = mounting.response.total_shifts(trajectory.spindle.rate)
        return shifts.apply(trajectory.spindle, static_columns)
    order = ORDERS[observable]
    effects = [term(symbol).effect for symbol in symbols]
    integrals = _TimeIntegrals(trajectory, mounting.turned(attitude), attitude, times, order)
    linear_vectors = {
        i: vector
        for i, effect in enumerate(effects)
        if (vector := integrals.linear_vector(effect)) is not None
    }
    bias_indices = [i for i, symbol in enumerate(symbols) if symbol == "K_F"]
    kinked_effects = {
        i: effect
        for i, effect in enumerate(effects)
        if isinstance(effect, SpecificForceProduct) and effect.has_kink
    }
    motion_errors = [i for i, effect in enumerate(effects) if isinstance(effect, TrajectoryError)]
    changing = trajectory.conditions.changing_conditions
    slopes = {
        i: effect
        for i, effect in enumerate(effects)
        if isinstance(effect, Slope) and effect.condition not in changing
    }
    evaluated_indices = {*linear_vectors, *bias_indices, *kinked_effects, *motion_errors, *slopes}
    smooth_effects = {
        i: effect
        for i, effect in enumerate(effects)
        if i not in evaluated_indices and isinstance(effect, IntegratedEffect)
    }
    if unobserved_indices := set(range(len(effects))) - evaluated_indices - set(smooth_effects):
        raise ValueError(
            f"no record observes {', '.join(symbols[i] for i in sorted(unobserved_indices))}"
        )
    result = np.empty((len(effects), times.size))
    result[bias_indices] = trajectory.site.gravity * times**order / max(1, order)
    if kinked_effects:
        result[list(kinked_effects)] = integrals.kinked(list(kinked_effects.values()))
    if smooth_effects:
        result[list(smooth_effects)] = integrals.smooth(list(smooth_effects.values()))
    for i, vector in linear_vectors.items():
        result[i] = vector @ integrals.force
    for i in motion_errors:
        result[i] = integrals.trajectory_error(symbols[i])
    product_columns = {symbol: result[i] for i, symbol in enumerate(symbols) if i not in slopes}
    missing_coefficients = {slope.coefficient for slope in slopes.values()} - product_columns.keys()
    if missing_coefficients:
        extra_columns = columns(
            trajectory, mounting, [*missing_coefficients], times, observable, attitude=attitude
        )
        product_columns |= dict(zip(missing_coefficients, extra_columns.T, strict=True))
    for i, slope in slopes.items():
        factor = slope.design_factor(trajectory.conditions, trajectory.centripetal)
        result[i] = factor * product_columns[slope.coefficient]
        if slope.condition == "time":  # it continues to change during the run
            result[i] += trajectory.site.gravity * times ** (order + 1) / math.factorial(order + 1)
    # Platform errors are multiplied by the scale factor.
    platform_indices = [
        i for i, effect in enumerate(effects) if isinstance(effect, AttitudeError | TrajectoryError)
    ]
    result[platform_indices] *= scale_factor
    return result.T


def block_average(function: Callable[[Array], Array], times: Array, time_sd: Array) -> Array:
    """Return a function of time averaged over blocks of samples.

    The mean of the values at the mean time plus and minus the standard deviation of the times is
    exact up to the third power of time. Over 1/64 revolution, the error is less than 1e-7 of the
    first harmonic.

    function: Maps times (m,) in s to values (m, ...).
    times, time_sd: Mean and standard deviation of the times of each block, s, shape (n,).
    Returns: shape (n, ...).
    """
    if not np.any(time_sd):
        return function(times)
    end_values = function(np.concatenate([times - time_sd, times + time_sd]))
    mean: Array = end_values[: times.size] + end_values[times.size :]
    mean *= 0.5
    return mean


class _Integrals:
    """Integrals along a trajectory, evaluated at any times."""

    def __init__(self, trajectory: Trajectory, panels: Panels) -> None:
        self._panels = panels
        self._motion = trajectory.at(panels.nodes)
        self._cache: dict[tuple[object, ...], Array] = {}

    def at(
        self,
        times: Array,
        effects: Sequence[IntegratedEffect],
        axes: Mounting,
        attitude: Array,
        order: int,
    ) -> Array:
        """Return the integrals of terms.

        All functions are integrated together, so the times are located in the panels only once.
        """
        return self._panels.at(times, self._evaluate(effects, axes, attitude, order))

    def _evaluate(
        self, effects: Sequence[IntegratedEffect], axes: Mounting, attitude: Array, order: int
    ) -> Array:
        if self._panels.nodes.size > _MAX_NODES:
            return self._panels.series(_integrands(effects, self._motion, axes, attitude), order)
        key = (axes.matrix.tobytes(), attitude.tobytes(), order)
        new_effects = [effect for effect in effects if (*key, effect) not in self._cache]
        series = self._panels.series(_integrands(new_effects, self._motion, axes, attitude), order)
        self._cache |= {
            (*key, effect): row for effect, row in zip(new_effects, series, strict=True)
        }
        if len(new_effects) == len(effects):
            return series
        return np.stack([self._cache[*key, effect] for effect in effects])


def _trajectory_integrals(
    trajectory: Trajectory, duration: float, kink_axis: tuple[float, ...] = ()
) -> _Integrals:
    """Return the cached integrals along a trajectory.

    Accelerometers of a run share the motion; a fit and its checks share the integrals.

    kink_axis: Axis; panels have an edge at each sign change of the specific force along it.
    """
    edges = quadrature.panel_edges(trajectory.spindle, duration, coarse=trajectory.coarse)
    is_cacheable = edges.size * quadrature.NODES <= _MAX_NODES
    make_integrals = _short_integrals if is_cacheable else _long_integrals
    return make_integrals(trajectory, duration, kink_axis)


def _make_integrals(
    trajectory: Trajectory, duration: float, kink_axis: tuple[float, ...]
) -> _Integrals:
    spindle, breaks, coarse = trajectory.spindle, trajectory.conditions.breaks, trajectory.coarse
    edges = quadrature.panel_edges(spindle, duration, breaks, coarse=coarse)
    if kink_axis:
        axis = np.array(kink_axis)
        changes = quadrature.sign_changes(lambda t: trajectory.specific_force(t) @ axis, edges)
        breaks = np.append(breaks, changes)
        edges = quadrature.panel_edges(spindle, duration, breaks, coarse=coarse)
    return _Integrals(trajectory, Panels(edges))


_short_integrals = lru_cache(maxsize=48)(_make_integrals)
_long_integrals = lru_cache(maxsize=8)(_make_integrals)


def table_angle_error(effect: AttitudeError, motion: Motion) -> Array:
    """Return the angle error of the table per unit of its term, shape (n,).

    The error is a harmonic of the angle of the table on the arm, opposite to the spindle's sense.
    """
    wave = np.sin if effect.quadrature == "sin" else np.cos
    return np.asarray(wave(-motion.trajectory.table_ratio * effect.harmonic * motion.angle))


def _integrands(
    effects: Sequence[IntegratedEffect], motion: Motion, axes: Mounting, attitude: Array
) -> Array:
    """Return the integrands of terms, m/s^2 per unit coefficient and K_I, shape (k, m)."""
    sensor_inputs = _SensorInputs(motion, axes, attitude)
    values = np.empty((len(effects), motion.t.size))
    for index, effect in enumerate(effects):
        values[index] = sensor_inputs.integrand(effect)
    return values


class _TimeIntegrals:
    """Integrals along a trajectory at given times."""

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
        return motion_at(self._trajectory, self._times)

    def trajectory_error(self, symbol: str) -> Array:
        """Return the contribution of an error of the trajectory, (n,)."""
        axis, motion = self._axes.input_axis, self.motion
        if term(symbol).effect.kind == "lever_arm":
            # It only acts if the table rotates in space, in records of specific force.
            return np.asarray(motion.table.lever_arm_force(axis) @ axis)
        return np.asarray(trajectory_sensitivity(symbol, motion, self._order) @ axis)

    def linear_vector(self, effect: Effect) -> Array | None:
        """Return the vector whose product with the specific force is the term; else None."""
        match effect:
            case SpecificForceProduct(is_linear=True, factors=(factor,), weight=weight):
                axis: Array = weight * self._axes.matrix["IPO".index(factor)]
                return axis
            case AttitudeError(kind="tilt", axis=i) if self._trajectory.table_ratio == -1.0:
                # (-psi x f) . I = f . (psi x I)
                return np.cross(np.eye(3)[i], self._axes.input_axis)
        return None

    @property
    def force(self) -> Array:
        """Specific force with the number of integrations of the observable, (3, n)."""
        prefix = ("", "velocity_of_", "displacement_of_")[self._order]
        force: Array = getattr(self.motion, f"{prefix}specific_force")
        return force.T

    def smooth(self, effects: Sequence[IntegratedEffect]) -> Array:
        """Return the integrals of terms, (k, n)."""
        if self._order == 0:
            return self._specific_force_columns(effects)
        integrals = _trajectory_integrals(self._trajectory, self._duration)
        return integrals.at(self._times, effects, self._axes, self._attitude, self._order)

    def kinked(self, effects: Sequence[IntegratedEffect]) -> Array:
        """Return the integrals of terms that have a kink where a_I changes sign, (k, n)."""
        if self._order == 0:
            return self._specific_force_columns(effects)
        axis = tuple(self._axes.input_axis.tolist())
        integrals = _trajectory_integrals(self._trajectory, self._duration, axis)
        return integrals.at(self._times, effects, self._axes, self._attitude, self._order)

    def _specific_force_columns(self, effects: Sequence[IntegratedEffect]) -> Array:
        """Return the contributions of terms to the specific force, m/s^2, (k, n)."""
        return _integrands(effects, self.motion, self._axes, self._attitude)


class _SensorInputs:
    """Inputs of accelerometer and gyros during a motion; each is computed once."""

    def __init__(self, motion: Motion, axes: Mounting, attitude: Array) -> None:
        self._motion = motion
        self._axes = axes
        # The axes of the gyros are rows of the attitude.
        self._attitude = attitude
        self._gravity = motion.trajectory.site.gravity

    def integrand(self, effect: IntegratedEffect) -> Array:
        """Return the integrand of a term, m/s^2 per unit coefficient and K_I, shape (m,)."""
        if isinstance(effect, SpecificForceProduct):
            return self._gravity * effect.evaluate(self._a_ipo, self._rotation)
        if isinstance(effect, Slope):
            path = self._motion.trajectory
            conditions = path.conditions.at(self._motion.t, path.centripetal)
            product = TERMS[effect.coefficient].effect
            return effect.design_factors(conditions) * self.integrand(product)
        if effect.kind in ("tilt", "table_axis"):
            lever_arms = np.cross(self._motion.table.tilt_axis(effect), self._axes.input_axis)
            return np.asarray(np.sum(lever_arms * self._motion.specific_force, axis=1))
        # The table rotates about up, other parts about the axes of the platform.
        sensitivity = (
            self._azimuth_sensitivity
            if effect.kind == "table"
            else self._tilt_sensitivity[effect.axis]
        )
        integrand: Array = self._attitude_error(effect) * sensitivity
        return integrand

    def _attitude_error(self, effect: AttitudeError) -> Array:
        """Return the attitude error per unit of a term that is not a tilt, rad, (m,)."""
        if effect.kind == "drift":
            return self._motion.t
        if effect.kind == "table":
            return table_angle_error(effect, self._motion)
        if effect.kind == "g2_sensitivity":
            return self._motion.square_of_specific_force / self._gravity**2
        assert effect.force_axis is not None
        force = self._velocity_change if effect.kind == "g_sensitivity" else self._platform_force
        error: Array = force[effect.force_axis]
        return error

    @cached_property
    def _a_ipo(self) -> Array:
        """Specific force along I, P, O in g, shape (3, m)."""
        return self._axes.matrix @ self._motion.specific_force.T / self._gravity

    @cached_property
    def _rotation(self) -> Array | None:
        """Rotation of the instrument, as in `TableMotion.instrument_rotation`."""
        return self._motion.table.instrument_rotation(self._axes)

    @cached_property
    def _tilt_sensitivity(self) -> Array:
        """Change of the sensed force per turn about each platform axis, m/s^2, (3, m)."""
        lever_arms = np.cross(self._attitude, self._axes.input_axis)
        return lever_arms @ self._motion.specific_force.T

    @cached_property
    def _azimuth_sensitivity(self) -> Array:
        """Change of the sensed force per turn about up, m/s^2, (m,)."""
        lever_arm = np.cross([0.0, 0.0, 1.0], self._axes.input_axis)
        return np.asarray(self._motion.specific_force @ lever_arm)

    @cached_property
    def _velocity_change(self) -> Array:
        """Integral of the specific force along the platform's axes in g s, (3, m)."""
        return self._attitude @ self._motion.velocity_of_specific_force.T / self._gravity

    @cached_property
    def _platform_force(self) -> Array:
        """Specific force along the platform's axes in g, (3, m)."""
        return self._attitude @ self._motion.specific_force.T / self._gravity
