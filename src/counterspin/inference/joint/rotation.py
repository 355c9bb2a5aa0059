"""The rotation of each run, found from the output itself.

Of a run without a recorded angle all of the rotation is unknown. With one it is what the encoder's
noise leaves open (`counterspin.inference.joint.encoder`).
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

_ROUNDS: Final = 20  #: of Gauss and Newton's iteration

#: Angle at the end of a run, rad, below which the iteration has settled.
_ANGLE_TOLERANCE: Final = 1e-7

#: Square of the norm of a change in a record, in units of its noise, below which it is left out.
_NEGLIGIBLE_NORM_SQUARED: Final = 1e-3

#: Standard deviations within which an error of the angle is taken to lie.
_SDS: Final = 3.0

#: Fewest samples of a stretch from which a phase is taken: five functions are fitted to them.
_MIN_REVOLUTION_SAMPLES: Final = 8

#: Horizontal part of an input axis from which the rotation can be seen.
_HORIZONTAL_PART: Final = 0.1


def find_rotation(
    series: Sequence[ResidualSeries],
    model: Unknowns,
    scale_factors: Mapping[str, float],
    noise: Mapping[str, Noise],
) -> tuple[ResidualSeries, ...]:
    """Find start angle, rate and drift of each run.

    The phase of each revolution against the nominal rate gives a first guess, whatever the start
    angle, for rates that are off by up to a tenth; the joint fit of all series is then iterated
    about it (Gauss and Newton).
    """
    records = _initial_rotations(series)
    # What turns the output by a right angle, such as a misalignment of which nothing is known, is
    # as good as a start angle; a step to any size of it would not be small.
    bounded_model = replace(model, unknowns=tuple(map(_with_credible_prior, model.unknowns)))
    for _ in range(_ROUNDS):
        design_blocks = build_design_blocks(records, bounded_model, scale_factors)
        solution = solve_joint(design_blocks, bounded_model, noise).solution
        change: dict[str, dict[str, float]] = {}
        for unknown, value in zip(model.unknowns, solution.estimate, strict=True):
            if unknown.symbol in ROTATION:
                change.setdefault(unknown.owner, {})[unknown.symbol] = float(value)
        records = tuple(
            _rotate_series(record, *(change[record.run][symbol] for symbol in ROTATION))
            for record in records
        )
        if all(_end_angle(record, change[record.run]) < _ANGLE_TOLERANCE for record in records):
            return records
    raise ConvergenceError(
        "the rotation cannot be determined from the displacement, because the nominal rate is "
        "too inaccurate. Record the spindle angle, or state the rate more accurately"
    )


def may_be_nonlinear(
    design_blocks: Sequence[DesignBlock], model: Unknowns, noise: Mapping[str, Noise]
) -> bool:
    """Return whether what the encoder leaves open may move a record beyond the first order."""
    runs = {unknown.owner for unknown in model.unknowns if unknown.symbol in encoder.SYMBOLS}
    for block in design_blocks:
        if block.run in runs:
            bound = np.full(block.series.time.size, second_order_bound(block.series))
            if _norm_squared(block.series, bound, noise) > _NEGLIGIBLE_NORM_SQUARED:
                return True
    return False


def second_order_bound(series: ResidualSeries) -> float:
    """Return the largest change of a row by an error of the angle beyond the first order.

    An angle ahead by q, at times behind by q/w, changes the specific force, R w^2 e^(i theta), by
    terms of second order. Their sizes add up to at most R w^2 (b^2 + 13 a d). The sums a, b and d
    are of the sizes of q's waves, each times its harmonic to the powers 0, 1 and 3. Velocity and
    displacement have fewer derivatives of q. On a table the force turns by the ratio times q.
    """
    error, motion = series.angle_error, series.trajectory
    if error is None:
        return 0.0
    max_angle_error = _SDS * np.linalg.norm(error.root, axis=1) + np.abs(error.deviation)
    max_angle_error = max_angle_error * error.largest
    harmonic = np.array([1, 1, 1, *np.repeat(error.harmonics, 2)])
    a, b, d = (float(np.sum(max_angle_error * harmonic**power)) for power in (0, 1, 3))
    scale = motion.radius * abs(motion.spindle.rate) ** (2 - series.order)
    scale *= max(1.0, motion.table_ratio**2)
    return scale * (b**2 + 13.0 * a * d)


def rotate_to_estimate(
    fit: JointFit, series: Sequence[ResidualSeries]
) -> tuple[tuple[ResidualSeries, ...], Unknowns] | None:
    """Return the series about the rotation that a fit found, and the model with renewed priors.

    A fit is linear in the error of the angle, and the records are not. By Cauchy and Schwarz, what
    is not linear moves no coefficient by more than u_noise times its norm in a record, rows being
    counted in units of their noise.

    fit: With all unknowns.
    series: With all rows, those that were rejected included.
    Returns: None where that norm is negligible in every record, or where times would not increase.
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
    if not any(_exceeds_linear(block.series, steps, fit.noise) for block in fit.design_blocks):
        return None
    records = []
    for record in series:
        ahead = record.add_angle(steps[record.run]) if record.run in steps else record
        if ahead is None:
            return None
        records.append(ahead)
    errors = {block.run: block.angle_error for block in records if block.angle_error is not None}
    return tuple(records), encoder.update_priors(fit.model, errors)


