"""Heteroscedastic white noise of records.

The noise of an accelerometer is first estimated for all its records together. It is often
heteroscedastic for two reasons: runs with more vibration are noisier, and errors of time stamps
cause noise proportional to the slope of the signal. Equal weights would waste the quiet rows, and
would understate u of coefficients that depend on noisy rows.

Both effects are estimated from third differences of the whitened residuals, which contain no slow
misfit. For homoscedastic noise, their squares have the mean 1. Third differences of independent
rows have correlations of -3/4, 3/10 and -1/20 with the following ones, so that n of them are
equivalent to n/2.31 rows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.outlier_rejection import remove_harmonics
from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.noise.model import Noise

#: Order of the differences.
_DIFFERENCE_ORDER: Final = 3

#: Squared weights of the rows in a third difference, over their sum.
_SQUARED_WEIGHTS: Final = np.array([1.0, 9.0, 9.0, 1.0]) / 20.0

#: Sum of the squared correlations of third differences: this many are equivalent to a row.
_CORRELATION_FACTOR: Final = 1.0 + 2.0 * (0.75**2 + 0.3**2 + 0.05**2)

#: Smallest number of differences of a series.
_MIN_DIFFERENCES: Final = 40

#: Significance level of heteroscedasticity, and smallest relevant ratio of two standard deviations.
_SIGNIFICANCE: Final = 1e-6
_MIN_SD_RATIO: Final = 1.1

#: Smallest gain in twice the log-likelihood by encoder noise in corrected times.
_MIN_GAIN: Final = 1.0

#: Trial values of timing noise: largest variance of a row over the white-noise variance.
_TRIAL_RATIOS: Final = np.geomspace(0.1, 1e6, 57)


@frozen
class VarianceModel:
    """Heteroscedasticity of the white noise of an accelerometer's records."""

    #: Run -> standard deviation over that of the accelerometer; empty: equal.
    run_ratios: Mapping[str, float]
    timestamp_sd: float  #: Estimated standard deviation of a time stamp, s; 0: none.
    #: Estimated standard deviation of a recorded angle in corrected times, rad; 0: none.
    encoder_sd: float = 0.0

    def apply_to(self, series: ResidualSeries) -> ResidualSeries:
        """Return a series with this noise."""
        if self.encoder_sd > 0.0:
            return series.with_encoder_noise(self.encoder_sd)
        return series.with_timestamp_noise(self.timestamp_sd).scale_noise(self.run_ratios)


def estimate_heteroscedasticity(
    fit: JointFit, series: Sequence[ResidualSeries], requests: Mapping[str, Noise]
) -> dict[str, VarianceModel]:
    """Return the heteroscedasticity of estimated white noise, by accelerometer.

    series: Series with all rows, for the slopes of the signals.
    """
    models = {}
    for name, request in requests.items():
        if encoder_sd := _estimate_encoder_noise(fit, name):
            models[name] = VarianceModel({}, 0.0, encoder_sd)
            continue
        if "white" not in request.to_estimate or fit.noise[name].sample_variance == 0.0:
            continue
        squares = _squared_differences(fit, name)
        if (
            squares
            and (model := _best_variance_model(fit, series, squares, fit.noise[name])) is not None
        ):
            models[name] = model
    return models


def noise_by_run(fit: JointFit, accelerometer: str) -> Mapping[str, float]:
    """Return the white noise of each run over that of the fit; empty if runs do not differ."""
    squares = _squared_differences(fit, accelerometer)
    variance_fit = _fit_run_variances(fit, squares) if squares else None
    return {} if variance_fit is None else variance_fit[1].run_ratios


def _squared_differences(fit: JointFit, accelerometer: str) -> dict[int, Array]:
    """Return the squared third differences of each series, with mean 1 for homoscedastic noise.

    If they are heteroscedastic, harmonics of the spindle are removed first, because high harmonics
    of encoder errors remain in third differences.
    """
    residuals = {
        i: fit.residuals[i].whitened
        for i, block in enumerate(fit.design_blocks)
        if block.accelerometer == accelerometer
        and fit.residuals[i].whitened.size >= _MIN_DIFFERENCES + _DIFFERENCE_ORDER
    }
    squares = _square_third_differences(residuals)
    if squares and (
        _fit_run_variances(fit, squares) is not None or _varies_within_run(fit, squares)
    ):
        return _square_third_differences(
            {
                i: remove_harmonics(fit.design_blocks[i].series, values)
                for i, values in residuals.items()
            }
        )
    return squares


