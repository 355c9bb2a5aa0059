"""Detection of outliers in a signal, relative to neighbouring samples.

Over a window of 128 samples, the signal of an accelerometer on a centrifuge (displacement, velocity
or specific force) is smooth: a constant, a slow trend, a first harmonic that may grow, and a second
harmonic. These functions are fitted to each window, and a sample that deviates by more than six
standard deviations is an outlier. Six rejects almost no Gaussian data (2e-9) and finds samples that
would distort a block mean; the joint fit uses a lower limit, on its own residuals.

A plain least-squares projection (one matrix product with a fixed basis) screens every window; only
windows that fail it are fitted robustly.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from counterspin.arrays import MAD_TO_SIGMA, empty_aligned, median

#: Samples in a window.
WINDOW_SAMPLES = 128
#: Smallest number of samples in which outliers can be detected: up to nine functions are fitted.
MIN_SAMPLES = 24
#: Number of functions fitted first, with outliers.
_FIRST_FUNCTIONS = 5
#: Standard deviations beyond which a sample is an outlier.
LIMIT_SDS = 6.0
#: Standard deviations beyond which a screened window is fitted robustly.
_SCREEN_SDS = 5.5
#: Largest ratio of a window's noise to that of the signal that widens the limits.
_NOISE_RATIO = 4.0
#: Ratio to the median magnitude of a chunk beyond which a sample is a sentinel.
_MIN_SENTINEL_RATIO = 1e9
#: Relative unevenness of the steps that is ignored.
_IGNORED_UNEVENNESS = 1e-4
#: Largest time shift of a sample that is corrected along the slope, in steps or, if that is more,
#: in rad of spindle angle (the curvature then causes an error of 5e-7 of the amplitude).
_SHIFT_STEPS = 0.3
_SHIFT_RAD = 1e-3


@np.errstate(invalid="ignore")  # missing samples give NaN residuals
def detect_outliers(
    time: np.ndarray,
    signal: np.ndarray,
    rate: float,
    step: float,
    unevenness: float,
    weight: np.ndarray | None = None,
) -> np.ndarray:
    """Return the indices of the outliers of a signal.

    time: (n,) s, increasing; gaps are allowed.
    signal: (n,) any unit; NaN for missing samples (infinite values are missing, too).
    rate: Spindle rate, rad/s; 0 at rest.
    step: Typical time step, s.
    unevenness: Largest relative deviation of a time step.
    weight: (n,) square roots of the weights (short block means are noisier); None: equal.
    """
    if len(signal) < MIN_SAMPLES:
        return np.empty(0, dtype=int)
    # At rest use a rotation so slow that it is a polynomial within a window.
    rate = rate or _SHIFT_RAD / _SHIFT_STEPS / step
    window_size = min(WINDOW_SAMPLES, len(signal))
    uneven_time = time if unevenness > _IGNORED_UNEVENNESS else None
    phase_step = rate * step
    peak, is_incomplete, scale = _screen_all(signal, uneven_time, window_size, phase_step, step)
    if not (peak.any() or is_incomplete.any()):
        return np.empty(0, dtype=int)
    is_finite = None
    # A missing sample makes the peak of its window NaN, unless the window was not screened.
    if (np.isnan(peak) | is_incomplete).any() and not np.isfinite(signal.sum()):
        is_finite = np.isfinite(signal)
        if not is_finite.any():
            return np.empty(0, dtype=int)
        signal = np.interp(time, time[is_finite], signal[is_finite])
        peak, is_incomplete, scale = _screen_all(signal, uneven_time, window_size, phase_step, step)
    is_suspect = is_incomplete | (peak > _SCREEN_SDS * scale)
    if not is_suspect.any():
        return np.empty(0, dtype=int)
    starts = np.minimum(np.arange(len(peak)) * window_size, len(signal) - window_size)
    # A sentinel such as 1e30 for an empty cell would dominate its window by rounding.
    typical_scale = upper_median(np.abs(signal))
    is_sentinel = np.abs(signal) > _MIN_SENTINEL_RATIO * typical_scale
    if typical_scale > 0.0 and is_sentinel.any():
        masked_signal = np.where(
            is_sentinel if is_finite is None else is_sentinel | ~is_finite, np.nan, signal
        )
        other_outliers = detect_outliers(time, masked_signal, rate, step, unevenness, weight)
        return np.union1d(
            np.flatnonzero(is_sentinel if is_finite is None else is_sentinel & is_finite),
            other_outliers,
        )

    def fit_windows(windows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        index = starts[windows, None] + np.arange(window_size)
        if uneven_time is None:
            basis = _make_even_basis(window_size, phase_step)[0]
        else:
            basis = _make_basis((time[index] - time[index].mean(axis=1, keepdims=True)) * rate)
        fit_weight = np.ones(index.shape) if is_finite is None else is_finite[index].astype(float)
        residuals, scales = _fit_robustly(
            signal[index], basis, fit_weight if weight is None else fit_weight * weight[index]
        )
        return index, residuals, scales

    if 10 * is_suspect.sum() > len(is_suspect):
        # Many outliers inflate the plain scale: use that of robust fits.
        _, _, scales = fit_windows(np.unique(np.linspace(0, len(starts) - 1, 32).astype(int)))
        scale = median(scales)
    scale = max(scale, estimate_resolution(signal) / 2)
    is_suspect |= peak > _SCREEN_SDS * scale
    is_rejected = np.zeros(len(signal), dtype=bool)
    suspect_windows = np.flatnonzero(is_suspect)
    for start in range(0, len(suspect_windows), 1024):
        index, residuals, scales = fit_windows(suspect_windows[start : start + 1024])
        limits = LIMIT_SDS * np.clip(scales, scale, _NOISE_RATIO * scale)
        is_outlier = np.abs(residuals) > limits[:, None]
        # If most of a window deviates, the signal has changed: these are not outliers.
        is_outlier[2 * is_outlier.sum(axis=1) > window_size] = False
        is_rejected[index[is_outlier]] = True
    return np.flatnonzero(is_rejected)


def upper_median(values: np.ndarray) -> float:
    """Return the median of values without NaN, the upper one of an even number.

    For a few hundred values, `np.median` takes several times as long.
    """
    middle_index = len(values) // 2
    partitioned_values = values.copy()
    partitioned_values.partition(middle_index)
    return float(partitioned_values[middle_index])


def _screen_all(
    signal: np.ndarray, time: np.ndarray | None, width: int, phase_step: float, step: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Screen all windows of a signal; return peaks, incomplete windows and the scale."""
    n_whole = len(signal) // width * width
    first_time = None if time is None else time[:n_whole]
    peak, is_incomplete, scale = _screen(signal[:n_whole], first_time, width, phase_step, step)
    if n_whole == len(signal):
        return peak, is_incomplete, scale
    # The last window overlaps the preceding one, so that every sample has a full window.
    last_window = signal[-width:]
    if time is None and not peak.any():
        # The common case again, in a fraction of the time of `_screen`.
        basis, transposed_basis, _ = _make_even_basis(width, phase_step)
        residuals = last_window - (last_window @ basis) @ transposed_basis
        max_residual, limit = np.abs(residuals).max(), _SCREEN_SDS * scale
        # Residuals have zero mean, and a median differs from the mean by at most one sd.
        if (
            max_residual <= limit
            and max_residual + math.sqrt(residuals @ residuals / width) <= limit
        ):
            return np.append(peak, 0.0), np.append(is_incomplete, False), scale
    last_time = None if time is None else time[-width:]
    last_peak, last_incomplete, _ = _screen(last_window, last_time, width, phase_step, step)
    return np.append(peak, last_peak), np.append(is_incomplete, last_incomplete), scale


