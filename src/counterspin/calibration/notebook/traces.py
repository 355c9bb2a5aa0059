"""The residuals of a joint fit, thinned so that a report can draw them without the records."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from counterspin.arrays import Array, median
from counterspin.calibration.joint_view import AccelerometerView
from counterspin.calibration.notebook.thinning import (
    normal_quantiles,
    over_revolution,
    smoothed_spectrum,
    stretches,
)
from counterspin.calibration.observed import ObservedRun
from counterspin.calibration.result_parts import Fold, Quantiles, Spectrum, Trace
from counterspin.physics import observation

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
    kept = view.fit.prepared[index].series
    residual, whitened = view.fit.residuals[index].plain, view.fit.residuals[index].whitened
    periodogram = view.diagnostics.runs[kept.run].periodogram
    share = _ALL_STRETCHES // len(view.fit.prepared)
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
    kept, residual = view.fit.prepared[index].series, view.fit.residuals[index].plain
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
