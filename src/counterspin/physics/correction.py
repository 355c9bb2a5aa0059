"""Correction of accelerometers for their calibrated errors, and the uncertainty that remains.

The products with a_P and a_O require the specific force along the other two axes. It is known, or
sensed by other accelerometers on the same platform, whose errors are corrected iteratively too.

For a single accelerometer, the correction is the inverse of Eq. 7. On either side of a_I = 0, the
indication is a polynomial in a_I that increases up to its first turning point. Within this range,
an indication has exactly one specific force, which a bracketed Newton iteration finds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

import numpy as np

from counterspin.arrays import Array, semidefinite_root
from counterspin.errors import ConvergenceError, InputError
from counterspin.frozen import frozen
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.effects import Slope, SpecificForceProduct
from counterspin.physics.terms import CONDITION_TERMS, TERMS, coefficient_of

_EPSILON: Final = float(np.finfo(np.float64).eps)

#: Largest number of iterations; the bracket halves at least every other step.
_MAX_ITERATIONS: Final = 200

#: Specific force, g, beyond which a turning point is ignored.
_MAX_FORCE: Final = 1e9


class NotInvertibleError(ConvergenceError):
    """No specific force gives the indication of a sample."""

    code = "not-invertible"

    def __init__(self, row: int, reason: str) -> None:
        self.row, self.reason = row, reason
        super().__init__(f"sample {row} (counted from 0) {reason}")


def invert(
    coefficients: Mapping[str, Array | float],
    indications: Array,
    a_p: Array | float = 0.0,
    a_o: Array | float = 0.0,
) -> Array:
    """Return the specific force along the input axis, the inverse of Eq. 7.

    coefficients: Symbol -> coefficient in g-units, shape (n,) or a number; nominal by default.
    indications: Indicated specific force in g, shape (n,).
    a_p, a_o: Specific force along the pendulous and the output axis in g, (n,) or a number.
    Returns: a_I in g, shape (n,), to rounding; not finite if an input is not finite.
    """
    y, p, o = np.broadcast_arrays(np.asarray(indications, dtype=np.float64), a_p, a_o)
    is_finite = np.isfinite(y) & np.isfinite(p) & np.isfinite(o)
    force = np.full(y.shape, np.nan)
    rows = np.flatnonzero(is_finite)
    if rows.size:
        row_coefficients = {
            s: value[rows] if np.ndim(value) else value  # type: ignore[index]
            for s, value in coefficients.items()
        }
        force[rows] = _solve_rising_branch(row_coefficients, y[rows], p[rows], o[rows], rows)
    return force


def _solve_rising_branch(
    coefficients: Mapping[str, Array | float], y: Array, a_p: Array, a_o: Array, rows: np.ndarray
) -> Array:
    """Return the root of the indication minus y on the branch with a_I = 0."""
    # With K_0_asym, the indication jumps at zero; the middle of the jump separates the signs.
    products = _nonzero_products(coefficients)
    constants = {product: value for product, value in products.items() if product.power == 0}
    jump_top, jump_bottom = (
        _indication_polynomial(constants, np.full_like(y, sign), a_p, a_o)[0] for sign in (1, -1)
    )
    force_sign = np.where(y >= 0.5 * (jump_top + jump_bottom), 1.0, -1.0)
    # With this sign, a_I is the root of an increasing polynomial in |a_I| that is negative at zero.
    # An indication inside the jump corresponds to zero.
    polynomial = _indication_polynomial(products, force_sign, a_p, a_o)
    polynomial[0] -= y
    polynomial *= force_sign
    polynomial[0] = np.minimum(polynomial[0], 0.0)
    rows_without_rise = np.flatnonzero(~(polynomial[1] > 0.0))
    if rows_without_rise.size:
        row = int(rows_without_rise[0])
        raise NotInvertibleError(
            int(rows[row]),
            "cannot be corrected, because at zero specific force the indication does not "
            f"increase with the specific force (slope {polynomial[1, row]:.3g}); check the "
            "coefficients and their units.",
        )
    upper_bound = 2.0 * -polynomial[0] / polynomial[1]
    # The slope without its positive terms decreases: if it is positive at `high`, no turning point
    # is below.
    min_slope = polynomial[1] + upper_bound * _evaluate(
        np.minimum(_derivative(polynomial)[1:], 0.0), upper_bound
    )
    may_turn = ~((min_slope > 0.0) & (_evaluate(polynomial, upper_bound) >= 0.0))
    turning_point = np.full_like(upper_bound, np.inf)
    if may_turn.any():
        turning_point[may_turn] = _turning_point(polynomial[:, may_turn])
    upper_bound = np.minimum(turning_point, upper_bound)
    while True:
        is_low = (_evaluate(polynomial, upper_bound) < 0.0) & (upper_bound < turning_point)
        if not is_low.any():
            break
        upper_bound = np.where(is_low, np.minimum(2.0 * upper_bound, turning_point), upper_bound)
    unreachable_rows = np.flatnonzero(
        _evaluate(polynomial, upper_bound) < -_rounding_bound(polynomial, upper_bound, y)
    )
    if unreachable_rows.size:
        row = int(unreachable_rows[0])
        force = float(force_sign[row] * turning_point[row])
        max_value = _evaluate(polynomial[:, row : row + 1], turning_point[row : row + 1])
        max_indication = float(y[row] + force_sign[row] * max_value[0])
        raise NotInvertibleError(
            int(rows[row]),
            f"cannot be corrected, because the indication is {y[row]:.6g} g, but the model has "
            f"a turning point at {force:.6g} g, where the indication is {max_indication:.6g} g.",
        )
    return force_sign * _find_root(polynomial, upper_bound, y, rows)


def _nonzero_products(
    coefficients: Mapping[str, Array | float],
) -> dict[SpecificForceProduct, Array | float]:
    """Return the products with nonzero coefficients, and these coefficients."""
    all_products = {row.effect: coefficients.get(row.symbol, row.nominal) for row in TERMS.values()}
    return {product: value for product, value in all_products.items() if np.any(value)}


def _indication_polynomial(
    products: Mapping[SpecificForceProduct, Array | float],
    force_sign: Array,
    a_p: Array,
    a_o: Array,
) -> Array:
    """Return the coefficients of the indication in powers of |a_I|, lowest first, shape (m, n)."""
    unit_forces = np.stack([force_sign, a_p, a_o])
    polynomial = np.zeros((1 + max([3, *(product.power for product in products)]), force_sign.size))
    for product, value in products.items():
        # On either side of zero, a product is its value at +-1 times |a_I|^power.
        polynomial[product.power] += value * product.evaluate(unit_forces)
    return polynomial


def _turning_point(polynomial: Array) -> Array:
    """Return the first positive zero of the slope, which is positive at 0; infinite if none."""
    slope = _derivative(polynomial)
    if polynomial.shape[0] == 4:
        return _first_parabola_root(slope)
    turning_point: Array = _positive_roots(slope)[0]
    return turning_point


def _derivative(polynomial: Array) -> Array:
    slope: Array = polynomial[1:] * np.arange(1.0, polynomial.shape[0])[:, None]
    return slope


def _positive_roots(polynomial: Array) -> Array:
    """Return the zeros of a polynomial between 0 and `_MAX_FORCE`, ascending, shape (degree, n).

    Missing zeros are infinite. Between the zeros of its derivative, a polynomial is monotonic, and
    bisection finds its zero if the signs at the ends differ.
    """
    if polynomial.shape[0] == 2:
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            root = -polynomial[:1] / polynomial[1:]
        return np.where((root > 0.0) & (root <= _MAX_FORCE), root, np.inf)
    intervals = np.empty((polynomial.shape[0] + 1, polynomial.shape[1]))
    intervals[0], intervals[-1] = 0.0, _MAX_FORCE
    intervals[1:-1] = np.minimum(_positive_roots(_derivative(polynomial)), _MAX_FORCE)
    low, high = intervals[:-1], intervals[1:]
    coefficients = polynomial[:, None]
    low_is_positive, high_is_positive = (_evaluate(coefficients, end) > 0.0 for end in (low, high))
    has_root = low_is_positive != high_is_positive
    root = np.where(has_root, 0.5 * (low + high), np.inf)
    for _ in range(_MAX_ITERATIONS if has_root.any() else 0):
        root_is_positive = _evaluate(coefficients, np.where(has_root, root, 0.0)) > 0.0
        is_below_root = root_is_positive == low_is_positive
        low, high = np.where(is_below_root, root, low), np.where(is_below_root, high, root)
        midpoint = np.where(has_root, 0.5 * (low + high), np.inf)
        if np.all((midpoint == root) | ~has_root):
            break
        root = midpoint
    return np.sort(root, axis=0)


def _first_parabola_root(polynomial: Array) -> Array:
    """Return the first zero beyond zero of a + b x + c x^2, a > 0; infinite if there is none."""
    a, b, c = polynomial
    discriminant = b * b - 4.0 * a * c
    # This form of the root keeps its digits as c goes to zero.
    divisor = -b + np.sqrt(np.maximum(discriminant, 0.0))
    has_root = (discriminant >= 0.0) & (divisor > 0.0)
    root = np.full(a.shape, np.inf)
    with np.errstate(over="ignore"):
        root[has_root] = 2.0 * a[has_root] / divisor[has_root]
    return root


def _evaluate(polynomial: Array, x: Array) -> Array:
    value: Array = polynomial[-1]
    for row in polynomial[-2::-1]:
        value = value * x + row
    return value


def _evaluate_slope(polynomial: Array, x: Array) -> Array:
    return _evaluate(_derivative(polynomial), x)


def _rounding_bound(polynomial: Array, x: Array, y: Array) -> Array:
    """Return the bound of the rounding error of the polynomial minus y."""
    return 2.0 * _EPSILON * (_evaluate(np.abs(polynomial), x) + np.abs(y))


def _find_root(polynomial: Array, high: Array, y: Array, rows: np.ndarray) -> Array:
    low = np.zeros_like(high)
    x = np.minimum(-polynomial[0] / polynomial[1], high)
    for _ in range(_MAX_ITERATIONS):
        value, slope = _evaluate(polynomial, x), _evaluate_slope(polynomial, x)
        low, high = np.where(value < 0.0, x, low), np.where(value < 0.0, high, x)
        step = np.divide(-value, slope, out=np.full_like(x, np.inf), where=slope > 0.0)
        next_x = x + step
        next_x = np.where((next_x >= low) & (next_x <= high), next_x, 0.5 * (low + high))
        has_converged = (np.abs(value) <= _rounding_bound(polynomial, x, y)) | (
            np.abs(next_x - x) <= 2.0 * _EPSILON * x
        )
        x = next_x
        if has_converged.all():
            return x
    row = int(rows[int(np.flatnonzero(~has_converged)[0])])
    raise NotInvertibleError(row, f"did not converge in {_MAX_ITERATIONS} steps.")


# Accelerometers together -----------------------------------------------------------------------

#: Largest number of mutual corrections; a misalignment of 1e-2 requires eight.
_MAX_ROUNDS: Final = 100

#: Projections below this are rounding of the mountings (directions are unit vectors).
_PROJECTION_ROUNDING: Final = 1e-9


@frozen(eq=False)
class CalibratedAccelerometer:
    """A calibrated accelerometer."""

    name: str  #: Name in messages.
    mounting: Mounting  #: Axes on the platform.
    #: Symbol of a product, or of a slope with temperature -> value in g-units; exactly nominal by
    #: default.
    coefficients: Mapping[str, float]
    covariance: Array  #: Covariance of these coefficients in their order, shape (t, t).

    def symbols_using(self, axis: str) -> tuple[str, ...]:
        """Return the symbols whose value or variance requires the force along an axis, P or O."""
        return tuple(
            symbol
            for index, (symbol, value) in enumerate(self.coefficients.items())
            if axis in product_of_symbol(symbol).factors
            and (value or self.covariance[index, index])
        )

    @property
    def slopes(self) -> dict[str, Slope]:
        """Symbol -> slope of a coefficient with a condition."""
        return {s: CONDITION_TERMS[s].effect for s in self.coefficients if s in CONDITION_TERMS}

    def at(self, temperature_offset: Array | float) -> dict[str, Array | float]:
        """Return the coefficients of products at a temperature, as in `TemperatureOffset`."""
        slopes = self.slopes
        values: dict[str, Array | float] = {
            s: value for s, value in self.coefficients.items() if s not in slopes
        }
        for symbol, slope in slopes.items():
            reference_value = values.get(slope.coefficient, TERMS[slope.coefficient].nominal)
            values[slope.coefficient] = reference_value + self.coefficients[
                symbol
            ] * _design_factor(slope, temperature_offset)
        return values


def product_of_symbol(symbol: str) -> SpecificForceProduct:
    """Return the product of a term, or of the coefficient that a slope changes."""
    return TERMS[coefficient_of(symbol)].effect


def _design_factor(slope: Slope, temperature_offset: Array | float) -> Array:
    """Return the factor of a slope with temperature."""
    return slope.design_factors({"temperature": np.asarray(temperature_offset, dtype=np.float64)})


@frozen(eq=False)
class KnownForce:
    """A direction along which the specific force is known without an accelerometer."""

    direction: Array  #: Unit vector in the frame of the mountings, shape (3,).
    force: Array | float  #: Specific force in this direction, g, shape (n,) or a number.
    u: float = 0.0  #: Standard uncertainty of the force, g, common to all samples.


@frozen(eq=False)
class TemperatureOffset:
    """Temperature minus the temperature of the stated coefficients, K."""

    value: Array | float = 0.0  #: Shape (n,) or a number.
    u: float = 0.0  #: Standard uncertainty, common to all samples.

    @property
    def nodes(self) -> list[tuple[float, Array | float]]:
        """Weights and temperatures for means over a normal temperature.

        Three nodes, exact for polynomials up to the fifth degree.
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
    """Specific forces that the accelerometers' indications represent."""

    force: Array  #: Specific force along each input axis in g, shape (n, m).
    #: Standard uncertainty due to coefficients and known forces, without the noise of the
    #: indications, shape (n, m).
    u: Array


