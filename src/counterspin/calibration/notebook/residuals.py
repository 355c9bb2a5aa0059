"""Whole residuals of a joint fit as arrays, for an analysis of one's own.

- `RunResiduals`: of one accelerometer in one run
- `residuals_of`: of all of a fit
- `choose`: of one accelerometer, of one run
- `displacement_pictures`: what was recorded and what was fitted, as pictures
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from counterspin.arrays import Array
from counterspin.frozen import frozen

if TYPE_CHECKING:
    import polars as pl

    from counterspin.inference.joint.fit import JointFit
    from counterspin.reports.blocks import Picture


@frozen(eq=False)
class RunResiduals:
    """What a fit leaves of one accelerometer's record in one run, outliers left out.

    Attributes
    ----------
    accelerometer, run, unit
        Whose, and the unit of the record: m, m/s or m/s^2.
    time
        s from the start of the run, shape (n,); the mean time where samples were averaged.
    count
        Samples in each mean, shape (n,).
    error
        The recorded output less what a perfect accelerometer would have recorded, shape (n,).
    fitted
        What the fit makes of it: the terms, start offset and start velocity, shape (n,).
    residual
        error - fitted, shape (n,).
    whitened
        In rows of unit variance, shape (m,), m <= n: differences belong to the later rows.
    """

    accelerometer: str
    run: str
    unit: str
    time: Array
    count: Array
    error: Array
    fitted: Array
    residual: Array
    whitened: Array

    def frame(self) -> pl.DataFrame:
        """Return a polars frame of `time`, `count`, `error`, `fitted` and `residual`."""
        import polars as pl

        names = ("time", "count", "error", "fitted", "residual")
        return pl.DataFrame({name: getattr(self, name) for name in names})

    def __repr__(self) -> str:
        """Return whose they are, and how many."""
        return f"<residuals of {self.accelerometer} in {self.run}: {self.time.size} in {self.unit}>"


def residuals_of(fit: JointFit, units: dict[str, str]) -> tuple[RunResiduals, ...]:
    """Return the residuals of every accelerometer in every run.

    Parameters
    ----------
    fit
        The solved problem.
    units
        Accelerometer -> unit of its records.
    """
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
    residuals: Sequence[RunResiduals], accelerometer: str | None, run: str | None
) -> list[RunResiduals]:
    """Return the residuals of one accelerometer, of one run, or of all.

    Raises
    ------
    KeyError
        If there are none; the message lists those that there are.
    """
    chosen = [
        left
        for left in residuals
        if accelerometer in (None, left.accelerometer) and run in (None, left.run)
    ]
    if not chosen:
        known = ", ".join(f"{left.accelerometer} in {left.run}" for left in residuals)
        raise KeyError(f"no residuals of {accelerometer} in {run}; there are those of {known}")
    return chosen


def displacement_pictures(residuals: Sequence[RunResiduals]) -> list[Picture]:
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
    ]
