"""Rotation errors of each run due to encoder noise, and their effect on a record.

Reference and columns are computed with the rotation fitted to the recorded angle. This fit is
uncertain, and the trajectory contains no ripple that is hidden by the noise. In displacement, the
error is only R times the angle error. In velocity and specific force, a ripple has the same
signature as K_II. Each run therefore has an `AngleError`. Its coefficients, transformed to be
uncorrelated with unit variance, are terms of the fit: considered terms if the records contain
little information on them, otherwise unknowns with a prior from the encoder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.joint.unknowns import Considered, Unknown, Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.physics import observation, quadrature
from counterspin.physics.angle_error import POLYNOMIAL_NAMES, AngleError, angle_sensitivity
from counterspin.physics.effects import SpecificForceProduct
from counterspin.physics.spindle import MAX_HARMONICS
from counterspin.physics.terms import TERMS

#: Symbols of the terms: angle, rate and drift, and two quadratures of each ripple.
SYMBOLS: Final = tuple(f"encoder.{name}" for name in POLYNOMIAL_NAMES) + tuple(
    f"encoder.ripple{n}.{phase}" for n in range(1, MAX_HARMONICS + 1) for phase in ("cos", "sin")
)

#: Square of a term's norm in a record above which it is considered, and above which estimated.
_CONSIDERED_NORM_SQUARED: Final = 1e-5
_ESTIMATED_NORM_SQUARED: Final = 1e-2

#: Largest credible size of a term, in its standard deviations.
_LIMIT_SDS: Final = 10.0


def rotation_component(symbol: str) -> str:
    """Return the component of the rotation of a term: angle, rate, drift, ripple1, ..."""
    return symbol.split(".")[1]


def _angle_error_symbols(angle_error: AngleError) -> tuple[str, ...]:
    ripples = (f"encoder.ripple{n}." for n in angle_error.harmonics)
    return SYMBOLS[: len(POLYNOMIAL_NAMES)] + tuple(
        r + phase for r in ripples for phase in ("cos", "sin")
    )


def columns(
    series: ResidualSeries, symbols: Sequence[str], coefficients: Mapping[str, float]
) -> Array:
    """Return the effect of one standard deviation of each term on a record.

    The angle error changes the reference and, through each coefficient, the response to specific
    force. Platform errors rotate this change by less than 1e-4 rad and are omitted. If the angle
    corrects the times of the rows, its error also shifts these times.

    Parameters
    ----------
    series
        Series of a run with a recorded angle, unless there are no symbols.
    symbols
        Symbols of m terms of this run.
    coefficients
        Coefficients of the accelerometer minus nominal values; 0 by default.

    Returns
    -------
    Array
        Shape (n, m), in the record's unit.
    """
    angle_error = series.angle_error
    if angle_error is None or not symbols:
        return np.empty((series.time.size, 0))
    indices = [_angle_error_symbols(angle_error).index(symbol) for symbol in symbols]
    motion, order = series.trajectory, series.order
    matrix = series.mounting.turned(series.attitude).matrix
    effects = {TERMS[symbol].effect: value for symbol, value in coefficients.items() if value}
    linear_sensitivity = matrix[0] + sum(
        value * row.weight * matrix["IPO".index(row.factors[0])]
        for row, value in effects.items()
        if row.is_linear
    )
    products = {row: value for row, value in effects.items() if not row.is_linear}

    def displacement_change(t: Array, order: int) -> Array:
        spindle = motion.spindle
        rotation = spindle.angle(t), spindle.angular_rate(t), spindle.angular_acceleration(t)
        change = np.zeros((t.size, angle_error.deviation.size, 3))
        change[..., :2] = motion.radius * angle_sensitivity(
            spindle.angle_functions(angle_error, t), *rotation, order
        )
        return change

    def force_change(t: Array) -> Array:
        # The Coriolis part matters only if the specific force is recorded or squared.
        coriolis = 2.0 * np.cross(motion.site.earth_rotation, displacement_change(t, 1))
        force: Array = displacement_change(t, 0) + coriolis
        if motion.table_ratio == -1.0:
            return force
        platform, angle_change = motion.at(t), motion.spindle.angle_functions(angle_error, t)[0]
        return platform.table.force_change(platform.specific_force, force, angle_change)

    def product_effect(t: Array) -> Array:
        derivatives = _product_derivatives(
            products, matrix @ motion.specific_force(t).T / motion.site.gravity
        )
        return np.asarray(np.einsum("nmc,cn->mn", force_change(t), matrix.T @ derivatives))

    def output_change(t: Array) -> Array:
        force = force_change(t) if order == 0 else displacement_change(t, order)
        change = force @ linear_sensitivity
        if products and order == 0:
            change += product_effect(t).T
        elif products:
            edges = quadrature.panel_edges(motion.spindle, float(t.max()))
            if any(row.has_kink for row in products):
                axis = matrix[0]
                kinks = quadrature.sign_changes(lambda s: motion.specific_force(s) @ axis, edges)
                edges = quadrature.panel_edges(motion.spindle, float(t.max()), kinks)
            change += quadrature.integrate(product_effect, edges, t, order)
        return np.asarray(change @ angle_error.root[:, indices])

    average = observation.block_average(output_change, series.time, series.time_sd)
    if series.corrected_fraction == 0.0:
        return average
    functions = motion.spindle.angle_functions(angle_error, series.time)[0]
    angle_change = functions @ angle_error.root[:, indices]
    nonzero_coefficients = {symbol: value for symbol, value in coefficients.items() if value != 0.0}
    rate = motion.spindle.angular_rate(series.time)
    output_slope = sum(series.slopes(nonzero_coefficients)) / rate
    return np.asarray(average - series.corrected_fraction * output_slope[:, None] * angle_change)


def _product_derivatives(products: Mapping[SpecificForceProduct, float], a_ipo: Array) -> Array:
    """Return the derivative of the sum of coefficient x product along I, P, O, shape (3, n)."""
    return np.stack(
        [sum(value * row.slope(a_ipo, axis) for row, value in products.items()) for axis in "IPO"]
    )


def add_encoder_terms(
    model: Unknowns, series: Sequence[ResidualSeries], noise: Mapping[str, Noise]
) -> Unknowns:
    """Return a model with encoder terms; the same model if all of them are negligible.

    A disturbance of the records shifts no coefficient by more than u_noise times its norm, with
    samples in units of their noise (Cauchy-Schwarz inequality). The squared norm of one standard
    deviation decides whether a term is omitted, considered or estimated. Omitted terms would
    increase no u by more than 1e-4 of it, and a considered term is below a hundredth of any
    variance. The records contain information on the estimated terms.
    """
    unknowns: list[Unknown] = []
    considered: list[Considered] = []
    for run in dict.fromkeys(record.run for record in series):
        run_series = [record for record in series if record.run == run]
        error = run_series[0].angle_error
        if error is None:
            continue
        norms = np.max(
            [_squared_norms(record, error, noise[record.accelerometer]) for record in run_series],
            axis=0,
        )
        values = error.standardised.tolist()
        for symbol, value, norm in zip(
            _angle_error_symbols(error), values, norms.tolist(), strict=True
        ):
            # The prior value of an omitted harmonic counts like its uncertainty.
            if norm > _ESTIMATED_NORM_SQUARED:
                unknowns.append(
                    Unknown(run, symbol, (value, 1.0), _LIMIT_SDS, is_of_interest=False)
                )
            elif norm * (1.0 + value**2) > _CONSIDERED_NORM_SQUARED:
                considered.append(
                    Considered(run, symbol, (value, 1.0), _LIMIT_SDS, is_of_interest=False)
                )
    if not unknowns and not considered:
        return model
    return replace(
        model, unknowns=(*model.unknowns, *unknowns), considered=(*model.considered, *considered)
    )


def angle_deviation(error: AngleError, estimates: Mapping[str, float]) -> Array:
    """Return the coefficients of the angle error from estimates of terms, shape (m,)."""
    values = np.array([estimates.get(symbol, 0.0) for symbol in _angle_error_symbols(error)])
    return np.asarray(error.root @ values)


def update_priors(model: Unknowns, errors: Mapping[str, AngleError]) -> Unknowns:
    """Return a model with the priors of encoder terms from the angle errors of the runs."""
    priors = {
        (run, symbol): (value, 1.0)
        for run, error in errors.items()
        for symbol, value in zip(
            _angle_error_symbols(error), error.standardised.tolist(), strict=True
        )
    }
    return replace(
        model,
        unknowns=tuple(
            replace(unknown, prior=priors.get((unknown.owner, unknown.symbol), unknown.prior))
            for unknown in model.unknowns
        ),
        considered=tuple(
            replace(unknown, prior=priors.get((unknown.owner, unknown.symbol), unknown.prior))
            for unknown in model.considered
        ),
    )


def considered_terms(series: Sequence[ResidualSeries]) -> tuple[Considered, ...]:
    """Return all encoder terms of the runs of an accelerometer, as considered terms."""
    return tuple(
        Considered(record.run, symbol, (value, 1.0), _LIMIT_SDS, is_of_interest=False)
        for record in series
        if (error := record.angle_error) is not None
        for symbol, value in zip(
            _angle_error_symbols(error), error.standardised.tolist(), strict=True
        )
    )


def _squared_norms(series: ResidualSeries, error: AngleError, noise: Noise) -> Array:
    """Return the squared norms of the terms in a record, or negligible bounds, shape (m,)."""
    # In a record of specific force, the random walk is white noise too.
    random_walk_variance = noise.random_walk**2 / series.block_spacing if series.order == 0 else 0.0
    variance = series.total_noise(noise).sample_variance + random_walk_variance
    weights = series.count / np.maximum(variance, np.finfo(float).tiny)
    if series.order == 2:
        max_angles = error.max_values @ np.abs(error.root)
        bound = np.sum(weights) * (series.trajectory.radius * max_angles) ** 2
        if np.all(bound * (1.0 + error.standardised**2) < _CONSIDERED_NORM_SQUARED):
            return np.asarray(bound)
    effects = columns(series, _angle_error_symbols(error), {})
    return np.asarray(weights @ effects**2)
