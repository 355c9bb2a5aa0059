"""The first stage: a parabola through the strobes of one run (Eq. 15-18, 31).

Strobes are one sample a revolution, where the reference displacement is zero. At these angles every
harmonic of the revolution has the same phase, so that only what accumulates shows: a parabola in
time, and around it noise.
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

FEWEST_STROBES: Final = 4  #: strobes that a parabola and one degree of freedom need

#: A strobe this near to a sample is on it: of a sample's spacing, and of a turn at the ends.
_ROUNDING: Final = 1e-9


@frozen
class Strobes:
    """The strobed displacement error of one run."""

    time: Array  #: s, shape (m,).
    error: Array  #: Displacement error S - S_ref at the strobes, m, shape (m,).
    #: Standard deviation of each strobe's error per standard deviation of one sample, shape (m,): 1
    #: on a sample, 0.71 midway between two.
    noise_factor: Array
    lost: int  #: Strobes that the record passes but cannot give, because samples are missing there.


def strobe_angle(input_axis: Array) -> float:
    """Return the spindle angle in [0, 2 pi) at which an input axis sees zero displacement.

    It is pi/2 past the axis' own azimuth, measured from east towards north: pi/2 for east
    (the paper's choice), pi for north.

    Parameters
    ----------
    input_axis
        Unit vector in east-north-up, shape (3,).

    Raises
    ------
    NotIdentifiableError
        If the axis is not horizontal within 1 mrad.

    Examples
    --------
    >>> import math
    >>> import counterspin as cs
    >>> [math.degrees(cs.strobe_angle(one.input_axis)) for one in (cs.QX, cs.QY)]
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
        If fewer than `FEWEST_STROBES` strobes are found.
    """
    revolutions = (angle - phase) / TURN
    revolutions = revolutions * (
        1.0 if revolutions[-1] >= revolutions[0] else -1.0
    )  # a strobe lies at each whole number
    first_turn, last_turn = (
        math.ceil(revolutions[0] - _ROUNDING),
        math.floor(revolutions[-1] + _ROUNDING),
    )
    target = np.arange(first_turn, last_turn + 1.0)
    # A noisy angle may pass a strobe to and fro: the first time counts.
    rows = np.searchsorted(np.maximum.accumulate(revolutions), target)
    row_before = np.clip(rows, 1, revolutions.size - 1) - 1
    share = (target - revolutions[row_before]) / (
        revolutions[row_before + 1] - revolutions[row_before]
    )
    return _interpolate(time, error, row_before, share, count)


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
        If fewer than `FEWEST_STROBES` strobes are found.
    """
    return by_angle(time, rate * time, error, phase, count)


def _interpolate(
    time: Array, error: Array, row_before: npt.NDArray[np.intp], share: Array, count: Array | None
) -> Strobes:
    spacing = np.diff(time)
    # Across a gap a straight line is no interpolation any more.
    is_inside = spacing[row_before] <= 1.5 * median(spacing)
    # On a sample the other neighbour does not matter, even if it is missing or far away.
    share = np.where(np.abs(share) < _ROUNDING, 0.0, share)
    share = np.where(np.abs(share - 1.0) < _ROUNDING, 1.0, share)
    before, after = error[row_before], error[row_before + 1]
    value = np.where(share == 0.0, before, (1.0 - share) * before + share * after)
    value = np.where(share == 1.0, after, value)
    samples = np.ones(time.size) if count is None else count
    variance = (1.0 - share) ** 2 / samples[row_before] + share**2 / samples[row_before + 1]
    keep = (is_inside | (share == 0.0) | (share == 1.0)) & np.isfinite(value)
    if np.count_nonzero(keep) < FEWEST_STROBES:
        raise RecordError(
            f"only {np.count_nonzero(keep)} of the {FEWEST_STROBES} strobes required for the "
            "parabola of the first stage could be read: record more revolutions, or fill the gaps",
            code="strobes-lost",
        )
    at = time[row_before] + share * spacing[row_before]
    return Strobes(at[keep], value[keep], np.sqrt(variance[keep]), int(np.sum(~keep)))


# The parabola ----------------------------------------------------------------------------------

#: A strobe is no block of samples: its extent, in parts of the time between two.
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
        Which of the two it is.
    dof
        Degrees of freedom of the residuals, m - 3.
    chi2
        Sum of squared residuals, whitened: divided by its strobe's standard deviation, or by the
        factor of their covariance where they have a random walk.
    residuals
        m, shape (m,).
    gain
        d(b0, b1, b2)/d(strobes), shape (3, m): the matrix P of Eq. 31.
    strobes
        What was fitted.
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
        """Its standard uncertainty (Eq. 31), m/s^2."""
        return math.sqrt(self.covariance[2, 2])

    @property
    def by_noise(self) -> tuple[float, float]:
        """Derivatives of b2's variance with respect to the white variance and N^2."""
        gain, strobes = self.gain[2], self.strobes
        white = float(np.sum((gain * strobes.noise_factor) ** 2))
        return white, float(gain @ walk_covariance(strobes.time) @ gain)


def first_stage(strobes: Strobes, sigma: float | None = None, random_walk: float = 0.0) -> Parabola:
    """Fit the strobes with a parabola (Eq. 16-18) and give its uncertainty (Eq. 31).

    Without a random walk of the accelerometer's velocity the weights are those of white noise, as
    in the paper; with one b2 is the generalised least-squares estimate.

    Parameters
    ----------
    strobes
        At least four; each is weighted by its own noise factor.
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
    if m < FEWEST_STROBES:
        raise NotIdentifiableError(f"{m} strobes cannot determine a parabola and its noise")
    span = float(np.ptp(strobes.time))
    powers = span ** -np.arange(3.0)
    design = np.vander(strobes.time / span, 3, increasing=True)
    weight = 1.0 / strobes.noise_factor
    gain = powers[:, None] * _gain(design, weight)
    residuals = strobes.error - np.vander(strobes.time, 3, increasing=True) @ (gain @ strobes.error)
    squares = float(np.sum((residuals * weight) ** 2))
    used_sigma = math.sqrt(squares / (m - 3)) if sigma is None else sigma
    chi2 = squares / used_sigma**2 if used_sigma > 0.0 else math.nan
    if random_walk > 0.0:
        # Differences remove b0 and b1, and with them what the walk was before the first strobe.
        whiten = make_whitener(
            strobes.time,
            DISPLACEMENT,
            Noise(used_sigma, random_walk),
            strobes.noise_factor**-2.0,
            _STROBE_EXTENT * float(np.diff(strobes.time).min()),
        )
        square = whiten.apply(strobes.time**2)
        b2_gain = whiten.apply(np.eye(m)).T @ square / (square @ square)
        line = powers[:2, None] * _gain(design[:, :2], weight)
        gain = np.vstack([line @ (np.eye(m) - np.outer(strobes.time**2, b2_gain)), b2_gain])
        residuals = strobes.error - np.vander(strobes.time, 3, True) @ (gain @ strobes.error)
        residuals_b2 = whiten.apply(strobes.error - strobes.time**2 * (b2_gain @ strobes.error))
        chi2 = float(residuals_b2 @ residuals_b2)
    spread = gain * (used_sigma * strobes.noise_factor)
    covariance = spread @ spread.T
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
    """Return the strobes' covariance by N^2: that of a twice integrated white noise, (m, m)."""
    earlier_time = np.minimum(time[:, None], time)
    later_time = np.maximum(time[:, None], time)
    covariance: Array = earlier_time**2 * (later_time / 2.0 - earlier_time / 6.0)
    return covariance
