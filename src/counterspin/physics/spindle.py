"""The centrifuge's spindle: its angle model and the model's identification (Eq. 1-4).

The paper's Eq. 1 with any number of ripple harmonics:
rate(t) = w0 (1 + C t) + sum_n w_n sin(n w0 t + phi_n).
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from counterspin.arrays import Array, median, qr_blocks, triangular_factor, triangular_root
from counterspin.errors import ConvergenceError, NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.physics.angle_error import (
    N_UNCERTAIN_HARMONICS,
    POLYNOMIAL_NAMES,
    UNRESOLVED_SD,
    AngleError,
    convert_polynomials,
)

TURN: Final = 2.0 * math.pi  #: rad

#: Rows whose functions of the angle's error are in memory at once.
_CHUNK_ROWS: Final = 65536

MAX_HARMONICS: Final = 8  #: highest ripple harmonic that `fit_spindle` tries by itself

#: Fits by which the noise of the angle, and so the weight of the default priors, converges.
_PRIOR_ITERATIONS: Final = 4


@frozen
class Ripple:
    """One periodic fluctuation of the angular rate, w_n sin(n w0 t + phi_n).

    Attributes
    ----------
    harmonic
        The number n of fluctuations a revolution.
    amplitude
        w_n, rad/s.
    phase
        phi_n at t = 0, rad.
    """

    harmonic: int
    amplitude: float
    phase: float


@frozen
class Spindle:
    """The spindle's motion, Eq. 1-4 with any number of harmonics.

    Attributes
    ----------
    rate
        w0, rad/s; negative for the sense from east towards south.
    drift
        C, relative drift of the rate, 1/s.
    ripples
        Periodic fluctuations of the rate.
    start_angle
        Angle at t = 0, from east towards north, rad.

    Examples
    --------
    A turn in two seconds, at a rate that grows by a millionth a second:

    >>> import math
    >>> import numpy as np
    >>> import counterspin as cs
    >>> spindle = cs.Spindle(math.pi, drift=1e-6)
    >>> turns = spindle.angle(np.array([2.0, 20.0])) / (2.0 * math.pi)
    >>> print(turns.round(6))
    [ 1.000001 10.0001  ]
    """

    rate: float
    drift: float = 0.0
    ripples: tuple[Ripple, ...] = ()
    start_angle: float = 0.0

    def angle(self, t: Array) -> Array:
        """Return the angle (Eq. 2) in rad; same shape as `t` in s."""
        w0 = self.rate
        theta = self.start_angle + w0 * t * (1.0 + 0.5 * self.drift * t)
        for ripple in self.ripples:
            n_w0 = ripple.harmonic * w0
            theta = theta - ripple.amplitude / n_w0 * (
                np.cos(n_w0 * t + ripple.phase) - math.cos(ripple.phase)
            )
        return theta

    def angular_rate(self, t: Array) -> Array:
        """Return the angular rate (Eq. 3) in rad/s; same shape as `t` in s."""
        rate = self.rate * (1.0 + self.drift * t)
        for ripple in self.ripples:
            rate = rate + ripple.amplitude * np.sin(ripple.harmonic * self.rate * t + ripple.phase)
        return rate

    def angular_acceleration(self, t: Array) -> Array:
        """Return the angular acceleration (Eq. 4) in rad/s^2; same shape as `t` in s."""
        alpha = np.full_like(t, self.drift * self.rate)
        for ripple in self.ripples:
            n_w0 = ripple.harmonic * self.rate
            alpha = alpha + ripple.amplitude * n_w0 * np.cos(n_w0 * t + ripple.phase)
        return alpha

    def angular_jerk(self, t: Array) -> Array:
        """Return the derivative of the angular acceleration in rad/s^3; same shape as `t` in s."""
        jerk = np.zeros_like(t)
        for ripple in self.ripples:
            n_w0 = ripple.harmonic * self.rate
            jerk = jerk - ripple.amplitude * n_w0**2 * np.sin(n_w0 * t + ripple.phase)
        return jerk

    def time_at(self, angle: Array) -> Array:
        """Return the times in s at which the spindle passes the given angles in rad.

        Newton's iteration from the uniform rotation; the rate must not change sign.

        Raises
        ------
        ConvergenceError
            If the iteration does not settle, as it does not when ripple stops the spindle.
        """
        t = (np.asarray(angle, dtype=float) - self.start_angle) / self.rate
        for _ in range(50):
            step = (self.angle(t) - angle) / self.angular_rate(t)
            t = t - step
            if np.all(np.abs(step) <= 4e-16 * (1.0 + np.abs(t))):
                break
        # Roundoff of a large angle keeps the last steps above an ulp, which is accepted too.
        if not np.all(np.abs(self.angle(t) - angle) <= 1e-12 * (1.0 + np.abs(angle))):
            raise ConvergenceError(
                "the spindle angle cannot be inverted, because the rate changes sign or drifts "
                "too much"
            )
        return t

    def later(self, delay: float) -> Spindle:
        """Return the same rotation with its time zero later by a delay in s.

        The harmonics keep their angular frequency, except for the drift over the delay.
        """
        angle_change = self.rate * delay
        rate = self.rate * (1.0 + self.drift * delay)
        return replace(
            self,
            rate=rate,
            drift=self.drift * self.rate / rate,
            ripples=tuple(
                replace(ripple, phase=ripple.phase + ripple.harmonic * angle_change)
                for ripple in self.ripples
            ),
            start_angle=float(self.angle(np.array([delay]))[0]),
        )

    def add_angle(self, error: AngleError, coefficients: Array) -> Spindle:
        """Return the rotation whose angle is larger by coefficients of an error's functions.

        Changes are exact, except that the harmonics follow the changed rate.

        coefficients: Shape (m,), in the units of `AngleError`.
        """
        values, rates, _ = (derivative[0] for derivative in error.functions(np.zeros(1)))
        n_polynomials = len(POLYNOMIAL_NAMES)
        start_rate = self.rate + float(rates[:n_polynomials] @ coefficients[:n_polynomials])
        curvature = self.rate * self.drift + error.rate * float(coefficients[2])
        waves = {r.harmonic: self._wave(r) for r in self.ripples}
        pairs = coefficients[n_polynomials:].reshape(-1, 2)
        for n, (a, b) in zip(error.harmonics, pairs, strict=True):
            waves[n] = waves.get(n, 0j) + complex(a, -b) / abs(n * error.rate)
        return Spindle(
            rate=start_rate,
            drift=curvature / start_rate,
            ripples=tuple(
                make_ripple(n, start_rate, wave) for n, wave in sorted(waves.items()) if wave
            ),
            start_angle=self.start_angle + float(values @ coefficients),
        )

    def angle_functions(self, error: AngleError, t: Array) -> tuple[Array, Array, Array]:
        """Return derivatives of angle, rate and acceleration by coefficients of an error.

        As `AngleError.functions`, shapes (n, m), but a change of the rate also changes the
        frequencies of the ripples.
        """
        value, first_derivative, second_derivative = error.functions(t)
        # Change of the rate at t = 0, which sets the frequencies of the ripples.
        rate_change = error.functions(np.zeros(1))[1][0, : len(POLYNOMIAL_NAMES)]
        for ripple in self.ripples:
            angular_frequency = 1j * ripple.harmonic * self.rate
            wave = 1j * ripple.harmonic * self._wave(ripple) * np.exp(angular_frequency * t)
            for component, slope in (
                (value, t * wave),
                (first_derivative, (1.0 + angular_frequency * t) * wave),
                (second_derivative, (2.0 + angular_frequency * t) * angular_frequency * wave),
            ):
                component[:, : len(POLYNOMIAL_NAMES)] += slope.real[:, None] * rate_change
        return value, first_derivative, second_derivative

    def _wave(self, ripple: Ripple) -> complex:
        """Return a - ib of a ripple's angle, a cos(n w0 t) + b sin(n w0 t), rad."""
        amplitude = ripple.amplitude / (ripple.harmonic * self.rate)
        return -amplitude * cmath.exp(1j * ripple.phase)

    @property
    def highest_harmonic(self) -> int:
        """The highest ripple harmonic, 0 without ripple."""
        return max((ripple.harmonic for ripple in self.ripples), default=0)


