"""Pictures of a report: descriptions of plots, bars and heat maps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from counterspin.calibration.pages.budget import evaluation_type
from counterspin.calibration.pages.uncertainty import source_label, split_budget
from counterspin.calibration.result_parts import AccelerometerResult, RunResult, Trace
from counterspin.frozen import frozen
from counterspin.reports.blocks import Bars, HeatMap, Plot, PlotSeries
from counterspin.reports.numbers import find_display_unit, format_share, format_uncertainty

#: Largest number of curves in a plot; more runs are divided into several plots.
_MAX_CURVES: Final = 6

#: Unit of residuals -> unit of plots and its factor.
_SUBMULTIPLE_UNITS: Final = {"m": ("mm", 1e3), "m/s": ("mm/s", 1e3), "m/s^2": ("mm/s^2", 1e3)}

_COVERAGE_FACTOR: Final = 1.96

#: Kind of a source -> index of its colour.
_KIND_COLOURS: Final = {"noise": 0, "unstated": 1, "stated": 2, "held": 3}
_REMAINDER_COLOUR: Final = 5


def correlation_map(name: str, accelerometer: AccelerometerResult) -> HeatMap | None:
    """Return a map of the correlations of the estimates; None for fewer than two estimates."""
    if accelerometer.correlation is None or len(accelerometer.correlation.terms) < 2:
        return None
    return HeatMap(
        title=f"Correlation of the estimates, {name}",
        labels=tuple(accelerometer.correlation.terms),
        values=tuple(tuple(row) for row in accelerometer.correlation.matrix),
    )


def budget_bars(name: str, accelerometer: AccelerometerResult, symbol: str = "K_II") -> Bars | None:
    """Return u^2 of a coefficient as a stacked bar by source, in %; None without a budget."""
    lines, small_lines = split_budget(accelerometer.budget.get(symbol, []))
    coefficient = accelerometer.coefficients.get(symbol)
    if not lines or coefficient is None:
        return None
    unit, factor = find_display_unit(coefficient.unit)
    labels = [
        f"{line.source if line.kind == 'noise' else source_label(line.source)} "
        f"(Type {evaluation_type(line, accelerometer)})"
        for line in lines
    ]
    colours = [_KIND_COLOURS[line.kind] for line in lines]
    contributions = [(line.contribution, line.share) for line in lines]
    if small_lines:
        labels.append(f"{len(small_lines)} more")
        colours.append(_REMAINDER_COLOUR)
        contributions.append(
            (
                math.hypot(*(line.contribution for line in small_lines)),
                sum(line.share for line in small_lines),
            )
        )
    return Bars(
        title=f"Uncertainty contributions to {symbol} of {name}, in {unit} (share of u^2 in %)",
        labels=tuple(labels),
        values=tuple(100.0 * share for _, share in contributions),
        texts=tuple(
            f"{format_uncertainty(contribution * factor)} ({format_share(share)})"
            for contribution, share in contributions
        ),
        stacked=True,
        colours=tuple(colours),
        x_label="Cumulative share of u^2, %",
    )


def jackknife_plot(name: str, accelerometer: AccelerometerResult) -> Plot | None:
    """Return a plot of K_II with each run omitted in turn; None without a jackknife."""
    k_ii = accelerometer.coefficients.get("K_II")
    lines = [line for line in accelerometer.jackknife if line.value is not None]
    if k_ii is None or k_ii.value is None or k_ii.u is None or not lines:
        return None
    unit, factor = find_display_unit(k_ii.unit)
    value, u = k_ii.value * factor, k_ii.u * factor
    x_values = tuple(float(index) for index in range(len(lines)))
    # The standard uncertainty of the shift is shift / z.
    shift_uncertainties = [
        abs(line.shift / line.z) * factor if line.shift is not None and line.z else 0.0
        for line in lines
    ]
    y_values = [line.value * factor for line in lines if line.value is not None]
    x_range = (x_values[0] - 0.5, x_values[-1] + 0.5)
    return Plot(
        title=f"K_II of {name} with each run omitted in turn",
        x_label="omitted run",
        y_label=f"K_II, {unit}",
        series=(
            PlotSeries(
                "all runs ± u",
                x_range,
                (value, value),
                low=(value - u, value - u),
                high=(value + u, value + u),
                kind="band",
            ),
            PlotSeries(
                "with this run omitted (error bar: standard uncertainty of the shift)",
                x_values,
                tuple(y_values),
                low=tuple(y - u for y, u in zip(y_values, shift_uncertainties, strict=True)),
                high=tuple(y + u for y, u in zip(y_values, shift_uncertainties, strict=True)),
                kind="points",
            ),
        ),
        x_names=tuple(line.run for line in lines),
    )


def residual_plots(
    name: str, accelerometer: AccelerometerResult, runs: Mapping[str, RunResult]
) -> Iterator[Plot]:
    """Yield the plots of an accelerometer's residuals."""
    yield from residuals_over_time(name, accelerometer, runs)
    unit, factor = _residual_unit(accelerometer)
    curves = _make_curves(accelerometer, runs)
    for start in range(0, len(curves), _MAX_CURVES):
        plotted_curves = curves[start : start + _MAX_CURVES]
        yield from _angle_plot(name, plotted_curves, unit, factor)
        yield from _spectrum_plot(name, plotted_curves)
        yield from _quantile_plot(name, plotted_curves)


