"""What a report draws: parts of a result as plots, bars and heat maps, still without a pen.

- `correlation_map`, `budget_bars`, `jackknife_plot`: of one accelerometer's coefficients
- `residual_plots`: over time by run, over the revolution, their spectrum and their quantiles
- `ripple_plot`: of the runs' rotation
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from counterspin.calibration.result_parts import AccelerometerResult, RunResult, Trace
from counterspin.reports.blocks import Bars, HeatMap, Plot, PlotSeries
from counterspin.reports.numbers import field_unit, format_share, format_uncertainty

#: More curves than this in one plot are not told apart: the runs then take several plots.
_CURVES: Final = 6

#: Residuals are drawn in the unit in which they are mostly small numbers.
_SMALL: Final = {"m": ("mm", 1e3), "m/s": ("mm/s", 1e3), "m/s^2": ("mm/s^2", 1e3)}

_COVERAGE_FACTOR: Final = 1.96


def correlation_map(name: str, accelerometer: AccelerometerResult) -> HeatMap | None:
    """Return the correlations of the estimates; None where there are fewer than two."""
    if accelerometer.correlation is None or len(accelerometer.correlation.terms) < 2:
        return None
    return HeatMap(
        title=f"Correlation of the estimates, {name}",
        labels=tuple(accelerometer.correlation.terms),
        values=tuple(tuple(row) for row in accelerometer.correlation.matrix),
    )


def budget_bars(name: str, accelerometer: AccelerometerResult, symbol: str = "K_II") -> Bars | None:
    """Return each source's contribution to the uncertainty of a coefficient; None without one."""
    lines, coefficient = (
        accelerometer.budget.get(symbol, []),
        accelerometer.coefficients.get(symbol),
    )
    if not lines or coefficient is None:
        return None
    unit, factor = field_unit(coefficient.unit)
    return Bars(
        title=f"Contributions to u({symbol}) of {name}, {unit}",
        labels=tuple(line.source for line in lines),
        values=tuple(line.contribution * factor for line in lines),
        texts=tuple(
            f"{format_uncertainty(line.contribution * factor)} ({format_share(line.share)})"
            for line in lines
        ),
    )


def jackknife_plot(name: str, accelerometer: AccelerometerResult) -> Plot | None:
    """Return K_II without each run beside K_II of all; None where no run could be left out."""
    k_ii = accelerometer.coefficients.get("K_II")
    lines = [line for line in accelerometer.jackknife if line.value is not None]
    if k_ii is None or k_ii.value is None or k_ii.u is None or not lines:
        return None
    unit, factor = field_unit(k_ii.unit)
    value, u = k_ii.value * factor, k_ii.u * factor
    places = tuple(float(place) for place in range(len(lines)))
    # What the shift may be is its standard uncertainty, shift / z.
    spreads = [
        abs(line.shift / line.z) * factor if line.shift is not None and line.z else 0.0
        for line in lines
    ]
    shown = [line.value * factor for line in lines if line.value is not None]
    ends = (places[0] - 0.5, places[-1] + 0.5)
    return Plot(
        title=f"K_II of {name} with each run left out",
        x_label="run left out",
        y_label=f"K_II, {unit}",
        series=(
            PlotSeries(
                "all runs ± u",
                ends,
                (value, value),
                low=(value - u, value - u),
                high=(value + u, value + u),
                kind="band",
            ),
            PlotSeries(
                "without this run; bar: standard uncertainty of the shift",
                places,
                tuple(shown),
                low=tuple(y - s for y, s in zip(shown, spreads, strict=True)),
                high=tuple(y + s for y, s in zip(shown, spreads, strict=True)),
                kind="points",
            ),
        ),
        x_names=tuple(line.run for line in lines),
    )


def residual_plots(name: str, accelerometer: AccelerometerResult) -> Iterator[Plot]:
    """Yield the pictures of an accelerometer's residuals; none where none were kept."""
    unit, factor = _SMALL.get(accelerometer.residual.unit, (accelerometer.residual.unit, 1.0))
    for run, trace in accelerometer.traces.items():
        yield _over_time(name, run, trace, unit, factor)
    traces = list(accelerometer.traces.items())
    for first in range(0, len(traces), _CURVES):
        runs = traces[first : first + _CURVES]
        yield from _over_angle(name, runs, unit, factor)
        yield from _spectra(name, runs)
        yield from _quantiles(name, runs)