def make_ripple(harmonic: int, rate: float, wave: complex) -> Ripple:
    """Return the ripple of an angle a cos(n w0 t) + b sin(n w0 t), rad.

    The sign of w0 goes into the phase so that the amplitude stays positive.

    wave: a - ib.
    """
    n_w0 = harmonic * rate
    return Ripple(harmonic, abs(n_w0) * abs(wave), cmath.phase(-math.copysign(1.0, n_w0) * wave))


@frozen
class SpindleFit:
    """A spindle identified from a recorded angle."""

    spindle: Spindle  #: The identified model; t = 0 is the time origin of the samples given.
    #: Standard uncertainties, rad/s, 1/s, rad.
    u_rate: float
    u_drift: float
    #: (amplitude rad/s, phase rad) standard uncertainties, one pair for each ripple.
    u_ripples: tuple[tuple[float, float], ...]
    rms: float  #: Root mean square of the residual angle, rad.
    dof: int  #: Degrees of freedom of the residuals.
    residuals: Array  #: Recorded minus modelled angle, rad, shape (n,).
    #: Possible deviation of the true angle from the model, including harmonics that can affect a
    #: coefficient although the criterion does not support them.
    error: AngleError

    def rate_at(self, t: Array) -> tuple[float, float]:
        """Return the root mean square of the rate at times, with its sign, and its u, rad/s.

        t: s, shape (n,), in the time of the samples given.
        """
        rate = self.spindle.angular_rate(t)
        value = math.copysign(math.sqrt(float(np.mean(rate**2))), self.spindle.rate)
        slopes = np.zeros(self.error.deviation.size)
        for rows in (slice(start, start + _CHUNK_ROWS) for start in range(0, t.size, _CHUNK_ROWS)):
            slopes += rate[rows] @ self.error.functions(t[rows])[1]
        slopes /= t.size * value
        return value, float(np.linalg.norm(slopes @ self.error.root))


