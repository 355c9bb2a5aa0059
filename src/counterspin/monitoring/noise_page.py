"""The noise of a record at rest, as a person reads it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

from counterspin.monitoring.result_noise import NoiseResult, NoiseSize, SignalNoise, shown_unit
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Plot, PlotSeries, Table
from counterspin.reports.numbers import format_estimate, format_number

#: What a file of the plots says that it is.
PLOTS: Final = "plots of noise"

#: Key of a component -> what it is called.
NAMES: Final = {
    "displacement": "white noise of the displacement, a sample",
    "velocity": "white noise of the velocity, a sample",
    "quantisation": "quantisation noise of the velocity, a sample",
    "acceleration": "white noise of the accelerometer, N",
    "flicker": "flicker (bias instability), B",
    "bias_walk": "random walk of the bias, K",
}

#: Averaging times of the table: every other one, an octave apart.
_EVERY: Final = 2


def noise_blocks(result: NoiseResult) -> Iterator[Block]:
    """Yield the components of each column, what to know of them, spectrum and Allan deviation."""
    yield Heading(f"Noise of {result.record}", 1)
    for signal in result.signals:
        yield Heading(signal.name)
        yield Paragraph(_first(signal, result.gravity), "answer")
        yield _components(signal, result.gravity)
        for remark in signal.remarks:
            yield Paragraph(remark)
        if signal.lines:
            yield _lines(signal, result.gravity)
        yield from noise_plots(signal, result.gravity)
        yield _allan(signal, result.gravity)
    yield Heading("For campaign.toml")
    for line in result.table.splitlines():
        yield Paragraph(line, "command")
    yield Paragraph(
        "Intervals are for 95 %. N^2 is a two-sided density, as in IEEE Std 952: the variance of "
        "velocity grows as N^2 t, and a one-sided spectrum is twice as high. The floor of the "
        "Allan deviation of flicker is 0.664 B.",
        "quiet",
    )
    if result.unused:
        yield Paragraph(f"Not taken: {', '.join(result.unused)}.", "quiet")
    if any(signal.in_g for signal in result.signals):
        gravity = format_number(result.gravity, 9)
        yield Paragraph(f"g = {gravity} m/s^2 converts between g and m/s^2.", "quiet")


def _shown(unit: str, signal: SignalNoise, gravity: float) -> tuple[str, float]:
    """Return the unit in which a quantity is shown, and the factor that leads to it."""
    return shown_unit(unit, signal.in_g, gravity)


def _first(signal: SignalNoise, gravity: float) -> str:
    size = signal.components["acceleration"]
    unit, factor = _shown(size.unit, signal, gravity)
    white = (
        f"N = {format_number(size.value * factor)} {unit}"
        if size.value is not None
        else f"N is below {_number(size.high, factor)} {unit}"
    )
    slow = []
    for key, name in (("flicker", "B"), ("bias_walk", "K")):
        own = signal.components[key]
        unit, factor = _shown(own.unit, signal, gravity)
        if own.value is not None:
            slow.append(f"{name} = {format_number(own.value * factor)} {unit}")
    beside = f", {' and '.join(slow)}" if slow else "; no slower noise is visible"
    rate = format_number(signal.sampling_rate, 5)
    return f"{white}{beside}, in {signal.seconds:.5g} s at {rate} Hz."


def _number(value: float | None, factor: float) -> str:
    return "-" if value is None else format_number(value * factor)


def _components(signal: SignalNoise, gravity: float) -> Table:
    rows = []
    for key, size in signal.components.items():
        unit, factor = _shown(size.unit, signal, gravity)
        value = "not seen" if size.value is None else format_number(size.value * factor)
        rows.append((NAMES[key], value, _interval(size, factor), unit))
    unit, factor = _shown("m/s^2/s", signal, gravity)
    drift = format_estimate(signal.drift * factor, signal.u_drift * factor)
    rows.append(("drift of the bias", drift, "", unit))
    columns = (
        Column("Component", wraps=True),
        Column("Size", "right"),
        Column("95 % interval", "right"),
        Column("Unit"),
    )
    quiet = [i for i, size in enumerate(signal.components.values()) if size.value is None]
    return Table(columns, tuple(rows), frozenset(quiet))


def _interval(size: NoiseSize, factor: float) -> str:
    if size.high is None:
        return f"above {_number(size.low, factor)}" if size.low > 0.0 else "any"
    if size.low == 0.0:
        return f"below {_number(size.high, factor)}"
    return f"{_number(size.low, factor)} to {_number(size.high, factor)}"


def _lines(signal: SignalNoise, gravity: float) -> Table:
    unit, factor = _shown("m/s^2", signal, gravity)
    rows = tuple(
        (
            format_estimate(line.frequency, line.u_frequency),
            format_estimate(line.amplitude * factor, line.u * factor),
            line.name or "",
        )
        for line in signal.lines
    )
    columns = (
        Column("Line, Hz", "right"),
        Column(f"Amplitude, {unit}", "right"),
        Column("May be", wraps=True),
    )
    return Table(columns, rows)


def _allan(signal: SignalNoise, gravity: float) -> Table:
    unit, factor = _shown("m/s^2", signal, gravity)
    rows = tuple(
        (
            format_number(point.tau),
            format_number(point.deviation * factor),
            f"{_number(point.low, factor)} to {_number(point.high, factor)}",
            format_number(point.dof),
            format_number(point.expected * factor),
        )
        for point in signal.allan[::_EVERY]
    )
    titles = ("Averaging time, s", f"Allan deviation, {unit}", "95 % interval")
    columns = (*titles, "Degrees of freedom", "By the components")
    return Table(tuple(Column(title, "right") for title in columns), rows)


def noise_plots(signal: SignalNoise, gravity: float) -> list[Plot]:
    """Return the Allan deviation and the spectrum of a column, with what the components make."""
    unit, factor = _shown("m/s^2", signal, gravity)
    tau = tuple(point.tau for point in signal.allan)
    allan = Plot(
        f"{signal.name}: overlapping Allan deviation",
        "averaging time, s",
        f"Allan deviation, {unit}",
        (
            PlotSeries(
                "record, 95 %",
                tau,
                tuple(point.deviation * factor for point in signal.allan),
                tuple(point.low * factor for point in signal.allan),
                tuple(point.high * factor for point in signal.allan),
                "points",
                colour=0,
            ),
            PlotSeries(
                "components",
                tau,
                tuple(point.expected * factor for point in signal.allan),
                colour=1,
            ),
        ),
        log_x=True,
        log_y=True,
    )
    unit, factor = _shown("m/s^2/Hz^0.5", signal, gravity)
    at = tuple(point.frequency for point in signal.spectrum)
    density = Plot(
        f"{signal.name}: spectral density",
        "frequency, Hz",
        f"root of the two-sided density, {unit}",
        (
            PlotSeries(
                "record, 95 %",
                at,
                tuple(math.sqrt(point.density) * factor for point in signal.spectrum),
                tuple(math.sqrt(point.low) * factor for point in signal.spectrum),
                tuple(math.sqrt(point.high) * factor for point in signal.spectrum),
                "points",
                colour=0,
            ),
            PlotSeries(
                "components",
                at,
                tuple(math.sqrt(point.expected) * factor for point in signal.spectrum),
                colour=1,
            ),
        ),
        log_x=True,
        log_y=True,
    )
    return [allan, density]
