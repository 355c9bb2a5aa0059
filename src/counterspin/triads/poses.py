"""Poses of a triad at unknown attitudes as data of a fit.

At rest the specific force is g, and two angles per pose give its direction. A small rotation moves
the three indications within a plane, so eliminating the angles leaves one combination of them,
along the force: one row per pose, whatever the noise of each accelerometer. The angles themselves
are those that fit the three indications best.
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

#: Iterations for the two angles of a pose; each multiplies the error by about the residual.
_MAX_ITERATIONS: Final = 40

#: Largest deviation of the magnitude of the outputs of a correct triad from 1 g, g.
_MAX_MAGNITUDE_ERROR: Final = 0.4

#: The iteration has converged when no direction moves by more, rad.
_CONVERGENCE_TOLERANCE: Final = 1e-14

#: Range of credible sensitivities for the initial values, relative to the nominal one.
_CREDIBLE_SENSITIVITIES: Final = (0.2, 5.0)

#: Condition number above which the poses do not determine a sphere or an ellipsoid.
_MAX_CONDITION_NUMBER: Final = 1e4


@frozen
class TriadPoses:
    """Group of n poses of three accelerometers at rest, whose noise is stated or estimated."""

    accelerometers: tuple[str, ...]  #: The first two span the frame.
    names: tuple[str, ...]  #: Of the poses.
    #: Axes I, P, O of each accelerometer in the frame of the triad, as rows, shape (3, 3, 3).
    axes: Array
    gravity: float  #: Of the site, m/s^2.
    #: Indications in g at nominal sensitivity, and their standard uncertainties, shape (n, 3).
    #: None: one noise for all, estimated from the residuals.
    value: Array
    u: Array | None
    #: Conditions relative to the reference, as in `relative_conditions`, each of shape (n,).
    conditions: Mapping[str, Array]
    #: If `u` is None: number of repeats per indication, and the sum of squares about their means,
    #: g^2, shape (n,).
    repeats: Array
    scatter: Array
    #: 1 for values converted from m/s^2 with the assumed gravity, else 0, shape (n, 3).
    in_si: Array
    noise_within_poses: float = 0.0  #: Noise estimated within the poses, g.
    resolution: float = 0.0  #: One unit of the last written digit, g.
    motion: str = "poses"

    @property
    def accelerometer(self) -> str:
        """Names of the three accelerometers, joined."""
        return ", ".join(self.accelerometers)

    @property
    def time(self) -> Array:
        """Times since the start of the campaign, s, shape (n,)."""
        return self.conditions["time"]

    @property
    def size(self) -> int:
        """The number of poses."""
        return len(self.names)

    @property
    def noise_floor(self) -> float:
        """Smallest credible noise, g; see `Readings.noise_floor`."""
        max_value = float(np.max(np.abs(self.value), initial=1e-3))
        return max(
            self.noise_within_poses,
            self.resolution / math.sqrt(12.0),
            MIN_RELATIVE_NOISE * max_value,
        )

    @property
    def replicates(self) -> tuple[tuple[int, ...], ...]:
        """Empty: unknown attitudes cannot be compared."""
        return ()

    @property
    def position(self) -> tuple[str, ...]:
        """Empty: no position was set."""
        return ()

    @property
    def repeat_dof(self) -> float:
        """Degrees of freedom of the repeats within poses, for all three accelerometers."""
        return 3.0 * float(np.sum(self.repeats - 1.0))

    def linearize(
        self,
        model: Unknowns,
        estimate: Array,
        variance: Array | None = None,  # noqa: ARG002 -- no second-order term in a pose
    ) -> LinearReadings:
        """Return one row per pose at an estimate, with the angles of the pose eliminated."""
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
        """Return the derivatives of the indications by the unknowns, shape (n, 3, p)."""
        columns = np.zeros((self.size, 3, len(point.unknowns)))
        for index, axis_index, term, factor in design_factors(self, point.unknowns):
            columns[:, axis_index, index] = point.products[:, axis_index, term] * factor
        return columns

    def curvature(self, model: Unknowns, estimate: Array, steps: Array) -> Array:
        """Return the second-order change of each row as the unknowns move, shape (n, m).

        A step rotates the force that the indications give. The known length of the force then
        changes by half the square of the rotation.

        steps: Steps of the unknowns from the estimate, shape (p, m).
        """
        point = self.at(model, estimate)
        terms = _active_terms(point.effective)
        _, slopes = _indications_and_slopes(self.axes, point.direction, terms)
        columns = self._columns(point)[:, :, : len(steps)]
        change = np.linalg.solve(slopes, columns @ steps)
        radial = np.einsum("nj,njm->nm", point.direction, change)
        tangential = change - point.direction[:, :, None] * radial[:, None, :]
        squared_rotation: Array = np.sum(tangential**2, axis=1)
        return 0.5 * point.gain[:, None] * squared_rotation

    def at(self, model: Unknowns, estimate: Array) -> SolvedPoses:
        """Return the poses solved for their angles, given the coefficients of an estimate.

        estimate: Unknowns minus nominal; missing considered terms have their prior means.
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
        """Cache of `at`: the last values, and the poses solved at these values."""
        return {}

    def start(self, unknowns: Sequence[Unknown], point: Array) -> Array:
        """Return initial values of biases, sensitivities and misalignments from the poses."""
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
        """Return the poses with the mounting of one accelerometer rotated."""
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
        """Return an error message if the residuals do not determine the noise, as in `Measured`."""
        if dof >= 0.5 and self.size + self.repeat_dof > n_free:
            return ""
        return _insufficient_poses_error(self, solution, model)

    def divergence_message(self, n_iterations: int) -> str:
        """Return the error message of a fit that did not converge."""
        return _divergence_error(self, n_iterations)


