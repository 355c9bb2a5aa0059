"""The overlapping Allan deviation of a record at rest, and how sure it is.

W. J. Riley and D. A. Howe, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008), section
5.2.4; IEEE Std 952 (annex C) uses it for inertial sensors. Its second differences of velocity are
stationary under every noise here. So its equivalent degrees of freedom, 2 E^2/Var, which C. A.
Greenhall and W. J. Riley (Uncertainty of stability variances based on finite differences, 35th PTTI
(2003) 267) tabulate for one power law at a time, are computed from the autocovariance of the noise
that was found, all its parts together.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.noise.even import SampleKind, sample_spectrum
from counterspin.inference.noise.wander import Variances

#: Averaging times an octave, and the part of a record that the longest is, at most.
_AN_OCTAVE: Final = 2
_LONGEST_PART: Final = 1.0 / 3.0

_LOW, _HIGH = 0.025, 0.975


@frozen
class AllanPoint:
    """One averaging time."""

    tau: float  #: s.
    deviation: float  #: m/s^2.
    #: Ends of its 95 % interval, by chi-square.
    low: float
    high: float
    dof: float  #: Equivalent degrees of freedom.
    expected: float  #: Of the noise that was found, m/s^2.


def allan_deviation(velocity: Array, step: float, count: int) -> float:
    """Return the overlapping Allan deviation over `count` steps; NaN where there is no pair.

    velocity: Integral of the specific force at even times, m/s, shape (n,).
    step: s.
    """
    second = velocity[2 * count :] - 2.0 * velocity[count:-count] + velocity[: -2 * count]
    return math.sqrt(float(np.mean(second**2)) / 2.0) / (count * step) if second.size else math.nan


def allan_points(
    velocity: Array, step: float, kind: SampleKind, variances: Variances
) -> list[AllanPoint]:
    """Return the deviation at averaging times up to a third of a record.

    variances: Of the noise found.
    """
    from scipy.stats import chi2

    n = velocity.size - 1
    longest = max(1, math.floor(_LONGEST_PART * n))
    counts = 2.0 ** (np.arange(_AN_OCTAVE * math.log2(longest) + 1e-9) / _AN_OCTAVE)
    points = []
    for count in np.unique(np.round(counts).astype(int)).tolist():
        deviation = allan_deviation(velocity, step, count)
        expected, dof = moments(n, step, kind, variances, count)
        low, high = (deviation * math.sqrt(dof / chi2.ppf(part, dof)) for part in (_HIGH, _LOW))
        points.append(AllanPoint(count * step, deviation, low, high, dof, expected))
    return points


def moments(
    samples: int, step: float, kind: SampleKind, variances: Variances, count: int
) -> tuple[float, float]:
    """Return the Allan deviation that a noise lets expect, and its equivalent degrees of freedom.

    samples: Of the specific force.
    count: Steps in the averaging time.
    """
    from scipy.fft import dct, next_fast_len

    grid = next_fast_len(2 * samples, real=True)
    angle = math.pi * (np.arange(grid) + 0.5) / grid
    density = np.asarray(variances) @ sample_spectrum(angle, step, kind)
    shown = 4.0 * step**2 * np.sin(count * angle / 2.0) ** 4 / np.sin(angle / 2.0) ** 2
    covariance = dct(density * shown, type=2) / (2.0 * grid)
    terms = samples + 1 - 2 * count
    lag = np.arange(1, terms)
    squared = (covariance[1:terms] / covariance[0]) ** 2
    dof = terms / (1.0 + 2.0 * float(((1.0 - lag / terms) * squared).sum()))
    return math.sqrt(float(covariance[0]) / 2.0) / (count * step), dof