def fit_spindle(
    time: Array,
    angle: Array,
    nominal_rate: float,
    *,
    harmonics: int | None = None,
    weights: Array | None = None,
    spread: Array | None = None,
) -> SpindleFit:
    """Identify w0, C and the ripples from a recorded angle (Eq. 2).

    Linear least squares in (theta0, w0, C w0/2, a_n, b_n) with the harmonics taken at the
    current w0, iterated; the noise of the angle is estimated from the residuals. Of the first
    `MAX_HARMONICS` harmonics those are kept that an information criterion supports. Those of the
    first `N_UNCERTAIN_HARMONICS` that the samples do not resolve have a default prior.

    Parameters
    ----------
    time, angle
        Shape (n,), s and rad. The angle may be wrapped or not; if it is wrapped, neighbouring
        samples must be less than half a revolution apart.
    nominal_rate
        Start value of w0 in rad/s; its sign gives the sense.
    harmonics
        Harmonics 1 to this number; None chooses them by the criterion.
    weights
        Shape (n,), relative weights (1/variance), such as the samples in each block mean.
    spread
        Shape (n,), s: where times and angles are means over blocks of samples, the standard
        deviation of the times inside each block. A mean has less of a harmonic than its samples.

    Returns
    -------
    SpindleFit

    Raises
    ------
    NotIdentifiableError
        If there are too few samples for the unknowns, or none at angles that separate the
        harmonics.
    ConvergenceError
        If w0 does not settle.
    """
    # An angle that spans more than a turn has already been unwrapped, perhaps across gaps.
    is_wrapped = angle.size == 0 or np.ptp(angle) <= TURN * (1.0 + 1e-9)
    theta = np.unwrap(angle) if is_wrapped else angle
    root_weight = np.ones_like(time) if weights is None else np.sqrt(weights / np.mean(weights))
    samples = _FitSamples(time, theta, root_weight, spread if np.any(spread) else None)
    if harmonics is not None:
        return _fit_harmonics(samples, nominal_rate, range(1, harmonics + 1))[0]
    n_resolved = _count_resolvable_harmonics(time, nominal_rate)
    full_fit, full_coefficients = _fit_harmonics(samples, nominal_rate, range(1, n_resolved + 1))
    # The first harmonics affect coefficients even if the samples do not resolve them.
    max_harmonic = max(n_resolved, _count_harmonics(time, N_UNCERTAIN_HARMONICS))
    prior = None
    for _ in range(_PRIOR_ITERATIONS if max_harmonic > n_resolved else 0):
        prior = _UnresolvedPrior(n_resolved, full_fit.rms)
        full_fit, full_coefficients = _fit_harmonics(
            samples, nominal_rate, range(1, max_harmonic + 1), prior
        )
    significant_harmonics = [
        ripple.harmonic
        for ripple, u_ripple in zip(full_fit.spindle.ripples, full_fit.u_ripples, strict=True)
        if _is_significant(ripple, u_ripple, time.size)
    ]
    fit, selected_coefficients = _fit_harmonics(
        samples, full_fit.spindle.rate, significant_harmonics, prior
    )
    # Harmonics that the criterion omits can still exist within their noise.
    error_harmonics = sorted(
        {*significant_harmonics, *range(1, min(N_UNCERTAIN_HARMONICS, max_harmonic) + 1)}
    )
    return replace(
        fit, error=_angle_error(time, error_harmonics, full_coefficients, selected_coefficients)
    )


