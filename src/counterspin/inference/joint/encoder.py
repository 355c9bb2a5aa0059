"""Rotation errors of each run due to encoder noise, and their effect on a record.

Reference and columns are taken along the spindle that was fitted to the recorded angle. The fit is
uncertain, and a ripple that the noise hides is in no trajectory. In displacement that hardly
matters: the platform's true place is off by R times the angle's error. In velocity and specific
force a ripple stands where K_II does. Hence each run has an `AngleError`, and its coefficients,
turned so that they are uncorrelated and of unit variance, are terms of the fit: considered ones
where the records are of no help, else unknowns whose prior is what the encoder says.
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
from counterspin.physics.angle_error import SLOW, AngleError, angle_sensitivity
from counterspin.physics.effects import SpecificForceProduct
from counterspin.physics.spindle import MAX_HARMONICS
from counterspin.physics.terms import TERMS

#: The terms: of the first three each one, of each harmonic's ripple two quadratures.
SYMBOLS: Final = tuple(f"encoder.{part}" for part in SLOW) + tuple(
    f"encoder.ripple{n}.{phase}" for n in range(1, MAX_HARMONICS + 1) for phase in ("cos", "sin")
)

#: Square of a term's norm in a record above which it is considered, and above which estimated.
_CONSIDERED_NORM_SQUARED: Final = 1e-5
_ESTIMATED_NORM_SQUARED: Final = 1e-2

#: Largest credible size of a term, in its standard deviations.
_LIMIT_SDS: Final = 10.0


def rotation_component(symbol: str) -> str:
    """Return which part of the rotation a term belongs to: angle, rate, drift, ripple1, ..."""
    return symbol.split(".")[1]


def _symbols(error: AngleError) -> tuple[str, ...]:
    ripples = (f"encoder.ripple{n}." for n in error.harmonics)
    return SYMBOLS[: len(SLOW)] + tuple(r + phase for r in ripples for phase in ("cos", "sin"))


def columns(
    series: ResidualSeries, symbols: Sequence[str], coefficients: Mapping[str, float]
) -> Array:
    """Return the effect of one standard deviation of each term on a record.

    By the chain rule: the angle's error changes the reference, and through each coefficient what
    the accelerometer makes of the specific force. Platform errors, which turn that change by less
    than 1e-4 rad, are left out. Where the angle corrects the times of the rows, its error also
    moves these, by the corrected share of itself over the rate.

    Parameters
    ----------
    series
        Of a run whose angle was recorded, unless there are no symbols.
    symbols
        Terms of this run, m of them.
    coefficients
        Of the accelerometer, less nominal; those that are not named count as nominal.

    Returns
    -------
    Array
        Shape (n, m), in the record's unit.
    """
    error = series.angle_error
    if error is None or not symbols:
        return np.empty((series.time.size, 0))
    indices = [_symbols(error).index(symbol) for symbol in symbols]
    motion, order = series.trajectory, series.order
    matrix = series.mounting.turned(series.attitude).matrix
    rows = {TERMS[symbol].effect: value for symbol, value in coefficients.items() if value != 0.0}
    linear = matrix[0] + sum(
        value * row.weight * matrix["IPO".index(row.factors[0])]
        for row, value in rows.items()
        if row.is_linear
    )
    products = {row: value for row, value in rows.items() if not row.is_linear}

    def displacement_change(t: Array, order: int) -> Array:
        spindle = motion.spindle
        rotation = spindle.angle(t), spindle.angular_rate(t), spindle.angular_acceleration(t)
        change = np.zeros((t.size, error.deviation.size, 3))
        change[..., :2] = motion.radius * angle_sensitivity(
            spindle.angle_functions(error, t), *rotation, order
        )
        return change

    def force_change(t: Array) -> Array:
        # Only where the force itself is recorded, or squared, its Coriolis part is not lost.
        coriolis = 2.0 * np.cross(motion.site.earth_rotation, displacement_change(t, 1))
        total: Array = displacement_change(t, 0) + coriolis
        if motion.table_ratio == -1.0:
            return total
        at_times, angle_change = motion.at(t), motion.spindle.angle_functions(error, t)[0]
        return at_times.table.force_change(at_times.specific_force, total, angle_change)

    def product_effect(t: Array) -> Array:
        slope = _product_derivatives(
            products, matrix @ motion.specific_force(t).T / motion.site.gravity
        )
        return np.asarray(np.einsum("nmc,cn->mn", force_change(t), matrix.T @ slope))

    def effect(t: Array) -> Array:
        total = (force_change(t) if order == 0 else displacement_change(t, order)) @ linear
        if products and order == 0:
            total += product_effect(t).T
        elif products:
            edges = quadrature.panel_edges(motion.spindle, float(t.max()))
            if any(row.has_kink for row in products):
                kinks = quadrature.sign_changes(
                    lambda s: motion.specific_force(s) @ matrix[0], edges
                )
                edges = quadrature.panel_edges(motion.spindle, float(t.max()), kinks)
            total += quadrature.integrate(product_effect, edges, t, order)
        return np.asarray(total @ error.root[:, indices])

    average_column = observation.block_average(effect, series.time, series.time_sd)
    if series.corrected_fraction == 0.0:
        return average_column
    angle_change = motion.spindle.angle_functions(error, series.time)[0] @ error.root[:, indices]
    nonzero_coefficients = {symbol: value for symbol, value in coefficients.items() if value != 0.0}
    slope = sum(series.slopes(nonzero_coefficients)) / motion.spindle.angular_rate(series.time)
    return np.asarray(average_column - series.corrected_fraction * slope[:, None] * angle_change)


def _product_derivatives(rows: Mapping[SpecificForceProduct, float], a_ipo: Array) -> Array:
    """Return the derivative of the sum of coefficient x product along I, P, O, shape (3, n)."""
    return np.stack(
        [sum(value * row.slope(a_ipo, axis) for row, value in rows.items()) for axis in "IPO"]
    )


def add_encoder_terms(
    model: Unknowns, series: Sequence[ResidualSeries], noise: Mapping[str, Noise]
) -> Unknowns:
    """Return a model that holds what the encoder leaves open; itself if that is negligible.

    A disturbance of the records moves no coefficient by more than u_noise times its own norm, the
    samples being counted in units of their noise (Cauchy and Schwarz). By the square of that norm,
    for one standard deviation, a term is left out, considered or estimated. Those left out would
    make no u grow by more than 1e-4 of it, those considered are each below a hundredth of any
    variance, and of the others the records know something, so that weighing both is more certain.
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
        for symbol, value, norm in zip(_symbols(error), values, norms.tolist(), strict=True):
            # What a harmonic left out is thought to be counts like its uncertainty.
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
        model,
        unknowns=(*model.unknowns, *unknowns),
        considered=(*model.considered, *considered),
    )


