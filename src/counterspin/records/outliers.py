"""Outlying samples of a signal, judged against their own neighbours.

Over a window of 128 samples, whatever an accelerometer on a centrifuge indicates (displacement,
velocity or specific force) is smooth: a constant, a slow trend, a wave of one period a
revolution that may grow, and its second harmonic. Those few functions are fitted to each window,
robustly where it matters, and a sample that stands off by more than six standard deviations is an
outlier. Six leaves Gaussian data alone (2e-9) and finds what would spoil a block mean; the joint
fit judges finer, on its own residuals.

Two levels keep this cheap. A plain least-squares projection (one matrix product with a fixed
basis) screens every window; only windows that fail it are fitted robustly.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from counterspin.arrays import MAD_TO_SIGMA, empty_aligned, median

#: Samples in a window.
WINDOW_SAMPLES = 128
#: Fewest samples that can be judged at all: up to nine functions are fitted to them.
MIN_SAMPLES = 24
#: How many of the functions are fitted first, while outliers are still in.
_FIRST_FUNCTIONS = 5
#: Standard deviations beyond which a sample is an outlier.
LIMIT_SDS = 6.0
#: Standard deviations beyond which the screening hands a window to the robust fit.
_SCREEN_SDS = 5.5
#: A window may be this many times noisier than its surroundings before that counts against it.
_NOISE_RATIO = 4.0
#: Times the middle of a chunk beyond which a sample is no measurement at all.
_SENTINEL_RATIO = 1e9
#: Relative unevenness of the steps that may be ignored.
_IGNORED_UNEVENNESS = 1e-4
#: How late a sample may be before moving it along the slope no longer serves: in steps, or, where
#: that is more, in rad of spindle angle (the curvature then costs 5e-7 of the wave).
_SHIFT_STEPS = 0.3
_SHIFT_RAD = 1e-3


@np.errstate(invalid="ignore")  # samples that are no numbers make residuals that are none
def detect_outliers(
    time: np.ndarray,
    signal: np.ndarray,
    rate: float,
    step: float,
    unevenness: float,
    weight: np.ndarray | None = None,
) -> np.ndarray:
    """Find the outlying samples of one signal.

    time: (n,) s, increasing; gaps are allowed.
    signal: (n,) any unit; NaN where empty (what is infinite counts as empty).
    rate: Spindle rate, rad/s; 0 at rest.
    step: The usual spacing of the samples, s.
    weight: (n,) optional: the square root of each sample's weight (short block means are noisier).
    """
    if len(signal) < MIN_SAMPLES:
        return np.empty(0, dtype=int)
    # At rest there is no wave: a turn so slow that a window sees a polynomial of it.
    rate = rate or _SHIFT_RAD / _SHIFT_STEPS / step
    width = min(WINDOW_SAMPLES, len(signal))
    uneven_time = time if unevenness > _IGNORED_UNEVENNESS else None
    phase_step = rate * step
    peak, is_incomplete, scale = _screen_all(signal, uneven_time, width, phase_step, step)
    if not (peak.any() or is_incomplete.any()):
        return np.empty(0, dtype=int)
    finite = None
    # A sample that is no number shows in its window's peak, unless that was not judged.
    if (np.isnan(peak) | is_incomplete).any() and not np.isfinite(signal.sum()):
        finite = np.isfinite(signal)
        if not finite.any():
            return np.empty(0, dtype=int)
        signal = np.interp(time, time[finite], signal[finite])
        peak, is_incomplete, scale = _screen_all(signal, uneven_time, width, phase_step, step)
    suspect = is_incomplete | (peak > _SCREEN_SDS * scale)
    if not suspect.any():
        return np.empty(0, dtype=int)
    starts = np.minimum(np.arange(len(peak)) * width, len(signal) - width)
    # A filler such as 1e30 in place of an empty cell would drown its window by rounding alone.
    typical_scale = upper_median(np.abs(signal))
    sentinel = np.abs(signal) > _SENTINEL_RATIO * typical_scale
    if typical_scale > 0.0 and sentinel.any():
        without_sentinels = np.where(
            sentinel if finite is None else sentinel | ~finite, np.nan, signal
        )
        other_outliers = detect_outliers(time, without_sentinels, rate, step, unevenness, weight)
        return np.union1d(
            np.flatnonzero(sentinel if finite is None else sentinel & finite), other_outliers
        )

    def fit_windows(windows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        index = starts[windows, None] + np.arange(width)
        if uneven_time is None:
            basis = _even_basis(width, phase_step)[0]
        else:
            basis = _basis((time[index] - time[index].mean(axis=1, keepdims=True)) * rate)
        availability = np.ones(index.shape) if finite is None else finite[index].astype(float)
        residuals, scales = _robust_fit(
            signal[index], basis, availability if weight is None else availability * weight[index]
        )
        return index, residuals, scales

    if 10 * suspect.sum() > len(suspect):
        # Where outliers are many they inflate the plain scale: take it from robust fits.
        _, _, scales = fit_windows(np.unique(np.linspace(0, len(starts) - 1, 32).astype(int)))
        scale = median(scales)
    scale = max(scale, resolution(signal) / 2)
    suspect |= peak > _SCREEN_SDS * scale
    is_sentinel = np.zeros(len(signal), dtype=bool)
    suspects = np.flatnonzero(suspect)
    for begin in range(0, len(suspects), 1024):
        index, residuals, scales = fit_windows(suspects[begin : begin + 1024])
        limits = LIMIT_SDS * np.clip(scales, scale, _NOISE_RATIO * scale)
        is_outlier = np.abs(residuals) > limits[:, None]
        # Where most of a window is out, something has changed; that is not for us to judge.
        is_outlier[2 * is_outlier.sum(axis=1) > width] = False
        is_sentinel[index[is_outlier]] = True
    return np.flatnonzero(is_sentinel)


def upper_median(values: np.ndarray) -> float:
    """Return the median of values without NaN, of an even number the upper one.

    For the few hundred values of a chunk `np.median` takes several times as long.
    """
    middle = len(values) // 2
    ordered_values = values.copy()
    ordered_values.partition(middle)
    return float(ordered_values[middle])


def _screen_all(
    signal: np.ndarray, time: np.ndarray | None, width: int, phase_step: float, step: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Screen all windows of a signal: `peak` and `broken` of each, `scale` of the whole ones."""
    whole_windows = len(signal) // width * width
    first_time = None if time is None else time[:whole_windows]
    peak, is_outlier, scale = _screen(signal[:whole_windows], first_time, width, phase_step, step)
    if whole_windows == len(signal):
        return peak, is_outlier, scale
    # The last window overlaps the one before, so that every sample has a full window.
    last = signal[-width:]
    if time is None and not peak.any():
        # The usual case again, at a fraction of the time that `_screen` takes for one window.
        basis, functions, _ = _even_basis(width, phase_step)
        remainder = last - (last @ basis) @ functions
        highest, limit = np.abs(remainder).max(), _SCREEN_SDS * scale
        # Residuals have no mean, and no median is farther from it than their standard deviation.
        if highest <= limit and highest + math.sqrt(remainder @ remainder / width) <= limit:
            return np.append(peak, 0.0), np.append(is_outlier, False), scale
    last_time = None if time is None else time[-width:]
    last_peak, last_broken, _ = _screen(last, last_time, width, phase_step, step)
    return np.append(peak, last_peak), np.append(is_outlier, last_broken), scale


