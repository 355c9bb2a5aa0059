"""Pictures of a report: parts of a result as plots, bars and heat maps, still without a pen."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from counterspin.calibration.pages.uncertainty import decisive_lines, label_of
from counterspin.calibration.result_parts import AccelerometerResult, RunResult, Trace
from counterspin.frozen import frozen
from counterspin.reports.blocks import Bars, HeatMap, Plot, PlotSeries
from counterspin.reports.numbers import field_unit, format_share, format_uncertainty

#: More curves than this in one plot cannot be told apart: the runs then take several plots.
_MAX_CURVES: Final = 6

#: Residuals are drawn in the unit in which they are mostly small numbers.
_SMALL: Final = {"m": ("mm", 1e3), "m/s": ("mm/s", 1e3), "m/s^2": ("mm/s^2", 1e3)}

_COVERAGE_FACTOR: Final = 1.96

#: Places in the row of colours.
_COLOUR_OF_KIND: Final = {"noise": 0, "unstated": 1, "stated": 2, "held": 3}
_COLOUR_OF_REST: Final = 5


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
    """Return u^2 of a coefficient as a stacked bar by source, in %; None without a budget."""
    lines, rest = decisive_lines(accelerometer.budget.get(symbol, []))
    coefficient = accelerometer.coefficients.get(symbol)
    if not lines or coefficient is None:
        return None
    unit, factor = field_unit(coefficient.unit)
    labels = [
        line.source if line.kind == "noise" else f"{label_of(line.source)} ({line.kind})"
        for line in lines
    ]
    colours = [_COLOUR_OF_KIND[line.kind] for line in lines]
    parts = [(line.contribution, line.share) for line in lines]
    if rest:
        labels.append(f"{len(rest)} more")
        colours.append(_COLOUR_OF_REST)
        parts.append((math.hypot(*(r.contribution for r in rest)), sum(r.share for r in rest)))
    return Bars(
        title=f"Contributions to u of {symbol} of {name}, in {unit} (share of u^2 in %)",
        labels=tuple(labels),
        values=tuple(100.0 * share for _, share in parts),
        texts=tuple(
            f"{format_uncertainty(size * factor)} ({format_share(share)})" for size, share in parts
        ),
        stacked=True,
        colours=tuple(colours),
        x_label="Cumulative share of u^2, %",
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


def residual_plots(
    name: str, accelerometer: AccelerometerResult, runs: Mapping[str, RunResult]
) -> Iterator[Plot]:
    """Yield the pictures of an accelerometer's residuals; none where none were kept."""
    yield from residuals_over_time(name, accelerometer, runs)
    unit, factor = _unit(accelerometer)
    traces = _traces(accelerometer, runs)
    for first in range(0, len(traces), _MAX_CURVES):
        some = traces[first : first + _MAX_CURVES]
        yield from _over_angle(name, some, unit, factor)
        yield from _spectra(name, some)
        yield from _quantiles(name, some)


def residuals_over_time(
    name: str, accelerometer: AccelerometerResult, runs: Mapping[str, RunResult]
) -> Iterator[Plot]:
    """Yield a picture of the residuals of each run; parameters as for `residual_plots`."""
    for trace in _traces(accelerometer, runs):
        yield _over_time(name, trace, *_unit(accelerometer))


def residual_spectra(
    name: str, accelerometer: AccelerometerResult, runs: Mapping[str, RunResult]
) -> Iterator[Plot]:
    """Yield spectra of the whitened residuals, several runs in a picture."""
    traces = _traces(accelerometer, runs)
    for first in range(0, len(traces), _MAX_CURVES):
        yield from _spectra(name, traces[first : first + _MAX_CURVES])


def _unit(accelerometer: AccelerometerResult) -> tuple[str, float]:
    return _SMALL.get(accelerometer.residual.unit, (accelerometer.residual.unit, 1.0))


def _traces(
    accelerometer: AccelerometerResult, runs: Mapping[str, RunResult]
) -> list[_ResidualTrace]:
    places = {run: place for place, run in enumerate(dict.fromkeys([*runs, *accelerometer.traces]))}
    return [
        _ResidualTrace(
            run, places[run], trace, runs[run].counts.get("block", 1) if run in runs else 1
        )
        for run, trace in accelerometer.traces.items()
    ]


@frozen
class _ResidualTrace:
    """The residuals of a run, its colour and the samples in each mean that was fitted."""

    run: str
    colour: int
    trace: Trace
    block: int


def _over_time(name: str, drawn: _ResidualTrace, unit: str, factor: float) -> Plot:
    trace = drawn.trace
    time = tuple(trace.time)
    low, high = _scaled(trace.low, factor), _scaled(trace.high, factor)
    middle = tuple(0.5 * (a + b) for a, b in zip(low, high, strict=True))
    what = f"means of {drawn.block} samples" if drawn.block > 1 else "samples"
    words = f"{what}, smallest to largest" if low != high else what
    series = [PlotSeries(words, time, middle, low, high, kind="band", colour=drawn.colour)]
    if trace.rms is not None:
        # Two standard deviations, if the model is right.
        label, ends = "± 2 rms", (time[0], time[-1])
        for height in (2.0 * factor * trace.rms, -2.0 * factor * trace.rms):
            series.append(PlotSeries(label, ends, (height, height), colour="muted"))
            label = ""
    if trace.left_out:
        times, values = zip(*trace.left_out, strict=True)
        left_out = _scaled(values, factor)
        words = "left out as outliers"
        series.append(PlotSeries(words, tuple(times), left_out, kind="points", stands_out=True))
    return Plot(
        title=f"Residuals of {name}, {drawn.run}",
        x_label="time, s",
        y_label=f"residual, {unit}",
        series=tuple(series),
        levels=(0.0,),
        zoom=True,
    )