_AS_CALIBRATED: Final = TemperatureOffset()


def missing_axes(
    instruments: Sequence[CalibratedAccelerometer], known_forces: Sequence[KnownForce]
) -> list[tuple[CalibratedAccelerometer, str, tuple[str, ...]]]:
    """Return (instrument, ``P`` or ``O``, symbols that need it) where the force is not known."""
    _, is_determined = _projections(instruments, known_forces)
    return [
        (instrument, axis, instrument.symbols_using(axis))
        for k, instrument in enumerate(instruments)
        for a, axis in enumerate("PO")
        if instrument.symbols_using(axis) and not is_determined[k, a]
    ]


def correct(
    instruments: Sequence[CalibratedAccelerometer],
    indications: Array,
    known_forces: Sequence[KnownForce] = (),
    cross_covariances: Mapping[tuple[int, int], Array] = MappingProxyType({}),
    temperature_offset: TemperatureOffset = _AS_CALIBRATED,
) -> CorrectedForces:
    """Correct the indications of accelerometers that stand on one platform.

    Each accelerometer's a_P and a_O are the projections of the vector that the corrected forces
    along all input axes, and the known ones, determine. The uncertainty is first order: with M
    the Jacobian of all indications with respect to all a_I, the errors of the coefficients K_k of
    accelerometer k move a_I by -M^-1 J_k dK_k, J_k being the products. For one accelerometer this
    is u(a_I) = sqrt(J C J^T) / |d a_ind/d a_I|.

    instruments: The accelerometers, m of them, each with an input axis of its own.
    indications: Indicated specific force in g, shape (n, m); where it is not finite, the result of
        the sample is not finite.
    cross_covariances: Indices of two accelerometers, the lower first -> covariance of their
        coefficients, of the first along the rows; accelerometers without an entry are uncorrelated.
    temperature_offset: For slopes with temperature. Its u moves the force by the slopes, and their
        own uncertainty counts at every temperature that it may have been.
    """
    unknown_axes = missing_axes(instruments, known_forces)
    if unknown_axes:
        instrument, axis, symbols = unknown_axes[0]
        raise ValueError(
            f"{instrument.name}: {', '.join(symbols)} require a_{axis}, which is not known"
        )
    weights, _ = _projections(instruments, known_forces)
    n, m = indications.shape
    known_values = np.empty((n, len(known_forces)))
    for index, known_force in enumerate(known_forces):
        known_values[:, index] = known_force.force
    offset = temperature_offset.value
    force = _correct_jointly(instruments, indications, known_values, weights, offset)
    a_ipo = _forces_along_axes(force, known_values, weights)

    jacobian = np.empty((n, m, m))
    known_sensitivity = np.zeros((n, m, len(known_forces) + 1))
    variance = np.zeros((n, m, m))
    for k, instrument in enumerate(instruments):
        coefficients = instrument.at(offset)
        p, o = (_total_slope(coefficients, a_ipo[k], axis)[:, None] for axis in "PO")
        jacobian[:, k] = p * weights[k, 0, :m] + o * weights[k, 1, :m]
        jacobian[:, k, k] += _total_slope(coefficients, a_ipo[k], "I")
        known_sensitivity[:, k, :-1] = p * weights[k, 0, m:] + o * weights[k, 1, m:]
        known_sensitivity[:, k, -1] = _temperature_sensitivity(instrument, a_ipo[k], offset)
        variance[:, k, k] = _variance(instrument, a_ipo[k], temperature_offset)
    for (k, column), covariance in cross_covariances.items():
        for weight, value in temperature_offset.nodes:
            row_products, column_products = (
                _coefficient_sensitivities(instruments[index], a_ipo[index], value)
                for index in (k, column)
            )
            variance[:, k, column] += weight * np.sum(
                (row_products @ covariance) * column_products, axis=1
            )
        variance[:, column, k] = variance[:, k, column]
    inverse = np.full_like(jacobian, np.nan)
    is_finite = np.isfinite(jacobian).all(axis=(1, 2))
    inverse[is_finite] = np.linalg.inv(jacobian[is_finite])
    force_variance = np.sum((inverse @ variance) * inverse, axis=2)
    sds = inverse @ known_sensitivity * [*(known.u for known in known_forces), temperature_offset.u]
    force_variance += np.sum(sds**2, axis=2)
    # Rounding may give negative variances if the errors of two accelerometers cancel.
    return CorrectedForces(force, np.sqrt(np.maximum(force_variance, 0.0)))


