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
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.used_rows import without_waves
from counterspin.inference.noise.model import Noise

#: Of the differences.
_ORDER: Final = 3

#: Squared weights of a third difference, over their sum: whose rows' variances it has.
_WEIGHTS: Final = np.array([1.0, 9.0, 9.0, 1.0]) / 20.0

#: Sum of the squared correlations of third differences: so many tell as much as one row.
_ALIKE: Final = 1.0 + 2.0 * (0.75**2 + 0.3**2 + 0.05**2)

#: Fewest differences of a series from which its noise is taken.
_FEWEST: Final = 40

#: Probability at which even noise is taken for uneven, and the least ratio of two standard
#: deviations that counts: weights that are off by less cost nothing.
_P: Final = 1e-6
_LEAST_RATIO: Final = 1.1

#: Least gain in twice the log-likelihood by noise of the encoder where times are corrected by it.
_LEAST_GAIN: Final = 1.0

#: Trial sizes of the time stamps' noise: its largest variance in a row over the white one.
_TRIALS: Final = np.geomspace(0.1, 1e6, 57)


@frozen
class Uneven:
    """Heteroscedasticity of the white noise of an accelerometer's records."""

    #: Run -> its standard deviation over that of the accelerometer; empty: they are alike.
    runs: Mapping[str, float]
    timing: float  #: Standard deviation of a time stamp that would explain it, s; 0: none.
    #: Standard deviation of a recorded angle, rad, where times are corrected by it; 0: unknown.
    encoder: float = 0.0

    def of(self, series: Series) -> Series:
        """Return a series with this noise."""
        if self.encoder > 0.0:
            return series.with_encoder_noise(self.encoder)
        return series.with_timing(self.timing).louder(self.runs)


def uneven_noise(
    fit: JointFit, series: Sequence[Series], requests: Mapping[str, Noise]
) -> dict[str, Uneven]:
    """Return the heteroscedasticity of estimated white noise, by accelerometer.

    series: With all rows, for the slopes of their signals.
    """
    found = {}
    for name, request in requests.items():
        if encoder := _encoder_noise(fit, name):
            found[name] = Uneven({}, 0.0, encoder)
            continue
        if "white" not in request.wanted or fit.noise[name].sample_variance == 0.0:
            continue
        squares = _squares(fit, name)
        if squares and (one := _uneven(fit, series, squares, fit.noise[name])) is not None:
            found[name] = one
    return found


def noise_by_run(fit: JointFit, accelerometer: str) -> Mapping[str, float]:
    """Return each run's white noise over what the fit takes it for; empty where runs are alike."""
    squares = _squares(fit, accelerometer)
    found = _by_run(fit, squares) if squares else None
    return {} if found is None else found[1].runs


def _squares(fit: JointFit, accelerometer: str) -> dict[int, Array]:
    """Return the squares of third differences, of mean 1 where the noise is even, by series.

    Where they are uneven, what goes with the spindle is taken away first: of an error of the
    encoder they leave a high harmonic.
    """
    left = {
        i: fit.residuals[i].whitened
        for i, part in enumerate(fit.prepared)
        if part.accelerometer == accelerometer
        and fit.residuals[i].whitened.size >= _FEWEST + _ORDER
    }
    squares = _differences(left)
    if squares and (_by_run(fit, squares) is not None or _uneven_within(fit, squares)):
        return _differences({i: without_waves(fit.prepared[i].series, o) for i, o in left.items()})
    return squares


def _differences(left: Mapping[int, Array]) -> dict[int, Array]:
    return {i: np.diff(own, _ORDER) ** 2 / 20.0 for i, own in left.items()}


def _uneven(
    fit: JointFit, series: Sequence[Series], squares: Mapping[int, Array], noise: Noise
) -> Uneven | None:
    """Return the best explanation of the sizes of third differences, if there is one."""
    by_run = _by_run(fit, squares)
    if by_run is None and not _uneven_within(fit, squares):
        return None
    by_slope = _by_slope(fit, series, squares, noise)
    candidates = [one for one in (by_run, by_slope) if one is not None]
    return max(candidates, key=lambda one: one[0])[1] if candidates else None


def _certainty(every: Array) -> float:
    """Return how many independent rows a third difference tells as much as.

    Tails longer than a Gaussian's make every sum of squares less certain.
    """
    tails = max(1.0, float(np.mean((every / np.mean(every) - 1.0) ** 2)) / 2.0)
    return 1.0 / (_ALIKE * tails)