def _screen(
    signal: np.ndarray, time: np.ndarray | None, width: int, phase_step: float, step: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Fit whole windows by least squares; `time` is required if it is uneven."""
    basis, transposed_basis, slopes = _make_even_basis(width, phase_step)
    windows = signal.reshape(-1, width)
    is_incomplete = np.zeros(len(windows), dtype=bool)
    if time is not None:
        # Shift each sample along the signal's slope to its even time.
        times = time.reshape(-1, width)
        offset_steps = (times - times.mean(axis=1, keepdims=True)) / step
        offset_steps -= np.arange(width) - (width - 1) / 2
        is_incomplete = np.abs(offset_steps).max(axis=1) > max(
            _SHIFT_RAD / abs(phase_step), _SHIFT_STEPS
        )
        windows = windows - ((windows @ basis) @ slopes) * offset_steps
    residuals = empty_aligned(len(windows), width)
    np.matmul(windows @ basis, transposed_basis, out=residuals)
    np.subtract(windows, residuals, out=residuals)
    tested_residuals = residuals[~is_incomplete] if is_incomplete.any() else residuals
    sample = tested_residuals.ravel()[:: max(1, tested_residuals.size // 512) | 1]
    if not len(sample):
        return np.zeros(len(residuals)), is_incomplete, 0.0
    residual_median = upper_median(sample)
    scale = MAD_TO_SIGMA * upper_median(np.abs(sample - residual_median))
    if (
        max(tested_residuals.max() - residual_median, residual_median - tested_residuals.min())
        <= _SCREEN_SDS * scale
    ):
        # The usual case: no window needs a separate peak.
        return np.zeros(len(residuals)), is_incomplete, scale
    max_residuals, min_residuals = residuals.max(axis=1), residuals.min(axis=1)
    peak = np.maximum(max_residuals - residual_median, residual_median - min_residuals)
    return peak, is_incomplete, scale


def estimate_resolution(signal: np.ndarray) -> float:
    """Estimate the quantisation step of a signal; lower noise appears as rare whole steps."""
    sorted_values = np.sort(signal[:4096])
    sorted_values = sorted_values[np.diff(sorted_values, prepend=-math.inf) > 0.0]
    if not len(sorted_values):
        return 0.0
    # A few huge outliers must not determine the rounding.
    typical_magnitude = float(np.sort(np.abs(sorted_values))[int(0.99 * (len(sorted_values) - 1))])
    rounding = 64 * np.finfo(float).eps * typical_magnitude
    steps = np.diff(sorted_values)
    steps = steps[steps > rounding]
    return max(float(steps.min()) if len(steps) else 0.0, rounding)


@lru_cache(maxsize=64)
def _make_even_basis(width: int, phase_step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the basis of an even window (width, k), its transpose and slopes (k, width).

    Transpose and slopes are contiguous in memory.
    """
    basis = _make_basis((np.arange(width) - (width - 1) / 2) * phase_step)
    slopes = np.gradient(basis, axis=0)
    return basis, np.ascontiguousarray(basis.T), np.ascontiguousarray(slopes.T)


def _make_basis(phase: np.ndarray) -> np.ndarray:
    """Return orthonormal functions (..., width, 5 or 9) of the spindle phase about the centre."""
    half_width = np.abs(phase).max(axis=-1, keepdims=True)
    u = phase / half_width
    if np.max(half_width) < 0.25:
        # Over a short arc the wave is a quartic polynomial (to 5e-7 of its amplitude), and
        # sine and cosine would be collinear with the trend.
        functions = [np.ones_like(u), u, u**2, u**3, u**4]
    else:
        cos, sin = np.cos(phase), np.sin(phase)
        # Include a growing first harmonic, a small rate error and the second harmonic, which
        # would look like outliers in a record with little noise.
        functions = [np.ones_like(u), u, u**2, cos, sin, u * cos, u * sin]
        functions += [np.cos(2.0 * phase), np.sin(2.0 * phase)]
    orthonormal_basis: np.ndarray = np.linalg.qr(np.stack(functions, axis=-1))[0]
    return orthonormal_basis


def _fit_robustly(
    windows: np.ndarray, basis: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fit each window by least absolute deviations, then bisquare; return residuals and scales."""
    is_finite = weight > 0
    median_indices = np.maximum(is_finite.sum(axis=1), 1) // 2
    min_scale = 1e-15 * np.abs(windows).max(axis=1) + 1e-300

    def fit(fit_weight: np.ndarray, basis: np.ndarray) -> np.ndarray:
        ridge = 1e-12 * np.eye(basis.shape[-1])
        weighted_basis = np.swapaxes(basis * fit_weight[..., None], -1, -2)
        normal_matrix = weighted_basis @ basis
        normal_matrix += (
            ridge * np.trace(normal_matrix, axis1=-2, axis2=-1)[:, None, None] + 1e-300 * ridge
        )
        amplitudes = np.linalg.solve(normal_matrix, weighted_basis @ windows[..., None])
        residuals: np.ndarray = (windows - (basis @ amplitudes)[..., 0]) * weight
        return residuals

    def estimate_scale(residuals: np.ndarray) -> np.ndarray:
        magnitudes = np.sort(np.where(is_finite, np.abs(residuals), np.inf), axis=1)
        median_magnitude: np.ndarray = np.take_along_axis(
            magnitudes, median_indices[:, None], axis=1
        )[:, 0]
        robust_scale: np.ndarray = np.maximum(MAD_TO_SIGMA * median_magnitude, min_scale)
        return robust_scale

    # Fewer functions are more robust: the first ones separate outliers, then all are fitted.
    first_functions = basis[..., :_FIRST_FUNCTIONS]
    residuals = fit(weight**2, first_functions)
    for _ in range(10):
        magnitude = np.maximum(np.abs(residuals), 0.1 * estimate_scale(residuals)[:, None])
        residuals = fit(
            weight**2 * magnitude.min(axis=1, keepdims=True) / magnitude, first_functions
        )
    for _ in range(4):
        scaled_residuals = np.clip(residuals / (6.0 * estimate_scale(residuals)[:, None]), -1, 1)
        residuals = fit(weight**2 * ((1 - scaled_residuals**2) ** 2 + 1e-12), basis)
    scale = estimate_scale(residuals)
    sample_counts = np.maximum(is_finite.sum(axis=1), basis.shape[-1] + 1)
    return residuals, scale * np.sqrt(sample_counts / (sample_counts - basis.shape[-1]))