@frozen
class SolvedPoses:
    """Poses at given coefficients, with the directions that fit their three indications best."""

    unknowns: tuple[Unknown, ...]  #: Estimated parameters, followed by considered ones.
    values: Array  #: Values of `unknowns` minus nominal.
    effective: Array  #: Coefficients at each pose, shape (n, 3, number of `TERMS`).
    direction: Array  #: Unit vectors of the specific force in the triad's frame, shape (n, 3).
    products: Array  #: Specific-force product of each term, shape (n, 3, number of `TERMS`).
    indicated: Array  #: Predicted indications, g, shape (n, 3).
    #: Unit vectors of the combination of indications that no rotation changes, shape (n, 3).
    projection: Array
    gain: Array  #: Derivative of this combination by the specific force, shape (n,).

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
    """Return the indications of a triad for given directions of the specific force, g, (n, 3).

    coefficients: Coefficients and slopes of each accelerometer by symbol; the others are nominal.
    direction: Specific force in the frame of the triad, shape (n, 3): unit vectors at rest, the
        force in g in motion.
    """
    effective = np.tile([row.nominal for row in TERMS.values()], (poses.size, 3, 1))
    for index, values in enumerate(coefficients):
        for symbol, value in values.items():
            deviation = value - ACCELEROMETER_TERMS[symbol].nominal
            effective[:, index, _term_index(symbol)] += deviation * design_factor(poses, symbol)
    return _indications_and_slopes(poses.axes, direction, _active_terms(effective))[0]


def design_factor(poses: TriadPoses, symbol: str) -> Array:
    """Return the factor of a coefficient or slope in each pose, shape (n,)."""
    return ACCELEROMETER_TERMS[symbol].effect.design_factors(poses.conditions)


def _term_index(symbol: str) -> int:
    """Return the index in `TERMS` of a coefficient, or of the coefficient that a slope changes."""
    return _SYMBOLS.index(coefficient_of(symbol))


