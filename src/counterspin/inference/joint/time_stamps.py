"""Errors of time stamps, from the correlation of the residuals of angle and output.

If the time stamp of a row is wrong by j, the residual of the angle changes by the rate times j, and
the residual of the output by its slope times j. Encoder noise affects only the angle, and noise of
the record only the output. The regression of the residual of the output on the slope times the
residual of the angle over the rate is therefore the fraction of the time stamps in the angle's
residual.

The regression uses third differences without harmonics of the spindle, which contain neither
undetected ripples nor misfits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.distributions import chi_square_tail
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.outlier_rejection import remove_harmonics
from counterspin.inference.joint.series import TimestampErrors
from counterspin.physics.spindle import Spindle, SpindleFit

#: Order of the differences, and sum of the squares of their correlations: this number of
#: differences is equivalent to an independent row.
DIFFERENCE_ORDER: Final = 3
CORRELATION_FACTOR: Final = 1.0 + 2.0 * (0.75**2 + 0.3**2 + 0.05**2)

#: Smallest number of rows of a run.
MIN_ROWS: Final = 43

#: Significance level for errors of time stamps without prior information.
_SIGNIFICANCE: Final = 1e-6


class _Regression(NamedTuple):
    """Normal equation of a fraction, and the variance of its right-hand side."""

    information: float
    product: float
    variance: float


def find_timestamp_errors(
    spindle_fit: SpindleFit,
    time: Array,
    count: Array,
    stated_noise: tuple[float, float],
    variance_change: Array | None = None,
) -> TimestampErrors | None:
    """Estimate the errors of time stamps from the angle; None for fewer than 43 rows.

    spindle_fit: Fit of the recorded angle.
    time, count: Times of the rows, s, and their numbers of samples, shape (n,).
    stated_noise: Noise of the time stamps, s, and of the encoder, rad; 0: not stated.
    variance_change: See `TimestampErrors.variance_change`; None: zero.
    """
    if time.size < MIN_ROWS:
        return None
    spindle, (timestamp_sd, encoder_sd) = spindle_fit.spindle, stated_noise
    rate = abs(spindle.rate)
    return TimestampErrors(
        _find_delays(spindle, time, spindle_fit.residuals),
        spindle_fit.rms * math.sqrt(float(np.mean(count))) / rate,
        spindle_fit.dof,
        np.zeros(time.size) if variance_change is None else variance_change,
        timestamp_sd,
        encoder_sd / rate,
    )


def _find_delays(spindle: Spindle, time: Array, angle_residuals: Array) -> Array:
    """Return the times in which the spindle turns by angles after these times, s, shape (n,).

    Two steps of Newton's method are enough, because the rate hardly changes.
    """
    delay = angle_residuals / spindle.angular_rate(time)
    turned_angles = spindle.angle(time + delay) - spindle.angle(time)
    return delay - (turned_angles - angle_residuals) / spindle.angular_rate(time + delay)


def estimate_timestamp_fractions(fit: JointFit) -> Mapping[str, float]:
    """Return the fraction of the delays of each run due to time stamps; empty if insignificant.

    Stated noise gives a prior of the fraction. Without stated noise, the fraction must be
    significant.
    """
    regressions_by_run: dict[str, list[_Regression]] = {}
    priors: dict[str, tuple[float, float]] = {}
    current_fractions: dict[str, float] = {}
    for i, block in enumerate(fit.design_blocks):
        errors = block.series.timestamp_errors
        if errors is None or errors.prior[1] == 0.0 or block.series.time.size < MIN_ROWS:
            continue
        regression = _regress_on_angle(fit, i)
        if regression is None:
            continue
        regressions_by_run.setdefault(block.run, []).append(regression)
        priors[block.run], current_fractions[block.run] = errors.prior, errors.fraction
    fractions, chi2 = {}, 0.0
    for run, regressions in regressions_by_run.items():
        information, product, variance = np.sum(regressions, axis=0).tolist()
        step, u = product / information, math.sqrt(variance) / information
        chi2 += (step / u) ** 2
        prior_fraction, u_prior = priors[run]
        fraction = current_fractions[run] + step
        if math.isfinite(u_prior):
            fraction = (fraction * u_prior**2 + prior_fraction * u**2) / (u_prior**2 + u**2)
        fractions[run] = min(max(fraction, 0.0), 1.0)
    has_prior_information = any(current_fractions.values()) or any(
        math.isfinite(u) for _, u in priors.values()
    )
    return fractions if has_prior_information or _is_beyond_chance(chi2, len(fractions)) else {}


def _is_beyond_chance(chi2: float, n_fractions: int) -> bool:
    """Return whether chi-square of the fractions is significant."""
    return n_fractions > 0 and chi_square_tail(n_fractions, chi2) < _SIGNIFICANCE


def _regress_on_angle(fit: JointFit, index: int) -> _Regression | None:
    """Return the regression of the residuals of a record on those of its angle."""
    series = fit.design_blocks[index].series
    assert series.timestamp_errors is not None
    weight = np.sqrt(series.count / series.variance_ratio)
    angle_residuals = sum(series.slopes()) * series.timestamp_errors.delay * weight
    output_residuals = fit.residuals[index].unweighted * weight
    x, y = np.diff(
        remove_harmonics(series, np.stack([angle_residuals, output_residuals])), DIFFERENCE_ORDER
    )
    sum_of_squares = float(x @ x)
    if sum_of_squares == 0.0:
        return None
    slope = float(x @ y) / sum_of_squares
    squared_residuals = (y - slope * x) ** 2
    mean_square = float(np.mean(squared_residuals))
    if mean_square == 0.0:
        return None
    variance = CORRELATION_FACTOR * float(x**2 @ squared_residuals) / mean_square**2
    return _Regression(sum_of_squares / mean_square, float(x @ y) / mean_square, variance)