def _by_run(fit: JointFit, squares: Mapping[int, Array]) -> tuple[float, Uneven] | None:
    """Return the runs' own sizes and how far their gain is beyond that of chance; None: alike.

    Bartlett's test, Proc. R. Soc. A 160 (1937) 268.
    """
    from scipy.special import chdtri

    sizes = {i: float(np.mean(own)) for i, own in squares.items()}
    ratio = math.sqrt(max(sizes.values()) / min(sizes.values()))
    if len(sizes) < 2 or ratio < _LEAST_RATIO:
        return None
    every = np.concatenate(list(squares.values()))
    lost = sum(squares[i].size * math.log(size / np.mean(every)) for i, size in sizes.items())
    gain = -_certainty(every) * lost
    beyond = gain - float(chdtri(len(sizes) - 1, _P))
    runs = {fit.prepared[i].run: math.sqrt(size) for i, size in sizes.items()}
    return (beyond, Uneven(runs, 0.0)) if beyond > 0.0 else None


def _uneven_within(fit: JointFit, squares: Mapping[int, Array]) -> bool:
    """Return whether squares follow twice the angle or the time, as slopes do, in any run."""
    from scipy.special import chdtrc

    smallest = 1.0
    for i, own in squares.items():
        series = fit.prepared[i].series
        time = series.time[-own.size :]
        twice = 2.0 * series.trajectory.spindle.angle(time)
        shape = np.column_stack([np.ones(own.size), np.cos(twice), np.sin(twice), time])
        found = np.linalg.lstsq(shape, own, rcond=None)[0]
        explained = np.sum((shape @ found - own.mean()) ** 2) / (2.0 * own.mean() ** 2)
        smallest = min(smallest, float(chdtrc(3, _certainty(own) * explained)))
    return smallest < _P


def _by_slope(
    fit: JointFit,
    series: Sequence[Series],
    squares: Mapping[int, Array],
    noise: Noise,
) -> tuple[float, Uneven] | None:
    """Return noise of the time stamps and how far its gain is beyond that of chance; None: none.

    The likelihood of the squares where their means go with 1 + (timing x slope)^2/white^2.
    """
    if any(fit.prepared[i].series.jitter > 0.0 for i in squares):
        return None
    slopes = {
        i: _slope_squared(fit.prepared[i].series, series[i], len(own)) for i, own in squares.items()
    }
    from scipy.special import chdtri

    gain, ratio, variance = _likeliest(squares, slopes)
    beyond = gain - float(chdtri(1, _P))
    if beyond <= 0.0 or ratio < _LEAST_RATIO:
        return None
    return beyond, Uneven({}, math.sqrt(variance * noise.sample_variance))


def _likeliest(
    squares: Mapping[int, Array], slopes: Mapping[int, Array]
) -> tuple[float, float, float]:
    """Return the likeliest noise of squares whose means are a constant plus it times the slopes.

    slopes: Squared, by series.
    Returns: Twice its gain in log-likelihood over even noise, the largest ratio of two rows'
        standard deviations, and the variance of the noise.
    """
    largest = max(float(one.max()) for one in slopes.values())
    if largest == 0.0:
        return 0.0, 1.0, 0.0
    slope = np.concatenate(list(slopes.values())) / largest
    every = np.concatenate(list(squares.values()))
    part = _certainty(every)

    def gained(size: float) -> float:
        """Return twice the gain in log-likelihood over even noise."""
        shape = 1.0 + size * slope
        level = math.log(np.mean(every / shape)) - math.log(np.mean(every))
        return -part * (float(np.sum(np.log(shape))) + every.size * level)

    size = float(max(_TRIALS, key=gained))
    fine = size * np.geomspace(0.75, 1.33, 21)
    size = float(max(fine, key=gained))
    level = float(np.mean(every / (1.0 + size * slope)))
    return gained(size), math.sqrt(1.0 + size), size * level / largest


def _encoder_noise(fit: JointFit, accelerometer: str) -> float:
    """Return the noise of the encoder that corrected times show, rad; 0: stated, or none.

    That time stamps err is known by then, so that it needs no test.
    """
    squares, slopes = {}, {}
    for i, part in enumerate(fit.prepared):
        series, stamps = part.series, part.series.stamps
        if part.accelerometer != accelerometer or stamps is None or stamps.share == 0.0:
            continue
        if series.jitter > 0.0:
            return 0.0
        weight = np.sqrt(series.count / series.relative)
        left = without_waves(series, fit.residuals[i].plain * weight)
        squares[i] = np.diff(left, _ORDER) ** 2 / 20.0
        slope = np.add(*series.slopes()) / series.trajectory.spindle.rate
        moved = stamps.share * slope**2
        slopes[i] = np.asarray(np.convolve(moved / series.relative, _WEIGHTS, mode="valid"))
    if not squares:
        return 0.0
    gain, _, variance = _likeliest(squares, slopes)
    return math.sqrt(variance) if gain > _LEAST_GAIN else 0.0


def _slope_squared(kept: Series, whole: Series, count: int) -> Array:
    """Return the mean square of the slope in the rows of each third difference, (count,)."""
    ideal, of_error = whole.slopes()
    squared = ((ideal + of_error) ** 2)[np.isin(whole.time, kept.time)]
    mean = np.convolve(squared, _WEIGHTS, mode="valid")
    # Whitened differences belong to the later rows.
    return np.asarray(mean[mean.size - count :])