def design_factors(
    poses: TriadPoses, unknowns: Sequence[Unknown]
) -> Iterator[tuple[int, int, int, Array]]:
    """Yield the index, accelerometer, term and factor of each unknown coefficient and slope."""
    for index, unknown in enumerate(unknowns):
        symbol = unknown.symbol
        if unknown.owner in poses.accelerometers and symbol in ACCELEROMETER_TERMS:
            axis_index = poses.accelerometers.index(unknown.owner)
            yield index, axis_index, _term_index(symbol), design_factor(poses, symbol)


def _term_products(axes: Array, direction: Array) -> Array:
    """Return the specific-force product of each term, shape (n, 3, number of `TERMS`)."""
    a_ipo = _force_along_axes(axes, direction)
    effects = (row.effect for row in TERMS.values())
    return np.stack([effect.evaluate(a_ipo, sign_width=SIGN_WIDTH) for effect in effects], axis=-1)


def _force_along_axes(axes: Array, direction: Array) -> Array:
    """Return the specific force along each axis of the accelerometers, shape (3, n, 3)."""
    components = direction @ axes.reshape(-1, 3).T
    return np.moveaxis(components.reshape(-1, *axes.shape[:2]), 2, 0)


_ActiveTerms = list[tuple[SpecificForceProduct, Array]]


def _active_terms(effective: Array) -> _ActiveTerms:
    """Return the products with nonzero coefficients, and these coefficients, shape (n, 3)."""
    columns = zip(TERMS.values(), np.moveaxis(effective, 2, 0), strict=True)
    return [(row.effect, column.copy()) for row, column in columns if column.any()]


def _indications_and_slopes(
    axes: Array, direction: Array, terms: _ActiveTerms
) -> tuple[Array, Array]:
    """Return the indications, g, (n, 3), and their derivatives by the direction, (n, 3, 3)."""
    a_ipo = _force_along_axes(axes, direction)
    indications, slopes_by_axis = np.zeros(a_ipo.shape[1:]), np.zeros((3, *a_ipo.shape[1:]))
    for effect, coefficient in terms:
        indications += coefficient * effect.evaluate(a_ipo, sign_width=SIGN_WIDTH)
        for axis, name in enumerate("IPO"):
            if not {name, f"|{name}|"}.isdisjoint(effect.factors):
                slopes_by_axis[axis] += coefficient * effect.slope(a_ipo, name)
    return indications, np.moveaxis(np.moveaxis(slopes_by_axis, (0, 2), (2, 0)) @ axes, 0, 1)


def _tangent_basis(direction: Array) -> Array:
    """Return two orthogonal unit vectors perpendicular to each direction, shape (n, 3, 2)."""
    reference = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    tangent = np.cross(direction, reference)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    return np.stack([tangent, np.cross(direction, tangent)], axis=2)


def _initial_directions(poses: TriadPoses, effective: Array) -> Array:
    """Return the directions from biases, sensitivities and misalignments alone."""
    bias, rows = effective[:, :, _SYMBOLS.index("K_F")], np.zeros((poses.size, 3, 3))
    for symbol, (axis, sign) in SENSITIVITY_TERMS.items():
        coefficient = sign * effective[:, :, _SYMBOLS.index(symbol)]
        rows += coefficient[:, :, None] * poses.axes[:, axis]
    forces = np.linalg.solve(rows, (poses.value - bias)[:, :, None])[:, :, 0]
    return np.asarray(forces / np.linalg.norm(forces, axis=1)[:, None], np.float64)