def forecast_angle_error(time: Array, rate: float, noise: float, weights: Array) -> AngleError:
    """Return the expected angle error of a fit before the angle is measured.

    time: Of the samples or block means, s, shape (n,).
    rate: rad/s.
    noise: Standard deviation of one sample's angle, rad.
    weights: Samples in each block, shape (n,).
    """
    harmonics = range(1, _count_harmonics(time, N_UNCERTAIN_HARMONICS) + 1)
    root_weight, scaled_time = np.sqrt(weights), time / float(np.ptp(time))
    columns = np.empty((3 + 2 * len(harmonics), time.size))
    columns[:3] = root_weight, root_weight * scaled_time, root_weight * scaled_time**2
    _fill_harmonics(rate * time, harmonics, root_weight, columns[3:])
    prior = _UnresolvedPrior(_count_resolvable_harmonics(time, rate), noise)
    triangle = triangular_factor(
        np.vstack([triangular_factor(qr_blocks(columns.T)), prior.rows(harmonics)])
    )
    factor = np.asarray(noise * np.linalg.inv(triangle), np.float64)
    coefficients = _Coefficients(rate, harmonics, np.zeros(len(columns)), factor)
    return _angle_error(time, harmonics, coefficients, coefficients)


def _count_resolvable_harmonics(time: Array, rate: float) -> int:
    """Return the largest number of harmonics that the samples of a revolution can resolve."""
    spacing = median(np.diff(time)) if time.size > 1 else 0.0
    max_harmonic = int(math.pi / abs(rate * spacing)) - 1 if spacing else 0
    return min(_count_harmonics(time, MAX_HARMONICS), max_harmonic)


