"""Reports of checked records, of a campaign during recording, and of noise analyses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

from counterspin.inference.noise.components import BIAS_COMPONENTS_BY_KEY, COMPONENTS_BY_KEY
from counterspin.monitoring.result import (
    CheckedRun,
    CurrentEstimate,
    GoalState,
    NoiseResult,
    NoiseSize,
    PosesState,
    RunState,
    SignalNoise,
    WatchState,
    component_name,
    noise_display_unit,
)
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Plot, PlotSeries, Table
from counterspin.reports.numbers import (
    NOT_DETERMINED,
    find_display_unit,
    format_estimate,
    format_items,
    format_number,
    format_p,
    format_uncertainty,
)


def format_watch_line(state: WatchState) -> str:
    """Return a state in one line."""
    runs = ", ".join(f"{run.run} {_format_progress(run)}" for run in state.runs)
    u_text = ", ".join(f"u({c.name}) {_format_u(c.u, c.unit)}" for c in state.coefficients)
    ratios = [r.ratio for run in state.runs for r in run.residuals.values()]
    residual_text = f"; residuals {max(ratios):.2f} times the noise" if ratios else ""
    goal_text = "; goal met" if state.met else ""
    return f"{runs}; {u_text}{residual_text}{goal_text}"


def check_blocks(checked_run: CheckedRun) -> Iterator[Block]:
    """Yield the report of a checked record."""
    run = checked_run.run
    yield Heading(f"{run.run}: {run.record}", 1)
    if checked_run.good:
        verdict = (
            "The run is usable, with these remarks:"
            if checked_run.remarks
            else "The run is usable."
        )
    else:
        verdict = "The run failed its checks and should be repeated."
    yield Paragraph(verdict, "answer" if checked_run.good else "warning")
    for remark in checked_run.remarks:
        yield Paragraph(remark, "plain" if checked_run.good else "warning")
    if run.state == "read":
        rows = tuple(_run_rows(run))
        yield Table((Column("What"), Column("Found", wraps=True)), rows)
    if checked_run.reached:
        other_names = ", ".join(checked_run.others)
        yield Heading("Expected uncertainty")
        yield _coefficient_table(
            checked_run,
            f"with {other_names}"
            if other_names
            else "uncertainty from this record and the priors alone",
        )
    if checked_run.why_not and run.state == "read":
        yield Paragraph(
            f"A forecast for the whole campaign is not possible, because {checked_run.why_not}.",
            "quiet",
        )


def _coefficient_table(checked_run: CheckedRun, current_title: str) -> Table:
    expected_by_name = {c.name: c for c in checked_run.expected}
    rows = []
    for c in checked_run.reached:
        expected_estimate = expected_by_name.get(c.name)
        rows.append(
            (
                c.name,
                _format_estimate(c),
                _format_u(expected_estimate.u, expected_estimate.unit)
                if expected_estimate
                else "-",
            )
        )
    titles = ("Coefficient", current_title.capitalize(), "uncertainty of the whole campaign")
    n_columns = len(titles) if expected_by_name else len(titles) - 1
    return Table(
        tuple(Column(title, wraps=True) for title in titles[:n_columns]),
        tuple(row[:n_columns] for row in rows),
    )


def _run_rows(run: RunState) -> Iterator[tuple[str, str]]:
    sampling_rate_text = f"{format_number(run.sampling_rate, 5)} Hz" if run.sampling_rate else "-"
    repeated_text = f", {format_items(run.repeated, 'repeated row')}" if run.repeated else ""
    gaps_text = (
        f", {format_items(run.gaps, 'gap')}, the longest {run.longest_gap:.3g} s"
        if run.gaps
        else ", no gaps"
    )
    stated_text = f" out of {run.stated_seconds:.5g} s" if run.stated_seconds else ""
    yield (
        "Clock",
        f"{run.rows} rows at {sampling_rate_text}, {run.seconds:.5g} s"
        f"{stated_text}{gaps_text}{repeated_text}",
    )
    if run.poses is not None:
        yield from _pose_rows(run, run.poses)
        return
    if run.rate is None or run.u_rate is None:
        if run.nominal_rate:
            yield "Angle", "not recorded; the nominal rate is used"
    else:
        relative_deviation = run.rate / run.nominal_rate - 1.0
        yield (
            "Rate",
            f"{format_estimate(run.rate, run.u_rate, 'rad/s')}, nominal {run.nominal_rate:.7g} "
            f"({'+' if relative_deviation >= 0.0 else ''}{format_number(relative_deviation, 2)})",
        )
        yield "Rate drift", f"{format_number(run.drift or 0.0)} 1/s"
        yield "Ripple", _format_ripple(run)
        rms_text = f"{format_number(run.angle_rms)} rad" if run.angle_rms else "-"
        yield "Angle residuals", f"rms {rms_text}"
    yield "Rejected or empty", _format_omitted(run)
    for name, mean in run.means.items():
        averaging_text = (
            f" over {format_items(mean.revolutions, 'revolution')}" if mean.revolutions else ""
        )
        yield f"Mean of {name}", f"{format_estimate(mean.value, mean.u, 'g')}{averaging_text}"
    for name, residual in run.residuals.items():
        stated_noise_text = (
            f", stated {format_number(residual.stated)} {residual.unit}" if residual.stated else ""
        )
        p_text = "" if residual.p is None else f", {format_p(residual.p)}"
        yield (
            f"Residuals of {name}",
            f"rms {format_number(residual.rms)} {residual.unit}{stated_noise_text}; "
            f"{residual.ratio:.3f} times the noise{p_text}",
        )


def _format_omitted(run: RunState) -> str:
    return f"{format_items(run.outliers, 'outlier')}, {format_items(run.empty, 'empty cell')}"


def _pose_rows(run: RunState, poses: PosesState) -> Iterator[tuple[str, str]]:
    rms = (
        ""
        if poses.rms is None
        else f", rms of the remaining |f| - g: {format_number(poses.rms)} m/s^2"
    )
    yield "Poses", f"{poses.count}{rms}"
    yield "At rest", f"where the scatter is below {format_number(poses.threshold)} m/s^2"
    yield "Rejected or empty", _format_omitted(run)
    yield "Deviations from the model", ", ".join(poses.outlying) or "none"
    yield "Missing directions", "; ".join(poses.missing) or "none"


def _format_ripple(run: RunState) -> str:
    if run.ripple is None:
        return "none detected"
    relative_ripple = run.ripple / abs(run.rate or run.nominal_rate)
    return f"{format_number(relative_ripple, 2)} of the rate at harmonic {run.harmonic}"


def watch_blocks(state: WatchState) -> Iterator[Block]:
    """Yield the report of a campaign during recording."""
    yield Heading(state.title or "Campaign", 1)
    for event in state.events:
        yield Paragraph(event, "warning")
    columns = [Column("Run"), Column("Recorded", wraps=True)]
    if any(run.nominal_rate for run in state.runs):
        titles = ("Rate, rad/s", "Ripple", "Residuals / noise")
        columns += [Column(title, "right") for title in titles]
    yield Table(
        tuple(columns),
        tuple(_watch_row(run)[: len(columns)] for run in state.runs),
        quiet_rows=frozenset(i for i, run in enumerate(state.runs) if run.state == "waiting"),
    )
    for run in state.runs:
        if run.state == "failed" or (run.state == "read" and run.why):
            yield Paragraph(f"{run.run}: {run.why}", "warning")
        if run.poses is not None and run.poses.outlying:
            names = ", ".join(run.poses.outlying)
            yield Paragraph(f"{run.run}: poses that deviate from the model: {names}", "warning")
        if run.poses is not None and run.poses.missing:
            missing_text = "; ".join(run.poses.missing)
            yield Paragraph(f"{run.run}: add poses with {missing_text}")
    if state.trouble:
        yield Paragraph(state.trouble, "warning")
    goal_by_name = {goal.name: goal for goal in state.goals}
    columns = [Column("Coefficient"), Column("So far", "right")]
    columns += [Column("Goal", wraps=True)] * bool(goal_by_name)
    rows = (
        (c.name, _format_estimate(c), _format_goal(goal_by_name.get(c.name)))
        for c in state.coefficients
    )
    yield Table(tuple(columns), tuple(row[: len(columns)] for row in rows))
    if state.met:
        yield Paragraph("The goal is met.", "answer")
    if state.complete:
        yield Paragraph("Every run has reached the duration stated in the campaign.", "answer")


def _watch_row(run: RunState) -> tuple[str, ...]:
    ratio_text = ", ".join(f"{r.ratio:.3f}" for r in run.residuals.values())
    rate = "" if run.rate is None else f"{run.rate:.7g}"
    ripple_text = ""
    if run.rate is not None:
        ripple_text = (
            "none detected" if run.ripple is None else format_number(run.ripple / abs(run.rate), 2)
        )
    return run.run, _format_progress(run), rate, ripple_text, ratio_text


def _format_progress(run: RunState) -> str:
    if run.state == "waiting":
        return f"waits: {run.why}" if run.why else "waits"
    if run.state == "failed":
        return f"{run.rows} rows, not usable"
    stated_duration = f" of {run.stated_seconds:.4g}" if run.stated_seconds else ""
    poses = f", poses: {run.poses.count}" if run.poses else ""
    return f"{run.seconds:.4g}{stated_duration} s, {run.rows} rows{poses}"


def _format_estimate(c: CurrentEstimate) -> str:
    unit, factor = find_display_unit(c.unit)
    if c.value is None or c.u is None:
        return NOT_DETERMINED
    return format_estimate(c.value * factor, c.u * factor, unit)


def _format_u(u: float | None, unit: str) -> str:
    display_unit, factor = find_display_unit(unit)
    if u is None or not math.isfinite(u):
        return NOT_DETERMINED
    return f"{format_uncertainty(u * factor)} {display_unit}"


def _format_goal(goal: GoalState | None) -> str:
    if goal is None:
        return ""
    return f"u {_format_u(goal.wanted, goal.unit)}: {'met' if goal.met else 'not yet'}"


#: Description in the file of the plots.
FILE_DESCRIPTION: Final = "plots of noise"

#: Stride of the averaging times in the table, which are then an octave apart.
_ALLAN_TABLE_STRIDE: Final = 2


def noise_blocks(result: NoiseResult) -> Iterator[Block]:
    """Yield the components of each column, remarks, spectrum and Allan deviation."""
    yield Heading(f"Noise of {result.record}", 1)
    for signal in result.signals:
        yield Heading(signal.name)
        yield Paragraph(_summary_sentence(signal, result.gravity), "answer")
        yield _component_table(signal, result.gravity)
        for remark in signal.remarks:
            yield Paragraph(remark)
        if signal.lines:
            yield _line_table(signal, result.gravity)
        yield from noise_plots(signal, result.gravity)
        yield _allan_table(signal, result.gravity)
    yield Heading("For campaign.toml")
    for line in result.table.splitlines():
        yield Paragraph(line, "command")
    yield Paragraph(
        "Intervals have 95 % coverage. N^2 is a two-sided density, as in IEEE Std 952. The "
        "variance of the velocity grows as N^2 t, and a one-sided spectrum is twice as high. "
        "For flicker noise, the minimum of the Allan deviation is 0.664 B.",
        "quiet",
    )
    if result.unused:
        yield Paragraph(f"Columns not used: {', '.join(result.unused)}.", "quiet")
    if any(signal.in_g for signal in result.signals):
        gravity_text = format_number(result.gravity, 9)
        yield Paragraph(f"Conversions between g and m/s^2 use g = {gravity_text} m/s^2.", "quiet")


def _display_unit(unit: str, signal: SignalNoise, gravity: float) -> tuple[str, float]:
    """Return the display unit of a quantity, and the conversion factor to it."""
    return noise_display_unit(unit, signal.in_g, gravity)


def _summary_sentence(signal: SignalNoise, gravity: float) -> str:
    noise_size = signal.components["acceleration"]
    unit, factor = _display_unit(noise_size.unit, signal, gravity)
    white_noise_text = (
        f"N = {format_number(noise_size.value * factor)} {unit}"
        if noise_size.value is not None
        else f"N is below {_format_scaled(noise_size.high, factor)} {unit}"
    )
    bias_texts = []
    for key in BIAS_COMPONENTS_BY_KEY:
        component = signal.components[key]
        unit, factor = _display_unit(component.unit, signal, gravity)
        if component.value is not None:
            symbol = COMPONENTS_BY_KEY[key].symbol
            bias_texts.append(f"{symbol} = {format_number(component.value * factor)} {unit}")
    bias_text = (
        f", {' and '.join(bias_texts)}"
        if bias_texts
        else "; no noise at lower frequencies detected"
    )
    rate = format_number(signal.sampling_rate, 5)
    return f"{white_noise_text}{bias_text}, in {signal.seconds:.5g} s at {rate} Hz."


def _format_scaled(value: float | None, factor: float) -> str:
    return "-" if value is None else format_number(value * factor)


def _component_table(signal: SignalNoise, gravity: float) -> Table:
    rows = []
    for key, size in signal.components.items():
        unit, factor = _display_unit(size.unit, signal, gravity)
        value = "not detected" if size.value is None else format_number(size.value * factor)
        component = COMPONENTS_BY_KEY.get(key)
        symbol_text = component.symbol if component else "per sample"
        name = f"{component_name(key)}, {symbol_text}"
        rows.append((name, value, _format_interval(size, factor), unit))
    unit, factor = _display_unit("m/s^2/s", signal, gravity)
    drift_text = format_estimate(signal.drift * factor, signal.u_drift * factor)
    rows.append(("bias drift", drift_text, "", unit))
    columns = (
        Column("Component", wraps=True),
        Column("Size", "right"),
        Column("95 % interval", "right"),
        Column("Unit"),
    )
    quiet_rows = [i for i, size in enumerate(signal.components.values()) if size.value is None]
    return Table(columns, tuple(rows), frozenset(quiet_rows))


def _format_interval(noise_size: NoiseSize, factor: float) -> str:
    if noise_size.high is None:
        return f"above {_format_scaled(noise_size.low, factor)}" if noise_size.low > 0.0 else "any"
    if noise_size.low == 0.0:
        return f"below {_format_scaled(noise_size.high, factor)}"
    return f"{_format_scaled(noise_size.low, factor)} to {_format_scaled(noise_size.high, factor)}"


def _line_table(signal: SignalNoise, gravity: float) -> Table:
    unit, factor = _display_unit("m/s^2", signal, gravity)
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
        Column("Possible source", wraps=True),
    )
    return Table(columns, rows)


def _allan_table(signal: SignalNoise, gravity: float) -> Table:
    unit, factor = _display_unit("m/s^2", signal, gravity)
    rows = tuple(
        (
            format_number(point.tau),
            format_number(point.deviation * factor),
            f"{_format_scaled(point.low, factor)} to {_format_scaled(point.high, factor)}",
            format_number(point.dof),
            format_number(point.expected * factor),
        )
        for point in signal.allan[::_ALLAN_TABLE_STRIDE]
    )
    titles = ("Averaging time, s", f"Allan deviation, {unit}", "95 % interval")
    columns = (*titles, "Degrees of freedom", "Calculated from the components")
    return Table(tuple(Column(title, "right") for title in columns), rows)


def noise_plots(signal: SignalNoise, gravity: float) -> list[Plot]:
    """Return plots of the Allan deviation and the spectrum of a column and its components."""
    unit, factor = _display_unit("m/s^2", signal, gravity)
    taus = tuple(point.tau for point in signal.allan)
    allan_plot = Plot(
        f"{signal.name}: overlapping Allan deviation",
        "averaging time, s",
        f"Allan deviation, {unit}",
        (
            PlotSeries(
                "record, 95 %",
                taus,
                tuple(point.deviation * factor for point in signal.allan),
                tuple(point.low * factor for point in signal.allan),
                tuple(point.high * factor for point in signal.allan),
                "points",
                colour=0,
            ),
            PlotSeries(
                "components",
                taus,
                tuple(point.expected * factor for point in signal.allan),
                colour=1,
            ),
        ),
        log_x=True,
        log_y=True,
    )
    unit, factor = _display_unit("m/s^2/Hz^0.5", signal, gravity)
    frequencies = tuple(point.frequency for point in signal.spectrum)
    spectrum_plot = Plot(
        f"{signal.name}: spectral density",
        "frequency, Hz",
        f"square root of two-sided density, {unit}",
        (
            PlotSeries(
                "record, 95 %",
                frequencies,
                tuple(math.sqrt(point.density) * factor for point in signal.spectrum),
                tuple(math.sqrt(point.low) * factor for point in signal.spectrum),
                tuple(math.sqrt(point.high) * factor for point in signal.spectrum),
                "points",
                colour=0,
            ),
            PlotSeries(
                "components",
                frequencies,
                tuple(math.sqrt(point.expected) * factor for point in signal.spectrum),
                colour=1,
            ),
        ),
        log_x=True,
        log_y=True,
    )
    return [allan_plot, spectrum_plot]
