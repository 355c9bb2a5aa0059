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
from functools import cached_property
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.identifiability import assess
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.least_squares import Solution
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.effects import SIGN_WIDTH, SpecificForceProduct
from counterspin.physics.terms import ACCELEROMETER_TERMS, SENSITIVITY_TERMS, TERMS, coefficient_of
from counterspin.readings.linear import MIN_RELATIVE_NOISE, LinearReadings
from counterspin.triads.determinability import default_candidates, undetermined_parameters

_SYMBOLS: Final = tuple(TERMS)

#: Rounds in which a pose's two angles settle; each leaves a residual's part of the last error.
_MAX_ITERATIONS: Final = 40

#: Settled: no direction moves by more, rad.
_CONVERGENCE_TOLERANCE: Final = 1e-14

#: Sensitivities that a start without a guess may find, of the nominal one.
_CREDIBLE_SENSITIVITIES: Final = (0.2, 5.0)

#: A quadric whose columns are worse conditioned says nothing of poses.
_MAX_CONDITION_NUMBER: Final = 1e4


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
    #: Conditions relative to the reference, as in `relative_conditions`, each of shape (n,).
    conditions: Mapping[str, Array]
    #: How many repeats each indication is the mean of, and the sum of all squares about their
    #: means, g^2, shape (n,). Where `u` is None.
    repeats: Array
    scatter: Array
    #: 1 where a value was written in m/s^2 and became g by the gravity assumed, else 0, (n, 3).
    in_si: Array
    noise_within_poses: float = 0.0  #: What is known of the noise from within the poses, g.
    resolution: float = 0.0  #: One of the last digit that was written, g.
    motion: str = "poses"

    @property
    def accelerometer(self) -> str:
        """All of them in one word."""
        return ", ".join(self.accelerometers)

    @property
    def time(self) -> Array:
        """Times from the beginning of the campaign, s, shape (n,)."""
        return self.conditions["time"]

    @property
    def size(self) -> int:
        """The number of poses."""
        return len(self.names)

    @property
    def noise_floor(self) -> float:
        """The least noise that they can be said to have, g; see `Readings.noise_floor`."""
        max_value = float(np.max(np.abs(self.value), initial=1e-3))
        return max(
            self.noise_within_poses,
            self.resolution / math.sqrt(12.0),
            MIN_RELATIVE_NOISE * max_value,
        )

    @property
    def replicates(self) -> tuple[tuple[int, ...], ...]:
        """Nobody knows whether two poses are one."""
        return ()

    @property
    def position(self) -> tuple[str, ...]:
        """Nobody has set them."""
        return ()

    @property
    def repeat_dof(self) -> float:
        """Degrees of freedom that repeats in one pose have among themselves, of all three."""
        return 3.0 * float(np.sum(self.repeats - 1.0))

    def linearize(
        self,
        model: Unknowns,
        estimate: Array,
        variance: Array | None = None,  # noqa: ARG002 -- nothing of a pose is of second order
    ) -> LinearReadings:
        """Return one row a pose at an estimate, the pose's angles eliminated."""
        point = self.at(model, estimate)
        columns = self._columns(point)
        offset = point.indicated - columns @ point.values
        for index, unknown in enumerate(point.unknowns):
            if unknown.symbol == "site.gravity":
                columns[:, :, index] += self.in_si * point.indicated / self.gravity
        projection = point.projection
        rows = np.einsum("nk,nkp->np", projection, columns)
        stated_u = None if self.u is None else np.sqrt(np.sum((projection * self.u) ** 2, axis=1))
        no_head_error = np.zeros(self.size)
        target = np.sum(projection * (self.value - offset), axis=1)
        return LinearReadings.from_columns(
            self, model, rows, target, stated_u, self.repeats, no_head_error
        )

    def _columns(self, point: SolvedPoses) -> Array:
        """Return the derivatives of the indications by everything, shape (n, 3, p)."""
        columns = np.zeros((self.size, 3, len(point.unknowns)))
        for index, axis_index, term, factor in design_factors(self, point.unknowns):
            columns[:, axis_index, index] = point.products[:, axis_index, term] * factor
        return columns

    def curvature(self, model: Unknowns, estimate: Array, steps: Array) -> Array:
        """Return the second-order change of each row as the unknowns move, shape (n, m).

        A move turns the force that the indications give. Its length, which is known, then changes
        by half the square of the turn.

        steps: Of the unknowns from the estimate, shape (p, m).
        """
        point = self.at(model, estimate)
        _, slopes = _indications_and_slopes(
            self.axes, point.direction, _active_terms(point.effective)
        )
        columns = self._columns(point)[:, :, : len(steps)]
        change = np.linalg.solve(slopes, columns @ steps)
        radial = np.einsum("nj,njm->nm", point.direction, change)
        tangential = change - point.direction[:, :, None] * radial[:, None, :]
        squared_rotation: Array = np.sum(tangential**2, axis=1)
        return 0.5 * point.gain[:, None] * squared_rotation

    def at(self, model: Unknowns, estimate: Array) -> SolvedPoses:
        """Return the poses under the coefficients of an estimate, their angles found.

        estimate: The unknowns less nominal; considered terms that it lacks are as assumed.
        """
        unknowns = (*model.unknowns, *model.considered)
        assumed_values = [parameter.prior_mean for parameter in unknowns[len(estimate) :]]
        values = np.append(estimate, assumed_values)
        # A fit and the tests of its residuals need the poses at the same values.
        key = tuple((unknown.owner, unknown.symbol) for unknown in unknowns), values.tobytes()
        if self._last_solved.get("key") != key:
            coefficients = np.tile([row.nominal for row in TERMS.values()], (self.size, 3, 1))
            for index, axis_index, term, factor in design_factors(self, unknowns):
                coefficients[:, axis_index, term] += values[index] * factor
            new_poses = SolvedPoses.solve_directions(self, unknowns, values, coefficients)
            self._last_solved.update(key=key, solved=new_poses)
        solved_poses: SolvedPoses = self._last_solved["solved"]
        return replace(solved_poses, unknowns=unknowns)

    @cached_property
    def _last_solved(self) -> dict[str, Any]:
        """The last values that `at` received, and the poses at them."""
        return {}

    def start(self, unknowns: Sequence[Unknown], point: Array) -> Array:
        """Return a place to begin at without a guess: of biases, sensitivities and angles."""
        bias, rows = _fit_ellipsoid(self.value, self.axes)
        initial_values = {"K_F": bias}
        for symbol, (axis, sign) in SENSITIVITY_TERMS.items():
            initial_values[symbol] = sign * np.sum(rows * self.axes[:, axis], axis=1)
        initial_point = point.copy()
        for index, unknown in enumerate(unknowns):
            if unknown.owner in self.accelerometers and unknown.symbol in initial_values:
                axis_index = self.accelerometers.index(unknown.owner)
                initial_point[index] = initial_values[unknown.symbol][axis_index] - unknown.nominal
        return initial_point

    @property
    def triad(self) -> tuple[str, ...]:
        """Names of the accelerometers."""
        return self.accelerometers

    def without_positioning_errors(self) -> TriadPoses:
        """Return the poses: no position was set."""
        return self

    def with_noise(self, noise: float) -> TriadPoses:
        """Return the poses with a stated noise of one repeat, g."""
        noise_sd = noise / np.sqrt(self.repeats)
        return replace(self, u=np.repeat(noise_sd[:, None], 3, axis=1))

    def with_rotated_mounting(
        self, name: str, rotate: Callable[[Mounting], Mounting]
    ) -> TriadPoses:
        """Return the poses with an accelerometer mounted otherwise."""
        if name not in self.accelerometers:
            return self
        axes, index = self.axes.copy(), self.accelerometers.index(name)
        axes[index] = rotate(Mounting(tuple(map(tuple, axes[index])))).matrix
        return replace(self, axes=axes)

    def default_candidates(self, model: Unknowns) -> Sequence[Unknown]:
        """Return the requested parameters that the directions may leave undetermined."""
        return default_candidates(model, self.accelerometers)

    def find_undetermined(
        self, fit: JointFit, model: Unknowns, candidates: Sequence[Unknown]
    ) -> Sequence[Unknown]:
        """Return the candidates that the directions do not determine, as in `Measured`."""
        return undetermined_parameters(fit, model, candidates)

    def insufficient_noise_message(
        self, dof: float, n_free: int, solution: Solution, model: Unknowns
    ) -> str:
        """Return the error that the residuals do not determine their noise; as in `Measured`."""
        if dof >= 0.5 and self.size + self.repeat_dof > n_free:
            return ""
        return _insufficient_poses_error(self, solution, model)

    def divergence_message(self, n_iterations: int) -> str:
        """Return the error that the fit did not converge in so many rounds."""
        return _divergence_error(self, n_iterations)


