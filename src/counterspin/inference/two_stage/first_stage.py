"""The first stage: a parabola through the strobes of one run (Eq. 16-18, 31)."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.noise.model import DISPLACEMENT, Noise, make_whitener
from counterspin.inference.two_stage.strobes import FEWEST_STROBES, Strobes

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
        """What b2's variance grows by with the white variance and with N^2."""
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
    scaled = np.vander(strobes.time / span, 3, increasing=True)
    weight = 1.0 / strobes.noise_factor
    gain = powers[:, None] * _gain(scaled, weight)
    residuals = strobes.error - np.vander(strobes.time, 3, increasing=True) @ (gain @ strobes.error)
    squares = float(np.sum((residuals * weight) ** 2))
    used = math.sqrt(squares / (m - 3)) if sigma is None else sigma
    chi2 = squares / used**2 if used > 0.0 else math.nan
    if random_walk > 0.0:
        # Differences remove b0 and b1, and with them what the walk was before the first strobe.
        whiten = make_whitener(
            strobes.time,
            DISPLACEMENT,
            Noise(used, random_walk),
            strobes.noise_factor**-2.0,
            _STROBE_EXTENT * float(np.diff(strobes.time).min()),
        )
        square = whiten.apply(strobes.time**2)
        b2_gain = whiten.apply(np.eye(m)).T @ square / (square @ square)
        line = powers[:2, None] * _gain(scaled[:, :2], weight)
        gain = np.vstack([line @ (np.eye(m) - np.outer(strobes.time**2, b2_gain)), b2_gain])
        residuals = strobes.error - np.vander(strobes.time, 3, True) @ (gain @ strobes.error)
        left = whiten.apply(strobes.error - strobes.time**2 * (b2_gain @ strobes.error))
        chi2 = float(left @ left)
    spread = gain * (used * strobes.noise_factor)
    covariance = spread @ spread.T
    if random_walk > 0.0:
        covariance += random_walk**2 * (gain @ walk_covariance(strobes.time) @ gain.T)
    return Parabola(
        coefficients=gain @ strobes.error,
        covariance=covariance,
        sigma=used,
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
    earlier = np.minimum(time[:, None], time)
    later = np.maximum(time[:, None], time)
    covariance: Array = earlier**2 * (later / 2.0 - earlier / 6.0)
    return covariance
