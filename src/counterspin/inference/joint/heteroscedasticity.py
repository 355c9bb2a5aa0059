"""White noise that is found in records and differs from row to row.

The noise of an accelerometer is found as one for all of its records. Two things often make it
uneven: a run that is noisier than the others, as vibration makes a fast one, and time stamps that
scatter, whose noise follows the slope of the signal. Weights that do not know of it waste the quiet
rows, and u of what rests on the noisy ones is too small.

Both are looked for in third differences of the whitened residuals, in which nothing slow is left:
a misfit of the model is not taken for noise. Where the noise is even, their squares have the mean
1. Of independent rows, a third difference has correlations of -3/4, 3/10 and -1/20 with the next
ones, so that n of them tell as much as n/2.31 rows.
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

#: Of the differences.
_ORDER: Final = 3

#: Squared weights of a third difference, over their sum: whose rows' variances it has.
_WEIGHTS: Final = np.array([1.0, 9.0, 9.0, 1.0]) / 20.0

#: Sum of the squared correlations of third differences: so many tell as much as one row.
_CORRELATION_FACTOR: Final = 1.0 + 2.0 * (0.75**2 + 0.3**2 + 0.05**2)

#: Fewest differences of a series from which its noise is taken.
_MIN_DIFFERENCES: Final = 40

#: Probability at which even noise is taken for uneven, and the least ratio of two standard
#: deviations that counts: weights that are off by less cost nothing.
_SIGNIFICANCE: Final = 1e-6
_MIN_SD_RATIO: Final = 1.1

#: Least gain in twice the log-likelihood by noise of the encoder where times are corrected by it.
_MIN_GAIN: Final = 1.0

#: Trial sizes of the time stamps' noise: its largest variance in a row over the white one.
_TRIAL_RATIOS: Final = np.geomspace(0.1, 1e6, 57)


@frozen
class VarianceModel:
    """Heteroscedasticity of the white noise of an accelerometer's records."""

    #: Run -> its standard deviation over that of the accelerometer; empty: they are alike.
    run_ratios: Mapping[str, float]
    timestamp_sd: float  #: Standard deviation of a time stamp that would explain it, s; 0: none.
    #: Standard deviation of a recorded angle, rad, where times are corrected by it; 0: unknown.
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

    series: With all rows, for the slopes of their signals.
    """
    models = {}
    for name, request in requests.items():
        if encoder := _estimate_encoder_noise(fit, name):
            models[name] = VarianceModel({}, 0.0, encoder)
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
    """Return each run's white noise over what the fit takes it for; empty where runs are alike."""
    squares = _squared_differences(fit, accelerometer)
    variance_fit = _fit_run_variances(fit, squares) if squares else None
    return {} if variance_fit is None else variance_fit[1].run_ratios


