"""Outlier rejection and thinning: the rows that a joint fit uses.

Outliers are rejected round by round, and reinstated where another model explains them.

A low-pass filter of the recorder correlates the errors of neighbouring rows. So does a signal that
needs several samples to cross a quantisation step. The first fit assumes white noise, and would
understate the uncertainty. Rows further apart than the correlation time are independent and contain
nearly all information of the record.

Test: the variance of lag-k third differences rises with k and levels off beyond the filter's
correlation time. For independent rows it does not rise. For integrated noise of the accelerometer,
and for a slow misfit, it rises with every doubling of the lag, to twice, eight times or more. For a
vibration it rises and falls. All runs of an accelerometer have the same filter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import MAD_TO_SIGMA, Array, median
from counterspin.errors import ConvergenceError
from counterspin.inference.distributions import student_quantile
from counterspin.inference.joint.design_blocks import DesignBlock
from counterspin.inference.joint.fit import JointFit, solve_joint
from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.physics.spindle import Spindle

#: Expected number of rejected samples of a series with Gaussian noise.
EXPECTED_FALSE_ALARMS: Final = 0.01

#: Samples on either side of the median filter that removes slow variations. The narrow filter is
#: used if a random walk exceeds the white noise within the wide one.
_MEDIAN_HALF_WIDTH: Final = 32
_NARROW_HALF_WIDTH: Final = 4

#: Ratio of the narrow to the wide scale below which the narrow filter is used.
_MAX_SCALE_RATIO: Final = 0.8

#: A time step longer than this multiple of the median is a gap.
_GAP_FACTOR: Final = 1.5

#: Degrees of freedom of the robust scale per independent sample.
_MAD_EFFICIENCY: Final = 0.37


def outlier_mask(
    residuals: Array, weight: Array, min_sd: float = 0.0, time: Array | None = None
) -> npt.NDArray[np.bool_]:
    """Return the mask of the residuals that are outliers.

    A residual is an outlier if its distance from the median of its neighbours exceeds a limit that
    Gaussian noise exceeds `EXPECTED_FALSE_ALARMS` times per series: 5 standard deviations for
    20,000 samples. The scale is the median absolute deviation of the series. The caller refits and
    repeats the test until no outlier remains, because gross outliers mask others.

    If a random walk exceeds the white noise among the neighbours, the test uses fewer neighbours.
    Samples at the ends, with neighbours on one side only, are then compared with the errors of the
    same prediction elsewhere in the series, and samples near a gap are not tested.

    residuals: In time order, shape (n,); NaN for rejected samples.
    weight: Inverse relative standard deviation of each residual, shape (n,).
    min_sd: Smallest credible standard deviation at weight 1, such as that of a quantisation step.
    time: Times, shape (n,), to find gaps; None: no gaps.
    Returns: shape (n,); false for samples that were rejected before.
    """
    n, is_present = residuals.size, np.isfinite(residuals)
    if np.count_nonzero(is_present) <= 2 * _MEDIAN_HALF_WIDTH:
        return np.zeros(n, dtype=bool)
    positions = np.arange(float(n)) if time is None else time
    interpolated_residuals = np.interp(positions, positions[is_present], residuals[is_present])
    deviations = _local_deviations(interpolated_residuals, _MEDIAN_HALF_WIDTH) * weight
    scale, is_tested = _robust_sd(deviations[is_present]), is_present
    narrow_deviations = _local_deviations(interpolated_residuals, _NARROW_HALF_WIDTH) * weight
    if _robust_sd(narrow_deviations[is_present]) < _MAX_SCALE_RATIO * scale:
        deviations, scale = narrow_deviations, _robust_sd(narrow_deviations[is_present])
        for direction in (1, -1):
            end_scales = _end_scales((interpolated_residuals * weight)[::direction])
            deviations[::direction][: end_scales.size] /= np.maximum(end_scales / scale, 1.0)
        is_tested = is_present & ~_is_near_gap(positions, _NARROW_HALF_WIDTH)
    scale = max(scale, min_sd)
    magnitudes = np.where(is_tested, np.abs(deviations), 0.0)
    if scale == 0.0:
        # More than half of the residuals are equal (coarse steps): use the rms instead.
        scale = float(np.sqrt(np.mean(magnitudes[is_tested] ** 2)))
    # Correlated noise seldom changes sign, and its scale has few degrees of freedom.
    n_independent = 2 * np.count_nonzero(np.diff(np.signbit(deviations[is_present])))
    dof = max(_MAD_EFFICIENCY * n_independent, 1.0)
    threshold = -student_quantile(dof, 0.5 * EXPECTED_FALSE_ALARMS / n)
    outliers: npt.NDArray[np.bool_] = magnitudes > threshold * scale
    return outliers


def _is_near_gap(positions: Array, half_width: int) -> npt.NDArray[np.bool_]:
    """Return the mask of the samples that have a gap within `half_width` neighbours."""
    steps = np.diff(positions)
    is_gap = np.append(steps > _GAP_FACTOR * median(steps), False)
    gap_indices = np.flatnonzero(is_gap)
    is_near = np.zeros(positions.size, dtype=bool)
    for k in range(-half_width + 1, half_width + 1):
        is_near[np.clip(gap_indices + k, 0, positions.size - 1)] = True
    return is_near


def _robust_sd(deviations: Array) -> float:
    """Return the standard deviation from the median absolute deviation."""
    return MAD_TO_SIGMA * median(np.abs(deviations))


def _local_deviations(residuals: Array, max_half_width: int) -> Array:
    """Return the deviation of each sample from its neighbours' median, in standard deviations.

    The neighbours form symmetric pairs about the sample; the median is that of the means of the
    pairs. A constant slope therefore has no effect. Near an end, there are fewer pairs; the first
    four samples are compared with a line through two medians. Deviations are divided by their
    standard deviation for white noise.
    """
    local_medians, variances = np.empty(residuals.size), np.empty(residuals.size)
    interior = slice(max_half_width, residuals.size - max_half_width)
    # Every second pair is nearly as accurate and takes half of the time.
    distances = (
        range(2, max_half_width + 1, 2)
        if max_half_width == _MEDIAN_HALF_WIDTH
        else range(1, max_half_width + 1)
    )
    local_medians[interior], variances[interior] = _pair_median(residuals, distances)
    for direction in (1, -1):
        end_residuals, end_medians, end_variances = (
            residuals[::direction],
            local_medians[::direction],
            variances[::direction],
        )
        for half_width in (16, 8, 4):
            if half_width < max_half_width:
                window = slice(half_width, 2 * half_width)
                end_medians[window], end_variances[window] = _pair_median(
                    end_residuals[: 3 * half_width], range(1, half_width + 1)
                )
        near_median, far_median = median(end_residuals[4:10]), median(end_residuals[10:16])
        end_medians[:4], end_variances[:4] = (
            near_median + (near_median - far_median) * _EXTRAPOLATION,
            _EXTRAPOLATION_VARIANCE,
        )
    return (residuals - local_medians) / np.sqrt(1.0 + variances)


def _end_scales(values: Array) -> Array:
    """Return the standard deviation of the first four samples' deviations, from the series."""
    windows = np.lib.stride_tricks.sliding_window_view(values, 16)
    near_median, far_median = (
        np.median(windows[:, columns], axis=1) for columns in (slice(4, 10), slice(10, 16))
    )
    errors = (
        windows[:, :4] - near_median[:, None] - (near_median - far_median)[:, None] * _EXTRAPOLATION
    )
    return MAD_TO_SIGMA * np.median(np.abs(errors / np.sqrt(1.0 + _EXTRAPOLATION_VARIANCE)), axis=0)


