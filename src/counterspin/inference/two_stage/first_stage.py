"""First stage: a parabola through the strobes of a run (Eq. 15-18, 31).

Strobes are one sample per revolution, at an angle with zero reference displacement. At this angle,
each harmonic of the revolution has a constant phase, so that the strobes only contain a parabola in
time and noise.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array, median
from counterspin.errors import NotIdentifiableError, RecordError
from counterspin.frozen import frozen
from counterspin.inference.noise.model import DISPLACEMENT, Noise, make_whitener
from counterspin.physics.spindle import TURN

MIN_STROBES: Final = 4  #: strobes that a parabola and one degree of freedom need

#: Tolerance for a strobe that coincides with a sample, in sample spacings or in revolutions.
_ROUNDING: Final = 1e-9


@frozen
class Strobes:
    """Strobed displacement error of a run."""

    time: Array  #: s, shape (m,).
    error: Array  #: Displacement error S - S_ref at the strobes, m, shape (m,).
    #: Standard deviation of each strobe over that of a sample, shape (m,): 1 on a sample, 0.71
    #: midway between two samples.
    noise_factor: Array
    lost: int  #: Number of strobes that are lost because samples are missing.


def strobe_angle(input_axis: Array) -> float:
    """Return the spindle angle in [0, 2 pi) at which an input axis sees zero displacement.

    It is pi/2 past the axis' own azimuth, measured from east towards north: pi/2 for east
    (the paper's choice), pi for north.

    Parameters
    ----------
    input_axis
        Unit vector in east-north-up, shape (3,).

    Returns
    -------
    float
        Strobe angle, rad.

    Raises
    ------
    NotIdentifiableError
        If the axis is not horizontal within 1 mrad.

    Examples
    --------
    >>> import math
    >>> import counterspin as cs
    >>> [math.degrees(cs.strobe_angle(mounting.input_axis)) for mounting in (cs.QX, cs.QY)]
    [90.0, 180.0]
    """
    if abs(float(input_axis[2])) > 1e-3:
        raise NotIdentifiableError(
            "strobes require a horizontal input axis; this axis is "
            f"{math.degrees(math.asin(float(input_axis[2]))):.3f} deg above the horizontal",
            code="method-not-applicable",
        )
    return (math.atan2(float(input_axis[1]), float(input_axis[0])) + math.pi / 2) % TURN


def by_angle(
    time: Array, angle: Array, error: Array, phase: float, count: Array | None = None
) -> Strobes:
    """Interpolate the displacement error where the recorded angle passes the strobe angle.

    Parameters
    ----------
    time, angle, error
        Recorded time (s), unwrapped angle (rad), displacement error (m), shape (n,). The
        error's missing samples are NaN.
    phase
        Strobe angle, rad, taken modulo 2 pi.
    count
        Samples averaged into each value, shape (n,); None for one each.

    Returns
    -------
    Strobes

    Raises
    ------
    RecordError
        If fewer than `MIN_STROBES` strobes are found.
    """
    revolutions = (angle - phase) / TURN
    revolutions = revolutions * (
        1.0 if revolutions[-1] >= revolutions[0] else -1.0
    )  # a strobe lies at each whole number
    first_turn, last_turn = (
        math.ceil(revolutions[0] - _ROUNDING),
        math.floor(revolutions[-1] + _ROUNDING),
    )
    strobe_turns = np.arange(first_turn, last_turn + 1.0)
    # A noisy angle may pass a strobe several times; the first time is used.
    rows = np.searchsorted(np.maximum.accumulate(revolutions), strobe_turns)
    row_before = np.clip(rows, 1, revolutions.size - 1) - 1
    fraction = (strobe_turns - revolutions[row_before]) / (
        revolutions[row_before + 1] - revolutions[row_before]
    )
    return _interpolate(time, error, row_before, fraction, count)


def by_nominal_rate(
    time: Array, rate: float, error: Array, phase: float, count: Array | None = None
) -> Strobes:
    """Interpolate the displacement error at the strobe times of a perfectly uniform rotation.

    Parameters
    ----------
    time, error, phase, count
        As for `by_angle`; the angle is zero at time zero.
    rate
        Nominal rate, rad/s, signed.

    Returns
    -------
    Strobes

    Raises
    ------
    RecordError
        If fewer than `MIN_STROBES` strobes are found.
    """
    return by_angle(time, rate * time, error, phase, count)


def _interpolate(
    time: Array,
    error: Array,
    row_before: npt.NDArray[np.intp],
    fraction: Array,
    count: Array | None,
) -> Strobes:
    spacing = np.diff(time)
    # Linear interpolation is not valid across a gap.
    is_inside = spacing[row_before] <= 1.5 * median(spacing)
    # If a strobe coincides with a sample, the other neighbour is not used, even if it is missing.
    fraction = np.where(np.abs(fraction) < _ROUNDING, 0.0, fraction)
    fraction = np.where(np.abs(fraction - 1.0) < _ROUNDING, 1.0, fraction)
    error_before, error_after = error[row_before], error[row_before + 1]
    value = np.where(
        fraction == 0.0, error_before, (1.0 - fraction) * error_before + fraction * error_after
    )
    value = np.where(fraction == 1.0, error_after, value)
    counts = np.ones(time.size) if count is None else count
    variance = (1.0 - fraction) ** 2 / counts[row_before] + fraction**2 / counts[row_before + 1]
    is_kept = (is_inside | (fraction == 0.0) | (fraction == 1.0)) & np.isfinite(value)
    if np.count_nonzero(is_kept) < MIN_STROBES:
        raise RecordError(
            f"only {np.count_nonzero(is_kept)} of the {MIN_STROBES} strobes required for the "
            "parabola of the first stage could be read: record more revolutions, or fill the gaps",
            code="strobes-lost",
        )
    strobe_times = time[row_before] + fraction * spacing[row_before]
    return Strobes(
        strobe_times[is_kept], value[is_kept], np.sqrt(variance[is_kept]), int(np.sum(~is_kept))
    )


# The parabola ----------------------------------------------------------------------------------

#: Sample spacing of a strobe, relative to the time between strobes: a strobe is not a block.
_STROBE_EXTENT: Final = 1e-9


@frozen
class Parabola:
    """The first stage of one run: b0 + b1 t + b2 t^2.

    Attributes
    ----------
    coefficients
        b0 (m), b1 (m/s), b2 (m/s^2), shape (3,).
    covariance
        Of the coefficients, shape (3, 3).
    sigma
        Standard deviation of one sample's displacement, m: given, or from the residuals.
    sigma_from_residuals
        True if sigma was estimated from the residuals.
    dof
        Degrees of freedom of the residuals, m - 3.
    chi2
        Sum of squared whitened residuals: divided by the standard deviation of the strobe, or
        multiplied by the inverse factor of the covariance with a random walk.
    residuals
        m, shape (m,).
    gain
        d(b0, b1, b2)/d(strobes), shape (3, m): the matrix P of Eq. 31.
    strobes
        The fitted strobes.
    """

    coefficients: Array
    covariance: Array
    sigma: float
    sigma_from_residuals: bool
    dof: int
    chi2: float
    residuals: Array
    gain: Array
    strobes: Strobes

    @property
    def b2(self) -> float:
        """The t^2 coefficient, m/s^2."""
        return float(self.coefficients[2])

    @property
    def u_b2(self) -> float:
        """Standard uncertainty of b2 (Eq. 31), m/s^2."""
        return math.sqrt(self.covariance[2, 2])

    @property
    def by_noise(self) -> tuple[float, float]:
        """Derivatives of b2's variance with respect to the white variance and N^2."""
        gain, strobes = self.gain[2], self.strobes
        white = float(np.sum((gain * strobes.noise_factor) ** 2))
        return white, float(gain @ walk_covariance(strobes.time) @ gain)


def first_stage(strobes: Strobes, sigma: float | None = None, random_walk: float = 0.0) -> Parabola:
    """Fit a parabola to the strobes (Eq. 16-18), with its uncertainty (Eq. 31).

    Without a random walk of the velocity, the weights are those of white noise, as in the paper;
    with a random walk, b2 is the generalised least-squares estimate.

    Parameters
    ----------
    strobes
        At least four strobes; the weight of each is ``noise_factor**-2``.
    sigma
        Standard deviation of one sample's displacement, m. None: from the residuals.
    random_walk
        Coefficient N of the accelerometer's white noise, m/s^2/Hz^0.5.

    Returns
    -------
    Parabola

    Raises
    ------
    NotIdentifiableError
        If there are fewer than four strobes.
    """
    m = strobes.time.size
    if m < MIN_STROBES:
        raise NotIdentifiableError(f"{m} strobes cannot determine a parabola and its noise")
    duration = float(np.ptp(strobes.time))
    powers = duration ** -np.arange(3.0)
    design = np.vander(strobes.time / duration, 3, increasing=True)
    weight = 1.0 / strobes.noise_factor
    gain = powers[:, None] * _gain(design, weight)
    residuals = strobes.error - np.vander(strobes.time, 3, increasing=True) @ (gain @ strobes.error)
    sum_of_squares = float(np.sum((residuals * weight) ** 2))
    used_sigma = math.sqrt(sum_of_squares / (m - 3)) if sigma is None else sigma
    chi2 = sum_of_squares / used_sigma**2 if used_sigma > 0.0 else math.nan
    if random_walk > 0.0:
        # Differences remove b0 and b1, and with them the walk before the first strobe.
        whitener = make_whitener(
            strobes.time,
            DISPLACEMENT,
            Noise(used_sigma, random_walk),
            strobes.noise_factor**-2.0,
            _STROBE_EXTENT * float(np.diff(strobes.time).min()),
        )
        whitened_square = whitener.apply(strobes.time**2)
        squared_norm = whitened_square @ whitened_square
        b2_gain = whitener.apply(np.eye(m)).T @ whitened_square / squared_norm
        line_gain = powers[:2, None] * _gain(design[:, :2], weight)
        gain = np.vstack([line_gain @ (np.eye(m) - np.outer(strobes.time**2, b2_gain)), b2_gain])
        residuals = strobes.error - np.vander(strobes.time, 3, True) @ (gain @ strobes.error)
        residuals_b2 = whitener.apply(strobes.error - strobes.time**2 * (b2_gain @ strobes.error))
        chi2 = float(residuals_b2 @ residuals_b2)
    weighted_gain = gain * (used_sigma * strobes.noise_factor)
    covariance = weighted_gain @ weighted_gain.T
    if random_walk > 0.0:
        covariance += random_walk**2 * (gain @ walk_covariance(strobes.time) @ gain.T)
    return Parabola(
        coefficients=gain @ strobes.error,
        covariance=covariance,
        sigma=used_sigma,
        sigma_from_residuals=sigma is None,
        dof=m - 3,
        chi2=chi2,
        residuals=residuals,
        gain=gain,
        strobes=strobes,
    )


def _gain(columns: Array, weight: Array) -> Array:
    """Return d(coefficients)/d(rows) of a weighted least-squares fit, shape (p, m)."""
    q, r = np.linalg.qr(columns * weight[:, None])
    gain: Array = np.linalg.solve(r, q.T * weight)
    return gain


def walk_covariance(time: Array) -> Array:
    """Return the covariance of the strobes per unit N^2, (m, m): doubly integrated white noise."""
    earlier_time = np.minimum(time[:, None], time)
    later_time = np.maximum(time[:, None], time)
    covariance: Array = earlier_time**2 * (later_time / 2.0 - earlier_time / 6.0)
    return covariance
