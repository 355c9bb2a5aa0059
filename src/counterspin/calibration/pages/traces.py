"""Residuals of a fit, thinned so that the file of a result holds what its pictures show."""

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

#: Stretches of all traces of a result together, and the most and the fewest of one.
_ALL_STRETCHES: Final = 12000
_MOST_STRETCHES: Final = 1500
_FEWEST_STRETCHES: Final = 100

#: Parts of a revolution: as many as all have samples, for a record in step with the spindle
#: shows the same few angles again and again.
_PARTS_OF_REVOLUTION: Final = (60, 30, 15)

_BANDS: Final = 100
_QUANTILES: Final = 120
_MOST_LEFT_OUT: Final = 100

#: Significant digits: a picture shows three.
_DIGITS: Final = 4

#: Residuals below this size are zero or the rounding of data without noise.
_ROUNDING: Final = 1e-15


def traces(view: AccelerometerView) -> dict[str, Trace]:
    """Return the residuals of one accelerometer by run, thinned."""
    runs = {run.run.name: run for run in view.problem.observed}
    return {
        prepared.run: _trace(view, index, runs[prepared.run])
        for index, prepared, _ in view.records()
    }


def _trace(view: AccelerometerView, index: int, run: ObservedRun) -> Trace:
    kept = view.fit.design_blocks[index].series
    residual, whitened = view.fit.residuals[index].unweighted, view.fit.residuals[index].whitened
    periodogram = view.diagnostics.runs[kept.run].periodogram
    share = _ALL_STRETCHES // len(view.fit.design_blocks)
    count = min(max(share, _FEWEST_STRETCHES), _MOST_STRETCHES)
    time, low, high = stretches(kept.time, residual, count)
    angle = kept.trajectory.spindle.angle(kept.time)
    for parts in _PARTS_OF_REVOLUTION:
        folded = over_revolution(angle, residual, parts)
        if np.isfinite(folded[1]).all():
            break
    interval = median(np.diff(kept.time))
    normal, ordered = normal_quantiles(whitened, _QUANTILES)
    frequency, power, lines = smoothed_spectrum(periodogram, whitened.size * interval, _BANDS)
    (rms,) = _rounded(np.sqrt([np.mean(residual**2)]))
    return Trace(
        rows=residual.size,
        rms=rms,
        time=_rounded(time, 6),
        low=_rounded(low),
        high=_rounded(high),
        left_out=_left_out(view, index, run),
        by_angle=Fold(**dict(zip(("low", "mean", "high"), map(_gaps, folded), strict=True))),
        spectrum=Spectrum(
            frequency=_rounded(frequency), power=_rounded(power), lines=lines.tolist()
        ),
        quantiles=Quantiles(normal=_rounded(normal), found=_rounded(ordered)),
    )


def _left_out(view: AccelerometerView, index: int, run: ObservedRun) -> list[tuple[float, float]]:
    """Return times and residuals of what reading and the fit have left out as outliers.

    The model there is that of the neighbours: once the reference is taken away it is smooth.
    """
    series, outliers = view.estimate.series[index], view.estimate.outliers[index]
    kept, residual = view.fit.design_blocks[index].series, view.fit.residuals[index].unweighted
    column = view.accelerometer.channel.name
    listed = [outlier for outlier in run.record.report.listed if outlier.column == column]
    while_reading = np.array([outlier.time - run.record.start_time for outlier in listed])
    values = np.array([outlier.value for outlier in listed])
    reference = observation.reference(
        kept.trajectory, kept.mounting, while_reading, kept.observable, kept.attitude
    )
    time = np.concatenate([series.time[outliers], while_reading])
    error = np.concatenate([series.error[outliers], values - reference])
    distance = error - np.interp(time, kept.time, kept.error - residual)
    largest = np.sort(np.argsort(-np.abs(distance), kind="stable")[:_MOST_LEFT_OUT])
    order = largest[np.argsort(time[largest], kind="stable")]
    return list(zip(_rounded(time[order], 6), _rounded(distance[order]), strict=True))


def _gaps(values: Array) -> list[float | None]:
    return [None if math.isnan(value) else value for value in _rounded(values)]