def angle_deviation(error: AngleError, estimates: Mapping[str, float]) -> Array:
    """Return the coefficients of an error's functions from estimates of terms, shape (m,)."""
    values = np.array([estimates.get(symbol, 0.0) for symbol in _symbols(error)])
    return np.asarray(error.root @ values)


def update_priors(model: Unknowns, errors: Mapping[str, AngleError]) -> Unknowns:
    """Return a model whose terms have the priors of these errors of each run's angle."""
    priors = {
        (run, symbol): (value, 1.0)
        for run, error in errors.items()
        for symbol, value in zip(_symbols(error), error.standardised.tolist(), strict=True)
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
    """Return all that the encoder leaves open of the runs of one accelerometer, as considered."""
    return tuple(
        Considered(record.run, symbol, (value, 1.0), _LIMIT_SDS, is_of_interest=False)
        for record in series
        if (error := record.angle_error) is not None
        for symbol, value in zip(_symbols(error), error.standardised.tolist(), strict=True)
    )


def _squared_norms(series: ResidualSeries, error: AngleError, noise: Noise) -> Array:
    """Return the squares of the terms' norms in a record, or bounds that are negligible, (m,)."""
    # In a record of specific force the accelerometer's noise is white too.
    random_walk_variance = noise.random_walk**2 / series.block_spacing if series.order == 0 else 0.0
    variance = series.total_noise(noise).sample_variance + random_walk_variance
    weight = series.count / np.maximum(variance, np.finfo(float).tiny)
    if series.order == 2:
        angle = error.largest @ np.abs(error.root)
        bound = np.sum(weight) * (series.trajectory.radius * angle) ** 2
        if np.all(bound * (1.0 + error.standardised**2) < _CONSIDERED_NORM_SQUARED):
            return np.asarray(bound)
    effects = columns(series, _symbols(error), {})
    return np.asarray(weight @ effects**2)