@frozen(eq=False)
class Prediction:
    """Predicted indications of an accelerometer at specific forces."""

    indicated: Array  #: In g, shape (n,).
    #: Standard uncertainty due to the coefficients, including default priors, without the noise of
    #: an indication, g, shape (n,).
    u: Array
    unit: str = "g"  #: Unit of both.

    def __repr__(self) -> str:
        """Return the number of indications and their extremes."""
        n = self.indicated.size
        low, high = float(self.indicated.min()), float(self.indicated.max())
        max_u = float(self.u.max())
        return f"<{n} indications from {low:.6g} to {high:.6g} g, u at most {max_u:.2g} g>"


def indication(instrument: CalibratedAccelerometer, a_ipo: Array) -> tuple[Array, Array]:
    """Return the indication (Eq. 7) and its u due to the coefficients, both in g.

    The temperature is that of the stated coefficients.

    a_ipo: Specific force along the axes I, P, O in g, shape (3, n).
    """
    output = np.zeros(a_ipo.shape[1])
    for row in TERMS.values():
        value = instrument.coefficients.get(row.symbol, row.nominal)
        if value != 0.0:
            output += value * row.effect.evaluate(a_ipo)
    return output, np.sqrt(_variance(instrument, a_ipo, _AS_CALIBRATED))


