"""Residuals of a fit, thinned for the plots of a result."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from counterspin.arrays import Array, median
from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.observed_runs import ObservedRun
from counterspin.calibration.result_parts import Fold, Quantiles, Spectrum, Trace
from counterspin.inference.distributions import normal_cdf, normal_quantile
from counterspin.physics import observation
from counterspin.physics.spindle import TURN

#: Number of segments in all traces of a result, and its limits for one trace.
_TOTAL_SEGMENTS: Final = 12000
_MAX_SEGMENTS: Final = 1500
_MIN_SEGMENTS: Final = 100

#: Numbers of bins of a revolution: the first one without empty bins applies, because a record in
#: phase with the rotation contains only a few different angles.
_REVOLUTION_BINS: Final = (60, 30, 15)

_BAND_COUNT: Final = 100
_QUANTILE_COUNT: Final = 120
_MAX_OUTLIERS: Final = 100

#: Significant digits; a plot shows three.
_DIGIT_COUNT: Final = 4

#: Residuals below this magnitude are rounding errors of data without noise.
_MIN_MAGNITUDE: Final = 1e-15


def thin_residuals(view: AccelerometerView) -> dict[str, Trace]:
    """Return the residuals of one accelerometer by run, thinned."""
    runs = {run.run.name: run for run in view.problem.observed_runs}
    return {block.run: _thin_run(view, k, runs[block.run]) for k, block, _ in view.records()}


def _thin_run(view: AccelerometerView, index: int, run: ObservedRun) -> Trace:
    series = view.fit.design_blocks[index].series
    residuals = view.fit.residuals[index].unweighted
    whitened = view.fit.residuals[index].whitened
    periodogram = view.diagnostics.runs[series.run].periodogram
    segments_per_run = _TOTAL_SEGMENTS // len(view.fit.design_blocks)
    n_segments = min(max(segments_per_run, _MIN_SEGMENTS), _MAX_SEGMENTS)
    time, low, high = envelope(series.time, residuals, n_segments)
    angle = series.trajectory.spindle.angle(series.time)
    for n_bins in _REVOLUTION_BINS:
        folded_residuals = fold_over_revolution(angle, residuals, n_bins)
        if np.isfinite(folded_residuals[1]).all():
            break
    interval = median(np.diff(series.time))
    normal, ordered_residuals = normal_quantiles(whitened, _QUANTILE_COUNT)
    frequency, power, lines = smoothed_spectrum(periodogram, whitened.size * interval, _BAND_COUNT)
    (rms,) = _round_digits(np.sqrt([np.mean(residuals**2)]))
    return Trace(
        rows=residuals.size,
        rms=rms,
        time=_round_digits(time, 6),
        low=_round_digits(low),
        high=_round_digits(high),
        left_out=_outlier_residuals(view, index, run),
        by_angle=Fold(
            **dict(zip(("low", "mean", "high"), map(_null_if_nan, folded_residuals), strict=True))
        ),
        spectrum=Spectrum(
            frequency=_round_digits(frequency), power=_round_digits(power), lines=lines.tolist()
        ),
        quantiles=Quantiles(normal=_round_digits(normal), found=_round_digits(ordered_residuals)),
    )


def _outlier_residuals(
    view: AccelerometerView, index: int, run: ObservedRun
) -> list[tuple[float, float]]:
    """Return times and residuals of the outliers that the reader and the fit rejected.

    The model at an outlier is interpolated; without the reference output, it is smooth.
    """
    series, outliers = view.estimate.series[index], view.estimate.outliers[index]
    fitted_series = view.fit.design_blocks[index].series
    residuals = view.fit.residuals[index].unweighted
    column = view.accelerometer.channel.name
    reader_outliers = [outlier for outlier in run.record.report.listed if outlier.column == column]
    reader_times = np.array([outlier.time - run.record.start_time for outlier in reader_outliers])
    values = np.array([outlier.value for outlier in reader_outliers])
    reference = observation.reference(
        fitted_series.trajectory,
        fitted_series.mounting,
        reader_times,
        fitted_series.observable,
        fitted_series.attitude,
    )
    time = np.concatenate([series.time[outliers], reader_times])
    error = np.concatenate([series.error[outliers], values - reference])
    deviations = error - np.interp(time, fitted_series.time, fitted_series.error - residuals)
    largest_indices = np.sort(np.argsort(-np.abs(deviations), kind="stable")[:_MAX_OUTLIERS])
    sorted_indices = largest_indices[np.argsort(time[largest_indices], kind="stable")]
    return list(
        zip(
            _round_digits(time[sorted_indices], 6),
            _round_digits(deviations[sorted_indices]),
            strict=True,
        )
    )


def _null_if_nan(values: Array) -> list[float | None]:
    return [None if math.isnan(value) else value for value in _round_digits(values)]


def _round_digits(values: Array, digits: int = _DIGIT_COUNT) -> list[float]:
    """Round values to significant digits, except NaN."""
    magnitude = np.abs(values)
    is_ordinary = (magnitude > _MIN_MAGNITUDE) & (magnitude < 1.0 / _MIN_MAGNITUDE)
    decimals = (
        digits
        - 1.0
        - np.floor(np.log10(magnitude, where=is_ordinary, out=np.zeros_like(magnitude)))
    )
    # Integers and these powers of ten are exact, so that a single division rounds correctly.
    multiplier, divisor = 10.0 ** np.maximum(decimals, 0.0), 10.0 ** np.maximum(-decimals, 0.0)
    rounded_values = np.rint(values * multiplier / divisor) / multiplier * divisor
    extreme_values = [float(f"{value:.{digits}g}") for value in values[~is_ordinary].tolist()]
    rounded_values[~is_ordinary] = extreme_values
    value_list: list[float] = rounded_values.tolist()
    return value_list


# Thinning


def envelope(time: Array, values: Array, n_segments: int) -> tuple[Array, Array, Array]:
    """Return middle times, minima and maxima of at most `n_segments` segments of samples.

    The segments have equal numbers of samples, so that a gap in the record remains visible, and
    no extreme sample is lost.

    time, values: Shape (n,), n >= 1, in the order of time.
    n_segments: At least 1.
    """
    first_indices = _unique(np.arange(n_segments) * time.size // n_segments)
    last_indices = np.append(first_indices[1:], time.size) - 1
    return (
        0.5 * (time[first_indices] + time[last_indices]),
        np.minimum.reduceat(values, first_indices),
        np.maximum.reduceat(values, first_indices),
    )


def fold_over_revolution(angle: Array, values: Array, n_bins: int) -> tuple[Array, Array, Array]:
    """Return smallest, mean and largest values in equal bins of a revolution, shape (n_bins,).

    angle: Spindle angle, rad, not reduced to one revolution, shape (n,).
    values: Shape (n,).
    """
    index = np.minimum((np.mod(angle, TURN) * (n_bins / TURN)).astype(np.intp), n_bins - 1)
    count = np.bincount(index, minlength=n_bins)
    low, high = np.full(n_bins, np.inf), np.full(n_bins, -np.inf)
    np.minimum.at(low, index, values)
    np.maximum.at(high, index, values)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(index, values, minlength=n_bins) / count
    is_empty = count == 0
    low[is_empty], high[is_empty] = np.nan, np.nan
    return low, mean, high


def smoothed_spectrum(
    power: Array, duration: float, n_bands: int
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Return frequency (Hz), mean power and lines of at most `n_bands` bands; white noise: 1.

    The bands are equally wide on a logarithmic scale.

    power: The periodogram of whitened residuals, from `counterspin.inference.diagnostics`, shape
        (m,).
    duration: Length of the record, s: inverse of the frequency of the first line.
    n_bands: At least 1.
    """
    edges = _unique(np.geomspace(1.0, power.size + 1.0, n_bands + 1).astype(np.intp))
    first_lines, widths = edges[:-1], np.diff(edges)
    frequency = (first_lines + 0.5 * (widths - 1)) / duration
    return frequency, np.add.reduceat(power[: edges[-1] - 1], first_lines - 1) / widths, widths


def normal_quantiles(whitened_residuals: Array, count: int) -> tuple[Array, Array]:
    """Return at most `count` ordered residuals with their normal scores.

    Blom's scores are the quantiles at (i - 3/8) / (n + 1/4). The ranks i are evenly spaced in the
    scores, so that the tails are complete and the centre is thinned.

    whitened_residuals: Shape (n,), n >= 1.
    count: At least 2.
    Returns: shape (m,), m <= count.
    """
    n = whitened_residuals.size
    min_z = normal_quantile(0.625 / (n + 0.25))
    z_values = np.linspace(min_z, -min_z, min(count, n)).tolist()
    exact_ranks = np.array([normal_cdf(z) for z in z_values]) * (n + 0.25) + 0.375
    ranks = _unique(np.clip(np.rint(exact_ranks), 1, n).astype(np.intp))
    normal = [normal_quantile(p) for p in ((ranks - 0.375) / (n + 0.25)).tolist()]
    return np.array(normal), np.sort(whitened_residuals)[ranks - 1]


def _unique(sorted_values: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return unique values of a sorted array; `np.unique` would import the masked arrays."""
    unique_values: NDArray[np.intp] = sorted_values[np.append(True, np.diff(sorted_values) > 0)]
    return unique_values