def _pair_median(values: Array, distances: range) -> tuple[Array, float]:
    """Return the median of the means of an even number of pairs about each sample."""
    min_distance, max_distance, step, n_half = (
        distances[0],
        distances[-1],
        distances.step,
        len(distances) // 2,
    )
    windows = np.lib.stride_tricks.sliding_window_view(values, 2 * max_distance + 1)
    left, right = (
        windows[:, : max_distance - min_distance + 1 : step],
        windows[:, : max_distance + min_distance - 1 : -step],
    )
    # For short rows, sorting is faster than the partition of `np.median`.
    sums = np.add(left, right, order="C")
    sums.sort(axis=1)
    return 0.25 * (sums[:, n_half - 1] + sums[:, n_half]), 0.5 * _median_variance(len(distances))


def _median_variance(n_samples: int) -> float:
    """Return the variance of the median of Gaussian samples over that of a single sample."""
    return 0.5 * math.pi / n_samples


#: Extrapolation of the line through the medians of samples 4 to 9 and 10 to 15 to the first four
#: samples, in units of the distance of the medians, and its variance.
_EXTRAPOLATION: Final[Array] = np.array([6.5, 5.5, 4.5, 3.5]) / 6.0
_EXTRAPOLATION_VARIANCE: Final[Array] = (
    (1.0 + _EXTRAPOLATION) ** 2 + _EXTRAPOLATION**2
) * _median_variance(6)