def _projections(
    instruments: Sequence[CalibratedAccelerometer], known_forces: Sequence[KnownForce]
) -> tuple[Array, np.ndarray]:
    """Return the weights of forces along the known directions that give a_P and a_O.

    Returns: weights, shape (m, 2, m + len(known_forces)), and whether they determine a_P and a_O,
        shape (m, 2).
    """
    rows = [instrument.mounting.input_axis for instrument in instruments]
    directions = np.stack([*rows, *(known_force.direction for known_force in known_forces)])
    if np.linalg.matrix_rank(directions, tol=_PROJECTION_ROUNDING) < directions.shape[0]:
        raise InputError(
            f"the specific force along a direction is overdetermined: {len(rows)} "
            f"accelerometers ({', '.join(i.name for i in instruments)}) and {len(known_forces)} "
            "known specific forces have linearly dependent directions",
            "conflicting-values",
        )
    targets = np.stack([instrument.mounting.matrix[1:] for instrument in instruments])
    weights = targets @ np.linalg.pinv(directions)
    is_determined = np.linalg.norm(weights @ directions - targets, axis=2) < _PROJECTION_ROUNDING
    weights[~is_determined] = 0.0
    return np.where(np.abs(weights) < _PROJECTION_ROUNDING, 0.0, weights), is_determined