@frozen
class SolvedPoses:
    """Poses under given coefficients, each turned so that its three indications fit best."""

    unknowns: tuple[Unknown, ...]  #: What is estimated, then what is considered.
    values: Array  #: Of these, less nominal.
    effective: Array  #: The coefficients at each pose, shape (n, 3, number of `TERMS`).
    direction: Array  #: Of the specific force in the triad's frame, unit vectors, shape (n, 3).
    products: Array  #: Of every term, shape (n, 3, number of `TERMS`).
    indicated: Array  #: By the coefficients, g, shape (n, 3).
    #: The combination of the three indications that no turn changes, unit vectors, (n, 3).
    projection: Array
    gain: Array  #: What it grows by as the specific force grows, shape (n,).

    @classmethod
    def solve_directions(
        cls, poses: TriadPoses, unknowns: tuple[Unknown, ...], values: Array, effective: Array
    ) -> Self:
        """Return the poses with the directions that fit their indications best."""
        weight = np.ones((poses.size, 3)) if poses.u is None else 1.0 / poses.u
        direction, terms = _initial_directions(poses, effective), _active_terms(effective)
        for _ in range(_MAX_ITERATIONS):
            indications, slopes = _indications_and_slopes(poses.axes, direction, terms)
            residuals = weight * (poses.value - indications)
            basis = _tangent_basis(direction)
            tangent_slopes = weight[:, :, None] * (slopes @ basis)
            gram = np.swapaxes(tangent_slopes, 1, 2) @ tangent_slopes
            step = np.linalg.solve(gram, np.swapaxes(tangent_slopes, 1, 2) @ residuals[:, :, None])
            new_direction = direction + (basis @ step)[:, :, 0]
            direction = new_direction / np.linalg.norm(new_direction, axis=1)[:, None]
            if np.max(np.abs(step), initial=0.0) < _CONVERGENCE_TOLERANCE:
                break
        products = _term_products(poses.axes, direction)
        indications, slopes = _indications_and_slopes(poses.axes, direction, terms)
        tangent_slopes = slopes @ _tangent_basis(direction)
        projection = np.cross(tangent_slopes[:, :, 0], tangent_slopes[:, :, 1])
        projection /= np.linalg.norm(projection, axis=1)[:, None]
        gain = np.einsum("nk,nkj,nj->n", projection, slopes, direction)
        sign = np.where(gain < 0.0, -1.0, 1.0)
        return cls(
            unknowns,
            values,
            effective,
            direction,
            products,
            indications,
            projection * sign[:, None],
            gain * sign,
        )