def _over_angle(
    name: str, traces: Sequence[_ResidualTrace], unit: str, factor: float
) -> Iterator[Plot]:
    series = []
    for drawn in traces:
        if drawn.trace.by_angle is not None and drawn.trace.by_angle.mean:
            mean = drawn.trace.by_angle.mean
            step = 360.0 / len(mean)
            places = tuple((part + 0.5) * step for part in range(len(mean)))
            heights = tuple(None if value is None else value * factor for value in mean)
            series.append(PlotSeries(drawn.run, places, heights, colour=drawn.colour))
    if series:
        yield Plot(
            title=f"Mean residual of {name} over the revolution",
            x_label="angle of the spindle, deg",
            y_label=f"mean residual, {unit}",
            series=tuple(series),
            levels=(0.0,),
        )


def _spectra(name: str, traces: Sequence[_ResidualTrace]) -> Iterator[Plot]:
    spectra = [
        (drawn, drawn.trace.spectrum)
        for drawn in traces
        if drawn.trace.spectrum is not None and len(drawn.trace.spectrum.frequency) > 1
    ]
    if not spectra:
        return
    series = []
    # Of the run with the fewest lines, for which it is widest.
    drawn, spectrum = min(spectra, key=lambda pair: sum(pair[1].lines))
    if spectrum.lines:
        low, high = _white_noise(spectrum.lines)
        series.append(
            PlotSeries(
                f"white noise, 95 % ({drawn.run})",
                tuple(spectrum.frequency),
                tuple(0.5 * (a + b) for a, b in zip(low, high, strict=True)),
                low,
                high,
                kind="band",
                colour="muted",
            )
        )
    series += [
        PlotSeries(drawn.run, tuple(spectrum.frequency), tuple(spectrum.power), colour=drawn.colour)
        for drawn, spectrum in spectra
    ]
    yield Plot(
        title=f"Spectrum of the whitened residuals of {name}",
        x_label="frequency, Hz",
        y_label="power, of white noise",
        series=tuple(series),
        levels=(1.0,),
        log_x=True,
        log_y=True,
    )


def _white_noise(lines: Sequence[int]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return between which powers means of so many lines of white noise are, 19 times in 20."""
    from scipy.special import gammaincinv

    # The power of a line is chi-square with two degrees of freedom, over two.
    ends = (gammaincinv(lines, level) / lines for level in (0.025, 0.975))
    low, high = (tuple(end.tolist()) for end in ends)
    return low, high


def _quantiles(name: str, traces: Sequence[_ResidualTrace]) -> Iterator[Plot]:
    kept = [(drawn, drawn.trace.quantiles) for drawn in traces if drawn.trace.quantiles is not None]
    if not kept:
        return
    series = []
    rows, fewest = min(
        ((drawn.trace.rows or math.inf, drawn) for drawn, _ in kept), key=lambda pair: pair[0]
    )
    if math.isfinite(rows) and fewest.trace.quantiles is not None:
        normal = tuple(fewest.trace.quantiles.normal)
        half = tuple(_spread(z, rows) for z in normal)
        words = f"normal distribution, 95 % ({fewest.run})"
        low = tuple(-h for h in half)
        series.append(
            PlotSeries(words, normal, (0.0,) * len(normal), low, half, "band", colour="muted")
        )
    # Less the quantiles of the normal distribution, beside which all would look like one line.
    series += [
        PlotSeries(
            drawn.run,
            tuple(quantiles.normal),
            tuple(a - b for a, b in zip(quantiles.found, quantiles.normal, strict=True)),
            colour=drawn.colour,
        )
        for drawn, quantiles in kept
    ]
    yield Plot(
        title=f"Whitened residuals of {name} less those of a normal distribution",
        x_label="quantile of the normal distribution",
        y_label="residual less quantile",
        series=tuple(series),
        levels=(0.0,),
    )


def _spread(z: float, rows: float) -> float:
    """Return the half width, 95 %, of the quantile z of so many normal samples (for many)."""
    below = 0.5 * math.erfc(-z / math.sqrt(2.0))
    density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return _COVERAGE_FACTOR * math.sqrt(below * (1.0 - below) / rows) / density


def _scaled(values: Sequence[float], factor: float) -> tuple[float, ...]:
    return tuple(value * factor for value in values)


def ripple_plot(runs: Mapping[str, RunResult]) -> Plot | None:
    """Return the ripples found in the runs, in parts per million of the rate; None without any."""
    series = []
    for place, (name, run) in enumerate(runs.items()):
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
                    colour=place,
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
