"""Whole residuals of a joint fit as arrays, for an analysis of one's own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen

if TYPE_CHECKING:
    import polars as pl

    from counterspin.calibration.result_parts import AccelerometerResult
    from counterspin.inference.joint.fit import JointFit
    from counterspin.reports.blocks import Picture


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