def _fit_ellipsoid(value: Array, axes: Array) -> tuple[Array, Array]:
    """Return initial biases and sensitivity vectors.

    The start is one sensitivity, the norm of the indications. A sphere and then an ellipsoid
    replace it if the poses determine them.

    Returns: biases in g, shape (3,); vectors in the frame of the triad in g/g, shape (3, 3).
    """
    nominal_axes = axes[:, 0]
    nominal_force: Array = np.asarray(np.linalg.solve(nominal_axes, value.T).T, np.float64)
    rms_force = float(np.sqrt(np.mean(np.sum(nominal_force**2, axis=1))))
    bias, gram = np.zeros(3), rms_force**2 * np.eye(3)
    sphere = _least_squares(2.0 * nominal_force, np.sum(nominal_force**2, axis=1), constant=True)
    if sphere is not None:
        centre = sphere[:3]
        squared_sensitivity = sphere[3] + float(centre @ centre)
        if (
            _all_credible(np.array([squared_sensitivity]))
            and np.linalg.norm(centre) < _CREDIBLE_SENSITIVITIES[1]
        ):
            bias, gram = centre, squared_sensitivity * np.eye(3)
    x, y, z = (nominal_force - bias).T
    products = [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z]
    quadric = _least_squares(np.column_stack(products), np.ones(len(nominal_force)))
    if quadric is not None:
        xx, yy, zz, xy, xz, yz = quadric[:6]
        quadratic = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if np.linalg.eigvalsh(quadratic)[0] > 0.0:
            centre = -np.linalg.solve(quadratic, quadric[6:])
            ellipsoid_gram = (1.0 + centre @ quadratic @ centre) * np.linalg.inv(quadratic)
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
    """Return the least-squares solution, or None if the rows do not determine it."""
    constants = np.ones((target.size, int(constant)))
    design: Array = np.hstack([columns, constants])
    norms = np.linalg.norm(design, axis=0)
    if design.shape[0] < design.shape[1] or not norms.all():
        return None
    if np.linalg.cond(design / norms) > _MAX_CONDITION_NUMBER:
        return None
    return np.asarray(np.linalg.lstsq(design, target, rcond=None)[0], np.float64)


def count_free(model: Unknowns) -> int:
    """Return the number of unknowns without a stated prior."""
    return sum(math.isinf(u.prior[1]) or u.uses_fallback_prior for u in model.unknowns)


def _insufficient_poses_error(poses: TriadPoses, solution: Solution, model: Unknowns) -> str:
    """Return the error message of poses that do not determine their noise."""
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
        f"without a stated uncertainty cannot determine both {count_free(model)} unknowns without "
        f"a prior and the noise.{undetermined_text} Measure more poses, spread over all "
        f"directions, or state the uncertainty.{suggestion}"
    )


def _divergence_error(poses: TriadPoses, n_iterations: int) -> str:
    """Return the error message of a fit that does not converge, as for nearly equal directions."""
    magnitudes = np.linalg.norm(poses.value, axis=1)
    lowest, highest = np.quantile(magnitudes, (0.1, 0.9)).tolist()
    mean_direction = (poses.value / magnitudes[:, None]).mean(axis=0)
    cosines = poses.value @ mean_direction / magnitudes / np.linalg.norm(mean_direction)
    max_angle = math.degrees(math.acos(np.clip(cosines.min(), -1.0, 1.0)))
    if lowest > 1.0 + _MAX_MAGNITUDE_ERROR or highest < 1.0 - _MAX_MAGNITUDE_ERROR:
        reason = (
            f"The outputs of most poses have a magnitude of {lowest:.2g} to {highest:.2g} g "
            "instead of 1 g; check the unit and the sensitivity."
        )
    elif highest - lowest > _MAX_MAGNITUDE_ERROR:
        reason = (
            f"The magnitude of the outputs varies from {lowest:.2g} to {highest:.2g} g, but at "
            "rest it is 1 g in all poses; check whether the three columns belong together, and "
            "their units."
        )
    else:
        reason = (
            f"The directions of the poses lie within {max_angle:.0f} deg of their mean; measure "
            "poses in all directions, or state priors for the coefficients."
        )
    return (
        f"{poses.accelerometer}: the fit of {poses.size} poses did not converge in "
        f"{n_iterations} iterations. {reason}"
    )