def _count_harmonics(time: Array, max_count: int) -> int:
    """Return the largest number of harmonics for which a fit has enough samples."""
    return min(max_count, (time.size - 8) // 2)


def _is_significant(ripple: Ripple, u_ripple: tuple[float, float], n_samples: int) -> bool:
    """Return True if the extended Bayesian information criterion keeps a harmonic.

    Two more parameters, chosen among `MAX_HARMONICS` pairs, must gain more than
    2 ln(n) + 2 ln(MAX_HARMONICS) of chi-square (Chen and Chen, Biometrika 95 (2008) 759); for a
    harmonic, whose two coefficients are as good as uncorrelated, the gain is the square of its
    signal-to-noise ratio. Pure noise then keeps one in about 1/n of the fits.
    """
    return ripple.amplitude**2 > 2.0 * math.log(n_samples * MAX_HARMONICS) * u_ripple[0] ** 2


class _FitSamples(NamedTuple):
    """Samples of a fit, each of shape (n,): s, rad, root of the weight, s."""

    time: Array
    angle: Array
    root_weight: Array
    spread: Array | None


class _UnresolvedPrior(NamedTuple):
    """Default priors of the harmonics that the samples of a revolution do not resolve."""

    resolved: int  #: Number of harmonics that they resolve.
    noise: float  #: Standard deviation of a sample's angle, rad.

    def rows(self, harmonics: Sequence[int]) -> Array:
        """Return the rows of the priors, in units of the noise, shape (m, 3 + 2 h)."""
        unresolved_indices = [index for index, n in enumerate(harmonics) if n > self.resolved]
        rows = np.zeros((2 * len(unresolved_indices), 3 + 2 * len(harmonics)))
        for row, index in enumerate(unresolved_indices):
            rows[2 * row, 3 + 2 * index] = rows[2 * row + 1, 4 + 2 * index] = 1.0
        return rows * (self.noise / UNRESOLVED_SD)


@frozen
class _Coefficients:
    """Fitted coefficients of 1, t/span, (t/span)^2 and cos, sin of each harmonic; rad."""

    rate: float
    harmonics: Sequence[int]
    value: Array  # (m,)
    factor: Array  # (m, m), factor @ factor.T is their covariance


def _angle_error(
    time: Array, harmonics: Sequence[int], full_fit: _Coefficients, reduced_fit: _Coefficients
) -> AngleError:
    """Return the angle error of `reduced_fit`, given the coefficients of `full_fit`."""
    start, span = float(np.min(time)), float(np.ptp(time))
    rate = reduced_fit.rate
    factor_rows = [convert_polynomials(full_fit.factor[:3], rate, start, span)]
    shift = (full_fit.value[:3] - reduced_fit.value[:3])[:, None]
    deviations = [convert_polynomials(shift, rate, start, span)[:, 0]]
    for n in harmonics:
        frequency = abs(n * rate)
        index = 3 + 2 * list(full_fit.harmonics).index(n)
        quadratures = full_fit.value[index : index + 2]
        if n in reduced_fit.harmonics:
            offset = 3 + 2 * list(reduced_fit.harmonics).index(n)
            quadratures = quadratures - reduced_fit.value[offset : offset + 2]
        factor_rows.append(frequency * full_fit.factor[index : index + 2])
        deviations.append(frequency * quadratures)
    return AngleError(
        rate=rate,
        start=start,
        span=span,
        harmonics=tuple(harmonics),
        deviation=np.concatenate(deviations),
        root=triangular_root(np.concatenate(factor_rows)),
    )


def _fit_harmonics(
    samples: _FitSamples,
    start_rate: float,
    harmonics: Sequence[int],
    prior: _UnresolvedPrior | None = None,
) -> tuple[SpindleFit, _Coefficients]:
    time, theta, root_weight, time_sd = samples
    n_harmonics = len(harmonics)
    n, n_unknowns = time.size, 3 + 2 * n_harmonics
    if n <= n_unknowns:
        raise NotIdentifiableError(
            f"{n} angle samples cannot determine the rotation with {n_harmonics} harmonics "
            f"({n_unknowns} unknowns); use a longer record or request fewer harmonics"
        )
    span = float(np.ptp(time))
    scaled_time = time / span  # keeps the columns of one size
    # Residuals from the nominal rotation keep the digits that the full angle would take.
    target = theta - start_rate * time
    w0 = start_rate
    # One row for each unknown's column of the design, and the target's; all of them weighted.
    columns = np.empty((n_unknowns + 1, n))
    columns[:3] = root_weight, root_weight * scaled_time, root_weight * scaled_time**2
    if time_sd is not None:
        columns[2] += root_weight * (time_sd / span) ** 2
    columns[-1] = root_weight * target
    for _ in range(20):
        _fill_harmonics(w0 * time, harmonics, root_weight, columns[3:-1])
        if time_sd is not None:
            # As `observation.block_average`: the mean of the waves at both ends of the spread.
            for index, harmonic in enumerate(harmonics):
                columns[3 + 2 * index : 5 + 2 * index] *= np.cos(harmonic * w0 * time_sd)
        triangle = triangular_factor(qr_blocks(columns.T))
        if prior is not None:
            rows = np.pad(prior.rows(harmonics), ((0, 0), (0, 1)))
            triangle = triangular_factor(np.vstack([triangle, rows]))
        r = triangle[:n_unknowns, :n_unknowns]
        # R's columns are as long as the design's.
        column_norms = np.maximum(np.linalg.norm(r, axis=0), math.sqrt(n))
        if np.any(np.abs(np.diag(r)) < 1e-12 * column_norms):
            raise NotIdentifiableError(
                f"the angle samples do not separate {n_harmonics} harmonics: there are too few "
                "samples per revolution, or the samples repeat the same angles; request fewer "
                "harmonics"
            )
        solution = np.asarray(np.linalg.solve(r, triangle[:n_unknowns, -1]))
        previous_rate, w0 = w0, start_rate + float(solution[1]) / span
        # Converged if the harmonics change by less than 1e-9 rad over the record.
        if abs(w0 - previous_rate) * span * max(harmonics, default=0) < 1e-9:
            break
    else:
        raise ConvergenceError(
            f"the estimate of the spindle rate did not converge near {start_rate:.9g} rad/s. "
            "Check the nominal rate of the run"
        )
    residuals = columns[-1] - solution @ columns[:-1]
    dof = n - n_unknowns
    variance = float(residuals @ residuals) / dof
    inverse = np.asarray(np.linalg.inv(r))
    covariance = variance * inverse @ inverse.T
    value = solution.copy()
    value[1] = w0 * span
    coefficients = _Coefficients(w0, harmonics, value, math.sqrt(variance) * inverse)
    ripples, u_ripples = _to_ripples(w0, harmonics, solution[3:], covariance[3:, 3:])
    half_drift = float(solution[2]) / span**2
    # start_angle is theta(0); the model's own ripple vanishes at t = 0, so the cosines add here.
    start_weights = np.zeros(n_unknowns)
    start_weights[0] = 1.0
    start_weights[3::2] = 1.0
    fit = SpindleFit(
        spindle=Spindle(
            rate=w0,
            drift=2.0 * half_drift / w0,
            ripples=ripples,
            start_angle=float(start_weights @ solution),
        ),
        u_rate=math.sqrt(covariance[1, 1]) / span,
        u_drift=2.0 * math.sqrt(covariance[2, 2]) / span**2 / abs(w0),
        u_ripples=u_ripples,
        rms=math.sqrt(variance),
        dof=dof,
        residuals=residuals / root_weight,
        error=_angle_error(time, harmonics, coefficients, coefficients),
    )
    return fit, coefficients


def _fill_harmonics(angle: Array, harmonics: Sequence[int], weights: Array, rows: Array) -> None:
    """Write cosine and sine of each harmonic of an angle, times `weights`, into rows (2 h, n).

    They are powers of one phasor.
    """
    phasor = np.empty(angle.shape, dtype=complex)
    phasor.real, phasor.imag = np.cos(angle), np.sin(angle)
    phasor_power = weights.astype(complex)
    row = 0
    for harmonic in range(1, max(harmonics, default=0) + 1):
        phasor_power *= phasor
        if harmonic in harmonics:
            rows[row], rows[row + 1] = phasor_power.real, phasor_power.imag
            row += 2


def _to_ripples(
    w0: float, harmonics: Sequence[int], coefficients: Array, covariance: Array
) -> tuple[tuple[Ripple, ...], tuple[tuple[float, float], ...]]:
    """Turn a_n cos + b_n sin of the angle into amplitude and phase of the rate."""
    ripples, uncertainties = [], []
    for k, harmonic in enumerate(harmonics):
        n_w0 = harmonic * w0
        a, b = float(coefficients[2 * k]), float(coefficients[2 * k + 1])
        amplitude = math.hypot(a, b)
        ripples.append(make_ripple(harmonic, w0, complex(a, -b)))
        block = covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        if amplitude == 0.0:
            uncertainties.append((abs(n_w0) * math.sqrt(block[0, 0]), math.inf))
            continue
        amplitude_gradient = np.array([a, b]) / amplitude
        phase_gradient = np.array([-b, a]) / amplitude**2
        uncertainties.append(
            (
                abs(n_w0) * math.sqrt(float(amplitude_gradient @ block @ amplitude_gradient)),
                math.sqrt(float(phase_gradient @ block @ phase_gradient)),
            )
        )
    return tuple(ripples), tuple(uncertainties)