def residuals_over_time(
    name: str, accelerometer: AccelerometerResult, runs: Mapping[str, RunResult]
) -> Iterator[Plot]:
    """Yield a plot of the residuals of each run; parameters as for `residual_plots`."""
    for curve in _make_curves(accelerometer, runs):
        yield _time_plot(name, curve, *_residual_unit(accelerometer))


def residual_spectra(
    name: str, accelerometer: AccelerometerResult, runs: Mapping[str, RunResult]
) -> Iterator[Plot]:
    """Yield plots of the spectra of the whitened residuals, with several runs in a plot."""
    curves = _make_curves(accelerometer, runs)
    for start in range(0, len(curves), _MAX_CURVES):
        yield from _spectrum_plot(name, curves[start : start + _MAX_CURVES])


def _residual_unit(accelerometer: AccelerometerResult) -> tuple[str, float]:
    return _SUBMULTIPLE_UNITS.get(accelerometer.residual.unit, (accelerometer.residual.unit, 1.0))


def _make_curves(accelerometer: AccelerometerResult, runs: Mapping[str, RunResult]) -> list[_Curve]:
    colours = {run: k for k, run in enumerate(dict.fromkeys([*runs, *accelerometer.traces]))}
    return [
        _Curve(run, colours[run], trace, runs[run].counts.get("block", 1) if run in runs else 1)
        for run, trace in accelerometer.traces.items()
    ]


@frozen
class _Curve:
    """Curve of the residuals of a run: colour, and number of samples in a block mean."""

    run: str
    colour: int
    trace: Trace
    block: int


def _time_plot(name: str, curve: _Curve, unit: str, factor: float) -> Plot:
    trace = curve.trace
    time = tuple(trace.time)
    low, high = _scale_values(trace.low, factor), _scale_values(trace.high, factor)
    centre = tuple(0.5 * (lower + upper) for lower, upper in zip(low, high, strict=True))
    sample_text = f"means of {curve.block} samples" if curve.block > 1 else "samples"
    label = f"{sample_text}, from smallest to largest" if low != high else sample_text
    series = [PlotSeries(label, time, centre, low, high, kind="band", colour=curve.colour)]
    if trace.rms is not None:
        # Two standard deviations, if the model is right.
        line_label, time_range = "± 2 rms", (time[0], time[-1])
        for level in (2.0 * factor * trace.rms, -2.0 * factor * trace.rms):
            series.append(PlotSeries(line_label, time_range, (level, level), colour="muted"))
            line_label = ""
    if trace.left_out:
        times, values = zip(*trace.left_out, strict=True)
        outliers = _scale_values(values, factor)
        label = "rejected as outliers"
        series.append(PlotSeries(label, tuple(times), outliers, kind="points", is_highlighted=True))
    return Plot(
        title=f"Residuals of {name}, {curve.run}",
        x_label="time, s",
        y_label=f"residual, {unit}",
        series=tuple(series),
        levels=(0.0,),
        zoom=True,
    )


def _angle_plot(name: str, curves: Sequence[_Curve], unit: str, factor: float) -> Iterator[Plot]:
    series = []
    for curve in curves:
        if curve.trace.by_angle is not None and curve.trace.by_angle.mean:
            mean = curve.trace.by_angle.mean
            step = 360.0 / len(mean)
            angles = tuple((index + 0.5) * step for index in range(len(mean)))
            values = tuple(None if value is None else value * factor for value in mean)
            series.append(PlotSeries(curve.run, angles, values, colour=curve.colour))
    if series:
        yield Plot(
            title=f"Mean residual of {name} as a function of the spindle angle",
            x_label="spindle angle, deg",
            y_label=f"mean residual, {unit}",
            series=tuple(series),
            levels=(0.0,),
        )