def predict_indications(
    poses: TriadPoses, coefficients: Sequence[Mapping[str, float]], direction: Array
) -> Array:
    """Return the indications of a triad in poses of given directions, g, shape (n, 3).

    coefficients: Of each accelerometer, slopes included; those not named are nominal.
    direction: Of the specific force in the triad's frame: unit vectors at rest, in motion the force
        itself in g; shape (n, 3).
    """
    effective = np.tile([row.nominal for row in TERMS.values()], (poses.size, 3, 1))
    for index, values in enumerate(coefficients):
        for symbol, value in values.items():
            deviation = value - ACCELEROMETER_TERMS[symbol].nominal
            effective[:, index, _term_index(symbol)] += deviation * design_factor(poses, symbol)
    return _indications_and_slopes(poses.axes, direction, _active_terms(effective))[0]


def design_factor(poses: TriadPoses, symbol: str) -> Array:
    """Return the factor of a coefficient, or of its slope, shape (n,)."""
    return ACCELEROMETER_TERMS[symbol].effect.design_factors(poses.conditions)


def _term_index(symbol: str) -> int:
    """Return the place of a coefficient, or of the one that a slope changes."""
    return _SYMBOLS.index(coefficient_of(symbol))


def design_factors(
    poses: TriadPoses, unknowns: Sequence[Unknown]
) -> Iterator[tuple[int, int, int, Array]]:
    """Yield for each coefficient, or slope of one: its index, whose, of which term, times what."""
    for index, unknown in enumerate(unknowns):
        symbol = unknown.symbol
        if unknown.owner in poses.accelerometers and symbol in ACCELEROMETER_TERMS:
            axis_index = poses.accelerometers.index(unknown.owner)
            yield index, axis_index, _term_index(symbol), design_factor(poses, symbol)