def _forces_along_axes(force: Array, known_values: Array, weights: Array) -> Array:
    """Return the forces along I, P, O of each accelerometer, shape (m, 3, n)."""
    all_known = np.concatenate([force, known_values], axis=1).T
    return np.concatenate([force.T[:, None], weights @ all_known], axis=1)


def _correct_jointly(
    instruments: Sequence[CalibratedAccelerometer],
    indications: Array,
    known_values: Array,
    weights: Array,
    temperature_offset: Array | float,
) -> Array:
    """Return the forces from iterative corrections of each accelerometer with the others."""
    force = np.array(indications, dtype=np.float64)
    # A sample that is missing for one accelerometer is missing for all.
    is_finite = np.isfinite(np.concatenate([force, known_values], axis=1)).all(axis=1)
    force[~(is_finite & np.isfinite(temperature_offset))] = np.nan
    m = len(instruments)
    is_coupled = bool(np.any(weights[:, :, :m]))
    scale = 32.0 * _EPSILON * (1.0 + np.max(np.abs(force), axis=1, keepdims=True))
    coefficients = [instrument.at(temperature_offset) for instrument in instruments]
    for _ in range(_MAX_ROUNDS if is_coupled else 1):
        a_ipo = _forces_along_axes(force, known_values, weights)
        new_force = np.empty_like(force)
        for k, (instrument, (_, p, o)) in enumerate(zip(instruments, a_ipo, strict=True)):
            target_indications = np.where(np.isnan(force[:, k]), np.nan, indications[:, k])
            try:
                new_force[:, k] = invert(coefficients[k], target_indications, p, o)
            except NotInvertibleError as error:
                raise NotInvertibleError(
                    error.row, f"of {instrument.name} {error.reason}"
                ) from error
        is_moving = np.abs(new_force - force) > scale
        force = new_force
        if not is_coupled or not is_moving.any():
            return force
    moving_row = int(np.flatnonzero(is_moving.any(axis=1))[0])
    raise NotInvertibleError(
        moving_row,
        "cannot be corrected: the mutual corrections of the accelerometers did not converge in "
        f"{_MAX_ROUNDS} rounds; check the coefficients and their units.",
    )