def _spectrum_plot(name: str, curves: Sequence[_Curve]) -> Iterator[Plot]:
    spectra = [
        (curve, curve.trace.spectrum)
        for curve in curves
        if curve.trace.spectrum is not None and len(curve.trace.spectrum.frequency) > 1
    ]
    if not spectra:
        return
    series = []
    # The band is widest for the run with the fewest lines.
    curve, spectrum = min(spectra, key=lambda pair: sum(pair[1].lines))
    if spectrum.lines:
        low, high = _white_noise_band(spectrum.lines)
        series.append(
            PlotSeries(
                f"white noise, 95 % ({curve.run})",
                tuple(spectrum.frequency),
                tuple(0.5 * (lower + upper) for lower, upper in zip(low, high, strict=True)),
                low,
                high,
                kind="band",
                colour="muted",
            )
        )
    series += [
        PlotSeries(curve.run, tuple(spectrum.frequency), tuple(spectrum.power), colour=curve.colour)
        for curve, spectrum in spectra
    ]
    yield Plot(
        title=f"Spectrum of the whitened residuals of {name}",
        x_label="frequency, Hz",
        y_label="power relative to white noise",
        series=tuple(series),
        levels=(1.0,),
        log_x=True,
        log_y=True,
    )


def _white_noise_band(lines: Sequence[int]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the 95 % band of the mean power of white noise for numbers of averaged lines."""
    from scipy.special import gammaincinv

    # The power of a line is chi-square with two degrees of freedom, over two.
    bounds = (gammaincinv(lines, level) / lines for level in (0.025, 0.975))
    low, high = (tuple(bound.tolist()) for bound in bounds)
    return low, high


def _quantile_plot(name: str, curves: Sequence[_Curve]) -> Iterator[Plot]:
    quantile_curves = [
        (curve, curve.trace.quantiles) for curve in curves if curve.trace.quantiles is not None
    ]
    if not quantile_curves:
        return
    series = []
    rows, shortest_curve = min(
        ((curve.trace.rows or math.inf, curve) for curve, _ in quantile_curves),
        key=lambda pair: pair[0],
    )
    if math.isfinite(rows) and shortest_curve.trace.quantiles is not None:
        z_values = tuple(shortest_curve.trace.quantiles.normal)
        half_widths = tuple(_quantile_half_width(z, rows) for z in z_values)
        label = f"normal distribution, 95 % ({shortest_curve.run})"
        low = tuple(-half_width for half_width in half_widths)
        series.append(
            PlotSeries(
                label, z_values, (0.0,) * len(z_values), low, half_widths, "band", colour="muted"
            )
        )
    # Minus the quantiles of the normal distribution: otherwise all curves would look alike.
    series += [
        PlotSeries(
            curve.run,
            tuple(quantiles.normal),
            tuple(
                sample - normal
                for sample, normal in zip(quantiles.found, quantiles.normal, strict=True)
            ),
            colour=curve.colour,
        )
        for curve, quantiles in quantile_curves
    ]
    yield Plot(
        title=f"Detrended normal Q-Q plot of whitened residuals of {name}",
        x_label="quantile of the normal distribution",
        y_label="residual minus quantile",
        series=tuple(series),
        levels=(0.0,),
    )


def _quantile_half_width(z: float, rows: float) -> float:
    """Return the half width of the 95 % interval of the quantile z of normal samples."""
    probability = 0.5 * math.erfc(-z / math.sqrt(2.0))
    density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return _COVERAGE_FACTOR * math.sqrt(probability * (1.0 - probability) / rows) / density


def _scale_values(values: Sequence[float], factor: float) -> tuple[float, ...]:
    return tuple(value * factor for value in values)


def ripple_plot(runs: Mapping[str, RunResult]) -> Plot | None:
    """Return a plot of the ripples of the runs, in ppm of the rate; None without ripples."""
    series = []
    for index, (name, run) in enumerate(runs.items()):
        if run.ripples:
            scale = 1e6 / abs(run.rate)
            amplitudes = [ripple.amplitude * scale for ripple in run.ripples]
            half_widths = [_COVERAGE_FACTOR * ripple.u_amplitude * scale for ripple in run.ripples]
            series.append(
                PlotSeries(
                    name,
                    tuple(float(ripple.harmonic) for ripple in run.ripples),
                    tuple(amplitudes),
                    low=tuple(y - u for y, u in zip(amplitudes, half_widths, strict=True)),
                    high=tuple(y + u for y, u in zip(amplitudes, half_widths, strict=True)),
                    kind="points",
                    colour=index,
                )
            )
    if not series:
        return None
    return Plot(
        title="Rate ripple by harmonic; error bars: 95 % intervals",
        x_label="harmonic of the rotation",
        y_label="amplitude, ppm of the rate",
        series=tuple(series),
        levels=(0.0,),
    )