# Rounds of rejection ---------------------------------------------------------------------------

#: Mask of the rows of each series.
RowMasks = tuple[npt.NDArray[np.bool_], ...]

_MAX_ROUNDS: Final = 20

#: Fraction of outliers in a record above which they are tested again.
_MAX_OUTLIER_FRACTION: Final = 0.01


def empty_masks(series: Sequence[ResidualSeries]) -> RowMasks:
    """Return masks that select no row."""
    return tuple(np.zeros(record.time.size, dtype=bool) for record in series)


def select_rows(blocks: Sequence[DesignBlock], outliers: RowMasks) -> tuple[DesignBlock, ...]:
    """Return the design blocks without outliers."""
    return tuple(
        block.drop_rows(mask) if mask.any() else block
        for block, mask in zip(blocks, outliers, strict=True)
    )


def reject_outliers(
    fit: JointFit,
    series: Sequence[ResidualSeries],
    requests: Mapping[str, Noise],
    outliers: RowMasks,
) -> tuple[JointFit, RowMasks]:
    """Reject outliers and refit until there are none.

    series: Series with all rows.
    outliers: Masks of the rows that the fit omits.
    """
    for _ in range(_MAX_ROUNDS):
        new_outliers = find_outliers(fit, series, requests, outliers)
        if not any(mask.any() for mask in new_outliers):
            return fit, outliers
        masks_of_rows_in_fit = tuple(
            mask[~previous_mask] for mask, previous_mask in zip(new_outliers, outliers, strict=True)
        )
        outliers = tuple(a | b for a, b in zip(outliers, new_outliers, strict=True))
        fit = solve_joint(
            select_rows(fit.design_blocks, masks_of_rows_in_fit), fit.model, fit.noise
        )
    records = " and ".join(
        f"{block.run} ({block.accelerometer})"
        for block, mask in zip(fit.design_blocks, new_outliers, strict=True)
        if mask.any()
    )
    raise ConvergenceError(
        f"{records}: outliers were still found after {_MAX_ROUNDS} rounds of rejection, so the "
        "residuals are not noise about a smooth curve. Inspect the record for a jump in the "
        "clock or the displacement, or add the missing terms to the model"
    )


def reinstate_rows(
    fit: JointFit,
    full_problem: tuple[Sequence[DesignBlock], Unknowns],
    series: Sequence[ResidualSeries],
    requests: Mapping[str, Noise],
    outliers: RowMasks,
) -> tuple[JointFit, RowMasks]:
    """Reinstate rows that are not outliers under the new model.

    full_problem: Design blocks of all rows, and the model.
    """
    all_blocks, model = full_problem
    refit = solve_joint(select_rows(all_blocks, outliers), model, fit.noise)
    # The same estimate, compared with all rows.
    new_outliers = find_outliers(
        replace(refit, observations=tuple(all_blocks)), series, requests, empty_masks(series)
    )
    if not any(
        (mask & ~new_mask).any() for mask, new_mask in zip(outliers, new_outliers, strict=True)
    ):
        return fit, outliers
    return solve_joint(select_rows(all_blocks, new_outliers), model, fit.noise), new_outliers


def has_many_outliers(outliers: RowMasks) -> bool:
    """Return whether more than 1 % of the rows of a series are outliers."""
    return any(mask.mean() > _MAX_OUTLIER_FRACTION for mask in outliers)


