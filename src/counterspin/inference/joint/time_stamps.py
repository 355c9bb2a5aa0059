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
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.series import StampErrors
from counterspin.inference.joint.used_rows import without_waves
from counterspin.physics.spindle import Spindle, SpindleFit

#: Order of the differences, and the sum of the squares of their correlations: so many of them tell
#: as much as one independent row.
ORDER: Final = 3
ALIKE: Final = 1.0 + 2.0 * (0.75**2 + 0.3**2 + 0.05**2)

#: Fewest rows of a run from which anything is told.
FEWEST_ROWS: Final = 43

#: Probability at which errors of time stamps of which nothing is stated are taken for chance.
_P: Final = 1e-6

#: A chi-square that has this probability with one degree of freedom is larger.
_LEAST_CHI2: Final = 23.0


class _Regression(NamedTuple):
    """Normal equation of a share, and the variance of its right-hand side."""

    information: float
    product: float
    variance: float


def find_stamp_errors(
    rotation: SpindleFit,
    time: Array,
    count: Array,
    stated: tuple[float, float],
    widening: Array | None = None,
) -> StampErrors | None:
    """Return the errors of time stamps that a recorded angle shows; None of fewer than 43 rows.

    rotation: As the angle shows it.
    time, count: Of the rows, s, and the samples in each, shape (n,).
    stated: Noise of the time stamps, s, and of the encoder, rad; 0: not stated.
    widening: As `StampErrors.widening`; None: zero.
    """
    if time.size < FEWEST_ROWS:
        return None
    spindle, (timing, encoder_noise) = rotation.spindle, stated
    rate = abs(spindle.rate)
    return StampErrors(
        _find_delays(spindle, time, rotation.residuals),
        rotation.rms * math.sqrt(float(np.mean(count))) / rate,
        rotation.dof,
        np.zeros(time.size) if widening is None else widening,
        timing,
        encoder_noise / rate,
    )


def _find_delays(spindle: Spindle, time: Array, ahead: Array) -> Array:
    """Return the times in which the spindle turns by angles, from these times on, s, shape (n,).

    Newton's iteration of two steps: the rate hardly changes in such times.
    """
    delay = ahead / spindle.angular_rate(time)
    turned = spindle.angle(time + delay) - spindle.angle(time)
    return delay - (turned - ahead) / spindle.angular_rate(time + delay)


def find_shares(fit: JointFit) -> Mapping[str, float]:
    """Return the share of the time stamps in the delays of each run; empty where there are none.

    Of what is stated the share is found beside its prior. Of what is not, it counts where the
    records show it beyond chance.
    """
    found: dict[str, list[_Regression]] = {}
    priors: dict[str, tuple[float, float]] = {}
    now: dict[str, float] = {}
    for i, part in enumerate(fit.prepared):
        stamps = part.series.stamps
        if stamps is None or stamps.prior[1] == 0.0 or part.series.time.size < FEWEST_ROWS:
            continue
        regression = _regression(fit, i)
        if regression is None:
            continue
        found.setdefault(part.run, []).append(regression)
        priors[part.run], now[part.run] = stamps.prior, stamps.share
    shares, beyond = {}, 0.0
    for run, regressions in found.items():
        information, product, variance = np.sum(regressions, axis=0).tolist()
        step, u = product / information, math.sqrt(variance) / information
        beyond += (step / u) ** 2
        value, u_prior = priors[run]
        best = now[run] + step
        if math.isfinite(u_prior):
            best = (best * u_prior**2 + value * u**2) / (u_prior**2 + u**2)
        shares[run] = min(max(best, 0.0), 1.0)
    known = any(now.values()) or any(math.isfinite(u) for _, u in priors.values())
    return shares if known or _is_beyond_chance(beyond, len(shares)) else {}


def _is_beyond_chance(chi2: float, count: int) -> bool:
    """Return whether chi-square of so many shares is larger than chance makes it."""
    if chi2 < _LEAST_CHI2:
        return False  # without SciPy, which takes as long to load as a fit takes
    from scipy.special import chdtri

    return chi2 > float(chdtri(count, _P))


def _regression(fit: JointFit, index: int) -> _Regression | None:
    """Return the regression of one record's residuals on those of its angle."""
    series = fit.prepared[index].series
    assert series.stamps is not None
    weight = np.sqrt(series.count / series.relative)
    moved = sum(series.slopes()) * series.stamps.delay * weight
    output = fit.residuals[index].plain * weight
    x, y = (np.diff(without_waves(series, rows), ORDER) for rows in (moved, output))
    strength = float(x @ x)
    if strength == 0.0:
        return None
    share = float(x @ y) / strength
    left = (y - share * x) ** 2
    level = float(np.mean(left))
    if level == 0.0:
        return None
    variance = ALIKE * float(x**2 @ left) / level**2
    return _Regression(strength / level, float(x @ y) / level, variance)
