"""Estimation of the rotation of each run from the output.

Without a recorded angle, the whole rotation is unknown. With a recorded angle, only the error due
to encoder noise is unknown (`counterspin.inference.joint.encoder`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import ConvergenceError
from counterspin.inference.joint import encoder
from counterspin.inference.joint.design_blocks import DesignBlock, build_design_blocks
from counterspin.inference.joint.fit import JointFit, solve_joint
from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.joint.unknowns import ROTATION, Unknown, Unknowns
from counterspin.inference.noise.model import Noise

_MAX_ITERATIONS: Final = 20  #: of the Gauss-Newton method

#: Change of the angle at the end of a run, rad, below which the iteration has converged.
_ANGLE_TOLERANCE: Final = 1e-7

#: Squared norm of a change of a record, in units of its noise, that is negligible.
_NEGLIGIBLE_NORM_SQUARED: Final = 1e-3

#: Bound of angle errors, in standard deviations.
_BOUND_SDS: Final = 3.0

#: Smallest number of samples for the phase of a revolution, a fit of five functions.
_MIN_REVOLUTION_SAMPLES: Final = 8

#: Smallest horizontal component of an input axis for the estimation of the rotation.
_MIN_HORIZONTAL_COMPONENT: Final = 0.1


def find_rotation(
    series: Sequence[ResidualSeries],
    model: Unknowns,
    scale_factors: Mapping[str, float],
    noise: Mapping[str, Noise],
) -> tuple[ResidualSeries, ...]:
    """Estimate start angle, rate and drift of each run.

    The phases of the revolutions relative to the nominal rate give initial values for any start
    angle and for rate errors up to a tenth. The Gauss-Newton method then refines them in the joint
    fit of all series.
    """
    rotated_series = _with_initial_rotations(series)
    # A misalignment without a prior acts like a start angle; its steps must remain small.
    bounded_model = replace(model, unknowns=tuple(map(_bound_prior, model.unknowns)))
    for _ in range(_MAX_ITERATIONS):
        design_blocks = build_design_blocks(rotated_series, bounded_model, scale_factors)
        solution = solve_joint(design_blocks, bounded_model, noise).solution
        changes: dict[str, dict[str, float]] = {}
        for unknown, value in zip(model.unknowns, solution.estimate, strict=True):
            if unknown.symbol in ROTATION:
                changes.setdefault(unknown.owner, {})[unknown.symbol] = float(value)
        rotated_series = tuple(
            _rotate_series(record, *(changes[record.run][symbol] for symbol in ROTATION))
            for record in rotated_series
        )
        if all(
            _max_angle_change(record, changes[record.run]) < _ANGLE_TOLERANCE
            for record in rotated_series
        ):
            return rotated_series
    raise ConvergenceError(
        "the rotation cannot be determined from the displacement, because the nominal rate is "
        "too inaccurate. Record the spindle angle, or state the rate more accurately"
    )


def may_be_nonlinear(
    design_blocks: Sequence[DesignBlock], model: Unknowns, noise: Mapping[str, Noise]
) -> bool:
    """Return whether encoder errors may have nonlinear effects on a record."""
    runs = {unknown.owner for unknown in model.unknowns if unknown.symbol in encoder.SYMBOLS}
    for block in design_blocks:
        if block.run in runs:
            bound = np.full(block.series.time.size, second_order_bound(block.series))
            if _squared_norm(block.series, bound, noise) > _NEGLIGIBLE_NORM_SQUARED:
                return True
    return False


def second_order_bound(series: ResidualSeries) -> float:
    """Return a bound of the nonlinear change of a row by an angle error.

    An angle error q, with times corrected by q/w, changes the specific force, R w^2 e^(i theta), by
    second-order terms of at most R w^2 (b^2 + 13 a d). The sums a, b and d contain the amplitudes
    of the harmonics n of q, times n to the powers 0, 1 and 3. Velocity and displacement have fewer
    derivatives of q. On a table, the force turns by the ratio times q.
    """
    angle_error, motion = series.angle_error, series.trajectory
    if angle_error is None:
        return 0.0
    max_angle_error = _BOUND_SDS * np.linalg.norm(angle_error.root, axis=1) + np.abs(
        angle_error.deviation
    )
    max_angle_error = max_angle_error * angle_error.max_values
    harmonic = np.array([1, 1, 1, *np.repeat(angle_error.harmonics, 2)])
    a, b, d = (float(np.sum(max_angle_error * harmonic**power)) for power in (0, 1, 3))
    scale = motion.radius * abs(motion.spindle.rate) ** (2 - series.order)
    scale *= max(1.0, motion.table_ratio**2)
    return scale * (b**2 + 13.0 * a * d)


def rotate_to_estimate(
    fit: JointFit, series: Sequence[ResidualSeries]
) -> tuple[tuple[ResidualSeries, ...], Unknowns] | None:
    """Return the series along the estimated rotation, and the model with updated priors.

    The fit is linear in the angle error, but the records are not. By the Cauchy-Schwarz inequality,
    the nonlinear part shifts no coefficient by more than u_noise times its norm in a record, with
    rows in units of their noise.

    fit: Fit with all unknowns.
    series: Series with all rows, including rejected rows.
    Returns: None if this norm is negligible in every record, or if times would not increase.
    """
    estimates: dict[str, dict[str, float]] = {}
    for unknown, value in zip(fit.model.unknowns, fit.solution.estimate.tolist(), strict=True):
        if unknown.symbol in encoder.SYMBOLS:
            estimates.setdefault(unknown.owner, {})[unknown.symbol] = value
    steps = {
        block.run: encoder.angle_deviation(block.series.angle_error, estimates[block.run])
        for block in fit.design_blocks
        if block.run in estimates and block.series.angle_error is not None
    }
    if not any(
        _has_nonlinear_change(block.series, steps, fit.noise) for block in fit.design_blocks
    ):
        return None
    records = []
    for record in series:
        rotated_record = record.add_angle(steps[record.run]) if record.run in steps else record
        if rotated_record is None:
            return None
        records.append(rotated_record)
    errors = {block.run: block.angle_error for block in records if block.angle_error is not None}
    return tuple(records), encoder.update_priors(fit.model, errors)


def _has_nonlinear_change(
    series: ResidualSeries, steps: Mapping[str, Array], noise: Mapping[str, Noise]
) -> bool:
    """Return whether an angle error changes a record nonlinearly."""
    if series.run not in steps:
        return False
    step = steps[series.run]
    change, double_change = series.add_angle(step), series.add_angle(2.0 * step)
    if change is None or double_change is None:
        return False
    second_order_change = 0.5 * (series.error - 2.0 * change.error + double_change.error)
    return _squared_norm(series, second_order_change, noise) > _NEGLIGIBLE_NORM_SQUARED


def _squared_norm(series: ResidualSeries, change: Array, noise: Mapping[str, Noise]) -> float:
    """Return the squared norm of a change of a record, with rows in units of their noise."""
    variance = series.total_noise(noise[series.accelerometer]).sample_variance
    return float(change**2 @ series.count) / max(variance, float(np.finfo(float).tiny))


def _bound_prior(unknown: Unknown) -> Unknown:
    """Return an unknown with a prior; without one, the prior u is its largest credible size."""
    if unknown.symbol in ROTATION or math.isfinite(unknown.prior[1]):
        return unknown
    return replace(unknown, prior=(unknown.nominal, unknown.limit))


def _with_initial_rotations(series: Sequence[ResidualSeries]) -> tuple[ResidualSeries, ...]:
    """Return the series along the initial rotation of each run."""
    rotations = {}
    for run in dict.fromkeys(record.run for record in series):
        run_series = [record for record in series if record.run == run]
        horizontal_components = [
            float(np.linalg.norm(record.mounting.turned(record.attitude).input_axis[:2]))
            for record in run_series
        ]
        best_index = int(np.argmax(horizontal_components))
        rotations[run] = (
            _estimate_rotation(run_series[best_index])
            if horizontal_components[best_index] > _MIN_HORIZONTAL_COMPONENT
            else (0.0, 0.0, 0.0)
        )
    return tuple(_rotate_series(record, *rotations[record.run]) for record in series)


def _estimate_rotation(series: ResidualSeries) -> tuple[float, float, float]:
    """Estimate changes of start angle, rate and drift from the phases of the revolutions."""
    spindle = series.trajectory.spindle
    quadrature = replace(
        series.trajectory, spindle=replace(spindle, start_angle=spindle.start_angle + math.pi / 2.0)
    )
    output = series.error + series.reference()
    harmonics = np.column_stack([series.reference(), series.reference(quadrature)])
    revolution_time = 2.0 * math.pi / abs(spindle.rate)
    revolutions = np.floor((series.time - series.time[0]) / revolution_time).astype(int)
    times, phases = [], []
    for revolution in range(revolutions[-1] + 1):
        is_in_revolution = revolutions == revolution
        if np.count_nonzero(is_in_revolution) < _MIN_REVOLUTION_SAMPLES:
            continue
        mean_time = float(series.time[is_in_revolution].mean())
        # Within a revolution, the rest of the output is a parabola.
        parabola = np.vander((series.time[is_in_revolution] - mean_time) / revolution_time, 3)
        amplitudes = np.linalg.lstsq(
            np.column_stack([harmonics[is_in_revolution], parabola]),
            output[is_in_revolution],
            rcond=None,
        )[0]
        times.append(mean_time)
        phases.append(math.atan2(amplitudes[1], amplitudes[0]))
    if not times:
        return (0.0, 0.0, 0.0)
    degree = min(2, len(times) - 1)
    phase_coefficients = (
        np.polynomial.Polynomial.fit(times, np.unwrap(phases), degree).convert().coef
    )
    start, rate, curvature = (*phase_coefficients, 0.0, 0.0)[:3]
    return (float(start), float(rate), float(2.0 * curvature / (spindle.rate + rate)))


def _rotate_series(
    series: ResidualSeries, start_angle: float, rate: float, drift: float
) -> ResidualSeries:
    """Return the series with a rotation changed by the given steps."""
    spindle = series.trajectory.spindle
    trajectory = replace(
        series.trajectory,
        spindle=replace(
            spindle,
            start_angle=spindle.start_angle + start_angle,
            rate=spindle.rate + rate,
            drift=spindle.drift + drift,
        ),
    )
    output = series.error + series.reference()
    return replace(series, trajectory=trajectory, error=output - series.reference(trajectory))


def _max_angle_change(series: ResidualSeries, change: Mapping[str, float]) -> float:
    """Return the largest change of the angle of the last sample, rad."""
    end = float(series.time[-1])
    factors = (1.0, end, abs(series.trajectory.spindle.rate) * end**2)
    return sum(abs(change[s]) * factor for s, factor in zip(ROTATION, factors, strict=True))
