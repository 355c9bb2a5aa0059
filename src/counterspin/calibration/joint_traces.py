"""The residuals of a joint fit, thinned so that a report can draw them without the records.

- `traces`: by run, for one accelerometer
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.observed import ObservedRun
from counterspin.calibration.result_parts import Fold, Quantiles, Spectrum, Trace
from counterspin.inference.diagnostics import Diagnostics
from counterspin.inference.joint import fit as fitting
from counterspin.inference.joint.estimation import Estimate, Rows
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.thinning import (
    normal_quantiles,
    over_revolution,
    smoothed_spectrum,
    stretches,
)
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

#: Residuals below this size are none, but zero or the rounding of data without noise.
_SMALL: Final = 1e-15


def traces(
    observed: Sequence[ObservedRun],
    series: Sequence[Series],
    found: Estimate,
    name: str,
    tests: Diagnostics,
) -> dict[str, Trace]:
    """Return the residuals of one accelerometer by run, thinned.

    Parameters
    ----------
    observed
        The campaign's runs.
    series
        What the fit was given, outliers still in.
    found
        The fit.
    name
        The accelerometer.
    tests
        Of its residuals.
    """
    share = _ALL_STRETCHES // max(len(series), 1)
    count = min(max(share, _FEWEST_STRETCHES), _MOST_STRETCHES)
    runs = {run.run.name: run for run in observed}
    return {
        one.run: _trace(runs[one.run], one, found, index, count, tests.runs[one.run].periodogram)
        for index, one in enumerate(series)
        if one.accelerometer == name
    }


def _trace(
    run: ObservedRun, series: Series, found: Estimate, index: int, count: int, periodogram: Array
) -> Trace:
    kept = found.fit.prepared[index].series
    residual, whitened = fitting.residuals(found.fit, index)
    time, low, high = stretches(kept.time, residual, count)
    angle = kept.trajectory.spindle.angle(kept.time)
    for parts in _PARTS_OF_REVOLUTION:
        folded = over_revolution(angle, residual, parts)
        if np.isfinite(folded[1]).all():
            break
    interval = float(np.median(np.diff(kept.time)))
    normal, ordered = normal_quantiles(whitened, _QUANTILES)
    frequency, power = smoothed_spectrum(periodogram, whitened.size * interval, _BANDS)
    return Trace(
        time=_rounded(time, 6),
        low=_rounded(low),
        high=_rounded(high),
        left_out=_left_out(run, series, kept, residual, found.outliers[index]),
        by_angle=Fold(**dict(zip(("low", "mean", "high"), map(_gaps, folded), strict=True))),
        spectrum=Spectrum(frequency=_rounded(frequency), power=_rounded(power)),
        quantiles=Quantiles(normal=_rounded(normal), found=_rounded(ordered)),
    )


def _left_out(
    run: ObservedRun, series: Series, kept: Series, residual: Array, outliers: Rows
) -> list[tuple[float, float]]:
    """Return times and residuals of what reading and the fit have left out as outliers.

    The model there is that of the neighbours: once the reference is taken away it is smooth.
    """
    report, channel = run.record.report, run.signals[series.accelerometer].accelerometer.channel
    listed = [outlier for outlier in report.listed if outlier.column == channel.column]
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
    ordinary = (size > _SMALL) & (size < 1.0 / _SMALL)
    places = digits - 1.0 - np.floor(np.log10(size, where=ordinary, out=np.zeros_like(size)))
    # Whole numbers and these powers of ten are exact, so that one division rounds correctly.
    up, down = 10.0 ** np.maximum(places, 0.0), 10.0 ** np.maximum(-places, 0.0)
    rounded = np.rint(values * up / down) / up * down
    rest = [float(f"{value:.{digits}g}") for value in values[~ordinary].tolist()]
    rounded[~ordinary] = rest
    found: list[float] = rounded.tolist()
    return found
