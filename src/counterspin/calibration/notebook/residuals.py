"""Residuals of a fit: whole for a notebook, and thinned so that a report draws them by itself."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from counterspin.arrays import Array, median
from counterspin.calibration.joint_problem import AccelerometerView
from counterspin.calibration.observed import ObservedRun
from counterspin.calibration.result_parts import Fold, Quantiles, Spectrum, Trace
from counterspin.frozen import frozen
from counterspin.inference.distributions import normal_cdf, normal_quantile
from counterspin.physics import observation
from counterspin.physics.spindle import TURN

if TYPE_CHECKING:
    import polars as pl

    from counterspin.calibration.result_parts import AccelerometerResult
    from counterspin.inference.joint.fit import JointFit
    from counterspin.reports.blocks import Picture


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


@frozen(eq=False)
class RunResiduals:
    """What a fit leaves of one accelerometer's record in one run, outliers left out."""

    #: Whose, and the unit of the record: m, m/s or m/s^2.
    accelerometer: str
    run: str
    unit: str
    #: s from the start of the run, shape (n,); the mean time where samples were averaged.
    time: Array
    count: Array  #: Samples in each mean, shape (n,).
    #: The recorded output less what a perfect accelerometer would have recorded, shape (n,).
    error: Array
    #: What the fit makes of it: the terms, start offset and start velocity, shape (n,).
    fitted: Array
    residual: Array  #: error - fitted, shape (n,).
    #: In rows of unit variance, shape (m,), m <= n: differences belong to the later rows.
    whitened: Array

    def frame(self) -> pl.DataFrame:
        """Return a polars frame of `time`, `count`, `error`, `fitted` and `residual`."""
        import polars as pl

        names = ("time", "count", "error", "fitted", "residual")
        return pl.DataFrame({name: getattr(self, name) for name in names})

    def __repr__(self) -> str:
        """Return whose they are, and how many."""
        return f"<residuals of {self.accelerometer} in {self.run}: {self.time.size} in {self.unit}>"


@frozen(eq=False)
class ReadingResiduals:
    """What a fit leaves of one accelerometer's readings in one motion, in g."""

    #: Whose; the motion stands for the run: static, arm or counter-rotating.
    accelerometer: str
    run: str
    names: tuple[str, ...]  #: Of the readings, n of them.
    value: Array  #: What was read, shape (n,).
    fitted: Array  #: What the fit makes of it, shape (n,).
    residual: Array  #: value - fitted, shape (n,).
    u: Array  #: Standard uncertainty of each reading, shape (n,).

    def frame(self) -> pl.DataFrame:
        """Return a polars frame of `names`, `value`, `fitted`, `residual` and `u`."""
        import polars as pl

        columns = ("names", "value", "fitted", "residual", "u")
        return pl.DataFrame({name: getattr(self, name) for name in columns})

    def __repr__(self) -> str:
        """Return whose they are, and how many."""
        return f"<residuals of {self.accelerometer}, {self.run}: {len(self.names)} readings in g>"


def of_readings(
    accelerometers: Mapping[str, AccelerometerResult],
) -> list[ReadingResiduals]:
    """Return the residuals of every accelerometer's readings, by motion."""
    found = []
    for name, accelerometer in accelerometers.items():
        for motion in dict.fromkeys(reading.motion for reading in accelerometer.readings):
            own = [reading for reading in accelerometer.readings if reading.motion == motion]
            value, residual, u = (
                np.array([getattr(reading, key) for reading in own])
                for key in ("value", "residual", "u")
            )
            names = tuple(reading.name for reading in own)
            found.append(
                ReadingResiduals(name, motion, names, value, value - residual, residual, u)
            )
    return found


def residuals_of(fit: JointFit, units: dict[str, str]) -> tuple[RunResiduals, ...]:
    """Return the residuals of every accelerometer in every run."""
    return tuple(
        RunResiduals(
            accelerometer=prepared.accelerometer,
            run=prepared.run,
            unit=units[prepared.accelerometer],
            time=prepared.series.time,
            count=prepared.series.count,
            error=prepared.series.error,
            fitted=prepared.series.error - left.plain,
            residual=left.plain,
            whitened=left.whitened,
        )
        for prepared, left in zip(fit.prepared, fit.residuals, strict=True)
    )


def choose(
    residuals: Sequence[RunResiduals | ReadingResiduals], accelerometer: str | None, run: str | None
) -> list[RunResiduals | ReadingResiduals]:
    """Return the residuals of one accelerometer, of one run, or of all."""
    chosen = [
        left
        for left in residuals
        if accelerometer in (None, left.accelerometer) and run in (None, left.run)
    ]
    if not chosen:
        known = ", ".join(f"{left.accelerometer} in {left.run}" for left in residuals)
        raise KeyError(f"no residuals of {accelerometer} in {run}; there are those of {known}")
    return chosen


def displacement_pictures(
    residuals: Sequence[RunResiduals | ReadingResiduals],
) -> list[Picture]:
    """Return what was recorded less the reference, and the fit through it, a picture a run."""
    from counterspin.reports.blocks import Plot, PlotSeries

    words = {"m": "displacement", "m/s": "velocity", "m/s^2": "specific force"}
    return [
        Plot(
            title=f"Error of the {words[left.unit]}: {left.accelerometer} in {left.run}",
            x_label="time, s",
            y_label=f"recorded less reference, {left.unit}",
            series=(
                PlotSeries(
                    "recorded", tuple(left.time), tuple(left.error), kind="points", colour=0
                ),
                PlotSeries("fitted", tuple(left.time), tuple(left.fitted), colour=1),
            ),
        )
        for left in residuals
        if isinstance(left, RunResiduals)
    ]


# Thinned for a result's file


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
