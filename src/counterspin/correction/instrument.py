"""The accelerometer that a result describes: its coefficients, and what it will indicate."""

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

#: Axes of an accelerometer on its own, whose place on the platform then does not matter.
_ALONE: Final = Mounting.from_axes("east", "north")

#: Bias up in temperature less down, of which nobody who applies a result knows the sign.
HYSTERESIS: Final = "K_F.hysteresis"

#: Relative growth of a variance by which a covariance may miss being one: rounding.
_ROUNDING: Final = 1e-6


def with_unstated(
    result: Result, given: Collection[str]
) -> tuple[Result, dict[str, tuple[str, ...]]]:
    r"""Return a result that knows its unstated terms, and of each accelerometer which it cannot.

    What nothing states is taken as it was for the result: ideal, with its typical size. A product
    with the force along another axis counts where that is given.

    given: Factors of products that are known, of I, \|I\|, sign_I, P and O; and ``temperature``,
        of slopes.
    """
    accelerometers, lost = dict(result.accelerometers), dict[str, tuple[str, ...]]()
    for row in result.rests_on:
        name, _, symbol = row.name.partition(".")
        if row.kind != "unstated" or name not in accelerometers:
            continue
        if not (acts(symbol) or symbol == HYSTERESIS):
            continue
        needed = {*product_of_symbol(symbol).factors}
        needed |= {"temperature"} & {condition_of(symbol)}
        if needed <= set(given):
            own = accelerometers[name]
            c = Coefficient(value=row.value, u=row.u, unit=row.unit, estimated=False)
            accelerometers[name] = own.model_copy(update={"known": {**own.known, symbol: c}})
        else:
            lost[name] = (*lost.get(name, ()), symbol)
    return result.model_copy(update={"accelerometers": accelerometers}), lost


def predict(
    result: Result,
    accelerometer: str,
    force: npt.ArrayLike,
    pendulous: npt.ArrayLike,
    output_axis: npt.ArrayLike,
) -> Prediction:
    """Return the indications of an accelerometer of a result; see `Result.predict`."""
    given = (np.atleast_1d(np.asarray(part, float)) for part in (force, pendulous, output_axis))
    axes = np.stack(np.broadcast_arrays(*given))
    if axes.ndim != 2 or not axes.size or not np.isfinite(axes).all():
        raise ValueError("specific forces must be finite numbers, or arrays of equal length")
    whole, _ = with_unstated(result, ("I", "|I|", "sign_I", "P", "O"))
    return Prediction(*indication(instrument_of(whole, accelerometer), axes))


def instrument_of(result: Result, name: str, *, placed: bool = False) -> CalibratedAccelerometer:
    """Return a calibrated accelerometer with the covariance of its coefficients.

    What is not estimated but known beforehand is applied too. Where the result holds a budget,
    its sensitivities say how such a prior has moved the estimates, so that errors which cancel
    are seen to cancel; else it is taken as uncorrelated.

    result: A calibration's result.
    name: The accelerometer's name there.
    placed: Whether its place on the platform is needed; else its axes are taken as the frame.
    """
    if name not in result.accelerometers:
        there = ", ".join(result.accelerometers)
        raise CampaignError(
            "apply",
            [f"the result has no accelerometer {name!r}; it has {there}"],
            code="unknown-accelerometer",
        )
    accelerometer = result.accelerometers[name]
    if placed and accelerometer.axes is None:
        raise CampaignError(
            "apply",
            [
                "the result was written by an earlier version and does not state the axes of "
                f"{name}. Calibrate again, or give the force along the axes"
            ],
            code="missing-in-result",
        )
    mounting = Mounting(tuple(accelerometer.axes)) if placed and accelerometer.axes else _ALONE
    terms = determined_terms(accelerometer)
    values = {s: float(c.value) for s, c in terms.items() if c.value is not None}
    if not values:
        raise CampaignError(
            "apply",
            [f"the result has no value for any coefficient of {name}"],
            code="not-determined",
        )
    covariance = covariance_of(accelerometer, terms)
    way = {**accelerometer.known, **accelerometer.coefficients}.get(HYSTERESIS)
    if way is not None and "K_F" in values:
        # Half of it is there with either sign: on which way it was is not known.
        place = list(values).index("K_F")
        covariance[place, place] += ((way.value or 0.0) ** 2 + (way.u or 0.0) ** 2) / 4.0
    if not is_possible(covariance):
        # However the errors are related, (sum of n parts)^2 is at most n times their squares' sum.
        covariance = len(terms) * np.diag(np.diag(covariance))
    return CalibratedAccelerometer(name, mounting, values, covariance)


def terms_of(accelerometer: AccelerometerResult) -> dict[str, Coefficient]:
    """Return the estimates and priors of an accelerometer's products and their slopes."""
    known = {**accelerometer.known, **accelerometer.coefficients}
    return {symbol: c for symbol, c in known.items() if acts(symbol)}


def acts(symbol: str) -> bool:
    """Return whether a term is a product of an accelerometer, or its slope with temperature."""
    return symbol in TERMS or condition_of(symbol) == "temperature"


def determined_terms(accelerometer: AccelerometerResult) -> dict[str, Coefficient]:
    """Return those that have a value."""
    return {symbol: c for symbol, c in terms_of(accelerometer).items() if c.value is not None}


def covariance_of(accelerometer: AccelerometerResult, terms: Mapping[str, Coefficient]) -> Array:
    """Return the covariance of terms in their order, shape (t, t), as far as the result has it."""
    symbols = list(terms)
    u = np.array([c.u or 0.0 for c in terms.values()])
    covariance = np.diag(u**2)
    stated = accelerometer.correlation
    related = stated.terms if stated else []
    estimated = [s for s in symbols if terms[s].estimated]
    for symbol, correlations in accelerometer.prior_correlations.items():
        for partner, r in correlations.items():
            if {symbol, partner} <= terms.keys() - {*estimated}:
                i, j = symbols.index(symbol), symbols.index(partner)
                covariance[i, j] += r * u[i] * u[j]
    for symbol in estimated:
        i = symbols.index(symbol)
        for other in estimated:
            if stated and symbol != other and {symbol, other} <= {*related}:
                j = symbols.index(other)
                r = stated.matrix[related.index(symbol)][related.index(other)]
                covariance[i, j] = r * u[i] * u[j]
        for line in accelerometer.budget.get(symbol, []):
            # An estimate and the prior that moved it: sensitivity x u^2.
            source = line.source
            if source in terms and source not in estimated and line.sensitivity is not None:
                j = symbols.index(source)
                covariance[i, j] = covariance[j, i] = line.sensitivity * u[j] ** 2
    return covariance


def is_possible(covariance: Array) -> bool:
    """Return whether some coefficients could have a covariance, to rounding."""
    root = semidefinite_root(covariance)
    return bool(np.all(np.sum(root**2, axis=1) <= np.diag(covariance) * (1.0 + _ROUNDING)))