def _square_third_differences(residuals: Mapping[int, Array]) -> dict[int, Array]:
    return {i: np.diff(values, _DIFFERENCE_ORDER) ** 2 / 20.0 for i, values in residuals.items()}


def _best_variance_model(
    fit: JointFit, series: Sequence[ResidualSeries], squares: Mapping[int, Array], noise: Noise
) -> VarianceModel | None:
    """Return the variance model with the largest significant gain; None if there is none."""
    run_model = _fit_run_variances(fit, squares)
    if run_model is None and not _varies_within_run(fit, squares):
        return None
    slope_model = _fit_timestamp_noise(fit, series, squares, noise)
    candidates = [candidate for candidate in (run_model, slope_model) if candidate is not None]
    return max(candidates, key=lambda candidate: candidate[0])[1] if candidates else None


def _information_per_row(squares: Array) -> float:
    """Return the number of independent rows that are equivalent to a third difference.

    Heavy tails make sums of squares less certain.
    """
    kurtosis_factor = max(1.0, float(np.mean((squares / np.mean(squares) - 1.0) ** 2)) / 2.0)
    return 1.0 / (_CORRELATION_FACTOR * kurtosis_factor)


def _fit_run_variances(
    fit: JointFit, squares: Mapping[int, Array]
) -> tuple[float, VarianceModel] | None:
    """Return the gain beyond the significance limit, and the noise of each run; None: equal.

    Bartlett's test, Proc. R. Soc. A 160 (1937) 268.
    """
    from scipy.special import chdtri

    variances = {i: float(np.mean(values)) for i, values in squares.items()}
    ratio = math.sqrt(max(variances.values()) / min(variances.values()))
    if len(variances) < 2 or ratio < _MIN_SD_RATIO:
        return None
    all_squares = np.concatenate(list(squares.values()))
    log_ratio_sum = sum(
        squares[i].size * math.log(variance / np.mean(all_squares))
        for i, variance in variances.items()
    )
    gain = -_information_per_row(all_squares) * log_ratio_sum
    gain_excess = gain - float(chdtri(len(variances) - 1, _SIGNIFICANCE))
    blocks = fit.design_blocks
    run_ratios = {blocks[i].run: math.sqrt(variance) for i, variance in variances.items()}
    return (gain_excess, VarianceModel(run_ratios, 0.0)) if gain_excess > 0.0 else None


def _varies_within_run(fit: JointFit, squares: Mapping[int, Array]) -> bool:
    """Return whether the squares depend on twice the angle or on time, as slopes do, in any run."""
    from scipy.special import chdtrc

    min_p = 1.0
    for i, values in squares.items():
        series = fit.design_blocks[i].series
        time = series.time[-values.size :]
        double_angle = 2.0 * series.trajectory.spindle.angle(time)
        regressors = np.column_stack(
            [np.ones(values.size), np.cos(double_angle), np.sin(double_angle), time]
        )
        coefficients = np.linalg.lstsq(regressors, values, rcond=None)[0]
        relative_sum_of_squares = np.sum((regressors @ coefficients - values.mean()) ** 2) / (
            2.0 * values.mean() ** 2
        )
        min_p = min(min_p, float(chdtrc(3, _information_per_row(values) * relative_sum_of_squares)))
    return min_p < _SIGNIFICANCE