def _term_products(axes: Array, direction: Array) -> Array:
    """Return every term's product at poses, shape (n, 3, number of `TERMS`)."""
    a_ipo = _force_along_axes(axes, direction)
    effects = (row.effect for row in TERMS.values())
    return np.stack([effect.evaluate(a_ipo, sign_width=SIGN_WIDTH) for effect in effects], axis=-1)


def _force_along_axes(axes: Array, direction: Array) -> Array:
    """Return the specific force along each axis of the accelerometers, shape (3, n, 3)."""
    components = direction @ axes.reshape(-1, 3).T
    return np.moveaxis(components.reshape(-1, *axes.shape[:2]), 2, 0)


_ActiveTerms = list[tuple[SpecificForceProduct, Array]]


def _active_terms(effective: Array) -> _ActiveTerms:
    """Return the products with coefficients that are not all zero, which have shape (n, 3)."""
    columns = zip(TERMS.values(), np.moveaxis(effective, 2, 0), strict=True)
    return [(row.effect, column.copy()) for row, column in columns if column.any()]


def _indications_and_slopes(
    axes: Array, direction: Array, terms: _ActiveTerms
) -> tuple[Array, Array]:
    """Return the indications at poses, g, and their slopes by the direction.

    Returns: shapes (n, 3) and (n, 3, 3).
    """
    a_ipo = _force_along_axes(axes, direction)
    indications, slopes_by_axis = np.zeros(a_ipo.shape[1:]), np.zeros((3, *a_ipo.shape[1:]))
    for effect, coefficient in terms:
        indications += coefficient * effect.evaluate(a_ipo, sign_width=SIGN_WIDTH)
        for axis, name in enumerate("IPO"):
            if not {name, f"|{name}|"}.isdisjoint(effect.factors):
                slopes_by_axis[axis] += coefficient * effect.slope(a_ipo, name)
    return indications, np.moveaxis(np.moveaxis(slopes_by_axis, (0, 2), (2, 0)) @ axes, 0, 1)


def _tangent_basis(direction: Array) -> Array:
    """Return two unit vectors at right angles to each direction and other, shape (n, 3, 2)."""
    reference = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    tangent = np.cross(direction, reference)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    return np.stack([tangent, np.cross(direction, tangent)], axis=2)


def _initial_directions(poses: TriadPoses, effective: Array) -> Array:
    """Return the directions that bias, sensitivity and misalignments alone give."""
    bias, rows = effective[:, :, _SYMBOLS.index("K_F")], np.zeros((poses.size, 3, 3))
    for symbol, (axis, sign) in SENSITIVITY_TERMS.items():
        coefficient = sign * effective[:, :, _SYMBOLS.index(symbol)]
        rows += coefficient[:, :, None] * poses.axes[:, axis]
    directions = np.asarray(
        np.linalg.solve(rows, (poses.value - bias)[:, :, None])[:, :, 0], np.float64
    )
    return np.asarray(directions / np.linalg.norm(directions, axis=1)[:, None], np.float64)