def _exceeds_linear(
    series: ResidualSeries, steps: Mapping[str, Array], noise: Mapping[str, Noise]
) -> bool:
    """Return whether an error of the angle moves a record beyond the first order."""
    if series.run not in steps:
        return False
    step = steps[series.run]
    change, double_change = series.add_angle(step), series.add_angle(2.0 * step)
    if change is None or double_change is None:
        return False
    second = 0.5 * (series.error - 2.0 * change.error + double_change.error)
    return _norm_squared(series, second, noise) > _NEGLIGIBLE_NORM_SQUARED


def _norm_squared(series: ResidualSeries, change: Array, noise: Mapping[str, Noise]) -> float:
    """Return the square of a change's norm, rows being counted in units of their noise."""
    variance = series.total_noise(noise[series.accelerometer]).sample_variance
    return float(change**2 @ series.count) / max(variance, float(np.finfo(float).tiny))


def _with_credible_prior(unknown: Unknown) -> Unknown:
    """Return an unknown of which nothing is known with its largest credible size for a prior."""
    if unknown.symbol in ROTATION or math.isfinite(unknown.prior[1]):
        return unknown
    return replace(unknown, prior=(unknown.nominal, unknown.limit))


def _initial_rotations(series: Sequence[ResidualSeries]) -> tuple[ResidualSeries, ...]:
    """Return the series about a first guess of each run's rotation."""
    guesses = {}
    for run in dict.fromkeys(record.run for record in series):
        run_series = [record for record in series if record.run == run]
        horizontal = [
            float(np.linalg.norm(record.mounting.turned(record.attitude).input_axis[:2]))
            for record in run_series
        ]
        best_index = int(np.argmax(horizontal))
        guesses[run] = (
            _estimate_rotation(run_series[best_index])
            if horizontal[best_index] > _HORIZONTAL_PART
            else (0.0, 0.0, 0.0)
        )
    return tuple(_rotate_series(record, *guesses[record.run]) for record in series)


def _estimate_rotation(series: ResidualSeries) -> tuple[float, float, float]:
    """Return changes of start angle, rate and drift from the phases of the revolutions."""
    spindle = series.trajectory.spindle
    ahead = replace(
        series.trajectory,
        spindle=replace(spindle, start_angle=spindle.start_angle + math.pi / 2.0),
    )
    output = series.error + series.reference()
    harmonics = np.column_stack([series.reference(), series.reference(ahead)])
    revolution_time = 2.0 * math.pi / abs(spindle.rate)
    revolutions = np.floor((series.time - series.time[0]) / revolution_time).astype(int)
    times, phases = [], []
    for revolution in range(revolutions[-1] + 1):
        rows = revolutions == revolution
        if np.count_nonzero(rows) < _MIN_REVOLUTION_SAMPLES:
            continue
        middle = float(series.time[rows].mean())
        # Over one revolution all else that the output does is a parabola.
        parabola = np.vander((series.time[rows] - middle) / revolution_time, 3)
        size = np.linalg.lstsq(
            np.column_stack([harmonics[rows], parabola]), output[rows], rcond=None
        )[0]
        times.append(middle)
        phases.append(math.atan2(size[1], size[0]))
    if not times:
        return (0.0, 0.0, 0.0)
    degree = min(2, len(times) - 1)
    lag = np.polynomial.Polynomial.fit(times, np.unwrap(phases), degree).convert().coef
    start, rate, curvature = (*lag, 0.0, 0.0)[:3]
    return (float(start), float(rate), float(2.0 * curvature / (spindle.rate + rate)))


def _rotate_series(
    series: ResidualSeries, start_angle: float, rate: float, drift: float
) -> ResidualSeries:
    """Return the series about the reference of a rotation changed by the given steps."""
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


def _end_angle(series: ResidualSeries, change: Mapping[str, float]) -> float:
    """Return how far the last sample has turned, at most, by a change of the rotation, rad."""
    end = float(series.time[-1])
    factors = (1.0, end, abs(series.trajectory.spindle.rate) * end**2)
    return sum(abs(change[s]) * factor for s, factor in zip(ROTATION, factors, strict=True))
