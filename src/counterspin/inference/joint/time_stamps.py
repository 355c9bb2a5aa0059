"""Errors of time stamps, from the correlation of what angle and output leave.

A row whose time stamp is off by j has its angle and its output of another time: the residual of the
angle moves by the rate times j, that of the output by its slope times j. Noise of the encoder moves
the angle alone, noise of the record the output alone. So the regression of the output's residual on
slope times angle's residual over the rate is the share of the time stamps in the angle's residual.

Both are taken in third differences, without waves of the spindle: a ripple that the angle does not
clearly show, and a misfit, leave nothing in these.
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

#: Order of the differences, and the sum of the squares of their correlations: so many of them tell
#: as much as one independent row.
ORDER: Final = 3
CORRELATION_FACTOR: Final = 1.0 + 2.0 * (0.75**2 + 0.3**2 + 0.05**2)

#: Fewest rows of a run from which anything is told.
MIN_ROWS: Final = 43

#: Probability at which errors of time stamps of which nothing is stated are taken for chance.
_SIGNIFICANCE: Final = 1e-6


class _Regression(NamedTuple):
    """Normal equation of a share, and the variance of its right-hand side."""

    information: float
    product: float
    variance: float


def find_stamp_errors(
    rotation: SpindleFit,
    time: Array,
    count: Array,
    stated_noise: tuple[float, float],
    widening: Array | None = None,
) -> TimestampErrors | None:
    """Return the errors of time stamps that a recorded angle shows; None of fewer than 43 rows.

    rotation: As the angle shows it.
    time, count: Of the rows, s, and the samples in each, shape (n,).
    stated_noise: Noise of the time stamps, s, and of the encoder, rad; 0: not stated.
    widening: As `TimestampErrors.variance_change`; None: zero.
    """
    if time.size < MIN_ROWS:
        return None
    spindle, (timing, encoder_noise) = rotation.spindle, stated_noise
    rate = abs(spindle.rate)
    return TimestampErrors(
        _find_delays(spindle, time, rotation.residuals),
        rotation.rms * math.sqrt(float(np.mean(count))) / rate,
        rotation.dof,
        np.zeros(time.size) if widening is None else widening,
        timing,
        encoder_noise / rate,
    )


def _find_delays(spindle: Spindle, time: Array, angles: Array) -> Array:
    """Return the times in which the spindle turns by angles, from these times on, s, shape (n,).

    Newton's iteration of two steps: the rate hardly changes in such times.
    """
    delay = angles / spindle.angular_rate(time)
    turned_angles = spindle.angle(time + delay) - spindle.angle(time)
    return delay - (turned_angles - angles) / spindle.angular_rate(time + delay)


def estimate_timestamp_fractions(fit: JointFit) -> Mapping[str, float]:
    """Return the share of the time stamps in the delays of each run; empty where there are none.

    Of what is stated the share is found beside its prior. Of what is not, it counts where the
    records show it beyond chance.
    """
    regressions_by_run: dict[str, list[_Regression]] = {}
    priors: dict[str, tuple[float, float]] = {}
    current_fractions: dict[str, float] = {}
    for i, block in enumerate(fit.design_blocks):
        stamps = block.series.timestamp_errors
        if stamps is None or stamps.prior[1] == 0.0 or block.series.time.size < MIN_ROWS:
            continue
        regression = _regression(fit, i)
        if regression is None:
            continue
        regressions_by_run.setdefault(block.run, []).append(regression)
        priors[block.run], current_fractions[block.run] = stamps.prior, stamps.fraction
    fractions, chi2 = {}, 0.0
    for run, regressions in regressions_by_run.items():
        information, product, variance = np.sum(regressions, axis=0).tolist()
        step, u = product / information, math.sqrt(variance) / information
        chi2 += (step / u) ** 2
        value, u_prior = priors[run]
        best_fraction = current_fractions[run] + step
        if math.isfinite(u_prior):
            best_fraction = (best_fraction * u_prior**2 + value * u**2) / (u_prior**2 + u**2)
        fractions[run] = min(max(best_fraction, 0.0), 1.0)
    is_known = any(current_fractions.values()) or any(math.isfinite(u) for _, u in priors.values())
    return fractions if is_known or _is_beyond_chance(chi2, len(fractions)) else {}


def _is_beyond_chance(chi2: float, count: int) -> bool:
    """Return whether chi-square of so many shares is larger than chance makes it."""
    return count > 0 and chi_square_tail(count, chi2) < _SIGNIFICANCE


def _regression(fit: JointFit, index: int) -> _Regression | None:
    """Return the regression of one record's residuals on those of its angle."""
    series = fit.design_blocks[index].series
    assert series.timestamp_errors is not None
    weight = np.sqrt(series.count / series.variance_ratio)
    angle_residuals = sum(series.slopes()) * series.timestamp_errors.delay * weight
    output = fit.residuals[index].unweighted * weight
    x, y = np.diff(remove_harmonics(series, np.stack([angle_residuals, output])), ORDER)
    strength = float(x @ x)
    if strength == 0.0:
        return None
    slope = float(x @ y) / strength
    squared_residuals = (y - slope * x) ** 2
    level = float(np.mean(squared_residuals))
    if level == 0.0:
        return None
    variance = CORRELATION_FACTOR * float(x**2 @ squared_residuals) / level**2
    return _Regression(strength / level, float(x @ y) / level, variance)