def _fit_ellipsoid(value: Array, axes: Array) -> tuple[Array, Array]:
    """Return biases and the vectors along which the three feel, as poses show them without a guess.

    First one sensitivity for all by the norm of the indications, then a sphere, then an ellipsoid,
    each where the poses determine it.

    Returns: g, shape (3,); in the triad's frame, g/g, shape (3, 3).
    """
    nominal_axes = axes[:, 0]
    nominal_force: Array = np.asarray(np.linalg.solve(nominal_axes, value.T).T, np.float64)
    rms_force = float(np.sqrt(np.mean(np.sum(nominal_force**2, axis=1))))
    bias, gram = np.zeros(3), rms_force**2 * np.eye(3)
    sphere_coefficients = _least_squares(
        2.0 * nominal_force, np.sum(nominal_force**2, axis=1), constant=True
    )
    if sphere_coefficients is not None:
        squared_sensitivity = sphere_coefficients[3] + float(
            sphere_coefficients[:3] @ sphere_coefficients[:3]
        )
        if (
            _all_credible(np.array([squared_sensitivity]))
            and np.linalg.norm(sphere_coefficients[:3]) < _CREDIBLE_SENSITIVITIES[1]
        ):
            bias, gram = sphere_coefficients[:3], squared_sensitivity * np.eye(3)
    x, y, z = (nominal_force - bias).T
    columns = np.column_stack(
        [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z]
    )
    quadric_coefficients = _least_squares(columns, np.ones(len(nominal_force)))
    if quadric_coefficients is not None:
        xx, yy, zz, xy, xz, yz = quadric_coefficients[:6]
        quadratic_form = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if np.linalg.eigvalsh(quadratic_form)[0] > 0.0:
            centre = -np.linalg.solve(quadratic_form, quadric_coefficients[6:])
            ellipsoid_gram = (1.0 + centre @ quadratic_form @ centre) * np.linalg.inv(
                quadratic_form
            )
            if _all_credible(np.linalg.eigvalsh(ellipsoid_gram)):
                bias, gram = bias + centre, np.asarray(ellipsoid_gram, np.float64)
    gram = nominal_axes @ gram @ nominal_axes.T
    frame = np.stack([nominal_axes[0], np.zeros(3), np.cross(nominal_axes[0], nominal_axes[1])])
    frame[2] /= np.linalg.norm(frame[2])
    frame[1] = np.cross(frame[2], frame[0])
    cholesky_factor = np.linalg.cholesky(np.asarray(gram, np.float64))
    cholesky_factor[:, 2] *= 1.0 if nominal_axes[2] @ frame[2] > 0.0 else -1.0
    return nominal_axes @ bias, cholesky_factor @ frame


def _all_credible(squared_sensitivities: npt.NDArray[np.float64]) -> bool:
    low, high = _CREDIBLE_SENSITIVITIES
    return bool(np.all((squared_sensitivities > low**2) & (squared_sensitivities < high**2)))


def _least_squares(columns: Array, target: Array, *, constant: bool = False) -> Array | None:
    """Return the solution; None where the rows do not determine it."""
    constants = np.ones((target.size, int(constant)))
    design: Array = np.hstack([columns, constants])
    norms = np.linalg.norm(design, axis=0)
    if design.shape[0] < design.shape[1] or not norms.all():
        return None
    if np.linalg.cond(design / norms) > _MAX_CONDITION_NUMBER:
        return None
    return np.asarray(np.linalg.lstsq(design, target, rcond=None)[0], np.float64)


def _insufficient_poses_error(poses: TriadPoses, solution: Solution, model: Unknowns) -> str:
    """Return that poses tell no noise, and what they do not determine besides."""
    free_names = [u.name for u in model.unknowns if math.isinf(u.prior[1])]
    requested_names = [unknown.name for unknown in model.unknowns if unknown.is_of_interest]
    determined = assess(solution, requested_names).determined
    undetermined_names = [name for name in requested_names if not determined[name]]
    undetermined_text = (
        f" The poses do not determine {', '.join(undetermined_names)} at all."
        if undetermined_names
        else ""
    )
    angles = [u for u in model.unknowns if u.is_of_interest and u.symbol.startswith("delta")]
    suggestion = (
        " The poses can determine biases and scale factors if only these coefficients are "
        'requested: terms = ["K_F", "K_I"] in [model].'
        if angles and poses.size > len(requested_names) - len(angles)
        else ""
    )
    return (
        f"{poses.accelerometer}: {poses.size} pose{'s' * (poses.size > 1)} at unknown attitudes "
        f"without a stated uncertainty cannot determine both {len(free_names)} unknowns without "
        f"a prior and the noise.{undetermined_text} Measure more poses, spread over all "
        f"directions, or state the uncertainty.{suggestion}"
    )


def _divergence_error(poses: TriadPoses, n_iterations: int) -> str:
    """Return why poses may leave a fit without an end: they lie too near each other."""
    unit_vectors = poses.value / np.linalg.norm(poses.value, axis=1)[:, None]
    mean_direction = unit_vectors.mean(axis=0)
    max_angle = math.degrees(
        math.acos(
            np.clip(np.min(unit_vectors @ mean_direction) / np.linalg.norm(mean_direction), -1, 1)
        )
    )
    return (
        f"{poses.accelerometer}: the fit of {poses.size} poses did not converge in "
        f"{n_iterations} iterations. The directions of the poses lie within {max_angle:.0f} deg of "
        "each other; measure poses in all directions, or state priors for the coefficients."
    )