def _over_time(name: str, run: str, trace: Trace, unit: str, factor: float) -> Plot:
    time = tuple(trace.time)
    low = tuple(value * factor for value in trace.low)
    high = tuple(value * factor for value in trace.high)
    middle = tuple(0.5 * (a + b) for a, b in zip(low, high, strict=True))
    series = [PlotSeries("smallest to largest", time, middle, low, high, kind="band")]
    if trace.left_out:
        times, values = zip(*trace.left_out, strict=True)
        series.append(
            PlotSeries(
                "left out as outliers",
                tuple(times),
                tuple(value * factor for value in values),
                kind="points",
                stands_out=True,
            )
        )
    return Plot(
        title=f"Residuals of {name}, {run}",
        x_label="time, s",
        y_label=f"residual, {unit}",
        series=tuple(series),
        levels=(0.0,),
        zoom=True,
    )


def _over_angle(
    name: str, runs: Sequence[tuple[str, Trace]], unit: str, factor: float
) -> Iterator[Plot]:
    series = []
    for run, trace in runs:
        if trace.by_angle is not None:
            mean = trace.by_angle.mean
            step = 360.0 / len(mean)
            series.append(
                PlotSeries(
                    run,
                    tuple((part + 0.5) * step for part in range(len(mean))),
                    tuple(None if value is None else value * factor for value in mean),
                )
            )
    if series:
        yield Plot(
            title=f"Mean residual of {name} over the revolution",
            x_label="angle of the spindle, deg",
            y_label=f"mean residual, {unit}",
            series=tuple(series),
            levels=(0.0,),
        )


def _spectra(name: str, runs: Sequence[tuple[str, Trace]]) -> Iterator[Plot]:
    series = [
        PlotSeries(run, tuple(trace.spectrum.frequency), tuple(trace.spectrum.power))
        for run, trace in runs
        if trace.spectrum is not None and len(trace.spectrum.frequency) > 1
    ]
    if series:
        yield Plot(
            title=f"Spectrum of the whitened residuals of {name}; white noise is 1",
            x_label="frequency, Hz",
            y_label="power",
            series=tuple(series),
            levels=(1.0,),
            log_x=True,
            log_y=True,
        )


def _quantiles(name: str, runs: Sequence[tuple[str, Trace]]) -> Iterator[Plot]:
    kept = [(run, trace.quantiles) for run, trace in runs if trace.quantiles is not None]
    if kept:
        reach = math.ceil(max(max(map(abs, quantiles.normal)) for _, quantiles in kept))
        yield Plot(
            title=f"Whitened residuals of {name} beside a normal distribution",
            x_label="quantile of the normal distribution",
            y_label="whitened residual",
            series=(
                PlotSeries("normal", (-reach, reach), (-reach, reach)),
                *(
                    PlotSeries(run, tuple(quantiles.normal), tuple(quantiles.found), kind="points")
                    for run, quantiles in kept
                ),
            ),
        )


def ripple_plot(runs: Mapping[str, RunResult]) -> Plot | None:
    """Return the ripples found in the runs, in parts per million of the rate; None without any."""
    series = []
    for name, run in runs.items():
        if run.ripples:
            scale = 1e6 / abs(run.rate)
            amplitudes = [ripple.amplitude * scale for ripple in run.ripples]
            widths = [_COVERAGE_FACTOR * ripple.u_amplitude * scale for ripple in run.ripples]
            series.append(
                PlotSeries(
                    name,
                    tuple(float(ripple.harmonic) for ripple in run.ripples),
                    tuple(amplitudes),
                    low=tuple(a - w for a, w in zip(amplitudes, widths, strict=True)),
                    high=tuple(a + w for a, w in zip(amplitudes, widths, strict=True)),
                    kind="points",
                )
            )
    if not series:
        return None
    return Plot(
        title="Ripple of the rate by harmonic; bars: 95 %",
        x_label="harmonic of the revolution",
        y_label="amplitude, ppm of the rate",
        series=tuple(series),
        levels=(0.0,),
    )