def _rounded(values: Array, digits: int = _DIGITS) -> list[float]:
    """Return values with so many significant digits; NaN stays."""
    size = np.abs(values)
    ordinary = (size > _ROUNDING) & (size < 1.0 / _ROUNDING)
    places = digits - 1.0 - np.floor(np.log10(size, where=ordinary, out=np.zeros_like(size)))
    # Whole numbers and these powers of ten are exact, so that one division rounds correctly.
    up, down = 10.0 ** np.maximum(places, 0.0), 10.0 ** np.maximum(-places, 0.0)
    rounded = np.rint(values * up / down) / up * down
    rest = [float(f"{value:.{digits}g}") for value in values[~ordinary].tolist()]
    rounded[~ordinary] = rest
    numbers: list[float] = rounded.tolist()
    return numbers


# Few points that show what many would


def stretches(time: Array, values: Array, count: int) -> tuple[Array, Array, Array]:
    """Return middle times, smallest and largest values of at most `count` stretches of samples.

    The stretches hold equally many samples, so that a gap in the record stays one, and no sample
    however far out is lost.

    time, values: Shape (n,), n >= 1, in the order of time.
    count: At least 1.
    """
    first = _distinct(np.arange(count) * time.size // count)
    last = np.append(first[1:], time.size) - 1
    return (
        0.5 * (time[first] + time[last]),
        np.minimum.reduceat(values, first),
        np.maximum.reduceat(values, first),
    )


def over_revolution(angle: Array, values: Array, parts: int) -> tuple[Array, Array, Array]:
    """Return smallest, mean and largest values in equal parts of a revolution, shape (parts,).

    angle: Of the spindle, rad, any revolution, shape (n,).
    values: Shape (n,).
    """
    place = np.minimum((np.mod(angle, TURN) * (parts / TURN)).astype(np.intp), parts - 1)
    count = np.bincount(place, minlength=parts)
    low, high = np.full(parts, np.inf), np.full(parts, -np.inf)
    np.minimum.at(low, place, values)
    np.maximum.at(high, place, values)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(place, values, minlength=parts) / count
    empty = count == 0
    low[empty], high[empty] = np.nan, np.nan
    return low, mean, high


def smoothed_spectrum(
    power: Array, length: float, count: int
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Return frequencies (Hz), mean power and lines of at most `count` bands; 1 is white noise.

    The bands are equally wide on a logarithmic scale.

    power: The periodogram of whitened residuals, from `counterspin.inference.diagnostics`, shape
        (m,).
    length: Of the record, s: the inverse of the first line's frequency.
    count: At least 1.
    """
    edges = _distinct(np.geomspace(1.0, power.size + 1.0, count + 1).astype(np.intp))
    first, width = edges[:-1], np.diff(edges)
    frequency = (first + 0.5 * (width - 1)) / length
    return frequency, np.add.reduceat(power[: edges[-1] - 1], first - 1) / width, width


def normal_quantiles(whitened: Array, count: int) -> tuple[Array, Array]:
    """Return at most `count` ordered residuals beside the normal scores that belong to them.

    Blom's scores, those of ranks (i - 3/8) / (n + 1/4); the ranks are chosen evenly along them,
    so that the tails are whole where the middle is thinned.

    whitened: Shape (n,), n >= 1.
    count: At least 2.
    Returns: shape (m,), m <= count.
    """
    n = whitened.size
    end = normal_quantile(0.625 / (n + 0.25))
    levels = np.linspace(end, -end, min(count, n)).tolist()
    wanted = np.array([normal_cdf(level) for level in levels]) * (n + 0.25) + 0.375
    ranks = _distinct(np.clip(np.rint(wanted), 1, n).astype(np.intp))
    normal = [normal_quantile(p) for p in ((ranks - 0.375) / (n + 0.25)).tolist()]
    return np.array(normal), np.sort(whitened)[ranks - 1]


def _distinct(ascending: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return each value once; `np.unique` would load the masked arrays at its first call."""
    distinct: NDArray[np.intp] = ascending[np.append(True, np.diff(ascending) > 0)]
    return distinct