def _squared_differences(fit: JointFit, accelerometer: str) -> dict[int, Array]:
    """Return the squares of third differences, of mean 1 where the noise is even, by series.

    Where they are uneven, what goes with the spindle is taken away first: of an error of the
    encoder they leave a high harmonic.
    """
    residuals = {
        i: fit.residuals[i].whitened
        for i, block in enumerate(fit.design_blocks)
        if block.accelerometer == accelerometer
        and fit.residuals[i].whitened.size >= _MIN_DIFFERENCES + _ORDER
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
    return {i: np.diff(values, _ORDER) ** 2 / 20.0 for i, values in residuals.items()}


def _best_variance_model(
    fit: JointFit, series: Sequence[ResidualSeries], squares: Mapping[int, Array], noise: Noise
) -> VarianceModel | None:
    """Return the best explanation of the sizes of third differences, if there is one."""
    by_run = _fit_run_variances(fit, squares)
    if by_run is None and not _varies_within_run(fit, squares):
        return None
    by_slope = _fit_timestamp_noise(fit, series, squares, noise)
    candidates = [candidate for candidate in (by_run, by_slope) if candidate is not None]
    return max(candidates, key=lambda candidate: candidate[0])[1] if candidates else None


def _information_per_row(squares: Array) -> float:
    """Return how many independent rows a third difference tells as much as.

    Tails longer than a Gaussian's make every sum of squares less certain.
    """
    tails = max(1.0, float(np.mean((squares / np.mean(squares) - 1.0) ** 2)) / 2.0)
    return 1.0 / (_CORRELATION_FACTOR * tails)


def _fit_run_variances(
    fit: JointFit, squares: Mapping[int, Array]
) -> tuple[float, VarianceModel] | None:
    """Return the runs' own sizes and how far their gain is beyond that of chance; None: alike.

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
    excess = gain - float(chdtri(len(variances) - 1, _SIGNIFICANCE))
    runs = {fit.design_blocks[i].run: math.sqrt(variance) for i, variance in variances.items()}
    return (excess, VarianceModel(runs, 0.0)) if excess > 0.0 else None


def _varies_within_run(fit: JointFit, squares: Mapping[int, Array]) -> bool:
    """Return whether squares follow twice the angle or the time, as slopes do, in any run."""
    from scipy.special import chdtrc

    smallest = 1.0
    for i, values in squares.items():
        series = fit.design_blocks[i].series
        time = series.time[-values.size :]
        double_angle = 2.0 * series.trajectory.spindle.angle(time)
        regressors = np.column_stack(
            [np.ones(values.size), np.cos(double_angle), np.sin(double_angle), time]
        )
        coefficients = np.linalg.lstsq(regressors, values, rcond=None)[0]
        r_squared = np.sum((regressors @ coefficients - values.mean()) ** 2) / (
            2.0 * values.mean() ** 2
        )
        smallest = min(smallest, float(chdtrc(3, _information_per_row(values) * r_squared)))
    return smallest < _SIGNIFICANCE


def _fit_timestamp_noise(
    fit: JointFit,
    series: Sequence[ResidualSeries],
    squares: Mapping[int, Array],
    noise: Noise,
) -> tuple[float, VarianceModel] | None:
    """Return noise of the time stamps and how far its gain is beyond that of chance; None: none.

    The likelihood of the squares where their means go with 1 + (timing x slope)^2/white^2.
    """
    if any(fit.design_blocks[i].series.timing_noise > 0.0 for i in squares):
        return None
    slopes = {
        i: _mean_squared_slope(fit.design_blocks[i].series, series[i], len(values))
        for i, values in squares.items()
    }
    from scipy.special import chdtri

    gain, ratio, variance = _maximize_slope_model(squares, slopes)
    excess = gain - float(chdtri(1, _SIGNIFICANCE))
    if excess <= 0.0 or ratio < _MIN_SD_RATIO:
        return None
    return excess, VarianceModel({}, math.sqrt(variance * noise.sample_variance))


def _maximize_slope_model(
    squares: Mapping[int, Array], slopes: Mapping[int, Array]
) -> tuple[float, float, float]:
    """Return the likeliest noise of squares whose means are a constant plus it times the slopes.

    slopes: Squared, by series.
    Returns: Twice its gain in log-likelihood over even noise, the largest ratio of two rows'
        standard deviations, and the variance of the noise.
    """
    largest = max(float(values.max()) for values in slopes.values())
    if largest == 0.0:
        return 0.0, 1.0, 0.0
    slope = np.concatenate(list(slopes.values())) / largest
    all_squares = np.concatenate(list(squares.values()))
    information = _information_per_row(all_squares)

    def gained(best_ratio: float) -> float:
        """Return twice the gain in log-likelihood over even noise."""
        shape = 1.0 + best_ratio * slope
        level = math.log(np.mean(all_squares / shape)) - math.log(np.mean(all_squares))
        return -information * (float(np.sum(np.log(shape))) + all_squares.size * level)

    best_ratio = float(max(_TRIAL_RATIOS, key=gained))
    refined_ratios = best_ratio * np.geomspace(0.75, 1.33, 21)
    best_ratio = float(max(refined_ratios, key=gained))
    level = float(np.mean(all_squares / (1.0 + best_ratio * slope)))
    return gained(best_ratio), math.sqrt(1.0 + best_ratio), best_ratio * level / largest


def _estimate_encoder_noise(fit: JointFit, accelerometer: str) -> float:
    """Return the noise of the encoder that corrected times show, rad; 0: stated, or none.

    That time stamps err is known by then, so that it needs no test.
    """
    squares, slopes = {}, {}
    for i, block in enumerate(fit.design_blocks):
        series, stamps = block.series, block.series.timestamp_errors
        if block.accelerometer != accelerometer or stamps is None or stamps.fraction == 0.0:
            continue
        if series.timing_noise > 0.0:
            return 0.0
        weight = np.sqrt(series.count / series.variance_ratio)
        residuals = remove_harmonics(series, fit.residuals[i].unweighted * weight)
        squares[i] = np.diff(residuals, _ORDER) ** 2 / 20.0
        slope = np.add(*series.slopes()) / series.trajectory.spindle.rate
        squared_slope = stamps.fraction * slope**2
        slopes[i] = np.asarray(
            np.convolve(squared_slope / series.variance_ratio, _WEIGHTS, mode="valid")
        )
    if not squares:
        return 0.0
    gain, _, variance = _maximize_slope_model(squares, slopes)
    return math.sqrt(variance) if gain > _MIN_GAIN else 0.0


def _mean_squared_slope(thinned: ResidualSeries, full: ResidualSeries, count: int) -> Array:
    """Return the mean square of the slope in the rows of each third difference, (count,)."""
    ideal, error_slope = full.slopes()
    squared_slope = ((ideal + error_slope) ** 2)[np.isin(full.time, thinned.time)]
    mean = np.convolve(squared_slope, _WEIGHTS, mode="valid")
    # Whitened differences belong to the later rows.
    return np.asarray(mean[mean.size - count :])
