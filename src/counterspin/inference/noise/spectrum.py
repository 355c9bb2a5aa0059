"""Model-free analysis of a record at rest: spectrum, spectral lines, Allan deviation.

- The spectrum is Welch's (IEEE Trans. Audio Electroacoust. 15 (1967) 70), with Hann windows that
  overlap by half, and with neighbouring frequencies averaged to a few values per decade.
- A spectral line is a maximum of the windowed transform of the whole record that exceeds the noise
  floor, the running median; its sinusoid is fitted by least squares.
- The Allan deviation is the overlapping one (W. J. Riley and D. A. Howe, Handbook of Frequency
  Stability Analysis, NIST SP 1065 (2008), section 5.2.4; IEEE Std 952, annex C, uses it for
  inertial sensors). Its second differences of velocity are stationary for all noise components.
  C. A. Greenhall and W. J. Riley (Uncertainty of stability variances based on finite differences,
  35th PTTI (2003) 267) tabulate its equivalent degrees of freedom, 2 E^2/Var, for single power
  laws. Here they are computed from the autocovariance of the estimated noise.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.noise.bias_instability import Variances
from counterspin.inference.noise.components import Sampling, sampled_densities

#: Number of values of the spectrum per decade.
_BINS_PER_DECADE: Final = 12.0

#: Number of segments of the record, without overlap, for the lowest frequencies.
_N_SEGMENTS: Final = 6

#: Ratio of the lengths of successive segments, first line that the window separates from zero, and
#: smallest number of samples of a segment.
_SEGMENT_RATIO: Final = 4
_FIRST_LINE: Final = 3
_MIN_SEGMENT_SAMPLES: Final = 64

#: Fraction of independent values in the spectrum of a Hann window.
_INDEPENDENT_FRACTION: Final = 0.66

#: Probability of a false line in a record of noise.
_FALSE_ALARM_PROBABILITY: Final = 1e-3

#: Largest number of lines, and number of neighbours on either side for the noise floor.
_MAX_LINES: Final = 20
_NEIGHBOURS: Final = 64
#: Relative variance of the floor times the number of values in the median: 1 / ln(2)^2 for
#: independent values, more for those of a Hann window, which are correlated.
_FLOOR_VARIANCE: Final = 4.04

#: Width of the maximum of a Hann window, within which there is no other line.
_PEAK_WIDTH: Final = 3

#: Increase of the variances of amplitude and frequency by a Hann window: its second moments over
#: those of a constant, sum w^2/(sum w)^2 and sum w^2 t^2/(sum w t^2)^2.
_AMPLITUDE_LOSS: Final = 1.5
_FREQUENCY_LOSS: Final = 2.341

#: Smallest number of samples for the search of lines.
_MIN_SAMPLES: Final = 256

#: Smallest number of periods of a line in a record.
_MIN_PERIODS: Final = 8

#: Number of averaging times per octave, and longest averaging time relative to the record.
_TAUS_PER_OCTAVE: Final = 2
_MAX_TAU_FRACTION: Final = 1.0 / 3.0

_LOWER_LEVEL, _UPPER_LEVEL = 0.025, 0.975


@frozen
class SpectrumValue:
    """The power spectral density of the specific force at one frequency, two-sided."""

    frequency: float  #: Frequency, Hz.
    #: Power spectral density, (m/s^2)^2/Hz; the density of white noise with coefficient N is N^2.
    density: float
    low: float  #: Lower end of the 95 % interval, from the chi-square distribution.
    high: float  #: Upper end of the 95 % interval.
    dof: float  #: Degrees of freedom.
    expected: float  #: Value predicted by the detected components, (m/s^2)^2/Hz.


@frozen
class SpectralLine:
    """A spectral line of a record."""

    frequency: float  #: Frequency, Hz.
    u_frequency: float  #: Standard uncertainty of the frequency, Hz.
    amplitude: float  #: Amplitude of the specific force, m/s^2.
    u: float  #: Standard uncertainty of the amplitude.
    #: Probable source, such as ``50 Hz mains, harmonic 3``; null if the source is unknown.
    name: str | None = None


def spectrum(
    force: Array, step: float, sampling: Sampling, variances: Variances
) -> list[SpectrumValue]:
    """Return the spectrum of a record, from its lowest frequencies to half the sampling rate.

    variances: Variances of the estimated noise.
    """
    from scipy.signal import welch
    from scipy.stats import chi2

    length = max(_MIN_SEGMENT_SAMPLES, force.size // _N_SEGMENTS)
    values: list[SpectrumValue] = []
    lower_frequency = 0.0
    # Higher frequencies use shorter segments, of which there are more.
    while length >= _MIN_SEGMENT_SAMPLES:
        frequency, density = welch(
            force, 1.0 / step, nperseg=min(length, force.size), scaling="density"
        )
        is_last = length // _SEGMENT_RATIO < _MIN_SEGMENT_SAMPLES
        is_in_range = frequency >= max(lower_frequency, _FIRST_LINE * frequency[1])
        upper_frequency = frequency[-1] if is_last else _SEGMENT_RATIO * _FIRST_LINE * frequency[1]
        # Half the sampling rate itself is excluded, because its density is one-sided.
        is_in_range &= frequency < upper_frequency
        n_segments = max(1.0, 2.0 * force.size / length - 1.0)
        dof_per_line = 36.0 * n_segments**2 / (19.0 * n_segments - 1.0) if n_segments > 1.0 else 2.0
        bin_numbers = np.floor(
            _BINS_PER_DECADE * np.log10(frequency[is_in_range] * force.size * step)
        ).astype(int)
        for bin_number in np.unique(bin_numbers):
            is_in_bin = bin_numbers == bin_number
            mean = 0.5 * float(np.mean(density[is_in_range][is_in_bin]))
            dof = dof_per_line * max(1.0, _INDEPENDENT_FRACTION * np.count_nonzero(is_in_bin))
            low, high = (float(mean * dof / chi2.ppf(p, dof)) for p in (0.975, 0.025))
            mean_frequency = float(np.exp(np.mean(np.log(frequency[is_in_range][is_in_bin]))))
            angle = np.array([2.0 * math.pi * step * mean_frequency])
            expected = step * float(
                (np.asarray(variances) @ sampled_densities(angle, step, sampling))[0]
            )
            values.append(SpectrumValue(mean_frequency, mean, low, high, dof, expected))
        if is_last:
            break
        lower_frequency, length = upper_frequency, length // _SEGMENT_RATIO
    return values


def find_lines(force: Array, step: float) -> tuple[list[SpectralLine], Array]:
    """Return the lines of a record, the most significant first, and the record without them."""
    n = force.size
    if n < _MIN_SAMPLES:
        return [], force
    window = np.hanning(n + 2)[1:-1]
    frequencies: list[float] = []
    residual = force - force.mean()
    noise_floor = _noise_floor(np.abs(np.fft.rfft(window * residual)) ** 2)
    # The floor is the median of few values, approximately gamma-distributed with this shape.
    shape = (2 * _floor_half_widths(noise_floor.size) + 1) / _FLOOR_VARIANCE
    limit = shape * np.expm1(math.log(0.5 * n / _FALSE_ALARM_PROBABILITY) / shape)
    amplitudes: list[complex] = []
    while len(frequencies) < _MAX_LINES:
        power = np.abs(np.fft.rfft(window * residual)) ** 2
        ratio = power / noise_floor
        ratio[:_MIN_PERIODS] = ratio[-_PEAK_WIDTH:] = 0.0
        peak = int(np.argmax(ratio / limit))
        if ratio[peak] < limit[peak]:
            break
        # The logarithm of a Hann window's maximum is a parabola to a hundredth of a step.
        log_below, log_peak, log_above = np.log(power[peak - 1 : peak + 2])
        offset = 0.5 * (log_below - log_above) / (log_below - 2.0 * log_peak + log_above)
        peak_frequency = (peak + float(np.clip(offset, -0.5, 0.5))) / (n * step)
        if any(
            abs(peak_frequency - frequency) * n * step < _PEAK_WIDTH for frequency in frequencies
        ):
            break  # remainder of a line whose frequency is not constant
        frequencies, amplitudes, residual = _fit_lines(force, step, [*frequencies, peak_frequency])
    if not frequencies:
        return [], force
    noise_floor = _noise_floor(np.abs(np.fft.rfft(window * residual)) ** 2) / float(window @ window)
    lines = []
    for frequency, amplitude in zip(frequencies, amplitudes, strict=True):
        index = min(round(frequency * n * step), noise_floor.size - 1)
        noise_sd = math.sqrt(float(noise_floor[index]) / n)
        # Rife and Boorstyn, IEEE Trans. Inf. Theory 20 (1974) 591, for the window's weights.
        u = math.sqrt(2.0 * _AMPLITUDE_LOSS) * noise_sd
        u_frequency = (
            math.sqrt(6.0 * _FREQUENCY_LOSS) * noise_sd / (math.pi * n * step * abs(amplitude))
        )
        lines.append(SpectralLine(frequency, u_frequency, abs(amplitude), u))
    return lines, residual + force.mean()


def _fit_lines(
    force: Array, step: float, frequencies: list[float]
) -> tuple[list[float], list[complex], Array]:
    """Return frequencies after a Newton step, complex amplitudes, and the remainder of a record.

    The rows are weighted by a Hann window, so that slow noise does not leak into the lines.
    """
    n, count = force.size, len(frequencies)
    root_window = np.sqrt(np.hanning(n + 2)[1:-1])
    time = step * (np.arange(n) - 0.5 * (n - 1))
    coefficients: Array = np.zeros(0)
    columns: Array = np.zeros((n, 0))
    for is_last in (False, True):
        phase = 2.0 * math.pi * np.outer(time, frequencies)
        cosine, sine = np.cos(phase), np.sin(phase)
        columns = np.column_stack([np.ones(n), cosine, sine])
        coefficients = np.asarray(
            np.linalg.lstsq(columns * root_window[:, None], force * root_window)[0], float
        )
        if not is_last:
            a, b = coefficients[1 : 1 + count], coefficients[1 + count :]
            frequency_columns = 2.0 * math.pi * time[:, None] * (b * cosine - a * sine)
            derivative_columns = (
                np.column_stack([columns, frequency_columns]) * root_window[:, None]
            )
            shift = np.linalg.lstsq(derivative_columns, force * root_window, rcond=None)[0][-count:]
            limit = 0.5 / (n * step)
            frequencies = (np.asarray(frequencies) + np.clip(shift, -limit, limit)).tolist()
    amplitudes = [
        complex(a, b)
        for a, b in zip(coefficients[1 : 1 + count], coefficients[1 + count :], strict=True)
    ]
    return frequencies, amplitudes, force - columns @ coefficients


def _floor_half_widths(size: int) -> Array:
    """Return the number of neighbours on either side in the median of the noise floor."""
    return np.clip(np.arange(size) // 4, 2, _NEIGHBOURS)


def _noise_floor(power: Array) -> Array:
    """Return the noise floor of a spectrum: its running median over ln 2."""
    from scipy.ndimage import median_filter

    width = min(2 * _NEIGHBOURS + 1, (power.size // 2) | 1)
    # Near zero, the neighbourhood narrows, because the spectrum may depend on the frequency.
    median = median_filter(power, width, mode="reflect")
    half_widths = _floor_half_widths(min(4 * _NEIGHBOURS, power.size))
    for index, half_width in enumerate(half_widths.tolist()):
        median[index] = np.median(power[max(0, index - half_width) : index + half_width + 1])
    return np.asarray(np.maximum(median, 1e-300) / math.log(2.0))


@frozen
class AllanValue:
    """Overlapping Allan deviation at an averaging time."""

    tau: float  #: Averaging time, s.
    deviation: float  #: Allan deviation, m/s^2.
    low: float  #: Lower end of the 95 % interval, from the chi-square distribution.
    high: float  #: Upper end of the 95 % interval.
    dof: float  #: Equivalent degrees of freedom for the detected noise.
    expected: float  #: Value predicted by the detected components, m/s^2.


def allan_deviation(velocity: Array, step: float, count: int) -> float:
    """Return the overlapping Allan deviation over `count` steps; NaN without a pair.

    velocity: Integral of the specific force at regular times, m/s, shape (n,).
    step: Time between samples, s.
    """
    differences = velocity[2 * count :] - 2.0 * velocity[count:-count] + velocity[: -2 * count]
    return (
        math.sqrt(float(np.mean(differences**2)) / 2.0) / (count * step)
        if differences.size
        else math.nan
    )


def allan_values(
    velocity: Array, step: float, sampling: Sampling, variances: Variances
) -> list[AllanValue]:
    """Return the Allan deviation at averaging times up to a third of a record.

    variances: Variances of the estimated noise.
    """
    from scipy.stats import chi2

    n = velocity.size - 1
    max_count = max(1, math.floor(_MAX_TAU_FRACTION * n))
    counts = 2.0 ** (np.arange(_TAUS_PER_OCTAVE * math.log2(max_count) + 1e-9) / _TAUS_PER_OCTAVE)
    values = []
    for count in np.unique(np.round(counts).astype(int)).tolist():
        deviation = allan_deviation(velocity, step, count)
        expected, dof = allan_moments(n, step, sampling, variances, count)
        low, high = (
            deviation * math.sqrt(dof / chi2.ppf(level, dof))
            for level in (_UPPER_LEVEL, _LOWER_LEVEL)
        )
        values.append(AllanValue(count * step, deviation, low, high, dof, expected))
    return values


def allan_moments(
    n_samples: int, step: float, sampling: Sampling, variances: Variances, count: int
) -> tuple[float, float]:
    """Return the expected Allan deviation of a noise, and its equivalent degrees of freedom.

    n_samples: Number of samples of the specific force.
    count: Number of steps in the averaging time.
    """
    from scipy.fft import dct, next_fast_len

    n_frequencies = next_fast_len(2 * n_samples, real=True)
    angle = math.pi * (np.arange(n_frequencies) + 0.5) / n_frequencies
    density = np.asarray(variances) @ sampled_densities(angle, step, sampling)
    filter_gain = 4.0 * step**2 * np.sin(count * angle / 2.0) ** 4 / np.sin(angle / 2.0) ** 2
    covariance = dct(density * filter_gain, type=2) / (2.0 * n_frequencies)
    n_terms = n_samples + 1 - 2 * count
    lag = np.arange(1, n_terms)
    squared_correlations = (covariance[1:n_terms] / covariance[0]) ** 2
    dof = n_terms / (1.0 + 2.0 * float(((1.0 - lag / n_terms) * squared_correlations).sum()))
    return math.sqrt(float(covariance[0]) / 2.0) / (count * step), dof
