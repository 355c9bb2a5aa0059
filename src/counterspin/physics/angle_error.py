"""Error of a spindle angle that was identified from a recorded angle.

The true angle is the identified one plus a sum of coefficient x function: a constant, a slope and a
bend (the first three Legendre polynomials over the record) and cosine
and sine of harmonics of the revolution. The encoder's noise leaves the coefficients uncertain.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen

#: What the three polynomials stand for.
POLYNOMIAL_NAMES: Final = ("angle", "rate", "drift")

#: Harmonics that count as uncertain even if the recorded angle does not show them. A ripple of
#: harmonic n adds harmonics n - 1 and n + 1 to the specific force, and its products have none
#: above the third.
N_UNCERTAIN_HARMONICS: Final = 4

#: Default standard uncertainty of each quadrature of a harmonic that the samples of a revolution do
#: not resolve, rad: 1 arcsec, that of an encoder's harmonics.
UNRESOLVED_SD: Final = math.radians(1.0 / 3600.0)


@frozen
class AngleError:
    """Deviation of the true angle from an identified one.

    Coefficients, m of them: mean angle (rad), mean rate (rad/s), drift (1/s), and for each harmonic
    n the amplitudes n w0 a_n and n w0 b_n of the rate's ripple (rad/s), where the angle has
    a_n cos(n w0 t) + b_n sin(n w0 t).
    """

    rate: float  #: w0, rad/s.
    #: Time of the first angle and the time from there to the last, s.
    start: float
    span: float
    harmonics: tuple[int, ...]  #: The numbers n.
    #: Best estimate of the coefficients, shape (m,): not zero where the identified spindle leaves
    #: out a harmonic that the angle does not clearly show.
    deviation: Array
    root: Array  #: Lower triangular, shape (m, m); root @ root.T is the covariance.

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients: angle, rate, drift, ripple1 twice, ripple2 twice, ..."""
        return POLYNOMIAL_NAMES + tuple(f"ripple{n}" for n in self.harmonics for _ in range(2))

    @property
    def u(self) -> dict[str, float]:
        """Standard uncertainty by name; of a ripple, that of one quadrature (their mean square)."""
        variances: dict[str, list[float]] = {}
        for name, row in zip(self.names, self.root, strict=True):
            variances.setdefault(name, []).append(float(row @ row))
        return {name: math.sqrt(sum(v) / len(v)) for name, v in variances.items()}

    @property
    def standardised(self) -> Array:
        """The best estimate in units of `root`, shape (m,); zero where nothing is uncertain."""
        if not np.diagonal(self.root).all():
            return np.zeros(self.deviation.size)
        return np.asarray(np.linalg.solve(self.root, self.deviation))

    @property
    def max_values(self) -> Array:
        """Largest size of each function within the record, rad per unit, shape (m,)."""
        polynomials = [1.0, self.span / 2.0, abs(self.rate) * self.span**2 / 12.0]
        waves = [1.0 / abs(n * self.rate) for n in self.harmonics for _ in range(2)]
        return np.array(polynomials + waves)

    def functions(self, t: Array) -> tuple[Array, Array, Array]:
        """Return each function's value, first and second time derivative, shapes (n, m)."""
        x_rate = 2.0 / self.span
        x = x_rate * (t - self.start) - 1.0
        ones, zeros = np.ones_like(x), np.zeros_like(x)
        # d(angle) per rad, per rad/s and per 1/s.
        drift_scale = self.rate / (3.0 * x_rate**2)
        columns = [
            (ones, zeros, zeros),
            (x / x_rate, ones, zeros),
            (
                drift_scale * 0.5 * (3.0 * x**2 - 1.0),
                drift_scale * 3.0 * x_rate * x,
                self.rate * ones,
            ),
        ]
        for n in self.harmonics:
            n_w0 = n * self.rate
            cos, sin = np.cos(n_w0 * t), np.sin(n_w0 * t)
            frequency = abs(n_w0)
            columns.append((cos / frequency, -n_w0 * sin / frequency, -frequency * cos))
            columns.append((sin / frequency, n_w0 * cos / frequency, -frequency * sin))
        value, first_derivative, second_derivative = (
            np.stack(derivatives, -1) for derivatives in zip(*columns, strict=True)
        )
        return value, first_derivative, second_derivative


def convert_polynomials(monomials: Array, rate: float, start: float, span: float) -> Array:
    """Convert coefficients of 1, t/span, (t/span)^2 to those of `POLYNOMIAL_NAMES`, (3, k) each."""
    scaled_start = start / span
    shift = np.array(
        [[1.0, scaled_start, scaled_start**2], [0.0, 1.0, 2.0 * scaled_start], [0.0, 0.0, 1.0]]
    )
    # 1, s and s^2 in Legendre polynomials of 2 s - 1.
    legendre = np.array([[1.0, 0.5, 1.0 / 3.0], [0.0, 0.5, 0.5], [0.0, 0.0, 1.0 / 6.0]])
    slope = 2.0 / span
    scale = np.array([1.0, slope, 3.0 * slope**2 / rate])
    rows: Array = scale[:, None] * (legendre @ shift @ monomials)
    return rows


def angle_sensitivity(
    error_functions: tuple[Array, Array, Array],
    angle: Array,
    rate: Array,
    acceleration: Array,
    order: int,
) -> Array:
    """Return the change of position, velocity or acceleration by changes of the angle.

    With outward and forward unit vectors e_r and e_t, e_t' = -w e_r and e_r' = w e_t, the position
    R e_r changes by R q e_t, and its time derivatives by

    R (q' e_t - q w e_r) and R [(q'' - w^2 q) e_t - (2 w q' + w' q) e_r],

    q being the change of the angle, w and w' the rate and its derivative.

    error_functions: q, q', q'', shapes (n, m).
    angle, rate, acceleration: Of the spindle, shape (n,).
    order: 0 for the acceleration, 1 for the velocity, 2 for the position.
    Returns: east and north components over the radius, shape (n, m, 2).
    """
    q, q_dot, q_ddot = error_functions
    cos, sin = np.cos(angle), np.sin(angle)
    outward, forward = np.stack([cos, sin], -1), np.stack([-sin, cos], -1)
    w = rate[:, None]
    if order == 2:
        tangential, radial = q, np.zeros_like(q)
    elif order == 1:
        tangential, radial = q_dot, -w * q
    else:
        tangential = q_ddot - w**2 * q
        radial = -2.0 * w * q_dot - acceleration[:, None] * q
    change: Array = tangential[..., None] * forward[:, None] + radial[..., None] * outward[:, None]
    return change