def _fit_timestamp_noise(
    fit: JointFit, series: Sequence[ResidualSeries], squares: Mapping[int, Array], noise: Noise
) -> tuple[float, VarianceModel] | None:
    """Return the gain beyond the significance limit, and the timing noise; None: none.

    In the likelihood, the means of the squares are proportional to 1 + (timing x slope)^2/white^2.
    """
    if any(fit.design_blocks[i].series.timing_noise > 0.0 for i in squares):
        return None
    slopes = {
        i: _mean_squared_slopes(fit.design_blocks[i].series, series[i], len(values))
        for i, values in squares.items()
    }
    from scipy.special import chdtri

    gain, ratio, variance = _maximize_slope_model(squares, slopes)
    excess = gain - float(chdtri(1, _SIGNIFICANCE))
    if excess <= 0.0 or ratio < _MIN_SD_RATIO:
        return None
    return excess, VarianceModel({}, math.sqrt(variance * noise.sample_variance))


def _maximize_slope_model(
    squares: Mapping[int, Array], squared_slopes: Mapping[int, Array]
) -> tuple[float, float, float]:
    """Maximise the likelihood of squares with means white variance + timing variance x slope^2.

    squared_slopes: Squared slopes of each series.
    Returns: twice the gain in log-likelihood over homoscedastic noise, the largest ratio of the
        standard deviations of two rows, and the timing variance.
    """
    max_slope = max(float(values.max()) for values in squared_slopes.values())
    if max_slope == 0.0:
        return 0.0, 1.0, 0.0
    relative_slopes = np.concatenate(list(squared_slopes.values())) / max_slope
    all_squares = np.concatenate(list(squares.values()))
    information = _information_per_row(all_squares)

    def log_likelihood_gain(ratio: float) -> float:
        """Return twice the gain in log-likelihood over homoscedastic noise."""
        relative_variances = 1.0 + ratio * relative_slopes
        log_variance_ratio = math.log(np.mean(all_squares / relative_variances)) - math.log(
            np.mean(all_squares)
        )
        return -information * (
            float(np.sum(np.log(relative_variances))) + all_squares.size * log_variance_ratio
        )

    best_ratio = float(max(_TRIAL_RATIOS, key=log_likelihood_gain))
    refined_ratios = best_ratio * np.geomspace(0.75, 1.33, 21)
    best_ratio = float(max(refined_ratios, key=log_likelihood_gain))
    white_variance = float(np.mean(all_squares / (1.0 + best_ratio * relative_slopes)))
    return (
        log_likelihood_gain(best_ratio),
        math.sqrt(1.0 + best_ratio),
        best_ratio * white_variance / max_slope,
    )


def _estimate_encoder_noise(fit: JointFit, accelerometer: str) -> float:
    """Estimate the encoder noise from series with corrected times, rad; 0: stated, or none.

    No test is necessary, because the errors of the time stamps are already significant.
    """
    squares, slopes = {}, {}
    for i, block in enumerate(fit.design_blocks):
        series, errors = block.series, block.series.timestamp_errors
        if block.accelerometer != accelerometer or errors is None or errors.fraction == 0.0:
            continue
        if series.timing_noise > 0.0:
            return 0.0
        weight = np.sqrt(series.count / series.variance_ratio)
        residuals = remove_harmonics(series, fit.residuals[i].unweighted * weight)
        squares[i] = np.diff(residuals, _DIFFERENCE_ORDER) ** 2 / 20.0
        slope = np.add(*series.slopes()) / series.trajectory.spindle.rate
        squared_slope = errors.fraction * slope**2
        slopes[i] = np.asarray(
            np.convolve(squared_slope / series.variance_ratio, _SQUARED_WEIGHTS, mode="valid")
        )
    if not squares:
        return 0.0
    gain, _, variance = _maximize_slope_model(squares, slopes)
    return math.sqrt(variance) if gain > _MIN_GAIN else 0.0


def _mean_squared_slopes(
    thinned_series: ResidualSeries, full_series: ResidualSeries, count: int
) -> Array:
    """Return the mean squared slope of the rows in each third difference, shape (count,)."""
    reference_slope, error_slope = full_series.slopes()
    squared_slope = ((reference_slope + error_slope) ** 2)[
        np.isin(full_series.time, thinned_series.time)
    ]
    mean = np.convolve(squared_slope, _SQUARED_WEIGHTS, mode="valid")
    # Whitened differences belong to the later rows.
    return np.asarray(mean[mean.size - count :])