def _total_slope(coefficients: Mapping[str, Array | float], a_ipo: Array, axis: str) -> Array:
    slope = np.zeros(a_ipo.shape[1])
    for row in TERMS.values():
        value = coefficients.get(row.symbol, row.nominal)
        if np.any(value):
            slope += value * row.effect.slope(a_ipo, axis)
    return slope


def _temperature_sensitivity(
    instrument: CalibratedAccelerometer, a_ipo: Array, temperature_offset: Array | float
) -> Array:
    """Return the change of the indication with temperature, g/K, shape (n,)."""
    sensitivity = np.zeros(a_ipo.shape[1])
    for symbol, slope in instrument.slopes.items():
        if slope.condition == "temperature":
            derivative = slope.power * np.asarray(temperature_offset) ** (slope.power - 1)
            value = instrument.coefficients[symbol]
            sensitivity += value * derivative * product_of_symbol(symbol).evaluate(a_ipo)
    return sensitivity


def _coefficient_sensitivities(
    instrument: CalibratedAccelerometer, a_ipo: Array, temperature_offset: Array | float
) -> Array:
    """Return the change of the indication per unit of each coefficient, shape (n, t)."""
    slopes = instrument.slopes
    columns = [product_of_symbol(symbol).evaluate(a_ipo) for symbol in instrument.coefficients]
    for index, symbol in enumerate(instrument.coefficients):
        if symbol in slopes:
            columns[index] = columns[index] * _design_factor(slopes[symbol], temperature_offset)
    return np.stack(columns, axis=1)


def _variance(
    instrument: CalibratedAccelerometer, a_ipo: Array, temperature_offset: TemperatureOffset
) -> Array:
    sqrt_covariance = semidefinite_root(instrument.covariance)
    variance = np.zeros(a_ipo.shape[1])
    for weight, value in temperature_offset.nodes:
        # A sum of squares is never negative.
        variance += weight * np.sum(
            (_coefficient_sensitivities(instrument, a_ipo, value) @ sqrt_covariance) ** 2, axis=1
        )
    return variance
