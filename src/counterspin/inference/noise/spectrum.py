"""Model-free analysis of a record at rest: its spectrum, its lines, its Allan deviation.

- The spectrum is Welch's (IEEE Trans. Audio Electroacoust. 15 (1967) 70), with Hann windows that
  overlap by half, neighbouring frequencies joined so that there are a few a decade.
- A line is a maximum of the windowed transform of the whole record that stands above what its
  neighbourhood's median lets expect of noise; its wave is fitted by least squares.
- The Allan deviation is the overlapping one (W. J. Riley and D. A. Howe, Handbook of Frequency
  Stability Analysis, NIST SP 1065 (2008), section 5.2.4; IEEE Std 952, annex C, uses it for
  inertial sensors). Its second differences of velocity are stationary under every noise here. So
  its equivalent degrees of freedom, 2 E^2/Var, which C. A. Greenhall and W. J. Riley (Uncertainty
  of stability variances based on finite differences, 35th PTTI (2003) 267) tabulate for one power
  law at a time, are computed from the autocovariance of the noise that was found, all its parts
  together.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.noise.bias_instability import Variances
from counterspin.inference.noise.components import Sampling, sampled_densities

#: Values of the spectrum, a decade.
_BINS_PER_DECADE: Final = 12.0

#: Segments of the record, without overlap, for the lowest frequencies.
_SEGMENTS: Final = 6

#: By how much shorter the segments of the next higher frequencies are, the first frequency of each
#: that the window leaves apart from zero, in steps, and the fewest samples of one.
_SHORTER: Final = 4
_FIRST: Final = 3
_MIN_SEGMENT_SAMPLES: Final = 64

#: Independent values of a Hann window's spectrum, of two neighbouring ones.
_INDEPENDENT: Final = 0.66

#: Probability of one line too many in a whole record of noise.
_FALSE_ALARM: Final = 1e-3

#: Most lines that are looked for, and neighbours on either side whose median is the noise there.
_MAX_LINES: Final = 20
_NEIGHBOURS: Final = 64

#: A window of Hann's has its maximum over this many values: none of them is another line.
_WIDTH: Final = 3

#: What a Hann window's weights lose in the variance of an amplitude and of a frequency: its second
#: moments over those of a constant, sum w^2/(sum w)^2 and sum w^2 t^2/(sum w t^2)^2.
_AMPLITUDE_LOSS: Final = 1.5
_FREQUENCY_LOSS: Final = 2.341

#: Fewest samples in which lines are looked for.
_MIN_SAMPLES: Final = 256

#: Lines slower than so many of a record's periods are its wander.
_MIN_PERIODS: Final = 8

#: Averaging times an octave, and the part of a record that the longest is, at most.
_TAUS_PER_OCTAVE: Final = 2
_MAX_TAU_FRACTION: Final = 1.0 / 3.0

_LOW, _HIGH = 0.025, 0.975


@frozen
class SpectrumValue:
    """The power spectral density of the specific force at one frequency, two-sided."""

    frequency: float  #: Frequency, Hz.
    #: Power spectral density, (m/s^2)^2/Hz; the density of white noise with coefficient N is N^2.
    density: float
    low: float  #: Lower end of the 95 % interval, by chi-square.
    high: float  #: Upper end of the 95 % interval.
    dof: float  #: Degrees of freedom.
    expected: float  #: Value predicted by the detected components, (m/s^2)^2/Hz.


@frozen
class SpectralLine:
    """A wave in the record."""

    frequency: float  #: Frequency, Hz.
    u_frequency: float  #: Standard uncertainty of the frequency, Hz.
    amplitude: float  #: Amplitude of the specific force, m/s^2.
    u: float  #: Standard uncertainty of the amplitude.
    #: Probable source, such as ``50 Hz mains, harmonic 3``; null if the source is unknown.
    name: str | None = None


def spectrum(
    force: Array, step: float, kind: Sampling, variances: Variances
) -> list[SpectrumValue]:
    """Return the spectrum of a record, from its lowest frequencies to half the sampling rate.

    variances: Of the noise found.
    """
    from scipy.signal import welch
    from scipy.stats import chi2

    length = max(_MIN_SEGMENT_SAMPLES, force.size // _SEGMENTS)
    values: list[SpectrumValue] = []
    above = 0.0
    # Shorter segments, of which there are more, serve higher frequencies.
    while length >= _MIN_SEGMENT_SAMPLES:
        frequency, density = welch(
            force, 1.0 / step, nperseg=min(length, force.size), scaling="density"
        )
        last = length // _SHORTER < _MIN_SEGMENT_SAMPLES
        inside = frequency >= max(above, _FIRST * frequency[1])
        upper = frequency[-1] if last else _SHORTER * _FIRST * frequency[1]
        # Not half the sampling rate itself, whose density is one-sided as it stands.
        inside &= frequency < upper
        count = max(1.0, 2.0 * force.size / length - 1.0)
        dof_per_line = 36.0 * count**2 / (19.0 * count - 1.0) if count > 1.0 else 2.0
        number = np.floor(
            _BINS_PER_DECADE * np.log10(frequency[inside] * force.size * step)
        ).astype(int)
        for bin_number in np.unique(number):
            in_bin = number == bin_number
            mean = 0.5 * float(np.mean(density[inside][in_bin]))
            dof = dof_per_line * max(1.0, _INDEPENDENT * np.count_nonzero(in_bin))
            low, high = (float(mean * dof / chi2.ppf(part, dof)) for part in (0.975, 0.025))
            middle = float(np.exp(np.mean(np.log(frequency[inside][in_bin]))))
            angle = np.array([2.0 * math.pi * step * middle])
            expected = step * float(
                (np.asarray(variances) @ sampled_densities(angle, step, kind))[0]
            )
            values.append(SpectrumValue(middle, mean, low, high, dof, expected))
        if last:
            break
        above, length = upper, length // _SHORTER
    return values


def find_lines(force: Array, step: float) -> tuple[list[SpectralLine], Array]:
    """Return the lines of a record, the largest against its noise first, and it without them."""
    n = force.size
    if n < _MIN_SAMPLES:
        return [], force
    window = np.hanning(n + 2)[1:-1]
    frequencies: list[float] = []
    remainder = force - force.mean()
    background = _noise_floor(np.abs(np.fft.rfft(window * remainder)) ** 2)
    limit = math.log(0.5 * n / _FALSE_ALARM)
    waves: list[complex] = []
    while len(frequencies) < _MAX_LINES:
        power = np.abs(np.fft.rfft(window * remainder)) ** 2
        ratio = power / background
        ratio[:_MIN_PERIODS] = ratio[-_WIDTH:] = 0.0
        peak = int(np.argmax(ratio))
        if ratio[peak] < limit:
            break
        # The logarithm of a Hann window's maximum is a parabola to a hundredth of a step.
        below, middle, above = np.log(power[peak - 1 : peak + 2])
        offset = 0.5 * (below - above) / (below - 2.0 * middle + above)
        peak_frequency = (peak + float(np.clip(offset, -0.5, 0.5))) / (n * step)
        if any(abs(peak_frequency - known) * n * step < _WIDTH for known in frequencies):
            break  # what is left of a line that is none of constant frequency
        frequencies, waves, remainder = _fit_lines(force, step, [*frequencies, peak_frequency])
    if not frequencies:
        return [], force
    background = _noise_floor(np.abs(np.fft.rfft(window * remainder)) ** 2) / float(window @ window)
    lines = []
    for frequency, wave in zip(frequencies, waves, strict=True):
        place = min(round(frequency * n * step), background.size - 1)
        spread = math.sqrt(float(background[place]) / n)
        # Rife and Boorstyn, IEEE Trans. Inf. Theory 20 (1974) 591, for the window's weights.
        u = math.sqrt(2.0 * _AMPLITUDE_LOSS) * spread
        u_frequency = math.sqrt(6.0 * _FREQUENCY_LOSS) * spread / (math.pi * n * step * abs(wave))
        lines.append(SpectralLine(frequency, u_frequency, abs(wave), u))
    return lines, remainder + force.mean()


def _fit_lines(
    force: Array, step: float, frequencies: list[float]
) -> tuple[list[float], list[complex], Array]:
    """Return waves of a record, their frequencies one of Newton's steps better, and what is left.

    The rows are weighted by a Hann window, so that a slow wander does not leak into the waves.
    """
    n, count = force.size, len(frequencies)
    root = np.sqrt(np.hanning(n + 2)[1:-1])
    time = step * (np.arange(n) - 0.5 * (n - 1))
    sizes: Array = np.zeros(0)
    columns: Array = np.zeros((n, 0))
    for last in (False, True):
        phase = 2.0 * math.pi * np.outer(time, frequencies)
        cosine, sine = np.cos(phase), np.sin(phase)
        columns = np.column_stack([np.ones(n), cosine, sine])
        sizes = np.asarray(np.linalg.lstsq(columns * root[:, None], force * root)[0], float)
        if not last:
            a, b = sizes[1 : 1 + count], sizes[1 + count :]
            change = 2.0 * math.pi * time[:, None] * (b * cosine - a * sine)
            derivative_columns = np.column_stack([columns, change]) * root[:, None]
            shift = np.linalg.lstsq(derivative_columns, force * root, rcond=None)[0][-count:]
            limit = 0.5 / (n * step)
            frequencies = (np.asarray(frequencies) + np.clip(shift, -limit, limit)).tolist()
    waves = [complex(a, b) for a, b in zip(sizes[1 : 1 + count], sizes[1 + count :], strict=True)]
    return frequencies, waves, force - columns @ sizes


def _noise_floor(power: Array) -> Array:
    """Return the noise floor of a spectrum: its running median over ln 2."""
    from scipy.ndimage import median_filter

    width = min(2 * _NEIGHBOURS + 1, (power.size // 2) | 1)
    # Near zero the neighbourhood narrows with the frequency, as the spectrum may go with it.
    median = median_filter(power, width, mode="reflect")
    for near in range(min(4 * _NEIGHBOURS, power.size)):
        half = max(2, min(near // 4, _NEIGHBOURS))
        median[near] = np.median(power[max(0, near - half) : near + half + 1])
    return np.asarray(np.maximum(median, 1e-300) / math.log(2.0))


@frozen
class AllanValue:
    """The overlapping Allan deviation at one averaging time."""

    tau: float  #: Averaging time, s.
    deviation: float  #: Allan deviation, m/s^2.
    low: float  #: Lower end of the 95 % interval, by chi-square.
    high: float  #: Upper end of the 95 % interval.
    dof: float  #: Equivalent degrees of freedom for the detected noise.
    expected: float  #: Value predicted by the detected components, m/s^2.


def allan_deviation(velocity: Array, step: float, count: int) -> float:
    """Return the overlapping Allan deviation over `count` steps; NaN where there is no pair.

    velocity: Integral of the specific force at even times, m/s, shape (n,).
    step: s.
    """
    second = velocity[2 * count :] - 2.0 * velocity[count:-count] + velocity[: -2 * count]
    return math.sqrt(float(np.mean(second**2)) / 2.0) / (count * step) if second.size else math.nan


def allan_values(
    velocity: Array, step: float, kind: Sampling, variances: Variances
) -> list[AllanValue]:
    """Return the deviation at averaging times up to a third of a record.

    variances: Of the noise found.
    """
    from scipy.stats import chi2

    n = velocity.size - 1
    longest = max(1, math.floor(_MAX_TAU_FRACTION * n))
    counts = 2.0 ** (np.arange(_TAUS_PER_OCTAVE * math.log2(longest) + 1e-9) / _TAUS_PER_OCTAVE)
    points = []
    for count in np.unique(np.round(counts).astype(int)).tolist():
        deviation = allan_deviation(velocity, step, count)
        expected, dof = allan_moments(n, step, kind, variances, count)
        low, high = (deviation * math.sqrt(dof / chi2.ppf(part, dof)) for part in (_HIGH, _LOW))
        points.append(AllanValue(count * step, deviation, low, high, dof, expected))
    return points


def allan_moments(
    samples: int, step: float, kind: Sampling, variances: Variances, count: int
) -> tuple[float, float]:
    """Return the Allan deviation that a noise lets expect, and its equivalent degrees of freedom.

    samples: Of the specific force.
    count: Steps in the averaging time.
    """
    from scipy.fft import dct, next_fast_len

    grid = next_fast_len(2 * samples, real=True)
    angle = math.pi * (np.arange(grid) + 0.5) / grid
    density = np.asarray(variances) @ sampled_densities(angle, step, kind)
    shown = 4.0 * step**2 * np.sin(count * angle / 2.0) ** 4 / np.sin(angle / 2.0) ** 2
    covariance = dct(density * shown, type=2) / (2.0 * grid)
    terms = samples + 1 - 2 * count
    lag = np.arange(1, terms)
    squared = (covariance[1:terms] / covariance[0]) ** 2
    dof = terms / (1.0 + 2.0 * float(((1.0 - lag / terms) * squared).sum()))
    return math.sqrt(float(covariance[0]) / 2.0) / (count * step), dof
