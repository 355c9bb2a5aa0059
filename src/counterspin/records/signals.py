"""Checks of a whole signal: unit and axis by its first harmonic, and removed polynomials.

The amplitude of the signal of an accelerometer that lies across the spindle axis follows from the
radius and the rate alone, so a change of unit in the middle of a record, a dead channel, or a
wrong unit, sign or axis in the campaign description shows in it at once, long before a fit would
misreport it. Along the spindle axis the wave is that of the errors: small, and free to grow.

The rows of a column of which a mean, a line or a parabola was taken are orthogonal to 1, to 1 and
t, or to 1, t and t^2, but for the last digit with which it was written. No real record is: its
noise alone leaves parts along each of them, as large as that of any single sample. A line through
the first row and the last, which some take for a base line, leaves both of them zero in every
record. Only all rows of a file show it, those too that are not used.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from counterspin.arrays import MAD_TO_SIGMA, Array, median
from counterspin.frozen import frozen

#: Fewest samples from which one revolution's amplitude is taken.
_MIN_SAMPLES = 12
#: Standard deviations of an amplitude by which it must differ from the others to be refused.
_CHANGE_SDS = 8.0
#: A revolution that lacks more than the rest of its samples tells wave and trend badly apart.
_MIN_REVOLUTION_FRACTION = 0.9
#: An amplitude that differs from the others by this factor or more is refused.
_CHANGE_RATIO = 2.0

#: Standard deviations of a noisy wave by which it may miss the motion's beside that.
_DEVIATIONS = 5.0

#: Part of a wave's amplitude, and standard deviations beside it, by which the samples of a channel
#: that is dead for a while are off its wave; the joint fit judges finer.
_DROPOUT_FRACTION = 0.05
_DROPOUT_SDS = 50.0

#: Amplitudes of three revolutions differ by less than this factor where they are steady.
_STEADY_RATIO = 1.2

#: Ratios that come of a mistaken unit, and the units' names.
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
    """The wave of one period a revolution that the motion makes."""

    #: Of the cosine of the angle, and of its sine as the imaginary part, in `unit`; not zero.
    amplitude: complex
    unit: str  #: For messages.


@frozen
class HarmonicFit:
    """A wave and a slow trend, fitted to each revolution."""

    #: (m, 5) of cos, sin, 1, u, u^2, where u is the angle from `centre` over pi.
    coefficients: np.ndarray
    #: (m,) rad, mean angle; standard deviation of the residuals.
    centre: np.ndarray
    deviation: np.ndarray
    u_amplitude: np.ndarray  #: (m,), of either part of the amplitude.
    #: (m,) int, the first and last sample.
    first: np.ndarray
    last: np.ndarray

    @property
    def amplitude(self) -> np.ndarray:
        """Return (m,) complex: of the cosine of the angle, and of its sine."""
        amplitude: np.ndarray = self.coefficients[:, 0] + 1j * self.coefficients[:, 1]
        return amplitude

    def value(self, index: int, angle: np.ndarray) -> np.ndarray:
        """Return the wave and trend of revolution `index` at (n,) angles."""
        value: np.ndarray = _harmonic_basis(angle, self.centre[index]) @ self.coefficients[index]
        return value


def _harmonic_basis(angle: np.ndarray, centre: np.ndarray) -> np.ndarray:
    u = (angle - centre) / math.pi
    return np.stack([np.cos(angle), np.sin(angle), np.ones_like(u), u, u**2], axis=-1)


def fit_harmonics(angle: np.ndarray, signal: np.ndarray) -> HarmonicFit:
    """Fit a wave to each revolution (or to a few, where samples are sparse).

    angle: (n,) rad, unwrapped.
    """
    revolutions = np.abs(angle - angle[0]) / (2 * math.pi)
    samples_per_turn = len(angle) / max(float(revolutions[-1]), 1.0)
    turns_per_fit = math.ceil(2 * _MIN_SAMPLES / max(samples_per_turn, 1e-9))
    bins = (revolutions // turns_per_fit).astype(int)
    order = np.flatnonzero(np.isfinite(signal))
    bins, th, s = bins[order], angle[order], signal[order]
    edges = np.flatnonzero(np.diff(bins, prepend=-1))
    bin_sizes = np.diff(edges, append=len(bins))
    # An incomplete revolution tells the wave badly from the trend.
    min_samples = _MIN_REVOLUTION_FRACTION * median(bin_sizes) if len(bin_sizes) else 0.0
    enough = bin_sizes >= max(_MIN_SAMPLES, min_samples)
    edges, bin_sizes = edges[enough], bin_sizes[enough]
    index = edges[:, None] + np.arange(bin_sizes.max(initial=0))
    valid = np.arange(bin_sizes.max(initial=0)) < bin_sizes[:, None]
    index = np.where(valid, index, edges[:, None])
    th, s = th[index], np.where(valid, s[index], 0.0)
    centre = th.sum(axis=1, where=valid) / bin_sizes
    functions = _harmonic_basis(th, centre[:, None]) * valid[..., None]
    transposed_functions = np.swapaxes(functions, -1, -2)
    normal = transposed_functions @ functions + 1e-12 * np.eye(5)
    coefficients = np.linalg.solve(normal, transposed_functions @ s[..., None])
    residuals = s - (functions @ coefficients)[..., 0]
    deviation = np.sqrt((residuals**2).sum(axis=1) / np.maximum(bin_sizes - 5, 1))
    spread = np.linalg.inv(normal)[:, :2, :2]
    u_amplitude = deviation * np.sqrt(np.trace(spread, axis1=1, axis2=2) / 2)
    first, last = order[edges], order[edges + bin_sizes - 1]
    return HarmonicFit(coefficients[..., 0], centre, deviation, u_amplitude, first, last)


def residual_noise(harmonic_fit: HarmonicFit) -> float:
    """Return the noise of a signal around its harmonics, in its unit; NaN if unknown."""
    return median(harmonic_fit.deviation) if len(harmonic_fit.deviation) else math.nan


@frozen
class UnitChange:
    """A change of amplitude: a revolution before it and one after it, and its description."""

    before: int
    after: int
    description: str


def _outlying_revolutions(harmonic_fit: HarmonicFit) -> np.ndarray:
    """Return (m,) bool: revolutions whose amplitude is another than the usual one by a factor."""
    amplitude = np.abs(harmonic_fit.amplitude)
    if len(amplitude) < 3:
        return np.zeros(len(amplitude), dtype=bool)
    # One of the amplitudes, not the middle of two: half the record may be in either unit.
    typical = float(np.sort(amplitude)[len(amplitude) // 2])
    clear_size = _CHANGE_SDS * median(harmonic_fit.u_amplitude)
    is_outlying: np.ndarray = (amplitude > _CHANGE_RATIO * typical) | (
        amplitude < typical / _CHANGE_RATIO
    )
    is_outlying &= (np.abs(amplitude - typical) > clear_size) & (typical > clear_size)
    return is_outlying


def find_unit_change(harmonic_fit: HarmonicFit, *, may_grow: bool) -> UnitChange | None:
    """Find where the amplitude of a signal's wave changes by a factor.

    None where all is well, or where the signal has no wave to judge by.

    harmonic_fit: The signal's waves.
    may_grow: Whether the wave may be that of errors, which grows with time: only a sudden change
        between steady amplitudes is one of the unit then.
    """
    outlying = _outlying_revolutions(harmonic_fit)
    if not outlying.any():
        return None
    amplitude = np.abs(harmonic_fit.amplitude)
    revolution = int(np.flatnonzero(outlying != outlying[0])[0])
    if may_grow and not (
        _is_steady(amplitude[:revolution][-4:-1])
        and _is_steady(amplitude[revolution + 1 : revolution + 4])
    ):
        return None
    # The revolution in which the unit changes is a mixture of both: take those beside it.
    before, after = max(revolution - 2, 0), min(revolution + 1, len(amplitude) - 1)
    factor = float(amplitude[after] / amplitude[before]) if amplitude[before] else math.inf
    if may_grow and 1 / _CHANGE_RATIO <= factor <= _CHANGE_RATIO:
        return None
    description = "the once-per-revolution component "
    if not 1e-9 < factor < 1e9:
        return UnitChange(before, after, description + ("stops" if factor < 1.0 else "only starts"))
    description += f"changes by a factor of {factor:.4g}"
    nearest, distance = _nearest_unit_ratio(factor)
    if distance < 0.02:
        description += f", the ratio of {nearest}"
    return UnitChange(before, after, description)


def find_dropout(harmonic_fit: HarmonicFit, angle: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """Return the indices of lost samples: off the harmonic, which is the same before and after.

    A channel that is dead for a while, a filler or a burst: all from the first to the last sample
    that is off the waves of both the revolution before and the one after.
    """
    outlying = _outlying_revolutions(harmonic_fit)
    if not outlying.any() or outlying[0] or outlying[-1]:
        return np.empty(0, dtype=int)
    edges = np.flatnonzero(np.diff(outlying))
    dropouts = []
    for first, last in zip(edges[::2], edges[1::2] + 1, strict=True):
        neighbours = (max(int(first) - 1, 0), min(int(last) + 1, len(outlying) - 1))
        samples = np.arange(harmonic_fit.first[neighbours[0]], harmonic_fit.last[neighbours[1]] + 1)
        deviation = np.ones(len(samples), dtype=bool)
        for revolution in neighbours:
            limit = (
                _DROPOUT_FRACTION * abs(harmonic_fit.amplitude[revolution])
                + _DROPOUT_SDS * harmonic_fit.deviation[revolution]
            )
            deviation &= (
                np.abs(signal[samples] - harmonic_fit.value(revolution, angle[samples])) > limit
            )
        if deviation.any():
            # Between them the wave crosses what a dead channel shows.
            dropouts.append(np.arange(samples[deviation][0], samples[deviation][-1] + 1))
    return np.concatenate([np.empty(0, dtype=int), *dropouts])


def _is_steady(values: np.ndarray) -> bool:
    return len(values) == 3 and float(values.max()) < _STEADY_RATIO * float(values.min())


def _nearest_unit_ratio(factor: float) -> tuple[str, float]:
    """Return the units whose ratio comes nearest to a factor, and how near (logarithm)."""
    log_factor = abs(math.log(factor))
    return min(
        ((names, abs(log_factor - math.log(r))) for r, names in _UNIT_RATIOS), key=lambda n: n[1]
    )


def find_changepoint(
    harmonic_fit: HarmonicFit, change: UnitChange, angle: np.ndarray, signal: np.ndarray
) -> int:
    """Return the sample, of (n,) signal, at which it leaves the wave before for the one after."""
    before = np.abs(signal - harmonic_fit.value(change.before, angle))
    after = np.abs(signal - harmonic_fit.value(change.after, angle))
    return int(np.argmin(np.append(0.0, np.cumsum(np.nan_to_num(before - after)))))


def check_first_harmonic(
    harmonic_fit: HarmonicFit, nominal: FirstHarmonic, has_angle: bool
) -> str | None:
    """Compare a signal's wave with the motion's; say what is wrong, or return None.

    harmonic_fit: The signal's waves, in the unit of `nominal`.
    has_angle: Whether the waves are over the recorded angle; else their phase means nothing.
    """
    if not len(harmonic_fit.amplitude):
        return None
    expected, unit = nominal.amplitude, nominal.unit
    mean = complex(median(harmonic_fit.amplitude.real), median(harmonic_fit.amplitude.imag))
    ratio, magnitude = mean / expected, abs(mean / expected)
    tolerance = _DEVIATIONS * _sd_of_median(harmonic_fit, mean) / abs(expected)
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
    nearest, distance = _nearest_unit_ratio(magnitude) if magnitude > 0.0 else ("", math.inf)
    if distance < 0.05:
        return (
            f"{message}; the factor {magnitude:.4g} is the ratio of {nearest}: check the unit of "
            "the column"
        )
    return f"{message}: check the unit of the column, the radius and the input axis"


def _sd_of_median(harmonic_fit: HarmonicFit, mean: complex) -> float:
    """Return the standard deviation of the median wave, from what the revolutions differ by."""
    revolution_count = len(harmonic_fit.amplitude)
    between_sd = MAD_TO_SIGMA * median(np.abs(harmonic_fit.amplitude - mean))
    samples = np.maximum(harmonic_fit.last - harmonic_fit.first + 1, 1)
    within_sd = median(harmonic_fit.deviation * np.sqrt(2.0 / samples))
    return math.hypot(between_sd, within_sd) * math.sqrt(0.5 * math.pi / revolution_count)


# What a recorder removed -----------------------------------------------------------------------

#: What may be removed, by how many of 1, t and t^2 it is.
WORDS: Final = ("", "mean", "line", "parabola")

#: Probability by chance below which something was removed.
_SIGNIFICANCE: Final = 1e-6

#: What rounding leaves of a part, over the noise, is less than this.
_ROUNDING: Final = 0.02

#: And of a row, over the rows beside it; where these are as small they are all rounded to zero.
_ROW_ROUNDING: Final = 1e-3


class SignalSums:
    """Sums and end rows of signals that are read in chunks.

    signals: Number of signals.
    """

    def __init__(self, signals: int) -> None:
        self._count, self._total = np.zeros(signals), np.zeros(signals)
        self._first: list[list[float]] = [[] for _ in range(signals)]
        self._final: list[list[float]] = [[] for _ in range(signals)]

    def add(self, signals: Sequence[Array]) -> None:
        """Add rows, shapes (n,)."""
        for index, signal in enumerate(signals):
            rows, total = signal, signal.sum()
            if not np.isfinite(total):
                rows = signal[np.isfinite(signal)]
                total = rows.sum()
            self._total[index] += total
            self._count[index] += len(rows)
            first, last_rows = self._first[index], self._final[index]
            first += rows[: 2 - len(first)].tolist()
            self._final[index] = [*last_rows, *rows[-2:].tolist()][-2:]

    def coefficients(
        self, index: int, noise: float, chunks: Iterable[tuple[Array, Array]]
    ) -> Array:
        """Return a signal's coefficients along 1, t and t^2, and the size of its ends, shape (4,).

        Only where the mean was removed can more have been removed: otherwise the coefficients along
        t and t^2 are infinite, and nothing is read again.

        noise: Standard deviation of a row, in the unit of the signal.
        chunks: Times and values of all rows, read again on demand.
        """
        mean = float(self._total[index] / math.sqrt(max(self._count[index], 1.0)))
        mean_removed = abs(mean) < _ROUNDING * abs(noise)
        moments = polynomial_coefficients(chunks) if mean_removed else [mean, math.inf, math.inf]
        return np.append(moments, self.end_size(index))

    def end_size(self, index: int) -> float:
        """Return the larger of a signal's first and last row, in its unit.

        Infinite if they are not far below the rows beside them.
        """
        (first, *second), (*before, last) = self._first[index] or [0.0], self._final[index] or [0.0]
        magnitude = max(abs(first), abs(last))
        next_size = min((abs(row) for row in (*second, *before)), default=0.0)
        return magnitude if magnitude < _ROW_ROUNDING * next_size else math.inf


def polynomial_coefficients(chunks: Iterable[tuple[Array, Array]]) -> Array:
    """Return a signal's parts along the polynomials 1, t and t^2 made orthonormal, shape (3,).

    In the signal's unit; each is as large as the noise of one row where that is all there is.

    chunks: Times in any unit and values of consecutive rows, shapes (n,).
    """
    origin, gram, sums = math.nan, np.zeros((3, 3)), np.zeros(3)
    for time, signal in chunks:
        is_finite = np.isfinite(time) & np.isfinite(signal)
        if not is_finite.any():
            continue
        if math.isnan(origin):
            origin = float(time[is_finite][0])
        powers = np.vander(time[is_finite] - origin, 3, increasing=True)
        gram += powers.T @ powers
        sums += signal[is_finite] @ powers
    squares = np.diagonal(gram)
    scale = 1.0 / np.sqrt(np.where(squares > 0.0, squares, 1.0))
    try:
        root = np.linalg.cholesky(gram * np.outer(scale, scale))
    except np.linalg.LinAlgError:  # fewer than three times
        return np.full(3, math.inf)
    return np.asarray(np.linalg.solve(root, sums * scale))


def detrending_order(moments: Sequence[Array]) -> int:
    """Return the number of terms of 1, t, t^2 that one recorder removed from its records.

    A line through the ends counts as one of least squares. One record does not show it: a recorder
    that begins at zero may come back to its last digit of it by chance.

    By chance, where noise is all that there is, the answer is wrong once in a million times; any
    part of an error along them makes it rarer.

    moments: Of each record as in `SignalSums.coefficients`, over the noise of one row, shape (4,).
    """
    moment_sizes = np.abs(np.array(moments).reshape(-1, 4))
    if len(moment_sizes) > 1 and float(moment_sizes[:, 3].max()) < _ROUNDING:
        return 2
    for count in (3, 2, 1) if np.isfinite(moment_sizes[:, :3]).all() else ():
        largest = float(moment_sizes[:, :count].max(initial=0.0))
        chance = math.erf(largest / math.sqrt(2.0)) ** (count * len(moment_sizes))
        if largest < _ROUNDING and chance < _SIGNIFICANCE:
            return count
    return 0
