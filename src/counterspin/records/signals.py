"""Checks of a whole signal: unit and axis by its first harmonic, and removed trends.

The amplitude of an accelerometer's signal perpendicular to the spindle axis follows from radius and
rate alone. It therefore shows a change of unit within a record, a dead channel, or a wrong unit,
sign or axis in the description. Along the spindle axis the first harmonic is that of the errors:
small, and possibly growing.

A column from which a mean, a line or a parabola was removed is orthogonal to 1, to 1 and t, or to
1, t and t^2, except for rounding. A real record is not: its noise has components along each of
them, as large as the noise of one sample. A line through the first and last rows, removed as a base
line, leaves both rows zero. All rows of a file are needed for this test.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from counterspin.arrays import MAD_TO_SIGMA, Array, median
from counterspin.frozen import frozen

#: Smallest number of samples to fit the amplitude of a revolution.
_MIN_SAMPLES = 12
#: Standard deviations by which an outlying amplitude must differ from the others.
_CHANGE_SDS = 8.0
#: Smallest fraction of samples in a revolution to separate harmonic and trend.
_MIN_REVOLUTION_FRACTION = 0.9
#: Smallest ratio of an outlying amplitude to the others.
_CHANGE_RATIO = 2.0

#: Standard deviations of an amplitude that are added to its tolerance.
_MATCH_SDS = 5.0

#: Smallest deviation of the samples in a dropout: fraction of the amplitude, plus standard
#: deviations; the joint fit uses lower limits.
_DROPOUT_FRACTION = 0.05
_DROPOUT_SDS = 50.0

#: Largest ratio of three steady amplitudes.
_STEADY_RATIO = 1.2

#: Ratios of mistaken units, and their names.
_UNIT_RATIOS = (
    (1000.0, "m and mm"),
    (100.0, "m and cm"),
    (10.0, "cm and mm"),
    (1e6, "m and um"),
    (3.28084, "m and ft"),
    (39.3701, "m and in"),
    (25.4, "mm and in"),
    (2.54, "cm and in"),
    (9.80665, "g and m/s^2"),
    (980.665, "g and Gal"),
    (9806.65, "mg and m/s^2"),
    (3.6, "m/s and km/h"),
)


@frozen
class FirstHarmonic:
    """The expected first harmonic of a signal."""

    #: Amplitude of the cosine (real) and sine (imaginary) of the angle, in `unit`; not zero.
    amplitude: complex
    unit: str  #: Unit for messages.


@frozen
class HarmonicFit:
    """A first harmonic and a slow trend, fitted to each revolution."""

    #: Coefficients of cos, sin, 1, u, u^2, (m, 5); u = (angle - `centre`) / pi.
    coefficients: np.ndarray
    #: Mean angle, rad, and standard deviation of the residuals, (m,).
    centre: np.ndarray
    residual_sd: np.ndarray
    u_amplitude: np.ndarray  #: Standard uncertainty of each part of the amplitude, (m,).
    #: First and last sample, (m,) int.
    first_sample: np.ndarray
    last_sample: np.ndarray

    @property
    def amplitude(self) -> np.ndarray:
        """Amplitudes of cosine (real) and sine (imaginary), (m,)."""
        amplitude: np.ndarray = self.coefficients[:, 0] + 1j * self.coefficients[:, 1]
        return amplitude

    def value(self, index: int, angle: np.ndarray) -> np.ndarray:
        """Evaluate the fit of revolution `index` at (n,) angles."""
        value: np.ndarray = _harmonic_basis(angle, self.centre[index]) @ self.coefficients[index]
        return value


def _harmonic_basis(angle: np.ndarray, centre: np.ndarray) -> np.ndarray:
    u = (angle - centre) / math.pi
    return np.stack([np.cos(angle), np.sin(angle), np.ones_like(u), u, u**2], axis=-1)


def fit_harmonics(angle: np.ndarray, signal: np.ndarray) -> HarmonicFit:
    """Fit a first harmonic to each revolution, or to several if samples are sparse.

    angle: Unwrapped angle, rad, (n,).
    """
    revolutions = np.abs(angle - angle[0]) / (2 * math.pi)
    samples_per_turn = len(angle) / max(float(revolutions[-1]), 1.0)
    turns_per_fit = math.ceil(2 * _MIN_SAMPLES / max(samples_per_turn, 1e-9))
    bins = (revolutions // turns_per_fit).astype(int)
    valid_indices = np.flatnonzero(np.isfinite(signal))
    bins, angles, samples = bins[valid_indices], angle[valid_indices], signal[valid_indices]
    bin_starts = np.flatnonzero(np.diff(bins, prepend=-1))
    bin_sizes = np.diff(bin_starts, append=len(bins))
    # An incomplete revolution does not separate harmonic and trend.
    min_samples = _MIN_REVOLUTION_FRACTION * median(bin_sizes) if len(bin_sizes) else 0.0
    is_complete = bin_sizes >= max(_MIN_SAMPLES, min_samples)
    bin_starts, bin_sizes = bin_starts[is_complete], bin_sizes[is_complete]
    index = bin_starts[:, None] + np.arange(bin_sizes.max(initial=0))
    is_valid = np.arange(bin_sizes.max(initial=0)) < bin_sizes[:, None]
    index = np.where(is_valid, index, bin_starts[:, None])
    angles, samples = angles[index], np.where(is_valid, samples[index], 0.0)
    centre = angles.sum(axis=1, where=is_valid) / bin_sizes
    functions = _harmonic_basis(angles, centre[:, None]) * is_valid[..., None]
    transposed_functions = np.swapaxes(functions, -1, -2)
    normal_matrix = transposed_functions @ functions + 1e-12 * np.eye(5)
    coefficients = np.linalg.solve(normal_matrix, transposed_functions @ samples[..., None])
    residuals = samples - (functions @ coefficients)[..., 0]
    residual_sd = np.sqrt((residuals**2).sum(axis=1) / np.maximum(bin_sizes - 5, 1))
    covariance = np.linalg.inv(normal_matrix)[:, :2, :2]
    u_amplitude = residual_sd * np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    first, last = valid_indices[bin_starts], valid_indices[bin_starts + bin_sizes - 1]
    return HarmonicFit(coefficients[..., 0], centre, residual_sd, u_amplitude, first, last)


def residual_noise(fit: HarmonicFit) -> float:
    """Return the noise of a signal around its harmonics, in its unit; NaN if unknown."""
    return median(fit.residual_sd) if len(fit.residual_sd) else math.nan


@frozen
class UnitChange:
    """A change of amplitude: a revolution before and one after it, and its description."""

    revolution_before: int
    revolution_after: int
    description: str


def _is_outlying_revolution(fit: HarmonicFit) -> np.ndarray:
    """Return the mask of revolutions whose amplitude differs from the typical one, (m,)."""
    amplitude = np.abs(fit.amplitude)
    if len(amplitude) < 3:
        return np.zeros(len(amplitude), dtype=bool)
    # An actual amplitude, not the mean of two: each half of the record may have another unit.
    typical_amplitude = float(np.sort(amplitude)[len(amplitude) // 2])
    min_difference = _CHANGE_SDS * median(fit.u_amplitude)
    is_outlying: np.ndarray = (amplitude > _CHANGE_RATIO * typical_amplitude) | (
        amplitude < typical_amplitude / _CHANGE_RATIO
    )
    is_outlying &= (np.abs(amplitude - typical_amplitude) > min_difference) & (
        typical_amplitude > min_difference
    )
    return is_outlying


def find_unit_change(fit: HarmonicFit, *, may_grow: bool) -> UnitChange | None:
    """Find a change of the amplitude by a factor; None without a change or a harmonic.

    fit: Harmonic fit of the signal.
    may_grow: Whether the harmonic may be that of errors, which grows with time: then only a sudden
        change between steady amplitudes is a change of unit.
    """
    is_outlying = _is_outlying_revolution(fit)
    if not is_outlying.any():
        return None
    amplitude = np.abs(fit.amplitude)
    change_index = int(np.flatnonzero(is_outlying != is_outlying[0])[0])
    if may_grow and not (
        _is_steady(amplitude[:change_index][-4:-1])
        and _is_steady(amplitude[change_index + 1 : change_index + 4])
    ):
        return None
    # The revolution of the change is a mixture: compare its neighbours.
    before, after = max(change_index - 2, 0), min(change_index + 1, len(amplitude) - 1)
    factor = float(amplitude[after] / amplitude[before]) if amplitude[before] else math.inf
    if may_grow and 1 / _CHANGE_RATIO <= factor <= _CHANGE_RATIO:
        return None
    description = "the once-per-revolution component "
    if not 1e-9 < factor < 1e9:
        return UnitChange(before, after, description + ("stops" if factor < 1.0 else "only starts"))
    description += f"changes by a factor of {factor:.4g}"
    unit_names, distance = _nearest_unit_ratio(factor)
    if distance < 0.02:
        description += f", the ratio of {unit_names}"
    return UnitChange(before, after, description)


def find_dropout(fit: HarmonicFit, angle: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """Return the indices of samples in a dropout, before and after which the harmonic is the same.

    These are all samples from the first to the last one that deviates from the harmonics of both
    neighbouring revolutions.
    """
    is_outlying = _is_outlying_revolution(fit)
    if not is_outlying.any() or is_outlying[0] or is_outlying[-1]:
        return np.empty(0, dtype=int)
    changes = np.flatnonzero(np.diff(is_outlying))
    dropouts = []
    for first, last in zip(changes[::2], changes[1::2] + 1, strict=True):
        neighbours = (max(int(first) - 1, 0), min(int(last) + 1, len(is_outlying) - 1))
        samples = np.arange(fit.first_sample[neighbours[0]], fit.last_sample[neighbours[1]] + 1)
        is_deviating = np.ones(len(samples), dtype=bool)
        for revolution in neighbours:
            limit = (
                _DROPOUT_FRACTION * abs(fit.amplitude[revolution])
                + _DROPOUT_SDS * fit.residual_sd[revolution]
            )
            is_deviating &= np.abs(signal[samples] - fit.value(revolution, angle[samples])) > limit
        if is_deviating.any():
            # In between, the harmonic may cross the value of a dead channel.
            dropouts.append(np.arange(samples[is_deviating][0], samples[is_deviating][-1] + 1))
    return np.concatenate([np.empty(0, dtype=int), *dropouts])


def _is_steady(values: np.ndarray) -> bool:
    return len(values) == 3 and float(values.max()) < _STEADY_RATIO * float(values.min())


def _nearest_unit_ratio(factor: float) -> tuple[str, float]:
    """Return the units whose ratio is nearest to a factor, and the distance of the logarithms."""
    log_factor = abs(math.log(factor))
    return min(
        ((names, abs(log_factor - math.log(ratio))) for ratio, names in _UNIT_RATIOS),
        key=lambda match: match[1],
    )


def find_changepoint(
    fit: HarmonicFit, change: UnitChange, angle: np.ndarray, signal: np.ndarray
) -> int:
    """Return the sample at which a signal, (n,), changes from the fit before to that after."""
    misfit_before = np.abs(signal - fit.value(change.revolution_before, angle))
    misfit_after = np.abs(signal - fit.value(change.revolution_after, angle))
    return int(np.argmin(np.append(0.0, np.cumsum(np.nan_to_num(misfit_before - misfit_after)))))


def check_first_harmonic(fit: HarmonicFit, nominal: FirstHarmonic, has_angle: bool) -> str | None:
    """Compare a signal's first harmonic with the expected one; return the problem, or None.

    fit: Harmonic fit of the signal, in the unit of `nominal`.
    has_angle: Whether the angle is recorded; without it, the phase is not compared.
    """
    if not len(fit.amplitude):
        return None
    expected, unit = nominal.amplitude, nominal.unit
    median_amplitude = complex(median(fit.amplitude.real), median(fit.amplitude.imag))
    ratio, magnitude = median_amplitude / expected, abs(median_amplitude / expected)
    tolerance = _MATCH_SDS * _median_amplitude_sd(fit, median_amplitude) / abs(expected)
    if (has_angle and abs(ratio - 1) < 0.5 + tolerance) or (
        not has_angle and 0.5 - tolerance < magnitude < 2 + tolerance
    ):
        return None
    message = (
        f"has an amplitude of {magnitude * abs(expected):.4g} {unit} at the rotation rate, but "
        f"{abs(expected):.4g} {unit} is expected from the radius and the input axis"
    )
    if 0.5 < magnitude < 2:
        angle_degrees = math.degrees(math.atan2(ratio.imag, ratio.real))
        return (
            f"is rotated by {angle_degrees:.0f} degrees relative to the input axis: check the "
            "input axis, its sign, and the assignment of the columns"
        )
    unit_names, distance = _nearest_unit_ratio(magnitude) if magnitude > 0.0 else ("", math.inf)
    # The time determines the amplitude of a velocity or a specific force.
    time_units = "" if unit == "m" else ", the unit of the time, the sampling rate"
    if unit == "m/s^2":
        unit_names = {"m and mm": "g and mg", "m and um": "g and ug"}.get(unit_names, unit_names)
    if distance < 0.05:
        return (
            f"{message}; the factor {magnitude:.4g} is the ratio of {unit_names}: check the unit "
            f"of the column{time_units.replace(', the sampling', ' and the sampling')}"
        )
    return f"{message}: check the unit of the column{time_units}, the radius and the input axis"


def _median_amplitude_sd(fit: HarmonicFit, median_amplitude: complex) -> float:
    """Return the standard deviation of the median amplitude, from the scatter of revolutions."""
    n_revolutions = len(fit.amplitude)
    between_sd = MAD_TO_SIGMA * median(np.abs(fit.amplitude - median_amplitude))
    samples = np.maximum(fit.last_sample - fit.first_sample + 1, 1)
    within_sd = median(fit.residual_sd * np.sqrt(2.0 / samples))
    return math.hypot(between_sd, within_sd) * math.sqrt(0.5 * math.pi / n_revolutions)


# Removed trends --------------------------------------------------------------------------------

#: Removed trends, by the number of terms of 1, t and t^2.
TREND_LABELS: Final = ("", "mean", "line", "parabola")

#: Largest probability by chance of a removed trend.
_SIGNIFICANCE: Final = 1e-6

#: Largest coefficient of a removed term, caused by rounding, relative to the noise.
_MAX_ROUNDING: Final = 0.02

#: Largest value of an end row after removal of a line, relative to the neighbouring rows.
_MAX_ROW_ROUNDING: Final = 1e-3


class SignalSums:
    """Sums and end rows of signals that are read in chunks.

    n_signals: Number of signals.
    """

    def __init__(self, n_signals: int) -> None:
        self._counts, self._sums = np.zeros(n_signals), np.zeros(n_signals)
        self._first_rows: list[list[float]] = [[] for _ in range(n_signals)]
        self._last_rows: list[list[float]] = [[] for _ in range(n_signals)]

    def add(self, signals: Sequence[Array]) -> None:
        """Add the rows of a chunk, shape (n,) for each signal."""
        for index, signal in enumerate(signals):
            rows, total = signal, signal.sum()
            if not np.isfinite(total):
                rows = signal[np.isfinite(signal)]
                total = rows.sum()
            self._sums[index] += total
            self._counts[index] += len(rows)
            first, last_rows = self._first_rows[index], self._last_rows[index]
            first += rows[: 2 - len(first)].tolist()
            self._last_rows[index] = [*last_rows, *rows[-2:].tolist()][-2:]

    def coefficients(
        self, index: int, noise: float, chunks: Iterable[tuple[Array, Array]]
    ) -> Array:
        """Return a signal's coefficients along 1, t and t^2, and the size of its ends, shape (4,).

        More than the mean can only be removed with the mean: otherwise the coefficients along t and
        t^2 are infinite, and the file is not read again.

        noise: Standard deviation of a row, in the unit of the signal.
        chunks: Times and values of all rows, read again on demand.
        """
        mean_coefficient = float(self._sums[index] / math.sqrt(max(self._counts[index], 1.0)))
        is_mean_removed = abs(mean_coefficient) < _MAX_ROUNDING * abs(noise)
        coefficients = (
            polynomial_coefficients(chunks)
            if is_mean_removed
            else [mean_coefficient, math.inf, math.inf]
        )
        return np.append(coefficients, self.end_size(index))

    def end_size(self, index: int) -> float:
        """Return the larger magnitude of a signal's first and last rows, in its unit.

        Infinite if they are not much smaller than the neighbouring rows.
        """
        first, *second = self._first_rows[index] or [0.0]
        *previous_rows, last = self._last_rows[index] or [0.0]
        magnitude = max(abs(first), abs(last))
        min_neighbour = min((abs(row) for row in (*second, *previous_rows)), default=0.0)
        return magnitude if magnitude < _MAX_ROW_ROUNDING * min_neighbour else math.inf


def polynomial_coefficients(chunks: Iterable[tuple[Array, Array]]) -> Array:
    """Return a signal's coefficients along orthonormal polynomials of 1, t and t^2, shape (3,).

    They are in the signal's unit; for noise alone, each is as large as the noise of one row.

    chunks: Times in any unit and values of consecutive rows, shapes (n,).
    """
    origin, gram, moments = math.nan, np.zeros((3, 3)), np.zeros(3)
    for time, signal in chunks:
        is_finite = np.isfinite(time) & np.isfinite(signal)
        if not is_finite.any():
            continue
        if math.isnan(origin):
            origin = float(time[is_finite][0])
        powers = np.vander(time[is_finite] - origin, 3, increasing=True)
        gram += powers.T @ powers
        moments += signal[is_finite] @ powers
    diagonal = np.diagonal(gram)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    try:
        cholesky_factor = np.linalg.cholesky(gram * np.outer(scale, scale))
    except np.linalg.LinAlgError:  # fewer than three times
        return np.full(3, math.inf)
    return np.asarray(np.linalg.solve(cholesky_factor, moments * scale))


def detrending_order(coefficients: Sequence[Array]) -> int:
    """Return the number of terms of 1, t, t^2 that a recorder removed from its records.

    A line through the ends counts like a least-squares line, but one record does not show it: a
    recorder that starts at zero may end at zero by chance.

    For noise alone, the probability of a wrong result is 1e-6; errors along these terms reduce it.

    coefficients: Of each record, as in `SignalSums.coefficients`, divided by the noise of one row,
        shape (4,).
    """
    magnitudes = np.abs(np.array(coefficients).reshape(-1, 4))
    if len(magnitudes) > 1 and float(magnitudes[:, 3].max()) < _MAX_ROUNDING:
        return 2
    for count in (3, 2, 1) if np.isfinite(magnitudes[:, :3]).all() else ():
        max_magnitude = float(magnitudes[:, :count].max(initial=0.0))
        probability = math.erf(max_magnitude / math.sqrt(2.0)) ** (count * len(magnitudes))
        if max_magnitude < _MAX_ROUNDING and probability < _SIGNIFICANCE:
            return count
    return 0