def find_outliers(
    fit: JointFit,
    series: Sequence[ResidualSeries],
    requests: Mapping[str, Noise],
    outliers: RowMasks,
) -> RowMasks:
    """Return the masks of further outliers in each series."""
    new_masks = []
    for index, (block, mask) in enumerate(zip(fit.design_blocks, outliers, strict=True)):
        time, weight = series[index].time, np.sqrt(series[index].count)
        residuals = np.full(time.size, np.nan)
        residuals[~mask] = fit.residuals[index].unweighted
        stated_noise = requests[block.accelerometer].known
        if block.series.timing_noise > 0.0:
            weight = weight / _relative_sd(
                residuals * weight,
                stated_noise.white,
                block.series.timing_noise,
                series[index].jitter_variance * series[index].variance_ratio,
            )
        new_masks.append(
            outlier_mask(residuals, weight, stated_noise.quantisation / math.sqrt(12.0), time)
        )
    return tuple(new_masks)


def _relative_sd(
    residuals: Array, white_sd: float, jitter_sd: float, jitter_variance: Array
) -> Array:
    """Return the standard deviation of each row over the rms, with timing noise.

    The squared ratio is at least 0.5, because quiet rows are compared with noisier neighbours.
    """
    scale = MAD_TO_SIGMA * float(np.nanmedian(np.abs(residuals)))
    even_variance = max(white_sd**2, scale**2 - jitter_sd**2)
    ratio: Array = np.sqrt(
        np.maximum((even_variance + jitter_variance) / (even_variance + jitter_sd**2), 0.5)
    )
    return ratio


# Independent rows ------------------------------------------------------------------------------

#: Smallest number of independent rows of all runs, and of a run.
_MIN_ROWS: Final = 60
_MIN_ROWS_PER_RUN: Final = 8

#: Variance ratio above which rows are correlated, and smallest excess over 1 in its standard
#: uncertainties, 1.5 over the root of the number of rows.
_MIN_VARIANCE_RATIO: Final = 1.5
_THRESHOLD_SDS: Final = 8.0

#: Factors of a lag up to its double, and ratio of the variances at these lags below which the
#: variance is constant.
_LAG_FACTORS: Final = (1.0, 1.25, 1.5, 1.75, 2.0)
_PLATEAU_RATIO: Final = 1.4

#: Ratio of the first two variances below which rows are independent.
_MIN_GROWTH_RATIO: Final = 1.1

#: Limit of third differences, in standard deviations, against outliers.
_CLIP_SDS: Final = 5.0

#: Number of spindle harmonics, and of powers of time, to remove: an encoder error of four periods
#: per revolution causes five harmonics, K_OQ causes seven.
_N_HARMONICS: Final = 8
#: Relative eigenvalue below which a combination of these functions is ignored.
_MIN_EIGENVALUE: Final = 1e-12
_N_POLYNOMIALS: Final = 4


def thin_rows(fit: JointFit, series: Sequence[ResidualSeries]) -> tuple[ResidualSeries, ...]:
    """Thin the rows of series to independent rows.

    fit: Fit of these series with all their rows.
    """
    thinned_series = list(series)
    for name in dict.fromkeys(record.accelerometer for record in series):
        indices = [i for i, record in enumerate(series) if record.accelerometer == name]
        spacing = {i: median(np.diff(series[i].time)) for i in indices}
        row_residuals = {i: fit.residuals[i].unweighted * np.sqrt(series[i].count) for i in indices}
        if _is_correlated(row_residuals, spacing):
            correlation_time = _correlation_time(
                {i: remove_harmonics(series[i], row_residuals[i]) for i in indices}, spacing
            )
        else:
            correlation_time = 0.0
        for i in indices if correlation_time else ():
            step = min(
                round(correlation_time / spacing[i]), series[i].time.size // _MIN_ROWS_PER_RUN
            )
            thinned_series[i] = _decimate(series[i], max(step, 1))
    return tuple(thinned_series)


def _decimate(series: ResidualSeries, step: int) -> ResidualSeries:
    if step == 1:
        return series
    return replace(series.drop_rows(np.arange(series.time.size) % step > 0), thinning=step)


def _is_correlated(residuals: Mapping[int, Array], spacing: Mapping[int, float]) -> bool:
    """Return whether third differences increase from the shortest lag to its double."""
    lag = max(spacing.values())
    steps = {i: max(round(lag / spacing[i]), 1) for i in residuals}
    return any(
        _third_difference_variance(values, 2 * steps[i])
        > _MIN_GROWTH_RATIO * _third_difference_variance(values, steps[i])
        for i, values in residuals.items()
    )