def _screen(
    signal: np.ndarray, time: np.ndarray | None, width: int, phase_step: float, step: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Fit whole windows by plain least squares. `time` is given where it is uneven."""
    basis, functions, slopes = _even_basis(width, phase_step)
    windows = signal.reshape(-1, width)
    is_outlier = np.zeros(len(windows), dtype=bool)
    if time is not None:
        # Move each sample along the signal's slope to where an even clock would have taken it.
        times = time.reshape(-1, width)
        offset = (times - times.mean(axis=1, keepdims=True)) / step
        offset -= np.arange(width) - (width - 1) / 2
        is_outlier = np.abs(offset).max(axis=1) > max(_SHIFT_RAD / abs(phase_step), _SHIFT_STEPS)
        windows = windows - ((windows @ basis) @ slopes) * offset
    residuals = empty_aligned(len(windows), width)
    np.matmul(windows @ basis, functions, out=residuals)
    np.subtract(windows, residuals, out=residuals)
    tested_residuals = residuals[~is_outlier] if is_outlier.any() else residuals
    sample = tested_residuals.ravel()[:: max(1, tested_residuals.size // 512) | 1]
    if not len(sample):
        return np.zeros(len(residuals)), is_outlier, 0.0
    centre = upper_median(sample)
    scale = MAD_TO_SIGMA * upper_median(np.abs(sample - centre))
    if max(tested_residuals.max() - centre, centre - tested_residuals.min()) <= _SCREEN_SDS * scale:
        return (
            np.zeros(len(residuals)),
            is_outlier,
            scale,
        )  # no window needs its own peak: the usual case
    return (
        np.maximum(residuals.max(axis=1) - centre, centre - residuals.min(axis=1)),
        is_outlier,
        scale,
    )


def resolution(signal: np.ndarray) -> float:
    """Return the step of a quantised signal: noise below it shows as rare whole steps."""
    sorted_values = np.sort(signal[:4096])
    sorted_values = sorted_values[np.diff(sorted_values, prepend=-math.inf) > 0.0]
    if not len(sorted_values):
        return 0.0
    # A few huge outliers must not determine the rounding.
    usual_size = float(np.sort(np.abs(sorted_values))[int(0.99 * (len(sorted_values) - 1))])
    rounding = 64 * np.finfo(float).eps * usual_size
    steps = np.diff(sorted_values)
    steps = steps[steps > rounding]
    return max(float(steps.min()) if len(steps) else 0.0, rounding)


@lru_cache(maxsize=64)
def _even_basis(width: int, phase_step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the basis of an evenly sampled window (width, k), and (k, width) for products with it.

    These are its transpose and its change from sample to sample, as they are read in memory.
    """
    basis = _basis((np.arange(width) - (width - 1) / 2) * phase_step)
    slopes = np.gradient(basis, axis=0)
    return basis, np.ascontiguousarray(basis.T), np.ascontiguousarray(slopes.T)


def _basis(phase: np.ndarray) -> np.ndarray:
    """Return orthonormal functions (..., width, 5 or 9) of the spindle phase about the centre."""
    half = np.abs(phase).max(axis=-1, keepdims=True)
    u = phase / half
    if np.max(half) < 0.25:
        # Over a short arc the wave is a quartic polynomial (to 5e-7 of its amplitude), and
        # sine and cosine would be collinear with the trend.
        functions = [np.ones_like(u), u, u**2, u**3, u**4]
    else:
        cos, sin = np.cos(phase), np.sin(phase)
        # A wave that grows or whose rate is slightly off, and the second harmonic: in a record
        # of little noise they are no outliers.
        functions = [np.ones_like(u), u, u**2, cos, sin, u * cos, u * sin]
        functions += [np.cos(2.0 * phase), np.sin(2.0 * phase)]
    orthonormal: np.ndarray = np.linalg.qr(np.stack(functions, axis=-1))[0]
    return orthonormal


def _robust_fit(
    windows: np.ndarray, basis: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fit each window by least absolute deviations, then bisquare; weighted residuals, scales."""
    is_finite = weight > 0
    middle = np.maximum(is_finite.sum(axis=1), 1) // 2
    floor = 1e-15 * np.abs(windows).max(axis=1) + 1e-300

    def fit(w: np.ndarray, basis: np.ndarray) -> np.ndarray:
        ridge = 1e-12 * np.eye(basis.shape[-1])
        weighted_basis = np.swapaxes(basis * w[..., None], -1, -2)
        normal = weighted_basis @ basis
        normal += ridge * np.trace(normal, axis1=-2, axis2=-1)[:, None, None] + 1e-300 * ridge
        amplitudes = np.linalg.solve(normal, weighted_basis @ windows[..., None])
        residuals: np.ndarray = (windows - (basis @ amplitudes)[..., 0]) * weight
        return residuals

    def spread(residuals: np.ndarray) -> np.ndarray:
        magnitude = np.sort(np.where(is_finite, np.abs(residuals), np.inf), axis=1)
        median: np.ndarray = np.take_along_axis(magnitude, middle[:, None], axis=1)[:, 0]
        floored: np.ndarray = np.maximum(MAD_TO_SIGMA * median, floor)
        return floored

    # Fewer functions withstand more outliers: the first ones part these from the rest, then all
    # of them follow the rest more closely.
    first_functions = basis[..., :_FIRST_FUNCTIONS]
    residuals = fit(weight**2, first_functions)
    for _ in range(10):
        magnitude = np.maximum(np.abs(residuals), 0.1 * spread(residuals)[:, None])
        residuals = fit(
            weight**2 * magnitude.min(axis=1, keepdims=True) / magnitude, first_functions
        )
    for _ in range(4):
        scaled_residuals = np.clip(residuals / (6.0 * spread(residuals)[:, None]), -1, 1)
        residuals = fit(weight**2 * ((1 - scaled_residuals**2) ** 2 + 1e-12), basis)
    scale = spread(residuals)
    sample_counts = np.maximum(is_finite.sum(axis=1), basis.shape[-1] + 1)
    return residuals, scale * np.sqrt(sample_counts / (sample_counts - basis.shape[-1]))
