"""The accelerometer that a result describes: its coefficients and its indication."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array, semidefinite_root
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient
from counterspin.errors import CampaignError
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.correction import (
    CalibratedAccelerometer,
    Prediction,
    indication,
    product_of_symbol,
)
from counterspin.physics.terms import TERMS, condition_of

if TYPE_CHECKING:
    from counterspin.calibration.result import Result

#: Mounting of a single accelerometer, for which the orientation does not matter.
_DEFAULT_MOUNTING: Final = Mounting.from_axes("east", "north")

#: Bias at rising minus falling temperature, of unknown sign when a result is applied.
HYSTERESIS_SYMBOL: Final = "K_F.hysteresis"

#: Relative tolerance of variances in the test of a covariance, for rounding errors.
_VARIANCE_TOLERANCE: Final = 1e-6


def add_unstated_terms(
    result: Result, available_factors: Collection[str]
) -> tuple[Result, dict[str, tuple[str, ...]]]:
    r"""Return a result with its unstated terms as known terms, and the omitted symbols by name.

    An unstated term has its default prior. A product is omitted if one of its factors is not
    available.

    available_factors: Known factors of products (I, \|I\|, sign_I, P and O) and of slopes
        (``temperature``).
    """
    accelerometers, omitted_symbols = dict(result.accelerometers), dict[str, tuple[str, ...]]()
    for row in result.rests_on:
        name, _, symbol = row.name.partition(".")
        if row.kind != "unstated" or name not in accelerometers:
            continue
        if not (is_applicable(symbol) or symbol == HYSTERESIS_SYMBOL):
            continue
        needed_factors = {*product_of_symbol(symbol).factors}
        needed_factors |= {"temperature"} & {condition_of(symbol)}
        if needed_factors <= set(available_factors):
            accelerometer = accelerometers[name]
            coefficient = Coefficient(value=row.value, u=row.u, unit=row.unit, estimated=False)
            accelerometers[name] = accelerometer.model_copy(
                update={"known": {**accelerometer.known, symbol: coefficient}}
            )
        else:
            omitted_symbols[name] = (*omitted_symbols.get(name, ()), symbol)
    return result.model_copy(update={"accelerometers": accelerometers}), omitted_symbols


def predict(
    result: Result,
    accelerometer: str,
    force: npt.ArrayLike,
    pendulous: npt.ArrayLike,
    output_axis: npt.ArrayLike,
) -> Prediction:
    """Return the indications of an accelerometer of a result; see `Result.predict`."""
    components = (np.atleast_1d(np.asarray(f, float)) for f in (force, pendulous, output_axis))
    forces = np.stack(np.broadcast_arrays(*components))
    if forces.ndim != 2 or not forces.size or not np.isfinite(forces).all():
        raise ValueError("specific forces must be finite numbers, or arrays of equal length")
    full_result, _ = add_unstated_terms(result, ("I", "|I|", "sign_I", "P", "O"))
    return Prediction(*indication(make_instrument(full_result, accelerometer), forces))


def make_instrument(
    result: Result, name: str, *, needs_mounting: bool = False
) -> CalibratedAccelerometer:
    """Return a calibrated accelerometer with the covariance of its coefficients.

    Known terms are included. Their correlations with the estimates follow from the sensitivities of
    the budget; without a budget, they count as uncorrelated.

    result: Result of a calibration.
    name: Name of the accelerometer in the result.
    needs_mounting: Whether the orientation on the platform is required; otherwise, the axes of the
        accelerometer are the frame.
    """
    if name not in result.accelerometers:
        names = ", ".join(result.accelerometers)
        raise CampaignError(
            "apply",
            [f"the result has no accelerometer {name!r}; it has {names}"],
            code="unknown-accelerometer",
        )
    accelerometer = result.accelerometers[name]
    if needs_mounting and accelerometer.axes is None:
        raise CampaignError(
            "apply",
            [
                "the result was written by an earlier version and does not state the axes of "
                f"{name}. Calibrate again, or give the force along the axes"
            ],
            code="missing-in-result",
        )
    mounting = (
        Mounting(tuple(accelerometer.axes))
        if needs_mounting and accelerometer.axes
        else _DEFAULT_MOUNTING
    )
    terms = determined_terms(accelerometer)
    values = {
        symbol: float(coefficient.value)
        for symbol, coefficient in terms.items()
        if coefficient.value is not None
    }
    if not values:
        raise CampaignError(
            "apply",
            [f"the result has no value for any coefficient of {name}"],
            code="not-determined",
        )
    covariance = term_covariance(accelerometer, terms)
    hysteresis = {**accelerometer.known, **accelerometer.coefficients}.get(HYSTERESIS_SYMBOL)
    if hysteresis is not None and "K_F" in values:
        # The bias differs by half of the hysteresis, with an unknown sign.
        i = list(values).index("K_F")
        covariance[i, i] += ((hysteresis.value or 0.0) ** 2 + (hysteresis.u or 0.0) ** 2) / 4.0
    if not is_valid_covariance(covariance):
        # For any correlation, (sum of n errors)^2 is at most n times the sum of squares.
        covariance = len(terms) * np.diag(np.diag(covariance))
    return CalibratedAccelerometer(name, mounting, values, covariance)


def applicable_terms(accelerometer: AccelerometerResult) -> dict[str, Coefficient]:
    """Return the coefficients of an accelerometer that a correction can apply."""
    terms = {**accelerometer.known, **accelerometer.coefficients}
    return {symbol: coefficient for symbol, coefficient in terms.items() if is_applicable(symbol)}


def is_applicable(symbol: str) -> bool:
    """Return whether a correction can apply a term: a product, or a temperature slope of one."""
    return symbol in TERMS or condition_of(symbol) == "temperature"


def determined_terms(accelerometer: AccelerometerResult) -> dict[str, Coefficient]:
    """Return the applicable terms that have a value."""
    return {
        symbol: coefficient
        for symbol, coefficient in applicable_terms(accelerometer).items()
        if coefficient.value is not None
    }


def term_covariance(accelerometer: AccelerometerResult, terms: Mapping[str, Coefficient]) -> Array:
    """Return the covariance of terms from correlations and budgets of a result, shape (t, t)."""
    symbols = list(terms)
    u = np.array([coefficient.u or 0.0 for coefficient in terms.values()])
    covariance = np.diag(u**2)
    correlation = accelerometer.correlation
    correlated_terms = correlation.terms if correlation else []
    estimated_symbols = [symbol for symbol in symbols if terms[symbol].estimated]
    for symbol, correlations in accelerometer.prior_correlations.items():
        for other_term, r in correlations.items():
            if {symbol, other_term} <= terms.keys() - {*estimated_symbols}:
                i, j = symbols.index(symbol), symbols.index(other_term)
                covariance[i, j] += r * u[i] * u[j]
    for symbol in estimated_symbols:
        i = symbols.index(symbol)
        for other_symbol in estimated_symbols:
            if (
                correlation
                and symbol != other_symbol
                and {symbol, other_symbol} <= {*correlated_terms}
            ):
                j = symbols.index(other_symbol)
                r = correlation.matrix[correlated_terms.index(symbol)][
                    correlated_terms.index(other_symbol)
                ]
                covariance[i, j] = r * u[i] * u[j]
        for line in accelerometer.budget.get(symbol, []):
            # Covariance of an estimate and a prior: sensitivity x u^2.
            source = line.source
            if source in terms and source not in estimated_symbols and line.sensitivity is not None:
                j = symbols.index(source)
                covariance[i, j] = covariance[j, i] = line.sensitivity * u[j] ** 2
    return covariance


def is_valid_covariance(matrix: Array) -> bool:
    """Return whether a matrix is positive semidefinite within rounding errors."""
    root = semidefinite_root(matrix)
    return bool(np.all(np.sum(root**2, axis=1) <= np.diag(matrix) * (1.0 + _VARIANCE_TOLERANCE)))