def remove_harmonics(series: ResidualSeries, residuals: Array) -> Array:
    """Remove a trend and the spindle's harmonics from residuals, shape (n,) or (k, n).

    The total variance of white noise is preserved.

    residuals: Residuals of the last n rows of the series; n must exceed the number of functions.
    """
    times = series.time[-residuals.shape[-1] :]
    regressors, inverse = _harmonic_regressors(series.trajectory.spindle, times.tobytes())
    n_regressors, n_rows = regressors.shape
    fitted_harmonics = (inverse @ (regressors @ residuals.T)).T @ regressors
    return np.asarray((residuals - fitted_harmonics) * math.sqrt(n_rows / (n_rows - n_regressors)))


@lru_cache(maxsize=1)
def _harmonic_regressors(spindle: Spindle, time_bytes: bytes) -> tuple[Array, Array]:
    """Return trend and harmonics, shape (m, n), and the inverse of their Gram matrix.

    The result is cached because the accelerometers of a run usually share the times.
    """
    times = np.frombuffer(time_bytes)
    # A harmonic at or beyond half the sampling rate would follow the errors of the time stamps.
    angle_step = abs(spindle.rate) * median(np.diff(times))
    max_harmonic = min(_N_HARMONICS, int(math.pi / angle_step) - 1)
    phasor = np.exp(1j * spindle.angle(times))
    harmonics = np.cumprod(np.broadcast_to(phasor, (max(max_harmonic, 0), times.size)), axis=0)
    powers = np.cumprod(np.broadcast_to(times / times[-1], (_N_POLYNOMIALS - 1, times.size)), 0)
    regressors = np.concatenate([np.ones((1, times.size)), powers, harmonics.real, harmonics.imag])
    # Ten times as fast as a decomposition of the regressors, and accurate enough for them.
    inverse = np.linalg.pinv(regressors @ regressors.T, rcond=_MIN_EIGENVALUE, hermitian=True)
    return regressors, inverse


def _correlation_time(residuals: Mapping[int, Array], spacing: Mapping[int, float]) -> float:
    """Return twice the lag at which the variance levels off, s; 0 without correlation."""
    n_rows = sum(values.size for values in residuals.values())
    min_ratio = max(_MIN_VARIANCE_RATIO, 1.0 + _THRESHOLD_SDS * 1.5 / math.sqrt(n_rows))
    lag = max(spacing.values())
    initial_variances = {
        i: _third_difference_variance(values, max(round(lag / spacing[i]), 1))
        for i, values in residuals.items()
    }

    def variance_ratio(lag: float) -> tuple[float, float]:
        """Return the ratio to the variance at the first lag, and the number of independent rows."""
        steps = {i: max(round(lag / spacing[i]), 1) for i in residuals}
        selected_steps = {
            i: k
            for i, k in steps.items()
            if residuals[i].size >= 6 * k and initial_variances[i] > 0.0
        }
        counts = {i: residuals[i].size / k for i, k in selected_steps.items()}
        n_total = sum(counts.values())
        weighted_ratio = sum(
            counts[i] * _third_difference_variance(residuals[i], k) / initial_variances[i]
            for i, k in selected_steps.items()
        )
        return weighted_ratio / max(n_total, 1.0), n_total

    while True:
        ratios_and_counts = [variance_ratio(factor * lag) for factor in _LAG_FACTORS]
        if ratios_and_counts[-1][1] < _MIN_ROWS:
            return 0.0
        ratios = [ratio for ratio, _ in ratios_and_counts]
        if max(ratios) < _PLATEAU_RATIO * min(ratios):
            return 2.0 * lag if ratios[-1] > min_ratio else 0.0
        lag *= 2.0


def _third_difference_variance(residuals: Array, step: int) -> float:
    """Return the variance of a row from third differences over a step, outliers clipped."""
    differences = (
        residuals[3 * step :]
        - 3.0 * residuals[2 * step : -step]
        + 3.0 * residuals[step : -2 * step]
    )
    differences = differences - residuals[: -3 * step]
    if not differences.size:
        return 0.0
    limit = _CLIP_SDS * MAD_TO_SIGMA * median(np.abs(differences))
    return float(np.mean(np.clip(differences, -limit, limit) ** 2) / 20.0)
