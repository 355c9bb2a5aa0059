"""The first stage: a parabola through the strobes of one run (Eq. 16-18, 31).

- `first_stage`, `Parabola`
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import NotIdentifiableError
from counterspin.inference.two_stage.strobes import MINIMUM, Strobes


@dataclass(frozen=True)
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
        Sum of squared residuals, each divided by its strobe's standard deviation.
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


def first_stage(strobes: Strobes, sigma: float | None = None, random_walk: float = 0.0) -> Parabola:
    """Fit the strobes with a parabola (Eq. 16-18) and give its uncertainty (Eq. 31).

    The weights are those of white noise, as in the paper; a random walk of the accelerometer's
    velocity, where one is given, enters the uncertainty only.

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
    if m < MINIMUM:
        raise NotIdentifiableError(f"{m} strobes cannot determine a parabola and its noise")
    span = float(np.ptp(strobes.time))
    powers = span ** -np.arange(3.0)
    scaled = np.vander(strobes.time / span, 3, increasing=True)
    weight = 1.0 / strobes.noise_factor
    q, r = np.linalg.qr(scaled * weight[:, None])
    gain: Array = powers[:, None] * np.linalg.solve(r, q.T * weight)
    coefficients = gain @ strobes.error
    residuals = strobes.error - np.vander(strobes.time, 3, increasing=True) @ coefficients
    squares = float(np.sum((residuals * weight) ** 2))
    used = math.sqrt(squares / (m - 3)) if sigma is None else sigma
    spread = gain * (used * strobes.noise_factor)
    covariance = spread @ spread.T
    if random_walk > 0.0:
        covariance += gain @ _integrated_walk(strobes.time, random_walk) @ gain.T
    return Parabola(
        coefficients=coefficients,
        covariance=covariance,
        sigma=used,
        sigma_from_residuals=sigma is None,
        dof=m - 3,
        chi2=squares / used**2 if used > 0.0 else math.nan,
        residuals=residuals,
        gain=gain,
        strobes=strobes,
    )


def _integrated_walk(time: Array, random_walk: float) -> Array:
    """Return the covariance of a twice integrated white noise, m^2, shape (m, m)."""
    earlier = np.minimum(time[:, None], time)
    later = np.maximum(time[:, None], time)
    covariance: Array = random_walk**2 * earlier**2 * (later / 2.0 - earlier / 6.0)
    return covariance
